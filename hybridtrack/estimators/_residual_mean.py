"""What the RMIMM adds to a cycle: the residuals' means and the factor made of them."""

from hybridtrack.compiled import row_kernel
from hybridtrack.elementary import maximum
from hybridtrack.estimators._rows import apply, product
from hybridtrack.vectors import repeat, select, sqrt


@row_kernel
def predict_residual(j, state, work, model, time, errors):
    """RMIMM's mean residual of filter j (Hwang 2006, eq. 28), the true mode marginalised.

    rbar_j = sum_i w_i C_i (A_i y_j + b_i) - C_j (A_j x0_j + b_j) with w the predicted mode
    probabilities and y_j = x0_j + ebar0_j; the predicted mean error likewise without C, left in
    state.residual_error[j]; without `errors` ebar0 is 0. Must follow `predict`.
    """
    n_modes, n_y, n_x = model.measurement_matrix.shape
    corrected, moved = work.row, work.gain
    residual, error = work.residual_mean[j], state.residual_error[j]
    for e in range(n_x):
        corrected[e] = work.mixed_mean[j, e]
        if errors:
            corrected[e] = corrected[e] + work.mixed_error[j, e]
        error[e] = -state.mean[j, e]
    for m in range(n_y):
        residual[m] = -product(model.measurement_matrix[j, m], state.mean[j])
    for i in range(n_modes):
        weight = work.predicted_probability[i]
        apply(moved, model.state_map, time, i, corrected, model.input_effect[time, i])
        for e in range(n_x):
            error[e] = error[e] + weight * moved[e]
        for m in range(n_y):
            residual[m] = residual[m] + weight * product(model.measurement_matrix[i, m], moved)


@row_kernel
def divide_by_residual_mean(work, seen, common, floor, n_modes, n_y):
    """RMIMM's factor N_j = 1/max(||rbar_j||, floor) on each likelihood (Hwang 2006, eq. 29).

    `common` is the formula as printed, summed over the filters: the same for all of them.
    """
    if common:
        for m in range(n_y):
            total = repeat(0.0)
            for j in range(n_modes):
                total += work.predicted_probability[j] * work.residual_mean[j, m]
            for j in range(n_modes):
                work.residual_mean[j, m] = total
    for j in range(n_modes):
        squared = repeat(0.0)
        for m in range(n_y):
            squared += work.residual_mean[j, m] * work.residual_mean[j, m]
        norm = maximum(sqrt(squared), floor)
        work.density[j] = work.density[j] / select(seen, norm, 1.0)
