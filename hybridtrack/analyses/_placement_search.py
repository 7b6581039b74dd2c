"""Where to linearise, where no greedy covering is the optimum: a global search with restarts.

In several states, or where a second derivative changes its sign, the places that a model serves
within a given error are no interval. So points are started at random several times, and each start
goes downhill; what no placement can do better than is told by `_least_errors_of_points`.
"""

from collections.abc import Sequence

import numpy as np

from hybridtrack.analyses._least_errors_of_points import least_error
from hybridtrack.analyses._linearisation import (
    Function,
    Nonlinear,
    lattice,
    on_places,
    worst_of,
)
from hybridtrack.analyses._worst_errors import Placement, peaks, worst_error
from hybridtrack.models import Array

PLACES = {1: 401, 2: 900, 3: 1000}  # a lattice that starts are judged on
FINER = {1: 801, 2: 1600, 3: 3375}  # that the best of them are improved on
RESTARTS = 24
IMPROVED = 5  # of the starts, the best
STEPS = 40  # downhill, at most
TRUST = 0.1  # of the range: how far a first step may go
NARROWED = 0.3  # it is, where a step leads nowhere
NARROWER = 0.7  # and from round to round
NEAREST = 1e-4  # of the range: a step that ends the descent
ROUNDS = 20  # of adding the worst places that were missed
NUDGE = 1e-7  # of the range: a difference that slopes are taken over
SETTLED = 1e-6  # relative: what more steps or rounds are not worth
AGREE = 0.02  # restarts within this of the best found the same


def search(
    function: Nonlinear,
    kind: str,
    low: Array,
    high: Array,
    count: int,
    seed: int,
    others: Sequence[Array] = (),
) -> Placement:
    """The best `count` points in a box low (d,), high (d,) that restarts find.

    others (each (count, d) or (count - 1, d)): points to start from besides; the placement is no
    worse than theirs.
    """
    rng = np.random.default_rng([seed, count])
    d = len(low)
    with np.errstate(all="ignore"):  # beside a pole; whoever asks refuses what isn't finite
        given = [_completed(function, kind, low, high, one, count) for one in others]
        places = lattice(low, high, PLACES[d])
        starts = [*given, *(rng.uniform(low, high, (count, d)) for _ in range(RESTARTS))]
        coarse = [descend(function, kind, places, low, high, start) for start in starts]
        coarse.sort(key=lambda one: one[0])
        better = [_improved(function, kind, low, high, one) for _, one in coarse[:IMPROVED]]
        better += [_improved(function, kind, low, high, one) for one in given]
        level, points = min(better, key=lambda one: one[0])
        ended = [(level, points), _improved(function, kind, low, high, points, thorough=True)]
        ended += [(worst_error(function, kind, low, high, one)[0], one) for one in given]
        _, points = min(ended, key=lambda one: one[0])
        level, _ = worst_error(function, kind, low, high, points)
        least = least_error(function, kind, low, high, count, level)
    agree = sum(one <= (1.0 + AGREE) * coarse[0][0] for one, _ in coarse)
    doubt = (
        f"the best of {len(starts)} starts, {agree} of which came within {100 * AGREE:.0f} % of it "
        "on a coarse lattice"
    )
    return Placement(points[np.lexsort(points.T[::-1])], level, least, "", doubt)


def _completed(
    function: Nonlinear, kind: str, low: Array, high: Array, points: Array, count: int
) -> Array:
    """Points, with the place that they serve worst where one is missing."""
    if len(points) == count:
        return points
    return np.vstack([points, worst_error(function, kind, low, high, points)[1]])


def _improved(
    function: Nonlinear,
    kind: str,
    low: Array,
    high: Array,
    points: Array,
    thorough: bool = False,
) -> tuple[float, Array]:
    """Downhill on a finer lattice, while the places it serves worst are added to those judged.

    Gives the best on the way: its worst error over the box, and its points.
    """
    places = lattice(low, high, FINER[len(low)])
    best = (np.inf, points)
    for i in range(ROUNDS):
        trust = TRUST * NARROWER**i
        seen, points = descend(function, kind, places, low, high, points, trust, thorough)
        errors, tops = peaks(function, kind, low, high, points)
        level = float(errors.max())
        if level < best[0]:
            best = (level, points)
        if level <= seen * (1.0 + SETTLED):
            break
        places = np.vstack([places, tops[errors > seen]])
    return best


def descend(
    function: Nonlinear,
    kind: str,
    places: Array,
    low: Array,
    high: Array,
    points: Array,
    trust: float = TRUST,
    thorough: bool = False,
) -> tuple[float, Array]:
    """Downhill from points (n, d): the worst error at places (m, d), and where it ends.

    Sequential linear programming in a trust region: each place keeps the model that is its best,
    and the largest error is made the smallest, errors taken as linear in the points. Where that
    leads nowhere and thorough, each place is given to what were its best if one point moved.
    """
    judge = on_places(function, kind, places)
    width = high - low
    farthest = trust
    nudges = np.eye(points.size).reshape(-1, *points.shape)
    shifts = [np.zeros_like(points), *(np.vstack([nudges, -nudges]) if thorough else ())]
    lines = _Lines(judge, points, width)
    for _ in range(STEPS):
        for shift in shifts:
            step, foreseen = lines.step(trust * shift, (points - low) / width, trust)
            if lines.level - foreseen <= SETTLED * lines.level:
                continue
            tried = np.clip(points + step * width, low, high)
            found = worst_of(judge(tried))
            if found < lines.level * (1.0 - SETTLED):
                if lines.level - found > 0.5 * (lines.level - foreseen):
                    trust = min(2.0 * trust, farthest)
                points = tried
                lines = _Lines(judge, points, width)
                break
        else:
            trust *= NARROWED
            if trust < NEAREST:
                break
    return lines.level, points


class _Lines:
    """Every model's errors at places as linear functions of its point's parts of the range."""

    def __init__(self, judge: Function, points: Array, width: Array) -> None:
        n, d = points.shape
        moved = (points[:, np.newaxis] + np.diag(NUDGE * width)).reshape(-1, d)
        found = judge(np.vstack([points, moved]))  # (m, n + n d, k)
        self.errors = found[:, :n]
        rise = found[:, n:].reshape(len(found), n, d, -1) - self.errors[:, :, np.newaxis]
        self.slopes = np.moveaxis(rise, 2, 3) / NUDGE  # (m, n, k, d)
        self.level = worst_of(self.errors)

    def step(self, shift: Array, parts: Array, trust: float) -> tuple[Array, float]:
        """The step (n, d) of the smallest largest error, and that error.

        Of the models that would be the best at each place if the points (at `parts` of the range)
        had moved by shift (n, d).
        """
        from scipy.optimize import linprog

        if not 0.0 < self.level < np.inf:
            return np.zeros_like(parts), self.level
        m, n, _ = self.errors.shape
        every = np.arange(m)
        there = self.errors + np.einsum("mnkd,nd->mnk", self.slopes, shift)
        owner = there.max(axis=-1).argmin(axis=1)
        errors = self.errors[every, owner] / self.level  # (m, k)
        slopes = self.slopes[every, owner] / self.level  # (m, k, d)
        # what can't come near the largest within the trust region binds nothing
        near = errors + trust * np.abs(slopes).sum(axis=-1) >= 1.0 - TRUST
        near &= np.isfinite(slopes).all(axis=-1)
        rows = np.zeros((*near.shape, n, parts.shape[1]))
        rows[every, :, owner] = slopes
        at = parts.ravel()
        answer = linprog(
            np.append(np.zeros(at.size), 1.0),
            A_ub=np.hstack([rows[near].reshape(-1, at.size), -np.ones((near.sum(), 1))]),
            b_ub=-errors[near],
            bounds=[
                *zip(np.maximum(-trust, -at), np.minimum(trust, 1.0 - at), strict=True),
                (None, None),
            ],
            method="highs",
        )
        if answer.x is None:
            return np.zeros_like(parts), self.level
        return answer.x[:-1].reshape(parts.shape), float(answer.x[-1]) * self.level
