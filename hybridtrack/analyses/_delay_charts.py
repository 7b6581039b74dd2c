"""The figures of the analysis of delays."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hybridtrack.analyses import Band, Chart, Line, Mark, Measured, Panel
from hybridtrack.description import Experiment
from hybridtrack.models import Array

Row = Mapping[str, Any]

MOST_PANELS = 6
ERRORS = 2.0  # standard errors that a band is wide on either side


def charts(
    experiment: Experiment,
    measured: Measured,
    predictions: Mapping[tuple[str, str], Array],
    rows: Sequence[Row],
) -> list[Chart]:
    """Averaged mode estimates over time (of the first case), and distributions of delays."""
    found = []
    if rows and rows[0]["switch"] is not None:
        found.append(_estimates(experiment, measured, predictions, rows))
    if measured.delay_distribution:
        found.append(_distributions(measured, rows))
    return found


def _estimates(
    experiment: Experiment,
    measured: Measured,
    predictions: Mapping[tuple[str, str], Array],
    rows: Sequence[Row],
) -> Chart:
    """As figure 4 of Hwang 2006: share of the runs that estimate each mode but the first."""
    case = rows[0]["case"]
    labels = list(dict.fromkeys(row["estimator"] for row in rows))[:MOST_PANELS]
    times_s = next(c.times_s for c in experiment.cases if c.name == case)
    number = [c.name for c in experiment.cases].index(case)
    true_mode = np.asarray(experiment.cases[number].truth.mode)[1:]  # type: ignore[union-attr]
    panels = []
    for label in labels:
        own = [r for r in rows if r["estimator"] == label and r["case"] == case]
        bank = next(c.bank.names for c in experiment.estimators if c.label == label)
        lines = []
        for mode in bank[1:]:
            true = np.array([experiment.truth_modes[j] == mode for j in true_mode], dtype=float)
            true = np.concatenate([true[:1], true])
            lines.append(Line("truth", times_s, true, reference=True, steps="pre"))
            share = _series(measured, case, label, f"mode_estimate:{mode}")
            of_two = len(bank) == 2
            lines.append(Line("share of runs" if of_two else f"{mode}, share of runs", *share))
            predicted = predictions[case, label][:, bank.index(mode)]
            said = "probability on the mean trajectory" if of_two else f"{mode}, mean trajectory"
            lines.append(Line(said, times_s[1:], predicted))
        marks = []
        for row in own:
            for said, delay, line in (
                ("noticed", row["averaged_delay_steps"], 1),
                ("predicted", row["mean_trajectory_delay_steps"], 2),
            ):
                if delay is not None and math.isfinite(delay):
                    step = int(np.searchsorted(times_s, row["time_s"])) + int(delay)
                    marks.append(Mark(said, x=float(times_s[step]), like=lines[line].label))
        what = f"{label}:\nestimated {bank[1]}" if len(bank) == 2 else label
        panels.append(Panel(what, lines, (), marks, y_limits=(-0.05, 1.05)))
    runs = f"{measured.runs:,} run{'s' * (measured.runs != 1)}"
    return Chart("mode_estimate", f"Mode estimates over {runs}", "time, s", panels)


def _series(measured: Measured, case: str, label: str, metric: str) -> tuple[Array, Array]:
    steps = measured.steps
    mine = (steps["case"] == case) & (steps["estimator"] == label) & (steps["metric"] == metric)
    return steps["time_s"][mine], steps["value"][mine]


def _distributions(measured: Measured, rows: Sequence[Row]) -> Chart:
    """Share of switches noticed within so many steps, a panel for each of the first switches."""
    keys = ("case", "switch", "from_mode", "to_mode")
    switches = list(dict.fromkeys(tuple(row[k] for k in keys) for row in rows))[:MOST_PANELS]
    panels = []
    for switch in switches:
        lines, bands = [], []
        for label in dict.fromkeys(row["estimator"] for row in rows):
            own = [
                row
                for row in measured.delay_distribution
                if row["estimator"] == label and tuple(row[k] for k in keys) == switch
            ]
            if own:
                x, p, error = (
                    np.array([row[name] for row in own], dtype=float)
                    for name in ("delay_steps", "probability", "standard_error")
                )
                x, p, error = (np.concatenate([[0.0], part]) for part in (x, p, error))
                lines.append(Line(label, x, p, steps="post"))
                bands.append(Band(label, x, p - ERRORS * error, p + ERRORS * error, "post"))
        said = f"{switch[2]} to {switch[3]}" + (
            f"\nat {_time(rows, switch):g} s" if switch[1] else ""
        )
        panels.append(Panel(said, lines, bands, y_limits=(-0.02, 1.02)))
    caption = "Share of switches noticed within so many steps; bands: ±2 standard errors"
    return Chart("delay_distribution", caption, "steps after the switch", panels)


def _time(rows: Sequence[Row], switch: tuple[Any, ...]) -> float:
    return next(float(row["time_s"]) for row in rows if (row["case"], row["switch"]) == switch[:2])
