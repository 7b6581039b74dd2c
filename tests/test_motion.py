"""The motion models against the matrix exponential, integration, exact series and their theory."""

import inspect
from fractions import Fraction
from math import factorial

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from hybridtrack.errors import UserError
from hybridtrack.motion import MOTION_MODELS, state_names, white_acceleration_covariance

EPS = np.finfo(float).eps
STEPS = np.array([0.25, 1.0, 4.0, 12.0])
RATE = 0.3  # rad/s; up to 3.6 rad in a step of STEPS
NEEDED = {float: RATE, tuple[float, ...]: (0.7, -1.9)}  # a value for each kind of parameter

# Every model with each of its noises: found from the signatures, so a new model is in too.
VARIANTS = [
    pytest.param(name, noise, id=f"{name}-{noise}")
    for name, model in MOTION_MODELS.items()
    for noise, parameter in inspect.signature(model.discretise).parameters.items()
    if parameter.default is None
]
# What disturbs each model in continuous time: the derivative of which state.
CONTINUOUS = {
    ("constant_velocity", "acceleration_psd_m2_s3"): "v",
    ("constant_velocity_with_input", "acceleration_psd_m2_s3"): "v",
    ("constant_velocity_zero_acceleration", "acceleration_psd_m2_s3"): "v",
    ("coordinated_turn", "acceleration_psd_m2_s3"): "v",
    ("wiener_acceleration", "jerk_psd_m2_s5"): "a",
}
continuous_models = pytest.mark.parametrize(("name", "noise"), CONTINUOUS)


def motion(name, noise, steps=STEPS, strength=1.7):
    """A motion in two dimensions with one noise and the other parameters as NEEDED."""
    discretise = MOTION_MODELS[name].discretise
    needed = {
        parameter.name: NEEDED[parameter.annotation]
        for parameter in inspect.signature(discretise).parameters.values()
        if parameter.kind is parameter.KEYWORD_ONLY and parameter.default is parameter.empty
    }
    return discretise(np.asarray(steps, dtype=float), 2, **needed, **{noise: strength})


def drift(names, turn_rate=0.0):
    """A of dx/dt = A x, entry by entry from the names."""
    matrix = np.zeros((len(names), len(names)))
    at = names.index
    for axis in "xy":
        matrix[at(axis), at("v" + axis)] = 1.0
        if "a" + axis in names:
            matrix[at("v" + axis), at("a" + axis)] = 1.0
    matrix[at("vx"), at("vy")] = turn_rate  # heading north, turning right: vx grows
    matrix[at("vy"), at("vx")] = -turn_rate
    return matrix


def unit_vectors(names, prefix):
    """One column per axis, one at the state `prefix` + axis."""
    return np.eye(len(names))[:, [names.index(prefix + axis) for axis in "xy"]]


def van_loan(drift_matrix, spread, density, step):
    """F and Q by Van Loan 1978, theorem 1: one matrix exponential."""
    n = len(drift_matrix)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n] = -drift_matrix
    block[:n, n:] = density * spread @ spread.T
    block[n:, n:] = drift_matrix.T
    exponential = expm(block * step)
    transition = exponential[n:, n:].T
    return transition, transition @ exponential[:n, n:]


def assert_close(ours, expected, rtol):
    """Equal to rtol of the largest entry: a matrix exponential rounds against its norm."""
    np.testing.assert_allclose(ours, expected, rtol=0, atol=rtol * np.abs(expected).max())


@continuous_models
def test_f_and_continuous_q_are_those_of_van_loan(name, noise):
    names = state_names(MOTION_MODELS[name], 2)
    zeroed = name == "constant_velocity_zero_acceleration"
    kept = [i for i, state in enumerate(names) if not (zeroed and state.startswith("a"))]
    kept_names = tuple(names[i] for i in kept)
    ours = motion(name, noise, strength=0.6)
    matrix = drift(kept_names, RATE if name == "coordinated_turn" else 0.0)
    spread = unit_vectors(kept_names, CONTINUOUS[name, noise])
    for k, step in enumerate(STEPS):
        expected = [np.zeros((len(names), len(names))) for _ in range(2)]
        for whole, part in zip(expected, van_loan(matrix, spread, 0.6, step), strict=True):
            whole[np.ix_(kept, kept)] = part
        # 1e-12: rounding of a scaled and squared exponential of norm up to 1e2
        assert_close(ours.state_transition[k], expected[0], rtol=1e-12)
        assert_close(ours.process_noise_covariance[k], expected[1], rtol=1e-12)


def held_acceleration_gain(names, step):
    """What an acceleration held over the step does to the state, (n_x, 2): by expm."""
    n = len(names)
    block = np.zeros((n + 2, n + 2))
    block[:n, :n] = drift(names)
    block[:n, n:] = unit_vectors(names, "v")
    return expm(block * step)[:n, n:]


@pytest.mark.parametrize("name", ["constant_velocity", "constant_velocity_with_input"])
def test_discrete_white_acceleration_is_held_over_the_step(name):
    ours = motion(name, "acceleration_std_m_s2", strength=3.0)
    for k, step in enumerate(STEPS):
        gain = held_acceleration_gain(("x", "vx", "y", "vy"), step)
        # 1e-13: a few roundings of expm, whose series ends here by itself
        assert_close(ours.process_noise_covariance[k], 9.0 * gain @ gain.T, rtol=1e-13)


def test_known_input_is_held_over_the_step():
    ours = motion("constant_velocity_with_input", "acceleration_psd_m2_s3")
    for k, step in enumerate(STEPS):
        expected = held_acceleration_gain(("x", "vx", "y", "vy"), step) @ NEEDED[tuple[float, ...]]
        assert_close(ours.input_effect[k], expected, rtol=1e-13)  # a few roundings of expm


def test_the_wiener_acceleration_of_sigalov_as_printed():
    """Eq. 16: Bar-Shalom's but for the last entry of Q, which is T and not 1; a covariance."""
    steps = np.array([1.0, 4.0, 10.0])
    printed = MOTION_MODELS["wiener_acceleration_as_printed"].discretise(
        steps, 2, acceleration_std_m_s2=6.0
    )
    ours = motion("wiener_acceleration", "acceleration_std_m_s2", steps, strength=6.0)
    np.testing.assert_array_equal(printed.state_transition, ours.state_transition)
    change = printed.process_noise_covariance - ours.process_noise_covariance
    expected = np.zeros_like(change)
    for a in (2, 5):
        expected[:, a, a] = 36.0 * (steps - 1.0)
    np.testing.assert_allclose(change, expected, atol=1e-12 * 36 * 1e4 / 4)  # of Q's largest entry
    smallest = np.linalg.eigvalsh(printed.process_noise_covariance)[:, 0]
    assert (smallest > -1e-12 * 36 * 1e4 / 4).all()


def test_q_as_printed_is_refused_where_it_is_no_covariance():
    with pytest.raises(UserError, match=r"no covariance for steps below 1 s, and one lasts 0\.5 s"):
        MOTION_MODELS["wiener_acceleration_as_printed"].discretise(
            np.array([2.0, 0.5]), 1, acceleration_std_m_s2=6.0
        )


def test_discrete_wiener_acceleration_adds_its_increment_at_the_start_of_the_step():
    names = ("x", "vx", "ax", "y", "vy", "ay")
    ours = motion("wiener_acceleration", "acceleration_std_m_s2", strength=3.0)
    for k, step in enumerate(STEPS):
        gain = expm(drift(names) * step) @ unit_vectors(names, "a")
        # 1e-13: a few roundings of expm, whose series ends here by itself
        assert_close(ours.process_noise_covariance[k], 9.0 * gain @ gain.T, rtol=1e-13)


def test_zeroed_acceleration_is_constant_velocity_with_a_dead_state():
    for noise in ("acceleration_std_m_s2", "acceleration_psd_m2_s3"):
        large = motion("constant_velocity_zero_acceleration", noise)
        small = motion("constant_velocity", noise)
        alive, dead = [0, 1, 3, 4], [2, 5]
        for ours, expected in zip(large, small, strict=True):
            assert not ours[:, dead].any()
            assert not ours[..., dead].any()
            kept = ours[:, alive] if ours.ndim == 2 else ours[:, alive][:, :, alive]
            np.testing.assert_array_equal(kept, expected)


def test_turn_has_the_discrete_noise_of_constant_velocity():
    turn = motion("coordinated_turn", "acceleration_std_m_s2")
    straight = motion("constant_velocity", "acceleration_std_m_s2")
    np.testing.assert_array_equal(turn.process_noise_covariance, straight.process_noise_covariance)


def composed(name, noise):
    """F and Q of a step of 1.5 s then one of 2.5 s; and F and Q of 4 s."""
    f, _, q = motion(name, noise, [1.5, 2.5, 4.0])
    return (f[1] @ f[0], f[1] @ q[0] @ f[1].T + q[1]), (f[2], q[2])


@pytest.mark.parametrize(("name", "noise"), VARIANTS)
def test_two_steps_are_one_for_f(name, noise):
    (two_steps, _), (one_step, _) = composed(name, noise)
    assert_close(two_steps, one_step, rtol=1e-14)  # a handful of roundings


@pytest.mark.parametrize(("name", "noise"), VARIANTS)
def test_two_steps_are_one_for_q_only_in_continuous_time(name, noise):
    (_, two_steps), (_, one_step) = composed(name, noise)
    if (name, noise) in CONTINUOUS:
        assert_close(two_steps, one_step, rtol=1e-14)  # a handful of roundings
    else:  # a draw per step: two independent ones are less than one that is held
        assert np.abs(two_steps - one_step).max() > 0.05 * np.abs(one_step).max()


def turn(rate, steps=STEPS, **noise):
    return MOTION_MODELS["coordinated_turn"].discretise(
        np.asarray(steps, dtype=float), 2, turn_rate_rad_s=rate, **noise
    )


@pytest.mark.parametrize("rate", [RATE, -0.05])
def test_turn_follows_the_integrated_motion(rate):
    start = np.array([100.0, 210.0, -50.0, 80.0])

    def derivative(_, state):
        _, vx, _, vy = state
        return [vx, rate * vy, vy, -rate * vx]

    path = solve_ivp(
        derivative, (0, STEPS[-1]), start, method="DOP853", t_eval=STEPS, rtol=1e-12, atol=1e-9
    )
    ours = turn(rate, acceleration_std_m_s2=1.0).state_transition @ start
    np.testing.assert_allclose(ours, path.y.T, rtol=0, atol=1e-6)  # m: the integrator's, summed


def series(x, first):
    """sum of (-1)^k x^(2k) / (2k + first)!, exactly rational: x is a Fraction."""
    return sum((-1) ** k * x ** (2 * k) / Fraction(factorial(2 * k + first)) for k in range(20))


@pytest.mark.parametrize("angle", [0.0, 1e-160, 1e-12, -1e-12, 1e-6, 1e-3, 0.1, 0.99, 1.01, -1.9])
def test_turn_keeps_full_relative_precision_at_every_rate(angle):
    step = 4.0  # a power of two: rate * step is the angle exactly
    ours = turn(angle / step, [step], acceleration_psd_m2_s3=1.0)
    x, t = Fraction(angle), Fraction(step)
    x = x if abs(angle) > 1e-100 else Fraction(0)  # x^2 is nothing beside 1; spares huge integers
    linear = Fraction(angle)
    f, q = ours.state_transition[0], ours.process_noise_covariance[0]
    got = [f[0, 1], f[0, 3], f[1, 3], f[1, 1], q[0, 0], q[0, 1], q[1, 2], q[1, 1]]
    exact = [
        t * series(x, 1),  # sin(wT) / w
        t * linear * series(x, 2),  # (1 - cos(wT)) / w
        linear * series(x, 1),  # sin(wT)
        series(x, 0),  # cos(wT)
        2 * t**3 * series(x, 3),  # 2 (wT - sin(wT)) / w^3
        t**2 * series(x, 2),  # (1 - cos(wT)) / w^2
        t**2 * linear * series(x, 3),  # (wT - sin(wT)) / w^2
        t,
    ]
    # 16 eps: up to ten roundings, and x - sin(x) costs a factor 6 just above 1, where it's used
    np.testing.assert_allclose(got, [float(value) for value in exact], rtol=16 * EPS, atol=0)


def test_turn_at_rate_zero_is_constant_velocity():
    for noise in ("acceleration_std_m_s2", "acceleration_psd_m2_s3"):
        straight = motion("constant_velocity", noise, strength=2.0)
        for ours, expected in zip(turn(0.0, **{noise: 2.0}), straight, strict=True):
            np.testing.assert_allclose(ours, expected, rtol=4 * EPS, atol=0)  # 2 / 6 for 1 / 3


def test_right_turn_turns_right():
    # North at 100 m/s, 3 deg/s for 30 s: east, after a quarter of a circle of radius v / w.
    rate, speed = np.radians(3.0), 100.0
    transition = turn(rate, [30.0], acceleration_std_m_s2=1.0).state_transition[0]
    radius = speed / rate
    # 1e-9: rounding at 2 km is 5e-13 m, times a few operations
    expected = [radius, speed, radius, 0.0]
    np.testing.assert_allclose(transition @ [0, 0, 0, speed], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("rate", [1e-9, 0.05, 1.0, 2.0])
def test_turn_keeps_the_speed_and_left_undoes_right(rate):
    steps = np.random.default_rng(7).uniform(1e-3, 100, 200)
    right = turn(rate, steps, acceleration_psd_m2_s3=1.0)
    left = turn(-rate, steps, acceleration_psd_m2_s3=1.0)
    rotation = right.state_transition[:, [1, 3]][:, :, [1, 3]]
    back = left.state_transition[:, [1, 3]][:, :, [1, 3]]
    same = np.broadcast_to(np.eye(2), rotation.shape)
    transposed = rotation.transpose(0, 2, 1)
    # 8 eps: four roundings
    np.testing.assert_allclose(rotation @ transposed, same, rtol=0, atol=8 * EPS)
    np.testing.assert_allclose(back @ rotation, same, rtol=0, atol=8 * EPS)
    swap = [2, 3, 0, 1]  # left is right in a mirror that exchanges east and north
    for ours, mirrored in zip(left, right, strict=True):
        expected = mirrored[:, swap] if mirrored.ndim == 2 else mirrored[:, swap][:, :, swap]
        np.testing.assert_array_equal(ours, expected)


@pytest.mark.parametrize(("name", "noise"), VARIANTS)
def test_every_motion_has_the_shapes_and_a_covariance(name, noise):
    n, n_x = len(STEPS), len(state_names(MOTION_MODELS[name], 2))
    ours = motion(name, noise)
    assert [field.shape for field in ours] == [(n, n_x, n_x), (n, n_x), (n, n_x, n_x)]
    assert all(field.dtype == np.float64 for field in ours)
    for covariance in ours.process_noise_covariance:
        np.testing.assert_array_equal(covariance, covariance.T)
        eigenvalues = np.linalg.eigvalsh(covariance)
        assert eigenvalues[-1] > 0
        assert eigenvalues[0] > -1e-14 * eigenvalues[-1]  # rounding of the solver, n_x eps


@pytest.mark.parametrize(("name", "noise"), VARIANTS)
def test_all_steps_at_once_are_one_at_a_time(name, noise):
    steps = np.linspace(0.1, 9.7, 11)  # 11: whole vector registers and a rest
    together = motion(name, noise, steps)
    for k, step in enumerate(steps):
        for ours, alone in zip(together, motion(name, noise, [step]), strict=True):
            # 4 eps: sin of a vector may differ in the last place; atol for what it leaves near 0
            np.testing.assert_allclose(ours[k], alone[0], rtol=4 * EPS, atol=4 * EPS)


@pytest.mark.parametrize(
    ("name", "noise"), [v for v in VARIANTS if v.values[0] != "coordinated_turn"]
)
def test_two_dimensions_are_two_of_one_in_the_order_of_the_names(name, noise):
    model, plane = MOTION_MODELS[name], motion(name, noise)
    names = state_names(model, 2)
    for i, axis in enumerate("xy"):
        own = [k for k, state in enumerate(names) if state.endswith(axis)]
        other = [k for k in range(len(names)) if k not in own]
        needed = (
            {"acceleration_m_s2": NEEDED[tuple[float, ...]][i : i + 1]}
            if "acceleration_m_s2" in inspect.signature(model.discretise).parameters
            else {}
        )
        line = model.discretise(STEPS, 1, **needed, **{noise: 1.7})
        assert len(own) == len(state_names(model, 1))
        np.testing.assert_array_equal(plane.input_effect[:, own], line.input_effect)
        for field in ("state_transition", "process_noise_covariance"):
            matrices = getattr(plane, field)
            np.testing.assert_array_equal(matrices[:, own][:, :, own], getattr(line, field))
            assert not matrices[:, own][:, :, other].any()


def test_state_names_go_axis_by_axis():
    wiener, turning = MOTION_MODELS["wiener_acceleration"], MOTION_MODELS["coordinated_turn"]
    assert state_names(wiener, 2) == ("x", "vx", "ax", "y", "vy", "ay")
    assert state_names(wiener, 1) == ("x", "vx", "ax")
    assert state_names(turning, 2) == ("x", "vx", "y", "vy")


def test_every_model_says_what_it_is():
    assert {name for name, _ in CONTINUOUS} <= set(MOTION_MODELS)
    for name, model in MOTION_MODELS.items():
        assert model.name == name == model.discretise.__name__
        assert set(model.axis_states) <= {"position", "velocity", "acceleration"}
        assert any(
            word.isdigit() and len(word) == 4 for word in model.source.replace(",", "").split()
        )
        assert model.summary.endswith(".")
        parameters = list(inspect.signature(model.discretise).parameters.values())
        assert [p.name for p in parameters[:2]] == ["step_s", "dimensions"]
        for parameter in parameters[2:]:  # what the reader of scenarios can read
            assert parameter.kind is parameter.KEYWORD_ONLY
            assert parameter.annotation in (float, float | None, tuple[float, ...])


def test_added_noise_is_that_of_constant_velocity_wherever_the_states_stand():
    names = ("heading", "vy", "x", "y", "bias", "vx")
    ours = white_acceleration_covariance(STEPS, names, 1.7)
    expected = motion("constant_velocity", "acceleration_std_m_s2").process_noise_covariance
    place = [names.index(name) for name in ("x", "vx", "y", "vy")]
    np.testing.assert_array_equal(ours[:, place][:, :, place], expected)
    rest = [names.index("heading"), names.index("bias")]
    assert not ours[:, rest].any()
    assert not ours[:, :, rest].any()


def test_added_noise_with_accelerations_and_on_one_axis():
    ours = white_acceleration_covariance(STEPS, ("x", "vx", "ax"), 1.7)
    expected = MOTION_MODELS["constant_velocity_zero_acceleration"].discretise(
        STEPS, 1, acceleration_std_m_s2=1.7
    )
    np.testing.assert_array_equal(ours, expected.process_noise_covariance)


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("constant_velocity", {}, ["acceleration_std_m_s2", "acceleration_psd_m2_s3", "none"]),
        (
            "constant_velocity",
            {"acceleration_std_m_s2": 0.25, "acceleration_psd_m2_s3": 3.5},
            ["acceleration_std_m_s2 0.25", "acceleration_psd_m2_s3 3.5", "exactly one"],
        ),
        ("constant_velocity", {"acceleration_std_m_s2": -0.5}, ["acceleration_std_m_s2", "-0.5"]),
        ("constant_velocity", {"acceleration_std_m_s2": np.nan}, ["acceleration_std_m_s2", "nan"]),
        ("wiener_acceleration", {"jerk_psd_m2_s5": -2.0}, ["jerk_psd_m2_s5", "-2.0"]),
        ("wiener_acceleration", {}, ["acceleration_std_m_s2", "jerk_psd_m2_s5", "none"]),
        (
            "constant_velocity_with_input",
            {"acceleration_m_s2": (1.5,), "acceleration_std_m_s2": 1.0},
            ["acceleration_m_s2", "[1.5]", "2 dimension"],
        ),
        (
            "constant_velocity_with_input",
            {"acceleration_m_s2": (1.5, np.inf), "acceleration_std_m_s2": 1.0},
            ["acceleration_m_s2", "inf"],
        ),
        (
            "coordinated_turn",
            {"dimensions": 1, "turn_rate_rad_s": 0.05, "acceleration_std_m_s2": 1.0},
            ["coordinated_turn", "2 dimensions", "1"],
        ),
        ("coordinated_turn", {"turn_rate_rad_s": 0.05}, ["acceleration_std_m_s2", "none"]),
        (
            "constant_velocity",
            {"dimensions": 3, "acceleration_std_m_s2": 1.0},
            ["dimensions", "3"],
        ),
        (
            "constant_velocity",
            {"step_s": np.array([1.0, -0.125]), "acceleration_std_m_s2": 1.0},
            ["step_s", "-0.125"],
        ),
        (
            "constant_velocity",
            {"step_s": np.array([1.0, np.nan]), "acceleration_std_m_s2": 1.0},
            ["step_s", "nan"],
        ),
    ],
)
def test_a_mistake_is_one_sentence_with_the_parameter_and_its_value(name, changes, words):
    arguments = {"step_s": STEPS, "dimensions": 2, **changes}
    with pytest.raises(UserError) as caught:
        MOTION_MODELS[name].discretise(**arguments)
    assert all(word in str(caught.value) for word in words), str(caught.value)


@pytest.mark.parametrize(
    ("steps", "names", "std", "words"),
    [
        ([0.0], ("x", "vx"), 1.0, ["step_s", "0.0"]),
        ([1.0], ("x", "vx"), -1.5, ["acceleration_std_m_s2", "-1.5"]),
        ([1.0], ("x", "vx"), np.inf, ["acceleration_std_m_s2", "inf"]),
        ([1.0], ("x", "y", "heading"), 1.0, ["x", "y", "heading", "velocity"]),
    ],
)
def test_added_noise_refuses_what_it_cannot_lay_on(steps, names, std, words):
    with pytest.raises(UserError) as caught:
        white_acceleration_covariance(np.array(steps), names, std)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_steps_must_be_an_array_of_one_axis():
    with pytest.raises(ValueError, match=r"\(1, 4\)"):
        MOTION_MODELS["constant_velocity"].discretise(STEPS[None], 1, acceleration_std_m_s2=1.0)
