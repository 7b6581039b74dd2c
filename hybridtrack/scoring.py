"""What estimates are worth: every quantity of a run and step, as rows of lanes on a sheet.

A *sheet* has one row per quantity and holds one step of one estimator. A new quantity is a metric
in `statistics.METRICS` and three things here: its row, the condition under which it exists (in
`defined`) and its formula (in `fill_sheet`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.compiled import lane_kernel, row_kernel, short_kernel
from hybridtrack.estimators import Estimates
from hybridtrack.models import Array
from hybridtrack.statistics import POSITION, POSITION_AT_SCANS, QUANTITIES, VELOCITY
from hybridtrack.vectors import aligned_zeros

ROUNDING = 1e-9  # likelihoods sum to 1; two filters that are one in theory differ by less

POSITION_ROW = QUANTITIES.index(POSITION)
AT_SCANS_ROW = QUANTITIES.index(POSITION_AT_SCANS)
VELOCITY_ROW = QUANTITIES.index(VELOCITY)
CORRECT_ROW = QUANTITIES.index("mode_correct")
BRIER_ROW = QUANTITIES.index("mode_brier")
TRUE_MODE_ROW = QUANTITIES.index("true_mode_probability")
DISTINCTNESS_ROW = QUANTITIES.index("likelihood_distinctness")
KEPT = "likelihood_advantage_kept"
KEPT_ROW = QUANTITIES.index(KEPT)
FINAL_ROW = QUANTITIES.index("final_mode_brier")
FINAL_PRIOR_ROW = QUANTITIES.index("final_mode_prior_brier")

Integers = NDArray[np.int64]


class Names(NamedTuple):
    """Names that tell which quantities exist."""

    truth_states: tuple[str, ...]
    truth_modes: tuple[str, ...]  # () where the truth has none
    states: tuple[str, ...]  # the estimator's
    modes: tuple[str, ...]  # the estimator's

    @property
    def scored_modes(self) -> tuple[str, ...]:
        """The estimator's modes, where there are several: one has no probabilities to score."""
        return self.modes if len(self.modes) > 1 else ()

    def axes(self, kind: str) -> Integers:
        """Where truth and estimate have the vector's common axes (n, 2); kind '' or 'v'."""
        both = [kind + a for a in "xyz" if {kind + a} <= {*self.truth_states} & {*self.states}]
        found = [(self.truth_states.index(name), self.states.index(name)) for name in both]
        return np.array(found, dtype=np.int64).reshape(-1, 2)

    def true_mode(self) -> Integers:
        """The estimator's index of each mode of the truth; -1 where it has none, and at the end."""
        table = [self.modes.index(n) if n in self.modes else -1 for n in self.truth_modes]
        return np.array([*table, -1], dtype=np.int64)  # the truth's -1, no mode, finds the last


class Given(NamedTuple):
    """What estimates hold besides means and mode probabilities, and what there is beside them."""

    likelihoods: bool = False  # of the modes
    final: bool = False  # the probability that the mode now is the last one
    leads: bool = False  # `compare_with` names this estimator, tallied before the others
    compared: bool = False  # the leading one has likelihoods too, whose advantage can be compared
    paired: bool = False  # there is another leading one, whose errors can be


NOTHING_MORE = Given()


def defined(names: Names, given: Given) -> tuple[str, ...]:
    """The quantities that exist, in the order in which they are tallied."""
    modes = bool(names.scored_modes)
    common = bool({*names.truth_modes} & {*names.scored_modes})
    position = bool(len(names.axes("")))
    exists = {
        POSITION: position,
        VELOCITY: bool(len(names.axes("v"))),
        POSITION_AT_SCANS: position,
        "likelihood_distinctness": modes and given.likelihoods,
        "mode_correct": common,
        "mode_brier": common,
        "true_mode_probability": common,
        KEPT: common and given.likelihoods and (given.leads or given.compared),
        "final_mode_brier": given.final and bool(names.truth_modes),
        "final_mode_prior_brier": given.final and bool(names.truth_modes),
    }
    return tuple(quantity for quantity in exists if exists[quantity])


class Layout(NamedTuple):
    """What the kernels have to know of the names."""

    tallied: Integers  # (n_tallied,) rows of the sheet, in the order of `defined`
    position: Integers  # (n_axes, 2) the truth's state, the estimate's
    velocity: Integers  # (n_axes, 2)
    true_mode: Integers  # (n_truth_modes + 1,) the estimator's mode by the truth's; -1 for none
    modes: int  # how many are scored
    likelihoods: bool  # these three: see Given
    leads: bool
    paired: bool
    told: bool  # whether the probability that the mode now is the last one is there ...
    final: bool  # ... and can be scored


class Sheet(NamedTuple):
    """One step of one estimator; scratch memory, overwritten from step to step."""

    rows: Array  # (n_quantities, lanes) in the order of QUANTITIES
    scratch: Array  # (4, lanes)
    true_mode: Integers  # (lanes,) as the estimator counts them
    # Of the estimator that `compare_with` names, for a whole span (n_steps, lanes):
    leading: Array  # likelihood advantage
    leading_position: Array  # squared errors
    leading_velocity: Array


def layout(names: Names, given: Given) -> Layout:
    """The same arguments for the kernels."""
    quantities = defined(names, given)
    return Layout(
        tallied=np.array([QUANTITIES.index(q) for q in quantities], dtype=np.int64),
        position=names.axes(""),
        velocity=names.axes("v"),
        true_mode=names.true_mode(),
        modes=len(names.scored_modes),
        likelihoods=given.likelihoods,
        leads=given.leads,
        paired=given.paired,
        told=given.final,
        final=given.final and bool(names.truth_modes),
    )


def blank_sheet(span_steps: int, lanes: int) -> Sheet:
    """A sheet for all estimators of a block."""
    return Sheet(
        rows=aligned_zeros(len(QUANTITIES), lanes),
        scratch=aligned_zeros(4, lanes),
        true_mode=aligned_zeros(lanes).view(np.int64),
        leading=aligned_zeros(span_steps, lanes),
        leading_position=aligned_zeros(span_steps, lanes),
        leading_velocity=aligned_zeros(span_steps, lanes),
    )


def as_measured(measurements: Array) -> Estimates:
    """The measurements themselves as an estimator's: a mean of positions, and nothing else."""
    nothing = np.empty((0, 0, measurements.shape[2]))
    return Estimates(measurements, nothing, nothing, nothing)


# ---- the formulas ----------------------------------------------------------------------------
# Loops over lanes stay short: one that reads and writes more than a few rows isn't vectorised,
# for the compiler would have to check that none of them overlap.


@row_kernel
def copy(out, row):
    for b in range(out.size):
        out[b] = row[b]


@row_kernel
def add_squared_difference(out, truth, row):
    """truth (lanes,), or (1,) where all runs have one. Infinite estimates count as NaN."""
    if truth.size == 1:
        for b in range(out.size):
            d = row[b] - truth[0]
            out[b] += d * d if abs(d) < np.inf else np.nan
    else:
        for b in range(out.size):
            d = row[b] - truth[b]
            out[b] += d * d if abs(d) < np.inf else np.nan


@lane_kernel
def squared_error(out, axes, truth, estimate):
    """Squared norm of the vector error; NaN where the estimate isn't finite."""
    for b in range(out.size):
        out[b] = 0.0
    for n in range(axes.shape[0]):
        add_squared_difference(out, truth[axes[n, 0]], estimate[axes[n, 1]])


@lane_kernel
def some_missed(measurement):
    """Whether any lane has a NaN."""
    missed = 0
    for m in range(measurement.shape[0]):
        for b in range(measurement.shape[1]):
            missed += 1 if measurement[m, b] != measurement[m, b] else 0
    return missed > 0


@row_kernel
def leave_out_missed(row, measurement):
    """NaN where a measurement, or a component of it, is missing."""
    for m in range(measurement.shape[0]):
        for b in range(row.size):
            row[b] = row[b] if measurement[m, b] == measurement[m, b] else np.nan


@lane_kernel
def find_true_mode(out, table, mode):
    """out <- table[mode]; mode (lanes,), or (1,) where all runs have one."""
    if mode.size == 1:
        only = table[mode[0]]
        for b in range(out.size):
            out[b] = only
    else:
        for b in range(out.size):
            out[b] = table[mode[b]]


@row_kernel
def pick(out, row, true_mode, i):
    """out <- row where the true mode is i."""
    for b in range(out.size):
        out[b] = row[b] if true_mode[b] == i else out[b]


@lane_kernel
def score_modes(correct, brier, own, probabilities, true_mode, largest):
    """Accuracy (0 or 1; the first of equals wins), Brier score, probability of the true mode.

    All NaN where the true mode is unknown or a probability is NaN.
    """
    lanes = own.size
    for b in range(lanes):
        largest[b] = -np.inf
        brier[b] = 0.0
        own[b] = np.nan
    for i in range(probabilities.shape[0]):
        for b in range(lanes):
            p = probabilities[i, b]
            here = true_mode[b] == i
            d = p - (1.0 if here else 0.0)
            brier[b] += 0.5 * d * d
            own[b] = p if here else own[b]
            larger = p > largest[b]
            correct[b] = (1.0 if here else 0.0) if larger else correct[b]
            largest[b] = p if larger else largest[b]
    for b in range(lanes):
        known = (true_mode[b] >= 0) & (brier[b] == brier[b])
        correct[b] = correct[b] if known else np.nan
        brier[b] = brier[b] if known else np.nan
        own[b] = own[b] if known else np.nan


@lane_kernel
def score_likelihoods(distinctness, advantage, likelihoods, true_mode, scratch):
    """Gap between the two largest; the true mode's lead over the best of the others."""
    lanes = distinctness.size
    first, second, others = scratch[0], scratch[1], scratch[2]
    for b in range(lanes):
        first[b] = -np.inf
        second[b] = -np.inf
        others[b] = -np.inf
        advantage[b] = np.nan
    for i in range(likelihoods.shape[0]):
        for b in range(lanes):
            value = likelihoods[i, b]
            beaten = value if value > second[b] else second[b]
            second[b] = first[b] if value > first[b] else beaten
            first[b] = value if value > first[b] else first[b]
        for b in range(lanes):
            value = likelihoods[i, b]
            better = (true_mode[b] != i) & (value > others[b])
            others[b] = value if better else others[b]
        pick(advantage, likelihoods[i], true_mode, i)
    for b in range(lanes):
        distinctness[b] = first[b] - second[b]
    for b in range(lanes):
        advantage[b] -= others[b]


@lane_kernel
def compare_advantages(kept, own, leading):
    """1 where the true mode leads by as much as under the leading estimator, or more; else 0."""
    for b in range(kept.size):
        known = (own[b] == own[b]) & (leading[b] == leading[b])
        enough = 1.0 if own[b] >= leading[b] - ROUNDING else 0.0
        kept[b] = enough if known else np.nan


@lane_kernel
def score_final_mode(brier, prior_brier, probability, prior, final):
    """Squared errors of the posterior and of the prior; final (lanes,), or (1,)."""
    for b in range(brier.size):
        brier[b] = probability[b]
        prior_brier[b] = prior if probability[b] == probability[b] else np.nan
    if final.size == 1:
        for b in range(brier.size):
            brier[b] -= final[0]
            prior_brier[b] -= final[0]
    else:
        for b in range(brier.size):
            brier[b] -= final[b]
        for b in range(brier.size):
            prior_brier[b] -= final[b]
    for b in range(brier.size):
        brier[b] *= brier[b]
        prior_brier[b] *= prior_brier[b]


@row_kernel
def subtract(out, row, other):
    for b in range(out.size):
        out[b] = row[b] - other[b]


@row_kernel
def fill_sheet(sheet, layout, k, scans, estimates, missed):
    """Every quantity of step k of a span; what isn't defined is left as it is.

    missed: whether any lane's scan is.
    """
    rows, truth, measurement = sheet.rows, scans.truth, scans.measurements[k]
    if layout.position.shape[0]:
        squared_error(rows[POSITION_ROW], layout.position, truth.state[k], estimates.mean[k])
        copy(rows[AT_SCANS_ROW], rows[POSITION_ROW])
        if missed:
            leave_out_missed(rows[AT_SCANS_ROW], measurement)
    if layout.velocity.shape[0]:
        squared_error(rows[VELOCITY_ROW], layout.velocity, truth.state[k], estimates.mean[k])
    if layout.modes:
        find_true_mode(sheet.true_mode, layout.true_mode, truth.mode[k])
        score_modes(
            rows[CORRECT_ROW],
            rows[BRIER_ROW],
            rows[TRUE_MODE_ROW],
            estimates.mode_probabilities[k],
            sheet.true_mode,
            sheet.scratch[0],
        )
        if layout.likelihoods:
            advantage = sheet.scratch[3]
            likelihoods = estimates.mode_likelihoods[k]
            distinctness = rows[DISTINCTNESS_ROW]
            score_likelihoods(distinctness, advantage, likelihoods, sheet.true_mode, sheet.scratch)
            if missed:
                leave_out_missed(distinctness, measurement)
                leave_out_missed(advantage, measurement)
            for b in range(advantage.size):
                known = rows[TRUE_MODE_ROW, b] == rows[TRUE_MODE_ROW, b]
                advantage[b] = advantage[b] if known else np.nan
            if layout.leads:
                copy(sheet.leading[k], advantage)
            compare_advantages(rows[KEPT_ROW], advantage, sheet.leading[k])
    if layout.final:
        score_final_mode(
            rows[FINAL_ROW],
            rows[FINAL_PRIOR_ROW],
            estimates.final_mode_probability[k],
            estimates.final_mode_prior[k, 0],
            truth.final[k],
        )
    if layout.leads and layout.position.shape[0]:
        copy(sheet.leading_position[k], rows[POSITION_ROW])
    if layout.leads and layout.velocity.shape[0]:
        copy(sheet.leading_velocity[k], rows[VELOCITY_ROW])


@short_kernel
def all_below(values, limit):
    """Whether every |value| of (n_steps, n, lanes) is below the limit, which NaN isn't."""
    beyond = 0
    for k in range(values.shape[0]):
        for e in range(values.shape[1]):
            for b in range(values.shape[2]):
                beyond += 0 if abs(values[k, e, b]) < limit else 1
    return beyond == 0
