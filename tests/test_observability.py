"""Telling modes apart: figures against dense references, and what the paper's tests are worth."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import reference_observability as reference
from hybridtrack import config
from hybridtrack.analyses import analyses, model_at_one_step
from hybridtrack.analyses._errors_of_tests import (
    Spectrum,
    best_chernoff,
    bhattacharyya_distance,
    chernoff_distance,
    error_probability,
    lower_error,
    upper_error,
)
from hybridtrack.analyses._horizons import _seems_to_level_off, horizon
from hybridtrack.analyses._least_errors import without_noise
from hybridtrack.analyses._observability_matrices import (
    ModeDynamics,
    initial_mode_test,
    initial_state_free_scan,
    joint_observability_index,
    mode_dynamics,
    observability_index,
    observability_indices,
    output_covariance,
    transition_test,
    transition_test_as_printed,
    unseen_states,
)
from hybridtrack.analyses._pairs_of_modes import Settings, theory
from hybridtrack.analyses._short_stretches import stretches, warnings_about_legs
from hybridtrack.analyses._telling_apart import outputs_of, settled_covariance, spectrum
from hybridtrack.errors import UserError
from models import figure_5_model, random_model

SEEDS = st.integers(0, 2**32 - 1)


def scalar(gain, noise, initial=1.0, mean=0.0, process=0.0, name=None):
    """A constant (or a random walk) measured with a gain."""
    return ModeDynamics(
        name or f"c{gain:g}",
        np.eye(1),
        np.zeros(1),
        np.array([[process]]),
        np.array([[float(gain)]]),
        np.array([[float(noise)]]),
        np.array([mean]),
        np.array([[float(initial)]]),
    )


def as_reference(mode):
    """A mode in the words of the references."""
    return dict(zip("FbQHRmP", mode[1:], strict=True))


def random_pair(seed, n_x=3, n_y=2):
    """Two modes with everything of their own but the start, which is that of a random model."""
    model = random_model(np.random.default_rng(seed), n_modes=2, n_x=n_x, n_y=n_y)
    return mode_dynamics(model)


def analysed(name, *changes):
    """The findings about a scenario, with some of its settings changed."""
    experiment = config.load(name, changes)
    analysis = analyses()["observability"]
    return analysis.analyse(experiment, experiment.analyses["observability"], None)


def cell(findings, old, new, figure):
    columns = findings.table.columns
    pairs = list(zip(columns["from_mode"], columns["to_mode"], strict=True))
    return columns[figure][pairs.index((old, new))]


def horizons(findings, old, new):
    return tuple(cell(findings, old, new, f"horizon{k}_scans") for k in ("_lower", "", "_upper"))


# ---- the reference figures -------------------------------------------------------------------


def test_the_papers_example_with_two_measurement_variances():
    found = analysed("observability_scalar")
    assert horizons(found, "single", "double") == (53, 89, 129)
    assert horizons(found, "double", "single") == (53, 89, 129)
    assert cell(found, "single", "double", "lemma_2") is True
    assert cell(found, "single", "double", "initial_state_free_scan") == 2
    assert cell(found, "single", "double", "joint_observability_index") == 1
    # Eqs. 7 and 8: pi0 c1^2 + sigma; here 2 against 6.
    assert cell(found, "single", "double", "lemma_2_difference") == pytest.approx(2 / 3)


def test_with_equal_variances_the_error_levels_off_though_lemma_2_is_met():
    found = analysed("observability_scalar", "modes.double.measurement_noise_covariance=[[1]]")
    assert horizons(found, "single", "double") == (math.inf,) * 3
    assert cell(found, "single", "double", "lemma_2") is True
    assert cell(found, "single", "double", "initial_state_free_scan") == math.inf
    # The published digits of the plateau, .3387 +- .001.
    assert cell(found, "single", "double", "horizon_last_error") == pytest.approx(0.3387, abs=1e-3)
    assert found.conclusions[0] == (
        "single and double can never be told apart at 1 % error: even without noise the best test "
        "would err in 33.8 % of cases."
    )
    assert any("lemma 2 calls single and double distinguishable" in n for n in found.notes)


def growing(gains, noise=1.0, growth=1.03, starts=(1.0, 1e-10), **changes):
    """A constant, beside a state that grows with every scan."""
    return scalar(1, noise, name=f"gains {gains}")._replace(
        state_transition=np.diag([1.0, growth]),
        input_effect=np.zeros(2),
        process_noise_covariance=np.zeros((2, 2)),
        measurement_matrix=np.array([gains]),
        initial_mean=np.zeros(2),
        initial_covariance=np.diag(starts),
        **changes,
    )


def test_a_difference_that_grows_late_is_not_never():
    """It is small for hundreds of scans, in which the error seems to level off."""
    one, other = growing([1.0, 0.0]), growing([2.0, 1.0])
    early, late = (horizon(one, other, 0.01, n, at_first_scan=True) for n in (256, 1000))
    assert (early.lower, early.exact, early.upper) == (None, None, None)
    assert early.because == "not within 256 scans, where the error seems to level off at 0.339"
    assert late.exact is not None
    assert 256 < late.exact < 1000
    # So do two noises that differ by 0.5 %, without a state that grows.
    one, other = scalar(1, 1), scalar(2, 1.005)
    early = horizon(one, other, 0.01, 256, at_first_scan=True)
    assert (early.lower, early.exact, early.upper) == (None, None, None)
    # A difference below rounding may grow out of it.
    one, other = growing([1.0, 0.0], starts=(1.0, 1e-32)), growing([1.0, 1.0], starts=(1.0, 1e-32))
    assert horizon(one, other, 0.01, 64, at_first_scan=True).exact is None


def test_a_growth_that_both_modes_share_changes_nothing_about_never():
    """Twice the gains on both states: two known states, N(0, 1) against N(0, 4), at the best."""
    one, other = growing([1.0, 1.0]), growing([2.0, 2.0])
    found = horizon(one, other, 0.01, 64, at_first_scan=True)
    assert found.exact == math.inf
    variances = Spectrum(np.array([4.0, 4.0]), np.zeros(2))
    assert found.last_error > error_probability(variances) > 0.263
    assert found.because == "even without noise the best test would err in 26.3 % of cases"
    # One step before the first scan it is the same, and a target above that error may be met.
    assert horizon(one, other, 0.01, 64).exact == math.inf
    assert horizon(one, other, 0.3, 64, at_first_scan=True).exact is None


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.booleans(), st.booleans())
def test_no_number_of_scans_errs_less_than_a_test_without_noise(seed, at_first_scan, is_told):
    """Modes of one motion, whose states start and show differently by a factor of each state."""
    rng = np.random.default_rng(seed)
    one = random_pair(seed, n_x=2, n_y=1)[0]
    calm = one._replace(process_noise_covariance=np.zeros((2, 2)), input_effect=np.zeros(2))
    factor = np.exp(rng.normal())
    other = calm._replace(
        name="other",
        measurement_matrix=calm.measurement_matrix * factor,
        initial_mean=calm.initial_mean + 0.3 * rng.normal(size=2),
    )
    told = np.diag([0.1, 0.0]) if is_told else None
    best = without_noise(calm, other, at_first_scan, told)
    assert best is not None
    outputs = outputs_of(calm, other, 30, at_first_scan=at_first_scan, told_covariance=told)
    after = spectrum(outputs, outputs.scans)
    for s in (0.2, 0.5, 0.8):
        assert chernoff_distance(after, s) <= chernoff_distance(best, s) * (1 + 1e-6)


def test_without_noise_is_known_only_where_noises_and_inputs_are_the_same():
    one, other = scalar(1, 1), scalar(2, 1)
    assert without_noise(one, other, True, None) is not None
    noisy = np.array([[0.1]])
    for changed in (
        other._replace(measurement_noise_covariance=np.array([[1.001]])),
        other._replace(process_noise_covariance=noisy),
        other._replace(input_effect=np.array([0.001])),
    ):
        assert without_noise(one, changed, True, None) is None
        assert horizon(one, changed, 0.01, 64, at_first_scan=True).exact != math.inf
    # Process noise is seen through the gains, which differ.
    shaken = [m._replace(process_noise_covariance=noisy) for m in (one, other)]
    assert without_noise(*shaken, True, None) is None
    # With one motion and one gain it is the same, and starts alone may differ.
    later = shaken[0]._replace(initial_covariance=np.array([[4.0]]))
    best = without_noise(shaken[0], later, True, None)
    assert best is not None
    np.testing.assert_allclose(best.variance, [4.0], rtol=1e-12)
    # A start of one mode that the other's can't have tells them apart for sure.
    fixed = other._replace(initial_covariance=np.zeros((1, 1)))
    assert without_noise(one, fixed, True, None) is None


@pytest.mark.parametrize(("ratio", "seems"), [(0.5, True), (0.9, False), (1.0, False)])
def test_gains_that_hardly_fall_from_doubling_to_doubling_promise_no_plateau(ratio, seems):
    """A distance that grows with the logarithm of the scans has 1, and meets every target."""
    gains = np.cumsum(0.05 * ratio ** np.arange(9))

    def axes(scans):
        return Spectrum(np.ones(1), np.sqrt(8 * gains[[int(math.log2(scans))]]))

    assert bhattacharyya_distance(axes(256)) == pytest.approx(gains[-1])
    assert _seems_to_level_off(axes, 256, 0.01) == seems


def test_the_plateau_is_that_of_two_known_states():
    """With R -> 0 the state is known up to the gain: N(0, 1) against N(0, 4), in closed form."""
    outputs = outputs_of(scalar(1, 1e-12), scalar(2, 1e-12), 4, at_first_scan=True)
    error = error_probability(spectrum(outputs, 4))
    # The other measurements add nothing but rounding and the noise of 1e-6.
    assert error == pytest.approx(reference.error_of_one_axis(4.0, 0.0), abs=1e-5)


def test_an_initial_covariance_that_makes_up_for_the_gain_hides_it_exactly():
    one, other = scalar(1, 1, initial=1.0), scalar(2, 1, initial=0.25)
    outputs = outputs_of(one, other, 256, at_first_scan=True)
    axes = spectrum(outputs, 256)
    assert bhattacharyya_distance(axes) < 1e-20
    assert error_probability(axes) == 0.5
    found = horizon(one, other, 0.01, 256, at_first_scan=True)
    assert (found.lower, found.exact, found.upper) == (math.inf,) * 3
    assert "alike" in found.because
    assert not initial_mode_test(one, other, 5).differ


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ((), (13, 23, 34)),
        (("sensor.position_std_m=10",), (7, 17, 26)),
        (
            (
                "initial.mean=[0, 77.1666666667, 0, 0]",
                "initial.position_std_m=50",
                "initial.velocity_std_m_s=5",
            ),
            (8, 9, 10),
        ),
    ],
)
def test_two_rates_of_turn(changes, expected):
    found = analysed("observability_turns", *changes)
    assert horizons(found, "gentle", "hard") == expected
    assert cell(found, "gentle", "hard", "horizon_s") == 2 * expected[1]
    assert cell(found, "gentle", "hard", "joint_observability_index") == 2


def test_one_step_before_the_first_scan_is_another_start():
    """The same start one step earlier lets the modes turn before they are first seen."""
    found = analysed(
        "observability_turns",
        "initial.mean=[0, 77.1666666667, 0, 0]",
        "initial.position_std_m=50",
        "initial.velocity_std_m_s=5",
        "analyses.observability.initial_at_first_scan=false",
    )
    one, other = mode_dynamics(
        model_at_one_step(
            config.load(
                "observability_turns",
                [
                    "initial.mean=[0, 77.1666666667, 0, 0]",
                    "initial.position_std_m=50",
                    "initial.velocity_std_m_s=5",
                ],
            )
        )[0]
    )
    dense = [
        [reference.stacked(as_reference(m), k, False) for m in (one, other)] for k in range(1, 11)
    ]
    brackets = [reference.bracket(*pair) for pair in dense]
    first = [next(k for k, b in enumerate(brackets, 1) if b[i] <= 0.01) for i in (0, 1)]
    assert [horizons(found, "gentle", "hard")[i] for i in (0, 2)] == first
    assert horizons(found, "gentle", "hard") == (7, 8, 9)


# ---- distances, bounds and errors against dense references -----------------------------------


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.integers(1, 6), st.booleans(), st.booleans())
def test_distances_are_those_of_the_stacked_outputs(seed, scans, at_first_scan, is_told):
    one, other = random_pair(seed)
    told = np.diag([0.5, 2.0, 0.0]) if is_told else None
    outputs = outputs_of(one, other, scans, at_first_scan=at_first_scan, told_covariance=told)
    axes = spectrum(outputs, scans)
    # Without the third told state, whose variance is 0, the dense covariance isn't singular.
    dense = []
    for mode in (one, other):
        mean, S = reference.stacked(as_reference(mode), scans, at_first_scan, told)
        keep = np.flatnonzero(np.diag(S) > 0)
        dense.append((mean[keep], S[np.ix_(keep, keep)]))
    for s in (0.1, 0.5, 0.8):
        # Dense log-determinants lose some digits of covariances of condition 1e6 or so.
        expected = reference.chernoff(*dense, s)
        assert chernoff_distance(axes, s) == pytest.approx(expected, rel=1e-8, abs=1e-9)
    assert best_chernoff(axes)[0] == pytest.approx(reference.largest_chernoff(*dense), rel=1e-7)
    low, high = reference.bracket(*dense)
    assert lower_error(axes) == pytest.approx(low, rel=1e-6)
    assert upper_error(axes) == pytest.approx(high, rel=1e-6)


@settings(max_examples=60, deadline=None)
@given(SEEDS)
def test_the_error_on_one_axis_is_that_of_a_parabola(seed):
    rng = np.random.default_rng(seed)
    variance = float(np.exp(rng.normal() * rng.choice([0.01, 1.0, 5.0])))
    shift = float(rng.normal() * rng.choice([0.0, 0.3, 4.0]))
    axes = Spectrum(np.array([variance]), np.array([shift]))
    if bhattacharyya_distance(axes) < 1e-10:
        return
    expected = reference.error_of_one_axis(variance, shift)
    # The integral agrees with its halved step to 1e-9; erfc differences lose a few digits.
    assert error_probability(axes) == pytest.approx(expected, rel=1e-7, abs=1e-12)


def test_the_error_of_equal_covariances_is_that_of_half_the_distance():
    for d in (0.01, 1.0, 5.0, 12.0, 30.0):
        axes = Spectrum(np.ones(3), np.array([0.0, 0.6 * d, 0.8 * d]))
        expected = 0.5 * math.erfc(d / (2 * math.sqrt(2)))
        assert error_probability(axes) == pytest.approx(expected, rel=1e-8)


@settings(max_examples=100, deadline=None)
@given(SEEDS)
def test_the_error_lies_between_its_bounds_whatever_the_sizes(seed):
    rng = np.random.default_rng(seed)
    n, size = int(rng.integers(1, 30)), rng.choice([1e-6, 1e-2, 1.0, 5.0, 50.0])
    variance = np.exp(np.clip(rng.normal(size=n) * size, -340, 340))
    shift = rng.normal(size=n) * 10.0 ** rng.uniform(-8, rng.choice([0, 3, 70]))
    axes = Spectrum(variance, shift)
    error = error_probability(axes)
    slack = 1 + 1e-7  # of the integral and the search for the best s
    assert lower_error(axes) <= error * slack + 1e-300
    assert error <= upper_error(axes) * slack


@settings(max_examples=15, deadline=None)
@given(SEEDS)
def test_the_error_on_several_axes_is_gil_pelaezs(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(6, 12))  # fewer axes make the printed integral converge too slowly
    axes = Spectrum(np.exp(rng.normal(size=n)), rng.normal(size=n) * rng.choice([0.0, 0.7]))
    expected = reference.error_by_inversion(*axes)
    # The reference's quadrature is asked for 1e-10, and not known to reach it.
    assert error_probability(axes) == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("is_told", [False, True])
def test_the_error_is_that_of_simulated_likelihood_ratios(seed, is_told):
    """Within 4 standard errors of 20,000 runs of each mode: one honest case in 16,000 misses."""
    one, other = random_pair(seed, n_x=2, n_y=1)
    told = np.array([[1.0, 0.3], [0.3, 0.5]]) if is_told else None
    scans, first = 3, bool(seed % 2)
    axes = spectrum(outputs_of(one, other, scans, at_first_scan=first, told_covariance=told), scans)
    rng = np.random.default_rng(1000 + seed)
    modes = as_reference(one), as_reference(other)
    error, standard_error = reference.monte_carlo_error(*modes, scans, first, told, 20_000, rng)
    assert abs(error_probability(axes) - error) < 4 * standard_error


@pytest.mark.parametrize("scans", [22, 23])
def test_the_horizon_of_the_turns_is_that_of_simulated_flights(scans):
    """Within 4 standard errors of 40,000 runs of each mode."""
    experiment = config.load("observability_turns")
    one, other = mode_dynamics(model_at_one_step(experiment)[0])
    axes = spectrum(outputs_of(one, other, scans, at_first_scan=True), scans)
    rng = np.random.default_rng(7)
    modes = as_reference(one), as_reference(other)
    error, standard_error = reference.monte_carlo_error(*modes, scans, True, None, 40_000, rng)
    assert abs(error_probability(axes) - error) < 4 * standard_error
    assert (error_probability(axes) <= 0.01) == (scans == 23)


def test_the_scalar_horizon_is_that_of_simulated_runs():
    one, other = scalar(1, 1), scalar(2, 2)
    axes = spectrum(outputs_of(one, other, 89, at_first_scan=True), 89)
    rng = np.random.default_rng(8)
    modes = as_reference(one), as_reference(other)
    error, standard_error = reference.monte_carlo_error(*modes, 89, True, None, 40_000, rng)
    assert abs(error_probability(axes) - error) < 4 * standard_error
    # A Monte Carlo check that could not tell 1 % from 2 % would be none.
    assert 4 * standard_error < 0.005


# ---- properties ------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.booleans())
def test_more_scans_never_harm_and_bounds_are_bounds(seed, at_first_scan):
    one, other = random_pair(seed)
    outputs = outputs_of(one, other, 8, at_first_scan=at_first_scan)
    axes = [spectrum(outputs, k) for k in range(1, 9)]
    lower, exact, upper = (
        np.array([f(a) for a in axes]) for f in (lower_error, error_probability, upper_error)
    )
    slack = 1 + 1e-7  # of the integral and the search for the best s
    for error in (lower, exact, upper):
        assert (error[1:] <= error[:-1] * slack).all()
    assert (lower <= exact * slack).all()
    assert (exact <= upper * slack).all()
    assert exact[0] < 0.5


@settings(max_examples=15, deadline=None)
@given(SEEDS)
def test_telling_one_from_the_other_is_telling_the_other_from_one(seed):
    one, other = random_pair(seed)
    there, back = (spectrum(outputs_of(*p, 5), 5) for p in ((one, other), (other, one)))
    assert chernoff_distance(there, 0.3) == pytest.approx(chernoff_distance(back, 0.7), rel=1e-8)
    assert error_probability(there) == pytest.approx(error_probability(back), rel=1e-7)


@settings(max_examples=15, deadline=None)
@given(SEEDS)
@example(896)  # 2 scans, or 3 where outputs in their own units are not made alike
@example(5990)
def test_coordinates_of_states_and_units_of_outputs_do_not_matter(seed):
    rng = np.random.default_rng(seed)
    T = np.eye(3) + 0.3 * rng.normal(size=(3, 3))
    T *= np.array([[1e3], [1.0], [1e-3]])
    U = np.diag([1e4, 1e-2])
    inverse = np.linalg.inv(T)

    def changed(mode):
        return ModeDynamics(
            mode.name,
            T @ mode.state_transition @ inverse,
            T @ mode.input_effect,
            T @ mode.process_noise_covariance @ T.T,
            U @ mode.measurement_matrix @ inverse,
            U @ mode.measurement_noise_covariance @ U.T,
            T @ mode.initial_mean,
            T @ mode.initial_covariance @ T.T,
        )

    pair = random_pair(seed)
    others = tuple(map(changed, pair))
    one, other = (spectrum(outputs_of(*p, 4), 4) for p in (pair, others))
    # Conditions of T up to 1e7 cost as many digits of 16.
    assert error_probability(one) == pytest.approx(error_probability(other), rel=1e-5)
    for mode, another in zip(pair, others, strict=True):
        index = observability_index(mode.state_transition, mode.measurement_matrix)
        assert index == observability_index(another.state_transition, another.measurement_matrix)


def test_a_smaller_target_takes_more_scans():
    one, other = scalar(1, 1), scalar(2, 2)
    found = [horizon(one, other, target, 256, at_first_scan=True).exact for target in (0.1, 0.01)]
    assert found[0] is not None
    assert found[1] is not None
    assert found[0] < found[1]
    late = horizon(one, other, 1e-9, 256, at_first_scan=True)
    assert late.exact is None
    assert late.because == "not within 256 scans"
    assert 1e-9 < late.last_error < 1e-3


@pytest.mark.parametrize("target", [0.3, 0.1, 0.02])
def test_the_horizon_is_the_first_scan_below_the_target(target):
    one, other = random_pair(11)
    found = horizon(one, other, target, 64)
    axes = [spectrum(outputs_of(one, other, k), k) for k in range(1, 65)]
    for f, scan in ((lower_error, found.lower), (error_probability, found.exact)):
        assert scan == next(k for k, a in enumerate(axes, 1) if f(a) <= target)
    assert found.upper == next(k for k, a in enumerate(axes, 1) if upper_error(a) <= target)


def test_growing_states_cost_no_digits():
    """Accelerations over 24 steps of 10 s: position variances of 1e9 m^2 beside noise of 140 m."""
    one, other = mode_dynamics(model_at_one_step(config.load("softbound_ex1"))[0])
    axes = spectrum(outputs_of(one, other, 24), 24)
    expected = reference.exact_bhattacharyya(as_reference(one), as_reference(other), 24)
    assert bhattacharyya_distance(axes) == pytest.approx(expected, rel=1e-9)


def test_unstable_states_are_followed_as_long_as_numbers_hold_them():
    """x grows threefold a scan: after 27 the rounding of 3^k is no longer small beside R = 1."""
    one, other = (
        scalar(gain, noise)._replace(state_transition=np.array([[3.0]]))
        for gain, noise in ((1, 1), (2, 2))
    )
    axes = spectrum(outputs_of(one, other, 20), 20)
    expected = reference.exact_bhattacharyya(as_reference(one), as_reference(other), 20)
    # Rounding has grown to 3^20 eps = 1e-6 by then.
    assert bhattacharyya_distance(axes) == pytest.approx(expected, rel=1e-5)
    found = horizon(one, other, 0.01, 256)
    assert found.exact is None
    assert 20 <= found.looked_at < 30
    assert found.because == (
        f"not within {found.looked_at} scans, beyond which the states are too large for numbers"
    )
    # What both modes share is no obstacle, however fast it grows.
    louder = one._replace(name="louder", measurement_noise_covariance=np.array([[2.0]]))
    assert horizon(one, louder, 0.01, 256).exact == pytest.approx(90, abs=4)


# ---- without noise ---------------------------------------------------------------------------


def test_without_noise_gains_are_guessed_from_the_first_output_alone():
    """The paper's opening: with Q = R = 0 all later outputs repeat the first."""
    found = horizon(scalar(1, 0), scalar(2, 0), 0.01, 64, at_first_scan=True)
    assert found.exact == math.inf
    assert found.last_error == pytest.approx(reference.error_of_one_axis(4.0, 0.0), rel=1e-7)


def test_noise_under_one_mode_alone_gives_it_away():
    quiet, noisy = scalar(1, 0), scalar(1, 1)
    for pair in ((quiet, noisy), (noisy, quiet)):
        found = horizon(*pair, 0.01, 64, at_first_scan=True)
        assert (found.lower, found.exact, found.upper) == (2, 2, 2)
        assert "impossible" in found.because
        assert found.last_error == 0.0


def test_known_states_without_noise_are_told_apart_by_their_means():
    at = horizon(scalar(1, 0, 0.0, 1.0), scalar(2, 0, 0.0, 1.0), 0.01, 64, with_curve=True)
    assert (at.lower, at.exact, at.upper) == (1, 1, 1)
    same = horizon(scalar(1, 0, 0.0), scalar(2, 0, 0.0), 0.01, 64, with_curve=True)
    assert same.exact == math.inf
    assert same.last_error == 0.5


def test_singular_noise_of_two_outputs():
    """One output of two has no noise: the modes share it, and differ in the other's noise."""
    one, other = random_pair(5)
    shared = one._replace(
        measurement_noise_covariance=np.diag([1.0, 0.0]), process_noise_covariance=np.eye(3)
    )
    louder = shared._replace(name="louder", measurement_noise_covariance=np.diag([2.0, 0.0]))
    axes = spectrum(outputs_of(shared, louder, 3), 3)
    dense = [reference.stacked(as_reference(m), 3, False) for m in (shared, louder)]
    assert bhattacharyya_distance(axes) == pytest.approx(
        reference.chernoff(*dense, 0.5), rel=1e-8, abs=1e-10
    )
    assert other.name != one.name


# ---- ranks, lemmas, and no word about the initial state --------------------------------------


def test_indices_of_motion_models():
    model = figure_5_model()
    assert observability_indices(model) == (math.inf, 3)  # the zero acceleration isn't measured
    assert joint_observability_index(model) == math.inf
    constant, wiener = mode_dynamics(model)
    F, H = constant.state_transition, constant.measurement_matrix
    assert unseen_states(F, H, model.state_names) == ("ax", "ay")
    F, H = wiener.state_transition, wiener.measurement_matrix
    assert unseen_states(F, H, model.state_names) == ()
    turns = model_at_one_step(config.load("observability_turns"))[0]
    assert joint_observability_index(turns) == 2


def test_a_model_of_several_steps_has_no_index():
    model = random_model(np.random.default_rng(1), n_times=3)
    with pytest.raises(UserError, match="one length, and the model has 3"):
        joint_observability_index(model)


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(1, 4), st.integers(1, 2))
@example(480173, 4, 2)  # a column that cancels to rounding, which normalising would make a state
def test_an_index_is_that_of_elimination_in_fractions(seed, n_x, n_y):
    rng = np.random.default_rng(seed)
    F, H = rng.integers(-1, 2, (n_x, n_x)), rng.integers(-1, 2, (n_y, n_x))
    index = observability_index(F.astype(float), H.astype(float))
    assert index == reference.index_by_fractions(F.tolist(), H.tolist())
    units = 10.0 ** rng.uniform(-6, 6, n_x)  # of the states
    scaled = F * units[None, :] / units[:, None]
    assert observability_index(scaled, H * units) == index


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.integers(1, 5))
def test_lemma_2_compares_the_covariances_of_the_stacked_outputs(seed, scans):
    for mode in random_pair(seed):
        dense = reference.stacked(as_reference(mode), scans, True)[1]
        np.testing.assert_allclose(output_covariance(mode, scans), dense, rtol=1e-9, atol=1e-9)


def test_lemma_3_as_printed_never_holds_where_modes_share_h_and_r():
    for scans in (1, 2, 5):
        turns = mode_dynamics(model_at_one_step(config.load("observability_turns"))[0])
        for old, new in (turns, turns[::-1]):
            assert transition_test_as_printed(old, new, scans) == (False, 0.0)
            assert transition_test(old, new, scans).differ
    found = analysed("observability_turns")
    assert found.table.columns["lemma_3_as_printed"] == [False, False]
    assert found.table.columns["lemma_3"] == [True, True]
    assert found.table.columns["theorem_1_as_printed"] == [False, False]
    assert found.table.columns["theorem_1"] == [True, True]
    assert any("as printed lets the old mode drive" in note for note in found.notes)


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.integers(1, 4))
def test_lemma_3_in_both_conventions(seed, scans):
    """By the powers of the paper's eq. 9, and with A_new A_old^(k1-k0-1) in ours."""
    from scipy.linalg import eigh

    old, new = random_pair(seed)
    a, b = as_reference(old), as_reference(new)
    power = np.linalg.matrix_power

    def state(mode, steps):
        P = power(mode["F"], steps) @ mode["P"] @ power(mode["F"], steps).T
        for i in range(steps):
            P = P + power(mode["F"], i) @ mode["Q"] @ power(mode["F"], i).T
        return P

    def output(mode, P):
        return mode["H"] @ P @ mode["H"].T + mode["R"]

    def relative(x, y):
        ratios = eigh(x, y, eigvals_only=True)
        return (np.abs(ratios - 1) / np.maximum(ratios, 1)).max()

    printed = relative(output(b, state(a, scans)), output(a, state(a, scans)))
    assert transition_test_as_printed(old, new, scans).difference == pytest.approx(printed)
    before = state(a, scans - 1)
    after = [m["F"] @ before @ m["F"].T + m["Q"] for m in (b, a)]
    ours = relative(output(b, after[0]), output(a, after[1]))
    assert transition_test(old, new, scans).difference == pytest.approx(ours)


@pytest.mark.parametrize("seed", range(6))
def test_the_first_scan_that_needs_no_initial_state(seed):
    one, other = random_pair(seed, n_x=2, n_y=1)
    pairs = [(one, other)]
    # The same noises as seen in the outputs, and other dynamics of the mean.
    pairs.append((one, one._replace(input_effect=one.input_effect + 1.0)))
    pairs.append((one, one._replace(measurement_noise_covariance=np.array([[3.0]]))))
    for pair in pairs:
        modes = tuple(map(as_reference, pair))
        differences = [reference.initial_state_free_difference(*modes, k) for k in range(1, 10)]
        expected = next((k for k, d in enumerate(differences, 1) if d > 1e-7), math.inf)
        assert initial_state_free_scan(*pair) == expected
        moved = [m._replace(initial_covariance=np.zeros((2, 2))) for m in pair]
        assert initial_state_free_scan(*moved) == expected
    assert initial_state_free_scan(one, one) == math.inf


def test_equal_noises_are_alike_for_ever_whatever_the_gains():
    assert initial_state_free_scan(scalar(1, 1), scalar(2, 1)) == math.inf
    assert initial_state_free_scan(scalar(1, 1), scalar(2, 2)) == 2
    # A random walk of variance q seen by gain 2 is one of 4 q seen by gain 1.
    assert initial_state_free_scan(scalar(1, 1, process=4.0), scalar(2, 1, process=1.0)) == math.inf
    assert initial_state_free_scan(scalar(1, 1, process=1.0), scalar(2, 1, process=1.0)) == 2


def measured(noise, start):
    """Two constants, each measured, with one noise and one start each (variances)."""
    return scalar(1, 1)._replace(
        state_transition=np.eye(2),
        input_effect=np.zeros(2),
        process_noise_covariance=np.zeros((2, 2)),
        measurement_matrix=np.eye(2),
        measurement_noise_covariance=np.diag(noise),
        initial_mean=np.zeros(2),
        initial_covariance=np.diag(start),
    )


def test_sizes_that_have_nothing_to_do_with_a_difference_hide_nothing():
    one, other = (measured([1e6, r], [1e6, 1e-2]) for r in (1e-4, 4e-4))
    for pair in ((one, other), (other, one)):
        assert initial_mode_test(*pair, 1).differ
        assert transition_test(*pair, 1).differ
        assert transition_test_as_printed(*pair, 1).differ
        assert initial_state_free_scan(*pair) == 2
    assert initial_mode_test(one, other, 1).difference == pytest.approx(3e-4 / 1.04e-2)
    unsure, quiet = scalar(1, 2, initial=1e10), scalar(1, 1, initial=1e10)
    found = initial_mode_test(unsure, quiet, 1)
    assert found.differ
    assert found.difference == pytest.approx(1e-10, rel=1e-4)  # 1 of 1e10, held to 1e-6
    assert not initial_mode_test(quiet, quiet, 5).differ


@pytest.mark.parametrize("noise", [1.0, 0.01, 0.001])
def test_little_process_noise_tells_turns_apart_as_soon_as_much(noise):
    changes = [f"modes.{m}.acceleration_std_m_s2={noise}" for m in ("gentle", "hard")]
    one, other = mode_dynamics(model_at_one_step(config.load("observability_turns", changes))[0])
    assert initial_state_free_scan(one, other) == initial_state_free_scan(other, one) == 4


def test_noises_that_differ_late_are_compared_for_long_enough():
    """What is free of both starts has one variance, and another covariance with its successor."""
    one = scalar(1, 1, process=(1.25 + 3.1625) / 1.81)._replace(state_transition=np.array([[0.5]]))
    other = scalar(1, 2, process=1.0)._replace(state_transition=np.array([[0.9]]))
    assert initial_state_free_scan(one, other) == 4  # 2 n_x + 1 show but the variance


@settings(max_examples=15, deadline=None)
@given(SEEDS)
def test_lemmas_depend_neither_on_units_of_outputs_nor_on_the_order_of_modes(seed):
    rng = np.random.default_rng(seed)
    U = np.diag(10.0 ** rng.uniform(-4, 4, 2))
    pair = random_pair(seed, n_x=2)
    pair = (pair[0], pair[int(rng.integers(2))]._replace(measurement_noise_covariance=np.eye(2)))
    scaled = [
        m._replace(
            measurement_matrix=U @ m.measurement_matrix,
            measurement_noise_covariance=U @ m.measurement_noise_covariance @ U,
        )
        for m in pair
    ]
    for test in (initial_mode_test, transition_test, transition_test_as_printed):
        expected = test(*pair, 2).difference
        assert test(*scaled, 2).difference == pytest.approx(expected, rel=1e-6)
    assert initial_mode_test(*pair[::-1], 2).difference == pytest.approx(
        initial_mode_test(*pair, 2).difference
    )
    found = {initial_state_free_scan(*p) for p in (pair, pair[::-1], scaled, scaled[::-1])}
    assert len(found) == 1


# ---- the delay of a switch -------------------------------------------------------------------


def test_the_settled_covariance_is_the_riccati_equations():
    from scipy.linalg import solve_discrete_are

    for mode in mode_dynamics(model_at_one_step(config.load("observability_turns"))[0]):
        F, Q, H, R = mode[1], mode[3], mode[4], mode[5]
        P = solve_discrete_are(F.T, H.T, Q, R)
        P = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
        covariance, settled = settled_covariance(mode)
        assert settled
        # Settled to 1e-6 a scan, and a scan forgets a good part of what is left.
        np.testing.assert_allclose(covariance, P, rtol=1e-4, atol=1e-4 * np.abs(P).max())


def test_the_filtered_covariance_after_some_scans():
    mode = random_pair(2)[0]
    covariance, settled = settled_covariance(mode, 3)
    assert not settled
    expected = reference.filtered_covariance(as_reference(mode), 3)
    np.testing.assert_allclose(covariance, expected, rtol=1e-10, atol=1e-12)


def test_the_delay_is_that_of_trackers_who_know_the_old_mode():
    """Within 4 standard errors of 20,000 switches of either kind, either way."""
    experiment = config.load("observability_turns")
    settings_ = experiment.analyses["observability"]
    known = theory(experiment, settings_)
    for n, pair in enumerate(known.pairs):
        filtered = settled_covariance(pair.old)[0]
        stay, go = (as_reference(m._replace(initial_covariance=filtered)) for m in pair[:2])
        told = known.model.initial_covariance
        scans = int(pair.delay.exact or 0)
        rng = np.random.default_rng(30 + n)
        error, standard_error = reference.monte_carlo_error(
            stay, go, scans, False, told, 20_000, rng
        )
        assert error < settings_.target_error + 4 * standard_error
        error, standard_error = reference.monte_carlo_error(
            stay, go, scans - 2, False, told, 20_000, rng
        )
        # Two scans sooner it errs by more than the target.
        assert error > settings_.target_error - 4 * standard_error
        assert standard_error < 0.001


def test_a_filter_that_knows_the_speed_notices_sooner():
    slow = analysed("observability_turns")
    fast = analysed("observability_turns", "initial.mean=truth")
    assert cell(fast, "gentle", "hard", "switch_delay_scans") < cell(
        slow, "gentle", "hard", "switch_delay_scans"
    )


def test_a_switch_has_a_direction():
    """A new mode that is noisier shows at once; one that is quieter takes its time."""
    found = analysed("rmimm_fig5")
    model = model_at_one_step(config.load("rmimm_fig5"))[0]
    start = np.array([0.0, 480 * 1852 / 3600, 0.0, 0.0, 0.0, 0.0])  # due east
    constant, wiener = (m._replace(initial_mean=start) for m in mode_dynamics(model))
    for old, new in ((constant, wiener), (wiener, constant)):
        filtered = settled_covariance(old)[0]
        begun = [m._replace(initial_covariance=filtered) for m in (old, new)]
        expected = horizon(*begun, 0.01, 256, told_covariance=model.initial_covariance).exact
        assert cell(found, old.name, new.name, "switch_delay_scans") == expected
    assert found.table.columns["switch_delay_scans"] == [11, 13]
    assert found.table.columns["switch_delay_s"] == [11, 13]


def test_filters_that_follow_a_chains_truth_are_told_where_it_starts():
    experiment = config.load("softbound_three_modes", ["initial.mean=truth"])
    known = theory(experiment, experiment.analyses["observability"])
    start = np.diag([500.0, 50.0, 1.0]) ** 2  # the chain's and the filters' own, by coincidence
    pair = known.pairs[0]
    told = horizon(pair.old, pair.new, 0.01, 256, told_covariance=start).exact
    untold = horizon(pair.old, pair.new, 0.01, 256).exact
    assert pair.horizon.exact == told
    assert told != untold


# ---- the lint --------------------------------------------------------------------------------


def test_a_stretch_that_is_too_short_is_named_with_what_it_needs():
    experiment = config.load("observability_turns")
    assert [(leg.mode, leg.scans, leg.before) for leg in stretches(experiment)] == [
        ("gentle", 30, None),
        ("hard", 6, "gentle"),
        ("gentle", 34, "hard"),
        ("hard", 30, "gentle"),
    ]
    delay = cell(analysed("observability_turns"), "gentle", "hard", "switch_delay_scans")
    assert warnings_about_legs(experiment) == [
        "stretch 2 (60 to 72 s, hard) lasts 6 scans; noticing the switch from gentle at 1 % error "
        f"needs {delay:.0f}"
    ]
    loose = Settings(target_error=0.3, initial_at_first_scan=True)
    assert warnings_about_legs(experiment, loose) == [
        "stretch 2 (60 to 72 s, hard) lasts 6 scans; telling hard from gentle without knowing the "
        "state at 30 % error needs 7"
    ]
    assert warnings_about_legs(experiment, loose._replace(target_error=0.4)) == []


def test_the_first_stretch_is_held_against_the_horizon():
    legs = "truth.legs=[{until_s: 20, mode: gentle}, {until_s: 200, mode: hard}]"
    (warning,) = warnings_about_legs(config.load("observability_turns", [legs]))
    assert warning == (
        "stretch 1 (0 to 20 s, gentle) lasts 10 scans; telling gentle from hard at 1 % error needs "
        "23"
    )


def test_a_chains_modes_are_held_against_their_mean_sojourn():
    warnings = warnings_about_legs(config.load("softbound_three_modes"))
    assert any(
        "gentle lasts 12.5 scans on average; noticing a switch to it from" in w for w in warnings
    )


def test_a_bank_of_one_mode_and_a_recording_have_nothing_to_warn_of():
    one = ["mean_sojourn_s={gentle: 60}", "truth.legs=[{until_s: 200}]"]
    assert warnings_about_legs(config.load("observability_turns", one)) == []


def test_what_lies_beyond_the_scans_looked_at_is_no_reason_to_warn():
    experiment = config.load("observability_turns")
    few = Settings(most_scans=5, initial_at_first_scan=True)
    assert warnings_about_legs(experiment, few) == []  # the shortest stretch has 6
    (warning,) = warnings_about_legs(experiment, few._replace(most_scans=6))
    assert warning.endswith("noticing the switch from gentle at 1 % error needs more than 6 scans")


def test_the_lint_looks_no_further_than_four_times_the_longest_leg(tmp_path):
    """Five modes of six states, four of them next to alike: the slowest kind (half a second)."""
    text = config.shipped()["rmimm_fig5"].read_text("utf-8").partition("published:")[0]
    wiener = "{motion: wiener_acceleration, acceleration_std_m_s2: 3.0}"
    more = "".join(f"  M{n}: {wiener.replace('3.0', f'3.0{n}')}\n" for n in (1, 2, 3))
    text = text.replace(f"  CT: {wiener}\n", f"  CT: {wiener}\n{more}")
    text = text.replace(
        "transition_matrix: [[0.95, 0.05], [0.05, 0.95]]",
        "mean_sojourn_s: {CV: 20, CT: 20, M1: 20, M2: 20, M3: 20}",
    ).replace("{CV: 0.9, CT: 0.1}", "[0.6, 0.1, 0.1, 0.1, 0.1]")
    path = tmp_path / "five.yaml"
    path.write_text(text)
    experiment = config.load(path)
    warnings = warnings_about_legs(experiment)
    assert warnings[0] == (
        "stretch 2 (30 to 50 s, CT) lasts 20 scans; telling CT from M1 without knowing the state "
        "at 1 % error needs more than 120 scans"
    )
