"""How long a mode must last for the mean error to shrink: as printed, rate-correct and direct.

Hwang, Balakrishnan and Tomlin 2003, section 3. The mean error of the filter of mode m obeys
e <- F_m e, and e <- F_m e + u in the steps between a switch to mode l and its detection, with
u = ((A_m - A_l) - K_m (C_m - C_l)) x + b_m - b_l. The paper's systems have no input b.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.analyses._eigenstructure import Eigenstructure, power_bound, steps_until_below
from hybridtrack.analyses._predictor_filters import PredictorFilter
from hybridtrack.analyses._sojourn_numbers import as_set, number
from hybridtrack.errors import Unsuited
from hybridtrack.models import Array, JumpMarkovModel

LONGEST_STEPS = 50_000  # no bound beyond this is looked for
BLOCK_STEPS = 1024  # powers of F that are worked out together
CANCELS = 1e-12  # what is left of equal entries, relative to their size: rounding
MOST_CORNERS = 12  # states that count, beyond which the corners of their box are not visited


# ---- what a wrong filter adds at every step --------------------------------------------------


class Mismatch(NamedTuple):
    """u = state_effect x + input_effect while mode `actual` is taken for mode `believed`."""

    state_effect: Array  # (n_modes, n_modes, n_x, n_x), [believed, actual]
    input_effect: Array  # (n_modes, n_modes, n_x)

    @property
    def counts(self) -> NDArray[np.bool_]:
        """The states (n_x,) that u depends on; the others cancel, however large they are."""
        counts: NDArray[np.bool_] = (self.state_effect != 0.0).any(axis=(0, 1, 2))
        return counts


class StateBound(NamedTuple):
    """How large the mean state may be."""

    each: Array  # (n_x,) |x_i| at most; inf where nothing is known
    norm: float  # 2-norm, at most, of the states that count; inf where nothing is known


class DisturbanceBounds(NamedTuple):
    """Bounds on u; None where a state that counts has no bound."""

    printed: float | None  # eq. 38: the 1-norm of the state effect times X, which is no bound
    infinity: float | None  # on every entry of u: the infinity norm times X, and the inputs
    euclidean: float | None  # on the 2-norm of u


def mismatch(model: JumpMarkovModel, filters: Sequence[PredictorFilter]) -> Mismatch:
    """What every filter adds in every other mode; model with n_times = 1."""
    A, b, C = model.state_transition[0], model.input_effect[0], model.measurement_matrix
    K = np.stack([one.gain for one in filters])
    gained = K[:, np.newaxis] @ (C[:, np.newaxis] - C)
    effect = A[:, np.newaxis] - A - gained
    size = np.maximum(np.abs(A[:, np.newaxis]), np.abs(A)) + np.abs(gained)
    effect[np.abs(effect) <= CANCELS * size] = 0.0
    return Mismatch(effect, b[:, np.newaxis] - b)


def disturbance_bounds(mismatch: Mismatch, state: StateBound) -> DisturbanceBounds:
    """The three bounds on u over every two modes.

    X, the bound on every state of the first two, is the largest of those of the states that count.
    The third takes the largest ||u|| over the corners of the box of bounds, or the 2-norm of the
    effect times the state's norm, whichever is smaller.
    """
    effect, inputs, counts = *mismatch, mismatch.counts
    X = float(state.each[counts].max(initial=0.0))
    printed = infinity = None
    if math.isfinite(X):
        printed, _ = state_effects(mismatch, X)
        rows = np.abs(effect).sum(axis=-1).max(axis=-1) * X + np.abs(inputs).max(axis=-1)
        infinity = float(rows.max())
    largest = max(
        _largest_norm(D[:, counts], d, state.each[counts], state.norm)
        for D, d in zip(
            effect.reshape(-1, *effect.shape[2:]), inputs.reshape(-1, len(counts)), strict=True
        )
    )
    return DisturbanceBounds(printed, infinity, largest if math.isfinite(largest) else None)


def state_effects(mismatch: Mismatch, largest_state: float) -> tuple[float, float]:
    """The largest 1-norm and the largest infinity norm of the state effects, times X."""
    sizes = np.abs(mismatch.state_effect)
    columns, rows = (float(sizes.sum(axis=axis).max(initial=0.0)) for axis in (-2, -1))
    return columns * largest_state, rows * largest_state


def _largest_norm(effect: Array, offset: Array, each: Array, norm: float) -> float:
    """The largest ||D x + d|| known; D (n_x, states that count)."""
    known = float(np.linalg.norm(offset))
    if not effect.any():
        return known
    by_norm = math.inf
    if math.isfinite(norm):
        by_norm = float(np.linalg.norm(effect, 2)) * norm + known
    if not np.isfinite(each).all():
        return by_norm
    if len(each) > MOST_CORNERS:
        by_box = float(np.linalg.norm(np.abs(effect) @ each + np.abs(offset)))
    else:  # a convex function is largest at a corner
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=len(each)))) * each
        by_box = float(np.linalg.norm(corners @ effect.T + offset, axis=1).max())
    return min(by_norm, by_box)


# ---- the paper's bound -----------------------------------------------------------------------


class PaperBound(NamedTuple):
    """Eq. 41 of Hwang 2003, as it is printed or corrected; steps are real numbers."""

    decay_steps: float  # the second term: until the condition number has been paid back
    repair_steps: float  # the first: until what the delay adds has been; inf: never
    delay_error: float | None  # b of the worst mode, what the delay adds at most

    @property
    def steps(self) -> float:
        """The larger of both: the bound on the time between detection and the next switch."""
        return max(self.decay_steps, self.repair_steps)


def delay_errors(
    structures: Sequence[Eigenstructure],
    disturbance: float | None,
    n_states: int,
    delay_steps: int,
) -> tuple[float, ...] | None:
    """b = sqrt(n) U Delta k by mode, what a delay adds at most (eq. 33); 0 without one.

    disturbance: U, on every entry of u; None where unknown, and so is b then. With Jordan blocks
    the largest that eq. 30 gives within the delay stands for k.
    """
    if delay_steps == 0 or disturbance == 0.0:
        return (0.0,) * len(structures)
    if disturbance is None:
        return None
    each = math.sqrt(n_states) * disturbance * delay_steps
    return tuple(each * max(power_bound(one, t) for t in range(delay_steps)) for one in structures)


def printed_bound(
    structures: Sequence[Eigenstructure],
    delay_errors: tuple[float, ...] | None,
    convergence_rate: float,
    error_bound: float,
) -> PaperBound:
    """Eq. 41 as printed: the largest over modes of ln|1 - b/M0| / |ln mu| and ln k / |ln alpha|.

    The first is never positive where b < M0, and the second ends when k alpha^t <= 1, not when it
    is mu^t.
    """
    decay = max(steps_until_below(structure) for structure in structures)
    terms = [0.0]
    if delay_errors is not None and any(delay_errors):
        ratios = [b / error_bound if error_bound > 0 else math.inf for b in delay_errors]
        logarithms = [math.log(abs(1.0 - q)) if q != 1.0 else -math.inf for q in ratios]
        terms = [logarithm / abs(math.log(convergence_rate)) for logarithm in logarithms]
    return PaperBound(decay, max(terms), _worst(delay_errors))


def rate_correct_bound(
    structures: Sequence[Eigenstructure],
    delay_errors: tuple[float, ...] | None,
    convergence_rate: float,
    error_bound: float,
) -> PaperBound:
    """Eq. 41 as its proof has it: |ln(1 - b/M0)| / |ln mu| and ln k / ln(mu/alpha).

    k alpha^t <= mu^t from the second on; M0 is kept if b / (1 - mu^t) <= M0 (eq. 37), which is
    the first, and never if b >= M0.
    """
    decay = max(steps_until_below(structure, convergence_rate) for structure in structures)
    worst, repair = _worst(delay_errors), 0.0
    if worst:
        repair = math.inf
        if worst < error_bound:
            repair = math.log1p(-worst / error_bound) / math.log(convergence_rate)
    return PaperBound(decay, repair, worst)


def _worst(delay_errors: tuple[float, ...] | None) -> float | None:
    return None if delay_errors is None else max(delay_errors)


# ---- the direct bound ------------------------------------------------------------------------


class DirectBound(NamedTuple):
    """The smallest time from detection to the next switch that the powers of F themselves allow.

    steps = max(decay_steps, repair_steps), at least 1; inf where M0 can't be kept.
    """

    decay_steps: int  # ||F_m^t|| <= mu^t for every mode and every t from here on
    repair_steps: float  # c / (1 - ||F_m^t||) <= M0 likewise; inf: never
    delay_error: float | None  # c, what the delay adds at most: no smaller M0 can be kept
    error_bound_at_decay: float | None  # the smallest M0 that decay_steps are enough for
    growth: tuple[float, ...]  # by mode, sup of ||F_m^t|| / mu^t: how far the error may jump
    decay_by_mode: tuple[int, ...]

    @property
    def steps(self) -> float:
        """The bound on the time between detection and the next switch."""
        return max(float(self.decay_steps), self.repair_steps)


class PowerNorms:
    """||(F_m / rate)^t||_2 by mode and step, as many steps as are asked for."""

    def __init__(self, transitions: Array, rate: float) -> None:
        """transitions (n_modes, n_x, n_x)."""
        self.rate = rate
        scaled = transitions / rate
        powers = [np.broadcast_to(np.eye(scaled.shape[-1]), scaled.shape)]
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(BLOCK_STEPS):
                powers.append(scaled @ powers[-1])
        self._stride = powers.pop()
        self._block = np.stack(powers)  # (block, n_modes, n_x, n_x), measured
        self._norms: list[Array] = []
        self._measure()

    def _measure(self) -> None:
        finite = np.asarray(np.isfinite(self._block).all(axis=(-2, -1)))
        held = np.where(finite[..., np.newaxis, np.newaxis], self._block, 0.0)
        self._norms.append(np.where(finite, np.linalg.norm(held, 2, axis=(-2, -1)), np.inf))

    def until(self, steps: int) -> Array:
        """The norms (steps, n_modes) for t = 0 .. steps - 1; inf where they overflow."""
        while len(self._norms) * BLOCK_STEPS < steps:
            with np.errstate(over="ignore", invalid="ignore"):
                self._block = self._block @ self._stride
            self._measure()
        return np.concatenate(self._norms)[:steps]


def direct_bound(
    transitions: Array,
    disturbance: float | None,
    convergence_rate: float,
    error_bound: float,
    delay_steps: int,
    names: Sequence[str],
) -> DirectBound:
    """The smallest L with ||F_m^t|| <= mu^t for all t >= L, and c/(1 - max ||F_m^t||) <= M0.

    transitions (n_modes, n_x, n_x) with spectral radii below mu; c = U_2 sum over i < Delta of
    max_m ||F_m^i||. Then the error at the n-th detection is at most mu^(t_n - t_0) ||e_0|| + M0.
    That a norm stays below for ever is seen from L to 2 L - 1: every later power is a product of
    those. Raises Unsuited where L is over LONGEST_STEPS.
    """
    norms = PowerNorms(transitions, convergence_rate)
    alphas = [float(np.abs(np.linalg.eigvals(F)).max()) for F in transitions]

    def last_above(limit: Callable[[Array], Array], key: str, why: str) -> list[int]:
        found = []
        for mode, name in enumerate(names):
            steps = _last_above(norms, mode, limit)
            if steps is None:
                decays = f"it decays at {number(alphas[mode], 1.0, convergence_rate)} per step"
                raise Unsuited(
                    f"mode '{name}' would have to last more than {LONGEST_STEPS} steps: {decays}, "
                    f"{why}",
                    "analyses",
                    "sojourn",
                    key,
                )
            found.append(steps)
        return found

    decay_by_mode = last_above(
        lambda t: np.ones(len(t)),
        "convergence_rate",
        f"and 'convergence_rate' is {as_set(convergence_rate)}; choose it further above that",
    )
    decay = max(1, *decay_by_mode)
    known = norms.until(max(decay, 1))
    growth = tuple(float(column.max()) for column in known.T)
    if delay_steps == 0:
        delay_error: float | None = 0.0
    elif disturbance is None:
        delay_error = None
    else:
        delay_error = disturbance * float(_plain(norms, delay_steps).sum())
    repair, at_decay = 0.0, delay_error
    if delay_error:
        largest = float(_plain(norms, 2 * decay)[decay:].max())
        at_decay = delay_error / (1.0 - largest)
        repair = math.inf
        allowed = 1.0 - delay_error / error_bound if error_bound > 0 else -1.0
        if allowed > 0.0 or (allowed == 0.0 and largest == 0.0):
            by_mode = last_above(
                lambda t: _over(allowed, convergence_rate, t),
                "error_bound",
                f"and the delay adds up to {number(delay_error, error_bound)}, where 'error_bound' "
                f"is {as_set(error_bound)}; choose it further above that",
            )
            repair = float(max(by_mode))
    return DirectBound(decay, repair, delay_error, at_decay, growth, tuple(decay_by_mode))


def _plain(norms: PowerNorms, steps: int) -> Array:
    """max_m ||F_m^t|| for t = 0 .. steps - 1."""
    plain: Array = norms.until(steps).max(axis=1) * norms.rate ** np.arange(float(steps))
    return plain


def _over(allowed: float, rate: float, t: Array) -> Array:
    """`allowed` in units of rate^t; inf where that is too large for a float."""
    with np.errstate(over="ignore", divide="ignore"):
        return allowed / rate**t


def _last_above(norms: PowerNorms, mode: int, limit: Callable[[Array], Array]) -> int | None:
    """The smallest L from which on the norms of a mode are at most limit(t), which never falls.

    None where it is over LONGEST_STEPS.
    """
    steps = 64
    while True:
        t = np.arange(float(steps))
        above = np.flatnonzero(norms.until(steps)[:, mode] > limit(t))
        first = int(above[-1]) + 1 if above.size else 0
        if 2 * first <= steps:
            return first
        if first > LONGEST_STEPS:
            return None
        steps *= 2
