"""What no placement of so many points can do better than: a lower bound, by linear programming.

The range is cut into cells that a point may stand in, and each cell is credited with the smallest
error that any point of it leaves at each of many places. At a level of error the places that a cell
serves are then known, and N points need N cells that serve all places. Cells may be taken in parts:
where even these parts sum to more than N, no N points do (the linear programme's optimum is below
the smallest covering). The largest such level is below every placement's worst error.
"""

import math

import numpy as np
import numpy.typing as npt

from hybridtrack.analyses._enclosures import largest_sizes
from hybridtrack.analyses._linearisation import PRINTED, Nonlinear, errors, lattice
from hybridtrack.models import Array

Flags = npt.NDArray[np.bool_]

CELLS = {1: 1000, 2: 900, 3: 1000}  # and as many places
FINENESS = {1: 2e-3, 2: 0.02, 3: 0.02}  # of the best known: how exactly the level is bisected
MORE = 1e-6  # than N: what a linear programme's rounding doesn't explain


def least_error(
    function: Nonlinear, kind: str, low: Array, high: Array, count: int, best: float
) -> float:
    """A level that no `count` points in a box low (d,), high (d,) have their worst error below.

    best: a level that some points reach. NaN where second derivatives have no enclosure.
    """
    credited = _credited(function, kind, low, high)
    if credited is None or not math.isfinite(best):
        return math.nan
    unserved, served = 0.0, best
    while served - unserved > FINENESS[len(low)] * best:
        middle = 0.5 * (unserved + served)
        if _needs_more(credited <= middle, count):
            unserved = middle
        else:
            served = middle
    return unserved


def _credited(function: Nonlinear, kind: str, low: Array, high: Array) -> Array | None:
    """Places (m,) by cells (n,): the largest weighted component of no point of a cell is less.

    Along its point c an error of f changes by f''(c) (x - c), which is enclosed over each cell; the
    printed one by 2 f''(x) (x - c).
    """
    d = len(low)
    side = round(CELLS[d] ** (1.0 / d))
    half = 0.5 * (high - low) / side
    centres = lattice(low + half, high - half, side**d)
    x = lattice(low, high, side**d)
    far = np.abs(x[:, np.newaxis] - centres) + half  # (m, n, d)
    if kind == PRINTED:
        bends = 2.0 * np.abs(function.hessian(x))  # (m, k, d, d)
        change = np.einsum("a,mkab,mnb->mnk", half, bends, far)
    else:
        enclosed = _curvature(function, centres - half, centres + half)
        if not np.isfinite(enclosed).all():
            return None
        change = np.einsum("a,nkab,mnb->mnk", half, enclosed, far)
    left = errors(function, kind, x, centres) - change * function.weights
    result: Array = left.max(axis=-1)
    return result


def _curvature(function: Nonlinear, low: Array, high: Array) -> Array:
    """An upper bound (n, k, d, d) of every |second derivative| over boxes low, high (n, d)."""
    import sympy

    d = low.shape[1]
    result = np.full((len(low), len(function.components), d, d), np.inf)
    for j, expression in enumerate(function.expressions):
        for a in range(d):
            for b in range(a, d):
                second = sympy.diff(expression, function.symbols[a], function.symbols[b])
                result[:, j, a, b] = largest_sizes(second, function.symbols, low, high)
                result[:, j, b, a] = result[:, j, a, b]
    return result


def _needs_more(serves: Flags, count: int) -> bool:
    """Whether places (m,) that cells (n,) serve, or not, need more than `count` parts of cells."""
    from scipy.optimize import linprog
    from scipy.sparse import csr_matrix

    if not serves.any(axis=1).all():
        return True
    kept = _reduced(serves)
    answer = linprog(
        np.ones(kept.shape[1]),
        A_ub=-csr_matrix(kept.astype(float)),
        b_ub=-np.ones(len(kept)),
        bounds=(0.0, 1.0),
        method="highs",
    )
    return answer.x is not None and bool(answer.fun > count + MORE)


def _reduced(serves: Flags) -> Flags:
    """Without cells that serve no more than another does, and places that come with another."""
    while True:
        before = serves.shape
        serves = serves[:, _largest(serves.T)]
        serves = serves[~_larger(serves)]
        if serves.shape == before:
            return serves


def _largest(sets: Flags) -> Flags:
    """Which of sets (n, m), one a row, are inside no other; of equals the first."""
    return ~_inside(sets)


def _larger(sets: Flags) -> Flags:
    """Which of sets (n, m), one a row, hold another; of equals all but the first."""
    return _inside(~sets)


def _inside(sets: Flags) -> Flags:
    """Which of sets (n, m) are inside another, or equal to an earlier one."""
    numbers = sets.astype(np.float32)
    sizes = numbers.sum(axis=1)
    inside = numbers @ numbers.T >= sizes[:, np.newaxis] - 0.5
    equal = inside & inside.T
    result: Flags = (inside & ~equal).any(axis=1) | np.tril(equal, -1).any(axis=1)
    return result
