"""Scores added up span by span, while they are in the cache.

One compiled pass goes over the steps of a span. At each it fills the sheet and adds its rows to
the moments of that step and to every run's sums over the windows that hold it.
"""

import functools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.compiled import lane_kernel, row_kernel
from hybridtrack.estimators import Estimates
from hybridtrack.models import Array
from hybridtrack.scoring import (
    KEPT,
    NOTHING_MORE,
    POSITION_ROW,
    VELOCITY_ROW,
    Given,
    Layout,
    Names,
    Sheet,
    copy,
    defined,
    fill_sheet,
    layout,
    leave_out_missed,
    some_missed,
    subtract,
)
from hybridtrack.simulation import Scans
from hybridtrack.statistics import POSITION, POSITION_AT_SCANS, VELOCITY, Moments
from hybridtrack.vectors import aligned_zeros

BINS = 10  # of probabilities from 0 to 1, to hold them against frequencies
DIFFERENCE = ":difference"  # of a quantity from the leading estimator's, run by run


class Totals(NamedTuple):
    """What the rows add up to; first the tallied quantities, then series over steps alone."""

    n: Array  # (n_series, n_steps)
    mean: Array  # (n_series, n_steps)
    squares: Array  # (n_series, n_steps)
    sums: Array  # (n_tallied, n_windows, lanes)
    numbers: Array  # (n_tallied, n_windows, lanes) steps counted run by run
    common: Array  # (n_tallied, n_windows) steps counted for all runs at once
    # (3, BINS or 0, lanes) by the probability that the mode now is the last one: the number of
    # steps, the sum of those probabilities, and how often it was the last one
    final_bins: Array


@row_kernel
def add_to_step(row, runs, totals, i, step):
    """Note the moments of a row's first runs, NaN left out; true where all of them are finite."""
    total = 0.0
    for b in range(runs):
        total += row[b]
    finite = abs(total) < np.inf
    deviation = 0.0
    if finite:  # nearly always: NaN and infinity would have spoilt the sum
        n = float(runs)
        centre = total / n
        for b in range(runs):
            d = row[b] - centre
            deviation += d * d
    else:
        present = 0
        total = 0.0
        for b in range(runs):
            value = row[b]
            present += 1 if value == value else 0
            total += value if value == value else 0.0
        n = float(present)
        centre = total / n if present else 0.0
        for b in range(runs):
            value = row[b]
            d = value - centre if value == value else 0.0
            deviation += d * d
    totals.n[i, step] = n
    totals.mean[i, step] = centre
    totals.squares[i, step] = deviation
    return finite


@row_kernel
def add_to_windows(row, finite, held, sums, numbers, common):
    """Add a row to the sums of the windows that hold its step, NaN left out.

    held (n_windows, lanes), or (n_windows, 1) where all runs have the same windows.
    """
    for w in range(held.shape[0]):
        if held.shape[1] > 1:
            for b in range(row.size):
                present = held[w, b] & (row[b] == row[b])
                sums[w, b] += row[b] if present else 0.0
                numbers[w, b] += 1.0 if present else 0.0
        elif held[w, 0] and finite:
            common[w] += 1.0
            for b in range(row.size):
                sums[w, b] += row[b]
        elif held[w, 0]:
            for b in range(row.size):
                present = row[b] == row[b]
                sums[w, b] += row[b] if present else 0.0
                numbers[w, b] += 1.0 if present else 0.0


@row_kernel
def add_to_bins(bins, probability, final, held):
    """Add a step's probabilities, and what came of them; held and final (lanes,) or (1,)."""
    for b in range(probability.size):
        p = probability[b]
        if held[b if held.size > 1 else 0] and p == p:
            i = min(int(p * BINS), BINS - 1)
            bins[0, i, b] += 1.0
            bins[1, i, b] += p
            bins[2, i, b] += final[b if final.size > 1 else 0]


@lane_kernel
def tally(totals, sheet, layout, step, runs, scans, held, estimates):
    """Score a span that begins at `step` and add it to the totals."""
    n_tallied = layout.tallied.size
    for k in range(estimates.mean.shape[0]):
        measurement = scans.measurements[k]
        missed = some_missed(measurement)
        fill_sheet(sheet, layout, k, scans, estimates, missed)
        for i in range(n_tallied):
            row = sheet.rows[layout.tallied[i]]
            finite = add_to_step(row, runs, totals, i, step + k)
            add_to_windows(
                row, finite, held[k], totals.sums[i], totals.numbers[i], totals.common[i]
            )
        i = n_tallied
        for j in range(layout.modes):
            add_to_step(estimates.mode_probabilities[k, j], runs, totals, i, step + k)
            i += 1
            if layout.likelihoods:
                likelihood = estimates.mode_likelihoods[k, j]
                if missed:
                    copy(sheet.scratch[0], likelihood)
                    likelihood = sheet.scratch[0]
                    leave_out_missed(likelihood, measurement)
                add_to_step(likelihood, runs, totals, i, step + k)
                i += 1
        if layout.paired:
            if layout.position.shape[0]:
                subtract(sheet.scratch[0], sheet.rows[POSITION_ROW], sheet.leading_position[k])
                add_to_step(sheet.scratch[0], runs, totals, i, step + k)
                i += 1
            if layout.velocity.shape[0]:
                subtract(sheet.scratch[0], sheet.rows[VELOCITY_ROW], sheet.leading_velocity[k])
                add_to_step(sheet.scratch[0], runs, totals, i, step + k)
                i += 1
        if layout.told:
            probability = estimates.final_mode_probability[k]
            add_to_step(probability, runs, totals, i, step + k)
            totals.n[i + 1, step + k] = runs
            totals.mean[i + 1, step + k] = estimates.final_mode_prior[k, 0]
            if layout.final:
                add_to_bins(totals.final_bins, probability, scans.truth.final[k], held[k, 0])


class Plan(NamedTuple):
    """What a tally counts, by name and as the kernels have it."""

    quantities: tuple[str, ...]
    series: tuple[str, ...]  # the quantities, then what has moments over steps alone
    layout: Layout


@functools.lru_cache
def plan(names: Names, given: Given) -> Plan:
    """Blocks have it in common."""
    quantities, kernels = defined(names, given), layout(names, given)
    kinds = ("mode_probability", "mode_likelihood") if given.likelihoods else ("mode_probability",)
    series = [f"{kind}:{mode}" for mode in names.scored_modes for kind in kinds]
    if given.paired:
        series += [
            quantity + DIFFERENCE for quantity in (POSITION, VELOCITY) if quantity in quantities
        ]
    if kernels.told:
        series += ["final_mode_probability", "final_mode_prior"]
    return Plan(quantities, (*quantities, *series), kernels)


class Tally:
    """One estimator's scores over one block of runs."""

    def __init__(
        self,
        names: Names,
        n_steps: int,
        windows: tuple[str, ...],
        sheet: Sheet,
        runs: int,
        given: Given = NOTHING_MORE,
    ) -> None:
        """The sheet may be shared; runs: how many of its lanes count."""
        self._plan = plan(names, given)
        self._windows = windows
        self._sheet = sheet
        self._runs = runs
        self.has_advantage = KEPT in self._plan.quantities
        series = (len(self._plan.series), n_steps)
        cells = (len(self._plan.quantities), len(windows))
        lanes = sheet.rows.shape[1]
        self._totals = Totals(
            n=np.zeros(series),
            mean=np.zeros(series),
            squares=np.zeros(series),
            sums=aligned_zeros(*cells, lanes),
            numbers=aligned_zeros(*cells, lanes),
            common=np.zeros(cells),
            final_bins=aligned_zeros(3, BINS if self._plan.layout.final else 0, lanes),
        )

    def add(self, step: int, scans: Scans, held: NDArray[np.bool_], estimates: Estimates) -> None:
        """Score a span that begins at `step`; held (n_steps, n_windows, lanes or 1)."""
        arguments = (self._totals, self._sheet, self._plan.layout, step, self._runs)
        tally(*arguments, scans, held, estimates)

    def steps(self) -> Iterator[tuple[str, Moments]]:
        """Each quantity's moments at every step (n_steps,)."""
        n, mean, squares = self._totals[:3]
        for i, name in enumerate(self._plan.series):
            if name != POSITION_AT_SCANS:
                yield name, Moments(n[i], mean[i], squares[i])

    def sums(self) -> Iterator[tuple[tuple[str, str], tuple[Array, Array]]]:
        """By window and quantity, the runs' sums (runs,) and how many steps each has."""
        numbers = self._totals.numbers + self._totals.common[..., np.newaxis]
        both = (array[..., : self._runs] for array in (self._totals.sums, numbers))
        for quantity, *by_window in zip(self._plan.quantities, *both, strict=True):
            for window, *totals in zip(self._windows, *by_window, strict=True):
                yield (window, quantity), (totals[0], totals[1])

    @property
    def final_bins(self) -> Array:
        """Each run's sums by bins (3 * BINS, runs), see Totals; no rows where there are none."""
        return self._totals.final_bins.reshape(-1, self._totals.final_bins.shape[-1])[
            :, : self._runs
        ]
