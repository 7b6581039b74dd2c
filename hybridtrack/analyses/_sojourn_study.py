"""All figures of the sojourn analysis, before they become tables, charts and sentences."""

import math
from typing import NamedTuple

import numpy as np

from hybridtrack.analyses._eigenstructure import Eigenstructure
from hybridtrack.analyses._predictor_filters import PredictorFilter
from hybridtrack.analyses._sojourn_bounds import (
    DirectBound,
    DisturbanceBounds,
    Mismatch,
    PaperBound,
    StateBound,
)
from hybridtrack.analyses._sojourn_observability import JointObservability
from hybridtrack.analyses._switching_runs import SwitchingRuns
from hybridtrack.models import Array, JumpMarkovModel


class Study(NamedTuple):
    """All figures of the analysis; steps are from detection to the next switch."""

    model: JumpMarkovModel
    rate: float  # mu
    error_bound: float  # M0
    delay_steps: int  # Delta
    filters: tuple[PredictorFilter, ...]
    structures: tuple[Eigenstructure, ...]
    observability: JointObservability
    mismatch: Mismatch
    state: StateBound
    disturbance: DisturbanceBounds
    printed: PaperBound
    rate_correct: PaperBound
    direct: DirectBound
    simulated: tuple[tuple[int, SwitchingRuns], ...]  # by the smallest sojourn, in steps
    flown: tuple[str, int] | None  # the mode of the flight's shortest stay, and its steps
    notes: tuple[str, ...]

    @property
    def step_s(self) -> float:
        """The length of a step."""
        return float(self.model.step_s[0])

    @property
    def names(self) -> tuple[str, ...]:
        """The modes' names."""
        return self.model.mode_names

    @property
    def printed_sojourn(self) -> float:
        """The fewest whole steps above the printed bound, which says `>` (eq. 40)."""
        steps = self.printed.steps
        return (math.floor(steps) + 1.0 if math.isfinite(steps) else steps) + self.delay_steps

    @property
    def rate_correct_sojourn(self) -> float:
        """The fewest whole steps that the corrected bound allows, one after the delay at least."""
        steps = self.rate_correct.steps
        return (
            max(float(math.ceil(steps)) if math.isfinite(steps) else steps, 1.0) + self.delay_steps
        )

    @property
    def direct_sojourn(self) -> float:
        """The fewest whole steps that the direct bound allows: the headline."""
        return self.direct.steps + self.delay_steps

    @property
    def too_short_probability(self) -> Array:
        """By mode (n_modes,), 1 - p_ii^(S - 1): how likely a stay is below the direct bound S."""
        stay = np.minimum(np.diagonal(self.model.transition_matrix[0]), 1.0)
        if len(stay) == 1 or self.direct_sojourn <= 1:
            return np.zeros(len(stay))
        if not math.isfinite(self.direct_sojourn):
            return np.where(stay < 1.0, 1.0, 0.0)
        short: Array = 1.0 - stay ** (self.direct_sojourn - 1.0)
        return short
