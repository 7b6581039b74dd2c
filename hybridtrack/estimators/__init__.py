"""The estimators: one short file each, found by its name, all on one compiled recursion.

A new estimator is one file here that defines ESTIMATOR. Its settings are a NamedTuple with types
and defaults; the scenario's checked form is derived from it.
"""

import functools
import importlib
import pkgutil
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from hybridtrack.estimators import _bank, _layout
from hybridtrack.estimators._bank import Recursion
from hybridtrack.estimators._layout import Array, Estimates
from hybridtrack.models import JumpMarkovModel

__all__ = ["BankEstimator", "Estimates", "Running", "estimators"]


class BankEstimator(NamedTuple):
    """A multiple-model filter: a change of the model, and the recursion's choices."""

    name: str
    summary: str
    source: str
    settings: type[Any]
    model: Callable[[JumpMarkovModel, Any], JumpMarkovModel]
    recursion: Callable[[Any], Recursion]
    limits: Mapping[str, tuple[float | None, float | None]] = {}  # smallest, largest by setting


@functools.cache
def estimators() -> Mapping[str, BankEstimator]:
    """Every estimator by its name, in alphabetical order."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        if not module.name.startswith("_"):
            estimator = importlib.import_module(f"{__name__}.{module.name}").ESTIMATOR
            found[estimator.name] = estimator
    return dict(sorted(found.items()))


class Running:
    """One estimator at work on one block of runs; remembers its state between spans.

    `status` (lanes,) holds 0, or the first step at which a run's estimate was no finite number.
    """

    def __init__(
        self,
        estimator: BankEstimator,
        settings: Any,
        model: JumpMarkovModel,
        initial_mean: Array,
    ) -> None:
        """model: of the first span; initial_mean (n_x, lanes)."""
        self._estimator = estimator
        self._settings = settings
        self._recursion = estimator.recursion(settings)
        self._model = estimator.model(model, settings)
        self._kernel_model = _layout.kernel_model(self._model)
        self._given = model
        self._lanes = initial_mean.shape[1]
        self._state = _layout.start(self._model, self._lanes, initial_mean)
        self._work = _layout.workspace(self._model)
        self._room: Estimates | None = None
        self.mode_names = _layout.output_modes(self._model)
        self.state_names = self._model.state_names

    def advance(
        self, model: JumpMarkovModel, measurements: Array, *, covariance: bool = False
    ) -> Estimates:
        """Filter a span: measurements (n_steps, n_y, lanes), NaN where missed.

        The estimates live in memory that the next call overwrites.
        """
        if model is not self._given:
            self._given = model
            self._kernel_model = _layout.kernel_model(self._estimator.model(model, self._settings))
        steps = len(measurements)
        room = self._room
        if room is None or len(room.mean) != steps or bool(len(room.covariance)) != covariance:
            likelihoods = len(self.mode_names) > 1
            room = self._room = _layout.empty_estimates(
                self._model, steps, self._lanes, likelihoods=likelihoods, covariance=covariance
            )
        _bank.run_span(
            self._state, self._work, self._kernel_model, self._recursion, measurements, room
        )
        return room
