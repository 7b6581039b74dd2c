"""Square roots of covariances, which may be singular: what makes white draws noise."""

import functools

import numpy as np

from hybridtrack.models import Array

# Eigenvalues of correlations that are nothing but rounding, per state; the largest is 1 or more.
ZERO = 1e-14


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


def thin_square_root(covariance: Array, rank: int | None = None) -> Array:
    """L (..., n, rank) with L L' = covariance: no more columns than there is noise for.

    rank: the highest among the matrices, unless it is known of a larger set that they belong to.
    It is that of the correlations, so it doesn't depend on units, and a state of small noise isn't
    lost in the rounding of one of large noise.
    """
    std = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    inverse = np.divide(1.0, std, out=np.zeros_like(std), where=std > 0.0)
    correlation = inverse[..., :, np.newaxis] * covariance * inverse[..., np.newaxis, :]
    values, vectors = np.linalg.eigh(correlation)
    values, vectors = values[..., ::-1], vectors[..., ::-1]  # the largest first
    values = np.where(values > ZERO * std.shape[-1], values, 0.0)
    if rank is None:
        rank = int((values > 0.0).sum(axis=-1).max(initial=0))
    scaled = vectors[..., :rank] * np.sqrt(values[..., np.newaxis, :rank])
    return np.ascontiguousarray(std[..., :, np.newaxis] * scaled)
