"""One block of runs: truth -> measurements -> estimates -> running statistics."""

import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.config import Experiment, Window
from hybridtrack.estimators import Estimates, Running
from hybridtrack.executors import Stopped
from hybridtrack.models import Array, JumpMarkovModel
from hybridtrack.simulation import (
    BLOCK_RUNS,
    BlockSimulation,
    Case,
    Scans,
    TruthSpan,
    spans,
    square_root,
    step_lengths,
    two_point_start,
)
from hybridtrack.statistics import (
    POSITION_AT_SCANS,
    Moments,
    Names,
    SumMoments,
    accumulate_steps,
    accumulate_window,
    advantage_kept,
    merge_moments,
    merge_sum_moments,
    score,
    score_measurements,
    sum_moments,
)

SPAN_STEPS = 32  # steps between two looks at Python: their arrays stay in the cache
LANE_GROUP = 32  # lanes are filtered in whole groups, so that each takes the same instructions
DIVERGED = 1e60  # an estimate beyond this has no use, and its fourth power must stay finite

RAW = "raw"
TRUTH = "truth"

Series = tuple[str, str]  # estimator, quantity
Cell = tuple[str, str, str]  # estimator, window, quantity


class BlockTask(NamedTuple):
    """A block of runs of one case."""

    case: int
    block: int
    runs: int  # how many of the block's runs are wanted
    tracks: int  # how many of them are kept whole


class Track(NamedTuple):
    """One quantity of one run over the steps."""

    run: int
    estimator: str
    quantity: str
    values: Array  # (n_steps,)


class BlockResult(NamedTuple):
    """Statistics of a block."""

    task: BlockTask
    steps: dict[Series, Moments]  # arrays (n_steps,)
    sums: dict[Cell, tuple[Array, Array]]  # (runs,) sums over steps, and their numbers
    status: dict[str, NDArray[np.int64]]  # by estimator (runs,): 0, or the step of divergence
    tracks: list[Track]


class GroupStatistics(NamedTuple):
    """Statistics of several blocks of one case, merged in their order."""

    steps: dict[Series, Moments]
    windows: dict[Cell, SumMoments]
    diverged: dict[str, int]


def run_block(experiment: Experiment, task: BlockTask, stop: threading.Event) -> BlockResult:
    """Simulate, estimate and score one block. Raises Stopped soon after `stop` is set."""
    return _Block(experiment, task).run(stop)


def merge(a: GroupStatistics, b: GroupStatistics) -> GroupStatistics:
    """Two groups together; `a` comes first in the order of blocks."""
    return GroupStatistics(
        {key: merge_moments(a.steps[key], b.steps[key]) for key in a.steps},
        {key: merge_sum_moments(a.windows[key], b.windows[key]) for key in a.windows},
        {key: a.diverged[key] + b.diverged[key] for key in a.diverged},
    )


def summarise(result: BlockResult) -> GroupStatistics:
    """A block as a group of its own."""
    windows = {
        cell: sum_moments(sums, numbers, result.status[cell[0]] == 0)
        for cell, (sums, numbers) in result.sums.items()
    }
    diverged = {label: int((status > 0).sum()) for label, status in result.status.items()}
    return GroupStatistics(result.steps, windows, diverged)


def inside(window: Window, times_s: Array, first_scan: int, truth: TruthSpan) -> NDArray[np.bool_]:
    """The steps of a span that a window holds: (n_steps, lanes or 1)."""
    scan = first_scan + np.arange(len(times_s))
    held = (times_s >= window.from_s) & (times_s <= window.until_s) & (scan >= window.skip_scans)
    mask: NDArray[np.bool_] = np.repeat(held[:, np.newaxis], truth.mode.shape[1], axis=1)
    if window.mode is not None:
        mask &= truth.mode == window.mode
    if window.after_switch_s is not None:
        mask &= (truth.since_switch_s > window.after_switch_s) & np.isfinite(truth.since_switch_s)
    if window.within_switch_s is not None:
        mask &= truth.since_switch_s <= window.within_switch_s
    return mask


class _Block:
    """The state of a block on its way through the spans."""

    def __init__(self, experiment: Experiment, task: BlockTask) -> None:
        self._experiment = experiment
        self._task = task
        self._case: Case = experiment.cases[task.case]
        self._n_steps = len(self._case.times_s) - 1
        self._lanes = LANE_GROUP * -(-task.runs // LANE_GROUP)
        assert self._lanes <= BLOCK_RUNS
        self._simulation = BlockSimulation(
            self._case,
            experiment.sensor,
            experiment.seed,
            task.case,
            task.block,
            self._lanes,
        )
        self._step_s = step_lengths(self._case.times_s)
        self._even = bool((self._step_s == self._step_s[0]).all())
        self._running: dict[str, Running] = {}
        self._steps: dict[Series, Moments] = {}
        self._sums: dict[Cell, tuple[Array, Array]] = {}
        self._status: dict[str, NDArray[np.int64]] = {RAW: np.zeros(task.runs, dtype=np.int64)}
        self._tracks: dict[tuple[int, str, str], Array] = {}

    def run(self, stop: threading.Event) -> BlockResult:
        for span in spans(self._n_steps, SPAN_STEPS):
            if stop.is_set():
                raise Stopped
            scans = self._simulation.advance(span)
            if not self._running:
                self._start(scans)
            self._advance(span, scans)
        tracks = [Track(*key, values) for key, values in self._tracks.items()]
        return BlockResult(self._task, self._steps, self._sums, self._status, tracks)

    # ---- the filters' start ----

    def _start(self, scans: Scans) -> None:
        experiment, initial = self._experiment, self._experiment.initial
        states = experiment.bank.state_names
        mean = np.repeat(initial.mean[:, np.newaxis], self._lanes, axis=1)
        banks = {id(chosen.bank): chosen.bank for chosen in experiment.estimators}
        covariances = dict.fromkeys(banks, initial.covariance)
        self._first_step = 0
        if initial.two_point:
            z, step_s = scans.measurements, float(self._step_s[1])
            for key, bank in banks.items():
                noise = bank.mean_measurement_noise
                mean, covariances[key] = two_point_start(z[0], z[1], step_s, noise, states)
            self._first_step = 2
        elif initial.follows_truth:
            known = self._simulation.state_names
            for e, name in enumerate(states):
                mean[e] = self._simulation.initial_state[known.index(name)] if name in known else 0
            if initial.drawn:
                noise = self._simulation.initial_estimate_noise(len(states))
                mean += square_root(initial.covariance) @ noise
        self._initial_covariances = covariances
        self._even_models = self._models(self._step_s[:1])
        for chosen in experiment.estimators:
            model = self._even_models[chosen.label]
            self._running[chosen.label] = Running(chosen.estimator, chosen.settings, model, mean)
            self._status[chosen.label] = np.zeros(self._task.runs, dtype=np.int64)

    def _models(self, step_s: Array) -> dict[str, JumpMarkovModel]:
        """Each estimator's model for the given steps; estimators of one bank share it."""
        nothing = np.zeros(len(self._experiment.bank.state_names))
        built: dict[int, JumpMarkovModel] = {}
        for chosen in self._experiment.estimators:
            bank = chosen.bank
            if id(bank) not in built:
                start = self._initial_covariances[id(bank)]
                built[id(bank)] = bank.discretise(step_s, nothing, start)
        return {c.label: built[id(c.bank)] for c in self._experiment.estimators}

    # ---- one span ----

    def _advance(self, span: slice, scans: Scans) -> None:
        experiment = self._experiment
        times_s = self._case.times_s[span.start + 1 : span.stop + 1]
        masks = {
            window.name: inside(window, times_s, span.start, scans.truth)
            for window in experiment.windows
        }
        known = self._simulation.state_names
        self._score_truth(span, scans)
        skipped = max(self._first_step - span.start, 0)  # scans used up by a two-point start
        for quantity, values in score_measurements(scans, known).items():
            values[:skipped] = np.nan
            self._take(span, RAW, quantity, values, masks)
        models = self._even_models
        if not self._even:
            models = self._models(self._step_s[span.start + skipped : span.stop])
        advantages: dict[str, Array] = {}
        for label, running in self._running.items():
            estimates = running.advance(
                models[label],
                np.ascontiguousarray(scans.measurements[skipped:]),
                covariance=self._task.tracks > 0,
            )
            estimates = _padded(estimates, skipped)
            self._note_status(span, label, estimates)
            names = Names(known, experiment.truth_modes, running.state_names, running.mode_names)
            scores = score(scans, estimates, names)
            for quantity, values in scores.quantities.items():
                self._take(span, label, quantity, values, masks)
            if scores.likelihood_advantage is not None:
                advantages[label] = scores.likelihood_advantage
            if len(running.mode_names) > 1:
                for j, name in enumerate(running.mode_names):
                    probabilities = estimates.mode_probabilities[:, j]
                    self._take(span, label, f"mode_probability:{name}", probabilities)
                    if estimates.mode_likelihoods.shape[0]:
                        likelihoods = np.ascontiguousarray(estimates.mode_likelihoods[:, j])
                        likelihoods[np.isnan(scans.measurements).any(axis=1)] = np.nan
                        self._take(span, label, f"mode_likelihood:{name}", likelihoods)
            self._keep_estimates(span, label, running, estimates)
        reference = advantages.get(experiment.compare_with or "")
        if reference is not None:
            for label, advantage in advantages.items():
                kept = advantage_kept(advantage, reference)
                self._take(span, label, "likelihood_advantage_kept", kept, masks)

    def _score_truth(self, span: slice, scans: Scans) -> None:
        for j, name in enumerate(self._experiment.truth_modes):
            share = np.repeat(
                (scans.truth.mode == j).astype(np.float64),
                self._lanes // scans.truth.mode.shape[1],
                axis=1,
            )
            self._take(span, TRUTH, f"mode_probability:{name}", share)
        if not self._task.tracks:
            return
        for e, name in enumerate(self._simulation.state_names):
            self._keep(span, TRUTH, name, scans.truth.state[:, e])
        if self._experiment.truth_modes:
            self._keep(span, TRUTH, "mode", scans.truth.mode.astype(np.float64))
        for m in range(scans.measurements.shape[1]):
            self._keep(span, "measurement", "xy"[m], scans.measurements[:, m])

    def _note_status(self, span: slice, label: str, estimates: Estimates) -> None:
        """Note the step at which a run diverges; from there on its estimates are NaN."""
        begin = max(self._first_step - span.start, 0)
        status = self._status[label]
        mean = estimates.mean[begin:]
        if mean.max(initial=0.0) < DIVERGED and mean.min(initial=0.0) > -DIVERGED:
            return  # nearly always; NaN isn't below anything
        sound = np.abs(mean).max(axis=1) < DIVERGED
        for b in np.flatnonzero(~sound.all(axis=0)):
            first = begin + int(np.argmin(sound[:, b]))
            if b < self._task.runs and status[b] == 0:
                status[b] = span.start + first + 1
            for array in estimates:
                array[first:, ..., b] = np.nan

    def _take(
        self,
        span: slice,
        label: str,
        quantity: str,
        values: Array,
        masks: dict[str, NDArray[np.bool_]] | None = None,
    ) -> None:
        """Add a span of a quantity (n_steps, lanes) to the statistics."""
        runs = self._task.runs
        if quantity != POSITION_AT_SCANS:
            key = (label, quantity)
            if key not in self._steps:
                self._steps[key] = Moments(*(np.zeros(self._n_steps) for _ in range(3)))
            accumulate_steps(values, runs, *(array[span] for array in self._steps[key]))
        for window, mask in (masks or {}).items():
            cell = (label, window, quantity)
            if cell not in self._sums:
                self._sums[cell] = (np.zeros(runs), np.zeros(runs))
            accumulate_window(values, mask, runs, *self._sums[cell])

    # ---- tracks of the first runs ----

    def _keep_estimates(
        self, span: slice, label: str, running: Running, estimates: Estimates
    ) -> None:
        if not self._task.tracks:
            return
        for e, name in enumerate(running.state_names):
            self._keep(span, label, name, estimates.mean[:, e])
            variance = estimates.covariance[:, e * (e + 1) // 2 + e]
            self._keep(span, label, f"std:{name}", np.sqrt(np.maximum(variance, 0.0)))
        if len(running.mode_names) > 1:
            for j, name in enumerate(running.mode_names):
                values = estimates.mode_probabilities[:, j]
                self._keep(span, label, f"mode_probability:{name}", values)

    def _keep(self, span: slice, label: str, quantity: str, values: Array) -> None:
        for run in range(self._task.tracks):
            key = (run, label, quantity)
            if key not in self._tracks:
                self._tracks[key] = np.full(self._n_steps, np.nan)
            self._tracks[key][span] = values[:, run if values.shape[1] > 1 else 0]


def _padded(estimates: Estimates, skipped: int) -> Estimates:
    """NaN in front, for scans that have no estimate yet."""
    if not skipped:
        return estimates
    padded = []
    for array in estimates:
        front = np.full((skipped if len(array) else 0, *array.shape[1:]), np.nan)
        padded.append(np.concatenate([front, array]))
    return Estimates(*padded)
