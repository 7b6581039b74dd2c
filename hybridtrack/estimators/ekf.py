"""The extended Kalman filter, beside set-membership filters: smaller ellipses, and no promise.

The half-axes of the noise are taken for `noise_sigma` standard deviations (1: Q and R as they
stand), and the ellipse of `ellipse_sigma` standard deviations for the set.
"""

import threading
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.ellipsoids import inverse, symmetric
from hybridtrack.estimators import NO_KNOWN_MODES, Estimates
from hybridtrack.estimators._sets import Nonlinear, Sets, blank, estimates
from hybridtrack.models import Array
from hybridtrack.nonlinear import NonlinearModel


class Settings(NamedTuple):
    """How many standard deviations the ellipse has, and the noise's half-axes are."""

    ellipse_sigma: float = 3.0
    noise_sigma: float = 1.0


class Running:
    """The filter of a block of runs at work; see AtWork."""

    def __init__(self, settings: Settings, model: NonlinearModel, initial_mean: Array) -> None:
        """Begin at k = 0; initial_mean (n_x, lanes)."""
        self._settings, self._model = settings, model
        self._lanes, self._step = initial_mean.shape[1], 0
        self._mean = np.ascontiguousarray(initial_mean.T)
        scale = settings.noise_sigma**-2
        self._Q = scale * model.process_noise_shape
        self._R = scale * model.measurement_noise_shape
        self._covariance = np.tile(scale * model.initial_shape, (self._lanes, 1, 1))
        self.mode_names: tuple[str, ...] = ()
        self.state_names = model.state_names
        self.point_names: tuple[str, ...] = ()
        self.sets: Sets = blank(0, len(model.state_names), 0, self._lanes)[1]

    def advance(
        self,
        prepared: Any,
        measurements: Array,
        *,
        covariance: bool = False,
        known_modes: Array = NO_KNOWN_MODES,
    ) -> Estimates:
        """See AtWork; the ellipses of the span are in `sets` until the next one."""
        mean, self.sets = blank(len(measurements), len(self.state_names), 0, self._lanes)
        with np.errstate(all="ignore"):
            for k in range(len(measurements)):
                self._advance_one(measurements[k].T)
                mean[k] = self._mean.T
                ellipse = self._settings.ellipse_sigma**2 * self._covariance
                self.sets.shape[k] = np.moveaxis(ellipse, 0, -1)
        return estimates(mean)

    def _advance_one(self, measurement: Array) -> None:
        """Predict and update (Bar-Shalom, Li, Kirubarajan 2001, section 10.3), in Joseph's form."""
        model, u = self._model, self._model.inputs_at(self._step)
        self._step += 1
        A = model.dynamics.jacobian(self._mean, u)
        mean = model.dynamics.value(self._mean, u)
        P = A @ self._covariance @ np.swapaxes(A, -1, -2) + self._Q
        C = model.measurement.jacobian(mean, u)
        innovation = model.innovation(measurement, model.measurement.value(mean, u))
        missed: NDArray[np.bool_] = np.asarray(np.isnan(innovation).any(axis=1))
        PC = P @ np.swapaxes(C, -1, -2)
        K = PC @ inverse(symmetric(C @ PC + self._R))
        left = np.eye(P.shape[-1]) - K @ C
        fused = left @ P @ np.swapaxes(left, -1, -2) + K @ self._R @ np.swapaxes(K, -1, -2)
        moved = mean + (K @ np.nan_to_num(innovation)[..., np.newaxis])[..., 0]
        self._mean = np.where(missed[:, np.newaxis], mean, moved)
        self._covariance = np.where(missed[:, np.newaxis, np.newaxis], P, symmetric(fused))


class ExtendedKalmanFilter(Nonlinear):
    """The estimator; see Estimator."""

    name = "ekf"
    summary = "extended Kalman filter, its ellipse of 3 sigmas taken for a set"
    source = "Bar-Shalom, Li, Kirubarajan 2001, section 10.3"
    settings = Settings
    limits = {"ellipse_sigma": (1e-3, 1e3), "noise_sigma": (1e-3, 1e3)}  # noqa: RUF012

    def prepare(self, settings: Settings, model: NonlinearModel) -> NonlinearModel:
        """The model as it is."""
        return model

    def begin(
        self,
        settings: Settings,
        prepared: NonlinearModel,
        initial_mean: Array,
        stop: threading.Event | None = None,
    ) -> Running:
        """At k = 0."""
        return Running(settings, prepared, initial_mean)


ESTIMATOR = ExtendedKalmanFilter()
