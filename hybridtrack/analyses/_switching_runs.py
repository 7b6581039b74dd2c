"""Random switches of mode, and what becomes of the mean error: a bound held against many runs."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.analyses._sojourn_bounds import Mismatch, StateBound
from hybridtrack.models import Array

ROUNDING = 1e-9  # relative: what of an excess is nothing but rounding of thousands of products
MOST_CELLS = 5_000_000  # runs times steps of one simulation: norms are kept for all of them
RUNAWAY = 1e100  # times the first claim: an error this large has broken all, and is held there


class Claimed(NamedTuple):
    """What is claimed of the error: ||e|| <= rate^t ||e_0|| + error_bound when a switch is noticed.

    Between, it may be `growth` times that. What an unnoticed switch adds is within: since a
    detection by which the error was e, at least L* steps have passed by then, so that it is at most
    g(t) ||e|| + c with g(t) <= rate^t and g(t) error_bound + c <= error_bound: the claim itself.
    Sooner nothing is added, and it is at most g(t) ||e|| <= growth rate^t ||e||.
    """

    rate: float
    error_bound: float
    growth: float


class SwitchingRuns(NamedTuple):
    """How many runs broke what is claimed, and how far the worst went."""

    at_switches: float  # fraction of runs that are over the claim when a switch is noticed
    between: float  # fraction of runs that are over it at any step: what the paper denies
    over_envelope: float  # fraction of runs that are over what may happen between
    largest_ratio: float  # of an error to the claim, at any step
    worst: Array  # (n_steps + 1,) the error's norm in the run that went furthest
    switches: Array  # (n,) when the switches of that run are noticed, in steps


def switching_runs(
    transitions: Array,
    mismatch: Mismatch,
    state: StateBound,
    claimed: Claimed,
    *,
    sojourn_steps: int,
    extra_steps: int,
    delay_steps: int,
    runs: int,
    steps: int,
    start: float | Array,
    generator: np.random.Generator,
) -> SwitchingRuns:
    """Mean errors of many runs whose modes last `sojourn_steps` or up to `extra_steps` more.

    transitions (n_modes, n_x, n_x). A run starts with an error of the norm `start` (one
    for all, or one each), in a random direction and in a random mode; the next is any other,
    equally likely, and so is each length from sojourn_steps to sojourn_steps + extra_steps, and
    each delay from 0 to delay_steps.
    While a switch is unnoticed the state is at a random corner of its bounds (scaled to its norm).
    """
    n_modes, n, _ = transitions.shape
    believed, actual, noticed = _modes(
        n_modes, sojourn_steps, extra_steps, delay_steps, runs, steps, generator
    )
    error = generator.standard_normal((n, runs))
    start = np.broadcast_to(np.asarray(start, dtype=np.float64), runs)
    runaway = RUNAWAY * (float(start.max()) + claimed.error_bound)
    error *= start / np.linalg.norm(error, axis=0)
    norms = np.empty((steps + 1, runs))
    norms[0] = start
    stacked, lane = transitions.reshape(n_modes * n, n), np.arange(runs)
    for t in range(steps):
        moved = (stacked @ error).reshape(n_modes, n, runs)
        error = moved[believed[t], :, lane].T
        wrong = np.flatnonzero(believed[t] != actual[t])
        if wrong.size:
            x = _corners(mismatch, state, wrong.size, generator)
            effect = mismatch.state_effect[believed[t, wrong], actual[t, wrong]]
            error[:, wrong] += np.einsum("bij,jb->ib", effect, x)
            error[:, wrong] += mismatch.input_effect[believed[t, wrong], actual[t, wrong]].T
        norms[t + 1] = np.linalg.norm(error, axis=0)
        error[:, norms[t + 1] > runaway] *= 0.1
    ratio = claimed.rate ** np.arange(steps + 1.0)[:, np.newaxis] * start
    ratio += claimed.error_bound
    np.divide(norms, ratio, out=ratio)
    over = ratio > 1.0 + ROUNDING
    furthest = int(np.argmax(ratio.max(axis=0)))
    return SwitchingRuns(
        at_switches=float((over & noticed).any(axis=0).mean()),
        between=float(over.any(axis=0).mean()),
        over_envelope=float((ratio > claimed.growth * (1.0 + ROUNDING)).any(axis=0).mean()),
        largest_ratio=float(ratio.max()),
        worst=norms[:, furthest].copy(),
        switches=np.flatnonzero(noticed[:, furthest]).astype(np.float64),
    )


def _modes(
    n_modes: int,
    sojourn: int,
    extra: int,
    delay: int,
    runs: int,
    steps: int,
    generator: np.random.Generator,
) -> tuple[NDArray[np.int8], NDArray[np.int8], NDArray[np.bool_]]:
    """The modes believed and actual (steps, runs), and when a switch is noticed (steps + 1, runs).

    Drawn switch by switch; sojourn > delay, so a switch is noticed before the next.
    """
    believed = np.empty((steps, runs), dtype=np.int8)
    noticed = np.zeros((steps + 1, runs), dtype=bool)
    actual = np.empty((steps, runs), dtype=np.int8)
    mode = generator.integers(n_modes, size=runs)
    step, lane = np.arange(steps)[:, np.newaxis], np.arange(runs)
    switch, notice = np.zeros(runs, dtype=np.int64), np.zeros(runs, dtype=np.int64)
    for _ in range(steps // sojourn + 1):
        # What begins here is overwritten from the next switch on; only later steps are touched.
        first = int(switch.min())
        if first >= steps:
            break
        span = slice(first, min(steps, int(notice.max()) + sojourn + extra + delay + 1))
        np.copyto(actual[span], mode.astype(np.int8), where=step[span] >= switch)
        np.copyto(believed[span], mode.astype(np.int8), where=step[span] >= notice)
        seen = (notice > 0) & (notice <= steps)
        noticed[notice[seen], lane[seen]] = True
        switch = switch + generator.integers(sojourn, sojourn + extra + 1, size=runs)
        notice = switch + generator.integers(delay + 1, size=runs)
        mode = (mode + generator.integers(1, n_modes, size=runs)) % n_modes
    return believed, actual, noticed


def _corners(
    mismatch: Mismatch, state: StateBound, runs: int, generator: np.random.Generator
) -> Array:
    """States (n_x, runs) at random corners of the bounds, those that cancel left at 0."""
    counts = mismatch.counts
    x = np.zeros((len(counts), runs))
    if counts.any():
        signs = generator.choice([-1.0, 1.0], size=(int(counts.sum()), runs))
        each = np.minimum(state.each[counts], state.norm)[:, np.newaxis]
        corner = signs * each
        size = np.linalg.norm(corner, axis=0)
        shrink = np.minimum(1.0, np.divide(state.norm, size, out=np.ones(runs), where=size > 0))
        x[counts] = corner * shrink
    return x


def whole_numbers(last: int, most: int) -> Sequence[int]:
    """1 .. last, at most so many of them, evenly spread, the last always among them."""
    if last <= most:
        return range(1, last + 1)
    return sorted({1, *(round(last * i / most) for i in range(1, most + 1))})
