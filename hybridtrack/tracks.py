"""Tracks: what the first runs of a block were and what was made of them, kept step by step."""

from typing import cast

import numpy as np

from hybridtrack.config import Experiment
from hybridtrack.estimators import AtWork, Estimates, SetsAtWork
from hybridtrack.groups import NOISE_FREE, TRUTH, BlockTask, Track
from hybridtrack.models import Array
from hybridtrack.simulation import Scans

MEASUREMENT = "measurement"


class TrackKeeper:
    """The tracks of a block, span by span; a step that isn't told stays NaN."""

    def __init__(self, experiment: Experiment, task: BlockTask, n_steps: int) -> None:
        """Keeps nothing where the task wants no tracks."""
        self._experiment, self._runs, self._n_steps = experiment, task.tracks, n_steps
        self._kept: dict[tuple[int, str, str], Array] = {}

    def tracks(self) -> list[Track]:
        """Truth and measurements first, then estimators in the scenario's order."""
        order = [
            TRUTH,
            NOISE_FREE,
            MEASUREMENT,
            *(chosen.label for chosen in self._experiment.estimators),
        ]
        kept = sorted(self._kept.items(), key=lambda item: order.index(item[0][1]))
        return [Track(*key, values) for key, values in kept]

    def truth(self, span: slice, states: tuple[str, ...], scans: Scans) -> None:
        """The truth's states, by name, and its modes; the measurements."""
        if not self._runs:
            return
        for e, name in enumerate(states):
            self._keep(span, TRUTH, name, scans.truth.state[:, e])
        if self._experiment.truth_modes:
            self._keep(span, TRUTH, "mode", scans.truth.mode.astype(np.float64))
        model = self._experiment.nonlinear
        for m in range(scans.measurements.shape[1]):
            name = "xy"[m] if model is None else model.measurement_names[m]
            self._keep(span, MEASUREMENT, name, scans.measurements[:, m])

    def noise_free(self, course: Array) -> None:
        """The states (n_steps, n_x) of a nonlinear truth, were there no noise."""
        model = self._experiment.nonlinear
        assert model is not None
        for e, name in enumerate(model.state_names):
            self._keep(slice(0, self._n_steps), NOISE_FREE, name, course[:, e, np.newaxis])

    def estimates(self, span: slice, label: str, running: AtWork, estimates: Estimates) -> None:
        """What an estimator says of a span, with what it tells beside its means."""
        if not self._runs:
            return
        for e, name in enumerate(running.state_names):
            self._keep(span, label, name, estimates.mean[:, e])
        if self._experiment.nonlinear is not None:
            self._sets(span, label, cast(SetsAtWork, running))
            return
        for e, name in enumerate(running.state_names):
            variance = estimates.covariance[:, e * (e + 1) // 2 + e]
            self._keep(span, label, f"std:{name}", np.sqrt(np.maximum(variance, 0.0)))
        if len(running.mode_names) > 1:
            for j, name in enumerate(running.mode_names):
                values = estimates.mode_probabilities[:, j]
                self._keep(span, label, f"mode_probability:{name}", values)
        if len(estimates.final_mode_probability):
            values = estimates.final_mode_probability
            self._keep(span, label, "final_mode_probability", values)

    def _sets(self, span: slice, label: str, running: SetsAtWork) -> None:
        for e, name in enumerate(running.state_names):
            bound: Array = np.sqrt(running.sets.shape[:, e, e])
            self._keep(span, label, f"bound:{name}", bound)
        if running.point_names:
            self._keep(span, label, "model", running.sets.chosen.astype(np.float64) + 1.0)

    def _keep(self, span: slice, label: str, quantity: str, values: Array) -> None:
        for run in range(self._runs):
            key = (run, label, quantity)
            if key not in self._kept:
                self._kept[key] = np.full(self._n_steps, np.nan)
            self._kept[key][span] = values[:, run if values.shape[1] > 1 else 0]
