"""What the outputs of a mode tell of its state: rank tests, and the covariances of the outputs.

The paper's convention is another than the house's, and both are here by name. In Hwang,
Balakrishnan, Tomlin 2003 the mode at k drives the step from k to k + 1 and the initial state is the
state at the first scan; in the house the mode at k drives the step from k - 1 to k.
"""

import math
from typing import NamedTuple

import numpy as np

from hybridtrack.errors import Unsuited
from hybridtrack.models import Array, JumpMarkovModel
from hybridtrack.roots import thin_square_root

EQUILIBRATED = 2  # times, after which units don't matter any more
RANK_TOLERANCE = 1e-9  # of the largest singular value, columns being normalised
SAME_TOLERANCE = 1e-12  # relative: variances that differ by less, in any direction, are equal
ROUNDING = 1e-13  # of the largest variance: what rounding leaves of differences
CANCELLED = 1e-13  # of the sizes of a sum's terms


class ModeDynamics(NamedTuple):
    """One mode alone: x_k = F x_{k-1} + b + w, z_k = H x_k + v, and how it starts."""

    name: str
    state_transition: Array  # F (n_x, n_x)
    input_effect: Array  # b (n_x,)
    process_noise_covariance: Array  # Q (n_x, n_x); may be zero
    measurement_matrix: Array  # H (n_y, n_x)
    measurement_noise_covariance: Array  # R (n_y, n_y); may be zero
    initial_mean: Array  # (n_x,)
    initial_covariance: Array  # (n_x, n_x); may be zero


class OutputTests(NamedTuple):
    """Whether covariances of outputs differ, and by how much at most.

    difference: 1 - smaller / larger of the two variances of the combination of outputs where that
    is largest. It doesn't depend on the outputs' units, nor on which covariance is named first.
    """

    differ: bool
    difference: float


def mode_dynamics(model: JumpMarkovModel) -> tuple[ModeDynamics, ...]:
    """Each mode of a model at one length of step, in order; all start alike.

    Raises Unsuited for a model of several lengths of step.
    """
    if len(model.state_transition) != 1:
        raise Unsuited(
            "observability is that of steps of one length, and the model has "
            f"{len(model.state_transition)}; give it one",
            "modes",
        )
    return tuple(
        ModeDynamics(
            name,
            model.state_transition[0, j],
            model.input_effect[0, j],
            model.process_noise_covariance[0, j],
            model.measurement_matrix[j],
            model.measurement_noise_covariance[j],
            model.initial_mean,
            model.initial_covariance,
        )
        for j, name in enumerate(model.mode_names)
    )


# ---- rank ------------------------------------------------------------------------------------


def observability_matrix(state_transition: Array, measurement_matrix: Array, scans: int) -> Array:
    """O_k = [H; H F; ..; H F^(k-1)], (k n_y, n_x), for k scans (Hwang 2003, eq. 2).

    Entries whose terms cancel to rounding are 0: a column of nothing else would pass for a state.
    """
    matrix = _powers(state_transition, measurement_matrix, scans)
    terms = _powers(np.abs(state_transition), np.abs(measurement_matrix), scans)
    return np.where(np.abs(matrix) > CANCELLED * terms, matrix, 0.0)


def _powers(state_transition: Array, measurement_matrix: Array, scans: int) -> Array:
    blocks = [measurement_matrix]
    for _ in range(scans - 1):
        blocks.append(blocks[-1] @ state_transition)
    return np.concatenate(blocks)


def observability_index(state_transition: Array, measurement_matrix: Array) -> float:
    """The smallest number of scans k with rank O_k = n_x; inf where there is none.

    Columns and outputs are normalised first, so that no units matter; singular values below
    RANK_TOLERANCE of the largest are zero. By Cayley and Hamilton no more than n_x scans help.
    Source: Hwang 2003, before lemma 2.
    """
    n_x = len(state_transition)
    outputs = _outputs_alike(state_transition, measurement_matrix)
    for scans in range(1, n_x + 1):
        matrix = observability_matrix(state_transition, outputs, scans)
        if rank(matrix) == n_x:
            return float(scans)
    return math.inf


def _outputs_alike(state_transition: Array, measurement_matrix: Array) -> Array:
    """H with outputs in units of their own, such that each is of size 1 in the states' own units.

    Not row by row of O, which would make something of a later scan's rounding.
    """
    outputs = measurement_matrix
    for _ in range(EQUILIBRATED):
        matrix = observability_matrix(state_transition, outputs, len(state_transition))
        states = np.abs(matrix).max(axis=0, initial=0.0)
        states[states == 0.0] = 1.0
        sizes = np.abs(outputs / states).max(axis=1, keepdims=True)
        outputs = outputs / np.where(sizes > 0.0, sizes, 1.0)
    return outputs


def observability_indices(model: JumpMarkovModel) -> tuple[float, ...]:
    """`observability_index` of each mode, in the model's order; inf for an unobservable mode."""
    return tuple(
        observability_index(mode.state_transition, mode.measurement_matrix)
        for mode in mode_dynamics(model)
    )


def joint_observability_index(model: JumpMarkovModel) -> float:
    """The scans after which every mode's state is determined: the largest index of its modes.

    inf where a mode is unobservable (`observability_indices` tells which). The model is that of
    one length of step. Source: Hwang 2003, before lemma 2.
    """
    return max(observability_indices(model))


def unseen_states(
    state_transition: Array, measurement_matrix: Array, names: tuple[str, ...]
) -> tuple[str, ...]:
    """The states of which not all is in the outputs: those with a part in O's null space."""
    matrix = observability_matrix(state_transition, measurement_matrix, len(state_transition))
    scaled = _normalised(matrix)
    _, values, rows = np.linalg.svd(scaled)
    seen = int((values > RANK_TOLERANCE * max(values[0], 1e-300)).sum())
    hidden = np.abs(rows[seen:]).max(axis=0, initial=0.0)
    return tuple(name for name, part in zip(names, hidden, strict=True) if part > 1e-6)


def _normalised(matrix: Array) -> Array:
    """Columns of length 1, or 0."""
    size = np.abs(matrix).max(axis=0, initial=0.0)  # first, lest squares overflow
    scaled = np.divide(matrix, size, out=np.zeros_like(matrix), where=size > 0.0)
    length = np.linalg.norm(scaled, axis=0)
    normalised: Array = np.divide(scaled, length, out=np.zeros_like(matrix), where=length > 0.0)
    return normalised


def rank(matrix: Array) -> int:
    """The number of singular values above RANK_TOLERANCE of the largest, columns normalised."""
    values = np.linalg.svd(_normalised(matrix), compute_uv=False)
    return int((values > RANK_TOLERANCE * values[0]).sum()) if values[0] > 0.0 else 0


# ---- the lemmas ------------------------------------------------------------------------------


def output_covariance(mode: ModeDynamics, scans: int) -> Array:
    """O P0 O' + T Q T' + R on the diagonal, (k n_y, k n_y): Hwang 2003, eq. 6.

    The initial state is that at the first scan, as there; a known input and a mean don't matter.
    """
    root = noise_response(mode, scans)
    start = observability_matrix(mode.state_transition, mode.measurement_matrix, scans)
    start = start @ thin_square_root(mode.initial_covariance)
    covariance: Array = root @ root.T + start @ start.T
    return covariance


def noise_response(mode: ModeDynamics, scans: int) -> Array:
    """[T Q^(1/2), R^(1/2)], (k n_y, noises): what unit noises do to the outputs of k scans.

    T is Hwang 2003's Toeplitz matrix (eq. 2); process noise acts from the second scan on.
    """
    noise = thin_square_root(mode.process_noise_covariance)
    sensor = thin_square_root(mode.measurement_noise_covariance)
    n_y, rank = len(mode.measurement_matrix), noise.shape[1]
    effect = observability_matrix(mode.state_transition, mode.measurement_matrix, scans) @ noise
    response = np.zeros((scans * n_y, (scans - 1) * rank))
    for step in range(scans - 1):
        begin = (step + 1) * n_y
        response[begin:, step * rank : (step + 1) * rank] = effect[: scans * n_y - begin]
    return np.hstack([response, np.kron(np.eye(scans), sensor)])


def initial_mode_test(one: ModeDynamics, other: ModeDynamics, scans: int) -> OutputTests:
    """Lemma 2 of Hwang 2003: the covariances of the outputs of `scans` scans differ."""
    return _compared(output_covariance(one, scans), output_covariance(other, scans))


def transition_test_as_printed(old: ModeDynamics, new: ModeDynamics, scans: int) -> OutputTests:
    """Lemma 3 of Hwang 2003 as printed, for a transition `scans` scans after the first.

    There the old mode still drives the state to the scan of the transition, and only H and R are
    the new one's: modes with the same H and R never pass.
    """
    state = _predicted_covariance(old, scans)
    return _compared(_scan_covariance(new, state), _scan_covariance(old, state))


def transition_test(old: ModeDynamics, new: ModeDynamics, scans: int) -> OutputTests:
    """Lemma 3 with the new mode driving the step to the scan of the transition (ours)."""
    before = _predicted_covariance(old, scans - 1)
    return _compared(
        _scan_covariance(new, _stepped(new, before)), _scan_covariance(old, _stepped(old, before))
    )


def _predicted_covariance(mode: ModeDynamics, steps: int) -> Array:
    covariance = mode.initial_covariance
    for _ in range(steps):
        covariance = _stepped(mode, covariance)
    return covariance


def _stepped(mode: ModeDynamics, covariance: Array) -> Array:
    F = mode.state_transition
    stepped: Array = F @ covariance @ F.T + mode.process_noise_covariance
    return stepped


def _scan_covariance(mode: ModeDynamics, covariance: Array) -> Array:
    H = mode.measurement_matrix
    output: Array = H @ covariance @ H.T + mode.measurement_noise_covariance
    return output


def _compared(one: Array, other: Array) -> OutputTests:
    """Along the axes on which both covariances together are uncorrelated."""
    variance = np.diag(one) + np.diag(other)
    told = np.isfinite(variance) & (variance > 0.0)  # no more than numbers hold
    scale = np.sqrt(variance[told])
    unit = np.outer(scale, scale)
    left, right = (covariance[np.ix_(told, told)] / unit for covariance in (one, other))
    if not (scale.size and np.isfinite(left).all() and np.isfinite(right).all()):
        return OutputTests(False, 0.0)
    total, axes = np.linalg.eigh(left + right)
    kept = total > ROUNDING * total[-1]
    total, axes = total[kept], axes[:, kept]
    apart = axes.T @ (left - right) @ axes
    apart = np.where(np.abs(apart) > ROUNDING * total[-1], apart, 0.0) / np.sqrt(
        np.outer(total, total)
    )
    # (l - 1) / (l + 1) of the generalised eigenvalues l.
    share = min(float(np.abs(np.linalg.eigvalsh(apart)).max()), 1.0)
    difference = 2.0 * share / (1.0 + share)
    return OutputTests(difference > SAME_TOLERANCE, difference)


# ---- without a word about the initial state --------------------------------------------------


def initial_state_free_scan(one: ModeDynamics, other: ModeDynamics) -> float:
    """The first scan at which noises and inputs tell two modes apart whatever the states are.

    Outputs are projected onto the left null space of [O_one O_other], where neither mode's initial
    state has a part; what is left has a mean (of known inputs) and a covariance under either mode.
    Outputs are first brought to common units, so that theirs don't matter.
    inf where both are equal to SAME_TOLERANCE for ever: vectors of that null space are shifts of
    polynomials of degree 2 n_x or less, so that what is left is a moving average no longer than
    that, and 4 n_x + 1 scans show all of it.
    """
    n_x, n_y = len(one.initial_mean), len(one.measurement_matrix)
    most = 4 * n_x + 1
    unit = _units_of_outputs(one, other, most)
    starts = np.hstack(
        [observability_matrix(m.state_transition, m.measurement_matrix, most) for m in (one, other)]
    )
    starts /= unit[:, np.newaxis]
    for scans in range(1, most + 1):
        now = unit[: scans * n_y]
        null = _left_null_space(starts[: scans * n_y])
        if not null.shape[1]:
            continue
        noises = [null.T @ (noise_response(m, scans) / now[:, np.newaxis]) for m in (one, other)]
        left, right = (noise @ noise.T for noise in noises)
        inputs = [input_response(mode, scans) / now for mode in (one, other)]
        std = math.sqrt(max(float(np.abs(left).max()), float(np.abs(right).max())))
        size = max(float(np.abs(mean).max()) for mean in inputs)
        apart = float(np.abs(null.T @ (inputs[0] - inputs[1])).max())
        if apart > SAME_TOLERANCE * max(std, size) or _compared(left, right).differ:
            return float(scans)
    return math.inf


def _units_of_outputs(one: ModeDynamics, other: ModeDynamics, scans: int) -> Array:
    """A size of each output, scan by scan (k n_y,): both modes' sensor noise, else their gains."""
    noise = np.diag(one.measurement_noise_covariance + other.measurement_noise_covariance)
    gains = np.abs(one.measurement_matrix) + np.abs(other.measurement_matrix)
    unit = np.where(noise > 0.0, np.sqrt(noise), gains.max(axis=1))
    return np.tile(np.where(unit > 0.0, unit, 1.0), scans)


def input_response(mode: ModeDynamics, scans: int) -> Array:
    """What a mode's known input does to the outputs of k scans, (k n_y,), from a zero state."""
    state, outputs = np.zeros(len(mode.initial_mean)), []
    for _ in range(scans):
        outputs.append(mode.measurement_matrix @ state)
        state = mode.state_transition @ state + mode.input_effect
    return np.concatenate(outputs)


def _left_null_space(matrix: Array) -> Array:
    """An orthonormal basis (rows, dimension) of the vectors n with n' matrix = 0."""
    vectors, values, _ = np.linalg.svd(_normalised(matrix))
    spanned = int((values > RANK_TOLERANCE * values[0]).sum()) if values[0] > 0.0 else 0
    basis: Array = vectors[:, spanned:]
    return basis
