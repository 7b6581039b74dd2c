"""Sojourns followed by lanes against plain loops; distributions; what the tables make of them."""

import itertools
import math

import numpy as np
import pytest

from hybridtrack import config, experiment, results
from hybridtrack.delays import LONGEST, Delays, DelayTally, distribution, merge_delays
from hybridtrack.detections import averaged_delay
from hybridtrack.simulation import spans
from hybridtrack.statistics import SumMoments

MODES = ("a", "b", "c")


def slow_sojourns(mode, estimate):
    """One run's sojourns: (from, to, delay or None, lasted, false switches, ended by a switch)."""
    found, begin = [], 0
    for k in range(1, len(mode) + 1):
        if k == len(mode) or mode[k] != mode[k - 1]:
            right = [int(e == mode[begin]) for e in estimate[begin:k]]
            delay = right.index(1) + 1 if 1 in right else None
            false = sum(a == 1 and b == 0 for a, b in itertools.pairwise(right))
            before = mode[begin - 1] if begin else None
            found.append((before, mode[begin], delay, k - begin, false, k < len(mode)))
            begin = k
    return found


def drawn(rng, steps, lanes, stay=0.8, truth_lanes=None):
    """Random true modes that stay a while, and mode probabilities."""
    wide = lanes if truth_lanes is None else truth_lanes
    mode = np.empty((steps, wide), dtype=np.int64)
    mode[0] = rng.integers(0, 3, wide)
    for k in range(1, steps):
        moved = rng.random(wide) > stay
        mode[k] = np.where(moved, rng.integers(0, 3, wide), mode[k - 1])
    return mode, rng.dirichlet(np.ones(3) * 0.5, size=(steps, lanes)).transpose(0, 2, 1)


def tallied(mode, probabilities, sojourns, sound=None, longest=7, runs=None, names=MODES):
    steps, _, lanes = probabilities.shape
    runs = lanes if runs is None else runs
    tally = DelayTally(MODES, names, steps, lanes, runs, sojourns)
    for span in spans(steps, longest):
        tally.add(span.start, mode[span], np.ascontiguousarray(probabilities[span]))
    return tally, tally.delays(np.ones(runs, dtype=bool) if sound is None else sound)


@pytest.mark.parametrize("longest", [1, 7, 1000])
def test_sojourns_of_random_runs_against_loops(longest):
    rng = np.random.default_rng(11)
    steps, lanes, runs = 120, 32, 29
    mode, p = drawn(rng, steps, lanes)
    p[40:43, :, 3] = np.nan  # a filter that has lost itself estimates nothing
    sound = np.ones(runs, dtype=bool)
    sound[5] = False
    _, found = tallied(mode, p, None, sound, longest, runs)
    detected, missed, unfinished = (np.zeros((9, steps + 1)) for _ in range(3))
    already = np.zeros(9)
    false, number = np.zeros((9, runs)), np.zeros((9, runs))
    for b in range(runs):
        estimate = [
            None if np.isnan(p[k, 0, b]) else int(p[k, :, b].argmax()) for k in range(steps)
        ]
        ends = 0
        stays = slow_sojourns(mode[:, b].tolist(), estimate)
        for before, to, delay, lasted, wrong, ended in stays:
            g = (to if before is None else before) * 3 + to
            begin = ends
            ends += lasted
            if sound[b]:
                already[g] += begin > 0 and estimate[begin - 1] == to
                kind = detected if delay else missed if ended else unfinished
                kind[g, delay or lasted] += 1
                false[g, b] += wrong
                number[g, b] += 1
    assert detected.sum() > 300
    assert missed.sum() > 50
    np.testing.assert_array_equal(found.detected, detected)
    np.testing.assert_array_equal(found.missed, missed)
    np.testing.assert_array_equal(found.unfinished, unfinished)
    np.testing.assert_array_equal(found.already, already)
    assert already.sum() > 50
    kept = sound
    false, number = (np.vstack([part, part.sum(axis=0)]) for part in (false, number))
    np.testing.assert_allclose(
        found.false_switches.mean_sum, false[:, kept].mean(axis=1), rtol=1e-12
    )
    np.testing.assert_allclose(
        found.false_switches.sum_squares, false[:, kept].var(axis=1) * kept.sum(), atol=1e-9
    )
    np.testing.assert_allclose(found.false_switches.mean_number, number[:, kept].mean(axis=1))


@pytest.mark.parametrize("start", [0, 2])
def test_sojourns_of_one_truth_are_numbered(start):
    rng = np.random.default_rng(12)
    mode, p = drawn(rng, 90, 8, stay=0.9, truth_lanes=1)
    ends = [*np.flatnonzero(np.diff(mode[:, 0])) + 1, 90]
    lengths = np.diff([0, *ends])
    tally = DelayTally(MODES, MODES, 90, 8, 8, lengths)
    for span in spans(90 - start, 7):
        some = slice(span.start + start, span.stop + start)
        tally.add(some.start, mode[some], np.ascontiguousarray(p[some]))
    found = tally.delays(np.ones(8, dtype=bool))
    assert found.detected.shape == (len(lengths), lengths.max() + 1)
    for b in range(8):
        estimate = p[start:, :, b].argmax(axis=1).tolist()
        over = int((np.cumsum(lengths) <= start).sum())  # before the first scan that counts
        for g, sojourn in enumerate(slow_sojourns(mode[start:, 0].tolist(), estimate), over):
            if sojourn[2]:
                found.detected[g, sojourn[2]] -= 1
    assert not found.detected.any()  # every one is where it belongs
    share = tally.shares()["b"]
    np.testing.assert_allclose(share.mean[start:], (p[start:].argmax(axis=1) == 1).mean(axis=1))
    np.testing.assert_array_equal(share.n[start:], 8)


def test_a_mode_that_the_estimator_does_not_have_is_never_right():
    rng = np.random.default_rng(13)
    mode, p = drawn(rng, 60, 8)
    _, found = tallied(mode, p[:, :2], None, names=("a", "c"))
    assert not found.detected[[1, 4, 7]].any()  # into b
    assert found.detected[[2, 5, 8]].any()  # into c


def test_a_sojourn_is_followed_for_so_many_steps_only():
    steps = LONGEST + 50
    p = np.zeros((steps, 3, 32))
    p[:, 0] = 1.0
    p[-10:] = p[-10:, [1, 0, 2]]  # noticed ten steps before the end: too late
    mode = np.ones((steps, 1), dtype=np.int64)
    _, found = tallied(mode, p, None)
    assert found.detected.sum() == 0
    assert found.unfinished[4, LONGEST] == 32


def test_merging_is_adding_up():
    rng = np.random.default_rng(14)
    mode, p = drawn(rng, 50, 64)
    _, whole = tallied(mode, p, None)
    halves = [
        tallied(mode[:, some], np.ascontiguousarray(p[..., some]), None)[1]
        for some in (slice(0, 32), slice(32, 64))
    ]
    merged = merge_delays(*halves)
    for one, other in zip(merged[:4], whole[:4], strict=True):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(merged.false_switches, whole.false_switches, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


# ---- distributions ---------------------------------------------------------------------------


def counted(detected, missed, unfinished=None):
    nothing = np.zeros_like(detected)
    moments = SumMoments(*(np.zeros(1) for _ in range(6)))
    rest = nothing if unfinished is None else unfinished
    counts = (np.array([a], dtype=float) for a in (detected, missed, rest))
    return Delays(*counts, np.zeros(1), moments)


def test_kaplan_and_meier_by_hand():
    """Six sojourns: noticed after 1, 2, 2 steps, lost after 1, 2, 3."""
    found = distribution(counted([0, 1, 2, 0], [0, 1, 1, 0], [0, 0, 0, 1]), 0)
    np.testing.assert_array_equal(found.at_risk, [6, 4, 1])
    np.testing.assert_allclose(found.probability, [1 / 6, 1 - 5 / 6 / 2, 1 - 5 / 12])
    greenwood = [1 / (6 * 5), 1 / (6 * 5) + 2 / (4 * 2)]
    np.testing.assert_allclose(
        found.standard_error[:2], [5 / 6 * greenwood[0] ** 0.5, 5 / 12 * greenwood[1] ** 0.5]
    )


def test_without_censoring_it_is_the_share_and_its_binomial_error():
    found = distribution(counted([0, 30, 50, 20], [0, 0, 0, 0]), 0)
    np.testing.assert_allclose(found.probability, [0.3, 0.8, 1.0], rtol=1e-12)
    np.testing.assert_allclose(found.standard_error, np.sqrt([0.0021, 0.0016, 0.0]), atol=1e-12)


def test_censored_delays_are_estimated_without_bias():
    """Geometric delays, sojourns of geometric lengths: P(delay <= d) within 5 standard errors."""
    rng = np.random.default_rng(15)
    n, q = 40_000, 0.3
    delay, length = rng.geometric(q, n), rng.geometric(0.25, n)
    seen = delay <= length
    detected = np.bincount(delay[seen], minlength=80)[:80]
    missed = np.bincount(length[~seen], minlength=80)[:80]
    found = distribution(counted(detected, missed), 0)
    for d in (1, 2, 5):
        truth = 1 - (1 - q) ** d
        assert abs(found.probability[d - 1] - truth) < 5 * found.standard_error[d - 1]
    naive = detected[1:6].sum() / n  # censored ones taken for undetected
    assert naive < 1 - (1 - q) ** 5 - 0.1


def test_the_averaged_delay_by_hand():
    shares = np.array([[0.9, 0.6, 0.3, 0.1], [0.1, 0.4, 0.4, 0.6], [0.0, 0.0, 0.3, 0.3]])
    runs = np.full(4, 1e6)
    assert averaged_delay(shares, 1, runs) == (3.0, 3.0, 3.0)
    assert averaged_delay(shares, 2, runs)[0] == math.inf
    low, high = averaged_delay(shares, 1, np.full(4, 100.0))[1:]
    assert (low, high) == (2.0, 4.0)  # .4 against .6, and .6 against .3, of 100 runs


# ---- run folders -----------------------------------------------------------------------------


def quiet(done, total):
    pass


@pytest.fixture(scope="module")
def figure_4(tmp_path_factory):
    path = tmp_path_factory.mktemp("figure_4") / "run"
    experiment.run(config.load("mode_delay_fig4"), path, 2, quiet)
    return path


def test_the_published_delays_are_measured(figure_4):
    """1 and 2 steps for IMM, 6 and 10 for MMAE; IMM at once in .83 and .15 of runs, +-.06."""
    rows = {(r["estimator"], r["switch"]): r for r in results.read_rows(figure_4, "delays")}
    found = {key: row["averaged_delay_steps"] for key, row in rows.items() if key[1]}
    assert found == {("IMM", 1): 1, ("IMM", 2): 2, ("MMAE", 1): 6, ("MMAE", 2): 10}
    for key in found:
        row = rows[key]
        assert row["averaged_delay_steps_low"] == row["averaged_delay_steps_high"] == found[key]
        assert row["sojourns"] == 2000 == row["detected"] + row["missed"] + row["unfinished"]
    assert rows["IMM", 1]["first_step_share"] == pytest.approx(0.83, abs=0.06)
    assert rows["IMM", 2]["first_step_share"] == pytest.approx(0.15, abs=0.06)
    assert (rows["IMM", 1]["step"], rows["IMM", 1]["time_s"]) == (46, 45.0)
    assert (rows["IMM", 0]["from_mode"], rows["IMM", 0]["to_mode"]) == (None, "CV")


def test_twenty_batches_of_a_hundred_runs_agree(tmp_path):
    """The paper has 100 runs; the delays of their averaged mode estimate in twenty such."""
    for seed in range(20):
        path = tmp_path / str(seed)
        chosen = ["monte_carlo.runs=100", f"monte_carlo.seed={100 + seed}"]
        experiment.run(config.load("mode_delay_fig4", chosen), path, 2, quiet)
        rows = results.read_rows(path, "delays")
        found = [(r["estimator"], r["averaged_delay_steps"]) for r in rows if r["switch"]]
        assert found == [("IMM", 1), ("MMAE", 6), ("IMM", 2), ("MMAE", 10)]


WHITE_ACCELERATION = [
    "sensor.position_std_m=0.25",
    "initial.position_std_m=0.25",
    "modes.CV={motion: constant_velocity, acceleration_std_m_s2: 0.008}",
    "modes.CT={motion: constant_velocity_with_input, acceleration_m_s2: [1.5, 1.5], "
    "acceleration_std_m_s2: 0.015}",
    "transition_matrix=[[0.95, 0.05], [0.05, 0.95]]",
    "published=[]",
]


def test_another_noise_gives_the_same_delays_but_one(tmp_path):
    """sigma_v = .25 m, sigma_w = .008 and .015 m/s^2: 1 and 1 for IMM, 6 and 10 for MMAE."""
    experiment.run(config.load("mode_delay_fig4", WHITE_ACCELERATION), tmp_path / "a", 2, quiet)
    rows = results.read_rows(tmp_path / "a", "delays")
    found = [(r["estimator"], r["averaged_delay_steps"]) for r in rows if r["switch"]]
    assert found == [("IMM", 1), ("MMAE", 6), ("IMM", 1), ("MMAE", 10)]


def test_ten_seconds_and_a_hundred_times_the_noise_are_the_same_in_steps(tmp_path):
    """Only sigma_v/T^2 and sigma_w matter: T = 10 s with 25 m is T = 1 s with .25 m."""
    slow = [
        *WHITE_ACCELERATION,
        "clock={step_s: 10, duration_s: 900}",
        "truth.legs=[{until_s: 450}, {until_s: 560, acceleration_m_s2: [1.5, 1.5], mode: CT}, "
        "{until_s: 900}]",
        "sensor.position_std_m=25",
        "initial.position_std_m=25",
        "initial.velocity_std_m_s=10",
    ]
    for name, changes in (("fast", WHITE_ACCELERATION), ("slow", slow)):
        experiment.run(config.load("mode_delay_fig4", changes), tmp_path / name, 2, quiet)
    fast, slow = (results.read_rows(tmp_path / name, "delays") for name in ("fast", "slow"))
    for one, other in zip(fast, slow, strict=True):
        for column in ("estimator", "averaged_delay_steps"):
            assert one[column] == other[column]
        share, error = "first_step_share", "first_step_share_standard_error"
        # The starts' draws go to other states, so that the runs are others: 5 standard errors.
        allowed = 5 * np.hypot(one[error], other[error])
        assert abs(one[share] - other[share]) <= allowed


def test_workers_and_continued_runs_change_no_byte(figure_4, tmp_path):
    names = ("delays.parquet", "delay_distribution.parquet", "steps.parquet")
    fewer = config.load("mode_delay_fig4", ["monte_carlo.runs=300"])
    experiment.run(fewer, tmp_path, 1, quiet)
    experiment.run(config.load("mode_delay_fig4"), tmp_path, 1, quiet)
    for name in names:
        assert (tmp_path / name).read_bytes() == (figure_4 / name).read_bytes()


def test_random_switches_are_put_together_by_their_modes(tmp_path):
    shipped = config.load("softbound_three_modes", ["monte_carlo.runs=300", "published=[]"])
    experiment.run(shipped, tmp_path / "a", 2, quiet)
    rows = results.read_rows(tmp_path / "a", "delays")
    assert {row["switch"] for row in rows} == {None}
    imm = {(r["from_mode"], r["to_mode"]): r for r in rows if r["estimator"] == "IMM"}
    assert set(imm) >= {("straight", "gentle"), ("hard", "straight"), (None, "straight")}
    assert all(row["averaged_delay_steps"] is None for row in rows)
    starts = sum(row["sojourns"] for key, row in imm.items() if key[0] is None)
    assert starts == 300
    by_delay = results.read_rows(tmp_path / "a", "delay_distribution")
    for key, row in imm.items():
        own = [
            r for r in by_delay if r["estimator"] == "IMM" and (r["from_mode"], r["to_mode"]) == key
        ]
        assert sum(r["detected"] for r in own) == row["detected"]
        probability = [r["probability"] for r in own]
        assert probability == sorted(probability)


def test_what_the_data_cut_short_is_no_never(tmp_path):
    """A switch at the last step but two: MMAE takes six."""
    changes = [
        "truth.legs=[{until_s: 87}, {until_s: 90, acceleration_m_s2: [1.5, 1.5], mode: CT}]",
        "published=[]",
        "monte_carlo.runs=50",
    ]
    experiment.run(config.load("mode_delay_fig4", changes), tmp_path / "a", 2, quiet)
    rows = {r["estimator"]: r for r in results.read_rows(tmp_path / "a", "delays") if r["switch"]}
    assert (rows["IMM"]["averaged_delay"], rows["MMAE"]["averaged_delay"]) == ("1", "over 3")
    assert (rows["MMAE"]["missed"], rows["MMAE"]["unfinished"]) == (0, 50)


def test_estimates_that_were_so_before_the_switch_are_counted(tmp_path):
    shipped = config.load("rmimm_fig5", ["monte_carlo.runs=256"])
    experiment.run(shipped, tmp_path / "a", 2, quiet)
    rows = {(r["estimator"], r["switch"]): r for r in results.read_rows(tmp_path / "a", "delays")}
    steps = results.read_columns(tmp_path / "a", "steps")
    for label, switch, before in (("RMIMM", 2, "CV"), ("MMAE", 3, "CT"), ("IMM", 2, "CV")):
        row = rows[label, switch]
        last = steps["step"] == row["step"] - 1
        mine = last & (steps["estimator"] == label) & (steps["metric"] == f"mode_estimate:{before}")
        assert row["already_share"] == pytest.approx(steps["value"][mine][0], abs=1e-12)
    assert rows["MMAE", 3]["already_share"] == 1.0
    assert rows["IMM", 2]["already_share"] < 0.05 < 0.25 < rows["RMIMM", 2]["already_share"]


def test_false_switches_of_all_stays_together(tmp_path):
    shipped = config.load("rmimm_fig5", ["monte_carlo.runs=256"])
    experiment.run(shipped, tmp_path / "a", 2, quiet)
    rows = results.read_rows(tmp_path / "a", "delays")
    summary = results.read_rows(tmp_path / "a", "summary")
    (found,) = [
        r for r in summary if r["metric"] == "false_switches_per_stay" and r["estimator"] == "RMIMM"
    ]
    own = [row["false_switches"] for row in rows if row["estimator"] == "RMIMM"]
    assert found["value"] == pytest.approx(np.mean(own))  # each run has every stay once
    assert 0 < found["standard_error"] < 0.1


def test_a_truth_without_switches_has_no_delays(tmp_path):
    changes = ["truth.legs=[{until_s: 90}]", "published=[]"]
    experiment.run(config.load("mode_delay_fig4", changes), tmp_path / "a", 2, quiet)
    assert results.read_rows(tmp_path / "a", "delays") == []
    steps = results.read_columns(tmp_path / "a", "steps")
    assert not any(metric.startswith("mode_estimate") for metric in steps["metric"])
