"""The Kalman update of one mode, lanes last, as accurate as Joseph's form.

No update of a covariance keeps digits beyond those of the covariance itself: with P0/R near 1e16
and no process noise, small variances are all rounding after a scan or two. Two bounds that every
exact covariance meets keep rounding from turning variances negative there: S >= R, and
P_aa >= K_a R K_a.
"""

import numpy as np

from hybridtrack.compiled import lane_kernel, log
from hybridtrack.estimators._lanes import add_scaled, apply, fill, packed, set_scaled


@lane_kernel
def _innovate(y, mean, coefficient, variance, position_variance, out, inverse, squared, scale):
    """Innovation of a scalar measurement; where it is missing, an update of no effect."""
    # One loop each: with many rows in one loop the compiler gives up proving them apart.
    for b in range(y.size):
        known = 0.0 if position_variance[b] < 0.0 else position_variance[b]  # NaN stays NaN
        s = coefficient * coefficient * known + variance
        inverse[b] = 1.0 / s if y[b] == y[b] else 0.0
    for b in range(y.size):
        known = 0.0 if position_variance[b] < 0.0 else position_variance[b]
        scale[b] *= coefficient * coefficient * known + variance if y[b] == y[b] else 1.0
    for b in range(y.size):
        out[b] = y[b] - coefficient * mean[b] if y[b] == y[b] else 0.0
    for b in range(y.size):
        squared[b] += out[b] * out[b] * inverse[b]


@lane_kernel
def _bound_variances(covariance, gains, variance):
    """P_aa >= r K_a^2, the share of the measurement's own noise in the estimate."""
    for a in range(gains.shape[0]):
        row = covariance[packed(a, a)]
        for b in range(row.size):
            least = variance * gains[a, b] * gains[a, b]
            row[b] = least if row[b] < least else row[b]


@lane_kernel
def _update_by_component(
    mean, covariance, component, coefficient, variance, y, squared, scale, work
):
    """Update by a scalar measurement coefficient x[component] + noise.

    The measured row of P is scaled by r/s instead of subtracted from: Joseph's digits there at
    half its cost; elsewhere his correction is no larger than the rounding of P itself.
    """
    n_x = mean.shape[0]
    innovation, inverse, kept = work.rows[3], work.rows[4], work.rows[5]
    gains, rows = work.states[1], work.states[2]
    p = component
    _innovate(
        y,
        mean[p],
        coefficient,
        variance,
        covariance[packed(p, p)],
        innovation,
        inverse,
        squared,
        scale,
    )
    for b in range(innovation.size):
        kept[b] = variance * inverse[b] if inverse[b] != 0.0 else 1.0
    for e in range(n_x):
        measured, row, gain = covariance[packed(e, p)], rows[e], gains[e]
        for b in range(innovation.size):
            row[b] = coefficient * measured[b]
            measured[b] *= kept[b]
        for b in range(innovation.size):
            gain[b] = row[b] * inverse[b]
            mean[e, b] += row[b] * inverse[b] * innovation[b]
    for a in range(n_x):
        for c in range(a + 1):
            if a != p and c != p:
                out, gain, row = covariance[packed(a, c)], gains[a], rows[c]
                for b in range(innovation.size):
                    out[b] -= gain[b] * row[b]
    _bound_variances(covariance, gains, variance)


@lane_kernel
def _update_by_combination(mean, covariance, h, variance, y, squared, scale, work):
    """Update by a scalar measurement h' x + noise: Joseph's form for one measurement.

    P <- A - u K' - K u' with A = P - v K', v = P h and u = (A h - r K)/2, which vanishes but
    for the rounding of A and takes it out again.
    """
    n_x = mean.shape[0]
    innovation, inverse = work.rows[3], work.rows[4]
    expected, expected_variance = work.rows[5], work.rows[6]
    gains, products = work.states[1], work.states[2]
    apply(expected, h, mean, 0.0)
    fill(expected_variance, 0.0)
    for a in range(n_x):
        fill(products[a], 0.0)
        for e in range(n_x):
            if h[e] != 0.0:
                add_scaled(products[a], h[e], covariance[packed(a, e)])
    apply(expected_variance, h, products, 0.0)
    _innovate(y, expected, 1.0, variance, expected_variance, innovation, inverse, squared, scale)
    for a in range(n_x):
        for b in range(innovation.size):
            gains[a, b] = products[a, b] * inverse[b]
            mean[a, b] += gains[a, b] * innovation[b]
    for a in range(n_x):
        for c in range(a + 1):
            out = covariance[packed(a, c)]
            for b in range(innovation.size):
                out[b] -= 0.5 * (products[a, b] * gains[c, b] + products[c, b] * gains[a, b])
    for a in range(n_x):
        set_scaled(products[a], -variance, gains[a])
        for e in range(n_x):
            if h[e] != 0.0:
                add_scaled(products[a], h[e], covariance[packed(a, e)])
    for a in range(n_x):
        for c in range(a + 1):
            out = covariance[packed(a, c)]
            for b in range(innovation.size):
                correction = products[a, b] * gains[c, b] + products[c, b] * gains[a, b]
                # Where the measurement is missing the gain is 0, and the correction with it.
                out[b] -= 0.5 * correction
    _bound_variances(covariance, gains, variance)


@lane_kernel
def update(j, state, work, model, y, errors):
    """Kalman update of mode j by the scan y (n_y, lanes), one decorrelated component at a time.

    Leaves the log-likelihood (without its constant; 0 where the scan is missing) in
    work.log_likelihood[j]; with `errors` also takes K rbar off RMIMM's mean error.
    """
    n_y, n_x = model.measurement_matrix.shape[1:]
    mean, covariance = state.mean[j], state.covariance[j]
    squared, scale, measured, correction = work.rows[7], work.rows[8], work.rows[9], work.rows[10]
    taken = work.states[0]  # K rbar, built up component by component
    fill(squared, 0.0)
    fill(scale, 1.0)
    if errors:
        for e in range(n_x):
            fill(taken[e], 0.0)
    for m in range(n_y):
        apply(measured, model.decorrelation[j, m], y, 0.0)
        # A scan with a missing component is missing as a whole.
        for other in range(n_y):
            if other != m:
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
            apply(correction, model.decorrelation[j, m], work.residual_mean[j], 0.0)
            for e in range(n_x):
                if h[e] != 0.0:
                    add_scaled(correction, -h[e], taken[e])
            for e in range(n_x):
                for b in range(correction.size):
                    taken[e, b] += gains[e, b] * correction[b]
    log_likelihood = work.log_likelihood[j]
    for b in range(squared.size):
        log_likelihood[b] = -0.5 * (squared[b] + log(scale[b]))
    if errors:
        for e in range(n_x):
            add_scaled(state.residual_error[j, e], -1.0, taken[e])
