"""What every figure shares: size, colours, panels, curves with bands, title and legend, PNG files.

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
from matplotlib.ticker import FuncFormatter
from PIL import Image

from hybridtrack.curves import Array, Curve, broken_at_gaps, isolated

Dashes = str | tuple[float, tuple[float, ...]]

DPI = 200
COMPRESSION = 3  # of 9: more takes half as long again and saves a tenth
WIDTH_IN = 7.0  # two columns of a journal page

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
RAW_COLOUR, TRUTH_COLOUR = "0.55", "black"

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
    units: Mapping[str, str] | None = None  # by state ('' unknown), where states aren't our own

    def label(self, state: str) -> str:
        """A state with its unit, for an axis."""
        unit = (self.units or {}).get(state)
        return f"{state} ({unit})" if unit else state


class Look(NamedTuple):
    """How one estimator is drawn, in every figure."""

    label: str
    colour: str
    dashes: Dashes


Looks = Mapping[str, Look]


@contextmanager
def style() -> Iterator[None]:
    """Matplotlib's defaults with our sizes, whatever the user's matplotlibrc says."""
    with matplotlib.style.context(["default", STYLE]):
        yield


def panels(
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


def plot_curve(ax: Axes, curve: Curve, look: Look) -> None:
    """The curve and two standard errors on either side: a band, or a bar without neighbours."""
    time, value, error = broken_at_gaps(curve.time, curve.value, curve.standard_error)
    plot_line(ax, time, value, look)
    low, high = value - 2 * error, value + 2 * error
    ax.fill_between(time, low, high, color=look.colour, alpha=0.2, linewidth=0)
    bars = isolated(low + high)  # a band has no width at one point
    if bars.any():
        ax.vlines(time[bars], low[bars], high[bars], look.colour, alpha=0.5, linewidth=0.8)


def plot_line(ax: Axes, x: Array, y: Array, look: Look) -> None:
    """A line broken at NaN; a point without neighbours, which a line would lose, gets a dot."""
    width = 1.3 if len(x) <= 500 else 0.8
    ax.plot(x, y, color=look.colour, linestyle=look.dashes, linewidth=width, label=look.label)
    alone = isolated(x + y)
    if alone.any():
        ax.plot(x[alone], y[alone], ".", color=look.colour, markersize=3)


def finish(figure: Figure, title: str, caption: str, leaving: Iterable[str]) -> None:
    """Title and caption above the axes, the legend below them, and height for both."""
    gone = ", ".join(leaving)
    caption += f"; leaves the frame: {gone}" if gone else ""
    heading = f"{plain(title, 88)}\n{plain(caption, 96)}"
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


def plain(text: str, width: int) -> str:
    """Text that fits, its dollar signs not taken for mathematics."""
    return textwrap.fill(text, width).replace("$", r"\$")


def plain_numbers(unit: float = 1.0) -> FuncFormatter:
    return FuncFormatter(lambda value, _: f"{value / unit:,.10g}".replace("-", "−"))


# ---- files ----


def save_one(figure: Figure, path: Path) -> Path:
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
