"""Slow, obvious oracles of the set-membership filter: one run at a time, as it is written down.

No code is shared with the package: remainders by a fine scan, fusion as Otanez 2004 prints it, in
as many digits as are asked for.
"""

import math

import mpmath
import numpy as np

T, V1, W1 = 0.01, 10.0, 0.5
C = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def f(x):
    """The relative motion of two aircraft, Otanez 2004, eqs. 34-36, v0 = w0 = 0."""
    return np.array([x[0] + T * V1 * math.cos(x[2]), x[1] + T * V1 * math.sin(x[2]), x[2] + T * W1])


def jacobian(x):
    s, c = math.sin(x[2]), math.cos(x[2])
    return np.array([[1.0, 0.0, -T * V1 * s], [0.0, 1.0, T * V1 * c], [0.0, 0.0, 1.0]])


def scanned_remainder(at, low, high, points=200_001):
    """Least and most of f(x) - f(at) - J(at) (x - at) for headings from low to high, by a scan."""
    psi = np.linspace(low, high, points)
    d = psi - at
    first = T * V1 * (np.cos(psi) - math.cos(at) + math.sin(at) * d)
    second = T * V1 * (np.sin(psi) - math.sin(at) - math.cos(at) * d)
    return (
        np.array([first.min(), second.min(), 0.0]),
        np.array([first.max(), second.max(), 0.0]),
    )


def sum_of_two(first, second):
    """The ellipsoid of the smallest trace around a sum, both of some size."""
    one, two = math.sqrt(np.trace(first)), math.sqrt(np.trace(second))
    beta = two / (one + two)
    return first / (1 - beta) + second / beta


def printed_fusion(centre, P, y, C, R, rho, digits=60):
    """Otanez 2004, eqs. 3-6 to the letter, in so many digits: centre, Sigma, delta."""
    with mpmath.workdps(digits):
        m = mpmath.matrix
        centre, P, y, C, R = (m(np.asarray(part).tolist()) for part in (centre, P, y, C, R))
        rho = mpmath.mpf(rho)
        P = P / (1 - rho)
        inverse = (C * P * C.T + R / rho) ** -1
        innovation = y - C * centre
        fused = P - P * C.T * inverse * C * P
        delta = (innovation.T * inverse * innovation)[0]
        moved = centre + P * C.T * inverse * innovation
        shape = (1 - delta) * fused
        return (
            np.array([float(v) for v in moved]),
            np.array([[float(shape[i, j]) for j in range(P.cols)] for i in range(P.rows)]),
            float(delta),
        )


def plain_filter(y, Q, R, centre, shape, rho=0.05, at=None):
    """The filter over measurements (n_steps, 2); `at`: an operating point, else its own centre."""
    centres, shapes = [], []
    for scan in y:
        point = centre if at is None else at
        reach = math.sqrt(shape[2, 2])
        low, high = scanned_remainder(
            point[2], min(centre[2] - reach, point[2]), max(centre[2] + reach, point[2])
        )
        middle, radius = (low + high) / 2, (high - low) / 2
        around = np.diag(radius * radius.sum())
        A = jacobian(point)
        predicted = f(point) + A @ (centre - point) + middle
        P = sum_of_two(A @ shape @ A.T, sum_of_two(around, Q))
        centre, shape, _ = printed_fusion(predicted, P, scan, C, R, rho, digits=30)
        centres.append(centre)
        shapes.append(shape)
    return np.array(centres), np.array(shapes)
