"""Bounds on the number of transitions: the chains against their stories told step by step, and
the filters on them against the filters that they become at their ends."""

import itertools
import math

import numpy as np
import pytest

import reference
from hybridtrack.chains import (
    Bound,
    expected_steps_in_mode,
    expected_steps_to_end,
    expected_transitions,
    hard_bound,
    on_supermodes,
    pruned,
    soft_bound,
)
from hybridtrack.estimators import estimators
from hybridtrack.jumps import ChainTruth
from hybridtrack.models import Mode, ModeBank
from hybridtrack.sensors import Sensor
from hybridtrack.simulation import BLOCK_RUNS, BlockSimulation, Case
from hybridtrack.vectors import WIDTH
from models import figure_5_model, random_model, run_kernel

MATRIX = np.array([[[0.7, 0.2, 0.1], [0.3, 0.6, 0.1], [0.05, 0.15, 0.8]]])
START = np.array([0.5, 0.3, 0.2])
EVEN = np.array([0.5, 0.5])

ROUNDING = 1e-10  # relative: some 1e4 operations at 1e-16 each, and a margin of 100
ASKED = 1e-8  # what the filters' ends are asked to meet; rounding is far below


def sequence_probabilities(chain, steps):
    """By sequence of modes from k = 0 on, its probability; stages summed."""
    found = {}
    n = len(chain.mode)
    for path in itertools.product(range(n), repeat=steps + 1):
        probability = chain.initial_probabilities[path[0]]
        for a, b in itertools.pairwise(path):
            probability *= chain.transition_matrix[0, a, b]
        modes = tuple(int(chain.mode[s]) for s in path)
        found[modes] = found.get(modes, 0.0) + probability
    return found


def soft_story(modes, p0):
    """Sum over when it ends: from the step that ends it on, the mode stays (Sigalov 2011, 1-3)."""
    steps = len(modes) - 1
    total = 0.0
    for end in range(1, steps + 2):  # the step that ends it; steps + 1: none of these
        probability = START[modes[0]]
        for k in range(1, steps + 1):
            before, after = modes[k - 1], modes[k]
            if k < end:
                probability *= p0 * MATRIX[0, before, after]
            else:
                probability *= (1 - p0 if k == end else 1.0) * (before == after)
        total += probability
    return total


def hard_story(modes, most):
    probability, count = START[modes[0]], 0
    for before, after in itertools.pairwise(modes):
        if count == most:
            probability *= before == after
        else:
            probability *= MATRIX[0, before, after]
            count += before != after
    return probability


@pytest.mark.parametrize("p0", [0.0, 0.4, 1.0])
def test_the_soft_bound_tells_its_story(p0):
    found = sequence_probabilities(soft_bound(MATRIX, START, p0), 3)
    assert sum(found.values()) == pytest.approx(1.0, abs=1e-14)
    for modes, probability in found.items():
        assert probability == pytest.approx(soft_story(modes, p0), abs=1e-15)


@pytest.mark.parametrize("most", [0, 1, 2])
def test_the_hard_bound_tells_its_story(most):
    found = sequence_probabilities(hard_bound(MATRIX, START, most), 3)
    assert sum(found.values()) == pytest.approx(1.0, abs=1e-14)
    for modes, probability in found.items():
        assert probability == pytest.approx(hard_story(modes, most), abs=1e-15)


def test_a_leak_brings_an_ended_mode_back():
    chain = soft_bound(MATRIX, START, 0.9, leak=0.25)
    np.testing.assert_allclose(chain.transition_matrix.sum(axis=-1), 1.0, atol=1e-15)
    np.testing.assert_array_equal(chain.transition_matrix[0, 3:, :3], 0.25 * np.eye(3))
    np.testing.assert_array_equal(chain.transition_matrix[0, 3:, 3:], 0.75 * np.eye(3))


def test_what_cannot_be_reached_is_left_out():
    known = np.array([1.0, 0.0])
    two = MATRIX[:, :2, :2] / MATRIX[:, :2, :2].sum(axis=-1, keepdims=True)
    chain = pruned(hard_bound(two, known, 4))
    # One mode in turn for each number of transitions.
    assert chain.mode.tolist() == [0, 1, 0, 1, 0]
    assert chain.stage.tolist() == [0, 1, 2, 3, 4]
    assert len(pruned(hard_bound(MATRIX, START, 4)).mode) == 15
    assert len(pruned(soft_bound(MATRIX, START, 0.0)).mode) == 6
    assert pruned(soft_bound(MATRIX, START, 1.0)).stage.tolist() == [0, 0, 0]


# ---- the last mode ---------------------------------------------------------------------------


def stays_for_ever(chain):
    """By supermode, the probability that the mode never changes again: the limit of staying."""
    same = chain.mode[:, np.newaxis] == chain.mode
    staying = np.where(same, chain.transition_matrix[0], 0.0)
    for _ in range(60):  # 2**60 steps
        staying = staying @ staying
    return staying.sum(axis=1)


ABSORBING = np.array([[[0.7, 0.2, 0.1], [0.0, 1.0, 0.0], [0.05, 0.15, 0.8]]])


@pytest.mark.parametrize("matrix", [MATRIX, ABSORBING], ids=["left", "one stays"])
@pytest.mark.parametrize(
    "bound",
    [
        Bound(),
        Bound(continuation_probability=0.0),
        Bound(continuation_probability=0.9),
        Bound(continuation_probability=1.0),
        Bound(most_transitions=0),
        Bound(most_transitions=2),
    ],
)
def test_how_likely_a_mode_is_the_last_one(bound, matrix):
    chain = bound.supermodes(matrix, START)
    np.testing.assert_allclose(chain.final_probability[0], stays_for_ever(chain), atol=1e-14)


def test_a_leak_is_no_belief_that_modes_go_on():
    with_leak, without = (soft_bound(MATRIX, START, 0.9, leak) for leak in (0.01, 0.0))
    np.testing.assert_array_equal(with_leak.final_probability, without.final_probability)


def test_rows_that_sum_to_one_but_for_rounding_are_never_left_where_nothing_leads_away():
    rounded = np.array([[[1.0 - 1e-10, 0.0], [0.3, 0.7]]])
    start = np.array([0.5, 0.5])
    for bound in (Bound(), Bound(continuation_probability=0.9), Bound(most_transitions=2)):
        chain = bound.supermodes(rounded, start)
        assert (chain.final_probability[0, chain.mode == 0] == 1.0).all()
        assert expected_transitions(chain) < 1.0


def test_uneven_steps_tell_nothing_of_the_last_mode():
    """What comes is another chain than what was; a filter that foresaw it would be wrong."""
    model = random_model(np.random.default_rng(5), n_times=4)
    bounded, recursion = bound_filter("sbf", model, continuation_probability=0.9)
    assert bounded.final_probability is None
    found, _ = run_kernel(bounded, scans(6, 4, scale=3.0), recursion)
    assert found.final_mode_probability.size == found.final_mode_prior.size == 0


def test_the_last_mode_in_example_1_of_sigalov():
    """q = (1 - p0)/(1 - p0 + p0 (1 - p_ii)) = 0.2033 where not ended."""
    chain = soft_bound(np.array([[[0.92, 0.08], [0.08, 0.92]]]), np.array([1.0, 0.0]), 0.98)
    q = 0.02 / (0.02 + 0.98 * 0.08)
    np.testing.assert_allclose(chain.final_probability, [[q, q, 1.0, 1.0]], rtol=1e-14)
    assert round(q, 4) == 0.2033


def test_lemma_1_the_mode_alone_is_no_markov_chain():
    """Sigalov 2011, eqs. 5-6: p12 = p21 = 1. Having stayed once, a mode stays for ever."""
    swap, p0 = np.array([[[0.0, 1.0], [1.0, 0.0]]]), 0.6
    chain = soft_bound(swap, np.array([1.0, 0.0]), p0)
    found = sequence_probabilities(chain, 3)

    def probability(*events):
        return sum(p for modes, p in found.items() if all(modes[k] == m for k, m in events))

    stayed = probability((3, 0), (2, 0), (1, 0)) / probability((2, 0), (1, 0))
    assert stayed == pytest.approx(1.0, abs=1e-15)
    alone = probability((3, 0), (2, 0)) / probability((2, 0))
    # m1 at k = 2: ended at once (.4), or twice over (.36), and then it ends next with .4.
    assert alone == pytest.approx((0.4 + 0.36 * 0.4) / 0.76, abs=1e-15)


def test_expected_times_and_numbers_of_sigalovs_example():
    even = np.array([[0.92, 0.08], [0.08, 0.92]])
    assert expected_steps_to_end(0.98) == pytest.approx(50)
    assert expected_steps_to_end(1.0) == math.inf
    np.testing.assert_allclose(expected_steps_in_mode(even), 12.5)
    assert expected_steps_in_mode(np.eye(2)).tolist() == [math.inf] * 2
    chain = soft_bound(even[np.newaxis], np.array([1.0, 0.0]), 0.98)
    assert expected_transitions(chain) == pytest.approx(0.98 * 0.08 * 50)


@pytest.mark.parametrize(
    ("chain", "known"),
    [
        (soft_bound(MATRIX, START, 0.9), None),
        (hard_bound(MATRIX, START, 3), 3.0),
        (hard_bound(np.array([[[1.0 - 1e-13, 1e-13], [1e-13, 1.0 - 1e-13]]]), EVEN, 4), 4.0),
        (hard_bound(ABSORBING, START, 3), None),
        (hard_bound(MATRIX, START, 0), 0.0),
        (soft_bound(MATRIX, START, 1.0), math.inf),
        (Bound().supermodes(MATRIX, START), math.inf),
    ],
)
def test_the_expected_number_of_transitions_is_the_sum_over_all_steps(chain, known):
    found = expected_transitions(chain)
    if known is None:
        probability, known = chain.initial_probabilities, 0.0
        leaves = chain.mode[:, np.newaxis] != chain.mode
        for _ in range(5000):
            known += float((probability @ np.where(leaves, chain.transition_matrix[0], 0)).sum())
            probability = probability @ chain.transition_matrix[0]
    assert found == pytest.approx(known, rel=1e-10)


@pytest.mark.parametrize("name", ["sbf", "hbf"])
def test_filters_tell_how_likely_the_mode_is_the_last_one(name):
    """Against the slow reference on the supermodes, and with no scan at all against the chain."""
    model = random_model(np.random.default_rng(5))._replace(
        transition_matrix=MATRIX, initial_mode_probabilities=START
    )
    settings = {"continuation_probability": 0.9} if name == "sbf" else {"most_transitions": 2}
    bounded, recursion = bound_filter(name, model, **settings)
    z = scans(6, 20, scale=3.0)
    found, _ = run_kernel(bounded, z, recursion)
    final = bounded.final_probability
    for k, (_, _, mu, _) in enumerate(reference.bank(bounded, z[:, :, 0])):
        assert found.final_mode_probability[k, 0] == pytest.approx(mu @ final, rel=ROUNDING)
    estimator = estimators()[name]
    chosen = estimator.settings(**settings)
    at_work = estimator.begin(chosen, estimator.prepare(chosen, model), np.zeros((4, WIDTH)))
    nothing = np.full((20, 2, WIDTH), np.nan)
    prior = bounded.initial_mode_probabilities
    for part in (nothing[:7], nothing[7:]):
        estimates = at_work.advance(estimator.prepare(chosen, model), part)
        for k in range(len(part)):
            prior = prior @ bounded.transition_matrix[0]
            expected = pytest.approx(prior @ final, rel=ROUNDING)
            assert estimates.final_mode_prior[k, 0] == expected
            assert estimates.final_mode_probability[k, 0] == expected


def test_others_do_not_tell_of_a_last_mode():
    found, _ = run_kernel(figure_5_model(), scans(1, 5))
    assert found.final_mode_probability.size == 0


# ---- the models of Sigalov 2011 --------------------------------------------------------------


def sigalovs_model(wiener="wiener_acceleration"):
    noise = np.array([[140.0**2]])
    modes = (
        Mode("m1", "constant_velocity_zero_acceleration", {"acceleration_std_m_s2": 0.3}, noise),
        Mode("m2", wiener, {"acceleration_std_m_s2": 6.0}, noise),
    )
    matrix = np.array([[0.92, 0.08], [0.08, 0.92]])
    bank = ModeBank(modes, ("x", "vx", "ax"), 1, matrix, None, np.array([1.0, 0.0]))
    return bank.discretise(np.array([10.0]), np.zeros(3), np.zeros((3, 3)))


@pytest.mark.parametrize(
    ("mode", "wiener", "position", "velocity"),
    [
        ("m1", "wiener_acceleration", 9385.954520, 23.36126351),
        ("m2", "wiener_acceleration", 18819.63796, 1175.219531),
        ("m2", "wiener_acceleration_as_printed", 19410.04112, 3179.324503),
    ],
)
def test_steady_state_variances_of_sigalovs_kalman_filters(mode, wiener, position, velocity):
    model = sigalovs_model(wiener).only(mode)
    found, _ = run_kernel(model, np.zeros((400, 1, 1)))
    # Packed lower triangle: (x, x), (x, vx), (vx, vx), ...
    assert found.covariance[-1, 0, 0] == pytest.approx(position, rel=ASKED)
    assert found.covariance[-1, 2, 0] == pytest.approx(velocity, rel=ASKED)


FAMILY = {
    "imm": {},
    "sbf": {"continuation_probability": 0.98},
    "hbf": {"most_transitions": 4},
    "mmae": {},
}


@pytest.mark.parametrize("name", FAMILY)
def test_a_start_known_exactly_divides_nothing_by_nothing(name):
    """m2 has probability 0 and all covariances are 0: unguarded mixing gives 0/0 at step 1."""
    model, recursion = bound_filter(name, sigalovs_model(), **FAMILY[name])
    found, _ = run_kernel(model, np.full((3, 1, 2), 50.0), recursion)
    for array in found:
        assert np.isfinite(array).all()
    np.testing.assert_allclose(found.mode_probabilities.sum(axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("name", [*FAMILY, "kalman", "genie"])
def test_an_outlier_of_a_thousand_sigma_leaves_all_finite(name):
    model, recursion = bound_filter(name, sigalovs_model(), **FAMILY.get(name, {}), **MODE[name])
    z = 140.0 * np.random.default_rng(7).normal(size=(60, 1, 4))
    z[20] += 140.0 * 1000.0 * np.array([1.0, -1.0, 1.0, -1.0])
    known = np.zeros((60, 4)) if name == "genie" else None
    found, _ = run_kernel(model, z, recursion, known=known)
    for array in found:
        assert np.isfinite(array).all()


MODE = {name: {"mode": "m1"} if name == "kalman" else {} for name in (*FAMILY, "kalman", "genie")}


# ---- as filters ------------------------------------------------------------------------------


def bound_filter(name, model, **settings):
    """The recursion's model of an estimator, and its choices."""
    estimator = estimators()[name]
    chosen = estimator.settings(**settings)
    return estimator.prepare(chosen, model).model, estimator.recursion(chosen)


def scans(seed, steps, n_y=2, lanes=3, scale=30.0):
    rng = np.random.default_rng(seed)
    z = scale * rng.normal(size=(steps, n_y, lanes)).cumsum(axis=0)
    z[rng.random((steps, 1, lanes)).repeat(n_y, axis=1) < 0.1] = np.nan
    return z


@pytest.mark.parametrize("initial", [(0.7, 0.3), (1.0, 0.0)])
def test_a_soft_bound_that_never_comes_leaves_the_imm(initial):
    model = figure_5_model()._replace(initial_mode_probabilities=np.array(initial))
    z = scans(1, 30)
    imm, _ = run_kernel(model, z)
    soft, recursion = bound_filter("sbf", model, continuation_probability=1.0)
    found, _ = run_kernel(soft, z, recursion)
    np.testing.assert_allclose(found.mean, imm.mean, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(found.mode_probabilities, imm.mode_probabilities, atol=ROUNDING)


@pytest.mark.parametrize(
    ("name", "settings"),
    [("sbf", {"continuation_probability": 0.0}), ("hbf", {"most_transitions": 0})],
)
def test_no_transition_at_all_is_the_kalman_filter_of_the_first_mode(name, settings):
    model = figure_5_model()._replace(initial_mode_probabilities=np.array([1.0, 0.0]))
    z = scans(2, 40)
    bounded, recursion = bound_filter(name, model, **settings)
    found, _ = run_kernel(bounded, z, recursion)
    alone, _ = run_kernel(model.only("CV"), z)
    np.testing.assert_allclose(found.mean, alone.mean, rtol=ASKED, atol=ASKED)
    np.testing.assert_allclose(found.covariance, alone.covariance, rtol=ASKED, atol=ASKED)
    np.testing.assert_allclose(found.mode_probabilities[:, 0], 1.0, atol=1e-12)


@pytest.mark.parametrize("name", ["sbf", "hbf"])
def test_pruned_and_whole_are_one_and_equal_the_reference(name):
    """Three modes, asymmetric, an unknown start among two of them, P0 = 0."""
    rng = np.random.default_rng(3)
    model = random_model(rng)._replace(
        transition_matrix=MATRIX,
        initial_mode_probabilities=np.array([0.6, 0.4, 0.0]),
        initial_covariance=np.zeros((4, 4)),
    )
    settings = {"continuation_probability": 0.9} if name == "sbf" else {"most_transitions": 2}
    small, recursion = bound_filter(name, model, **settings)
    arguments = (model.transition_matrix, model.initial_mode_probabilities, *settings.values())
    chain = soft_bound(*arguments) if name == "sbf" else hard_bound(*arguments)
    whole = on_supermodes(model, chain)
    assert len(small.mode_names) <= len(whole.mode_names)
    z = scans(4, 25, scale=3.0)
    found, _ = run_kernel(small, z, recursion)
    unpruned, _ = run_kernel(whole, z, recursion)
    assert np.isfinite(found.mean).all()
    np.testing.assert_allclose(found.mean, unpruned.mean, rtol=ASKED, atol=ASKED)
    np.testing.assert_allclose(found.mode_probabilities, unpruned.mode_probabilities, atol=ASKED)
    for k, (mean, _, mu, _) in enumerate(reference.bank(small, z[:, :, 0])):
        np.testing.assert_allclose(found.mean[k, :, 0], mean, rtol=ASKED, atol=ASKED)
        summed = [mu[np.array(small.mode_names) == mode].sum() for mode in model.mode_names]
        np.testing.assert_allclose(found.mode_probabilities[k, :, 0], summed, atol=ASKED)


# ---- as the truth ----------------------------------------------------------------------------


def drawn_modes(bound, blocks=8, steps=200):
    """Modes (steps, runs) of a chain of two modes, .92 and .92, that begins in the first."""
    noise = np.eye(1)
    modes = tuple(
        Mode(name, "wiener_acceleration", {"acceleration_std_m_s2": 1.0}, noise) for name in "ab"
    )
    matrix = np.array([[0.92, 0.08], [0.08, 0.92]])
    bank = ModeBank(modes, ("x", "vx", "ax"), 1, matrix, None, np.array([1.0, 0.0]))
    truth = ChainTruth(bank, np.zeros(3), np.zeros((3, 3)), bound)
    case = Case("chain", np.arange(steps + 1.0), truth)
    sensor = Sensor(noise[np.newaxis], 1.0, 0)
    spans = (slice(0, 30), slice(30, steps))
    drawn = []
    for block in range(blocks):
        simulation = BlockSimulation(case, sensor, 1, 0, block, BLOCK_RUNS)
        drawn.append(np.concatenate([simulation.advance(span).truth.mode for span in spans]))
    return np.concatenate(drawn, axis=1)


def transitions(modes):
    return (np.diff(np.vstack([np.zeros_like(modes[:1]), modes]), axis=0) != 0).sum(axis=0)


def test_a_softly_bounded_truth_stops_changing():
    """On average 3.92 transitions for ever: 0.98 * 0.08 of the 50 steps until it ends."""
    modes = drawn_modes(Bound(continuation_probability=0.98))
    count = transitions(modes)
    # The geometric series up to the 200th step, by which 1.8 % of the runs have not ended.
    expected = 0.98 * 0.08 * (1 - 0.98**200) / (1 - 0.98)
    error = count.std(ddof=1) / np.sqrt(count.size)
    assert abs(count.mean() - expected) < 4 * error  # four standard errors


def test_a_hard_bounded_truth_changes_no_more_than_that():
    modes = drawn_modes(Bound(most_transitions=4))
    count = transitions(modes)
    assert count.max() == 4
    assert (count == 4).mean() > 0.99  # 200 steps with .08 each: fewer than 4 in 1e-4 of runs
    assert (modes[-1][count == 4] == 0).all()  # an even number leads back


def test_an_unbounded_truth_is_the_chain_alone():
    count = transitions(drawn_modes(Bound()))
    assert abs(count.mean() - 16) < 4 * count.std(ddof=1) / np.sqrt(count.size)
