"""Where a state transition diagram's circles, arrows and labels go, in inches.

A column per mode, a row per stage. An arrow is a cubic Bezier curve from circle to circle, and its
label stands beside it where it touches nothing else.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.chains import Supermodes
from hybridtrack.models import Array

RADIUS = 0.31  # of the circles
GAP = 0.045  # between a curve and its label
BEND = math.radians(20.0)  # of an arrow beside its opposite
LOOP_REACH, LOOP_HALF_WIDTH = 0.78, math.radians(24.0)
LOWEST_ARC, NEXT_ARC = 1.15, 0.36  # above the centres; the lowest is clear of the others' loops
STEEPEST, LEAST_STEEP = math.radians(62.0), math.radians(40.0)  # at which arcs leave

BEZIER = np.array([[1.0, 0, 0, 0], [-3, 3, 0, 0], [3, -6, 3, 0], [-1, 3, -3, 1]])
DRAWN = np.vander(np.linspace(0.0, 1.0, 121), 4, increasing=True) @ BEZIER
# A label may stand at these fractions of its arrow.
TRIED = np.array([0.5, 0.44, 0.56, 0.38, 0.62, 0.32, 0.68, 0.26, 0.74, 0.2, 0.8, 0.14, 0.86])
MIDDLE, NEAR_ORIGIN = 0.5, 0.32


class Arrow(NamedTuple):
    """One nonzero entry of the transition matrix."""

    origin: int
    destination: int
    probability: float
    curve: Array  # (4, 2), the control points

    @property
    def points(self) -> Array:
        """Along the curve, (n_points, 2)."""
        drawn: Array = DRAWN @ self.curve
        return drawn


def lay_out(supermodes: Supermodes) -> tuple[Array, list[Arrow]]:
    """Where each supermode stands, (n, 2), and the arrows between them at the first step."""
    column = np.unique(supermodes.mode, return_inverse=True)[1]
    row = np.unique(supermodes.stage, return_inverse=True)[1]
    matrix = supermodes.transition_matrix[0]
    pairs = [(int(i), int(j)) for i, j in np.argwhere(matrix) if i != j]
    diagonal = any(row[i] != row[j] and column[i] != column[j] for i, j in pairs)
    centres = np.stack([column, -row], axis=1) * _spacing(len(set(column)), diagonal)
    arcs = [(i, j) for i, j in pairs if row[i] == row[j] and abs(column[i] - column[j]) > 1]
    # Leftward arcs pass below, unless other rows are there: then above, over the rightward ones.
    below = not row.any()
    levels = {(i, j): _level(int(column[j] - column[i]), below) for i, j in arcs}
    highest = max([1, *levels.values()])
    curves = {}
    for i, j in pairs:
        if (i, j) in levels:
            above_left = column[j] > column[i] or below
            curves[i, j] = _arc(centres[i], centres[j], levels[i, j], highest, above_left)
        else:
            bent = row[i] == row[j] or matrix[j, i] != 0.0
            curves[i, j] = _curve(centres[i], centres[j], BEND if bent else 0.0)
    for i in np.flatnonzero(np.diagonal(matrix)).tolist():
        ends = [curve[[0, 3]] for pair, curve in curves.items() if i in pair]
        outer = 180.0 if column[i] == 0 else 0.0 if column[i] == column.max() else 90.0
        curves[i, i] = _loop(centres[i], _free_side(centres[i], ends, outer))
    return centres, [Arrow(i, j, float(matrix[i, j]), curve) for (i, j), curve in curves.items()]


def _spacing(n_columns: int, diagonal: bool) -> Array:
    """Between columns and between rows: lines to far columns pass clear of what is between."""
    if not diagonal or n_columns <= 2:
        return np.array([2.2, 1.35])
    return np.array([2.2 if n_columns == 3 else 2.6, max(2.3, 1.0 * (n_columns - 1))])


def _level(columns: int, below: bool) -> int:
    """How many arcs an arc over so many columns passes over."""
    return abs(columns) - 2 if below else 2 * (abs(columns) - 2) + (columns < 0)


def _direction(angle: float) -> Array:
    return np.array([math.cos(angle), math.sin(angle)])


def _curve(origin: Array, destination: Array, bend: float, handle: float | None = None) -> Array:
    """From circle to circle, leaving and arriving at an angle to the left of the straight way."""
    way = destination - origin
    angle = math.atan2(way[1], way[0])
    leaving, arriving = _direction(angle + bend), _direction(angle + math.pi - bend)
    start, end = origin + RADIUS * leaving, destination + RADIUS * arriving
    if handle is None:
        handle = 0.36 * math.hypot(*(end - start))
    return np.stack([start, start + handle * leaving, end + handle * arriving, end])


def _arc(origin: Array, destination: Array, level: int, highest: int, left: bool) -> Array:
    """Over the circles between two of a row; a cubic rises to 3/4 of its control points."""
    steep = LEAST_STEEP + (STEEPEST - LEAST_STEEP) * level / highest
    rise = LOWEST_ARC + NEXT_ARC * level - RADIUS * math.sin(steep)
    bend = steep if left else -steep
    return _curve(origin, destination, bend, rise / 0.75 / math.sin(steep))


def _loop(centre: Array, side: float) -> Array:
    """Clockwise, from a circle to itself."""
    leaving, arriving = side + LOOP_HALF_WIDTH, side - LOOP_HALF_WIDTH
    out, wide = RADIUS + LOOP_REACH, 1.35 * LOOP_HALF_WIDTH
    curve = [
        RADIUS * _direction(leaving),
        out * _direction(side + wide),
        out * _direction(side - wide),
        RADIUS * _direction(arriving),
    ]
    return centre + np.stack(curve)


def _free_side(centre: Array, ends: list[Array], outer: float) -> float:
    """The angle at which a loop is far from the ends of other arrows; `outer` if it's far there."""
    sides = np.radians([outer, 90.0, 270.0, 0.0, 180.0])
    away = np.reshape(ends, (-1, 2)) - centre
    here = away[np.hypot(away[:, 0], away[:, 1]) < 1.01 * RADIUS]
    taken = np.arctan2(here[:, 1], here[:, 0])
    apart = np.abs((sides[:, np.newaxis] - taken + np.pi) % (2 * np.pi) - np.pi)
    clear = np.minimum(apart.min(axis=1, initial=np.pi), math.radians(50.0))
    return float(sides[np.argmax(np.round(clear, 6))])


# ---- labels ----


def place_labels(arrows: list[Arrow], centres: Array, sizes: Array) -> Array:
    """The middle of each arrow's label, (n, 2); sizes (n, 2) of the labels."""
    points = np.stack([arrow.points for arrow in arrows])
    halves = sizes / 2
    tried = []
    for a, arrow in enumerate(arrows):
        spots, cost = _beside(arrow, halves[a])
        others = np.arange(len(arrows)) != a
        tried.append((spots, cost + _in_the_way(spots, halves[a], points, centres, others)))
    chosen = np.full((len(arrows), 2), np.inf)
    for _ in range(3):  # who came first may find a better place once all the others are there
        for a, (spots, cost) in enumerate(tried):
            others = np.arange(len(arrows)) != a
            apart = np.abs(spots[:, np.newaxis] - chosen[others]) - halves[a] - halves[others]
            overlapping = (apart < 0.05).all(axis=-1).sum(axis=1)
            chosen[a] = spots[np.argmin(cost + 60.0 * overlapping)]
    return chosen


def _beside(arrow: Arrow, half: Array) -> tuple[Array, Array]:
    """Places on both sides of a curve (n, 2), and how unusual they are (n,)."""
    middle = np.vander(TRIED, 4, increasing=True) @ BEZIER @ arrow.curve
    slopes = np.vander(TRIED, 3, increasing=True) * [1.0, 2.0, 3.0] @ BEZIER[1:]
    along = slopes @ arrow.curve
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    left /= np.hypot(left[:, :1], left[:, 1:])
    away = (np.abs(left) @ half + GAP)[:, np.newaxis] * left
    way, bulge = arrow.curve[3] - arrow.curve[0], arrow.curve[1] - arrow.curve[0]
    # Diagonals cross one another halfway, and near its origin there's no doubt whose a label is.
    diagonal = (np.abs(way) > 2 * RADIUS).all()
    unusual = 10.0 * np.abs(TRIED - (NEAR_ORIGIN if diagonal else MIDDLE))
    inside = math.copysign(0.7, way[0] * bulge[1] - way[1] * bulge[0])  # where a bend has less room
    cost = np.concatenate([unusual - inside, unusual + inside])
    return np.concatenate([middle + away, middle - away]), cost


def _in_the_way(
    spots: Array, half: Array, points: Array, centres: Array, others: NDArray[np.bool_]
) -> Array:
    """What circles and curves cost a label (n_spots,), a curve close by something too."""
    off = np.maximum(np.abs(spots[:, np.newaxis] - centres) - half, 0.0)
    on_circle = (np.hypot(off[..., 0], off[..., 1]) < RADIUS + 0.02).sum(axis=1)
    near = (np.abs(spots[:, np.newaxis, np.newaxis] - points) - half).max(axis=-1)
    nearest = near.min(axis=-1)
    crossed = (nearest < 0.015).sum(axis=1)
    doubtful = (nearest[:, others] < 0.08).sum(axis=1)  # whose label it is
    cost: Array = 100.0 * on_circle + 40.0 * crossed + 4.0 * doubtful
    return cost
