"""Slow and obvious references for observability. They share no code with the package.

A mode is a dict of its matrices F, b, Q, H, R and of its initial mean m and covariance P. Outputs
of all scans are stacked, and their moments written out as dense matrices.
"""

import math
from fractions import Fraction

import numpy as np


def stacked(mode, scans, at_first_scan, told=None):
    """Mean and covariance of the outputs of all scans, the drawn initial mean in front if told.

    Everything random is one long vector e of independent parts: told mean's deviation, initial
    error, process noises, measurement noises; outputs are A e + a mean.
    """
    F, b, Q, H, R = (mode[key] for key in "FbQHR")
    n, m = len(F), len(H)
    parts = [np.zeros((n, n)) if told is None else told, mode["P"]] + [Q] * scans + [R] * scans
    sizes = [len(part) for part in parts]
    begin = np.concatenate([[0], np.cumsum(sizes)])
    total = begin[-1]
    covariance = np.zeros((total, total))
    for part, start in zip(parts, begin, strict=False):
        covariance[start : start + len(part), start : start + len(part)] = part
    state, mean = np.zeros((n, total)), mode["m"].astype(float)
    state[:, :n] = np.eye(n)
    state[:, n : 2 * n] = np.eye(n)
    rows, means = [], []
    if told is not None:
        first = np.zeros((n, total))
        first[:, :n] = np.eye(n)
        rows.append(first)
        means.append(mean)
    for k in range(scans):
        if k > 0 or not at_first_scan:
            state, mean = F @ state, F @ mean + b
            state[:, begin[2 + k] : begin[2 + k] + n] += np.eye(n)
        row = H @ state
        row[:, begin[2 + scans + k] : begin[2 + scans + k] + m] += np.eye(m)
        rows.append(row)
        means.append(H @ mean)
    A = np.vstack(rows)
    return np.concatenate(means), A @ covariance @ A.T


def chernoff(one, other, s):
    """-ln of the integral of p_one^s p_other^(1-s), of two (mean, covariance)."""
    (m1, S1), (m2, S2) = one, other
    mixed = s * S2 + (1 - s) * S1
    logs = [np.linalg.slogdet(S)[1] for S in (mixed, S1, S2)]
    d = m1 - m2
    return 0.5 * (logs[0] - (1 - s) * logs[1] - s * logs[2]) + 0.5 * s * (1 - s) * (
        d @ np.linalg.solve(mixed, d)
    )


def largest_chernoff(one, other):
    """By looking everywhere, then closer."""
    low, high = 0.0, 1.0
    for _ in range(12):
        grid = np.linspace(low, high, 41)[1:-1]
        values = [chernoff(one, other, s) for s in grid]
        best, step = grid[int(np.argmax(values))], grid[1] - grid[0]
        low, high = max(best - step, 0.0), min(best + step, 1.0)
    return max(values)


def bracket(one, other):
    """Bounds of the error by the Bhattacharyya and the Chernoff distance."""
    half = chernoff(one, other, 0.5)
    return (
        0.5 * (1 - math.sqrt(1 - math.exp(-2 * half))),
        0.5 * math.exp(-largest_chernoff(one, other)),
    )


def log_density(y, mean, S):
    """Of many vectors, as rows."""
    r = y - mean
    return -0.5 * (np.sum(r * np.linalg.solve(S, r.T).T, axis=1) + np.linalg.slogdet(S)[1])


def error_of_one_axis(variance, shift):
    """The best test's error between N(0, 1) and N(shift, variance), split by a parabola."""
    # ln p_other - ln p_one = a y^2 + b y + c
    a = 0.5 - 0.5 / variance
    b = shift / variance
    c = -0.5 * math.log(variance) - 0.5 * shift**2 / variance

    def below(x, mean, std):
        return 0.5 * math.erfc(-(x - mean) / (std * math.sqrt(2)))

    def between(low, high, mean, std):
        return below(high, mean, std) - below(low, mean, std)

    if a == 0:
        return below(-abs(shift) / 2, 0, 1)
    root = math.sqrt(b * b - 4 * a * c)
    low, high = sorted([(-b - root) / (2 * a), (-b + root) / (2 * a)])
    inside_one = between(low, high, 0.0, 1.0)
    inside_other = between(low, high, shift, math.sqrt(variance))
    if a > 0:  # the other is likelier outside
        return 0.5 * (1 - inside_one + inside_other)
    return 0.5 * (inside_one + 1 - inside_other)


def error_by_inversion(variances, shifts):
    """Gil-Pelaez 1951 as printed, for each of the two errors: slow, and only for some axes."""
    from scipy.integrate import quad

    l, d = np.asarray(variances), np.asarray(shifts)  # noqa: E741
    constant = float((-0.5 * np.log(l)).sum())

    def positive_probability(square, linear, offset):
        """P(sum of square w^2 + linear w, plus offset > 0) of standard normal w."""

        def integrand(t):
            v = 1 - 2j * t * square
            log = -0.5 * np.log(v) - 0.5 * t * t * linear**2 / v
            return float((np.exp(log.sum() + 1j * t * offset) / t).imag)

        total, _ = quad(integrand, 0.0, np.inf, limit=2000, epsabs=1e-10)
        return 0.5 + total / math.pi

    # Under one: w = y. Under the other: y = d + sqrt(l) w.
    under_one = positive_probability(0.5 - 0.5 / l, d / l, constant - 0.5 * float((d**2 / l).sum()))
    under_other = positive_probability(
        0.5 * (l - 1), d * np.sqrt(l), constant + 0.5 * float((d**2).sum())
    )
    return 0.5 * (under_one + 1 - under_other)


def simulated(mode, scans, at_first_scan, told, runs, rng):
    """Outputs of many runs, step by step; (runs, outputs), the drawn mean in front if told."""
    F, b, Q, H, R = (mode[key] for key in "FbQHR")

    def draw(S):
        return rng.multivariate_normal(np.zeros(len(S)), S, size=runs, method="svd")

    mean = np.repeat(mode["m"][None], runs, axis=0)
    out = []
    if told is not None:
        mean = mean + draw(told)
        out.append(mean)
    x = mean + draw(mode["P"])
    for k in range(scans):
        if k > 0 or not at_first_scan:
            x = x @ F.T + b + draw(Q)
        out.append(x @ H.T + draw(R))
    return np.hstack(out)


def monte_carlo_error(one, other, scans, at_first_scan, told, runs, rng):
    """How often the likelihood ratio errs, and the standard error of that."""
    of_one = stacked(one, scans, at_first_scan, told)
    of_other = stacked(other, scans, at_first_scan, told)
    wrong = []
    for mode, sign in ((one, 1.0), (other, -1.0)):
        y = simulated(mode, scans, at_first_scan, told, runs, rng)
        ratio = log_density(y, *of_other) - log_density(y, *of_one)
        wrong.append(sign * ratio > 0)
    p = [float(np.mean(w)) for w in wrong]
    return 0.5 * sum(p), 0.5 * math.sqrt(sum(q * (1 - q) for q in p) / runs)


def index_by_fractions(F, H):
    """The smallest k with [H; HF; ..] of full column rank, by elimination in whole fractions."""
    F, H = ([[Fraction(v) for v in row] for row in A] for A in (F, H))
    n, rows, block = len(F), [], H
    for k in range(1, n + 1):
        rows += block
        if fraction_rank(rows) == n:
            return k
        block = [[sum(row[e] * F[e][c] for e in range(n)) for c in range(n)] for row in block]
    return math.inf


def fraction_rank(rows):
    rows, rank = [list(row) for row in rows], 0
    for column in range(len(rows[0])):
        pivot = next((i for i in range(rank, len(rows)) if rows[i][column] != 0), None)
        if pivot is None:
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        for i in range(rank + 1, len(rows)):
            factor = rows[i][column] / rows[rank][column]
            rows[i] = [a - factor * p for a, p in zip(rows[i], rows[rank], strict=True)]
        rank += 1
    return rank


def initial_state_free_difference(one, other, scans):
    """The largest difference of the outputs' covariances and means where no initial state shows.

    By dense covariances with P = 0, projected by scipy's null space; relative to the covariances.
    """
    from scipy.linalg import null_space

    blocks = []
    for mode in (one, other):
        block, rows = mode["H"], []
        for _ in range(scans):
            rows.append(block)
            block = block @ mode["F"]
        blocks.append(np.vstack(rows))
    both = np.hstack(blocks)
    null = null_space(both.T, rcond=1e-10)
    if not null.shape[1]:
        return 0.0
    n = len(one["F"])
    known = {"P": np.zeros((n, n)), "m": np.zeros(n)}
    (m1, S1), (m2, S2) = (stacked(mode | known, scans, True) for mode in (one, other))
    S1, S2 = null.T @ S1 @ null, null.T @ S2 @ null
    size = max(np.abs(S1).max(), np.abs(S2).max())
    return max(np.abs(S1 - S2).max() / size, np.abs(null.T @ (m1 - m2)).max() / math.sqrt(size))


def filtered_covariance(mode, scans):
    """The covariance after so many scans, by the textbook's formulas."""
    P = mode["P"]
    for _ in range(scans):
        P = mode["F"] @ P @ mode["F"].T + mode["Q"]
        K = P @ mode["H"].T @ np.linalg.inv(mode["H"] @ P @ mode["H"].T + mode["R"])
        A = np.eye(len(P)) - K @ mode["H"]
        P = A @ P @ A.T + K @ mode["R"] @ K.T
    return P


def exact_bhattacharyya(one, other, scans):
    """D(1/2) of the outputs of zero-mean modes from one step before the first scan on.

    Dense covariances and their determinants in whole fractions: no digit is lost.
    """
    covariances = []
    for mode in (one, other):
        F, Q, H, R, P = ([[Fraction(v) for v in row] for row in mode[key]] for key in "FQHRP")
        blocks = {}
        for k in range(scans):
            P = added(times(times(F, P), transposed(F)), Q)
            crossed = times(P, transposed(H))
            blocks[k, k] = added(times(H, crossed), R)
            for later in range(k + 1, scans):
                crossed = times(F, crossed)
                blocks[later, k] = times(H, crossed)
                blocks[k, later] = transposed(blocks[later, k])
        covariances.append(
            [
                [v for column in range(scans) for v in blocks[row, column][i]]
                for row in range(scans)
                for i in range(len(H))
            ]
        )
    S1, S2 = covariances
    middle = [
        [(a + b) / 2 for a, b in zip(*rows, strict=True)] for rows in zip(S1, S2, strict=True)
    ]
    square = determinant(middle) ** 2 / (determinant(S1) * determinant(S2))
    return 0.25 * (math.log(square.numerator) - math.log(square.denominator))


def times(A, B):
    return [
        [sum(a * b for a, b in zip(row, column, strict=True)) for column in zip(*B, strict=True)]
        for row in A
    ]


def added(A, B):
    return [[a + b for a, b in zip(*rows, strict=True)] for rows in zip(A, B, strict=True)]


def transposed(A):
    return [list(column) for column in zip(*A, strict=True)]


def determinant(A):
    """Of a positive definite matrix of fractions, by elimination."""
    A, product = [list(row) for row in A], Fraction(1)
    for k in range(len(A)):
        product *= A[k][k]
        for i in range(k + 1, len(A)):
            factor = A[i][k] / A[k][k]
            A[i] = [a - factor * p for a, p in zip(A[i], A[k], strict=True)]
    return product
