"""The Kalman update of one mode, as accurate as Joseph's form.

No update of a covariance keeps digits beyond those of the covariance itself: with P0/R near 1e16
and no process noise, small variances are all rounding after a scan or two. Two bounds that every
exact covariance meets keep rounding from turning variances negative there: S >= R, and
P_aa >= K_a R K_a.
"""

from hybridtrack.compiled import row_kernel
from hybridtrack.elementary import maximum
from hybridtrack.estimators._rows import packed, product
from hybridtrack.vectors import repeat, select, sqrt


@row_kernel
def update(j, state, work, model, seen, errors):
    """Kalman update of mode j by the scan, one decorrelated component at a time.

    The likelihood of the scan is left as density times e**exponent (without its constant; 1 where
    the scan is missing). With `errors` K rbar is taken off RMIMM's mean error too.
    """
    n_y, n_x = model.measurement_matrix.shape[1:]
    mean, covariance = state.mean[j], state.covariance[j]
    gain, row, taken = work.gain, work.row, work.taken  # taken: K rbar, component by component
    squared, precision = repeat(0.0), repeat(1.0)
    if errors:
        for e in range(n_x):
            taken[e] = repeat(0.0)
    for m in range(n_y):
        h, r = model.decorrelated_matrix[j, m], model.decorrelated_variance[j, m]
        p = model.component[j, m]
        if p >= 0:
            for a in range(n_x):
                row[a] = h[p] * covariance[packed(a, p)]
            expected, variance = h[p] * mean[p], h[p] * row[p]
        else:
            _products(row, covariance, h)
            expected, variance = product(h, mean), product(h, row)
        s = select(variance < 0.0, 0.0, variance) + r  # NaN stays NaN
        inverse = select(seen, 1.0 / s, 0.0)
        innovation = select(seen, product(model.decorrelation[j, m], work.scan) - expected, 0.0)
        squared += innovation * innovation * inverse
        precision *= select(seen, inverse, 1.0)
        for a in range(n_x):
            k = row[a] * inverse
            gain[a] = k
            mean[a] = mean[a] + k * innovation
        if p >= 0:
            _reduce_by_component(covariance, n_x, p, r, select(seen, r * inverse, 1.0), gain, row)
        else:
            _reduce_by_combination(covariance, n_x, h, r, gain, row)
        if errors:
            correction = product(model.decorrelation[j, m], work.residual_mean[j])
            correction -= product(h, taken)
            for e in range(n_x):
                taken[e] = taken[e] + gain[e] * correction
    work.density[j] = sqrt(precision)
    work.exponent[j] = -0.5 * squared
    if errors:
        for e in range(n_x):
            state.residual_error[j, e] = state.residual_error[j, e] - taken[e]


@row_kernel
def _products(row, covariance, h):
    """row <- P h"""
    for a in range(h.shape[0]):
        total = repeat(0.0)
        for e in range(h.shape[0]):
            if h[e] != 0.0:
                total += h[e] * covariance[packed(a, e)]
        row[a] = total


@row_kernel
def _reduce_by_component(covariance, n_x, p, r, kept, gain, row):
    """P <- P - K row' for a measurement of state p alone, and P_aa >= r K_a^2.

    The measured row of P is scaled by r/s instead of subtracted from: Joseph's digits there at
    half its cost; elsewhere his correction is no larger than the rounding of P itself.
    """
    t = 0
    for a in range(n_x):
        k = gain[a]
        for c in range(a):
            if a == p or c == p:
                covariance[t] = covariance[t] * kept
            else:
                covariance[t] = covariance[t] - k * row[c]
            t += 1
        variance = covariance[t] * kept if a == p else covariance[t] - k * row[a]
        covariance[t] = maximum(variance, r * k * k)
        t += 1


@row_kernel
def _reduce_by_combination(covariance, n_x, h, r, gain, row):
    """Joseph's form for one measurement h' x, and P_aa >= r K_a^2. Overwrites `row`.

    P <- A - u K' - K u' with A = P - K row' and u = (A h - r K)/2, which vanishes but for the
    rounding of A and takes it out again. Where the measurement is missing the gain is 0, and all
    of this with it.
    """
    _subtract_products(covariance, n_x, gain, row)
    _products(row, covariance, h)
    for a in range(n_x):
        row[a] = row[a] - r * gain[a]
    _subtract_products(covariance, n_x, gain, row)
    for a in range(n_x):
        t = packed(a, a)
        covariance[t] = maximum(covariance[t], r * gain[a] * gain[a])


@row_kernel
def _subtract_products(covariance, n_x, gain, row):
    """P <- P - (K row' + row K')/2"""
    t = 0
    for a in range(n_x):
        k, v = gain[a], row[a]
        for c in range(a + 1):
            covariance[t] = covariance[t] - 0.5 * (v * gain[c] + row[c] * k)
            t += 1
