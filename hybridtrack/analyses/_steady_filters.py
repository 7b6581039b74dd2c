"""Each mode's Kalman filter in its steady state, and how two modes' filters differ.

Filters in the form x(k) = A x(k-1) + b + K r(k), r(k) = z(k) - C (A x(k-1) + b), as in Hwang,
Balakrishnan, Tomlin 2006, section 4. What an input does is a vector b = B u here; modes that differ
in u alone differ in b.
"""

from typing import NamedTuple

import numpy as np

from hybridtrack.analyses._predictor_filters import settled_covariance
from hybridtrack.errors import Unsuited
from hybridtrack.models import Array, JumpMarkovModel


class SteadyFilter(NamedTuple):
    """A mode with its steady-state filter."""

    name: str
    A: Array  # (n_x, n_x)
    b: Array  # (n_x,)
    C: Array  # (n_y, n_x)
    gain: Array  # K (n_x, n_y)
    innovation_covariance: Array  # S (n_y, n_y)
    predicted_covariance: Array  # P(k|k-1) (n_x, n_x)

    @property
    def eigenvalues_of_information(self) -> Array:
        """Those of S^-1, in ascending order (n_y,)."""
        return np.asarray(1.0 / np.linalg.eigvalsh(self.innovation_covariance)[::-1], dtype=float)

    @property
    def log_determinant(self) -> float:
        """ln |S|."""
        return float(np.linalg.slogdet(self.innovation_covariance)[1])


class NoSteadyState(NamedTuple):
    """Why a mode's filter has none."""

    name: str
    reason: str


def steady_filters(model: JumpMarkovModel) -> list[SteadyFilter | NoSteadyState]:
    """The filter of each mode of a model with steps of one length."""
    return [_steady_filter(model, j) for j in range(len(model.mode_names))]


def _steady_filter(model: JumpMarkovModel, j: int) -> SteadyFilter | NoSteadyState:
    name, A, C = model.mode_names[j], model.state_transition[0, j], model.measurement_matrix[j]
    try:
        P = settled_covariance(model, j)
    except Unsuited as error:
        return NoSteadyState(name, str(error))
    S = C @ P @ C.T + model.measurement_noise_covariance[j]
    gain = np.linalg.solve(S, C @ P).T
    return SteadyFilter(name, A, model.input_effect[0, j], C, gain, S, P)


class Difference(NamedTuple):
    """Filter i where mode T is true (Hwang 2006, eqs. 16-21), inputs as vectors."""

    F_T: Array  # (I - K_T C_T) A_T
    F_i: Array  # (I - K_i C_T) A_T
    H_x: Array  # C_T dA + dC A_T - dC dA (n_y, n_x)
    H_u: Array  # C_T db + dC b_T - dC db (n_y,)
    G_x: Array  # (I - K_i C_T) dA - K_i dC A_i (n_x, n_x)
    G_u: Array  # (I - K_i C_T) db - K_i dC b_i (n_x,)
    input_difference: Array  # db = b_T - b_i (n_x,)
    alpha: float  # lambda_min(S_i^-1) / lambda_max(S_T^-1)
    log_determinants: float  # ln |S_i| / |S_T|
    largest_information: float  # lambda_max(S_T^-1)
    condition_number: float  # of C_T A_T


def difference(i: SteadyFilter, T: SteadyFilter) -> Difference:
    """Filter of mode i against the truth in mode T."""
    dA, dC, db = T.A - i.A, T.C - i.C, T.b - i.b
    identity = np.eye(len(T.A))
    off = identity - i.gain @ T.C
    singular = np.linalg.svd(T.C @ T.A, compute_uv=False)
    return Difference(
        F_T=(identity - T.gain @ T.C) @ T.A,
        F_i=off @ T.A,
        H_x=T.C @ dA + dC @ T.A - dC @ dA,
        H_u=T.C @ db + dC @ T.b - dC @ db,
        G_x=off @ dA - i.gain @ dC @ i.A,
        G_u=off @ db - i.gain @ dC @ i.b,
        input_difference=db,
        alpha=float(i.eigenvalues_of_information[0] / T.eigenvalues_of_information[-1]),
        log_determinants=i.log_determinant - T.log_determinant,
        largest_information=float(T.eigenvalues_of_information[-1]),
        condition_number=float(singular[0] / singular[-1]) if singular[-1] > 0 else np.inf,
    )


SETTLING = 5000  # steps after which what still moves is said to move for good
STEADY = 1e-6  # relative change over the last tenth of them


class SteadyResidual(NamedTuple):
    """Mean residual of a wrong filter in the long run."""

    settled: Array | None  # (n_y,) as the recursion settles; None where it doesn't
    formula: Array | None  # (n_y,) by the paper's; None where that has no value
    reason: str  # why one is missing; empty otherwise


def steady_residual(i: SteadyFilter, T: SteadyFilter, state: Array) -> SteadyResidual:
    """Filter i while mode T lasts, from a true state (n_x,) on, without noise.

    (C_T A_T Theta G_x + H_x) x + C_T A_T Theta G_u + H_u with Theta = (I - F_i)^-1 and the filter's
    settled estimate x (Hwang 2006, section 4.1, whose bracket is garbled).
    """
    d = difference(i, T)
    x, estimate = state.copy(), state.copy()
    drive = np.concatenate([d.G_x, d.H_x])
    before, settled, early = estimate, np.zeros(len(drive)), np.zeros(len(drive))
    residual = np.zeros(len(T.C))
    for step in range(SETTLING):
        before = estimate
        x = T.A @ x + T.b
        predicted = i.A @ estimate + i.b
        residual = T.C @ x - i.C @ predicted
        estimate = predicted + i.gain @ residual
        if not max(np.abs(estimate).max(), np.abs(x).max()) < 1e100:
            return SteadyResidual(None, None, "no steady state: the estimate grows")
        if step == SETTLING * 9 // 10:
            settled = drive @ before
        if step < SETTLING // 2:
            early = np.maximum(early, np.abs(drive @ before))
    scale = max(float(np.abs(settled).max()), float(np.abs(residual).max()), 1e-9)
    if not np.abs(drive @ before - settled).max() <= STEADY * scale:
        grows = float(np.abs(drive @ before).max()) > 1.05 * float(np.abs(early).max())
        how = "grows" if grows else "keeps moving"
        return SteadyResidual(None, None, f"no steady state: the estimate {how}")
    theta_inverse = np.eye(len(T.A)) - d.F_i
    if np.linalg.cond(theta_inverse) > 1e12:
        reason = "premise fails: I - F_i is singular, so there is no Theta"
        return SteadyResidual(residual, None, reason)
    formula = d.H_x @ before + d.H_u
    formula += T.C @ T.A @ np.linalg.solve(theta_inverse, d.G_x @ before + d.G_u)
    return SteadyResidual(residual, formula, "")
