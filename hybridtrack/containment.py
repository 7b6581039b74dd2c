"""Whether sets contain the truth, how large they are, and which model made them.

A *set quantity* is counted by run: a flag (0 or 1) of a whole window, or a sum over its steps. The
bound on a state is how far the ellipsoid reaches from its centre, sqrt(Sigma_jj).
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.ellipsoids import half_widths, quadratic, trace
from hybridtrack.estimators import Sets
from hybridtrack.models import Array
from hybridtrack.statistics import Metric, Moments

TOLERANCE = 1e-9  # of the normalised error, whose square is 1 on the boundary: rounding
USELESS = np.pi  # a bound on an angle beyond this excludes no direction

FLAGS = {
    "violation_share": Metric(
        "violated", False, "less", "share of runs whose truth ever leaves the set"
    ),
    "empty_share": Metric(
        "emptied", False, "less", "share of runs in which a measurement leaves nothing of the set"
    ),
    "useless_share": Metric(
        "useless", False, "less", "share of runs in which the bound on an angle exceeds pi"
    ),
    "largest_normalised_error": Metric(
        "largest_error", False, "less", "mean over runs of the largest (x-c)' Sigma^-1 (x-c)"
    ),
    "model_switches": Metric("switched", False, "less", "switches of the chosen model in a run"),
    "models_in_order_share": Metric(
        "in_order", False, "greater", "share of runs that choose every model, first to last"
    ),
}
NOISE = {
    "process_noise_outside_share": Metric(
        "process_noise_outside", False, "less", "share of draws outside the process noise's set"
    ),
    "measurement_noise_outside_share": Metric(
        "measurement_noise_outside", False, "less", "the same of the measurement noise"
    ),
}
MEAN_BOUND, RMSE, MSE = "mean_bound", "rmse", "mse"  # these are of a state
SQUARED_ERROR = "squared_error"
FIRST_CHOICE = "first_choice_s"  # this one of a model
FAMILIES = (MEAN_BOUND, RMSE, MSE, FIRST_CHOICE)


def set_metrics(states: tuple[str, ...], points: tuple[str, ...]) -> dict[str, Metric]:
    """The metrics of an experiment with sets, by name; points: names of operating points."""
    of_states = {
        f"{MEAN_BOUND}:{name}": Metric(f"bound:{name}", False, "less", f"mean bound on {name}")
        for name in states
    }
    of_states |= {
        f"{kind}:{name}": Metric(f"{SQUARED_ERROR}:{name}", kind == RMSE, "less", f"{text} {name}")
        for kind, text in ((RMSE, "root mean square error of"), (MSE, "mean square error of"))
        for name in states
    }
    of_points = {
        f"{FIRST_CHOICE}:{name}": Metric(
            f"{FIRST_CHOICE}:{name}", False, "less", f"time at which model {name} is first chosen"
        )
        for name in points
    }
    return FLAGS | of_states | of_points | NOISE


def metrics_of(quantities: tuple[str, ...]) -> dict[str, Metric]:
    """The metrics of sets that some quantities are of, by name."""
    kinds = {kind: f"{kind}:" for kind in ("bound", FIRST_CHOICE)}
    states, points = (
        tuple(q.removeprefix(start) for q in quantities if q.startswith(start))
        for start in kinds.values()
    )
    every = set_metrics(states, points).items()
    return {name: metric for name, metric in every if metric.quantity in quantities}


class Names(NamedTuple):
    """What is scored, by name."""

    states: tuple[str, ...]  # the truth's and the estimator's alike
    angles: tuple[int, ...]
    points: tuple[str, ...]  # operating points; () of a filter that has none
    windows: tuple[str, ...]


class SetTally:
    """The sets of one estimator in one block of runs, added up span by span."""

    def __init__(self, names: Names, times_s: Array, runs: int) -> None:
        """times_s: (n_steps,) of the steps k = 1 .."""
        self._names, self._times_s, self._runs = names, times_s, runs
        n_w, n_x, n_p = len(names.windows), len(names.states), len(names.points)
        self._met = np.zeros((n_w, runs), dtype=np.bool_)  # whether the window holds a step
        self._flags = {
            name: np.zeros((n_w, runs), dtype=np.bool_)
            for name in ("violated", "emptied", "useless")
        }
        self._largest = np.zeros((n_w, runs))
        self._switches = np.zeros((n_w, runs))
        self._bounds, self._squares = np.zeros((2, n_w, n_x, runs))
        self._numbers = np.zeros((n_w, runs))
        self._first_s = np.full((n_w, n_p, runs), np.inf)
        self._last: NDArray[np.int64] | None = None
        self._steps: dict[str, list[Moments]] = {}

    def add(
        self, span: slice, truth: Array, mean: Array, sets: Sets, held: NDArray[np.bool_]
    ) -> None:
        """Score a span: truth and mean (n_steps, n_x, lanes); held as blocks have it.

        A step whose estimate is NaN, of a run that has diverged, isn't counted.
        """
        runs = self._runs
        shape = np.moveaxis(sets.shape[..., :runs], -1, 1)
        error = np.swapaxes(truth[..., :runs] - mean[..., :runs], 1, 2)
        distance = quadratic(error, shape)  # (n_steps, runs)
        bound = half_widths(shape)  # (n_steps, runs, n_x)
        told: NDArray[np.bool_] = ~np.asarray(np.isnan(error).any(axis=2))
        empty, chosen = sets.empty[:, :runs], sets.chosen[:, :runs]
        outside = told & (~(distance <= 1.0 + TOLERANCE) | empty)
        useless = told & (bound[..., list(self._names.angles)] > USELESS).any(axis=2)
        before = np.concatenate([chosen[:1] if self._last is None else self._last, chosen[:-1]])
        switched, self._last = told & (chosen != before), chosen[-1:]
        events = (("violated", outside), ("emptied", empty), ("useless", useless))
        times_s = self._times_s[span]
        for w in range(len(self._names.windows)):
            inside = told & np.broadcast_to(held[:, w, :runs], told.shape)
            self._met[w] |= inside.any(axis=0)
            for name, event in events:
                self._flags[name][w] |= (event & inside).any(axis=0)
            self._largest[w] = np.fmax(
                self._largest[w], np.where(inside, distance, 0.0).max(axis=0, initial=0.0)
            )
            self._switches[w] += (switched & inside).sum(axis=0)
            self._numbers[w] += inside.sum(axis=0)
            here = inside[..., np.newaxis]
            self._bounds[w] += np.where(here, bound, 0.0).sum(axis=0).T
            self._squares[w] += np.where(here, error**2, 0.0).sum(axis=0).T
            for i in range(len(self._names.points)):
                when = np.where(inside & (chosen == i), times_s[:, np.newaxis], np.inf)
                self._first_s[w, i] = np.minimum(self._first_s[w, i], when.min(axis=0))
        self._note_steps(told, outside, bound, shape, sets)

    def _note_steps(
        self,
        told: NDArray[np.bool_],
        outside: NDArray[np.bool_],
        bound: Array,
        shape: Array,
        sets: Sets,
    ) -> None:
        runs = self._runs
        series = {"set_trace": trace(shape), "outside_share": outside.astype(np.float64)}
        series |= {f"bound:{s}": bound[..., e] for e, s in enumerate(self._names.states)}
        for i, point in enumerate(self._names.points):
            chosen = (sets.chosen[:, :runs] == i).astype(np.float64)
            series[f"chosen_share:{point}"] = np.where(told, chosen, np.nan)
            series[f"point_trace:{point}"] = sets.point_trace[:, i, :runs]
            for e, state in enumerate(self._names.states):
                series[f"point_bound:{state}:{point}"] = sets.point_bound[:, i, e, :runs]
        for name, values in series.items():
            self._steps.setdefault(name, []).append(_moments(values))

    def steps(self) -> Iterator[tuple[str, Moments]]:
        """Each quantity's moments over runs at every step."""
        for name, parts in self._steps.items():
            yield name, Moments(*map(np.concatenate, zip(*parts, strict=True)))

    def sums(self) -> Iterator[tuple[tuple[str, str], tuple[Array, Array]]]:
        """By window and quantity, what every run (runs,) adds up to, and over how many."""
        points = self._names.points
        for w, window in enumerate(self._names.windows):
            once = self._met[w].astype(np.float64)
            for name, flag in self._flags.items():
                yield (window, name), (flag[w].astype(np.float64), once)
            yield (window, "largest_error"), (self._largest[w], once)
            for e, state in enumerate(self._names.states):
                yield (window, f"bound:{state}"), (self._bounds[w, e], self._numbers[w])
                squares = (self._squares[w, e], self._numbers[w])
                yield (window, f"{SQUARED_ERROR}:{state}"), squares
            if not points:
                continue
            first_s = self._first_s[w]
            yield (window, "switched"), (self._switches[w], once)
            in_order = np.isfinite(first_s).all(axis=0) & (first_s[1:] > first_s[:-1]).all(axis=0)
            yield (window, "in_order"), (in_order.astype(np.float64), once)
            for i, point in enumerate(points):
                ever = np.isfinite(first_s[i])
                cell = (window, f"{FIRST_CHOICE}:{point}")
                yield cell, (np.where(ever, first_s[i], 0.0), ever.astype(np.float64))


class NoiseTally:
    """How often the noise leaves its ellipsoid, run by run and window by window."""

    def __init__(self, windows: tuple[str, ...], runs: int) -> None:
        """windows: their names."""
        self._windows, self._runs = windows, runs
        self._sums = np.zeros((len(windows), 2, runs))
        self._numbers = np.zeros((len(windows), runs))

    def add(self, outside: Array, held: NDArray[np.bool_]) -> None:
        """Outside (n_steps, lanes, 2) is 1 where a draw is; held as in SetTally."""
        far = outside[:, : self._runs]
        for w in range(len(self._windows)):
            inside = np.broadcast_to(held[:, w, : self._runs], far.shape[:2])
            self._numbers[w] += inside.sum(axis=0)
            self._sums[w] += np.where(inside[..., np.newaxis], far, 0.0).sum(axis=0).T

    def sums(self) -> Iterator[tuple[tuple[str, str], tuple[Array, Array]]]:
        """As SetTally's."""
        for w, window in enumerate(self._windows):
            for i, metric in enumerate(NOISE.values()):
                yield (window, metric.quantity), (self._sums[w, i], self._numbers[w])


def _moments(values: Array) -> Moments:
    """Moments over runs of values (n_steps, runs); what isn't finite is left out."""
    known = np.isfinite(values) & (np.abs(values) < 1e100)
    n = known.sum(axis=1).astype(np.float64)
    mean = np.where(known, values, 0.0).sum(axis=1) / np.maximum(n, 1.0)
    deviation = np.where(known, values - mean[:, np.newaxis], 0.0)
    return Moments(n, mean, (deviation**2).sum(axis=1))
