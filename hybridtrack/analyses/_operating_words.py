"""The analysis of operating points in words: its table, its conclusions, what is wrong in print."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from hybridtrack.analyses._linearisation import PRINTED, lattice
from hybridtrack.analyses._operating_design import PAPER, RESERVED, TEN, Design, coarse
from hybridtrack.analyses._operating_tables import named, place
from hybridtrack.analyses._procedure import TRIED
from hybridtrack.analyses._worst_errors import Placement, checked

Row = Mapping[str, Any]

LOOSE = 0.01  # of an error: a certificate that says little
MOST_SHOWN = 5  # points that a terminal has room for


def shown(design: Design, rows: Sequence[Row]) -> dict[str, list[str]]:
    """What a terminal shows: a line for each placement."""
    all_names = design.procedure.system.state_names
    names = [all_names[j] for j in design.wanted] or [design.state_name]
    states = design.procedure.function.states
    cells = {
        "points": [named(row["placement"], row["points"]) for row in rows],
        f"worst\n{_of('error', design.error_unit)}": [
            _short(row["worst_error"]) if row["points"] else "" for row in rows
        ],
        "norm-\nalised": [_short(row["normalised_error"]) if row["points"] else "" for row in rows],
    }
    if len(states) == 1:
        width = float(design.over.high[0] - design.over.low[0])
        cells[f"at {states[0]} ="] = [_places(row, states[0], width) for row in rows]
    for name in names:
        unit = design.procedure.system.units.get(name, "")
        cells[f"bound\n{_of(name, unit)}"] = [
            _short(row[f"bound_{name}"]) or "none" for row in rows
        ]
    if design.wanted:
        cells["with-\nin"] = [_answer(row) for row in rows]
    return cells


def _of(words: str, unit: str) -> str:
    return f"{words}, {unit}" if unit else words


def _answer(row: Row) -> str:
    return ("yes" if row["meets_wanted"] else "no") if row["points"] else ""


def _places(row: Row, state: str, width: float) -> str:
    values = [row[f"{state}_{i + 1}"] for i in range(row["points"])]
    listed = " ".join(place(value, width) for value in values[:MOST_SHOWN])
    return listed + " ..." * (len(values) > MOST_SHOWN)


def _bound(value: float) -> str:
    return f"{value:.3f}" if 0.1 <= value < 100.0 else f"{value:.4g}"


def share(part: float) -> str:
    """A share of starts to a fifth; 0 and 100 % only where it is none or all of them."""
    if 0.0 < part < 1.0 and coarse(part) in (0.0, 1.0):
        return "under 10 %" if part < 0.5 else "over 90 %"
    return f"{100 * coarse(part):.0f} %"


def _short(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _percent(part: float) -> str:
    """A small part, rounded up to a power of ten."""
    return f"{10.0 ** math.ceil(math.log10(max(100.0 * part, 1e-4))):g} %"


def _count(points: int) -> str:
    return f"{points} point{'s' * (points != 1)}"


# ---- conclusions -----------------------------------------------------------------------------


def conclusions(design: Design, rows: Sequence[Row]) -> list[str]:
    """What a practitioner should conclude, in whole sentences."""
    return [*_how_many(design, rows), *_how_far(design), *_others(design), *_local(design)]


def _how_many(design: Design, rows: Sequence[Row]) -> list[str]:
    name = design.state_name
    alone = rows[0][f"bound_{name}"]
    leave = f"noise alone leaves {_bound(alone)}"
    bounds = {
        row["points"]: row[f"bound_{name}"] for row in rows if row["placement"] in RESERVED[1:]
    }
    most = max(bounds)
    if not design.wanted:
        listed = ", ".join(
            f"{_bound(bound)} with {count}" for count, bound in bounds.items() if bound is not None
        )
        if not listed:
            return [f"With up to {_count(most)} the bound on {name} has no steady state; {leave}."]
        told = {_bound(bound) for bound in bounds.values() if bound is not None}
        if len(told) == 1 and None not in bounds.values() and most > 1:
            return [
                f"The bound on {name} settles at {told.pop()} with 1 to {most} points; {leave}."
            ]
        settled = [count for count, bound in bounds.items() if bound is not None]
        plural = "s" * (settled[-1] != 1)
        return [f"The bound on {name} settles at {listed} point{plural}; {leave}."]
    wanted = " and ".join(
        f"{design.procedure.system.state_names[j]} within {bound:g}"
        for j, bound in design.wanted.items()
    )
    if len(design.wanted) > 1:
        return [_of_several(design, rows, wanted)]
    if design.needed is None:
        last = bounds[most]
        settles = "has no steady state" if last is None else f"settles at {_bound(last)}"
        return [
            f"Even {_count(most)} don't keep {wanted}: with them the bound on {name} {settles}; "
            f"{leave}."
        ]
    few, verb = ("One point", "is") if design.needed == 1 else (_count(design.needed), "are")
    said_first = (
        f"{few} {verb} enough for {wanted}: the bound on {name} "
        f"settles at {_bound(bounds[design.needed])}; {leave}."
    )
    fewer = bounds.get(design.needed - 1)
    if design.needed > 1:
        was = "has none" if fewer is None else f"is {_bound(fewer)}"
        said_first = said_first[:-1] + f", and with one point fewer it {was}."
    return [said_first]


def _of_several(design: Design, rows: Sequence[Row], wanted: str) -> str:
    """How many points keep several bounds, and what they come to."""
    names = [design.procedure.system.state_names[j] for j in design.wanted]
    best = [row for row in rows if row["placement"] in RESERVED[1:]]
    row = best[(design.needed or len(best)) - 1]
    told = [(name, row[f"bound_{name}"]) for name in names]
    settle = ", ".join(
        f"that on {name} {'has no steady state' if bound is None else f'at {_bound(bound)}'}"
        for name, bound in told
    )
    if design.needed is None:
        return f"Even {_count(row['points'])} don't keep {wanted}: the bounds settle, {settle}."
    few, verb = ("One point", "is") if design.needed == 1 else (_count(design.needed), "are")
    return f"{few} {verb} enough for {wanted}: the bounds settle, {settle}."


def _how_far(design: Design) -> list[str]:
    steps = design.steps
    first, last = steps[0].placement, steps[-1].placement
    sentence = f"The worst linearisation error is {first.worst_error:.4g} with one point"
    if len(steps) > 1:
        sentence += f" and {last.worst_error:.4g} with {len(steps)}"
    gaps = [_gap(step.placement) for step in (steps[0], steps[-1])]
    if all(step.placement.certificate for step in steps):
        gap = max(_gap(step.placement) for step in steps)
        if gap > LOOSE:  # a range of so many waves that the cells are too wide
            return [f"{sentence}; other places may be better by up to {_up(gap)} of it."]
        return [f"{sentence}; no other places are better by {_percent(gap)} of it."]
    doubt = next(step.placement.doubt for step in reversed(steps) if step.placement.doubt)
    said_first = f"{sentence}: the best found, not certified ({doubt})."
    if any(map(math.isnan, gaps)):
        return [f"{said_first} How much better other places may be is not known."]
    found = f"by up to {_up(gaps[0])} of it"
    if len(steps) > 1:
        found += f" with one point, {_up(gaps[1])} with {len(steps)}"
    return [f"{said_first} Other places may be better {found} (a bound by linear programming)."]


def _gap(placement: Placement) -> float:
    """The part of a worst error that other places may take away at most; NaN: not known."""
    if not placement.worst_error > 0.0:
        return 0.0
    return max(1.0 - placement.no_less_than / placement.worst_error, 0.0)


def _up(part: float) -> str:
    """Whole per cents, rounded up."""
    return f"{math.ceil(100.0 * part - 1e-9):.0f} %"


def _others(design: Design) -> list[str]:
    parts = []
    for step in design.given:
        count = len(step.placement.points)
        if count <= len(design.steps):
            best = design.steps[count - 1].placement.worst_error
            # of the same points, looked at by another search, rounding is left
            more = max(100.0 * (step.placement.worst_error / best - 1.0), 0.0)
            parts.append(f"'{step.name}' by {more:.0f} %")
    if not parts:
        return []
    return [
        f"The worst error of other placements is above the best of as many: {', '.join(parts)}."
    ]


def _local(design: Design) -> list[str]:
    if not design.study:
        return []
    optimum = design.studied
    shares = ", ".join(
        f"{share(one.share_within(TEN, optimum))} by {one.solver}" for one in design.study
    )
    return [
        f"Of {design.starts:,} random starts, "
        f"with {_count(design.settings.starts_points)}, "
        f"within 10 % of the {design.best} end, to the nearest fifth, {shares}: the solver decides."
    ]


# ---- notes -----------------------------------------------------------------------------------


def notes(design: Design) -> list[str]:
    """What was assumed; of the paper's own scenario also what is wrong in print or left open."""
    found = _of_the_paper(design) if design.of_paper else _of_another(design)
    tried = len(lattice(*design.over, TRIED))
    found.append(
        f"noise alone: linearised where its bound is the smallest, of {tried} places of the range "
        "and, where they differ, of as many about the best"
    )
    if len(design.over.low) > 1:
        found.append(
            f"worst errors are the largest found, of {len(checked(*design.over)):,} places and "
            "between the highest of them; a steeper place may have been missed"
        )
    if len(design.procedure.function.components) > 1 and not design.settings.weights:
        listed = ", ".join(design.procedure.function.components)
        found.append(f"errors of {listed} are compared as they stand; see 'weights'")
    return found


def _of_the_paper(design: Design) -> list[str]:
    errors = (
        "errors as (40) prints them: the curvature at the state and no half, where (31) has it at "
        "the point; neither is a bound at every place, `remainder: exact` is"
        if design.settings.remainder == PRINTED
        else "errors are |f(x) - f(c) - f'(c) (x - c)|; (40) of the paper is no bound of them"
    )
    return [
        errors,
        "normalised: by the largest curvature in the range (T v1 in the paper, which gives .129 so "
        "and .006 as it is)",
        "one model serves all components at a place; (32) lets each take its own, as no bank can",
        "a bank's bound is its widest model's, with the worst error of each component everywhere; "
        "a box of m components takes m r^2, where (22) prints 2",
        f"beta and rho by {design.settings.rule}; the paper names no rule, and what is steady "
        "depends on it (rules.parquet)",
    ]


def _of_another(design: Design) -> list[str]:
    errors = (
        f"errors as {PAPER} prints them, |(x - c)' f''(x) (x - c)|: no bound at every place, "
        "`remainder: exact` is"
        if design.settings.remainder == PRINTED
        else "errors are |f(x) - f(c) - f'(c) (x - c)|"
    )
    return [
        errors,
        "normalised: by the largest curvature in the range",
        "one model serves all components at a place",
        "a bank's bound is its widest model's, with the worst error of each component everywhere",
        f"ellipsoids are weighed by {design.settings.rule}; what is steady depends on the rule "
        "(rules.parquet)",
    ]
