"""From sojourns that were followed to the rows of a run folder's tables on delays."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from hybridtrack import columns
from hybridtrack.config import Experiment
from hybridtrack.delays import Delays, distribution
from hybridtrack.groups import GroupStatistics
from hybridtrack.models import Array
from hybridtrack.simulation import Case, sojourns
from hybridtrack.statistics import Estimate, ratio_of_sums
from hybridtrack.verdicts import K


class DelayRows(NamedTuple):
    """Columns of two tables."""

    switches: dict[str, Any]  # what there is to say of each switch, or pair of modes
    distribution: dict[str, Any]  # delay by delay


class Switch(NamedTuple):
    """What a group of sojourns has in common; the first is none, but the start."""

    number: int | None  # None: of all runs and times, by their modes
    from_mode: str | None
    to_mode: str
    step: int | None  # the first that the new mode affects
    stay_steps: int | None  # that the new mode lasts
    is_last: bool  # ended by the end of the data, not by another switch
    time_s: float | None  # at which the mode changes


def switches(case: Case, truth_modes: tuple[str, ...]) -> list[Switch]:
    """Those of a case, in the order of delays' groups; the truth's modes by name."""
    lasting = sojourns(case.truth)
    if lasting is None:
        pairs = [(a, b) for a in truth_modes for b in truth_modes]
        return [Switch(None, None if a == b else a, b, None, None, False, None) for a, b in pairs]
    first = np.concatenate([[0], np.cumsum(lasting)[:-1]]) + 1
    names = [truth_modes[j] for j in case.truth.mode[first]]  # type: ignore[union-attr]
    before = [None, *names[:-1]]
    return [
        Switch(
            i,
            before[i],
            names[i],
            int(step),
            int(lasting[i]),
            i == len(first) - 1,
            float(case.times_s[step - 1]),
        )
        for i, step in enumerate(first)
    ]


def averaged_delay(shares: Array, new: int, runs: Array) -> tuple[float, float, float]:
    """Steps until the run-averaged mode estimate is the new mode, and the least and most of them.

    shares (n_modes, n_steps): of the runs whose estimate is each mode, from the sojourn's first
    step on; runs (n_steps,). The averaged estimate is the mode of the largest share. Infinite where
    it isn't the new one before the next switch. The bounds are K standard errors of the lead.
    """
    others = np.delete(shares, new, axis=0)
    lead = (shares[new] - others).min(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = (shares[new] + others - (shares[new] - others) ** 2).max(axis=0)
        allowed = K * np.sqrt(np.maximum(variance, 0.0) / np.maximum(runs, 1.0))

    def first(ahead: Any) -> float:
        return float(np.argmax(ahead)) + 1.0 if ahead.any() else math.inf

    return first(lead > 0), first(lead + allowed > 0), first(lead - allowed > 0)


def delay_rows(experiment: Experiment, cases: list[GroupStatistics]) -> DelayRows:
    """The two tables; switches in their order, for each the estimators in the scenario's."""
    summary: list[tuple[Any, ...]] = []
    by_delay: list[tuple[Any, ...]] = []
    for case, group in zip(experiment.cases, cases, strict=True):
        found = switches(case, experiment.truth_modes) if group.delays else []
        for g, switch in enumerate(found):
            for label, delays in group.delays.items():
                modes = next(c.bank.names for c in experiment.estimators if c.label == label)
                if switch.to_mode in modes:
                    key = (case.name, label, *switch[:3])
                    summary += _summary(
                        key, switch, delays, g, _averaged(group, label, switch, found)
                    )
                    by_delay += _by_delay(key, delays, g)
    return DelayRows(_columns("delays", summary), _columns("delay_distribution", by_delay))


def _averaged(
    group: GroupStatistics, label: str, switch: Switch, found: list[Switch]
) -> tuple[float | None, ...]:
    """The averaged delay with its bounds; nothing where every run has its own switches."""
    if switch.number is None or switch.step is None:
        return (None, None, None)
    start = "mode_estimate:"
    of_modes = {
        quantity.removeprefix(start): moments
        for (estimator, quantity), moments in group.steps.items()
        if estimator == label and quantity.startswith(start)
    }
    later = [s.step for s in found if s.number == switch.number + 1]
    span = slice(switch.step - 1, later[0] - 1 if later and later[0] is not None else None)
    shares = np.stack([moments.mean[span] for moments in of_modes.values()])
    runs = next(iter(of_modes.values())).n[span]
    return averaged_delay(shares, list(of_modes).index(switch.to_mode), runs)


def _summary(
    key: tuple[Any, ...],
    switch: Switch,
    delays: Delays,
    g: int,
    averaged: tuple[float | None, ...],
) -> Iterator[tuple[Any, ...]]:
    detected, missed, unfinished = (counts[g].sum() for counts in delays[:3])
    n = detected + missed + unfinished
    if n == 0:
        return
    by = delays.detected[g]
    steps = np.arange(by.size)
    mean = float(by @ steps / detected) if detected else math.nan
    spread = float(by @ (steps - mean) ** 2) if detected > 1 else math.nan
    error = math.sqrt(spread / (detected - 1) / detected) if detected > 1 else math.nan
    probability = distribution(delays, g).probability
    reached = probability >= 0.5
    false = delays.false_switches
    of_runs = tuple(float(moments[g]) for moments in false)
    wrong = ratio_of_sums([of_runs], root=False)
    yield (
        *key,
        switch.step,
        switch.time_s,
        switch.stay_steps,
        int(n),
        *averaged,
        None if averaged[0] is None else said(averaged[0], switch.stay_steps, switch.is_last),
        int(detected),
        int(missed),
        int(unfinished),
        *_share(float(by[1]), n),
        *_share(float(delays.already[g]), n),
        mean,
        error,
        float(np.argmax(reached)) + 1.0 if reached.any() else math.inf,
        *_share(missed, n),
        wrong.value,
        wrong.standard_error,
    )


def said(delay: float, stay_steps: int | None, is_last: bool) -> str:
    """A delay in words: a stay that the data cut short tells no more than how long it was."""
    if math.isfinite(delay):
        return f"{delay:.0f}"
    return f"over {stay_steps}" if is_last else "never"


def false_switches(cases: list[GroupStatistics], label: str) -> Estimate:
    """How often the estimate leaves the right mode, per stay of the truth."""
    cells = [group.delays[label].false_switches for group in cases if label in group.delays]
    return ratio_of_sums([tuple(float(part[-1]) for part in cell) for cell in cells], root=False)


def _share(part: float, n: float) -> tuple[float, float]:
    """A share of n and its standard error."""
    share = part / n
    return share, math.sqrt(share * (1.0 - share) / (n - 1)) if n > 1 else math.nan


def _by_delay(key: tuple[Any, ...], delays: Delays, g: int) -> Iterator[tuple[Any, ...]]:
    """Up to the last delay that there was."""
    found = distribution(delays, g)
    last = np.flatnonzero(found.detected)
    for i in range(last[-1] + 1 if last.size else 0):
        counts = (int(found.at_risk[i]), int(found.detected[i]))
        yield *key, i + 1, *counts, float(found.probability[i]), float(found.standard_error[i])


def _columns(table: str, rows: list[tuple[Any, ...]]) -> dict[str, Any]:
    names = columns.SCHEMAS[table].names
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}
