"""One run of an IMM in plain NumPy, with what the stability of its mixing is about.

The estimators give what a tracker wants; here every mode's own covariance is kept, and the
matrices that carry the errors of all modes from one step to the next. Equations are those of Seah
and Hwang 2008.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.analyses._definite import square_root, symmetric
from hybridtrack.models import Array, JumpMarkovModel

Modes = NDArray[np.int64]

# Farther than this, positions leave no digits for metres, and numbers soon overflow.
FARTHEST = 1e12


class Flight(NamedTuple):
    """A truth drawn from a bank's own chain, and its measurements at k = 1 .. n_steps."""

    modes: Modes  # (n_steps,)
    states: Array  # (n_steps, n_x)
    measurements: Array  # (n_steps, n_y)


class ImmRun(NamedTuple):
    """What an IMM did with some measurements; modes j are the second axis."""

    means: Array  # (n_steps + 1, n_modes, n_x) from k = 0
    covariances: Array  # P_j(k|k) (n_steps + 1, n_modes, n_x, n_x) from k = 0
    mode_probabilities: Array  # (n_steps + 1, n_modes) from k = 0
    mixing: Array  # gamma_ji(k-1) (n_steps, n_modes, n_modes): row j is what mode j mixes
    spread: Array  # of the means that mode j mixes, about their mean (n_steps, n_modes, n_x, n_x)
    closed_loop: Array  # [I - K_j C_j] A_j (n_steps, n_modes, n_x, n_x)


def fly(model: JumpMarkovModel, steps: int, seed: int) -> Flight:
    """A flight from the model's own chain, start and noises (n_times = 1).

    It ends before `steps` where a state gets beyond FARTHEST.
    """
    rng = np.random.default_rng(seed)
    A, b = model.state_transition[0], model.input_effect[0]
    G = square_root(model.process_noise_covariance[0])
    D = square_root(model.measurement_noise_covariance)
    cumulative = np.cumsum(model.transition_matrix[0], axis=1)
    n_y, n_x = model.measurement_matrix.shape[1:]
    uniform = rng.random(steps + 1)
    process = rng.standard_normal((steps, n_x))
    noise = rng.standard_normal((steps, n_y))
    x = model.initial_mean + square_root(model.initial_covariance) @ rng.standard_normal(n_x)
    j = _drawn(np.cumsum(model.initial_mode_probabilities), uniform[0])
    modes = np.empty(steps, dtype=np.int64)
    states = np.empty((steps, n_x))
    for k in range(steps):
        j = _drawn(cumulative[j], uniform[k + 1])
        x = A[j] @ x + b[j] + G[j] @ process[k]
        if np.abs(x).max() > FARTHEST:
            modes, states, noise = modes[:k], states[:k], noise[:k]
            break
        modes[k], states[k] = j, x
    seen = np.einsum("kme,ke->km", model.measurement_matrix[modes], states)
    return Flight(modes, states, seen + np.einsum("kml,kl->km", D[modes], noise))


def _drawn(cumulative: Array, uniform: float) -> int:
    """The mode whose share of 0..1 a uniform draw falls in; rounding may leave the sum below 1."""
    return int(np.searchsorted(cumulative, uniform * cumulative[-1], side="right"))


def interacting_filters(model: JumpMarkovModel, measurements: Array) -> ImmRun:
    """The IMM on measurements (n_steps, n_y), none missing (Seah 2008, eqs. 4-15; n_times = 1).

    It ends early where a covariance gets beyond FARTHEST squared. A mode that no mode leads to
    mixes nothing but itself.
    """
    A, b = model.state_transition[0], model.input_effect[0]
    W = model.process_noise_covariance[0]
    C, R = model.measurement_matrix, model.measurement_noise_covariance
    A_, C_ = A.transpose(0, 2, 1), C.transpose(0, 2, 1)
    steps, (n_modes, _, n_x) = len(measurements), C.shape
    eye = np.eye(n_x)
    run = ImmRun(
        np.empty((steps + 1, n_modes, n_x)),
        np.empty((steps + 1, n_modes, n_x, n_x)),
        np.empty((steps + 1, n_modes)),
        np.empty((steps, n_modes, n_modes)),
        np.empty((steps, n_modes, n_x, n_x)),
        np.empty((steps, n_modes, n_x, n_x)),
    )
    x, P, mu = run.means, run.covariances, run.mode_probabilities
    x[0], P[0], mu[0] = (
        model.initial_mean,
        model.initial_covariance,
        model.initial_mode_probabilities,
    )
    flow = model.transition_matrix[0]
    for k, z in enumerate(measurements):
        predicted = mu[k] @ flow
        gamma = run.mixing[k] = _mixing(flow, mu[k], predicted)  # (4)
        x0 = gamma @ x[k]  # (5)
        apart = x[k] - x0[:, np.newaxis]  # (j, i, state)
        spread = apart.transpose(0, 2, 1) @ (gamma[:, :, np.newaxis] * apart)  # in (6), of (32)
        P0 = np.tensordot(gamma, P[k], axes=1)  # (33)
        M = A @ (P0 + spread) @ A_ + W  # P_j(k|k-1), (34)
        S = C @ M @ C_ + R  # (11)
        K = np.linalg.solve(S, C @ M).transpose(0, 2, 1)  # (9)
        keep = eye - K @ C
        x_predicted = (A @ x0[:, :, np.newaxis])[:, :, 0] + b
        r = z - (C @ x_predicted[:, :, np.newaxis])[:, :, 0]  # (8)
        x[k + 1] = x_predicted + (K @ r[:, :, np.newaxis])[:, :, 0]  # (7)
        P[k + 1] = symmetric(
            keep @ M @ keep.transpose(0, 2, 1) + K @ R @ K.transpose(0, 2, 1)
        )  # (12), in Joseph's form
        whitened = np.linalg.solve(S, r[:, :, np.newaxis])[:, :, 0]
        distance = np.sum(r * whitened, axis=1) + np.linalg.slogdet(S)[1]
        weight = np.where(predicted > 0, predicted, 0.0)
        weight *= np.exp(-0.5 * (distance - distance[weight > 0].min()).clip(0.0))  # (13)
        mu[k + 1] = weight / weight.sum()  # (14)
        run.spread[k], run.closed_loop[k] = spread, keep @ A
        if np.abs(P[k + 1]).max() > FARTHEST**2:
            return _first_steps(run, k)
    return run


def _mixing(flow: Array, probabilities: Array, predicted: Array) -> Array:
    """gamma_ji (j, i) = pi_ij alpha_i / alpha_j^- (4)."""
    reached = predicted > 0
    weights = (flow * probabilities[:, np.newaxis]).T
    return np.where(
        reached[:, np.newaxis],
        weights / np.where(reached, predicted, 1.0)[:, np.newaxis],
        np.eye(len(flow)),
    )


def _first_steps(run: ImmRun, steps: int) -> ImmRun:
    return ImmRun(
        *(part[: steps + 1] for part in run[:3]),
        *(part[:steps] for part in run[3:]),
    )


def contraction(run: ImmRun) -> Array:
    """log ||Phi(k, 0)|| (n_steps + 1,) of the homogeneous errors of all modes (Seah 2008, eq. 21).

    Phi(k, 0) = Psi(k, k-1) Gamma(k-1) ... Psi(1, 0) Gamma(0) takes the stacked errors e~ at 0 to
    those at k, and its 2-norm is the worst that can become of a start of length 1. -inf once
    nothing is left of any.
    """
    steps, n_modes, n_x, _ = run.closed_loop.shape
    logs = np.full(steps + 1, -np.inf)
    logs[0] = 0.0
    carried = np.eye(n_modes * n_x)
    for k in range(steps):
        mixed = run.mixing[k] @ carried.reshape(n_modes, -1)
        carried = (run.closed_loop[k] @ mixed.reshape(n_modes, n_x, -1)).reshape(n_modes * n_x, -1)
        size = float(np.linalg.norm(carried, 2))
        if size == 0.0:
            break
        carried /= size  # else it would underflow, or overflow
        logs[k + 1] = logs[k] + np.log(size)
    return logs


def smallest_spread(run: ImmRun) -> Array:
    """A diagonal matrix (n_x, n_x) that no spread of means in the run exceeds.

    Each state's largest spread, all enlarged by one factor until the matrices too are bounded
    (at most n_x times, and n_modes - 1 times).
    """
    n_x = run.spread.shape[-1]
    largest = np.diagonal(run.spread, axis1=-2, axis2=-1).reshape(-1, n_x).max(axis=0)
    scale = np.sqrt(np.where(largest > 0.0, largest, 1.0))
    relative = symmetric(run.spread) / np.outer(scale, scale)
    factor = max(float(np.linalg.eigvalsh(relative)[..., -1].max()), 1.0)
    return np.diag(factor * largest)


class Rate(NamedTuple):
    """A mean factor per step, the standard error of the estimate, and whether it is one rate."""

    per_step: float
    standard_error: float | None  # None: too few steps to tell
    from_step: int  # those before are left out
    trend: Literal["none", "rising", "falling"]  # of the factor, as the simulation goes on
    halves: tuple[float, float]  # mean growths of log ||Phi|| per step in the earlier and the later

    @property
    def known(self) -> bool:
        """Whether the factor is a property of the bank, and not of how long was simulated."""
        return self.per_step == 0.0 or (self.standard_error is not None and self.trend == "none")


BATCHES = 20
TREND = 4.0  # standard deviations of a rank test that steady growth passes but for 6 in 100,000
DRIFT = 0.1  # of the growth itself between the halves: less is no matter


def simulated_rate(logs: Array) -> Rate | None:
    """exp of the mean growth of log ||Phi(k, 0)|| per step; None without a step.

    The first tenth is left out, since there ||Phi|| may grow before it shrinks. The standard error
    is that of 20 batch means, so that neighbouring steps may be alike. Errors that go as 1/k, or
    that change their pace otherwise, have no rate: such a trend shows in the order of the batches
    (Mann-Kendall).
    """
    steps = len(logs) - 1
    if steps < 1:
        return None
    if np.isneginf(logs[-1]):
        return Rate(0.0, None, 0, "none", (-np.inf, -np.inf))
    start = steps // 10
    middle = (start + steps) // 2
    growth = float((logs[-1] - logs[start]) / (steps - start))
    halves = (
        float((logs[middle] - logs[start]) / max(middle - start, 1)),
        float((logs[-1] - logs[middle]) / (steps - middle)),
    )
    rate = float(np.exp(growth))
    if steps - start < 5 * BATCHES:
        return Rate(rate, None, start, "none", halves)
    edges = np.linspace(start, steps, BATCHES + 1).astype(int)
    batches = np.diff(logs[edges]) / np.diff(edges)
    error = float(rate * batches.std(ddof=1) / np.sqrt(BATCHES))
    return Rate(rate, error, start, _trend(batches, halves), halves)


def _trend(batches: Array, halves: tuple[float, float]) -> Literal["none", "rising", "falling"]:
    """Whether the means of batches in a row rise or fall, by more than chance and by enough."""
    n = len(batches)
    later = np.sign(batches[np.newaxis, :] - batches[:, np.newaxis])
    score = float(np.triu(later).sum()) / np.sqrt(n * (n - 1) * (2 * n + 5) / 18)
    change = halves[1] - halves[0]
    if abs(score) < TREND or abs(change) <= DRIFT * max(abs(halves[0]), abs(halves[1])):
        return "none"
    return "rising" if score > 0.0 else "falling"
