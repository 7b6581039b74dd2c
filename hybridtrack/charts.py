"""An analysis' charts, which are plain numbers, as figures of our style."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hybridtrack.analyses import Chart, Panel
from hybridtrack.page import COLOURS, DASHES, TRUTH_COLOUR, finish, panels, plain, style

PANEL_IN = 1.7  # inches that a panel is high
MARKS = ("0.25", "0.5", "0.65", "#882255")  # none is one of the first lines'
MARK_DASHES = ("-", (0, (1.5, 1.5)), (0, (4, 1, 1, 1)), (0, (6, 2)))


def draw(charts: Sequence[Chart], title: str) -> dict[str, Figure]:
    """A figure for each chart, by its name."""
    with style():
        return {chart.name: _draw(chart, title) for chart in charts}


def _draw(chart: Chart, title: str) -> Figure:
    height = max(PANEL_IN * len(chart.panels), 2.4)
    figure, axes = panels(len(chart.panels), 1, height, sharey=False)
    labels = [line.label for panel in chart.panels for line in panel.lines if not line.reference]
    place = {label: i for i, label in enumerate(dict.fromkeys(labels))}
    kinds = [mark.label for panel in chart.panels for mark in panel.marks]
    marks = {label: i for i, label in enumerate(dict.fromkeys(kinds))}
    for ax, panel in zip(axes, chart.panels, strict=True):
        _draw_panel(ax, panel, place, marks)
    axes[-1].set_xlabel(plain(chart.x_label, 60))
    if chart.x_label.startswith(("step", "scan")):
        axes[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    finish(figure, title, chart.caption, [])
    return figure


def _draw_panel(ax: Axes, panel: Panel, place: dict[str, int], marks: dict[str, int]) -> None:
    for band in panel.bands:
        low, high = (np.asarray(edge, dtype=float) for edge in (band.low, band.high))
        known = band.label in place
        colour = COLOURS[place[band.label] % len(COLOURS)] if known else "0.6"
        label = None if known else plain(band.label, 60)
        look: dict[str, Any] = {"color": colour, "alpha": 0.2, "linewidth": 0, "label": label}
        ax.fill_between(band.x, low, high, step=band.steps or None, **look)
    for line in panel.lines:
        few = len(line.x) <= 60
        if line.reference:
            look = {"color": TRUTH_COLOUR, "linewidth": 0.8}
        else:
            i = place[line.label]
            look = {"color": COLOURS[i % len(COLOURS)], "linewidth": 1.3}
            look["linestyle"] = DASHES[(i + i // len(COLOURS)) % len(DASHES)]
            look |= {"marker": "o", "markersize": 2.5} if few else {}
        look["drawstyle"] = f"steps-{line.steps}" if line.steps else "default"
        ax.plot(line.x, line.y, label=plain(line.label, 60), **look)
    for mark in panel.marks:
        i = marks[mark.label] % len(MARKS)
        look = {"color": MARKS[i], "linestyle": MARK_DASHES[i], "linewidth": 1.0, "zorder": 0.8}
        if mark.like in place:
            look["color"] = COLOURS[place[mark.like] % len(COLOURS)]
        look["label"] = plain(mark.label, 60)
        if mark.x is not None:
            ax.axvline(mark.x, **look)
        elif mark.y is not None:
            ax.axhline(mark.y, **look)
    ax.set_ylabel(panel.y_label.replace("$", r"\$"))
    if panel.log_y:
        ax.set_yscale("log")
    if panel.y_limits is not None:
        ax.set_ylim(panel.y_limits)
