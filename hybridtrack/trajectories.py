"""One run in the plane, or its position over time."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybridtrack.curves import Array, Table, read_paths
from hybridtrack.page import (
    TRUTH_COLOUR,
    Looks,
    RunInformation,
    finish,
    panels,
    plain_numbers,
    plot_line,
)

HALVES = np.array([-0.5, 0.5])


def draw_trajectory(tracks: Table, looks: Looks, information: RunInformation) -> Figure | None:
    """One run in the plane (east, north), or its position over time if it has one dimension.

    Of states with units of their own there is a plane alone, of an x and a y in the same unit.
    """
    if not len(tracks["case"]):
        return None
    case, run = (np.asarray(tracks[column])[0] for column in ("case", "run"))
    paths, plane = read_paths(tracks, case, run)
    own = information.units
    if not paths or (own is not None and not (plane and own.get("x") == own.get("y"))):
        return None
    errors = not plane and "truth" in paths
    rows, height, heights = (2, 4.2, (1, 1)) if errors else (1, 3.2, (1,))
    figure, (ax, *below) = panels(rows, 1, height, sharey=False, heights=heights)
    _plot_paths(ax, paths, looks, crosses_above=plane)
    leaving = _frame_trajectory(figure, ax, paths, plane)
    if own is not None:
        ax.set(xlabel=information.label("x"), ylabel=information.label("y"))
        ax.xaxis.set_major_formatter(plain_numbers())
        ax.yaxis.set_major_formatter(plain_numbers())
    if errors:
        leaving += [n for n in _plot_errors(below[0], paths, looks) if n not in leaving]
        ax.set_xlabel("")
    where = f"case {case}, " if len(set(tracks["case"])) > 1 else ""
    finish(figure, information.title, f"Trajectory, {where}run {run}", leaving)
    return figure


def _plot_paths(ax: Axes, paths: Mapping[str, Array], looks: Looks, *, crosses_above: bool) -> None:
    if "measurement" in paths:
        label, colour, _ = looks["raw"]
        # Crosses wider than the truth, which would hide dots; too many would hide the lines.
        above = 3 if crosses_above and paths["measurement"].shape[1] <= 500 else 1
        cross: dict[str, Any] = {"markersize": 4, "markeredgewidth": 0.5, "zorder": above}
        ax.plot(*paths["measurement"], "+", color=colour, label=label, **cross)
    if "truth" in paths:
        truth = paths["truth"]
        first = truth[:, np.isfinite(truth).all(axis=0)][:, 0]
        ax.plot(*truth, color=TRUTH_COLOUR, linewidth=2.2, label="truth")
        ring: dict[str, Any] = {"color": TRUTH_COLOUR, "markerfacecolor": "white", "zorder": 5}
        ax.plot(*first, "o", label="first scan", **ring)
    if "noise_free" in paths:
        style: dict[str, Any] = {"color": "0.6", "linewidth": 3.0, "zorder": 0.8}
        ax.plot(*paths["noise_free"], label="truth without noise", **style)
    for name, look in looks.items():
        if name in paths:
            plot_line(ax, paths[name][0], paths[name][1], look)


def _plot_errors(ax: Axes, paths: Mapping[str, Array], looks: Looks) -> list[str]:
    """How far off positions are, where the flight is too long to see it; returns who leaves."""
    time, truth = paths["truth"]
    off = {name: path[1] - truth for name, path in paths.items() if name != "truth"}
    if "measurement" in off:
        style: dict[str, Any] = {"markersize": 4, "markeredgewidth": 0.5}
        ax.plot(time, off["measurement"], "+", color=looks["raw"].colour, **style)
    for name, look in looks.items():
        if name in off:
            plot_line(ax, time, off[name], look)
    sizes = {name: float(np.nanquantile(np.abs(e), 0.95)) for name, e in off.items()}
    limit = 1.6 * sizes.get("measurement", min(sizes.values(), default=1.0))
    ax.axhline(0.0, color=TRUTH_COLOUR, linewidth=0.7, zorder=0.5)
    ax.set(xlabel="time (s)", ylabel="position error (m)")
    if limit > 0:
        ax.set_ylim(-limit, limit)
    ax.yaxis.set_major_formatter(plain_numbers())
    return [name for name, size in sizes.items() if size > limit > 0]


def _frame_trajectory(
    figure: Figure, ax: Axes, paths: Mapping[str, Array], plane: bool
) -> list[str]:
    """Fit axes and unit to the flight and the estimates; returns the estimates that leave.

    An estimate may widen the frame by half a span of the flight on each side and no more, so that
    a filter that runs away doesn't shrink the flight to a dot.
    """
    flight = [paths[name] for name in ("truth", "noise_free", "measurement") if name in paths]
    flown, everything = _extent(flight or paths.values()), _extent(paths.values())
    span = np.ptp(flown, axis=1)
    margin = 0.5 * (np.full(2, span.max()) if plane else span)
    margin[margin == 0] = np.inf
    low = np.maximum(everything[:, 0], flown[:, 0] - margin)
    high = np.minimum(everything[:, 1], flown[:, 1] + margin)
    size = 1.08 * np.where(high > low, high - low, 1.0)
    unit, metres = ("km", 1e3) if size[0 if plane else 1 :].max() > 10e3 else ("m", 1.0)
    formatter = plain_numbers(metres)
    ax.yaxis.set_major_formatter(formatter)
    ax.set_ylabel(f"y, north ({unit})" if plane else f"position x ({unit})")
    ax.set_xlabel(f"x, east ({unit})" if plane else "time (s)")
    if plane:
        # Even a straight flight gets a readable shape.
        size = np.maximum(size, [1.3 * size[1], 0.3 * size[0]])
        figure.set_figheight(0.5 + 6.3 * size[1] / size[0])
        ax.xaxis.set_major_formatter(formatter)
        ax.set_aspect("equal")
    middle = (low + high) / 2
    ax.set(xlim=middle[0] + size[0] * HALVES, ylim=middle[1] + size[1] * HALVES)
    return [
        name
        for name, path in paths.items()
        if (np.abs(path - middle[:, None]) > size[:, None] / 2).any()
    ]


def _extent(paths: Iterable[Array]) -> Array:
    """(2, 2): the least and the largest of both rows."""
    joined = np.concatenate(list(paths), axis=1)
    return np.stack([np.nanmin(joined, axis=1), np.nanmax(joined, axis=1)], axis=1)
