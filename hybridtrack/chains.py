"""A model on a larger chain: a bound, soft or hard, on how often the mode may change.

A supermode is a mode and a stage: whether the last transition is over (soft bound), how many
transitions there have been (hard bound). Row = from, and the supermode at k drives the step from
k - 1 to k. Both chains stand here because truths and filters move on them.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.models import Array, JumpMarkovModel

Indices = NDArray[np.int64]


class Supermodes(NamedTuple):
    """A chain of modes and stages."""

    mode: Indices  # (n_supermodes,) each one's mode
    stage: Indices  # (n_supermodes,) 1 where ended; how many transitions there have been
    transition_matrix: Array  # (n_times, n_supermodes, n_supermodes)
    initial_probabilities: Array  # (n_supermodes,)
    # (n_times, n_supermodes) that the mode now is the last one, if later steps are as long
    final_probability: Array


class Bound(NamedTuple):
    """How a chain of modes is bounded, if at all: softly or hard."""

    continuation_probability: float | None = None
    leak: float = 0.0
    most_transitions: int | None = None

    @property
    def is_set(self) -> bool:
        """Whether there is one."""
        return self.continuation_probability is not None or self.most_transitions is not None

    def supermodes(self, transition_matrix: Array, initial_probabilities: Array) -> Supermodes:
        """The chain (n_times, n, n) and its start (n,) under this bound, pruned."""
        given = (transition_matrix, initial_probabilities)
        if self.continuation_probability is not None:
            return pruned(soft_bound(*given, self.continuation_probability, self.leak))
        if self.most_transitions is not None:
            return pruned(hard_bound(*given, self.most_transitions))
        modes = np.arange(len(initial_probabilities))
        return Supermodes(modes, np.zeros_like(modes), *given, _never_left(transition_matrix))


def soft_bound(
    transition_matrix: Array,
    initial_probabilities: Array,
    continuation_probability: float,
    leak: float = 0.0,
) -> Supermodes:
    """Modes that change by a Markov chain until a transition that ends it (Sigalov 2011, eq. 12).

    transition_matrix P (n_times, n, n); initial_probabilities (n,), not ended. With p0 the
    continuation_probability, (i, 0) -> (j, 0) has p0 p_ij, (i, 0) -> (i, 1) has 1 - p0; (i, 1)
    stays, but for a probability `leak` of going back to (i, 0), which is ours: without it no
    evidence frees a filter from a wrong mode that has ended.

    Mode i is the last one for certain once ended, before that with (1 - p0)/(1 - p0 p_ii): it ends
    before it is left. The leak is a guard and no belief, so it has no part in this.
    """
    n_times, n, _ = transition_matrix.shape
    left = continuation_probability * leaving_probability(transition_matrix)
    ends = 1.0 - continuation_probability
    final = np.divide(ends, ends + left, out=np.ones_like(left), where=ends + left > 0.0)
    same = np.eye(n)
    chain = np.zeros((n_times, 2 * n, 2 * n))
    chain[:, :n, :n] = continuation_probability * transition_matrix
    chain[:, :n, n:] = (1.0 - continuation_probability) * same
    chain[:, n:, :n] = leak * same
    chain[:, n:, n:] = (1.0 - leak) * same
    return Supermodes(
        mode=np.tile(np.arange(n), 2),
        stage=np.repeat([0, 1], n),
        transition_matrix=chain,
        initial_probabilities=np.concatenate([initial_probabilities, np.zeros(n)]),
        final_probability=np.concatenate([final, np.ones_like(final)], axis=1),
    )


def hard_bound(
    transition_matrix: Array, initial_probabilities: Array, most_transitions: int
) -> Supermodes:
    """Modes that change by a Markov chain, at most so many times, then never again.

    transition_matrix P (n_times, n, n); initial_probabilities (n,), nothing counted. (i, c) ->
    (i, c) has p_ii and (i, c) -> (j, c + 1) has p_ij while c < most_transitions; then it stays.

    Mode i is the last one once so many are counted, before that only if it is never left.
    """
    n_times, n, _ = transition_matrix.shape
    stages = most_transitions + 1
    chain = np.zeros((n_times, stages, n, stages, n))
    same = np.arange(n)
    others = transition_matrix.copy()
    others[:, same, same] = 0.0
    for count in range(most_transitions):
        chain[:, count, same, count, same] = transition_matrix[:, same, same]
        chain[:, count, :, count + 1, :] = others
    chain[:, -1, same, -1, same] = 1.0
    start = np.zeros((stages, n))
    start[0] = initial_probabilities
    final = np.repeat(_never_left(transition_matrix)[:, np.newaxis], stages, axis=1)
    final[:, -1] = 1.0
    return Supermodes(
        mode=np.tile(same, stages),
        stage=np.repeat(np.arange(stages), n),
        transition_matrix=chain.reshape(n_times, stages * n, stages * n),
        initial_probabilities=start.ravel(),
        final_probability=final.reshape(n_times, stages * n),
    )


def leaving_probability(transition_matrix: Array) -> Array:
    """The probability (..., n) of leaving each mode in a step; exactly 0 where none leads away."""
    n = transition_matrix.shape[-1]
    leaving: Array = np.where(np.eye(n, dtype=bool), 0.0, transition_matrix).sum(axis=-1)
    return leaving


def _never_left(transition_matrix: Array) -> Array:
    """1 for a mode that stays for ever, 0 for one that is left some time (n_times, n)."""
    return np.where(leaving_probability(transition_matrix) == 0.0, 1.0, 0.0)


def expected_steps_to_end(continuation_probability: float) -> float:
    """Steps until the transition that ends a soft bound, 1/(1 - p0) (Sigalov 2011, section IV)."""
    ending = 1.0 - continuation_probability
    return 1.0 / ending if ending else math.inf


def expected_steps_in_mode(transition_matrix: Array) -> Array:
    """Steps from entering a mode to leaving it, 1/(1 - p_ii); transition_matrix (n, n)."""
    leaving = leaving_probability(transition_matrix)
    return np.divide(1.0, leaving, out=np.full_like(leaving, np.inf), where=leaving > 0.0)


def expected_transitions(supermodes: Supermodes) -> float:
    """How often the mode changes on average, for ever; steps of one length.

    From the expected visits of the supermodes that are not yet the last, (I - T')^-1 of the start.
    """
    chain = pruned(supermodes)
    matrix, mode = chain.transition_matrix[0], chain.mode
    passing = np.flatnonzero(chain.final_probability[0] < 1.0)
    among = matrix[np.ix_(passing, passing)]
    # I - T with 1 - p_ii as the sum of all that leads away, which keeps its digits.
    passed = -among
    np.fill_diagonal(passed, leaving_probability(matrix)[passing])
    if passing.size == 0:
        return 0.0
    leads = matrix != 0.0
    ends = chain.final_probability[0] == 1.0
    for _ in range(ends.size):
        ends = ends | leads[:, ends].any(axis=1)
    if not ends.all():  # the mode changes for ever, from some time on
        return math.inf
    start = chain.initial_probabilities[passing]
    visits = np.linalg.solve(passed.T, start)
    changes = np.where(mode[passing, np.newaxis] != mode, matrix[passing], 0.0).sum(axis=1)
    return float(visits @ changes)


def pruned(supermodes: Supermodes) -> Supermodes:
    """Without the supermodes that cannot be reached from the start."""
    leads = (supermodes.transition_matrix != 0.0).any(axis=0)
    reached = supermodes.initial_probabilities != 0.0
    for _ in range(reached.size):
        reached = reached | leads[reached].any(axis=0)
    kept = np.flatnonzero(reached)
    return Supermodes(
        mode=supermodes.mode[kept],
        stage=supermodes.stage[kept],
        transition_matrix=supermodes.transition_matrix[:, kept[:, np.newaxis], kept],
        initial_probabilities=supermodes.initial_probabilities[kept],
        final_probability=supermodes.final_probability[:, kept],
    )


def on_supermodes(model: JumpMarkovModel, supermodes: Supermodes) -> JumpMarkovModel:
    """The model with its modes repeated on the larger chain, under their own names."""
    mode = supermodes.mode
    return model._replace(
        state_transition=model.state_transition[:, mode],
        input_effect=model.input_effect[:, mode],
        process_noise_covariance=model.process_noise_covariance[:, mode],
        measurement_matrix=model.measurement_matrix[mode],
        measurement_noise_covariance=model.measurement_noise_covariance[mode],
        transition_matrix=supermodes.transition_matrix,
        initial_mode_probabilities=supermodes.initial_probabilities,
        mode_names=tuple(model.mode_names[j] for j in mode),
        final_probability=supermodes.final_probability[0] if model.even_steps else None,
    )
