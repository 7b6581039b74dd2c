"""Scores and tallies against plain loops, run by run and step by step."""

import math

import numpy as np
import pytest

from hybridtrack.estimators import Estimates
from hybridtrack.scoring import Given, Names, all_below, as_measured, blank_sheet
from hybridtrack.simulation import Scans, TruthSpan
from hybridtrack.statistics import POSITION, POSITION_AT_SCANS, QUANTITIES
from hybridtrack.tallies import BINS, DIFFERENCE, Tally, Totals, add_to_step

ROUNDING = 1e-12  # relative: some 1e2 operations of 1e-16, a margin of 100


# ---- scores ----------------------------------------------------------------------------------

TRUTH_STATES = ("x", "vx", "y", "vy")


def span(rng, *, n_modes=2, steps=6, lanes=5, truth_lanes=None, states=6, likelihoods=True):
    """A span of scans and of estimates, all random."""
    wide = lanes if truth_lanes is None else truth_lanes
    truth = TruthSpan(
        rng.normal(size=(steps, 4, wide)),
        rng.integers(0, n_modes, size=(steps, wide)),
        np.full((steps, wide), np.inf),
    )
    probabilities, weights = rng.random((2, steps, n_modes, lanes))
    estimates = Estimates(
        mean=rng.normal(size=(steps, states, lanes)),
        mode_probabilities=probabilities / probabilities.sum(axis=1, keepdims=True),
        mode_likelihoods=(weights / weights.sum(axis=1, keepdims=True))[: steps * likelihoods],
        covariance=np.empty((0, 0, lanes)),
    )
    return Scans(truth, rng.normal(size=(steps, 2, lanes))), estimates


def foreseen(scans, estimates, rng):
    """The same with the truth's last mode and what an estimator and its chain say of it."""
    final = (rng.random(scans.truth.mode.shape) < 0.5).astype(float)
    steps, _, lanes = estimates.mean.shape
    told = {
        "final_mode_probability": rng.random((steps, lanes)),
        "final_mode_prior": rng.random((steps, 1)),
    }
    return scans._replace(truth=scans.truth._replace(final=final)), estimates._replace(**told)


def slow_scores(scans, estimates, names):
    """Every quantity of one run and one step, run by run, step by step, mode by mode."""
    steps, _, lanes = estimates.mean.shape
    found = {}

    def note(quantity, k, run, value):
        found.setdefault(quantity, np.full((steps, lanes), np.nan))[k, run] = value

    for k in range(steps):
        for run in range(lanes):
            here = min(run, scans.truth.state.shape[2] - 1)
            truth = dict(zip(names.truth_states, scans.truth.state[k, :, here], strict=True))
            ours = dict(zip(names.states, estimates.mean[k, :, run], strict=True))
            for quantity, states in (
                ("position_squared_error_m2", ("x", "y")),
                ("velocity_squared_error_m2_s2", ("vx", "vy")),
            ):
                shared = [s for s in states if s in truth and s in ours]
                if shared and all(math.isfinite(ours[s]) for s in shared):
                    note(quantity, k, run, sum((ours[s] - truth[s]) ** 2 for s in shared))
            if "position_squared_error_m2" in found:
                missed = np.isnan(scans.measurements[k, :, run]).any()
                error = found["position_squared_error_m2"][k, run]
                note(POSITION_AT_SCANS, k, run, math.nan if missed else error)
            p = dict(zip(names.modes, estimates.mode_probabilities[k, :, run], strict=True))
            j = scans.truth.mode[k, here]
            mode = names.truth_modes[j] if j >= 0 else None
            known = mode in p and not any(math.isnan(v) for v in p.values())
            if known:
                note("mode_correct", k, run, float(max(p, key=p.get) == mode))
                half = sum((v - (name == mode)) ** 2 for name, v in p.items()) / 2
                note("mode_brier", k, run, half)
                note("true_mode_probability", k, run, p[mode])
            if len(estimates.final_mode_probability) and len(scans.truth.final):
                final = scans.truth.final[k, here]
                for name, told in (
                    ("final_mode_brier", estimates.final_mode_probability[k, run]),
                    ("final_mode_prior_brier", estimates.final_mode_prior[k, 0]),
                ):
                    note(name, k, run, (told - final) ** 2)
            if (
                len(estimates.mode_likelihoods)
                and not np.isnan(scans.measurements[k, :, run]).any()
            ):
                values = dict(zip(names.modes, estimates.mode_likelihoods[k, :, run], strict=True))
                first, second = sorted(values.values(), reverse=True)[:2]
                note("likelihood_distinctness", k, run, first - second)
                if known:
                    best_other = max(v for name, v in values.items() if name != mode)
                    note("advantage", k, run, values[mode] - best_other)
    return found


def tallied(scans, estimates, names, **options):
    """What a tally makes of each run and step: by quantity (n_steps, lanes), NaN where left out.

    Every step has a window to itself.
    """
    steps, _, lanes = estimates.mean.shape
    sheet = options.pop("sheet", None) or blank_sheet(steps, lanes)
    given = Given(
        likelihoods=len(estimates.mode_likelihoods) > 0,
        final=len(estimates.final_mode_probability) > 0,
        **options,
    )
    windows = tuple(map(str, range(steps)))
    tally = Tally(names, steps, windows, sheet, lanes, given)
    tally.add(0, scans, np.eye(steps, dtype=bool)[..., np.newaxis], estimates)
    found = {}
    for (window, quantity), (sums, numbers) in tally.sums():
        assert set(numbers.tolist()) <= {0.0, 1.0}
        values = found.setdefault(quantity, np.empty((steps, lanes)))
        values[int(window)] = np.where(numbers > 0, sums, np.nan)
    return found


def assert_scores(scans, estimates, names):
    """Scored by itself; the leading estimator's advantage is the sheet's."""
    sheet = blank_sheet(*estimates.mean.shape[::2])
    ours = tallied(scans, estimates, names, sheet=sheet, leads=True)
    expected = slow_scores(scans, estimates, names)
    advantage = expected.pop("advantage", None)
    kept = ours.pop("likelihood_advantage_kept", None)
    assert set(ours) == set(expected)
    for quantity, values in expected.items():
        np.testing.assert_allclose(ours[quantity], values, ROUNDING, ROUNDING)
    assert (kept is None) == (advantage is None)
    if advantage is not None:
        np.testing.assert_allclose(sheet.leading, advantage, ROUNDING, ROUNDING)
        np.testing.assert_array_equal(kept, np.where(np.isnan(advantage), np.nan, 1.0))
    alone = tallied(scans, estimates, names)
    assert set(alone) == set(expected)  # an advantage is kept only if another one's is known


RAW_NAMES = Names(TRUTH_STATES, (), ("x", "y"), ())
SIX_STATES = ("x", "vx", "ax", "y", "vy", "ay")


@pytest.mark.parametrize("truth_lanes", [None, 1])
@pytest.mark.parametrize("likelihoods", [True, False])
@pytest.mark.parametrize(
    ("truth_modes", "modes"),
    [
        (("a", "b"), ("a", "b")),
        (("a", "b"), ("b", "a")),
        (("a", "b", "c"), ("c", "a", "b")),
        (("a", "b", "c"), ("d", "b")),  # a and c are unknown to the estimator, d never occurs
    ],
)
@pytest.mark.parametrize("states", [SIX_STATES, ("vy", "ax", "y", "x", "ay", "vx")])
def test_scores_are_those_of_plain_loops(states, truth_modes, modes, likelihoods, truth_lanes):
    rng = np.random.default_rng(1)
    scans, estimates = span(rng, n_modes=3, truth_lanes=truth_lanes, likelihoods=likelihoods)
    scans = scans._replace(truth=scans.truth._replace(mode=scans.truth.mode % len(truth_modes)))
    estimates = estimates._replace(
        mode_probabilities=estimates.mode_probabilities[:, : len(modes)],
        mode_likelihoods=estimates.mode_likelihoods[:, : len(modes)],
    )
    assert_scores(scans, estimates, Names(TRUTH_STATES, truth_modes, states, modes))


def test_scores_in_a_hand_case():
    truth = TruthSpan(
        np.array([1.0, 2.0, 3.0, 4.0]).reshape(1, 4, 1), np.array([[1]]), np.array([[np.inf]])
    )
    estimates = Estimates(
        np.array([7.0, 4.0, 4.0, 3.0, 0.0, 0.0]).reshape(1, 6, 1),
        np.array([0.25, 0.75]).reshape(1, 2, 1),
        np.array([0.6, 0.4]).reshape(1, 2, 1),
        np.empty((0, 0, 1)),
    )
    states = ("y", "x", "vy", "vx", "ax", "ay")
    scans = Scans(truth, np.array([2.0, 0.0]).reshape(1, 2, 1))
    names, sheet = Names(TRUTH_STATES, ("a", "b"), states, ("a", "b")), blank_sheet(1, 1)
    quantities = tallied(scans, estimates, names, sheet=sheet, leads=True)
    assert {name: float(value[0, 0]) for name, value in quantities.items()} == {
        "position_squared_error_m2": 25.0,  # 3-4-5
        POSITION_AT_SCANS: 25.0,
        "velocity_squared_error_m2_s2": 1.0,
        "likelihood_distinctness": pytest.approx(0.2, rel=ROUNDING),
        "mode_correct": 1.0,
        "mode_brier": 0.0625,
        "true_mode_probability": 0.75,
        "likelihood_advantage_kept": 1.0,
    }
    assert sheet.leading[0, 0] == pytest.approx(-0.2, rel=ROUNDING)
    raw = tallied(scans, as_measured(scans.measurements), RAW_NAMES)
    assert {name: float(value[0, 0]) for name, value in raw.items()} == {
        "position_squared_error_m2": 10.0,
        POSITION_AT_SCANS: 10.0,
    }


@pytest.mark.parametrize("n_modes", [2, 3])
def test_missed_scans_unknown_modes_and_diverged_runs_are_left_out(n_modes):
    rng = np.random.default_rng(2)
    scans, estimates = span(rng, n_modes=n_modes)
    scans.measurements[0, 1, :3] = np.nan  # one component is enough
    scans.truth.mode[1, 1:4] = -1
    estimates.mean[2:, 3, 2] = np.nan
    estimates.mean[3, 4, 3] = np.inf
    estimates.mode_probabilities[4, :, 0] = np.nan
    modes = ("a", "b", "c")[:n_modes]
    assert_scores(scans, estimates, Names(TRUTH_STATES, modes, SIX_STATES, modes))


def test_an_error_too_large_to_square_is_infinite_without_a_warning():
    scans, estimates = span(np.random.default_rng(3))
    estimates.mean[0, 0, 0] = -1e200
    names = Names(TRUTH_STATES, (), SIX_STATES, ("a",))
    assert tallied(scans, estimates, names)["position_squared_error_m2"][0, 0] == np.inf


def test_the_brier_score_and_accuracy_at_their_bounds():
    scans, estimates = span(np.random.default_rng(4))
    sure = np.eye(2)[scans.truth.mode].swapaxes(1, 2)
    names = Names(TRUTH_STATES, ("a", "b"), SIX_STATES, ("a", "b"))
    right, wrong = (
        tallied(scans, estimates._replace(mode_probabilities=np.ascontiguousarray(p)), names)
        for p in (sure, 1.0 - sure)
    )
    assert (right["mode_correct"] == 1.0).all()
    assert (right["mode_brier"] == 0.0).all()
    assert (wrong["mode_correct"] == 0.0).all()
    assert (wrong["mode_brier"] == 1.0).all()


@pytest.mark.parametrize(
    ("truth_modes", "modes", "kept"),
    [
        ((), ("a", "b"), {"likelihood_distinctness"}),
        (("c",), ("a", "b"), {"likelihood_distinctness"}),
        (("a", "b"), ("a",), set()),
        (("a", "b"), (), set()),
    ],
)
def test_quantities_follow_from_the_names(truth_modes, modes, kept):
    scans, estimates = span(np.random.default_rng(5))
    scans = scans._replace(truth=scans.truth._replace(mode=np.full_like(scans.truth.mode, -1)))
    names = Names(TRUTH_STATES, truth_modes, SIX_STATES, modes)
    for compared in (False, True):
        quantities = tallied(scans, estimates, names, compared=compared)
        assert set(quantities) == kept | {
            "position_squared_error_m2",
            POSITION_AT_SCANS,
            "velocity_squared_error_m2_s2",
        }


def test_a_span_that_misses_every_known_mode_has_the_same_quantities():
    # Blocks are merged by quantity: none may come and go with the draw.
    scans, estimates = span(np.random.default_rng(6))
    names = Names(TRUTH_STATES, ("a", "c"), SIX_STATES, ("a", "b"))
    unknown = scans._replace(truth=scans.truth._replace(mode=np.ones_like(scans.truth.mode)))
    quantities = tallied(unknown, estimates, names, leads=True)
    assert set(quantities) == set(tallied(scans, estimates, names, leads=True))
    for quantity in ("mode_brier", "likelihood_advantage_kept"):
        assert np.isnan(quantities[quantity]).all()


def test_vectors_are_compared_on_the_axes_that_both_know():
    truth = TruthSpan(np.zeros((1, 2, 1)), np.zeros((1, 1), dtype=np.int64), np.zeros((1, 1)))
    scans, estimates = Scans(truth, np.zeros((1, 2, 1))), as_measured(np.full((1, 2, 1), 3.0))
    found = tallied(scans, estimates, Names(("x", "vx"), (), ("x", "y"), ()))
    assert found[POSITION].tolist() == [[9.0]]
    assert "velocity_squared_error_m2_s2" not in found
    both = ("heading", "rate")
    assert tallied(scans, estimates, Names(both, (), both, ())) == {}


def test_raw_errors_are_missing_where_the_scan_is():
    scans, _ = span(np.random.default_rng(7), truth_lanes=1)
    scans.measurements[2, 0, 1] = np.nan
    error = tallied(scans, as_measured(scans.measurements), RAW_NAMES)[POSITION]
    expected = ((scans.measurements - scans.truth.state[:, [0, 2]]) ** 2).sum(axis=1)
    np.testing.assert_allclose(error, expected, ROUNDING)
    assert np.isnan(error).sum() == 1


def test_an_advantage_is_kept_or_not_or_unknown():
    # 1e-10 less is rounding between two filters that are one in theory, 1e-8 less is less.
    own = np.array([0.5, 0.2, 0.3, 0.3 - 1e-10, 0.3 - 1e-8, np.nan, 0.1])
    leading = np.array([0.4, 0.3, 0.3, 0.3, 0.3, 0.1, np.nan])
    expected = [1.0, 0.0, 1.0, 1.0, 0.0, np.nan, np.nan]
    scans, estimates = span(np.random.default_rng(8), steps=1, lanes=7, truth_lanes=1)
    scans.truth.mode[:] = 0
    names = Names(TRUTH_STATES, ("a", "b"), SIX_STATES, ("a", "b"))

    def given(advantage):
        likelihoods = np.array([(1.0 + advantage) / 2.0, (1.0 - advantage) / 2.0])
        return estimates._replace(mode_likelihoods=likelihoods[np.newaxis])

    sheet = blank_sheet(1, 7)
    tallied(scans, given(leading), names, sheet=sheet, leads=True)
    found = tallied(scans, given(own), names, sheet=sheet, compared=True)
    np.testing.assert_array_equal(found["likelihood_advantage_kept"][0], expected)


def test_every_quantity_can_be_tallied():
    rng = np.random.default_rng(9)
    scans, estimates = foreseen(*span(rng), rng)
    names = Names(TRUTH_STATES, ("a", "b"), SIX_STATES, ("a", "b"))
    assert set(tallied(scans, estimates, names, leads=True)) == set(QUANTITIES)


@pytest.mark.parametrize("truth_lanes", [None, 1])
def test_the_last_mode_is_scored(truth_lanes):
    rng = np.random.default_rng(12)
    scans, estimates = foreseen(*span(rng, truth_lanes=truth_lanes), rng)
    names = Names(TRUTH_STATES, ("a", "b"), SIX_STATES, ("a", "b"))
    assert_scores(scans, estimates, names)
    # Of a truth without modes nothing is known, of an estimator that tells nothing neither.
    without = names._replace(truth_modes=())
    assert "final_mode_brier" not in tallied(scans, estimates, without)
    silent = estimates._replace(**{name: np.zeros((0, 1)) for name in TOLD})
    assert "final_mode_brier" not in tallied(scans, silent, names)


TOLD = ("final_mode_probability", "final_mode_prior")


@pytest.mark.parametrize("wide", [True, False])
def test_probabilities_of_the_last_mode_are_binned_in_the_first_window(wide):
    rng = np.random.default_rng(13)
    steps, lanes, runs = 40, 8, 5
    scans, estimates = foreseen(*span(rng, steps=steps, lanes=lanes), rng)
    estimates.final_mode_probability[3, 2] = np.nan
    estimates.final_mode_probability[4, :3] = (0.0, 1.0, 0.3)
    names = Names(TRUTH_STATES, ("a", "b"), SIX_STATES, ("a", "b"))
    held = rng.random((steps, 2, lanes if wide else 1)) < 0.7
    tally = Tally(names, steps, ("a", "b"), blank_sheet(steps, lanes), runs, Given(final=True))
    tally.add(0, scans, held, estimates)
    expected = np.zeros((3, BINS, runs))
    for k in range(steps):
        for run in range(runs):
            p, final = estimates.final_mode_probability[k, run], scans.truth.final[k, run]
            if held[k, 0, run if wide else 0] and not math.isnan(p):
                i = min(int(p * BINS), BINS - 1)
                expected[:, i, run] += (1.0, p, final)
    np.testing.assert_allclose(tally.final_bins, expected.reshape(-1, runs), ROUNDING)
    assert expected[0].sum() > 0


def test_errors_are_held_against_the_leading_ones_run_by_run():
    rng = np.random.default_rng(14)
    (scans, ours), (_, theirs) = span(rng, truth_lanes=1), span(rng)
    ours.mean[2, 0, 1] = np.nan
    names = Names(TRUTH_STATES, ("a", "b"), SIX_STATES, ("a", "b"))
    sheet, steps = blank_sheet(*ours.mean.shape[::2]), len(ours.mean)
    held = np.ones((steps, 1, 1), dtype=bool)
    series = {}
    for label, estimates, given in (
        ("leading", theirs, Given(leads=True)),
        ("other", ours, Given(paired=True)),
    ):
        tally = Tally(names, steps, ("all",), sheet, 5, given)
        tally.add(0, scans, held, estimates)
        series[label] = dict(tally.steps())
    assert not any(DIFFERENCE in name for name in series["leading"])
    for quantity in (POSITION, "velocity_squared_error_m2_s2"):
        errors = [slow_scores(scans, e, names)[quantity] for e in (ours, theirs)]
        difference = errors[0] - errors[1]
        found = series["other"][quantity + DIFFERENCE]
        present = (~np.isnan(difference)).sum(axis=1)
        assert found.n.tolist() == present.tolist()
        np.testing.assert_allclose(found.mean, np.nanmean(difference, axis=1), ROUNDING)
        spread = np.nanvar(difference, axis=1) * present
        np.testing.assert_allclose(found.squares, spread, 1e-10)


# ---- tallies ---------------------------------------------------------------------------------


@pytest.mark.parametrize("gaps", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("runs", [1, 9, 32])
def test_moments_of_a_step_are_those_of_the_runs_that_are_wanted(runs, gaps):
    rng = np.random.default_rng(10)
    row = 1e3 + rng.normal(size=32)
    row[rng.random(32) < gaps] = np.nan
    totals = Totals(*np.full((3, 2, 4), -7.0), *(np.empty(0),) * 4)
    finite = add_to_step(row, runs, totals, 1, 2)
    present = row[:runs][~np.isnan(row[:runs])]
    assert finite == (present.size == runs)
    mean = present.mean() if present.size else 0.0
    moments = [array[1, 2] for array in totals[:3]]
    expected = [present.size, mean, ((present - mean) ** 2).sum()]
    np.testing.assert_allclose(moments, expected, ROUNDING, 1e3**2 * 1e-15)  # of the values' size
    assert sum((array == -7.0).sum() for array in totals[:3]) == 3 * 7


@pytest.mark.parametrize("wide", [True, False])
def test_window_sums_and_step_moments_of_spans_are_those_of_the_whole(wide):
    rng = np.random.default_rng(11)
    steps, lanes, runs = 10, 8, 5
    scans, estimates = foreseen(*span(rng, steps=steps, lanes=lanes), rng)
    scans.measurements[rng.random(scans.measurements.shape) < 0.1] = np.nan
    estimates.mean[6:, 0, 3] = np.nan
    names = Names(TRUTH_STATES, ("a", "b"), SIX_STATES, ("a", "b"))
    held = rng.random((steps, 3, lanes if wide else 1)) < 0.5
    given = Given(likelihoods=True, final=True)
    tally = Tally(names, steps, ("a", "b", "c"), blank_sheet(steps, lanes), runs, given)
    for begin, end in ((0, 4), (4, 10)):
        part = Estimates(*(array[begin:end] for array in estimates))
        tally.add(begin, scans.cut(slice(begin, end)), held[begin:end], part)
    expected = slow_scores(scans, estimates, names)
    del expected["advantage"]
    for j, mode in enumerate(names.modes):
        expected[f"mode_probability:{mode}"] = estimates.mode_probabilities[:, j]
        missed = np.isnan(scans.measurements).any(axis=1)
        likelihoods = np.where(missed, np.nan, estimates.mode_likelihoods[:, j])
        expected[f"mode_likelihood:{mode}"] = likelihoods
    expected["final_mode_probability"] = estimates.final_mode_probability
    expected["final_mode_prior"] = np.repeat(estimates.final_mode_prior, lanes, axis=1)
    moments, sums = dict(tally.steps()), dict(tally.sums())
    assert set(moments) == set(expected) - {POSITION_AT_SCANS}
    series = {"final_mode_probability", "final_mode_prior"}
    assert {quantity for _, quantity in sums} == {q for q in expected if ":" not in q} - series
    for quantity, values in moments.items():
        wanted = expected[quantity][:, :runs]
        present = ~np.isnan(wanted)
        assert values.n.tolist() == present.sum(axis=1).tolist()
        for k in range(steps):
            row = wanted[k, present[k]]
            mean = row.mean() if row.size else 0.0
            np.testing.assert_allclose(values.mean[k], mean, ROUNDING, ROUNDING)
            squares = ((row - mean) ** 2).sum()
            np.testing.assert_allclose(values.squares[k], squares, ROUNDING, ROUNDING)
    for (window, quantity), (total, number) in sums.items():
        inside = held[:, "abc".index(window)] & ~np.isnan(expected[quantity])
        assert number.tolist() == inside.sum(axis=0)[:runs].tolist()
        wanted = np.where(inside, expected[quantity], 0.0).sum(axis=0)[:runs]
        np.testing.assert_allclose(total, wanted, ROUNDING, ROUNDING)


def test_all_below_a_limit():
    values = np.zeros((2, 3, 40))
    assert all_below(values, 1.0)
    for value in (1.0, -1.0, np.nan, -np.inf):
        values[1, 2, 39] = value
        assert not all_below(values, 1.0)
