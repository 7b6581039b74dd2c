"""What a scenario asks for, in SI and arrays: the frozen Experiment and its parts."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from hybridtrack.containment import set_metrics
from hybridtrack.estimators import Estimator
from hybridtrack.models import Array, ModeBank
from hybridtrack.nonlinear import NonlinearModel
from hybridtrack.sensors import Sensor
from hybridtrack.simulation import Case, sojourns, step_lengths
from hybridtrack.statistics import METRICS, QUANTITIES, Metric
from hybridtrack.verdicts import AnalysisClaim, Claim


class Initial(NamedTuple):
    """How the filters start."""

    two_point: bool  # from the first two scans; what follows is unused then
    follows_truth: bool  # the mean is the run's true start, plus a draw if `drawn`
    drawn: bool
    mean: Array  # (n_x,)
    covariance: Array  # (n_x, n_x)


class Window(NamedTuple):
    """Steps scored by themselves; every condition that isn't None must hold."""

    name: str
    from_s: float = -np.inf
    until_s: float = np.inf
    mode: int | None = None  # the truth's
    after_switch_s: float | None = None
    within_switch_s: float | None = None
    skip_scans: int = 0


class ChosenEstimator(NamedTuple):
    """An estimator of the scenario: its label there, and how it is set."""

    label: str
    estimator: Estimator
    settings: Any
    bank: ModeBank  # what it believes; one mode for a Kalman filter


class Experiment(NamedTuple):
    """What a scenario asks for, in SI and arrays; nothing of YAML is left in it."""

    name: str
    title: str
    source: str
    assumptions: tuple[str, ...]
    cases: tuple[Case, ...]
    truth_modes: tuple[str, ...]
    bank: ModeBank
    sensor: Sensor
    initial: Initial
    estimators: tuple[ChosenEstimator, ...]
    compare_with: str | None
    error: str  # rmse | mse: what tables and figures show
    windows: tuple[Window, ...]
    runs: int
    seed: int
    keep_tracks: int
    claims: tuple[Claim, ...]  # on figures of a run
    analysis_claims: tuple[AnalysisClaim, ...]
    analyses: Mapping[str, Any]  # settings by analysis
    resolved: dict[str, Any]  # the scenario as it can be run again
    nonlinear: NonlinearModel | None = None  # instead of a bank of modes, which is empty then
    point_names: tuple[str, ...] = ()  # of operating points, of the estimator with the most
    units: Mapping[str, str] = MappingProxyType({})  # of states and measurements beside `nonlinear`

    @property
    def metrics(self) -> Mapping[str, Metric]:
        """Every metric that an estimator here may have, by name."""
        if self.nonlinear is None:
            return METRICS
        return {**METRICS, **set_metrics(self.nonlinear.state_names, self.point_names)}

    @property
    def quantities(self) -> tuple[str, ...]:
        """What they are made of, in the order of runs.parquet."""
        if self.nonlinear is None:
            return QUANTITIES
        own = set_metrics(self.nonlinear.state_names, self.point_names).values()
        return (*QUANTITIES, *dict.fromkeys(metric.quantity for metric in own))

    @property
    def states(self) -> dict[str, str]:
        """Where it is nonlinear, the states with their units, '' where none is given."""
        names = self.nonlinear.state_names if self.nonlinear else ()
        return {name: self.units.get(name, "") for name in names}

    def switches(self, case: int) -> bool:
        """Whether the truth of a case may change its mode."""
        lasting = sojourns(self.cases[case].truth)
        return len(self.truth_modes) > 1 and (lasting is None or len(lasting) > 1)

    @property
    def foresees(self) -> bool:
        """Whether an estimator tells how likely the mode now is the last, and the truth knows.

        None does where steps are uneven: what comes after a step is another chain than before it.
        """
        bounds = [chosen.estimator.bound(chosen.settings) for chosen in self.estimators]
        told = any(bound.is_set for bound in bounds) and bool(self.truth_modes)
        return told and all(not np.ptp(step_lengths(case.times_s)) for case in self.cases)
