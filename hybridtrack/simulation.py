"""Truth and measurements: trajectory legs or a simulated chain, then what a sensor sees of it.

Randomness is keyed (seed, case, block, purpose). A whole block is always drawn and the surplus
thrown away, and each purpose has a stream of its own that is read on from span to span: run r
depends neither on how many runs were asked for nor on the length of spans.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.bounded import BoundedRuns, BoundedTruth, Opponent
from hybridtrack.errors import UserError
from hybridtrack.jumps import ChainTruth, JumpRuns, Modes
from hybridtrack.models import Array
from hybridtrack.purposes import Purpose
from hybridtrack.sensors import Noise, Sensor

BLOCK_RUNS = 256  # runs drawn and filtered together
NOT_FORESEEN: Array = np.zeros((0, 1))


def stream(seed: int, case: int, block: int, purpose: Purpose) -> np.random.Generator:
    """The random stream of one purpose in one block of one case."""
    key = np.random.SeedSequence(seed, spawn_key=(case, block, int(purpose)))
    return np.random.Generator(np.random.Philox(key))


# ---- trajectory legs -------------------------------------------------------------------------


class Leg(NamedTuple):
    """A straight flight, a coordinated turn (an exact arc) or a constant acceleration."""

    until_s: float
    turn_rate_rad_s: float  # positive to the right: headings run clockwise from north
    speed_m_s: float | None  # None: as the leg before ends
    mode: int
    acceleration_m_s2: tuple[float, float] = (0.0, 0.0)  # east, north; not in a turn


class FixedTruth(NamedTuple):
    """One trajectory, the same in every run."""

    state: Array  # (n_steps + 1, n_states), from k = 0
    mode: Modes  # (n_steps + 1,), the mode that drives the step to k; -1 where there is none
    state_names: tuple[str, ...]


def fly(
    legs: tuple[Leg, ...], times_s: Array, position_m: tuple[float, float], heading_rad: float
) -> FixedTruth:
    """Fly the legs from a start at times_s[0] and note the state (x, vx, y, vy) at every time.

    Turns are exact circular arcs, accelerations exact parabolas; the first leg has a speed. A
    step's mode is that of the leg in which it ends.
    """
    state = np.empty((len(times_s), 4))
    mode = np.empty(len(times_s), dtype=np.int64)
    slack_s = 1e-6 * np.diff(times_s).min()  # 3 * 0.1 s still ends a leg that lasts until 0.3 s
    ends = np.array([leg.until_s for leg in legs]) + slack_s
    index = np.minimum(np.searchsorted(ends, times_s, side="left"), len(legs) - 1)
    position, heading, begin = np.array(position_m, dtype=float), heading_rad, float(times_s[0])
    speed = 0.0
    for number, leg in enumerate(legs):
        here = index == number
        speed = speed if leg.speed_m_s is None else leg.speed_m_s
        start = (speed, position, heading)
        state[here] = _along(leg, times_s[here] - begin, *start)
        mode[here] = leg.mode
        last = _along(leg, np.array([leg.until_s - begin]), *start)[0]
        duration = leg.until_s - begin
        position, begin = last[[0, 2]], leg.until_s
        if any(leg.acceleration_m_s2):
            speed, heading = math.hypot(last[1], last[3]), math.atan2(last[1], last[3])
        else:
            heading += leg.turn_rate_rad_s * duration
    return FixedTruth(state, mode, ("x", "vx", "y", "vy"))


def _along(leg: Leg, elapsed_s: Array, speed: float, position: Array, heading: float) -> Array:
    """States (n, 4) on a leg.

    The chord of an arc is as long as v t sin(a/2)/(a/2), halfway between the headings.
    """
    angle = leg.turn_rate_rad_s * elapsed_s
    chord = speed * elapsed_s * np.sinc(angle / (2 * np.pi))
    bearing = heading + angle / 2
    state = np.stack(
        [
            position[0] + chord * np.sin(bearing),
            speed * np.sin(heading + angle),
            position[1] + chord * np.cos(bearing),
            speed * np.cos(heading + angle),
        ],
        axis=1,
    )
    if any(leg.acceleration_m_s2):
        a = np.array(leg.acceleration_m_s2)
        state[:, [0, 2]] += np.multiply.outer(elapsed_s**2 / 2, a)
        state[:, [1, 3]] += np.multiply.outer(elapsed_s, a)
    return state


# ---- truth and measurements of a span --------------------------------------------------------

Truth = FixedTruth | ChainTruth | BoundedTruth


class TruthSpan(NamedTuple):
    """The truth of a span; the last axis is 1 where it is the same in every run."""

    state: Array  # (n_steps, n_states, lanes or 1)
    mode: Modes  # (n_steps, lanes or 1), -1 where there is none
    since_switch_s: Array  # (n_steps, lanes or 1) since the last switch of mode; inf before it
    final: Array = NOT_FORESEEN  # (n_steps, lanes or 1) 1 where no switch comes any more, else 0

    def cut(self, steps: slice) -> "TruthSpan":
        """Some of the steps."""
        return self.each(lambda array: array[steps])

    def each(self, change: Callable[[NDArray[Any]], NDArray[Any]]) -> "TruthSpan":
        """The same change of every array."""
        return TruthSpan(*map(change, self))


class Scans(NamedTuple):
    """A span of truth and of measurements."""

    truth: TruthSpan
    measurements: Array  # (n_steps, n_y, lanes), NaN where missed

    def cut(self, steps: slice) -> "Scans":
        """Some of the steps."""
        return Scans(self.truth.cut(steps), self.measurements[steps])


class Case(NamedTuple):
    """One truth with its own times; an experiment has one or more."""

    name: str
    times_s: Array  # (n_steps + 1,) from k = 0
    truth: Truth
    recorded: Array | None = None  # (n_steps + 1, n_y): measurements as recorded, no sensor drawn


def spans(n_steps: int, longest: int) -> Iterator[slice]:
    """Steps 0 .. n_steps cut into as few spans as can be, of one length or nearly so.

    What is kept from span to span need not be allocated anew for a short last one.
    """
    number = -(-n_steps // longest)
    for i in range(number):
        yield slice(i * n_steps // number, (i + 1) * n_steps // number)


def step_lengths(times_s: Array) -> Array:
    """The lengths of steps (n_steps,), made equal where nothing but rounding tells them apart."""
    step_s = np.diff(times_s)
    rounding = 4 * np.finfo(np.float64).eps * np.abs(times_s).max()
    even = np.ptp(step_s) <= 1e-9 * step_s.mean() + rounding
    return np.full_like(step_s, step_s[0]) if even else step_s


class BlockSimulation:
    """Truth and measurements of one block of runs, span by span."""

    def __init__(
        self,
        case: Case,
        sensor: Sensor,
        seed: int,
        case_index: int,
        block: int,
        lanes: int,
        *,
        foresees: bool = False,
    ) -> None:
        """lanes: how many of the block's runs are kept of what is drawn.

        foresees: whether to tell at every step if the mode is the last one.
        """
        self._lanes = lanes
        self._case = case
        self._sensor = sensor
        self._key = (seed, case_index, block)
        self._streams: dict[Purpose, np.random.Generator] = {}
        self._noise = Noise(sensor.noise_covariance)
        self._may_be_outliers = sensor.may_be_outliers(case.times_s)
        self.fixed: TruthSpan | None = None  # the truth of all steps, if every run has the same
        self.noise_outside = np.zeros((0, lanes, 2))  # of the last span, see BoundedRuns
        self._bounded: BoundedRuns | None = None
        truth = case.truth
        if isinstance(truth, BoundedTruth):
            self.state_names = truth.model.state_names
            self._bounded = BoundedRuns(truth, self._stream, BLOCK_RUNS, lanes)
            self.initial_state = self._bounded.state.T.copy()
        elif isinstance(truth, ChainTruth):
            self.state_names = truth.bank.state_names
            n_x = len(self.state_names)
            draws = self._stream(Purpose.INITIAL_STATE).standard_normal((n_x, BLOCK_RUNS))
            uniform = self._stream(Purpose.MODE_SEQUENCE).random(BLOCK_RUNS)
            self._runs = JumpRuns(truth, step_lengths(case.times_s), uniform, draws)
            self.initial_state = self._runs.state[:, :lanes].copy()
            self._last_switch: Array | None = None
            if foresees:  # the same modes, drawn once before their time
                again = stream(*self._key, Purpose.MODE_SEQUENCE)
                again.random(BLOCK_RUNS)
                self._last_switch = self._runs.last_switches(again)
        else:
            self.state_names = truth.state_names
            self.initial_state = truth.state[0][:, np.newaxis]
            since_switch_s = _since_switch(case.times_s, truth.mode)
            self.fixed = TruthSpan(
                truth.state[1:, :, np.newaxis],
                truth.mode[1:, np.newaxis],
                since_switch_s[1:, np.newaxis],
                _final(truth.mode)[1:, np.newaxis] if foresees else NOT_FORESEEN,
            )
        self._positions = [
            self.state_names.index(axis) for axis in "xy" if axis in self.state_names
        ]

    def _stream(self, purpose: Purpose) -> np.random.Generator:
        """The purpose's stream, begun when first asked for: most cases need few of them."""
        if purpose not in self._streams:
            self._streams[purpose] = stream(*self._key, purpose)
        return self._streams[purpose]

    def initial_estimate_noise(self, n_x: int) -> Array:
        """Standard normal draws (n_x, lanes) for a start drawn about the truth."""
        draws = self._stream(Purpose.INITIAL_ESTIMATE).standard_normal((n_x, BLOCK_RUNS))
        return draws[:, : self._lanes]

    def oppose(self, opponent: Opponent) -> None:
        """Give an adversary the filter that it plays against, at k = 0."""
        assert self._bounded is not None
        self._bounded.opponent = opponent

    def advance(self, span: slice) -> Scans:
        """Truth and measurements of the next span of steps."""
        if self._bounded is not None:
            return self._advance_bounded(self._bounded, span)
        truth, measurements = self._draw(span)
        lanes = self._lanes
        kept = truth.each(lambda array: np.ascontiguousarray(array[..., :lanes]))
        return Scans(kept, np.ascontiguousarray(measurements[..., :lanes]))

    def _advance_bounded(self, runs: BoundedRuns, span: slice) -> Scans:
        states, measurements, self.noise_outside = runs.advance(span.stop - span.start)
        steps = (len(states), 1)
        truth = TruthSpan(
            np.ascontiguousarray(np.swapaxes(states, 1, 2)),
            np.full(steps, -1, dtype=np.int64),
            np.full(steps, np.inf),
        )
        return Scans(truth, np.ascontiguousarray(np.swapaxes(measurements, 1, 2)))

    def _draw(self, span: slice) -> Scans:
        truth = self._advance_truth(span)
        n_y = self._sensor.noise_covariance.shape[-1]
        steps = span.stop - span.start
        if self._case.recorded is not None:
            scans = self._case.recorded[span.start + 1 : span.stop + 1, :, np.newaxis]
            return Scans(truth, np.repeat(scans, BLOCK_RUNS, axis=2))
        draws = self._stream(Purpose.MEASUREMENT_NOISE).standard_normal((steps, n_y, BLOCK_RUNS))
        measurements = self._noise.shape(draws, truth.mode)
        measurements += truth.state[:, self._positions]
        if self._sensor.outliers is not None:
            uniform = self._stream(Purpose.OUTLIERS).random((steps, 2, BLOCK_RUNS))
            possible = self._may_be_outliers[span]
            self._noise.add_outliers(
                measurements, self._sensor.outliers, uniform, possible, truth.mode
            )
        if self._sensor.detection_probability < 1.0:
            uniform = self._stream(Purpose.DETECTION).random((steps, BLOCK_RUNS))
            missed = uniform >= self._sensor.detection_probability
            missed[: max(self._sensor.certain_scans - span.start, 0)] = False
            measurements[np.repeat(missed[:, np.newaxis], n_y, axis=1)] = np.nan
        return Scans(truth, measurements)

    def _advance_truth(self, span: slice) -> TruthSpan:
        if self.fixed is not None:
            return self.fixed.cut(span)
        steps, rank = span.stop - span.start, self._runs.noise_rank
        uniform = self._stream(Purpose.MODE_SEQUENCE).random((steps, BLOCK_RUNS))
        noise = self._stream(Purpose.PROCESS_NOISE).standard_normal((steps, rank, BLOCK_RUNS))
        times_s = self._case.times_s[span.start : span.stop + 1]
        truth = TruthSpan(*self._runs.advance(span, times_s, uniform, noise))
        if self._last_switch is None:
            return truth
        step = np.arange(span.start, span.stop)[:, np.newaxis] + 1
        return truth._replace(final=(step >= self._last_switch).astype(np.float64))


def sojourns(truth: Truth) -> Modes | None:
    """How many steps each mode lasts, from the start on (n_sojourns,); None where runs differ."""
    if isinstance(truth, ChainTruth | BoundedTruth):
        return None
    switched = np.flatnonzero(truth.mode[2:] != truth.mode[1:-1]) + 1
    return np.diff(np.concatenate([[0], switched, [len(truth.mode) - 1]]))


def _since_switch(times_s: Array, modes: Modes) -> Array:
    """Seconds (n_steps + 1,) since the start of the last step that began a mode; inf before."""
    began = np.full(len(times_s), -np.inf)
    switched = np.flatnonzero(modes[2:] != modes[1:-1]) + 2
    began[switched] = times_s[switched - 1]
    return times_s - np.maximum.accumulate(began)


def _final(modes: Modes) -> Array:
    """1 where the mode stays as it is to the end of the flight, else 0; modes (n_steps + 1,)."""
    switches = np.flatnonzero(modes[2:] != modes[1:-1]) + 2
    final = np.zeros(len(modes))
    final[switches[-1] if switches.size else 0 :] = 1.0
    return final


def two_point_start(
    first: Array,
    second: Array,
    step_s: float,
    noise_covariance: Array,
    state_names: tuple[str, ...],
) -> tuple[Array, Array]:
    """Start from two scans by differencing (Bar-Shalom, Li, Kirubarajan 2001, section 5.5.3).

    first, second (n_y, lanes) positions; gives the mean (n_x, lanes) at the second scan and its
    covariance (n_x, n_x): R for the position, R/T with it and 2 R/T^2 for the velocity, 0 for an
    acceleration. Raises UserError where a state is neither position, velocity nor acceleration,
    or where a position or velocity is missing.
    """
    n_x = len(state_names)
    mean = np.zeros((n_x, first.shape[1]))
    covariance = np.zeros((n_x, n_x))
    axes = "xy"[: len(first)]
    unknown = set(state_names) - {prefix + axis for axis in axes for prefix in ("", "v", "a")}
    if unknown:
        raise UserError(
            f"a start from measurements knows no state '{min(unknown)}'; give initial mean and "
            "covariance instead"
        )
    missing = {prefix + axis for axis in axes for prefix in ("", "v")} - set(state_names)
    if missing:
        raise UserError(
            f"a start from measurements needs the state '{min(missing)}'; give initial mean and "
            "covariance instead"
        )
    for m, axis in enumerate(axes):
        p, v = state_names.index(axis), state_names.index("v" + axis)
        mean[p] = second[m]
        mean[v] = (second[m] - first[m]) / step_s
        for n, other in enumerate(axes):
            q, w = state_names.index(other), state_names.index("v" + other)
            r = noise_covariance[m, n]
            covariance[p, q] = r
            covariance[p, w] = covariance[v, q] = r / step_s
            covariance[v, w] = 2 * r / step_s**2
    return mean, covariance
