"""Where to linearise, in several varied states: a global search with restarts, and no certificate.

Eq. 33 of Otanez 2004 has many local minima, and covering a box by the models' regions has no greedy
optimum as an interval has. So differential evolution is started several times; the best of its
answers is polished, and its worst error is looked up on places that the search never saw. What is
known of it then: the error is a bank's that can be built; that no other is better is not.
"""

import math

import numpy as np

from hybridtrack.analyses._linearisation import Nonlinear, lattice, of_bank, on_places, worst_of
from hybridtrack.analyses._placement import Placement
from hybridtrack.models import Array

PLACES = 600  # a lattice that candidates are judged on
FINER = 2500  # that answers are improved on
POWERS = (4.0, 16.0, 64.0, 256.0)
FARTHEST = 10.0  # times the best so far: what is worse counts as this, or powers overflow
NUDGE = 1e-7  # of the box: a difference that slopes are taken over
CHECKED = 40_000  # a finer one, for the worst error that is told
ROUNDS = 8  # of adding the worst place that was missed
SETTLED = 1e-3  # relative: what more rounds are not worth
RESTARTS = 5
GENERATIONS = 200
AGREE = 0.02  # restarts within this of the best found the same


def place_several(
    function: Nonlinear,
    kind: str,
    low: Array,
    high: Array,
    count: int,
    seed: int,
    restarts: int | None = None,
) -> Placement:
    """The best `count` points in a box low (d,), high (d,) that the restarts find."""
    restarts = RESTARTS if restarts is None else restarts
    places = lattice(low, high, PLACES)
    rng = np.random.default_rng([seed, count])
    found = []
    with np.errstate(all="ignore"):  # beside a pole; whoever asks refuses what isn't finite
        for _ in range(restarts):
            points = _evolve(function, kind, places, (low, high), count, rng)
            found.append(_polish(function, kind, places, (low, high), points))
    worst, points = min(found, key=lambda one: one[0])
    points = points[np.lexsort(points.T[::-1])]
    agree = sum(level <= (1.0 + AGREE) * worst for level, _ in found)
    doubt = (
        f"the best of {restarts} restarts of a global search, {agree} of which agree within "
        f"{100 * AGREE:.0f} %: in several dimensions nothing certifies it"
    )
    return Placement(points, worst, math.nan, "", doubt)


def _evolve(
    function: Nonlinear,
    kind: str,
    places: Array,
    box: tuple[Array, Array],
    count: int,
    rng: np.random.Generator,
) -> Array:
    """The answer (n, d) of one differential evolution."""
    from scipy.optimize import differential_evolution

    d = len(box[0])
    judge = on_places(function, kind, places)
    answer = differential_evolution(
        lambda c: worst_of(judge(c.reshape(count, d))),
        list(zip(np.tile(box[0], count), np.tile(box[1], count), strict=True)),
        maxiter=GENERATIONS,
        popsize=max(40 // (count * d), 5),
        tol=1e-6,
        rng=rng,
        polish=False,
        init="sobol",
    )
    return np.asarray(answer.x).reshape(count, d)


def _polish(
    function: Nonlinear, kind: str, places: Array, box: tuple[Array, Array], points: Array
) -> tuple[float, Array]:
    """Downhill from an answer, while the place it serves worst is added to those that are judged.

    Gives the best on the way: its worst error over the box, and its points.
    """
    from scipy.optimize import minimize

    bounds = list(zip(np.tile(box[0], len(points)), np.tile(box[1], len(points)), strict=True))
    points = _smoothed(function, kind, lattice(*box, FINER), box, points)
    level, place = worst_of_several(function, kind, *box, points)
    best = (level, points)
    for _ in range(ROUNDS):
        places = np.vstack([places, place])
        judge = on_places(function, kind, places)
        answer = minimize(
            lambda c, judge=judge, shape=points.shape: worst_of(judge(c.reshape(shape))),
            points.ravel(),
            method="Nelder-Mead",
            bounds=bounds,
            options={"xatol": 1e-5, "fatol": 1e-5 * level, "maxfev": 150 * points.size},
        )
        points = np.asarray(answer.x).reshape(points.shape)
        level, place = worst_of_several(function, kind, *box, points)
        if level < best[0]:
            best = (level, points)
        if answer.fun >= best[0] * (1.0 - SETTLED):
            break
    return best


def _smoothed(
    function: Nonlinear, kind: str, places: Array, box: tuple[Array, Array], points: Array
) -> Array:
    """Downhill on power means of the errors, of ever higher powers, which tend to the largest.

    The largest itself has a kink at every good answer, where steps along one coordinate at a time
    all go up; the means have slopes. Each power begins where the one before it ended.
    """
    from scipy.optimize import minimize

    n, d = points.shape
    nudge = NUDGE * (box[1] - box[0])
    judge = on_places(function, kind, places)
    every = np.arange(len(places))

    def mean(c: Array, power: float, scale: float) -> tuple[float, Array]:
        at = c.reshape(n, d)
        moved = (at[:, np.newaxis] + np.diag(nudge)).reshape(-1, d)
        ratio = np.minimum(judge(np.vstack([at, moved])) / scale, FARTHEST)
        found = (ratio**power).sum(axis=-1)
        owner = found[:, :n].argmin(axis=1)
        own = found[every, owner]
        total = float(own.mean()) + 1e-300
        rise = found[:, n:].reshape(-1, n, d)[every, owner] - own[:, np.newaxis]
        slopes = np.zeros((n, d))
        np.add.at(slopes, owner, rise / nudge)
        level = total ** (1.0 / power)
        return level, level / (power * total * len(places)) * slopes.ravel()

    best = (worst_of(judge(points)), points)
    for power in POWERS:
        answer = minimize(
            mean,
            points.ravel(),
            args=(power, best[0]),
            jac=True,
            method="L-BFGS-B",
            bounds=list(zip(np.tile(box[0], n), np.tile(box[1], n), strict=True)),
        )
        points = np.asarray(answer.x).reshape(n, d)
        level = worst_of(judge(points))
        if level < best[0]:
            best = (level, points)
    return best[1]


def worst_of_several(
    function: Nonlinear, kind: str, low: Array, high: Array, points: Array
) -> tuple[float, Array]:
    """The largest error over a box, and its place (d,): a fine lattice, then uphill."""
    from scipy.optimize import minimize

    x = lattice(low, high, CHECKED)
    found = of_bank(function, kind, x, points)
    peak = int(found.argmax())
    options = {"xatol": 1e-9, "fatol": 1e-14, "initial_simplex": _simplex(x[peak], low, high)}
    with np.errstate(all="ignore"):  # uphill to a pole
        answer = minimize(
            lambda place: -float(of_bank(function, kind, place[np.newaxis], points)[0]),
            x[peak],
            method="Nelder-Mead",
            bounds=list(zip(low, high, strict=True)),
            options=options,
        )
    if -answer.fun > found[peak]:
        return -float(answer.fun), np.asarray(answer.x)
    return float(found[peak]), x[peak]


def _simplex(place: Array, low: Array, high: Array) -> Array:
    """A cell of the lattice about a place, inside the box."""
    step = (high - low) / max(round(CHECKED ** (1.0 / len(low))) - 1, 1)
    step = np.where(place + step > high, -step, step)
    return np.vstack([place, place + np.diag(step)])
