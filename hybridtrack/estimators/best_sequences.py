"""Best sequences: a Kalman filter for each sequence of modes, the most probable ones kept.

A jump Markov system is filtered exactly by one Kalman filter for every sequence of modes that may
have been, and they multiply with every scan. The tree of sequences is pruned here after every scan
to the most probable; nothing is merged. So it is a yardstick for filters that merge, near the best
there can be where enough are kept. It is ours, in the spirit of Tugnait and Haddad 1979 (a pruned
tree of mode histories).

On a bounded chain a sequence of modes may be in several stages. Its Kalman filter is the same in
all of them, so each sequence has a weight for every supermode of its present mode, and the bound
costs no sequences.
"""

import threading
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hybridtrack.chains import Bound
from hybridtrack.errors import Stopped, UserError
from hybridtrack.estimators import NO_KNOWN_MODES, Estimates, memory
from hybridtrack.estimators._bank import foresee
from hybridtrack.estimators._layout import (
    Array,
    KernelModel,
    SparseMaps,
    kernel_model,
    sparse,
    start,
)
from hybridtrack.estimators._tree import Chain, Sequences, Tree, advance
from hybridtrack.models import JumpMarkovModel
from hybridtrack.vectors import WIDTH, aligned_zeros

RUNS_PER_CALL, SUPERMODES_PER_CALL = 8, 40_000  # half a second at most, for 75 scans


class Settings(NamedTuple):
    """sequences: how many are kept at most. The others are the soft and the hard bound filter's."""

    sequences: int = 100
    continuation_probability: float | None = None
    leak: float = 0.0
    most_transitions: int | None = None


class Prepared(NamedTuple):
    """A bank's model for some steps: as the kernels want it, and as it is."""

    kernel: KernelModel
    chain: Chain
    model: JumpMarkovModel


class Running:
    """The sequences of a block of runs at work; see AtWork."""

    def __init__(
        self, most: int, first: Prepared, initial_mean: Array, stop: threading.Event | None
    ) -> None:
        """Begin with one sequence, of no mode yet, whose supermodes are as probable as at k = 0."""
        model, chain = first.model, first.chain
        n_modes, _, n_x = model.measurement_matrix.shape
        n_packed, n_supermodes = n_x * (n_x + 1) // 2, chain.mode.size
        n_groups, runs = -(-most // WIDTH), initial_mean.shape[1]
        self._most, self._model, self._stop = most, model, stop
        self._runs_per_call = min(
            RUNS_PER_CALL, max(1, SUPERMODES_PER_CALL // (most * n_supermodes))
        )
        self._prior = chain.initial_probabilities.copy()
        self._sequences = Sequences(
            mean=aligned_zeros(runs, n_groups, n_x, WIDTH),
            covariance=aligned_zeros(runs, n_groups, n_packed, WIDTH),
            log_weight=aligned_zeros(runs, n_groups, n_supermodes, WIDTH),
            kept=np.ones(runs, dtype=np.int64),
        )
        self._sequences.mean[:, 0, :, 0] = initial_mean.T
        self._sequences.covariance[:, 0, :, 0] = model.initial_covariance[np.tril_indices(n_x)]
        self._sequences.log_weight[:] = -np.inf
        self._sequences.log_weight[:, 0, :, 0] = _logarithms(self._prior)
        self._tree = Tree(
            filters=start(model, n_groups * WIDTH),
            log_weight=aligned_zeros(n_groups, n_supermodes, WIDTH),
            log_total=aligned_zeros(n_groups, n_modes, WIDTH),
            log_likelihood=aligned_zeros(n_modes, WIDTH),
            found=aligned_zeros(n_groups * n_modes * WIDTH),
            weight=aligned_zeros(n_groups, WIDTH),
            lanes=aligned_zeros(WIDTH),
        )
        self.mode_names, self.state_names = model.mode_names, model.state_names

    def advance(
        self,
        prepared: Prepared,
        measurements: Array,
        *,
        covariance: bool = False,
        known_modes: Array = NO_KNOWN_MODES,
    ) -> Estimates:
        """See AtWork."""
        n_runs = measurements.shape[2]
        room = memory.room(self._model, len(measurements), n_runs, False, covariance)
        work, chain = memory.workspace(self._model), prepared.chain
        shared = (self._sequences, self._tree, work, prepared.kernel, chain, self._most)
        with np.errstate(all="ignore"):  # uncompiled, NumPy would warn of what is dealt with
            for first in range(0, n_runs, self._runs_per_call):
                if self._stop is not None and self._stop.is_set():
                    raise Stopped
                runs = (first, min(first + self._runs_per_call, n_runs))
                advance(*shared, measurements, room, runs)
        if len(room.final_mode_prior):
            foresee(self._prior, np.empty_like(self._prior), chain, room.final_mode_prior)
        return room


class BestSequences:
    """The estimator; see Estimator."""

    name = "best_sequences"
    summary = "Kalman filters of the most probable sequences of modes, nothing merged"
    source = "ours, in the spirit of Tugnait and Haddad 1979"
    settings = Settings
    limits: Mapping[str, tuple[float | None, float | None]] = {
        "sequences": (1.0, 1000.0),
        "continuation_probability": (0.0, 1.0),
        "leak": (0.0, 1.0),
        "most_transitions": (0.0, 100.0),
    }

    has_likelihoods = False
    nonlinear = False

    def is_told_modes(self, settings: Settings) -> bool:
        """Never."""
        return False

    def bound(self, settings: Settings) -> Bound:
        """The soft one's, the hard one's or none."""
        return Bound(settings.continuation_probability, settings.leak, settings.most_transitions)

    def prepare(self, settings: Settings, model: JumpMarkovModel) -> Prepared:
        """The bank's modes, and the chain of supermodes beside them."""
        bound = self.bound(settings)
        if bound.continuation_probability is None and bound.leak:
            raise UserError(
                "'leak' brings back a mode that has ended, and without 'continuation_probability' "
                "none ends; add that, or remove 'leak'"
            )
        if bound.continuation_probability is not None and bound.most_transitions is not None:
            raise UserError(
                "'most_transitions' bounds the chain hard and 'continuation_probability' softly; "
                "remove one"
            )
        found = bound.supermodes(model.transition_matrix, model.initial_mode_probabilities)
        told = bound.is_set and model.even_steps
        members = found.mode == np.arange(len(model.mode_names))[:, np.newaxis]
        chain = Chain(
            mode=found.mode,
            initial_probabilities=found.initial_probabilities,
            transition_matrix=np.ascontiguousarray(found.transition_matrix),
            log_origins=_in_logarithms(np.swapaxes(found.transition_matrix, 1, 2)),
            log_members=_in_logarithms(members[np.newaxis].astype(np.float64)),
            final_probability=found.final_probability[0] if told else np.zeros(0),
        )
        kernel = kernel_model(model)
        if told:  # for the room of the estimates
            model = model._replace(final_probability=found.final_probability[0])
        return Prepared(kernel, chain, model)

    def begin(
        self,
        settings: Settings,
        prepared: Prepared,
        initial_mean: Array,
        stop: threading.Event | None = None,
    ) -> Running:
        """At k = 0."""
        return Running(settings.sequences, prepared, initial_mean, stop)


def _in_logarithms(matrices: Array) -> SparseMaps:
    """Matrices (n_times, n_rows, n_columns) without what is always zero."""
    maps = sparse(matrices[:, np.newaxis])
    return maps._replace(weight=_logarithms(maps.weight))


def _logarithms(values: Array) -> Array:
    with np.errstate(divide="ignore"):
        logarithms: Array = np.log(values)
    return logarithms


ESTIMATOR = BestSequences()
