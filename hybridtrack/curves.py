"""From the tables of a run folder to what its figures draw: curves, paths and the true modes."""

import itertools
import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Table = Mapping[str, Any]  # columns by name: arrays, or a DataFrame's

MOST_CASES = 6
MOST_POINTS = 500  # of a curve; a page has no room for more
GAP_IN_MEDIAN_STEPS = 5.0


class Curve(NamedTuple):
    """One metric of one estimator over time, each (n_points,); time in s, NaN where unknown."""

    time: Array
    value: Array
    standard_error: Array
    pooled: int = 1  # steps to a point


Curves = Mapping[tuple[str, str], Curve]  # by estimator and metric, a point for every step


class Truth(NamedTuple):
    """Share of the runs whose true mode is each mode, (n_steps, n_modes).

    Mode k drives the step from k-1 to k, so step k lasts from edges[k-1] to edges[k], with
    `edges` (n_steps + 1,) in s. The truth is `fixed` if it is the same in all runs.
    """

    edges: Array
    modes: tuple[str, ...]
    share: Array
    fixed: bool


class Case(NamedTuple):
    """One case's curves, its true modes if known, and how its figures say it."""

    curves: Curves
    truth: Truth | None
    suffix: str
    title: str


def split_cases(steps: Table, title: str) -> list[Case]:
    """The first cases, each with an ending for its figures' names where there are several."""
    found: dict[str, dict[tuple[str, str], Curve]] = {}
    columns = ("time_s", "value", "standard_error")
    for key, series in by_step(steps, ("case", "estimator", "metric"), columns):
        name, estimator, metric = key
        time, value, error = series
        found.setdefault(name, {})[estimator, metric] = Curve(time, value, error)
    chosen: dict[str, Case] = {}
    for number, name in enumerate(itertools.islice(found, MOST_CASES), start=1):
        suffix, where = "", ""
        if len(found) > 1:
            suffix = "-" + re.sub(r"[^A-Za-z0-9_-]", "_", name)
            suffix += f"-{number}" if suffix in chosen else ""
            where = f", case {name} ({number} of {len(found)})"
        chosen[suffix] = Case(found[name], true_modes(found[name]), suffix, title + where)
    return list(chosen.values())


def by_step(
    table: Table, keys: Iterable[str], columns: Iterable[str]
) -> list[tuple[tuple[str, ...], list[Array]]]:
    """Columns of the rows that have the same texts under `keys`, in the order of their steps.

    The texts are in the order of their first rows, the first key's before the second's.
    """
    texts = []
    codes: NDArray[np.int64] = np.zeros(len(table["step"]), dtype=np.int64)
    for key in keys:
        place = {text: i for i, text in enumerate(dict.fromkeys(table[key]))}
        texts.append(list(place))
        codes = codes * len(place) + np.array([place[text] for text in table[key]], dtype=np.int64)
    order = np.lexsort((table["step"], codes))
    groups = np.split(order, np.flatnonzero(np.diff(codes[order])) + 1) if order.size else []
    shape = [len(names) for names in texts]
    values = [as_numbers(table[column]) for column in columns]
    return [
        (
            tuple(
                n[i] for n, i in zip(texts, np.unravel_index(codes[rows[0]], shape), strict=True)
            ),
            [column[rows] for column in values],
        )
        for rows in groups
    ]


def as_numbers(values: Any) -> Array:
    """As float64, NaN for what isn't finite: an infinity cannot be drawn."""
    numbers = np.asarray(values, dtype=np.float64)
    return np.where(np.isfinite(numbers), numbers, np.nan)


def chosen_curves(curves: Curves, metric: str, names: Iterable[str]) -> dict[str, Curve]:
    """The curves of one metric by estimator, in the order of `names`, where anything is known."""
    return {
        name: pooled(curve, "_rmse_" in metric)
        for name in names
        if (curve := curves.get((name, metric))) is not None and np.isfinite(curve.value).any()
    }


def pooled(curve: Curve, root: bool) -> Curve:
    """At most MOST_POINTS points: the mean, or root mean square, over groups of steps.

    The standard error is the steps' mean one, as if they erred together: rather too wide.
    """
    size = -(-len(curve.time) // MOST_POINTS)
    if size <= 1:
        return curve
    power = 2.0 if root else 1.0
    edges = [0, *gaps(curve.time), len(curve.time)]  # no point pools what lies on both sides
    starts = np.concatenate([np.arange(*ends, size) for ends in itertools.pairwise(edges)])
    places = np.searchsorted(starts, edges[1:-1])

    def means(values: Array) -> Array:
        known = ~np.isnan(values)
        total = np.add.reduceat(np.where(known, values, 0.0), starts)
        with np.errstate(invalid="ignore"):  # 0/0: nothing known is NaN
            return np.insert(total / np.add.reduceat(known.astype(float), starts), places, np.nan)

    with np.errstate(over="ignore"):
        value = means(curve.value**power) ** (1.0 / power)
    return Curve(means(curve.time), value, means(curve.standard_error), size)


def gaps(time: Array) -> Any:
    """Indices of the steps before which the time jumps."""
    if len(time) < 2:
        return np.empty(0, dtype=np.intp)
    jumps = np.diff(time)
    return np.flatnonzero(jumps > GAP_IN_MEDIAN_STEPS * np.median(jumps)) + 1


def mode_names(metrics: Iterable[str], metric: str) -> tuple[str, ...]:
    """Modes that have a metric of their own, METRIC:MODE, in the metrics' order."""
    start = f"{metric}:"
    return tuple(m.removeprefix(start) for m in dict.fromkeys(metrics) if m.startswith(start))


def true_modes(curves: Curves) -> Truth | None:
    """The truth's modes in one case, None if the table doesn't know them."""
    metrics = (metric for estimator, metric in curves if estimator == "truth")
    modes = mode_names(metrics, "mode_probability")
    found = [curves["truth", f"mode_probability:{mode}"] for mode in modes]
    if not any(np.isfinite(curve.value).any() for curve in found):
        return None
    time, share = found[0].time, np.stack([curve.value for curve in found], axis=1)
    first = 2 * time[0] - time[1] if len(time) > 1 else time[0]  # k = 0 has no row of its own
    fixed = bool(np.isin(share[np.isfinite(share)], (0.0, 1.0)).all())
    return Truth(np.concatenate([[first], time]), modes, share, fixed)


def switch_times(truth: Truth | None) -> Array:
    """Times (s) at which a fixed truth switches its mode; none for a random truth."""
    if truth is None or not truth.fixed:
        return np.empty(0)
    change = np.abs(np.diff(truth.share, axis=0)).max(axis=1)  # NaN beside an unknown mode
    switches: Array = truth.edges[1:-1][change > 0]
    return switches


def broken_at_gaps(time: Array, *columns: Array) -> list[Array]:
    """The same columns with a NaN put in wherever the time jumps: no line crosses a gap."""
    places = gaps(time)
    return [np.insert(column, places, np.nan) for column in (time, *columns)]


def isolated(values: Array) -> Any:
    """Which known values have no known neighbour, so that a line through them shows nothing."""
    known = np.pad(np.isfinite(values), 1)
    return known[1:-1] & ~known[:-2] & ~known[2:]


def read_paths(tracks: Table, case: str, run: int) -> tuple[dict[str, Array], bool]:
    """A run's (x, y) of everything that has a position, each (2, n_steps); whether it is a plane.

    Where it isn't, because nothing has a y, (time, x).
    """
    mine = (np.asarray(tracks["case"]) == case) & (np.asarray(tracks["run"]) == run)
    names = ("estimator", "quantity", "step", "time_s", "value")
    one = {name: np.asarray(tracks[name])[mine] for name in names}
    found: dict[str, dict[str, list[Array]]] = {}
    for (name, quantity), series in by_step(one, ("estimator", "quantity"), ("time_s", "value")):
        if quantity in ("x", "y"):
            found.setdefault(name, {})[quantity] = series
    plane = any("y" in axes and np.isfinite(axes["y"][1]).any() for axes in found.values())
    paths = {}
    for name, axes in found.items():
        if "x" in axes and ("y" in axes or not plane):
            time, x = axes["x"]
            path = np.array(broken_at_gaps(time, *((x, axes["y"][1]) if plane else (time, x)))[1:])
            if np.isfinite(path).all(axis=0).any():
                paths[name] = path
    return paths, plane
