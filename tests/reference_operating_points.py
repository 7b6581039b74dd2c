"""Slow and obvious references for operating points: two aircraft by hand, grids, plain iterations.

They share no code with the package. Otanez, Campbell 2004, section IV: T v1 = .1 m, psi in
[0, pi/2], C = [I 0], Q = .01^2 I, R = .09^2 I.
"""

import itertools

import numpy as np
from scipy.optimize import minimize_scalar

REACH = 0.1  # T v1
LOW, HIGH = 0.0, np.pi / 2
C = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
Q = 0.01**2 * np.eye(3)
R = 0.09**2 * np.eye(2)


def jacobian(psi):
    """A of (34)-(36) at a heading."""
    return np.array(
        [[1.0, 0.0, -REACH * np.sin(psi)], [0.0, 1.0, REACH * np.cos(psi)], [0.0, 0.0, 1.0]]
    )


def printed_error(x, c):
    """The larger of (40) and (41), each without its minimum over points."""
    return REACH * np.maximum(np.abs(np.cos(x)), np.abs(np.sin(x))) * (x - c) ** 2


def exact_error(x, c):
    """What the linear models at c leave out at x, of both components."""
    cosine = np.cos(x) - np.cos(c) + np.sin(c) * (x - c)
    sine = np.sin(x) - np.sin(c) - np.cos(c) * (x - c)
    return REACH * np.maximum(np.abs(cosine), np.abs(sine))


def worst_error(error, points, low=LOW, high=HIGH, places=40_001):
    """The largest over a fine grid of the smallest over points."""
    x = np.linspace(low, high, places)
    return np.min([error(x, c) for c in points], axis=0).max()


def exhaustive(error, count, grid, places=401, low=LOW, high=HIGH):
    """The best `count` points of a grid, all combinations of them tried."""
    x = np.linspace(low, high, places)
    table = np.array([error(x, c) for c in grid])
    best, chosen = np.inf, None
    for rest in itertools.combinations(range(len(grid)), count - 1):
        begin = rest[-1] + 1 if rest else 0
        if begin == len(grid):
            continue
        known = table[list(rest)].min(axis=0) if rest else np.full(places, np.inf)
        worst = np.minimum(known, table[begin:]).max(axis=1)
        if worst.min() < best:
            best, chosen = worst.min(), (*rest, begin + int(worst.argmin()))
    return best, grid[list(chosen)]


def worst_of_squares(points, side=401):
    """max(|x - a|, |y - b|)^2 over the unit square, of the nearest of points (n, 2)."""
    x, y = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side))
    return np.min([np.maximum((x - a) ** 2, (y - b) ** 2) for a, b in points], axis=0).max()


def best_pair_for_a_product(low, high, points=13, places=61):
    """x y is off its tangent at (a, b) by (x - a)(y - b): the best two points of a grid."""
    x, y = np.meshgrid(*(np.linspace(a, b, places) for a, b in zip(low, high, strict=True)))
    sides = [np.linspace(a, b, points) for a, b in zip(low, high, strict=True)]
    tables = [np.abs((x - a) * (y - b)).ravel() for a, b in itertools.product(*sides)]
    return min(np.minimum(one, two).max() for one, two in itertools.combinations(tables, 2))


def fewest_points(intervals):
    """How few points pierce closed intervals, by trying every set of right ends."""
    ends = [high for _, high in intervals]
    for count in range(1, len(intervals) + 1):
        for points in itertools.combinations(ends, count):
            if all(any(low <= p <= high for p in points) for low, high in intervals):
                return count
    return 0


# ---- steady ellipsoids -----------------------------------------------------------------------


def smallest(size):
    """The weight in (0, 1) of the smallest size."""
    return minimize_scalar(
        size, bounds=(1e-7, 1 - 1e-7), method="bounded", options={"xatol": 1e-12}
    ).x


def log_determinant(S):
    """ln |S|."""
    return np.linalg.slogdet(S)[1]


def fused(P, rho):
    """(29) as it is printed."""
    return np.linalg.inv((1 - rho) * np.linalg.inv(P) + rho * C.T @ np.linalg.inv(R) @ C)


def added(M, N, beta):
    """(2) as it is printed."""
    return M / (1 - beta) + N / beta


def rule_of_eigenvalues(P):
    """sqrt(r)/(sqrt(p) + sqrt(r))."""
    p, r = np.linalg.eigvalsh(C @ P @ C.T)[-1], np.linalg.eigvalsh(R)[-1]
    return np.sqrt(r) / (np.sqrt(p) + np.sqrt(r))


BETA = {
    "trace": lambda M, N: smallest(lambda b: np.trace(added(M, N, b))),
    "determinant": lambda M, N: smallest(lambda b: log_determinant(added(M, N, b))),
}
RHO = {
    "trace": lambda P: smallest(lambda r: np.trace(fused(P, r))),
    "determinant": lambda P: smallest(lambda r: log_determinant(fused(P, r))),
    "sqrt": rule_of_eigenvalues,
}


def steady(rule, noise, psi=0.3, steps=1200):
    """Sigma after many steps; rule: "BETA_RHO", or a pair of constants."""
    A, S = jacobian(psi), 0.01 * np.eye(3)
    for _ in range(steps):
        M = A @ S @ A.T
        if isinstance(rule, str):
            beta_rule, rho_rule = rule.split("_")
            P = added(M, noise, BETA[beta_rule](M, noise))
            S = fused(P, RHO[rho_rule](P))
        else:
            S = fused(added(M, noise, rule[0]), rule[1])
    return S


def with_remainder(error):
    """Qhat for a remainder of so many metres in x and in y, by the smallest trace."""
    box = np.diag([2 * error**2, 2 * error**2, 0.0])
    return added(box, Q, smallest(lambda b: np.trace(added(box, Q, b))))
