"""Where to linearise, in one varied state: the smallest largest error, to the global optimum.

Placing N points so that the worst place of a range is served best is a covering problem. At a given
level of error each place x is served by an interval of points; walking from the left and setting
each point as far right as the leftmost unserved place allows needs the fewest points of all (the
greedy piercing of intervals). So a bisection on the level finds the optimum of eq. 33 of Otanez
2004, which local solvers miss from many starts. The exact error of a function whose second
derivative changes its sign is served by no interval; there `_placement_search` looks.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hybridtrack.analyses._enclosures import largest_size
from hybridtrack.analyses._linearisation import EXACT, Nonlinear
from hybridtrack.analyses._worst_errors import Placement, worst_error
from hybridtrack.models import Array

CELLS = 65_536  # of the range; the certificate's gap is about the error times 3/CELLS
ENCLOSED = 128  # intervals that fourth derivatives are enclosed over
SIGNS = 4096  # cells that a second derivative's sign is looked up at
ROUNDING = 1e-12  # of its largest value: what has no sign
HALVINGS = 60
BITS = 16.0  # last bits of the largest value that a sum of a few terms may lose
BISECTIONS = 50  # of a place: to 1e-15 of what is left of the range

CERTIFICATE = "greedy covering, bisected"
NOT_ENCLOSED = "the fourth derivative has no enclosure, so errors are those of a lattice"

Cover = Callable[[float], list[float] | None]  # points that serve the range at a level, or None


def place_one(
    function: Nonlinear, kind: str, low: float, high: float, count: int
) -> Placement | None:
    """The best `count` points in [low, high] for a function of one state.

    None for the exact error of what has a second derivative that changes its sign there.
    """
    if kind == EXACT:
        return _place_exact(function, low, high, count)
    return _place_printed(function, kind, low, high, count)


def smallest_level(cover: Cover, highest: float) -> tuple[float, float, list[float]]:
    """Bisection: a level that can't be served, one above it that can, and the points that do."""
    unserved, served = 0.0, highest
    points = cover(served)
    while points is None:  # rounding at the top
        served *= 2.0
        points = cover(served)
    for _ in range(HALVINGS):
        middle = 0.5 * (unserved + served)
        tried = cover(middle)
        if tried is None:
            unserved = middle
        else:
            served, points = middle, tried
        if served - unserved <= 1e-13 * served:
            break
    return unserved, served, points


# ---- (x - c)^2 |f''(x)|, as (40) prints it ---------------------------------------------------


def pierce(edges: Array, weight: Array, level: float, count: int) -> list[float] | None:
    """At most `count` points c with weight (x - c)^2 <= level for every x; None: too few.

    edges (cells + 1,); weight (cells,) is constant over each cell.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(weight > 0.0, np.sqrt(level / weight), np.inf)
    begin, end = edges[:-1].copy(), edges[1:]  # of what is unserved in each cell
    points: list[float] = []
    while True:
        unserved = begin < end
        if not unserved.any():
            return points or [0.5 * float(edges[0] + edges[-1])]
        if len(points) == count:
            return None
        point = min(float((begin + reach)[unserved].min()), float(edges[-1]))
        points.append(point)
        begin = np.maximum(begin, point + reach)


def weights_of_cells(function: Nonlinear, edges: Array) -> tuple[Array, Array, bool]:
    """A lower and an upper bound of max_j |f_j''| over each cell, and whether they are certain.

    Between two edges g = f'' is off its chord by at most max |g''| h^2/8, with g'' enclosed.
    """
    at_edges = np.abs(function.hessian(edges[:, np.newaxis])[:, :, 0, 0]) * function.weights
    signs = np.sign(function.hessian(edges[:, np.newaxis])[:, :, 0, 0])
    bend, certain = _bends(function, edges)
    slack = bend * (np.diff(edges) ** 2 / 8.0)[:, np.newaxis]
    upper = np.maximum(at_edges[:-1], at_edges[1:]) + slack
    lower = np.minimum(at_edges[:-1], at_edges[1:]) - slack
    lower = np.where(signs[:-1] == signs[1:], np.maximum(lower, 0.0), 0.0)
    return lower.max(axis=1), upper.max(axis=1), certain


def _bends(function: Nonlinear, edges: Array) -> tuple[Array, bool]:
    """An upper bound of |f_j''''| over each cell (cells, k), weighted; 0 and False without one."""
    import sympy

    cells = len(edges) - 1
    coarse = np.linspace(edges[0], edges[-1], ENCLOSED + 1)
    if not function.expressions:
        return np.zeros((cells, len(function.components))), False
    (symbol,) = function.symbols
    found = [
        weight * largest_size(sympy.diff(expression, symbol, 4), symbol, coarse)
        for expression, weight in zip(function.expressions, function.weights, strict=True)
    ]
    if not np.isfinite(found).all():
        return np.zeros((cells, len(function.components))), False
    # a cell may lie across an edge of the coarse ones by rounding: the larger of neighbours
    wide = np.stack([np.pad(one, 1, mode="edge") for one in found], axis=1)
    wide = np.maximum(np.maximum(wide[:-2], wide[1:-1]), wide[2:])
    middle = 0.5 * (edges[:-1] + edges[1:])
    owner = np.clip(np.searchsorted(coarse, middle) - 1, 0, ENCLOSED - 1)
    return wide[owner], True


def _place_printed(
    function: Nonlinear, kind: str, low: float, high: float, count: int
) -> Placement:
    edges = np.linspace(low, high, CELLS + 1)
    lower, upper, certain = weights_of_cells(function, edges)
    highest = float(upper.max()) * (high - low) ** 2
    _, _, points = smallest_level(lambda q: pierce(edges, upper, q, count), highest)
    below, _, _ = smallest_level(lambda q: pierce(edges, lower, q, count), highest)
    chosen = _filled(points, count)
    worst, _ = worst_error(function, kind, np.array([low]), np.array([high]), chosen)
    if not certain:
        return Placement(chosen, worst, math.nan, "", NOT_ENCLOSED)
    return Placement(chosen, max(worst, below), below, CERTIFICATE, "")


# ---- |f(x) - f(c) - f'(c) (x - c)| -----------------------------------------------------------


class Majorant(NamedTuple):
    """E(x, c) = |integral from x to c of |f''(s)| |s - x| ds|, which bounds the exact error.

    It grows with the distance of x and c, both ways, so each model serves an interval and the
    greedy covering is the optimum. Where f'' keeps its sign it is the error itself.
    """

    starts: list[Array]  # by component: where a sign of f'' begins, from the range's left end
    signs: list[Array]
    function: Nonlinear

    def integrals(self, x: float) -> tuple[Array, Array]:
        """Of |f''| and of s |f''| from the left end to x: (k,) each."""
        zeroth, first = np.empty((2, len(self.starts)))
        for j, (starts, signs) in enumerate(zip(self.starts, self.signs, strict=True)):
            past = starts < x
            ends = np.append(starts[1:], np.inf)
            ends = np.where(ends > x, x, ends)[past]
            begins = starts[past]
            at = np.concatenate([begins, ends])[:, np.newaxis]
            slopes = self.function.jacobian(at)[:, j, 0]
            values = self.function.value(at)[:, j]
            moments = at[:, 0] * slopes - values
            half = len(begins)
            zeroth[j] = (signs[past] * (slopes[half:] - slopes[:half])).sum()
            first[j] = (signs[past] * (moments[half:] - moments[:half])).sum()
        return zeroth, first

    def error(self, x: float, c: float) -> float:
        """E(x, c), weighted, of the largest component."""
        (zeroth_x, first_x), (zeroth_c, first_c) = self.integrals(x), self.integrals(c)
        found = np.abs((first_c - first_x) - x * (zeroth_c - zeroth_x))
        return float((found * self.function.weights).max())

    def error_of(self, c: float, x: float) -> float:
        """E(x, c) of one point."""
        return self.error(x, c)


def majorant(function: Nonlinear, low: float, high: float) -> Majorant:
    """Of a function over [low, high]: where its second derivatives change their signs."""
    from scipy.optimize import brentq

    nodes = np.linspace(low, high, SIGNS + 1)
    curvature = function.hessian(nodes[:, np.newaxis])[:, :, 0, 0]
    starts, signs = [], []
    for j in range(curvature.shape[1]):
        # what is rounding beside the largest has no sign of its own
        own = np.where(np.abs(curvature[:, j]) > ROUNDING * np.abs(curvature[:, j]).max(), 1.0, 0.0)
        own *= np.sign(curvature[:, j])
        kept = np.flatnonzero(own)
        changes = kept[:-1][own[kept[:-1]] != own[kept[1:]]]
        follow = kept[1:][own[kept[:-1]] != own[kept[1:]]]
        fine = min(2e-12, 1e-13 * (high - low))
        roots = [
            float(
                brentq(
                    lambda x, j=j: function.hessian(np.array([[x]]))[0, j, 0, 0],
                    *(a, b),
                    xtol=fine,
                    full_output=True,
                    disp=False,
                )[0]
            )
            for a, b in zip(nodes[changes], nodes[follow], strict=True)
        ]
        starts.append(np.array([low, *roots]))
        signs.append(np.concatenate([own[kept[:1]], own[follow]]) if len(kept) else np.ones(1))
    return Majorant(starts, signs, function)


def _walk(bound: Majorant, low: float, high: float, level: float, count: int) -> list[float] | None:
    """The greedy covering: each point as far right as the first unserved place allows."""
    points: list[float] = []
    served = low
    while len(points) < count:
        begin = served
        point = _farthest(functools.partial(bound.error, begin), begin, high, level)
        points.append(point)
        served = _farthest(functools.partial(bound.error_of, point), point, high, level)
        if served >= high:
            return points
    return None


def _farthest(error: Callable[[float], float], start: float, high: float, level: float) -> float:
    """The largest place up to `high` with error <= level, of an error that grows from 0."""
    from scipy.optimize import brentq

    if error(high) <= level:
        return high
    fine = min(1e-14, 1e-13 * (high - start))
    place, answer = brentq(
        lambda x: error(x) - level,
        *(start, high),
        xtol=fine,
        rtol=1e-14,
        full_output=True,
        disp=False,
    )
    return float(place) if answer.converged else _halved(error, start, high, level)


def _halved(error: Callable[[float], float], served: float, unserved: float, level: float) -> float:
    """By bisection, which an error that rounding makes rough doesn't hold up."""
    for _ in range(BISECTIONS):
        middle = 0.5 * (served + unserved)
        if error(middle) <= level:
            served = middle
        else:
            unserved = middle
    return served


def _place_exact(function: Nonlinear, low: float, high: float, count: int) -> Placement | None:
    bound = majorant(function, low, high)
    if any(len(starts) > 1 for starts in bound.starts):
        return None
    highest = bound.error(low, high) + bound.error(high, low)
    below, _, points = smallest_level(lambda q: _walk(bound, low, high, q, count), highest)
    chosen = _filled(points, count)
    worst, _ = worst_error(function, EXACT, np.array([low]), np.array([high]), chosen)
    slack = _unseen(function, low, high)
    if math.isinf(slack):
        return Placement(chosen, worst, math.nan, "", NOT_ENCLOSED)
    below = max(below - slack - rounding(function, low, high), 0.0)
    return Placement(chosen, max(worst, below), below, CERTIFICATE, "")


def _unseen(function: Nonlinear, low: float, high: float) -> float:
    """How far E may be above the error by changes of sign between two places that were looked at.

    In a cell f'' is beyond 0 by no more than max |f''''| h^2/8 less its distance from 0 at the
    cell's ends; what was taken for rounding may have any sign. E exceeds the error by at most twice
    the integral of what is beyond 0, times the range: nothing where f'' keeps away from 0.
    """
    edges = np.linspace(low, high, SIGNS + 1)
    bend, certain = _bends(function, edges)
    if not certain:
        return math.inf
    curvature = function.hessian(edges[:, np.newaxis])[:, :, 0, 0] * function.weights
    one, other = curvature[:-1], curvature[1:]
    faint = ROUNDING * np.abs(curvature).max(axis=0)
    distance = np.where(one * other > 0.0, np.minimum(np.abs(one), np.abs(other)), 0.0)
    width = (high - low) / SIGNS
    beyond = np.maximum(bend * width**2 / 8.0 - np.where(distance > faint, distance, 0.0), 0.0)
    beyond += np.where(np.minimum(np.abs(one), np.abs(other)) <= faint, faint, 0.0)
    return float(2.0 * (beyond.sum(axis=0) * width).max()) * (high - low)


def rounding(function: Nonlinear, low: float, high: float) -> float:
    """What last bits may be worth in an error, weighted: far from 0 values cancel."""
    nodes = np.linspace(low, high, SIGNS + 1)[:, np.newaxis]
    sizes = np.abs(function.value(nodes)) + np.abs(function.jacobian(nodes)[:, :, 0] * nodes)
    return float(BITS * np.finfo(float).eps * (sizes * function.weights).max())


def _filled(points: list[float], count: int) -> Array:
    """As many points as asked for: where fewer serve as well, the last one again."""
    return np.array(points + points[-1:] * (count - len(points)))[:, np.newaxis]
