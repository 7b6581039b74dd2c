"""The set-membership filter: against an oracle, under every noise and its adversary, in figures.

Figures are those of a reference written apart from this package, medians over 1,000 runs; they
agree within 5 %, which leaves room for other draws.
"""

import numpy as np
import pytest

from hybridtrack.errors import UserError
from hybridtrack.estimators import estimators
from reference_ellipsoids import plain_filter
from set_models import (
    PARALLEL,
    POINTS,
    RESET,
    aircraft,
    begun,
    filtered,
    opposed,
    simulated,
    truth,
)

RUNS = 1000
PLAIN: dict = {}
NOISES = {"ball": False, "persistent_ball": False, "persistent_box": True}


FILTERS = {"plain": PLAIN, "reset": RESET, "parallel": PARALLEL}


@pytest.fixture(scope="module")
def drawn():
    """By noise: the model, states and measurements of 1,000 runs."""
    models = {kind: aircraft(contains_box) for kind, contains_box in NOISES.items()}
    return {kind: (model, *simulated(model, kind, RUNS)) for kind, model in models.items()}


@pytest.fixture(scope="module")
def outcomes(drawn):
    """By filter and noise, over the same runs."""
    return {
        (name, kind): filtered(one[0], settings, *one[1:])
        for name, settings in FILTERS.items()
        for kind, one in drawn.items()
    }


@pytest.mark.parametrize("at", [None, 0, 2])
def test_it_is_the_oracle(at):
    """To the scan's own accuracy: a grid of 2e5 headings is off by 1e-11 of the remainder."""
    model = aircraft()
    states, y = simulated(model, "persistent_ball", 2, steps=30)
    settings = PLAIN if at is None else {**PARALLEL, "operating_points": [POINTS[at]]}
    ours = filtered(model, settings, states, y)
    for b in range(2):
        point = None if at is None else np.array(POINTS[at])
        start = (np.zeros(3), 0.01 * np.eye(3))
        Q, R = model.process_noise_shape, model.measurement_noise_shape
        centres, shapes = plain_filter(y[:, b], Q, R, *start, at=point)
        np.testing.assert_allclose(ours.centre[:, b], centres, rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours.shape[:, b], shapes, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("kind", NOISES)
def test_no_run_is_violated_under_noise_inside_its_bounds(outcomes, name, kind):
    assert not outcomes[name, kind].violated.any()


@pytest.mark.parametrize(
    ("name", "published"),
    [
        ("plain", (0.272, 0.286, 0.481)),
        ("reset", (0.292, 0.315, 0.559)),
        ("parallel", (0.349, 0.386, 1.434)),
    ],
)
def test_heading_bounds_are_the_reference_s(outcomes, name, published):
    for kind, wanted in zip(NOISES, published, strict=True):
        assert outcomes[name, kind].median_heading == pytest.approx(wanted, rel=0.05), kind


def test_the_plain_filter_beats_the_bank(outcomes):
    """By 7 to 16 % in the median, as the reference's; run by run, not once the bank is ahead."""
    for kind in NOISES:
        plain, bank = outcomes["plain", kind], outcomes["reset", kind]
        gain = bank.median_heading / plain.median_heading - 1
        assert 0.07 < gain < 0.17, kind
        assert (bank.heading.mean(axis=0) > plain.heading.mean(axis=0))[~bank.diverged].all()


@pytest.mark.parametrize("settings", [PLAIN, RESET, PARALLEL], ids=["plain", "reset", "parallel"])
def test_the_adversary_reaches_the_boundary_and_never_leaves(settings):
    """From anywhere in the first ellipsoid; what happens at the start counts as well."""
    found = opposed(aircraft(), settings, 128)
    assert not found.violated.any()
    assert 0.9 < found.largest <= 1 + 1e-9


def test_the_adversary_still_hurts_long_after_the_start():
    found = opposed(aircraft(), PLAIN, 128, spread="none")
    assert 0.9 < found.distance[50:].max() <= 1 + 1e-9


NO_REMAINDER = {"remainder": "printed_eq40"}  # about its own centre eq. 40 leaves none


def test_random_noise_hides_a_filter_without_remainder(drawn):
    """All looks right under random noise inside the ellipsoid; the adversary shows it."""
    model, states, y = drawn["ball"]
    assert not filtered(model, NO_REMAINDER, states, y).violated.any()
    assert opposed(model, NO_REMAINDER, 128).violated.any()


def test_the_printed_remainder_must_fail(drawn):
    """Negative control: eq. 20's box about the operating point, at least 80 % of the runs."""
    model, states, y = drawn["persistent_ball"]
    for settings in (PARALLEL, RESET):
        found = filtered(model, {**settings, "remainder": "printed_eq20"}, states, y)
        assert found.violated.mean() >= 0.8


def test_corner_noise_without_scaling_must_fail():
    """Negative control: a box is not inside its ellipsoid, at least 95 % of the runs."""
    model = aircraft(contains_box=False)
    states, y = simulated(model, "persistent_box", RUNS)
    for settings in (PLAIN, RESET):
        assert filtered(model, settings, states, y).violated.mean() >= 0.95


def test_a_bank_off_its_range_degrades(outcomes):
    """Under the scaled box some of the bank's runs diverge, none of the plain filter's.

    20 % alone and 12.5 % with reset, within 3 standard errors of two shares of 1,000 runs. That is
    of a bound 1,000 times the first; at 100 times it is twice as many.
    """
    shares = [outcomes[name, "persistent_box"].diverged.mean() for name in FILTERS]
    assert shares[0] == 0.0
    for ours, published in zip(shares[1:], (0.125, 0.20), strict=True):
        error = np.sqrt(2 * published * (1 - published) / RUNS)
        assert ours == pytest.approx(published, abs=3 * error)


def test_a_start_that_is_known_exactly_does_not_diverge():
    """A first ellipsoid of a millionth: what grows out of it is the noise's."""
    model = aircraft()._replace(initial_shape=1e-14 * np.eye(3))
    states, y = simulated(aircraft(), "ball", 16)
    assert not filtered(model, PLAIN, states, y).diverged.any()


def test_an_ekf_is_smaller_and_breaks_its_promise(drawn):
    model, states, y = drawn["persistent_ball"]
    found = filtered(model, PLAIN, states, y, "ekf")
    assert found.median_heading == pytest.approx(0.130, rel=0.05)
    assert found.violated.all()


def test_models_are_chosen_in_order_and_more_calmly_by_sigma(drawn, outcomes):
    """Otanez 2004, figure 6: with reset 1, 2, 3; the trace of Sigma switches no more often."""
    chosen = outcomes["reset", "ball"].chosen
    first = np.stack([np.argmax(chosen == i, axis=0) for i in range(3)])
    assert all((chosen == i).any(axis=0).all() for i in range(3))
    assert (np.diff(first, axis=0) > 0).all()
    model, states, y = drawn["ball"][0], *(part[:, :256] for part in drawn["ball"][1:])
    switches = {
        criterion: (
            np.diff(filtered(model, {**PARALLEL, "criterion": criterion}, states, y).chosen, axis=0)
            != 0
        ).sum()
        for criterion in ("trace_sigma", "trace_q", "determinant_q", "eigenvalue_q")
    }
    assert all(switches["trace_sigma"] <= number for number in switches.values())


CRITERIA = [
    f"{size}_{of}" for size in ("trace", "determinant", "eigenvalue") for of in ("sigma", "q")
]


@pytest.mark.parametrize("criterion", CRITERIA)
def test_every_criterion_chooses_the_smallest(criterion):
    """Of filters each alone, by NumPy's own trace, determinant and eigenvalues, step by step."""
    steps, runs = 180, 24
    model = aircraft()
    states, y = simulated(model, "ball", runs, steps=steps)
    bank = filtered(model, {**PARALLEL, "criterion": criterion}, states, y)
    size, of = criterion.split("_")
    measure = {
        "trace": lambda s: np.trace(s, axis1=-2, axis2=-1),
        "determinant": np.linalg.det,
        "eigenvalue": lambda s: np.linalg.eigvalsh(s)[..., -1],
    }[size]
    sizes = np.empty((len(POINTS), steps, runs))
    for i, point in enumerate(POINTS):
        alone = begun(model, {**PARALLEL, "operating_points": [point]}, runs)
        for k in range(steps):
            step = alone._advance_one(y[k])
            sizes[i, k] = measure(step.filters.shape if of == "sigma" else step.noise)
    np.testing.assert_array_equal(bank.chosen, sizes.argmin(axis=0))
    assert {0, 1} <= {*bank.chosen.flat}  # so that another order of points would be seen


def test_criteria_are_not_all_one():
    model = aircraft()
    states, y = simulated(model, "ball", 64, steps=180)
    chosen = [
        filtered(model, {**PARALLEL, "criterion": criterion}, states, y).chosen.tobytes()
        for criterion in CRITERIA
    ]
    assert len({*chosen}) >= 5


def test_a_bank_of_one_point_is_the_same_parallel_and_reset():
    model = aircraft()
    states, y = simulated(model, "ball", 16, steps=80)
    one = [
        filtered(model, {"operation": op, "operating_points": POINTS[1:2]}, states, y)
        for op in ("bank_parallel", "bank_reset")
    ]
    np.testing.assert_array_equal(one[0].shape, one[1].shape)


@pytest.mark.parametrize("settings", [PLAIN, RESET], ids=["plain", "reset"])
def test_two_spans_are_one(settings):
    model = aircraft()
    _, y = simulated(model, "persistent_ball", 8, steps=60)
    y = np.ascontiguousarray(np.swapaxes(y, 1, 2))
    whole, parts = begun(model, settings, 8), begun(model, settings, 8)
    at_once = whole.advance(None, y).mean
    pieces = [parts.advance(None, part).mean.copy() for part in (y[:23], y[23:])]
    np.testing.assert_array_equal(at_once, np.concatenate(pieces))


@pytest.mark.parametrize("form", ["schweppe", "bertsekas"])
def test_both_forms_keep_the_truth_for_any_weights(form):
    """beta and rho are free in (0, 1): the guarantee doesn't depend on them."""
    model = aircraft()
    states, y = simulated(model, "persistent_ball", 64, steps=120, spread="sphere")
    generator = np.random.default_rng(5)
    for _ in range(6):
        beta, rho = (float(w) for w in generator.uniform(0.02, 0.6, 2))
        for settings in (PLAIN, RESET):
            chosen = {**settings, "form": form, "beta": beta, "rho": rho}
            assert not filtered(model, chosen, states, y).violated.any(), (beta, rho)
    for rule in ("trace", "determinant"):
        assert not filtered(model, {"form": form, "rho": rule}, states, y).violated.any()


def test_bertsekas_without_remainder_doesn_t_depend_on_the_measurements():
    """Affine dynamics: the shape is the same in all runs, only the level 1 - delta differs."""
    model = aircraft(dynamics=("x + .1*psi", "y", "psi + .005"))
    _, y = simulated(model, "ball", 16, steps=301)
    y = np.ascontiguousarray(np.swapaxes(y, 1, 2))
    running = begun(model, {"form": "bertsekas"}, 16)
    running.advance(None, y[:300])
    shape, level = running._filters.shape, running._filters.level
    np.testing.assert_allclose(shape, np.broadcast_to(shape[:1], shape.shape), rtol=1e-12)
    assert np.ptp(level) > 1e-3
    # And it settles: a steady state, where Schweppe's own shrinks and grows with the noise.
    before = np.diag(shape[0])
    running.advance(None, y[300:])
    assert np.abs(np.diag(running._filters.shape[0]) / before - 1).max() < 1e-3


def test_the_best_rho_is_no_worse_than_any_other():
    model = aircraft()
    states, y = simulated(model, "ball", 32, steps=1)
    best = filtered(model, {"rho": "trace"}, states, y).shape[0]
    for rho in np.linspace(0.02, 0.95, 40):
        other = filtered(model, {"rho": float(rho)}, states, y).shape[0]
        assert (np.trace(best, axis1=1, axis2=2) <= 1.001 * np.trace(other, axis1=1, axis2=2)).all()


def test_an_impossible_measurement_empties_the_set_and_says_so():
    """delta > 1: the noise broke its bounds; the prediction stands and the run is told."""
    model = aircraft()
    states, y = simulated(model, "none", 4, steps=3)
    y[1, 2] += 50.0
    found = filtered(model, PLAIN, states, y)
    assert found.empty.tolist() == [False, False, True, False]
    assert np.isfinite(found.shape).all()
    assert found.violated.tolist() == [False, False, True, False]


def test_a_missed_scan_only_predicts():
    model = aircraft()
    states, y = simulated(model, "ball", 4, steps=3)
    y[1, 1] = np.nan
    found = filtered(model, PLAIN, states, y)
    moved = found.centre[1, :, 2] - found.centre[0, :, 2] - 0.005
    assert abs(moved[1]) < 1e-15
    assert (np.abs(moved[[0, 2, 3]]) > 1e-9).all()
    assert not found.violated.any()


def test_a_nonlinear_sensor_keeps_the_truth():
    """Remainders of the measurement too, by interval arithmetic."""
    model = aircraft(measurement=("sqrt((x + 20)**2 + (y - 15)**2)", "y + .3*sin(psi)"))
    states, y = simulated(model, "persistent_ball", 16, steps=60, spread="ball")
    assert not filtered(model, PLAIN, states, y).violated.any()
    without = model._replace(measurement_remainder=aircraft().measurement_remainder)
    smaller = filtered(without, PLAIN, states, y)
    assert smaller.heading.mean() < filtered(model, PLAIN, states, y).heading.mean()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"operating_points": POINTS}, "has no 'operating_points'"),
        ({"operation": "bank_reset"}, "needs 'operating_points'"),
        ({**RESET, "operating_points": [[0.0, 1.0]]}, "has 2 numbers"),
        ({"rho": 1.0}, "'rho' is 1"),
        ({"beta": 0.0}, "'beta' is 0"),
    ],
)
def test_settings_that_fit_nothing_are_refused(settings, said):
    estimator = estimators()["esmf"]
    with pytest.raises(UserError, match=said):
        estimator.prepare(estimator.settings(**settings), aircraft())


def test_the_truth_without_noise_ends_where_the_paper_says():
    model = aircraft()
    end = model.course(truth(model, "none").start, 314)[-1]
    np.testing.assert_allclose(end, [20, 20, np.pi / 2], atol=0.1)
