"""Legs against circles and a numerical integration, chains against their exact moments, streams
against themselves under every cut.

Monte Carlo tolerances are 5 standard errors: 6e-7 per comparison if all is well, and the seeds
are fixed. `SIGMAS` is that 5.
"""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from hybridtrack import jumps
from hybridtrack.chains import Bound
from hybridtrack.errors import UserError
from hybridtrack.jumps import ChainTruth
from hybridtrack.models import Mode, ModeBank, generator_from_sojourns
from hybridtrack.motion import Motion
from hybridtrack.sensors import Outliers, Sensor
from hybridtrack.simulation import (
    BLOCK_RUNS,
    BlockSimulation,
    Case,
    FixedTruth,
    Leg,
    Purpose,
    fly,
    spans,
    stream,
    two_point_start,
)
from models import random_model

SIGMAS = 5.0
ROUNDING = 1e-9  # metres at 1e5 m: 1e-16 relative, some 1e2 operations


def simulate(
    case, sensor, *, seed=1, case_index=0, block=0, lanes=BLOCK_RUNS, length=1000, foresees=False
):
    """One block whole: (initial state, state, mode, since_switch_s, measurements).

    With `foresees` also whether the mode is the last one, before the measurements.
    """
    simulation = BlockSimulation(case, sensor, seed, case_index, block, lanes, foresees=foresees)
    parts = [simulation.advance(span) for span in spans(len(case.times_s) - 1, length)]
    joined = [np.concatenate(arrays) for arrays in zip(*(p.truth for p in parts), strict=True)]
    if not foresees:
        assert joined.pop().size == 0
    return simulation.initial_state, *joined, np.concatenate([p.measurements for p in parts])


def assert_mean(samples, expected):
    """The mean over the last axis is the one expected, give or take SIGMAS standard errors."""
    error = samples.std(axis=-1, ddof=1) / math.sqrt(samples.shape[-1])
    assert (np.abs(samples.mean(axis=-1) - expected) <= SIGMAS * error + ROUNDING).all()


# ---- legs ------------------------------------------------------------------------------------


def integrated(legs, times_s, position_m, heading_rad):
    """x' = v sin(heading), y' = v cos(heading), heading' = turn rate, leg by leg."""
    state, begin, rows = np.array([*position_m, heading_rad]), times_s[0], []
    for number, leg in enumerate(legs):

        def slope(_, s, leg=leg):
            velocity = leg.speed_m_s * np.array([np.sin(s[2]), np.cos(s[2])])
            return np.array([*velocity, leg.turn_rate_rad_s])

        here = times_s[(times_s <= leg.until_s) & ((times_s > begin) | (number == 0))]
        solution = solve_ivp(
            slope, (begin, leg.until_s), state, "DOP853", dense_output=True, rtol=1e-11, atol=1e-9
        )
        for x, y, heading in solution.sol(np.append(here, leg.until_s)).T[:-1]:
            vx, vy = leg.speed_m_s * np.array([np.sin(heading), np.cos(heading)])
            rows.append([x, vx, y, vy])
        state, begin = solution.sol(leg.until_s), leg.until_s
    return np.array(rows)


LEGS = (
    Leg(30.0, 0.0, 240.0, 0),
    Leg(47.3, math.radians(-3.0), 240.0, 1),
    Leg(60.0, math.radians(4.5), 180.0, 2),
    Leg(75.0, 0.0, 180.0, 0),
)


@pytest.mark.parametrize("times_s", [np.arange(76.0), np.array([0.0, 0.3, 29.0, 31.5, 47.3, 75.0])])
def test_legs_follow_the_heading_equation(times_s):
    truth = fly(LEGS, times_s, (100.0, -50.0), 1.2)
    # The integration's own error, its interpolation's above all: 1e-11 per step asked for.
    expected = integrated(LEGS, times_s, (100.0, -50.0), 1.2)
    np.testing.assert_allclose(truth.state, expected, rtol=0.0, atol=1e-4)
    assert truth.state_names == ("x", "vx", "y", "vy")


@settings(max_examples=100, deadline=None)
@given(
    turn_rate=st.floats(1e-3, 1.0).flatmap(lambda w: st.sampled_from([w, -w])),
    speed=st.floats(1.0, 300.0),
    heading=st.floats(-7.0, 7.0),
)
def test_a_turn_is_an_exact_circle_about_a_centre_abeam(turn_rate, speed, heading):
    times_s = np.linspace(0.0, 40.0, 17)
    state = fly((Leg(40.0, turn_rate, speed, 0),), times_s, (3.0, 4.0), heading).state
    # The centre of a right turn lies to the right of the nose: v/w along (cos, -sin)(heading).
    radius = speed / turn_rate
    centre = np.array([3.0, 4.0]) + radius * np.array([np.cos(heading), -np.sin(heading)])
    angle = heading + turn_rate * times_s
    circle = centre[:, None] - radius * np.array([np.cos(angle), -np.sin(angle)])
    # The oracle loses digits where the radius is long: 3e5 m, 1e-16 relative, a few operations.
    np.testing.assert_allclose(state[:, [0, 2]].T, circle, rtol=0.0, atol=ROUNDING)
    velocity = speed * np.array([np.sin(angle), np.cos(angle)])
    np.testing.assert_allclose(state[:, [1, 3]].T, velocity, rtol=0.0, atol=ROUNDING)


def test_headings_run_clockwise_from_north_and_right_turns_are_positive():
    times_s = np.array([0.0, 10.0])
    quarter = math.pi / 2
    north = fly((Leg(10.0, 0.0, 5.0, 0),), times_s, (0.0, 0.0), 0.0).state[-1]
    east = fly((Leg(10.0, 0.0, 5.0, 0),), times_s, (0.0, 0.0), quarter).state[-1]
    right = fly((Leg(10.0, quarter / 10, 5.0, 0),), times_s, (0.0, 0.0), 0.0).state[-1]
    left = fly((Leg(10.0, -quarter / 10, 5.0, 0),), times_s, (0.0, 0.0), 0.0).state[-1]
    radius = 50.0 / quarter
    np.testing.assert_allclose(north, [0.0, 0.0, 50.0, 5.0], rtol=0.0, atol=ROUNDING)
    np.testing.assert_allclose(east, [50.0, 5.0, 0.0, 0.0], rtol=0.0, atol=ROUNDING)
    np.testing.assert_allclose(right, [radius, 5.0, radius, 0.0], rtol=0.0, atol=ROUNDING)
    np.testing.assert_allclose(left, [-radius, -5.0, radius, 0.0], rtol=0.0, atol=ROUNDING)


def test_position_and_heading_are_continuous_where_legs_meet():
    instant = 1e-6
    for leg, following in itertools.pairwise(LEGS):
        times_s = np.array([0.0, leg.until_s, leg.until_s + instant])
        state = fly(LEGS, times_s, (0.0, 0.0), 0.3).state
        moved = np.hypot(*(state[2, [0, 2]] - state[1, [0, 2]]))
        # At up to 240 m/s; the rounding of positions of 1e4 m stays below.
        assert moved == pytest.approx(following.speed_m_s * instant, abs=1e-10)
        before, after = (np.arctan2(s[1], s[3]) for s in state[1:])
        assert after - before == pytest.approx(following.turn_rate_rad_s * instant, abs=1e-12)


def test_a_turn_rate_that_vanishes_is_a_straight_leg():
    times_s = np.arange(101.0)
    straight = fly((Leg(100.0, 0.0, 250.0, 0),), times_s, (0.0, 0.0), 0.7).state
    for rate in (1e-14, -1e-14, 5e-324):
        turned = fly((Leg(100.0, rate, 250.0, 0),), times_s, (0.0, 0.0), 0.7).state
        # Off the chord by v w t^2 / 2 = 1.3e-8 m after 100 s.
        np.testing.assert_allclose(turned, straight, rtol=0.0, atol=2e-8)


def test_uneven_times_give_the_same_points():
    times_s = np.arange(76.0)
    chosen = np.array([0, 1, 5, 30, 31, 32, 60, 74])
    even, uneven = (fly(LEGS, t, (5.0, 6.0), 2.0) for t in (times_s, times_s[chosen]))
    np.testing.assert_allclose(uneven.state, even.state[chosen], rtol=0.0, atol=ROUNDING)
    assert uneven.mode.tolist() == even.mode[chosen].tolist()


def test_a_steps_mode_is_that_of_the_leg_in_which_it_ends():
    times_s = np.array([0.0, 15.0, 30.0, 30.5, 47.3, 59.0, 60.0, 61.0, 75.0])
    assert fly(LEGS, times_s, (0.0, 0.0), 0.0).mode.tolist() == [0, 0, 0, 1, 1, 2, 2, 0, 0]


def test_a_steps_mode_isnt_decided_by_rounding():
    times_s = 0.1 * np.arange(10.0)  # 0.30000000000000004, 0.6000000000000001, 0.7000000000000001
    ends = (0.3, 0.6, 0.7, 0.9)
    legs = tuple(Leg(end, 0.1 * (i % 2), 10.0, i % 2) for i, end in enumerate(ends))
    assert fly(legs, times_s, (0.0, 0.0), 0.0).mode.tolist() == [0] * 4 + [1] * 3 + [0] + [1] * 2


def test_an_acceleration_is_an_exact_parabola_and_the_next_leg_goes_on_from_it():
    times_s = np.array([0.0, 4.0, 7.5, 10.0, 13.0, 16.0])
    legs = (
        Leg(4.0, 0.0, 150.0, 0),
        Leg(10.0, 0.0, None, 1, (1.5, -0.5)),
        Leg(16.0, 0.1, None, 0),
    )
    heading = 0.3
    state = fly(legs, times_s, (5.0, 6.0), heading).state
    u = 150.0 * np.array([np.sin(heading), np.cos(heading)])
    a = np.array([1.5, -0.5])
    start = np.array([5.0, 6.0]) + 4.0 * u
    for row, t in zip(state[1:4], (0.0, 3.5, 6.0), strict=True):
        np.testing.assert_allclose(row[[0, 2]], start + u * t + a * t**2 / 2, rtol=1e-13)
        np.testing.assert_allclose(row[[1, 3]], u + a * t, rtol=1e-13)
    speed = np.hypot(*(u + 6.0 * a))
    np.testing.assert_allclose(np.hypot(state[4:, 1], state[4:, 3]), speed, rtol=1e-13)
    turned = np.arctan2(state[5, 1], state[5, 3]) - np.arctan2(state[3, 1], state[3, 3])
    assert turned == pytest.approx(0.6, abs=1e-12)


# ---- models of chains ------------------------------------------------------------------------


def bank_of_matrices(model):
    """A ModeBank of the model's matrices as they stand; model.n_times is 1."""
    modes = tuple(
        Mode(
            name,
            None,
            {},
            model.measurement_noise_covariance[j],
            Motion(
                model.state_transition[:, j],
                model.input_effect[:, j],
                model.process_noise_covariance[:, j],
            ),
            model.measurement_matrix[j],
        )
        for j, name in enumerate(model.mode_names)
    )
    return ModeBank(
        modes,
        model.state_names,
        2,
        model.transition_matrix[0],
        None,
        model.initial_mode_probabilities,
    )


def flight_bank(*, generator=None, transition_matrix=None, initial=(1.0, 0.0), std=2.0):
    """Two modes on x, vx, y, vy: a gentle and a lively constant velocity."""
    noise = 100.0 * np.eye(2)
    modes = (
        Mode("calm", "constant_velocity", {"acceleration_std_m_s2": 0.1}, noise),
        Mode("lively", "constant_velocity", {"acceleration_std_m_s2": std}, noise),
    )
    names = ("x", "vx", "y", "vy")
    return ModeBank(modes, names, 2, transition_matrix, generator, np.array(initial))


def chain(bank, *, mean=(0.0, 100.0, 0.0, -50.0), covariance=None):
    covariance = np.diag([400.0, 25.0, 400.0, 25.0]) if covariance is None else covariance
    return ChainTruth(bank, np.array(mean), covariance)


CORRELATED = np.array([[400.0, 90.0], [90.0, 100.0]])
SENSOR = Sensor(CORRELATED[np.newaxis], 0.8, 2)
UNEVEN_S = np.concatenate([[0.0], np.cumsum(np.tile([1.0, 3.0, 0.5, 0.5, 2.0], 14))])
SOJOURNS = generator_from_sojourns(np.array([10.0, 4.0]))


def cases():
    uneven = chain(flight_bank(generator=SOJOURNS, initial=(0.7, 0.3)))
    even = chain(flight_bank(transition_matrix=np.array([[0.9, 0.1], [0.3, 0.7]])))
    legs = fly((Leg(20.0, 0.0, 240.0, 0), Leg(70.0, 0.05, 240.0, 1)), UNEVEN_S, (0.0, 0.0), 1.0)
    return {
        "chain, uneven": Case("a", UNEVEN_S, uneven),
        "chain, even": Case("b", np.arange(71.0), even),
        "chain, tenths": Case("c", 0.1 * np.arange(71.0), even),
        "legs": Case("d", UNEVEN_S, legs),
    }


# ---- streams ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", cases())
def test_a_run_depends_neither_on_lanes_nor_on_spans(name):
    case = cases()[name]
    by_mode = SENSOR._replace(noise_covariance=np.stack([CORRELATED, 4.0 * np.eye(2)]))
    outliers = Outliers(0.3, 20.0, 3.0, 40.0)
    sensors = (SENSOR, by_mode, by_mode._replace(outliers=outliers))
    for sensor, foresees in zip(sensors, (False, True, False), strict=True):
        whole = simulate(case, sensor, foresees=foresees)
        for lanes, length in [(BLOCK_RUNS, 1), (BLOCK_RUNS, 32), (5, 1000), (64, 7), (1, 69)]:
            part = simulate(case, sensor, lanes=lanes, length=length, foresees=foresees)
            for ours, theirs in zip(part, whole, strict=True):
                expected = theirs[..., :lanes]
                assert ours.shape == expected.shape
                assert ours.tobytes() == expected.tobytes()


def test_the_start_of_estimates_doesnt_depend_on_lanes():
    case = cases()["legs"]
    draws = [BlockSimulation(case, SENSOR, 1, 0, 0, n).initial_estimate_noise(6) for n in (256, 3)]
    assert draws[1].shape == (6, 3)
    assert draws[1].tobytes() == draws[0][:, :3].tobytes()


@pytest.mark.parametrize(
    ("steps", "lengths"), [(7, [7]), (50, [50]), (51, [25, 26]), (150, [50] * 3), (0, [])]
)
def test_spans_are_few_and_of_nearly_one_length(steps, lengths):
    cut = list(spans(steps, 50))
    assert [span.stop - span.start for span in cut] == lengths
    assert [k for span in cut for k in range(span.start, span.stop)] == list(range(steps))


def test_streams_differ_by_seed_case_block_and_purpose():
    keys = list(itertools.product((0, 1), (0, 1), (0, 1), Purpose))
    draws = {stream(*key).random(4).tobytes() for key in keys}
    assert len(draws) == len(keys)
    # A key is the same stream every time.
    assert stream(*keys[5]).random(4).tobytes() == stream(*keys[5]).random(4).tobytes()


@pytest.mark.parametrize("other", [{"seed": 2}, {"case_index": 1}, {"block": 1}])
def test_blocks_cases_and_seeds_are_other_draws(other):
    case = cases()["chain, even"]
    for ours, theirs in zip(simulate(case, SENSOR, **other), simulate(case, SENSOR), strict=True):
        shared = np.isfinite(ours) & np.isfinite(theirs)
        assert (ours[shared] != theirs[shared]).any()


def test_noise_is_white_over_steps_and_runs():
    truth = FixedTruth(np.zeros((401, 2)), np.zeros(401, dtype=np.int64), ("x", "vx"))
    z = simulate(Case("a", np.arange(401.0), truth), Sensor(np.eye(1)[None], 1.0, 0))[-1][:, 0]
    for product in (z[1:] * z[:-1], z[:, 1:] * z[:, :-1]):
        assert_mean(product.ravel(), 0.0)


# ---- the sensor ------------------------------------------------------------------------------


def still(n_steps, modes=None):
    """An aircraft that stands at x = 1000 m, y = -500 m."""
    state = np.tile([1000.0, 0.0, -500.0, 0.0], (n_steps + 1, 1))
    modes = np.zeros(n_steps + 1, dtype=np.int64) if modes is None else modes
    truth = FixedTruth(state, modes, ("x", "vx", "y", "vy"))
    return Case("still", np.arange(n_steps + 1.0), truth)


def assert_noise(error, covariance):
    """error (n_y, samples): zero-mean Gaussian with the covariance given."""
    assert_mean(error, 0.0)
    assert_mean(error[:, np.newaxis] * error[np.newaxis], covariance)
    # The fourth moment of a Gaussian, 3 R^2.
    assert_mean(error**4, 3.0 * np.diagonal(covariance) ** 2)


@pytest.mark.parametrize("covariance", [np.diag([400.0, 25.0]), CORRELATED])
def test_measurement_noise_has_the_stated_covariance(covariance):
    *_, z = simulate(still(200), Sensor(covariance[np.newaxis], 1.0, 0))
    error = z - np.array([[1000.0], [-500.0]])
    assert_noise(error.swapaxes(0, 1).reshape(2, -1), covariance)


@pytest.mark.parametrize("kind", ["fixed", "chain"])
def test_measurement_noise_follows_the_truths_mode(kind):
    covariances = np.stack([np.diag([25.0, 400.0]), CORRELATED])
    case = still(200, np.arange(201) // 3 % 2)
    if kind == "chain":
        bank = flight_bank(transition_matrix=np.array([[0.8, 0.2], [0.4, 0.6]]))
        case = Case("chain", np.arange(201.0), chain(bank))
    _, state, mode, _, z = simulate(case, Sensor(covariances, 1.0, 0))
    error = z - state[:, [0, 2]]
    mode = np.broadcast_to(mode, (200, BLOCK_RUNS))
    for j in range(2):
        assert_noise(error.swapaxes(0, 1)[:, mode == j], covariances[j])


def test_scans_are_missed_whole_and_as_often_as_stated():
    case = still(200)
    *_, z = simulate(case, Sensor(CORRELATED[np.newaxis], 0.7, 0))
    missed = np.isnan(z)
    assert (missed[:, 0] == missed[:, 1]).all()
    assert_mean(1.0 - missed[:, 0].ravel(), 0.7)
    # What is seen is what would have been seen without misses.
    *_, seen = simulate(case, Sensor(CORRELATED[np.newaxis], 1.0, 0))
    assert np.isfinite(seen).all()
    assert (z[~missed] == seen[~missed]).all()


@pytest.mark.parametrize("length", [1, 2, 1000])
def test_certain_scans_are_never_missed(length):
    *_, z = simulate(still(6), Sensor(CORRELATED[np.newaxis], 0.5, 3), length=length)
    missed = np.isnan(z[:, 0])
    assert not missed[:3].any()
    assert missed[3:].any(axis=1).all()


def test_a_detection_probability_of_zero_leaves_the_certain_scans():
    *_, z = simulate(still(5), Sensor(CORRELATED[np.newaxis], 0.0, 2))
    assert np.isfinite(z[:2]).all()
    assert np.isnan(z[2:]).all()


def test_recorded_measurements_stay_as_they_are_in_every_run():
    recorded = np.random.default_rng(1).normal(size=(8, 2))
    recorded[3] = np.nan
    case = still(7)._replace(recorded=recorded)
    *_, z = simulate(case, Sensor(CORRELATED[np.newaxis], 0.5, 0), lanes=3, length=2)
    assert z.shape == (7, 2, 3)
    for run in range(3):
        np.testing.assert_array_equal(z[:, :, run], recorded[1:])


# ---- a chain's modes -------------------------------------------------------------------------

ASYMMETRIC = np.array([[0.85, 0.1, 0.05], [0.0, 0.7, 0.3], [0.5, 0.02, 0.48]])


def three_modes(initial):
    model = random_model(np.random.default_rng(2))
    return bank_of_matrices(
        model._replace(
            transition_matrix=ASYMMETRIC[np.newaxis],
            initial_mode_probabilities=np.array(initial),
            state_names=("x", "vx", "y", "vy"),
        )
    )


def test_modes_follow_the_transition_matrix():
    truth = chain(three_modes([0.0, 0.4, 0.6]))
    _, _, mode, _, _ = simulate(Case("a", np.arange(301.0), truth), SENSOR)
    before, after = mode[:-1].ravel(), mode[1:].ravel()
    for i, j in itertools.product(range(3), range(3)):
        assert_mean((after[before == i] == j).astype(float), ASYMMETRIC[i, j])
    assert not (after[before == 1] == 0).any()


def test_the_first_step_is_a_step_of_the_chain_too():
    initial = np.array([0.0, 0.4, 0.6])
    case = Case("a", np.arange(2.0), chain(three_modes(initial)))
    mode = np.concatenate([simulate(case, SENSOR, block=b)[2][0] for b in range(40)])
    for j in range(3):
        assert_mean((mode == j).astype(float), (initial @ ASYMMETRIC)[j])


def test_modes_of_uneven_steps_follow_the_generator():
    truth = chain(flight_bank(generator=SOJOURNS, initial=(0.5, 0.5)))
    times_s = np.concatenate([[0.0], np.cumsum(np.tile([0.5, 6.0], 100))])
    _, _, mode, _, _ = simulate(Case("a", times_s, truth), SENSOR)
    leave, back = 1 / 10.0, 1 / 4.0
    for parity, step_s in ((0, 0.5), (1, 6.0)):
        moved = -math.expm1(-(leave + back) * step_s) / (leave + back)  # a chain of two, exactly
        after = mode[1:][parity != np.arange(199) % 2]
        before = mode[:-1][parity != np.arange(199) % 2]
        assert_mean((after[before == 0] == 1).astype(float), leave * moved)
        assert_mean((after[before == 1] == 0).astype(float), back * moved)


def switches(times_s, mode, first):
    """Time since the start of the last step that began a mode; `first` = mode at k = 0."""
    since, last = [], -math.inf
    for k, m in enumerate(mode):
        if m != first:
            last = times_s[k]
        first = m
        since.append(times_s[k + 1] - last)
    return since


def test_time_since_a_switch_of_a_chain():
    even = cases()["chain, even"]
    times_s = np.cumsum(np.random.default_rng(3).uniform(0.2, 4.0, 71))
    truth = chain(flight_bank(generator=SOJOURNS, initial=(1.0, 0.0)))
    for case in (even, Case("uneven", times_s, truth)):
        _, _, mode, since_switch_s, _ = simulate(case, SENSOR, lanes=20, length=9)
        for run in range(20):
            # The same subtraction of the same numbers: no rounding.
            assert since_switch_s[:, run].tolist() == switches(case.times_s, mode[:, run], 0)
        assert np.isinf(since_switch_s).any()


def test_time_since_a_switch_of_legs():
    legs = (Leg(3.0, 0.0, 1.0, 0), Leg(6.0, 0.0, 1.0, 1), Leg(7.0, 0.0, 2.0, 1))
    legs = (*legs, Leg(9.5, 0.0, 1.0, 0))
    times_s = np.array([1.0, 2.0, 3.0, 3.5, 5.0, 6.5, 7.0, 9.0, 9.5])
    case = Case("a", times_s, fly(legs, times_s, (0.0, 0.0), 0.0))
    _, _, mode, since_switch_s, _ = simulate(case, SENSOR, length=3)
    assert mode[:, 0].tolist() == [0, 0, 1, 1, 1, 1, 0, 0]
    inf = math.inf
    assert since_switch_s[:, 0].tolist() == [inf, inf, 0.5, 2.0, 3.5, 4.0, 2.0, 2.5]
    assert since_switch_s[:, 0].tolist() == switches(times_s, mode[:, 0], 0)


BOUNDS = {
    "none": Bound(),
    "soft": Bound(continuation_probability=0.9),
    "hard": Bound(most_transitions=2),
}


@pytest.mark.parametrize("kind", BOUNDS)
def test_the_last_mode_is_foretold(kind):
    """Against the modes as they come; beyond the last step the chain's own story goes on."""
    bound, initial = BOUNDS[kind], np.array([0.0, 0.4, 0.6])
    truth = chain(three_modes(initial))._replace(bound=bound)
    case = Case("a", np.arange(26.0), truth)
    blocks = [simulate(case, SENSOR, block=b, foresees=True) for b in range(12)]
    mode, final = (np.concatenate([block[i] for block in blocks], axis=1) for i in (2, 4))
    alone = [simulate(case, SENSOR, block=b)[2] for b in range(12)]
    assert (np.concatenate(alone, axis=1) == mode).all()  # nothing else is drawn otherwise
    assert np.isin(final, (0.0, 1.0)).all()
    assert (np.diff(final, axis=0) >= 0).all()
    switched = mode[1:] != mode[:-1]
    assert (final[:-1][switched] == 0).all()
    # From 0 to 1 by a switch and by nothing else: an end is no event of its own.
    assert (switched[np.diff(final, axis=0) == 1]).all()
    if kind == "none":
        assert (final == 0).all()
        return
    # What the chain says before anything is seen, step by step; pruned and whole alike.
    supermodes = bound.supermodes(ASYMMETRIC[np.newaxis], initial)
    probability = supermodes.initial_probabilities
    for k in range(25):
        probability = probability @ supermodes.transition_matrix[0]
        assert_mean(final[k], probability @ supermodes.final_probability[0])


def test_the_last_leg_is_the_last_mode():
    legs = (Leg(3.0, 0.0, 1.0, 0), Leg(6.0, 0.0, 1.0, 1), Leg(9.0, 0.0, 2.0, 1))
    times_s = np.arange(10.0)
    for n, expected in ((3, [0, 0, 0, 1, 1, 1, 1, 1, 1]), (1, [1] * 9)):
        flown = fly((*legs[: n - 1], legs[2]), times_s, (0.0, 0.0), 0.0)
        final = simulate(Case("a", times_s, flown), SENSOR, foresees=True, length=4)[4]
        assert final[:, 0].tolist() == expected


def test_a_truth_without_modes_never_switches():
    _, _, mode, since_switch_s, _ = simulate(still(5, np.full(6, -1)), SENSOR)
    assert (mode == -1).all()
    assert np.isinf(since_switch_s).all()


# ---- a chain's states ------------------------------------------------------------------------


def jump_moments(model, steps):
    """Mean and second moment of x and the modes' probabilities at 1 .. steps, exactly.

    E[x 1(mode j)] and E[x x' 1(mode j)] have a linear recursion (Costa, Fragoso, Marques 2005,
    chapter 3).
    """
    n = len(model.mode_names)
    p = model.initial_mode_probabilities
    second = model.initial_covariance + np.outer(model.initial_mean, model.initial_mean)
    m = [p[j] * model.initial_mean for j in range(n)]
    S = [p[j] * second for j in range(n)]
    for _ in range(steps):
        p, m_before, S_before = p @ model.transition_matrix[0], m, S
        m, S = [], []
        for j in range(n):
            F, b = model.state_transition[0, j], model.input_effect[0, j]
            mixed = sum(model.transition_matrix[0, i, j] * m_before[i] for i in range(n))
            mixed_S = sum(model.transition_matrix[0, i, j] * S_before[i] for i in range(n))
            cross = np.outer(F @ mixed, b)
            noise = model.process_noise_covariance[0, j] + np.outer(b, b)
            m.append(F @ mixed + p[j] * b)
            S.append(F @ mixed_S @ F.T + cross + cross.T + p[j] * noise)
        yield sum(m), sum(S)


def test_states_have_the_moments_of_the_jump_markov_system():
    model = random_model(np.random.default_rng(4))._replace(
        state_names=("x", "vx", "y", "vy"), initial_mode_probabilities=np.array([0.7, 0.0, 0.3])
    )
    truth = ChainTruth(bank_of_matrices(model), model.initial_mean, model.initial_covariance)
    case = Case("a", np.arange(7.0), truth)
    blocks = [simulate(case, SENSOR, block=b) for b in range(40)]
    initial = np.concatenate([block[0] for block in blocks], axis=-1)
    state = np.concatenate([block[1] for block in blocks], axis=-1)
    assert_mean(initial, model.initial_mean)
    start = initial - model.initial_mean[:, np.newaxis]
    assert_mean(start[:, np.newaxis] * start, model.initial_covariance)
    for x, (mean, second) in zip(state, jump_moments(model, 6), strict=True):
        assert_mean(x, mean)
        assert_mean(x[:, np.newaxis] * x, second)


def test_mode_k_drives_the_step_to_k():
    model = random_model(np.random.default_rng(5))._replace(state_names=("x", "vx", "y", "vy"))
    model = model._replace(process_noise_covariance=np.zeros((1, 3, 4, 4)))
    truth = ChainTruth(bank_of_matrices(model), model.initial_mean, model.initial_covariance)
    initial, state, mode, _, _ = simulate(
        Case("a", np.arange(31.0), truth), SENSOR, lanes=40, length=8
    )
    before = initial
    for k in range(30):
        for run in range(40):
            j = mode[k, run]
            expected = model.state_transition[0, j] @ before[:, run] + model.input_effect[0, j]
            # One product of four terms: rounding.
            np.testing.assert_allclose(state[k, :, run], expected, rtol=1e-13, atol=1e-13)
        before = state[k]
    assert len(np.unique(mode)) == 3


def low_rank(truth, step_s):
    """The truth's model, but only steps of 1 s have process noise."""
    model = plain_model(truth, step_s)
    noise = model.process_noise_covariance.copy()
    noise[model.step_s != 1.0] = 0.0
    return model._replace(process_noise_covariance=noise)


plain_model = jumps.truth_model


def test_where_noise_has_another_rank_in_other_steps_spans_dont_matter(monkeypatch):
    monkeypatch.setattr(jumps, "truth_model", low_rank)
    monkeypatch.setattr(jumps, "RANK_STEPS", 1)  # a look at each of the four lengths of steps
    case = Case("a", UNEVEN_S, chain(flight_bank(generator=SOJOURNS), covariance=np.zeros((4, 4))))
    initial, state, *others = simulate(case, SENSOR)
    for length in (1, 3):
        part = simulate(case, SENSOR, length=length)
        for ours, theirs in zip(part, (initial, state, *others), strict=True):
            assert ours.tobytes() == theirs.tobytes()
    before = np.concatenate([initial[np.newaxis], state[:-1]])
    moved = (state[:, 1] != before[:, 1]).mean(axis=1)
    # Other steps have no noise at all, and no draw of these is 0.
    assert (moved == (np.diff(UNEVEN_S) == 1.0)).all()


def test_a_step_takes_as_many_draws_as_its_noise_has_dimensions():
    standing = ("x", "vx", "ax")
    noise = np.eye(1)
    quiet = Mode("quiet", "wiener_acceleration", {"acceleration_std_m_s2": 0.0}, noise)
    steady = Mode("s", "constant_velocity_zero_acceleration", {"acceleration_std_m_s2": 1}, noise)
    curved = Mode("c", "wiener_acceleration", {"jerk_psd_m2_s5": 1.0}, noise)
    for modes, rank in (((quiet, quiet), 0), ((quiet, steady), 1), ((steady, curved), 3)):
        bank = ModeBank(modes, standing, 1, np.full((2, 2), 0.5), None, np.array([1.0, 0.0]))
        truth = ChainTruth(bank, np.array([5.0, 1.0, 0.5]), np.zeros((3, 3)))
        for times_s in (np.arange(5.0), np.array([0.0, 1.0, 3.0, 3.5])):
            if len(times_s) == 4:
                uneven = bank._replace(transition_matrix=None, generator_per_s=SOJOURNS)
                truth = truth._replace(bank=uneven)
            runs = jumps.JumpRuns(truth, np.diff(times_s), np.zeros(8), np.zeros((3, 8)))
            assert runs.noise_rank == rank
            sensor = Sensor(np.eye(1)[np.newaxis], 1.0, 0)
            _, state, *_ = simulate(Case("a", times_s, truth), sensor)
            exact = 5.0 + times_s[1:] + 0.25 * times_s[1:] ** 2
            spread = state[:, 0].std(axis=1)
            assert (spread == 0.0).all() if rank == 0 else (spread > 0.0).all()
            if rank == 0:
                np.testing.assert_allclose(state[:, 0, 0], exact, rtol=1e-14)  # rounding


def test_a_fixed_start_is_exact():
    truth = chain(flight_bank(generator=SOJOURNS), covariance=np.zeros((4, 4)))
    initial, *_ = simulate(Case("a", np.arange(3.0), truth), SENSOR)
    assert (initial == np.array([0.0, 100.0, 0.0, -50.0])[:, np.newaxis]).all()


def test_singular_noise_stays_in_its_range():
    # DWNA: w = [T^2/2, T] a on each axis, so position and velocity noise are one number; over
    # uneven steps each with its own T.
    truth = chain(flight_bank(generator=SOJOURNS, std=2.0), covariance=np.zeros((4, 4)))
    initial, state, mode, _, _ = simulate(Case("a", UNEVEN_S, truth), SENSOR)
    before = np.concatenate([initial[np.newaxis], state[:-1]])
    T = np.diff(UNEVEN_S)[:, np.newaxis]
    for p, v in ((0, 1), (2, 3)):
        position_noise = state[:, p] - before[:, p] - T * before[:, v]
        acceleration = (state[:, v] - before[:, v]) / T
        # The positions' rounding, 1e-16 of 1e5 m: a direction without noise has none at all.
        np.testing.assert_allclose(position_noise, T**2 / 2 * acceleration, rtol=0.0, atol=1e-9)
        for j, std in enumerate((0.1, 2.0)):
            assert_mean(acceleration[mode == j] ** 2, std**2)


# ---- a start from two scans ------------------------------------------------------------------


@pytest.mark.parametrize(
    "names",
    [("x", "vx", "y", "vy"), ("x", "vx", "ax", "y", "vy", "ay"), ("vy", "y", "vx", "x", "ax")],
)
def test_two_point_start_is_the_least_squares_solution(names):
    rng = np.random.default_rng(6)
    T, z = 2.5, rng.normal(0.0, 1e3, (2, 2, 7))
    # z1 = p - T v + e1, z2 = p + e2 with p, v in the plane; what isn't measured is 0, exactly.
    kinematic = ["x", "y", "vx", "vy"]
    A = np.block([[np.eye(2), -T * np.eye(2)], [np.eye(2), np.zeros((2, 2))]])
    S = np.kron(np.eye(2), CORRELATED)
    covariance = np.linalg.inv(A.T @ np.linalg.solve(S, A))
    solution = covariance @ A.T @ np.linalg.solve(S, z.reshape(4, 7))
    expected_mean = np.zeros((len(names), 7))
    expected = np.zeros((len(names), len(names)))
    rows = [names.index(name) for name in kinematic]
    expected_mean[rows] = solution
    expected[np.ix_(rows, rows)] = covariance
    mean, covariance = two_point_start(z[0], z[1], T, CORRELATED, names)
    # Rounding of well-conditioned 4 x 4 solutions.
    np.testing.assert_allclose(mean, expected_mean, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(covariance, expected, rtol=1e-10, atol=1e-10)


def test_two_point_start_errs_by_its_covariance():
    rng = np.random.default_rng(7)
    T, n = 4.0, 20_000
    position, velocity = np.array([1e3, -2e3]), np.array([-200.0, 30.0])
    noise = np.linalg.cholesky(CORRELATED) @ rng.normal(size=(2, 2, n))
    first = (position - T * velocity)[:, np.newaxis] + noise[0]
    second = position[:, np.newaxis] + noise[1]
    mean, covariance = two_point_start(first, second, T, CORRELATED, ("x", "vx", "y", "vy"))
    error = mean - np.array([1e3, -200.0, -2e3, 30.0])[:, np.newaxis]
    assert_noise(error, covariance)


def test_two_point_start_in_one_dimension():
    mean, covariance = two_point_start(
        np.array([[10.0]]), np.array([[16.0]]), 2.0, np.array([[4.0]]), ("x", "vx")
    )
    assert mean[:, 0].tolist() == [16.0, 3.0]
    assert covariance.tolist() == [[4.0, 2.0], [2.0, 2.0]]


@pytest.mark.parametrize(("names", "said"), [(("x", "vx", "w"), "'w'"), (("x",), "'vx'")])
def test_two_point_start_names_the_state_that_it_cant_start(names, said):
    with pytest.raises(UserError, match=f"{said}.*give initial mean and covariance"):
        two_point_start(np.zeros((1, 1)), np.ones((1, 1)), 1.0, np.eye(1), names)
