"""Figures of sets over time: bounds on the states, operating points, the model chosen."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybridtrack.curves import Array, Case, Curve, Table, chosen_curves
from hybridtrack.page import (
    COLOURS,
    DASHES,
    Look,
    Looks,
    RunInformation,
    finish,
    panels,
    plot_curve,
)

WIDEST = 30.0  # times the smallest curve's median: what goes beyond leaves the frame


def draw_bounds(case: Case, looks: Looks, information: RunInformation) -> Figure | None:
    """The mean bound on every state, a panel each; estimators side by side."""
    states = _parts(case, "bound:")
    if not states:
        return None
    figure, axes = panels(len(states), 1, 0.4 + 1.9 * len(states), sharey=False)
    leaving: dict[str, None] = {}
    for ax, state in zip(axes, states, strict=True):
        curves = chosen_curves(case.curves, f"bound:{state}", looks)
        for name, curve in curves.items():
            plot_curve(ax, curve, looks[name])
        beyond = _frame(ax, {name: curve.value for name, curve in curves.items()})
        leaving |= dict.fromkeys(f"{name} ({state})" for name in beyond)
        ax.set_ylabel(f"bound on {state}")
    axes[-1].set_xlabel("time (s)")
    finish(figure, case.title, f"Mean bounds over {_runs(information)}", leaving)
    return figure


def draw_points(case: Case, looks: Looks, information: RunInformation) -> Figure | None:
    """The filters of a bank, by operating point: trace of their sets, and bounds on every state.

    Of the first estimator whose filters are apart (Otanez 2004, figures 4 and 5).
    """
    owner, points = _bank(case)
    if owner is None:
        return None
    states = [s for s in _parts(case, "bound:") if (owner, f"point_bound:{s}:1") in case.curves]
    names = ["point_trace", *(f"point_bound:{state}" for state in states)]
    labels = ["trace of the set", *(f"bound on {state}" for state in states)]
    figure, axes = panels(len(names), 1, 0.4 + 1.7 * len(names), sharey=False)
    leaving: dict[str, None] = {}
    for ax, name, label in zip(axes, names, labels, strict=True):
        values = {}
        for i, point in enumerate(points):
            curve = case.curves[owner, f"{name}:{point}"]
            look = Look(f"operating point {point}", COLOURS[i % len(COLOURS)], DASHES[i % 8])
            plot_curve(ax, curve, look)
            values[point] = curve.value
        leaving |= dict.fromkeys(f"point {p} ({label})" for p in _frame(ax, values))
        ax.set_ylabel(label)
    axes[-1].set_xlabel("time (s)")
    caption = f"{owner}: every operating point's filter, means over {_runs(information)}"
    finish(figure, case.title, caption, leaving)
    return figure


def draw_models(
    case: Case, tracks: Table, looks: Looks, information: RunInformation
) -> Figure | None:
    """Which model was chosen over time in the first run, and in what share of all runs.

    Banks one below the other (Otanez 2004, figure 6).
    """
    points = _bank(case)[1]
    banks = [name for name in looks if (name, "chosen_share:1") in case.curves]
    if not banks:
        return None
    figure, axes = panels(len(banks), 1, 0.4 + 1.1 * len(banks))
    for ax, name in zip(axes, banks, strict=True):
        for i, point in enumerate(points):
            share: Curve | None = case.curves.get((name, f"chosen_share:{point}"))
            if share is not None:
                ax.fill_between(
                    share.time,
                    i + 1 - 0.4 * share.value,
                    i + 1 + 0.4 * share.value,
                    color=looks[name].colour,
                    alpha=0.25,
                    linewidth=0,
                )
        time, model = _first_run(tracks, name)
        ax.step(time, model, where="mid", color=looks[name].colour, label=looks[name].label)
        ax.set(yticks=range(1, len(points) + 1), ylim=(0.5, len(points) + 0.5), ylabel="model")
    axes[-1].set_xlabel("time (s)")
    caption = f"Model chosen in the first run; bands: share of {_runs(information)}"
    finish(figure, case.title, caption, [])
    return figure


def _parts(case: Case, start: str) -> list[str]:
    """What follows `start` in the metrics of a case, each once."""
    found = (metric.removeprefix(start) for _, metric in case.curves if metric.startswith(start))
    return list(dict.fromkeys(found))


def _bank(case: Case) -> tuple[str | None, list[str]]:
    """The first estimator with operating points, and their names."""
    start = "point_trace:"
    owners = [(name, metric) for name, metric in case.curves if metric.startswith(start)]
    if not owners:
        return None, []
    first = owners[0][0]
    return first, [metric.removeprefix(start) for name, metric in owners if name == first]


def _first_run(tracks: Table, name: str) -> tuple[Array, Array]:
    mine = (np.asarray(tracks["estimator"]) == name) & (np.asarray(tracks["quantity"]) == "model")
    mine &= np.asarray(tracks["run"]) == (
        np.asarray(tracks["run"])[mine].min() if mine.any() else 0
    )
    return np.asarray(tracks["time_s"])[mine], np.asarray(tracks["value"])[mine]


def _frame(ax: Axes, values: dict[str, Array]) -> list[str]:
    """Frame what can be compared; the names of the curves that go beyond."""
    known = {name: v[np.isfinite(v)] for name, v in values.items() if np.isfinite(v).any()}
    if not known:
        return []
    limit = WIDEST * min(float(np.median(v)) for v in known.values())
    largest = {name: float(v.max()) for name, v in known.items()}
    inside = [top for top in largest.values() if top <= limit]
    ax.set_ylim(0.0, 1.05 * max([*inside, limit / WIDEST] if inside else [limit]))
    return [name for name, top in largest.items() if top > ax.get_ylim()[1]]


def _runs(information: RunInformation) -> str:
    return f"{information.runs:,} run{'s' * (information.runs != 1)}"
