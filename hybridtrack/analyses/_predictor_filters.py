"""Each mode's Kalman filter once it has settled, in predictor form, and whether there is one."""

import warnings
from typing import NamedTuple

import numpy as np

from hybridtrack.analyses._eigenstructure import clusters
from hybridtrack.errors import Unsuited
from hybridtrack.models import Array, JumpMarkovModel
from hybridtrack.roots import thin_square_root

# A matrix whose smallest singular value is this much smaller than its largest has lost a rank;
# an eigenvalue this close to the unit circle is on it.
RANK = 1e-9
CIRCLE = 1e-7
RESIDUAL = 1e-6  # of the Riccati equation, relative: beyond it, the solver's answer is none


class PredictorFilter(NamedTuple):
    """The filter of one mode with its settled gain, x^ <- F x^ + K z, F = A - K C."""

    mode: str
    gain: Array  # K (n_x, n_y)
    transition: Array  # F (n_x, n_x), stable
    observable: bool  # {A, C}
    controllable: bool  # {A, Q^(1/2)}


def predictor_filters(model: JumpMarkovModel) -> tuple[PredictorFilter, ...]:
    """The settled filter of every mode of a model with n_times = 1.

    K = A P C' (C P C' + R)^-1 with P the stabilising solution of the Riccati equation
    (Hwang 2003, eqs. 14 and 15). Raises Unsuited where a mode has none: by Theorem 2 there, where
    {A, C} is undetectable or {A, Q^(1/2)} uncontrollable on the unit circle.
    """
    return tuple(_predictor_filter(model, j) for j in range(len(model.mode_names)))


def _predictor_filter(model: JumpMarkovModel, j: int) -> PredictorFilter:
    mode = model.mode_names[j]
    A, Q = model.state_transition[0, j], model.process_noise_covariance[0, j]
    C, R = model.measurement_matrix[j], model.measurement_noise_covariance[j]
    P = settled_covariance(model, j)
    K: Array = np.linalg.solve(C @ P @ C.T + R, C @ P @ A.T).T
    observable = not lost_eigenvalues(A.T, C.T)
    controllable = not lost_eigenvalues(A, thin_square_root(Q))
    return PredictorFilter(mode, K, A - K @ C, observable, controllable)


def settled_covariance(model: JumpMarkovModel, j: int) -> Array:
    """P(k|k-1) (n_x, n_x) of mode j's filter in its steady state; model with n_times = 1.

    The stabilising solution of P = A P A' - A P C' (C P C' + R)^-1 C P A' + Q, by scipy's
    solve_discrete_are. Raises Unsuited as `predictor_filters` does.
    """
    mode = model.mode_names[j]
    A, Q = model.state_transition[0, j], model.process_noise_covariance[0, j]
    C, R = model.measurement_matrix[j], model.measurement_noise_covariance[j]
    unobservable = lost_eigenvalues(A.T, C.T)
    uncontrollable = lost_eigenvalues(A, thin_square_root(Q))
    for eigenvalue in unobservable:
        if abs(eigenvalue) >= 1.0 - CIRCLE:
            raise Unsuited(
                f"mode '{mode}' is not detectable: its measurements never show what goes on at the "
                f"eigenvalue {_shown(eigenvalue)}, which doesn't decay; measure it, or leave the "
                "state out",
                "modes",
                mode,
            )
    for eigenvalue in uncontrollable:
        if abs(abs(eigenvalue) - 1.0) <= CIRCLE:
            raise Unsuited(
                f"the Riccati equation of mode '{mode}' has no stabilising solution: no process "
                f"noise reaches its eigenvalue {_shown(eigenvalue)} on the unit circle, so its "
                "gain dies away; give the mode some process noise there",
                "modes",
                mode,
            )
    return _solved(mode, A, Q, C, R)


def _solved(mode: str, A: Array, Q: Array, C: Array, R: Array) -> Array:
    from scipy.linalg import LinAlgError, LinAlgWarning, solve_discrete_are

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LinAlgWarning)  # the gain is checked below
            # In units of the measurements' noise: the solver is sensitive to the scale of Q and R.
            unit = float(np.trace(R)) / len(R)
            P = unit * solve_discrete_are(A.T, C.T, Q / unit, R / unit)
        P = (P + P.T) / 2
        K = np.linalg.solve(C @ P @ C.T + R, C @ P @ A.T).T
        settled = (A - K @ C) @ P @ A.T + Q
        wrong = np.abs(settled - P).max() > RESIDUAL * max(np.abs(P).max(), np.abs(Q).max())
        rate = np.abs(np.linalg.eigvals(A - K @ C)).max()
    except (LinAlgError, ValueError):
        wrong, rate = True, np.inf
    if wrong or not rate < 1.0:
        raise Unsuited(
            f"the Riccati equation of mode '{mode}' has no stabilising solution that can be found "
            "in floating point; bring its process noise and its measurement noise closer together",
            "modes",
            mode,
        )
    return np.asarray(P, dtype=float)


def lost_eigenvalues(A: Array, B: Array) -> tuple[complex, ...]:
    """The eigenvalues of A (n, n) that inputs by B (n, m) can't move: those uncontrollable.

    By the test of Popov, Belevitch and Hautus: where [A - lambda I, B] has less than full rank.
    The unobservable ones of {A, C} are those of {A', C'}. B counts by its directions alone.
    """
    size = float(np.linalg.norm(B, 2)) if B.size else 0.0
    scaled = B / size if size > 0 else B
    lost = []
    for eigenvalue, _ in clusters(A):
        shifted = A - eigenvalue * np.eye(len(A))
        spread = float(np.linalg.norm(shifted, 2))
        both = np.hstack([shifted / spread if spread > 0 else shifted, scaled])
        singular = np.linalg.svd(both, compute_uv=False)
        if singular[-1] <= RANK * max(singular[0], 1e-300):
            lost.append(eigenvalue)
    return tuple(lost)


def _shown(eigenvalue: complex) -> str:
    real, imaginary = eigenvalue.real, abs(eigenvalue.imag)
    return f"{real:.4g}" if imaginary <= CIRCLE else f"{real:.4g} +- {imaginary:.4g}i"
