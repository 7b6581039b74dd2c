"""The extended set-membership filter: an ellipsoid that contains the state for certain.

Scholte, Campbell 2003, as in Otanez, Campbell 2004: predict by the linearised model, enclose what
the linearisation leaves out, fuse with the measurement (Schweppe 1973). Relinearised at its own
centre it is the plain filter; a bank has fixed operating points and takes, step by step, the one
with the smallest ellipsoid.

What is ours where the paper is silent or wrong: the centre is f(xbar) + A (xhat - xbar) plus the
middle of the remainder (eq. 1 prints f(xhat), which for a fixed operating point contradicts
eq. 18); the remainder is that over the ellipsoid at hand (eq. 20 centres it at the operating point,
wherever the state is); a box of m components takes a factor m (eq. 22 prints 2).
"""

import threading
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.ellipsoids import Updated as Fused
from hybridtrack.ellipsoids import (
    add,
    around_box,
    best_rho,
    half_widths,
    sizes,
    trace,
    update,
)
from hybridtrack.errors import Unsuited
from hybridtrack.estimators import NO_KNOWN_MODES, Estimates
from hybridtrack.estimators._sets import Nonlinear, Sets, blank, estimates, note_points
from hybridtrack.models import Array
from hybridtrack.nonlinear import NonlinearModel
from hybridtrack.remainders import Remainder

Criterion = Literal[
    "trace_sigma",
    "determinant_sigma",
    "eigenvalue_sigma",
    "trace_q",
    "determinant_q",
    "eigenvalue_q",
]


class Settings(NamedTuple):
    """operation: relinearised | bank_parallel (each filter alone) | bank_reset (one feeds all).

    criterion: what chooses in a bank, of the ellipsoid (sigma) or of the noise with the remainder
    (q). remainder, box, form: see the module and its rooms. beta: by the smallest trace, or a
    number; rho: a number, or by the smallest trace or determinant. growth: a run has diverged whose
    bound on a state is this many times the first one, or the half-axis of the state's process noise
    where that is larger.
    """

    operation: Literal["relinearised", "bank_parallel", "bank_reset"] = "relinearised"
    operating_points: list[list[float]] = []  # noqa: RUF012  (read only; a scenario's own replaces it)
    criterion: Criterion = "trace_sigma"
    remainder: Literal["exact", "printed_eq20", "printed_eq40"] = "exact"
    box: Literal["trace", "count", "two"] = "trace"
    beta: Literal["trace"] | float = "trace"
    rho: Literal["trace", "determinant"] | float = 0.05
    form: Literal["schweppe", "bertsekas"] = "schweppe"
    growth: float = 1000.0


class Filters(NamedTuple):
    """All filters of a bank in all lanes, one after the other: (n_filters lanes, ...)."""

    centre: Array  # (., n_x)
    shape: Array  # (., n_x, n_x)
    level: Array  # (.,) delta of Bertsekas: the bound is (1 - level) shape; 0 with Schweppe

    @property
    def bound(self) -> Array:
        """The ellipsoid that contains the state."""
        result: Array = (1.0 - self.level)[:, np.newaxis, np.newaxis] * self.shape
        return result


class Step(NamedTuple):
    """What a step gives besides the filters."""

    filters: Filters
    noise: Array  # Qhat (., n_x, n_x)
    empty: Any  # (.,)


class Running:
    """The filters of a block of runs at work; see AtWork."""

    def __init__(
        self,
        settings: Settings,
        model: NonlinearModel,
        initial_mean: Array,
        stop: threading.Event | None,
    ) -> None:
        """Begin at k = 0; initial_mean (n_x, lanes)."""
        self._settings, self._model = settings, model
        self._lanes = initial_mean.shape[1]
        self._points = np.array(settings.operating_points, dtype=np.float64)
        self._count = 1 if settings.operation == "relinearised" else len(self._points)
        self._at = np.repeat(self._points, self._lanes, axis=0)  # (n_filters lanes, n_x)
        centre = np.ascontiguousarray(initial_mean.T)
        self._filters = Filters(
            np.tile(centre, (self._count, 1)),
            np.tile(model.initial_shape, (self._count * self._lanes, 1, 1)),
            np.zeros(self._count * self._lanes),
        )
        first = np.maximum(half_widths(model.initial_shape), half_widths(model.process_noise_shape))
        self._limit = settings.growth * first  # (n_x,)
        self._step = 0
        self._diverged = np.zeros(self._lanes, dtype=np.bool_)
        self.mode_names: tuple[str, ...] = ()
        self.state_names = model.state_names
        self.point_names = tuple(str(i + 1) for i in range(self._count if self._at.size else 0))
        self.sets: Sets = blank(0, len(model.state_names), 0, self._lanes)[1]

    def advance(
        self,
        prepared: Any,
        measurements: Array,
        *,
        covariance: bool = False,
        known_modes: Array = NO_KNOWN_MODES,
    ) -> Estimates:
        """See AtWork; the sets of the span are in `sets` until the next one."""
        n_steps, lanes, n_x = len(measurements), self._lanes, len(self.state_names)
        mean, self.sets = blank(n_steps, n_x, len(self.point_names), lanes)
        with np.errstate(all="ignore"):
            for k in range(n_steps):
                step = self._advance_one(measurements[k].T)
                self._note(k, mean, step)
        return estimates(mean)

    # ---- one step ----

    def _advance_one(self, measurement: Array) -> Step:
        """Predict and update every filter with a measurement (lanes, n_y)."""
        u = self._model.inputs_at(self._step)
        self._step += 1
        predicted, noise = self._predict(u)
        y = np.tile(measurement, (self._count, 1))
        filters, empty = self._fuse(predicted, y, u)
        self._filters = filters
        return Step(filters, noise, empty)

    def _predict(self, u: Array) -> tuple[Filters, Array]:
        """Otanez 2004, eq. 1, 2 and 18-23; with Qhat."""
        settings, model, now = self._settings, self._model, self._filters
        at = self._at if self._points.size else now.centre
        A = model.dynamics.jacobian(at, u)
        middle, radius = self._remainder(model.dynamics_remainder, at, now.centre, now.bound, u)
        beta = None if isinstance(settings.beta, str) else settings.beta
        Q = np.broadcast_to(model.process_noise_shape, now.shape.shape)
        noise = add(_diagonal(around_box(radius, settings.box)), Q, beta).shape
        total = add(A @ now.shape @ np.swapaxes(A, -1, -2), noise, beta)
        moved = (A @ (now.centre - at)[..., np.newaxis])[..., 0]
        centre = model.dynamics.value(at, u) + moved + middle
        # (1 - beta) (1 - delta) + beta is what the sum's own distances stay below.
        return Filters(centre, total.shape, (1.0 - total.beta) * now.level), noise

    def _fuse(self, predicted: Filters, y: Array, u: Array) -> tuple[Filters, Any]:
        """Otanez 2004, eq. 3-6, or 29-30; and where nothing is left."""
        settings, model = self._settings, self._model
        at = self._at if self._points.size else predicted.centre
        C = model.measurement.jacobian(at, u)
        guess = model.measurement.value(at, u)
        guess += (C @ (predicted.centre - at)[..., np.newaxis])[..., 0]
        R = np.broadcast_to(model.measurement_noise_shape, (len(y), *2 * (y.shape[1],)))
        if not model.measurement_remainder.is_zero:
            bound, centre = predicted.bound, predicted.centre
            middle, radius = self._remainder(model.measurement_remainder, at, centre, bound, u)
            guess += middle
            beta = None if isinstance(settings.beta, str) else settings.beta
            R = add(_diagonal(around_box(radius, settings.box)), R, beta).shape
        innovation = y - guess
        missed: NDArray[np.bool_] = np.asarray(np.isnan(innovation).any(axis=1))
        innovation = np.where(missed[:, np.newaxis], 0.0, innovation)

        def fused(rho: Array) -> Fused:
            return update(predicted.centre, predicted.shape, innovation, C, R, rho)

        found = fused(self._rho(fused, len(y)))
        if settings.form == "bertsekas":
            level = (1.0 - found.rho) * predicted.level + found.distance
            shape = found.shape
        else:
            level = np.zeros(len(y))
            shape = (1.0 - found.distance)[:, np.newaxis, np.newaxis] * found.shape
        spent = level if settings.form == "bertsekas" else found.distance
        empty = (spent > 1.0) & ~missed
        kept = missed | empty  # the prediction stands
        filters = Filters(
            np.where(kept[:, np.newaxis], predicted.centre, found.centre),
            np.where(kept[:, np.newaxis, np.newaxis], predicted.shape, shape),
            np.where(kept, predicted.level, level),
        )
        return filters, empty

    def _rho(self, fused: Any, lanes: int) -> Array:
        rule = self._settings.rho
        if not isinstance(rule, str):
            return np.full(lanes, rule)

        def size(rho: Array) -> Array:
            found = fused(rho)
            left = 1.0
            if self._settings.form == "schweppe":
                left = np.maximum(1.0 - found.distance, 0.0)[:, np.newaxis, np.newaxis]
            return sizes(left * found.shape, rule)

        return best_rho(size, lanes)

    def _remainder(
        self, remainder: Remainder, at: Array, centre: Array, bound: Array, u: Array
    ) -> tuple[Array, Array]:
        """Middle and radius of what linearising at `at` leaves out over an ellipsoid."""
        kind = self._settings.remainder
        if remainder.is_zero:
            nothing = np.zeros((len(at), len(remainder.waves)))
            return nothing, nothing
        if kind == "printed_eq40":
            size = remainder.at_point(at, centre, u)
            return np.zeros_like(size), size
        reach = half_widths(bound)
        middle = at if kind == "printed_eq20" else centre
        low, high = np.minimum(middle - reach, at), np.maximum(middle + reach, at)
        least, most = remainder.enclose(at, low, high, u)
        # Rounded up, so that neither end is lost.
        radius = 0.5 * (most - least) * (1.0 + 4 * np.finfo(np.float64).eps)
        return 0.5 * (least + most), radius

    # ---- what is told ----

    def _note(self, k: int, mean: Array, step: Step) -> None:
        """Choose among the filters, feed the chosen one to all if so set, and note the step."""
        settings, n, lanes = self._settings, self._count, self._lanes
        bound = step.filters.bound
        measure, _, of = settings.criterion.partition("_")
        size = sizes(bound if of == "sigma" else step.noise, measure).reshape(n, lanes)
        usable = np.isfinite(trace(bound)).reshape(n, lanes)
        chosen = np.where(usable & np.isfinite(size), size, np.inf).argmin(axis=0)
        row = chosen * lanes + np.arange(lanes)
        sets = self.sets
        mean[k], shape = step.filters.centre[row].T, bound[row]
        self._diverged |= ~(half_widths(shape) <= self._limit).all(axis=1)
        mean[k][:, self._diverged] = np.nan
        sets.shape[k] = np.moveaxis(shape, 0, -1)
        sets.chosen[k] = chosen
        sets.empty[k] = step.empty.reshape(n, lanes).any(axis=0) & ~self._diverged
        if self.point_names:
            note_points(sets, k, bound.reshape(n, lanes, *bound.shape[1:]))
        if settings.operation == "bank_reset":
            self._filters = Filters(*(np.concatenate([part[row]] * n) for part in step.filters))


def _diagonal(values: Array) -> Array:
    """Matrices (lanes, n, n) with values (lanes, n) on the diagonal."""
    shape: Array = values[..., np.newaxis] * np.eye(values.shape[-1])
    return shape


class SetMembershipFilter(Nonlinear):
    """The estimator; see Estimator."""

    name = "esmf"
    summary = "extended set-membership filter: hard bounds, one model or a switched bank"
    source = "Otanez, Campbell 2004, eqs. 1-6, 18-23, 29-30; Scholte, Campbell 2003"
    settings = Settings
    limits: Mapping[str, tuple[float | None, float | None]] = {"growth": (1.0, 1e12)}

    def prepare(self, settings: Settings, model: NonlinearModel) -> NonlinearModel:
        """The model as it is; the settings are checked against it."""
        n_x = len(model.state_names)
        if settings.operation == "relinearised" and settings.operating_points:
            raise Unsuited(
                "a relinearised filter has no 'operating_points'; remove them, or set 'operation' "
                "to bank_reset",
                "operating_points",
            )
        if settings.operation != "relinearised" and not settings.operating_points:
            raise Unsuited(
                f"'operation' {settings.operation} needs 'operating_points', a list of states such "
                f"as [{', '.join('0' * n_x)}]; add it",
                "operation",
            )
        for i, point in enumerate(settings.operating_points):
            if len(point) != n_x:
                raise Unsuited(
                    f"an operating point has {len(point)} numbers and needs one for each of the "
                    f"states {' '.join(model.state_names)}",
                    "operating_points",
                    i,
                )
        for key in ("beta", "rho"):
            weight = getattr(settings, key)
            if not isinstance(weight, str) and not 0.0 < weight < 1.0:
                raise Unsuited(
                    f"'{key}' is {weight:g}; give a number between 0 and 1, without both", key
                )
        return model

    def begin(
        self,
        settings: Settings,
        prepared: NonlinearModel,
        initial_mean: Array,
        stop: threading.Event | None = None,
    ) -> Running:
        """At k = 0."""
        return Running(settings, prepared, initial_mean, stop)


ESTIMATOR = SetMembershipFilter()
