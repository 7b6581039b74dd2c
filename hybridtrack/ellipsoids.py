"""Ellipsoids that contain a state for certain: their sums, their intersections, boxes inside them.

An ellipsoid Omega(c, S) is the set of x with (x - c)' S^-1 (x - c) <= 1. Shapes: lanes (runs)
first, S (lanes, n, n), c (lanes, n). Everything is NumPy over all lanes at once.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.models import Array

SEARCHED = np.concatenate([np.geomspace(1e-4, 0.1, 13), np.linspace(0.2, 0.9, 8), [0.97]])  # rho
GOLDEN, GOLDEN_STEPS = (np.sqrt(5.0) - 1.0) / 2.0, 12  # from a cell of the search to 0.3 % of it


def trace(shape: Array) -> Array:
    """tr S (lanes,)."""
    result: Array = np.einsum("...ii->...", shape)
    return result


def half_widths(shape: Array) -> Array:
    """sqrt(S_jj) (lanes, n): how far the ellipsoid reaches from its centre along each state."""
    result: Array = np.sqrt(np.maximum(np.einsum("...ii->...i", shape), 0.0))
    return result


def symmetric(shape: Array) -> Array:
    """The symmetric part."""
    result: Array = 0.5 * (shape + np.swapaxes(shape, -1, -2))
    return result


class Sum(NamedTuple):
    """An ellipsoid around the sum of two, and the weight that made it."""

    shape: Array  # (lanes, n, n)
    beta: Array  # (lanes,) the second one's; 1 where the first is a point, 0 where the second is


def add(first: Array, second: Array, beta: float | None) -> Sum:
    """S1/(1 - beta) + S2/beta, which contains the sum of both (Schweppe 1973; Otanez 2004, eq. 2).

    beta None: the one of the smallest trace, sqrt(tr S2)/(sqrt(tr S1) + sqrt(tr S2)). Where one of
    the two is a point the sum is the other.
    """
    one, two = (np.sqrt(np.maximum(trace(shape), 0.0)) for shape in (first, second))
    total = one + two
    weight = np.divide(two, total, out=np.ones_like(total), where=total > 0.0)
    if beta is not None:
        weight = np.where((one > 0.0) & (two > 0.0), beta, weight)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = np.where(one > 0.0, 1.0 / (1.0 - weight), 0.0)[..., np.newaxis, np.newaxis]
        right = np.where(two > 0.0, 1.0 / weight, 0.0)[..., np.newaxis, np.newaxis]
    return Sum(left * first + right * second, weight)


def around_box(radius: Array, rule: str) -> Array:
    """Diagonal q (lanes, n) of an ellipsoid around the box |x_j| <= r_j; it touches the corners.

    count: m r_j^2, m the number of r_j that aren't 0 (the smallest volume); trace: r_j sum r (the
    smallest trace); two: 2 r_j^2, as Otanez 2004, eq. 22 prints it, right where m <= 2 only. In the
    first two sum r_j^2/q_j = 1.
    """
    if rule == "trace":
        by_trace: Array = radius * radius.sum(axis=-1, keepdims=True)
        return by_trace
    number = 2.0 if rule == "two" else (radius > 0.0).sum(axis=-1, keepdims=True)
    result: Array = number * radius**2
    return result


class Updated(NamedTuple):
    """The intersection with what a measurement allows, in an ellipsoid of its own."""

    centre: Array  # (lanes, n)
    shape: Array  # (lanes, n, n) before (1 - delta): Sigma-bar of eq. 4
    distance: Array  # (lanes,) e' S^-1 e, delta of eq. 5: above 1 the intersection is empty
    rho: Array  # (lanes,)


def update(
    centre: Array, shape: Array, innovation: Array, C: Array, R: Array, rho: Array
) -> Updated:
    """Fuse Omega(centre, shape) with a measurement (Otanez 2004, eq. 3-5), in Joseph's form.

    innovation e = y - h(centre) (lanes, n_y); C (n_y, n) or (lanes, n_y, n); R alike; rho (lanes,)
    in (0, 1). (4) as printed cancels: a large P minus nearly itself; here two squares are added.
    """
    P = shape / (1.0 - rho)[:, np.newaxis, np.newaxis]
    noise = R / rho[:, np.newaxis, np.newaxis]
    PC = P @ np.swapaxes(C, -1, -2)
    S = symmetric(C @ PC + noise)
    K = PC @ inverse(S)
    left = np.eye(P.shape[-1]) - K @ C
    fused = symmetric(left @ P @ np.swapaxes(left, -1, -2) + K @ noise @ np.swapaxes(K, -1, -2))
    moved = centre + (K @ innovation[..., np.newaxis])[..., 0]
    return Updated(moved, fused, quadratic(innovation, S), rho)


def inverse(shape: Array) -> Array:
    """S^-1 (lanes, m, m) of positive definite S; NaN where it has none."""
    m = shape.shape[-1]
    with np.errstate(all="ignore"):
        if m == 1:
            return 1.0 / shape
        if m == 2:
            a, b, d = shape[..., 0, 0], shape[..., 0, 1], shape[..., 1, 1]
            swapped = np.stack([np.stack([d, -b], -1), np.stack([-b, a], -1)], -2)
            # b/a first: a d alone may leave the range of floats.
            result: Array = swapped / (a * (d - b * (b / a)))[..., np.newaxis, np.newaxis]
            return result
        sound: NDArray[np.bool_] = np.asarray(np.isfinite(shape).all(axis=(-1, -2)))
        safe = np.where(sound[..., np.newaxis, np.newaxis], shape, np.eye(m))
        try:
            inverted: Array = np.linalg.inv(safe)
        except np.linalg.LinAlgError:  # one of them is singular: the pseudo-inverse has no such end
            inverted = np.linalg.pinv(safe, hermitian=True)
        return np.where(sound[..., np.newaxis, np.newaxis], inverted, np.nan)


def quadratic(vector: Array, shape: Array) -> Array:
    """v' S^-1 v (lanes,), by a factorisation L L' that breaks down nowhere: |L^-1 v|^2.

    Where a pivot is not positive S has no such ellipsoid: infinite, or NaN where S is.
    """
    n = vector.shape[-1]
    rest = np.array(np.broadcast_to(shape, (*vector.shape[:-1], n, n)))
    left = np.array(vector, dtype=np.float64)
    total = np.zeros(vector.shape[:-1])
    with np.errstate(all="ignore"):
        for j in range(n):
            pivot = rest[..., j, j]
            term = left[..., j] ** 2 / pivot
            term = np.where(pivot > 0.0, term, np.where(left[..., j] == 0.0, 0.0, np.inf))
            total = total + np.where(np.isnan(pivot), np.nan, term)
            column = rest[..., j + 1 :, j] / pivot[..., np.newaxis]
            left[..., j + 1 :] -= column * left[..., j : j + 1]
            rest[..., j + 1 :, j + 1 :] -= (
                column[..., :, np.newaxis] * rest[..., np.newaxis, j, j + 1 :]
            )
    result: Array = total
    return result


def sizes(shape: Array, measure: str) -> Array:
    """How large ellipsoids are (lanes,): trace, determinant or largest eigenvalue of S."""
    if measure == "trace":
        return trace(shape)
    sound: NDArray[np.bool_] = np.asarray(np.isfinite(shape).all(axis=(-1, -2)))
    safe = np.where(sound[..., np.newaxis, np.newaxis], shape, np.eye(shape.shape[-1]))
    with np.errstate(all="ignore"):
        found = (
            np.linalg.det(safe) if measure == "determinant" else np.linalg.eigvalsh(safe)[..., -1]
        )
    result: Array = np.where(sound, found, np.inf)
    return result


def best_rho(size: Callable[[Array], Array], lanes: int) -> Array:
    """The rho (lanes,) of the smallest size(rho) on (0, 1): a search, then golden sections.

    size: of one rho per lane. Whatever is found is a rho in (0, 1), so the ellipsoid is right.
    """
    values = np.stack([size(np.full(lanes, rho)) for rho in SEARCHED])
    best = np.nanargmin(np.where(np.isnan(values), np.inf, values), axis=0)
    low, high = SEARCHED[np.maximum(best - 1, 0)], SEARCHED[np.minimum(best + 1, len(SEARCHED) - 1)]
    for _ in range(GOLDEN_STEPS):
        a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        left: NDArray[np.bool_] = size(a) < size(b)
        low, high = np.where(left, low, a), np.where(left, b, high)
    found: Array = 0.5 * (low + high)
    return found
