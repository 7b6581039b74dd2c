"""What a block of runs gives, and groups of blocks: statistics that merge in the blocks' order."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hybridtrack.delays import Delays, merge_delays
from hybridtrack.models import Array
from hybridtrack.statistics import (
    Moments,
    SumMoments,
    VectorMoments,
    merge_moments,
    merge_sum_moments,
    merge_vectors,
    sum_moments,
    vector_moments,
)

RAW = "raw"
TRUTH = "truth"
NOISE_FREE = "noise_free"  # the truth's course, were there no noise

Series = tuple[str, str]  # estimator, quantity
Cell = tuple[str, str, str]  # estimator, window, quantity

Key = TypeVar("Key", Series, Cell)
M = TypeVar("M", Moments, SumMoments)


class BlockTask(NamedTuple):
    """A block of runs of one case."""

    case: int
    block: int
    runs: int  # how many of the block's runs are wanted
    tracks: int  # how many of them are kept whole


class Track(NamedTuple):
    """One quantity of one run over the steps."""

    run: int
    estimator: str
    quantity: str
    values: Array  # (n_steps,)


class BlockResult(NamedTuple):
    """Statistics of a block."""

    task: BlockTask
    steps: dict[Series, Moments]  # arrays (n_steps,)
    sums: dict[Cell, tuple[Array, Array]]  # (runs,) sums over steps, and their numbers
    final_bins: dict[str, Array]  # by estimator (3 * BINS, runs), see tallies.Totals
    delays: dict[str, Delays]  # by estimator
    status: dict[str, NDArray[np.int64]]  # by estimator (runs,): 0, or the step of divergence
    tracks: list[Track]


class GroupStatistics(NamedTuple):
    """Statistics of several blocks of one case, merged in their order."""

    steps: dict[Series, Moments]
    windows: dict[Cell, SumMoments]
    final_bins: dict[str, VectorMoments]
    delays: dict[str, Delays]
    diverged: dict[str, int]


def merge(a: GroupStatistics, b: GroupStatistics) -> GroupStatistics:
    """Two groups together; `a` comes first in the order of blocks."""
    return GroupStatistics(
        _merged(a.steps, b.steps, merge_moments),
        _merged(a.windows, b.windows, merge_sum_moments),
        {label: merge_vectors(a.final_bins[label], b.final_bins[label]) for label in a.final_bins},
        {label: merge_delays(a.delays[label], b.delays[label]) for label in a.delays},
        {key: a.diverged[key] + b.diverged[key] for key in a.diverged},
    )


def _merged(a: dict[Key, M], b: dict[Key, M], merge_all: Callable[[M, M], M]) -> dict[Key, M]:
    """Moments of the same keys merged all at once: a call of NumPy costs more than its work."""
    if not a:
        return {}
    kind = type(next(iter(a.values())))
    together = (zip(*(group[key] for key in a), strict=True) for group in (a, b))
    merged = merge_all(*(kind(*map(np.array, fields)) for fields in together))
    return dict(zip(a, map(kind, *merged), strict=True))


def summarise(result: BlockResult) -> GroupStatistics:
    """A block as a group of its own."""
    windows: dict[Cell, SumMoments] = {}
    if result.sums:
        sums, numbers = (np.array([pair[i] for pair in result.sums.values()]) for i in (0, 1))
        sound = {label: status == 0 for label, status in result.status.items()}
        moments = sum_moments(sums, numbers, np.array([sound[cell[0]] for cell in result.sums]))
        windows = dict(zip(result.sums, map(SumMoments, *moments), strict=True))
    final_bins = {
        label: vector_moments(sums, result.status[label] == 0)
        for label, sums in result.final_bins.items()
    }
    diverged = {label: int((status > 0).sum()) for label, status in result.status.items()}
    return GroupStatistics(result.steps, windows, final_bins, result.delays, diverged)
