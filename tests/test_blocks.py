"""A block of runs against a slow path: every lane filtered by the reference and scored by hand."""

import threading

import numpy as np
import pytest

import reference
from hybridtrack import blocks, estimators
from hybridtrack.blocks import inside, run_block
from hybridtrack.config import Window
from hybridtrack.errors import Stopped
from hybridtrack.experiment import run as run_experiment
from hybridtrack.groups import RAW, TRUTH, BlockTask, merge, summarise
from hybridtrack.outcomes import paired
from hybridtrack.roots import square_root
from hybridtrack.simulation import (
    BLOCK_RUNS,
    BlockSimulation,
    Purpose,
    TruthSpan,
    stream,
)
from hybridtrack.statistics import POSITION_AT_SCANS
from models import RANDOM, SMALL, scenario

# The kernels and the reference order their operations differently: 1e-10 per filter (test_bank),
# and a factor ten for what squares and sums make of it.
CLOSE = {"rtol": 1e-9, "atol": 1e-9}


def block_of(experiment, runs, tracks=0, block=0):
    return run_block(experiment, BlockTask(0, block, runs, tracks), threading.Event())


# ---- the slow path ---------------------------------------------------------------------------


def slow_start(experiment, case, z, truth_start, run, bank=None):
    """Mean, covariance and the number of scans used up, by the scenario's words.

    After two scans each bank has the noise that it expects of its modes at the start.
    """
    states = experiment.bank.state_names
    initial = experiment.initial
    if initial.two_point:
        T = case.times_s[2] - case.times_s[1]
        bank = bank or experiment.bank
        r = sum(
            share * mode.measurement_noise_covariance[0, 0]
            for share, mode in zip(bank.initial_mode_probabilities, bank.modes, strict=True)
        )
        assert states == ("x", "vx")
        mean = np.array([z[1, 0], (z[1, 0] - z[0, 0]) / T])
        return mean, r * np.array([[1, 1 / T], [1 / T, 2 / T**2]]), 2
    mean = np.array([truth_start.get(name, 0.0) for name in states])
    draws = stream(experiment.seed, 0, 0, Purpose.INITIAL_ESTIMATE)
    draw = draws.standard_normal((len(states), BLOCK_RUNS))[:, run]
    return mean + square_root(initial.covariance) @ draw, initial.covariance, 0


def slow_filter(experiment, label, model, z, mean, true_modes):
    """The reference's history for one estimator of the scenario."""
    chosen = next(c for c in experiment.estimators if c.label == label)
    estimator, settings, options = chosen.estimator, chosen.settings, {}
    if estimator.name == "kalman":
        model = model.only(settings.mode)
    if estimator.name == "mmae":
        options = {"mixing": False}
    if estimator.name == "genie":
        options = {"known": true_modes}
    if estimator.name == "rmimm":
        floor, recursive = settings.residual_floor_m, settings.residual_error == "recursive"
        options = {"rmimm": {"floor": floor, "recursive": recursive, "common": False}}
    return reference.bank(model, z, initial_mean=mean, **options)


def slow_scores(truth, names, true_mode, estimate, z):
    """Quantities of one step of one run; the likelihood's advantage for later."""
    mean, _, probabilities, likelihoods = estimate
    scores = {}
    for kind, quantity in (
        ("", "position_squared_error_m2"),
        ("v", "velocity_squared_error_m2_s2"),
    ):
        scores[quantity] = sum(
            (mean[names.index(kind + axis)] - truth[kind + axis]) ** 2
            for axis in "xy"
            if kind + axis in names
        )
    advantage = np.nan
    if len(probabilities) > 1:
        scores["mode_correct"] = float(np.argmax(probabilities) == true_mode)
        scores["mode_brier"] = 0.5 * sum(
            (p - (j == true_mode)) ** 2 for j, p in enumerate(probabilities)
        )
        scores["true_mode_probability"] = probabilities[true_mode]
        scores["likelihood_distinctness"] = np.nan
        if not np.isnan(z).any():
            first, second = sorted(likelihoods)[::-1][:2]
            scores["likelihood_distinctness"] = first - second
            advantage = likelihoods[true_mode] - max(np.delete(likelihoods, true_mode))
    return scores, advantage


def slow_since_switch(times_s, mode, k, random):
    """Seconds from the start of the step that began the present mode to step k's end."""
    first = 1 if random else 2  # a fixed truth has no mode before its first step
    for step in range(k, first - 1, -1):
        if mode[step] != mode[step - 1]:
            return times_s[k] - times_s[step - 1]
    return np.inf


def slow_inside(window, time_s, scan, mode, since_switch_s):
    """A window's conditions, one by one."""
    conditions = [window.from_s <= time_s <= window.until_s, scan > window.skip_scans]
    if window.mode is not None:
        conditions.append(mode == window.mode)
    if window.after_switch_s is not None:
        conditions.append(window.after_switch_s < since_switch_s < np.inf)  # there was a switch
    if window.within_switch_s is not None:
        conditions.append(since_switch_s <= window.within_switch_s)
    return all(conditions)


def simulated(experiment, runs):
    """The block's simulation in one span: truth, modes with that at k = 0, measurements."""
    case = experiment.cases[0]
    simulation = BlockSimulation(case, experiment.sensor, experiment.seed, 0, 0, runs)
    names = simulation.state_names
    start = simulation.initial_state
    random = simulation.fixed is None
    first_mode = simulation._runs.mode.copy() if random else np.full(runs, -1)
    truth, z = simulation.advance(slice(0, len(case.times_s) - 1))
    starts = [
        {n: start[e, b if start.shape[1] > 1 else 0] for e, n in enumerate(names)}
        for b in range(runs)
    ]
    lanes = [b if truth.mode.shape[1] > 1 else 0 for b in range(runs)]
    modes = [np.concatenate([[first_mode[b]], truth.mode[:, lanes[b]]]) for b in range(runs)]
    states = [
        [dict(zip(names, x, strict=True)) for x in truth.state[:, :, lanes[b]]] for b in range(runs)
    ]
    return starts, states, modes, np.moveaxis(z, -1, 0)


def slow_block(experiment, runs):
    """values[label, quantity] (runs, steps), held[window] (runs, steps), estimates by label."""
    case = experiment.cases[0]
    n = len(case.times_s) - 1
    n_x = len(experiment.bank.state_names)
    starts, states, modes, scans = simulated(experiment, runs)
    values, estimates = {}, {}
    held = {w.name: np.zeros((runs, n), dtype=bool) for w in experiment.windows}

    def put(label, quantity, b, k, value):
        array = values.setdefault((label, quantity), np.full((runs, n), np.nan))
        array[b, k] = value

    for b in range(runs):
        z = scans[b]
        mean, covariance, used = slow_start(experiment, case, z, starts[b], b)
        step_s = np.diff(case.times_s)[used:]
        model = experiment.bank.discretise(step_s, np.zeros(n_x), covariance)
        advantages = {}
        for chosen in experiment.estimators:
            _, own, _ = slow_start(experiment, case, z, starts[b], b, chosen.bank)
            own_model = model._replace(initial_covariance=own)
            known = modes[b][used + 1 :]
            history = slow_filter(experiment, chosen.label, own_model, z[used:], mean, known)
            estimates[chosen.label, b] = history
            for k, estimate in enumerate(history, start=used):
                scores, advantages[chosen.label, k] = slow_scores(
                    states[b][k], experiment.bank.state_names, modes[b][k + 1], estimate, z[k]
                )
                for quantity, value in scores.items():
                    put(chosen.label, quantity, b, k, value)
        for (label, k), advantage in advantages.items():
            other = advantages[experiment.compare_with, k]
            if not np.isnan(advantage + other):
                kept = float(advantage > other or np.isclose(advantage, other, rtol=0, atol=1e-9))
                put(label, "likelihood_advantage_kept", b, k, kept)
        for k in range(used, n):  # the scans used up by the start are no one's to be scored
            error = sum(
                (z[k, m] - states[b][k][axis]) ** 2 for m, axis in enumerate("xy"[: z.shape[1]])
            )
            put(RAW, "position_squared_error_m2", b, k, error)
            since = slow_since_switch(case.times_s, modes[b], k + 1, modes[b][0] >= 0)
            for w in experiment.windows:
                held[w.name][b, k] = slow_inside(
                    w, case.times_s[k + 1], k + 1, modes[b][k + 1], since
                )
    return values, held, estimates


def with_genie(text):
    return text.replace("compare_with:", "  genie: {type: genie}\ncompare_with:")


SCENARIOS = {
    "legs, even steps": with_genie(SMALL),
    "chain, uneven steps, two-point start": with_genie(RANDOM),
}


def test_the_genie_is_told_modes_by_name(tmp_path):
    """The truth counts its modes the other way round."""
    own = """    modes:
      rough: {motion: constant_velocity, acceleration_psd_m2_s3: 60}
      calm: {motion: constant_velocity, acceleration_psd_m2_s3: 0.1}
    mean_sojourn_s: {rough: 8, calm: 30}
sensor:"""
    text = with_genie(RANDOM).replace("sensor:", own, 1)
    experiment = scenario(tmp_path, text, "monte_carlo.runs=40")
    assert experiment.truth_modes == ("rough", "calm")
    assert experiment.bank.names == ("calm", "rough")
    result = block_of(experiment, 40)
    correct, steps = result.sums["genie", "all", "mode_correct"]
    np.testing.assert_array_equal(correct, steps)
    assert steps.min() > 0


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_block_equals_the_slow_path(tmp_path, name):
    experiment = scenario(tmp_path, SCENARIOS[name])
    runs = experiment.runs
    result = block_of(experiment, runs)
    values, held, _ = slow_block(experiment, runs)
    scored = {key for key in result.steps if ":" not in key[1]}
    assert scored == {key for key, array in values.items() if not np.isnan(array).all()}
    for (label, quantity), array in values.items():
        if (label, quantity) not in scored:
            continue
        moments = result.steps[label, quantity]
        known = ~np.isnan(array)
        np.testing.assert_array_equal(moments.n, known.sum(axis=0))
        total = np.where(known, array, 0.0).sum(axis=0)
        mean = total / np.maximum(known.sum(axis=0), 1)
        np.testing.assert_allclose(moments.mean, mean, **CLOSE)
        squares = np.where(known, (array - mean) ** 2, 0.0).sum(axis=0)
        np.testing.assert_allclose(moments.squares, squares, rtol=1e-8, atol=1e-8)  # differences
        for window, mask in held.items():
            sums, numbers = result.sums[label, window, quantity]
            here = known & mask
            np.testing.assert_array_equal(numbers, here.sum(axis=1))
            np.testing.assert_allclose(sums, np.where(here, array, 0.0).sum(axis=1), **CLOSE)
    assert all((status == 0).all() for status in result.status.values())
    for window, mask in held.items():
        assert mask.any()
        assert window == "all" or not mask.all()


@pytest.mark.parametrize("name", SCENARIOS)
def test_tracks_and_mode_series_equal_the_slow_path(tmp_path, name):
    experiment = scenario(tmp_path, SCENARIOS[name])
    runs = experiment.runs
    result = block_of(experiment, runs, tracks=2)
    _, _, estimates = slow_block(experiment, runs)
    _, states, modes, scans = simulated(experiment, runs)
    used = 2 if experiment.initial.two_point else 0
    expected = {}
    for run in range(2):
        for e, axis in enumerate("xy"[: scans.shape[2]]):
            expected[run, "measurement", axis] = scans[run, :, e]
        for state in states[run][0]:
            expected[run, TRUTH, state] = [x[state] for x in states[run]]
        expected[run, TRUTH, "mode"] = modes[run][1:]
        for chosen in experiment.estimators:
            means, covariances, probabilities, _ = zip(*estimates[chosen.label, run], strict=True)
            front = np.full(used, np.nan)
            for e, state in enumerate(experiment.bank.state_names):
                expected[run, chosen.label, state] = np.append(front, np.array(means)[:, e])
                std = np.sqrt(np.array(covariances)[:, e, e])
                expected[run, chosen.label, f"std:{state}"] = np.append(front, std)
            for j, mode in enumerate(experiment.bank.names if len(probabilities[0]) > 1 else ()):
                series = np.append(front, np.array(probabilities)[:, j])
                expected[run, chosen.label, f"mode_probability:{mode}"] = series
    kept = {(t.run, t.estimator, t.quantity): t.values for t in result.tracks}
    assert kept.keys() == expected.keys()
    for key, series in kept.items():
        np.testing.assert_allclose(series, expected[key], err_msg=str(key), **CLOSE)
    for j, mode in enumerate(experiment.bank.names):
        share = np.mean([m[1:] == j for m in modes], axis=0)
        moments = result.steps[TRUTH, f"mode_probability:{mode}"]
        np.testing.assert_allclose(moments.mean, share, rtol=0, atol=1e-15)  # rounding of a mean
        every = np.array([[e[2][j] for e in estimates["IMM", b]] for b in range(runs)])
        moments = result.steps["IMM", f"mode_probability:{mode}"]
        np.testing.assert_allclose(moments.mean[used:], every.mean(axis=0), **CLOSE)
        likely = np.array([[e[3][j] for e in estimates["IMM", b]] for b in range(runs)])
        likely[np.isnan(scans[:, used:]).any(axis=2)] = np.nan
        moments = result.steps["IMM", f"mode_likelihood:{mode}"]
        seen = ~np.isnan(likely)
        np.testing.assert_array_equal(moments.n[used:], seen.sum(axis=0))
        total = np.where(seen, likely, 0.0).sum(axis=0)
        np.testing.assert_allclose((moments.mean * moments.n)[used:], total, **CLOSE)


def test_two_point_start_has_no_estimate_before_the_third_scan(tmp_path):
    result = block_of(scenario(tmp_path, RANDOM), 5, tracks=1)
    (track,) = (t for t in result.tracks if (t.estimator, t.quantity) == ("IMM", "x"))
    assert np.isnan(track.values[:2]).all()
    assert np.isfinite(track.values[2:]).all()
    assert result.steps["IMM", "position_squared_error_m2"].n[:3].tolist() == [0, 0, 5]
    assert result.steps[RAW, "position_squared_error_m2"].n[:2].tolist() == [0, 0]


# ---- windows ---------------------------------------------------------------------------------


def test_windows_by_hand():
    """Seven scans; a switch at the start of the step that ends at 13 s."""
    times_s = np.array([10.0, 11.0, 13.0, 14.0, 16.0, 17.0, 20.0])
    mode = np.array([0, 0, 1, 1, 1, 1, 1])[:, None]
    since = np.array([np.inf, np.inf, 2.0, 3.0, 5.0, 6.0, 9.0])[:, None]
    truth = TruthSpan(np.zeros((7, 1, 1)), mode, since)

    def held(**conditions):
        mask = inside(Window("w", **conditions), times_s, 100, truth)
        return times_s[mask[:, 0]].tolist()

    assert held() == times_s.tolist()
    assert held(from_s=11.0, until_s=16.0) == [11.0, 13.0, 14.0, 16.0]  # both ends belong to it
    assert held(mode=1) == [13.0, 14.0, 16.0, 17.0, 20.0]
    assert held(after_switch_s=3.0) == [16.0, 17.0, 20.0]  # and not before any switch
    assert held(within_switch_s=3.0) == [13.0, 14.0]
    assert held(mode=1, after_switch_s=2.0, within_switch_s=6.0) == [14.0, 16.0, 17.0]
    assert held(skip_scans=103) == times_s[3:].tolist()  # the span's first scan is the 101st


# ---- bytes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("text", SCENARIOS.values(), ids=SCENARIOS)
def test_first_runs_of_a_block_do_not_depend_on_how_many_are_asked_for(tmp_path, text):
    experiment = scenario(tmp_path, text)
    whole = block_of(experiment, 256, tracks=2)
    for runs in (1, 33, 100):
        part = block_of(experiment, runs, tracks=1)
        assert part.sums.keys() == whole.sums.keys()
        for cell, arrays in part.sums.items():
            for array, full in zip(arrays, whole.sums[cell], strict=True):
                assert array.tobytes() == full[:runs].tobytes(), cell
        kept = {t[:3]: t.values.tobytes() for t in whole.tracks}
        assert all(kept[t[:3]] == t.values.tobytes() for t in part.tracks)


def test_length_of_spans_does_not_change_the_bytes(tmp_path, monkeypatch):
    for text in SCENARIOS.values():
        experiment = scenario(tmp_path, text)
        whole = block_of(experiment, 40)
        monkeypatch.setattr(blocks, "SPAN_STEPS", 7)
        parts = block_of(experiment, 40)
        monkeypatch.undo()
        for cell, arrays in whole.sums.items():
            for a, b in zip(arrays, parts.sums[cell], strict=True):
                assert a.tobytes() == b.tobytes(), cell
        for key, moments in whole.steps.items():
            assert np.array(moments).tobytes() == np.array(parts.steps[key]).tobytes()


def test_blocks_and_seeds_differ(tmp_path):
    experiment = scenario(tmp_path, SMALL)
    key = (RAW, "all", "position_squared_error_m2")
    first = block_of(experiment, 32).sums[key][0]
    assert not np.isin(block_of(experiment, 32, block=1).sums[key][0], first).any()
    other = block_of(experiment._replace(seed=4), 32).sums[key][0]
    assert not np.isin(other, first).any()


# ---- starts ----------------------------------------------------------------------------------


def test_starts_drawn_about_the_truth_have_the_stated_covariance(tmp_path):
    """The filters are blind (one scan in a million, none here), so the error stays the start's."""
    text = SMALL.replace("detection_probability: 0.85", "detection_probability: 1e-6")
    n_x, runs = 6, 256
    covariance = np.zeros((n_x, n_x))
    covariance[:2, :2] = covariance[3:5, 3:5] = [[400, 90], [90, 100]]
    covariance[0, 4] = covariance[4, 0] = 60
    covariance[2, 2] = covariance[5, 5] = 0.25
    spread = "".join(
        f"  {key}\n"
        for key in ("position_std_m: 20", "velocity_std_m_s: 10", "acceleration_std_m_s2: 0.5")
    )
    text = text.replace(spread, f"  covariance: {covariance.tolist()}\n")
    experiment = scenario(tmp_path, text)
    experiment = experiment._replace(
        estimators=tuple(c for c in experiment.estimators if c.label == "IMM")
    )
    starts = []

    class Watched(estimators.Running):
        def __init__(self, recursion, first, mean):
            starts.append(mean)
            np.testing.assert_array_equal(first.model.initial_covariance, covariance)
            super().__init__(recursion, first, mean)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimators, "Running", Watched)
        for block in range(16):
            block_of(experiment, runs, block=block)
    truth = experiment.cases[0].truth.state[0]
    mean = np.array([truth[0], truth[1], 0, truth[2], truth[3], 0])
    errors = np.concatenate(starts, axis=1) - mean[:, None]
    n = errors.shape[1]
    assert n == 16 * runs
    std = np.sqrt(np.diag(covariance))
    # Four standard errors of a mean, and of a sample covariance of Gaussians (Wishart):
    # var = (P_ij^2 + P_ii P_jj)/n. With 27 numbers one in 600 seeds misses; the seed is fixed.
    assert (np.abs(errors.mean(axis=1)) < 4 * std / np.sqrt(n)).all()
    sample = errors @ errors.T / n
    error = np.sqrt((covariance**2 + np.outer(std, std) ** 2) / n)
    assert (np.abs(sample - covariance) < 4 * error).all()


# ---- runs that diverge -----------------------------------------------------------------------


class Planted(estimators.Running):
    """Run 2 sees an impossible measurement at step 35, run 4 an enormous one at step 20."""

    seen = 0

    def advance(self, prepared, measurements, **options):
        begin, self.seen = self.seen, self.seen + len(measurements)
        for run, step, value in ((2, 35, np.inf), (4, 20, 1e200)):
            if begin < step <= self.seen:
                measurements = measurements.copy()
                measurements[step - begin - 1, 0, run] = value
        return super().advance(prepared, measurements, **options)


def test_a_run_that_diverges_is_noted_and_harms_no_other(tmp_path, monkeypatch):
    text = SMALL.replace("detection_probability: 0.85", "detection_probability: 1")
    experiment = scenario(tmp_path, text)
    clean = block_of(experiment, 6, tracks=3)
    monkeypatch.setattr(estimators, "Running", Planted)
    planted = block_of(experiment, 6, tracks=3)
    others = [0, 1, 3, 5]
    for label in ("KF", "MMAE", "IMM", "RMIMM"):
        assert planted.status[label].tolist() == [0, 0, 35, 0, 20, 0]
    assert planted.status[RAW].tolist() == [0] * 6
    for cell, arrays in planted.sums.items():
        for array, sound in zip(arrays, clean.sums[cell], strict=True):
            assert array[others].tobytes() == sound[others].tobytes(), cell
    count = np.array([6] * 19 + [5] * 15 + [4] * 6)
    for label in ("KF", "IMM"):
        moments = planted.steps[label, "position_squared_error_m2"]
        assert moments.n.tolist() == count.tolist()
        assert np.isfinite(moments.mean).all()
        assert np.isfinite(moments.squares).all()
    (track,) = (t for t in planted.tracks if t[:3] == (2, "IMM", "x"))
    assert np.flatnonzero(np.isnan(track.values)).tolist() == list(range(34, 40))
    group = summarise(planted)
    assert group.diverged == {"raw": 0, "KF": 2, "MMAE": 2, "IMM": 2, "RMIMM": 2}
    cell = ("IMM", "all", "position_squared_error_m2")
    assert group.windows[cell].n == 4
    assert group.windows[cell].mean_sum == pytest.approx(clean.sums[cell][0][others].mean())


def test_an_unstable_model_overflows_into_a_status(tmp_path):
    """F = 1e30 per step and a blind sensor: |x| passes 1e60 at step 2 of every run."""
    text = """
name: unstable
dimensions: 1
clock: {step_s: 1, duration_s: 15}
states: [x]
truth: {chain: {initial: {mean: [0]}, modes: {still: {state_transition: [[1]],
  process_noise_covariance: [[1]]}}, transition_matrix: [[1]]}}
sensor: {position_std_m: 1, detection_probability: 1.0e-9}
modes: {unstable: {state_transition: [[1.0e30]], process_noise_covariance: [[0]]}}
initial: {mean: [3], covariance: [[0]]}
estimators: {KF: {type: kalman, mode: unstable}}
monte_carlo: {runs: 4, seed: 1}
"""
    result = block_of(scenario(tmp_path, text), 4)
    assert result.status["KF"].tolist() == [2] * 4  # 3e60
    assert result.steps["KF", "position_squared_error_m2"].n.tolist() == [4] * 1 + [0] * 14


# ---- the rest --------------------------------------------------------------------------------


def test_an_estimator_keeps_its_own_likelihood_advantage(tmp_path):
    """An RMIMM whose factor cancels is the IMM but for rounding, which must decide nothing."""
    text = SMALL.replace("residual_floor_m: 1}", "residual_floor_m: 1.0e12}")
    result = block_of(scenario(tmp_path, text), 64)
    for label in ("IMM", "RMIMM"):
        sums, numbers = result.sums[label, "all", "likelihood_advantage_kept"]
        assert numbers.sum() > 1000
        np.testing.assert_array_equal(sums, numbers)


def test_blocks_merge_into_the_moments_of_all_their_runs(tmp_path):
    experiment = scenario(tmp_path, SMALL)
    results = [block_of(experiment, runs, block=i) for i, runs in enumerate((256, 256, 40))]
    group = summarise(results[0])
    for result in results[1:]:
        group = merge(group, summarise(result))
    cell = ("IMM", "settled", "mode_brier")
    sums, numbers = (np.concatenate(p) for p in zip(*(r.sums[cell] for r in results), strict=True))
    moments = group.windows[cell]
    ds, dm = sums - sums.mean(), numbers - numbers.mean()
    expected = [552, sums.mean(), numbers.mean(), ds @ ds, ds @ dm, dm @ dm]
    np.testing.assert_allclose(moments, expected, rtol=1e-12)  # rounding of 552 terms
    steps = [r.steps["IMM", "mode_brier"] for r in results]
    assert group.steps["IMM", "mode_brier"].n.tolist() == [552] * 40
    total = sum(m.mean * m.n for m in steps)
    np.testing.assert_allclose(group.steps["IMM", "mode_brier"].mean, total / 552, rtol=1e-12)


def test_a_block_stops_when_told(tmp_path):
    stop = threading.Event()
    stop.set()
    with pytest.raises(Stopped):
        run_block(scenario(tmp_path, SMALL), BlockTask(0, 0, 5, 0), stop)


def test_raw_is_compared_at_the_scans_that_were_not_missed(tmp_path):
    """An estimator has errors at missed scans too, and larger ones: they don't count against it."""
    half = ["sensor.detection_probability=0.5", "monte_carlo.runs=64"]
    experiment = scenario(tmp_path, RANDOM, *half)
    result = block_of(experiment, 64)
    _, raw_numbers = result.sums["raw", "all", "position_squared_error_m2"]
    at_scans, numbers = result.sums["IMM", "all", POSITION_AT_SCANS]
    everywhere, steps = result.sums["IMM", "all", "position_squared_error_m2"]
    assert numbers.tolist() == raw_numbers.tolist()
    assert numbers.sum() < 0.6 * steps.sum()
    assert at_scans.sum() / numbers.sum() < 0.8 * everywhere.sum() / steps.sum()
    run_experiment(experiment, tmp_path / "run", 1, lambda done, total: None)
    pair = paired(tmp_path / "run", "raw", "IMM", "position_mse_m2", "all")
    # rounding: sums of some 1,000 terms in another order
    assert pair.second == pytest.approx(at_scans.sum() / numbers.sum(), rel=1e-12)


def test_two_point_starts_have_the_noise_that_each_bank_believes(tmp_path):
    """Estimators whose modes believe other noises start with other covariances."""
    experiment = scenario(tmp_path, RANDOM, "modes.rough.position_std_m=50")
    result = block_of(experiment, 2, tracks=1)
    stds = {
        track.estimator: track.values[2]
        for track in result.tracks
        if track.quantity == "std:x" and track.run == 0
    }
    assert len(set(stds.values())) > 1
