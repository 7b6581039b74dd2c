"""The outputs of two modes on common axes, whatever the scans.

Outputs are whitened by one mode's own Kalman filter in square-root form, never by a stacked
covariance: the states' growth would cost all digits of that. Under the first mode what comes out is
white, N(0, I); under the other N(shift, root root').
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hybridtrack.analyses._errors_of_tests import Spectrum
from hybridtrack.analyses._observability_matrices import ModeDynamics
from hybridtrack.models import Array
from hybridtrack.roots import thin_square_root

ZERO_STD = 1e-9  # of the largest so far: below it a combination of outputs has no noise at all
FEW_ROWS = 64  # up to here a singular value decomposition costs little
WELL_CONDITIONED = 1e-4  # smallest to largest eigenvalue: squaring costs 4 digits of 16 at most
LARGE = 1e75  # its square's products can still be held
EPSILON = float(np.finfo(np.float64).eps)
LOST = 1e-3  # rounding, in standard deviations of an innovation: beyond it figures mean nothing
CANCELS = 1e-9  # of an innovation: rounding below it is that of large numbers, not of differences
SETTLING_SCANS = 1000  # no filter is followed for longer


class Outputs(NamedTuple):
    """The outputs of two modes over some scans, whitened by the first one's filter.

    root (rows, columns), shift (rows,); those of the first k scans are the leading rows_after[k]
    rows and columns_after[k] columns. singular_at: the scan from which one mode's outputs are
    impossible under the other (where there is too little noise), None where there is none.
    Where states grow so large that numbers lose their digits, there are fewer scans than asked for.
    """

    root: Array
    shift: Array
    rows_after: tuple[int, ...]  # (scans + 1,)
    columns_after: tuple[int, ...]  # (scans + 1,)
    singular_at: int | None

    @property
    def scans(self) -> int:
        """How many scans there are."""
        return len(self.rows_after) - 1


class _Whitener(NamedTuple):
    """What a filter does with the innovation of one scan."""

    whitening: Array  # (rank, n_y)
    without_noise: Array  # (n_y - rank, n_y) combinations that the filter knows beforehand
    gain: Array  # (n_x, rank) of the whitened innovation
    updated_root: Array  # (n_x, n_x) of the covariance after the scan


def _whiteners(mode: ModeDynamics, error_root: Array, at_first_scan: bool) -> Iterator[_Whitener]:
    """The mode's Kalman filter scan by scan, in square-root form, as long as numbers hold it."""
    F, H = mode.state_transition, mode.measurement_matrix
    Q_root = thin_square_root(mode.process_noise_covariance)
    R_root = thin_square_root(mode.measurement_noise_covariance)
    n_y = len(H)
    full = R_root.shape[1] == n_y
    root, largest, first = error_root, 0.0, True
    while True:
        if not (first and at_first_scan):
            root = _compressed(np.hstack([F @ root, Q_root]))
        first = False
        if not np.isfinite(root).all() or np.abs(root).max(initial=0.0) > LARGE**2:
            return
        outputs = np.hstack([R_root, H @ root])
        vectors, std, rows = np.linalg.svd(outputs, full_matrices=False)
        if len(std) < n_y:  # fewer noises than outputs
            vectors = np.linalg.svd(outputs)[0]
        largest = max(largest, float(std.max(initial=0.0)))
        rank = n_y if full else int((std > ZERO_STD * largest).sum())
        states = np.hstack([np.zeros((len(F), R_root.shape[1])), root])
        gain = states @ rows[:rank].T
        root = _compressed(states - gain @ rows[:rank])
        whitening = vectors[:, :rank].T / std[:rank, np.newaxis]
        yield _Whitener(whitening, vectors[:, rank:].T, gain, root)


def _compressed(root: Array) -> Array:
    """A square root (n, n) of the same covariance."""
    if root.shape[1] <= len(root):
        return root
    upper: Array = np.linalg.qr(root.T)[1]
    return upper.T


def settled_covariance(mode: ModeDynamics, most_scans: int = SETTLING_SCANS) -> tuple[Array, bool]:
    """The filtered covariance (n_x, n_x) of a mode's Kalman filter once it has settled.

    It starts from the mode's initial covariance and has settled when a scan changes no state's
    standard deviation by more than 1e-6 of itself; False where it hasn't after `most_scans`, or
    grows beyond what numbers hold.
    """
    root = thin_square_root(mode.initial_covariance)
    before = np.full(len(root), np.inf)
    filtering = zip(range(1, most_scans + 1), _whiteners(mode, root, False), strict=False)
    with np.errstate(over="ignore", invalid="ignore"):
        for scan, whitener in filtering:
            root = whitener.updated_root
            std = np.sqrt((root**2).sum(axis=1))
            if scan > 1 and (np.abs(std - before) <= 1e-6 * std + 1e-150).all():
                return root @ root.T, True
            before = std
        return root @ root.T, False


def outputs_of(
    one: ModeDynamics,
    other: ModeDynamics,
    scans: int,
    *,
    at_first_scan: bool = False,
    told_covariance: Array | None = None,
) -> Outputs:
    """Whiten the outputs of `scans` scans of two modes, each from its own initial state.

    at_first_scan: the initial state is that at the first scan (the paper's convention); else a step
    of the mode leads from it to the first scan (the house's).
    told_covariance (n_x, n_x): the initial means are themselves drawn with it, the same for both
    modes, and the test is told what was drawn, as a tracker is by its filter.
    """
    told = _root_or_nothing(told_covariance, len(one.initial_mean))
    with np.errstate(over="ignore", invalid="ignore"):
        return _whitened(one, other, scans, at_first_scan, told)


def _root_or_nothing(covariance: Array | None, n_x: int) -> Array:
    return np.zeros((n_x, 0)) if covariance is None else thin_square_root(covariance)


def _whitened(
    one: ModeDynamics, other: ModeDynamics, scans: int, at_first_scan: bool, told: Array
) -> Outputs:
    F, b, H = other.state_transition, other.input_effect, other.measurement_matrix
    Q_root = thin_square_root(other.process_noise_covariance)
    R_root = thin_square_root(other.measurement_noise_covariance)
    start = thin_square_root(other.initial_covariance)
    n_x, n_y, n_told = len(F), len(H), told.shape[1]
    n_q, n_r = Q_root.shape[1], R_root.shape[1]
    # Column by column, what a unit of each noise of `other` does to its state, and to the error of
    # the filter of `one`; the mean goes along. Columns of a scan: its process noise, its sensor.
    # Errors, not estimates: what both modes share then cancels before it has grown.
    known = n_told + start.shape[1]
    columns = known + scans * (n_q + n_r)
    state, error = np.zeros((2, n_x, columns))
    state[:, :known] = np.hstack([told, start])
    error[:, n_told:known] = start
    state_mean, error_mean = other.initial_mean, other.initial_mean - one.initial_mean
    other_F, other_H = F - one.state_transition, H - one.measurement_matrix
    root = np.zeros((n_told + scans * n_y, columns))
    root[:n_told, :n_told] = np.eye(n_told)
    shift = np.zeros(len(root))
    rows_after, columns_after, row, now = [n_told], [known], n_told, known
    singular_at = None
    filters = zip(
        range(1, scans + 1),
        _whiteners(one, thin_square_root(one.initial_covariance), at_first_scan),
        _whiteners(other, start, at_first_scan),
        strict=False,
    )
    for scan, filtering, others in filters:
        if scan > 1 or not at_first_scan:
            error[:, :now] = one.state_transition @ error[:, :now] + other_F @ state[:, :now]
            state[:, :now] = F @ state[:, :now]
            state[:, now : now + n_q] = error[:, now : now + n_q] = Q_root
            error_mean = one.state_transition @ error_mean + other_F @ state_mean
            error_mean = error_mean + b - one.input_effect
            state_mean = F @ state_mean + b
        now += n_q
        innovation = one.measurement_matrix @ error[:, : now + n_r]
        innovation += other_H @ state[:, : now + n_r]
        innovation[:, now:] = R_root
        now += n_r
        mean = one.measurement_matrix @ error_mean + other_H @ state_mean
        size = np.abs(one.measurement_matrix) @ np.abs(error[:, :now]).max(axis=1, initial=0.0)
        size += np.abs(other_H) @ np.abs(state[:, :now]).max(axis=1, initial=0.0)
        rounding = EPSILON * (np.abs(filtering.whitening) @ size).max(initial=0.0)
        if not (np.isfinite(rounding) and np.isfinite(mean).all()):
            break
        if len(filtering.whitening) != len(others.whitening) or _sees(
            filtering.without_noise, innovation, mean
        ):
            singular_at = scan
            break
        white = filtering.whitening @ innovation
        white_mean = filtering.whitening @ mean
        if rounding > LOST and rounding > CANCELS * np.abs(white).max(initial=0.0):
            break
        error[:, :now] -= filtering.gain @ white
        error_mean = error_mean - filtering.gain @ white_mean
        root[row : row + len(white), :now] = white
        shift[row : row + len(white)] = white_mean
        row += len(white)
        rows_after.append(row)
        columns_after.append(now)
        if rounding > LOST:  # this scan is as large as its terms, but the next has lost its digits
            break
    return Outputs(
        root[:row, : columns_after[-1]],
        shift[:row],
        tuple(rows_after),
        tuple(columns_after),
        singular_at,
    )


def _sees(without_noise: Array, innovation: Array, mean: Array) -> bool:
    """Whether the other mode puts anything where the filter's mode has nothing but its mean."""
    if not len(without_noise):
        return False
    size = max(float(np.abs(innovation).max(initial=0.0)), float(np.abs(mean).max()))
    left = max(
        float(np.abs(without_noise @ innovation).max(initial=0.0)),
        float(np.abs(without_noise @ mean).max()),
    )
    return left > ZERO_STD * size and left > 1e-150


def spectrum(outputs: Outputs, scans: int) -> Spectrum:
    """The outputs of the first `scans` scans on axes where both modes' are uncorrelated."""
    rows, columns = outputs.rows_after[scans], outputs.columns_after[scans]
    root, shift = outputs.root[:rows, :columns], outputs.shift[:rows]
    with np.errstate(over="ignore", invalid="ignore"):
        gram = root @ root.T
    if rows > FEW_ROWS and np.isfinite(gram).all():
        variance, vectors = np.linalg.eigh(gram)
        if variance[0] > variance[-1] * WELL_CONDITIONED:
            return Spectrum(variance, vectors.T @ shift)
    vectors, std, _ = np.linalg.svd(_compressed(root))
    # Larger ones decide just as surely, and their squares' products could not be held.
    return Spectrum(
        np.clip(std, 1.0 / LARGE, LARGE) ** 2, np.clip(vectors.T @ shift, -LARGE, LARGE)
    )
