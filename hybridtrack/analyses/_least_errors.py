"""Proofs of never: an error of telling two modes apart that no number of scans goes below."""

import math

import numpy as np

from hybridtrack.analyses._errors_of_tests import Spectrum
from hybridtrack.analyses._observability_matrices import ModeDynamics, observability_matrix
from hybridtrack.models import Array
from hybridtrack.roots import thin_square_root

ZERO = 1e-13  # of the largest singular value, rows and columns being normalised: rounding
LOST = 1e-10  # of the largest spread of a state: smaller ones would lose their digits beside it


def without_noise(
    one: ModeDynamics, other: ModeDynamics, at_first_scan: bool, told: Array | None
) -> Spectrum | None:
    """All that outputs show of the initial states, were there no noise; None if unknown.

    Where both modes put the same noises and inputs into the outputs, these are functions of the
    initial states, of the forms O_one x and O_other x, plus something of one law under both. By the
    data processing inequality no number of scans then tells the modes apart better than the
    functions themselves do, however the states grow. Of O_one and O_other the common row space
    of [O_one O_other] is kept: by Cayley and Hamilton 2 n_x scans show it.
    None where noises or inputs differ, or where the functions alone tell the modes apart for sure,
    or where states are of too many sizes for numbers. The last two arguments are those of
    `outputs_of`.
    """
    if not _same_noises_and_inputs(one, other):
        return None
    n_x = len(one.initial_mean)
    with np.errstate(over="ignore", invalid="ignore"):
        shown = np.hstack([_from_the_start(mode, 2 * n_x, at_first_scan) for mode in (one, other)])
    if not np.isfinite(shown).all():
        return None
    columns = _sizes(shown.T)
    spread = columns * np.sqrt(
        np.concatenate([np.diag(m.initial_covariance) for m in (one, other)])
    )
    if (spread[spread > 0.0] < LOST * spread.max()).any():
        return None
    _, values, rows = np.linalg.svd(shown / columns / _sizes(shown / columns)[:, np.newaxis])
    spanned = int((values > ZERO * values[0]).sum())
    seen = rows[:spanned] * columns
    drawn = np.zeros((n_x, 0)) if told is None else thin_square_root(told)
    roots, means = [], []
    for mode, part in ((one, seen[:, :n_x]), (other, seen[:, n_x:])):
        start = thin_square_root(mode.initial_covariance)
        known = np.hstack([np.eye(drawn.shape[1]), np.zeros((drawn.shape[1], start.shape[1]))])
        roots.append(np.vstack([known, part @ np.hstack([drawn, start])]))
        means.append(np.concatenate([np.zeros(drawn.shape[1]), part @ mode.initial_mean]))
    return _on_common_axes(roots[0], roots[1], means[1] - means[0])


def _same_noises_and_inputs(one: ModeDynamics, other: ModeDynamics) -> bool:
    """Whether both modes' outputs have, from zero states, the very same mean and covariance."""
    same_motion = np.array_equal(one.state_transition, other.state_transition) and np.array_equal(
        one.measurement_matrix, other.measurement_matrix
    )

    def alike(a: Array, b: Array) -> bool:
        return (same_motion and np.array_equal(a, b)) or not (a.any() or b.any())

    return (
        np.array_equal(one.measurement_noise_covariance, other.measurement_noise_covariance)
        and alike(one.process_noise_covariance, other.process_noise_covariance)
        and alike(one.input_effect, other.input_effect)
    )


def _from_the_start(mode: ModeDynamics, scans: int, at_first_scan: bool) -> Array:
    matrix = observability_matrix(mode.state_transition, mode.measurement_matrix, scans)
    return matrix if at_first_scan else matrix @ mode.state_transition


def _sizes(matrix: Array) -> Array:
    """The largest entry of each row (rows,), or 1."""
    size = np.abs(matrix).max(axis=1, initial=0.0)
    return np.where(size > 0.0, size, 1.0)


def _on_common_axes(root: Array, other_root: Array, shift: Array) -> Spectrum | None:
    """N(0, root root') and N(shift, other_root other_root'); None where their ranges differ."""
    if not (np.isfinite(root).all() and np.isfinite(other_root).all() and np.isfinite(shift).all()):
        return None
    scale = _sizes(np.hstack([root, other_root, shift[:, np.newaxis]]))
    root, other_root = root / scale[:, np.newaxis], other_root / scale[:, np.newaxis]
    shift = shift / scale
    vectors, std, _ = np.linalg.svd(root)
    rank = int((std > ZERO * std.max(initial=0.0)).sum())
    inside, outside = vectors[:, :rank].T, vectors[:, rank:].T
    both = np.hstack([other_root, shift[:, np.newaxis]])
    if np.abs(outside @ both).max(initial=0.0) > ZERO:
        return None
    white = (inside @ both) / std[:rank, np.newaxis]
    vectors, std, _ = np.linalg.svd(white[:, :-1], full_matrices=False)
    if len(std) < rank or std.min(initial=math.inf) <= ZERO * std.max(initial=0.0):
        return None
    return Spectrum(std**2, vectors.T @ white[:, -1])
