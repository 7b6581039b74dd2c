"""How the recursion's numbers lie in memory, and how a model becomes them.

Lanes (runs) are kept in groups of WIDTH, each group's state together: with the workspace it stays
in the first-level cache from one span's first step to its last.
"""

import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.compiled import row_kernel
from hybridtrack.models import JumpMarkovModel
from hybridtrack.vectors import WIDTH, aligned_zeros, vectors

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

NO_ROWS: Array = np.zeros((0, 1))


class SparseMaps(NamedTuple):
    """A matrix for each mode without the elements that are always zero, row after row."""

    first: NDArray[np.uint64]  # (n_modes, n_rows + 1) where each row begins, and the last ends
    column: NDArray[np.uint64]  # (n_modes, n_elements)
    weight: Array  # (n_times or 1, n_modes, n_elements)


class KernelModel(NamedTuple):
    """A JumpMarkovModel as the kernel wants it; measurements decorrelated by R = L D L'."""

    state_map: SparseMaps  # x -> F x
    covariance_map: SparseMaps  # P -> F P F', of packed lower triangles
    input_effect: Array  # (n_times or 1, n_modes, n_x)
    process_noise_covariance: Array  # (n_times or 1, n_modes, n_packed)
    transition_matrix: Array  # (n_times or 1, n_modes, n_modes)
    only_origin: Indices  # (n_times or 1, n_modes) the one mode it may come from; -1: several
    keeps_logarithm: NDArray[np.bool_]  # (n_modes,) whether it has an only origin at any time
    measurement_matrix: Array  # H (n_modes, n_y, n_x)
    decorrelation: Array  # L^-1 (n_modes, n_y, n_y)
    decorrelated_matrix: Array  # L^-1 H (n_modes, n_y, n_x)
    decorrelated_variance: Array  # D (n_modes, n_y)
    component: Indices  # (n_modes, n_y) the one state in a row of L^-1 H; -1: several
    output_mode: Indices  # (n_modes,) where a mode's probability is added
    final_probability: Array  # (n_modes,); (0,) where there is none


class BankState(NamedTuple):
    """What goes on from one span of steps to the next; overwritten by `advance`."""

    mean: Array  # (n_groups, n_modes, n_x, WIDTH)
    covariance: Array  # (n_groups, n_modes, n_packed, WIDTH)
    mode_probabilities: Array  # (n_groups, n_modes, WIDTH)
    log_mode_probabilities: Array  # (n_groups, n_modes, WIDTH)
    residual_error: Array  # (n_groups, n_modes, n_x, WIDTH), RMIMM's mean estimation error


class Workspace(NamedTuple):
    """Scratch memory of one group, so that no step allocates."""

    mixed_mean: Array  # (n_modes, n_x, WIDTH)
    mixed_covariance: Array  # (n_modes, n_packed, WIDTH)
    mixed_error: Array  # (n_modes, n_x, WIDTH)
    residual_mean: Array  # (n_modes, n_y, WIDTH)
    predicted_probability: Array  # (n_modes, WIDTH)
    log_predicted_probability: Array  # (n_modes, WIDTH), of modes with an only origin
    density: Array  # (n_modes, WIDTH) a mode's likelihood is this ...
    exponent: Array  # (n_modes, WIDTH) ... times e to this
    weight: Array  # (n_modes, WIDTH)
    scan: Array  # (n_y, WIDTH)
    row: Array  # (n_x, WIDTH)
    gain: Array  # (n_x, WIDTH)
    taken: Array  # (n_x, WIDTH)


class Estimates(NamedTuple):
    """What a span of steps gives; arrays of length 0 where not asked for."""

    mean: Array  # (n_steps, n_x, lanes)
    mode_probabilities: Array  # (n_steps, n_output_modes, lanes)
    mode_likelihoods: Array  # (n_steps, n_output_modes, lanes) N_j Lambda_j, summing to 1
    covariance: Array  # (n_steps, n_packed, lanes) or (0, n_packed, lanes)
    final_mode_probability: Array = NO_ROWS  # (n_steps, lanes) that the mode now is the last one
    final_mode_prior: Array = NO_ROWS  # (n_steps, 1) the same before any scan, by the time alone


# ---- as vectors ------------------------------------------------------------------------------


@row_kernel
def group_of(state, g):
    """The state of one group of lanes, as vectors."""
    return BankState(
        vectors(state.mean)[g],
        vectors(state.covariance)[g],
        vectors(state.mode_probabilities)[g],
        vectors(state.log_mode_probabilities)[g],
        vectors(state.residual_error)[g],
    )


@row_kernel
def in_vectors(work):
    """The workspace as vectors."""
    return Workspace(
        vectors(work.mixed_mean),
        vectors(work.mixed_covariance),
        vectors(work.mixed_error),
        vectors(work.residual_mean),
        vectors(work.predicted_probability),
        vectors(work.log_predicted_probability),
        vectors(work.density),
        vectors(work.exponent),
        vectors(work.weight),
        vectors(work.scan),
        vectors(work.row),
        vectors(work.gain),
        vectors(work.taken),
    )


# ---- memory ----------------------------------------------------------------------------------


def start(model: JumpMarkovModel, lanes: int, initial_mean: Array | None = None) -> BankState:
    """The state at k = 0 of `lanes` runs, a multiple of WIDTH.

    initial_mean (n_x, lanes) where runs have their own, else the model's.
    """
    n_modes, _, n_x = model.measurement_matrix.shape
    assert lanes % WIDTH == 0, f"{lanes} lanes are no multiple of {WIDTH}"
    groups = lanes // WIDTH
    if initial_mean is None:
        initial_mean = np.repeat(model.initial_mean[:, np.newaxis], lanes, axis=1)
    packed = model.initial_covariance[_lower(n_x)]
    probabilities = model.initial_mode_probabilities[:, np.newaxis]
    with np.errstate(divide="ignore"):
        logarithms = np.log(probabilities)
    rows = (n_x, packed.size, 1, 1, n_x)  # of each mode
    memory = aligned_zeros(groups * n_modes * sum(rows) * WIDTH)
    ends = np.cumsum(rows) * (groups * n_modes * WIDTH)
    parts = np.split(memory, ends[:-1].tolist())
    state = BankState(
        mean=parts[0].reshape(groups, n_modes, n_x, WIDTH),
        covariance=parts[1].reshape(groups, n_modes, packed.size, WIDTH),
        mode_probabilities=parts[2].reshape(groups, n_modes, WIDTH),
        log_mode_probabilities=parts[3].reshape(groups, n_modes, WIDTH),
        residual_error=parts[4].reshape(groups, n_modes, n_x, WIDTH),
    )
    state.mean[:] = initial_mean.reshape(n_x, groups, 1, WIDTH).transpose(1, 2, 0, 3)
    state.covariance[:] = packed[:, np.newaxis]
    state.mode_probabilities[:] = probabilities
    state.log_mode_probabilities[:] = logarithms
    return state


@functools.cache
def _lower(n: int) -> tuple[Indices, Indices]:
    """Rows and columns of a packed lower triangle."""
    rows, columns = np.tril_indices(n)
    return rows, columns


def workspace(model: JumpMarkovModel) -> Workspace:
    """Scratch memory for the recursion of this model."""
    n_modes, n_y, n_x = model.measurement_matrix.shape
    n_packed = n_x * (n_x + 1) // 2
    return Workspace(
        mixed_mean=aligned_zeros(n_modes, n_x, WIDTH),
        mixed_covariance=aligned_zeros(n_modes, n_packed, WIDTH),
        mixed_error=aligned_zeros(n_modes, n_x, WIDTH),
        residual_mean=aligned_zeros(n_modes, n_y, WIDTH),
        predicted_probability=aligned_zeros(n_modes, WIDTH),
        log_predicted_probability=aligned_zeros(n_modes, WIDTH),
        density=aligned_zeros(n_modes, WIDTH),
        exponent=aligned_zeros(n_modes, WIDTH),
        weight=aligned_zeros(n_modes, WIDTH),
        scan=aligned_zeros(n_y, WIDTH),
        row=aligned_zeros(n_x, WIDTH),
        gain=aligned_zeros(n_x, WIDTH),
        taken=aligned_zeros(n_x, WIDTH),
    )


def empty_estimates(
    model: JumpMarkovModel, steps: int, lanes: int, *, likelihoods: bool, covariance: bool
) -> Estimates:
    """Room for the estimates of a span."""
    n_x = len(model.state_names)
    n_modes = len(output_modes(model))
    likelihoods = likelihoods and n_modes == len(model.mode_names)
    final = steps if model.final_probability is not None else 0
    return Estimates(
        mean=aligned_zeros(steps, n_x, lanes),
        mode_probabilities=aligned_zeros(steps, n_modes, lanes),
        mode_likelihoods=aligned_zeros(steps if likelihoods else 0, n_modes, lanes),
        covariance=aligned_zeros(steps if covariance else 0, n_x * (n_x + 1) // 2, lanes),
        final_mode_probability=aligned_zeros(final, lanes),
        final_mode_prior=aligned_zeros(final, 1),
    )


# ---- models ----------------------------------------------------------------------------------


def output_modes(model: JumpMarkovModel) -> tuple[str, ...]:
    """The modes' names as reported: supermodes of one name are one."""
    return tuple(dict.fromkeys(model.mode_names))


def kernel_model(model: JumpMarkovModel) -> KernelModel:
    """Arrange a model for the kernel: covariances packed, zeros left out, R made diagonal."""
    n_modes, n_y, n_x = model.measurement_matrix.shape
    lower = _lower(n_x)
    decorrelation = np.empty((n_modes, n_y, n_y))
    variance = np.empty((n_modes, n_y))
    for j, covariance in enumerate(model.measurement_noise_covariance):
        factor = np.linalg.cholesky(covariance)
        diagonal = np.diagonal(factor)
        decorrelation[j] = np.linalg.inv(factor / diagonal)
        variance[j] = diagonal**2
    decorrelated = np.einsum("jml,jle->jme", decorrelation, model.measurement_matrix)
    names = output_modes(model)
    only_origin = _only_nonzero(np.swapaxes(model.transition_matrix, 1, 2))
    return KernelModel(
        state_map=sparse(model.state_transition),
        covariance_map=sparse(_covariance_map(model.state_transition)),
        input_effect=np.ascontiguousarray(model.input_effect),
        process_noise_covariance=np.ascontiguousarray(
            model.process_noise_covariance[..., lower[0], lower[1]]
        ),
        transition_matrix=np.ascontiguousarray(model.transition_matrix),
        only_origin=only_origin,
        keeps_logarithm=np.asarray((only_origin >= 0).any(axis=0)),
        measurement_matrix=np.ascontiguousarray(model.measurement_matrix),
        decorrelation=decorrelation,
        decorrelated_matrix=np.ascontiguousarray(decorrelated),
        decorrelated_variance=variance,
        component=_only_nonzero(decorrelated),
        output_mode=np.array([names.index(name) for name in model.mode_names], dtype=np.int64),
        final_probability=(
            np.zeros(0)
            if model.final_probability is None
            else np.ascontiguousarray(model.final_probability)
        ),
    )


def _covariance_map(F: Array) -> Array:
    """The matrix (..., n_packed, n_packed) of P -> F P F' on packed lower triangles."""
    a, c = (index[:, np.newaxis] for index in _lower(F.shape[-1]))
    e, g = _lower(F.shape[-1])
    transposed = np.where(e != g, F[..., a, g] * F[..., c, e], 0.0)
    matrix: Array = F[..., a, e] * F[..., c, g] + transposed
    return matrix


def sparse(matrices: Array) -> SparseMaps:
    """matrices (n_times, n_modes, n_rows, n_columns), the same zeros at all times."""
    n_times, n_modes, n_rows, _ = matrices.shape
    kept = (matrices != 0).any(axis=0)
    most = int(kept.sum(axis=(1, 2)).max())
    first = np.zeros((n_modes, n_rows + 1), dtype=np.uint64)
    first[:, 1:] = kept.sum(axis=2).cumsum(axis=1)
    column = np.zeros((n_modes, most), dtype=np.uint64)
    weight = np.zeros((n_times, n_modes, most))
    for j in range(n_modes):
        rows, columns = np.nonzero(kept[j])
        column[j, : len(columns)] = columns
        weight[:, j, : len(columns)] = matrices[:, j, rows, columns]
    return SparseMaps(first, column, weight)


def _only_nonzero(rows: NDArray[Any]) -> Indices:
    """Where the last axis has its one nonzero element; -1 where there are several or none."""
    kept = rows != 0
    index: Indices = np.where(kept.sum(axis=-1) == 1, kept.argmax(axis=-1), -1)
    return index
