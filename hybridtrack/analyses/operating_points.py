"""How many linear models a nonlinear scenario needs for a wanted bound, and where they stand.

Otanez, Campbell 2004, section III-B: the bound that noise alone leaves, then 1, 2, ... operating
points at the places of the smallest largest linearisation error, until the steady ellipsoid is
within what is wanted. In one state the placement is the global optimum where the curvature
keeps its sign; elsewhere, and in several states, the best found, with a lower bound. Beside it,
what local solvers make of the same problem.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from hybridtrack.analyses import Analysis, Findings, Measured
from hybridtrack.analyses._linearisation import lattice
from hybridtrack.analyses._local_starts import LocalStarts, local_starts
from hybridtrack.analyses._operating_charts import charts
from hybridtrack.analyses._operating_design import (
    PAPER,
    RESERVED,
    STARTS,
    STARTS_OF_SEVERAL,
    TEN,
    WITHOUT,
    Design,
    Settings,
    coarse,
)
from hybridtrack.analyses._operating_tables import (
    columns,
    ends,
    points,
    row_of,
    rules,
    shares,
    table_of,
)
from hybridtrack.analyses._operating_words import conclusions, notes, shown
from hybridtrack.analyses._procedure import TRIED, Procedure, Range, Step, System
from hybridtrack.analyses._worst_errors import worst_error
from hybridtrack.description import Experiment
from hybridtrack.errors import Unsuited
from hybridtrack.expressions import number
from hybridtrack.models import Array

MOST_STATES = 3  # that points are placed in
BEYOND = 1e3  # times what the curvature that was seen allows an error


def _analyse(experiment: Experiment, settings: Settings, measured: Measured | None) -> Findings:
    return findings(system_of(experiment), settings, experiment.seed, PAPER in experiment.source)


def system_of(experiment: Experiment) -> System:
    """The scenario's nonlinear model, as expressions. Raises Unsuited where it has none."""
    model = experiment.nonlinear
    if model is None:
        raise Unsuited(
            "its models are linear, and have no operating points; give it "
            "'dynamics', as switched_esmf has",
            "modes",
        )
    dynamics, measurement = model.dynamics, model.measurement
    inputs: dict[Any, Any] = {}
    names = experiment.resolved.get("inputs", {})
    for i, (name, values) in enumerate(zip(names, model.inputs.T, strict=True)):
        for map_ in (dynamics, measurement):
            if np.ptp(values) and any(one.has(map_.inputs[i]) for one in map_.gradient):
                raise Unsuited(
                    f"the input {name} changes over time and the linear models "
                    "with it, so that nothing is steady; give it one number",
                    "inputs",
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
        units=experiment.units,
    )


def findings(system: System, settings: Settings, seed: int, of_paper: bool = False) -> Findings:
    """All of it for a system; of_paper: whose equations notes may name. Raises Unsuited."""
    weights = _weights(system, settings)
    procedure = Procedure(system, settings.remainder, weights, seed)
    over = _range(procedure, settings)
    if settings.starts is None:
        several = len(over.low) > 1
        settings = settings._replace(starts=STARTS_OF_SEVERAL if several else STARTS)
    wanted = _wanted(system, settings)
    state = next(iter(wanted), system.state_names.index(procedure.function.states[0]))
    _refuse_unattainable(procedure, over, settings.rule, state, wanted)
    most = settings.most_points
    settings = settings._replace(starts_points=min(settings.starts_points, most))
    least = max(settings.least_points, settings.starts_points if settings.starts else 1)
    study: list[LocalStarts] = []
    if settings.starts:
        count = settings.starts_points
        study = local_starts(
            procedure.function, settings.remainder, *over, count, settings.starts, seed
        )
    placements = _placements(over, settings)
    others = [*placements.values(), *(one.points[one.worst_errors.argmin()] for one in study)]
    steps = []
    for step in procedure.steps(over, settings.rule, wanted, least, most, others):
        _refuse_pole(procedure, over, step)
        steps.append(step)
    given = [
        procedure.step(over, label, procedure.given(over, points), settings.rule, state)
        for label, points in placements.items()
    ]
    for step in given:
        _refuse_pole(procedure, over, step)
    met = [procedure.meets(step, settings.rule, wanted) for step in steps] if wanted else []
    needed = met.index(True) + 1 if True in met else None
    rows = [row_of(procedure, over, WITHOUT, None, settings.rule, state)]
    for step in (*steps, *given):
        row = row_of(procedure, over, step.name, step, settings.rule, state)
        if wanted:
            row["meets_wanted"] = procedure.meets(step, settings.rule, wanted)
        if step.name in RESERVED and len(step.placement.points) == settings.starts_points:
            for one in study:
                share = one.share_within(TEN, step.placement.worst_error)
                row[f"share_within_10_percent_{one.solver}"] = coarse(share)
        rows.append(row)
    for row in rows:
        row["points_needed"] = needed
    if wanted:
        rows[0]["meets_wanted"] = True
    design = Design(procedure, over, wanted, state, steps, given, study, needed, settings, of_paper)
    return Findings(
        table=table_of(rows, columns(procedure, design))._replace(shown=shown(design, rows)),
        conclusions=conclusions(design, rows),
        notes=notes(design),
        tables={
            "rules": rules(design),
            "points": points(design),
            "local_starts": ends(design),
            "shares": shares(design),
        },
        charts=charts(design),
    )


# ---- what is asked, checked ------------------------------------------------------------------


def _unsuited(key: str, sentence: str) -> Unsuited:
    """What is wrong with a setting."""
    return Unsuited(sentence, "analyses", "operating_points", key)


def _where(states: tuple[str, ...], place: Array) -> str:
    return ", ".join(f"{s} = {v:.4g}" for s, v in zip(states, place, strict=True))


def _range(procedure: Procedure, settings: Settings) -> Range:
    states = procedure.function.states
    if not states:
        raise Unsuited(
            "its dynamics are linear, so a linear model leaves no remainder wherever it "
            "is placed; there is nothing to analyse here",
            "dynamics",
        )
    if len(states) > MOST_STATES:
        raise Unsuited(
            f"the linearisation error depends on {len(states)} states "
            f"({', '.join(states)}), and points are placed in {MOST_STATES} at most; make some of "
            "them constants",
            "dynamics",
        )
    given = settings.range or {}
    example = ", ".join(f"{state}: [low, high]" for state in states if state not in given)
    for state in given:
        if state not in procedure.system.state_names:
            raise _unsuited(
                "range",
                f"'range' has '{state}', which is no state; {_those(procedure)}",
            )
        if state not in states:
            raise _unsuited(
                "range",
                f"'range' has '{state}', along which a linear model leaves no remainder; "
                f"remove it, the remainder depends on {' and '.join(states)}",
            )
    if example:
        raise _unsuited(
            "range",
            f"the range of {' and '.join(s for s in states if s not in given)} is not "
            f"bounded; add analyses: {{operating_points: {{range: {{{example}}}}}}}",
        )
    for state in states:
        ends = given[state]
        if len(ends) != 2 or not all(map(math.isfinite, ends)) or not ends[0] < ends[1]:
            raise _unsuited(
                "range",
                f"the range of {state} is {[*map(float, ends)]}; give two finite numbers, "
                "the lower first",
            )
    low, high = (np.array([given[state][i] for state in states], dtype=float) for i in (0, 1))
    over = Range(low, high)
    place = procedure.not_finite(over)
    if place is not None:
        raise _unsuited(
            "range",
            f"the dynamics, or their derivatives, have no value at {_where(states, place)}; "
            "choose a range without it",
        )
    place = procedure.jump(over)
    if place is not None:
        raise _unsuited(
            "range",
            f"a value jumps at {_where(states, place)} or thereabouts (an angle's cut, a pole of "
            "tan), and no linear model is good on both sides; choose a range on one side of it",
        )
    if not procedure.largest_curvature(over) > 0.0:
        raise _unsuited(
            "range",
            "over this range the dynamics are linear, so there is no remainder; widen it",
        )
    return over


def _refuse_pole(procedure: Procedure, over: Range, step: Step) -> None:
    """Where an error has no bound, between the places that were looked at before."""
    width = float(np.linalg.norm(over.high - over.low))
    most = BEYOND * procedure.largest_curvature(over) * width**2
    if step.placement.worst_error <= most:
        return
    where = ""
    if len(over.low) > 1:
        _, place = worst_error(procedure.function, procedure.kind, *over, step.placement.points)
        where = f" about {_where(procedure.function.states, place)}"
    raise _unsuited(
        "range",
        f"the dynamics, or their derivatives, have no bound{where}; choose a range without it",
    )


def _those(procedure: Procedure) -> str:
    return f"the remainder depends on {' and '.join(procedure.function.states)}"


def _weights(system: System, settings: Settings) -> dict[str, float]:
    weights = settings.weights or {}
    for component, weight in weights.items():
        if component not in system.component_names:
            raise _unsuited(
                "weights",
                f"'weights' has '{component}', which is no component; there are "
                f"{', '.join(system.component_names)}",
            )
        if not 0.0 < weight < math.inf:
            raise _unsuited(
                "weights",
                f"the weight of {component} is {weight:g}; give a positive number",
            )
    return weights


def _wanted(system: System, settings: Settings) -> dict[int, float]:
    wanted = {}
    for state, bound in (settings.wanted or {}).items():
        if state not in system.state_names:
            raise _unsuited(
                "wanted",
                f"'wanted' has '{state}', which is no state; there are "
                f"{', '.join(system.state_names)}",
            )
        if not 0.0 < bound < math.inf:
            raise _unsuited(
                "wanted",
                f"the bound wanted of {state} is {bound:g}; give a positive number",
            )
        wanted[system.state_names.index(state)] = bound
    return wanted


def _refuse_unattainable(
    procedure: Procedure,
    over: Range,
    rule: str,
    state: int,
    wanted: Mapping[int, float],
) -> None:
    """Step 1: where there is nothing steady, or where what is wanted can't be had at all."""
    tried = len(lattice(*over, TRIED))
    if procedure.smallest(over, rule, state) is None:
        raise Unsuited(
            f"without any remainder the ellipsoid has no steady state by the rule {rule} "
            f"at any of {tried} places of the range (a part of the state that doesn't decay is not "
            "measured); choose another rule or measurement",
            "dynamics",
        )
    for j, bound in wanted.items():
        own = procedure.smallest(over, rule, j)
        least = math.inf if own is None else float(own.half_widths[j])
        if bound < least:
            raise _unsuited(
                "wanted",
                f"{procedure.system.state_names[j]} is wanted within {bound:g}, and the "
                f"noise alone leaves {least:.4g} in steady state, however many points there are "
                f"(at the best of {tried} places of the range and of as many about it); want at "
                f"least that, or another rule than {rule}",
            )


def _placements(over: Range, settings: Settings) -> dict[str, Array]:
    found, d = {}, len(over.low)
    for label, listed in (settings.placements or {}).items():
        if label in RESERVED:
            raise _unsuited(
                "placements",
                f"a placement can't be called '{label}'; rename it",
            )
        points = [point if isinstance(point, list) else [point] for point in listed]
        if not points:
            raise _unsuited(
                "placements",
                f"the placement '{label}' has no points; give it some, or remove it",
            )
        if any(len(point) != d for point in points):
            raise _unsuited(
                "placements",
                f"the placement '{label}' needs {d} number{'s' * (d > 1)} for each of its "
                "points; correct it",
            )
        array = np.array(points, dtype=float)
        if not ((array >= over.low) & (array <= over.high)).all():
            raise _unsuited(
                "placements",
                f"the placement '{label}' has a point outside the range; move it, or widen 'range'",
            )
        found[label] = array
    return found


ANALYSIS = Analysis(
    name="operating-points",
    summary="how many linear models a wanted bound needs, and where to linearise",
    source=f"{PAPER}, sections III-B and IV",
    settings=Settings,
    analyse=_analyse,
    example="switched_esmf",
    of_dynamics=True,
    limits={
        "least_points": (1, 12),
        "most_points": (1, 12),
        "starts": (0, 100_000),
        "starts_points": (1, 12),
    },
)
