"""Every ordered pair of a bank's modes: how soon they are told apart, how soon a switch is seen."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from hybridtrack.analyses import model_at_one_step
from hybridtrack.analyses._horizons import Horizon, horizon
from hybridtrack.analyses._observability_matrices import ModeDynamics, mode_dynamics
from hybridtrack.analyses._telling_apart import SETTLING_SCANS, settled_covariance
from hybridtrack.description import Experiment
from hybridtrack.errors import Unsuited
from hybridtrack.jumps import ChainTruth
from hybridtrack.models import Array, JumpMarkovModel
from hybridtrack.simulation import Case, FixedTruth, two_point_start


class Settings(NamedTuple):
    """What counts as told apart, and how long to look.

    target_error: how often the best test between two modes, equally probable beforehand, may err;
    most_scans: no more scans than these are looked at;
    initial_at_first_scan: `initial` is the state at the first scan, as in the paper, and not one
    step before it, as for the filters.
    """

    target_error: float = 0.01
    most_scans: int = 256
    initial_at_first_scan: bool = False


class PairOfModes(NamedTuple):
    """All about telling one mode from another, and about noticing the switch between them."""

    old: ModeDynamics
    new: ModeDynamics
    horizon: Horizon  # from the initial state, in one of the two modes throughout
    delay: Horizon  # scans after a switch from old to new


class Theory(NamedTuple):
    """What the bank of an experiment can do, and what was assumed for it."""

    model: JumpMarkovModel
    pairs: tuple[PairOfModes, ...]  # ordered pairs, old mode by old mode
    notes: tuple[str, ...]


def theory(
    experiment: Experiment,
    settings: Settings,
    *,
    from_modes: Collection[str] | None = None,
    with_curves: bool = True,
) -> Theory:
    """Horizons and delays of every ordered pair of modes, or of those from `from_modes`.

    with_curves: horizons come with the error over the scans, for a picture.
    Raises Unsuited for a bank of one mode.
    """
    model, step_notes = model_at_one_step(experiment)
    names = model.mode_names
    if len(names) < 2:
        raise Unsuited(
            f"the bank has one mode, '{names[0]}', and nothing to tell it from; observability "
            "needs two modes or more",
            "modes",
        )
    initial = experiment.initial
    told, model, start_notes = _started(experiment, model)
    modes = mode_dynamics(model)
    unsettled = []
    horizons: dict[tuple[int, int], Horizon] = {}
    pairs = []
    for i, old in enumerate(modes):
        if from_modes is not None and old.name not in from_modes:
            continue
        filtered, settled = settled_covariance(old)
        if not settled:
            unsettled.append(old.name)
        for j, new in enumerate(modes):
            if i == j:
                continue
            key = (min(i, j), max(i, j))
            if key not in horizons:
                horizons[key] = horizon(
                    modes[key[0]],
                    modes[key[1]],
                    settings.target_error,
                    settings.most_scans,
                    at_first_scan=settings.initial_at_first_scan and not initial.two_point,
                    told_covariance=told,
                    with_curve=with_curves,
                )
            delay = horizon(
                old._replace(initial_covariance=filtered),
                new._replace(initial_covariance=filtered),
                settings.target_error,
                settings.most_scans,
                told_covariance=model.initial_covariance + (0.0 if told is None else told),
            )
            pairs.append(PairOfModes(old, new, horizons[key], delay))
    notes = [*step_notes, *start_notes]
    if unsettled:
        notes.append(
            f"the covariance of the filter of {' and of '.join(unsettled)} still changes after "
            f"{SETTLING_SCANS} scans; delays of switches begin with what it is then"
        )
    return Theory(model, tuple(pairs), tuple(notes))


# ---- the start -------------------------------------------------------------------------------


def _started(
    experiment: Experiment, model: JumpMarkovModel
) -> tuple[Array | None, JumpMarkovModel, tuple[str, ...]]:
    """The model with the mean and covariance that filters start from, and what was assumed.

    Also the covariance with which a mean is drawn that the filters are told, or None.
    """
    initial = experiment.initial
    if not (initial.two_point or initial.follows_truth):
        return None, model, ()
    case = experiment.cases[0]
    mean, which = _start_of_truth(case, model.state_names, 2 if initial.two_point else 0)
    if initial.two_point:
        noise = experiment.bank.mean_measurement_noise
        nothing = np.zeros((len(noise), 1))
        step_s = float(model.step_s[0])
        covariance = two_point_start(nothing, nothing, step_s, noise, model.state_names)[1]
        note = (
            "filters start from two scans: scans are counted after these, the start's covariance "
            f"is that of two-point differencing, and its mean {which}"
        )
        return None, model._replace(initial_mean=mean, initial_covariance=covariance), (note,)
    told = None
    if isinstance(case.truth, ChainTruth):
        known = case.truth.bank.state_names
        told = _by_name(case.truth.initial_covariance, known, model.state_names)
    note = f"the filters' mean follows the truth, and is here {which}"
    return told, model._replace(initial_mean=mean), (note,)


def _start_of_truth(case: Case, names: Sequence[str], step: int) -> tuple[Array, str]:
    """The truth's state at the start, zero where it has none of that name, and what it is."""
    truth = case.truth
    if isinstance(truth, FixedTruth):
        known, values = truth.state_names, truth.state[min(step, len(truth.state) - 1)]
        which = f"the true state of '{case.name}' then"
    else:
        assert isinstance(truth, ChainTruth)
        known, values = truth.bank.state_names, truth.initial_mean
        which = "the mean of the chain's own start"
    state = dict(zip(known, values.tolist(), strict=True))
    mean = np.array([state.get(name, 0.0) for name in names])
    if not np.isfinite(mean).all():
        return np.nan_to_num(mean, nan=0.0), f"{which}, 0 where that is unknown"
    return mean, which


def _by_name(covariance: Array, known: Sequence[str], names: Sequence[str]) -> Array:
    """A covariance of the known states as one of others; 0 for states that aren't known."""
    chosen = np.zeros((len(names), len(known)))
    for row, name in enumerate(names):
        if name in known:
            chosen[row, known.index(name)] = 1.0
    arranged: Array = chosen @ covariance @ chosen.T
    return arranged
