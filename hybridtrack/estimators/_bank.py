"""The one compiled recursion of every multiple-model filter, lanes last.

A lane is a run: all arrays end in the axis of runs, every inner loop goes over it in contiguous
memory, and the compiler turns it into vector instructions. A cycle has the IMM's five steps
(Blom and Bar-Shalom 1988; Hwang, Balakrishnan, Tomlin 2006, section 3), each a function below:

    predict_mode_probabilities -> mix -> predict -> update -> weigh_modes (-> combine)

The covariances are packed lower triangles: element (a, c), a >= c, stands at a (a + 1)/2 + c.
Mode probabilities are kept as logarithms too, so that the evidence against a mode that nothing
else feeds (a static bank, an absorbing mode) may exceed the range of a float without being
forgotten: it can still come back from e**-2000. Modes that feed one another and are all below
e**-745 together are forgotten.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.compiled import exp, lane_kernel, log
from hybridtrack.estimators._lanes import (
    add_scaled,
    aligned_zeros,
    apply,
    copy,
    copy_all,
    fill,
    merge,
    merge_mean,
    merge_share,
    packed,
    set_scaled,
)
from hybridtrack.estimators._residual_mean import divide_by_residual_mean, predict_residual
from hybridtrack.estimators._update import update
from hybridtrack.models import JumpMarkovModel

Array = NDArray[np.float64]

NO_INTERACTION, MIXING, INHERIT = 0, 1, 2
LIKELIHOOD, RESIDUAL_MEAN, COMMON_RESIDUAL_MEAN = 0, 1, 2


class Recursion(NamedTuple):
    """The choices that tell one multiple-model filter from another."""

    interaction: int = MIXING  # NO_INTERACTION | MIXING | INHERIT (the mode known before)
    weighting: int = LIKELIHOOD  # LIKELIHOOD | RESIDUAL_MEAN | COMMON_RESIDUAL_MEAN
    recursive_residual_error: bool = True  # RMIMM: carry the mean estimation error along
    residual_floor: float = 1.0  # RMIMM: smallest norm of a residual's mean, measurement units
    mode_probability_floor: float = 0.0  # Maybeck's lower bound on mode probabilities


class KernelModel(NamedTuple):
    """A JumpMarkovModel as the kernel wants it; measurements decorrelated by R = L D L'."""

    state_transition: Array  # F (n_times or 1, n_modes, n_x, n_x)
    input_effect: Array  # (n_times or 1, n_modes, n_x)
    process_noise_covariance: Array  # (n_times or 1, n_modes, n_packed)
    transition_matrix: Array  # (n_times or 1, n_modes, n_modes)
    measurement_matrix: Array  # H (n_modes, n_y, n_x)
    decorrelation: Array  # L^-1 (n_modes, n_y, n_y)
    decorrelated_matrix: Array  # L^-1 H (n_modes, n_y, n_x)
    decorrelated_variance: Array  # D (n_modes, n_y)
    output_mode: NDArray[np.int64]  # (n_modes,) where a mode's probability is added


class BankState(NamedTuple):
    """What goes on from one span of steps to the next; overwritten by `advance`."""

    mean: Array  # (n_modes, n_x, lanes)
    covariance: Array  # (n_modes, n_packed, lanes)
    mode_probabilities: Array  # (n_modes, lanes)
    log_mode_probabilities: Array  # (n_modes, lanes)
    residual_error: Array  # (n_modes, n_x, lanes), RMIMM's mean estimation error


class Workspace(NamedTuple):
    """Scratch memory, so that no step allocates."""

    mixed_mean: Array  # (n_modes, n_x, lanes)
    mixed_covariance: Array  # (n_modes, n_packed, lanes)
    mixed_error: Array  # (n_modes, n_x, lanes)
    residual_mean: Array  # (n_modes, n_y, lanes)
    predicted_probability: Array  # (n_modes, lanes)
    log_predicted_probability: Array  # (n_modes, lanes)
    log_likelihood: Array  # (n_modes, lanes)
    states: Array  # (n_x, n_x, lanes)
    rows: Array  # (12, lanes)


class Estimates(NamedTuple):
    """What a span of steps gives; arrays of length 0 where not asked for."""

    mean: Array  # (n_steps, n_x, lanes)
    mode_probabilities: Array  # (n_steps, n_output_modes, lanes)
    mode_likelihoods: Array  # (n_steps, n_output_modes, lanes) N_j Lambda_j, summing to 1
    covariance: Array  # (n_steps, n_packed, lanes) or (0, n_packed, lanes)


# ---- the five steps --------------------------------------------------------------------------


@lane_kernel
def predict_mode_probabilities(state, work, transition):
    """c_j = sum_i p_ij mu_i (Hwang 2006, eq. 6; row = from), and its logarithm.

    A mode with a single origin (identity matrices, absorbing modes) keeps its logarithm exact.
    """
    n_modes = transition.shape[0]
    for j in range(n_modes):
        predicted = work.predicted_probability[j]
        log_predicted = work.log_predicted_probability[j]
        fill(predicted, 0.0)
        origins = 0
        origin = 0
        for i in range(n_modes):
            if transition[i, j] != 0.0:
                add_scaled(predicted, transition[i, j], state.mode_probabilities[i])
                origins += 1
                origin = i
        if origins == 1:
            log_transition = log(transition[origin, j])
            for b in range(predicted.size):
                log_predicted[b] = log_transition + state.log_mode_probabilities[origin, b]
        else:
            for b in range(predicted.size):
                log_predicted[b] = log(predicted[b])


@lane_kernel
def mix(state, work, transition, interaction, errors):
    """Each mode's start of the cycle: the merged state of the modes it may come from.

    Where a mode cannot be reached (predicted probability 0) its state stays finite and its
    probability 0.
    """
    n_modes, n_x = state.mean.shape[:2]
    total, share = work.rows[0], work.rows[1]
    for j in range(n_modes):
        mean, covariance = work.mixed_mean[j], work.mixed_covariance[j]
        first = j
        if interaction == MIXING:
            first = 0
            while first < n_modes - 1 and transition[first, j] == 0.0:
                first += 1
            if transition[first, j] == 0.0:
                first = j
        elif interaction == INHERIT:
            first = 0
        if errors:
            copy_all(work.mixed_error[j], state.residual_error[first])
        if interaction == NO_INTERACTION:
            copy_all(mean, state.mean[first])
            copy_all(covariance, state.covariance[first])
            continue
        set_scaled(
            total,
            transition[first, j] if interaction == MIXING else 1.0,
            state.mode_probabilities[first],
        )
        merged = False
        for i in range(first + 1, n_modes):
            factor = transition[i, j] if interaction == MIXING else 1.0
            if factor == 0.0:
                continue
            merge_share(total, share, factor, state.mode_probabilities[i])
            other_mean, other_covariance = state.mean[i], state.covariance[i]
            if merged:
                merge(
                    mean,
                    covariance,
                    share,
                    mean,
                    covariance,
                    other_mean,
                    other_covariance,
                    work.states[0],
                )
            else:
                merge(
                    mean,
                    covariance,
                    share,
                    state.mean[first],
                    state.covariance[first],
                    other_mean,
                    other_covariance,
                    work.states[0],
                )
            merged = True
            if errors:
                for e in range(n_x):
                    error = work.mixed_error[j, e]
                    merge_mean(error, work.rows[2], share, error, state.residual_error[i, e])
        if not merged:
            copy_all(mean, state.mean[first])
            copy_all(covariance, state.covariance[first])


@lane_kernel
def predict(j, state, work, state_transition, input_effect, process_noise):
    """x <- F x + b, P <- F P F' + Q of mode j, from its mixed start."""
    n_x = state.mean.shape[1]
    mixed_covariance = work.mixed_covariance[j]
    rows = work.states[0]
    for a in range(n_x):
        apply(state.mean[j, a], state_transition[a], work.mixed_mean[j], input_effect[a])
        # Row a of F P, as far as the elements up to the diagonal need it, then times F'.
        for g in range(n_x):
            needed = False
            for c in range(a + 1):
                needed = needed or state_transition[c, g] != 0.0
            if needed:
                first = True
                for e in range(n_x):
                    factor = state_transition[a, e]
                    if factor != 0.0:
                        source = mixed_covariance[packed(e, g)]
                        if first:
                            set_scaled(rows[g], factor, source)
                        else:
                            add_scaled(rows[g], factor, source)
                        first = False
                if first:
                    fill(rows[g], 0.0)
        for c in range(a + 1):
            t = packed(a, c)
            apply(state.covariance[j, t], state_transition[c], rows, process_noise[t])


@lane_kernel
def weigh_modes(state, work, likelihoods, floor):
    """mu_j proportional to Lambda_j c_j (Hwang 2006, eq. 11), with no underflow.

    likelihoods (n_modes, lanes), or of length 0 when not wanted, takes Lambda_j over their sum.
    """
    n_modes = state.mode_probabilities.shape[0]
    largest, total = work.rows[2], work.rows[3]
    if likelihoods.shape[0]:
        _normalise(likelihoods, work.log_likelihood, largest, total)
    for j in range(n_modes):
        for b in range(total.size):
            state.log_mode_probabilities[j, b] = (
                work.log_likelihood[j, b] + work.log_predicted_probability[j, b]
            )
    _normalise(state.mode_probabilities, state.log_mode_probabilities, largest, total)
    for b in range(total.size):
        largest[b] += log(total[b])
    for j in range(n_modes):
        add_scaled(state.log_mode_probabilities[j], -1.0, largest)
    if floor > 0.0:
        fill(total, 0.0)
        for j in range(n_modes):
            for b in range(total.size):
                raised = max(state.mode_probabilities[j, b], floor)
                state.mode_probabilities[j, b] = raised
                total[b] += raised
        for j in range(n_modes):
            for b in range(total.size):
                state.mode_probabilities[j, b] /= total[b]
                state.log_mode_probabilities[j, b] = log(state.mode_probabilities[j, b])


@lane_kernel
def _normalise(out, logarithms, largest, total):
    """out_j <- exp(l_j)/sum_i exp(l_i); leaves max l and sum exp(l - max l) in the last two."""
    n_modes = logarithms.shape[0]
    copy(largest, logarithms[0])
    for j in range(1, n_modes):
        for b in range(largest.size):
            largest[b] = logarithms[j, b] if logarithms[j, b] > largest[b] else largest[b]
    fill(total, 0.0)
    for j in range(n_modes):
        for b in range(largest.size):
            value = exp(logarithms[j, b] - largest[b])
            out[j, b] = value
            total[b] += value
    for j in range(n_modes):
        for b in range(largest.size):
            out[j, b] /= total[b]


@lane_kernel
def know_modes(state, known):
    """Mode probabilities of 1 and 0 for the mode that is known, lane by lane."""
    for j in range(state.mode_probabilities.shape[0]):
        for b in range(known.size):
            state.mode_probabilities[j, b] = 1.0 if known[b] == j else 0.0
            state.log_mode_probabilities[j, b] = 0.0 if known[b] == j else -np.inf


@lane_kernel
def combine(state, mean, covariance):
    """The estimate: the mean (n_x, lanes) of the mixture, and its covariance if wanted."""
    n_modes, n_x = state.mean.shape[:2]
    for e in range(n_x):
        for b in range(mean.shape[1]):
            mean[e, b] = state.mode_probabilities[0, b] * state.mean[0, e, b]
        for i in range(1, n_modes):
            for b in range(mean.shape[1]):
                mean[e, b] += state.mode_probabilities[i, b] * state.mean[i, e, b]
    if covariance.shape[0]:
        t = 0
        for a in range(n_x):
            for c in range(a + 1):
                fill(covariance[t], 0.0)
                for i in range(n_modes):
                    for b in range(mean.shape[1]):
                        covariance[t, b] += state.mode_probabilities[i, b] * (
                            state.covariance[i, t, b]
                            + (state.mean[i, a, b] - mean[a, b])
                            * (state.mean[i, c, b] - mean[c, b])
                        )
                t += 1


@lane_kernel
def advance(state, work, model, choices, measurements, known_modes, estimates):
    """Run the recursion over a span of scans; overwrites `state`, `work` and `estimates`.

    measurements (n_steps, n_y, lanes), NaN where missed; known_modes (n_steps, lanes) or (0, 0).
    Two spans one after the other give the bytes of one.
    """
    interaction = choices.interaction
    residuals = choices.weighting != LIKELIHOOD
    errors = residuals and choices.recursive_residual_error
    n_modes = state.mean.shape[0]
    no_covariance = work.rows[:0]
    for k in range(measurements.shape[0]):
        y = measurements[k]
        f = k if model.state_transition.shape[0] > 1 else 0
        q = k if model.process_noise_covariance.shape[0] > 1 else 0
        transition = model.transition_matrix[k if model.transition_matrix.shape[0] > 1 else 0]

        predict_mode_probabilities(state, work, transition)
        mix(state, work, transition, interaction, errors)
        for j in range(n_modes):
            predict(
                j,
                state,
                work,
                model.state_transition[f, j],
                model.input_effect[f, j],
                model.process_noise_covariance[q, j],
            )
            if residuals:
                predict_residual(
                    j,
                    state,
                    work,
                    model,
                    model.state_transition[f],
                    model.input_effect[f],
                )
            update(j, state, work, model, y, errors)
        if residuals:
            common = choices.weighting == COMMON_RESIDUAL_MEAN
            divide_by_residual_mean(work, y, common, choices.residual_floor)
        likelihoods = work.rows[:0]
        if estimates.mode_likelihoods.shape[0]:
            likelihoods = estimates.mode_likelihoods[k]
        weigh_modes(state, work, likelihoods, choices.mode_probability_floor)
        if interaction == INHERIT:
            know_modes(state, known_modes[k])
        covariance = no_covariance
        if estimates.covariance.shape[0]:
            covariance = estimates.covariance[k]
        combine(state, estimates.mean[k], covariance)
        probabilities = estimates.mode_probabilities[k]
        for o in range(probabilities.shape[0]):
            fill(probabilities[o], 0.0)
        for j in range(n_modes):
            add_scaled(probabilities[model.output_mode[j]], 1.0, state.mode_probabilities[j])


# ---- from outside ----------------------------------------------------------------------------


def output_modes(model: JumpMarkovModel) -> tuple[str, ...]:
    """The modes' names as reported: supermodes of one name are one."""
    return tuple(dict.fromkeys(model.mode_names))


def kernel_model(model: JumpMarkovModel) -> KernelModel:
    """Arrange a model for the kernel: contiguous, covariances packed, measurements decorrelated."""
    n_modes, n_y, n_x = model.measurement_matrix.shape
    lower = np.tril_indices(n_x)
    unit = np.empty((n_modes, n_y, n_y))
    variance = np.empty((n_modes, n_y))
    for j, covariance in enumerate(model.measurement_noise_covariance):
        factor = np.linalg.cholesky(covariance)
        diagonal = np.diagonal(factor)
        unit[j] = np.linalg.inv(factor / diagonal)
        variance[j] = diagonal**2
    decorrelated = np.einsum("jml,jle->jme", unit, model.measurement_matrix)
    names = output_modes(model)
    return KernelModel(
        state_transition=np.ascontiguousarray(model.state_transition),
        input_effect=np.ascontiguousarray(model.input_effect),
        process_noise_covariance=np.ascontiguousarray(
            model.process_noise_covariance[..., lower[0], lower[1]]
        ),
        transition_matrix=np.ascontiguousarray(model.transition_matrix),
        measurement_matrix=np.ascontiguousarray(model.measurement_matrix),
        decorrelation=unit,
        decorrelated_matrix=np.ascontiguousarray(decorrelated),
        decorrelated_variance=variance,
        output_mode=np.array([names.index(name) for name in model.mode_names], dtype=np.int64),
    )


def start(model: JumpMarkovModel, lanes: int, initial_mean: Array | None = None) -> BankState:
    """The state at k = 0; initial_mean (n_x, lanes) where runs have their own, else the model's."""
    n_modes, _, n_x = model.measurement_matrix.shape
    if initial_mean is None:
        initial_mean = np.repeat(model.initial_mean[:, np.newaxis], lanes, axis=1)
    packed = model.initial_covariance[np.tril_indices(n_x)]
    probabilities = np.repeat(model.initial_mode_probabilities[:, np.newaxis], lanes, axis=1)
    with np.errstate(divide="ignore"):
        logarithms = np.log(probabilities)
    state = BankState(
        mean=aligned_zeros(n_modes, n_x, lanes),
        covariance=aligned_zeros(n_modes, packed.size, lanes),
        mode_probabilities=aligned_zeros(n_modes, lanes),
        log_mode_probabilities=aligned_zeros(n_modes, lanes),
        residual_error=aligned_zeros(n_modes, n_x, lanes),
    )
    state.mean[:] = initial_mean
    state.covariance[:] = packed[:, np.newaxis]
    state.mode_probabilities[:] = probabilities
    state.log_mode_probabilities[:] = logarithms
    return state


def workspace(model: JumpMarkovModel, lanes: int) -> Workspace:
    """Scratch memory for one block of `lanes` runs."""
    n_modes, n_y, n_x = model.measurement_matrix.shape
    n_packed = n_x * (n_x + 1) // 2
    return Workspace(
        mixed_mean=aligned_zeros(n_modes, n_x, lanes),
        mixed_covariance=aligned_zeros(n_modes, n_packed, lanes),
        mixed_error=aligned_zeros(n_modes, n_x, lanes),
        residual_mean=aligned_zeros(n_modes, n_y, lanes),
        predicted_probability=aligned_zeros(n_modes, lanes),
        log_predicted_probability=aligned_zeros(n_modes, lanes),
        log_likelihood=aligned_zeros(n_modes, lanes),
        states=aligned_zeros(3, n_x, lanes),
        rows=aligned_zeros(12, lanes),
    )


def empty_estimates(
    model: JumpMarkovModel, steps: int, lanes: int, *, likelihoods: bool, covariance: bool
) -> Estimates:
    """Room for the estimates of a span."""
    n_x = len(model.state_names)
    n_modes = len(output_modes(model))
    likelihoods = likelihoods and n_modes == len(model.mode_names)
    return Estimates(
        mean=aligned_zeros(steps, n_x, lanes),
        mode_probabilities=aligned_zeros(steps, n_modes, lanes),
        mode_likelihoods=aligned_zeros(steps if likelihoods else 0, n_modes, lanes),
        covariance=aligned_zeros(steps if covariance else 0, n_x * (n_x + 1) // 2, lanes),
    )


NO_KNOWN_MODES: NDArray[np.int64] = np.zeros((0, 0), dtype=np.int64)


def run_span(
    state: BankState,
    work: Workspace,
    model: KernelModel,
    recursion: Recursion,
    measurements: Array,
    estimates: Estimates,
    known_modes: NDArray[np.int64] = NO_KNOWN_MODES,
) -> None:
    """`advance` with its arguments' types as Python sees them."""
    arguments: tuple[Any, ...] = (state, work, model, recursion, measurements, known_modes)
    advance(*arguments, estimates)
