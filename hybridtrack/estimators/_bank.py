"""The one compiled recursion of every multiple-model filter, lanes last.

A lane is a run: all arrays end in the axis of runs, every inner loop goes over it in contiguous
memory, and the compiler turns it into vector instructions. A cycle has the IMM's five steps
(Blom and Bar-Shalom 1988; Hwang, Balakrishnan, Tomlin 2006, section 3), each a function below:

    predict_mode_probabilities -> mix -> predict -> update -> weigh_modes (-> combine)

The covariances are packed lower triangles: element (a, c), a >= c, stands at a (a + 1)/2 + c.
Mode probabilities are kept as logarithms too, so that the evidence against a mode may exceed the
range of a float without being forgotten: a static bank can still come back from e**-2000.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.compiled import exp, kernel, log
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


# ---- rows of lanes ---------------------------------------------------------------------------


@kernel
def _scale(out, factor, row):
    for b in range(out.size):
        out[b] = factor * row[b]


@kernel
def _add_scaled(out, factor, row):
    for b in range(out.size):
        out[b] += factor * row[b]


@kernel
def _copy(out, row):
    for b in range(out.size):
        out[b] = row[b]


@kernel
def _fill(out, value):
    for b in range(out.size):
        out[b] = value


@kernel
def _apply(out, matrix_row, vector, offset):
    """out <- matrix_row . vector + offset; structural zeros are skipped."""
    _fill(out, offset)
    for e in range(matrix_row.size):
        if matrix_row[e] != 0.0:
            _add_scaled(out, matrix_row[e], vector[e])


@kernel
def _packed(a, c):
    return a * (a + 1) // 2 + c if a >= c else c * (c + 1) // 2 + a


# ---- Gaussians merged one at a time ----------------------------------------------------------


@kernel
def _merge_share(total, share, factor, row):
    """share <- factor row / (total + factor row), 0 where both are 0; total grows by it."""
    for b in range(total.size):
        weight = factor * row[b]
        total[b] += weight
        share[b] = weight / total[b] if total[b] > 0.0 else 0.0


@kernel
def _merge_mean(mean, difference, share, other):
    for b in range(mean.size):
        difference[b] = other[b] - mean[b]
        mean[b] += share[b] * difference[b]


@kernel
def _merge_second_moment(out, other, share, difference_a, difference_c):
    for b in range(out.size):
        s = share[b]
        rest = 1.0 - s
        out[b] = rest * (out[b] + s * (difference_a[b] * difference_c[b])) + s * other[b]


@kernel
def _merge(mean, covariance, share, other_mean, other_covariance, difference):
    """Merge a second Gaussian into the first, with the given share of the sum of weights.

    P <- (1 - s) P + s P' + s (1 - s) d d', d the difference of the means: positive semidefinite
    in rounding too, since nothing is subtracted.
    """
    n_x = mean.shape[0]
    for e in range(n_x):
        _merge_mean(mean[e], difference[e], share, other_mean[e])
    t = 0
    for a in range(n_x):
        for c in range(a + 1):
            _merge_second_moment(
                covariance[t], other_covariance[t], share, difference[a], difference[c]
            )
            t += 1


# ---- the five steps --------------------------------------------------------------------------


@kernel
def predict_mode_probabilities(state, work, transition):
    """c_j = sum_i p_ij mu_i (Hwang 2006, eq. 6; row = from), and its logarithm.

    A mode with a single origin (identity matrices, absorbing modes) keeps its logarithm exact.
    """
    n_modes = transition.shape[0]
    for j in range(n_modes):
        predicted = work.predicted_probability[j]
        log_predicted = work.log_predicted_probability[j]
        _fill(predicted, 0.0)
        origins = 0
        origin = 0
        for i in range(n_modes):
            if transition[i, j] != 0.0:
                _add_scaled(predicted, transition[i, j], state.mode_probabilities[i])
                origins += 1
                origin = i
        if origins == 1:
            log_transition = log(transition[origin, j])
            for b in range(predicted.size):
                log_predicted[b] = log_transition + state.log_mode_probabilities[origin, b]
        else:
            for b in range(predicted.size):
                log_predicted[b] = log(predicted[b])


@kernel
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
        mean[:] = state.mean[first]
        covariance[:] = state.covariance[first]
        if errors:
            work.mixed_error[j, :] = state.residual_error[first]
        if interaction == NO_INTERACTION:
            continue
        _scale(
            total,
            transition[first, j] if interaction == MIXING else 1.0,
            state.mode_probabilities[first],
        )
        for i in range(first + 1, n_modes):
            factor = transition[i, j] if interaction == MIXING else 1.0
            if factor == 0.0:
                continue
            _merge_share(total, share, factor, state.mode_probabilities[i])
            _merge(mean, covariance, share, state.mean[i], state.covariance[i], work.states[0])
            if errors:
                for e in range(n_x):
                    _merge_mean(
                        work.mixed_error[j, e], work.rows[2], share, state.residual_error[i, e]
                    )


@kernel
def predict(j, state, work, state_transition, input_effect, process_noise):
    """x <- F x + b, P <- F P F' + Q of mode j, from its mixed start."""
    n_x = state.mean.shape[1]
    mixed_covariance = work.mixed_covariance[j]
    rows = work.states[0]
    for a in range(n_x):
        _apply(state.mean[j, a], state_transition[a], work.mixed_mean[j], input_effect[a])
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
                        source = mixed_covariance[_packed(e, g)]
                        if first:
                            _scale(rows[g], factor, source)
                        else:
                            _add_scaled(rows[g], factor, source)
                        first = False
                if first:
                    _fill(rows[g], 0.0)
        for c in range(a + 1):
            t = _packed(a, c)
            _apply(state.covariance[j, t], state_transition[c], rows, process_noise[t])


@kernel
def predict_residual(j, state, work, model, state_transition, input_effect):
    """RMIMM's mean residual of filter j (Hwang 2006, eq. 28), the true mode marginalised.

    rbar_j = sum_i w_i C_i (A_i y_j + b_i) - C_j (A_j x0_j + b_j) with w the predicted mode
    probabilities and y_j = x0_j + ebar0_j; the predicted mean error likewise without C, left in
    state.residual_error[j]. Must follow `predict`.
    """
    n_modes, n_x = state.mean.shape[:2]
    n_y = model.measurement_matrix.shape[1]
    corrected, moved = work.states[1], work.states[2]
    row = work.rows[2]
    residual = work.residual_mean[j]
    error = state.residual_error[j]
    for e in range(n_x):
        for b in range(row.size):
            corrected[e, b] = work.mixed_mean[j, e, b] + work.mixed_error[j, e, b]
        _scale(error[e], -1.0, state.mean[j, e])
    for m in range(n_y):
        _apply(row, model.measurement_matrix[j, m], state.mean[j], 0.0)
        _scale(residual[m], -1.0, row)
    for i in range(n_modes):
        weight = work.predicted_probability[i]
        for e in range(n_x):
            _apply(moved[e], state_transition[i, e], corrected, input_effect[i, e])
            for b in range(row.size):
                error[e, b] += weight[b] * moved[e, b]
        for m in range(n_y):
            _apply(row, model.measurement_matrix[i, m], moved, 0.0)
            for b in range(row.size):
                residual[m, b] += weight[b] * row[b]


@kernel
def _innovate(y, mean, coefficient, variance, position_variance, out, inverse, squared, scale):
    """Innovation of a scalar measurement; where it is missing, an update of no effect."""
    for b in range(y.size):
        detected = y[b] == y[b]
        s = coefficient * coefficient * position_variance[b] + variance
        innovation = y[b] - coefficient * mean[b] if detected else 0.0
        inverse[b] = 1.0 / s if detected else 0.0
        out[b] = innovation
        squared[b] += innovation * innovation * inverse[b]
        scale[b] *= s if detected else 1.0


@kernel
def _update_by_component(
    mean, covariance, component, coefficient, variance, y, squared, scale, work
):
    """Update by a scalar measurement coefficient x[component] + noise.

    The measured row of P is scaled by r/s instead of subtracted from, which keeps every digit
    that Joseph's form keeps, at half its cost.
    """
    n_x = mean.shape[0]
    innovation, inverse, gain = work.rows[3], work.rows[4], work.rows[5]
    rows = work.states[1]
    p = component
    _innovate(
        y,
        mean[p],
        coefficient,
        variance,
        covariance[_packed(p, p)],
        innovation,
        inverse,
        squared,
        scale,
    )
    for e in range(n_x):
        source = covariance[_packed(e, p)]
        row = rows[e]
        for b in range(innovation.size):
            row[b] = coefficient * source[b]
            mean[e, b] += row[b] * inverse[b] * innovation[b]
    for a in range(n_x):
        if a == p:
            continue
        for b in range(innovation.size):
            gain[b] = rows[a, b] * inverse[b]
        for c in range(a + 1):
            if c != p:
                out, other = covariance[_packed(a, c)], rows[c]
                for b in range(innovation.size):
                    out[b] -= gain[b] * other[b]
    for b in range(innovation.size):
        gain[b] = variance * inverse[b] if inverse[b] != 0.0 else 1.0
    for e in range(n_x):
        out = covariance[_packed(e, p)]
        for b in range(innovation.size):
            out[b] *= gain[b]
    for e in range(n_x):  # the rows become the gain, for whoever needs it afterwards
        for b in range(innovation.size):
            rows[e, b] *= inverse[b]


@kernel
def _update_by_combination(mean, covariance, h, variance, y, squared, scale, work):
    """Update by a scalar measurement h' x + noise: Joseph's form for one measurement.

    P <- A - u K' - K u' with A = P - v K', v = P h and u = (A h - r K)/2, which vanishes but
    for the rounding of A and takes it out again.
    """
    n_x = mean.shape[0]
    innovation, inverse = work.rows[3], work.rows[4]
    expected, expected_variance = work.rows[5], work.rows[6]
    gains, products = work.states[1], work.states[2]
    _apply(expected, h, mean, 0.0)
    _fill(expected_variance, 0.0)
    for a in range(n_x):
        _fill(products[a], 0.0)
        for e in range(n_x):
            if h[e] != 0.0:
                _add_scaled(products[a], h[e], covariance[_packed(a, e)])
    _apply(expected_variance, h, products, 0.0)
    _innovate(y, expected, 1.0, variance, expected_variance, innovation, inverse, squared, scale)
    for a in range(n_x):
        for b in range(innovation.size):
            gains[a, b] = products[a, b] * inverse[b]
            mean[a, b] += gains[a, b] * innovation[b]
    for a in range(n_x):
        for c in range(a + 1):
            out = covariance[_packed(a, c)]
            for b in range(innovation.size):
                out[b] -= 0.5 * (products[a, b] * gains[c, b] + products[c, b] * gains[a, b])
    for a in range(n_x):
        _scale(products[a], -variance, gains[a])
        for e in range(n_x):
            if h[e] != 0.0:
                _add_scaled(products[a], h[e], covariance[_packed(a, e)])
    for a in range(n_x):
        for c in range(a + 1):
            out = covariance[_packed(a, c)]
            for b in range(innovation.size):
                correction = products[a, b] * gains[c, b] + products[c, b] * gains[a, b]
                # Where the measurement is missing the gain is 0, and the correction with it.
                out[b] -= 0.5 * correction


@kernel
def update(j, state, work, model, y, errors):
    """Kalman update of mode j by the scan y (n_y, lanes), one decorrelated component at a time.

    Leaves the log-likelihood (without its constant; 0 where the scan is missing) in
    work.log_likelihood[j]; with `errors` also takes K rbar off RMIMM's mean error.
    """
    n_y, n_x = model.measurement_matrix.shape[1:]
    mean, covariance = state.mean[j], state.covariance[j]
    squared, scale, measured, correction = work.rows[7], work.rows[8], work.rows[9], work.rows[10]
    taken = work.states[0]  # K rbar, built up component by component
    _fill(squared, 0.0)
    _fill(scale, 1.0)
    if errors:
        for e in range(n_x):
            _fill(taken[e], 0.0)
    for m in range(n_y):
        _apply(measured, model.decorrelation[j, m], y, 0.0)
        # A scan with a missing component is missing as a whole.
        for other in range(n_y):
            for b in range(measured.size):
                measured[b] = measured[b] if y[other, b] == y[other, b] else np.nan
        h, variance = model.decorrelated_matrix[j, m], model.decorrelated_variance[j, m]
        components = 0
        component = 0
        for e in range(n_x):
            if h[e] != 0.0:
                components += 1
                component = e
        if components == 1:
            _update_by_component(
                mean, covariance, component, h[component], variance, measured, squared, scale, work
            )
        else:
            _update_by_combination(mean, covariance, h, variance, measured, squared, scale, work)
        if errors:
            gains = work.states[1]
            _apply(correction, model.decorrelation[j, m], work.residual_mean[j], 0.0)
            for e in range(n_x):
                if h[e] != 0.0:
                    _add_scaled(correction, -h[e], taken[e])
            for e in range(n_x):
                for b in range(correction.size):
                    taken[e, b] += gains[e, b] * correction[b]
    log_likelihood = work.log_likelihood[j]
    for b in range(squared.size):
        log_likelihood[b] = -0.5 * (squared[b] + log(scale[b]))
    if errors:
        for e in range(n_x):
            _add_scaled(state.residual_error[j, e], -1.0, taken[e])


@kernel
def divide_by_residual_mean(work, y, common, floor):
    """RMIMM's factor N_j = 1/max(||rbar_j||, floor) on each likelihood (Hwang 2006, eq. 29).

    `common` is the formula as printed, summed over the filters: the same for all of them.
    """
    n_modes, n_y = work.residual_mean.shape[:2]
    norm = work.rows[2]
    if common:
        for m in range(n_y):
            _fill(norm, 0.0)
            for j in range(n_modes):
                for b in range(norm.size):
                    norm[b] += work.predicted_probability[j, b] * work.residual_mean[j, m, b]
            for j in range(n_modes):
                _copy(work.residual_mean[j, m], norm)
    for j in range(n_modes):
        _fill(norm, 0.0)
        for m in range(n_y):
            for b in range(norm.size):
                norm[b] += work.residual_mean[j, m, b] * work.residual_mean[j, m, b]
        for b in range(norm.size):
            size = np.sqrt(norm[b])
            size = floor if size < floor else size
            for m in range(n_y):
                size = size if y[m, b] == y[m, b] else 1.0
            norm[b] = size
        for b in range(norm.size):
            work.log_likelihood[j, b] -= log(norm[b])


@kernel
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
        _add_scaled(state.log_mode_probabilities[j], -1.0, largest)
    if floor > 0.0:
        _fill(total, 0.0)
        for j in range(n_modes):
            for b in range(total.size):
                raised = max(state.mode_probabilities[j, b], floor)
                state.mode_probabilities[j, b] = raised
                total[b] += raised
        for j in range(n_modes):
            for b in range(total.size):
                state.mode_probabilities[j, b] /= total[b]
                state.log_mode_probabilities[j, b] = log(state.mode_probabilities[j, b])


@kernel
def _normalise(out, logarithms, largest, total):
    """out_j <- exp(l_j)/sum_i exp(l_i); leaves max l and sum exp(l - max l) in the last two."""
    n_modes = logarithms.shape[0]
    _copy(largest, logarithms[0])
    for j in range(1, n_modes):
        for b in range(largest.size):
            largest[b] = logarithms[j, b] if logarithms[j, b] > largest[b] else largest[b]
    _fill(total, 0.0)
    for j in range(n_modes):
        for b in range(largest.size):
            value = exp(logarithms[j, b] - largest[b])
            out[j, b] = value
            total[b] += value
    for j in range(n_modes):
        for b in range(largest.size):
            out[j, b] /= total[b]


@kernel
def know_modes(state, known):
    """Mode probabilities of 1 and 0 for the mode that is known, lane by lane."""
    for j in range(state.mode_probabilities.shape[0]):
        for b in range(known.size):
            state.mode_probabilities[j, b] = 1.0 if known[b] == j else 0.0
            state.log_mode_probabilities[j, b] = 0.0 if known[b] == j else -np.inf


@kernel
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
                _fill(covariance[t], 0.0)
                for i in range(n_modes):
                    for b in range(mean.shape[1]):
                        covariance[t, b] += state.mode_probabilities[i, b] * (
                            state.covariance[i, t, b]
                            + (state.mean[i, a, b] - mean[a, b])
                            * (state.mean[i, c, b] - mean[c, b])
                        )
                t += 1


@kernel
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
            _fill(probabilities[o], 0.0)
        for j in range(n_modes):
            _add_scaled(probabilities[model.output_mode[j]], 1.0, state.mode_probabilities[j])


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
    return BankState(
        mean=np.repeat(initial_mean[np.newaxis], n_modes, axis=0),
        covariance=np.tile(packed[np.newaxis, :, np.newaxis], (n_modes, 1, lanes)),
        mode_probabilities=probabilities,
        log_mode_probabilities=logarithms,
        residual_error=np.zeros((n_modes, n_x, lanes)),
    )


def workspace(model: JumpMarkovModel, lanes: int) -> Workspace:
    """Scratch memory for one block of `lanes` runs."""
    n_modes, n_y, n_x = model.measurement_matrix.shape
    n_packed = n_x * (n_x + 1) // 2
    return Workspace(
        mixed_mean=np.zeros((n_modes, n_x, lanes)),
        mixed_covariance=np.zeros((n_modes, n_packed, lanes)),
        mixed_error=np.zeros((n_modes, n_x, lanes)),
        residual_mean=np.zeros((n_modes, n_y, lanes)),
        predicted_probability=np.zeros((n_modes, lanes)),
        log_predicted_probability=np.zeros((n_modes, lanes)),
        log_likelihood=np.zeros((n_modes, lanes)),
        states=np.zeros((3, n_x, lanes)),
        rows=np.zeros((12, lanes)),
    )


def empty_estimates(
    model: JumpMarkovModel, steps: int, lanes: int, *, likelihoods: bool, covariance: bool
) -> Estimates:
    """Room for the estimates of a span."""
    n_x = len(model.state_names)
    n_modes = len(output_modes(model))
    likelihoods = likelihoods and n_modes == len(model.mode_names)
    return Estimates(
        mean=np.empty((steps, n_x, lanes)),
        mode_probabilities=np.empty((steps, n_modes, lanes)),
        mode_likelihoods=np.empty((steps if likelihoods else 0, n_modes, lanes)),
        covariance=np.empty((steps if covariance else 0, n_x * (n_x + 1) // 2, lanes)),
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
