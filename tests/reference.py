"""Slow and obvious references in NumPy, one run at a time. They share no code with the package."""

import itertools

import numpy as np


def gaussian_log_density(r, S):
    """Log of N(r; 0, S)."""
    return -0.5 * (r @ np.linalg.solve(S, r) + np.linalg.slogdet(2 * np.pi * S)[1])


def normalised(log_weights):
    """exp(l) over its sum."""
    w = np.exp(log_weights - np.max(log_weights))
    return w / w.sum()


def kalman_predict(x, P, F, b, Q):
    """Mean and covariance one step on."""
    return F @ x + b, F @ P @ F.T + Q


def kalman_update(x, P, H, R, z):
    """Joseph's form; gain and log-likelihood too."""
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    A = np.eye(len(x)) - K @ H
    return x + K @ (z - H @ x), A @ P @ A.T + K @ R @ K.T, K, gaussian_log_density(z - H @ x, S)


def moments(weights, means, covariances):
    """Mean and covariance of a Gaussian mixture."""
    mean = sum(w * x for w, x in zip(weights, means, strict=True))
    covariance = sum(
        w * (P + np.outer(x - mean, x - mean))
        for w, x, P in zip(weights, means, covariances, strict=True)
    )
    return mean, covariance


def at(array, k):
    """Step k of an array whose first axis is n_times or 1."""
    return array[k if len(array) > 1 else 0]


def bank(model, z, *, mixing=True, rmimm=None, floor=0.0, initial_mean=None, known=None):
    """IMM, MMAE (mixing=False), RMIMM (rmimm={floor, recursive, common}) or the genie, one run.

    z (steps, n_y). Returns a list per step of (mean, covariance, mode probabilities, normalised
    N_j Lambda_j).
    """
    n = len(model.transition_matrix[0])
    x0 = model.initial_mean if initial_mean is None else initial_mean
    x = [x0.copy() for _ in range(n)]
    P = [model.initial_covariance.copy() for _ in range(n)]
    e = [np.zeros(len(x0)) for _ in range(n)]
    mu = model.initial_mode_probabilities.copy()
    H, R = model.measurement_matrix, model.measurement_noise_covariance
    history = []
    for k in range(len(z)):
        Pi = at(model.transition_matrix, k)
        F, b = at(model.state_transition, k), at(model.input_effect, k)
        Q = at(model.process_noise_covariance, k)
        c = mu @ Pi
        mixed_x, mixed_P, mixed_e = list(x), list(P), list(e)
        for j in range(n):
            if known is not None:
                weights = mu
            elif mixing and c[j] > 0:
                weights = Pi[:, j] * mu / c[j]
            else:
                continue
            mixed_x[j], mixed_P[j] = moments(weights, x, P)
            mixed_e[j] = sum(w * v for w, v in zip(weights, e, strict=True))
        detected = not np.isnan(z[k]).any()
        log_likelihood = np.zeros(n)
        rbar = np.zeros((n, len(z[k])))
        for j in range(n):
            x[j], P[j] = kalman_predict(mixed_x[j], mixed_P[j], F[j], b[j], Q[j])
            if rmimm is not None:
                y = mixed_x[j] + (mixed_e[j] if rmimm["recursive"] else 0.0)
                CA = sum(c[i] * H[i] @ F[i] for i in range(n))
                Cb = sum(c[i] * H[i] @ b[i] for i in range(n))
                rbar[j] = CA @ y - H[j] @ F[j] @ mixed_x[j] + Cb - H[j] @ b[j]
                A_mean = sum(c[i] * F[i] for i in range(n))
                b_mean = sum(c[i] * b[i] for i in range(n))
                e[j] = A_mean @ y - F[j] @ mixed_x[j] + b_mean - b[j]
            if detected:
                x[j], P[j], K, log_likelihood[j] = kalman_update(x[j], P[j], H[j], R[j], z[k])
                if rmimm is not None:
                    e[j] = e[j] - K @ rbar[j]
        if rmimm is not None and detected:
            if rmimm["common"]:
                rbar[:] = sum(c[j] * rbar[j] for j in range(n))
            log_likelihood -= np.log(np.maximum(np.linalg.norm(rbar, axis=1), rmimm["floor"]))
        with np.errstate(divide="ignore"):
            mu = normalised(np.log(c) + log_likelihood)
        if floor:
            mu = np.maximum(mu, floor) / np.maximum(mu, floor).sum()
        if known is not None:
            mu = np.eye(n)[known[k]]
        history.append((*moments(mu, x, P), mu, normalised(log_likelihood)))
    return history


def enumerate_mode_sequences(model, z, initial_mean=None):
    """The exact posterior after all scans: every sequence of modes has its own Kalman filter.

    Returns mean, covariance and mode probabilities at the last step. Exponential in the steps.
    """
    n = len(model.transition_matrix[0])
    x0 = model.initial_mean if initial_mean is None else initial_mean
    log_weights, xs, Ps, last = [], [], [], []
    for sequence in itertools.product(range(n), repeat=len(z) + 1):
        with np.errstate(divide="ignore"):
            log_weight = np.log(model.initial_mode_probabilities[sequence[0]])
            x, P = x0, model.initial_covariance
            for k, j in enumerate(sequence[1:]):
                log_weight += np.log(at(model.transition_matrix, k)[sequence[k], j])
                x, P = kalman_predict(
                    x,
                    P,
                    at(model.state_transition, k)[j],
                    at(model.input_effect, k)[j],
                    at(model.process_noise_covariance, k)[j],
                )
                if not np.isnan(z[k]).any():
                    x, P, _, log_likelihood = kalman_update(
                        x,
                        P,
                        model.measurement_matrix[j],
                        model.measurement_noise_covariance[j],
                        z[k],
                    )
                    log_weight += log_likelihood
        if np.isfinite(log_weight):
            log_weights.append(log_weight)
            xs.append(x)
            Ps.append(P)
            last.append(sequence[-1])
    weights = normalised(np.array(log_weights))
    mode_probabilities = np.bincount(last, weights=weights, minlength=n)
    return (*moments(weights, xs, Ps), mode_probabilities)


def best_sequences(model, z, most):
    """The tree of mode sequences, its best `most` kept after every scan; one run.

    Modes of one name (supermodes) are one mode in several stages, with a weight each. Returns a
    list per step of (mean, covariance, probabilities of the supermodes).
    """
    names = np.array(model.mode_names)
    with np.errstate(divide="ignore"):
        start = np.log(model.initial_mode_probabilities)
    kept = [(start, model.initial_mean, model.initial_covariance)]
    history = []
    for k in range(len(z)):
        with np.errstate(divide="ignore"):
            log_matrix = np.log(at(model.transition_matrix, k))
        grown = []
        for log_weights, x0, P0 in kept:
            moved = np.logaddexp.reduce(log_weights[:, np.newaxis] + log_matrix, axis=0)
            for name in dict.fromkeys(names):
                log_weight = np.where(names == name, moved, -np.inf)
                if np.isneginf(log_weight).all():
                    continue
                j = np.argmax(names == name)
                x, P = kalman_predict(
                    x0,
                    P0,
                    at(model.state_transition, k)[j],
                    at(model.input_effect, k)[j],
                    at(model.process_noise_covariance, k)[j],
                )
                if not np.isnan(z[k]).any():
                    H, R = model.measurement_matrix[j], model.measurement_noise_covariance[j]
                    x, P, _, log_likelihood = kalman_update(x, P, H, R, z[k])
                    log_weight = log_weight + log_likelihood
                grown.append((log_weight, x, P))
        grown.sort(key=lambda sequence: np.logaddexp.reduce(sequence[0]), reverse=True)
        kept = grown[:most]
        log_weights, xs, Ps = zip(*kept, strict=True)
        weights = normalised(np.array(log_weights))
        history.append((*moments(weights.sum(axis=1), xs, Ps), weights.sum(axis=0)))
    return history
