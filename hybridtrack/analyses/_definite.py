"""Covariances as an ordered set: bounds below and above several of them, and numerical rank.

A <= B means that B - A is positive semidefinite. Two matrices have many lower bounds and no
greatest one; the one here is found along the directions that diagonalise both.
"""

from collections.abc import Callable, Sequence

import numpy as np

from hybridtrack.models import Array

RANK_TOLERANCE = 1e-12  # of singular values, relative to the largest: some 5000 roundings


def symmetric(matrices: Array) -> Array:
    """The symmetric part of matrices (..., n, n)."""
    return (matrices + np.swapaxes(matrices, -1, -2)) / 2


def meet(covariances: Sequence[Array]) -> Array:
    """A covariance (n, n) below all of some, folded in their order.

    Of positive definite A = L L' and B with L^-1 B L^-T = V diag(l) V' it is
    L V diag(min(l, 1)) V' L', where l are B's variances in units of A's. It depends on the order
    where there are three or more.
    """
    return _folded(covariances, np.minimum)


def join(covariances: Sequence[Array]) -> Array:
    """A covariance (n, n) above all of some, folded in their order: as `meet`, with max."""
    return _folded(covariances, np.maximum)


def _folded(covariances: Sequence[Array], choose: Callable[[Array, Array], Array]) -> Array:
    bound = covariances[0]
    for other in covariances[1:]:
        bound = _along_common_directions(bound, other, choose)
    return bound


def _along_common_directions(
    first: Array, second: Array, choose: Callable[[Array, Array], Array]
) -> Array:
    """The smaller or the larger of two in each direction that diagonalises both.

    The two are measured against their sum, which gives the same bound as measuring one against
    the other and lets one, or both, be singular.
    """
    from scipy.linalg import eigh

    scale = np.sqrt(np.maximum(np.diag(first) + np.diag(second), 0.0))
    scale[scale == 0.0] = 1.0  # so that metres and their derivatives are alike in rounding
    unit = np.outer(scale, scale)
    total = symmetric((first + second) / unit)
    variances, axes = np.linalg.eigh(total)
    kept = axes[:, variances > RANK_TOLERANCE * max(float(variances[-1]), 0.0)]
    if not kept.size:
        return np.zeros_like(first)
    inside = symmetric(kept.T @ total @ kept)
    share, directions = eigh(symmetric(kept.T @ (first / unit) @ kept), inside)
    share = np.clip(share, 0.0, 1.0)
    basis = scale[:, np.newaxis] * (kept @ inside @ directions)
    return symmetric((basis * choose(share, 1.0 - share)) @ basis.T)


def square_root(covariances: Array) -> Array:
    """G (..., n, n) with G G' the covariances (..., n, n); columns of rounding are zero."""
    scale = np.sqrt(np.maximum(np.diagonal(covariances, axis1=-2, axis2=-1), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)  # a state's unit mustn't make its noise a rounding
    variances, axes = np.linalg.eigh(
        symmetric(covariances) / (unit[..., :, np.newaxis] * unit[..., np.newaxis, :])
    )
    least = RANK_TOLERANCE * np.maximum(variances[..., -1:], 0.0)
    deviations = np.sqrt(np.where(variances > least, variances, 0.0))
    root: Array = unit[..., :, np.newaxis] * axes * deviations[..., np.newaxis, :]
    return root


def is_definite(covariance: Array) -> bool:
    """Whether a covariance (n, n) has full rank in numbers, whatever its states' units."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if not scale.all():
        return False
    variances = np.linalg.eigvalsh(symmetric(covariance / np.outer(scale, scale)))
    return bool(variances[0] > RANK_TOLERANCE * variances[-1])


def is_singular(matrix: Array) -> bool:
    """Whether a square matrix (n, n), a map of states, has no inverse in numbers.

    It is balanced first, since the states' units mustn't decide.
    """
    from scipy.linalg import matrix_balance

    values = np.linalg.svd(matrix_balance(matrix, permute=False)[0], compute_uv=False)
    return bool(values[-1] <= RANK_TOLERANCE * values[0])
