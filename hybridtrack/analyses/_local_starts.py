"""What local solvers make of the placement, from many starts: figures 2 and 3 of Otanez 2004.

The paper's is MATLAB's sequential quadratic programming, as it was in 2004. How often a start leads
to the optimum depends on the solver as much as on the problem, so three are compared.
"""

from typing import NamedTuple

import numpy as np

from hybridtrack.analyses._linearisation import Nonlinear, largest_on_places, lattice
from hybridtrack.analyses._objective import SOLVERS, Scaled
from hybridtrack.analyses._worst_errors import peaks
from hybridtrack.models import Array

FINE = 4001  # places of a range of one state that ends are judged at
WITHIN_PERCENT = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


class LocalStarts(NamedTuple):
    """Where a solver ends from every start."""

    solver: str
    points: Array  # (starts, n, d)
    worst_errors: Array  # (starts,)

    def share_within(self, percent: float, optimum: float) -> float:
        """Of the starts, those that end within so many per cent of the optimum."""
        return float((self.worst_errors <= (1.0 + percent / 100.0) * optimum).mean())


def local_starts(
    function: Nonlinear, kind: str, low: Array, high: Array, count: int, starts: int, seed: int
) -> list[LocalStarts]:
    """Every solver from the same starts, uniform in the box low (d,), high (d,)."""
    rng = np.random.default_rng([seed, count])
    begun = rng.uniform(low, high, (starts, count, len(low)))
    objective = Scaled(function, kind, (low, high), count)
    parts = ((begun - low) / (high - low)).reshape(starts, -1)
    ended = [objective.ends(start) for start in parts]
    judged = largest_on_places(function, kind, lattice(low, high, FINE))
    found = []
    for name in SOLVERS:
        ends = np.array([one[name] for one in ended])
        points = np.clip(low + (high - low) * ends.reshape(begun.shape), low, high)
        # between a solver's places, few in each state, there are worse ones
        if len(low) == 1:
            worst = np.array([_largest(judged(one)) for one in points])
        else:
            worst = np.array([peaks(function, kind, low, high, one)[0].max() for one in points])
        found.append(LocalStarts(name, points, worst))
    return found


def _largest(errors: Array) -> float:
    """Of errors (m, n) at places, each by its best model."""
    return float(errors.min(axis=1).max())
