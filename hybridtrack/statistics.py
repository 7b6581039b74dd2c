"""Monte Carlo statistics: quantities per run and step, running moments, metrics with their errors.

A *quantity* is what a run gives at a step (a squared error, a 0 or 1). A *metric* is a function of
its mean over runs and steps (a root mean square, an accuracy). Means are ratios of sums, so that
runs may contribute different numbers of steps; standard errors are by the delta method over runs.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.models import Array


class Metric(NamedTuple):
    """A metric of a run, as tables and claims name it."""

    quantity: str
    root: bool  # the square root of the mean, or the mean itself
    better: str  # less | greater
    summary: str


METRICS: Mapping[str, Metric] = {
    "position_rmse_m": Metric(
        "position_squared_error_m2", True, "less", "root mean square error of the position vector"
    ),
    "velocity_rmse_m_s": Metric(
        "velocity_squared_error_m2_s2", True, "less", "root mean square error of the velocity"
    ),
    "position_mse_m2": Metric(
        "position_squared_error_m2", False, "less", "mean square error of the position vector"
    ),
    "velocity_mse_m2_s2": Metric(
        "velocity_squared_error_m2_s2", False, "less", "mean square error of the velocity vector"
    ),
    "mode_accuracy": Metric(
        "mode_correct", False, "greater", "share of steps whose most probable mode is the true one"
    ),
    "mode_brier": Metric(
        "mode_brier", False, "less", "half the squared error of the mode probabilities, 0 to 1"
    ),
    "true_mode_probability": Metric(
        "true_mode_probability", False, "greater", "probability given to the true mode"
    ),
    "likelihood_distinctness": Metric(
        "likelihood_distinctness",
        False,
        "greater",
        "gap between the two largest normalised likelihoods of the modes",
    ),
    "likelihood_advantage_kept": Metric(
        "likelihood_advantage_kept",
        False,
        "greater",
        "share of steps whose true mode leads by as much as under `compare_with`, or more",
    ),
    "final_mode_brier": Metric(
        "final_mode_brier",
        False,
        "less",
        "squared error of the probability that the mode now is the last one",
    ),
    "final_mode_prior_brier": Metric(
        "final_mode_prior_brier",
        False,
        "less",
        "the same of the chain's own probability, which knows the time and no scan",
    ),
}

# A figure of a whole window, not a mean over its runs and steps; see reliability.
CALIBRATION = "final_mode_calibration_error"

# Of a whole run too: how often an estimate leaves the right mode while the truth stays in it.
FALSE_SWITCHES = "false_switches_per_stay"

# The position error at the scans that were not missed: what compares with the measurements.
POSITION, POSITION_AT_SCANS = "position_squared_error_m2", "position_squared_error_at_scans_m2"
VELOCITY = "velocity_squared_error_m2_s2"
QUANTITIES = (*dict.fromkeys(metric.quantity for metric in METRICS.values()), POSITION_AT_SCANS)


# ---- running moments -------------------------------------------------------------------------


class Moments(NamedTuple):
    """Number n, mean and sum of squared deviations of many series; arrays of one shape."""

    n: Array
    mean: Array
    squares: Array


class SumMoments(NamedTuple):
    """The same for pairs (sum over a run's steps, their number), of which metrics are ratios."""

    n: Array
    mean_sum: Array
    mean_number: Array
    sum_squares: Array
    products: Array
    number_squares: Array


def merge_moments(a: Moments, b: Moments) -> Moments:
    """Moments of two groups together (Chan, Golub, LeVeque 1983, eq. 2.1)."""
    count = a.n + b.n
    share = np.divide(b.n, count, out=np.zeros_like(count), where=count > 0)
    step = b.mean - a.mean
    return Moments(count, a.mean + share * step, a.squares + b.squares + a.n * share * step**2)


def merge_sum_moments(a: SumMoments, b: SumMoments) -> SumMoments:
    """Chan's merging for pairs."""
    count = a.n + b.n
    share = np.divide(b.n, count, out=np.zeros_like(count), where=count > 0)
    step, other = b.mean_sum - a.mean_sum, b.mean_number - a.mean_number
    weight = a.n * share
    return SumMoments(
        count,
        a.mean_sum + share * step,
        a.mean_number + share * other,
        a.sum_squares + b.sum_squares + weight * step**2,
        a.products + b.products + weight * step * other,
        a.number_squares + b.number_squares + weight * other**2,
    )


def sum_moments(sums: Array, numbers: Array, sound: NDArray[np.bool_]) -> SumMoments:
    """Moments over the last axis (runs) of sums and numbers (..., runs); sound (..., runs)."""
    count = sound.sum(axis=-1).astype(np.float64)
    divisor = np.maximum(count, 1.0)
    s, m = np.where(sound, sums, 0.0), np.where(sound, numbers, 0.0)
    mean_sum, mean_number = s.sum(axis=-1) / divisor, m.sum(axis=-1) / divisor
    ds = np.where(sound, s - mean_sum[..., None], 0.0)
    dm = np.where(sound, m - mean_number[..., None], 0.0)
    return SumMoments(
        count,
        mean_sum,
        mean_number,
        (ds * ds).sum(axis=-1),
        (ds * dm).sum(axis=-1),
        (dm * dm).sum(axis=-1),
    )


# ---- metrics with their errors ---------------------------------------------------------------


class Estimate(NamedTuple):
    """A figure with its standard error over runs (NaN for fewer than two)."""

    value: float
    standard_error: float
    n_runs: int


NOTHING = Estimate(math.nan, math.nan, 0)


def ratio_of_sums(cases: Sequence[tuple[float, ...]], root: bool) -> Estimate:
    """Mean (or its root) of a quantity pooled over cases, from each case's SumMoments scalars.

    Cases are strata: runs vary within them, and the errors add up as variances.
    """
    total = sum(c[0] * c[1] for c in cases)
    number = sum(c[0] * c[2] for c in cases)
    runs = round(sum(c[0] for c in cases))
    if number == 0.0 or runs == 0:
        return NOTHING
    ratio = total / number
    variance = 0.0
    for count, _, _, ss, sn, nn in cases:
        spread = max(ss - 2 * ratio * sn + ratio**2 * nn, 0.0)
        variance += count * spread / (count - 1) if count > 1 else (math.nan if count else 0.0)
    error = math.sqrt(variance) / number
    if not root:
        return Estimate(ratio, error, runs)
    value = math.sqrt(ratio)
    return Estimate(value, error / (2 * value) if value > 0 else 0.0, runs)


class Reliability(NamedTuple):
    """Probabilities held against what came of them, bin by bin; arrays (bins,), NaN where empty."""

    share: Array  # of all steps
    probability: Array  # mean of those given
    frequency: Array  # how often the event came
    standard_error: Array  # of the frequency, over runs
    calibration_error: Estimate  # mean distance of the two, weighed by the share (ECE)


def reliability(cases: Sequence["VectorMoments"]) -> Reliability:
    """From each case's moments of a run's sums by bins: numbers, probabilities, events (3 bins,).

    The expected calibration error is that of Naeini, Cooper, Hauskrecht 2015. Noise makes it a
    little too large: an honest bin is off by its own standard error. Errors by the delta method
    over runs; cases are strata.
    """
    n = sum(float(case.n) for case in cases)
    total = np.sum([case.n * case.mean for case in cases], axis=0)
    # A sum over n runs varies n times as much as one run does.
    variance = np.sum([c.n * c.products / np.maximum(c.n - 1.0, 1.0) for c in cases], axis=0)
    number, probability, events = total.reshape(3, -1)
    bins, steps = number.size, float(number.sum())
    if steps == 0:
        nothing = np.full(bins, np.nan)
        return Reliability(nothing, nothing, nothing, nothing, NOTHING)
    with np.errstate(invalid="ignore", divide="ignore"):
        frequency = events / number
        spread = variance.reshape(3, bins, 3, bins)
        i = np.arange(bins)
        of_bin = spread[2, i, 2, i] - 2 * frequency * spread[0, i, 2, i]
        of_bin += frequency**2 * spread[0, i, 0, i]
        error = np.sqrt(np.maximum(of_bin, 0.0)) / number
        mean = probability / number
    gap = probability - events
    value = float(np.abs(gap).sum()) / steps
    slope = np.concatenate([np.full(bins, -value), np.sign(gap), -np.sign(gap)]) / steps
    calibration = math.sqrt(max(float(slope @ variance @ slope), 0.0))
    if n < 2:
        error, calibration = np.full(bins, np.nan), math.nan
    estimate = Estimate(value, calibration, round(n))
    return Reliability(number / steps, mean, frequency, error, estimate)


class RunSums(NamedTuple):
    """One estimator's sums in one window, run by run, in one order for all; leading axes free."""

    sums: Array  # (..., n_runs)
    numbers: Array  # (..., n_runs)
    sound: NDArray[np.bool_]  # (n_runs,) False where the run diverged


class Paired(NamedTuple):
    """Two estimators over the same runs; a run that diverged under either is left out of both."""

    first: float
    second: float
    difference: Estimate  # first - second
    ratio: Estimate  # first / second


class VectorMoments(NamedTuple):
    """Moments over one case's runs of vectors, a vector a run."""

    n: Array  # (...)
    mean: Array  # (..., size)
    products: Array  # (..., size, size) sums of products of deviations


def pair_moments(first: RunSums, second: RunSums) -> VectorMoments:
    """Moments of (S1, N1, S1 - S2, N1 - N2): sums and numbers of steps of two.

    A run that diverged under either is left out of both. The differences stand for the second
    estimator, so that two alike have an error of exactly 0.
    """
    both = first.sound & second.sound & (first.numbers > 0) & (second.numbers > 0)
    s, m = first.sums, first.numbers
    with np.errstate(invalid="ignore"):  # of runs that are left out
        values = np.stack([s, m, s - second.sums, m - second.numbers], axis=-2)
    return vector_moments(values, both)


def vector_moments(values: Array, counted: NDArray[np.bool_]) -> VectorMoments:
    """Moments of values (..., size, n_runs) over the runs that are counted (..., n_runs)."""
    n = counted.sum(axis=-1).astype(np.float64)
    counted = counted[..., np.newaxis, :]
    mean = np.where(counted, values, 0.0).sum(axis=-1) / np.maximum(n, 1.0)[..., np.newaxis]
    deviations = np.where(counted, values - mean[..., np.newaxis], 0.0)
    return VectorMoments(n, mean, deviations @ np.swapaxes(deviations, -1, -2))


def merge_vectors(a: VectorMoments, b: VectorMoments) -> VectorMoments:
    """Both together (Chan's merging)."""
    n = a.n + b.n
    share = np.divide(b.n, n, out=np.zeros_like(n), where=n > 0)[..., np.newaxis]
    step = b.mean - a.mean
    outer = step[..., :, np.newaxis] * step[..., np.newaxis, :]
    weight = (a.n[..., np.newaxis] * share)[..., np.newaxis]
    return VectorMoments(n, a.mean + share * step, a.products + b.products + weight * outer)


def compare(cases: Sequence[VectorMoments], root: bool) -> Paired:
    """Difference and ratio of a metric over the same runs, with paired standard errors.

    From each case's moments of one pair, without leading axes. By the delta method; cases are
    strata.
    """
    pairs = [pair for pair in cases if pair.n]
    n = float(sum(pair.n for pair in pairs))
    if n == 0:
        return Paired(math.nan, math.nan, NOTHING, NOTHING)
    s, m, ds, dm = np.sum([pair.n * pair.mean for pair in pairs], axis=0) / n
    value_1, slope_1 = _metric(float(s), float(m), root)
    value_2, slope_2 = _metric(float(s - ds), float(m - dm), root)

    def error(weight_1: float, weight_2: float) -> float:
        """Standard error of weight_1 first + weight_2 second."""
        one, two = weight_1 * slope_1, weight_2 * slope_2
        coefficients = np.concatenate([one + two, -two])
        variance = 0.0
        for pair in pairs:
            spread = max(float(coefficients @ pair.products @ coefficients), 0.0)
            runs = float(pair.n)
            variance += runs * spread / (runs - 1) if runs > 1 else math.nan
        return math.sqrt(variance) / n

    difference = Estimate(value_1 - value_2, error(1.0, -1.0), round(n))
    if value_2 == 0.0:
        return Paired(value_1, value_2, difference, NOTHING)
    ratio = value_1 / value_2
    relative = error(1.0 / value_2, -ratio / value_2)
    return Paired(value_1, value_2, difference, Estimate(ratio, relative, round(n)))


def _metric(total: float, number: float, root: bool) -> tuple[float, Array]:
    """The metric of mean sum and mean number, and its derivatives by them."""
    ratio = total / number
    slope = np.array([1.0, -ratio]) / number
    if not root:
        return ratio, slope
    value = math.sqrt(ratio)
    return value, slope / (2 * value) if value > 0 else np.zeros(2)
