"""The tables of the analysis of operating points."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from hybridtrack.analyses import Table
from hybridtrack.analyses._local_starts import WITHIN_PERCENT
from hybridtrack.analyses._objective import SOLVERS
from hybridtrack.analyses._operating_design import RESERVED, WITHOUT, Design
from hybridtrack.analyses._procedure import Procedure, Range, Step
from hybridtrack.analyses._steady_ellipsoids import NAMES
from hybridtrack.analyses._worst_errors import Placement

MOST_DECIMALS = 5


def row_of(
    procedure: Procedure,
    over: Range,
    label: str,
    step: Step | None,
    rule: str,
    state: int,
) -> dict[str, Any]:
    """A row of the main table; step None: without remainder.

    Each state's bound is that of the model with the widest one on it.
    """

    def bank(by: str, of: int) -> float | None:
        if step is None:
            found = procedure.smallest(over, by, of)
        else:
            found = procedure.bank(step.placement.points, step.radius, by, of)
        return None if found is None else float(found.half_widths[of])

    row: dict[str, Any] = {"placement": label, "points": 0}
    names = procedure.system.state_names
    if step is None:
        row |= {"worst_error": 0.0, "normalised_error": 0.0}
    else:
        row |= _of_placement(procedure, over, step.placement)
    row |= {f"bound_{name}": bank(rule, j) for j, name in enumerate(names)}
    return row | {f"bound_{names[state]}_{by}": bank(by, state) for by in NAMES}


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


def columns(procedure: Procedure, design: Design) -> list[str]:
    """The order of the main table's columns; each is there whether or not a row has it."""
    names = procedure.system.state_names
    most = max(len(step.placement.points) for step in (*design.steps, *design.given))
    return [
        *("placement", "points", "worst_error", "normalised_error", "no_less_than"),
        *("certificate", "doubt"),
        *(f"{state}_{i + 1}" for i in range(most) for state in procedure.function.states),
        *(f"bound_{name}" for name in names),
        *(f"bound_{names[design.state]}_{rule}" for rule in NAMES),
        *("meets_wanted", "points_needed"),
        *(f"share_within_10_percent_{solver}" for solver in SOLVERS),
    ]


def table_of(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Table:
    return Table({name: [row.get(name) for row in rows] for name in names})


def rules(design: Design) -> Table:
    """Every rule's steady ellipsoid for every placement, of the widest model."""
    procedure, rows = design.procedure, []
    names = procedure.system.state_names
    for rule in NAMES:
        banks = [(WITHOUT, 0, procedure.smallest(design.over, rule, design.state))]
        for step in (*design.steps, *design.given):
            bank = procedure.bank(step.placement.points, step.radius, rule, design.state)
            banks.append((step.name, len(step.placement.points), bank))
        for label, count, bank in banks:
            row = {"rule": rule, "placement": label, "points": count}
            row |= {"beta": None, "rho": None} if bank is None else bank.weights
            for j, name in enumerate(names):
                row[f"bound_{name}"] = None if bank is None else float(bank.half_widths[j])
            rows.append(row)
    return table_of(rows, list(rows[0]))


def points(design: Design) -> Table:
    rows = []
    for step in (*design.steps, *design.given):
        for i, point in enumerate(step.placement.points):
            row = {"placement": step.name, "points": len(step.placement.points), "point": i + 1}
            states = design.procedure.function.states
            rows.append(row | dict(zip(states, map(float, point), strict=True)))
    table = table_of(rows, list(rows[0]))
    states = design.procedure.function.states
    return table if len(states) == 1 else table._replace(shown=_coordinates(design, rows))


def _coordinates(design: Design, rows: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Where the points stand, as a terminal shows it; in one state the main table has it."""
    low, high = design.over
    cells = {
        "points": [named(row["placement"], row["points"]) for row in rows],
        "point": [str(row["point"]) for row in rows],
    }
    for i, state in enumerate(design.procedure.function.states):
        width = float(high[i] - low[i])
        cells[state] = [place(row[state], width) for row in rows]
    return cells


def named(label: str, count: int) -> str:
    """A placement in a terminal's first column."""
    if not count:
        return "noise alone"
    return str(count) if label in RESERVED else f"{count}: {label}"


def place(value: float, width: float) -> str:
    """To about four digits of the range's width; no minus before what rounds to 0."""
    decimals = 3 - math.floor(math.log10(width))
    rounded = round(value, decimals) + 0.0
    if 0 <= decimals <= MOST_DECIMALS:
        return f"{rounded:.{decimals}f}"
    return f"{rounded:.4g}"


def ends(design: Design) -> Table:
    """Figure 2: where every solver ends from every start."""
    scale = design.procedure.largest_curvature(design.over)
    rows = [
        {
            "solver": one.solver,
            "start": i + 1,
            "worst_error": float(error),
            "normalised_error": float(error) / scale,
        }
        for one in design.study
        for i, error in enumerate(one.worst_errors)
    ]
    return table_of(rows, ("solver", "start", "worst_error", "normalised_error"))


def shares(design: Design) -> Table:
    """Figure 3: the share of starts within a percentage of the optimum."""
    rows = []
    for one in design.study:
        optimum = design.studied
        for percent in WITHIN_PERCENT:
            share = one.share_within(percent, optimum)
            rows.append({"solver": one.solver, "within_percent": percent, "share_of_starts": share})
    return table_of(rows, ("solver", "within_percent", "share_of_starts"))
