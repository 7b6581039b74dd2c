"""The tree of mode sequences against all of them enumerated, and pruned against a slow one."""

import numpy as np
import pytest

import reference
from hybridtrack.chains import Bound, on_supermodes
from hybridtrack.errors import UserError
from hybridtrack.estimators import Estimates, memory
from hybridtrack.estimators.best_sequences import ESTIMATOR, RUNS_PER_CALL, Settings
from models import figure_5_model, random_model, run_kernel, slice_times, unpacked
from test_bank import constant_model, measurements

# Asked for. The kernels and the references order some 1e4 operations of 1e-16 differently.
CLOSE = 1e-9

BOUNDS = {
    "soft": {"continuation_probability": 0.9},
    "soft, with a leak": {"continuation_probability": 0.7, "leak": 0.1},
    "hard": {"most_transitions": 1},
}


def filtered(model, z, *, spans=None, initial_mean=None, **settings):
    """Estimates of z (steps, n_y, runs), with everything, in memory full of rubbish."""
    chosen = Settings(**settings)
    steps, _, runs = z.shape
    if initial_mean is None:
        initial_mean = np.repeat(model.initial_mean[:, np.newaxis], runs, axis=1)
    running, parts = None, []
    for span in spans or [slice(0, steps)]:
        prepared = ESTIMATOR.prepare(chosen, slice_times(model, span))
        running = running or ESTIMATOR.begin(chosen, prepared, initial_mean)
        part = np.ascontiguousarray(z[span])
        room = memory.room(prepared.model, len(part), runs, False, True)
        for array in (*room, *memory.workspace(prepared.model)):
            array.fill(np.nan)
        found = running.advance(prepared, part, covariance=True)
        parts.append(Estimates(*(array.copy() for array in found)))
    return Estimates(*(np.concatenate(p) for p in zip(*parts, strict=True)))


def on_bound(model, bound):
    """The model on the supermodes of a bound, for the references."""
    chain = Bound(**bound).supermodes(model.transition_matrix, model.initial_mode_probabilities)
    return on_supermodes(model, chain)


def compare(estimates, k, run, expected, model):
    """Step k of a run; `expected` has the probabilities of the model's supermodes.

    Those lie in any order, the estimates in that of the modes: m0, m1, m2.
    """
    mean, covariance, probabilities = expected
    close = {"rtol": CLOSE, "atol": CLOSE}
    np.testing.assert_allclose(estimates.mean[k, :, run], mean, **close)
    found = unpacked(estimates.covariance[k, :, run], len(mean))
    np.testing.assert_allclose(found, covariance, **close)
    names = np.array(model.mode_names)
    summed = [probabilities[names == name].sum() for name in sorted(set(names))]
    np.testing.assert_allclose(estimates.mode_probabilities[k, :, run], summed, **close)
    if len(estimates.final_mode_probability):
        final = model.final_probability @ probabilities
        np.testing.assert_allclose(estimates.final_mode_probability[k, run], final, **close)


def of_start(model, start):
    """The model with another start."""
    n_modes, n_x = len(model.mode_names), len(model.state_names)
    if start == "known":
        model = model._replace(
            initial_covariance=np.zeros((n_x, n_x)), initial_mode_probabilities=np.eye(n_modes)[1]
        )
    return model


# ---- nothing pruned --------------------------------------------------------------------------


@pytest.mark.parametrize("n_times", [1, 5])
@pytest.mark.parametrize("start", ["spread", "known"])
def test_all_sequences_are_the_exact_filter(n_times, start):
    """Three modes of their own H and correlated R; the second scan is missed."""
    rng = np.random.default_rng(31)
    model = of_start(random_model(rng, n_times=n_times), start)
    z = rng.normal(size=(5, 2, 1))
    z[1, 0] = np.nan
    estimates = filtered(model, z, sequences=3**5)
    for k in range(5):
        expected = reference.enumerate_mode_sequences(model, z[: k + 1, :, 0])
        compare(estimates, k, 0, expected, model)
    assert not len(estimates.final_mode_probability)
    assert not len(estimates.final_mode_prior)
    assert not len(estimates.mode_likelihoods)


@pytest.mark.parametrize("name", BOUNDS)
@pytest.mark.parametrize("n_times", [1, 4])
@pytest.mark.parametrize("start", ["spread", "known"])
def test_all_sequences_of_a_bounded_chain_are_the_exact_filter(name, n_times, start):
    """As many are kept as there are sequences of modes: stages must not take their places."""
    rng = np.random.default_rng(32)
    model = of_start(random_model(rng, n_modes=2, n_times=n_times), start)
    z = rng.normal(size=(4, 2, 1))
    z[2] = np.nan
    estimates = filtered(model, z, sequences=2**4, **BOUNDS[name])
    larger = on_bound(model, BOUNDS[name])
    prior = larger.initial_mode_probabilities
    for k in range(4):
        expected = reference.enumerate_mode_sequences(larger, z[: k + 1, :, 0])
        compare(estimates, k, 0, expected, larger)
        prior = prior @ reference.at(larger.transition_matrix, k)
        if n_times == 1:
            final = larger.final_probability @ prior
            # Rounding of sums of a few products.
            np.testing.assert_allclose(estimates.final_mode_prior[k, 0], final, rtol=1e-14)
    # Where steps are uneven nothing is told: what comes is another chain than what was.
    told = 4 if n_times == 1 else 0
    assert (len(estimates.final_mode_probability), len(estimates.final_mode_prior)) == (told, told)


@pytest.mark.parametrize("sequences", [1, 100])
def test_one_mode_is_the_kalman_filter(sequences):
    rng = np.random.default_rng(33)
    model = random_model(rng).only("m1")
    z = measurements(rng, 30, 2, 3)
    estimates = filtered(model, z, sequences=sequences)
    kalman, _ = run_kernel(model, z)
    # The same operations, and a division by the one weight, 1.
    np.testing.assert_allclose(estimates.mean, kalman.mean, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(estimates.covariance, kalman.covariance, rtol=1e-13, atol=1e-14)
    np.testing.assert_array_equal(estimates.mode_probabilities, 1.0)


# ---- pruned ----------------------------------------------------------------------------------


@pytest.mark.parametrize("sequences", [1, 2, 7, 40])
@pytest.mark.parametrize("n_times", [1, 12])
def test_the_pruned_tree_equals_the_reference(sequences, n_times):
    rng = np.random.default_rng(34)
    model = random_model(rng, n_times=n_times)
    z = measurements(rng, 12, 2, 2, scale=2.0)
    estimates = filtered(model, z, sequences=sequences)
    for run in range(2):
        history = reference.best_sequences(model, z[:, :, run], sequences)
        for k, expected in enumerate(history):
            compare(estimates, k, run, expected, model)


@pytest.mark.parametrize("name", BOUNDS)
def test_the_pruned_tree_on_a_bounded_chain_equals_the_reference(name):
    rng = np.random.default_rng(35)
    model = of_start(random_model(rng, n_times=15), "known")
    z = measurements(rng, 15, 2, 1, scale=2.0)
    estimates = filtered(model, z, sequences=5, **BOUNDS[name])
    larger = on_bound(model, BOUNDS[name])
    for k, expected in enumerate(reference.best_sequences(larger, z[:, :, 0], 5)):
        compare(estimates, k, 0, expected, larger)


def by_chain_alone(row, **settings):
    """Mode probabilities after one missed scan, from the first of three modes on."""
    rng = np.random.default_rng(36)
    model = random_model(rng)._replace(
        transition_matrix=np.array([[row, [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]]),
        initial_mode_probabilities=np.array([1.0, 0.0, 0.0]),
    )
    estimates = filtered(model, np.full((1, 2, 1), np.nan), **settings)
    return estimates.mode_probabilities[0, :, 0]


def test_hand_case_of_what_is_kept():
    """The least probable goes, of equals the last; the rest share its probability."""
    close = {"rtol": 0, "atol": 1e-15}  # rounding of one quotient
    three = by_chain_alone([0.3, 0.1, 0.6], sequences=3)
    np.testing.assert_allclose(three, [0.3, 0.1, 0.6], **close)
    two = by_chain_alone([0.3, 0.1, 0.6], sequences=2)
    np.testing.assert_allclose(two, [1 / 3, 0.0, 2 / 3], **close)
    np.testing.assert_array_equal(by_chain_alone([0.3, 0.1, 0.6], sequences=1), [0.0, 0.0, 1.0])
    equals = by_chain_alone([0.4, 0.4, 0.2], sequences=1)
    np.testing.assert_array_equal(equals, [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(
        by_chain_alone([0.25, 0.5, 0.25], sequences=2), by_chain_alone([1, 2, 0], sequences=2)
    )


def test_unreachable_modes_stay_at_zero():
    rng = np.random.default_rng(37)
    model = random_model(rng)._replace(
        transition_matrix=np.array([[[0.7, 0.3, 0.0], [0.4, 0.6, 0.0], [0.2, 0.3, 0.5]]]),
        initial_mode_probabilities=np.array([1.0, 0.0, 0.0]),
    )
    estimates = filtered(model, measurements(rng, 20, 2, 2), sequences=33)
    assert not estimates.mode_probabilities[:, 2].any()
    assert np.isfinite(estimates.mean).all()


# ---- spans and runs --------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [{}, *BOUNDS.values()], ids=["plain", *BOUNDS])
@pytest.mark.parametrize("n_times", [1, 12])
def test_two_spans_give_the_bytes_of_one(settings, n_times):
    rng = np.random.default_rng(38)
    model = random_model(rng, n_times=n_times)
    z = measurements(rng, 12, 2, 3)
    whole = filtered(model, z, sequences=35, **settings)
    spans = [slice(0, 3), slice(3, 4), slice(4, 12)]
    parts = filtered(model, z, sequences=35, spans=spans, **settings)
    for a, b in zip(whole, parts, strict=True):
        assert a.tobytes() == b.tobytes()


def test_a_run_does_not_depend_on_the_others():
    rng = np.random.default_rng(39)
    model = random_model(rng)
    runs = 2 * RUNS_PER_CALL + 3
    z, start = measurements(rng, 10, 2, runs), rng.normal(size=(4, runs))
    together = filtered(model, z, initial_mean=start, sequences=40)
    assert np.unique(together.mean[-1, 0]).size == runs
    for run in range(runs):
        only = slice(run, run + 1)
        alone = filtered(model, z[..., only], initial_mean=start[:, only], sequences=40)
        for a, b in zip(together, alone, strict=True):
            assert a[..., only].tobytes() == b.tobytes()


# ---- numbers that break filters --------------------------------------------------------------


def test_an_outlier_of_1000_sigma_leaves_everything_finite():
    z = np.zeros((30, 2, 1))
    z[20] = 1000 * 17.7
    for array in filtered(figure_5_model(), z):
        assert np.isfinite(array).all()


def test_a_scan_beyond_all_numbers_ends_the_run():
    """Where every likelihood is 0 nothing is left to be kept, and the block calls it diverged."""
    z = np.zeros((6, 2, 2))
    z[3, :, 0] = 1e200
    estimates = filtered(figure_5_model(), z, continuation_probability=0.9)
    for array in (estimates.mean, estimates.mode_probabilities, estimates.covariance):
        assert np.isnan(array[3:, :, 0]).all()
        assert np.isfinite(array[:3]).all()
        assert np.isfinite(array[..., 1]).all()


def test_evidence_beyond_the_range_of_a_float_is_not_forgotten():
    """400 scans for one mode (e**-5000 against the other), then all for the other, of two that
    last for ever: the filter adds up the scans' likelihoods."""
    z = np.concatenate([np.full(400, 6.0), np.zeros(12000)])
    estimates = filtered(constant_model(np.eye(2)), z[:, np.newaxis, np.newaxis], sequences=2)
    variance = np.array([[1.0], [4.0]])
    log_odds = np.cumsum(np.diff(-0.5 * (z**2 / variance + np.log(variance)), axis=0))
    assert log_odds.max() > 4000
    # Logarithms of 5000 have 1e-12 of rounding, and 12,000 steps add theirs.
    expected = 1 / (1 + np.exp(-np.clip(log_odds, -700, 700)))
    np.testing.assert_allclose(estimates.mode_probabilities[:, 1, 0], expected, atol=1e-7)
    assert estimates.mode_probabilities[-1, 0, 0] > 0.9


def explosive_model():
    """Two modes that last for ever: the state stays 0, or grows by 1e100 a step."""
    return constant_model(np.eye(2), R=(1.0, 1.0))._replace(
        state_transition=np.array([1.0, 1e100]).reshape(1, 2, 1, 1),
        input_effect=np.array([0.0, 1e3]).reshape(1, 2, 1),
    )


def test_a_sequence_that_a_scan_rules_out_leaves_no_trace():
    """At 1e203, after three missed scans, it has no likelihood at all; the other one is left."""
    z = np.full((6, 1, 1), np.nan)
    z[3] = 0.0
    estimates = filtered(explosive_model(), z)
    np.testing.assert_array_equal(estimates.mode_probabilities[:3, :, 0], 0.5)
    np.testing.assert_array_equal(estimates.mode_probabilities[3:, 0], 1.0)
    np.testing.assert_array_equal(estimates.mean[3:], 0.0)


def test_a_mode_without_weight_may_overflow():
    """It is ruled out by e**-5e5, and grows beyond all numbers while scans are missed."""
    z = np.full((8, 1, 1), np.nan)
    z[0] = 0.0
    estimates = filtered(explosive_model(), z)
    np.testing.assert_array_equal(estimates.mode_probabilities[:, 0], 1.0)
    np.testing.assert_array_equal(estimates.mean, 0.0)
    np.testing.assert_array_equal(estimates.covariance, 0.0)


def test_that_a_mode_has_not_ended_is_never_forgotten():
    """By the chain alone the one sequence kept has ended but for e**-1600; then a scan says e**5000
    for the other mode."""
    model = constant_model([[0.9, 0.1], [0.1, 0.9]], R=(1.0, 1e4))
    model = model._replace(initial_mode_probabilities=np.array([1.0, 0.0]))
    z = np.full((2001, 1, 1), np.nan)
    z[-1] = 100.0
    estimates = filtered(model, z, sequences=1, continuation_probability=0.5)
    np.testing.assert_array_equal(estimates.mode_probabilities[:-1, 0, 0], 1.0)
    np.testing.assert_array_equal(estimates.mode_probabilities[-1, :, 0], [0.0, 1.0])


def test_a_vague_start_keeps_josephs_digits():
    """P0 = 1e9 against R of 1: after the first scan the position's variance is R's but for 1e-9."""
    rng = np.random.default_rng(40)
    model = random_model(rng, n_x=2, n_y=1)._replace(
        state_transition=np.broadcast_to(np.eye(2), (1, 3, 2, 2)),
        process_noise_covariance=np.zeros((1, 3, 2, 2)),
        input_effect=np.zeros((1, 3, 2)),
        measurement_matrix=np.broadcast_to([[1.0, 0.0]], (3, 1, 2)),
        measurement_noise_covariance=np.ones((3, 1, 1)),
        initial_mean=np.zeros(2),
        initial_covariance=1e9 * np.eye(2),
    )
    z = np.zeros((40, 1, 1))
    estimates = filtered(model, z, sequences=50)
    k = np.arange(1, 41)
    expected = 1 / (k + 1e-9)  # all modes are one: the mean of k scans
    np.testing.assert_allclose(estimates.covariance[:, 0, 0], expected, rtol=1e-12)
    np.testing.assert_allclose(estimates.covariance[:, 2, 0], 1e9, rtol=1e-12)


# ---- settings --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"continuation_probability": 0.9, "most_transitions": 3}, "remove one"),
        ({"leak": 0.1}, "without 'continuation_probability' none ends; add that, or remove"),
        ({"most_transitions": 3, "leak": 0.1}, "without 'continuation_probability' none ends"),
    ],
)
def test_settings_that_do_not_go_together(settings, sentence):
    with pytest.raises(UserError, match=sentence):
        ESTIMATOR.prepare(Settings(**settings), figure_5_model())
