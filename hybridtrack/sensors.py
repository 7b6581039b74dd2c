"""What a sensor makes of positions: Gaussian noise, missed scans, outliers.

Draws come from outside: which run has which is a matter of its random streams.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.models import Array
from hybridtrack.roots import square_root


class Outliers(NamedTuple):
    """Errors far larger than the noise, which they are added to.

    Each is the offset size_sigma L u, with L L' = R the noise covariance at that scan and u of
    length 1 in a direction drawn uniformly (in one dimension a sign). So its Mahalanobis length,
    the square root of offset' R^-1 offset, is size_sigma exactly.
    """

    probability: float  # of each scan that may be one
    size_sigma: float
    from_s: float = -np.inf  # both ends belong to the span
    until_s: float = np.inf


class Sensor(NamedTuple):
    """What is measured: positions with Gaussian noise, some scans missed, some of them outliers."""

    noise_covariance: Array  # (n_modes or 1, n_y, n_y) by the truth's mode
    detection_probability: float
    certain_scans: int  # the first are neither missed nor outliers (a track starts with them)
    outliers: Outliers | None = None

    def may_be_outliers(self, times_s: Array) -> NDArray[np.bool_]:
        """Which scans (n_steps,) of a case with times_s (n_steps + 1,) can be outliers at all."""
        if self.outliers is None:
            return np.zeros(len(times_s) - 1, dtype=np.bool_)
        slack_s = 1e-6 * np.diff(times_s).min()  # 3 * 0.1 s still lies in a span until 0.3 s
        begin, end = self.outliers.from_s - slack_s, self.outliers.until_s + slack_s
        held: NDArray[np.bool_] = (times_s[1:] >= begin) & (times_s[1:] <= end)
        held[: self.certain_scans] = False
        return held


class Noise:
    """Zero-mean Gaussian errors of the truth's modes, from white draws."""

    def __init__(self, covariance: Array) -> None:
        """covariance: (n_modes or 1, n_y, n_y)."""
        self._root = square_root(covariance)
        axes = np.diagonal(self._root, axis1=1, axis2=2)[..., np.newaxis]  # (n_modes, n_y, 1)
        alone = len(axes) == 1 and not np.any(self._root[0] - np.diag(axes[0, :, 0]))
        self._std = axes[0] if alone else None  # where axes are independent of one another

    def shape(self, draws: Array, modes: NDArray[np.int64]) -> Array:
        """L w, (n_steps, n_y, runs), of draws w, which may be overwritten.

        modes: (n_steps, runs or 1).
        """
        if self._std is not None:
            draws *= self._std
            return draws
        if len(self._root) == 1:
            shaped: Array = np.einsum("ml,klb->kmb", self._root[0], draws)
        else:
            by_run = self._root[np.broadcast_to(modes, (len(draws), draws.shape[-1]))]
            shaped = np.einsum("kbml,klb->kmb", by_run, draws)
        return shaped

    def add_outliers(
        self,
        measurements: Array,
        outliers: Outliers,
        uniform: Array,
        possible: NDArray[np.bool_],
        modes: NDArray[np.int64],
    ) -> None:
        """Make outliers of some measurements (n_steps, n_y, runs).

        uniform (n_steps, 2, runs): whether, and in which direction; possible (n_steps,);
        modes (n_steps, runs or 1).
        """
        k, b = np.nonzero((uniform[:, 0] < outliers.probability) & possible[:, np.newaxis])
        j = np.broadcast_to(modes, (len(modes), uniform.shape[-1]))[k, b]
        root = self._root[j if len(self._root) > 1 else np.zeros_like(j)]
        direction = _direction(uniform[k, 1, b], measurements.shape[1])
        measurements[k, :, b] += outliers.size_sigma * np.einsum("iml,il->im", root, direction)


def _direction(uniform: Array, n_y: int) -> Array:
    """Vectors (n, n_y) of length 1, uniform over all directions, from draws (n,) of [0, 1)."""
    if n_y == 1:
        return np.where(uniform < 0.5, -1.0, 1.0)[:, np.newaxis]
    angle = 2 * np.pi * uniform
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)
