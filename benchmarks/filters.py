"""The competitors. Each lays a problem out as it likes and gives a function that filters it.

The function returns the estimates' means (n_steps, n_x, n_runs) and mode probabilities (n_steps,
n_modes, n_runs). Timed, it is called with keep=False: what works in spans then lets each span's
estimates overwrite the last's, as the product does, and nobody puts axes in order.
"""

import ctypes
import functools
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from problem import Array, Problem

from hybridtrack.blocks import SPAN_STEPS
from hybridtrack.estimators import Estimates, _bank, _layout, estimators
from hybridtrack.simulation import BLOCK_RUNS, spans
from hybridtrack.vectors import WIDTH, aligned_zeros

Filter = Callable[[bool], tuple[Array, Array] | None]
Competitor = Callable[[Problem], Filter]

CXX = "g++"
CXX_FLAGS = ("-std=c++17", "-O3", "-march=native", "-ffast-math", "-fPIC")


def available() -> dict[str, Competitor]:
    """The competitors that can run here, ours first."""
    found: dict[str, Competitor] = {"hybridtrack": ours}
    if shutil.which(CXX):
        found["C++, textbook"] = functools.partial(cpp, algebra="textbook")
        found["C++, ours"] = functools.partial(cpp, algebra="ours")
        found["C++, 256 lanes"] = functools.partial(cpp, algebra="textbook", lanes=BLOCK_RUNS)
    if find_spec("jax"):
        found["JAX"] = with_jax
    found["NumPy, batched"] = batched
    if find_spec("filterpy"):
        found["FilterPy"] = with_filterpy
    if find_spec("pyrecest"):
        found["PyRecEst"] = with_pyrecest
    return found


def one_bank(problem: Problem) -> tuple[Array, Array, Array, Array, Array]:
    """F, Q, H, R (n_modes, ...) and the transition matrix, the same at every step."""
    model = problem.model
    assert not model.input_effect.any()
    return (
        model.state_transition[0],
        model.process_noise_covariance[0],
        model.measurement_matrix,
        model.measurement_noise_covariance,
        model.transition_matrix[0],
    )


# ---- blocks of lanes, spans of steps: ours and C++ -------------------------------------------

Advance = Callable[[Array, Estimates], None]  # a span's measurements, room for estimates


def _in_blocks(problem: Problem, start: Callable[[], Advance]) -> Filter:
    """Filter block after block of runs, each in spans of steps, as the product does."""
    steps, _, runs = problem.measurements.shape
    assert runs % BLOCK_RUNS == 0, f"{runs} runs are no multiple of {BLOCK_RUNS}"
    blocks = [
        np.ascontiguousarray(problem.measurements[..., first : first + BLOCK_RUNS])
        for first in range(0, runs, BLOCK_RUNS)
    ]
    room = _layout.empty_estimates(
        problem.model, SPAN_STEPS, BLOCK_RUNS, likelihoods=False, covariance=False
    )

    def filter_all(keep: bool) -> tuple[Array, Array] | None:
        means, probabilities = [], []
        for block in blocks:
            advance = start()
            for span in spans(steps, SPAN_STEPS):
                length = len(block[span])
                here = room._replace(
                    mean=room.mean[:length], mode_probabilities=room.mode_probabilities[:length]
                )
                advance(block[span], here)
                if keep:
                    means.append(here.mean.copy())
                    probabilities.append(here.mode_probabilities.copy())
        return (_joined(means, steps), _joined(probabilities, steps)) if keep else None

    return filter_all


def _joined(parts: list[Array], steps: int) -> Array:
    """Spans of blocks, in their order, as (steps, ..., runs)."""
    per_block = -(-steps // SPAN_STEPS)
    blocks = [np.concatenate(parts[i : i + per_block]) for i in range(0, len(parts), per_block)]
    return np.concatenate(blocks, axis=2)


def ours(problem: Problem) -> Filter:
    """The compiled recursion through the function that the product calls."""
    model = problem.model
    kernel_model = _layout.kernel_model(model)
    imm = estimators()["imm"]
    recursion = imm.recursion(imm.settings())
    work = _layout.workspace(model)

    def start() -> Advance:
        state = _layout.start(model, BLOCK_RUNS)

        def advance(z: Array, room: Estimates) -> None:
            _bank.run_span(state, work, kernel_model, recursion, z, room)

        return advance

    return _in_blocks(problem, start)


def cpp(problem: Problem, algebra: str, lanes: int = WIDTH) -> Filter:
    """imm.cpp, written for this size; algebra: textbook or ours; lanes at a time."""
    F, Q, H, R, transition = one_bank(problem)
    n_modes, n_y, n_x = H.shape
    lower = np.tril_indices(n_x)
    in_pattern = _cpp_pattern(n_modes, n_x)
    assert not F[~in_pattern].any(), "imm.cpp takes other elements of F for zeros"
    assert (np.eye(n_x)[::3] == H).all(), "imm.cpp measures positions"
    assert (R[0] * np.eye(n_y) == R).all(), "imm.cpp takes uncorrelated measurements"
    model = problem.model
    packed_model = np.concatenate(
        [part.ravel() for part in (F, Q[:, *lower], np.diagonal(R[0]), transition)]
    )
    start_of_a_lane = np.concatenate(
        [
            *n_modes * [model.initial_mean],
            *n_modes * [model.initial_covariance[lower]],
            model.initial_mode_probabilities,
        ]
    )
    group = np.repeat(start_of_a_lane, lanes)
    mixed = aligned_zeros(n_modes * (n_x + len(lower[0]) + 3) * lanes)
    function = getattr(_library(lanes), f"advance_{algebra}_{n_x}_{n_y}")
    function.restype = None

    def start() -> Advance:
        state = aligned_zeros(BLOCK_RUNS // lanes, group.size)
        state[:] = group

        def advance(z: Array, room: Estimates) -> None:
            arrays = (state, mixed, packed_model, z, room.mean, room.mode_probabilities)
            function(ctypes.c_int(len(z)), *(ctypes.c_void_p(a.ctypes.data) for a in arrays))

        return advance

    return _in_blocks(problem, start)


def _cpp_pattern(n_modes: int, n_x: int) -> Any:
    """`moves` of imm.cpp."""
    mode, a, e = np.ogrid[:n_modes, :n_x, :n_x]
    return (a // 3 == e // 3) & (e >= a) & ~((mode == 0) & (e % 3 == 2))


@functools.cache
def _library(lanes: int) -> ctypes.CDLL:
    """imm.cpp compiled for this machine."""
    with tempfile.TemporaryDirectory() as folder:
        library, compiled = Path(folder) / "imm.so", Path(folder) / "imm.o"
        source = Path(__file__).with_name("imm.cpp")
        flags = [*CXX_FLAGS, f"-DLANES={lanes}"]
        subprocess.run([CXX, *flags, "-c", str(source), "-o", str(compiled)], check=True)
        # Linked with -ffast-math it would flush subnormals to zero in this whole process.
        subprocess.run([CXX, "-shared", str(compiled), "-o", str(library)], check=True)
        return ctypes.CDLL(str(library))


# ---- runs first: NumPy and JAX ---------------------------------------------------------------

NUMPY_RUNS = 2048  # at a time: of 64 ... 4096 fastest with 3 states, within 4 % with 6


def batched(problem: Problem) -> Filter:
    """All runs at once in NumPy, runs first; F applied to all runs by one matrix product."""
    F, Q, H, R, transition = one_bank(problem)
    _, n_y, n_x = H.shape
    z = np.ascontiguousarray(np.moveaxis(problem.measurements, 2, 0))  # runs, steps, n_y

    def filter_some(z: Array) -> tuple[Array, Array]:
        runs, steps, _ = z.shape
        x = np.tile(problem.model.initial_mean, (2, runs, 1))
        P = np.tile(problem.model.initial_covariance, (2, runs, 1, 1))
        mu = np.tile(problem.model.initial_mode_probabilities, (runs, 1))
        means, probabilities = np.empty((steps, runs, n_x)), np.empty((steps, runs, 2))
        for k in range(steps):
            predicted = mu @ transition
            mixed = []
            for j in range(2):
                w = (mu * transition[:, j] / predicted[:, j : j + 1]).T
                mean = w[0][:, None] * x[0] + w[1][:, None] * x[1]
                d = x - mean
                spread = P + d[..., :, None] * d[..., None, :]
                mixed.append(
                    (mean, w[0][:, None, None] * spread[0] + w[1][:, None, None] * spread[1])
                )
            log_likelihood = np.empty((runs, 2))
            for j, (mean, covariance) in enumerate(mixed):
                mean = mean @ F[j].T
                half = (covariance.reshape(-1, n_x) @ F[j].T).reshape(covariance.shape)
                # (F P F')' = F (P F'), by symmetry one product of all runs again
                covariance = half.swapaxes(1, 2).reshape(-1, n_x) @ F[j].T
                covariance = covariance.reshape(half.shape) + Q[j]
                PH = (covariance.reshape(-1, n_x) @ H[j].T).reshape(runs, n_x, n_y)
                S = (PH.swapaxes(1, 2).reshape(-1, n_x) @ H[j].T).reshape(runs, n_y, n_y) + R[j]
                inverse, determinant = _inverse(S)
                K = PH @ inverse
                innovation = z[:, k] - mean @ H[j].T
                weighted = (inverse @ innovation[..., None])[..., 0]
                x[j] = mean + (PH @ weighted[..., None])[..., 0]
                # Joseph's form, (I - K H) P (I - K H)' + K R K' with both products opened
                A = np.eye(n_x) - K @ H[j]
                P[j] = A @ covariance @ A.swapaxes(1, 2) + K @ R[j] @ K.swapaxes(1, 2)
                squared = np.einsum("rm,rm->r", innovation, weighted)
                log_likelihood[:, j] = -0.5 * (squared + np.log(determinant))
            mu = predicted * np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
            mu /= mu.sum(axis=1, keepdims=True)
            means[k] = mu[:, :1] * x[0] + mu[:, 1:] * x[1]
            probabilities[k] = mu
        return means, probabilities

    def filter_all(keep: bool) -> tuple[Array, Array] | None:
        parts = [filter_some(z[i : i + NUMPY_RUNS]) for i in range(0, len(z), NUMPY_RUNS)]
        if not keep:
            return None
        means, probabilities = (np.concatenate(p, axis=1) for p in zip(*parts, strict=True))
        return means.swapaxes(1, 2), probabilities.swapaxes(1, 2)

    return filter_all


def _inverse(S: Array) -> tuple[Array, Array]:
    """Inverse and determinant of innovation covariances (runs, n_y, n_y), n_y 1 or 2."""
    if S.shape[1] == 1:
        return 1.0 / S, S[:, 0, 0]
    determinant = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] * S[:, 1, 0]
    adjugate = np.empty_like(S)
    adjugate[:, 0, 0], adjugate[:, 1, 1] = S[:, 1, 1], S[:, 0, 0]
    adjugate[:, 0, 1], adjugate[:, 1, 0] = -S[:, 0, 1], -S[:, 1, 0]
    return adjugate / determinant[:, None, None], determinant


def with_jax(problem: Problem) -> Filter:
    """One run's recursion, scanned over the steps, mapped over the runs and compiled; float64."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    F, Q, H, R, transition = (jnp.asarray(array) for array in one_bank(problem))
    n_x = H.shape[2]

    def update(x: Any, P: Any, F: Any, Q: Any, H: Any, R: Any, z: Any) -> Any:
        x, P = F @ x, F @ P @ F.T + Q
        S = H @ P @ H.T + R
        if S.shape[0] == 1:
            inverse, determinant = 1.0 / S, S[0, 0]
        else:
            determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
            inverse = jnp.array([[S[1, 1], -S[0, 1]], [-S[1, 0], S[0, 0]]]) / determinant
        K = P @ H.T @ inverse
        innovation = z - H @ x
        A = jnp.eye(n_x) - K @ H
        log_likelihood = -0.5 * (innovation @ inverse @ innovation + jnp.log(determinant))
        return x + K @ innovation, A @ P @ A.T + K @ R @ K.T, log_likelihood

    def step(carry: Any, z: Any) -> Any:
        x, P, mu = carry
        predicted = mu @ transition
        w = mu[:, None] * transition / predicted
        mean = w.T @ x
        d = x[:, None] - mean[None]  # from, to, n_x
        spread = P[:, None] + d[..., :, None] * d[..., None, :]
        covariance = (w[..., None, None] * spread).sum(axis=0)
        x, P, log_likelihood = jax.vmap(update, in_axes=(0,) * 6 + (None,))(
            mean, covariance, F, Q, H, R, z
        )
        mu = predicted * jnp.exp(log_likelihood - log_likelihood.max())
        mu = mu / mu.sum()
        return (x, P, mu), (mu @ x, mu)

    model = problem.model
    start = (
        jnp.tile(model.initial_mean, (2, 1)),
        jnp.tile(model.initial_covariance, (2, 1, 1)),
        jnp.asarray(model.initial_mode_probabilities),
    )
    over_runs = jax.jit(jax.vmap(lambda z: jax.lax.scan(step, start, z)[1]))
    z = jnp.asarray(np.moveaxis(problem.measurements, 2, 0))

    def filter_all(keep: bool) -> tuple[Array, Array] | None:
        means, probabilities = jax.block_until_ready(over_runs(z))
        if not keep:
            return None
        return np.moveaxis(np.asarray(means), 0, 2), np.moveaxis(np.asarray(probabilities), 0, 2)

    return filter_all


# ---- one run at a time: FilterPy and PyRecEst ------------------------------------------------


def _run_by_run(problem: Problem, start: Callable[[], Callable[[Array], Any]]) -> Filter:
    """start() gives a function of one measurement that returns mean and mode probabilities."""
    steps, _, runs = problem.measurements.shape
    n_modes, _, n_x = problem.model.measurement_matrix.shape

    def filter_all(keep: bool) -> tuple[Array, Array]:
        means, probabilities = np.empty((steps, n_x, runs)), np.empty((steps, n_modes, runs))
        for b in range(runs):
            step = start()
            for k in range(steps):
                means[k, :, b], probabilities[k, :, b] = step(problem.measurements[k, :, b])
        return means, probabilities

    return filter_all


def with_filterpy(problem: Problem) -> Filter:
    """filterpy.kalman.IMMEstimator, its transition matrix i to j as its code has it."""
    from filterpy.kalman import IMMEstimator, KalmanFilter

    F, Q, H, R, transition = one_bank(problem)
    n_modes, n_y, n_x = H.shape
    model = problem.model

    def start() -> Callable[[Array], Any]:
        filters = []
        for j in range(n_modes):
            kalman = KalmanFilter(dim_x=n_x, dim_z=n_y)
            kalman.x = model.initial_mean.copy()
            kalman.P = model.initial_covariance.copy()
            kalman.F, kalman.Q, kalman.H, kalman.R = F[j], Q[j], H[j], R[j]
            filters.append(kalman)
        imm = IMMEstimator(filters, model.initial_mode_probabilities, transition)

        def step(z: Array) -> tuple[Array, Array]:
            imm.predict()
            imm.update(z)
            return imm.x, imm.mu

        return step

    return _run_by_run(problem, start)


def with_pyrecest(problem: Problem) -> Filter:
    """pyrecest's InteractingMultipleModelFilter over its Kalman filters."""
    from pyrecest.filters.interacting_multiple_model_filter import InteractingMultipleModelFilter
    from pyrecest.filters.kalman_filter import KalmanFilter

    F, Q, H, R, transition = one_bank(problem)
    model = problem.model
    mean, covariance = model.initial_mean, model.initial_covariance

    def start() -> Callable[[Array], Any]:
        bank = [KalmanFilter((mean, covariance)) for _ in F]
        imm = InteractingMultipleModelFilter(bank, transition, model.initial_mode_probabilities)

        def step(z: Array) -> tuple[Array, Array]:
            imm.predict_linear(list(F), list(Q))
            imm.update_linear(z, list(H), list(R))
            return imm.combined_filter_state.mu, imm.mode_probabilities

        return step

    return _run_by_run(problem, start)


RUN_BY_RUN: tuple[Competitor, ...] = (with_filterpy, with_pyrecest)
