"""The one compiled recursion of every multiple-model filter.

It is written for a vector of lanes (hybridtrack.vectors), a lane being a run, and reads as if for
one. A cycle has the IMM's five steps (Blom and Bar-Shalom 1988; Hwang, Balakrishnan, Tomlin 2006,
section 3), each a function below:

    predict_mode_probabilities -> mix -> predict -> update -> weigh_modes (-> combine)

The covariances are packed lower triangles: element (a, c), a >= c, is at a (a + 1)/2 + c.

A mode that only one mode leads to, itself in the end (any in a static bank, one that can be left
and not entered), has a logarithm of its probability too, so that the evidence against it may exceed
the range of a float without being forgotten: it can still come back from e**-2000. Modes that feed
one another and are all below e**-708 together are forgotten.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from hybridtrack.compiled import COMPILED, lane_kernel, row_kernel
from hybridtrack.elementary import log, maximum
from hybridtrack.estimators._layout import (
    Array,
    BankState,
    Estimates,
    KernelModel,
    Workspace,
    group_of,
    in_vectors,
)
from hybridtrack.estimators._residual_mean import divide_by_residual_mean, predict_residual
from hybridtrack.estimators._rows import apply, copy, merge, merge_means, normalise
from hybridtrack.estimators._update import update
from hybridtrack.vectors import load, repeat, select, store

NO_INTERACTION, MIXING, INHERIT = 0, 1, 2
LIKELIHOOD, RESIDUAL_MEAN, COMMON_RESIDUAL_MEAN = 0, 1, 2

TINY, RAISED, LOG_RAISED = 1e-150, 2.0**600, 600 * math.log(2.0)


class Recursion(NamedTuple):
    """The choices that tell one multiple-model filter from another."""

    interaction: int = MIXING  # NO_INTERACTION | MIXING | INHERIT (the mode known before)
    weighting: int = LIKELIHOOD  # LIKELIHOOD | RESIDUAL_MEAN | COMMON_RESIDUAL_MEAN
    recursive_residual_error: bool = True  # RMIMM: carry the mean estimation error along
    residual_floor: float = 1.0  # RMIMM: smallest norm of a residual's mean, measurement units
    mode_probability_floor: float = 0.0  # Maybeck's lower bound on mode probabilities


# ---- the five steps --------------------------------------------------------------------------


@row_kernel
def predict_mode_probabilities(state, work, transition, only_origin, keeps_logarithm):
    """c_j = sum_i p_ij mu_i (Hwang 2006, eq. 6; row = from)."""
    n_modes = transition.shape[0]
    for j in range(n_modes):
        predicted = repeat(0.0)
        for i in range(n_modes):
            if transition[i, j] != 0.0:
                predicted += transition[i, j] * state.mode_probabilities[i]
        work.predicted_probability[j] = predicted
        origin = only_origin[j]
        if origin >= 0:
            if keeps_logarithm[origin]:
                logarithm = state.log_mode_probabilities[origin]
            else:
                logarithm = log(state.mode_probabilities[origin])
            work.log_predicted_probability[j] = logarithm + math.log(transition[origin, j])


@row_kernel
def mix(state, work, transition, interaction, errors, n_x):
    """Each mode's start of the cycle: the merged state of the modes it may come from.

    Where a mode cannot be reached (predicted probability 0) its state stays finite and its
    probability 0.
    """
    n_modes = transition.shape[0]
    for j in range(n_modes):
        first = j
        if interaction == INHERIT:
            first = 0
        elif interaction == MIXING:
            first = 0
            while first < n_modes - 1 and transition[first, j] == 0.0:
                first += 1
            if transition[first, j] == 0.0:
                first = j
        mean, covariance = state.mean[first], state.covariance[first]
        mixed_mean, mixed_covariance = work.mixed_mean[j], work.mixed_covariance[j]
        if errors:
            copy(work.mixed_error[j], state.residual_error[first], n_x)
        merged = False
        if interaction != NO_INTERACTION:
            factor = transition[first, j] if interaction == MIXING else 1.0
            total = factor * state.mode_probabilities[first]
            for i in range(first + 1, n_modes):
                factor = transition[i, j] if interaction == MIXING else 1.0
                if factor != 0.0:
                    weight = factor * state.mode_probabilities[i]
                    total = total + weight
                    share = select(total > 0.0, weight / total, 0.0)
                    merge(
                        mixed_mean,
                        mixed_covariance,
                        share,
                        mean,
                        covariance,
                        state.mean[i],
                        state.covariance[i],
                        work.row,
                        n_x,
                    )
                    if errors:
                        merge_means(work.mixed_error[j], share, state.residual_error[i], n_x)
                    mean, covariance = mixed_mean, mixed_covariance
                    merged = True
        if not merged:
            copy(mixed_mean, mean, n_x)
            copy(mixed_covariance, covariance, n_x * (n_x + 1) // 2)


@row_kernel
def predict(j, state, work, model, time, noise_time):
    """x <- F x + b, P <- F P F' + Q of mode j, from its mixed start."""
    input_effect = model.input_effect[time, j]
    apply(state.mean[j], model.state_map, time, j, work.mixed_mean[j], input_effect)
    Q = model.process_noise_covariance[noise_time, j]
    apply(state.covariance[j], model.covariance_map, time, j, work.mixed_covariance[j], Q)


@row_kernel
def weigh_modes(state, work, only_origin, keeps_logarithm, floor):
    """mu_j proportional to Lambda_j c_j (Hwang 2006, eq. 11), with no underflow."""
    n_modes = only_origin.shape[0]
    for j in range(n_modes):
        if only_origin[j] >= 0:
            logarithm = log(work.density[j]) + work.log_predicted_probability[j]
            work.exponent[j] = work.exponent[j] + logarithm
            work.density[j] = repeat(1.0)
        else:
            # What is tiny goes over to the exponent, lest it vanish where all the others do.
            predicted = work.predicted_probability[j]
            tiny = predicted < TINY
            work.density[j] = work.density[j] * select(tiny, predicted * RAISED, predicted)
            work.exponent[j] = work.exponent[j] - select(tiny, LOG_RAISED, 0.0)
    largest, total = normalise(state.mode_probabilities, work.density, work.exponent, n_modes)
    for j in range(n_modes):
        if only_origin[j] >= 0:
            state.log_mode_probabilities[j] = work.exponent[j] - (largest + log(total))
        elif keeps_logarithm[j]:
            state.log_mode_probabilities[j] = log(state.mode_probabilities[j])
    if floor > 0.0:
        total = repeat(0.0)
        for j in range(n_modes):
            state.mode_probabilities[j] = maximum(state.mode_probabilities[j], floor)
            total += state.mode_probabilities[j]
        for j in range(n_modes):
            state.mode_probabilities[j] = state.mode_probabilities[j] / total
            if keeps_logarithm[j]:
                state.log_mode_probabilities[j] = log(state.mode_probabilities[j])


@row_kernel
def know_modes(state, known, n_modes):
    """Mode probabilities of 1 and 0 for the mode that is known, lane by lane."""
    for j in range(n_modes):
        is_known = known == float(j)
        state.mode_probabilities[j] = select(is_known, 1.0, 0.0)
        state.log_mode_probabilities[j] = select(is_known, 0.0, -np.inf)


@row_kernel
def combine(state, mean, covariance, g, combined, n_modes):
    """The estimate: the mean (n_x, lanes) of the mixture, and its covariance if wanted."""
    n_x = mean.shape[0]
    for e in range(n_x):
        total = state.mode_probabilities[0] * state.mean[0, e]
        for i in range(1, n_modes):
            total += state.mode_probabilities[i] * state.mean[i, e]
        combined[e] = total
        store(mean[e], g, total)
    if covariance.shape[0]:
        t = 0
        for a in range(n_x):
            for c in range(a + 1):
                total = repeat(0.0)
                for i in range(n_modes):
                    spread = (state.mean[i, a] - combined[a]) * (state.mean[i, c] - combined[c])
                    total += state.mode_probabilities[i] * (state.covariance[i, t] + spread)
                store(covariance[t], g, total)
                t += 1


# ---- the cycle -------------------------------------------------------------------------------


@lane_kernel
def advance(bank_state, workspace, model, choices, measurements, known_modes, estimates):
    """Run the recursion over a span of scans; overwrites the state, workspace and estimates.

    measurements (n_steps, n_y, lanes), NaN where missed; known_modes (n_steps, lanes) or (0, 0).
    Two spans one after the other give the bytes of one.
    """
    interaction = choices.interaction
    residuals = choices.weighting != LIKELIHOOD
    errors = residuals and choices.recursive_residual_error
    common = choices.weighting == COMMON_RESIDUAL_MEAN
    n_modes, n_y, n_x = model.measurement_matrix.shape
    work = in_vectors(workspace)
    not_wanted = measurements[0, :0]
    for g in range(bank_state.mean.shape[0]):
        state = group_of(bank_state, g)
        for k in range(measurements.shape[0]):
            time = k if model.state_map.weight.shape[0] > 1 else 0
            noise_time = k if model.process_noise_covariance.shape[0] > 1 else 0
            transition = model.transition_matrix[k if model.transition_matrix.shape[0] > 1 else 0]
            seen = repeat(0.0) == 0.0
            for m in range(n_y):
                work.scan[m] = load(measurements[k, m], g)
                # A scan with a missing component is missing as a whole.
                seen = seen & (work.scan[m] == work.scan[m])

            only_origin = model.only_origin[k if model.only_origin.shape[0] > 1 else 0]
            keeps_logarithm = model.keeps_logarithm

            predict_mode_probabilities(state, work, transition, only_origin, keeps_logarithm)
            mix(state, work, transition, interaction, errors, n_x)
            for j in range(n_modes):
                predict(j, state, work, model, time, noise_time)
                if residuals:
                    predict_residual(j, state, work, model, time, errors)
                update(j, state, work, model, seen, errors)
            if residuals:
                divide_by_residual_mean(work, seen, common, choices.residual_floor, n_modes, n_y)
            if estimates.mode_likelihoods.shape[0]:
                normalise(work.weight, work.density, work.exponent, n_modes)
                for j in range(n_modes):
                    store(estimates.mode_likelihoods[k, j], g, work.weight[j])
            floor = choices.mode_probability_floor
            weigh_modes(state, work, only_origin, keeps_logarithm, floor)
            if interaction == INHERIT:
                know_modes(state, load(known_modes[k], g), n_modes)

            covariance = not_wanted
            if estimates.covariance.shape[0]:
                covariance = estimates.covariance[k]
            combine(state, estimates.mean[k], covariance, g, work.row, n_modes)
            for o in range(estimates.mode_probabilities.shape[1]):
                total = repeat(0.0)
                for j in range(n_modes):
                    if model.output_mode[j] == o:
                        total += state.mode_probabilities[j]
                store(estimates.mode_probabilities[k, o], g, total)
            if estimates.final_mode_probability.shape[0]:
                total = repeat(0.0)
                for j in range(n_modes):
                    total += model.final_probability[j] * state.mode_probabilities[j]
                store(estimates.final_mode_probability[k], g, total)
        for j in range(n_modes):  # for a next span, in which it may have an only origin
            if not model.keeps_logarithm[j]:
                state.log_mode_probabilities[j] = log(state.mode_probabilities[j])


@lane_kernel
def foresee(prior, scratch, model, out):
    """What the chain alone says of each step of a span: out (n_steps, 1), by no measurement.

    prior (n_modes,): the mode probabilities before the span, overwritten by those after it.
    """
    for k in range(out.shape[0]):
        transition = model.transition_matrix[k if model.transition_matrix.shape[0] > 1 else 0]
        total = 0.0
        for j in range(prior.size):
            scratch[j] = 0.0
            for i in range(prior.size):
                scratch[j] += transition[i, j] * prior[i]
            total += model.final_probability[j] * scratch[j]
        for j in range(prior.size):
            prior[j] = scratch[j]
        out[k, 0] = total


NO_KNOWN_MODES: Array = np.zeros((0, 0))


def run_span(
    state: BankState,
    workspace: Workspace,
    model: KernelModel,
    recursion: Recursion,
    measurements: Array,
    estimates: Estimates,
    known_modes: Array = NO_KNOWN_MODES,
) -> None:
    """`advance` with its arguments' types as Python sees them."""
    arguments: tuple[Any, ...] = (state, workspace, model, recursion, measurements, known_modes)
    if COMPILED:
        advance(*arguments, estimates)
    else:
        with np.errstate(all="ignore"):  # NumPy would warn of what the kernel deals with
            advance(*arguments, estimates)
