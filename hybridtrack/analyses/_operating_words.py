"""The analysis of operating points in words: its table, its conclusions, what is wrong in print."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hybridtrack.analyses._linearisation import PRINTED

if TYPE_CHECKING:
    from hybridtrack.analyses.operating_points import Said

Row = Mapping[str, Any]

MOST_SHOWN = 5  # points that a terminal has room for


def shown(said: "Said", rows: Sequence[Row]) -> dict[str, list[str]]:
    """What a terminal shows: a line for each placement."""
    name = said.state_name
    states = said.procedure.function.states
    cells = {
        "placed": [row["placement"] for row in rows],
        "points": [str(row["points"]) for row in rows],
        "worst\nerror": [_short(row["worst_error"]) if row["points"] else "" for row in rows],
        "norm-\nalised": [_short(row["normalised_error"]) if row["points"] else "" for row in rows],
    }
    if len(states) == 1:
        cells[f"at {states[0]} ="] = [_places(row, states[0]) for row in rows]
    cells[f"bound\n{name}"] = [_short(row[f"bound_{name}"]) or "none" for row in rows]
    if said.wanted:
        cells["with-\nin"] = ["yes" if row["meets_wanted"] else "no" for row in rows]
    return cells


def _places(row: Row, state: str) -> str:
    values = [row[f"{state}_{i + 1}"] for i in range(row["points"])]
    listed = " ".join(f"{value:.3f}" for value in values[:MOST_SHOWN])
    return listed + " ..." * (len(values) > MOST_SHOWN)


def _short(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _count(points: int) -> str:
    return f"{points} point{'s' * (points != 1)}"


# ---- conclusions -----------------------------------------------------------------------------


def conclusions(said: "Said", rows: Sequence[Row]) -> list[str]:
    """What a practitioner should conclude, in whole sentences."""
    return [*_how_many(said, rows), *_how_far(said), *_others(said), *_local(said)]


def _how_many(said: "Said", rows: Sequence[Row]) -> list[str]:
    name = said.state_name
    alone = rows[0][f"bound_{name}"]
    leave = f"noise alone leaves {alone:.3f}"
    bounds = {row["points"]: row[f"bound_{name}"] for row in rows if row["placement"] == "optimal"}
    most = max(bounds)
    if not said.wanted:
        listed = ", ".join(
            f"{bound:.3f} with {count}" for count, bound in bounds.items() if bound is not None
        )
        return [f"The bound on {name} settles at {listed or 'no value'} points; {leave}."]
    wanted = " and ".join(
        f"{said.procedure.system.state_names[j]} within {bound:g}"
        for j, bound in said.wanted.items()
    )
    if said.needed is None:
        last = bounds[most]
        settles = "has no steady state" if last is None else f"settles at {last:.3f}"
        return [
            f"Even {_count(most)} don't keep {wanted}: with them the bound on {name} {settles}; "
            f"{leave}."
        ]
    verb = "is" if said.needed == 1 else "are"
    said_first = (
        f"{_count(said.needed).capitalize()} {verb} enough for {wanted}: the bound on {name} "
        f"settles at {bounds[said.needed]:.3f}; {leave}."
    )
    fewer = bounds.get(said.needed - 1)
    if said.needed > 1:
        was = "has none" if fewer is None else f"is {fewer:.3f}"
        said_first = said_first[:-1] + f", and with one point fewer it {was}."
    return [said_first]


def _how_far(said: "Said") -> list[str]:
    steps = said.steps
    first, last = steps[0].placement, steps[-1].placement
    sentence = f"The worst linearisation error is {first.worst_error:.4g} with one point"
    if len(steps) > 1:
        sentence += f" and {last.worst_error:.4g} with {len(steps)}"
    if all(step.placement.certificate for step in steps):
        gap = max(
            1.0 - step.placement.no_less_than / step.placement.worst_error
            for step in steps
            if step.placement.worst_error > 0.0
        )
        return [f"{sentence}; no other places are better by more than {max(gap, 1e-9):.0e} of it."]
    doubt = next(step.placement.doubt for step in reversed(steps) if step.placement.doubt)
    return [f"{sentence}; that no other places are better is not certified ({doubt})."]


def _others(said: "Said") -> list[str]:
    parts = []
    for step in said.given:
        count = len(step.placement.points)
        if count <= len(said.steps):
            best = said.steps[count - 1].placement.worst_error
            more = 100.0 * (step.placement.worst_error / best - 1.0)
            parts.append(f"'{step.name}' by {more:.0f} %")
    if not parts:
        return []
    return [f"The worst error of other placements is above the best of as many: {', '.join(parts)}."]


def _local(said: "Said") -> list[str]:
    if not said.study:
        return []
    optimum = said.steps[said.settings.starts_points - 1].placement.worst_error
    shares = ", ".join(
        f"{100 * one.share_within(10.0, optimum):.0f} % of {one.solver}" for one in said.study
    )
    return [
        f"Of {said.settings.starts:,} random starts with {_count(said.settings.starts_points)}, "
        f"within 10 % of the optimum end {shares}: the solver decides."
    ]


# ---- notes -----------------------------------------------------------------------------------


def notes(said: "Said") -> list[str]:
    """What the paper prints wrongly or leaves open, and what was assumed."""
    said_first = (
        "errors as (40) prints them: the curvature at the state and no half, where (31) has it at "
        "the point; neither is a bound at every place, `remainder: exact` is"
        if said.settings.remainder == PRINTED
        else "errors are |f(x) - f(c) - f'(c) (x - c)|; (40) of the paper is no bound of them"
    )
    found = [
        said_first,
        "normalised: by the largest curvature in the range (T v1 in the paper, which gives .129 so "
        "and .006 as it is)",
        "one model serves all components at a place; (32) lets each take its own, which no bank can",
        "a bank's bound is its widest model's, with the worst error of each component everywhere; a "
        "box of m components takes m r^2, where (22) prints 2",
        f"beta and rho by {said.settings.rule}; the paper names no rule, and what is steady depends "
        "on it (rules.parquet)",
    ]
    if len(said.procedure.function.components) > 1 and not said.settings.weights:
        listed = ", ".join(said.procedure.function.components)
        found.append(f"errors of {listed} are compared as they stand; see 'weights'")
    return found
