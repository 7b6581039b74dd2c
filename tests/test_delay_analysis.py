"""The analysis of delays: its filters against iterations, its bounds against what they bound."""

import math

import numpy as np
import pytest

import reference
from hybridtrack import config
from hybridtrack.analyses import analyses, model_at_one_step
from hybridtrack.analyses._directions import condition_15
from hybridtrack.analyses._mean_course import (
    Switch,
    courses,
    mode_probabilities,
    noise_free_delays,
    predicted_delay,
    run_mean_bank,
    start,
    states_of_bank,
)
from hybridtrack.analyses._propositions import Ingredients, bounds, rival
from hybridtrack.analyses._steady_filters import (
    NoSteadyState,
    SteadyFilter,
    difference,
    steady_filters,
    steady_residual,
)
from hybridtrack.analyses._tuning import concordance
from hybridtrack.analyses.delay import _terms
from hybridtrack.delays import distribution
from hybridtrack.errors import Unsuited
from models import figure_5_model, random_model

ROUNDING = 1e-9  # relative, of a Riccati equation that was solved or iterated


@pytest.fixture(scope="module")
def figure_4():
    return config.load("mode_delay_fig4")


def steady(model):
    found = steady_filters(model)
    assert all(isinstance(one, SteadyFilter) for one in found)
    return found


# ---- filters in steady state -----------------------------------------------------------------


def settled(model, j, steps=3000):
    """The filter's gain and residual covariance after many steps."""
    F, Q = model.state_transition[0, j], model.process_noise_covariance[0, j]
    H, R = model.measurement_matrix[j], model.measurement_noise_covariance[j]
    x, P = np.zeros(len(F)), np.eye(len(F))
    for _ in range(steps):
        x, P = reference.kalman_predict(x, P, F, np.zeros(len(F)), Q)
        S = H @ P @ H.T + R
        x, P, K, _ = reference.kalman_update(x, P, H, R, H @ x)
    return K, S


@pytest.mark.parametrize("seed", range(4))
def test_gains_are_those_that_a_filter_settles_at(seed):
    rng = np.random.default_rng(seed)
    models = [random_model(rng), figure_5_model(), config.load("softbound_ex1")]
    models[2] = model_at_one_step(models[2])[0]
    for model in models:
        for j, one in enumerate(steady(model)):
            K, S = settled(model, j)
            np.testing.assert_allclose(one.gain, K, rtol=1e-6, atol=1e-9)
            rounding = 1e-9 * np.abs(S).max()
            np.testing.assert_allclose(one.innovation_covariance, S, rtol=1e-6, atol=rounding)


def test_filters_without_a_steady_state_say_why():
    model = figure_5_model()
    noiseless = model.process_noise_covariance.copy()
    noiseless[0, 0] = 0.0
    unseen = model.measurement_matrix.copy()
    unseen[1, 0] = 0.0
    first, second = steady_filters(
        model._replace(process_noise_covariance=noiseless, measurement_matrix=unseen)
    )
    assert isinstance(first, NoSteadyState)
    assert "no process noise" in first.reason
    assert isinstance(second, NoSteadyState)
    assert "its measurements never show" in second.reason


@pytest.mark.parametrize("seed", range(6))
def test_means_of_residuals_and_errors_follow_the_papers_recursion(seed):
    """Section 4.1's recursions against the filter itself on a truth without noise."""
    rng = np.random.default_rng(seed)
    model = random_model(rng, n_modes=2)
    i, T = steady(model)
    d = difference(i, T)
    x, estimate = rng.normal(size=(2, 4))
    for _ in range(5):
        e = x - estimate
        x = T.A @ x + T.b
        predicted = i.A @ estimate + i.b
        r = T.C @ x - i.C @ predicted
        np.testing.assert_allclose(
            r, T.C @ T.A @ e + d.H_x @ estimate + d.H_u, rtol=1e-9, atol=1e-12
        )
        after = d.F_i @ e + d.G_x @ estimate + d.G_u
        estimate = predicted + i.gain @ r
        np.testing.assert_allclose(x - estimate, after, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_the_steady_residual_is_the_one_that_settles(seed):
    model = random_model(np.random.default_rng(seed), n_modes=2)
    i, T = steady(model)
    found = steady_residual(i, T, np.ones(4))
    assert found.reason == ""
    np.testing.assert_allclose(found.formula, found.settled, rtol=1e-6, atol=1e-9)
    assert np.linalg.norm(found.settled) > 1e-3


def test_figure_4s_residuals_settle_and_growing_estimates_do_not(figure_4):
    CV, CT = steady(model_at_one_step(figure_4)[0])
    state = np.array([0.0, 150.0, 0.0, -150.0])
    found = steady_residual(CV, CT, state)  # modes that differ in u alone: no dA x
    np.testing.assert_allclose(found.formula, found.settled, rtol=1e-6)
    first, second = steady(figure_5_model())
    turning = np.array([0.0, 240.0, 5.0, 0.0, 0.0, 0.0])  # at constant acceleration the CV's ...
    lagging = steady_residual(first, second, turning)
    assert "singular" in lagging.reason  # ... residual settles, but there is no Theta
    assert np.linalg.norm(lagging.settled) > 1.0
    grows = second._replace(A=1.01 * second.A)
    assert "grows" in steady_residual(first, grows, turning).reason
    angle = 0.1
    turn = first.A.copy()
    turn[np.ix_([1, 4], [1, 4])] = [
        [math.cos(angle), math.sin(angle)],
        [-math.sin(angle), math.cos(angle)],
    ]
    circles = first._replace(A=turn)
    assert "keeps moving" in steady_residual(first, circles, turning).reason


def test_equal_modes_have_no_residual(figure_4):
    CV, _ = steady(model_at_one_step(figure_4)[0])
    d = difference(CV, CV)
    assert not np.concatenate([d.G_x.ravel(), d.H_x.ravel(), d.G_u, d.H_u]).any()
    assert d.log_determinants == 0.0
    found = steady_residual(CV, CV, np.ones(4))
    np.testing.assert_allclose(found.settled, 0.0, atol=1e-9)


# ---- the mean trajectory ---------------------------------------------------------------------


def test_the_prediction_is_the_bank_on_measurements_without_noise(figure_4):
    (course,) = courses(figure_4)
    for chosen in figure_4.estimators:
        model, _ = model_at_one_step(figure_4)
        model = model._replace(initial_mean=course.state[0])
        history = reference.bank(model, course.measurements, mixing=chosen.label == "IMM")
        expected = np.array([mu for _, _, mu, _ in history])
        found = mode_probabilities(figure_4, course, chosen)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-12)


def test_predicted_delays_of_figure_4(figure_4):
    (course,) = courses(figure_4)
    assert [s[:4] for s in course.switches] == [(1, "CV", "CT", 46), (2, "CT", "CV", 57)]
    found = {}
    for chosen in figure_4.estimators:
        probabilities = mode_probabilities(figure_4, course, chosen)
        for switch in course.switches:
            new = chosen.bank.names.index(switch.to_mode)
            found[chosen.label, switch.number] = predicted_delay(probabilities, new, switch)
    assert found == {("IMM", 1): 1, ("IMM", 2): 2, ("MMAE", 1): 6, ("MMAE", 2): 10}


def test_a_mode_that_is_not_noticed_before_the_next_switch_never_is():
    p = np.array([[0.9, 0.1], [0.8, 0.2], [0.3, 0.7], [0.3, 0.7]])
    assert predicted_delay(p, 1, Switch(1, "a", "b", 2, 4, 0.0)) == 2
    assert predicted_delay(p, 1, Switch(1, "a", "b", 1, 2, 0.0)) == math.inf
    assert predicted_delay(np.full((4, 2), 0.5), 1, Switch(1, "a", "b", 1, 4, 0.0)) == math.inf


def test_uneven_steps_and_starts_from_two_scans(tmp_path):
    times = [0, 1, 2.5, 3, 5, 6, 8, 9, 10, 12, 13, 15, 16, 18, 19, 20]
    changes = [
        f"clock={{times_s: {times}}}",
        "truth.legs=[{until_s: 8}, {until_s: 20, turn_rate_deg_s: 6, mode: CT}]",
        "transition_matrix=",
        "mean_sojourn_s={CV: 20, CT: 10}",
        "initial={from_measurements: two_point}",
        "windows={}",
        "published=[]",
    ]
    experiment = config.load("rmimm_fig5", changes)
    (course,) = courses(experiment)
    for chosen in experiment.estimators:
        if len(chosen.bank.modes) > 1:
            found = mode_probabilities(experiment, course, chosen)
            assert found.shape == (15, 2)
            assert np.isnan(found[:2]).all()
            np.testing.assert_allclose(found[2:].sum(axis=1), 1.0, rtol=1e-12)


def test_chains_are_predicted_by_their_own_truths():
    experiment = config.load("softbound_ex1")
    chosen = [c for c in experiment.estimators if c.label in ("IMM", "SBF")]
    found = noise_free_delays(experiment, chosen)
    for label in ("IMM", "SBF"):
        into_m2 = distribution(found["softbound_ex1", label], 1)
        assert into_m2.at_risk[0] > 100
        assert into_m2.probability[1] > 0.5 > into_m2.probability[0]


def test_the_courses_of_a_chain_switch_once():
    experiment = config.load("softbound_three_modes")
    found = [course.switches for course in courses(experiment)]
    assert all(len(switches) == 1 for switches in found)
    assert {(s.from_mode, s.to_mode) for (s,) in found} == {
        (a, b)
        for a in ("straight", "gentle", "hard")
        for b in ("straight", "gentle", "hard")
        if a != b
    }


# ---- the propositions ------------------------------------------------------------------------


def slow_mean_bank(filters, model, z, mean, mixing):
    """Mean residuals, mixed starts and predicted probabilities, with plain probabilities."""
    Pi, mu = model.transition_matrix[0], model.initial_mode_probabilities.copy()
    x = [mean.copy() for _ in filters]
    history = []
    for k in range(len(z)):
        c = mu @ Pi
        begun = [
            sum(Pi[a, j] * mu[a] / c[j] * x[a] for a in range(len(x))) if mixing else x[j]
            for j in range(len(x))
        ]
        r = []
        log_weight = np.log(c)
        for j, one in enumerate(filters):
            predicted = one.A @ begun[j] + one.b
            r.append(z[k] - one.C @ predicted)
            x[j] = predicted + one.gain @ r[j]
            log_weight[j] += reference.gaussian_log_density(r[j], one.innovation_covariance)
        mu = reference.normalised(log_weight)
        history.append((np.array(r), np.array(begun), c, mu))
    return history


@pytest.mark.parametrize("mixing", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_the_steady_bank_against_loops(mixing, seed):
    rng = np.random.default_rng(seed)
    model = random_model(rng)
    z, mean = rng.normal(size=(12, 2)), rng.normal(size=4)
    filters = steady(model)
    found = run_mean_bank(filters, model, z, mean, mixing)
    for k, (r, begun, c, _) in enumerate(slow_mean_bank(filters, model, z, mean, mixing)):
        np.testing.assert_allclose(found.residual[k], r, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(found.start[k], begun, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(np.exp(found.log_predicted[k]), c, rtol=1e-8)


def rivals(experiment, label, as_printed=False):
    """By switch, the bounds against all other modes, and what the mean bank's modes are."""
    (course,) = courses(experiment)
    model, _ = model_at_one_step(experiment)
    filters = steady(model)
    chosen = next(c for c in experiment.estimators if c.label == label)
    mean, _, _ = start(experiment, course, chosen)
    bank = run_mean_bank(filters, model, course.measurements, mean, label == "IMM")
    truth = states_of_bank(course, experiment.bank.state_names)
    slow = slow_mean_bank(filters, model, course.measurements, mean, label == "IMM")
    names = experiment.bank.names
    for switch in course.switches:
        new = names.index(switch.to_mode)
        others = [j for j in range(len(names)) if j != new]
        transition = model.transition_matrix[0]
        found = [
            rival(bank, switch, filters, new, j, truth, transition, as_printed) for j in others
        ]
        right = [mu[new] > max(mu[j] for j in others) for *_, mu in slow]
        yield switch, found, right[switch.step - 1 : switch.last]


@pytest.mark.parametrize("label", ["IMM", "MMAE"])
def test_condition_2_is_that_the_bank_is_right(figure_4, label):
    """Proposition 4.1's second condition says no more and no less than mu_T > mu_i."""
    for _, (one,), right in rivals(figure_4, label):
        np.testing.assert_array_equal(one.holds["proposition_4_1"], right)
        sufficient = one.holds["proposition_4_1_condition_3"]
        assert not (sufficient & ~one.holds["proposition_4_1"]).any()


def by_hand(model, filters, slow, truth, switch, as_printed):
    """Every condition for two modes of one state and one output, in plain numbers."""
    i, T = (one for one in filters)
    a_T, a_i, b_T, b_i = (float(v) for v in (T.A[0, 0], i.A[0, 0], T.b[0], i.b[0]))
    c_T, c_i = float(T.C[0, 0]), float(i.C[0, 0])
    k_T, k_i = float(T.gain[0, 0]), float(i.gain[0, 0])
    S_T, S_i = float(T.innovation_covariance[0, 0]), float(i.innovation_covariance[0, 0])
    p = model.transition_matrix[0]
    f_T, f_i = (1 - k_T * c_T) * a_T, (1 - k_i * c_T) * a_T
    dA, dC, db = a_T - a_i, c_T - c_i, b_T - b_i
    h_x, h_u = c_T * dA + dC * a_T - dC * dA, c_T * db + dC * b_T - dC * db
    g_x = (1 - k_i * c_T) * dA - k_i * dC * a_i
    g_u = (1 - k_i * c_T) * db - k_i * dC * b_i
    least_L = math.sqrt((c_T * a_T) ** 2 + h_x**2 + h_u**2)
    least_FG = math.sqrt(f_i**2 + g_x**2 + g_u**2)
    ln_S = (2 if as_printed else 1) * math.log(S_i / S_T)
    alpha, k = S_T / S_i, switch.step - 1
    e_T, e_i = (truth[k, 0] - slow[k][1][j, 0] for j in (1, 0))
    before_T, before_i = (truth[k - 1, 0] - slow[k - 1][1][j, 0] for j in (1, 0))
    found = {name: [] for name in ("1", "1c3", "2c1", "2a", "2c2", "3", "4")}
    ratio = p[1, 0] / p[0, 0] if as_printed else p[0, 1] / p[0, 0]
    right = alpha * (least_L * least_FG * before_i) ** 2 if as_printed else 0.0
    left = (c_T * a_T * (before_T if as_printed else e_T)) ** 2
    found["4"].append(right + S_T * (ln_S + 2 * math.log(ratio)) > left)
    first = None
    for d in range(1, switch.last - switch.step + 2):
        r, _, c, _ = slow[k + d - 1]
        ln_mu = 2 * math.log(c[1] / c[0])
        first = ln_mu if first is None else first
        rest = r[0, 0] ** 2 / S_i + ln_S + ln_mu
        left = (c_T * a_T * f_T ** (d - 1) * e_T) ** 2
        right = alpha * (least_L * least_FG ** (d - 1) * e_i) ** 2 if as_printed else 0.0
        found["1"].append(rest > 0 and r[1, 0] ** 2 / S_T < rest)
        found["1c3"].append(rest > 0 and r[1, 0] ** 2 < alpha * r[0, 0] ** 2 + S_T * (ln_S + ln_mu))
        found["2c1"].append(rest > 0 and left < S_T * (ln_S + first) + right)
        found["2a"].append(rest > 0 and left < S_T * (ln_S + ln_mu) + right)
        found["3"].append(left < right + S_T * (ln_S + 2 * math.log(p[0, 1] / p[0, 0])))
        bound = 1 + (-math.log(alpha) + 2 * math.log(abs(e_T / e_i))) / (
            2 * math.log(abs(f_i / f_T))
        )
        b = r[0, 0] - c_T * a_T * f_i ** (d - 1) * e_i
        j_not_negative = alpha * b**2 + S_T * (ln_S + first) >= 0
        found["2c2"].append(as_printed and rest > 0 and d > bound and j_not_negative)
    return found


@pytest.mark.parametrize("as_printed", [False, True])
def test_every_condition_in_plain_numbers(as_printed):
    """Random modes of one state, each with its own A, b, C, Q, R; an asymmetric chain."""
    names = {
        "1": "proposition_4_1",
        "1c3": "proposition_4_1_condition_3",
        "2c1": "proposition_4_2_condition_1",
        "2a": "proposition_4_2_condition_1_along",
        "2c2": "proposition_4_2_condition_2",
        "3": "proposition_4_3",
        "4": "proposition_4_4",
    }
    seen = {name: set() for name in names}
    for seed in range(300):
        rng = np.random.default_rng(seed)
        model = random_model(rng, n_modes=2, n_x=1, n_y=1)
        model = model._replace(
            state_transition=rng.uniform(0.3, 1.0, size=(1, 2, 1, 1)),
            measurement_noise_covariance=rng.uniform(0.05, 4.0, size=(2, 1, 1)),
            transition_matrix=np.array([[[0.55, 0.45], [0.2, 0.8]]]),
            initial_mode_probabilities=np.array([0.7, 0.3]),
        )
        i, T = steady(model)
        mode = np.array([0] * 6 + [1] * 8)
        truth = rng.normal(size=(15, 1))
        for k in range(14):
            one = (i, T)[mode[k]]
            truth[k + 1] = one.A @ truth[k] + one.b
        z = np.array([(i, T)[mode[k]].C @ truth[k + 1] for k in range(14)])
        start = truth[0] + rng.normal(size=1)
        switch = Switch(1, "m0", "m1", 7, 14, 6.0)
        bank = run_mean_bank([i, T], model, z, start, True)
        slow = slow_mean_bank([i, T], model, z, start, True)
        transition = model.transition_matrix[0]
        found = rival(bank, switch, [i, T], 1, 0, truth, transition, as_printed)
        expected = by_hand(model, [i, T], slow, truth, switch, as_printed)
        for short, name in names.items():
            np.testing.assert_array_equal(found.holds[name], expected[short], err_msg=name)
            seen[short] |= set(expected[short])
    for short in names:
        if as_printed or short != "2c2":
            assert seen[short] == {False, True}, short


def test_premises_that_fail_are_said(figure_4):
    swapping = figure_4.bank._replace(transition_matrix=np.array([[0.2, 0.8], [0.7, 0.3]]))
    for _, found, _ in rivals(figure_4._replace(bank=swapping), "IMM"):
        for name in ("proposition_4_3", "proposition_4_4"):
            assert "not diagonally dominant" in bounds(found)[name].result


def test_condition_15_by_hand(figure_4):
    CV, CT = steady(model_at_one_step(figure_4)[0])
    d = difference(CV, CT)
    largest, ln = d.largest_information, d.log_determinants
    # 0 < alpha r^2 + (ln |S_i|/|S_T| + 2 ln p_TT/p_Ti) / lambda_max(S_T^-1)
    edge = math.sqrt(-(ln + 2 * math.log(0.51 / 0.49)) / largest / d.alpha)
    assert condition_15(d, 1.001 * edge, 0.51, 0.49) is True
    assert condition_15(d, 0.999 * edge, 0.51, 0.49) is False
    assert condition_15(d, 0.0, 1.0, 0.0) is True
    assert condition_15(d, 5.0, 0.0, 1.0) is None


def test_the_three_terms_by_hand():
    """sqrt(1/alpha) = 2, condition number 3, ratio of errors 5: ln 30."""
    values = dict.fromkeys(Ingredients._fields, 1.0)
    values |= {"alpha": 0.25, "sigma_max_C_T_A_T": 6.0, "sigma_min_C_T_A_T": 2.0}
    values |= {"error_T": 10.0, "error_i": 2.0}
    assert _terms(Ingredients(**values)) == pytest.approx((4.0, 3.0, 5.0, math.log(30.0)))


def test_figure_4s_propositions(figure_4):
    """Condition 1 of 4.2, 4.3 and 4.4 are never satisfied, as printed or not."""
    for label in ("IMM", "MMAE"):
        for as_printed in (False, True):
            for _, found, _ in rivals(figure_4, label, as_printed):
                said = bounds(found)
                for name in (
                    "proposition_4_2_condition_1",
                    "proposition_4_3",
                    "proposition_4_4",
                ):
                    assert said[name] == (math.inf, "never satisfied")
                second = said["proposition_4_2_condition_2"]
                if not as_printed:
                    assert second.result.startswith("premise fails: sigma_min(F_i)")


def test_what_is_printed_differs_where_it_is_wrong(figure_4):
    """2 ln |S_i|/|S_T| for ln; the transpose of the transition matrix."""
    lopsided = figure_4.bank._replace(transition_matrix=np.array([[0.9, 0.1], [0.001, 0.999]]))
    experiment = figure_4._replace(bank=lopsided)
    for (_, (one,), _), (_, (printed,), _) in zip(
        rivals(experiment, "IMM"), rivals(experiment, "IMM", as_printed=True), strict=True
    ):
        more = one.ingredients.log_determinant_ratio
        information = 1.0 / (printed.ingredients.beta - one.ingredients.beta) * more
        assert information > 0.0
        own = steady(model_at_one_step(experiment)[0])
        largest = [f.eigenvalues_of_information[-1] for f in own]
        assert min(abs(information / value - 1.0) for value in largest) < 1e-9


def test_a_bound_holds_where_filters_run_alone(figure_4):
    """Where condition 1 of 4.2 is satisfied, the bank of lone steady filters is right then.

    Over 60 noise settings; it is satisfied in some.
    """
    satisfied = 0
    for sigma_v in (0.05, 0.2, 0.8):
        for ratio in (0.3, 1.0, 3.0, 10.0):
            for q in (0.01, 0.1, 0.5, 2.0, 8.0):
                modes = tuple(
                    mode._replace(
                        measurement_noise_covariance=(sigma_v * factor) ** 2 * np.eye(2),
                        matrices=mode.matrices._replace(
                            process_noise_covariance=q**2 * np.eye(4)[np.newaxis]
                        ),
                    )
                    for mode, factor in zip(figure_4.bank.modes, (1.0, ratio), strict=True)
                )
                changed = figure_4._replace(bank=figure_4.bank._replace(modes=modes))
                for _, found, right in rivals(changed, "MMAE"):
                    bound = bounds(found)["proposition_4_2_condition_1"]
                    if bound.delay_steps < len(right):
                        satisfied += 1
                        assert right[int(bound.delay_steps) - 1]
    assert satisfied >= 5


def test_three_modes_have_no_proposition_4_3():
    experiment = config.load("softbound_three_modes")
    analysis = analyses()["delay"]
    changed = config.load("softbound_three_modes", analysis.wants_run(experiment))
    model, _ = model_at_one_step(changed)
    filters = steady(model)
    course = next(iter(courses(changed)))
    bank = run_mean_bank(filters, model, course.measurements, course.state[0], True)
    truth = states_of_bank(course, changed.bank.state_names)
    found = [
        rival(bank, course.switches[0], filters, 1, j, truth, model.transition_matrix[0], False)
        for j in (0, 2)
    ]
    assert "two modes, and there are 3" in bounds(found)["proposition_4_3"].result


# ---- tuning and what is asked for ------------------------------------------------------------


def test_concordance():
    one = [("CV", "R")] * 4
    assert concordance(one[:3], [1, 2, 3], [5, 6, 7]) == 1.0
    assert concordance(one[:3], [1, 2, 3], [7, 6, 5]) == -1.0
    assert concordance(one, [1, 2, 3, 4], [1, 2, 2, 1]) == 0.0
    assert concordance(one[:3], [1, 2, 3], [4, 4, 4]) is None
    assert concordance(one[:2], [1, 2], [1, math.inf]) == 1.0
    assert concordance([], [], []) is None
    two = [("", ""), ("CV", "R"), ("CT", "R")]
    assert concordance(two, [2, 1, 3], [5, 4, 4]) == 0.0  # each against the untuned alone


def test_scenarios_that_have_nothing_to_notice():
    wants = analyses()["delay"].wants_run
    still = config.load("mode_delay_fig4", ["truth.legs=[{until_s: 90}]", "published=[]"])
    for name in (still, config.load("softbound_outlier"), config.load("recorded_flight")):
        with pytest.raises(Unsuited, match="the truth has no switch of mode") as caught:
            wants(name)
        assert caught.value.keys == ("truth",)
    experiment = config.load("softbound_ex1")
    one = experiment._replace(bank=experiment.bank._replace(modes=experiment.bank.modes[:1]))
    with pytest.raises(Unsuited, match="the filters have one mode"):
        wants(one)
    others = tuple(mode._replace(name=f"other_{mode.name}") for mode in experiment.bank.modes)
    strange = experiment._replace(bank=experiment.bank._replace(modes=others))
    with pytest.raises(Unsuited, match="never switches between two of the filters' modes"):
        wants(strange)


def test_missing_estimators_are_asked_for_under_free_labels():
    experiment = config.load(
        "rmimm_fig5", ["estimators={MMAE: {type: imm}}", "compare_with=", "published=[]"]
    )
    assert analyses()["delay"].wants_run(experiment) == ("estimators.MMAE_added={type: mmae}",)
