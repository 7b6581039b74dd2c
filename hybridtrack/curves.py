"""From the tables of a run folder to what its figures draw: curves, paths and the true modes."""

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_CASES = 6
MOST_POINTS = 500  # of a curve; a page has no room for more
GAP_IN_MEDIAN_STEPS = 5.0


class Curve(NamedTuple):
    """One metric of one estimator over time, each (n_points,); time in s, NaN where unknown."""

    time: Array
    value: Array
    standard_error: Array
    pooled: int = 1  # steps to a point


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
    """One case's rows of the steps' table, its true modes if known, and how its figures say it."""

    steps: pd.DataFrame
    truth: Truth | None
    suffix: str
    title: str


def split_cases(steps: pd.DataFrame, title: str) -> list[Case]:
    """The first cases, each with an ending for its figures' names where there are several."""
    names = list(dict.fromkeys(steps["case"]))
    chosen: dict[str, Case] = {}
    for number, name in enumerate(names[:MOST_CASES], start=1):
        table = steps[steps["case"] == name]
        suffix, where = "", ""
        if len(names) > 1:
            suffix = "-" + re.sub(r"[^A-Za-z0-9_-]", "_", name)
            suffix += f"-{number}" if suffix in chosen else ""
            where = f", case {name} ({number} of {len(names)})"
        chosen[suffix] = Case(table, true_modes(table), suffix, title + where)
    return list(chosen.values())


def as_numbers(values: Any) -> Array:
    """As float64, NaN for what isn't finite: an infinity cannot be drawn."""
    numbers = np.asarray(values, dtype=np.float64)
    return np.where(np.isfinite(numbers), numbers, np.nan)


def read_curves(table: pd.DataFrame, metric: str, names: Iterable[str]) -> dict[str, Curve]:
    """The curves of one case and metric by estimator, in the order of `names`."""
    chosen = table[table["metric"] == metric].sort_values("step", kind="stable")
    curves = {}
    for name in names:
        rows = chosen[chosen["estimator"] == name]
        time, value, error = (as_numbers(rows[c]) for c in ("time_s", "value", "standard_error"))
        curve = Curve(time, value, error)
        if np.isfinite(curve.value).any():
            curves[name] = pooled(curve, "_rmse_" in metric)
    return curves


def pooled(curve: Curve, root: bool) -> Curve:
    """At most MOST_POINTS points: the mean, or root mean square, over groups of steps.

    The standard error is the steps' mean one, as if they erred together: rather too wide.
    """
    size = -(-len(curve.time) // MOST_POINTS)
    if size <= 1:
        return curve
    power = 2.0 if root else 1.0
    segments = np.split(np.arange(len(curve.time)), gaps(curve.time))
    table = pd.DataFrame(
        {"time": curve.time, "value": curve.value**power, "error": curve.standard_error}
    )
    parts = []
    for segment in segments:  # no point pools what lies on both sides of a gap
        part = table.iloc[segment].groupby(np.arange(len(segment)) // size).mean()
        parts += [part, pd.DataFrame({name: [np.nan] for name in table})]
    points = pd.concat(parts[:-1])
    time, value, error = (points[name].to_numpy(np.float64) for name in table)
    return Curve(time, value ** (1.0 / power), error, size)


def gaps(time: Array) -> Any:
    """Indices of the steps before which the time jumps."""
    if len(time) < 2:
        return np.empty(0, dtype=np.intp)
    jumps = np.diff(time)
    return np.flatnonzero(jumps > GAP_IN_MEDIAN_STEPS * np.median(jumps)) + 1


def mode_names(table: pd.DataFrame, metric: str) -> tuple[str, ...]:
    """Modes that have a metric of their own, METRIC:MODE, in the table's order."""
    metrics = dict.fromkeys(table["metric"])
    return tuple(m.removeprefix(f"{metric}:") for m in metrics if m.startswith(f"{metric}:"))


def true_modes(table: pd.DataFrame) -> Truth | None:
    """The truth's modes in one case, None if the table doesn't know them."""
    rows = table[table["estimator"] == "truth"]
    modes = mode_names(rows, "mode_probability")
    wide = rows.pivot(index=["step", "time_s"], columns="metric", values="value").sort_index()
    share = as_numbers(wide[[f"mode_probability:{mode}" for mode in modes]])
    if not np.isfinite(share).any():
        return None
    time = as_numbers(wide.index.get_level_values("time_s"))
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


def read_paths(one: pd.DataFrame, plane: bool) -> dict[str, Array]:
    """(x, y), or (time, x) without a plane, (2, n_steps), of everything that has a position."""
    paths = {}
    for name in dict.fromkeys(one["estimator"]):
        rows = one[(one["estimator"] == name) & one["quantity"].isin(["x", "y"])]
        wide = rows.pivot(index=["step", "time_s"], columns="quantity", values="value").sort_index()
        wide = wide.reindex(columns=["x", "y"])
        time = as_numbers(wide.index.get_level_values("time_s"))
        x, y = as_numbers(wide["x"]), as_numbers(wide["y"])
        path = np.array(broken_at_gaps(time, *((x, y) if plane else (time, x)))[1:])
        if np.isfinite(path).all(axis=0).any():
            paths[name] = path
    return paths
