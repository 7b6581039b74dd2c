"""How many linear models a nonlinear scenario needs for a wanted bound, and where they stand.

Otanez, Campbell 2004, section III-B: the bound that noise alone leaves, then 1, 2, ... operating
points at the places of the smallest largest linearisation error, until the steady ellipsoid is
within what is wanted. In one state the placement is the global optimum; in several it is the best
that restarts find. Beside it, what local solvers make of the same problem.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from hybridtrack.analyses import Analysis, Findings, Measured, Table
from hybridtrack.analyses import _operating_charts as charts
from hybridtrack.analyses._local_starts import WITHIN_PERCENT, LocalStarts, local_starts
from hybridtrack.analyses._objective import SOLVERS
from hybridtrack.analyses._operating_words import conclusions, notes, shown
from hybridtrack.analyses._placement import Placement
from hybridtrack.analyses._procedure import Procedure, Range, Step, System
from hybridtrack.analyses._steady_ellipsoids import NAMES, Steady
from hybridtrack.description import Experiment
from hybridtrack.errors import UserError
from hybridtrack.expressions import number
from hybridtrack.models import Array

MOST_STATES = 3  # that points are placed in
WITHOUT, OPTIMAL = "without remainder", "optimal"
HALF = 10.0  # per cent of the optimum that the paper counts starts within


class Settings(NamedTuple):
    """range: low and high by state; wanted: the largest half-width by state; both in its unit.

    weights: of components of the dynamics (by state) or of the measurement ("measured NAME"), to
    compare errors of unlike units. placements: points by a name, to be compared: a number each, or
    a list where several states vary. least_points: how many are tried although fewer would do.
    starts: of the local solvers (0: none), with starts_points points.
    """

    range: dict[str, list[float]] | None = None
    wanted: dict[str, float] | None = None
    remainder: Literal["exact", "printed_eq40"] = "exact"
    rule: Literal[
        "trace_trace",
        "trace_sqrt",
        "determinant_determinant",
        "trace_determinant",
        "best_constants",
    ] = "trace_trace"
    weights: dict[str, float] | None = None
    placements: dict[str, list[float | list[float]]] | None = None
    least_points: int = 3
    most_points: int = 6
    starts: int = 1000
    starts_points: int = 3


def _analyse(experiment: Experiment, settings: Settings, measured: Measured | None) -> Findings:
    return findings(experiment.name, system_of(experiment), settings, experiment.seed)


def system_of(experiment: Experiment) -> System:
    """The scenario's nonlinear model, as expressions. Raises UserError where it has none."""
    model = experiment.nonlinear
    if model is None:
        raise UserError(
            f"{experiment.name}: its models are linear, and have no operating points; give it "
            "'dynamics', as switched_esmf has"
        )
    dynamics, measurement = model.dynamics, model.measurement
    inputs: dict[Any, Any] = {}
    names = experiment.resolved.get("inputs", {})
    for i, (name, values) in enumerate(zip(names, model.inputs.T, strict=True)):
        for map_ in (dynamics, measurement):
            if np.ptp(values) and any(one.has(map_.inputs[i]) for one in map_.gradient):
                raise UserError(
                    f"{experiment.name}: the input {name} changes over time and the linear models "
                    "with it, so that nothing is steady; give it one number"
                )
            inputs[map_.inputs[i]] = number(float(values[0]))
    return System(
        state_names=model.state_names,
        measurement_names=model.measurement_names,
        symbols=dynamics.states,
        dynamics=tuple(one.subs(inputs) for one in dynamics.expressions),
        measurement=tuple(one.subs(inputs) for one in measurement.expressions),
        process_noise=model.process_noise_shape,
        measurement_noise=model.measurement_noise_shape,
    )


def findings(name: str, system: System, settings: Settings, seed: int) -> Findings:
    """All of it for a system; `name` is what complaints begin with. Raises UserError."""
    weights = _weights(name, system, settings)
    procedure = Procedure(system, settings.remainder, weights, seed)
    over = _range(name, procedure, settings)
    wanted = _wanted(name, system, settings)
    state = next(iter(wanted), system.state_names.index(procedure.function.states[0]))
    smallest = _smallest(name, procedure, over, settings.rule, state, wanted)
    least = max(settings.least_points, settings.starts_points if settings.starts else 1)
    most = max(settings.most_points, least)
    steps = list(procedure.steps(over, settings.rule, wanted, least, most))
    given = [
        procedure.step(over, label, procedure.given(over, points), settings.rule, state)
        for label, points in _placements(name, over, settings).items()
    ]
    met = [procedure.meets(step, settings.rule, wanted) for step in steps] if wanted else []
    needed = met.index(True) + 1 if True in met else None
    study: list[LocalStarts] = []
    if settings.starts:
        count = settings.starts_points
        study = local_starts(
            procedure.function, settings.remainder, *over, count, settings.starts, seed
        )
    rows = [_row(procedure, over, WITHOUT, None, smallest, state)]
    for step in (*steps, *given):
        row = _row(procedure, over, step.name, step, step.steady, state)
        if wanted:
            row["meets_wanted"] = procedure.meets(step, settings.rule, wanted)
        if step.name == OPTIMAL and len(step.placement.points) == settings.starts_points:
            for one in study:
                row[f"share_within_10_percent_{one.solver}"] = one.share_within(
                    HALF, step.placement.worst_error
                )
        rows.append(row)
    for row in rows:
        row["points_needed"] = needed
    if wanted:
        rows[0]["meets_wanted"] = True
    said = Said(procedure, over, wanted, state, steps, given, study, needed, settings)
    return Findings(
        table=_table(rows, _columns(procedure, said))._replace(shown=shown(said, rows)),
        conclusions=conclusions(said, rows),
        notes=notes(said),
        tables={
            "rules": _rules(said, smallest),
            "points": _points(said),
            "local_starts": _ends(said),
            "shares": _shares(said),
        },
        charts=charts.charts(said),
    )


class Said(NamedTuple):
    """All that tables, sentences and figures are made of."""

    procedure: Procedure
    over: Range
    wanted: Mapping[int, float]  # by state
    state: int  # whose bound is told
    steps: Sequence[Step]  # with 1, 2, ... points
    given: Sequence[Step]
    study: Sequence[LocalStarts]
    needed: int | None  # the fewest points that meet what is wanted
    settings: Settings

    @property
    def state_name(self) -> str:
        """The state whose bound is told."""
        return self.procedure.system.state_names[self.state]


# ---- what is asked, checked ------------------------------------------------------------------


def _range(name: str, procedure: Procedure, settings: Settings) -> Range:
    states = procedure.function.states
    if not states:
        raise UserError(
            f"{name}: its dynamics are linear, so a linear model leaves no remainder wherever it "
            "is placed; there is nothing to analyse here"
        )
    if len(states) > MOST_STATES:
        raise UserError(
            f"{name}: the linearisation error depends on {len(states)} states "
            f"({', '.join(states)}), and points are placed in {MOST_STATES} at most; make some of "
            "them constants"
        )
    given = settings.range or {}
    example = ", ".join(f"{state}: [low, high]" for state in states if state not in given)
    for state in given:
        if state not in procedure.system.state_names:
            raise UserError(f"{name}: 'range' has '{state}', which is no state; {_those(procedure)}")
        if state not in states:
            raise UserError(
                f"{name}: 'range' has '{state}', along which a linear model leaves no remainder; "
                f"remove it, the remainder depends on {' and '.join(states)}"
            )
    if example:
        raise UserError(
            f"{name}: the range of {' and '.join(s for s in states if s not in given)} is not "
            f"bounded; add analyses: {{operating_points: {{range: {{{example}}}}}}}"
        )
    for state in states:
        ends = given[state]
        if len(ends) != 2 or not all(map(math.isfinite, ends)) or not ends[0] < ends[1]:
            raise UserError(
                f"{name}: the range of {state} is {ends}; give two finite numbers, the lower first"
            )
    low, high = (np.array([given[state][i] for state in states], dtype=float) for i in (0, 1))
    over = Range(low, high)
    place = procedure.not_finite(over)
    if place is not None:
        where = ", ".join(f"{s} = {v:.6g}" for s, v in zip(states, place, strict=True))
        raise UserError(
            f"{name}: the dynamics, or their derivatives, have no value at {where}; choose a range "
            "without it"
        )
    if not procedure.largest_curvature(over) > 0.0:
        raise UserError(
            f"{name}: over this range the dynamics are linear, so there is no remainder; widen it"
        )
    return over


def _those(procedure: Procedure) -> str:
    return f"the remainder depends on {' and '.join(procedure.function.states)}"


def _weights(name: str, system: System, settings: Settings) -> dict[str, float]:
    weights = settings.weights or {}
    for component, weight in weights.items():
        if component not in system.component_names:
            raise UserError(
                f"{name}: 'weights' has '{component}', which is no component; there are "
                f"{', '.join(system.component_names)}"
            )
        if not 0.0 < weight < math.inf:
            raise UserError(
                f"{name}: the weight of {component} is {weight:g}; give a positive number"
            )
    return weights


def _wanted(name: str, system: System, settings: Settings) -> dict[int, float]:
    wanted = {}
    for state, bound in (settings.wanted or {}).items():
        if state not in system.state_names:
            raise UserError(
                f"{name}: 'wanted' has '{state}', which is no state; there are "
                f"{', '.join(system.state_names)}"
            )
        if not 0.0 < bound < math.inf:
            raise UserError(
                f"{name}: the bound wanted of {state} is {bound:g}; give a positive number"
            )
        wanted[system.state_names.index(state)] = bound
    return wanted


def _smallest(
    name: str,
    procedure: Procedure,
    over: Range,
    rule: str,
    state: int,
    wanted: Mapping[int, float],
) -> Steady:
    """Step 1, and whether what is wanted can be had at all."""
    found = procedure.smallest(over, rule, state)
    if found is None:
        raise UserError(
            f"{name}: without any remainder the ellipsoid has no steady state by the rule {rule} "
            "(a part of the state that doesn't decay is not seen in the measurements); choose "
            "another rule or measurement"
        )
    for j, bound in wanted.items():
        own = procedure.smallest(over, rule, j)
        least = math.inf if own is None else float(own.half_widths[j])
        if bound < least:
            raise UserError(
                f"{name}: {procedure.system.state_names[j]} is wanted within {bound:g}, and the "
                f"noise alone leaves {least:.4g} in steady state, however many points there are; "
                f"want at least that, or another rule than {rule}"
            )
    return found


def _placements(name: str, over: Range, settings: Settings) -> dict[str, Array]:
    found, d = {}, len(over.low)
    for label, listed in (settings.placements or {}).items():
        if label in (WITHOUT, OPTIMAL):
            raise UserError(f"{name}: a placement can't be called '{label}'; rename it")
        points = [point if isinstance(point, list) else [point] for point in listed]
        if not points or any(len(point) != d for point in points):
            raise UserError(
                f"{name}: the placement '{label}' needs {d} number{'s' * (d > 1)} for each of its "
                "points; correct it"
            )
        array = np.array(points, dtype=float)
        if not ((array >= over.low) & (array <= over.high)).all():
            raise UserError(
                f"{name}: the placement '{label}' has a point outside the range; move it, or widen "
                "'range'"
            )
        found[label] = array
    return found


# ---- tables ----------------------------------------------------------------------------------


def _row(
    procedure: Procedure,
    over: Range,
    label: str,
    step: Step | None,
    settled: Steady | None,
    state: int,
) -> dict[str, Any]:
    """A row of the main table; step None: without remainder."""
    row: dict[str, Any] = {"placement": label, "points": 0}
    names = procedure.system.state_names
    if step is None:
        row |= {"worst_error": 0.0, "normalised_error": 0.0}
        banks = {rule: procedure.smallest(over, rule, state) for rule in NAMES}
    else:
        placement = step.placement
        row |= _of_placement(procedure, over, placement)
        banks = {
            rule: procedure.bank(placement.points, step.radius, rule, state) for rule in NAMES
        }
    for j, name in enumerate(names):
        row[f"bound_{name}"] = None if settled is None else float(settled.half_widths[j])
    for rule, bank in banks.items():
        row[f"bound_{names[state]}_{rule}"] = (
            None if bank is None else float(bank.half_widths[state])
        )
    return row


def _of_placement(procedure: Procedure, over: Range, placement: Placement) -> dict[str, Any]:
    known = not math.isnan(placement.no_less_than)
    row: dict[str, Any] = {
        "points": len(placement.points),
        "worst_error": placement.worst_error,
        "normalised_error": procedure.normalised(over, placement.worst_error),
        "no_less_than": placement.no_less_than if known else None,
        "certificate": placement.certificate or None,
        "doubt": placement.doubt or None,
    }
    for i, point in enumerate(placement.points):
        for state, value in zip(procedure.function.states, point, strict=True):
            row[f"{state}_{i + 1}"] = float(value)
    return row


def _columns(procedure: Procedure, said: Said) -> list[str]:
    """The order of the main table's columns; each is there whether or not a row has it."""
    names = procedure.system.state_names
    most = max(len(step.placement.points) for step in (*said.steps, *said.given))
    return [
        *("placement", "points", "worst_error", "normalised_error", "no_less_than"),
        *("certificate", "doubt"),
        *(f"{state}_{i + 1}" for i in range(most) for state in procedure.function.states),
        *(f"bound_{name}" for name in names),
        *(f"bound_{names[said.state]}_{rule}" for rule in NAMES),
        *("meets_wanted", "points_needed"),
        *(f"share_within_10_percent_{solver}" for solver in SOLVERS),
    ]


def _table(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Table:
    return Table({name: [row.get(name) for row in rows] for name in names})


def _rules(said: Said, smallest: Steady) -> Table:
    """Every rule's steady ellipsoid for every placement, of the widest model."""
    procedure, rows = said.procedure, []
    names = procedure.system.state_names
    for rule in NAMES:
        banks = [(WITHOUT, 0, procedure.smallest(said.over, rule, said.state))]
        for step in (*said.steps, *said.given):
            bank = procedure.bank(step.placement.points, step.radius, rule, said.state)
            banks.append((step.name, len(step.placement.points), bank))
        for label, count, bank in banks:
            row = {"rule": rule, "placement": label, "points": count}
            row |= {"beta": None, "rho": None} if bank is None else bank.weights
            for j, name in enumerate(names):
                row[f"bound_{name}"] = None if bank is None else float(bank.half_widths[j])
            rows.append(row)
    return _table(rows, list(rows[0]))


def _points(said: Said) -> Table:
    rows = []
    for step in (*said.steps, *said.given):
        for i, point in enumerate(step.placement.points):
            row = {"placement": step.name, "points": len(step.placement.points), "point": i + 1}
            states = said.procedure.function.states
            rows.append(row | dict(zip(states, map(float, point), strict=True)))
    return _table(rows, list(rows[0]))


def _ends(said: Said) -> Table:
    """Figure 2: where every solver ends from every start."""
    scale = said.procedure.largest_curvature(said.over)
    rows = [
        {
            "solver": one.solver,
            "start": i + 1,
            "worst_error": float(error),
            "normalised_error": float(error) / scale,
        }
        for one in said.study
        for i, error in enumerate(one.worst_errors)
    ]
    return _table(rows, ("solver", "start", "worst_error", "normalised_error"))


def _shares(said: Said) -> Table:
    """Figure 3: the share of starts within a percentage of the optimum."""
    rows = []
    for one in said.study:
        optimum = said.steps[said.settings.starts_points - 1].placement.worst_error
        for percent in WITHIN_PERCENT:
            share = one.share_within(percent, optimum)
            rows.append({"solver": one.solver, "within_percent": percent, "share_of_starts": share})
    return _table(rows, ("solver", "within_percent", "share_of_starts"))


ANALYSIS = Analysis(
    name="operating-points",
    summary="how many linear models a wanted bound needs, and where to linearise",
    source="Otanez, Campbell 2004, sections III-B and IV",
    settings=Settings,
    analyse=_analyse,
    example="switched_esmf",
    limits={
        "least_points": (1, 12),
        "most_points": (1, 12),
        "starts": (0, 100_000),
        "starts_points": (1, 12),
    },
)
