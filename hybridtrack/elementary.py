"""Elementary functions of vectors of lanes: branch-free, where the C library's take one float."""

import numpy as np

from hybridtrack.compiled import exact_row_kernel, row_kernel
from hybridtrack.vectors import exponent, mantissa, rint, select, two_to

LOG2_E = 1.4426950408889634
LN2_HIGH = 0.693147180369123816490  # the upper 32 bits of ln 2, and the rest (fdlibm)
LN2_LOW = 1.90821492927058770002e-10


@row_kernel
def maximum(x, y):
    """The larger of two; x where either is NaN."""
    return select(x < y, y, x)


@exact_row_kernel
def exp(x):
    """e**x for x up to 700; below -708, where subnormals begin, 0.

    Cody-Waite reduction to |r| <= ln(2)/2 and the Taylor polynomial of degree 13, whose remainder
    there is below 1e-17.
    """
    y = select(x <= -708.0, -708.0, x)  # NaN stays NaN
    n = rint(y * LOG2_E)
    r = (y - n * LN2_HIGH) - n * LN2_LOW
    p = r * (1.0 / 6227020800.0) + 1.0 / 479001600.0
    p = p * r + 1.0 / 39916800.0
    p = p * r + 1.0 / 3628800.0
    p = p * r + 1.0 / 362880.0
    p = p * r + 1.0 / 40320.0
    p = p * r + 1.0 / 5040.0
    p = p * r + 1.0 / 720.0
    p = p * r + 1.0 / 120.0
    p = p * r + 1.0 / 24.0
    p = p * r + 1.0 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    return select(x <= -708.0, 0.0, p * two_to(n))


@exact_row_kernel
def log(x):
    """Natural logarithm for finite x >= 0 (log 0 = -inf), to about one unit in the last place.

    log(m) = 2 atanh((m - 1)/(m + 1)) for the mantissa in [sqrt(1/2), sqrt(2)); the series'
    remainder after eleven terms is below 1e-17.
    """
    tiny = x < 2.2250738585072014e-308
    y = select(tiny, x * 18014398509481984.0, x)  # 2**54 brings subnormals up
    n = exponent(y) - select(tiny, 54.0, 0.0)
    m = mantissa(y)
    f = (m - 1.0) / (m + 1.0)
    g = f * f
    p = g * (1.0 / 21.0) + 1.0 / 19.0
    p = p * g + 1.0 / 17.0
    p = p * g + 1.0 / 15.0
    p = p * g + 1.0 / 13.0
    p = p * g + 1.0 / 11.0
    p = p * g + 1.0 / 9.0
    p = p * g + 1.0 / 7.0
    p = p * g + 1.0 / 5.0
    p = p * g + 1.0 / 3.0
    value = n * LN2_HIGH + (n * LN2_LOW + 2.0 * (f * g * p + f))
    return select(x > 0.0, value, select(x == 0.0, -np.inf, np.nan))
