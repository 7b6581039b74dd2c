"""Jump Markov models for tests, small and asymmetric."""

import numpy as np
import pandas as pd

from hybridtrack.config import load
from hybridtrack.estimators import Estimates, _bank, _layout
from hybridtrack.models import JumpMarkovModel, Mode, ModeBank
from hybridtrack.vectors import WIDTH


def figure_5_model(dimensions=2):
    """The bank of Hwang 2006, section 5, with an asymmetric transition matrix."""
    names = ("x", "vx", "ax", "y", "vy", "ay")[: 3 * dimensions]
    R = 17.7**2 * np.eye(dimensions)
    modes = (
        Mode("CV", "constant_velocity_zero_acceleration", {"acceleration_std_m_s2": 0.2}, R),
        Mode("CT", "wiener_acceleration", {"acceleration_std_m_s2": 3.0}, R),
    )
    matrix = np.array([[0.95, 0.05], [0.15, 0.85]])
    bank = ModeBank(modes, names, dimensions, matrix, None, np.array([0.9, 0.1]))
    start = np.diag([17.7**2, 100.0, 1e-6] * dimensions)
    mean = np.array([0.0, 240.0, 0.0, 0.0, 50.0, 0.0])[: 3 * dimensions]
    return bank.discretise(np.ones(1), mean, start)


def random_model(rng, n_modes=3, n_x=4, n_y=2, n_times=1):
    """Full matrices everywhere: correlated noise, H and R of each mode its own, inputs."""

    def covariance(*shape):
        root = rng.normal(size=shape + shape[-1:])
        return root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(shape[-1])

    matrix = rng.random((n_times, n_modes, n_modes)) ** 2 + 0.02
    F = np.eye(n_x) + 0.3 * rng.normal(size=(n_times, n_modes, n_x, n_x))
    F *= 0.9 / np.maximum(np.linalg.norm(F, 2, axis=(-2, -1)), 0.9)[..., None, None]
    F[..., 0, n_x - 1] = 0.0
    mu = rng.random(n_modes) + 0.05
    return JumpMarkovModel(
        state_transition=F,
        input_effect=rng.normal(size=(n_times, n_modes, n_x)),
        process_noise_covariance=covariance(n_times, n_modes, n_x),
        measurement_matrix=rng.normal(size=(n_modes, n_y, n_x)),
        measurement_noise_covariance=covariance(n_modes, n_y),
        transition_matrix=matrix / matrix.sum(axis=-1, keepdims=True),
        initial_mode_probabilities=mu / mu.sum(),
        initial_mean=rng.normal(size=n_x),
        initial_covariance=covariance(n_x),
        step_s=np.ones(n_times),
        mode_names=tuple(f"m{j}" for j in range(n_modes)),
        state_names=tuple(f"s{e}" for e in range(n_x)),
        even_steps=n_times == 1,
    )


def slice_times(model, steps):
    """The model of a span of steps."""
    names = ("state_transition", "input_effect", "process_noise_covariance", "transition_matrix")
    return model._replace(
        **{name: getattr(model, name)[steps] for name in names if len(getattr(model, name)) > 1}
    )


def run_kernel(model, z, recursion=None, spans=None, known=None, initial_mean=None, rubbish=0.0):
    """Filter z (steps, n_y, lanes); returns Estimates (with everything) and the last state.

    The state has (n_groups, ..., WIDTH); lanes that fill the last group up are copies of the last.
    """
    steps, _, lanes = z.shape
    last = [*range(lanes), *[lanes - 1] * (-lanes % WIDTH)]
    z = z[..., last]
    initial_mean = None if initial_mean is None else initial_mean[..., last]
    known = _bank.NO_KNOWN_MODES if known is None else known[..., last].astype(float)
    state = _layout.start(model, len(last), initial_mean)
    work = _layout.workspace(model)
    parts = []
    for span in spans or [slice(0, steps)]:
        part = slice_times(model, span)
        n = len(z[span])
        out = _layout.empty_estimates(part, n, len(last), likelihoods=True, covariance=True)
        for array in (*work, *out):
            array.fill(rubbish)
        _bank.run_span(
            state,
            work,
            _layout.kernel_model(part),
            recursion or _bank.Recursion(),
            np.ascontiguousarray(z[span]),
            out,
            np.ascontiguousarray(known[span]),
        )
        parts.append(Estimates(*(array[..., :lanes] for array in out)))
    return Estimates(*(np.concatenate(p) for p in zip(*parts, strict=True))), state


def unpacked(covariance, n_x):
    """(n_packed, ...) to (n_x, n_x, ...)."""
    a, c = np.tril_indices(n_x)
    full = np.empty((n_x, n_x, *covariance.shape[1:]))
    full[a, c] = covariance
    full[c, a] = covariance
    return full


SMALL = """
name: small
clock: {step_s: 1, duration_s: 40}
truth:
  start: {position_m: [0, 0], speed_m_s: 200, heading_deg: 30}
  legs:
    - {until_s: 14}
    - {until_s: 25, turn_rate_deg_s: 3, mode: turn}
    - {until_s: 40}
sensor: {position_std_m: 20, detection_probability: 0.85}
modes:
  straight: {motion: constant_velocity_zero_acceleration, acceleration_std_m_s2: 0.5}
  turn: {motion: wiener_acceleration, acceleration_std_m_s2: 3}
transition_matrix: [[0.95, 0.05], [0.15, 0.85]]
initial:
  mean: drawn_about_truth
  position_std_m: 20
  velocity_std_m_s: 10
  acceleration_std_m_s2: 0.5
  mode_probabilities: {straight: 0.8, turn: 0.2}
estimators:
  KF: {type: kalman, mode: turn}
  MMAE: {type: mmae}
  IMM: {type: imm}
  RMIMM: {type: rmimm, residual_floor_m: 1}
compare_with: IMM
windows:
  settled: {mode: straight, after_switch_s: 4}
  onset: {mode: turn, within_switch_s: 3}
  middle: {from_s: 10, until_s: 33}
scoring: {skip_scans: 3}
monte_carlo: {runs: 5, seed: 3, keep_tracks: 2}
"""

UNEVEN_TIMES_S = np.concatenate([[0.0], np.cumsum(np.tile([0.5, 1.0, 2.5], 13))])
RANDOM = f"""
name: random
dimensions: 1
clock: {{times_s: [{", ".join(f"{t:g}" for t in UNEVEN_TIMES_S)}]}}
truth:
  chain:
    initial: {{mean: [5, 10], covariance: [[400, 30], [30, 25]]}}
sensor: {{position_std_m: {{calm: 4, rough: 9}}, detection_probability: 0.8}}
modes:
  calm: {{motion: constant_velocity, acceleration_psd_m2_s3: 0.1}}
  rough: {{motion: constant_velocity, acceleration_psd_m2_s3: 60}}
mean_sojourn_s: {{calm: 30, rough: 8}}
initial: {{from_measurements: two_point}}
estimators:
  KF: {{type: kalman, mode: rough}}
  IMM: {{type: imm}}
compare_with: IMM
windows:
  settled: {{mode: calm, after_switch_s: 5}}
  onset: {{within_switch_s: 4}}
monte_carlo: {{runs: 5, seed: 8, keep_tracks: 2}}
"""


def scenario(folder, text, *settings):
    """The experiment of a scenario's text after `key.path=value` settings."""
    file = folder / "scenario.yaml"
    file.write_text(text)
    return load(file, settings)


def read_table(folder, name):
    """A table of a run folder, as a user with pandas has it."""
    return pd.read_parquet(folder / f"{name}.parquet")
