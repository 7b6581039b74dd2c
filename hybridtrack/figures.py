"""Tables in, matplotlib Figures out: trajectory, errors and mode probabilities over time.

Only matplotlib's object API on the Agg canvas is used and every setting lives in a context, so
drawing needs no display, changes no global state, and gives the same bytes for the same tables.
"""

import math
import os
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from PIL import Image

from hybridtrack.curves import (
    Array,
    Case,
    Curve,
    Table,
    Truth,
    broken_at_gaps,
    chosen_curves,
    isolated,
    mode_names,
    read_paths,
    split_cases,
    switch_times,
)
from hybridtrack.errors import UserError

Dashes = str | tuple[float, tuple[float, ...]]

DPI = 200
COMPRESSION = 3  # of 9: more takes half as long again and saves a tenth
WIDTH_IN = 7.0  # two columns of a journal page
HALVES = np.array([-0.5, 0.5])
LOG_SCALE_RATIO = 15.0
LEAVES_THE_FRAME = 1e5  # a curve this many times the best one's median has nothing left to tell
HOPELESS = 100.0  # a curve whose own median is so many times the best's is named, not drawn
NEARLY_AS_GOOD = 1.3  # ratios whose median is within this of the best's make the frame

# Okabe & Ito (2008) without black (the truth) and yellow (faint on white); the last two, wine and
# olive, are from Tol's muted scheme (2021). The dashes tell the curves apart in grey.
COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#882255", "#999933"]
DASHES: tuple[Dashes, ...] = (
    "-",
    (0, (5, 1.5)),
    (0, (5, 1.5, 1, 1.5)),
    (0, (1.2, 1.2)),
    (0, (9, 2)),
    (0, (5, 1.5, 1, 1.5, 1, 1.5)),
    (0, (2.5, 1)),
    (0, (9, 2, 2.5, 2)),
)
RAW_COLOUR, TRUTH_COLOUR, TRUE_MODE_COLOUR, SWITCH_COLOUR = "0.55", "black", "0.88", "0.6"

STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "figure.titlesize": 9.5,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "agg.path.chunksize": 10_000,  # Agg gives up on a dashed line of a million points in one piece
}


class RunInformation(NamedTuple):
    """What a figure says besides its curves; estimators and modes in the scenario's order."""

    title: str
    runs: int
    estimators: tuple[str, ...]
    modes: tuple[str, ...]
    error: str = "rmse"  # or mse: what errors over time are
    compare_with: str | None = None  # the estimator that ratios are to


class Look(NamedTuple):
    """How one estimator is drawn, in every figure."""

    label: str
    colour: str
    dashes: Dashes


Looks = Mapping[str, Look]


def draw(
    steps: Table, tracks: Table, reliability: Table, information: RunInformation
) -> dict[str, Figure]:
    """Draw what the tables of a run folder hold; a figure whose data are absent is left out.

    Args:
        steps: long, columns case, estimator, step, time_s, metric, value, standard_error.
        tracks: long, columns case, run, estimator, step, time_s, quantity, value (SI units).
        reliability: columns estimator, from_probability, to_probability, share_of_steps,
            mean_probability, frequency, standard_error.
        information: title, number of runs, the order of estimators and modes, what is compared.

    Returns:
        Figures by name: trajectory (of the first run in `tracks`), position_error,
        velocity_error, error_ratio, mode_probability, mode_likelihood, final_mode_probability and
        reliability. With several cases the figures over time are drawn for each of the first six,
        and their names end in `-CASE`.
    """
    with style():
        looks = _looks(steps, tracks, information)
        figures = {"trajectory": _draw_trajectory(tracks, looks, information)}
        for case in split_cases(steps, information.title):
            for quantity in ("position", "velocity"):
                figure = _draw_error(case, quantity, looks, information)
                figures[f"{quantity}_error{case.suffix}"] = figure
            figures["error_ratio" + case.suffix] = _draw_ratios(case, looks, information)
            for metric in ("mode_probability", "mode_likelihood"):
                figures[metric + case.suffix] = _draw_modes(case, metric, looks, information)
            name = "final_mode_probability"
            figures[name + case.suffix] = _draw_final_mode(case, looks, information)
        figures["reliability"] = _draw_reliability(reliability, looks, information)
    return {name: figure for name, figure in figures.items() if figure is not None}


def save(figures: Mapping[str, Figure], folder: Path) -> list[Path]:
    """Write each figure to `folder`/NAME.png, whole or not at all; the folder is made if missing.

    The same tables give the same bytes: the PNG carries neither date nor software. Raises
    UserError where the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return [_save_one(figure, folder / f"{name}.png") for name, figure in figures.items()]
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise UserError(
            f"{folder}: figures cannot be written here ({reason}); make room or name another folder"
        ) from None


def _save_one(figure: Figure, path: Path) -> Path:
    """What savefig does, but laid out once, drawn once, and without the alpha of a white page."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    try:
        with style():
            canvas.draw()  # type: ignore[no-untyped-call]
        pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
        image = Image.fromarray(pixels).convert("RGB")
        image.save(partial, format="png", dpi=(DPI, DPI), compress_level=COMPRESSION)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return path


@contextmanager
def style() -> Iterator[None]:
    """Matplotlib's defaults with our sizes, whatever the user's matplotlibrc says."""
    with matplotlib.style.context(["default", STYLE]):
        yield


def _looks(steps: Table, tracks: Table, information: RunInformation) -> dict[str, Look]:
    """Colour and dashes by the scenario's order of estimators; the raw measurements come first."""
    names = dict.fromkeys([*information.estimators, *steps["estimator"], *tracks["estimator"]])
    estimators = [name for name in names if name not in ("raw", "truth", "measurement")]
    n = len(COLOURS)
    return {"raw": Look("measurements", RAW_COLOUR, (0, (1, 1)))} | {
        name: Look(_plain(name, 60), COLOURS[i % n], DASHES[(i + i // n) % n])
        for i, name in enumerate(estimators)
    }


# ---- the trajectory ----


def _draw_trajectory(tracks: Table, looks: Looks, information: RunInformation) -> Figure | None:
    """One run in the plane (east, north), or its position over time if it has one dimension."""
    if not len(tracks["case"]):
        return None
    case, run = (np.asarray(tracks[column])[0] for column in ("case", "run"))
    paths, plane = read_paths(tracks, case, run)
    if not paths:
        return None
    figure, (ax,) = _panels(1, 1, 3.2)
    _plot_paths(ax, paths, looks)
    leaving = _frame_trajectory(figure, ax, paths, plane)
    where = f"case {case}, " if len(set(tracks["case"])) > 1 else ""
    _finish(figure, information.title, f"Trajectory, {where}run {run}", leaving)
    return figure


def _plot_paths(ax: Axes, paths: Mapping[str, Array], looks: Looks) -> None:
    if "measurement" in paths:
        label, colour, _ = looks["raw"]
        # Crosses wider than the truth, which would hide dots; too many would hide the lines.
        above = 3 if paths["measurement"].shape[1] <= 500 else 1
        cross: dict[str, Any] = {"markersize": 4, "markeredgewidth": 0.5, "zorder": above}
        ax.plot(*paths["measurement"], "+", color=colour, label=label, **cross)
    if "truth" in paths:
        truth = paths["truth"]
        first = truth[:, np.isfinite(truth).all(axis=0)][:, 0]
        ax.plot(*truth, color=TRUTH_COLOUR, linewidth=2.2, label="truth")
        ring: dict[str, Any] = {"color": TRUTH_COLOUR, "markerfacecolor": "white", "zorder": 5}
        ax.plot(*first, "o", label="first scan", **ring)
    for name, look in looks.items():
        if name in paths:
            _plot_line(ax, paths[name][0], paths[name][1], look)


def _frame_trajectory(
    figure: Figure, ax: Axes, paths: Mapping[str, Array], plane: bool
) -> list[str]:
    """Fit axes and unit to the flight and the estimates; returns the estimates that leave.

    An estimate may widen the frame by half a span of the flight on each side and no more, so that
    a filter that runs away doesn't shrink the flight to a dot.
    """
    flight = [paths[name] for name in ("truth", "measurement") if name in paths]
    flown, everything = _extent(flight or paths.values()), _extent(paths.values())
    span = np.ptp(flown, axis=1)
    margin = 0.5 * (np.full(2, span.max()) if plane else span)
    margin[margin == 0] = np.inf
    low = np.maximum(everything[:, 0], flown[:, 0] - margin)
    high = np.minimum(everything[:, 1], flown[:, 1] + margin)
    size = 1.08 * np.where(high > low, high - low, 1.0)
    unit, metres = ("km", 1e3) if size[0 if plane else 1 :].max() > 10e3 else ("m", 1.0)
    formatter = _plain_numbers(metres)
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


# ---- figures over time ----


# By what errors are and of what: metric, and unit of the axis.
ERRORS = {
    ("rmse", "position"): ("position_rmse_m", "m"),
    ("rmse", "velocity"): ("velocity_rmse_m_s", "m/s"),
    ("mse", "position"): ("position_mse_m2", "m²"),
    ("mse", "velocity"): ("velocity_mse_m2_s2", "m²/s²"),
}
ERROR_NAMES = {"rmse": "RMS", "mse": "mean square"}


def _draw_error(
    case: Case, quantity: str, looks: Looks, information: RunInformation
) -> Figure | None:
    metric, unit = ERRORS[information.error, quantity]
    curves, beyond = _worth_drawing(chosen_curves(case.curves, metric, looks))
    if not curves:
        return None
    figure, (ax,) = _panels(1, 1, 3.0)
    for name, curve in curves.items():
        _plot_curve(ax, curve, looks[name])
    _mark_switches(ax, switch_times(case.truth))
    leaving = beyond + _scale_error(ax, {name: curve.value for name, curve in curves.items()})
    _frame_time([ax], curves.values(), case.truth)
    name = ERROR_NAMES[information.error]
    ax.set_ylabel(f"{quantity} {name} error ({unit})")
    caption = f"{name[0].upper() + name[1:]} {_over(curves.values(), information.runs)}"
    _finish(figure, case.title, caption, leaving)
    return figure


def _worth_drawing(curves: Mapping[str, Curve]) -> tuple[dict[str, Curve], list[str]]:
    """The curves that are not hopeless beside the best one, and the names of those that are."""
    middle = {name: float(np.nanmedian(curve.value)) for name, curve in curves.items()}
    limit = HOPELESS * min(middle.values(), default=math.nan)
    beyond = [name for name in curves if middle[name] > limit > 0.0]
    return {name: curve for name, curve in curves.items() if name not in beyond}, beyond


def _draw_ratios(case: Case, looks: Looks, information: RunInformation) -> Figure | None:
    """Errors over those of one estimator: what tells estimators apart that are nearly as good."""
    drawn = {
        quantity: curves
        for quantity in ("position", "velocity")
        if (curves := chosen_curves(case.curves, f"{quantity}_{information.error}_ratio", looks))
    }
    if not drawn or information.compare_with is None:
        return None
    figure, axes = _panels(len(drawn), 1, 0.4 + 2.1 * len(drawn), sharey=False)
    leaving: dict[str, None] = {}
    for ax, quantity in zip(axes, drawn, strict=True):
        curves, beyond = _worth_drawing(drawn[quantity])
        drawn[quantity] = curves
        ax.axhline(1.0, color=TRUTH_COLOUR, linewidth=0.7, zorder=0.5)
        for name, curve in curves.items():
            _plot_curve(ax, curve, looks[name])
        _mark_switches(ax, switch_times(case.truth))
        leaving |= dict.fromkeys(beyond + _scale_ratio(ax, curves))
        ax.set_ylabel(f"{quantity} error ratio")
    every = [curve for curves in drawn.values() for curve in curves.values()]
    _frame_time(axes[-1:], every, case.truth)
    name = ERROR_NAMES[information.error]
    caption = f"Ratio of {name} errors to {information.compare_with}'s, over the same "
    caption += _over(every, information.runs).removeprefix("over ")
    _finish(figure, case.title, caption, leaving)
    return figure


def _draw_final_mode(case: Case, looks: Looks, information: RunInformation) -> Figure | None:
    """How likely the mode now is the last one: by the scans, and by the time alone."""
    curves = chosen_curves(case.curves, "final_mode_probability", looks)
    if not curves:
        return None
    figure, (ax,) = _panels(1, 1, 2.6)
    for name, curve in curves.items():
        _plot_curve(ax, curve, looks[name])
        prior = case.curves.get((name, "final_mode_prior"))
        if prior is not None:
            label = f"{looks[name].label}, before any scan"
            _plot_line(ax, prior.time, prior.value, Look(label, looks[name].colour, (0, (1, 2))))
    truth = case.curves.get(("truth", "final_mode_probability"))
    if truth is not None:
        look = Look("truth: share of runs", TRUTH_COLOUR, (0, (4, 3)))
        _plot_line(ax, truth.time, truth.value, look)
    _frame_time([ax], curves.values(), case.truth)
    ax.set(ylim=(-0.02, 1.02), ylabel="probability")
    over = _over(curves.values(), information.runs)
    _finish(figure, case.title, f"Mean probability that the mode now is the last one, {over}", [])
    return figure


def _draw_reliability(table: Table, looks: Looks, information: RunInformation) -> Figure | None:
    """Frequencies over the probabilities that foretold them; below, how often each was given."""
    names = [name for name in looks if name in set(table["estimator"])]
    if not names:
        return None
    figure, (ax, below) = _panels(2, 1, 3.6, sharey=False, heights=(3, 1))
    ax.plot([0, 1], [0, 1], color=TRUTH_COLOUR, linewidth=0.7, zorder=0.5)
    for i, name in enumerate(names):
        mine = np.asarray(table["estimator"]) == name
        columns = ("mean_probability", "frequency", "standard_error", "share_of_steps")
        given, came, error, share = (np.asarray(table[column])[mine] for column in columns)
        look = looks[name]
        style: dict[str, Any] = {"color": look.colour, "linestyle": look.dashes}
        ax.errorbar(given, came, 2 * error, marker="o", markersize=3, label=look.label, **style)
        edges = np.asarray(table["from_probability"])[mine]
        width = (edges[1] - edges[0]) / (len(names) + 1)
        below.bar(edges + (i + 1) * width, share, width, color=look.colour)
    ax.set(xlim=(0, 1), ylim=(-0.02, 1.02), ylabel="share that was the last")
    below.set(xlabel="probability that the mode now is the last one", ylabel="share of\nsteps")
    below.set_ylim(bottom=0.0)
    caption = f"Reliability over {information.runs:,} runs; bars: ±2 standard errors"
    _finish(figure, information.title, caption, [])
    return figure


def _draw_modes(
    case: Case, metric: str, looks: Looks, information: RunInformation
) -> Figure | None:
    """One panel per mode on shared axes, so that a panel compares the estimators."""
    named = mode_names((name for _, name in case.curves), metric)
    modes = dict.fromkeys([*information.modes, *named])
    panels = {mode: chosen_curves(case.curves, f"{metric}:{mode}", looks) for mode in modes}
    panels = {mode: curves for mode, curves in panels.items() if curves}
    if not panels:
        return None
    columns = 1 if len(panels) <= 3 else 2
    rows = math.ceil(len(panels) / columns)
    height = 0.4 + 1.5 * rows + 0.35 * (len(panels) % columns)  # an odd one needs a second x-axis
    figure, axes = _panels(rows, columns, height)
    for unused in axes[len(panels) :]:
        unused.remove()
    axes = axes[: len(panels)]
    for ax, (mode, curves) in zip(axes, panels.items(), strict=True):
        _show_true_mode(ax, case.truth, mode)
        for estimator, curve in curves.items():
            _plot_curve(ax, curve, looks[estimator])
        ax.set_title(_plain(mode, 60), loc="left")
    drawn = [curve for curves in panels.values() for curve in curves.values()]
    _frame_time(axes[-columns:], drawn, case.truth)
    axes[0].set_ylim(-0.02, 1.02 * max(1.0, *(np.nanmax(curve.value) for curve in drawn)))
    for ax in axes[::columns]:
        ax.set_ylabel(metric.replace("_", " "))
    name = {"mode_likelihood": "normalised mode likelihood"}.get(metric, "mode probability")
    _finish(figure, case.title, f"Mean {name} {_over(drawn, information.runs)}", [])
    return figure


def _scale_error(ax: Axes, values: Mapping[str, Array]) -> list[str]:
    """A log scale if one curve would squash the others; returns the curves that leave the frame."""
    ax.set_ylim(bottom=0.0)
    ax.yaxis.set_major_formatter(_plain_numbers())
    positive = [value[value > 0] for value in values.values() if (value > 0).any()]
    best = min((float(np.median(value)) for value in positive), default=math.inf)
    highest = max((float(value.max()) for value in positive), default=0.0)
    if highest <= LOG_SCALE_RATIO * best:
        return []
    low = 0.8 * max(min(float(value.min()) for value in positive), best / 100)
    high = 1.25 * min(highest, LEAVES_THE_FRAME * best)
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 3000 * low else (1,)))
    ax.yaxis.set_major_formatter(_plain_numbers())
    ax.yaxis.set_minor_formatter(NullFormatter())
    return [name for name, value in values.items() if (value > high).any()]


def _scale_ratio(ax: Axes, curves: Mapping[str, Curve]) -> list[str]:
    """A frame about what is nearly as good as the best; returns the curves that leave it for long.

    A few steps may go beyond it, such as the first after a start that is known exactly.
    """
    middle = {name: float(np.nanmedian(curve.value)) for name, curve in curves.items()}
    near = [
        curves[name].value
        for name, m in middle.items()
        if m <= NEARLY_AS_GOOD * min(middle.values())
    ]
    low = min(1.0, *(float(np.nanquantile(value, 0.02)) for value in near))
    high = max(1.0, *(float(np.nanquantile(value, 0.98)) for value in near))
    room = 0.08 * max(high - low, 1e-3)
    ax.set_ylim(low - room, high + room)
    ax.yaxis.set_major_formatter(_plain_numbers())
    return [
        name
        for name, curve in curves.items()
        if ((curve.value < low - room) | (curve.value > high + room)).mean() > 0.05
    ]


def _over(curves: Iterable[Curve], runs: int) -> str:
    curves = list(curves)
    bands = any(np.isfinite(curve.standard_error).any() for curve in curves)
    steps = max(curve.pooled for curve in curves)
    said = f"over {runs:,} run{'s' * (runs != 1)}"
    said += f" and {steps} steps a point" * (steps > 1)
    return said + "; bands: ±2 standard errors" * bands


def _plot_curve(ax: Axes, curve: Curve, look: Look) -> None:
    """The curve and two standard errors on either side: a band, or a bar without neighbours."""
    time, value, error = broken_at_gaps(curve.time, curve.value, curve.standard_error)
    _plot_line(ax, time, value, look)
    low, high = value - 2 * error, value + 2 * error
    ax.fill_between(time, low, high, color=look.colour, alpha=0.2, linewidth=0)
    bars = isolated(low + high)  # a band has no width at one point
    if bars.any():
        ax.vlines(time[bars], low[bars], high[bars], look.colour, alpha=0.5, linewidth=0.8)


def _plot_line(ax: Axes, x: Array, y: Array, look: Look) -> None:
    """A line broken at NaN; a point without neighbours, which a line would lose, gets a dot."""
    width = 1.3 if len(x) <= 500 else 0.8
    ax.plot(x, y, color=look.colour, linestyle=look.dashes, linewidth=width, label=look.label)
    alone = isolated(x + y)
    if alone.any():
        ax.plot(x[alone], y[alone], ".", color=look.colour, markersize=3)


def _mark_switches(ax: Axes, times: Array) -> None:
    if len(times):
        width = 0.8 if len(times) <= 40 else 0.4
        transform = ax.get_xaxis_transform()
        lines = ax.vlines(times, 0, 1, SWITCH_COLOUR, linewidth=width, transform=transform)
        lines.set(zorder=0.5, label="mode switch", gid="mode switch")


def _show_true_mode(ax: Axes, truth: Truth | None, mode: str) -> None:
    """Shade the stays of a fixed truth in `mode`; dash the share of runs if the truth is random."""
    if truth is None or mode not in truth.modes:
        return
    share = truth.share[:, truth.modes.index(mode)]
    if truth.fixed:
        transform = ax.get_xaxis_transform()
        inside = np.nan_to_num(share)
        shade = ax.stairs(inside, truth.edges, fill=True, transform=transform)
        shade.set(facecolor=TRUE_MODE_COLOUR, zorder=0.5, label="true mode", gid="true mode")
    else:
        time, share = broken_at_gaps(truth.edges[1:], share)
        _plot_line(ax, time, share, Look("truth: share of runs", TRUTH_COLOUR, (0, (4, 3))))


def _frame_time(bottom: Iterable[Axes], curves: Iterable[Curve], truth: Truth | None) -> None:
    edges = [] if truth is None else [truth.edges]
    times = np.concatenate([*(curve.time for curve in curves), *edges])
    for ax in bottom:
        ax.set_xlabel("time (s)")
        ax.tick_params(labelbottom=True)
        if np.ptp(times) > 0:
            ax.set_xlim(times.min(), times.max())


# ---- around the axes ----


def _panels(
    rows: int,
    columns: int,
    height: float,
    *,
    sharey: bool = True,
    heights: tuple[float, ...] | None = None,
) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(WIDTH_IN, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(
        rows, columns, sharex=True, sharey=sharey, squeeze=False, height_ratios=heights
    )
    return figure, list(axes.flat)


def _finish(figure: Figure, title: str, caption: str, leaving: Iterable[str]) -> None:
    """Title and caption above the axes, the legend below them, and height for both."""
    gone = ", ".join(leaving)
    caption += f"; leaves the frame: {gone}" if gone else ""
    heading = f"{_plain(title, 88)}\n{_plain(caption, 96)}"
    figure.suptitle(heading, x=0.01, horizontalalignment="left")
    handles: dict[str, Any] = {}
    for ax in figure.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    longest = max(len(line) for label in handles for line in label.split("\n"))
    rows = math.ceil(len(handles) / max(1, 104 // (longest + 9)))
    style: dict[str, Any] = {"frameon": False, "handlelength": 2.8}
    columns = math.ceil(len(handles) / rows)
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=columns, **style)
    lines = rows + heading.count("\n") + 1 + sum(label.count("\n") for label in handles)
    figure.set_figheight(figure.get_figheight() + 0.16 * lines)


def _plain(text: str, width: int) -> str:
    """Text that fits, its dollar signs not taken for mathematics."""
    return textwrap.fill(text, width).replace("$", r"\$")


def _plain_numbers(unit: float = 1.0) -> FuncFormatter:
    return FuncFormatter(lambda value, _: f"{value / unit:,.10g}".replace("-", "−"))
