"""Square roots of covariances, which may be singular: what makes white draws noise."""

import functools

import numpy as np

from hybridtrack.models import Array


def square_root(covariance: Array) -> Array:
    """L (..., n, n) with L L' = covariance, which may be singular."""
    if covariance.size > 256:  # many steps of their own lengths: not worth remembering
        return _square_root(covariance)
    return _known_square_root(covariance.tobytes(), covariance.shape)


def _square_root(covariance: Array) -> Array:
    values, vectors = np.linalg.eigh(covariance)
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))[..., np.newaxis, :]
    return root


@functools.lru_cache  # every block begins with the same ones
def _known_square_root(covariance: bytes, shape: tuple[int, ...]) -> Array:
    root = _square_root(np.frombuffer(covariance).reshape(shape))
    root.flags.writeable = False
    return root
