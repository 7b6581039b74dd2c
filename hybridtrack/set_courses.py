"""Figures of sets over time: bounds on the states, operating points, the model chosen."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybridtrack.curves import Array, Case, Curve, Table, by_step, chosen_curves
from hybridtrack.page import (
    COLOURS,
    DASHES,
    TRUTH_COLOUR,
    Look,
    Looks,
    RunInformation,
    finish,
    panels,
    plot_curve,
    plot_line,
)

BANDS = "bands: ±2 standard errors"
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
        ax.set_ylabel(f"bound on {information.label(state)}")
    axes[-1].set_xlabel("time (s)")
    finish(figure, case.title, f"Mean bounds over {_runs(information)}; {BANDS}", leaving)
    return figure


def draw_sets(
    case: Case, tracks: Table, looks: Looks, information: RunInformation
) -> Figure | None:
    """How far the sets of one run reach about its truth, a panel per state.

    The truth is the line at 0: it is contained while it lies between an estimator's two lines.
    """
    run = _one_run(tracks)
    states = [quantity for name, quantity in run if name == "truth"]
    names = [n for n in looks if states and all((n, f"bound:{s}") in run for s in states)]
    if not names:
        return None
    figure, axes = panels(len(states), 1, 0.4 + 1.9 * len(states), sharey=False)
    leaving: dict[str, None] = {}
    for ax, state in zip(axes, states, strict=True):
        time, truth = run["truth", state]
        ax.axhline(0.0, color=TRUTH_COLOUR, linewidth=1.3, label="truth")
        reach: dict[str, Array] = {}
        for name in names:
            off, bound = run[name, state][1] - truth, run[name, f"bound:{state}"][1]
            plot_line(ax, time, off + bound, looks[name])
            plot_line(ax, time, off - bound, looks[name])
            reach[name] = np.abs(off) + bound
        leaving |= dict.fromkeys(f"{name} ({state})" for name in _frame(ax, reach))
        ax.set_ylim(-ax.get_ylim()[1], ax.get_ylim()[1])
        ax.set_ylabel(f"{information.label(state)}\nless the truth")
    axes[-1].set_xlabel("time (s)")
    number = int(np.asarray(tracks["run"]).min())
    finish(figure, case.title, f"Both ends of every set, run {number}", leaving)
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
    labels = ["trace of the set", *(f"bound on {information.label(state)}" for state in states)]
    figure, axes = panels(len(names), 1, 0.4 + 1.7 * len(names), sharey=False)
    leaving: dict[str, None] = {}
    for ax, name, label in zip(axes, names, labels, strict=True):
        values = {}
        for i, point in enumerate(points):
            curve = case.curves[owner, f"{name}:{point}"]
            look = Look(f"operating point {point}", COLOURS[i % len(COLOURS)], DASHES[i % 8])
            plot_curve(ax, curve, look)
            values[point] = curve.value
        leaving |= dict.fromkeys(
            f"point {p} ({label.partition(' (')[0]})" for p in _frame(ax, values)
        )
        ax.set_ylabel(label)
    axes[-1].set_xlabel("time (s)")
    caption = f"{owner}: every operating point's filter, means over {_runs(information)}; {BANDS}"
    finish(figure, case.title, caption, leaving)
    return figure


def draw_models(
    case: Case, tracks: Table, looks: Looks, information: RunInformation
) -> Figure | None:
    """Which model was chosen over time in the first run, and in what share of all runs.

    Banks one below the other (Otanez 2004, figure 6).
    """
    points = _bank(case)[1]
    run = _one_run(tracks)
    banks = [n for n in looks if (n, "chosen_share:1") in case.curves and (n, "model") in run]
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
        time, model = run[name, "model"]
        ax.step(time, model, where="mid", color=looks[name].colour, label=looks[name].label)
        ax.set(yticks=range(1, len(points) + 1), ylim=(0.5, len(points) + 0.5), ylabel="model")
    axes[-1].set_xlabel("time (s)")
    caption = f"Model chosen in the first run; width of bands: share of {_runs(information)}"
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


def _one_run(tracks: Table) -> dict[tuple[str, str], list[Array]]:
    """Time and value of every estimator's quantities, in the first run that was kept."""
    runs = np.asarray(tracks["run"])
    mine = runs == runs.min(initial=np.iinfo(np.int64).max)
    names = ("estimator", "quantity", "step", "time_s", "value")
    one = {name: np.asarray(tracks[name])[mine] for name in names}
    series = by_step(one, ("estimator", "quantity"), ("time_s", "value"))
    return {(name, quantity): both for (name, quantity), both in series}


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
