"""Baselines and the test of every figure against one, held against plain NumPy and SciPy."""

import json
import math
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy import stats

from hybridtrack import columns, results
from hybridtrack.errors import UserError
from hybridtrack.experiment import run
from hybridtrack.statistics import METRICS, POSITION, POSITION_AT_SCANS, QUANTITIES
from hybridtrack.studies import baselines
from hybridtrack.studies.regression import (
    BETTER,
    DIVERGED,
    FAMILY_ERROR,
    ROUNDING,
    SAME,
    TESTED,
    UNCHANGED,
    UNTOLD,
    WORSE,
    Change,
    Comparison,
    _Figure,
    _judge,
    hold_against,
    is_beyond_rounding,
    runs_to_detect,
)
from models import RANDOM, SMALL, scenario

EXACT = 1e-9  # relative: some 1e3 operations of 1e-16 on differences of a hundredth, and a margin
ESTIMATORS, WINDOWS = ("raw", "A", "B"), ("all", "late")


# ---- made tables -----------------------------------------------------------------------------


class Made(NamedTuple):
    """Some runs of one case: quantity, estimator, window, run."""

    case: int
    first: int
    sums: np.ndarray  # (n_quantities, n_estimators, n_windows, n_runs)
    numbers: np.ndarray
    status: np.ndarray  # (n_estimators, n_runs)

    def table(self, estimators=ESTIMATORS, windows=WINDOWS):
        """As a shard of runs.parquet has them."""
        _, n_estimators, n_windows, runs = self.sums.shape
        shape = (n_estimators, n_windows, runs)
        flat = {
            "case_number": np.full(shape, self.case),
            "run": np.broadcast_to(self.first + np.arange(runs), shape),
            "status": np.broadcast_to(self.status[:, np.newaxis], shape),
        }
        for quantity, sums, numbers in zip(QUANTITIES, self.sums, self.numbers, strict=True):
            flat |= {f"{quantity}_sum": sums, f"{quantity}_count": numbers.astype(np.int64)}
        texts = {
            "estimator": columns.texts(estimators[:n_estimators], n_windows * runs),
            "window": columns.texts(windows[:n_windows] * n_estimators, runs),
        }
        return pa.table(texts | {name: values.ravel() for name, values in flat.items()})

    def cut(self, runs):
        """In shards of so many runs."""
        return [
            self._replace(
                first=self.first + i,
                sums=self.sums[..., i : i + runs],
                numbers=self.numbers[..., i : i + runs],
                status=self.status[:, i : i + runs],
            )
            for i in range(0, self.sums.shape[-1], runs)
        ]


def made(rng, runs, case=0, estimators=3, windows=2, steps=20, even=False, diverged=0.0):
    """Runs whose numbers of steps differ, unless they are even, and depend on their sums."""
    shape = (len(QUANTITIES), estimators, windows, runs)
    numbers = np.full(shape, float(steps))
    if not even:
        numbers = np.broadcast_to(rng.integers(1, steps, (windows, runs)), shape).astype(float)
    sums = numbers * rng.gamma(2.0 + case, 50.0, shape)
    status = np.where(rng.random((estimators, runs)) < diverged, 3, 0)
    status[0] = 0
    return Made(case, 0, sums, numbers, status)


def changed(before, rng, change=0.02):
    """The same runs after a change that does something to each."""
    factor = 1 + change * rng.normal(0.2, 1.0, before.sums.shape)
    return before._replace(sums=before.sums * factor)


def tables(*parts, runs=None):
    return [shard.table() for part in parts for shard in part.cut(runs or 10**6)]


def figure(held, metric, estimator="A", window="all"):
    (found,) = (c for c in held.changes if c[:3] == (metric, estimator, window))
    return found


# ---- plain oracles ---------------------------------------------------------------------------


def cells():
    """What is tested: metric, quantity as the place of its sums, estimator, window."""
    for e, estimator in enumerate(ESTIMATORS):
        for w, window in enumerate(WINDOWS):
            for name, metric in TESTED.items():
                at_scans = estimator == "raw" and metric.quantity == POSITION
                quantity = POSITION_AT_SCANS if at_scans else metric.quantity
                yield name, (QUANTITIES.index(quantity), e, w), estimator, window


def influences(parts, cell, root, sound):
    """The figure, and by case what each run adds to it: deviations to first order."""
    runs = [(p.sums[cell][s], p.numbers[cell][s]) for p, s in zip(parts, sound, strict=True)]
    total = sum(sums.sum() for sums, _ in runs)
    number = sum(numbers.sum() for _, numbers in runs)
    ratio = total / number
    value = np.sqrt(ratio) if root else ratio
    slope = 1 / (2 * value) if root else 1.0
    return value, [slope * (sums - ratio * numbers) / number for sums, numbers in runs]


def error_of(by_case):
    """Of a sum over all runs of all cases, which are strata."""
    return np.sqrt(sum(x.size * x.var(ddof=1) for x in by_case))


N_FIGURES = len(TESTED) * len(ESTIMATORS) * len(WINDOWS) + len(ESTIMATORS)  # and diverged runs


def assert_change(change, now, then, error, freedom, family_error):
    """Value, interval and detectable change; the level is the family's over all figures."""
    level = family_error / N_FIGURES
    half = stats.t.isf(level / 2, freedom) * error
    missed = stats.t.isf(family_error, freedom) * error
    assert (change.now, change.baseline) == pytest.approx((now, then), rel=EXACT)
    assert (change.low, change.high) == pytest.approx(
        (now - then - half, now - then + half), rel=1e-7, abs=EXACT * abs(then)
    )
    detectable = half + missed + ROUNDING * abs(then)
    assert change.detectable == pytest.approx(detectable, rel=1e-7)


@pytest.mark.parametrize("family_error", [1e-6, 0.05])
@pytest.mark.parametrize("diverged", [0.0, 0.1])
def test_paired_changes_are_plain_ones(family_error, diverged):
    """Two cases of different lengths in shards of 40; a run is left out where either diverged."""
    rng = np.random.default_rng(1)
    before = [made(rng, 150, 0, diverged=diverged), made(rng, 70, 1, diverged=diverged)]
    after = [changed(part, rng) for part in before]
    after[1] = after[1]._replace(status=made(rng, 70, 1, diverged=diverged).status)
    held = hold_against(
        tables(*after, runs=40), tables(*before, runs=40), paired=True, family_error=family_error
    )
    assert (held.paired, held.runs, held.identical) == (True, 220, False)
    assert len(held.changes) == N_FIGURES
    for name, cell, estimator, window in cells():
        both = [
            (a.status[cell[1]] == 0) & (b.status[cell[1]] == 0)
            for a, b in zip(after, before, strict=True)
        ]
        root = METRICS[name].root
        now, ours = influences(after, cell, root, both)
        then, theirs = influences(before, cell, root, both)
        error = error_of([a - b for a, b in zip(ours, theirs, strict=True)])
        found = figure(held, name, estimator, window)
        assert_change(found, now, then, error, sum(map(np.sum, both)) - 2, family_error)


@pytest.mark.parametrize("family_error", [1e-6, 0.05])
def test_unpaired_changes_are_plain_ones(family_error):
    """As many runs as there are on either side, errors squared and added, the smaller freedom."""
    rng = np.random.default_rng(2)
    before = [made(rng, 150, 0, diverged=0.1), made(rng, 70, 1, diverged=0.1)]
    after = [made(rng, 90, 0), made(rng, 60, 1, diverged=0.2)]
    held = hold_against(
        tables(*after, runs=40), tables(*before, runs=40), paired=False, family_error=family_error
    )
    assert (held.paired, held.runs, held.identical) == (False, 150, False)
    for name, cell, estimator, window in cells():
        root, e = METRICS[name].root, cell[1]
        sound = [[part.status[e] == 0 for part in parts] for parts in (after, before)]
        now, ours = influences(after, cell, root, sound[0])
        then, theirs = influences(before, cell, root, sound[1])
        error = np.hypot(error_of(ours), error_of(theirs))
        freedom = min(int(sum(s.sum() for s in part)) for part in sound) - 2
        found = figure(held, name, estimator, window)
        assert_change(found, now, then, error, freedom, family_error)


def test_a_mean_of_even_runs_has_the_t_test_of_pairs():
    """SciPy's, at the level of one figure: its p-value decides, its interval is ours."""
    rng = np.random.default_rng(3)
    before = made(rng, 80, even=True)
    for size in (0.0, 0.05, 0.2):
        after = changed(before, rng)
        after = after._replace(sums=after.sums * (1 + size))
        held = hold_against(tables(after), tables(before), paired=True, family_error=0.05)
        for name in ("mode_brier", "mode_accuracy", "likelihood_distinctness"):
            cell = (QUANTITIES.index(METRICS[name].quantity), 1, 0)
            means = [part.sums[cell] / part.numbers[cell] for part in (after, before)]
            test = stats.ttest_rel(*means)
            found = figure(held, name)
            interval = test.confidence_interval(1 - 0.05 / N_FIGURES)
            assert (found.low, found.high) == pytest.approx(tuple(interval), rel=1e-6)
            assert (found.verdict != UNCHANGED) == (test.pvalue < 0.05 / N_FIGURES)


def test_false_alarms_are_as_rare_as_promised():
    """At a family error of 0.3 over independent figures: 1 - (1 - 0.3/63)^60, 0.249, are alarms.

    400 comparisons tell it to 0.022: three of these. The figures of diverged runs raise none.
    """
    rng = np.random.default_rng(4)
    alarms = 0
    for _ in range(400):
        before = made(rng, 40, even=True)
        noise = rng.normal(0.0, 1.0, before.sums.shape)
        after = before._replace(sums=before.sums + noise)
        held = hold_against(tables(after), tables(before), paired=True, family_error=0.3)
        alarms += any(change.verdict in (WORSE, BETTER) for change in held.changes)
    expected = 1 - (1 - 0.3 / N_FIGURES) ** (N_FIGURES - 3)
    assert alarms / 400 == pytest.approx(expected, abs=0.065)


# ---- verdicts --------------------------------------------------------------------------------


def test_identical_runs_are_the_same():
    rng = np.random.default_rng(5)
    parts = [made(rng, 50, 0, diverged=0.1), made(rng, 30, 1)]
    held = hold_against(tables(*parts, runs=20), tables(*parts, runs=20), paired=True)
    assert held.identical
    diverged = {c.estimator: c.baseline for c in held.changes if c.metric == DIVERGED}
    assert diverged["A"] > 0
    assert {change.verdict for change in held.changes} == {SAME}
    assert all(c.low == c.high == 0.0 for c in held.changes if c.metric != DIVERGED)


def test_one_bit_is_not_identical_and_no_change():
    rng = np.random.default_rng(6)
    before = made(rng, 50)
    sums = before.sums.copy()
    sums[0, 1, 0, 7] = np.nextafter(sums[0, 1, 0, 7], np.inf)
    held = hold_against(tables(before._replace(sums=sums)), tables(before), paired=True)
    assert not held.identical
    assert {change.verdict for change in held.changes} == {SAME, UNCHANGED}


@pytest.mark.parametrize(
    ("factor", "verdicts"),
    [
        (1 + 1e-10, {UNCHANGED}),  # of each sum: roots change by half of it
        (1 - 1e-10, {UNCHANGED}),
        (1 + 1e-8, {WORSE, BETTER}),
        (1 - 1e-8, {WORSE, BETTER}),
    ],
)
def test_a_change_within_rounding_is_none(factor, verdicts):
    """Every run changes by one factor, so there is next to no error to hide in."""
    before = made(np.random.default_rng(7), 1000)
    after = before._replace(sums=before.sums * factor)
    held = hold_against(tables(after), tables(before), paired=True)
    assert {c.verdict for c in held.changes if c.metric != DIVERGED} == verdicts


@pytest.mark.parametrize("name", TESTED)
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_metric_says_which_way_is_worse(name, factor):
    rng = np.random.default_rng(8)
    before = made(rng, 200)
    after = before._replace(sums=factor * before.sums)
    worse = (factor > 1) == (METRICS[name].better == "less")
    held = hold_against(tables(after), tables(before), paired=True)
    assert figure(held, name).verdict == (WORSE if worse else BETTER)
    apart = made(rng, 200)
    apart = apart._replace(sums=factor**4 * apart.sums)  # roots change by its root
    held = hold_against(tables(apart), tables(before), paired=False)
    assert figure(held, name).verdict == (WORSE if worse else BETTER)


def test_every_metric_is_tested_once():
    """Mean squares are left to their roots."""
    assert {METRICS[name].quantity for name in TESTED} == {m.quantity for m in METRICS.values()}
    assert len({METRICS[name].quantity for name in TESTED}) == len(TESTED)


def test_one_run_tells_nothing_unless_it_is_equal():
    rng = np.random.default_rng(9)
    before = made(rng, 1)
    after = before._replace(sums=before.sums.copy())
    after.sums[:, 1] *= 1 + 1e-12
    after.sums[:, 2] *= 1.5
    held = hold_against(tables(after), tables(before), paired=True)
    verdicts = {c.estimator: c.verdict for c in held.changes if c.metric != DIVERGED}
    assert verdicts == {"raw": SAME, "A": UNCHANGED, "B": UNTOLD}
    assert all(math.isnan(c.low) for c in held.changes)
    held = hold_against(tables(made(rng, 1)), tables(before), paired=False)
    assert {c.verdict for c in held.changes if c.metric != DIVERGED} == {UNTOLD}


@pytest.mark.parametrize("paired", [True, False])
def test_a_figure_that_is_gone_is_worse(paired):
    """One side has it, the other has not; a figure of neither is none."""
    rng = np.random.default_rng(10)
    whole = made(rng, 30)
    numbers = whole.numbers.copy()
    q = QUANTITIES.index("mode_brier")
    numbers[q, 1] = 0.0
    gone = whole._replace(numbers=numbers, sums=np.where(numbers > 0, whole.sums, np.nan))
    lost = hold_against(tables(gone), tables(whole), paired=paired)
    assert figure(lost, "mode_brier").verdict == WORSE
    won = hold_against(tables(whole), tables(gone), paired=paired)
    assert figure(won, "mode_brier").verdict == BETTER
    assert figure(won, "mode_brier", "B").verdict in (SAME, UNCHANGED)
    neither = hold_against(tables(gone), tables(gone), paired=paired)
    assert not [c for c in neither.changes if c[:2] == ("mode_brier", "A")]
    assert len(neither.changes) == len(lost.changes) - len(WINDOWS)


@pytest.mark.parametrize("paired", [True, False])
def test_an_estimator_that_always_diverges_is_worse(paired):
    rng = np.random.default_rng(11)
    before = made(rng, 60)
    status = before.status.copy()
    status[1] = 5
    after = before._replace(status=status, sums=before.sums.copy())
    after.sums[:, 1] = np.nan
    held = hold_against(tables(after), tables(before), paired=paired)
    assert {c.verdict for c in held.changes if c.estimator == "A"} == {WORSE}
    assert WORSE not in {c.verdict for c in held.changes if c.estimator != "A"}


def with_diverged(rng, now, then, both, paired, runs=100, runs_then=100):
    """Runs of which so many diverged now alone, then alone, in both."""
    before, after = made(rng, runs_then), made(rng, runs)
    if paired:
        after = before._replace(status=before.status.copy())
    after.status[1, : now + both] = 1
    before.status[1, now : now + both + then] = 1
    return hold_against(tables(after), tables(before), paired=paired, family_error=0.05)


@pytest.mark.parametrize(
    ("now", "then", "both"),
    [(0, 0, 0), (0, 0, 9), (1, 0, 0), (11, 0, 5), (12, 0, 5), (0, 12, 0), (20, 3, 2), (30, 9, 0)],
)
def test_diverged_runs_have_the_exact_test_of_signs(now, then, both):
    held = with_diverged(np.random.default_rng(12), now, then, both, paired=True)
    found = figure(held, DIVERGED, window="")
    assert (found.now, found.baseline) == (now + both, then + both)
    level = 0.05 / N_FIGURES
    certain = now + then > 0 and stats.binomtest(now, now + then).pvalue < level
    expected = SAME if now + then == 0 else UNCHANGED
    if certain:
        expected = WORSE if now > then else BETTER
    if now and not then + both:  # the same scans, and none fled from them
        expected = WORSE
    assert found.verdict == expected
    # So many, all of them now, are found, and one fewer is not.
    assert stats.binomtest(int(found.detectable), int(found.detectable)).pvalue < level
    fewer = int(found.detectable) - 1
    assert stats.binomtest(fewer, fewer).pvalue >= level


@pytest.mark.parametrize(
    ("now", "then", "verdict"),
    [
        (10, 40, UNCHANGED),  # 1 % of 1,000, 1 % of 4,000
        (40, 40, WORSE),
        (0, 160, BETTER),
        (0, 40, BETTER),  # by chance 2 x 0.8^40 = 3e-4, and the level is 8e-4
        (0, 30, UNCHANGED),  # 2.5e-3
    ],
)
def test_diverged_runs_without_pairs_go_by_the_numbers_of_runs(now, then, verdict):
    held = with_diverged(np.random.default_rng(13), now, then, 0, False, 1000, 4000)
    found = figure(held, DIVERGED, window="")
    assert (found.now, found.baseline) == (now, then)
    assert found.verdict == verdict


# ---- which runs ------------------------------------------------------------------------------


@pytest.mark.parametrize(("ours", "theirs"), [(30, 50), (50, 30), (20, 50), (50, 50)])
def test_runs_that_both_have_are_compared(ours, theirs):
    """Shards of 20 runs, of two cases: a last one may be shorter, or missing."""
    rng = np.random.default_rng(14)
    before = [made(rng, 50, case, diverged=0.1) for case in (0, 1)]
    after = [changed(part, rng) for part in before]
    held = hold_against(
        tables(*(part.cut(ours)[0] for part in after), runs=20),
        tables(*(part.cut(theirs)[0] for part in before), runs=20),
        paired=True,
    )
    common = min(ours, theirs)
    expected = hold_against(
        tables(*(part.cut(common)[0] for part in after), runs=20),
        tables(*(part.cut(common)[0] for part in before), runs=20),
        paired=True,
    )
    assert held.runs == 2 * common
    np.testing.assert_equal(held, expected)  # to the bit, NaN for NaN


def test_a_case_that_one_side_has_alone_is_left_out():
    rng = np.random.default_rng(15)
    before = [made(rng, 30, case) for case in (0, 1, 2)]
    after = [changed(part, rng) for part in before]
    for ours, theirs in ((after[1:], before), (after, before[1:])):
        held = hold_against(tables(*ours, runs=20), tables(*theirs, runs=20), paired=True)
        expected = hold_against(tables(*after[1:]), tables(*before[1:]), paired=True)
        assert held.runs == expected.runs == 60
        for one, other in zip(held.changes, expected.changes, strict=True):
            assert one.now == pytest.approx(other.now, rel=EXACT)
            assert one.verdict == other.verdict


def test_no_run_in_common():
    rng = np.random.default_rng(16)
    one, other = made(rng, 20, 0), made(rng, 20, 1)
    with pytest.raises(UserError, match=r"no run in common; renew"):
        hold_against(tables(one), tables(other), paired=True)
    for new, old in ((tables(one), []), ([], tables(one))):
        with pytest.raises(UserError, match=r"holds no run; renew"):
            hold_against(new, old, paired=False)


@pytest.mark.parametrize("paired", [True, False])
def test_other_estimators_or_windows_are_refused(paired):
    part = made(np.random.default_rng(17), 20)
    ours = [part.table()]
    renamed = [part.table(estimators=("raw", "A", "C"))]
    sentence = r"the estimators are raw, A, B here and raw, A, C in the baseline; renew it"
    with pytest.raises(UserError, match=sentence):
        hold_against(ours, renamed, paired=paired)
    windows = [part.table(windows=("all", "early"))]
    sentence = r"the windows are all, late here and all, early in the baseline; renew it"
    with pytest.raises(UserError, match=sentence):
        hold_against(ours, windows, paired=paired)
    fewer = part._replace(
        sums=part.sums[:, :2], numbers=part.numbers[:, :2], status=part.status[:2]
    )
    with pytest.raises(UserError, match=r"raw, A, B here and raw, A in the baseline"):
        hold_against(ours, [fewer.table()], paired=paired)


# ---- how many runs ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("runs", "percent", "unpaired"),
    [(100_000, 2.3, 3.2), (1_000, 23, 32)],
)
def test_the_guides_figures(runs, percent, unpaired):
    """One Gaussian error a run, 16 metrics: what so many runs find of a change of the RMS.

    The mean of n squares has the variance 2 sigma^4/n, its root the relative error 1/sqrt(2 n).
    The two chances of 1e-6 are Gaussian quantiles, one of them two-sided and shared by 16.
    """
    relative = 1 / math.sqrt(2 * runs)
    away = stats.norm.isf(FAMILY_ERROR / 16 / 2) + stats.norm.isf(FAMILY_ERROR)
    assert 100 * away * relative == pytest.approx(percent, rel=0.02)  # as printed: two digits
    assert 100 * away * relative * math.sqrt(2) == pytest.approx(unpaired, rel=0.02)
    for error, expected in ((relative, percent), (math.sqrt(2) * relative, unpaired)):
        made_figure = _Figure("position_rmse_m", "KF", "all", 1.0, 1.0, error, runs - 1)
        change = _judge(made_figure, FAMILY_ERROR / 16, FAMILY_ERROR, ROUNDING)
        # Student's quantiles are larger by some (z^2 + 1)/(4 n), 0.8 % of 1,000 runs.
        assert change.detectable == pytest.approx(away * error, rel=10 / runs)
        assert 100 * change.detectable == pytest.approx(expected, rel=0.03)


def test_a_gaussian_run_has_the_guides_scatter():
    """Tables of real squares: 100,000 runs tell their own error to 1/sqrt(2 n) and a little."""
    rng = np.random.default_rng(18)
    parts = []
    for _ in range(2):
        part = made(rng, 100_000, estimators=1, windows=1, steps=1, even=True)
        parts.append(part._replace(sums=rng.normal(size=part.sums.shape) ** 2))
    held = hold_against(tables(parts[0]), tables(parts[1]), paired=False)
    (found,) = (c for c in held.changes if c.metric == "velocity_rmse_m_s")
    level = FAMILY_ERROR / len(held.changes)
    away = stats.norm.isf(level / 2) + stats.norm.isf(FAMILY_ERROR)
    # The error of an error: sqrt((kurtosis of squares)/(4 n)) = 0.6 % each; four of these.
    assert found.detectable == pytest.approx(away / math.sqrt(100_000), rel=0.025)


def test_what_is_detectable_is_detected():
    """A change of that size is missed with the family's error, here 5 %.

    It is the change as estimated that scatters. 20,000 draws tell 5 % to 0.15 %: four of these.
    """
    rng = np.random.default_rng(19)
    of = ("position_rmse_m", "KF", "all")
    detectable = _judge(_Figure(*of, 100.0, 100.0, 1.0, 10**6), 0.001, 0.05, 0.0).detectable
    missed = sum(
        _judge(_Figure(*of, 100.0 + change, 100.0, 1.0, 10**6), 0.001, 0.05, 0.0).verdict != WORSE
        for change in detectable + rng.normal(size=20_000)
    )
    assert missed / 20_000 == pytest.approx(0.05, abs=0.0062)


def test_so_many_runs_find_what_is_wanted():
    """Four times as many halve what is detectable; the whole window's worst figure decides."""
    rng = np.random.default_rng(20)
    parts = [made(rng, 2000) for _ in range(2)]
    held = hold_against(tables(parts[0]), tables(parts[1]), paired=False)
    whole = [c for c in held.changes if c.window == "all"]
    worst = max(c.detectable / abs(c.baseline) for c in whole)
    assert runs_to_detect(held, worst)[0] == pytest.approx(2000, abs=1)
    assert runs_to_detect(held, worst / 2)[0] == pytest.approx(8000, abs=1)
    wanted = worst / 3
    number, decides = runs_to_detect(held, wanted)
    assert decides in whole
    more = [made(rng, number) for _ in range(2)]
    held = hold_against(tables(more[0]), tables(more[1]), paired=False)
    found = max(c.detectable / abs(c.baseline) for c in held.changes if c.window == "all")
    # The worst of 27 figures, each error known to some 2 % of 2,000 runs: the pilot's worst is
    # worse by up to three of these than the same figure of many runs.
    assert found == pytest.approx(wanted, rel=0.06)


def test_no_figure_tells_how_many_runs():
    one = made(np.random.default_rng(21), 1)
    held = hold_against(tables(one), tables(one), paired=False)
    with pytest.raises(UserError, match="give the number of runs instead"):
        runs_to_detect(held, 0.01)
    with pytest.raises(UserError, match="give the number of runs instead"):
        runs_to_detect(Comparison([], True, 10, True), 0.01)


# ---- baselines -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Finished runs by name: 60 runs of two scenarios, SMALL with another seed too."""
    folder = tmp_path_factory.mktemp("runs")
    found = {}
    for name, text, seed in (("small", SMALL, 3), ("other", SMALL, 4), ("random", RANDOM, 8)):
        settings = ("monte_carlo.runs=60", f"monte_carlo.seed={seed}")
        found[name] = folder / name
        run(scenario(folder, text, *settings), found[name], 2, lambda done, total: None)
    return found


@pytest.fixture
def file(runs, tmp_path):
    """A baseline of the small run."""
    baselines.write(runs["small"], tmp_path / "deep" / "small.parquet")
    return tmp_path / "deep" / "small.parquet"


@pytest.mark.parametrize("name", ["small", "random"])
def test_a_baseline_is_read_as_it_was_written(name, runs, tmp_path):
    file = tmp_path / "b.parquet"
    baselines.write(runs[name], file)
    assert [path.name for path in tmp_path.iterdir()] == ["b.parquet"]  # nothing of the way there
    held, told = baselines.read(file), baselines.describe(runs[name])
    here = {"path": None, "remedy": "", "summary": []}
    assert held._replace(**here) == told._replace(**here)
    np.testing.assert_equal(held.summary, told.summary)  # NaN for NaN
    manifest = json.loads((runs[name] / "manifest.json").read_text())
    assert held.path == file
    assert (held.name, held.seed, held.runs) == (name, manifest["seed"], 60)
    assert held.made["sources"] == manifest["versions"]["sources"]
    assert held.made["machine"] == manifest["host"]["machine"]
    assert {"numpy", "numba", "python", "processor"} <= held.made.keys()
    np.testing.assert_equal(held.summary, results.read_rows(runs[name], "summary"))
    assert held.scenario["estimators"].keys() >= {"KF", "IMM"}
    assert not {"runs", "seed"} & held.scenario["monte_carlo"].keys()
    assert not set(baselines.TOLD) & held.scenario.keys()


@pytest.mark.parametrize("name", ["small", "random"])
def test_a_baseline_has_the_runs_without_what_no_step_has(name, runs, tmp_path):
    file = tmp_path / "b.parquet"
    baselines.write(runs[name], file)
    shards, kept = list(results.read_runs(runs[name])), list(baselines.read(file).shards())
    absent = {
        q for q in QUANTITIES if not any(np.any(columns.as_numpy(s[f"{q}_count"])) for s in shards)
    }
    assert "final_mode_brier" in absent  # there is no bound on the number of manoeuvres
    for shard, ours in zip(shards, kept, strict=True):
        left_out = set(shard.column_names) - set(ours.column_names)
        assert left_out == {f"{q}_{kind}" for q in absent for kind in ("sum", "count")}
        for column in ours.column_names:
            np.testing.assert_array_equal(
                columns.as_numpy(ours[column]), columns.as_numpy(shard[column])
            )


@pytest.mark.parametrize("paired", [True, False])
def test_a_baseline_stands_for_its_run(runs, file, paired):
    """The same comparison from the file as from the folder; and the summary's figures."""
    new = "small" if paired else "other"
    held, direct = (
        hold_against(results.read_runs(runs[new]), old, paired=paired)
        for old in (baselines.read(file).shards(), results.read_runs(runs["small"]))
    )
    np.testing.assert_equal(held, direct)
    assert held.identical == paired
    figures = {(r["metric"], r["estimator"], r["window"]): r for r in baselines.read(file).summary}
    compared = [c for c in held.changes if c.metric != DIVERGED]
    assert {c[:3] for c in compared} <= figures.keys()
    for change in compared:
        value = figures[change[:3]]["value"]
        assert change.baseline == pytest.approx(value, rel=EXACT), change[:3]
    verdicts = {change.verdict for change in held.changes}
    assert verdicts == {SAME} if paired else not verdicts & {WORSE, BETTER}


def test_more_runs_of_one_seed_pair_with_fewer(runs, file, tmp_path):
    """Two shards, of 2,048 and 12 runs, against one of 60."""
    experiment = scenario(tmp_path, SMALL, "monte_carlo.runs=2060")
    run(experiment, tmp_path / "more", 2, lambda done, total: None)
    held = hold_against(
        results.read_runs(tmp_path / "more"), baselines.read(file).shards(), paired=True
    )
    assert (held.runs, held.identical) == (60, True)
    assert {change.verdict for change in held.changes} == {SAME}


def test_a_baseline_is_replaced_whole_or_not_at_all(runs, file, monkeypatch):
    """Rows that cannot be written leave the old baseline, and nothing beside it."""
    old = file.read_bytes()
    real = pq.ParquetWriter.write_table

    def fail(self, *arguments, **options):
        real(self, *arguments, **options)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq.ParquetWriter, "write_table", fail)
    with pytest.raises(UserError, match=r"small\.parquet: cannot be written \(no space left"):
        baselines.write(runs["other"], file)
    assert file.read_bytes() == old
    assert [path.name for path in file.parent.iterdir()] == ["small.parquet"]
    monkeypatch.undo()
    baselines.write(runs["other"], file)
    assert baselines.read(file).seed == 4


def test_a_run_that_is_none_makes_no_baseline(tmp_path):
    with pytest.raises(UserError, match="this is no run folder"):
        baselines.write(tmp_path, tmp_path / "b.parquet")
    assert not list(tmp_path.iterdir())


def refused(file):
    """The sentence with which a baseline is refused: one, and it names the file."""
    with pytest.raises(UserError) as caught:
        baselines.read(file)
    said = str(caught.value)
    assert said.startswith(f"{file}: ")
    assert "\n" not in said
    assert not said.endswith(".")
    return said.removeprefix(f"{file}: ")


def test_a_file_that_is_no_baseline_is_refused(runs, file, tmp_path):
    assert refused(tmp_path / "none.parquet").startswith("there is no such baseline; make it")
    assert refused(runs["small"] / "runs.parquet").startswith("this Parquet file is no baseline")
    pq.write_table(pa.table({"a": [1]}), tmp_path / "plain.parquet")
    assert refused(tmp_path / "plain.parquet").startswith("this Parquet file is no baseline")
    for name, content in (("text", b"name: small\n"), ("empty", b""), ("half", halved(file))):
        (tmp_path / name).write_bytes(content)
        said = refused(tmp_path / name)
        assert said.startswith("this baseline is damaged ("), name
        assert said.endswith("; renew it"), name
    assert refused(tmp_path).startswith("this baseline is damaged (")


def halved(file):
    return file.read_bytes()[: file.stat().st_size // 2]


def rewritten(file, table, **facts):
    """A baseline with other rows, and facts of its own; those that are None are left out."""
    known = json.loads(pq.read_metadata(file).metadata[baselines.KEY]) | facts
    known = {name: fact for name, fact in known.items() if fact is not None}
    path = file.with_name("rewritten.parquet")
    pq.write_table(table.replace_schema_metadata({baselines.KEY: json.dumps(known)}), path)
    return path


def test_a_baseline_of_another_form_is_refused(file):
    table = pq.read_table(file)
    assert baselines.read(rewritten(file, table)).seed == 3
    said = refused(rewritten(file, table, form=2))
    assert said == (
        "this baseline is of form 2 and this version reads 1; renew it with `hybridtrack baseline`"
    )
    assert refused(rewritten(file, table[:0])) == "this baseline holds no run; renew it"
    assert refused(rewritten(file, table, seed=None)).startswith("this Parquet file is no baseline")
    path = file.with_name("garbled.parquet")
    for garbled in (b"{", b"[]", b"1", b"\xff"):
        pq.write_table(table.replace_schema_metadata({baselines.KEY: garbled}), path)
        assert refused(path).startswith("this baseline is damaged ("), garbled


def test_rows_that_are_damaged_are_told_when_they_are_read(file):
    """Its end is whole, so it is a baseline; bytes amid its rows are not what they were."""
    content = bytearray(file.read_bytes())
    content[100:2000] = bytes(1900)
    file.write_bytes(content)
    held = baselines.read(file)
    with pytest.raises(UserError, match=r"small\.parquet: this file is damaged \(.*\); ") as caught:
        list(held.shards())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("now", "then", "beyond"),
    [
        (1.0 + 1e-10, 1.0, False),
        (1.0 + 1e-8, 1.0, True),
        (1e-13, 0.0, False),
        (1e-11, 0.0, True),
        (math.nan, math.nan, False),
        (math.nan, 1.0, True),
        (math.inf, 1.0, True),
    ],
)
def test_last_bits_are_told_from_changes(now, then, beyond):
    nothing = (math.nan,) * 3
    change = Change("position_rmse_m", "KF", "all", then, now, *nothing, UNCHANGED)
    assert is_beyond_rounding(change) == beyond
