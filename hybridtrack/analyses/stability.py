"""Is this IMM stable, and between which covariances does it live?

Seah and Hwang 2008 bound the covariances P_j(k|k) of an IMM's filters and show that its errors die
away, if three conditions hold. Here their constants are computed over all sequences of modes; the
bounds are made valid (the printed lower one, from Deyst and Price, fails in general, and the upper
one forgets how far the modes' means may lie apart); and what the theorem certifies stands beside
what one simulated flight shows.
"""

from typing import NamedTuple

import numpy as np

from hybridtrack.analyses import Analysis, Findings, Measured, model_at_one_step
from hybridtrack.analyses import _stability_charts as charts
from hybridtrack.analyses import _stability_tables as tables
from hybridtrack.analyses import _stability_words as words
from hybridtrack.analyses._definite import is_definite
from hybridtrack.analyses._examination import Stability, checks, examine
from hybridtrack.analyses._riccati import MOST_SEQUENCES
from hybridtrack.description import Experiment
from hybridtrack.errors import Unsuited
from hybridtrack.jumps import ChainTruth
from hybridtrack.models import Array, JumpMarkovModel
from hybridtrack.simulation import FixedTruth, two_point_start

MOST_NUMBERS = 30_000_000  # kept of a simulation: 240 MB


class Settings(NamedTuple):
    """How far to look, and for how long to simulate.

    measurements: the largest N, all of whose sequences of modes are looked at; by default 10, or as
    many as have 4,096 sequences at most;
    steps, seed: of the simulated flight;
    spread_std: how far the means of the modes lie apart at most, as a standard deviation, one
    number per state in the states' units and order (or one for all); by default what the
    simulation shows.
    """

    measurements: int | None = None
    steps: int = 5000
    seed: int = 1
    spread_std: tuple[float, ...] | None = None


def longest_sequence(n_modes: int, measurements: int | None) -> int:
    """How many measurements to look at. Raises Unsuited where they have too many sequences."""
    if measurements is None:
        longest = max((N for N in range(2, 11) if n_modes**N <= 4096), default=2)
    else:
        longest = measurements
    if n_modes**longest > MOST_SEQUENCES:
        most = max((N for N in range(1, 25) if n_modes**N <= MOST_SEQUENCES), default=1)
        remedy = "name fewer modes"
        keys: tuple[str, ...] = ("modes",)
        if most >= 2:
            remedy = f"set 'measurements' under analyses.stability to {most} or less"
            keys = ("analyses", "stability", "measurements")
        raise Unsuited(
            f"{n_modes} modes have {n_modes**longest:,} sequences of N = {longest} measurements, "
            f"more than {MOST_SEQUENCES:,}; {remedy}",
            *keys,
        )
    return longest


def _analyse(experiment: Experiment, settings: Settings, measured: Measured | None) -> Findings:
    """The findings of a scenario; what a run of it gave isn't used."""
    names = experiment.bank.names
    if len(names) < 2:
        raise Unsuited(
            f"'{names[0]}' is the only mode, and an IMM needs two or more; add one, or ask a "
            "Kalman filter's steady state instead",
            "modes",
        )
    model, notes = model_at_one_step(experiment)
    for name, R in zip(names, model.measurement_noise_covariance, strict=True):
        if not is_definite(R):
            raise Unsuited(
                f"the measurement noise covariance of mode '{name}' is singular, and the theory "
                "divides by it; give every measured component a noise",
                "modes",
            )
    longest = longest_sequence(len(names), settings.measurements)
    n_modes, n_x = len(names), len(model.state_names)
    numbers = settings.steps * n_modes * n_x * n_x * 3
    if numbers > MOST_NUMBERS:
        most = MOST_NUMBERS // (n_modes * n_x * n_x * 3)
        raise Unsuited(
            f"{settings.steps:,} steps of {n_modes} modes with {n_x} states are more than is kept; "
            f"set 'steps' under analyses.stability to {most:,} or less",
            "analyses",
            "stability",
            "steps",
        )
    spread = _given_spread(settings.spread_std, model.state_names)
    model, start_notes = _started(experiment, model)
    found = examine(model, longest, settings.steps, settings.seed, spread)
    notes = (*notes, *start_notes)
    if experiment.sensor.detection_probability < 1.0:
        notes = (
            *notes,
            "the theory and the simulation take every scan as detected, and here "
            f"{experiment.sensor.detection_probability:.3g} of them are",
        )
    return findings(found, notes)


def _given_spread(spread_std: tuple[float, ...] | None, states: tuple[str, ...]) -> Array | None:
    """The spread (n_x, n_x) that the scenario gives, if it does."""
    if spread_std is None:
        return None
    if len(spread_std) not in (1, len(states)):
        raise Unsuited(
            f"'spread_std' has {len(spread_std)} numbers for the states {' '.join(states)}; give "
            "one per state, or one for all",
            "analyses",
            "stability",
            "spread_std",
        )
    if min(spread_std) < 0.0:
        raise Unsuited(
            f"'spread_std' contains {min(spread_std):g}; give numbers from 0 on",
            "analyses",
            "stability",
            "spread_std",
        )
    each = np.broadcast_to(np.asarray(spread_std, dtype=np.float64), len(states))
    return np.diag(each**2)


def _started(
    experiment: Experiment, model: JumpMarkovModel
) -> tuple[JumpMarkovModel, tuple[str, ...]]:
    """The model with a start for the simulation, where the scenario leaves it to its runs."""
    initial = experiment.initial
    if not (initial.two_point or initial.follows_truth):
        return model, ()
    truth = experiment.cases[0].truth
    if isinstance(truth, ChainTruth):
        names, values = truth.bank.state_names, truth.initial_mean
    else:
        assert isinstance(truth, FixedTruth)
        names, values = truth.state_names, truth.state[0]
    there = dict(zip(names, np.nan_to_num(values).tolist(), strict=True))
    mean = np.array([there.get(name, 0.0) for name in model.state_names])
    model = model._replace(initial_mean=mean)
    told = "the simulated flight starts about the truth's first state"
    if initial.two_point:
        noise = experiment.bank.mean_measurement_noise
        nothing = np.zeros((len(noise), 1))
        step_s = float(model.step_s[0])
        start = two_point_start(nothing, nothing, step_s, noise, model.state_names)
        model = model._replace(initial_covariance=start[1])
        told += ", with the covariance of a start from two scans"
    return model, (told,)


def findings(found: Stability, notes: tuple[str, ...] = ()) -> Findings:
    """Tables, charts and sentences of what was found, after `notes` on how."""
    checked = checks(found)
    return Findings(
        table=tables.sequences(found),
        conclusions=words.conclusions(found, checked),
        notes=(*notes, *words.notes(found, checked)),
        tables={
            "conditions": tables.conditions(found),
            "rates": tables.rates(found),
            "bounds": tables.bounds(found),
            "eigenvalues": tables.eigenvalues(found, checked),
            "constants": tables.constants(found),
            "over_time": tables.over_time(found),
        },
        charts=(charts.bounds_chart(found), charts.decay_chart(found)),
    )


ANALYSIS = Analysis(
    name="stability",
    summary="whether the IMM forgets its start, and between which covariances it lives",
    source="Seah and Hwang 2008; Lemma 1 there: Deyst and Price 1968",
    settings=Settings,
    analyse=_analyse,
    example="stability_cv_ct",
    limits={"measurements": (2, 24), "steps": (10, 100_000), "seed": (0, None)},
)
