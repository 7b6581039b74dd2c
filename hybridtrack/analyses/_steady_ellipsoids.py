"""The ellipsoid that a set-membership filter settles at, by the rule that weighs its sets.

Of Bertsekas's form (Otanez 2004, eqs. 2 and 29), whose shape doesn't depend on what is measured:
P = A Sigma A'/(1 - beta) + Qhat/beta, Sigma = [(1 - rho) P^-1 + rho C' R^-1 C]^-1. The paper names
no rule for beta and rho; what is steady depends on it by a factor of four.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from hybridtrack.models import Array

STEPS = 5_000  # after which what still grows is said to grow for good
SETTLED = 1e-10  # relative change per step
DOUBLINGS = 40
GROWN = 1e16  # times the start: it has no steady state
NEAR = 1e-9  # of 0 and 1: a weight that leaves one of the two sets out

BEST_CONSTANTS = "best_constants"


class Steady(NamedTuple):
    """An ellipsoid that stays as it is, and the weights that keep it so."""

    shape: Array  # Sigma (n, n)
    beta: float
    rho: float

    @property
    def half_widths(self) -> Array:
        """sqrt(Sigma_jj) (n,): how far from the estimate each state can be."""
        result: Array = np.sqrt(np.diagonal(self.shape))
        return result

    @property
    def weights(self) -> dict[str, float]:
        """beta and rho by name."""
        return {"beta": self.beta, "rho": self.rho}


# ---- beta: the sum of two ellipsoids ---------------------------------------------------------


def beta_of_trace(moved: Array, noise: Array) -> float:
    """Of the smallest trace of M/(1 - beta) + N/beta: sqrt(tr N)/(sqrt(tr M) + sqrt(tr N))."""
    one, two = math.sqrt(np.trace(moved)), math.sqrt(np.trace(noise))
    return _inside(two / (one + two)) if two > 0.0 else 0.0


def beta_of_determinant(moved: Array, noise: Array) -> float:
    """Of the smallest volume: with p = beta/(1 - beta) and l of N relative to M, sum 1/(l + p) =
    n/(p (p + 1)), which has one solution (Kurzhanski, Valyi 1997, section 2.5)."""
    from scipy.linalg import eigh
    from scipy.optimize import brentq

    relative = np.maximum(eigh(noise, moved, eigvals_only=True), 0.0)
    n = len(relative)

    def slope(logarithm: float) -> float:
        p = math.exp(logarithm)
        return float((p / (relative + p)).sum()) - n / (p + 1.0)

    span = math.log(1.0 / NEAR)
    if slope(-span) >= 0.0:
        return NEAR
    if slope(span) <= 0.0:
        return 1.0 - NEAR
    p = math.exp(brentq(slope, -span, span, xtol=1e-14, rtol=1e-14))
    return p / (1.0 + p)


# ---- rho: the intersection with what a measurement allows ------------------------------------


def rho_of_trace(P: Array, C: Array, R: Array) -> float:
    """Of the smallest trace of [(1 - rho) P^-1 + rho C' R^-1 C]^-1, which is convex in rho."""
    gains, parts = _seen(P, C, R)
    return _root(
        lambda rho: float((parts * (1.0 - gains) / (1.0 + rho * (gains - 1.0)) ** 2).sum())
    )


def rho_of_determinant(P: Array, C: Array, R: Array) -> float:
    """Of the smallest volume, whose logarithm is convex in rho."""
    gains, _ = _seen(P, C, R)
    return _root(lambda rho: float(((1.0 - gains) / (1.0 + rho * (gains - 1.0))).sum()))


def rho_of_eigenvalues(P: Array, C: Array, R: Array) -> float:
    """sqrt(r)/(sqrt(p) + sqrt(r)) of the largest eigenvalues of R and C P C' (Scholte, Campbell
    2003): no search, and safe, but not the smallest."""
    p = math.sqrt(max(np.linalg.eigvalsh(C @ P @ C.T)[-1], 0.0))
    r = math.sqrt(max(np.linalg.eigvalsh(R)[-1], 0.0))
    return _inside(r / (p + r))


def _inside(weight: float) -> float:
    """Not so near to 0 or 1 that a set is divided by it."""
    return min(max(weight, NEAR), 1.0 - NEAR)


def _seen(P: Array, C: Array, R: Array) -> tuple[Array, Array]:
    """What is measured in the coordinates that make P round: gains (n,) and shares of tr P (n,)."""
    values, vectors = np.linalg.eigh(P)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    seen = C @ root
    gains, axes = np.linalg.eigh(seen.T @ np.linalg.solve(R, seen))
    return np.maximum(gains, 0.0), ((root @ axes) ** 2).sum(axis=0)


def _root(slope: Callable[[float], float]) -> float:
    """Where a growing slope is 0 in (0, 1), or the nearer end."""
    from scipy.optimize import brentq

    if slope(NEAR) >= 0.0:
        return NEAR
    if slope(1.0 - NEAR) <= 0.0:
        return 1.0 - NEAR
    return float(brentq(slope, NEAR, 1.0 - NEAR, xtol=1e-15, rtol=1e-14))


class Rule(NamedTuple):
    """How beta and rho are chosen at every step."""

    beta: Callable[[Array, Array], float]
    rho: Callable[[Array, Array, Array], float]
    words: str


RULES: Mapping[str, Rule] = {
    "trace_trace": Rule(beta_of_trace, rho_of_trace, "smallest trace, smallest trace"),
    "trace_sqrt": Rule(beta_of_trace, rho_of_eigenvalues, "smallest trace, roots of eigenvalues"),
    "determinant_determinant": Rule(
        beta_of_determinant, rho_of_determinant, "smallest volume, smallest volume"
    ),
    "trace_determinant": Rule(beta_of_trace, rho_of_determinant, "smallest trace, smallest volume"),
}
NAMES = (*RULES, BEST_CONSTANTS)


# ---- the steady state ------------------------------------------------------------------------


def steady(A: Array, C: Array, Q: Array, R: Array, rule: str, state: int = 0) -> Steady | None:
    """The steady ellipsoid of A (n, n), C (n_y, n), Qhat (n, n), R (n_y, n_y); None without one.

    state: the one that the best constants make the bound of smallest. What isn't finite has none.
    """
    if not all(np.isfinite(part).all() for part in (A, C, Q, R)) or not seen(A, C):
        return None
    if rule == BEST_CONSTANTS:
        return best_constants(A, C, Q, R, state)
    chosen = RULES[rule]
    largest = float(np.linalg.eigvalsh(R)[-1]) + float(np.trace(Q))
    shape = largest * np.eye(len(A))
    for _ in range(STEPS):
        moved = A @ shape @ A.T
        try:
            beta = chosen.beta(moved, Q)
        except np.linalg.LinAlgError:  # a flat ellipsoid, which has no volume
            return None
        predicted = around_sum(moved, Q, beta)
        rho = chosen.rho(predicted, C, R)
        fused = intersection(predicted, C, R, rho)
        if not np.trace(fused) < GROWN * largest:
            return None
        if not Q.any() and np.trace(fused) < largest / GROWN**2:
            return Steady(np.zeros_like(fused), beta, rho)  # without noise it shrinks to a point
        std = np.sqrt(np.maximum(np.diagonal(fused), 0.0))  # of huge noise rounding may be left
        if (np.abs(fused - shape) <= SETTLED * np.outer(std, std)).all():
            return Steady(fused, beta, rho)
        shape = fused
    return None


def seen(A: Array, C: Array) -> bool:
    """Whether every part of the state that doesn't decay is measured, now or later."""
    for eigenvalue in np.linalg.eigvals(A):
        if abs(eigenvalue) >= 1.0 - 1e-9:
            rows = np.vstack([eigenvalue * np.eye(len(A)) - A, C])
            # a double eigenvalue is known to the root of rounding
            if np.linalg.matrix_rank(rows, tol=1e-7 * max(float(np.abs(A).max()), 1.0)) < len(A):
                return False
    return True


def around_sum(moved: Array, noise: Array, beta: float) -> Array:
    """M/(1 - beta) + N/beta (eq. 2); the other one where one of the two is a point."""
    if beta <= 0.0 or beta >= 1.0:
        return moved if beta <= 0.0 else noise
    predicted = moved / (1.0 - beta) + noise / beta
    result: Array = 0.5 * (predicted + predicted.T)
    return result


def intersection(P: Array, C: Array, R: Array, rho: float) -> Array:
    """[(1 - rho) P^-1 + rho C' R^-1 C]^-1 (eq. 29), as a sum of two squares (Joseph's form)."""
    wide, noise = P / (1.0 - rho), R / rho
    gain = np.linalg.solve(C @ wide @ C.T + noise, C @ wide).T
    left = np.eye(len(P)) - gain @ C
    result: Array = left @ wide @ left.T + gain @ noise @ gain.T
    return result


def with_constants(A: Array, C: Array, Q: Array, R: Array, beta: float, rho: float) -> Array | None:
    """Sigma (n, n) for one beta and rho at all steps; None without one.

    P/(1 - rho) solves the Riccati equation of a Kalman filter with A/sqrt((1 - beta)(1 - rho)), the
    noises Q/(beta (1 - rho)) and R/rho.
    """
    grown = A / math.sqrt((1.0 - beta) * (1.0 - rho))
    wide = _riccati(grown, C.T @ np.linalg.solve(R / rho, C), Q / (beta * (1.0 - rho)))
    if wide is None:
        return None
    shape = intersection((1.0 - rho) * wide, C, R, rho)
    # doubling that has lost its digits may end in what is no ellipsoid
    return shape if (np.diagonal(shape) >= 0.0).all() else None


def _riccati(A: Array, information: Array, Q: Array) -> Array | None:
    """X = A X (I + G X)^-1 A' + Q by doubling: k rounds are 2^k steps of the recursion from X = Q.

    Anderson 1978. scipy's solver takes milliseconds for what are 3 x 3 matrices, and this is
    called a hundred times for every best constant.
    """
    F, G, X = A.T, information, Q
    identity = np.eye(len(A))
    for _ in range(DOUBLINGS):
        try:
            half = np.linalg.solve(identity + G @ X, np.hstack([F, G]))
        except np.linalg.LinAlgError:  # what grows for good has lost all digits
            return None
        through, seen = half[:, : len(A)], half[:, len(A) :]
        step = F.T @ X @ through
        X, G = X + 0.5 * (step + step.T), G + F @ seen @ F.T
        F = F @ through
        if not np.isfinite(X).all() or np.trace(X) > GROWN * max(np.trace(Q), 1e-300):
            return None
        if np.abs(step).max() <= 1e-12 * np.abs(X).max():
            return X
    return None


def best_constants(A: Array, C: Array, Q: Array, R: Array, state: int) -> Steady | None:
    """The constant beta and rho of the smallest Sigma_jj of a state: a search over both."""
    from scipy.optimize import minimize

    def size(logits: Array) -> float:
        beta, rho = _weights(logits)
        with np.errstate(all="ignore"):  # what grows for good
            shape = with_constants(A, C, Q, R, beta, rho)
        # without noise an ellipsoid shrinks to a point, which no constants keep
        found = 0.0 if shape is None else float(shape[state, state])
        return math.log(found) if 0.0 < found < math.inf else math.inf

    tried = [np.array([b, r]) for b in (-5.0, -3.0, -1.0) for r in (-5.0, -3.0, -1.0)]
    start = min(tried, key=size)
    if math.isinf(size(start)):
        return None
    simplex = start + np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])
    options = {"xatol": 1e-4, "fatol": 1e-9, "initial_simplex": simplex}
    beta, rho = _weights(minimize(size, start, method="Nelder-Mead", options=options).x)
    shape = with_constants(A, C, Q, R, beta, rho)
    return None if shape is None else Steady(shape, beta, rho)


def _weights(logits: Array) -> tuple[float, float]:
    beta, rho = 1.0 / (1.0 + np.exp(-np.clip(logits, -20.0, 20.0)))
    return float(beta), float(rho)


# ---- noise with a remainder ------------------------------------------------------------------


def around_box(radius: Array) -> Array:
    """The smallest ellipsoid around the box |x_j| <= r_j: m r_j^2 on the diagonal (n, n), m the
    number of r_j that aren't 0. (22) of Otanez 2004 prints 2 for m, right for two only."""
    return np.diag(float((radius > 0.0).sum()) * radius**2)


def with_box(noise: Array, radius: Array) -> Array:
    """Qhat: an ellipsoid around the sum of a noise's and a box (eq. 23), of the smallest trace."""
    box = around_box(radius)
    if not box.any():
        return noise
    if not noise.any():
        return box
    return around_sum(box, noise, beta_of_trace(box, noise))
