"""What a bank does on measurements without noise: its mean trajectory through the switches."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from hybridtrack.analyses._steady_filters import SteadyFilter
from hybridtrack.delays import Delays, DelayTally
from hybridtrack.description import ChosenEstimator, Experiment
from hybridtrack.estimators import AtWork
from hybridtrack.jumps import ChainTruth, Modes, truth_model
from hybridtrack.models import Array, JumpMarkovModel
from hybridtrack.simulation import (
    BLOCK_RUNS,
    BlockSimulation,
    Case,
    FixedTruth,
    sojourns,
    spans,
    step_lengths,
    two_point_start,
)
from hybridtrack.vectors import WIDTH

SPAN_STEPS = 75
BEFORE, AFTER = 100, 200  # steps of a chain's modes, before and after a switch


class Switch(NamedTuple):
    """A change of the true mode; a stay lasts until the next one."""

    number: int | None  # from 1; None for a pair of modes of a chain
    from_mode: str
    to_mode: str
    step: int  # the first that the new mode affects, from 1
    last: int  # the last of the stay
    time_s: float | None


class Course(NamedTuple):
    """A truth without noise."""

    case: str
    times_s: Array  # (n_steps + 1,)
    state: Array  # (n_steps + 1, n_x of the truth)
    state_names: tuple[str, ...]
    mode: Modes  # (n_steps + 1,)
    measurements: Array  # (n_steps, n_y)
    switches: tuple[Switch, ...]


def courses(experiment: Experiment) -> Iterator[Course]:
    """Every case's truth; of a chain, for each pair of modes one that switches once.

    A chain's begins at its mean and stays in the first mode for BEFORE steps.
    """
    for case in experiment.cases:
        if isinstance(case.truth, ChainTruth):
            yield from _of_chain(case, case.truth)
        elif experiment.truth_modes:
            yield _of_flight(case, experiment.truth_modes)


def _of_flight(case: Case, truth_modes: tuple[str, ...]) -> Course:
    truth = case.truth
    assert isinstance(truth, FixedTruth)
    lasting = sojourns(truth)
    assert lasting is not None
    last = np.cumsum(lasting)
    modes = [truth_modes[j] for j in truth.mode[last]]
    switches = tuple(
        Switch(
            i,
            modes[i - 1],
            modes[i],
            int(last[i - 1]) + 1,
            int(last[i]),
            float(case.times_s[last[i - 1]]),
        )
        for i in range(1, len(last))
    )
    positions = [truth.state_names.index(axis) for axis in "xy" if axis in truth.state_names]
    seen = truth.state[1:, positions]
    return Course(
        case.name, case.times_s, truth.state, truth.state_names, truth.mode, seen, switches
    )


def _of_chain(case: Case, truth: ChainTruth) -> Iterator[Course]:
    step_s = float(np.median(step_lengths(case.times_s)))
    model = truth_model(truth, np.array([step_s]))
    names = truth.bank.names
    positions = [
        truth.bank.state_names.index(axis) for axis in "xy" if axis in truth.bank.state_names
    ]
    for a, before in enumerate(names):
        for b, after in enumerate(names):
            if a == b or model.transition_matrix[0, a, b] == 0.0:
                continue
            mode = np.array([a] * (BEFORE + 1) + [b] * AFTER)
            state = np.empty((len(mode), len(truth.initial_mean)))
            state[0] = truth.initial_mean
            for k in range(1, len(mode)):
                j = mode[k]
                state[k] = model.state_transition[0, j] @ state[k - 1] + model.input_effect[0, j]
            switch = Switch(None, before, after, BEFORE + 1, BEFORE + AFTER, None)
            yield Course(
                case.name,
                np.arange(len(mode), dtype=np.float64) * step_s,
                state,
                truth.bank.state_names,
                mode,
                state[1:, positions],
                (switch,),
            )


def states_of_bank(course: Course, state_names: tuple[str, ...]) -> Array | None:
    """The truth's states (n_steps + 1, n_x) as a bank names them; None where one is unknown.

    An acceleration that the truth has no state for is the velocity's change over the step before.
    """
    found = np.empty((len(course.times_s), len(state_names)))
    step_s = np.diff(course.times_s)
    for e, name in enumerate(state_names):
        if name in course.state_names:
            found[:, e] = course.state[:, course.state_names.index(name)]
        elif name in ("ax", "ay") and f"v{name[1]}" in course.state_names:
            velocity = course.state[:, course.state_names.index(f"v{name[1]}")]
            found[1:, e] = np.diff(velocity) / step_s
            found[0, e] = 0.0
        else:
            return None
    return found


def start(
    experiment: Experiment, course: Course, chosen: ChosenEstimator
) -> tuple[Array, Array, int]:
    """The filters' mean start (n_x,), its covariance, and how many scans it takes."""
    initial, names = experiment.initial, chosen.bank.state_names
    if initial.two_point:
        z, step_s = course.measurements, float(course.times_s[2] - course.times_s[1])
        noise = chosen.bank.mean_measurement_noise
        mean, covariance = two_point_start(z[0][:, None], z[1][:, None], step_s, noise, names)
        return mean[:, 0], covariance, 2
    if initial.follows_truth:
        known = {name: course.state[0, e] for e, name in enumerate(course.state_names)}
        return np.array([known.get(name, 0.0) for name in names]), initial.covariance, 0
    return initial.mean, initial.covariance, 0


Change = Callable[[JumpMarkovModel], JumpMarkovModel]


def _as_it_is(model: JumpMarkovModel) -> JumpMarkovModel:
    return model


def mode_probabilities(
    experiment: Experiment, course: Course, chosen: ChosenEstimator, change: Change = _as_it_is
) -> Array:
    """The estimator's mode probabilities (n_steps, n_modes) over the course.

    NaN at scans that a start is made from; change: of what the filters believe.
    """
    mean, covariance, used = start(experiment, course, chosen)
    step_s = step_lengths(course.times_s)
    bank = _Bank(chosen, step_s, np.repeat(mean[:, np.newaxis], WIDTH, axis=1), covariance, change)
    found = [np.full((used, len(chosen.bank.modes)), np.nan)]
    for span in spans(len(step_s) - used, SPAN_STEPS):
        some = slice(span.start + used, span.stop + used)
        scans = np.repeat(course.measurements[some][..., np.newaxis], WIDTH, axis=2)
        found.append(bank.advance(some, scans)[..., 0].copy())
    return np.concatenate(found)


class _Bank:
    """An estimator at work, over steps of any length."""

    def __init__(
        self,
        chosen: ChosenEstimator,
        step_s: Array,
        mean: Array,
        covariance: Array,
        change: Change = _as_it_is,
    ) -> None:
        """mean (n_x, lanes)."""
        self._chosen, self._step_s, self._change = chosen, step_s, change
        self._mean, self._covariance = mean, covariance
        self._even = bool((step_s == step_s[0]).all())
        self._prepared: Any = None
        self._running: AtWork | None = None

    def advance(self, span: slice, scans: Array) -> Array:
        """Mode probabilities (n_steps, n_modes, lanes) of a span, in memory that is used again."""
        chosen = self._chosen
        if self._prepared is None or not self._even:
            step_s = self._step_s[:1] if self._even else self._step_s[span]
            model = chosen.bank.discretise(step_s, self._mean[:, 0], self._covariance)
            changed = self._change(model._replace(even_steps=self._even))
            self._prepared = chosen.estimator.prepare(chosen.settings, changed)
        if self._running is None:
            self._running = chosen.estimator.begin(chosen.settings, self._prepared, self._mean)
        scans = np.ascontiguousarray(scans)
        return self._running.advance(self._prepared, scans).mode_probabilities


def noise_free_delays(
    experiment: Experiment, chosen: Sequence[ChosenEstimator]
) -> dict[tuple[str, str], Delays]:
    """By case and estimator, the delays in one block of a chain's own truths, without noise.

    The truths are those of the scenario's first runs; groups are pairs of modes as in delays.
    """
    found: dict[tuple[str, str], Delays] = {}
    for number, case in enumerate(experiment.cases):
        if not isinstance(case.truth, ChainTruth):
            continue
        step_s = step_lengths(case.times_s)
        block = BlockSimulation(case, experiment.sensor, experiment.seed, number, 0, BLOCK_RUNS)
        known = block.state_names
        positions = [known.index(axis) for axis in "xy" if axis in known]
        banks: dict[str, _Bank] = {}
        tallies: dict[str, DelayTally] = {}
        for span in spans(len(step_s), SPAN_STEPS):
            truth = block.advance(span).truth
            z = truth.state[:, positions]
            used = 0
            if not banks:
                used = 2 * experiment.initial.two_point
                for one in chosen:
                    mean, covariance = _starts(experiment, block, one, z, step_s)
                    banks[one.label] = _Bank(one, step_s, mean, covariance)
                    tallies[one.label] = DelayTally(
                        experiment.truth_modes,
                        one.bank.names,
                        len(step_s),
                        BLOCK_RUNS,
                        BLOCK_RUNS,
                        None,
                    )
            some = slice(span.start + used, span.stop)
            for label, bank in banks.items():
                tallies[label].add(some.start, truth.mode[used:], bank.advance(some, z[used:]))
        sound = np.ones(BLOCK_RUNS, dtype=bool)
        found |= {(case.name, label): tally.delays(sound) for label, tally in tallies.items()}
    return found


def _starts(
    experiment: Experiment, block: BlockSimulation, chosen: ChosenEstimator, z: Array, step_s: Array
) -> tuple[Array, Array]:
    """The filters' starts (n_x, lanes) without a draw, and their covariance."""
    initial, names = experiment.initial, chosen.bank.state_names
    if initial.two_point:
        noise = chosen.bank.mean_measurement_noise
        return two_point_start(z[0], z[1], float(step_s[1]), noise, names)
    mean = np.repeat(initial.mean[:, np.newaxis], BLOCK_RUNS, axis=1)
    if initial.follows_truth:
        for e, name in enumerate(names):
            known = block.state_names
            mean[e] = block.initial_state[known.index(name)] if name in known else 0.0
    return mean, initial.covariance


def predicted_delay(probabilities: Array, new: int, switch: Switch) -> float:
    """Steps until the new mode is more probable than every other, or infinity.

    probabilities (n_steps, n_modes) from the course's first step on.
    """
    stay = probabilities[switch.step - 1 : switch.last]
    others = np.delete(stay, new, axis=1).max(axis=1)
    ahead = stay[:, new] > others
    return float(np.argmax(ahead)) + 1.0 if ahead.any() else np.inf


class MeanBank(NamedTuple):
    """A bank of steady filters on a course; arrays by step (n_steps, ...)."""

    residual: Array  # (n_steps, n_modes, n_y)
    start: Array  # (n_steps, n_modes, n_x) each filter's estimate that the step begins with
    log_predicted: Array  # (n_steps, n_modes) logarithm of the predicted mode probabilities


def run_mean_bank(
    filters: list[SteadyFilter],
    model: JumpMarkovModel,
    measurements: Array,
    mean: Array,
    mixing: bool,
) -> MeanBank:
    """The IMM's cycle, or MMAE's without mixing, with every filter's gain and S in steady state.

    Hwang, Balakrishnan, Tomlin 2006, section 4.2, with the density's |S|^(-1/2). model: with steps
    of one length; measurements (n_steps, n_y); mean (n_x,).
    """
    transition = model.transition_matrix[0]
    n, n_modes = len(measurements), len(filters)
    residual = np.empty((n, n_modes, len(measurements[0])))
    begun = np.empty((n, n_modes, len(mean)))
    log_predicted = np.empty((n, n_modes))
    estimate = np.repeat(mean[np.newaxis], n_modes, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_transition = np.log(transition)
        log_probability = np.log(model.initial_mode_probabilities)
        for k, z in enumerate(measurements):
            joint = log_probability[:, np.newaxis] + log_transition  # [i, j]: from i to j
            log_predicted[k] = np.logaddexp.reduce(joint, axis=0)
            begun[k] = estimate
            if mixing:
                weights = np.exp(joint - log_predicted[k])  # [i, j]
                reached = np.isfinite(log_predicted[k])
                begun[k, reached] = weights.T[reached] @ estimate
            for j, one in enumerate(filters):
                predicted = one.A @ begun[k, j] + one.b
                residual[k, j] = z - one.C @ predicted
                estimate[j] = predicted + one.gain @ residual[k, j]
            log_likelihood = [
                -0.5 * (r @ np.linalg.solve(one.innovation_covariance, r) + one.log_determinant)
                for r, one in zip(residual[k], filters, strict=True)
            ]
            log_probability = log_predicted[k] + log_likelihood
            log_probability = log_probability - np.logaddexp.reduce(log_probability)
    return MeanBank(residual, begun, log_predicted)
