"""Ratios step by step and reliability against plain calculations from the runs themselves."""

import threading

import numpy as np
import pytest

from hybridtrack import outcomes
from hybridtrack.blocks import run_block
from hybridtrack.config import load
from hybridtrack.experiment import _pack, _unpack
from hybridtrack.groups import BlockTask, merge, summarise
from hybridtrack.simulation import BlockSimulation
from hybridtrack.statistics import POSITION, Moments
from hybridtrack.tallies import BINS

RUNS, STEPS = 40, 30
ROUNDING = 1e-10  # relative: some 1e3 operations of 1e-16, merging among them


@pytest.fixture(scope="module")
def blocks():
    """Two blocks of runs of three filters and a genie, every run kept; one of HBF's is unsound."""
    experiment = load("softbound_three_modes", ["clock.duration_s=300", f"monte_carlo.runs={RUNS}"])
    tasks = [BlockTask(0, block, RUNS, RUNS) for block in (0, 1)]
    results = [run_block(experiment, task, threading.Event()) for task in tasks]
    results[1].status["HBF"][3] = 5
    return experiment, results


@pytest.fixture(scope="module")
def group(blocks):
    _, results = blocks
    return merge(*map(summarise, results))


def kept(results, label, quantity):
    """Values of every run (runs, steps)."""
    return np.array(
        [
            track.values
            for result in results
            for track in result.tracks
            if (track.estimator, track.quantity) == (label, quantity)
        ]
    )


def as_rows(columns):
    """A table's columns, lists or Arrow's, as rows."""
    lists = [c.to_pylist() if hasattr(c, "to_pylist") else c for c in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)]


@pytest.mark.parametrize("label", ["SBF", "HBF", "IMM"])
@pytest.mark.parametrize(("kind", "state"), [("position", "x"), ("velocity", "vx")])
def test_ratios_by_step_are_those_of_the_runs(blocks, group, label, kind, state):
    experiment, results = blocks
    truth = kept(results, "truth", state)
    ours, genies = ((kept(results, name, state) - truth) ** 2 for name in (label, "genie"))
    ratio = ours.mean(axis=0) / genies.mean(axis=0)
    spread = (ours - ratio * genies).std(axis=0, ddof=1)
    error = spread / np.sqrt(2 * RUNS) / genies.mean(axis=0)
    rows = as_rows(outcomes.steps_rows(experiment, [group]))

    def found(metric):
        mine = [r for r in rows if (r["estimator"], r["metric"]) == (label, metric)]
        return np.array([(r["value"], r["standard_error"]) for r in mine]).T

    value, standard_error = found(f"{kind}_mse_ratio")
    np.testing.assert_allclose(value, ratio, ROUNDING)
    np.testing.assert_allclose(standard_error, error, 1e-6)  # a small difference of squares
    root, root_error = found(f"{kind}_rmse_ratio")
    np.testing.assert_allclose(root, np.sqrt(ratio), ROUNDING)
    np.testing.assert_allclose(root_error, error / (2 * np.sqrt(ratio)), 1e-6)
    assert not any(r["estimator"] == "genie" and r["metric"].endswith("ratio") for r in rows)


def test_there_is_no_ratio_where_a_run_diverged_and_no_error_of_one_run(blocks, group):
    experiment, _ = blocks
    key = ("SBF", POSITION)
    n, mean, squares = (array.copy() for array in group.steps[key])
    n[7] -= 1
    steps = group.steps | {key: Moments(n, mean, squares)}
    rows = as_rows(outcomes.steps_rows(experiment, [group._replace(steps=steps)]))
    value = [
        r["value"] for r in rows if (r["estimator"], r["metric"]) == ("SBF", "position_mse_ratio")
    ]
    assert np.flatnonzero(np.isnan(value)).tolist() == [7]
    one = summarise(run_block(experiment, BlockTask(0, 0, 1, 0), threading.Event()))
    rows = as_rows(outcomes.steps_rows(experiment, [one]))
    errors = [r["standard_error"] for r in rows if r["metric"] == "position_mse_ratio"]
    assert len(errors) == 3 * STEPS
    assert np.isnan(errors).all()


@pytest.mark.parametrize("label", ["SBF", "HBF"])
def test_reliability_is_that_of_the_sound_runs_of_all_blocks(blocks, group, label):
    experiment, results = blocks
    told = kept(results, label, "final_mode_probability")
    final = []
    for block in (0, 1):
        simulation = BlockSimulation(
            experiment.cases[0], experiment.sensor, experiment.seed, 0, block, 64, foresees=True
        )
        final.append(simulation.advance(slice(0, STEPS)).truth.final[:, :RUNS].T)
    came = np.concatenate(final)
    sound = np.concatenate([result.status[label] == 0 for result in results])
    assert sound.sum() == 2 * RUNS - (label == "HBF")
    told, came = told[sound], came[sound]
    place = np.minimum((told * BINS).astype(int), BINS - 1)
    rows = [
        r
        for r in as_rows(outcomes.reliability_rows(experiment, [group]))
        if r["estimator"] == label
    ]
    assert [(r["from_probability"], r["to_probability"]) for r in rows] == [
        (i / BINS, (i + 1) / BINS) for i in range(BINS)
    ]
    gap = 0.0
    for i, row in enumerate(rows):
        here = place == i
        assert row["share_of_steps"] == pytest.approx(here.mean(), rel=ROUNDING)
        if here.any():
            assert row["mean_probability"] == pytest.approx(told[here].mean(), rel=ROUNDING)
            assert row["frequency"] == pytest.approx(came[here].mean(), rel=ROUNDING, abs=1e-12)
            gap += here.mean() * abs(told[here].mean() - came[here].mean())
    summary = as_rows(outcomes.summary_rows(experiment, [group]))
    (ece,) = [
        r["value"]
        for r in summary
        if (r["estimator"], r["metric"]) == (label, "final_mode_calibration_error")
    ]
    assert ece == pytest.approx(gap, rel=ROUNDING)


def test_a_shard_keeps_its_statistics(group):
    again, tracks = _unpack({key: np.asarray(value) for key, value in _pack(group, []).items()})
    assert tracks == []
    assert again.diverged == group.diverged
    for ours, theirs in zip(again[:3], group[:3], strict=True):
        assert list(ours) == list(theirs)
        for key in ours:
            for a, b in zip(ours[key], theirs[key], strict=True):
                assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
    assert set(group.final_bins) == {"SBF", "HBF"}
