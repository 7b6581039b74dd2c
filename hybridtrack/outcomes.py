"""From merged statistics to the rows of a run folder's tables, verdicts among them."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from hybridtrack import results
from hybridtrack.blocks import RAW, GroupStatistics, Track
from hybridtrack.config import Experiment
from hybridtrack.statistics import (
    METRICS,
    Estimate,
    Metric,
    Paired,
    RunSums,
    compare,
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


def _runs(path: Path, label: str, window: str) -> dict[str, RunSums]:
    """The runs of an estimator in a window, by quantity."""
    sums, case, status = results.read_run_sums(path, label, window)
    return {q: RunSums(case, s, n, status == 0) for q, (s, n) in sums.items()}


def paired(path: Path, first: str, second: str, metric: str, window: str) -> Paired:
    """Two estimators of a run folder compared over the same runs."""
    quantity, root = METRICS[metric].quantity, METRICS[metric].root
    return compare(
        _runs(path, first, window)[quantity], _runs(path, second, window)[quantity], root
    )


def comparisons_rows(experiment: Experiment, path: Path) -> dict[str, Any]:
    """Every estimator against `compare_with`, window by window, metric by metric."""
    rows: list[tuple[Any, ...]] = []
    second = experiment.compare_with
    for window in experiment.windows if second is not None else ():
        assert second is not None
        other = _runs(path, second, window.name)
        for first in labels(experiment):
            one = _runs(path, first, window.name) if first != second else {}
            for name, metric in METRICS.items() if one else ():
                pair = compare(one[metric.quantity], other[metric.quantity], metric.root)
                n = pair.difference.n_runs
                if n:
                    figures = (*pair.difference[:2], *pair.ratio[:2], n)
                    rows.append((first, second, name, window.name, *figures))
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
