"""From merged statistics to the rows of a run folder's tables, verdicts among them."""

import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from hybridtrack import columns, results
from hybridtrack.config import Experiment
from hybridtrack.containment import metrics_of
from hybridtrack.detections import false_switches
from hybridtrack.errors import UserError
from hybridtrack.groups import RAW, BlockResult, GroupStatistics, Track
from hybridtrack.simulation import BLOCK_RUNS
from hybridtrack.statistics import (
    CALIBRATION,
    FALSE_SWITCHES,
    METRICS,
    POSITION,
    POSITION_AT_SCANS,
    QUANTITIES,
    VELOCITY,
    Estimate,
    Metric,
    Moments,
    Paired,
    Reliability,
    RunSums,
    VectorMoments,
    compare,
    merge_vectors,
    pair_moments,
    ratio_of_sums,
    reliability,
)
from hybridtrack.tallies import BINS, DIFFERENCE
from hybridtrack.verdicts import Claim, Outcome, judge_comparison, judge_exact, judge_figure


def runs_table(experiment: Experiment, blocks: list[BlockResult]) -> pa.Table:
    """A shard's rows of runs.parquet: by estimator, window and run, with sums and counts."""
    rows, windows = labels(experiment), experiment.windows
    case = blocks[0].task.case
    run = np.concatenate([b.task.block * BLOCK_RUNS + np.arange(b.task.runs) for b in blocks])
    stops = np.cumsum([b.task.runs for b in blocks])
    shape = (len(rows), len(windows), run.size)
    per_estimator = len(windows) * run.size

    def number(values: Any) -> pa.Array:
        array = np.broadcast_to(values, shape).ravel()
        return columns.numbers(array, pa.from_numpy_dtype(array.dtype))

    status = np.stack([np.concatenate([block.status[label] for block in blocks]) for label in rows])
    table = {
        "case": columns.texts([experiment.cases[case].name], len(rows) * per_estimator),
        "case_number": number(np.int64(case)),
        "run": number(run),
        "estimator": columns.texts(rows, per_estimator),
        "window": columns.texts([window.name for window in windows] * len(rows), run.size),
        "status": number(status[:, np.newaxis]),
    }
    for quantity in experiment.quantities:
        sums, counts = np.full(shape, np.nan), np.zeros(shape, dtype=np.int64)
        for i, label in enumerate(rows):
            for j, chosen in enumerate(windows):
                for block, stop in zip(blocks, stops, strict=True):
                    found = block.sums.get((label, chosen.name, quantity))
                    if found is not None:
                        mine = (i, j, slice(stop - block.task.runs, stop))
                        sums[mine], counts[mine] = found
        table |= {f"{quantity}_sum": number(sums), f"{quantity}_count": number(counts)}
    return pa.table(table)


def _step_metrics(quantity: str) -> list[tuple[str, bool]]:
    """Metrics of a quantity as steps.parquet has them: name, and whether a root is taken."""
    found = [(name, m.root) for name, m in METRICS.items() if m.quantity == quantity]
    return found or [(quantity, False)]


def _ratio_by_step(first: Moments, second: Moments, difference: Moments) -> dict[str, Any]:
    """Ratio of two means over the same runs, step by step, with paired standard errors.

    By the delta method, from the variances of both and of their difference. NaN where a run
    diverged under either.
    """
    n = second.n
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        ratio = np.where((first.n == n) & (difference.n == n), first.mean / second.mean, np.nan)
        spread = (1 - ratio) * first.squares + ratio * (ratio - 1) * second.squares
        spread += ratio * difference.squares
        error = np.sqrt(np.maximum(spread, 0.0) / (n * (n - 1))) / second.mean
    return {"value": ratio, "standard_error": error}


def _ratio_rows(
    experiment: Experiment, group: GroupStatistics, label: str, quantity: str
) -> Iterator[tuple[str, dict[str, Any]]]:
    """The ratio to the estimator that `compare_with` names, of mean squares and of their roots."""
    leading = experiment.compare_with
    assert leading is not None
    three = [(label, quantity), (leading, quantity), (label, quantity + DIFFERENCE)]
    squares = _ratio_by_step(*(group.steps[key] for key in three))
    kind = quantity.partition("_")[0]
    yield f"{kind}_mse_ratio", squares
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        root = np.sqrt(squares["value"])
        error = squares["standard_error"] / (2 * root)
    yield f"{kind}_rmse_ratio", {"value": root, "standard_error": error}


def steps_rows(experiment: Experiment, cases: list[GroupStatistics]) -> dict[str, Any]:
    parts = []
    for case, group in zip(experiment.cases, cases, strict=True):
        times_s = case.times_s[1:]
        for (label, quantity), moments in group.steps.items():
            if quantity in (POSITION + DIFFERENCE, VELOCITY + DIFFERENCE):  # a mode may end so too
                of = quantity.removesuffix(DIFFERENCE)
                for metric, numbers in _ratio_rows(experiment, group, label, of):
                    texts = {"case": case.name, "estimator": label, "metric": metric}
                    parts.append((texts, _by_step(times_s) | numbers))
                continue
            n = moments.n
            with np.errstate(invalid="ignore", divide="ignore"):
                mean = np.where(n > 0, moments.mean, np.nan)
                error = np.sqrt(moments.squares / (n * (n - 1)))
                error[n < 2] = np.nan
                for metric, root in _step_metrics(quantity):
                    value = np.sqrt(mean) if root else mean
                    scale = np.where(value > 0, 0.5 / value, 0.0) if root else 1.0
                    texts = {"case": case.name, "estimator": label, "metric": metric}
                    numbers = {"value": value, "standard_error": error * scale}
                    parts.append((texts, _by_step(times_s) | numbers))
    return _joined("steps", parts)


def tracks_rows(experiment: Experiment, tracks: list[tuple[int, Track]]) -> dict[str, Any]:
    parts = []
    for number, track in tracks:
        case = experiment.cases[number]
        texts = {"case": case.name, "estimator": track.estimator, "quantity": track.quantity}
        run = np.full(track.values.size, track.run)
        parts.append((texts, _by_step(case.times_s[1:]) | {"run": run, "value": track.values}))
    return _joined("tracks", parts)


Part = tuple[dict[str, str], dict[str, Any]]  # columns of one text each, and of numbers


def _by_step(times_s: Any) -> dict[str, Any]:
    return {"step": np.arange(1, times_s.size + 1, dtype=np.int32), "time_s": times_s}


def _joined(table: str, parts: list[Part]) -> dict[str, Any]:
    if not parts:
        return _columns(table, [])
    texts, numbers = zip(*parts, strict=True)
    lengths = [part["step"].size for part in numbers]
    return {name: columns.texts([part[name] for part in texts], lengths) for name in texts[0]} | {
        name: np.concatenate([part[name] for part in numbers]) for name in numbers[0]
    }


def labels(experiment: Experiment) -> tuple[str, ...]:
    """Rows of the tables: the raw measurements, then the estimators in the scenario's order."""
    return (RAW, *(chosen.label for chosen in experiment.estimators))


def _pooled(cases: list[GroupStatistics], label: str, window: str, metric: Metric) -> Estimate:
    cells = [group.windows.get((label, window, metric.quantity)) for group in cases]
    present = [tuple(float(v) for v in cell) for cell in cells if cell is not None]
    return ratio_of_sums(present, metric.root)


def summary_rows(experiment: Experiment, cases: list[GroupStatistics]) -> dict[str, Any]:
    rows: list[tuple[Any, ...]] = []
    for label in labels(experiment):
        for window in experiment.windows:
            for name, metric in experiment.metrics.items():
                estimate = _pooled(cases, label, window.name, metric)
                if not math.isnan(estimate.value):
                    rows.append((label, name, window.name, *estimate))
    for label in cases[0].delays:
        estimate = false_switches(cases, label)
        if not math.isnan(estimate.value):
            rows.append((label, FALSE_SWITCHES, experiment.windows[0].name, *estimate))
    for label, found in _reliabilities(experiment, cases).items():
        if not math.isnan(found.calibration_error.value):
            rows.append((label, CALIBRATION, experiment.windows[0].name, *found.calibration_error))
    return _columns("summary", rows)


def _reliabilities(experiment: Experiment, cases: list[GroupStatistics]) -> dict[str, Reliability]:
    """Of the probability that the mode now is the last one, for the estimators that tell it."""
    told = [label for label in labels(experiment) if label in cases[0].final_bins]
    return {label: reliability([group.final_bins[label] for group in cases]) for label in told}


def reliability_rows(experiment: Experiment, cases: list[GroupStatistics]) -> dict[str, Any]:
    rows = [
        (label, i / BINS, (i + 1) / BINS, *(float(array[i]) for array in found[:4]))
        for label, found in _reliabilities(experiment, cases).items()
        for i in range(BINS)
    ]
    return _columns("reliability", rows)


def _columns(table: str, rows: list[tuple[Any, ...]]) -> dict[str, Any]:
    names = columns.SCHEMAS[table].names
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}


Pair = tuple[str, str, str]  # first and second estimator, window


class Pairs:
    """Pairs of estimators compared over the same runs, which come shard by shard."""

    def __init__(self, wanted: Iterable[Pair], metrics: Mapping[str, Metric] = METRICS) -> None:
        """metrics: those that there are."""
        self._metrics, self._quantities = metrics, list(QUANTITIES)
        # By case; leading axis of the moments: the quantities.
        self._moments: dict[Pair, dict[int, VectorMoments]] = {pair: {} for pair in wanted}

    def add(self, runs: pa.Table) -> None:
        """The runs of the next shard, as runs.parquet has them.

        Raises UserError where a pair isn't among them.
        """
        labels, windows = (columns.names_in(runs[column]) for column in ("estimator", "window"))
        shape = (len(labels), len(windows), -1)
        names = [name for name in runs.column_names if name.endswith("_sum")]
        self._quantities = [name.removesuffix("_sum") for name in names]
        self._metrics = {**self._metrics, **metrics_of(tuple(self._quantities))}
        sums, numbers = (
            np.stack(
                [columns.as_numpy(runs[f"{q}_{kind}"]).reshape(shape) for q in self._quantities]
            )
            for kind in ("sum", "count")
        )
        sound = columns.as_numpy(runs["status"]).reshape(shape)[:, 0] == 0
        case = int(columns.as_numpy(runs["case_number"])[0])
        for (first, second, window), by_case in self._moments.items():
            if not ({first, second} <= set(labels) and window in windows):
                what = f"no estimator '{first}' or '{second}', or no window '{window}'"
                raise UserError(f"the run holds {what}")
            w = windows.index(window)
            one, two = (
                RunSums(sums[:, i, w], numbers[:, i, w], sound[i])
                for i in (labels.index(first), labels.index(second))
            )
            moments = pair_moments(one, two)
            by_case[case] = merge_vectors(by_case[case], moments) if case in by_case else moments

    def compare(self, pair: Pair, metric: str) -> Paired:
        """A metric of a pair; where one is raw, at the scans that it has."""
        quantity, root = self._metrics[metric].quantity, self._metrics[metric].root
        if RAW in pair[:2] and quantity == POSITION:  # no measurement where the scan is missed
            quantity = POSITION_AT_SCANS
        q = self._quantities.index(quantity)
        cases = [VectorMoments(*(of[q] for of in case)) for case in self._moments[pair].values()]
        return compare(cases, root)


def pairs_wanted(experiment: Experiment) -> Pairs:
    """Every estimator against `compare_with` in every window, and what is claimed."""
    second = experiment.compare_with
    wanted: dict[Pair, None] = {}
    if second is not None:
        for window in experiment.windows:
            firsts = (first for first in labels(experiment) if first != second)
            wanted |= dict.fromkeys((first, second, window.name) for first in firsts)
    claimed = ((*c.compare, c.window) for c in experiment.claims if c.compare is not None)
    return Pairs(wanted | dict.fromkeys(claimed), experiment.metrics)


def paired(path: Path, first: str, second: str, metric: str, window: str) -> Paired:
    """Two estimators of a finished run folder compared over the same runs."""
    pair = (first, second, window)
    pairs = Pairs([pair])
    for runs in results.read_runs(path):
        pairs.add(runs)
    return pairs.compare(pair, metric)


def comparisons_rows(experiment: Experiment, pairs: Pairs) -> dict[str, Any]:
    """Every estimator against `compare_with`, window by window, metric by metric."""
    rows: list[tuple[Any, ...]] = []
    second = experiment.compare_with
    for window in experiment.windows if second is not None else ():
        assert second is not None
        for first in labels(experiment):
            for metric in experiment.metrics if first != second else ():
                pair = pairs.compare((first, second, window.name), metric)
                n = pair.difference.n_runs
                if n:
                    figures = (*pair.difference[:2], *pair.ratio[:2], n)
                    rows.append((first, second, metric, window.name, *figures))
    return _columns("comparisons", rows)


def published_rows(
    experiment: Experiment, pairs: Pairs, cases: list[GroupStatistics]
) -> dict[str, Any]:
    rows = []
    for claim in experiment.claims:
        outcome = _judge(experiment, pairs, cases, claim)
        ours = outcome.ours
        rows.append(
            (
                claim.claim,
                " / ".join(claim.compare) if claim.compare else claim.estimator,
                claim.metric,
                claim.window,
                claim.value,
                claim.tolerance if claim.value is not None else None,
                claim.sign,
                ours.value,
                ours.standard_error,
                outcome.verdict,
                claim.expect,
                outcome.differs,
                claim.because,
            )
        )
    return _columns("published", rows)


def _judge(
    experiment: Experiment, pairs: Pairs, cases: list[GroupStatistics], claim: Claim
) -> Outcome:
    if claim.exact is not None:
        return judge_exact(claim)
    assumed = bool(experiment.assumptions)
    if claim.compare is not None:
        pair = pairs.compare((*claim.compare, claim.window), claim.metric)
        return judge_comparison(claim, pair, assumed)
    assert claim.estimator is not None
    ours = _pooled(cases, claim.estimator, claim.window, experiment.metrics[claim.metric])
    return judge_figure(claim, ours, assumed)
