"""Between which covariances the filters of an IMM live, whatever the sequence of modes.

All rests on two properties of the Riccati map Upsilon_j of a mode: a larger covariance before it
gives a larger one after it, and mixing first gives more than mixing after (Seah 2008, lemma 2).
Equations are those of Seah and Hwang 2008. N counts measurements.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.analyses._definite import (
    RANK_TOLERANCE,
    is_singular,
    join,
    meet,
    square_root,
    symmetric,
)
from hybridtrack.models import Array, JumpMarkovModel

MOST_SEQUENCES = 20_000  # a second's work for six states
FREE_STEPS = 2_000  # of an iteration towards a floor or a ceiling, before it is held
MOST_STEPS = 4_000
SETTLED = 1e-11  # relative change per step
LARGEST = 1e24  # beyond it an iteration is given up as growing without end


class Bank(NamedTuple):
    """A bank at one length of step, in the paper's letters: x = A x + B w, z = C x + v."""

    A: Array  # (n_modes, n_x, n_x)
    W: Array  # B Q B' (n_modes, n_x, n_x)
    C: Array  # (n_modes, n_y, n_x)
    R: Array  # (n_modes, n_y, n_y)
    modes: tuple[str, ...]
    states: tuple[str, ...]

    @property
    def singular(self) -> tuple[str, ...]:
        """The modes whose A has no inverse."""
        return tuple(name for name, A in zip(self.modes, self.A, strict=True) if is_singular(A))


def bank(model: JumpMarkovModel) -> Bank:
    """The bank of a model with n_times = 1."""
    return Bank(
        model.state_transition[0],
        model.process_noise_covariance[0],
        model.measurement_matrix,
        model.measurement_noise_covariance,
        model.mode_names,
        model.state_names,
    )


def predicted(bank: Bank, j: int, covariance: Array) -> Array:
    """A_j X A_j' + B_j Q_j B_j' of covariances X (..., n_x, n_x), as in (34)."""
    return symmetric(bank.A[j] @ covariance @ bank.A[j].T + bank.W[j])


def updated(bank: Bank, j: int, covariance: Array) -> Array:
    """Upsilon_j(X) of covariances X (..., n_x, n_x) (36), in Joseph's form, which inverts S alone.

    So X, A and B Q B' may be singular.
    """
    M, C, R = predicted(bank, j, covariance), bank.C[j], bank.R[j]
    K = np.swapaxes(np.linalg.solve(C @ M @ C.T + R, C @ M), -1, -2)
    keep = np.eye(M.shape[-1]) - K @ C
    return symmetric(keep @ M @ np.swapaxes(keep, -1, -2) + K @ R @ np.swapaxes(K, -1, -2))


# ---- over all sequences of modes -------------------------------------------------------------


class Figures(NamedTuple):
    """What holds for every sequence of N modes; None where it takes the inverse of a singular A."""

    measurements: int  # N
    kappa_1: float  # smallest eigenvalue of the controllability Gramians (definition 2)
    kappa_2: float  # their largest
    kappa_3: float | None  # smallest eigenvalue of the observability Gramians (definition 3)
    kappa_4: float | None  # their largest
    controllable: bool
    observable: bool | None
    beta_1: float  # smallest eigenvalue of Upsilon(... Upsilon(0)), 0 if not controllable
    certain: tuple[str, str]  # the mode last and the state along which there is least doubt
    unseen: tuple[str, str] | None  # the mode last and the state that is seen least

    @property
    def beta_1_printed(self) -> float | None:
        """kappa_1 / (1 + kappa_1 kappa_4) (lemma 1): no lower bound in general."""
        return None if self.kappa_4 is None else self.kappa_1 / (1 + self.kappa_1 * self.kappa_4)

    @property
    def upper_printed(self) -> float | None:
        """1 / kappa_3 + kappa_2 (lemma 1): no upper bound in general."""
        if self.kappa_3 is None:
            return None
        return np.inf if self.kappa_3 == 0 else 1 / self.kappa_3 + self.kappa_2


def all_sequences(bank: Bank, longest: int) -> tuple[Figures, ...]:
    """The figures of every sequence of N = 1 .. longest modes, exactly.

    Definition 3 is read as section III-C uses it: N = 2 are the measurements at k and k - 1, seen
    from the state at k. Gramians are kept as factors F with F'F the Gramian, so that kappa_1 and
    kappa_3 are squared singular values and keep their digits.
    """
    n_modes, n_x = len(bank.modes), len(bank.states)
    roots = np.swapaxes(square_root(bank.W), -1, -2)
    white = [np.linalg.solve(np.linalg.cholesky(R), C) for R, C in zip(bank.R, bank.C, strict=True)]
    backwards = None if bank.singular else np.linalg.inv(bank.A)
    driven = np.zeros((1, n_x, n_x))
    seen = np.zeros((1, n_x, n_x))
    covariances = np.zeros((1, n_x, n_x))
    found = []
    for N in range(1, longest + 1):
        modes = range(n_modes)  # the newest first: sequence s ends in mode s // n_modes^(N-1)
        driven = np.concatenate([_stacked(roots[j], driven @ bank.A[j].T) for j in modes])
        kappa_1, kappa_2, controllable, certain = _extremes(driven, bank)
        covariances = np.concatenate([updated(bank, j, covariances) for j in modes])
        beta_1 = float(np.linalg.eigvalsh(covariances)[:, 0].min()) if controllable else 0.0
        kappa_3 = kappa_4 = observable = unseen = None
        if backwards is not None:
            seen = np.concatenate([_stacked(white[j], seen @ backwards[j]) for j in modes])
            kappa_3, kappa_4, observable, unseen = _extremes(seen, bank)
        found.append(
            Figures(
                N, kappa_1, kappa_2, kappa_3, kappa_4, controllable, observable,
                max(beta_1, 0.0), certain, unseen,
            )
        )  # fmt: skip
    return tuple(found)


def _stacked(rows: Array, factors: Array) -> Array:
    """The triangular factors (n, n_x, n_x) of [rows; factor], by QR."""
    on_top = np.broadcast_to(rows, (len(factors), *rows.shape))
    triangular: Array = np.linalg.qr(np.concatenate([on_top, factors], axis=1), mode="r")  # type: ignore[assignment]
    return triangular


def _extremes(factors: Array, bank: Bank) -> tuple[float, float, bool, tuple[str, str]]:
    """Smallest and largest eigenvalue of F'F, whether all are definite; where the smallest is."""
    values = np.linalg.svd(factors, compute_uv=False)
    scale = np.linalg.norm(factors, axis=1, keepdims=True)
    scale[scale == 0.0] = 1.0  # ranks shouldn't depend on the units of states
    relative = np.linalg.svd(factors / scale, compute_uv=False)
    definite = bool((relative[:, -1] > RANK_TOLERANCE * relative[:, 0]).all())
    weakest = int(np.argmin(values[:, -1] if definite else relative[:, -1]))
    direction = np.linalg.svd((factors / scale)[weakest])[2][-1]
    place = (
        bank.modes[weakest // (len(factors) // len(bank.modes))],
        bank.states[int(np.argmax(np.abs(direction)))],
    )
    smallest = float(values[:, -1].min()) ** 2 if definite else 0.0
    return smallest, float(values[:, 0].max()) ** 2, definite, place


# ---- floor and ceiling -----------------------------------------------------------------------


class Bound(NamedTuple):
    """A covariance that every P_j(k|k) lies above, or below.

    path[i] bounds those at step first + i, and the last of it all that come later.
    """

    path: Array  # (n, n_x, n_x); empty where there is no bound
    first: int
    why: str = ""  # there is none, or none that the iteration settled at by itself

    @property
    def matrix(self) -> Array | None:
        """The last of the path (n_x, n_x): the bound of all later steps."""
        return self.path[-1] if len(self.path) else None

    @property
    def from_step(self) -> int:
        """From when on `matrix` is a bound, whatever the start."""
        return self.first + max(len(self.path) - 1, 0)

    def at(self, steps: NDArray[np.int64]) -> Array:
        """The bounds (n, n_x, n_x) at steps >= first."""
        index = np.minimum(steps - self.first, len(self.path) - 1)
        bounds: Array = self.path[index]
        return bounds


def floor(bank: Bank, figures: tuple[Figures, ...]) -> Bound:
    """X <- meet over j of Upsilon_j(X), from beta_1(N0) I, N0 the first N that is controllable.

    If all P_i >= X, so is any mixture of them, and Upsilon_j of it is >= Upsilon_j(X): every
    iterate is a floor of one step later. The spread of means only adds to it.
    """
    start = next((one for one in figures if one.beta_1 > 0.0), None)
    n_x = len(bank.states)
    if start is None:
        mode, state = figures[-1].certain
        why = (
            f"not controllable up to N = {figures[-1].measurements}: in {mode} there may be no "
            f"doubt left about {state}"
        )
        return Bound(np.zeros((0, n_x, n_x)), 0, why)
    path, settled, why = _iterated(bank, start.beta_1 * np.eye(n_x), np.zeros((n_x, n_x)), meet)
    if settled:
        return Bound(path, start.measurements, why)
    last = figures[-1]
    why = f"the iteration was given up: {why}; it is beta_1 I instead, of N = {last.measurements}"
    return Bound(last.beta_1 * np.eye(n_x)[np.newaxis], last.measurements, why)


def ceiling(bank: Bank, spread: Array, initial_covariance: Array) -> Bound:
    """X <- join over j of Upsilon_j(X + spread), from a multiple of I above the start (k = 0).

    A ceiling of every P_j(k|k) as long as what the spread of the means adds to the mixed
    covariance is <= `spread` (n_x, n_x) at every step: if all P_i <= X, the mixed covariance is
    <= X + spread, and Upsilon_j keeps the order. A join is larger than what it bounds, so that
    there may be none though the covariances are bounded.
    """
    parts = (initial_covariance, spread, *bank.W, *bank.R)
    highest = max(float(np.linalg.eigvalsh(symmetric(part))[-1]) for part in parts)
    path, settled, why = _iterated(bank, 10 * highest * np.eye(len(bank.states)), spread, join)
    if settled:
        return Bound(path, 0, why)
    state = bank.states[int(np.argmax(np.diag(path[-1])))]
    why = (
        f"the joins' doubt about {state} grows on after {len(path) - 1:,} steps, which the "
        "filters' own needn't"
    )
    return Bound(path[:0], 0, why)


Choice = Callable[[Sequence[Array]], Array]


def _iterated(bank: Bank, start: Array, spread: Array, choose: Choice) -> tuple[Array, bool, str]:
    """X <- choose over j of Upsilon_j(X + spread): the path, whether it came to rest, a remark.

    A path that doesn't settle may go round in circles, since meet and join aren't monotone, or
    creep. Then each iterate is also chosen against the one before, so that it only gets weaker as
    a bound: where it comes to rest so, X bounds its own successor, and hence all.
    """
    path, remark = [start], ""
    for step in range(MOST_STEPS):
        reached = [updated(bank, j, path[-1] + spread) for j in range(len(bank.modes))]
        if step == FREE_STEPS:
            remark = (
                f"it hadn't settled after {step:,} steps and changed by "
                f"{_change(path[-2], path[-1]):.1g} of itself per step"
            )
        path.append(choose(reached if step < FREE_STEPS else [path[-1], choose(reached)]))
        if _change(path[-2], path[-1]) < SETTLED:
            return np.stack(path), True, remark
        if np.abs(path[-1]).max() > LARGEST:
            return np.stack(path), False, f"it grew beyond {LARGEST:g} within {step + 1:,} steps"
    return np.stack(path), False, remark


def _change(before: Array, after: Array) -> float:
    """The largest change, relative to the variances it belongs to."""
    scale = np.sqrt(np.maximum(np.diag(before), np.diag(after)))
    scale[scale == 0.0] = 1.0
    return float(np.abs((after - before) / np.outer(scale, scale)).max())


def below(lower: Array, upper: Array, slack: float = 1e-8) -> NDArray[np.bool_]:
    """Whether lower <= upper, matrix by matrix (..., n, n): bools (...).

    Rounding may take `slack` of the larger variance in each direction of a state.
    """
    scale = np.sqrt(
        np.maximum(
            np.diagonal(lower, axis1=-2, axis2=-1), np.diagonal(upper, axis1=-2, axis2=-1)
        ).clip(0.0)
    )
    scale = np.where(scale > 0.0, scale, 1.0)
    relative = symmetric(upper - lower) / (scale[..., :, np.newaxis] * scale[..., np.newaxis, :])
    answer: NDArray[np.bool_] = np.linalg.eigvalsh(relative)[..., 0] >= -slack
    return answer


# ---- the theorem's constants -----------------------------------------------------------------


class Certificate(NamedTuple):
    """The constants of section III-C for one beta_1; rates are of ||e~|| per step."""

    beta_1: float
    beta_3: float  # P_j(k|k-1) <= beta_3 I
    beta_4: float
    beta_5: float
    kappa_3: float  # of N = 2
    c_1: float

    @property
    def rate(self) -> float:
        """V shrinks by 1 / (1 + c_1) in two steps, and V goes with ||e||^2."""
        return float(np.exp(-np.log1p(self.c_1) / 4))

    @property
    def short(self) -> float:
        """1 - rate, with all its digits."""
        return float(-np.expm1(-np.log1p(self.c_1) / 4))

    @property
    def time_constant_steps(self) -> float:
        """Steps until ||e|| is certified to be 1 / e of what it was, but for a constant factor."""
        return float(4 / np.log1p(self.c_1)) if self.c_1 > 0 else np.inf


def certificate(bank: Bank, beta_1: float, kappa_3: float, beta_3: float) -> Certificate:
    """beta_4, beta_5 and c_1 = beta_1 beta_5 kappa_3, by section III-C.

    Needs C and R of mode 0 to be those of all modes, and every A_j to have an inverse.
    beta_4 = 1 / max_j lambda_max(R + beta_3 C A_j^-1 A_j^-T C'), beta_5 = min(beta_4 xi_3, 1),
    xi_3 = lambda_min(R).
    """
    C, R = bank.C[0], bank.R[0]
    back = [np.linalg.solve(A.T, C.T).T for A in bank.A]  # C A_j^-1
    beta_4 = 1 / max(float(np.linalg.eigvalsh(R + beta_3 * g @ g.T)[-1]) for g in back)
    beta_5 = min(beta_4 * float(np.linalg.eigvalsh(R)[0]), 1.0)
    return Certificate(beta_1, beta_3, beta_4, beta_5, kappa_3, beta_1 * beta_5 * kappa_3)


def largest_prediction(bank: Bank, ceiling: Array, spread: Array) -> float:
    """beta_3 = max_j lambda_max(A_j (X + spread) A_j' + B_j Q_j B_j') of a ceiling X."""
    return max(
        float(np.linalg.eigvalsh(predicted(bank, j, ceiling + spread))[-1])
        for j in range(len(bank.modes))
    )


def one_step_loss(bank: Bank, ceiling: Array) -> float:
    """1 - rho, rho = max_j lambda_max(A X A' (A X A' + W)^-1), W = B Q B' > 0, X a ceiling. Ours.

    By lemma 6, y' (A P A' + W)^-1 y <= rho x' P^-1 x for y = A x and P <= X, so that the Lyapunov
    function (48) shrinks by rho in every step, whatever C and R, and ||e~|| by its root.
    """
    from scipy.linalg import eigh

    losses = []
    for A, W in zip(bank.A, bank.W, strict=True):
        moved = symmetric(A @ ceiling @ A.T)
        ratio = max(float(eigh(moved, symmetric(W), eigvals_only=True)[-1]), 0.0)  # A X A' to W
        losses.append(1 / (1 + ratio))
    return min(losses)
