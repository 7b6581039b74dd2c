"""How soon a switch of mode is noticed: measured, predicted by the mean trajectory, and bounded.

Delay 1 means: noticed at the first measurement that the new mode affects. The prediction is ours:
the bank itself, run on measurements without noise, until the new mode is more probable than every
other; where every run has its own truth, the median over a block of them. The bounds are those of
Hwang, Balakrishnan, Tomlin 2006, section 4; see _propositions for what is wrong with them in print.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from hybridtrack.analyses import Analysis, Findings, Measured, Table, model_at_one_step
from hybridtrack.analyses import _delay_charts as charts
from hybridtrack.analyses._delay_words import NOTES, conclusions, shown, shown_pairs
from hybridtrack.analyses._directions import pairs_of_modes
from hybridtrack.analyses._mean_course import (
    BEFORE,
    Course,
    MeanBank,
    Switch,
    courses,
    mode_probabilities,
    noise_free_delays,
    predicted_delay,
    run_mean_bank,
    start,
    states_of_bank,
)
from hybridtrack.analyses._propositions import CONDITIONS, Ingredients, Rival, bounds, rival
from hybridtrack.analyses._steady_filters import NoSteadyState, SteadyFilter, steady_filters
from hybridtrack.analyses._tuning import MOST_STEPS, concordance, of_switch, tuned
from hybridtrack.delays import Delays, distribution
from hybridtrack.description import ChosenEstimator, Experiment
from hybridtrack.errors import Unsuited
from hybridtrack.jumps import ChainTruth
from hybridtrack.models import Array, JumpMarkovModel

COMPARED = ("imm", "mmae")  # types of estimators that the bounds are about
MEASURED = (
    "sojourns",
    "averaged_delay_steps",
    "averaged_delay_steps_low",
    "averaged_delay_steps_high",
    "averaged_delay",
    "stay_steps",
    "already_share",
    "already_share_standard_error",
    "detection_delay_steps",
    "detection_delay_steps_standard_error",
    "median_delay_steps",
    "first_step_share",
    "first_step_share_standard_error",
    "missed_share",
    "missed_share_standard_error",
    "false_switches",
    "false_switches_standard_error",
)


class Settings(NamedTuple):
    """as_printed: the bounds as the paper prints them too, in columns of their own."""

    as_printed: bool = False


def _wants(experiment: Experiment) -> tuple[str, ...]:
    """The scenario with an IMM and a bank without mixing, where it has none."""
    switches = [switch for course in courses(experiment) for switch in course.switches]
    if not switches:
        raise Unsuited(
            "the truth has no switch of mode that could be noticed; give its legs several modes, "
            "or a chain",
            "truth",
        )
    if len(experiment.bank.modes) < 2:
        raise Unsuited(
            "the filters have one mode, and nothing to notice; add another to 'modes'", "modes"
        )
    known = {*experiment.bank.names}
    if not any({switch.from_mode, switch.to_mode} <= known for switch in switches):
        raise Unsuited(
            "the truth never switches between two of the filters' modes "
            f"({', '.join(experiment.bank.names)}); call the modes alike",
            "truth",
        )
    types = {chosen.estimator.name for chosen in experiment.estimators}
    labels = {chosen.label for chosen in experiment.estimators}
    added = []
    for kind in COMPARED:
        if kind not in types:
            label = kind.upper()
            while label in labels:
                label += "_added"
            added.append(f"estimators.{label}={{type: {kind}}}")
    return tuple(added)


def _analyse(experiment: Experiment, settings: Settings, measured: Measured | None) -> Findings:
    assert measured is not None
    model, notes = model_at_one_step(experiment)
    filters = steady_filters(model)
    rows: list[dict[str, Any]] = []
    tunings: list[dict[str, Any]] = []
    predictions: dict[tuple[str, str], Array] = {}
    states: dict[tuple[str, str], Array] = {}  # the truth's at a switch, by its modes
    noise_free = noise_free_delays(experiment, _followed(experiment))
    for course in courses(experiment):
        truth = states_of_bank(course, experiment.bank.state_names)
        for chosen in _followed(experiment):
            probabilities = mode_probabilities(experiment, course, chosen)
            predictions[course.case, chosen.label] = probabilities
            bank = _steady_bank(experiment, course, chosen, model)
            tuned_courses = (
                tuned(experiment, course, chosen, model)
                if chosen.estimator.name in COMPARED
                else []
            )
            for switch in course.switches:
                names = chosen.bank.names
                if not {switch.from_mode, switch.to_mode} <= set(names):
                    continue
                if truth is not None:
                    states.setdefault((switch.from_mode, switch.to_mode), truth[switch.step - 1])
                new = names.index(switch.to_mode)
                row = _key(course, switch, chosen) | _measured(measured, course, switch, chosen)
                drawn = noise_free.get((course.case, chosen.label))
                delay = (
                    predicted_delay(probabilities, new, switch)
                    if drawn is None
                    else _median(drawn, experiment, switch)
                )
                row["mean_trajectory_delay_steps"] = delay
                row["mean_trajectory_delay"] = _said(delay, switch, course)
                row |= _bounded(bank, truth, switch, model, settings)
                own = of_switch(tuned_courses, switch, names)
                row["tuning_concordance"] = concordance(
                    [(one["mode"], one["parameter"]) for one in own],
                    [one["first_term"] for one in own],
                    [one["delay_steps"] for one in own],
                )
                tunings += [_key(course, switch, chosen) | one for one in own]
                rows.append(row)
    order = [case.name for case in experiment.cases]
    rows.sort(key=lambda row: (order.index(row["case"]), row["switch"] or 0))
    pairs = pairs_of_modes(filters, model, states, rows)
    table = _table(rows)
    return Findings(
        table=table._replace(shown=shown(rows)),
        conclusions=conclusions(rows, pairs, measured.runs),
        notes=(*notes, *_limits(experiment), *NOTES),
        tables={
            "pairs": _table(pairs)._replace(shown=shown_pairs(pairs)),
            "tuning": _table(tunings),
        },
        charts=charts.charts(experiment, measured, predictions, rows),
    )


def _said(delay: float, switch: Switch, course: Course) -> str:
    """A predicted delay in words: a stay that the data cut short tells no more than its length."""
    if math.isnan(delay):
        return "no switch"
    if math.isfinite(delay):
        return f"{delay:.0f}"
    cut_short = switch.number is not None and switch.last == len(course.measurements)
    return f"over {switch.last - switch.step + 1}" if cut_short else "never"


def _limits(experiment: Experiment) -> list[str]:
    """What the prediction and the bounds leave out here."""
    notes = []
    sensor = experiment.sensor
    if sensor.detection_probability < 1.0 or sensor.outliers is not None:
        notes.append(
            "prediction and bounds know of no missed scan and no outlier; the runs have them"
        )
    if any(isinstance(case.truth, ChainTruth) for case in experiment.cases):
        notes.append(
            "the truth is drawn anew in every run: predicted is the median over truths of their "
            "own, measured without noise; bounds and tuning are along the chain's mean, which "
            f"switches once, after {BEFORE} steps"
        )
    if any(len(case.times_s) - 1 > MOST_STEPS for case in experiment.cases):
        notes.append(f"tuning is not tried on tracks of more than {MOST_STEPS:,} steps")
    return notes


def _median(drawn: Delays, experiment: Experiment, switch: Switch) -> float:
    """Of the delays of a kind of switch; infinite where most aren't noticed, NaN without any."""
    names = experiment.truth_modes
    group = names.index(switch.from_mode) * len(names) + names.index(switch.to_mode)
    found = distribution(drawn, group)
    if not found.at_risk[0]:
        return math.nan
    reached = found.probability >= 0.5
    return float(np.argmax(reached)) + 1.0 if reached.any() else math.inf


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    names = list(dict.fromkeys(name for row in rows for name in row))
    return Table({name: [row.get(name) for row in rows] for name in names})


def _followed(experiment: Experiment) -> list[ChosenEstimator]:
    """Estimators that find out the mode for themselves."""
    return [
        chosen
        for chosen in experiment.estimators
        if len(chosen.bank.modes) > 1 and not chosen.estimator.is_told_modes(chosen.settings)
    ]


def _key(course: Course, switch: Switch, chosen: ChosenEstimator) -> dict[str, Any]:
    return {
        "case": course.case,
        "switch": switch.number,
        "from_mode": switch.from_mode,
        "to_mode": switch.to_mode,
        "time_s": switch.time_s,
        "estimator": chosen.label,
    }


def _measured(
    measured: Measured, course: Course, switch: Switch, chosen: ChosenEstimator
) -> dict[str, Any]:
    """What the run says of a switch; nothing where it never happened."""
    for row in measured.delays:
        same = row["case"] == course.case and row["estimator"] == chosen.label
        modes = (row["from_mode"], row["to_mode"]) == (switch.from_mode, switch.to_mode)
        if same and modes and row["switch"] == switch.number:
            return {name: row[name] for name in MEASURED}
    return dict.fromkeys(MEASURED)


# ---- the bounds ------------------------------------------------------------------------------


class _SteadyBank(NamedTuple):
    filters: list[SteadyFilter]
    course: MeanBank
    begun: int  # scans that a start is made from

    def estimate(self, step: int) -> int | None:
        """The most probable mode after a step, from 1; None before there is one."""
        if step <= self.begun:
            return None
        return int(np.argmax(self.course.log_probability[step - 1]))


def _steady_bank(
    experiment: Experiment, course: Course, chosen: ChosenEstimator, model: JumpMarkovModel
) -> _SteadyBank | str | None:
    """The bank in steady state along a course; or why there is none; None for other estimators."""
    if chosen.estimator.name not in COMPARED:
        return None
    if np.ptp(np.diff(course.times_s)) > 1e-6 * np.diff(course.times_s).mean():
        return "the steps are uneven, so that no filter is steady"
    own: JumpMarkovModel = chosen.estimator.prepare(chosen.settings, model).model
    filters = []
    for one in steady_filters(own):
        if isinstance(one, NoSteadyState):
            return one.reason
        filters.append(one)
    mean, _, used = start(experiment, course, chosen)
    mixing = chosen.estimator.name == "imm"
    bank = run_mean_bank(filters, own, course.measurements[used:], mean, mixing)
    pad = [(used, 0)]
    whole = (np.pad(array, pad + [(0, 0)] * (array.ndim - 1)) for array in bank)
    return _SteadyBank(filters, MeanBank(*whole), used)


def _bounded(
    bank: _SteadyBank | str | None,
    truth: Array | None,
    switch: Switch,
    model: JumpMarkovModel,
    settings: Settings,
) -> dict[str, Any]:
    """Every proposition's result, and its ingredients against the mode that was left."""
    row: dict[str, Any] = {}
    versions = {"": False} | ({"_as_printed": True} if settings.as_printed else {})
    names = model.mode_names
    new, left = names.index(switch.to_mode), names.index(switch.from_mode)
    if bank is not None and truth is None:
        bank = "the truth has not all of the filters' states"
    elif isinstance(bank, _SteadyBank) and bank.estimate(switch.step - 1) != left:
        bank = f"without noise the bank does not estimate {switch.from_mode} before the switch"
    fails = f"premise fails: {bank}" if isinstance(bank, str) else None
    against: Rival | None = None
    for suffix, as_printed in versions.items():
        for name in CONDITIONS:
            row[f"{name}{suffix}_delay_steps"] = None
            row[f"{name}{suffix}_result"] = fails
        if isinstance(bank, _SteadyBank) and truth is not None:
            transition = model.transition_matrix[0]
            others = [j for j in range(len(names)) if j != new]
            rivals = [
                rival(bank.course, switch, bank.filters, new, j, truth, transition, as_printed)
                for j in others
            ]
            for name, bound in bounds(rivals).items():
                row[f"{name}{suffix}_delay_steps"] = bound.delay_steps
                row[f"{name}{suffix}_result"] = bound.result
            against = against or rivals[others.index(left)]
    values = against.ingredients if against else (None,) * len(Ingredients._fields)
    row |= dict(zip(Ingredients._fields, values, strict=True))
    terms = _terms(against.ingredients) if against else (None, None, None, None)
    columns = ("first_term", "second_term", "third_term", "sum_of_logarithms")
    return row | dict(zip(columns, terms, strict=True))


def _terms(of: Ingredients) -> tuple[float, float, float, float]:
    """Hwang 2006, eq. 21: three ratios, and the sum of their logarithms that should be small."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first = np.float64(1.0) / of.alpha
        second = np.float64(of.sigma_max_C_T_A_T) / of.sigma_min_C_T_A_T
        third = np.float64(of.error_T) / of.error_i
        total = 0.5 * np.log(first) + np.log(second) + np.log(third)
    return float(first), float(second), float(third), float(total)


ANALYSIS = Analysis(
    name="delay",
    summary="how soon a switch of mode is noticed: measured, predicted, bounded",
    source="Hwang, Balakrishnan, Tomlin 2006, sections 3 and 4",
    settings=Settings,
    analyse=_analyse,
    example="mode_delay_fig4",
    wants_run=_wants,
)
