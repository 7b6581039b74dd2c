"""Estimators' settings from the scenario's words to the estimates, against the slow reference."""

import threading

import numpy as np
import pytest

import reference
from hybridtrack.blocks import run_block
from hybridtrack.config import load
from hybridtrack.groups import BlockTask
from models import SMALL, scenario
from test_blocks import simulated, slow_start

RUNS = 3
# The kernels and the reference order their operations differently (see test_bank).
CLOSE = {"rtol": 1e-9, "atol": 1e-9}


def series(experiment, label):
    """What an estimator gives over time, (runs, states + modes, steps)."""
    result = run_block(experiment, BlockTask(0, 0, RUNS, RUNS), threading.Event())
    kept = {(t.run, t.quantity): t.values for t in result.tracks if t.estimator == label}
    wanted = [*experiment.bank.state_names]
    wanted += [f"mode_probability:{mode}" for mode in experiment.bank.names]
    return np.array([[kept[run, quantity] for quantity in wanted] for run in range(RUNS)])


def slow_series(experiment, change=lambda model: model, **options):
    """The same by the reference, whose options are said in the test's own words."""
    case = experiment.cases[0]
    starts, _, _, scans = simulated(experiment, RUNS)
    found = []
    for run in range(RUNS):
        mean, covariance, _ = slow_start(experiment, case, scans[run], starts[run], run)
        model = experiment.bank.discretise(np.diff(case.times_s), np.zeros_like(mean), covariance)
        history = reference.bank(change(model), scans[run], initial_mean=mean, **options)
        found.append(np.array([np.append(mean, mu) for mean, _, mu, _ in history]).T)
    return np.array(found)


def residual(floor=1.0, recursive=True, common=False):
    return {"rmimm": {"floor": floor, "recursive": recursive, "common": common}}


def with_added_acceleration(model):
    """White acceleration of 4 m/s^2 held over each second: (T^2/2, T) on position, velocity."""
    effect = np.array([0.5, 1.0, 0.0])
    added = np.kron(np.eye(2), 16.0 * np.outer(effect, effect))
    assert model.state_names == ("x", "vx", "ax", "y", "vy", "ay")
    return model._replace(process_noise_covariance=model.process_noise_covariance + added)


MMAE, RMIMM = {"mixing": False}, residual()
SETTINGS = {
    "MMAE: {type: mmae, mode_probability_floor: 0.05}": {"mixing": False, "floor": 0.05},
    "MMAE: {type: mmae, added_acceleration_std_m_s2: 4}": {
        "mixing": False,
        "change": with_added_acceleration,
    },
    "RMIMM: {type: rmimm, residual_floor_m: 1, residual_error: zero}": residual(recursive=False),
    "RMIMM: {type: rmimm, residual_floor_m: 1, residual_mean: common}": residual(common=True),
    "RMIMM: {type: rmimm, residual_floor_m: 12}": residual(floor=12.0),
}
PLAIN = {
    "MMAE": ("MMAE: {type: mmae}", MMAE),
    "RMIMM": ("RMIMM: {type: rmimm, residual_floor_m: 1}", RMIMM),
}


@pytest.mark.parametrize("written", SETTINGS)
def test_a_setting_does_what_the_reference_does(tmp_path, written):
    label = written.split(":")[0]
    plain, default = PLAIN[label]
    assert plain in SMALL
    experiment = scenario(tmp_path, SMALL.replace(plain, written))
    ours = series(experiment, label)
    np.testing.assert_allclose(ours, slow_series(experiment, **SETTINGS[written]), **CLOSE)
    # Were the setting ignored, the filter would be the plain one: this is how far it is away.
    unset = slow_series(experiment, **default)
    modes = len(experiment.bank.names)
    assert np.abs(ours - unset)[:, -modes:].max() > 0.01
    assert np.abs(ours - unset)[:, :-modes].max() > 0.1


def test_a_common_residual_mean_makes_the_rmimm_an_imm(tmp_path):
    plain, _ = PLAIN["RMIMM"]
    experiment = scenario(tmp_path, SMALL.replace(plain, f"{plain[:-1]}, residual_mean: common}}"))
    # Rounding of some 1e4 operations at 1e-16, and a margin of 100 (see test_bank).
    close = {"rtol": 1e-10, "atol": 1e-10}
    imm = series(experiment, "IMM")
    np.testing.assert_allclose(series(experiment, "RMIMM"), imm, **close)
    own = series(scenario(tmp_path, SMALL), "RMIMM")
    assert np.abs(own - imm).max() > 1.0


def test_the_printed_factor_holds_the_filter_in_one_mode_far_into_a_turn():
    """Hwang 2006, eq. 29, with next to no floor: a residual mean of 0 outweighs any likelihood."""
    settings = [f"estimators.{label}.residual_floor_m=1e-30" for label in ("RMIMM", "RMIMM_zero")]
    experiment = load("rmimm_fig5", [*settings, "monte_carlo.runs=20"])
    result = run_block(experiment, BlockTask(0, 0, 20, 20), threading.Event())

    def rmse_m(label):
        squares, numbers = result.sums[label, "all", "position_squared_error_m2"]
        return np.sqrt(squares.sum() / numbers.sum())

    def noticed_s(label):
        """How far into the first turn, from 30 to 50 s, each run believes in it."""
        wanted = (label, "mode_probability:CT")
        turn = [t.values[30:50] > 0.5 for t in result.tracks if (t.estimator, t.quantity) == wanted]
        return np.argmax(turn, axis=1)

    # 68, 219 and 18 m. In this many runs and steps they vary by a few per cent from seed to seed.
    assert rmse_m("RMIMM") > 3 * rmse_m("IMM")
    assert rmse_m("RMIMM_zero") > 8 * rmse_m("IMM")
    assert noticed_s("IMM").max() <= 5  # 0 to 4 s
    assert noticed_s("RMIMM").min() >= 8  # 9 to 11 s
    assert noticed_s("RMIMM_zero").min() >= 12  # 14 and 15 s
