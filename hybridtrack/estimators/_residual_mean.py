"""What the RMIMM adds to a cycle: the residuals' means and the factor made of them."""

import numpy as np

from hybridtrack.compiled import lane_kernel, log
from hybridtrack.estimators._lanes import apply, copy, fill, set_scaled


@lane_kernel
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
        set_scaled(error[e], -1.0, state.mean[j, e])
    for m in range(n_y):
        apply(row, model.measurement_matrix[j, m], state.mean[j], 0.0)
        set_scaled(residual[m], -1.0, row)
    for i in range(n_modes):
        weight = work.predicted_probability[i]
        for e in range(n_x):
            apply(moved[e], state_transition[i, e], corrected, input_effect[i, e])
            for b in range(row.size):
                error[e, b] += weight[b] * moved[e, b]
        for m in range(n_y):
            apply(row, model.measurement_matrix[i, m], moved, 0.0)
            for b in range(row.size):
                residual[m, b] += weight[b] * row[b]


@lane_kernel
def divide_by_residual_mean(work, y, common, floor):
    """RMIMM's factor N_j = 1/max(||rbar_j||, floor) on each likelihood (Hwang 2006, eq. 29).

    `common` is the formula as printed, summed over the filters: the same for all of them.
    """
    n_modes, n_y = work.residual_mean.shape[:2]
    norm = work.rows[2]
    if common:
        for m in range(n_y):
            fill(norm, 0.0)
            for j in range(n_modes):
                for b in range(norm.size):
                    norm[b] += work.predicted_probability[j, b] * work.residual_mean[j, m, b]
            for j in range(n_modes):
                copy(work.residual_mean[j, m], norm)
    for j in range(n_modes):
        fill(norm, 0.0)
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
