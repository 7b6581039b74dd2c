"""The motion models by name: state transition, input effect, process noise; each with its source.

States are ordered axis by axis (x, vx, ax, y, vy, ay); x points east, y north, and a heading runs
clockwise from north, so a positive turn rate turns right. Everything is SI and radians.

A new model is one function here, under `motion_model`. Its keyword-only parameters are what a
scenario may set: float, `float | None` or `tuple[float, ...]`, the unit in the name's suffix.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.errors import UserError

FloatArray = NDArray[np.float64]

AXES = ("x", "y")
PREFIX = {"position": "", "velocity": "v", "acceleration": "a"}


class Motion(NamedTuple):
    """x[k] = F x[k-1] + B u + w, w ~ N(0, Q), for each of n step lengths."""

    state_transition: FloatArray  # (n, n_x, n_x)   F
    input_effect: FloatArray  # (n, n_x)   B u
    process_noise_covariance: FloatArray  # (n, n_x, n_x)   Q


Discretise = Callable[..., Motion]


class MotionModel(NamedTuple):
    """One named model; `discretise(step_s, dimensions, **parameters)` gives its Motion."""

    name: str
    axis_states: tuple[str, ...]  # the kinds of one axis' states, keys of PREFIX
    discretise: Discretise
    source: str  # author, year, section
    summary: str


_models: dict[str, MotionModel] = {}
MOTION_MODELS: Mapping[str, MotionModel] = MappingProxyType(_models)


def motion_model(
    *, axis_states: tuple[str, ...], source: str
) -> Callable[[Discretise], Discretise]:
    """Enter a function in MOTION_MODELS under its own name; its docstring's first line sums it up.

    The function is entered (and returned) with the checks that every model needs: steps positive,
    one or two dimensions, parameters finite.
    """

    def register(discretise: Discretise) -> Discretise:
        @functools.wraps(discretise)
        def checked(step_s: FloatArray, dimensions: int, **parameters: object) -> Motion:
            if dimensions not in (1, 2):
                raise UserError(f"dimensions is {dimensions}; a motion has 1 or 2 dimensions.")
            for parameter, value in parameters.items():
                _check_finite(parameter, value)
            return discretise(_checked_steps(step_s), dimensions, **parameters)

        name = discretise.__name__
        summary = (discretise.__doc__ or "").partition("\n")[0]
        _models[name] = MotionModel(name, axis_states, checked, source, summary)
        return checked

    return register


def state_names(model: MotionModel, dimensions: int) -> tuple[str, ...]:
    """The names of the model's states in their order, such as ("x", "vx", "y", "vy")."""
    return tuple(PREFIX[kind] + axis for axis in AXES[:dimensions] for kind in model.axis_states)


@motion_model(
    axis_states=("position", "velocity"),
    source="Bar-Shalom, Li, Kirubarajan 2001, sec. 6.3.2 (std) and 6.2.2 (psd)",
)
def constant_velocity(
    step_s: FloatArray,
    dimensions: int,
    *,
    acceleration_std_m_s2: float | None = None,
    acceleration_psd_m2_s3: float | None = None,
) -> Motion:
    """Constant velocity, disturbed by a white acceleration.

    The disturbance is either constant over each step, of the standard deviation given (discrete
    white noise acceleration, DWNA), or continuous, of the power spectral density given (CWNA).

    step_s is (n,), in s. Raises UserError unless exactly one of the two is given.
    """
    noise = _white_acceleration(step_s, acceleration_std_m_s2, acceleration_psd_m2_s3)
    return _motion(_matrices([[1.0, step_s], [0.0, 1.0]]), noise, dimensions)


@motion_model(
    axis_states=("position", "velocity"),
    source="Bar-Shalom, Li, Kirubarajan 2001, sec. 6.3.2 (std) and 6.2.2 (psd), with a known input",
)
def constant_velocity_with_input(
    step_s: FloatArray,
    dimensions: int,
    *,
    acceleration_m_s2: tuple[float, ...],
    acceleration_std_m_s2: float | None = None,
    acceleration_psd_m2_s3: float | None = None,
) -> Motion:
    """Constant velocity, driven by a known constant acceleration and disturbed by a white one.

    B u = [T²/2, T] u on each axis; F and Q are those of `constant_velocity`.

    step_s is (n,), in s; acceleration_m_s2 has one number per axis, else UserError.
    """
    if len(acceleration_m_s2) != dimensions:
        raise UserError(
            f"acceleration_m_s2 is {list(acceleration_m_s2)}, but the motion has {dimensions} "
            f"dimension(s); give one number per axis."
        )
    motion = constant_velocity(
        step_s,
        dimensions,
        acceleration_std_m_s2=acceleration_std_m_s2,
        acceleration_psd_m2_s3=acceleration_psd_m2_s3,
    )
    acceleration = np.asarray(acceleration_m_s2, dtype=np.float64)
    effect = acceleration[:, np.newaxis] * _step_gain(step_s)[:, np.newaxis, :]
    return motion._replace(input_effect=effect.reshape(len(effect), -1))


@motion_model(
    axis_states=("position", "velocity", "acceleration"),
    source="Hwang, Balakrishnan, Tomlin 2006, sec. 5",
)
def constant_velocity_zero_acceleration(
    step_s: FloatArray,
    dimensions: int,
    *,
    acceleration_std_m_s2: float | None = None,
    acceleration_psd_m2_s3: float | None = None,
) -> Motion:
    """Constant velocity in a state vector with an acceleration, which is held at zero.

    F = [[1, T, 0], [0, 1, 0], [0, 0, 0]]; Q is that of `constant_velocity`, zero on the
    acceleration. For a bank whose other modes have an acceleration.

    step_s is (n,), in s. Raises UserError unless exactly one of the two noises is given.
    """
    transition = _matrices([[1.0, step_s, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    noise = _white_acceleration(step_s, acceleration_std_m_s2, acceleration_psd_m2_s3)
    return _motion(transition, np.pad(noise, ((0, 0), (0, 1), (0, 1))), dimensions)


@motion_model(
    axis_states=("position", "velocity"),
    source="Bar-Shalom, Li, Kirubarajan 2001, eq. 11.7.1-4, the sense of the turn reversed",
)
def coordinated_turn(
    step_s: FloatArray,
    dimensions: int,
    *,
    turn_rate_rad_s: float,
    acceleration_std_m_s2: float | None = None,
    acceleration_psd_m2_s3: float | None = None,
) -> Motion:
    """A turn at a known constant rate, positive to the right, disturbed by a white acceleration.

    With w the rate and v = (vx, vy), the velocity turns clockwise:
    vx' = vx cos(wT) + vy sin(wT), vy' = -vx sin(wT) + vy cos(wT). At w = 0 it is
    `constant_velocity`. The noise of a given standard deviation is laid on as in
    `constant_velocity`, G = [T²/2, T] on each axis, as in the source; that of a given density is
    integrated along the turn, Q = q integral of F(s) D D' F(s)' over 0..T, exactly.

    step_s is (n,), in s. Two dimensions only, and exactly one of the two noises, else UserError.
    """
    if dimensions != 2:
        raise UserError(
            f"coordinated_turn with turn_rate_rad_s {turn_rate_rad_s} needs 2 dimensions, not "
            f"{dimensions}; choose another motion for a single axis."
        )
    angle = turn_rate_rad_s * step_s
    sine, cosine = np.sin(angle), np.cos(angle)
    along = step_s * _sinc(angle)  # sin(wT) / w
    across = step_s * np.sin(angle / 2) * _sinc(angle / 2)  # (1 - cos(wT)) / w
    transition = _matrices(
        [
            [1.0, along, 0.0, across],
            [0.0, cosine, 0.0, sine],
            [0.0, -across, 1.0, along],
            [0.0, -sine, 0.0, cosine],
        ]
    )
    kind, strength = _the_one_noise(
        acceleration_std_m_s2=acceleration_std_m_s2, acceleration_psd_m2_s3=acceleration_psd_m2_s3
    )
    if kind == "acceleration_psd_m2_s3":
        noise = strength * _turning_noise(step_s, angle)
    else:
        noise = _on_every_axis(strength**2 * _outer(_step_gain(step_s)), dimensions)
    return Motion(transition, np.zeros((len(step_s), 4)), noise)


@motion_model(
    axis_states=("position", "velocity", "acceleration"),
    source="Bar-Shalom, Li, Kirubarajan 2001, sec. 6.3.3 (std) and 6.2.3 (psd)",
)
def wiener_acceleration(
    step_s: FloatArray,
    dimensions: int,
    *,
    acceleration_std_m_s2: float | None = None,
    jerk_psd_m2_s5: float | None = None,
) -> Motion:
    """An acceleration that wanders as a Wiener process.

    Either the acceleration's increment over each step has the standard deviation given (discrete
    Wiener process acceleration, DWPA: Q = G G' std², G = [T²/2, T, 1]), or a continuous white
    jerk has the power spectral density given (CWPA).

    step_s is (n,), in s. Raises UserError unless exactly one of the two is given.
    """
    step = step_s
    transition = _matrices([[1.0, step, step**2 / 2], [0.0, 1.0, step], [0.0, 0.0, 1.0]])
    kind, strength = _the_one_noise(
        acceleration_std_m_s2=acceleration_std_m_s2, jerk_psd_m2_s5=jerk_psd_m2_s5
    )
    if kind == "jerk_psd_m2_s5":
        noise = strength * _matrices(
            [
                [step**5 / 20, step**4 / 8, step**3 / 6],
                [step**4 / 8, step**3 / 3, step**2 / 2],
                [step**3 / 6, step**2 / 2, step],
            ]
        )
    else:
        gain = np.stack([step**2 / 2, step, np.ones_like(step)], axis=-1)
        noise = strength**2 * _outer(gain)
    return _motion(transition, noise, dimensions)


@motion_model(
    axis_states=("position", "velocity", "acceleration"),
    source="Sigalov, Oshman 2011, eq. 16 as printed",
)
def wiener_acceleration_as_printed(
    step_s: FloatArray, dimensions: int, *, acceleration_std_m_s2: float
) -> Motion:
    """Wiener acceleration with T where `wiener_acceleration` has 1, as Sigalov 2011 prints it.

    Q = G G' std², G = [T²/2, T, 1], but for its last entry, which is T std². To repeat the paper;
    units do not fit. step_s is (n,), in s. Raises UserError for steps below 1 s, where this Q is
    no covariance.
    """
    shortest = float(np.min(step_s))
    if shortest < 1.0:
        raise UserError(
            f"Q as printed is no covariance for steps below 1 s, and one lasts {shortest:g} s; use "
            "wiener_acceleration."
        )
    motion = wiener_acceleration(step_s, dimensions, acceleration_std_m_s2=acceleration_std_m_s2)
    noise = motion.process_noise_covariance
    last = np.arange(2, noise.shape[-1], 3)
    noise[:, last, last] *= step_s[:, np.newaxis]
    return motion


def white_acceleration_covariance(
    step_s: FloatArray, names: tuple[str, ...], acceleration_std_m_s2: float
) -> FloatArray:
    """The noise of a white acceleration, constant over each step, on any named state vector.

    DWNA's Q (Bar-Shalom, Li, Kirubarajan 2001, sec. 6.3.2) on every pair of a position and its
    velocity (x and vx, y and vy), independent between axes and zero elsewhere: the process noise
    that Maybeck adds to a filter that trusts its model too much.

    step_s is (n,), in s; the answer is (n, n_x, n_x) with n_x = len(names). Raises UserError if
    no position has its velocity beside it, if a step isn't positive or the std is negative.
    """
    step_s = _checked_steps(step_s)
    _check_finite("acceleration_std_m_s2", acceleration_std_m_s2)
    _, std = _the_one_noise(acceleration_std_m_s2=acceleration_std_m_s2)
    pairs = [[names.index(name), names.index("v" + name)] for name in names if "v" + name in names]
    if not pairs:
        raise UserError(
            f"acceleration_std_m_s2 {std} can't be laid on the states {list(names)}; it needs a "
            f"position and its velocity, such as x and vx."
        )
    covariance = np.zeros((len(step_s), len(names), len(names)))
    for pair in pairs:
        covariance[np.ix_(range(len(step_s)), pair, pair)] = std**2 * _outer(_step_gain(step_s))
    return covariance


def _white_acceleration(step_s: FloatArray, std: float | None, psd: float | None) -> FloatArray:
    """DWNA's or CWNA's Q for one axis, (n, 2, 2)."""
    kind, strength = _the_one_noise(acceleration_std_m_s2=std, acceleration_psd_m2_s3=psd)
    if kind == "acceleration_psd_m2_s3":
        return strength * _matrices([[step_s**3 / 3, step_s**2 / 2], [step_s**2 / 2, step_s]])
    return strength**2 * _outer(_step_gain(step_s))


def _turning_noise(step_s: FloatArray, angle: FloatArray) -> FloatArray:
    """The Q of a continuous white acceleration of unit density along a turn, (n, 4, 4).

    With A(s) = the integral of the rotation over 0..s, F's block from velocity to position, the
    blocks of Q are the integrals of A A', A R' = A' and R R' = I over 0..T.
    """
    position = 2 * step_s**3 * _sine_remainder(angle)  # 2 (wT - sin(wT)) / w³
    along = (step_s * _sinc(angle / 2)) ** 2 / 2  # (1 - cos(wT)) / w²
    across = step_s**2 * angle * _sine_remainder(angle)  # (wT - sin(wT)) / w²
    return _matrices(
        [
            [position, along, 0.0, -across],
            [along, step_s, across, 0.0],
            [0.0, across, position, along],
            [-across, 0.0, along, step_s],
        ]
    )


def _sinc(angle: FloatArray) -> FloatArray:
    """sin(x) / x, 1 at 0."""
    return np.divide(np.sin(angle), angle, out=np.ones_like(angle), where=angle != 0)


def _sine_remainder(angle: FloatArray) -> FloatArray:
    """(x - sin(x)) / x³, 1/6 at 0, to full precision."""
    size = np.abs(angle)
    small = size < 1  # where the difference would lose digits
    square = np.where(small, size, 0.0) ** 2
    series = np.zeros_like(size)
    for k in reversed(range(9)):  # the first term left out is x^18 / 21!, under 1e-19
        series = (-1) ** k / math.factorial(2 * k + 3) + square * series
    large = np.where(small, 1.0, size)
    return np.where(small, series, (large - np.sin(large)) / large**3)


def _step_gain(step_s: FloatArray) -> FloatArray:
    """What an acceleration held over a step does to position and velocity, (n, 2)."""
    return np.stack([step_s**2 / 2, step_s], axis=-1)


def _outer(gain: FloatArray) -> FloatArray:
    """G G', (n, n_x, n_x), of gains (n, n_x)."""
    return gain[:, :, np.newaxis] * gain[:, np.newaxis, :]


def _matrices(rows: Sequence[Sequence[FloatArray | float]]) -> FloatArray:
    """Matrices (n, rows, columns) of entries that are numbers or (n,)."""
    entries = np.broadcast_arrays(*(entry for row in rows for entry in row))
    return np.stack(entries, axis=-1).reshape(-1, len(rows), len(rows[0]))


def _on_every_axis(block: FloatArray, dimensions: int) -> FloatArray:
    """One axis' matrices, (n, m, m), repeated along the diagonal, once per axis."""
    blocks: FloatArray = np.einsum("ij,nab->niajb", np.eye(dimensions), block)
    side = dimensions * block.shape[-1]
    return blocks.reshape(len(block), side, side)


def _motion(transition: FloatArray, noise: FloatArray, dimensions: int) -> Motion:
    """The motion of independent axes that share one F and Q, (n, m, m); no input."""
    no_input = np.zeros((len(transition), dimensions * transition.shape[-1]))
    return Motion(
        _on_every_axis(transition, dimensions), no_input, _on_every_axis(noise, dimensions)
    )


def _the_one_noise(**strengths: float | None) -> tuple[str, float]:
    """The name and value of the only strength given; UserError unless it is one and >= 0."""
    given = [(name, value) for name, value in strengths.items() if value is not None]
    if len(given) != 1:
        found = " and ".join(f"{name} {value}" for name, value in given) or "none"
        raise UserError(f"Give exactly one of {' and '.join(strengths)}; found {found}.")
    name, value = given[0]
    if value < 0:
        raise UserError(f"{name} is {value}; give a number that is zero or positive.")
    return name, value


def _check_finite(name: str, value: object) -> None:
    """UserError if a parameter is infinite or not a number; None is a parameter left out."""
    if value is not None and not np.all(np.isfinite(np.asarray(value, dtype=np.float64))):
        raise UserError(f"{name} is {value}; give finite numbers.")


def _checked_steps(step_s: FloatArray) -> FloatArray:
    """Steps as float64, (n,); UserError unless every one is positive and finite."""
    steps = np.asarray(step_s, dtype=np.float64)
    if steps.ndim != 1:
        raise ValueError(f"step_s has the shape {steps.shape}; it must be (n,)")
    wrong = steps[~((steps > 0) & np.isfinite(steps))]
    if wrong.size:
        raise UserError(f"step_s contains {wrong[0]}; every step must be positive and finite.")
    return steps
