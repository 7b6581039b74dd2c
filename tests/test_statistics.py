"""Merged moments against direct ones, errors against resampling."""

import functools
import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridtrack.statistics import (
    METRICS,
    POSITION_AT_SCANS,
    QUANTITIES,
    Moments,
    RunSums,
    SumMoments,
    compare,
    merge_moments,
    merge_sum_moments,
    merge_vectors,
    pair_moments,
    ratio_of_sums,
    reliability,
    sum_moments,
    vector_moments,
)

ROUNDING = 1e-12  # relative: some 1e2 operations of 1e-16, a margin of 100
SIGMAS = 4.0  # standard errors allowed to a Monte Carlo figure: 6e-5 each, and the seeds are fixed


def test_every_quantity_has_a_metric_that_says_which_way_is_better():
    assert {metric.better for metric in METRICS.values()} == {"less", "greater"}
    scored = {metric.quantity for metric in METRICS.values()}
    assert set(QUANTITIES) == scored | {POSITION_AT_SCANS}
    assert all(metric.root == ("rmse" in name) for name, metric in METRICS.items())


# ---- running moments -------------------------------------------------------------------------


def slow_moments(values):
    """Number, mean and squared deviations of every row, NaN left out."""
    rows = [row[~np.isnan(row)] for row in values]
    means = [row.mean() if row.size else 0.0 for row in rows]
    squares = [((row - mean) ** 2).sum() for row, mean in zip(rows, means, strict=True)]
    return Moments(np.array([float(row.size) for row in rows]), np.array(means), np.array(squares))


def assert_moments(ours, expected, size):
    """Each field to rounding; deviations by the square of the values' size."""
    assert ours.n.tolist() == expected.n.tolist()
    for field in ours._fields[1:]:
        scale = size if field.startswith("mean") else size**2
        np.testing.assert_allclose(
            getattr(ours, field), getattr(expected, field), ROUNDING, ROUNDING * scale
        )


@st.composite
def cut_values(draw):
    """Values (n_steps, lanes) with gaps and a large mean, and where to cut the lanes."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    lanes = draw(st.integers(1, 60))
    values = draw(st.sampled_from([0.0, 1.0, 1e3])) + rng.normal(size=(3, lanes))
    values[rng.random(values.shape) < draw(st.sampled_from([0.0, 0.3, 0.9, 1.0]))] = np.nan
    cuts = sorted(draw(st.lists(st.integers(0, lanes), max_size=5)))
    return values, cuts


def folded(parts, merge, backwards):
    """All parts merged from the left, or from the right."""
    if backwards:
        parts = parts[::-1]
    whole = parts[0]
    for part in parts[1:]:
        whole = merge(part, whole) if backwards else merge(whole, part)
    return whole


@settings(max_examples=200, deadline=None)
@given(cut_values(), st.booleans())
def test_merged_moments_are_those_of_the_whole(case, backwards):
    values, cuts = case
    parts = [slow_moments(part) for part in np.split(values, cuts, axis=1)]
    # Sums of 60 numbers: rounding, by the size of the values.
    assert_moments(folded(parts, merge_moments, backwards), slow_moments(values), 1e3)


def test_moments_of_a_large_mean_keep_their_digits():
    # A sum of squares would lose them all: 1e18 against deviations of 1.
    values = 1e9 + np.arange(6.0).reshape(1, 6)
    merged = merge_moments(slow_moments(values[:, :2]), slow_moments(values[:, 2:]))
    assert merged.squares[0] == pytest.approx(17.5, rel=1e-6)  # 1e-16 of 1e9 in each deviation


def slow_sum_moments(sums, numbers, sound):
    s, m = sums[sound], numbers[sound]
    if not s.size:
        return SumMoments(*np.zeros(6))
    ds, dm = s - s.mean(), m - m.mean()
    sizes = (s.size, s.mean(), m.mean(), ds @ ds, ds @ dm, dm @ dm)
    return SumMoments(*(np.float64(value) for value in sizes))


def run_sums(rng, n, diverged=0.0):
    """Sums and numbers of steps of n runs, which depend on each other; NaN where diverged."""
    numbers = rng.integers(0, 30, n).astype(float)
    sums = numbers * rng.gamma(2.0, 50.0, n)
    sound = rng.random(n) >= diverged
    sums[~sound] = np.nan
    return sums, numbers, sound


@settings(max_examples=200, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 60),
    st.sampled_from([0.0, 0.5, 1.0]),
    st.lists(st.integers(0, 60), max_size=5),
    st.booleans(),
)
def test_merged_moments_of_sums_are_those_of_the_whole(seed, n, diverged, cuts, backwards):
    sums, numbers, sound = run_sums(np.random.default_rng(seed), n, diverged)
    pieces = [np.split(array, sorted(cuts)) for array in (sums, numbers, sound)]
    parts = [sum_moments(*piece) for piece in zip(*pieces, strict=True)]
    merged = folded(parts, merge_sum_moments, backwards)
    # Sums of 60 numbers of up to some 1e4: rounding.
    assert_moments(merged, slow_sum_moments(sums, numbers, sound), 1e4)


# ---- metrics and their errors ----------------------------------------------------------------


def scalars(sums, numbers, sound=None):
    """A case's SumMoments as ratio_of_sums takes them."""
    sound = np.ones(len(sums), dtype=bool) if sound is None else sound
    return tuple(float(value) for value in sum_moments(sums, numbers, sound))


def pooled(strata, root):
    """The metric of all runs of all cases."""
    value = sum(s.sum() for s, _ in strata) / sum(m.sum() for _, m in strata)
    return math.sqrt(value) if root else value


def jackknife_error(strata, root):
    """One run left out at a time, case by case (Efron, Stein 1981, the stratified form)."""
    variance = 0.0
    for c, (s, m) in enumerate(strata):
        left_out = np.array(
            [
                pooled([*strata[:c], (np.delete(s, i), np.delete(m, i)), *strata[c + 1 :]], root)
                for i in range(len(s))
            ]
        )
        variance += (len(s) - 1) * left_out.var()
    return math.sqrt(variance)


@pytest.mark.parametrize("root", [False, True])
@pytest.mark.parametrize("sizes", [(300,), (150, 40, 90)])
def test_ratio_of_sums_has_the_jackknifes_error(sizes, root):
    rng = np.random.default_rng(10)
    strata = [run_sums(rng, n)[:2] for n in sizes]
    strata = [(s * 10.0**c, m) for c, (s, m) in enumerate(strata)]  # cases of unlike size
    ours = ratio_of_sums([scalars(*stratum) for stratum in strata], root)
    assert ours.value == pytest.approx(pooled(strata, root), rel=ROUNDING)
    assert ours.n_runs == sum(sizes)
    # Two linearisations of one function, apart by the order of 1/n, 3 % at 40 runs.
    assert ours.standard_error == pytest.approx(jackknife_error(strata, root), rel=0.03)


def test_ratio_of_sums_in_a_hand_case():
    # Runs (sum, number): (2, 1), (4, 1), (6, 1): the mean 4 with the error 2 / sqrt(3).
    ours = ratio_of_sums([scalars(np.array([2.0, 4.0, 6.0]), np.ones(3))], root=False)
    assert ours == (4.0, pytest.approx(2 / math.sqrt(3), rel=ROUNDING), 3)
    ours = ratio_of_sums([scalars(np.array([2.0, 4.0, 6.0]), np.ones(3))], root=True)
    assert ours == (2.0, pytest.approx(2 / math.sqrt(3) / 4, rel=ROUNDING), 3)


@pytest.mark.parametrize("root", [False, True])
def test_the_true_value_lies_within_two_standard_errors(root):
    rng = np.random.default_rng(11)
    repetitions, n = 400, 150
    within = 0
    for _ in range(repetitions):
        numbers = 5.0 + rng.poisson(20.0, n)
        sums = numbers * rng.gamma(4.0, 25.0, n)  # the mean of a step is 100 in every run
        ours = ratio_of_sums([scalars(sums, numbers)], root)
        truth = math.sqrt(100.0) if root else 100.0
        within += abs(ours.value - truth) <= 2.0 * ours.standard_error
    expected = math.erf(2.0 / math.sqrt(2.0))  # 95.4 %
    spread = math.sqrt(expected * (1.0 - expected) / repetitions)
    assert abs(within / repetitions - expected) <= SIGMAS * spread


def test_cases_are_strata_their_differences_are_no_error():
    rng = np.random.default_rng(12)
    values, errors = [], []
    for _ in range(400):
        strata = [(level + rng.normal(0.0, 1.0, n), np.ones(n)) for level, n in ((5, 20), (90, 30))]
        ours = ratio_of_sums([scalars(*stratum) for stratum in strata], root=False)
        values.append(ours.value)
        errors.append(ours.standard_error)
    # A standard deviation of 400 draws is known to 1 in sqrt(800).
    assert np.std(values, ddof=1) == pytest.approx(np.mean(errors), rel=SIGMAS / math.sqrt(800))


def test_diverged_runs_leave_the_ratio():
    sums, numbers, sound = run_sums(np.random.default_rng(13), 80, diverged=0.2)
    ours = ratio_of_sums([scalars(sums, numbers, sound)], root=True)
    expected = ratio_of_sums([scalars(sums[sound], numbers[sound])], root=True)
    assert ours == pytest.approx(expected, rel=ROUNDING)
    assert ours.n_runs == sound.sum() < 80


def test_ratios_that_are_not_there():
    nothing = ratio_of_sums([], root=True)
    assert math.isnan(nothing.value)
    assert nothing.n_runs == 0
    empty = ratio_of_sums([scalars(np.zeros(3), np.zeros(3))], root=False)
    assert math.isnan(empty.value)
    one = ratio_of_sums([scalars(np.array([9.0]), np.array([4.0]))], root=True)
    assert one.value == 1.5
    assert math.isnan(one.standard_error)
    assert one.n_runs == 1
    exact = ratio_of_sums([scalars(np.zeros(3), np.ones(3))], root=True)
    assert exact == (0.0, 0.0, 3)


# ---- pairs -----------------------------------------------------------------------------------


class Runs(NamedTuple):
    """An estimator's sums over the runs of several cases."""

    case: np.ndarray
    sums: np.ndarray
    numbers: np.ndarray
    sound: np.ndarray


def compared(first, second, root):
    cases = []
    for c in np.unique(first.case):
        pair = (RunSums(*(a[r.case == c] for a in r[1:])) for r in (first, second))
        cases.append(pair_moments(*pair))
    return compare(cases, root)


def pair(rng, sizes):
    """Two estimators whose errors rise and fall together over the same runs."""
    n = sum(sizes)
    case = np.repeat(np.arange(len(sizes)), sizes)
    numbers = rng.integers(10, 30, n).astype(float)
    shared = (1.0 + case) * rng.gamma(3.0, 30.0, n)
    everyone = np.ones(n, dtype=bool)
    first, second = (
        numbers * shared * factor * rng.gamma(60.0, 1 / 60.0, n) for factor in (0.9, 1)
    )
    return Runs(case, first, numbers, everyone), Runs(case, second, numbers, everyone)


def bootstrapped(first, second, root, rng, resamples=4000):
    """Standard deviations of difference and ratio over runs drawn again, case by case."""
    drawn = np.concatenate(
        [
            rng.choice(np.flatnonzero(first.case == c), (resamples, (first.case == c).sum()))
            for c in np.unique(first.case)
        ],
        axis=1,
    )
    a, b = (r.sums[drawn].sum(axis=1) / r.numbers[drawn].sum(axis=1) for r in (first, second))
    a, b = (np.sqrt(a), np.sqrt(b)) if root else (a, b)
    return (a - b).std(), (a / b).std()


@pytest.mark.parametrize("root", [False, True])
@pytest.mark.parametrize("sizes", [(300,), (80, 120)])
def test_pairs_have_the_bootstraps_error(sizes, root):
    first, second = pair(np.random.default_rng(14), sizes)
    ours = compared(first, second, root)
    difference, ratio = bootstrapped(first, second, root, np.random.default_rng(15))
    # A deviation of 4000 resamples is known to 1.1 %; the bootstrap lacks Bessel's factor, 0.6 %
    # at 80 runs, and is no linearisation, 1/n again.
    allowed = SIGMAS / math.sqrt(8000) + 0.02
    assert ours.difference.standard_error == pytest.approx(difference, rel=allowed)
    assert ours.ratio.standard_error == pytest.approx(ratio, rel=allowed)
    # What they share is no error: unpaired, it would be several times as large.
    strata = [
        (first.sums[first.case == c], first.numbers[first.case == c]) for c in range(len(sizes))
    ]
    alone = ratio_of_sums([scalars(*stratum) for stratum in strata], root)
    assert ours.difference.standard_error < 0.5 * alone.standard_error
    assert ours.first == pytest.approx(alone.value, rel=ROUNDING)


@pytest.mark.parametrize("root", [False, True])
def test_a_pair_is_the_two_metrics_difference_and_ratio(root):
    first, second = pair(np.random.default_rng(16), (50, 30))
    ours, turned = compared(first, second, root), compared(second, first, root)
    values = [pooled([(r.sums, r.numbers)], root) for r in (first, second)]
    assert (ours.first, ours.second) == pytest.approx(values, rel=ROUNDING)
    assert ours.difference.value == pytest.approx(values[0] - values[1], rel=ROUNDING)
    assert ours.ratio.value == pytest.approx(values[0] / values[1], rel=ROUNDING)
    assert ours.ratio.n_runs == ours.difference.n_runs == 80
    assert turned.difference.value == -ours.difference.value
    assert turned.difference.standard_error == pytest.approx(ours.difference.standard_error)
    # d(1/r) = -dr/r^2.
    relative = [p.ratio.standard_error / p.ratio.value for p in (ours, turned)]
    assert relative[0] == pytest.approx(relative[1], rel=ROUNDING)


def test_the_true_ratio_lies_within_two_standard_errors():
    rng = np.random.default_rng(17)
    repetitions = 400
    within = {"difference": 0, "ratio": 0}
    for _ in range(repetitions):
        ours = compared(*pair(rng, (150,)), root=True)
        # Mean errors are .9 * 90 and 90 m^2.
        truth = {"difference": math.sqrt(81.0) - math.sqrt(90.0), "ratio": math.sqrt(0.9)}
        for name, estimate in (("difference", ours.difference), ("ratio", ours.ratio)):
            within[name] += abs(estimate.value - truth[name]) <= 2.0 * estimate.standard_error
    expected = math.erf(2.0 / math.sqrt(2.0))
    spread = math.sqrt(expected * (1.0 - expected) / repetitions)
    for count in within.values():
        assert abs(count / repetitions - expected) <= SIGMAS * spread


def test_a_pair_in_a_hand_case():
    # Runs of one step: 2, 4, 6 against 1, 3, 2. Differences 1, 1, 4 have the mean 2 and the
    # deviation sqrt(3), so the error 1; the residuals of the ratio 2, first - 2 second, are
    # 0, -2, 2 with the deviation 2, so its error is 2 / sqrt(3) over the mean of the second, 2.
    case, numbers, sound = np.zeros(3, dtype=np.int64), np.ones(3), np.ones(3, dtype=bool)
    first = Runs(case, np.array([2.0, 4.0, 6.0]), numbers, sound)
    second = Runs(case, np.array([1.0, 3.0, 2.0]), numbers, sound)
    ours = compared(first, second, root=False)
    assert ours.difference == (2.0, pytest.approx(1.0, rel=ROUNDING), 3)
    assert ours.ratio == (2.0, pytest.approx(1 / math.sqrt(3), rel=ROUNDING), 3)


def test_a_run_that_diverged_under_either_leaves_both():
    first, second = pair(np.random.default_rng(18), (40,))
    kept = np.ones(40, dtype=bool)
    kept[[3, 7, 7, 20, 31]] = False
    spoiled_1, spoiled_2 = first.sums.copy(), second.sums.copy()
    spoiled_1[[3, 7]] = np.nan
    spoiled_2[[7, 20]] = np.inf
    no_steps = second.numbers.copy()
    no_steps[31] = 0.0  # sound, but with no step in the window
    ours = compared(
        first._replace(sums=spoiled_1, sound=np.isfinite(spoiled_1)),
        second._replace(sums=spoiled_2, numbers=no_steps, sound=np.isfinite(spoiled_2)),
        root=True,
    )
    expected = compared(*(Runs(*(array[kept] for array in r)) for r in (first, second)), root=True)
    np.testing.assert_allclose(np.hstack(ours), np.hstack(expected), rtol=1e-12)  # sums' order
    assert ours.difference.n_runs == 36


@pytest.mark.parametrize("root", [False, True])
def test_identical_estimators_have_the_ratio_1_and_no_error(root):
    first, _ = pair(np.random.default_rng(19), (30, 20))
    ours = compared(first, first, root)
    assert ours.difference == (0.0, 0.0, 50)
    assert ours.ratio == (1.0, 0.0, 50)


def test_pairs_that_are_not_there():
    first, second = pair(np.random.default_rng(20), (5,))
    none = compared(first._replace(sound=np.zeros(5, dtype=bool)), second, root=True)
    assert none.difference.n_runs == none.ratio.n_runs == 0
    assert math.isnan(none.ratio.value)
    flawless = compared(first, second._replace(sums=np.zeros(5)), root=True)
    assert flawless.difference.value == flawless.first
    assert math.isnan(flawless.ratio.value)
    lonely = compared(*(Runs(*(field[:1] for field in r)) for r in (first, second)), root=True)
    assert lonely.difference.n_runs == 1
    assert math.isnan(lonely.difference.standard_error)


def test_pairs_merge_along_all_their_axes():
    """Two parts of the runs, and quantities one of which is nowhere defined."""
    one, two = pair(np.random.default_rng(21), (90,))
    factors = np.array([1.0, 3.0, np.nan])[:, np.newaxis]

    def part(runs, which):
        numbers = np.where(np.isnan(factors), 0.0, runs.numbers[which])
        return RunSums(factors * runs.sums[which], numbers, runs.sound[which])

    parts = [
        pair_moments(part(one, which), part(two, which))
        for which in (slice(0, 50), slice(50, 90), slice(0, 0))
    ]
    merged = functools.reduce(merge_vectors, parts)
    whole = pair_moments(part(one, slice(None)), part(two, slice(None)))
    assert merged.n.tolist() == whole.n.tolist() == [90, 90, 0]
    for ours, expected in zip(merged, whole, strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-9)  # differences of like numbers


# ---- reliability -----------------------------------------------------------------------------


def foretold(rng, runs, bins=4, steps=30, slope=0.6):
    """Sums by bins of each run (3 bins, runs), and the flat probabilities, events and run numbers.

    Events come with probability .2 + slope p, so forecasts p are off; runs differ in their level.
    """
    p = np.clip(rng.beta(0.6, 0.6, size=(runs, 1)) + rng.normal(0, 0.1, (runs, steps)), 0, 0.999)
    came = (rng.random(p.shape) < 0.2 + slope * p).astype(float)
    place = (p * bins).astype(int)
    sums = np.zeros((3, bins, runs))
    for i in range(bins):
        here = place == i
        sums[:, i] = here.sum(axis=1), (p * here).sum(axis=1), (came * here).sum(axis=1)
    return sums.reshape(3 * bins, runs), p, came


def slow_reliability(p, came, bins):
    """Share, mean probability, frequency by bin and the calibration error, value by value."""
    place = np.minimum((p * bins).astype(int), bins - 1)
    rows, gap = [], 0.0
    for i in range(bins):
        here = place == i
        rows.append((here.mean(), p[here].mean(), came[here].mean()))
        gap += abs(p[here].mean() - came[here].mean()) * here.mean()
    return np.array(rows).T, gap


def test_reliability_is_what_it_is_value_by_value():
    rng = np.random.default_rng(31)
    sums, p, came = foretold(rng, 300)
    parts = (slice(0, 100), slice(100, 250), slice(250, 300))
    merged = functools.reduce(
        merge_vectors, [vector_moments(sums[:, s], np.ones(s.stop - s.start, bool)) for s in parts]
    )
    found = reliability([merged])
    expected, gap = slow_reliability(p, came, 4)
    np.testing.assert_allclose(found[:3], expected, rtol=1e-10)
    assert found.calibration_error.value == pytest.approx(gap, rel=1e-10)
    assert found.calibration_error.n_runs == 300


def test_reliability_has_the_bootstraps_errors():
    """Over runs, which differ. 400 resamples tell a standard error to 3.5 %: three of these."""
    rng = np.random.default_rng(32)
    sums, _, _ = foretold(rng, 400)
    everyone = np.ones(400, dtype=bool)
    found = reliability([vector_moments(sums, everyone)])
    resampled = []
    for _ in range(400):
        again = reliability([vector_moments(sums[:, rng.integers(0, 400, 400)], everyone)])
        resampled.append([*again.frequency, again.calibration_error.value])
    errors = np.std(resampled, axis=0, ddof=1)
    np.testing.assert_allclose(found.standard_error, errors[:-1], rtol=0.12)
    assert found.calibration_error.standard_error == pytest.approx(errors[-1], rel=0.12)


def test_the_calibration_error_has_the_jackknifes_error():
    """Of runs of very different lengths, whose number of steps errs along with the gaps.

    Two estimates of one error differ by terms of 1/n: 2 % of 400 runs, and a margin.
    """
    rng = np.random.default_rng(35)
    runs = 400
    sums, p, came = foretold(rng, runs, slope=0.1)
    for run in range(runs):  # a run of a low level is short, and one of a high level is long
        steps = 3 if p[run].mean() < 0.5 else 30
        place = (p[run, :steps] * 4).astype(int)
        for i in range(4):
            here = place == i
            parts = (here.sum(), p[run, :steps][here].sum(), came[run, :steps][here].sum())
            sums.reshape(3, 4, runs)[:, i, run] = parts
    everyone = np.ones(runs, dtype=bool)
    found = reliability([vector_moments(sums, everyone)]).calibration_error

    def without(run):
        left = np.delete(sums, run, axis=1)
        return reliability([vector_moments(left, everyone[1:])]).calibration_error.value

    values = np.array([without(run) for run in range(runs)])
    jackknife = np.sqrt((runs - 1) / runs * ((values - values.mean()) ** 2).sum())
    assert found.standard_error == pytest.approx(jackknife, rel=0.04)


def test_reliability_of_several_cases_and_of_nothing():
    rng = np.random.default_rng(33)
    halves = [foretold(rng, 100, slope=s)[0] for s in (0.2, 0.7)]
    everyone = np.ones(100, dtype=bool)
    strata = reliability([vector_moments(half, everyone) for half in halves])
    together = reliability([vector_moments(np.hstack(halves), np.ones(200, dtype=bool))])
    np.testing.assert_allclose(strata[:3], together[:3], rtol=1e-10)
    assert (strata.standard_error <= together.standard_error * 1.01).all()  # 1/(n - 1) twice
    empty = np.zeros((12, 100))
    none = reliability([vector_moments(empty, everyone)])
    assert math.isnan(none.calibration_error.value)
    assert np.isnan(none.frequency).all()
    one = reliability([vector_moments(halves[0][:, :1], everyone[:1])])
    assert math.isnan(one.calibration_error.standard_error)


def test_diverged_runs_leave_the_reliability():
    rng = np.random.default_rng(34)
    sums, p, came = foretold(rng, 50)
    sound = rng.random(50) < 0.7
    sums[:, ~sound] = np.nan
    found = reliability([vector_moments(sums, sound)])
    expected, _ = slow_reliability(p[sound], came[sound], 4)
    np.testing.assert_allclose(found[:3], expected, rtol=1e-10)
