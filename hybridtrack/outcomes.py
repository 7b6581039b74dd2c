"""From merged statistics to the rows of a run folder's tables, verdicts among them."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hybridtrack import results
from hybridtrack.blocks import RAW, GroupStatistics, Track
from hybridtrack.config import Experiment
from hybridtrack.statistics import (
    METRICS,
    POSITION,
    POSITION_AT_SCANS,
    Estimate,
    Metric,
    Paired,
    PairMoments,
    RunSums,
    compare,
    merge_pairs,
    pair_moments,
    ratio_of_sums,
)
from hybridtrack.verdicts import Claim, Outcome, judge_comparison, judge_figure


def _step_metrics(quantity: str) -> list[tuple[str, bool]]:
    """Metrics of a quantity as steps.parquet has them: name, and whether a root is taken."""
    found = [(name, m.root) for name, m in METRICS.items() if m.quantity == quantity]
    return found or [(quantity, False)]


def steps_rows(experiment: Experiment, cases: list[GroupStatistics]) -> dict[str, Any]:
    parts: list[dict[str, Any]] = []
    for case, group in zip(experiment.cases, cases, strict=True):
        times_s = case.times_s[1:]
        for (label, quantity), moments in group.steps.items():
            n = moments.n
            with np.errstate(invalid="ignore", divide="ignore"):
                mean = np.where(n > 0, moments.mean, np.nan)
                error = np.sqrt(moments.squares / (n * (n - 1)))
                error[n < 2] = np.nan
                for metric, root in _step_metrics(quantity):
                    value = np.sqrt(mean) if root else mean
                    scale = np.where(value > 0, 0.5 / value, 0.0) if root else 1.0
                    parts.append(
                        {
                            "case": np.full(n.size, case.name),
                            "estimator": np.full(n.size, label),
                            "step": np.arange(1, n.size + 1, dtype=np.int32),
                            "time_s": times_s,
                            "metric": np.full(n.size, metric),
                            "value": value,
                            "standard_error": error * scale,
                        }
                    )
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def tracks_rows(experiment: Experiment, tracks: list[tuple[int, Track]]) -> dict[str, Any]:
    parts = []
    for case, track in tracks:
        n = track.values.size
        parts.append(
            {
                "case": np.full(n, experiment.cases[case].name),
                "run": np.full(n, track.run),
                "estimator": np.full(n, track.estimator),
                "step": np.arange(1, n + 1, dtype=np.int32),
                "time_s": experiment.cases[case].times_s[1:],
                "quantity": np.full(n, track.quantity),
                "value": track.values,
            }
        )
    names = results.SCHEMAS["tracks"].names
    if not parts:
        return {name: [] for name in names}
    return {name: np.concatenate([part[name] for part in parts]) for name in names}


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
            for name, metric in METRICS.items():
                estimate = _pooled(cases, label, window.name, metric)
                if not math.isnan(estimate.value):
                    rows.append((label, name, window.name, *estimate))
    return _columns("summary", rows)


def _columns(table: str, rows: list[tuple[Any, ...]]) -> dict[str, Any]:
    names = results.SCHEMAS[table].names
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}


def paired(path: Path, first: str, second: str, metric: str, window: str) -> Paired:
    """Two estimators of a run folder compared over the same runs (and scans, if one is raw)."""
    return _paired(path, first, second, window, [metric])[metric]


def _paired(
    path: Path, first: str, second: str, window: str, metrics: Iterable[str]
) -> dict[str, Paired]:
    """Comparisons by metric; memory holds the runs of one shard at a time."""
    quantities = {metric: METRICS[metric].quantity for metric in metrics}
    if RAW in (first, second):  # there is a measurement only where the scan isn't missed
        exchanged = {POSITION: POSITION_AT_SCANS}
        quantities = {m: exchanged.get(q, q) for m, q in quantities.items()}
    pairs: dict[str, dict[int, PairMoments]] = {q: {} for q in quantities.values()}
    shards = [results.run_sums(path, label, window) for label in (first, second)]
    for one, two in zip(*shards, strict=True):
        for quantity in pairs:
            moments = pair_moments(_run_sums(one, quantity), _run_sums(two, quantity))
            pairs[quantity] = merge_pairs(pairs[quantity], moments)
    return {m: compare(pairs[q], METRICS[m].root) for m, q in quantities.items()}


def _run_sums(columns: Mapping[str, Any], quantity: str) -> RunSums:
    return RunSums(
        case=columns["case_number"],
        sums=columns[f"{quantity}_sum"],
        numbers=columns[f"{quantity}_count"],
        sound=columns["status"] == 0,
    )


def comparisons_rows(experiment: Experiment, path: Path) -> dict[str, Any]:
    """Every estimator against `compare_with`, window by window, metric by metric."""
    rows: list[tuple[Any, ...]] = []
    second = experiment.compare_with
    for window in experiment.windows if second is not None else ():
        assert second is not None
        for first in labels(experiment):
            if first == second:
                continue
            for metric, pair in _paired(path, first, second, window.name, METRICS).items():
                n = pair.difference.n_runs
                if n:
                    figures = (*pair.difference[:2], *pair.ratio[:2], n)
                    rows.append((first, second, metric, window.name, *figures))
    return _columns("comparisons", rows)


def published_rows(
    experiment: Experiment, path: Path, cases: list[GroupStatistics]
) -> dict[str, Any]:
    rows = []
    for claim in experiment.claims:
        outcome = _judge(experiment, path, cases, claim)
        ours = outcome.ours
        rows.append(
            (
                claim.claim,
                " / ".join(claim.compare) if claim.compare else claim.estimator,
                claim.metric,
                claim.window,
                claim.value,
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
    experiment: Experiment, path: Path, cases: list[GroupStatistics], claim: Claim
) -> Outcome:
    assumed = bool(experiment.assumptions)
    if claim.compare is not None:
        pair = paired(path, *claim.compare, claim.metric, claim.window)
        return judge_comparison(claim, pair, assumed)
    assert claim.estimator is not None
    ours = _pooled(cases, claim.estimator, claim.window, METRICS[claim.metric])
    return judge_figure(claim, ours, assumed)
