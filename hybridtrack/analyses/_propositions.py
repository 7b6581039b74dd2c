"""Bounds on the detection delay: Hwang, Balakrishnan, Tomlin 2006, propositions 4.1 to 4.4.

Mode T is true from a switch on, i any other mode; step k_l is the last before the switch, delta is
the delay. With means of residuals r and of errors e, on filters in steady state, mode T is detected
at k_l + delta where

    r_T' S_T^-1 r_T < r_i' S_i^-1 r_i + ln |S_i|/|S_T| + 2 ln (mu_T^- / mu_i^-)        (14)

What is printed otherwise, and computed so where `as_printed` is:

- (14) and all after it have 2 ln |S_i|/|S_T|, from a density with |S|^-1 for |S|^-1/2;
- (18) bounds the wrong filter's residual below by the least singular values of L_i and of
  [F_i G_x G_u]. Both are wide, so the vectors that they act upon may be such that nothing is left:
  the greatest lower bound is 0, and so it is taken here;
- condition 2 of proposition 4.2 divides by ln(sigma_min(F_i)/sigma_max(F_T)), which must be
  positive, or the inequality turns round; its C_T A_T is wide too, and ||a + b||^2 is taken for
  ||a||^2 + ||b||^2; J is printed with b at k_l + delta - 2, and b is that at k_l + delta - 1;
- beta(k_l + delta) of proposition 4.2 rests on mode probabilities after the switch. Taken from the
  mean trajectory it holds once the mode was noticed, which was to be predicted (`..._along`); it is
  a prediction with beta(k_l + 1), which is known at the switch;
- proposition 4.4 has e at k_l - 1 and one factor [F_i G_x G_u] too many for that; and with the
  paper's transition matrix, whose columns sum to 1 (eq. 2), its pi_jT/pi_jj is the transpose's.

All need the bank to have estimated the old mode when it ended; 4.3 and 4.4 a transition matrix that
is diagonally dominant, as is said before them. Errors grow by F_T from step to step in filters that
run alone. The IMM's mix, so that of it the bounds are right at the first step only.
"""

import math
from typing import NamedTuple

import numpy as np

from hybridtrack.analyses._mean_course import MeanBank, Switch
from hybridtrack.analyses._steady_filters import SteadyFilter, difference
from hybridtrack.delays import LONGEST
from hybridtrack.models import Array

NEVER = "never satisfied"
ROUNDING = 1e-10  # relative to the state: errors below it are none
CONDITIONS = (
    "proposition_4_1",
    "proposition_4_1_condition_3",
    "proposition_4_2",
    "proposition_4_2_condition_1",
    "proposition_4_2_condition_1_along",
    "proposition_4_2_condition_2",
    "proposition_4_3",
    "proposition_4_4",
)
FROM_THEN_ON = ("proposition_4_1", "proposition_4_1_condition_3")  # to the end of the stay


class Bound(NamedTuple):
    """What a proposition says of a switch."""

    delay_steps: float | None  # infinite where it is never satisfied; None: a premise fails
    result: str  # in words


class Ingredients(NamedTuple):
    """What the bounds are made of, for mode T against mode i at a switch."""

    alpha: float  # lambda_min(S_i^-1) / lambda_max(S_T^-1)
    beta: float  # at the first step after the switch
    sigma_max_C_T_A_T: float
    sigma_min_C_T_A_T: float
    sigma_max_F_T: float
    sigma_min_F_i: float
    sigma_min_L_i: float  # the least of its n_y singular values
    sigma_min_F_i_G_i: float  # that of [F_i G_x G_u]
    error_T: float  # norm of the mean error that filter T begins the first step with
    error_i: float
    log_determinant_ratio: float  # ln |S_i|/|S_T|


class Rival(NamedTuple):
    """Mode T against one other mode at a switch."""

    ingredients: Ingredients
    holds: dict[str, Array]  # by condition (stay,): whether it holds after 1, 2, ... steps
    premise: dict[str, str]  # by condition: what fails, where a premise does


class _Stay(NamedTuple):
    """Both filters over the stay in mode T."""

    r_T: Array  # (n, n_y) mean residuals
    r_i: Array
    ln_mu: Array  # (n,) ln mu_T^-/mu_i^-
    e_T: Array  # (n_x,) mean errors that the first step begins with
    e_i: Array
    before_T: float  # their norms a step earlier
    before_i: float


def rival(
    bank: MeanBank,
    switch: Switch,
    filters: list[SteadyFilter],
    new: int,
    other: int,
    truth: Array,
    transition: Array,
    as_printed: bool,
) -> Rival:
    """Filter `new` (T) against filter `other` (i) over the stay after a switch.

    truth (n_steps + 1, n_x): the states; transition (n_modes, n_modes), row = from.
    """
    T, i = filters[new], filters[other]
    d = difference(i, T)
    stay = _stay(bank, switch, new, other, truth)
    CA = T.C @ T.A
    parts = (CA, d.F_i, np.column_stack([CA, d.H_x, d.H_u]), np.column_stack([d.F_i, d.G_x, d.G_u]))
    least_CA, least_F_i, least_L, least_FG = (
        float(np.linalg.svd(part, compute_uv=False)[-1]) for part in parts
    )
    sigma_CA, sigma_F_T = float(np.linalg.norm(CA, 2)), float(np.linalg.norm(d.F_T, 2))
    error_T, error_i = float(np.linalg.norm(stay.e_T)), float(np.linalg.norm(stay.e_i))
    information = d.largest_information
    ln_S = (2.0 if as_printed else 1.0) * d.log_determinants
    steps = np.arange(len(stay.r_T), dtype=float)  # delta - 1
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        beta = (ln_S + 2.0 * stay.ln_mu) / information
        left = (sigma_CA * sigma_F_T**steps * error_T) ** 2
        right = np.zeros_like(left)
        if as_printed:
            right = d.alpha * (least_L * least_FG**steps * error_i) ** 2
        own, theirs = (
            np.einsum("km,km->k", r, np.linalg.solve(one.innovation_covariance, r.T).T)
            for r, one in ((stay.r_T, T), (stay.r_i, i))
        )
        rest = theirs + ln_S + 2.0 * stay.ln_mu
        squares_T, squares_i = ((r**2).sum(axis=1) for r in (stay.r_T, stay.r_i))
        leaves = np.log(transition[other, new]) - np.log(transition[other, other])
        at_once = np.log(_smallest_ratio(transition, new, as_printed))
        if as_printed:
            known = d.alpha * (least_L * least_FG * stay.before_i) ** 2
            instant = known + (ln_S + 2.0 * at_once) / information > (sigma_CA * stay.before_T) ** 2
        else:
            instant = (ln_S + 2.0 * at_once) / information > left[0]
        holds = {
            "proposition_4_1": (rest > 0) & (own < rest),
            "proposition_4_1_condition_3": (rest > 0) & (squares_T < d.alpha * squares_i + beta),
            "proposition_4_2_condition_1": (rest > 0) & (left < beta[0] + right),
            "proposition_4_2_condition_1_along": (rest > 0) & (left < beta + right),
            "proposition_4_2_condition_2": np.zeros(len(steps), dtype=bool),
            "proposition_4_3": left < right + (ln_S + 2.0 * leaves) / information,
            "proposition_4_4": np.array([bool(instant)]),
        }
        if as_printed:
            inner = -np.log(d.alpha) + 2.0 * (np.log(sigma_CA) - np.log(least_CA))
            inner += 2.0 * (np.log(error_T) - np.log(error_i))
            bound = 1.0 + inner / (2.0 * (np.log(least_F_i) - np.log(sigma_F_T)))
            squares_b = _without_start(stay, CA, d.F_i)
            not_negative = d.alpha * squares_b + beta[0] >= 0
            holds["proposition_4_2_condition_2"] = (rest > 0) & (steps + 1.0 > bound) & not_negative
        holds["proposition_4_2"] = (
            holds["proposition_4_2_condition_1"] | holds["proposition_4_2_condition_2"]
        )
    premise: dict[str, str] = {}
    if not _is_dominant(transition):
        premise["proposition_4_3"] = premise["proposition_4_4"] = (
            "the transition matrix is not diagonally dominant"
        )
    if len(filters) != 2:
        premise["proposition_4_3"] = f"it is for two modes, and there are {len(filters)}"
    if not as_printed and least_F_i <= sigma_F_T:
        premise["proposition_4_2_condition_2"] = (
            f"sigma_min(F_i) = {least_F_i:.3g} is not above sigma_max(F_T) = {sigma_F_T:.3g}"
        )
    elif not as_printed:
        # Whatever its singular values: a wide matrix bounds nothing, a square one not the sum.
        n_y, n_x = CA.shape
        premise["proposition_4_2_condition_2"] = (
            f"C_T A_T is {n_y} x {n_x}, so nothing bounds the wrong filter's residual below"
            if n_y < n_x
            else "the cross term of the wrong filter's residual has no bound"
        )
    ingredients = Ingredients(
        alpha=d.alpha,
        beta=float(beta[0]),
        sigma_max_C_T_A_T=sigma_CA,
        sigma_min_C_T_A_T=least_CA,
        sigma_max_F_T=sigma_F_T,
        sigma_min_F_i=least_F_i,
        sigma_min_L_i=least_L,
        sigma_min_F_i_G_i=least_FG,
        error_T=error_T,
        error_i=error_i,
        log_determinant_ratio=d.log_determinants,
    )
    return Rival(ingredients, holds, premise)


def _stay(bank: MeanBank, switch: Switch, new: int, other: int, truth: Array) -> _Stay:
    span = slice(switch.step - 1, min(switch.last, switch.step - 1 + LONGEST))
    with np.errstate(invalid="ignore"):
        ln_mu = bank.log_predicted[span, new] - bank.log_predicted[span, other]
    k = switch.step - 1
    rounding = ROUNDING * float(np.abs(truth).max(initial=1.0))

    def error(step: int, mode: int) -> Array:
        e = truth[max(step, 0)] - bank.start[max(step, 0), mode]
        return np.where(np.abs(e) > rounding, e, 0.0)

    before = (float(np.linalg.norm(error(k - 1, mode))) for mode in (new, other))
    return _Stay(
        bank.residual[span, new],
        bank.residual[span, other],
        np.where(np.isnan(ln_mu), 0.0, ln_mu),
        error(k, new),
        error(k, other),
        *before,
    )


def _without_start(stay: _Stay, CA: Array, F_i: Array) -> Array:
    """||b_i||^2 (n,): the wrong filter's residuals without what its first error leaves in them."""
    left, squares = stay.e_i, np.empty(len(stay.r_i))
    for k, residual in enumerate(stay.r_i):
        squares[k] = ((residual - CA @ left) ** 2).sum()
        left = F_i @ left
    return squares


def _is_dominant(transition: Array) -> bool:
    """Whether every mode rather stays than leaves."""
    return bool((np.diagonal(transition) > 0.5).all())


def _smallest_ratio(transition: Array, new: int, as_printed: bool) -> float:
    """The least P(mode T next | mode j now) / P(mode j next | mode j now), j other than T."""
    entries = transition[new] if as_printed else transition[:, new]
    stays = np.diagonal(transition)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = [entries[j] / stays[j] for j in range(len(transition)) if j != new]
    return float(min(ratios))


def bounds(rivals: list[Rival]) -> dict[str, Bound]:
    """Each condition against all other modes together."""
    found = {}
    for name in CONDITIONS:
        failing = [r.premise[name] for r in rivals if name in r.premise]
        if failing:
            found[name] = Bound(None, f"premise fails: {failing[0]}")
            continue
        holds = np.logical_and.reduce([r.holds[name] for r in rivals])
        if name in FROM_THEN_ON:
            holds = np.logical_and.accumulate(holds[::-1])[::-1]
        if not holds.any():
            found[name] = Bound(math.inf, NEVER)
        else:
            delay = float(np.argmax(holds)) + 1.0
            found[name] = Bound(delay, f"{delay:.0f}")
    return found
