"""Where in a range a bank of linear models is the most wrong, and by how much."""

from typing import Any, NamedTuple

import numpy as np

from hybridtrack.analyses._linearisation import Nonlinear, lattice, of_bank, on_places
from hybridtrack.models import Array

CHECKED = {1: 20_001, 2: 40_000, 3: 46_656}  # places of a range of so many states
PEAKS = 30  # that are looked into between the places of the lattice
CLIMBED = 6  # of them, in several states
SIDE = {1: 9, 2: 7, 3: 5}  # places along each axis about a peak
FINEST = 1e-9  # of the range: places nearer to each other are one
NUDGE = 1e-7  # of the range: a difference that slopes are taken over
SETTLED = 1e-7  # relative: what more steps are not worth


class Placement(NamedTuple):
    """Points, the worst error of the bank that is linearised there, and what is known of it."""

    points: Array  # (n, d), ascending where d = 1
    worst_error: float  # over the range, weighted
    no_less_than: float  # no placement of as many has a smaller one; NaN where that isn't known
    certificate: str  # what makes it the optimum; empty where nothing does
    doubt: str = ""  # why it may not be the optimum


def checked(low: Array, high: Array) -> Array:
    """The places (m, d) of a box low (d,), high (d,) that an error is looked up at first."""
    return lattice(low, high, CHECKED[len(low)])


def worst_error(
    function: Nonlinear, kind: str, low: Array, high: Array, points: Array
) -> tuple[float, Array]:
    """The largest error of the models at points (n, d) over a box, and its place (d,)."""
    errors, places = peaks(function, kind, low, high, points)
    order = np.argsort(-errors, kind="stable")
    found = [(float(errors[i]), places[i]) for i in order[:1]]
    if len(low) > 1:
        found += [_climbed(function, kind, low, high, points, places[i]) for i in order[:CLIMBED]]
    return max(found, key=lambda one: one[0])


def _climbed(
    function: Nonlinear, kind: str, low: Array, high: Array, points: Array, place: Array
) -> tuple[float, Array]:
    """Uphill from a place, along the edge where models are equally wrong.

    A lattice climbs such an edge badly. Linear programmes in a trust region: the smallest of the
    models' errors is made the largest, each taken as linear in the place.
    """
    from scipy.optimize import linprog

    width, d = high - low, len(low)
    level = float(of_bank(function, kind, place[np.newaxis], points)[0])
    trust = 2.0 / CHECKED[d] ** (1.0 / d)
    while trust > FINEST and np.isfinite(level) and level > 0.0:
        nudged = np.vstack([place, place + np.diag(NUDGE * width)])
        found = on_places(function, kind, nudged)(points)  # (1 + d, n, k)
        worst = found[0].argmax(axis=-1)
        found = found[:, np.arange(len(points)), worst]
        slopes = (found[1:] - found[0]).T / NUDGE  # (n, d)
        part = (place - low) / width
        answer = linprog(
            np.append(np.zeros(d), -1.0),
            A_ub=np.hstack([-slopes, np.full((len(points), 1), level)]),
            b_ub=found[0],
            bounds=[
                *zip(np.maximum(-trust, -part), np.minimum(trust, 1.0 - part), strict=True),
                (None, None),
            ],
            method="highs",
        )
        if answer.x is None or answer.x[-1] <= 1.0 + SETTLED:
            break
        tried = np.clip(place + answer.x[:d] * width, low, high)
        reached = float(of_bank(function, kind, tried[np.newaxis], points)[0])
        if reached > level:
            place, level = tried, reached
        else:
            trust *= 0.3
    return level, place


def peaks(
    function: Nonlinear, kind: str, low: Array, high: Array, points: Array
) -> tuple[Array, Array]:
    """The largest errors (p,) of the models at points (n, d), and their places (p, d).

    A fine lattice, then ever smaller ones about its highest peaks: the worst place is mostly where
    the regions of several models meet, and an error has no slope there to climb by.
    """
    x = checked(low, high)
    d = len(low)
    found = np.nan_to_num(of_bank(function, kind, x, points), nan=np.inf, posinf=np.inf)
    step = (high - low) / (round(len(x) ** (1.0 / d)) - 1)
    tops = x[_tops(found, d)]
    offsets = lattice(-np.ones(d), np.ones(d), SIDE[d] ** d)
    while (step > FINEST * (high - low)).any():
        near = np.clip(tops[:, np.newaxis] + offsets * step, low, high)
        errors = of_bank(function, kind, near.reshape(-1, d), points).reshape(len(tops), -1)
        tops = near[np.arange(len(tops)), errors.argmax(axis=1)]
        step = step * 2.0 / (SIDE[d] - 1)
    return of_bank(function, kind, tops, points), tops


def _tops(found: Array, d: int) -> Any:
    """The places of a lattice, by number, whose errors (m,) no neighbour exceeds: largest first."""
    from scipy.ndimage import maximum_filter

    grid = found.reshape((round(len(found) ** (1.0 / d)),) * d)
    tops = np.flatnonzero((grid == maximum_filter(grid, size=3, mode="nearest")).ravel())
    return tops[np.argsort(-found[tops], kind="stable")][:PEAKS]
