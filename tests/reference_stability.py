"""Slow and obvious references for the stability of an IMM (Seah and Hwang 2008).

They share no code with the package: sums are written out, inverses are inverses.
"""

import itertools

import numpy as np


def transition(A, sequence, k, i):
    """Phi(k, i) of definition 2 along modes sequence[k] (1-based: sequence[0] is unused)."""
    phi = np.eye(A.shape[-1])
    if k >= i:
        for step in range(i + 1, k + 1):
            phi = A[sequence[step]] @ phi
        return phi
    return np.linalg.inv(transition(A, sequence, i, k))


def kappas(A, W, C, R, N):
    """kappa_1 .. kappa_4 over all sequences of N modes, by the sums of definitions 2 and 3."""
    found = []
    for modes in itertools.product(range(len(A)), repeat=N):
        sequence = (None, *modes)
        control = observe = 0.0
        for i in range(1, N + 1):
            j = sequence[i]
            phi = transition(A, sequence, N, i)
            control = control + phi @ W[j] @ phi.T
            back = transition(A, sequence, i, N)
            observe = observe + back.T @ C[j].T @ np.linalg.inv(R[j]) @ C[j] @ back
        found.append((*extremes(control), *extremes(observe)))
    k1, k2, k3, k4 = np.array(found).T
    return k1.min(), k2.max(), k3.min(), k4.max()


def extremes(matrix):
    """Smallest and largest eigenvalue."""
    values = np.linalg.eigvalsh((matrix + matrix.T) / 2)
    return values[0], values[-1]


def upsilon(A, W, C, R, P):
    """(36), by the gain: P may be singular."""
    M = A @ P @ A.T + W
    return M - M @ C.T @ np.linalg.inv(C @ M @ C.T + R) @ C @ M


def beta_1(A, W, C, R, N):
    """The least eigenvalue of Upsilon(... Upsilon(0)) over all sequences of N modes."""
    least = np.inf
    for modes in itertools.product(range(len(A)), repeat=N):
        P = np.zeros_like(A[0])
        for j in modes:
            P = upsilon(A[j], W[j], C[j], R[j], P)
        least = min(least, extremes(P)[0])
    return least


def along_both(A, B, choose):
    """L V diag(choose(l, 1)) V' L' of A = L L', L^-1 B L^-T = V diag(l) V'."""
    L = np.linalg.cholesky(A)
    lower = np.linalg.inv(L)
    values, V = np.linalg.eigh(lower @ B @ lower.T)
    return L @ V @ np.diag(choose(values, 1.0)) @ V.T @ L.T


def imm(model, z):
    """The IMM of one run, scalar by scalar; n_times = 1.

    Lists per step: P_j(k|k), P_j(k|k-1), gamma_ji(k-1), the spread of the means mode j mixes, the
    gains.
    """
    A, b = model.state_transition[0], model.input_effect[0]
    W, Pi = model.process_noise_covariance[0], model.transition_matrix[0]
    C, R = model.measurement_matrix, model.measurement_noise_covariance
    r = len(A)
    x = [model.initial_mean] * r
    P = [model.initial_covariance] * r
    alpha = model.initial_mode_probabilities
    history = []
    for scan in z:
        ahead = [sum(Pi[i, j] * alpha[i] for i in range(r)) for j in range(r)]
        gamma = np.array([[Pi[i, j] * alpha[i] / ahead[j] for i in range(r)] for j in range(r)])
        new_x, new_P, predictions, spreads, gains, likelihood = [], [], [], [], [], []
        for j in range(r):
            x0 = sum(gamma[j, i] * x[i] for i in range(r))
            spread = sum(gamma[j, i] * np.outer(x[i] - x0, x[i] - x0) for i in range(r))
            P0 = sum(gamma[j, i] * P[i] for i in range(r)) + spread
            M = A[j] @ P0 @ A[j].T + W[j]
            S = C[j] @ M @ C[j].T + R[j]
            K = M @ C[j].T @ np.linalg.inv(S)
            innovation = scan - C[j] @ (A[j] @ x0 + b[j])
            new_x.append(A[j] @ x0 + b[j] + K @ innovation)
            new_P.append(np.linalg.inv(np.linalg.inv(M) + C[j].T @ np.linalg.inv(R[j]) @ C[j]))
            likelihood.append(
                np.exp(-0.5 * innovation @ np.linalg.inv(S) @ innovation)
                / np.sqrt(np.linalg.det(2 * np.pi * S))
            )
            predictions.append(M)
            spreads.append(spread)
            gains.append(K)
        x, P = new_x, new_P
        alpha = np.array(likelihood) * ahead
        alpha = alpha / alpha.sum()
        history.append((P, predictions, gamma, spreads, gains))
    return history


def propagator(model, gammas, gains):
    """Psi(k, k-1) Gamma(k-1) ... Psi(1, 0) Gamma(0) of (21), as one big matrix."""
    A, C = model.state_transition[0], model.measurement_matrix
    r, n = A.shape[:2]
    product = np.eye(r * n)
    for gamma, K in zip(gammas, gains, strict=True):
        big = np.zeros((r * n, r * n))
        for j in range(r):
            for i in range(r):
                block = (np.eye(n) - K[j] @ C[j]) @ A[j] * gamma[j, i]
                big[j * n : (j + 1) * n, i * n : (i + 1) * n] = block
        product = big @ product
    return product
