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

from hybridtrack.compiled import kernel
from hybridtrack.estimators import Estimates
from hybridtrack.models import Array
from hybridtrack.simulation import Modes, Scans, TruthSpan


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
}

ROUNDING = 1e-9  # likelihoods sum to 1; two filters that are one in theory differ by less

# The position error at the scans that were not missed: what compares with the measurements.
POSITION, POSITION_AT_SCANS = "position_squared_error_m2", "position_squared_error_at_scans_m2"
QUANTITIES = (*dict.fromkeys(metric.quantity for metric in METRICS.values()), POSITION_AT_SCANS)


# ---- one span scored -------------------------------------------------------------------------


class Names(NamedTuple):
    """Names that tell which quantities exist."""

    truth_states: tuple[str, ...]
    truth_modes: tuple[str, ...]  # () where the truth has none
    states: tuple[str, ...]  # the estimator's
    modes: tuple[str, ...]  # the estimator's; one mode has no probabilities to score


class Scores(NamedTuple):
    """What a span of estimates is worth: arrays (n_steps, lanes), NaN where not defined."""

    quantities: dict[str, Array]
    likelihood_advantage: Array | None  # of the true mode over the best of the others


def squared_error(
    truth: Array, truth_states: tuple[str, ...], estimate: Array, states: tuple[str, ...], kind: str
) -> Array | None:
    """Squared norm of the vector error over the axes that both know; kind '' or 'v'.

    NaN where the estimate isn't finite, infinite where only its square isn't.
    """
    axes = [kind + axis for axis in "xyz" if kind + axis in truth_states and kind + axis in states]
    if not axes:
        return None
    total = np.zeros((estimate.shape[0], estimate.shape[2]))
    for name in axes:
        difference = estimate[:, states.index(name)] - truth[:, truth_states.index(name)]
        difference[np.isinf(difference)] = np.nan
        with np.errstate(over="ignore"):
            difference *= difference
            total += difference
    return total


def score_measurements(scans: Scans, truth_states: tuple[str, ...]) -> dict[str, Array]:
    """The raw measurements' own error, by the quantities that they have."""
    states = tuple("xyz"[: scans.measurements.shape[1]])
    error = squared_error(scans.truth.state, truth_states, scans.measurements, states, "")
    return {} if error is None else {POSITION: error, POSITION_AT_SCANS: error}


def score(scans: Scans, estimates: Estimates, names: Names) -> Scores:
    """Quantities of a span of estimates, by name; absent where the names don't carry them."""
    quantities: dict[str, Array] = {}
    for kind, quantity in (("", POSITION), ("v", "velocity_squared_error_m2_s2")):
        error = squared_error(
            scans.truth.state, names.truth_states, estimates.mean, names.states, kind
        )
        if error is not None:
            quantities[quantity] = error
    if POSITION in quantities:
        missed = np.isnan(scans.measurements).any(axis=1)
        quantities[POSITION_AT_SCANS] = np.where(missed, np.nan, quantities[POSITION])
    if len(names.modes) < 2:
        return Scores(quantities, None)
    steps, _, lanes = estimates.mode_probabilities.shape
    out = np.empty((5, steps, lanes))
    true_mode = _true_mode(scans.truth, names)
    arguments = (estimates.mode_probabilities, estimates.mode_likelihoods, scans.measurements)
    score_modes(*arguments, true_mode, out)
    if estimates.mode_likelihoods.shape[0]:
        quantities["likelihood_distinctness"] = out[3]
    if not set(names.truth_modes) & set(names.modes):
        return Scores(quantities, None)
    quantities["mode_correct"] = out[0]
    quantities["mode_brier"] = out[1]
    quantities["true_mode_probability"] = out[2]
    return Scores(quantities, out[4] if estimates.mode_likelihoods.shape[0] else None)


def _true_mode(truth: TruthSpan, names: Names) -> Modes:
    """The true mode (n_steps, lanes or 1) as an index into the estimator's; -1 where none is."""
    table = [names.modes.index(n) if n in names.modes else -1 for n in names.truth_modes]
    index: Modes = np.array([*table, -1])[truth.mode]  # -1, no true mode, finds the last entry
    return np.ascontiguousarray(index)


@kernel
def score_modes(probabilities, likelihoods, measurements, true_mode, out):
    """Correct (0 or 1), Brier score, probability of the true mode, distinctness, advantage.

    out (5, n_steps, lanes). NaN where the true mode is unknown, where an estimate isn't finite,
    and for the last two where the scan is missing or there are no likelihoods.
    """
    n_steps, n_modes, lanes = probabilities.shape
    for k in range(n_steps):
        for b in range(lanes):
            j = true_mode[k, b if true_mode.shape[1] > 1 else 0]
            best = 0
            brier = 0.0
            total = 0.0
            for i in range(n_modes):
                p = probabilities[k, i, b]
                total += p
                brier += 0.5 * (p - (1.0 if i == j else 0.0)) ** 2
                if p > probabilities[k, best, b]:
                    best = i
            unknown = j < 0 or total != total
            out[0, k, b] = np.nan if unknown else (1.0 if best == j else 0.0)
            out[1, k, b] = np.nan if unknown else brier
            out[2, k, b] = np.nan if unknown else probabilities[k, j, b]
            missed = likelihoods.shape[0] == 0
            for m in range(measurements.shape[1]):
                missed = missed or measurements[k, m, b] != measurements[k, m, b]
            out[3, k, b] = np.nan
            out[4, k, b] = np.nan
            if not missed:
                first = -np.inf
                second = -np.inf
                others = -np.inf
                for i in range(n_modes):
                    value = likelihoods[k, i, b]
                    if value > first:
                        second = first
                        first = value
                    elif value > second:
                        second = value
                    if i != j and value > others:
                        others = value
                out[3, k, b] = first - second
                if not unknown:
                    out[4, k, b] = likelihoods[k, j, b] - others


def advantage_kept(own: Array, reference: Array) -> Array:
    """1 where the true mode leads by at least as much as under the reference, 0 where less."""
    kept = (own >= reference - ROUNDING).astype(np.float64)
    kept[np.isnan(own) | np.isnan(reference)] = np.nan
    return kept


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


@kernel
def accumulate_steps(values, runs, count, mean, squares):
    """Moments over the first `runs` lanes at each step; values (n_steps, lanes), NaN left out."""
    for k in range(values.shape[0]):
        n = 0.0
        total = 0.0
        for b in range(runs):
            present = values[k, b] == values[k, b]
            n += 1.0 if present else 0.0
            total += values[k, b] if present else 0.0
        centre = total / n if n > 0.0 else 0.0
        deviation = 0.0
        for b in range(runs):
            d = values[k, b] - centre if values[k, b] == values[k, b] else 0.0
            deviation += d * d
        count[k] = n
        mean[k] = centre
        squares[k] = deviation


@kernel
def accumulate_window(values, inside, runs, sums, numbers):
    """Sums and numbers of steps per run; inside (n_steps, lanes or 1), NaN left out."""
    for k in range(values.shape[0]):
        for b in range(runs):
            here = inside[k, b if inside.shape[1] > 1 else 0]
            if here and values[k, b] == values[k, b]:
                sums[b] += values[k, b]
                numbers[b] += 1.0


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


class PairMoments(NamedTuple):
    """Moments over one case's runs of (S1, N1, S1 - S2, N1 - N2): sums and numbers of steps of two.

    The differences stand for the second estimator, so that two alike have an error of exactly 0.
    """

    n: Array  # (...)
    mean: Array  # (..., 4)
    products: Array  # (..., 4, 4) sums of products of deviations


def pair_moments(first: RunSums, second: RunSums) -> PairMoments:
    """Moments of a pair; a run that diverged under either is left out of both."""
    both = first.sound & second.sound & (first.numbers > 0) & (second.numbers > 0)
    counted = both[..., np.newaxis, :]
    s, m = first.sums, first.numbers
    with np.errstate(invalid="ignore"):  # of runs that are left out
        values = np.stack([s, m, s - second.sums, m - second.numbers], axis=-2)
    n = both.sum(axis=-1).astype(np.float64)
    mean = np.where(counted, values, 0.0).sum(axis=-1) / np.maximum(n, 1.0)[..., np.newaxis]
    deviations = np.where(counted, values - mean[..., np.newaxis], 0.0)
    return PairMoments(n, mean, deviations @ np.swapaxes(deviations, -1, -2))


def merge_pairs(a: PairMoments, b: PairMoments) -> PairMoments:
    """Both together (Chan's merging)."""
    n = a.n + b.n
    share = np.divide(b.n, n, out=np.zeros_like(n), where=n > 0)[..., np.newaxis]
    step = b.mean - a.mean
    outer = step[..., :, np.newaxis] * step[..., np.newaxis, :]
    weight = (a.n[..., np.newaxis] * share)[..., np.newaxis]
    return PairMoments(n, a.mean + share * step, a.products + b.products + weight * outer)


def compare(cases: Sequence[PairMoments], root: bool) -> Paired:
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
