"""Figures that follow from a scenario alone, for claims that need no run."""

import numpy as np

from hybridtrack.bounded import BoundedTruth
from hybridtrack.chains import (
    expected_steps_in_mode,
    expected_steps_to_end,
    expected_transitions,
)
from hybridtrack.config import checks
from hybridtrack.config.reader import Document, Keys
from hybridtrack.config.schema import ClaimForm
from hybridtrack.jumps import ChainTruth, truth_model
from hybridtrack.models import ModeBank
from hybridtrack.sensors import Sensor
from hybridtrack.simulation import Case, step_lengths

# What `published` may hold against a scenario's chain or modes, without a run and an analysis.
EXACT_FIGURES = (
    "expected_steps_to_end",
    "expected_steps_in_mode",
    "expected_transitions",
    "manoeuvring_index",
)
OF_MODES = ("expected_steps_in_mode", "manoeuvring_index")
WITH_PLACE = ("jacobian", "end_point")  # of nonlinear dynamics; `where` says which element


def exact_figure(
    claim: ClaimForm, cases: tuple[Case, ...], sensor: Sensor, document: Document, path: Keys
) -> float:
    """The value of a claim's `figure`: of the truth's chain, or of one of its modes."""
    name, truth = claim.figure, cases[0].truth
    if isinstance(truth, BoundedTruth):
        return _of_dynamics(claim, truth, len(cases[0].times_s) - 1, document, path)
    if name not in EXACT_FIGURES:
        raise document.error(
            (*path, "figure"),
            f"'figure' is {name}, which needs an 'analysis', or is none; "
            f"{checks.nearest(str(name), EXACT_FIGURES)}",
        )
    if not isinstance(truth, ChainTruth):
        raise document.error(
            (*path, "figure"), f"'{name}' is a chain's, and the truth has none; remove the claim"
        )
    step_s = step_lengths(cases[0].times_s)
    if np.ptp(step_s):
        raise document.error(
            (*path, "figure"), f"'{name}' counts steps of one length, and these are uneven"
        )
    mode = _mode(claim, truth.bank, document, path)
    if name == "manoeuvring_index":
        return _manoeuvring_index(mode, truth.bank, float(step_s[0]), sensor, document, path)
    model = truth_model(truth, step_s[:1])
    if name == "expected_steps_in_mode":
        return float(expected_steps_in_mode(model.transition_matrix[0])[mode])
    if name == "expected_transitions":
        start = model.initial_mode_probabilities
        return expected_transitions(truth.bound.supermodes(model.transition_matrix, start))
    if truth.bound.continuation_probability is None:
        raise document.error(
            (*path, "figure"),
            f"'{name}' is that of a soft bound, and the truth's chain has no "
            "'continuation_probability'",
        )
    return expected_steps_to_end(truth.bound.continuation_probability)


def _of_dynamics(
    claim: ClaimForm, truth: BoundedTruth, n_steps: int, document: Document, path: Keys
) -> float:
    """An element of df/dx at a state, or where the course without noise ends."""
    model, name = truth.model, claim.figure
    if name not in WITH_PLACE:
        raise document.error(
            (*path, "figure"), f"'figure' is {name}; {checks.nearest(str(name), WITH_PLACE)}"
        )
    where = dict(claim.where or {})
    states = model.state_names
    asked = ("row", "column") if name == "jacobian" else ("state",)
    chosen = [where.pop(key, None) for key in asked]
    for key, value in zip(asked, chosen, strict=True):
        if value not in states:
            raise document.error(
                (*path, "where"),
                f"'where' of '{name}' needs '{key}', a state; there are {', '.join(states)}",
            )
    for key, value in where.items():
        if key not in states or not isinstance(value, int | float) or name == "end_point":
            raise document.error(
                (*path, "where"),
                f"'{key}' has no place in 'where'; it takes {', '.join(asked)}"
                + (", and a number for every state that isn't 0" if name == "jacobian" else ""),
            )
    places = [states.index(str(value)) for value in chosen]
    if name == "end_point":
        return float(model.course(truth.start, n_steps)[-1, places[0]])
    at = np.array([[float(where.get(state, 0.0)) for state in states]])
    return float(model.dynamics.jacobian(at, model.inputs_at(0))[0, places[0], places[1]])


def _mode(claim: ClaimForm, bank: ModeBank, document: Document, path: Keys) -> int:
    """Which mode a figure is of, 0 for one that is of the whole chain."""
    if claim.figure not in OF_MODES:
        if claim.mode is not None:
            raise document.error(
                (*path, "mode"), f"'{claim.figure}' is the whole chain's; remove 'mode'"
            )
        return 0
    if claim.mode is None:
        raise document.error(path, f"'mode' is missing: '{claim.figure}' is one mode's; add it")
    checks.known_mode(claim.mode, bank.names, document, (*path, "mode"))
    return bank.names.index(claim.mode)


def _manoeuvring_index(
    mode: int, bank: ModeBank, step_s: float, sensor: Sensor, document: Document, path: Keys
) -> float:
    """sigma_w T^2 / sigma_v (Bar-Shalom, Li, Kirubarajan 2001, eq. 6.5.3-13)."""
    std = bank.modes[mode].parameters.get("acceleration_std_m_s2")
    variances = np.diagonal(sensor.noise_covariance, axis1=1, axis2=2)
    if std is None or np.ptp(variances):
        raise document.error(
            (*path, "figure"),
            "a 'manoeuvring_index' needs a mode with an 'acceleration_std_m_s2' and one "
            "'position_std_m'",
        )
    return float(std) * step_s**2 / float(np.sqrt(variances.flat[0]))
