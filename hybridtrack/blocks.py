"""One block of runs: truth -> measurements -> estimates -> running statistics."""

import functools
import threading
from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from hybridtrack.bounded import BoundedTruth, Opponent
from hybridtrack.config import Experiment, Window
from hybridtrack.containment import Names as SetNames
from hybridtrack.containment import NoiseTally, SetTally
from hybridtrack.delays import Delays, DelayTally
from hybridtrack.errors import Stopped
from hybridtrack.estimators import NO_KNOWN_MODES, AtWork, Estimates, SetsAtWork
from hybridtrack.groups import RAW, TRUTH, BlockResult, BlockTask, Cell, Series
from hybridtrack.models import Array, Itself, JumpMarkovModel, ModeBank
from hybridtrack.roots import square_root
from hybridtrack.scoring import Given, Names, all_below, as_measured, blank_sheet
from hybridtrack.simulation import (
    BLOCK_RUNS,
    BlockSimulation,
    Case,
    Scans,
    TruthSpan,
    sojourns,
    spans,
    step_lengths,
    two_point_start,
)
from hybridtrack.statistics import Moments
from hybridtrack.tallies import Tally
from hybridtrack.tracks import TrackKeeper
from hybridtrack.vectors import WIDTH

SPAN_STEPS = 75  # at most, between two looks at Python, whose lock threads wait for
DIVERGED = 1e60  # an estimate beyond this has no use, and its fourth power must stay finite


def run_block(experiment: Experiment, task: BlockTask, stop: threading.Event) -> BlockResult:
    """Simulate, estimate and score one block. Raises Stopped soon after `stop` is set."""
    return _Block(experiment, task).run(stop)


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


@functools.lru_cache(maxsize=64)
def _model_of_one(bank: Itself, step_s: float, covariance: bytes, even: bool) -> JumpMarkovModel:
    """The model of a step, and of all where they are even; blocks have it in common."""
    one: ModeBank = bank.one
    n_x = len(one.state_names)
    initial = np.frombuffer(covariance).reshape(n_x, n_x)
    model = one.discretise(np.array([step_s]), np.zeros(n_x), initial)
    return model._replace(even_steps=even)


@functools.lru_cache(maxsize=64)
def _prepared_for_one(
    bank: Itself, step_s: float, covariance: bytes, even: bool, estimator: Itself, settings: Any
) -> Any:
    """An estimator for such a step, which blocks have in common too."""
    return estimator.one.prepare(settings, _model_of_one(bank, step_s, covariance, even))


def _in_metres(names: tuple[str, ...], units: Mapping[str, str]) -> tuple[str, ...]:
    """Names of positions and velocities as scores know them; '' for what has another unit."""
    scored = {"": "m", "v": "m/s"}
    return tuple(n if units.get(n) == scored.get(n[:-1]) else "" for n in names)


def _one_step(running: SetsAtWork, prepared: Any) -> Callable[[Array], tuple[Array, Array]]:
    """A filter as an adversary sees it: measurements (lanes, n_y) in, its next ellipsoid out."""

    def advance(measurements: Array) -> tuple[Array, Array]:
        scan = np.ascontiguousarray(measurements.T)[np.newaxis]
        estimates = running.advance(prepared, scan)
        return estimates.mean[0].T, np.moveaxis(running.sets.shape[0], -1, 0)

    return advance


class _Block:
    """The state of a block on its way through the spans."""

    def __init__(self, experiment: Experiment, task: BlockTask) -> None:
        self._experiment = experiment
        self._task = task
        self._case: Case = experiment.cases[task.case]
        self._n_steps = len(self._case.times_s) - 1
        self._lanes = WIDTH * -(-task.runs // WIDTH)  # the recursion takes whole vectors
        assert self._lanes <= BLOCK_RUNS
        self._simulation = BlockSimulation(
            self._case,
            experiment.sensor,
            experiment.seed,
            task.case,
            task.block,
            self._lanes,
            foresees=experiment.foresees,
        )
        self._step_s = step_lengths(self._case.times_s)
        self._steps_are_even = bool((self._step_s == self._step_s[0]).all())
        self._first: dict[str, Any] = {}  # for all steps, where they are even
        self._running: dict[str, AtWork] = {}
        chosen = experiment.estimators
        self._told = {c.label for c in chosen if c.estimator.is_told_modes(c.settings)}
        self._sheet = blank_sheet(SPAN_STEPS, self._lanes)
        self._tallies: dict[str, Tally] = {}
        self._watched: dict[str, DelayTally] = {}
        self._sets: dict[str, SetTally] = {}
        names = tuple(window.name for window in experiment.windows)
        self._noise = NoiseTally(names, task.runs) if experiment.nonlinear else None
        self._shares = {
            name: Moments(*(np.zeros(self._n_steps) for _ in range(3)))
            for name in experiment.truth_modes
        }
        if experiment.foresees:
            self._final_share = Moments(*(np.zeros(self._n_steps) for _ in range(3)))
        labels = (RAW, *(chosen.label for chosen in experiment.estimators))
        self._status = {label: np.zeros(task.runs, dtype=np.int64) for label in labels}
        self._tracks = TrackKeeper(experiment, task, self._n_steps)
        self._held: NDArray[np.bool_] | None = None
        fixed, everything = self._simulation.fixed, slice(0, self._n_steps)
        if fixed is not None:
            self._held = self._windows(everything, fixed)
            self._note_shares(everything, fixed)

    def run(self, stop: threading.Event) -> BlockResult:
        for span in spans(self._n_steps, SPAN_STEPS):
            if stop.is_set():
                raise Stopped
            if isinstance(self._case.truth, BoundedTruth) and not self._running:
                self._start_nonlinear(self._case.truth, stop)
            scans = self._simulation.advance(span)
            if not self._running:
                self._start(scans, stop)
            if self._held is None:
                self._note_shares(span, scans.truth)
            self._tracks.truth(span, self._simulation.state_names, scans)
            used = max(self._first_step - span.start, 0)  # scans of a two-point start
            if used:
                span, scans = slice(span.start + used, span.stop), scans.cut(slice(used, None))
            if span.start < span.stop:
                self._advance(span, scans)
        return self._result()

    def _result(self) -> BlockResult:
        steps: dict[Series, Moments] = {
            (TRUTH, f"mode_probability:{name}"): moments for name, moments in self._shares.items()
        }
        if self._experiment.foresees:
            steps[TRUTH, "final_mode_probability"] = self._final_share
        sums: dict[Cell, tuple[Array, Array]] = {}
        final_bins: dict[str, Array] = {}
        delays: dict[str, Delays] = {}
        for label in self._status:  # in the scenario's order
            if label in self._tallies:
                tally = self._tallies[label]
                steps |= {(label, quantity): moments for quantity, moments in tally.steps()}
                sums |= {(label, *cell): totals for cell, totals in tally.sums()}
                if tally.final_bins.size:
                    final_bins[label] = tally.final_bins
            own = self._noise if label == RAW else self._sets.get(label)
            if own is not None:
                sums |= {(label, *cell): totals for cell, totals in own.sums()}
            if label in self._sets:
                of_sets = self._sets[label].steps()
                steps |= {(label, quantity): moments for quantity, moments in of_sets}
            if label in self._watched:
                watched = self._watched[label]
                delays[label] = watched.delays(self._status[label] == 0)
                if self._simulation.fixed is not None:
                    shares = watched.shares().items()
                    steps |= {(label, f"mode_estimate:{mode}"): m for mode, m in shares}
        tracks = self._tracks.tracks()
        return BlockResult(self._task, steps, sums, final_bins, delays, self._status, tracks)

    # ---- the filters' start ----

    def _start(self, scans: Scans, stop: threading.Event) -> None:
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
        for chosen in experiment.estimators:
            covariance = np.ascontiguousarray(covariances[id(chosen.bank)], dtype=np.float64)
            self._first[chosen.label] = _prepared_for_one(
                Itself(chosen.bank),
                float(self._step_s[0]),
                covariance.tobytes(),
                self._steps_are_even,
                Itself(chosen.estimator),
                chosen.settings,
            )
        # The one that others are compared with goes first, so that its scores are at hand.
        for chosen in sorted(
            experiment.estimators, key=lambda c: c.label != experiment.compare_with
        ):
            prepared = self._first[chosen.label]
            running = chosen.estimator.begin(chosen.settings, prepared, mean, stop)
            self._running[chosen.label] = running
            if experiment.switches(self._task.case) and len(running.mode_names) > 1:
                self._watched[chosen.label] = DelayTally(
                    experiment.truth_modes,
                    running.mode_names,
                    self._n_steps,
                    self._lanes,
                    self._task.runs,
                    sojourns(self._case.truth),
                )

    def _start_nonlinear(self, truth: BoundedTruth, stop: threading.Event) -> None:
        """Filters of a nonlinear model, and the adversary's own copy of its opponent."""
        experiment, initial = self._experiment, self._experiment.initial
        model = experiment.nonlinear
        assert model is not None
        if self._task.tracks:
            self._tracks.noise_free(model.course(truth.start, self._n_steps)[1:])
        mean = np.repeat(initial.mean[:, np.newaxis], self._lanes, axis=1)
        if initial.follows_truth:
            mean = self._simulation.initial_state.copy()
        self._first_step = 0
        leading = experiment.compare_with  # goes first, so that its scores are at hand
        for chosen in sorted(experiment.estimators, key=lambda c: c.label != leading):
            prepared = chosen.estimator.prepare(chosen.settings, model)
            self._first[chosen.label] = prepared
            begin = functools.partial(chosen.estimator.begin, chosen.settings, prepared, mean)
            self._running[chosen.label] = begin(stop)
            if chosen.label == truth.against:
                start = np.repeat(model.initial_shape[np.newaxis], self._lanes, axis=0)
                shadow: Any = begin(stop)
                self._simulation.oppose(Opponent(mean.T, start, _one_step(shadow, prepared)))

    def _prepared(self, span: slice) -> dict[str, Any]:
        """Each estimator for the steps of a span; estimators of one bank share its matrices."""
        if self._steps_are_even:
            return self._first
        nothing = np.zeros(len(self._experiment.bank.state_names))
        built: dict[int, JumpMarkovModel] = {}
        for chosen in self._experiment.estimators:
            bank = chosen.bank
            if id(bank) not in built:
                start = self._initial_covariances[id(bank)]
                model = bank.discretise(self._step_s[span], nothing, start)
                built[id(bank)] = model._replace(even_steps=False)
        return {
            c.label: c.estimator.prepare(c.settings, built[id(c.bank)])
            for c in self._experiment.estimators
        }

    # ---- one span ----

    def _advance(self, span: slice, scans: Scans) -> None:
        """Filter and score scans that none of the filters started from."""
        held = self._windows(span, scans.truth) if self._held is None else self._held[span]
        measured = as_measured(scans.measurements)
        lost = self._lost(scans.truth)
        if lost is not None:
            self._give_up(span, RAW, measured, lost)
        self._score(span, RAW, scans, held, measured)
        if self._noise is not None:
            self._noise.add(self._simulation.noise_outside, held)
        prepared = self._prepared(span)
        covariance = self._task.tracks > 0
        for label, running in self._running.items():
            told = self._true_modes(running, scans) if label in self._told else NO_KNOWN_MODES
            estimates = running.advance(
                prepared[label], scans.measurements, covariance=covariance, known_modes=told
            )
            self._note_status(span, label, estimates, lost)
            self._score(span, label, scans, held, estimates)
            if self._experiment.nonlinear is not None:
                self._score_sets(span, label, cast(SetsAtWork, running), scans, held, estimates)
            if label in self._watched:
                self._watched[label].add(span.start, scans.truth.mode, estimates.mode_probabilities)
            self._tracks.estimates(span, label, running, estimates)

    def _true_modes(self, running: AtWork, scans: Scans) -> Array:
        """The truth's modes as the estimator counts them (n_steps, lanes)."""
        number = [running.mode_names.index(name) for name in self._experiment.truth_modes]
        shape = (len(scans.measurements), self._lanes)
        modes = np.array(number, dtype=np.float64)[scans.truth.mode]
        return np.ascontiguousarray(np.broadcast_to(modes, shape))

    def _score(
        self,
        span: slice,
        label: str,
        scans: Scans,
        held: NDArray[np.bool_],
        estimates: Estimates,
    ) -> None:
        if label not in self._tallies:
            self._tallies[label] = self._begin_tally(label, estimates)
        self._tallies[label].add(span.start, scans, held, estimates)

    def _score_sets(
        self,
        span: slice,
        label: str,
        running: SetsAtWork,
        scans: Scans,
        held: NDArray[np.bool_],
        estimates: Estimates,
    ) -> None:
        model = self._experiment.nonlinear
        assert model is not None
        if label not in self._sets:
            windows = tuple(window.name for window in self._experiment.windows)
            names = SetNames(running.state_names, model.angles, running.point_names, windows)
            self._sets[label] = SetTally(names, self._case.times_s[1:], self._task.runs)
        self._sets[label].add(span, scans.truth.state, estimates.mean, running.sets, held)

    def _begin_tally(self, label: str, estimates: Estimates) -> Tally:
        experiment, running = self._experiment, self._running.get(label)
        measured = tuple("xyz"[: estimates.mean.shape[1]])
        states = self._simulation.state_names
        if experiment.nonlinear is not None:
            measured = _in_metres(experiment.nonlinear.measurement_names, experiment.units)
            states = _in_metres(states, experiment.units)
        names = Names(
            states,
            experiment.truth_modes,
            running.state_names if running else measured,
            running.mode_names if running else (),
        )
        leading = self._tallies.get(experiment.compare_with or "")
        given = Given(
            likelihoods=len(estimates.mode_likelihoods) > 0,
            final=len(estimates.final_mode_probability) > 0,
            leads=label == experiment.compare_with,
            compared=leading is not None and leading.has_advantage,
            paired=leading is not None,
        )
        windows = tuple(window.name for window in experiment.windows)
        return Tally(names, self._n_steps, windows, self._sheet, self._task.runs, given)

    def _windows(self, span: slice, truth: TruthSpan) -> NDArray[np.bool_]:
        """Which windows hold a span's steps (n_steps, n_windows, lanes or 1)."""
        times_s = self._case.times_s[span.start + 1 : span.stop + 1]
        windows = self._experiment.windows
        return np.stack([inside(w, times_s, span.start, truth) for w in windows], axis=1)

    def _note_shares(self, span: slice, truth: TruthSpan) -> None:
        """Moments of the truth's being in each of its modes, and in its last one."""
        for j, moments in enumerate(self._shares.values()):
            self._note_share(span, moments, truth.mode == j)
        if self._experiment.foresees:
            self._note_share(span, self._final_share, truth.final)

    def _note_share(self, span: slice, moments: Moments, ones: NDArray[Any]) -> None:
        runs = self._task.runs
        share = ones[:, :runs].mean(axis=1)
        moments.n[span] = runs
        moments.mean[span] = share
        moments.squares[span] = runs * share * (1.0 - share)

    def _lost(self, truth: TruthSpan) -> NDArray[np.bool_] | None:
        """Where (n_steps, lanes) a nonlinear truth has no value any more; None if nowhere."""
        if self._noise is None or all_below(truth.state, DIVERGED):
            return None
        beyond: NDArray[np.bool_] = ~(np.abs(truth.state).max(axis=1) < DIVERGED)
        return beyond

    def _note_status(
        self, span: slice, label: str, estimates: Estimates, lost: NDArray[np.bool_] | None
    ) -> None:
        """Note the step at which a run diverges, or its truth is lost."""
        if lost is None and all_below(estimates.mean, DIVERGED):
            return
        beyond = ~(np.abs(estimates.mean).max(axis=1) < DIVERGED)
        self._give_up(span, label, estimates, beyond if lost is None else beyond | lost)

    def _give_up(
        self, span: slice, label: str, estimates: Estimates, beyond: NDArray[np.bool_]
    ) -> None:
        """From its first step beyond on (n_steps, lanes) a run's estimates are NaN."""
        status = self._status[label]
        for b in np.flatnonzero(beyond.any(axis=0)):
            first = int(np.argmax(beyond[:, b]))
            if b < self._task.runs and status[b] == 0:
                status[b] = span.start + first + 1
            for array in estimates:
                if array.shape[-1] == self._lanes:
                    array[first:, ..., b] = np.nan
