"""What every competitor solves: the IMM of Hwang 2006, figure 5, and measurements to filter."""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.models import JumpMarkovModel

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from models import figure_5_model

Array = NDArray[np.float64]


class Problem(NamedTuple):
    """A bank of two modes and what it is to filter."""

    name: str
    model: JumpMarkovModel
    measurements: Array  # (n_steps, n_y, n_runs)


def problem(dimensions: int, runs: int, steps: int, seed: int = 3) -> Problem:
    """Targets that straighten and turn as the bank's own Markov chain says, seen with noise."""
    model = figure_5_model(dimensions)
    rng = np.random.default_rng(seed)
    n_modes, n_y, n_x = model.measurement_matrix.shape
    x = model.initial_mean[:, np.newaxis] + np.linalg.cholesky(
        model.initial_covariance
    ) @ rng.standard_normal((n_x, runs))
    roots = np.array([_root(Q) for Q in model.process_noise_covariance[0]])
    noise = np.linalg.cholesky(model.measurement_noise_covariance[0])
    mode = (rng.random(runs) > model.initial_mode_probabilities[0]).astype(np.int64)
    z = np.empty((steps, n_y, runs))
    for k in range(steps):
        to_second = model.transition_matrix[0, mode, 1]
        mode = (rng.random(runs) < to_second).astype(np.int64)
        draws = rng.standard_normal((n_x, runs))
        moved = [model.state_transition[0, j] @ x + roots[j] @ draws for j in range(n_modes)]
        x = np.where(mode == 0, *moved)
        z[k] = model.measurement_matrix[0] @ x + noise @ rng.standard_normal((n_y, runs))
    return Problem(f"{n_x} states, {n_y} measurement{'s' * (n_y > 1)}", model, z)


def _root(covariance: Array) -> Array:
    """A square root of a covariance that may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))
