"""From the runs of sets to the rows of a run folder's table on them: outcomes kept apart, medians.

A run may be *violated* (the truth left the set), *emptied* (a measurement left nothing of the set:
noise or remainder beyond what the filter believes), *diverged* (a bound grew past `growth` times
the first one, or a value was lost, and it isn't followed further), or *useless* (the bound on an
angle exceeds pi at some step). One run may be several of these.
"""

from typing import Any

import numpy as np
import pyarrow as pa

from hybridtrack import columns
from hybridtrack.description import Experiment
from hybridtrack.models import Array

FLAGGED = {"violated_runs": "violated", "emptied_runs": "emptied", "useless_runs": "useless"}


class SetRuns:
    """What every run of every estimator had, over all scored steps; shards come one by one."""

    def __init__(self, experiment: Experiment) -> None:
        self._model = experiment.nonlinear
        self._labels = [chosen.label for chosen in experiment.estimators]
        self._found: dict[tuple[str, str], list[Array]] = {}

    def add(self, runs: pa.Table) -> None:
        """The runs of the next shard, as runs.parquet has them."""
        if self._model is None:
            return
        labels, windows = (columns.names_in(runs[name]) for name in ("estimator", "window"))
        shape = (len(labels), len(windows), -1)
        w = windows.index("all")

        def read(name: str) -> Array:
            return columns.as_numpy(runs[name]).reshape(shape)[:, w].astype(np.float64)

        values = {name: read(f"{name}_sum") for name in (*FLAGGED.values(), "largest_error")}
        values["status"] = read("status")
        with np.errstate(invalid="ignore", divide="ignore"):
            for state in self._model.state_names:
                values[f"bound:{state}"] = read(f"bound:{state}_sum") / read(f"bound:{state}_count")
        for label in self._labels:
            for name, table in values.items():
                self._found.setdefault((label, name), []).append(table[labels.index(label)])

    def rows(self) -> dict[str, Any]:
        """Columns of the table `sets`; counts are exact, so their error is NaN."""
        rows: list[tuple[Any, ...]] = []
        for label in self._labels if self._found else ():
            mine = {name: np.concatenate(p) for (of, name), p in self._found.items() if of == label}
            diverged = mine["status"] > 0
            n = diverged.size
            counts = {name: int((mine[flag] > 0).sum()) for name, flag in FLAGGED.items()}
            counts["diverged_runs"] = int(diverged.sum())
            rows += [(label, name, float(count), np.nan, n) for name, count in counts.items()]
            largest = float(np.nanmax(mine["largest_error"]))
            rows.append((label, "largest_normalised_error", largest, np.nan, n))
            assert self._model is not None
            for state in self._model.state_names:
                # A run that diverged counts as one of the widest, whatever it was before.
                bound = np.where(diverged, np.inf, mine[f"bound:{state}"])
                rows.append((label, f"median_bound:{state}", *median(bound), n))
        names = columns.SCHEMAS["sets"].names
        return {name: [row[i] for row in rows] for i, name in enumerate(names)}


def median(values: Array) -> tuple[float, float]:
    """Median and its standard error, from the order statistics that a binomial puts one sigma off.

    Distribution-free (David, Nagaraja 2003, section 7.1); NaN for fewer than four values.
    """
    ordered = np.sort(values)
    n = len(ordered)
    middle = 0.5 * (ordered[(n - 1) // 2] + ordered[n // 2])
    if n < 4:
        return float(middle), np.nan
    places = 0.5 * (n - 1) + 0.5 * np.sqrt(n) * np.array([-1.0, 1.0])
    with np.errstate(invalid="ignore"):  # of medians among runs that diverged
        low, high = np.interp(places, np.arange(n), ordered)
        return float(middle), float(0.5 * (high - low))
