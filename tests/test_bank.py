"""The compiled recursion against slow references, against theory and against FilterPy."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import reference
from hybridtrack.estimators import _bank, _layout
from hybridtrack.estimators._bank import (
    COMMON_RESIDUAL_MEAN,
    INHERIT,
    MIXING,
    NO_INTERACTION,
    RESIDUAL_MEAN,
    Recursion,
)
from hybridtrack.vectors import WIDTH
from models import figure_5_model, random_model, run_kernel, unpacked

ROUNDING = 1e-10  # relative: about 1e-16 per operation, some 1e4 operations, a margin of 100


def compare_with_reference(model, z, recursion, **keywords):
    initial_mean = keywords.pop("initial_mean", None)
    known = keywords.pop("known", None)
    estimates, _ = run_kernel(model, z, recursion, known=known, initial_mean=initial_mean)
    n_x = len(model.state_names)
    for lane in range(z.shape[2]):
        history = reference.bank(
            model,
            z[:, :, lane],
            initial_mean=None if initial_mean is None else initial_mean[:, lane],
            known=None if known is None else known[:, lane],
            **keywords,
        )
        for k, (mean, covariance, probabilities, likelihoods) in enumerate(history):
            scale = np.sqrt(np.trace(covariance)) + np.abs(mean).max()
            close = {"rtol": ROUNDING, "atol": ROUNDING * scale}
            np.testing.assert_allclose(estimates.mean[k, :, lane], mean, **close)
            np.testing.assert_allclose(
                unpacked(estimates.covariance[k, :, lane], n_x),
                covariance,
                rtol=ROUNDING,
                atol=ROUNDING * scale**2,
            )
            np.testing.assert_allclose(
                estimates.mode_probabilities[k, :, lane], probabilities, rtol=0, atol=ROUNDING
            )
            np.testing.assert_allclose(
                estimates.mode_likelihoods[k, :, lane], likelihoods, rtol=0, atol=ROUNDING
            )


def measurements(rng, steps, n_y, lanes, missing=0.2, scale=1.0):
    z = scale * rng.normal(size=(steps, n_y, lanes))
    z[rng.random(z.shape) < missing / n_y] = np.nan  # one missing component misses the scan
    return z


def rmimm(floor=0.5, recursive=True, common=False):
    weighting = COMMON_RESIDUAL_MEAN if common else RESIDUAL_MEAN
    return (
        Recursion(MIXING, weighting, recursive, floor),
        {"rmimm": {"floor": floor, "recursive": recursive, "common": common}},
    )


FILTERS = {
    "imm": (Recursion(), {}),
    "mmae": (Recursion(interaction=NO_INTERACTION), {"mixing": False}),
    "mmae with a floor": (
        Recursion(interaction=NO_INTERACTION, mode_probability_floor=0.02),
        {"mixing": False, "floor": 0.02},
    ),
    "rmimm": rmimm(),
    "rmimm, residual error zero": rmimm(recursive=False),
    "rmimm, common": rmimm(common=True),
}


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("n_times", [1, 12])
def test_equals_the_reference_on_full_matrices(name, n_times):
    rng = np.random.default_rng(11)
    recursion, keywords = FILTERS[name]
    model = random_model(rng, n_times=n_times)
    z = measurements(rng, 12, 2, 3)
    start = rng.normal(size=(4, 3))
    compare_with_reference(model, z, recursion, initial_mean=start, **keywords)


@pytest.mark.parametrize("name", FILTERS)
def test_equals_the_reference_on_the_bank_of_figure_5(name):
    rng = np.random.default_rng(12)
    recursion, keywords = FILTERS[name]
    z = measurements(rng, 25, 2, 2, scale=40.0)
    z[:, 0] += 240.0 * np.arange(1, 26)[:, None]
    compare_with_reference(figure_5_model(), z, recursion, **keywords)


def test_known_modes_equal_the_reference_and_the_kalman_filter():
    rng = np.random.default_rng(13)
    model = random_model(rng)
    z = measurements(rng, 10, 2, 3)
    known = rng.integers(0, 3, size=(10, 3))
    genie = Recursion(interaction=INHERIT)
    compare_with_reference(model, z, genie, known=known)
    always = np.full((10, 3), 1)
    estimates, _ = run_kernel(model, z, genie, known=always)
    alone, _ = run_kernel(model.only("m1"), z)
    np.testing.assert_allclose(estimates.mean, alone.mean, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["imm", "mmae with a floor", "rmimm"])
def test_supermodes_of_one_name_are_reported_as_one(name):
    rng = np.random.default_rng(21)
    model = random_model(rng)
    z = measurements(rng, 15, 2, 3)
    recursion, _ = FILTERS[name]
    apart, _ = run_kernel(model, z, recursion)
    named, state = run_kernel(model._replace(mode_names=("a", "b", "a")), z, recursion)
    a, b, other_a = np.moveaxis(apart.mode_probabilities, 1, 0)
    assert min(a.max(), other_a.max()) > 0.1  # neither is the sum alone
    expected = np.stack([a + other_a, b], axis=1)
    # Rounding of one sum.
    np.testing.assert_allclose(named.mode_probabilities, expected, rtol=0, atol=1e-15)
    assert named.mean.tobytes() == apart.mean.tobytes()
    assert state.mode_probabilities.shape == (1, 3, WIDTH)  # inside they stay apart
    assert named.mode_likelihoods.size == 0  # a likelihood of several modes together is none


@pytest.mark.parametrize("n_times", [1, 20])
def test_two_spans_give_the_bytes_of_one(n_times):
    rng = np.random.default_rng(14)
    model = random_model(rng, n_times=n_times)
    z = measurements(rng, 20, 2, 16)
    recursion, _ = rmimm()
    whole, state = run_kernel(model, z, recursion)
    parts, other = run_kernel(model, z, recursion, spans=[slice(0, 7), slice(7, 8), slice(8, 20)])
    for a, b in zip((*whole, *state), (*parts, *other), strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("first", ["fed by all", "alone"])
def test_two_spans_are_one_where_the_chain_changes_its_zeros(first):
    rng = np.random.default_rng(23)
    model = random_model(rng, n_modes=2, n_times=20)
    alone = slice(10, 20) if first == "fed by all" else slice(0, 10)
    model.transition_matrix[alone] = np.eye(2)
    z = measurements(rng, 20, 2, 4)
    whole, state = run_kernel(model, z)
    parts, other = run_kernel(model, z, spans=[slice(0, 7), slice(7, 10), slice(10, 20)])
    for a, b in zip((*whole, *state), (*parts, *other), strict=True):
        assert a.tobytes() == b.tobytes()
    compare_with_reference(model, z, Recursion())


@pytest.mark.parametrize("name", FILTERS)
def test_what_was_in_memory_before_does_not_matter(name):
    """Workspace and room for estimates are used again by whoever comes next."""
    rng = np.random.default_rng(22)
    model = random_model(rng)
    z = measurements(rng, 12, 2, 5)
    recursion, _ = FILTERS[name]
    clean, state = run_kernel(model, z, recursion)
    spoilt, other = run_kernel(model, z, recursion, rubbish=np.nan)
    for a, b in zip((*clean, *state), (*spoilt, *other), strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("lanes", [16, 32, 48])
def test_a_lane_does_not_depend_on_how_many_there_are(lanes):
    rng = np.random.default_rng(15)
    z = measurements(rng, 20, 2, 256, scale=30.0)
    model = figure_5_model()
    recursion, _ = rmimm()
    all_lanes, _ = run_kernel(model, z, recursion)
    few, _ = run_kernel(model, z[:, :, :lanes].copy(), recursion)
    for a, b in zip(all_lanes, few, strict=True):
        assert a[..., :lanes].tobytes() == b.tobytes()


# ---- theory ----------------------------------------------------------------------------------

seeds = st.integers(0, 2**32 - 1)
few_examples = settings(max_examples=20, deadline=None, derandomize=True)


@given(seeds)
@few_examples
def test_identity_matrix_makes_imm_and_mmae_one(seed):
    rng = np.random.default_rng(seed)
    model = random_model(rng)._replace(transition_matrix=np.eye(3)[np.newaxis])
    z = measurements(rng, 8, 2, 2)
    imm, _ = run_kernel(model, z)
    mmae, _ = run_kernel(model, z, Recursion(interaction=NO_INTERACTION))
    np.testing.assert_allclose(imm.mean, mmae.mean, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(imm.mode_probabilities, mmae.mode_probabilities, atol=ROUNDING)


@given(seeds)
@few_examples
def test_identical_modes_are_the_kalman_filter_and_follow_the_chain_alone(seed):
    rng = np.random.default_rng(seed)
    model = random_model(rng)
    same = [0, 0, 0]
    model = model._replace(
        state_transition=model.state_transition[:, same],
        input_effect=model.input_effect[:, same],
        process_noise_covariance=model.process_noise_covariance[:, same],
        measurement_matrix=model.measurement_matrix[same],
        measurement_noise_covariance=model.measurement_noise_covariance[same],
    )
    z = measurements(rng, 8, 2, 2)
    imm, _ = run_kernel(model, z)
    kalman, _ = run_kernel(model.only("m0"), z)
    np.testing.assert_allclose(imm.mean, kalman.mean, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(imm.covariance, kalman.covariance, rtol=ROUNDING, atol=ROUNDING)
    chain = model.initial_mode_probabilities
    for k in range(8):
        chain = chain @ model.transition_matrix[0]
        np.testing.assert_allclose(imm.mode_probabilities[k, :, 0], chain, atol=ROUNDING)


@given(seeds)
@few_examples
def test_first_imm_step_is_exact(seed):
    rng = np.random.default_rng(seed)
    model = random_model(rng)
    z = measurements(rng, 1, 2, 1, missing=0.0)
    imm, _ = run_kernel(model, z)
    mean, covariance, probabilities = reference.enumerate_mode_sequences(model, z[:, :, 0])
    np.testing.assert_allclose(imm.mean[0, :, 0], mean, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(
        unpacked(imm.covariance[0, :, 0], 4), covariance, rtol=ROUNDING, atol=ROUNDING
    )
    np.testing.assert_allclose(imm.mode_probabilities[0, :, 0], probabilities, atol=ROUNDING)


@given(seeds)
@few_examples
def test_static_bank_is_exact(seed):
    rng = np.random.default_rng(seed)
    model = random_model(rng)._replace(transition_matrix=np.eye(3)[np.newaxis])
    z = measurements(rng, 5, 2, 1)
    mmae, _ = run_kernel(model, z, Recursion(interaction=NO_INTERACTION))
    mean, _, probabilities = reference.enumerate_mode_sequences(model, z[:, :, 0])
    np.testing.assert_allclose(mmae.mean[-1, :, 0], mean, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(mmae.mode_probabilities[-1, :, 0], probabilities, atol=ROUNDING)


@pytest.mark.parametrize(
    "recursion",
    [rmimm(common=True)[0], rmimm(floor=1e12)[0], rmimm(floor=1e12, recursive=False)[0]],
    ids=["common", "floor 1e12", "floor 1e12, residual error zero"],
)
def test_rmimm_without_its_factor_is_imm(recursion):
    rng = np.random.default_rng(16)
    z = measurements(rng, 60, 2, 4, scale=40.0)
    imm, _ = run_kernel(figure_5_model(), z)
    other, _ = run_kernel(figure_5_model(), z, recursion)
    np.testing.assert_allclose(other.mean, imm.mean, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(other.mode_probabilities, imm.mode_probabilities, atol=1e-10)


def scalar_model(F, P0=(1.0, 1.0), means=(0.0, 10.0), matrix=((0.9, 0.1), (0.1, 0.9))):
    model = random_model(np.random.default_rng(0), n_modes=2, n_x=1, n_y=1)
    return model._replace(
        state_transition=np.array(F, dtype=float).reshape(1, 2, 1, 1),
        input_effect=np.zeros((1, 2, 1)),
        process_noise_covariance=np.zeros((1, 2, 1, 1)),
        measurement_matrix=np.ones((2, 1, 1)),
        measurement_noise_covariance=np.ones((2, 1, 1)),
        transition_matrix=np.array([matrix]),
        initial_mean=np.array([means[0]]),
        initial_covariance=np.array([[P0[0]]]),
    )


def test_hand_case_of_one_step():
    """Means 0 and 10 of variance 1; a missing scan leaves the prediction to be seen."""
    model = scalar_model((1.0, 2.0))
    state = _layout.start(model, WIDTH)
    state.mean[:, :, 0] = [[0.0], [10.0]]
    # Equal probabilities and .9/.1: the modes' starts are 1 and 9, of variance 1 + .09 * 100.
    state.mode_probabilities[:] = 0.5
    out = _advance_one_step(model, state, Recursion())
    np.testing.assert_allclose(state.mean[0, :, 0, 0], [1.0, 18.0], rtol=1e-14)
    np.testing.assert_allclose(state.covariance[0, :, 0, 0], [10.0, 40.0], rtol=1e-14)
    # The combination: means 0 and 10, variances 1, probabilities .25 and .75.
    model = scalar_model((1.0, 1.0), matrix=((1.0, 0.0), (0.0, 1.0)))
    state.mean[:, :, 0] = [[0.0], [10.0]]
    state.covariance[:] = 1.0
    state.mode_probabilities[:] = [[0.25], [0.75]]
    state.log_mode_probabilities[:] = np.log([[0.25], [0.75]])
    out = _advance_one_step(model, state, Recursion(interaction=NO_INTERACTION))
    np.testing.assert_allclose(out.mean[0, 0], 7.5, rtol=1e-14)
    np.testing.assert_allclose(out.covariance[0, 0], 19.75, rtol=1e-14)


def _advance_one_step(model, state, recursion):
    """A step without a scan."""
    out = _layout.empty_estimates(model, 1, WIDTH, likelihoods=True, covariance=True)
    z = np.full((1, 1, WIDTH), np.nan)
    _bank.run_span(state, _layout.workspace(model), _layout.kernel_model(model), recursion, z, out)
    return out


# ---- numbers that break filters --------------------------------------------------------------


def test_evidence_beyond_the_range_of_a_float_is_not_forgotten():
    """400 scans for one mode (e**-5000 against the other), then 500 for the other."""
    model = scalar_model((1.0, 1.0), matrix=((1.0, 0.0), (0.0, 1.0)))
    model = model._replace(
        input_effect=np.array([[[0.0], [0.0]]]),
        measurement_matrix=np.array([[[1.0]], [[1.0]]]),
        measurement_noise_covariance=np.array([[[1.0]], [[4.0]]]),
        initial_covariance=np.array([[0.0]]),
        initial_mode_probabilities=np.array([0.5, 0.5]),
    )
    z = np.concatenate([np.full((400, 1, 1), 6.0), np.full((20000, 1, 1), 0.0)])
    estimates, _ = run_kernel(model, z, Recursion(interaction=NO_INTERACTION))
    per_scan = 0.5 * 36 * (1 - 0.25) - np.log(2)  # log-likelihood ratio of m1 to m0 at z = 6
    back = np.log(2)  # and of m0 to m1 at z = 0
    turn = 400 + int(400 * per_scan / back) + 1
    assert estimates.mode_probabilities[399, 0, 0] == 0.0
    assert estimates.mode_probabilities[turn - 3, 0, 0] < 0.5
    assert estimates.mode_probabilities[turn + 2, 0, 0] > 0.5


def constant_model(matrix, R=(1.0, 4.0)):
    """A state known to be 0: the filter is then the exact filter of a hidden Markov chain."""
    model = scalar_model((1.0, 1.0), matrix=matrix)
    return model._replace(
        measurement_matrix=np.ones((2, 1, 1)),
        measurement_noise_covariance=np.array(R).reshape(2, 1, 1),
        initial_covariance=np.zeros((1, 1)),
        initial_mode_probabilities=np.array([0.5, 0.5]),
    )


@pytest.mark.parametrize("scans", range(300, 330, 3))
def test_modes_that_vanish_together_leave_no_hole(scans):
    """Two pairs of modes; one pair gone to e**-700, then a scan that all but excludes the other."""
    matrix = np.kron(np.eye(2), [[0.9, 0.1], [0.1, 0.9]])
    model = random_model(np.random.default_rng(0), n_modes=4, n_x=1, n_y=1)._replace(
        state_transition=np.ones((1, 4, 1, 1)),
        input_effect=np.zeros((1, 4, 1)),
        process_noise_covariance=np.zeros((1, 4, 1, 1)),
        measurement_matrix=np.ones((4, 1, 1)),
        measurement_noise_covariance=np.array([1.0, 1.0, 100.0, 100.0]).reshape(4, 1, 1),
        transition_matrix=matrix[np.newaxis],
        initial_mode_probabilities=np.full(4, 0.25),
        initial_mean=np.zeros(1),
        initial_covariance=np.zeros((1, 1)),
    )
    z = np.concatenate([np.zeros(scans), [45.0]])[:, np.newaxis, np.newaxis]
    compare_with_reference(model, z, Recursion())


def test_evidence_against_a_mode_that_nothing_else_feeds_is_not_forgotten():
    """m0 may end in m1, which is for ever: e**-5000 against m0, and then all for it again."""
    matrix = np.array([[0.9, 0.1], [0.0, 1.0]])
    z = np.concatenate([np.full(400, 6.0), np.zeros(12000)])
    estimates, _ = run_kernel(constant_model(matrix), z[:, np.newaxis, np.newaxis])
    # Forwards in logarithms; the constant of the likelihood is that of R alone.
    log_mu = np.log([0.5, 0.5])
    with np.errstate(divide="ignore"):
        log_matrix = np.log(matrix)
    least = 0.0
    for k, value in enumerate(z):
        log_mu = np.logaddexp.reduce(log_mu[:, np.newaxis] + log_matrix, axis=0)
        log_mu = log_mu - 0.5 * (value**2 / np.array([1.0, 4.0]) + np.log([1.0, 4.0]))
        log_mu = log_mu - np.logaddexp.reduce(log_mu)
        least = min(least, log_mu[0])
        # Logarithms of 5000 have 1e-12 of rounding, and 12,000 steps add theirs.
        np.testing.assert_allclose(
            estimates.mode_probabilities[k, :, 0], np.exp(log_mu), rtol=1e-7, atol=1e-12
        )
    assert least < -4000
    assert estimates.mode_probabilities[-1, 0, 0] > 0.5


def test_unreachable_modes_stay_at_zero_and_finite():
    rng = np.random.default_rng(17)
    model = random_model(rng)._replace(
        transition_matrix=np.array([[[0.7, 0.3, 0.0], [0.4, 0.6, 0.0], [0.2, 0.3, 0.5]]]),
        initial_mode_probabilities=np.array([1.0, 0.0, 0.0]),
    )
    for recursion in (Recursion(), Recursion(interaction=NO_INTERACTION), rmimm()[0]):
        estimates, state = run_kernel(model, measurements(rng, 30, 2, 4), recursion)
        assert not estimates.mode_probabilities[:, 2].any()
        for array in (estimates.mean, estimates.covariance, state.mean, state.covariance):
            assert np.isfinite(array).all()


def test_exactly_known_start_and_zeroed_states():
    rng = np.random.default_rng(18)
    model = figure_5_model()._replace(initial_covariance=np.zeros((6, 6)))
    z = measurements(rng, 40, 2, 2, scale=20.0)
    z[:, 0] += 240.0 * np.arange(1, 41)[:, None]
    compare_with_reference(model, z, Recursion())


def test_all_scans_missing_is_prediction():
    model = figure_5_model().only("CT")
    estimates, _ = run_kernel(model, np.full((5, 2, 1), np.nan))
    F = model.state_transition[0, 0]
    x = np.linalg.matrix_power(F, 5) @ model.initial_mean
    np.testing.assert_allclose(estimates.mean[-1, :, 0], x, rtol=1e-14)


def test_covariance_update_keeps_josephs_digits():
    """P0 = 1e9, R = 1e-9: the plain form P - K H P loses every digit of the result.

    Measured position of (position, velocity) of correlation 1/2, exactly by fractions.
    """
    P0, R = 10**9, Fraction(1, 10**9)
    exact = np.array([[float(P0 * R / (P0 + R)), 0.0], [0.0, 0.0]])
    exact[0, 1] = exact[1, 0] = float(Fraction(P0, 2) * R / (P0 + R))
    exact[1, 1] = float(P0 - Fraction(P0, 2) ** 2 / (P0 + R))
    model = random_model(np.random.default_rng(0), n_modes=1, n_x=2, n_y=1)._replace(
        state_transition=np.eye(2).reshape(1, 1, 2, 2),
        process_noise_covariance=np.zeros((1, 1, 2, 2)),
        measurement_noise_covariance=np.full((1, 1, 1), 1e-9),
        initial_covariance=P0 * np.array([[1.0, 0.5], [0.5, 1.0]]),
    )
    component = model._replace(measurement_matrix=np.array([[[1.0, 0.0]]]))
    by_component, _ = run_kernel(component, np.zeros((1, 1, 1)))
    got = unpacked(by_component.covariance[0, :, 0], 2)
    np.testing.assert_allclose(got, exact, rtol=1e-13)
    # A rotated state measures the same by a combination of two components.
    c, s = 0.6, 0.8
    turn = np.array([[c, -s], [s, c]])
    rotated = model._replace(
        measurement_matrix=np.array([[[c, s]]]),
        initial_covariance=turn @ component.initial_covariance @ turn.T,
    )
    by_combination, _ = run_kernel(rotated, np.zeros((1, 1, 1)))
    got = turn.T @ unpacked(by_combination.covariance[0, :, 0], 2) @ turn
    # Joseph's form keeps the order of the measured variance, 1e-9 of 1e9, and so must this.
    assert np.linalg.eigvalsh(got)[0] > -1e-6
    assert abs(got[1, 1] / exact[1, 1] - 1) < 1e-12


@pytest.mark.parametrize("seed", range(20))
def test_rounding_turns_no_variance_negative(seed):
    """P0/R = 1e18 without process noise: after two scans small variances are all rounding.

    Textbook Joseph has S <= 0 in a quarter of such cases, the plain form in nearly all.
    """
    rng = np.random.default_rng(seed)
    T = rng.uniform(0.3, 3.0)
    model = random_model(rng, n_modes=1, n_x=2, n_y=1)._replace(
        state_transition=np.array([[1.0, T], [0.0, 1.0]]).reshape(1, 1, 2, 2),
        input_effect=np.zeros((1, 1, 2)),
        process_noise_covariance=np.zeros((1, 1, 2, 2)),
        measurement_matrix=np.array([[[1.0, 0.0]]]),
        measurement_noise_covariance=np.full((1, 1, 1), 1e-9),
        initial_covariance=1e9 * np.eye(2),
    )
    estimates, _ = run_kernel(model, np.zeros((30, 1, 1)))
    covariance = unpacked(np.moveaxis(estimates.covariance, 0, 1), 2)
    assert np.isfinite(estimates.mean).all()
    assert (covariance[[0, 1], [0, 1]] >= 0).all()


def test_long_run_stays_symmetric_and_positive_definite():
    rng = np.random.default_rng(19)
    z = measurements(rng, 2000, 2, 2, scale=20.0)
    model = figure_5_model()
    estimates, state = run_kernel(model, z)
    assert np.isfinite(estimates.mean).all()
    for j in range(2):
        assert np.linalg.eigvalsh(unpacked(state.covariance[0, j, :, 0], 6)).min() > -1e-9


def test_enormous_outlier_leaves_everything_finite():
    z = np.zeros((50, 2, 2))
    z[20] = 1000 * 17.7
    for recursion in (Recursion(), Recursion(interaction=NO_INTERACTION), rmimm()[0]):
        estimates, _ = run_kernel(figure_5_model(), z, recursion)
        for array in estimates:
            assert np.isfinite(array).all()


# ---- a peer ----------------------------------------------------------------------------------


@pytest.mark.parametrize("mixing", [True, False], ids=["IMM", "MMAE"])
def test_equals_filterpy(mixing):
    from filterpy.kalman import IMMEstimator, KalmanFilter, MMAEFilterBank

    model = figure_5_model()
    if not mixing:  # its MMAE is the static bank
        model = model._replace(transition_matrix=np.eye(2)[np.newaxis])
    filters = []
    for j in range(2):
        f = KalmanFilter(dim_x=6, dim_z=2)
        f.x = model.initial_mean[:, np.newaxis].copy()
        f.P = model.initial_covariance.copy()
        f.F, f.Q = model.state_transition[0, j], model.process_noise_covariance[0, j]
        f.H, f.R = model.measurement_matrix[j], model.measurement_noise_covariance[j]
        filters.append(f)
    probabilities = model.initial_mode_probabilities
    if mixing:
        peer = IMMEstimator(filters, probabilities, model.transition_matrix[0])
    else:
        peer = MMAEFilterBank(filters, list(probabilities), dim_x=6, H=model.measurement_matrix[0])
    rng = np.random.default_rng(20)
    z = 20.0 * rng.normal(size=(30, 2, 1))
    z[:, 0] += 240.0 * np.arange(1, 31)[:, None]
    z[15:, 1] += 8.0 * np.arange(15)[:, None] ** 2
    recursion = Recursion(interaction=MIXING if mixing else NO_INTERACTION)
    estimates, _ = run_kernel(model, z, recursion)
    for k in range(30):
        peer.predict()
        peer.update(z[k])
        mu = peer.mu if mixing else peer.p
        # 1e-9: both carry rounding of about 1e-12 over 30 steps of states of 1e4
        np.testing.assert_allclose(
            estimates.mean[k, :, 0], np.ravel(peer.x), rtol=1e-9, atol=1e-9 * 1e4
        )
        np.testing.assert_allclose(estimates.mode_probabilities[k, :, 0], np.ravel(mu), atol=1e-9)
        if mixing:  # the covariance of its MMAE is wrong (MMAEFilterBank.P)
            np.testing.assert_allclose(
                unpacked(estimates.covariance[k, :, 0], 6), peer.P, rtol=1e-9, atol=1e-6
            )
