"""The placement of several points as local solvers see it: the objective, its slopes, the solvers.

Eq. 33 of Otanez 2004 is a largest error of best models: it has kinks wherever another place is the
worst, and many local minima. In one state meetings of regions are interpolated between places.
"""

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from hybridtrack.analyses._linearisation import Nonlinear, largest_on_places, lattice
from hybridtrack.compiled import kernel
from hybridtrack.models import Array

PLACES = 201  # of a range of one state: what lies between is interpolated
PLACES_OF_SEVERAL = 900
NUDGE = 1e-7  # of the range: a difference that slopes are taken over
STOPS = 1e-6  # MATLAB's default: relative, of the objective


class Objective:
    """The worst error of points (n d,), as the solvers see it, and its slopes."""

    def __init__(
        self,
        function: Nonlinear,
        kind: str,
        box: tuple[Array, Array],
        count: int,
        places: Array | None = None,
    ) -> None:
        """For `count` points in a box (d,), (d,), judged at places (m, d), by default a lattice."""
        low, high = box
        self.shape = (count, len(low))
        self.ordered = len(low) == 1
        if places is None:
            places = lattice(low, high, PLACES if self.ordered else PLACES_OF_SEVERAL)
        self._errors = largest_on_places(function, kind, places)
        self._nudge = NUDGE * (high - low)
        self.box = list(
            zip(np.tile(low, count).tolist(), np.tile(high, count).tolist(), strict=True)
        )

    def by_region(self, points: Array) -> Array:
        """The largest error (n,) in the region that each model is the best in; 0 if it has none."""
        return self._regions(self._errors(points.reshape(self.shape)))

    def worst(self, points: Array) -> float:
        """The largest of these."""
        return float(self.by_region(points).max())

    def slopes(self, points: Array) -> tuple[Array, Array]:
        """Of by_region (n, n d), by differences, and itself; all points are judged at one go."""
        count, d = self.shape
        at = points.reshape(self.shape)
        moved = at[:, np.newaxis] + np.diag(self._nudge)  # (n, d, d): one coordinate each
        found = self._errors(np.vstack([at, moved.reshape(-1, d)]))
        still = found[:, :count]
        before = self._regions(still)
        result = np.empty((count, count * d))
        for k in range(count * d):
            tried = still.copy()
            tried[:, k // d] = found[:, count + k]
            result[:, k] = (self._regions(tried) - before) / self._nudge[k % d]
        return result, before

    def _regions(self, found: Array) -> Array:
        """Of errors (m, n): each model's largest where it is the best; 0 if it is nowhere."""
        result: Array = largest_by_region(found, self.ordered)
        return result


@kernel
def largest_by_region(found: Array, ordered: bool) -> Array:
    """Of errors (m, n) at places: each model's largest (n,) where it is the best; 0 if nowhere.

    ordered: along one state a meeting of two regions lies between two places; there both errors are
    interpolated, or the objective would be a staircase that solvers get stuck on.
    """
    m, n = found.shape
    result = np.zeros(n)
    before = -1
    for row in range(m):
        owner = 0
        for i in range(1, n):
            if found[row, i] < found[row, owner]:
                owner = i
        result[owner] = max(result[owner], found[row, owner])
        if ordered and row > 0 and owner != before:
            falls = found[row - 1, owner] - found[row - 1, before]
            total = falls + found[row, before] - found[row, owner]
            part = falls / total if total > 0.0 else 0.0
            left = found[row - 1, before]
            meeting = left + part * (found[row, before] - left)
            result[before] = max(result[before], meeting)
            result[owner] = max(result[owner], meeting)
        before = owner
    return result


class Scaled(Objective):
    """The same of points that are parts of the range, 0 to 1: solvers' steps have no unit."""

    def __init__(
        self, function: Nonlinear, kind: str, box: tuple[Array, Array], count: int
    ) -> None:
        super().__init__(function, kind, box, count)
        low, high = box
        judged, width = self._errors, high - low
        self._errors = lambda parts: judged(low + width * parts)
        self._nudge = np.full(len(low), NUDGE)
        self.box = [(0.0, 1.0)] * (count * len(low))

    def ends(self, start: Array) -> dict[str, Array]:
        """Where every solver ends (n d,), by its name; what gave up above its start, there."""
        found = {}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a solver's steps out of bounds, which it clips
            for name, solver in SOLVERS.items():
                end = np.clip(solver(self, start), 0.0, 1.0)
                found[name] = end if self.worst(end) <= self.worst(start) else start
        return found


# ---- solvers ---------------------------------------------------------------------------------


def sqp(objective: Objective, start: Array) -> Array:
    """On the largest error itself, whose slope jumps where another place is the worst."""
    from scipy.optimize import minimize

    level = objective.worst(start) or 1.0  # a solver stops by what a start is worth

    def slope(c: Array) -> Array:
        slopes, errors = objective.slopes(c)
        result: Array = slopes[int(errors.argmax())] / level
        return result

    return _end(
        minimize(
            lambda c: objective.worst(c) / level,
            start,
            jac=slope,
            method="SLSQP",
            bounds=objective.box,
            options={"ftol": STOPS},
        )
    )


def sqp_by_region(objective: Objective, start: Array) -> Array:
    """The smallest t above the largest error of every model's own region: smooth constraints."""
    from scipy.optimize import minimize

    level = objective.worst(start) or 1.0
    ones = np.ones((objective.shape[0], 1))
    answer = minimize(
        lambda z: z[-1],
        np.append(start, 1.0),
        jac=lambda z: np.append(np.zeros(len(z) - 1), 1.0),
        method="SLSQP",
        bounds=[*objective.box, (0.0, None)],
        constraints=[
            {
                "type": "ineq",
                "fun": lambda z: z[-1] - objective.by_region(z[:-1]) / level,
                "jac": lambda z: np.hstack([-objective.slopes(z[:-1])[0] / level, ones]),
            }
        ],
        options={"ftol": STOPS},
    )
    return _end(answer)[:-1]


def nelder_mead(objective: Objective, start: Array) -> Array:
    """Without slopes."""
    from scipy.optimize import minimize

    level = objective.worst(start) or 1.0
    options = {"xatol": 1e-4, "fatol": 1e-4 * level}
    return _end(
        minimize(
            objective.worst, start, method="Nelder-Mead", bounds=objective.box, options=options
        )
    )


def _end(answer: Any) -> Array:
    return np.asarray(answer.x, dtype=np.float64)


SOLVERS: Mapping[str, Callable[[Objective, Array], Array]] = {
    "sqp": sqp,
    "sqp_by_region": sqp_by_region,
    "nelder_mead": nelder_mead,
}
