"""Slow and obvious references of the sojourn analysis. They share no code with the package."""

import itertools
import math

import numpy as np


def settled_predictor(A, C, Q, R, cycles=20_000):
    """F = A - K C and K, the Riccati recursion (Hwang 2003, eq. 15) run until it stands still."""
    P = np.eye(len(A))
    for _ in range(cycles):
        K = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        P = (A - K @ C) @ P @ (A - K @ C).T + Q + K @ R @ K.T
    return A - K @ C, K


def power_norms(F, steps):
    """||F^t||_2 for t = 0 .. steps - 1."""
    power, norms = np.eye(len(F)), []
    for _ in range(steps):
        norms.append(np.sqrt(max(np.linalg.eigvalsh(power.T @ power)[-1], 0.0)))
        power = F @ power
    return np.array(norms)


def smallest_sojourn(Fs, disturbance, rate, error_bound, delay, steps=3000):
    """L* of the direct bound by looking at every L and every later power; inf if there's none."""
    g = np.max([power_norms(F, steps) for F in Fs], axis=0)
    c = disturbance * sum(g[i] for i in range(delay))
    for L in range(1, steps // 2):
        later = range(L, steps)
        if all(g[t] <= rate**t for t in later):
            largest = max(g[t] for t in later)
            if c == 0 or (largest < 1 and c / (1 - largest) <= error_bound):
                return L
    return math.inf


def printed_terms(ks, alphas, U, rate, error_bound, delay, n):
    """Both terms of eq. 41, letter by letter."""
    first = max(
        math.log(abs(1 - math.sqrt(n) * U * delay * k / error_bound)) / abs(math.log(rate))
        for k in ks
    )
    second = max(math.log(k) / abs(math.log(a)) for k, a in zip(ks, alphas, strict=True))
    return first, second


def largest_disturbance(A, b, C, K, each):
    """max ||u||_inf and max ||u||_2 over modes and over the corners of the box |x_i| <= each_i."""
    infinity = euclidean = 0.0
    for m, l in itertools.product(range(len(A)), repeat=2):  # noqa: E741
        for signs in itertools.product((-1, 1), repeat=len(each)):
            x = np.array(signs) * each
            u = (A[m] - A[l]) @ x - K[m] @ ((C[m] - C[l]) @ x) + b[m] - b[l]
            infinity = max(infinity, np.abs(u).max())
            euclidean = max(euclidean, np.sqrt(u @ u))
    return infinity, euclidean


def error_left(F, addition, sojourn, switches=20_000):
    """The error that a scalar is left with when every `sojourn` steps something is added to it."""
    e = 0.0
    for _ in range(switches):
        e = F**sojourn * e + addition
    return e


def share_that_breaks_the_claim(Fs, rate, sojourn, extra, runs, steps, rng):
    """The fraction of runs with ||e|| > rate^t at a switch; run by run, step by step, no delay."""
    broken = 0
    for _ in range(runs):
        e = rng.normal(size=len(Fs[0]))
        e /= np.linalg.norm(e)
        mode = rng.integers(len(Fs))
        switch, over = rng.integers(sojourn, sojourn + extra + 1), False
        for t in range(1, steps + 1):
            e = Fs[mode] @ e
            if t == switch:
                over = over or np.linalg.norm(e) > rate**t
                mode = rng.choice([m for m in range(len(Fs)) if m != mode])
                switch += rng.integers(sojourn, sojourn + extra + 1)
        broken += over
    return broken / runs


def controllable(A, B):
    """Kalman's rank test."""
    blocks, block = [], B
    for _ in range(len(A)):
        blocks.append(block)
        block = A @ block
    return np.linalg.matrix_rank(np.hstack(blocks)) == len(A)


def output_covariance(A, C, Q, R, second_moment, steps):
    """O Pi O' + T (I x Q) T' + I x R with the matrices O and T written out (Hwang 2003, eq. 6)."""
    n, p = len(A), len(C)
    O = np.vstack([C @ np.linalg.matrix_power(A, t) for t in range(steps)])  # noqa: E741
    T = np.zeros((steps * p, steps * n))
    for t in range(steps):
        for s in range(t):
            block = C @ np.linalg.matrix_power(A, t - 1 - s)
            T[t * p : (t + 1) * p, s * n : (s + 1) * n] = block
    noise = T @ np.kron(np.eye(steps), Q) @ T.T + np.kron(np.eye(steps), R)
    return O @ np.atleast_2d(second_moment) @ O.T + noise
