"""The stability of an IMM: the lemmas, the constants, the bounds and the verdicts."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import reference
import reference_stability as slow
from hybridtrack.analyses import _mixing, _riccati
from hybridtrack.analyses._definite import is_definite, is_singular, join, meet, square_root
from hybridtrack.analyses._examination import checks, examine
from hybridtrack.analyses._stability_words import no_rate
from hybridtrack.analyses.stability import ANALYSIS
from hybridtrack.config import load
from hybridtrack.vectors import WIDTH
from models import random_model, scenario, unpacked
from scenarios import CHAIN

SEEDS = st.integers(0, 2**32 - 1)
MANY = settings(max_examples=60, deadline=None)
FEW = settings(max_examples=15, deadline=None)
ROUNDING = 1e-9  # relative to the largest entry: some thousand operations, a margin of 1,000


def analyse(experiment):
    return ANALYSIS.analyse(experiment, experiment.analyses["stability"], None)


def model_of(name, *changes):
    experiment = load(name, list(changes))
    initial = experiment.initial
    return experiment.bank.discretise(np.array([2.0]), initial.mean, initial.covariance)


def definite(rng, n, spread=2.0):
    """A random covariance whose eigenvalues differ by some powers of ten."""
    axes = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return (axes * 10 ** rng.uniform(-spread, spread, n)) @ axes.T


def semidefinite(rng, n):
    root = rng.normal(size=(n, int(rng.integers(1, n + 1))))
    return root @ root.T


def weights(rng, n):
    gamma = rng.random(n) ** 3 + 1e-6
    return gamma / gamma.sum()


def assert_below(lower, upper, slack=ROUNDING):
    """lower <= upper as matrices, but for rounding of the larger one's size."""
    least = np.linalg.eigvalsh((upper - lower + (upper - lower).T) / 2)[0]
    assert least >= -slack * np.abs(upper).max(), least


def row(table, **where):
    """A row of a table's columns."""
    (name, cell), *_ = where.items()
    i = list(table.columns[name]).index(cell)
    return {column: values[i] for column, values in table.columns.items()}


# ---- the reference case ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def reference_case():
    """CV and a 3 deg/s turn, as shipped."""
    return analyse(load("stability_cv_ct"))


PRINTED = 1e-4  # relative, as many digits as are given


def test_the_constants_of_the_reference_case(reference_case):
    two, ten = (row(reference_case.table, measurements=N) for N in (2, 10))
    expected = {
        "kappa_1": 0.013726,
        "kappa_2": 46.580,
        "kappa_3": 3.0550e-4,
        "kappa_4": 2.0944e-3,
        "beta_1_printed": 0.0137254,
        "beta_1": 0.0137258,
    }
    for name, value in expected.items():
        assert two[name] == pytest.approx(value, rel=PRINTED), name
    # Two that differ by 3e-5 of themselves: the relative tolerance alone couldn't tell them apart.
    assert two["beta_1"] - two["beta_1_printed"] == pytest.approx(4e-7, abs=1e-7)
    assert ten["beta_1"] == pytest.approx(0.0985, abs=5e-5)
    assert two["kappa_1"] / (1 + two["kappa_1"] * two["kappa_4"]) == two["beta_1_printed"]
    one = row(reference_case.table, measurements=1)
    assert (one["controllable"], one["observable"], one["beta_1"]) == (False, False, 0.0)


def test_floor_and_ceiling_of_the_reference_case(reference_case):
    bounds, eigenvalues = reference_case.tables["bounds"], reference_case.tables["eigenvalues"]
    for state, floor, ceiling in (("x", 17.197, 29.079), ("vx", 0.78226, 4.3232)):
        for axis in (state, state.replace("x", "y")):
            found = row(bounds, state=axis)
            assert found["floor_std"] == pytest.approx(floor, rel=PRINTED)
            assert found["ceiling_std_without_spread"] == pytest.approx(ceiling, rel=PRINTED)
            assert found["floor_std"] < found["simulated_smallest_std"]
            assert found["simulated_largest_std"] < found["ceiling_std"]
    floor = row(eigenvalues, bound="floor")
    assert floor["smallest_eigenvalue"] == pytest.approx(0.31528, rel=PRINTED)
    bare = row(eigenvalues, bound="ceiling without spread")
    assert bare["largest_eigenvalue"] == pytest.approx(854.07, rel=PRINTED)
    assert bare["share_broken"] > 0.9  # so it is no ceiling at all
    assert row(eigenvalues, bound="ceiling given the spread")["share_broken"] == 0.0
    assert (floor["steps_checked"], floor["steps_broken"]) == (4991, 0)
    assert floor["bound_from_step"] == 202


def test_a_floor_is_due_from_the_first_measurements_on():
    """beta_1(2) bounds what two measurements gave, and 200 iterations later it has settled."""
    bank = _riccati.bank(model_of("stability_cv_ct"))
    low = _riccati.floor(bank, _riccati.all_sequences(bank, 3))
    assert (low.first, len(low.path), low.from_step) == (2, 201, 202)
    np.testing.assert_array_equal(low.at(np.array([2, 202, 999])), low.path[[0, -1, -1]])


def test_the_simulation_of_the_reference_case():
    """.853 +- .01 is asked for: the mean of four flights, their own error in it, 3 of them."""
    model = model_of("stability_cv_ct")
    found = [examine(model, 2, 5000, seed) for seed in range(1, 5)]
    rates = np.array([one.rate.per_step for one in found])
    errors = np.array([one.rate.standard_error for one in found])
    assert abs(rates.mean() - 0.853) < 0.01
    assert (np.abs(rates - rates.mean()) < 3 * np.hypot(errors, errors.mean() / 2)).all()
    least = [np.linalg.eigvalsh(one.run.covariances[10:]).min() for one in found]
    assert 0.31528 < min(least) < max(least) < 0.6  # about .504 is asked for, and chance decides
    shares = [checks(one).bare_ceiling.share for one in found]
    assert min(shares) > 0.9


def test_the_certified_rate_is_valid_and_useless(reference_case):
    rates = reference_case.tables["rates"]
    certified = row(rates, kind="certified, beta_1 of the floor")
    printed = row(rates, kind="certified, beta_1 as printed")
    assert 0.999999 < certified["rate_per_step"] < printed["rate_per_step"] < 1.0
    assert certified["conditional_on_spread"]
    assert row(rates, kind="one step, ours")["rate_per_step"] is None  # B Q B' is singular
    constants = reference_case.tables["constants"]
    value = {name: row(constants, constant=name)["value"] for name in constants.columns["constant"]}
    kappa_3 = row(reference_case.table, measurements=2)["kappa_3"]
    assert value["c_1"] == pytest.approx(value["beta_1 of the floor"] * value["beta_5"] * kappa_3)
    assert value["beta_5"] == min(value["beta_4"] * 2500, 1)  # xi_3 is r^2
    assert value["beta_4"] < 1 / (2500 + value["beta_3"])
    # V falls by 1 / (1 + c_1) in two steps and goes with ||e||^2: four steps' worth of ||e||.
    assert certified["one_minus_rate"] == pytest.approx(value["c_1"] / 4, rel=1e-5)
    assert certified["rate_per_step"] == pytest.approx(1 - certified["one_minus_rate"], rel=1e-12)
    assert f"certifies 1 - {certified['one_minus_rate']:.2g} per" in reference_case.conclusions[1]
    assert certified["time_constant_steps"] == pytest.approx(4 / value["c_1"], rel=1e-5)
    assert certified["time_constant_s"] == 2 * certified["time_constant_steps"]


def test_what_is_printed_wrongly_is_said(reference_case):
    notes = " ".join(reference_case.notes)
    assert "1 (controllable) met, N = 2; 2 (observable with N <= 2) met, N = 2; 3 (the" in notes
    assert "beta_3 2.9" in notes  # 4 digits; the simulated spread is in it
    for part in ("lemma 1", "definition 3", "Q^e (eq. 32)", "beta_5 =", "phi(k)"):
        assert part in notes
    assert reference_case.conclusions[0].startswith("Conditions met")
    assert "as long as the spread of the modes' means is at most" in reference_case.conclusions[2]


def test_a_page_has_beta_1_and_beta_2_and_few_tables(reference_case):
    printed = {name: table.shown for name, table in reference_case.tables.items() if table.shown}
    assert list(printed) == ["rates", "bounds", "eigenvalues"]
    cells = printed["eigenvalues"]
    smallest = dict(zip(cells["P_j(k|k)"], cells["smallest\neigenvalue"], strict=True))
    largest = dict(zip(cells["P_j(k|k)"], cells["largest\neigenvalue"], strict=True))
    assert smallest["floor (smallest: beta_1)"] == "0.3153"
    beta_2 = largest["ceiling if spread (largest: beta_2)"]
    assert largest["ceiling, no spread"] == "854.1"
    assert "simulated, from step 10" in smallest
    assert any(f"no larger: beta_2 {beta_2}, beta_3" in note for note in reference_case.notes)
    bare = printed["bounds"]["ceiling,\nno spread"]
    assert bare == ["29.08", "4.323", "29.08", "4.323"]
    # Where the theorem says nothing, the ceiling still has its beta_2.
    other = analyse(load("stability_embedded_cv", ["analyses.stability.steps=200"]))
    assert any("no larger: beta_2 " in note and "beta_3" not in note for note in other.notes)


# ---- the other verdicts ----------------------------------------------------------------------


def test_two_acceleration_models_need_three_measurements():
    found = analyse(load("stability_ca"))
    observable = found.table.columns["observable"]
    assert observable[:3] == [False, False, True]
    assert found.table.columns["kappa_3"][:2] == [0.0, 0.0]
    assert found.table.columns["kappa_3"][2] > 0
    assert found.conclusions[0].startswith(
        "Condition 2 not met (needs N = 3): the paper conjectures stability; simulated rate 0."
    )
    rates = found.tables["rates"]
    assert row(rates, kind="certified, beta_1 of the floor")["rate_per_step"] is None
    ours = row(rates, kind="one step, ours")  # needs neither N <= 2 nor the same C and R
    assert row(rates, kind="simulated")["rate_per_step"] < ours["rate_per_step"] <= 1.0
    assert 0 < ours["one_minus_rate"] < 1e-6
    assert any("is ours, not the paper's" in note for note in found.notes)


def test_an_embedded_straight_flight_has_no_inverse():
    found = analyse(load("stability_embedded_cv"))
    start = "Theorem not applicable: A of mode CV is singular; simulated rate 0."
    assert found.conclusions[0].startswith(start)
    for name in ("kappa_3", "kappa_4", "observable", "beta_1_printed", "upper_bound_printed"):
        assert set(found.table.columns[name]) == {None}
    assert set(found.table.columns["beta_1"]) == {0.0}  # no doubt about the acceleration in CV
    condition = row(found.tables["conditions"], condition="2: uniformly observable with N <= 2")
    assert condition["verdict"] == "not applicable"
    condition = row(found.tables["conditions"], condition="1: uniformly controllable")
    assert "in CV there may be no doubt left about a" in condition["because"]


def test_every_condition_that_fails_is_named():
    found = analyse(load("stability_cv_ct", ["modes.CT.position_std_m=20"]))
    assert found.conclusions[0].startswith("Condition 3 not met (C and R differ between modes): ")
    found = analyse(load("stability_ca", ["modes.agile.position_std_m=20"]))
    both = (
        "Condition 3 not met (C and R differ between modes) and condition 2 not met (needs N = 3)"
    )
    assert found.conclusions[0].startswith(f"{both}: the theorem says nothing; simulated rate 0.")


def test_both_conditions_that_fail_are_named(tmp_path):
    found = analyse(scenario(tmp_path, CHAIN, "modes.fast.measurement_matrix=[[0, 0]]"))
    assert "condition 2 not met (not observable up to N = 10)" in found.conclusions[0]
    assert "Condition 3 not met" in found.conclusions[0]
    assert any("there is no ceiling: the joins' doubt about x" in s for s in found.conclusions)
    zero = load("stability_cv_ct", [f"modes.{m}.acceleration_std_m_s2=0" for m in ("CV", "CT")])
    found = analyse(zero)
    assert found.conclusions[0].startswith("Condition 1 not met (not controllable up to N = 10)")
    assert any("there is no floor" in sentence for sentence in found.conclusions)


# ---- against slow references -----------------------------------------------------------------


@FEW
@given(SEEDS)
def test_constants_over_all_sequences(seed):
    rng = np.random.default_rng(seed)
    model = random_model(rng, n_modes=int(rng.integers(2, 4)), n_x=int(rng.integers(1, 4)))
    bank = _riccati.bank(model)
    if min(np.linalg.svd(A, compute_uv=False)[-1] for A in bank.A) < 1e-3:
        return  # inverses of the slow sums lose the digits to be compared
    for one in _riccati.all_sequences(bank, 4):
        expected = slow.kappas(bank.A, bank.W, bank.C, bank.R, one.measurements)
        ours = (one.kappa_1, one.kappa_2, one.kappa_3, one.kappa_4)
        scale = (expected[1], expected[1], expected[3], expected[3])  # what eigenvalues round by
        for value, want, size in zip(ours, expected, scale, strict=True):
            assert value == pytest.approx(want, rel=1e-6, abs=1e-11 * size)
        beta_1 = slow.beta_1(bank.A, bank.W, bank.C, bank.R, one.measurements)
        assert one.beta_1 == pytest.approx(beta_1, rel=1e-7)


def test_two_measurements_are_those_of_section_iii_c():
    bank = _riccati.bank(model_of("stability_cv_ct"))
    least = []
    for A in bank.A:
        back, information = np.linalg.inv(A), bank.C[0].T @ np.linalg.inv(bank.R[0]) @ bank.C[0]
        least.append(np.linalg.eigvalsh(back.T @ information @ back + information)[0])
    assert _riccati.all_sequences(bank, 2)[1].kappa_3 == pytest.approx(min(least), rel=1e-10)


def test_a_state_seen_faintly_keeps_its_digits():
    """Squared singular values: as eigenvalues of the Gramian these would be all rounding."""
    A = np.array([[1.0, 1e-9], [0.0, 1.0]])
    bank = _riccati.Bank(
        np.stack([A, A]), np.stack([np.eye(2)] * 2), np.array([[[1.0, 0.0]]] * 2),
        np.ones((2, 1, 1)), ("a", "b"), ("x", "vx"),
    )  # fmt: skip
    kappa_3 = _riccati.all_sequences(bank, 2)[1].kappa_3
    assert kappa_3 == pytest.approx(0.5e-18, rel=1e-6)  # det = 1e-18, trace = 2 of the Gramian


def two_modes(A, W, C):
    """A bank of states x and vx, R = 1."""
    return _riccati.Bank(
        np.array(A), np.array(W), np.array(C), np.ones((2, 1, 1)), ("a", "b"), ("x", "vx")
    )


def test_what_is_certain_and_what_is_unseen_has_a_name():
    """The culprit is the mode and the state that a practitioner has to look at."""
    bank = two_modes(
        [np.eye(2)] * 2, [np.diag([9.0, 9.0]), np.diag([1e4, 0.0])], [[[1.0, 1.0]], [[5.0, 0.0]]]
    )
    one = _riccati.all_sequences(bank, 1)[0]
    assert one.certain == ("b", "vx")
    assert not one.controllable
    bank = two_modes(
        [np.eye(2)] * 2, [np.diag([9.0, 9.0]), np.diag([1e4, 1.0])], [[[1.0, 0.0]]] * 2
    )
    one = _riccati.all_sequences(bank, 1)[0]
    assert one.certain == ("b", "vx")
    assert one.controllable
    assert one.unseen == ("a", "vx")


def test_a_state_in_a_large_unit_is_no_certain_one():
    """Its variance is 1e-28 of the other's, and yet it is noise."""
    noise = np.diag([1e14, 1e-14])
    bank = two_modes([np.eye(2)] * 2, [noise, noise], [[[1.0, 0.0]]] * 2)
    one = _riccati.all_sequences(bank, 1)[0]
    assert one.controllable
    assert one.kappa_1 == pytest.approx(1e-14)
    assert one.kappa_2 == pytest.approx(1e14)


@FEW
@given(SEEDS)
def test_more_measurements_never_take_away(seed):
    """Gramians grow by positive semidefinite parts, and Upsilon(0) >= 0: all are monotone in N."""
    rng = np.random.default_rng(seed)
    model = random_model(rng, n_modes=2, n_x=3, n_y=1)
    figures = _riccati.all_sequences(_riccati.bank(model), 5)
    for name in ("kappa_1", "kappa_2", "kappa_3", "kappa_4", "beta_1"):
        values = np.array([getattr(one, name) for one in figures])
        assert (np.diff(values) >= -1e-9 * values[1:]).all(), name


@MANY
@given(SEEDS)
def test_the_riccati_map_is_the_papers_and_keeps_the_order(seed):
    rng = np.random.default_rng(seed)
    bank = _riccati.bank(random_model(rng, n_x=3))
    smaller = definite(rng, 3)
    larger = smaller + semidefinite(rng, 3)
    for j in range(3):
        M = bank.A[j] @ smaller @ bank.A[j].T + bank.W[j]
        information = bank.C[j].T @ np.linalg.inv(bank.R[j]) @ bank.C[j]
        ours = _riccati.updated(bank, j, smaller)
        printed = np.linalg.inv(np.linalg.inv(M) + information)  # (36)
        np.testing.assert_allclose(ours, printed, rtol=1e-6, atol=1e-9 * np.abs(M).max())
        assert_below(ours, _riccati.updated(bank, j, larger))


@FEW
@given(SEEDS)
def test_the_imm_is_the_reference_mode_by_mode(seed):
    rng = np.random.default_rng(seed)
    model = random_model(rng, n_modes=int(rng.integers(2, 4)), n_x=3)
    flight = _mixing.fly(model, 12, seed)
    run = _mixing.interacting_filters(model, flight.measurements)
    history = slow.imm(model, flight.measurements)
    for k, (P, _, gamma, spread, K) in enumerate(history):
        close = {"rtol": 1e-8, "atol": 1e-8 * np.abs(P).max()}
        np.testing.assert_allclose(run.covariances[k + 1], P, **close)
        np.testing.assert_allclose(run.mixing[k], gamma, atol=1e-8)
        np.testing.assert_allclose(run.spread[k], spread, **close)
        for j, C in enumerate(model.measurement_matrix):
            closed = (np.eye(3) - K[j] @ C) @ model.state_transition[0, j]
            np.testing.assert_allclose(run.closed_loop[k, j], closed, atol=1e-8)
    product = slow.propagator(model, [h[2] for h in history], [h[4] for h in history])
    logs = _mixing.contraction(run)
    assert logs[-1] == pytest.approx(np.log(np.linalg.norm(product, 2)), abs=1e-7)


def test_the_imm_is_the_packages_own():
    """Combined means, covariances and mode probabilities: the references' and the estimator's."""
    from hybridtrack.estimators import estimators

    model = random_model(np.random.default_rng(8))
    z = _mixing.fly(model, 40, 3).measurements
    run = _mixing.interacting_filters(model, z)
    imm = estimators()["imm"]
    prepared = imm.prepare(imm.settings(), model)
    lanes = WIDTH
    start = np.repeat(model.initial_mean[:, np.newaxis], lanes, axis=1)
    scans = np.repeat(z[:, :, np.newaxis], lanes, axis=2)
    theirs = imm.begin(imm.settings(), prepared, start).advance(prepared, scans, covariance=True)
    for k, (mean, covariance, probabilities, _) in enumerate(reference.bank(model, z)):
        mu = run.mode_probabilities[k + 1]
        ours = reference.moments(mu, run.means[k + 1], run.covariances[k + 1])
        size = np.abs(covariance).max()
        np.testing.assert_allclose(mu, probabilities, atol=1e-10)
        np.testing.assert_allclose(ours[0], mean, atol=1e-10 * (1 + np.abs(mean).max()))
        np.testing.assert_allclose(ours[1], covariance, atol=1e-10 * size)
        np.testing.assert_allclose(theirs.mode_probabilities[k, :, 0], mu, atol=1e-10)
        np.testing.assert_allclose(
            theirs.mean[k, :, 0], ours[0], atol=1e-10 * (1 + np.abs(mean).max())
        )
        packed = unpacked(theirs.covariance[k, :, 0], len(mean))
        np.testing.assert_allclose(packed, ours[1], atol=1e-10 * size)


def test_a_mode_that_none_leads_to_mixes_itself():
    model = random_model(np.random.default_rng(2), n_modes=2)
    model = model._replace(transition_matrix=np.array([[[1.0, 0.0], [1.0, 0.0]]]))
    run = _mixing.interacting_filters(model, _mixing.fly(model, 5, 1).measurements)
    np.testing.assert_array_equal(run.mixing[:, 1], np.tile([0.0, 1.0], (5, 1)))
    np.testing.assert_array_equal(run.mode_probabilities[1:, 1], 0.0)


# ---- bounds of covariances -------------------------------------------------------------------


@MANY
@given(SEEDS)
def test_meet_and_join_bound_both(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    A, B = definite(rng, n), definite(rng, n)
    low, high = meet([A, B]), join([A, B])
    for one in (A, B):
        assert_below(low, one)
        assert_below(one, high)
    assert_below(np.zeros_like(A), low)
    np.testing.assert_allclose(low, slow.along_both(A, B, np.minimum), atol=1e-9 * np.abs(A).max())
    np.testing.assert_allclose(
        high, slow.along_both(A, B, np.maximum), rtol=1e-7, atol=1e-7 * np.abs(high).max()
    )
    np.testing.assert_allclose(low + high, A + B, atol=1e-10 * np.abs(A + B).max())
    np.testing.assert_allclose(low, meet([B, A]), atol=1e-9 * np.abs(low).max())


@MANY
@given(SEEDS)
def test_meet_and_join_know_no_units(seed):
    """T meet(A, B) T' = meet(T A T', T B T') for every invertible T."""
    rng = np.random.default_rng(seed)
    A, B, T = definite(rng, 3, 1.0), definite(rng, 3, 1.0), rng.normal(size=(3, 3)) + 3 * np.eye(3)
    for bound in (meet, join):
        moved = bound([T @ A @ T.T, T @ B @ T.T])
        expected = T @ bound([A, B]) @ T.T
        np.testing.assert_allclose(moved, expected, atol=1e-8 * np.abs(expected).max())


def test_meet_and_join_of_numbers_and_of_singular_matrices():
    ones = [np.array([[value]]) for value in (3.0, 2.0, 5.0)]
    assert meet(ones)[0, 0] == pytest.approx(2.0)
    assert join(ones)[0, 0] == pytest.approx(5.0)
    x, y = np.diag([1.0, 0.0]), np.diag([0.0, 4.0])
    np.testing.assert_allclose(meet([x, y]), np.zeros((2, 2)), atol=1e-15)
    np.testing.assert_allclose(join([x, y]), np.diag([1.0, 4.0]), atol=1e-15)
    np.testing.assert_allclose(join([x, 2 * x]), 2 * x, atol=1e-15)
    np.testing.assert_array_equal(meet([np.zeros((2, 2))] * 2), np.zeros((2, 2)))
    tiny = np.diag([1e8, 1e-8])  # metres and their derivatives
    np.testing.assert_allclose(meet([tiny, 4 * tiny]), tiny, rtol=1e-12)


def test_numerical_rank():
    assert is_singular(np.diag([1.0, 0.0]))
    assert not is_singular(np.array([[1.0, 10.0], [0.0, 1.0]]))
    assert not is_singular(np.array([[1.0, 3e8], [0.0, 1.0]]))  # a clock's drift, in metres
    assert is_singular(np.array([[1.0, 3e8, 0.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]]))
    assert is_definite(np.diag([1e9, 1e-9]))  # units don't matter
    assert not is_definite(np.outer([1.0, 2.0], [1.0, 2.0]))
    assert not is_definite(np.diag([1.0, 0.0]))
    gain = np.array([2.0, 2.0])
    root = square_root(np.outer(gain, gain))
    np.testing.assert_allclose(root @ root.T, np.outer(gain, gain), atol=1e-14)
    assert np.linalg.matrix_rank(root, tol=1e-9) == 1


@FEW
@given(SEEDS)
def test_every_covariance_lies_between_floor_and_ceiling(seed):
    """Any bank, any start, three modes: from step N0 on, and from the start on."""
    rng = np.random.default_rng(seed)
    model = random_model(rng, n_modes=int(rng.integers(2, 4)), n_x=3, n_y=1)
    found = examine(model, 3, 150, seed)
    held = checks(found)
    assert held.floor_in_time.checked >= 150
    for part in (held.floor_in_time, held.ceiling, held.spread):
        assert part.broken == 0
    if found.ceiling.matrix is not None:  # of three modes one in twenty has none
        assert_below(found.floor.matrix, found.ceiling.matrix)
    # beta_1(N) bounds the eigenvalues from step N on.
    least = np.linalg.eigvalsh(found.run.covariances)[..., 0].min(axis=1)
    for one in found.figures:
        assert (least[one.measurements :] >= one.beta_1 * (1 - 1e-9)).all()


ENDLESS = [  # a position that is never measured, and whose doubt grows
    *(f"modes.{mode}.measurement_matrix=[[0, 1]]" for mode in ("slow", "fast")),
    "modes.slow.measurement_noise_covariance=[[9]]",
]
CREEPING = [
    f"modes.{mode}.process_noise_covariance=[[1e-20, 0], [0, 1e-20]]" for mode in ("slow", "fast")
]


@pytest.mark.parametrize("changes", [[], ENDLESS, CREEPING])
def test_a_bound_bounds_its_own_successor(changes, tmp_path):
    """So it bounds all that comes after it, whether the iteration settled or was held."""
    experiment = scenario(tmp_path, CHAIN, *changes)
    initial = experiment.initial
    model = experiment.bank.discretise(np.array([0.5]), initial.mean, initial.covariance)
    bank = _riccati.bank(model)
    spread = np.diag([1.0, 0.1])
    low = _riccati.floor(bank, _riccati.all_sequences(bank, 4))
    high = _riccati.ceiling(bank, spread, model.initial_covariance)
    assert (low.why != "", high.matrix is None) == {0: (False, False), 3: (True, True)}.get(
        len(changes), (True, False)
    )
    for j in range(2):
        assert _riccati.below(low.matrix, _riccati.updated(bank, j, low.matrix))
        if high.matrix is not None:
            assert _riccati.below(_riccati.updated(bank, j, high.matrix + spread), high.matrix)


def test_iterations_that_go_round_are_held_and_grow_weaker():
    """Without a free step at all: every iterate is then a bound of all that follow."""
    model = random_model(np.random.default_rng(4), n_modes=3, n_x=3, n_y=1)
    bank = _riccati.bank(model)
    figures = _riccati.all_sequences(bank, 3)
    free = _riccati.floor(bank, figures)
    kept, _riccati.FREE_STEPS = _riccati.FREE_STEPS, 1
    try:
        held = _riccati.floor(bank, figures)
    finally:
        _riccati.FREE_STEPS = kept
    assert held.why.startswith("it hadn't settled after 1 steps")
    for earlier, later in zip(held.path[1:], held.path[2:], strict=False):
        assert _riccati.below(later, earlier)
    for j in range(3):
        assert _riccati.below(held.matrix, _riccati.updated(bank, j, held.matrix))
    assert np.trace(held.matrix) <= np.trace(free.matrix) * (1 + 1e-9)


def test_a_floor_that_outgrows_all_numbers_is_beta_1(tmp_path):
    """Nothing is seen, and all grows: the iteration is given up, and says why."""
    unseen = [
        change
        for mode in ("slow", "fast")
        for change in (
            f"modes.{mode}.state_transition=[[1.5, 0.5], [0, 1.2]]",
            f"modes.{mode}.measurement_matrix=[[0, 0]]",
        )
    ]
    unseen.append("modes.slow.measurement_noise_covariance=[[9]]")
    found = analyse(scenario(tmp_path, CHAIN, *unseen))
    note = next(note for note in found.notes if note.startswith("the floor is valid, but "))
    assert "given up: it grew beyond 1e+24 within" in note
    assert note.endswith("steps; it is beta_1 I instead, of N = 10")


def test_a_ceiling_begins_above_the_start():
    """The start is the largest of all covariances here."""
    model = model_of("stability_cv_ct")
    start = 1e8 * np.eye(4)
    high = _riccati.ceiling(_riccati.bank(model), np.zeros((4, 4)), start)
    assert high.first == 0
    assert_below(start, high.path[0])
    assert np.trace(high.path[0]) > 2 * np.trace(start)


def test_a_larger_spread_has_a_higher_ceiling():
    """Both with S2 = 4 S1, as matrices."""
    model = model_of("stability_cv_ct")
    bank, start = _riccati.bank(model), model.initial_covariance
    spread = np.diag([100.0, 4.0, 100.0, 4.0])
    bare, one, two = (
        _riccati.ceiling(bank, factor * spread, start).matrix for factor in (0.0, 1.0, 4.0)
    )
    assert_below(bare, one)
    assert_below(one, two)


def test_a_ceiling_forgets_where_it_began_and_a_floor_is_the_kalman_filters():
    """Two equal modes: both bounds are the solution of the Riccati equation."""
    from scipy.linalg import solve_discrete_are

    model = model_of(
        "stability_cv_ct", "modes.CT={motion: constant_velocity, acceleration_std_m_s2: 0.1}"
    )
    bank = _riccati.bank(model)
    M = solve_discrete_are(bank.A[0].T, bank.C[0].T, bank.W[0], bank.R[0])
    steady = slow.upsilon(np.eye(4), np.zeros((4, 4)), bank.C[0], bank.R[0], M)
    figures = _riccati.all_sequences(bank, 3)
    nothing = np.zeros((4, 4))
    for bound in (
        _riccati.floor(bank, figures),
        _riccati.ceiling(bank, nothing, model.initial_covariance),
        _riccati.ceiling(bank, nothing, 1e6 * np.eye(4)),
    ):
        assert bound.why == ""
        np.testing.assert_allclose(bound.matrix, steady, rtol=1e-7, atol=1e-7)


# ---- what becomes of errors ------------------------------------------------------------------


def test_equal_modes_forget_like_their_kalman_filter():
    """The rate is the spectral radius of (I - K C) A, 2-norms of powers included (1 %)."""
    model = model_of(
        "stability_cv_ct", "modes.CT={motion: constant_velocity, acceleration_std_m_s2: 0.1}"
    )
    found = examine(model, 2, 2000, 1)
    radius = np.abs(np.linalg.eigvals(found.run.closed_loop[-1, 0])).max()
    assert found.rate.per_step == pytest.approx(radius, rel=0.01)
    assert np.abs(found.spread).max() < 1e-12


def test_modes_that_never_change_forget_as_the_slower_does():
    model = model_of("stability_cv_ct", "transition_matrix=[[1, 0], [0, 1]]")
    found = examine(model, 2, 2000, 1)
    radii = np.abs(np.linalg.eigvals(found.run.closed_loop[-1])).max(axis=1)
    assert radii.max() > 1.05 * radii.min()
    assert found.rate.per_step == pytest.approx(radii.max(), rel=0.01)


def test_rates_know_no_units():
    """States in other units have other eigenvalues, the same rate and the same verdict."""
    model = model_of("stability_cv_ct")
    scale = np.diag([1e-3, 1.0, 1e-3, 60.0])  # km, m/s, km, m/min
    back = np.linalg.inv(scale)
    other = model._replace(
        state_transition=scale @ model.state_transition @ back,
        process_noise_covariance=scale @ model.process_noise_covariance @ scale,
        measurement_matrix=model.measurement_matrix @ back,
        initial_mean=scale @ model.initial_mean,
        initial_covariance=scale @ model.initial_covariance @ scale,
    )
    flight = _mixing.fly(model, 2000, 1)
    rates = []
    for one in (model, other):
        run = _mixing.interacting_filters(one, flight.measurements)
        rates.append(_mixing.simulated_rate(_mixing.contraction(run)).per_step)
        asked = examine(one, 4, 10, 1).conditions
        assert asked.met
        assert (asked.controllable_from, asked.observable_from) == (2, 2)
    assert rates[0] == pytest.approx(rates[1], rel=0.01)  # norms of the first and the last step


def lyapunov(covariances, errors):
    """V (48) and its parts V_j (51) at one step: covariances (r, n, n), errors (r, n)."""
    parts = np.einsum("ja,jab,jb->j", errors, np.linalg.inv(covariances), errors)
    return parts.max(), parts


def errors_of(run, rng):
    """e_j(k) of (18) from a random start, (n_steps + 1, r, n)."""
    errors = [rng.normal(size=run.covariances.shape[1:3])]
    for gamma, closed in zip(run.mixing, run.closed_loop, strict=True):
        errors.append(np.einsum("jab,jb->ja", closed, gamma @ errors[-1]))
    return np.array(errors)


def test_the_lyapunov_function_falls_as_certified():
    """V(k) (1 + c_1) <= V(k - 2) from when on the floor holds; starts drawn anew every 10 steps."""
    model = model_of("stability_cv_ct")
    found = examine(model, 10, 600, 5)
    assert found.certificate is not None
    rng = np.random.default_rng(1)
    run, c_1 = found.run, found.certificate.c_1
    for k0 in range(found.floor.from_step, 590, 10):
        part = _mixing.ImmRun(
            *(field[k0 : k0 + 11] for field in run[:3]), *(field[k0 : k0 + 10] for field in run[3:])
        )
        errors = errors_of(part, rng)
        V = [lyapunov(part.covariances[k], errors[k])[0] for k in range(11)]
        for k in range(2, 11):
            assert V[k] * (1 + c_1) <= V[k - 2]


@FEW
@given(SEEDS)
def test_the_lyapunov_function_falls_by_our_one_step_factor(seed):
    """V(k) <= rho V(k - 1) where B Q B' > 0, with C and R of each mode its own."""
    rng = np.random.default_rng(seed)
    model = random_model(rng, n_modes=3, n_x=3, n_y=1)
    found = examine(model, 2, 60, seed)
    if found.ceiling.matrix is None:  # as happens to one in twenty
        assert found.one_step_loss is None
        return
    rho = 1 - found.one_step_loss
    assert 0 < rho < 1
    errors = errors_of(found.run, rng)
    V = [lyapunov(found.run.covariances[k], errors[k])[0] for k in range(60)]
    for k in range(1, 60):  # what the ceiling is at a step bounds that step, before it settles too
        due = found.ceiling.path[min(k - 1, len(found.ceiling.path) - 1)]
        at_k = 1 - _riccati.one_step_loss(found.bank, due)
        assert V[k] <= at_k * V[k - 1] * (1 + 1e-9)
        if k > found.ceiling.from_step:
            assert at_k == rho


def test_the_one_step_factor_is_tight_for_numbers():
    """A = a, W = w: rho = a^2 X / (a^2 X + w), the larger of two modes."""
    bank = _riccati.Bank(
        np.array([[[2.0]], [[0.5]]]), np.array([[[3.0]], [[0.1]]]), np.ones((2, 1, 1)),
        np.ones((2, 1, 1)), ("a", "b"), ("x",),
    )  # fmt: skip
    expected = max(4 * 0.7 / (4 * 0.7 + 3), 0.25 * 0.7 / (0.25 * 0.7 + 0.1))
    assert 1 - _riccati.one_step_loss(bank, np.array([[0.7]])) == pytest.approx(expected)


def test_a_rate_and_its_error():
    """Independent growths: the error is that of a mean, within what 20 batches allow (3 sigma)."""
    rng = np.random.default_rng(4)
    rates = []
    for _ in range(200):
        logs = np.concatenate([[0.0], np.cumsum(-0.1 + 0.5 * rng.normal(size=2000))])
        rates.append(_mixing.simulated_rate(logs))
    per_step = np.array([rate.per_step for rate in rates])
    true_error = np.exp(-0.1) * 0.5 / np.sqrt(1800)
    errors = np.array([rate.standard_error for rate in rates])
    assert errors.mean() == pytest.approx(true_error, rel=0.08)
    assert per_step.std() == pytest.approx(true_error, rel=3 / np.sqrt(400))
    assert abs(per_step.mean() - np.exp(-0.1)) < 4 * true_error / np.sqrt(200)
    assert _mixing.simulated_rate(np.array([0.0])) is None
    assert _mixing.simulated_rate(np.array([0.0, -np.inf])).per_step == 0.0


def test_the_first_tenth_says_nothing_of_a_rate():
    """Errors that grow at first, and then fall by a tenth of their logarithm per step."""
    logs = np.concatenate([0.3 * np.arange(20), 5.7 - 0.1 * np.arange(1, 182)])
    rate = _mixing.simulated_rate(logs)
    assert rate.from_step == 20
    assert rate.per_step == pytest.approx(np.exp(-0.1), rel=1e-12)
    assert rate.known


def test_a_pace_that_drifts_is_no_rate():
    """Powers of k, and a change halfway; chance alone hardly ever looks so (none of 2,000)."""
    k = np.arange(1001.0)
    assert _mixing.simulated_rate(-np.log1p(k)).trend == "rising"
    assert _mixing.simulated_rate(-1e-4 * k**1.5).trend == "falling"
    assert not _mixing.simulated_rate(-np.log1p(k)).known
    assert _mixing.simulated_rate(-0.1 * k - 1e-6 * k**2).trend == "none"  # by 2 % of itself
    rng = np.random.default_rng(7)
    steady = np.cumsum(-0.1 + 0.5 * rng.normal(size=(2000, 1001)), axis=1)
    assert all(_mixing.simulated_rate(logs).known for logs in steady)
    drifting = _mixing.simulated_rate(-3 * np.log1p(k) + 0.01 * rng.normal(size=1001))
    assert drifting.trend == "rising"


def test_errors_that_die_as_one_over_k_have_no_time_constant():
    """A constant without noise: its filter averages, however long."""
    for steps in (500, 2000):
        found = analyse(load("observability_scalar", [f"analyses.stability.steps={steps}"]))
        assert found.conclusions[0].endswith("errors die away, but slower and slower: no rate.")
        simulated = row(found.tables["rates"], kind="simulated")
        assert (simulated["rate_per_step"], simulated["time_constant_steps"]) == (None, None)
        assert "slower and slower" in simulated["because"]
        assert set(found.table.columns["simulated_rate_per_step"]) == {None}
        labels = [line.label for line in found.charts[1].panels[0].lines]
        assert not any(label.startswith("simulated rate") for label in labels)


def test_a_simulation_may_be_too_short_for_a_rate(tmp_path):
    found = analyse(load("stability_cv_ct", ["analyses.stability.steps=100"]))
    assert "the simulation of 100 steps is too short for a rate." in found.conclusions[0]
    away = "modes.fast.state_transition=[[1.5, 0.5], [0, 2]]"
    found = analyse(scenario(tmp_path, CHAIN, away))
    assert "of its 5,000 steps, too short for a rate." in found.conclusions[0]
    assert row(found.tables["rates"], kind="simulated")["rate_per_step"] is None


def paced(trend, *halves):
    """The words for a simulation of 200 steps whose halves go at these paces."""
    found = examine(model_of("stability_cv_ct"), 2, 200, 1)
    return no_rate(found._replace(rate=_mixing.Rate(0.9, 0.01, 20, trend, halves)))


def test_a_pace_that_drifts_has_words():
    assert paced("none", -0.1, -0.1) == ""
    assert paced("rising", -0.2, -0.1).endswith("but slower and slower: no rate")
    assert paced("falling", -0.1, -0.2).endswith("faster and faster: no rate")
    assert "in the simulation's later half errors don't die" in paced("rising", -0.2, 0.1)
    assert "in the later half only" in paced("falling", 0.1, -0.2)


def test_the_bounds_that_are_drawn_are_those_due(reference_case):
    """The settled floor of the reference case is a bound from step 202 on, beyond the figure."""
    for panel, floor in zip(reference_case.charts[0].panels, (17.197, 0.78226) * 2, strict=True):
        (band,) = panel.bands
        assert band.x[0] == 2
        assert band.low[0] < 0.2
        assert (np.diff(band.low) >= -1e-12).all()
        assert band.low[-1] == pytest.approx(floor, rel=1e-2)
        for line in panel.lines:
            assert line.y.max() <= panel.y_limits[1]
            assert (line.y[2:] >= band.low).all()
            assert (line.y[2:] <= band.high).all()


def test_a_ceiling_alone_is_drawn_as_a_reference():
    found = analyse(load("stability_embedded_cv", ["analyses.stability.steps=200"]))
    for panel in found.charts[0].panels:
        assert not panel.bands
        assert [(line.label, line.reference) for line in panel.lines] == [
            ("CV", False),
            ("CA", False),
            ("ceiling", True),
        ]
        ceiling = panel.lines[2].y
        assert max(line.y.max() for line in panel.lines[:2]) <= panel.y_limits[1] < ceiling[0]
        assert ceiling[0] > ceiling[-1]
        assert all((line.y <= ceiling).all() for line in panel.lines[:2])


def test_certified_curves_hold_up_to_a_factor():
    certified = {
        line.label
        for name in ("stability_cv_ct", "stability_ca")
        for line in analyse(load(name, ["analyses.stability.steps=200"])).charts[1].panels[0].lines
        if line.label.startswith(("certified", "one-step"))
    }
    assert len(certified) == 2
    assert all(label.endswith(", up to a constant factor") for label in certified)


def test_a_flight_is_drawn_from_the_banks_own_chain():
    """Transitions within 4 standard errors; noise against its covariance within 5."""
    model = random_model(np.random.default_rng(6), n_modes=3, n_x=2)
    steps = 20_000
    flight = _mixing.fly(model, steps, 9)
    flow = model.transition_matrix[0]
    for i in range(3):
        after = flight.modes[1:][flight.modes[:-1] == i]
        for j in range(3):
            error = np.sqrt(flow[i, j] * (1 - flow[i, j]) / len(after))
            assert abs((after == j).mean() - flow[i, j]) < 4 * error
    for j in range(3):
        here = np.flatnonzero(flight.modes[1:] == j) + 1
        noise = (
            flight.states[here]
            - flight.states[here - 1] @ model.state_transition[0, j].T
            - model.input_effect[0, j]
        )
        seen = flight.measurements[here] - flight.states[here] @ model.measurement_matrix[j].T
        for draws, covariance in (
            (noise, model.process_noise_covariance[0, j]),
            (seen, model.measurement_noise_covariance[j]),
        ):
            variances = np.diag(covariance)
            error = np.sqrt((covariance**2 + np.outer(variances, variances)) / len(draws))
            assert (np.abs(draws.T @ draws / len(draws) - covariance) < 5 * error).all()


def test_the_same_seed_gives_the_same_findings():
    model = model_of("stability_cv_ct")
    first, again, other = (examine(model, 2, 50, seed).logs for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


# ---- the lemmas ------------------------------------------------------------------------------


def test_lemma_1_is_no_bound():
    """Of 2,000 random time-invariant two-state systems some 9 % break each (4 standard errors)."""
    rng = np.random.default_rng(1)
    broken = np.zeros((2000, 2), dtype=bool)
    for trial in range(2000):
        A, G, H = rng.normal(size=(2, 2)), rng.normal(size=(2, 1)), rng.normal(size=(1, 2))
        A_, W, C, R = A[None], (G @ G.T)[None], H[None], np.ones((1, 1, 1))
        k1, k2, k3, k4 = slow.kappas(A_, W, C, R, 2)
        P = np.eye(2) * 10 ** rng.uniform(-4, 4)
        for k in range(12):
            P = slow.upsilon(A, W[0], H, R[0], P)
            if k >= 1:
                least, most = slow.extremes(P)
                broken[trial, 0] |= least < k1 / (1 + k1 * k4) * (1 - 1e-6)
                broken[trial, 1] |= most > (1 / k3 + k2) * (1 + 1e-6)
    error = np.sqrt(0.09 * 0.91 / 2000)
    assert (np.abs(broken.mean(axis=0) - 0.088) < 4 * error).all(), broken.mean(axis=0)


@MANY
@given(SEEDS)
def test_lemma_2_mixing_first_gives_more(seed):
    rng = np.random.default_rng(seed)
    n, r = int(rng.integers(1, 5)), int(rng.integers(1, 5))
    P = [definite(rng, n, 1.5) for _ in range(r)]
    gamma, Q, R = weights(rng, r), semidefinite(rng, n), semidefinite(rng, n)

    def after(X):
        return np.linalg.inv(np.linalg.inv(X + Q) + R)

    first = after(sum(g * X for g, X in zip(gamma, P, strict=True)))
    assert_below(sum(g * after(X) for g, X in zip(gamma, P, strict=True)), first)


@MANY
@given(SEEDS)
def test_lemma_4_no_other_gain_does_better(seed):
    """Over five steps, from a start that is no smaller, with any gains."""
    rng = np.random.default_rng(seed)
    r, n, steps = 3, 3, 5
    bank = _riccati.bank(random_model(rng, n_modes=r, n_x=n))
    P = [definite(rng, n, 1.0) for _ in range(r)]
    T = [X + semidefinite(rng, n) for X in P]

    def chi(i, X, K, spread):  # (43)
        M = bank.A[i] @ X @ bank.A[i].T + spread + bank.W[i]
        keep = np.eye(n) - K @ bank.C[i]
        return keep @ M @ keep.T + K @ bank.R[i] @ K.T, M

    for _ in range(steps):
        gammas = [weights(rng, r) for _ in range(r)]
        spreads = [semidefinite(rng, n) for _ in range(r)]
        best, other = [], []
        for i in range(r):
            M = chi(i, P[i], np.zeros((n, 2)), spreads[i])[1]
            K = M @ bank.C[i].T @ np.linalg.inv(bank.C[i] @ M @ bank.C[i].T + bank.R[i])  # (40)
            best.append(chi(i, P[i], K, spreads[i])[0])
            any_gain = K + 0.3 * rng.normal(size=K.shape)
            other.append(chi(i, T[i], any_gain, spreads[i])[0])
        P = [sum(g * X for g, X in zip(gammas[j], best, strict=True)) for j in range(r)]
        T = [sum(g * X for g, X in zip(gammas[j], other, strict=True)) for j in range(r)]
        for smaller, larger in zip(P, T, strict=True):
            assert_below(smaller, larger)


@MANY
@given(SEEDS)
def test_lemma_6_and_7_of_mixed_vectors(seed):
    rng = np.random.default_rng(seed)
    n, r = int(rng.integers(1, 5)), int(rng.integers(1, 5))
    M = [definite(rng, n, 1.5) for _ in range(r)]
    gamma, y = weights(rng, r), rng.normal(size=(r, n))
    mean = gamma @ y
    mixed = np.linalg.inv(sum(g * X for g, X in zip(gamma, M, strict=True)))
    apart = sum(g * v @ np.linalg.inv(X) @ v for g, v, X in zip(gamma, y, M, strict=True))
    assert mean @ mixed @ mean <= apart * (1 + 1e-9)  # (50)
    one = semidefinite(rng, n)
    apart = sum(g * v @ one @ v for g, v in zip(gamma, y, strict=True))
    assert mean @ one @ mean <= apart * (1 + 1e-9) + 1e-12


@pytest.mark.parametrize("name", ["stability_cv_ct", "stability_ca", "random"])
def test_lemma_8_along_simulated_runs(name):
    """(54), mode by mode and step by step."""
    rng = np.random.default_rng(3)
    model = random_model(rng, n_x=4) if name == "random" else model_of(name)
    z = _mixing.fly(model, 60, 2).measurements
    run, history = _mixing.interacting_filters(model, z), slow.imm(model, z)
    A, C = model.state_transition[0], model.measurement_matrix
    e = rng.normal(size=run.means.shape[1:]) * np.sqrt(np.diag(model.initial_covariance))
    _, before = lyapunov(run.covariances[0], e)
    for k, (P, M, gamma, _, _) in enumerate(history):
        mixed = gamma @ e
        after = np.empty_like(e)
        for j in range(len(A)):
            y = A[j] @ mixed[j]  # (52)
            after[j] = P[j] @ np.linalg.solve(M[j], y)  # (20)
            u = after[j] - y  # (53)
            seen = C[j] @ after[j]
            lost = seen @ np.linalg.solve(model.measurement_noise_covariance[j], seen)
            lost += u @ np.linalg.solve(M[j], u)
            V = after[j] @ np.linalg.solve(P[j], after[j])
            allowed = gamma[j] @ before
            assert V + lost <= allowed * (1 + 1e-7)
        e = after
        _, before = lyapunov(run.covariances[k + 1], e)


@MANY
@given(SEEDS)
def test_lemma_4_of_hwang_2003(seed):
    """||A^t|| <= k(A) alpha(A)^t of distinct eigenvalues, k the condition of the eigenvectors."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(3, 3))
    values, vectors = np.linalg.eig(A)
    if min(abs(values[i] - values[j]) for i in range(3) for j in range(i)) < 1e-3:
        return  # too near to one that isn't distinct for the eigenvectors' digits
    condition = np.linalg.norm(vectors, 2) * np.linalg.norm(np.linalg.inv(vectors), 2)
    for t in range(12):
        norm = np.linalg.norm(np.linalg.matrix_power(A, t), 2)
        assert norm <= condition * np.abs(values).max() ** t * (1 + 1e-9)


@MANY
@given(SEEDS)
def test_lemma_5_of_hwang_2003(seed):
    """Resets x -> a x + b at least beta decays by eta apart: x falls by mu = a^(1/beta) eta < 1.

    What remains is at most b / (1 - mu); between resets x only falls.
    """
    rng = np.random.default_rng(seed)
    eta, a, b = rng.uniform(0.1, 0.95), rng.uniform(1.0, 5.0), rng.uniform(0.0, 3.0)
    beta = max(int(np.ceil(np.log(a) / -np.log(eta) * rng.uniform(1.02, 3.0))), 2)
    mu = a ** (1 / beta) * eta
    assert mu < 1
    x = x0 = rng.uniform(0.0, 100.0)
    k = 0
    for _ in range(20):
        for _ in range(beta + int(rng.integers(0, 4))):
            x, k = eta * x, k + 1
            assert x <= (mu**k * x0 + b / (1 - mu)) * (1 + 1e-12)
        x = a * x + b
        assert x <= (mu**k * x0 + b / (1 - mu)) * (1 + 1e-12)
