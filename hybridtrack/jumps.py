"""Runs of a jump Markov system: modes and states of a chain's truth, step by step.

Draws come from outside: which run has which is a matter of its random streams.
"""

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.chains import Bound, Supermodes
from hybridtrack.compiled import kernel
from hybridtrack.models import Array, Itself, JumpMarkovModel, ModeBank
from hybridtrack.roots import square_root, thin_square_root

RANK_STEPS = 1000  # lengths of steps whose noise is looked at together
FORESEEN_STEPS = 75  # whose modes are drawn at a time, before their own

Modes = NDArray[np.int64]


class ChainTruth(NamedTuple):
    """States simulated from a jump Markov model of their own, other in every run."""

    bank: ModeBank
    initial_mean: Array  # (n_x,)
    initial_covariance: Array  # (n_x, n_x); 0 for a fixed start
    bound: Bound = Bound()  # on how often the mode changes


# ---- what moves them -------------------------------------------------------------------------


class _Dynamics(NamedTuple):
    """What moves modes and states over some steps; n_times is 1 where all are of one length."""

    supermodes: Supermodes
    cumulative: Array  # (n_times, n_supermodes, n_supermodes) probabilities, summed along rows
    state_transition: Array  # (n_times, n_modes, n_x, n_x)
    input_effect: Array  # (n_times, n_modes, n_x)
    noise_root: Array  # (n_times, n_modes, n_x, rank)


def truth_model(truth: ChainTruth, step_s: Array) -> JumpMarkovModel:
    """The truth's own jump Markov model for the given steps."""
    return truth.bank.discretise(step_s, truth.initial_mean, truth.initial_covariance)


def _dynamics(truth: ChainTruth, step_s: Array, rank: int | None) -> _Dynamics:
    """rank: of the process noise; None for that of these steps."""
    model = truth_model(truth, step_s)
    chain = truth.bound.supermodes(model.transition_matrix, model.initial_mode_probabilities)
    return _Dynamics(
        chain,
        np.cumsum(chain.transition_matrix, axis=-1),
        model.state_transition,
        model.input_effect,
        thin_square_root(model.process_noise_covariance, rank),
    )


@functools.lru_cache(maxsize=64)
def _even_dynamics(truth: Itself, step_s: float) -> _Dynamics:
    """Those of steps of one length, which blocks have in common."""
    return _dynamics(truth.one, np.array([step_s]), None)


@functools.lru_cache(maxsize=64)
def _noise_rank(truth: Itself, lengths_s: bytes) -> int:
    """The rank of the process noise over steps of all these lengths: one for every span."""
    lengths = np.frombuffer(lengths_s)
    ranks: list[int] = []
    for some in np.array_split(lengths, -(-len(lengths) // RANK_STEPS)):
        root = thin_square_root(truth_model(truth.one, some).process_noise_covariance)
        ranks.append(root.shape[-1])
    return max(ranks)


# ---- the runs --------------------------------------------------------------------------------


@kernel
def _draw_modes(mode, uniform, cumulative, out):
    for k in range(uniform.shape[0]):
        rows = cumulative[k if cumulative.shape[0] > 1 else 0]
        for b in range(uniform.shape[1]):
            j = 0
            while j < rows.shape[1] - 1 and uniform[k, b] >= rows[mode[b], j]:
                j += 1
            mode[b] = j
            out[k, b] = j


@kernel
def _time_switches(mode, last_switch_s, modes, times_s, out):
    """Seconds since each lane's last switch; mode and last_switch_s go on from span to span."""
    for k in range(modes.shape[0]):
        for b in range(modes.shape[1]):
            if modes[k, b] != mode[b]:
                last_switch_s[b] = times_s[k]
                mode[b] = modes[k, b]
            out[k, b] = times_s[k + 1] - last_switch_s[b]


@kernel
def _note_switches(mode, modes, first, last):
    """The step of each lane's last switch so far; `mode` and `last` go on from span to span."""
    for k in range(modes.shape[0]):
        for b in range(modes.shape[1]):
            if modes[k, b] != mode[b]:
                last[b] = first + k
                mode[b] = modes[k, b]


@kernel
def _drive(state, modes, noise, state_transition, input_effect, noise_root, out):
    """x <- F_j x + b_j + L_j w, j the mode of each lane, every mode's in turn: rows of lanes."""
    n_x, lanes = state.shape
    row = np.empty(lanes)
    for k in range(modes.shape[0]):
        f = k if state_transition.shape[0] > 1 else 0
        before = out[k - 1] if k > 0 else state
        for j in range(state_transition.shape[1]):
            for a in range(n_x):
                row[:] = input_effect[f, j, a]
                for e in range(n_x):
                    transition = state_transition[f, j, a, e]
                    if transition != 0.0:
                        for b in range(lanes):
                            row[b] += transition * before[e, b]
                for i in range(noise.shape[1]):
                    root = noise_root[f, j, a, i]
                    if root != 0.0:
                        for b in range(lanes):
                            row[b] += root * noise[k, i, b]
                for b in range(lanes):
                    out[k, a, b] = row[b] if modes[k, b] == j else out[k, a, b]
    state[:] = out[-1]


class JumpRuns:
    """Modes and states of some runs of a chain, span by span."""

    def __init__(self, truth: ChainTruth, step_s: Array, uniform: Array, noise: Array) -> None:
        """Begin at k = 0 from draws: uniform (runs,) for the modes, white noise (n_x, runs)."""
        self._truth = truth
        self._step_s = step_s
        self._even = bool((step_s == step_s[0]).all())
        self._rank: int | None = None
        if not self._even:
            self._rank = _noise_rank(Itself(truth), np.unique(step_s).tobytes())
        first = self._dynamics(slice(0, 1))
        self.noise_rank = first.noise_root.shape[-1]  # draws of noise that a step takes
        self.state = truth.initial_mean[:, None] + square_root(truth.initial_covariance) @ noise
        cumulative = np.cumsum(first.supermodes.initial_probabilities)[:-1]
        self._supermode: Modes = np.searchsorted(cumulative, uniform, side="right")
        self.mode = first.supermodes.mode[self._supermode]
        self._last_switch_s = np.full(len(uniform), -np.inf)

    def _dynamics(self, span: slice) -> _Dynamics:
        if self._even:
            return _even_dynamics(Itself(self._truth), float(self._step_s[0]))
        return _dynamics(self._truth, self._step_s[span], self._rank)

    def last_switches(self, draws: np.random.Generator) -> Array:
        """The step of each run's last switch of mode (runs,); 0: none; inf: after the last step.

        For runs that still are at k = 0, from the draws to come. What the chain does after the
        last step is drawn too, so that the end of the steps is no end of switches.
        """
        runs, steps = len(self.mode), len(self._step_s)
        mode, supermode, last = self.mode.copy(), self._supermode.copy(), np.zeros(len(self.mode))
        for start in range(0, steps, FORESEEN_STEPS):
            span = slice(start, min(start + FORESEEN_STEPS, steps))
            dynamics = self._dynamics(span)
            uniform = draws.random((span.stop - start, runs))
            supermodes = np.empty(uniform.shape, dtype=np.int64)
            _draw_modes(supermode, uniform, dynamics.cumulative, supermodes)
            _note_switches(mode, dynamics.supermodes.mode[supermodes], start + 1, last)
        stays = dynamics.supermodes.final_probability[-1, supermode]
        last[draws.random(runs) >= stays] = np.inf
        return last

    def advance(
        self, span: slice, times_s: Array, uniform: Array, noise: Array
    ) -> tuple[Array, Modes, Array]:
        """States (n_steps, n_x, runs), modes and seconds since the last switch (n_steps, runs).

        times_s (n_steps + 1,) from the span's beginning; uniform (n_steps, runs) for the modes,
        white noise (n_steps, noise_rank, runs).
        """
        dynamics = self._dynamics(span)
        supermodes = np.empty(uniform.shape, dtype=np.int64)
        _draw_modes(self._supermode, uniform, dynamics.cumulative, supermodes)
        modes = dynamics.supermodes.mode[supermodes]
        since_switch_s = np.empty(uniform.shape)
        _time_switches(self.mode, self._last_switch_s, modes, times_s, since_switch_s)
        state = np.empty((len(uniform), *self.state.shape))
        matrices = (dynamics.state_transition, dynamics.input_effect, dynamics.noise_root)
        _drive(self.state, modes, noise, *matrices, state)
        return state, modes, since_switch_s
