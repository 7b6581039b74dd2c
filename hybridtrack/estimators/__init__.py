"""The estimators: one short file each, found by its name, nearly all on one compiled recursion.

A new estimator is one file here that defines ESTIMATOR. Its settings are a NamedTuple with types
and defaults; the scenario's checked form is derived from it. One that isn't a choice of the
recursion (a BankEstimator) needs its own `prepare` and `begin`; blocks of runs know no more of any.
"""

import functools
import importlib
import pkgutil
import threading
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from hybridtrack.chains import Bound, on_supermodes
from hybridtrack.estimators import _bank, _layout
from hybridtrack.estimators._bank import NO_KNOWN_MODES, Recursion
from hybridtrack.estimators._layout import Array, Estimates
from hybridtrack.estimators._sets import Sets
from hybridtrack.models import JumpMarkovModel

__all__ = [
    "NO_KNOWN_MODES",
    "AtWork",
    "BankEstimator",
    "Estimates",
    "Estimator",
    "Running",
    "Sets",
    "SetsAtWork",
    "estimators",
]


class AtWork(Protocol):
    """An estimator at work on one block of runs; remembers its state between spans."""

    mode_names: tuple[str, ...]
    state_names: tuple[str, ...]

    def advance(
        self,
        prepared: Any,
        measurements: Array,
        *,
        covariance: bool = False,
        known_modes: Array = NO_KNOWN_MODES,
    ) -> Estimates:
        """Filter a span: measurements (n_steps, n_y, lanes), NaN where missed.

        known_modes (n_steps, lanes): the index of the true mode, where it is to be told.

        The estimates live in memory that the thread's next call, of any estimator, may overwrite:
        what is used at once is still in the cache.
        """
        ...


class SetsAtWork(AtWork, Protocol):
    """One that gives a set beside every estimate."""

    point_names: tuple[str, ...]  # of its operating points, where it has some
    sets: Sets  # those of the last span


class Estimator(Protocol):
    """What a scenario can choose by its name."""

    @property
    def name(self) -> str: ...
    @property
    def summary(self) -> str: ...
    @property
    def source(self) -> str: ...
    @property
    def settings(self) -> type[Any]:
        """A NamedTuple: types, and defaults where there are any."""
        ...

    @property
    def limits(self) -> Mapping[str, tuple[float | None, float | None]]:
        """Smallest and largest value by setting."""
        ...

    @property
    def nonlinear(self) -> bool:
        """Whether it is for a NonlinearModel, and gives sets (a SetsAtWork)."""
        ...

    def is_told_modes(self, settings: Any) -> bool:
        """Whether it has to be given the true modes."""
        ...

    @property
    def has_likelihoods(self) -> bool:
        """Whether it gives one of each mode, where modes are no supermodes."""
        ...

    @property
    def bound(self) -> Callable[[Any], Bound]:
        """How its chain is bounded, by its settings.

        Under a bound its model says how likely the mode now is the last one, and so it estimates.
        """
        ...

    def prepare(self, settings: Any, model: Any) -> Any:
        """What it makes of a model for some steps; kept for all blocks with such steps.

        model: a JumpMarkovModel, or a NonlinearModel where it is for these.
        """
        ...

    def begin(
        self,
        settings: Any,
        prepared: Any,
        initial_mean: Array,
        stop: threading.Event | None = None,
    ) -> AtWork:
        """Start on a block: `prepared` for its first span, initial_mean (n_x, lanes).

        Whose spans take longer than half a second looks at `stop` on the way, and raises Stopped.
        """
        ...


def _as_it_is(model: JumpMarkovModel, settings: Any) -> JumpMarkovModel:
    return model


def _no_bound(settings: Any) -> Bound:
    return Bound()


class BankEstimator(NamedTuple):
    """A multiple-model filter: the recursion's choices, a change of the model, a bound."""

    name: str
    summary: str
    source: str
    settings: type[Any]
    recursion: Callable[[Any], Recursion]
    model: Callable[[JumpMarkovModel, Any], JumpMarkovModel] = _as_it_is  # of the bank's modes
    limits: Mapping[str, tuple[float | None, float | None]] = {}  # smallest, largest by setting
    bound: Callable[[Any], Bound] = _no_bound  # on the chain of these

    @property
    def has_likelihoods(self) -> bool:
        """Always."""
        return True

    @property
    def nonlinear(self) -> bool:
        """Never."""
        return False

    def is_told_modes(self, settings: Any) -> bool:
        """Whether it has to be given the true modes."""
        return self.recursion(settings).interaction == _bank.INHERIT

    def prepare(self, settings: Any, model: JumpMarkovModel) -> "Prepared":
        """The model on its own chain, as it is and as the kernel wants it."""
        own, bound = self.model(model, settings), self.bound(settings)
        if bound.is_set:
            chain = bound.supermodes(own.transition_matrix, own.initial_mode_probabilities)
            own = on_supermodes(own, chain)
        return Prepared(own, _layout.kernel_model(own))

    def begin(
        self,
        settings: Any,
        prepared: "Prepared",
        initial_mean: Array,
        stop: threading.Event | None = None,
    ) -> "Running":
        """The recursion at k = 0; a span takes milliseconds."""
        return Running(self.recursion(settings), prepared, initial_mean)


@functools.cache
def estimators() -> Mapping[str, Estimator]:
    """Every estimator by its name, in alphabetical order."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        if not module.name.startswith("_"):
            estimator = importlib.import_module(f"{__name__}.{module.name}").ESTIMATOR
            found[estimator.name] = estimator
    return dict(sorted(found.items()))


class Prepared(NamedTuple):
    """A bank's model for some steps, as it is and as the kernel wants it."""

    model: JumpMarkovModel
    kernel: _layout.KernelModel


class Running:
    """The recursion at work; see AtWork."""

    def __init__(self, recursion: Recursion, first: Prepared, initial_mean: Array) -> None:
        """first: for the first span; initial_mean (n_x, lanes)."""
        self._recursion = recursion
        self._model = first.model
        self._lanes = initial_mean.shape[1]
        self._state = _layout.start(first.model, self._lanes, initial_mean)
        self._prior = first.model.initial_mode_probabilities.copy()
        self.mode_names = _layout.output_modes(first.model)
        self.state_names = first.model.state_names

    def advance(
        self,
        prepared: Prepared,
        measurements: Array,
        *,
        covariance: bool = False,
        known_modes: Array = NO_KNOWN_MODES,
    ) -> Estimates:
        """See AtWork."""
        room = memory.room(
            self._model, len(measurements), self._lanes, len(self.mode_names) > 1, covariance
        )
        work = memory.workspace(self._model)
        _bank.run_span(
            self._state, work, prepared.kernel, self._recursion, measurements, room, known_modes
        )
        if len(room.final_mode_prior):
            scratch = np.empty_like(self._prior)
            _bank.foresee(self._prior, scratch, prepared.kernel, room.final_mode_prior)
        return room


class _Memory(threading.local):
    """What a thread's calls use one after the other, by size."""

    def __init__(self) -> None:
        self._workspaces: dict[tuple[int, ...], _layout.Workspace] = {}
        self._rooms: dict[tuple[Any, ...], Estimates] = {}

    def workspace(self, model: JumpMarkovModel) -> _layout.Workspace:
        size = model.measurement_matrix.shape
        if size not in self._workspaces:
            self._workspaces[size] = _layout.workspace(model)
        return self._workspaces[size]

    def room(
        self, model: JumpMarkovModel, steps: int, lanes: int, likelihoods: bool, covariance: bool
    ) -> Estimates:
        outputs = len(set(model.mode_names))
        final = model.final_probability is not None
        size = (model.measurement_matrix.shape, outputs, lanes, likelihoods, covariance, final)
        kept = self._rooms.get(size)
        if kept is None or len(kept.mean) < steps:
            kept = self._rooms[size] = _layout.empty_estimates(
                model, steps, lanes, likelihoods=likelihoods, covariance=covariance
            )
        return Estimates(*(array[:steps] for array in kept))


memory = _Memory()
