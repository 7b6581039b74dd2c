"""Is a run worse than its baseline? A test for every figure, the errors of all of them bounded.

A *figure* is a metric of an estimator in a window. Where both runs have one seed the test is
paired: it looks at the differences run by run, and what the two have in common cancels. It is
Student's, at a level that all figures share (Bonferroni): the chance that any of them cries wolf is
at most the family error, as far as Student's test goes: errors that are nearly always small one way
and rarely large the other need many runs. A change smaller than rounding makes on another machine
is none. Where fewer than FEW runs have a figure, or a window is met too rarely, nothing is told.
"""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from hybridtrack import columns
from hybridtrack.containment import FLAGS, metrics_of
from hybridtrack.errors import UserError
from hybridtrack.models import Array
from hybridtrack.results import DAMAGE
from hybridtrack.statistics import (
    METRICS,
    POSITION,
    POSITION_AT_SCANS,
    QUANTITIES,
    Metric,
    RunSums,
    SumMoments,
    VectorMoments,
    compare,
    merge_sum_moments,
    merge_vectors,
    pair_moments,
    ratio_of_sums,
    sum_moments,
)

FAMILY_ERROR = 1e-6  # that any figure cries wolf; that a detectable change is missed
ROUNDING = 1e-9  # relative: other rounding was seen to make 1e-11
SMALLEST = 1e-12  # of a share or a probability; below, it is rounding's own
FEW = 8  # runs of which an error can be estimated at all

SAME, UNCHANGED, WORSE, BETTER, UNTOLD = "same", "unchanged", "worse", "better", "untold"

# Squared errors are told by their roots alone: both would be one test done twice.
SMALLER = Metric("", False, "less", "")  # of sets, what isn't a flag is a size
TESTED: Mapping[str, Metric] = {n: m for n, m in METRICS.items() if not n.endswith(("_m2", "_s2"))}
DIVERGED = "diverged_runs"


class Mismatch(UserError):
    """A run and a baseline that don't belong together."""


class Change(NamedTuple):
    """One figure, now and in the baseline."""

    metric: str
    estimator: str
    window: str
    baseline: float
    now: float
    low: float  # of the change, now - baseline: its interval at the shared level
    high: float
    detectable: float  # the smallest change that would have been found, with the family's error
    verdict: str

    @property
    def change(self) -> float:
        """Now - baseline."""
        return self.now - self.baseline


class Comparison(NamedTuple):
    """Every figure of a run held against its baseline."""

    changes: list[Change]
    paired: bool
    runs: int  # compared: pairs, or those of the run
    identical: bool  # to the last bit


class _Shard(NamedTuple):
    """Some runs of one case: sums and numbers (n_quantities, n_estimators, n_windows, n_runs)."""

    place: tuple[int, int]  # case, first run
    estimators: list[str]
    windows: list[str]
    sums: Array
    numbers: Array
    sound: NDArray[np.bool_]  # (n_estimators, n_runs)

    def first(self, runs: int) -> "_Shard":
        return self._replace(
            sums=self.sums[..., :runs],
            numbers=self.numbers[..., :runs],
            sound=self.sound[..., :runs],
        )


def _quantities(table: pa.Table) -> tuple[str, ...]:
    """What a table has sums of: QUANTITIES, and those of sets where it has any."""
    names = [n.removesuffix("_sum") for n in table.column_names if n.endswith("_sum")]
    return tuple(dict.fromkeys((*QUANTITIES, *names)))


def _shard(table: pa.Table, quantities: tuple[str, ...]) -> _Shard:
    """A row group of runs.parquet, or of a baseline, which leaves out what no step has."""
    try:
        return _read_shard(table, quantities)
    except DAMAGE:
        raise Mismatch("there are rows as no run writes them; renew it") from None


def _read_shard(table: pa.Table, quantities: tuple[str, ...]) -> _Shard:
    estimators, windows = (columns.names_in(table[name]) for name in ("estimator", "window"))
    shape = (len(estimators), len(windows), -1)
    rows = columns.as_numpy(table["run"]).reshape(shape)

    def values(quantity: str, kind: str) -> Array:
        name = f"{quantity}_{kind}"
        if name not in table.column_names:
            return np.full(rows.shape, np.nan if kind == "sum" else 0.0)
        return columns.as_numpy(table[name]).reshape(shape).astype(np.float64)

    sums, numbers = (np.stack([values(q, kind) for q in quantities]) for kind in ("sum", "count"))
    sound = columns.as_numpy(table["status"]).reshape(shape)[:, 0] == 0
    place = tuple(int(columns.as_numpy(table[name])[0]) for name in ("case_number", "run"))
    return _Shard((place[0], place[1]), estimators, windows, sums, numbers, sound)


def hold_against(
    new: Iterable[pa.Table],
    old: Iterable[pa.Table],
    *,
    paired: bool,
    family_error: float = FAMILY_ERROR,
    rounding: float = ROUNDING,
) -> Comparison:
    """Compare the shards of a run with those of its baseline; paired: both have one seed.

    Raises UserError where their estimators or windows differ, or no run is in both.
    """
    new, old, quantities = _with_quantities(new, old)
    of = _paired if paired else _unpaired
    gathered = of(new, old, quantities)
    figures = list(gathered.figures())
    level = family_error / max(1, len(figures))
    changes = [_judge(figure, level, family_error, rounding) for figure in figures]
    return Comparison(changes, paired, gathered.runs, gathered.identical)


def _with_quantities(
    new: Iterable[pa.Table], old: Iterable[pa.Table]
) -> tuple[Iterable[pa.Table], Iterable[pa.Table], tuple[str, ...]]:
    """Both again, and the quantities that either has, by a look at its first shard."""
    sides, found = [], dict.fromkeys(QUANTITIES)
    for tables in (new, old):
        rest = iter(tables)
        first = list(itertools.islice(rest, 1))
        for table in first:
            found |= dict.fromkeys(_quantities(table))
        sides.append(itertools.chain(first, rest))
    return sides[0], sides[1], tuple(found)


class _Figure(NamedTuple):
    """A figure before it is judged: value now and then, the change's error and its freedom."""

    metric: str
    estimator: str
    window: str
    now: float
    baseline: float
    error: float
    freedom: int
    discordant: tuple[int, int] | None = None  # of diverged runs: now alone, then alone
    share: float = 0.5  # of all runs, those that are now's: of discordant ones too, by chance
    certain: bool = True  # whether a figure that is there on one side alone tells anything


class _Gathered:
    """Moments of all shards, by case."""

    def __init__(self, paired: bool, quantities: tuple[str, ...]) -> None:
        self.quantities = quantities
        self.metrics = {**TESTED, **metrics_of(quantities)}
        self.estimators: list[str] = []
        self.windows: list[str] = []
        self.runs = 0
        self.runs_then = 0
        self.identical = paired
        self.pairs: dict[int, VectorMoments] = {}  # leading axes: quantity, estimator, window
        self.single: tuple[dict[int, SumMoments], dict[int, SumMoments]] = ({}, {})
        # Runs that have a figure at all, (quantity, estimator, window) by case.
        self.counted: tuple[dict[int, Any], dict[int, Any]] = ({}, {})
        self.diverged: dict[str, list[int]] = {}  # now and then: both, now alone, then alone

    def check(self, shard: _Shard) -> None:
        if not self.estimators:
            self.estimators, self.windows = shard.estimators, shard.windows
        for kind, names, wanted in (
            ("estimators", shard.estimators, self.estimators),
            ("windows", shard.windows, self.windows),
        ):
            if names != wanted:
                raise Mismatch(
                    f"the {kind} are {', '.join(wanted)} here and {', '.join(names)} in the "
                    "baseline; renew it"
                )

    def figures(self) -> Iterator[_Figure]:
        for e, estimator in enumerate(self.estimators):
            for w, window in enumerate(self.windows):
                for name, metric in self.metrics.items():
                    found = self._figure(name, metric, estimator, window, e, w)
                    if found is not None:
                        yield found
            now, alone, then = self.diverged[estimator]
            counts = (float(now), float(now - alone + then))
            share = self.runs / (self.runs + self.runs_then)
            discordant, paired = (alone, then), bool(self.pairs)
            yield _Figure(DIVERGED, estimator, "", *counts, math.nan, 0, discordant, share, paired)

    def _figure(
        self, name: str, metric: Metric, estimator: str, window: str, e: int, w: int
    ) -> _Figure | None:
        quantity = metric.quantity
        if estimator == "raw" and quantity == POSITION:
            quantity = POSITION_AT_SCANS
        cell = (self.quantities.index(quantity), e, w)
        if self.pairs:
            cases = [VectorMoments(*(of[cell] for of in case)) for case in self.pairs.values()]
            with np.errstate(all="ignore"):
                pair = compare(cases, metric.root)
            n = pair.difference.n_runs
            if math.isfinite(pair.first) and math.isfinite(pair.second):
                values = (pair.first, pair.second)
                error = pair.difference.standard_error if n >= FEW else math.nan
                return _Figure(name, estimator, window, *values, error, n - len(cases))
        # Without pairs, or where none is left since one of the two has no such figure.
        with np.errstate(all="ignore"):  # of infinite sums
            now, then = (
                ratio_of_sums([tuple(float(of[cell]) for of in c) for c in s.values()], metric.root)
                for s in self.single
            )
        there = [float(sum(of[cell] for of in counted.values())) for counted in self.counted]
        if not any(there):
            return None
        fewest = int(min(there))
        error = math.hypot(now.standard_error, then.standard_error) if fewest >= FEW else math.nan
        usual = any(n > 0.5 * of for n, of in zip(there, (self.runs, self.runs_then), strict=True))
        certain = bool(self.pairs) or fewest > 0 or self.diverged[estimator][0] > 0 or usual
        freedom = fewest - len(self.single[0])
        values = (now.value, then.value)
        return _Figure(name, estimator, window, *values, error, freedom, certain=certain)

    def add(self, shard: _Shard, side: int) -> None:
        """A shard's runs by themselves; side: 0 now, 1 then."""
        sums, numbers, sound = _run_sums(shard)
        with np.errstate(invalid="ignore"):
            moments = sum_moments(sums, numbers, np.broadcast_to(sound, sums.shape))
        cases, case = self.single[side], shard.place[0]
        known = cases.get(case)
        cases[case] = moments if known is None else merge_sum_moments(known, moments)
        counted = ((numbers > 0) & sound).sum(axis=-1)
        self.counted[side][case] = self.counted[side].get(case, 0) + counted
        if side == 0:
            self.runs += sums.shape[-1]
        else:
            self.runs_then += sums.shape[-1]

    def note_diverged(self, shard: _Shard, other: _Shard | None, side: int) -> None:
        for e, estimator in enumerate(shard.estimators):
            counts = self.diverged.setdefault(estimator, [0, 0, 0])
            if other is not None:
                counts[0] += int((~shard.sound[e]).sum())
                counts[1] += int((~shard.sound[e] & other.sound[e]).sum())
                counts[2] += int((shard.sound[e] & ~other.sound[e]).sum())
            elif side == 0:
                number = int((~shard.sound[e]).sum())
                counts[0] += number
                counts[1] += number
            else:
                counts[2] += int((~shard.sound[e]).sum())


def _pairs(
    new: Iterable[pa.Table], old: Iterable[pa.Table], quantities: tuple[str, ...]
) -> Iterator[tuple[_Shard, _Shard]]:
    """Shards of the same runs; both come in the order of cases and runs, cut alike."""
    ours, theirs = ((_shard(table, quantities) for table in side) for side in (new, old))
    one, other = next(ours, None), next(theirs, None)
    while one is not None and other is not None:
        if one.place == other.place:
            runs = min(one.sums.shape[-1], other.sums.shape[-1])  # a last one may be shorter
            yield one.first(runs), other.first(runs)
        behind, ahead = one.place <= other.place, other.place <= one.place
        one = next(ours, None) if behind else one
        other = next(theirs, None) if ahead else other


def _paired(
    new: Iterable[pa.Table], old: Iterable[pa.Table], quantities: tuple[str, ...]
) -> _Gathered:
    gathered = _Gathered(True, quantities)
    for ours, theirs in _pairs(new, old, quantities):
        gathered.check(ours)
        gathered.check(theirs)
        gathered.add(ours, 0)
        gathered.add(theirs, 1)
        for a, b in ((ours.sums, theirs.sums), (ours.numbers, theirs.numbers)):
            gathered.identical &= np.array_equal(a, b, equal_nan=True)
        with np.errstate(all="ignore"):
            moments = pair_moments(_run_sums(ours), _run_sums(theirs))
        known, case = gathered.pairs.get(ours.place[0]), ours.place[0]
        gathered.pairs[case] = moments if known is None else merge_vectors(known, moments)
        gathered.note_diverged(ours, theirs, 0)
    if not gathered.runs:
        raise Mismatch("the run and its baseline have no run in common; renew it")
    return gathered


def _run_sums(shard: _Shard) -> RunSums:
    sound = np.broadcast_to(shard.sound[:, np.newaxis], shard.sums.shape[1:])
    return RunSums(shard.sums, shard.numbers, sound)


def _unpaired(
    new: Iterable[pa.Table], old: Iterable[pa.Table], quantities: tuple[str, ...]
) -> _Gathered:
    gathered = _Gathered(False, quantities)
    for side, tables in enumerate((new, old)):
        for shard in (_shard(table, quantities) for table in tables):
            gathered.check(shard)
            gathered.add(shard, side)
            gathered.note_diverged(shard, None, side)
    if not gathered.runs or not gathered.runs_then:
        raise Mismatch("the run or its baseline holds no run; renew it")
    if set(gathered.single[0]) != set(gathered.single[1]):
        raise Mismatch("the run and its baseline have other cases; renew it")
    return gathered


# ---- judgement -------------------------------------------------------------------------------


def _judge(figure: _Figure, level: float, missed: float, rounding: float) -> Change:
    """level: of this figure's two-sided test; missed: the chance that what is detectable is not."""
    if figure.discordant is not None:
        return _judge_diverged(figure, level)
    of = (figure.metric, figure.estimator, figure.window, figure.baseline, figure.now)
    change = figure.now - figure.baseline
    slack = rounding * abs(figure.baseline) + SMALLEST
    finite = math.isfinite(figure.now), math.isfinite(figure.baseline)
    if not all(finite):
        told = figure.certain and any(finite)
        verdict = (BETTER if finite[0] else WORSE) if told else UNTOLD
        return Change(*of, math.nan, math.nan, math.nan, verdict)
    if figure.freedom < 1 or math.isnan(figure.error):
        verdict = SAME if change == 0.0 else UNCHANGED if abs(change) <= slack else UNTOLD
        return Change(*of, math.nan, math.nan, math.nan, verdict)
    half = _student(figure.freedom, level / 2) * figure.error
    detectable = half + _student(figure.freedom, missed) * figure.error + slack
    low, high = change - half, change + half
    verdict = SAME if change == 0.0 and figure.error == 0.0 else UNCHANGED
    if low > slack or high < -slack:
        less = {**TESTED, **FLAGS}.get(figure.metric, SMALLER).better == "less"
        verdict = WORSE if (change > 0) == less else BETTER
    return Change(*of, low, high, detectable, verdict)


def is_beyond_rounding(change: Change, rounding: float = ROUNDING) -> bool:
    """Whether a figure moved by more than its last bits."""
    if math.isnan(change.now) and math.isnan(change.baseline):
        return False
    return not abs(change.change) <= rounding * abs(change.baseline) + SMALLEST


def _judge_diverged(figure: _Figure, level: float) -> Change:
    """Of runs that diverged now or then alone each has its share by chance: an exact test.

    Of pairs it is the test of signs, but where none diverged then, any now is worse. Without pairs
    it errs on the safe side: of a given number of diverged runs those of now scatter less than a
    binomial, since runs are drawn but once.
    """
    from scipy.stats import binom

    assert figure.discordant is not None
    now, then = figure.discordant
    both, share = now + then, figure.share
    many, few = float(binom.sf(now - 1, both, share)), float(binom.cdf(now, both, share))
    verdict = SAME if not both else UNCHANGED
    if both and 2 * min(many, few) < level:
        verdict = WORSE if many < few else BETTER
    if figure.certain and now and not figure.baseline:  # pairs: the scans from which none fled
        verdict = WORSE
    smallest = float(math.ceil(math.log(level / 2) / math.log(share)))  # so many, all of them now
    of = (figure.metric, figure.estimator, figure.window, figure.baseline, figure.now)
    return Change(*of, math.nan, math.nan, smallest, verdict)


def _student(freedom: int, tail: float) -> float:
    """Student's quantile with this probability beyond it."""
    from scipy.special import stdtrit

    return float(-stdtrit(freedom, tail))


def runs_to_detect(comparison: Comparison, wanted: float) -> tuple[int, Change]:
    """How many runs find a relative change of the whole window's figures, from what these found.

    Of the figure that takes most, which is named.

    Errors fall with the root of the number of runs. Figures near 0 have no relative change.
    """
    ratios = [
        (change.detectable / (wanted * abs(change.baseline)), change)
        for change in comparison.changes
        if change.window == "all" and change.baseline and math.isfinite(change.detectable)
    ]
    if not ratios:
        raise UserError("no figure here has a standard error; give the number of runs instead")
    ratio, decides = max(ratios, key=lambda found: found[0])
    return math.ceil(comparison.runs * ratio**2), decides
