"""How often the best test between two Gaussians errs: its bounds, and the exact figure.

Both are equally probable beforehand.
"""

import math
from typing import NamedTuple

import numpy as np

from hybridtrack.models import Array

INDISTINGUISHABLE = 1e-10  # Bhattacharyya distances below it are rounding
HUMP = 30.0  # times the integrand at the start of its path: how many digits may cancel
HALVINGS = 7  # of the integral's step


class Spectrum(NamedTuple):
    """Two Gaussians on axes where both are uncorrelated: N(0, 1) and N(shift, variance)."""

    variance: Array  # (rows,) the generalised eigenvalues of the two covariances
    shift: Array  # (rows,) the whitened difference of the means


def chernoff_distance(axes: Spectrum, s: float) -> float:
    """D(s) = -ln of the integral of p_one^s p_other^(1-s), 0 < s < 1, of two Gaussians.

    With l the variances, d the shifts and v = s l + 1 - s,
    D(s) = 1/2 sum[ln v - s ln l] + 1/2 s (1 - s) sum d^2 / v (Fukunaga 1990, section 3.4, on axes
    where both are uncorrelated).
    """
    l, d = axes  # noqa: E741
    v = s * l + (1.0 - s)
    # Where both are next to alike, ln v and s ln l are, and rounding is all that log would leave.
    close = np.abs(l - 1.0) < 0.5
    nearly = np.where(close, l - 1.0, 0.0)
    logs = np.where(
        close, np.log1p(s * nearly) - s * np.log1p(nearly), np.log(v) - s * np.log(l)
    ).sum()
    return 0.5 * float(logs) + 0.5 * s * (1.0 - s) * float((d**2 / v).sum())


def bhattacharyya_distance(axes: Spectrum) -> float:
    """D(1/2)."""
    return chernoff_distance(axes, 0.5)


def best_chernoff(axes: Spectrum) -> tuple[float, float]:
    """The largest D(s) and its s. D is concave: its slope is bisected."""
    l, d = axes  # noqa: E741
    logs = np.log(l)

    def slope(s: float) -> float:
        v = s * l + (1.0 - s)
        means = d**2 * ((1.0 - 2.0 * s) / v - s * (1.0 - s) * (l - 1.0) / v**2)
        return float(((l - 1.0) / v - logs + means).sum())

    low, high = 1e-9, 1.0 - 1e-9
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if slope(middle) > 0.0 else (low, middle)
    s = 0.5 * (low + high)
    return max(chernoff_distance(axes, s), bhattacharyya_distance(axes)), s


def lower_error(axes: Spectrum) -> float:
    """1/2 (1 - sqrt(1 - exp(-2 D(1/2)))): no test errs less often (Kailath 1967, eq. 48)."""
    distance = bhattacharyya_distance(axes)
    if distance < INDISTINGUISHABLE:
        return 0.5
    return -0.5 * math.expm1(0.5 * math.log1p(-math.exp(-2.0 * distance)))


def upper_error(axes: Spectrum) -> float:
    """1/2 exp(-max D(s)): the best test errs no more often (Chernoff 1952)."""
    return 0.5 * math.exp(-best_chernoff(axes)[0])


def error_probability(axes: Spectrum) -> float:
    """How often the best test between two equally probable modes errs, by numerical inversion.

    Gil-Pelaez 1951 on a path moved to where the integrand doesn't oscillate: with
    M(u) = exp(-D(u)), the moment generating function of the log-likelihood ratio,
    Pe = 1/(4 pi i) integral of M(u) / (u (1 - u)) along any line 0 < Re u < 1. Here it is a
    hyperbola through D's largest value that leans to the side where M dies out: all singularities
    lie on the real axis. It leans less where M has a hump on the way. The trapezoidal rule is
    halved until two agree to 1e-9; should no path get there (none is known), the answer is between
    the two bounds.
    """
    if bhattacharyya_distance(axes) < INDISTINGUISHABLE:
        return 0.5
    l, d = axes  # noqa: E741
    largest, s = best_chernoff(axes)
    if largest > 700.0:  # below what a float holds
        return 0.0
    v = s * l + (1.0 - s)
    curvature = 0.5 * float((((l - 1.0) / v) ** 2).sum()) + float((l / v * (d / v) ** 2).sum())
    width = 1.0 / math.sqrt(curvature + 1.0 / s**2 + 1.0 / (1.0 - s) ** 2)
    # Far away ln M is u times this: M dies out to the left where it is positive.
    bent = l != 1.0
    rate = 0.5 * float(np.log(l).sum() + (d[bent] ** 2 / (l[bent] - 1.0)).sum())
    for lean in (0.5, 0.2, 0.05, 0.0):
        total = _along(_Path(axes, s, width, -math.copysign(lean, rate), largest))
        if total is not None:
            # M is even in the imaginary part: twice the upper half.
            return min(math.exp(-largest) * total / (2.0 * math.pi), 0.5)
    return math.sqrt(lower_error(axes) * upper_error(axes))


class _Path(NamedTuple):
    """A hyperbola through s on the real axis, for an integral of M(u) / (u (1 - u))."""

    axes: Spectrum
    s: float
    width: float
    lean: float  # to the right, of its height
    largest: float  # D(s)

    def integrand(self, x: Array) -> Array:
        """Relative to M(s), at points (n,) >= 0 from s upwards; complex."""
        l, d = self.axes  # noqa: E741
        u = self.s + self.width * (self.lean * (np.cosh(x) - 1.0) + 1j * np.sinh(x))
        slope = self.width * (self.lean * np.sinh(x) + 1j * np.cosh(x))
        v = u[:, np.newaxis] * (l - 1.0) + 1.0
        log_m = 0.5 * (u * np.log(l).sum() - np.log(v).sum(axis=1))
        log_m -= 0.5 * u * (1.0 - u) * (d**2 / v).sum(axis=1)
        value: Array = np.exp(log_m + self.largest) * slope / (u * (1.0 - u))
        return value


def _along(path: _Path) -> float | None:
    """The imaginary part of the integral along a path; None where it can't be had to 1e-9.

    That is where M has grown on the way, so that large parts cancel, or the rule doesn't settle.
    """
    step = 0.25
    points = np.arange(0.0, 40.0, step)
    with np.errstate(all="ignore"):
        values = path.integrand(points)
        size = float(np.abs(values).max())
        if not size <= HUMP * abs(values[0]):
            return None
        total = float(values.imag.sum() - 0.5 * values[0].imag)
        for _ in range(HALVINGS):
            points = points + 0.5 * step if step == 0.25 else _between(points, step)
            more = total + float(path.integrand(points).imag.sum())
            step *= 0.5
            agreed = abs(0.5 * more - total) <= 1e-9 * abs(total)
            total = more
            if agreed:
                return step * total
    return None


def _between(points: Array, step: float) -> Array:
    """Halfway between all points so far, of which these are the last that were put between."""
    return np.concatenate([points - 0.5 * step, points + 0.5 * step])
