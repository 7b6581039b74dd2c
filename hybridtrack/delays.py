"""How soon each switch of the true mode is noticed, run by run.

A *sojourn* is a stay of the truth in one mode. Its delay is 1 where the mode estimate (the most
probable mode; the first of equals) is right at the sojourn's first scan, which is the first that
the new mode affects. A switch is *missed* if the next one comes before the estimate was right;
at the end of the data it is unfinished, which tells less. A *false switch* leaves the right mode
within a sojourn. Where all runs have one truth, sojourns are numbered, 0 being the start; where
each has its own, they are put together by the modes before and after.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.compiled import lane_kernel
from hybridtrack.models import Array
from hybridtrack.statistics import Moments, SumMoments, merge_sum_moments, sum_moments

# Of runs that may be in a mode before the switch to it: beyond, the delay is that of no switch.
MOST_ALREADY = 0.25
LONGEST = 1000  # steps that a sojourn is followed for: later ones count as not noticed

Integers = NDArray[np.int64]
LANE, GROUP, DELAY, LASTED, FALSE, ENDED, ALREADY = range(7)  # what is noted of a sojourn


class Delays(NamedTuple):
    """Sojourns by group and by steps; a group is a switch, or a pair of modes.

    The first three are (n_groups, 1 + the most steps): how many were noticed after so many steps,
    how many lasted so long unnoticed until the next switch, or until there were no more data.
    """

    detected: Array
    missed: Array
    unfinished: Array
    already: Array  # (n_groups,) how many began when the estimate was the new mode already
    # Over runs: false switches, and sojourns; arrays (n_groups + 1,), the last of all together.
    false_switches: SumMoments


def merge_delays(a: Delays, b: Delays) -> Delays:
    """Of two groups of runs together."""
    return Delays(
        a.detected + b.detected,
        a.missed + b.missed,
        a.unfinished + b.unfinished,
        a.already + b.already,
        merge_sum_moments(a.false_switches, b.false_switches),
    )


class _Watch(NamedTuple):
    """Each lane's sojourn as it is now; arrays (lanes,)."""

    mode: Integers  # the truth's, as the truth counts; -2 before the first step
    group: Integers
    begun: Integers  # its first step
    delay: Integers  # 0: not noticed yet
    right: Integers  # whether the estimate was, a step ago
    false_switches: Integers
    estimate: Integers  # a step ago; -1: none
    already: Integers  # whether the estimate was the new mode before its sojourn began


@lane_kernel
def _follow(watch, probabilities, true_mode, table, numbered, step, runs, counts, events, noted):
    """Follow the lanes over a span that begins at `step`; gives the number of events noted.

    probabilities (n_steps, n_modes, lanes); true_mode (n_steps, lanes or 1); table: the estimator's
    number of each of the truth's modes; counts (n_modes, n_steps of the case): runs that estimate
    each mode; events (capacity, 7).
    """
    n_modes, lanes = probabilities.shape[1], probabilities.shape[2]
    n_true = table.size
    for k in range(probabilities.shape[0]):
        now = step + k + 1
        for b in range(lanes):
            best, largest = -1, -np.inf
            for j in range(n_modes):
                larger = probabilities[k, j, b] > largest
                best = j if larger else best
                largest = probabilities[k, j, b] if larger else largest
            if best >= 0 and b < runs:
                counts[best, now - 1] += 1.0
            mode = true_mode[k, b if true_mode.shape[1] > 1 else 0]
            before = watch.mode[b]
            if mode != before:
                if before >= 0:
                    events[noted, 0] = b
                    events[noted, 1] = watch.group[b]
                    events[noted, 2] = watch.delay[b]
                    events[noted, 3] = now - watch.begun[b]
                    events[noted, 4] = watch.false_switches[b]
                    events[noted, 5] = 1
                    events[noted, 6] = watch.already[b]
                    noted += 1
                if numbered:
                    watch.group[b] += 1
                elif before >= 0:
                    watch.group[b] = before * n_true + mode
                else:
                    watch.group[b] = mode * n_true + mode
                watch.mode[b] = mode
                watch.begun[b] = now
                watch.delay[b] = 0
                watch.right[b] = 0
                watch.false_switches[b] = 0
                known = before >= 0 and mode >= 0 and watch.estimate[b] >= 0
                watch.already[b] = 1 if known and table[mode] == watch.estimate[b] else 0
            right = 1 if mode >= 0 and table[mode] == best and best >= 0 else 0
            if right == 1 and watch.delay[b] == 0:
                watch.delay[b] = now - watch.begun[b] + 1
            if right == 0 and watch.right[b] == 1:
                watch.false_switches[b] += 1
            watch.right[b] = right
            watch.estimate[b] = best
    return noted


class DelayTally:
    """One estimator's mode estimates followed over one block of runs."""

    def __init__(
        self,
        truth_modes: tuple[str, ...],
        modes: tuple[str, ...],
        n_steps: int,
        lanes: int,
        runs: int,
        sojourns: Integers | None,
    ) -> None:
        """sojourns: the steps each lasts, where all runs have the same; else None."""
        self._table = np.array([modes.index(m) if m in modes else -1 for m in truth_modes])
        self._modes, self._runs, self._sojourns = modes, runs, sojourns
        zeros = (np.zeros(lanes, dtype=np.int64) for _ in range(7))
        self._watch = _Watch(np.full(lanes, -2), *zeros)
        self._counts = np.zeros((len(modes), n_steps))
        self._events: Integers = np.zeros((8 * lanes, 7), dtype=np.int64)
        self._noted = 0
        self._steps = 0  # those done

    def add(self, step: int, true_mode: Integers, probabilities: Array) -> None:
        """Follow a span that begins at `step` (from 0); true_mode (n_steps, lanes or 1)."""
        lanes = probabilities.shape[2]
        if self._steps == 0 and self._sojourns is not None:  # some scans may have made a start
            self._watch.group[:] = np.searchsorted(np.cumsum(self._sojourns), step, "right") - 1
        switches = np.count_nonzero(true_mode[1:] != true_mode[:-1]) + true_mode.shape[1]
        needed = self._noted + switches * (lanes // true_mode.shape[1])
        if needed > len(self._events):
            room = np.zeros((2 * needed, 7), dtype=np.int64)
            room[: self._noted] = self._events[: self._noted]
            self._events = room
        self._noted = _follow(
            self._watch,
            probabilities,
            true_mode,
            self._table,
            self._sojourns is not None,
            step,
            self._runs,
            self._counts,
            self._events,
            self._noted,
        )
        self._steps = step + len(probabilities)

    def shares(self) -> dict[str, Moments]:
        """By mode, the moments of its being the estimate, step by step."""
        n = self._counts.sum(axis=0)
        mean = np.divide(self._counts, n, out=np.zeros_like(self._counts), where=n > 0)
        return {
            mode: Moments(n, share, n * share * (1.0 - share))
            for mode, share in zip(self._modes, mean, strict=True)
        }

    def delays(self, sound: NDArray[np.bool_]) -> Delays:
        """What became of the sojourns of sound runs (runs,)."""
        watch = self._watch
        still = np.stack(
            [
                np.arange(len(watch.mode)),
                watch.group,
                watch.delay,
                self._steps + 1 - watch.begun,
                watch.false_switches,
                np.zeros_like(watch.mode),
                watch.already,
            ],
            axis=1,
        )
        events = np.concatenate([self._events[: self._noted], still[watch.mode >= 0]])
        events = events[events[:, LANE] < self._runs]
        events = events[sound[events[:, LANE]]]
        if self._sojourns is not None:
            groups, longest = len(self._sojourns), int(self._sojourns.max(initial=1))
        else:
            groups, longest = len(self._table) ** 2, self._counts.shape[1]
        longest = min(longest, LONGEST)
        noticed = (events[:, DELAY] > 0) & (events[:, DELAY] <= longest)
        ended = (events[:, ENDED] == 1) & (events[:, LASTED] <= longest)
        steps = np.minimum(np.where(noticed, events[:, DELAY], events[:, LASTED]), longest)
        cell = events[:, GROUP] * (longest + 1) + steps
        shape, size = (groups, longest + 1), groups * (longest + 1)
        detected, missed, unfinished = (
            np.bincount(cell[kind], minlength=size).reshape(shape).astype(np.float64)
            for kind in (noticed, ~noticed & ended, ~noticed & ~ended)
        )
        place = events[:, GROUP] * self._runs + events[:, LANE]
        false_switches, number = (
            np.bincount(place, weights=weights, minlength=groups * self._runs)
            .reshape(groups, self._runs)
            .astype(np.float64)
            for weights in (events[:, FALSE], None)
        )
        false_switches, number = (
            np.concatenate([part, part.sum(axis=0, keepdims=True)])
            for part in (false_switches, number)
        )
        everywhere = np.broadcast_to(sound, (groups + 1, self._runs))
        moments = sum_moments(false_switches, number, everywhere)
        already = np.bincount(events[:, GROUP], weights=events[:, ALREADY], minlength=groups)
        return Delays(detected, missed, unfinished, already.astype(np.float64), moments)


class Distribution(NamedTuple):
    """How the delays of a group are distributed; arrays by delay, from 1 on."""

    at_risk: Array  # sojourns that lasted so long unnoticed, this step included
    detected: Array
    probability: Array  # of a delay of at most so many steps
    standard_error: Array


def distribution(delays: Delays, group: int) -> Distribution:
    """The distribution with censored sojourns (Kaplan, Meier 1958; error: Greenwood 1926).

    A sojourn that ended unnoticed was at risk until its last step. Sojourns of one run count as
    independent.
    """
    detected = delays.detected[group, 1:]
    lost = (delays.missed + delays.unfinished)[group, 1:]
    gone = detected + lost
    at_risk = gone.sum() - np.concatenate([[0.0], np.cumsum(gone)[:-1]])
    with np.errstate(invalid="ignore", divide="ignore"):
        hazard = np.where(at_risk > 0, detected / at_risk, 0.0)
        survival = np.cumprod(1.0 - hazard)
        terms = np.where(at_risk > detected, detected / (at_risk * (at_risk - detected)), 0.0)
        error = survival * np.sqrt(np.cumsum(terms))
    probability = np.asarray(1.0 - survival, dtype=np.float64)
    return Distribution(at_risk, detected, probability, np.asarray(error, dtype=np.float64))
