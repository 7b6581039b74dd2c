"""Jump Markov models: what a bank of filters believes, and its checks.

Shapes are the house's: modes first, states last; `n_times` is 1 where every step is the same.
"""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.errors import UserError
from hybridtrack.motion import MOTION_MODELS, Motion

Array = NDArray[np.float64]


class Itself(NamedTuple):
    """A bank, a truth or an estimator as a key of what is remembered about it.

    Itself and not its like, since arrays have no hash.
    """

    one: Any

    def __hash__(self) -> int:
        return id(self.one)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Itself) and other.one is self.one


class JumpMarkovModel(NamedTuple):
    """x_k = F x_{k-1} + b + w, z_k = H x_k + v, with F, b, Q, H, R of the mode at k.

    Mode k drives the step from k-1 to k. Equal names of modes are one mode to the outside
    (supermodes): their probabilities are added up.
    """

    state_transition: Array  # F (n_times or 1, n_modes, n_x, n_x)
    input_effect: Array  # B u (n_times or 1, n_modes, n_x)
    process_noise_covariance: Array  # Q (n_times or 1, n_modes, n_x, n_x)
    measurement_matrix: Array  # H (n_modes, n_y, n_x)
    measurement_noise_covariance: Array  # R (n_modes, n_y, n_y)
    transition_matrix: Array  # (n_times or 1, n_modes, n_modes), row = from; rows sum to 1
    initial_mode_probabilities: Array  # (n_modes,)
    initial_mean: Array  # (n_x,)
    initial_covariance: Array  # (n_x, n_x)
    step_s: Array  # (n_times or 1,)
    mode_names: tuple[str, ...]
    state_names: tuple[str, ...]
    even_steps: bool = True  # whether all steps are of one length, those of other spans too
    # (n_modes,) that the mode now is the last one; None where nothing can be said of it
    final_probability: Array | None = None

    def only(self, mode: str) -> "JumpMarkovModel":
        """The model with one of its modes alone, for a single Kalman filter."""
        j = self.mode_names.index(mode)
        return self._replace(
            state_transition=self.state_transition[:, j : j + 1],
            input_effect=self.input_effect[:, j : j + 1],
            process_noise_covariance=self.process_noise_covariance[:, j : j + 1],
            measurement_matrix=self.measurement_matrix[j : j + 1],
            measurement_noise_covariance=self.measurement_noise_covariance[j : j + 1],
            transition_matrix=np.ones((1, 1, 1)),
            initial_mode_probabilities=np.ones(1),
            mode_names=(mode,),
            final_probability=None,
        )


class Mode(NamedTuple):
    """One mode as a scenario names it: a motion model with its parameters, or matrices."""

    name: str
    motion: str | None  # None: the explicit matrices below, whatever the step's length
    parameters: Mapping[str, Any]
    measurement_noise_covariance: Array  # (n_y, n_y) m^2
    matrices: Motion | None = None  # each with n = 1
    measurement_matrix: Array | None = None  # (n_y, n_x); None: the positions


class ModeBank(NamedTuple):
    """The modes of a scenario with their Markov chain, before the lengths of steps are known."""

    modes: tuple[Mode, ...]
    state_names: tuple[str, ...]
    dimensions: int
    transition_matrix: Array | None  # (n_modes, n_modes), for steps of one length
    generator_per_s: Array | None  # (n_modes, n_modes), rows sum to 0, for steps of any length
    initial_mode_probabilities: Array  # (n_modes,)

    @property
    def names(self) -> tuple[str, ...]:
        """The modes' names, in the scenario's order."""
        return tuple(mode.name for mode in self.modes)

    @property
    def mean_measurement_noise(self) -> Array:
        """R (n_y, n_y) expected over the modes as they are at the start."""
        covariances = np.stack([mode.measurement_noise_covariance for mode in self.modes])
        mean: Array = np.einsum("j,jml->ml", self.initial_mode_probabilities, covariances)
        return mean

    def discretise(
        self, step_s: Array, initial_mean: Array, initial_covariance: Array
    ) -> JumpMarkovModel:
        """The jump Markov model for the given steps.

        step_s (n,) seconds; initial_mean (n_x,); initial_covariance (n_x, n_x). Steps that are
        all of one length give n_times = 1.
        """
        unique, index = np.unique(step_s, return_inverse=True)
        motions = [_motion(mode, unique, self.dimensions) for mode in self.modes]
        transition = self._transition(unique)
        if unique.size > 1:
            motions = [Motion(*(part[index] for part in motion)) for motion in motions]
            transition = transition[index]
        return JumpMarkovModel(
            state_transition=np.stack([m.state_transition for m in motions], axis=1),
            input_effect=np.stack([m.input_effect for m in motions], axis=1),
            process_noise_covariance=np.stack(
                [m.process_noise_covariance for m in motions], axis=1
            ),
            measurement_matrix=np.stack([self._measurement_matrix(mode) for mode in self.modes]),
            measurement_noise_covariance=np.stack(
                [mode.measurement_noise_covariance for mode in self.modes]
            ),
            transition_matrix=transition,
            initial_mode_probabilities=self.initial_mode_probabilities,
            initial_mean=initial_mean,
            initial_covariance=initial_covariance,
            step_s=unique if unique.size == 1 else np.asarray(step_s, dtype=np.float64),
            mode_names=self.names,
            state_names=self.state_names,
        )

    def _transition(self, steps_s: Array) -> Array:
        if self.generator_per_s is not None:
            generator = self.generator_per_s
            if not generator.any():  # a Kalman filter's, which shouldn't have to wait for scipy
                return np.repeat(np.eye(len(generator))[np.newaxis], steps_s.size, axis=0)
            return np.stack([_matrix_exponential(generator.tobytes(), s) for s in steps_s.tolist()])
        assert self.transition_matrix is not None
        if steps_s.size > 1:
            raise UserError(
                f"the steps are uneven ({steps_s[0]:g} to {steps_s[-1]:g} s) and transition_matrix "
                "holds for one length only; give mean_sojourn_s or generator_per_s instead"
            )
        return self.transition_matrix[np.newaxis]

    def _measurement_matrix(self, mode: Mode) -> Array:
        if mode.measurement_matrix is not None:
            return mode.measurement_matrix
        return position_measurement_matrix(self.state_names, self.dimensions)


def position_measurement_matrix(state_names: tuple[str, ...], dimensions: int) -> Array:
    """H (dimensions, n_x) that picks x (and y) out of a state vector with the given names."""
    matrix = np.zeros((dimensions, len(state_names)))
    for row, axis in enumerate("xy"[:dimensions]):
        matrix[row, state_names.index(axis)] = 1.0
    return matrix


def _motion(mode: Mode, steps_s: Array, dimensions: int) -> Motion:
    if mode.motion is not None:
        return MOTION_MODELS[mode.motion].discretise(steps_s, dimensions, **mode.parameters)
    assert mode.matrices is not None
    if steps_s.size > 1:
        raise UserError(
            f"the steps are uneven ({steps_s[0]:g} to {steps_s[-1]:g} s) and the matrices of mode "
            f"'{mode.name}' hold for one length only; name a motion model instead"
        )
    return mode.matrices


@functools.lru_cache(maxsize=4096)
def _matrix_exponential(generator: bytes, step_s: float) -> Array:
    from scipy.linalg import expm

    flat = np.frombuffer(generator)
    n = round(flat.size**0.5)
    matrix: Array = np.maximum(expm(flat.reshape(n, n) * step_s), 0.0)
    matrix /= matrix.sum(axis=1, keepdims=True)
    return matrix


def generator_from_sojourns(mean_sojourn_s: Array) -> Array:
    """Generator (n, n) per second of the chain whose mode i lasts mean_sojourn_s[i] on average.

    A mode that ends leaves for each other mode equally often.
    """
    n = mean_sojourn_s.size
    rate = 1.0 / np.asarray(mean_sojourn_s, dtype=np.float64)
    generator = np.repeat(rate[:, np.newaxis] / max(n - 1, 1), n, axis=1)
    np.fill_diagonal(generator, -rate if n > 1 else 0.0)
    return generator
