"""The sojourn analysis as tables: bounds, conditions, modes, simulated runs."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hybridtrack.analyses._eigenstructure import steps_until_below
from hybridtrack.analyses._findings import Table
from hybridtrack.analyses._sojourn_bounds import PaperBound
from hybridtrack.analyses._sojourn_numbers import number
from hybridtrack.analyses._sojourn_observability import JointObservability
from hybridtrack.analyses._sojourn_study import Study
from hybridtrack.analyses._sojourn_words import listed, pairs, plural


def bounds_table(study: Study) -> Table:
    """One row per bound: as printed, rate-correct, direct."""
    printed, corrected, direct = study.printed, study.rate_correct, study.direct
    horizon = study.observability.covariance_steps
    columns: dict[str, list[Any]] = {
        "bound": ["as printed", "rate-correct", "direct"],
        "minimum_sojourn_s": [],
        "minimum_sojourn_steps": [
            study.printed_sojourn,
            study.rate_correct_sojourn,
            study.direct_sojourn,
        ],
        "sojourn_bound_steps": [
            bound.steps + study.delay_steps for bound in (printed, corrected, direct)
        ],
        "decay_steps": [printed.decay_steps, corrected.decay_steps, float(direct.decay_steps)],
        "repair_steps": [printed.repair_steps, corrected.repair_steps, direct.repair_steps],
        "disturbance": [*study.disturbance],
        "smallest_error_bound": [bound.delay_error for bound in (printed, corrected, direct)],
        "error_bound_at_decay": [
            None,
            _at_decay(corrected, study.rate),
            direct.error_bound_at_decay,
        ],
        "largest_growth": [None, None, max(direct.growth)],
        "told_apart_after_steps": [math.inf if horizon is None else float(horizon)] * 3,
        "why": _reasons(study),
    }
    columns["minimum_sojourn_s"] = [s * study.step_s for s in columns["minimum_sojourn_steps"]]
    return Table(
        columns,
        {
            "bound": columns["bound"],
            "sojourn\nsteps": _cells(columns["minimum_sojourn_steps"]),
            "sojourn\ns": _cells(columns["minimum_sojourn_s"]),
            "beta, steps\n(decay)": _cells(columns["decay_steps"]),
            "for M0\nsteps": _cells(columns["repair_steps"]),
            "U": _cells(columns["disturbance"], never="unbounded"),
            "smallest\nM0": _cells(columns["smallest_error_bound"]),
        },
    )


def _at_decay(corrected: PaperBound, rate: float) -> float | None:
    """The smallest M0 for which the first term of eq. 41 asks no more than the second."""
    if not corrected.delay_error:
        return corrected.delay_error
    kept = 1.0 - rate**corrected.decay_steps
    return corrected.delay_error / kept if kept > 0 else math.inf


def _reasons(study: Study) -> list[str]:
    found = []
    for name, bound in (
        ("printed", study.printed),
        ("corrected", study.rate_correct),
        ("direct", study.direct),
    ):
        if math.isfinite(bound.steps):
            decay = bound.decay_steps >= bound.repair_steps
            found.append("the decay to mu^t asks for it" if decay else "error_bound asks for it")
        elif not math.isfinite(bound.decay_steps):
            found.append("infeasible: the eigenvectors are not independent in floating point")
        elif study.error_bound == 0.0:
            found.append(
                f"infeasible: a delay of {study.delay_steps} "
                f"{plural('step', study.delay_steps)} leaves an error for ever, and "
                "error_bound is 0"
            )
        else:
            assert bound.delay_error is not None
            comparison = "above" if bound.delay_error > study.error_bound else "no less than"
            found.append(
                f"infeasible: the delay adds {number(bound.delay_error, study.error_bound)}, "
                f"{comparison} error_bound"
                if name != "printed"
                else "infeasible"
            )
    return found


class _Condition(NamedTuple):
    asks: str
    met: bool | None
    figure: float | None
    what: str  # the figure is
    remark: str
    shown: str  # figure and remark in a few words


def conditions_table(study: Study) -> Table:
    """The seven conditions of Theorem 3, each with its verdict and a figure."""
    rows = [
        _condition_1(study.observability),
        _condition_2(study),
        _condition_3(study),
        _condition_4(study),
        _condition_5(study),
        _condition_6(study),
        _condition_7(study),
    ]
    columns: dict[str, list[Any]] = {
        "condition": list(range(1, 8)),
        "asks": [row.asks for row in rows],
        "met": [row.met for row in rows],
        "figure": [row.figure for row in rows],
        "figure_is": [row.what for row in rows],
        "remark": [row.remark for row in rows],
    }
    return Table(
        columns,
        {
            "condition": [f"{i} {row.asks}" for i, row in enumerate(rows, start=1)],
            "met": [{True: "yes", False: "no", None: "unknown"}[met] for met in columns["met"]],
            "by": [row.shown for row in rows],
        },
    )


def _condition_1(told: JointObservability) -> _Condition:
    remarks = []
    if told.same_covariances:
        remarks.append(f"Lemma 2 fails: {pairs(told.same_covariances)} never differ")
    elif told.covariance_steps is None:
        remarks.append("Lemma 2 fails: some state never shows")
    else:
        remarks.append(f"Lemma 2 holds after {told.covariance_steps} outputs")
    if told.unseen_switches:
        remarks.append(
            f"Lemma 3 fails: the output at a switch of {pairs(told.unseen_switches)} "
            "has one covariance before and after"
        )
    else:
        remarks.append("Lemma 3 holds")
    if told.joint_index is None:
        remarks.append("noise apart, there is no joint observability index")
    else:
        remarks.append(f"noise apart, the joint observability index is {told.joint_index}")
    steps = told.covariance_steps
    first = "Lemma 2 fails" if steps is None else f"Lemma 2 after {steps} {plural('output', steps)}"
    return _Condition(
        "modes told apart",
        told.met,
        math.inf if steps is None else float(steps),
        "outputs, Lemma 2",
        "; ".join(remarks),
        f"{first}, Lemma 3 {'fails' if told.unseen_switches else 'holds'}",
    )


def _condition_2(study: Study) -> _Condition:
    lost = [one.mode for one in study.filters if not one.observable]
    remark = f"not of {listed(lost)}, but detectable, which Theorem 2 asks" if lost else ""
    return _Condition(
        "{A, C} observable",
        not lost,
        float(len(lost)),
        "modes that aren't",
        remark,
        f"not of {listed(lost)}" if lost else "all modes",
    )


def _condition_3(study: Study) -> _Condition:
    lost = [one.mode for one in study.filters if not one.controllable]
    remark = f"not of {listed(lost)}, but on the unit circle, which Theorem 2 asks" if lost else ""
    return _Condition(
        "{A, Q^1/2} controllable",
        not lost,
        float(len(lost)),
        "modes that aren't",
        remark,
        f"not of {listed(lost)}" if lost else "all modes",
    )


def _condition_4(study: Study) -> _Condition:
    repeated = [
        name for name, one in zip(study.names, study.structures, strict=True) if not one.distinct
    ]
    blocks = {
        name: one.largest_block
        for name, one in zip(study.names, study.structures, strict=True)
        if one.largest_block > 1
    }
    alpha = max(one.rate for one in study.structures)
    remark, shown = "all are stable", f"alpha at most {number(alpha, 1.0)}"
    if repeated:
        remark += f"; eigenvalues repeat in {listed(repeated)}"
        remark += (
            f", with Jordan blocks of {listed([f'{m} in {name}' for name, m in blocks.items()])}"
            if blocks
            else ", with eigenvectors enough, so eq. 29 holds all the same"
        )
        shown += f"; repeated eigenvalues in {listed(repeated)}"
    return _Condition("F stable, distinct", not repeated, alpha, "largest alpha", remark, shown)


def _condition_5(study: Study) -> _Condition:
    bound = study.disturbance
    if bound.infinity is None:
        return _Condition(
            "bound U",
            None,
            None,
            "U",
            "the states that count have no known bound; add state_bound under analyses.sojourn",
            "no bound of a state that counts",
        )
    assert bound.printed is not None
    if bound.printed == 0.0 and bound.infinity == 0.0:
        remark = "the modes differ in noise alone, if at all: a wrong filter adds no error"
        return _Condition("bound U", True, 0.0, "U, infinity norm", remark, "0")
    remark = f"as printed, by the 1-norm, {number(bound.printed)}, which is no bound in general"
    if bound.euclidean is not None:
        remark += f"; of the 2-norm {number(bound.euclidean)}"
    shown = f"{number(bound.infinity)}, infinity norm"
    return _Condition("bound U", True, bound.infinity, "U, infinity norm", remark, shown)


def _condition_6(study: Study) -> _Condition:
    """Eq. 39, Delta <= M0 / (sqrt(n) U max k), with the U that is a bound."""
    n, delay = study.model.initial_mean.size, study.delay_steps

    def allowed(disturbance: float | None) -> float | None:
        if disturbance is None:
            return None
        k = max(one.condition_number for one in study.structures)
        each = math.sqrt(n) * disturbance * k
        return study.error_bound / each if each > 0 else math.inf

    corrected, printed = allowed(study.disturbance.infinity), allowed(study.disturbance.printed)
    remark = "" if printed is None else f"as printed, {_cell(printed, 'any number of')} steps"
    met = True if delay == 0 else None if corrected is None else delay <= corrected
    shown = f"{delay} {plural('step', delay)}"
    if delay and corrected is not None:
        shown += f", eq. 39 allows {_cell(corrected, 'any', delay)}"
    elif delay:
        shown += ", and U isn't known"
    return _Condition("delay short enough", met, corrected, "largest delay, steps", remark, shown)


def _condition_7(study: Study) -> _Condition:
    """Judged by the flight's stays, where it has any that end; else by those of the chain."""
    sojourn, asks, what = study.direct_sojourn, "sojourn long enough", "steps, direct"
    if not math.isfinite(sojourn):
        return _Condition(asks, False, sojourn, what, "infeasible", "no sojourn is")
    if len(study.names) == 1:
        return _Condition(asks, True, sojourn, what, "nothing switches", "nothing switches")
    asked = f"{sojourn:.0f} {plural('step', sojourn)}"
    short = study.too_short_probability
    worst = int(np.argmax(short))
    by_chain = (
        f"by the transition matrix {short[worst]:.3g} of the stays in {study.names[worst]} are "
        "shorter"
    )
    if study.flown is None:
        return _Condition(
            asks,
            bool(short[worst] == 0.0),
            sojourn,
            what,
            f"judged by the modes' chain: {by_chain}",
            f"{asked}; {100 * short[worst]:.3g} % of the chain's are less"
            if short[worst] > 0.0
            else f"{asked}; none of the chain's is less",
        )
    mode, steps = study.flown
    return _Condition(
        asks,
        steps >= sojourn,
        sojourn,
        what,
        f"judged by the flight, whose shortest stay, in {mode}, lasts {steps} steps; {by_chain}",
        f"{asked}; the flight's last {steps} or more",
    )


def modes_table(study: Study) -> Table:
    """What each mode's filter has of its own."""
    structures, filters = study.structures, study.filters
    stay = np.diagonal(study.model.transition_matrix[0])
    columns: dict[str, Sequence[Any]] = {
        "mode": list(study.names),
        "alpha": [one.rate for one in structures],
        "condition_number": [one.condition_number for one in structures],
        "largest_jordan_block": [one.largest_block for one in structures],
        "distinct_eigenvalues": [one.distinct for one in structures],
        "observable": [one.observable for one in filters],
        "controllable": [one.controllable for one in filters],
        "decay_steps_as_printed": [steps_until_below(one) for one in structures],
        "decay_steps_rate_correct": [steps_until_below(one, study.rate) for one in structures],
        "decay_steps_direct": [float(steps) for steps in study.direct.decay_by_mode],
        "growth": list(study.direct.growth),
        "mean_sojourn_steps": [1.0 / (1.0 - p) if p < 1.0 else math.inf for p in stay.tolist()],
        "too_short_probability": study.too_short_probability.tolist(),
    }
    return Table(
        columns,
        {
            "mode": list(study.names),
            "alpha": _cells(columns["alpha"], "never", 1.0),
            "k": _cells(columns["condition_number"]),
            "decay\nsteps": _cells(columns["decay_steps_direct"]),
            "growth": _cells(columns["growth"], "never", 1.0),
            "mean stay\nsteps": _cells(columns["mean_sojourn_steps"]),
            "too\nshort": _cells(columns["too_short_probability"]),
        },
    )


def simulation_table(study: Study) -> Table:
    """One row per smallest sojourn that was simulated."""
    sojourns = [sojourn for sojourn, _ in study.simulated]
    runs = [found for _, found in study.simulated]
    columns: dict[str, Sequence[Any]] = {
        "sojourn_steps": sojourns,
        "sojourn_s": [sojourn * study.step_s for sojourn in sojourns],
        "violated_at_switches": [one.at_switches for one in runs],
        "violated_between": [one.between for one in runs],
        "envelope_violated": [one.over_envelope for one in runs],
        "largest_ratio": [one.largest_ratio for one in runs],
    }
    return Table(
        columns,
        {
            "sojourn of at\nleast, steps": [str(sojourn) for sojourn in sojourns],
            "over mu^t\nat switches": _percent(columns["violated_at_switches"]),
            "over it\nanywhere": _percent(columns["violated_between"]),
            "over the\nenvelope": _percent(columns["envelope_violated"]),
            "largest\nratio": _cells(columns["largest_ratio"]),
        },
    )


def _cell(value: float | None, never: str = "never", *others: float) -> str:
    if value is None:
        return "-"
    return number(value, *others) if math.isfinite(value) else never if value > 0 else "none"


def _cells(values: Sequence[float | None], never: str = "never", *others: float) -> list[str]:
    return [_cell(value, never, *others) for value in values]


def _percent(values: Sequence[float]) -> list[str]:
    return [f"{100.0 * value:.3g} %" for value in values]
