"""What Hwang 2006 leaves out: is there any noise, or any floor, with which its figures come out?

288 settings of measurement noise and of both accelerations, 256 runs each, and floors from 1 to
50 m, 1,024 runs each. The verdicts in configs/rmimm_fig5.yaml rest on it.
"""

import itertools
import threading

import pytest

from hybridtrack.blocks import run_block
from hybridtrack.config import load
from hybridtrack.experiment import run
from hybridtrack.groups import BlockTask, summarise
from hybridtrack.outcomes import paired
from hybridtrack.statistics import METRICS, ratio_of_sums

SETTINGS = [
    (noise, cv, ct)
    for noise, cv, ct in itertools.product(
        (10, 12.5, 15, 17.7, 20, 22.5, 25, 30, 40), (0.05, 0.2, 0.5, 1, 2), (1, 2, 3, 5, 8, 12, 20)
    )
    if cv < ct
]


@pytest.fixture(scope="module")
def found():
    rows = []
    for noise, cv, ct in SETTINGS:
        experiment = load(
            "rmimm_fig5",
            [
                f"sensor.position_std_m={noise}",
                f"initial.position_std_m={noise}",
                f"modes.CV.acceleration_std_m_s2={cv}",
                f"modes.CT.acceleration_std_m_s2={ct}",
            ],
        )
        task = BlockTask(case=0, block=0, runs=256, tracks=0)
        windows = summarise(run_block(experiment, task, threading.Event())).windows
        rows.append(
            {
                (label, metric): ratio_of_sums(
                    [tuple(map(float, windows[label, "all", METRICS[metric].quantity]))], True
                ).value
                for label in ("IMM", "RMIMM")
                for metric in ("position_rmse_m", "velocity_rmse_m_s")
            }
        )
    return rows


def test_no_noise_gives_the_published_velocity_error(found):
    """18 m comes with 11 m/s, not with 2.3; and no setting at all is below 8 m/s."""
    near = [row for row in found if 17 < row["IMM", "position_rmse_m"] < 19]
    assert len(near) > 20
    assert min(row["IMM", "velocity_rmse_m_s"] for row in near) > 11.0
    assert min(row["IMM", "velocity_rmse_m_s"] for row in found) > 8.0


def test_no_noise_makes_rmimm_the_better_one_at_a_floor_of_1_m(found):
    assert all(row["RMIMM", "position_rmse_m"] > row["IMM", "position_rmse_m"] for row in found)


@pytest.mark.parametrize(
    ("floor_m", "better"),
    [(1, False), (3, False), (5, False), (10, True), (15, True), (20, None), (50, None)],
)
def test_the_floor_decides_whether_rmimm_is_better_but_never_by_much(floor_m, better, tmp_path):
    """Better from 10 to 15 m by less than half a percent, then the IMM; 15 m is never near."""
    experiment = load(
        "rmimm_fig5", [f"estimators.RMIMM.residual_floor_m={floor_m}", "monte_carlo.runs=1024"]
    )
    run(experiment, tmp_path, 2, lambda done, total: None)
    pair = paired(tmp_path, "RMIMM", "IMM", "position_rmse_m", "all")
    accuracy = paired(tmp_path, "RMIMM", "IMM", "mode_accuracy", "all").difference
    assert pair.first > 17.5
    if better is None:
        assert abs(pair.ratio.value - 1) < 1e-3
    else:  # by three standard errors
        sign = 1 if better else -1
        assert -sign * pair.difference.value > 3 * pair.difference.standard_error
        assert sign * accuracy.value > 3 * accuracy.standard_error
        assert pair.ratio.value > 0.995
        assert not better or accuracy.value < 0.015


def test_on_settled_straight_legs_rmimm_is_better(tmp_path):
    run(load("rmimm_fig5"), tmp_path, 2, lambda done, total: None)
    pair = paired(tmp_path, "RMIMM", "IMM", "position_rmse_m", "straight_settled")
    assert pair.difference.value < -3 * pair.difference.standard_error
