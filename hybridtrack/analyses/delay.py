"""How soon a switch of mode is noticed: measured, predicted by the mean trajectory, and bounded.

Delay 1 means: noticed at the first measurement that the new mode affects. The prediction is ours:
the bank itself, run on measurements without noise, until the new mode is more probable than every
other; where every run has its own truth, the median over a block of them. The bounds are those of
Hwang, Balakrishnan, Tomlin 2006, section 4; see _propositions for what is wrong with them in print.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from hybridtrack.analyses import Analysis, Findings, Measured, Table, model_at_one_step
from hybridtrack.analyses import _delay_charts as charts
from hybridtrack.analyses._delay_words import NOTES, conclusions, shown
from hybridtrack.analyses._mean_course import (
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
from hybridtrack.analyses._steady_filters import (
    Difference,
    NoSteadyState,
    SteadyFilter,
    difference,
    steady_filters,
    steady_residual,
)
from hybridtrack.delays import Delays, distribution
from hybridtrack.description import ChosenEstimator, Experiment
from hybridtrack.errors import UserError
from hybridtrack.models import Array, JumpMarkovModel

COMPARED = ("imm", "mmae")  # types of estimators that the bounds are about
FACTORS = (0.25, 0.5, 2.0, 4.0)  # of the noise that filters believe in, one at a time
MOST_TUNED = 5000  # steps of a course whose tuning is tried
MEASURED = (
    "sojourns",
    "averaged_delay_steps",
    "averaged_delay_steps_low",
    "averaged_delay_steps_high",
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
        raise UserError(
            f"{experiment.name}: the truth has no switch of mode that could be noticed; give its "
            "legs several modes, or a chain"
        )
    if len(experiment.bank.modes) < 2:
        raise UserError(
            f"{experiment.name}: the filters have one mode, and nothing to notice; add another to "
            "'modes'"
        )
    known = {*experiment.bank.names}
    if not any({switch.from_mode, switch.to_mode} <= known for switch in switches):
        raise UserError(
            f"{experiment.name}: the truth never switches between two of the filters' modes "
            f"({', '.join(experiment.bank.names)}); call the modes alike"
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
            tuned = _tuned(experiment, course, chosen, model)
            for switch in course.switches:
                names = chosen.bank.names
                if not {switch.from_mode, switch.to_mode} <= set(names):
                    continue
                if truth is not None:
                    states.setdefault((switch.from_mode, switch.to_mode), truth[switch.step - 1])
                new = names.index(switch.to_mode)
                row = _key(course, switch, chosen) | _measured(measured, course, switch, chosen)
                drawn = noise_free.get((course.case, chosen.label))
                row["mean_trajectory_delay_steps"] = (
                    predicted_delay(probabilities, new, switch)
                    if drawn is None
                    else _median(drawn, experiment, switch)
                )
                row |= _bounded(bank, truth, switch, model, settings)
                own = _tuning(tuned, switch, names)
                row["tuning_concordance"] = concordance(
                    [one["first_term"] for one in own], [one["delay_steps"] for one in own]
                )
                tunings += [_key(course, switch, chosen) | one for one in own]
                rows.append(row)
    rows.sort(key=lambda row: (row["case"], row["switch"] or 0))
    pairs = _pairs(filters, model, states, rows, settings)
    table = _table(rows)
    return Findings(
        table=table._replace(shown=shown(rows)),
        conclusions=conclusions(rows, pairs, measured.runs),
        notes=(*notes, *NOTES),
        tables={"pairs": _table(pairs), "tuning": _table(tunings)},
        charts=charts.charts(experiment, measured, predictions, rows),
    )


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
            return f"the filter of {one.name} has no steady state: {one.reason}"
        filters.append(one)
    mean, _, used = start(experiment, course, chosen)
    mixing = chosen.estimator.name == "imm"
    bank = run_mean_bank(filters, own, course.measurements[used:], mean, mixing)
    pad = [(used, 0)]
    whole = (np.pad(array, pad + [(0, 0)] * (array.ndim - 1)) for array in bank)
    return _SteadyBank(filters, MeanBank(*whole))


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
    against: Rival | None = None
    for suffix, as_printed in versions.items():
        for name in CONDITIONS:
            row[f"{name}{suffix}_delay_steps"] = None
            row[f"{name}{suffix}_result"] = None if bank is None else f"premise fails: {bank}"
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


# ---- tuning ----------------------------------------------------------------------------------


class _Tuned(NamedTuple):
    mode: str
    parameter: str
    factor: float
    filters: list[SteadyFilter | NoSteadyState]
    probabilities: Array


def _tuned(
    experiment: Experiment, course: Course, chosen: ChosenEstimator, model: JumpMarkovModel
) -> list[_Tuned]:
    """The course again with the noise that the filters believe in changed, one at a time."""
    if len(course.measurements) > MOST_TUNED or chosen.estimator.name not in COMPARED:
        return []
    found = []
    changes: list[tuple[str, str, float]] = [("", "", 1.0)]
    changes += [
        (mode, parameter, factor)
        for mode in model.mode_names
        for parameter in ("process_noise_covariance", "measurement_noise_covariance")
        for factor in FACTORS
    ]
    for mode, parameter, factor in changes:
        change = _scaling(mode, parameter, factor)
        probabilities = mode_probabilities(experiment, course, chosen, change)
        own = chosen.estimator.prepare(chosen.settings, change(model)).model
        found.append(_Tuned(mode, parameter, factor, steady_filters(own), probabilities))
    return found


def _scaling(
    mode: str, parameter: str, factor: float
) -> Callable[[JumpMarkovModel], JumpMarkovModel]:
    def change(model: JumpMarkovModel) -> JumpMarkovModel:
        if not parameter:
            return model
        j = model.mode_names.index(mode)
        scaled = getattr(model, parameter).copy()
        scaled[..., j, :, :] *= factor
        return model._replace(**{parameter: scaled})

    return change


def _tuning(
    tuned: Sequence[_Tuned], switch: Switch, names: tuple[str, ...]
) -> list[dict[str, Any]]:
    """The first term of eq. 21 and the delay of a switch, tuning by tuning of its two modes."""
    found = []
    new, left = names.index(switch.to_mode), names.index(switch.from_mode)
    for one in tuned:
        T, i = one.filters[new], one.filters[left]
        if one.mode not in ("", switch.from_mode, switch.to_mode):
            continue
        if isinstance(T, SteadyFilter) and isinstance(i, SteadyFilter):
            found.append(
                {
                    "mode": one.mode,
                    "parameter": one.parameter,
                    "factor": one.factor,
                    "first_term": 1.0 / difference(i, T).alpha,
                    "delay_steps": predicted_delay(one.probabilities, new, switch),
                }
            )
    return found


def concordance(terms: Sequence[float], delays: Sequence[float]) -> float | None:
    """Pairs of tunings that the smaller term makes sooner, less those it makes later, over both.

    1 where a smaller term always comes with a shorter delay, -1 with a longer one (Goodman and
    Kruskal's gamma); None where all delays are alike.
    """
    sooner = later = 0
    for a in range(len(terms)):
        for b in range(a):
            if delays[a] != delays[b] and not math.isclose(terms[a], terms[b], rel_tol=1e-9):
                same = (terms[a] < terms[b]) == (delays[a] < delays[b])
                sooner, later = sooner + same, later + (not same)
    return (sooner - later) / (sooner + later) if sooner + later else None


# ---- pairs of modes --------------------------------------------------------------------------


def _pairs(
    filters: list[SteadyFilter | NoSteadyState],
    model: JumpMarkovModel,
    states: Mapping[tuple[str, str], Array],
    rows: Sequence[Mapping[str, Any]],
    settings: Settings,
) -> list[dict[str, Any]]:
    """Which direction is the easier one, and what is left in the long run, per ordered pair."""
    found = []
    for left, name in enumerate(model.mode_names):
        for new, other in enumerate(model.mode_names):
            if left != new:
                row: dict[str, Any] = {"from_mode": name, "to_mode": other}
                i, T = filters[left], filters[new]
                lost = [one.reason for one in (i, T) if isinstance(one, NoSteadyState)]
                if isinstance(i, SteadyFilter) and isinstance(T, SteadyFilter):
                    d = difference(i, T)
                    row |= {"first_term": 1.0 / d.alpha, "second_term": d.condition_number}
                    row |= _third_terms(rows, name, other)
                    row |= _equalities(d)
                    state = states.get((name, other), model.initial_mean)
                    row |= _in_the_long_run(i, T, d, state, model.transition_matrix[0], left, new)
                else:
                    row["steady_state"] = f"premise fails: {lost[0]}"
                found.append(row)
    return found


def _third_terms(rows: Sequence[Mapping[str, Any]], left: str, new: str) -> dict[str, Any]:
    """||e_T||/||e_i|| at the first switch of this kind, by estimator."""
    found: dict[str, Any] = {}
    for row in rows:
        if (row["from_mode"], row["to_mode"]) == (left, new) and row["third_term"] is not None:
            found.setdefault(f"third_term_{row['estimator']}", row["third_term"])
    return found


def _equalities(d: Difference) -> dict[str, Any]:
    """Hwang 2006, section 4.1: the five that make two modes one to a filter, each by its norm."""
    norms = {
        "G_x_norm": d.G_x,
        "H_x_norm": d.H_x,
        "G_u_norm": d.G_u,
        "H_u_norm": d.H_u,
        "input_difference_norm": d.input_difference,
    }
    found: dict[str, Any] = {name: float(np.linalg.norm(part)) for name, part in norms.items()}
    return found | {"means_indistinguishable": all(value < 1e-12 for value in found.values())}


def _in_the_long_run(
    i: SteadyFilter,
    T: SteadyFilter,
    d: Difference,
    state: Array,
    transition: Array,
    left: int,
    new: int,
) -> dict[str, Any]:
    """The steady mean residual of the wrong filter, and condition 15 with it."""
    steady = steady_residual(i, T, state)
    norms = [
        None if part is None else float(np.linalg.norm(part))
        for part in (steady.formula, steady.settled)
    ]
    condition = None
    if norms[1] is not None:
        with np.errstate(divide="ignore"):
            ln_mu = np.log(transition[new, new]) - np.log(transition[new, left])
        beta = (d.log_determinants + 2.0 * ln_mu) / d.largest_information
        condition = bool(d.alpha * norms[1] ** 2 + beta > 0)
    return {
        "steady_residual_m": norms[0],
        "settled_residual_m": norms[1],
        "steady_state": steady.reason or "settles",
        "condition_15": condition,
    }


ANALYSIS = Analysis(
    name="delay",
    summary="how soon a switch of mode is noticed: measured, predicted, bounded",
    source="Hwang, Balakrishnan, Tomlin 2006, sections 3 and 4",
    settings=Settings,
    analyse=_analyse,
    example="mode_delay_fig4",
    wants_run=_wants,
)
