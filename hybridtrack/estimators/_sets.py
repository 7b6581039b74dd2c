"""What filters of nonlinear models have in common: how they start, and what they give.

A set-membership filter gives a set beside its estimate: an ellipsoid, step by step, and which of
its models made it. Arrays here have lanes (runs) last, as blocks keep them.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.chains import Bound
from hybridtrack.ellipsoids import half_widths, trace
from hybridtrack.estimators._layout import Array, Estimates

NONE: Array = np.empty((0, 0, 0))


class Sets(NamedTuple):
    """Ellipsoids of a span of steps."""

    shape: Array  # Sigma (n_steps, n_x, n_x, lanes), the bound itself
    chosen: NDArray[np.int64]  # (n_steps, lanes) which of the operating points'; 0 of one alone
    empty: NDArray[np.bool_]  # (n_steps, lanes) whether a measurement left nothing
    # Of every operating point's own filter; (n_steps, 0, ...) where there are none:
    point_trace: Array  # (n_steps, n_points, lanes)
    point_bound: Array  # (n_steps, n_points, n_x, lanes)
    unused: Array  # (n_steps, lanes) share of the components measured that the filter left out


def blank(n_steps: int, n_x: int, n_points: int, lanes: int) -> tuple[Array, Sets]:
    """Room for the centres (n_steps, n_x, lanes) and the sets of a span."""
    return np.empty((n_steps, n_x, lanes)), Sets(
        shape=np.empty((n_steps, n_x, n_x, lanes)),
        chosen=np.zeros((n_steps, lanes), dtype=np.int64),
        empty=np.zeros((n_steps, lanes), dtype=np.bool_),
        point_trace=np.empty((n_steps, n_points, lanes)),
        point_bound=np.empty((n_steps, n_points, n_x, lanes)),
        unused=np.zeros((n_steps, lanes)),
    )


def note_points(sets: Sets, k: int, shape: Array) -> None:
    """Note the bounds (n_points, lanes, n_x, n_x) of all points at step k of the span."""
    sets.point_trace[k] = trace(shape)
    sets.point_bound[k] = np.swapaxes(half_widths(shape), 1, 2)


def estimates(mean: Array) -> Estimates:
    """Centres as blocks want them: no probabilities of modes, and the sets apart."""
    lanes = mean.shape[2]
    nothing = np.empty((0, 0, lanes))
    return Estimates(np.ascontiguousarray(mean), nothing, nothing, nothing)


class Nonlinear:
    """What all of these answer alike to a scenario; see Estimator."""

    nonlinear = True
    has_likelihoods = False
    limits: Mapping[str, tuple[float | None, float | None]] = {}

    def is_told_modes(self, settings: Any) -> bool:
        """Never: there are none."""
        return False

    def bound(self, settings: Any) -> Bound:
        """There is no chain to bound."""
        return Bound()
