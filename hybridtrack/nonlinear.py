"""Nonlinear models with bounded noise: what set-membership filters believe, and its truth.

x_k = f(x_{k-1}, u_k) + w_k, y_k = h(x_k, u_k) + v_k, with w in Omega(0, Q) and v in Omega(0, R)
(Otanez 2004, eq. 8-12). Both maps come from expressions; see maps.
"""

from typing import NamedTuple

import numpy as np

from hybridtrack.maps import Map
from hybridtrack.models import Array
from hybridtrack.remainders import Remainder

TURN = 2 * np.pi


class NonlinearModel(NamedTuple):
    """Maps, bounds of the noise and of the start; shapes of ellipsoids are SI squared."""

    dynamics: Map
    measurement: Map
    dynamics_remainder: Remainder
    measurement_remainder: Remainder
    state_names: tuple[str, ...]
    measurement_names: tuple[str, ...]
    angles: tuple[int, ...]  # the states that are angles
    measured_angles: tuple[int, ...]  # the measurements that are, told but for whole turns
    inputs: Array  # (n_steps or 1, n_u) u_k at k = 1 ..
    process_noise_shape: Array  # Q (n_x, n_x), as filters believe
    measurement_noise_shape: Array  # R (n_y, n_y), as filters believe
    initial_shape: Array  # Sigma_0 (n_x, n_x)

    def inputs_at(self, step: int) -> Array:
        """u (n_u,) of the step from `step` to `step` + 1, counted from 0."""
        u: Array = self.inputs[min(step, len(self.inputs) - 1)]
        return u

    def innovation(self, measurement: Array, guess: Array) -> Array:
        """measurement - guess (lanes, n_y), angles within half a turn."""
        found: Array = measurement - guess
        chosen = list(self.measured_angles)
        found[:, chosen] -= TURN * np.round(found[:, chosen] / TURN)
        return found

    def course(self, start: Array, n_steps: int) -> Array:
        """States (n_steps + 1, n_x) without noise from `start` (n_x,)."""
        states = [start]
        for k in range(n_steps):
            states.append(self.dynamics.value(states[-1][np.newaxis], self.inputs_at(k))[0])
        return np.array(states)
