"""Per ordered pair of modes: which direction is easier to notice, and what remains in the end."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hybridtrack.analyses._steady_filters import (
    Difference,
    NoSteadyState,
    SteadyFilter,
    difference,
    steady_residual,
)
from hybridtrack.models import Array, JumpMarkovModel


def pairs_of_modes(
    filters: list[SteadyFilter | NoSteadyState],
    model: JumpMarkovModel,
    states: Mapping[tuple[str, str], Array],
    rows: Sequence[Mapping[str, Any]],
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
    return found | {"five_equalities_hold": all(value < 1e-12 for value in found.values())}


def condition_15(d: Difference, residual: float, stays: float, leaves: float) -> bool | None:
    """Hwang 2006, eq. 15, with the density's |S|^(-1/2): in the long run mode T is the estimate.

    residual: norm of the wrong filter's; stays and leaves: P(T next | T now), P(i next | T now).
    None where mode T never stays.
    """
    if stays == 0.0:
        return None
    ln_mu = math.log(stays) - math.log(leaves) if leaves > 0.0 else math.inf
    beta = (d.log_determinants + 2.0 * ln_mu) / d.largest_information
    return d.alpha * residual**2 + beta > 0.0


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
        condition = condition_15(d, norms[1], transition[new, new], transition[new, left])
    return {
        "steady_residual_m": norms[0],
        "settled_residual_m": norms[1],
        "steady_state": steady.reason or "settles",
        "condition_15": condition,
    }
