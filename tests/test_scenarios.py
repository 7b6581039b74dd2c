"""The shipped scenarios at their full size, and what they are there to show."""

import numpy as np
import pytest

from hybridtrack import config, experiment, outcomes, results
from hybridtrack.models import Mode
from hybridtrack.verdicts import UNDECIDED
from models import read_table

# True by some four standard errors of as many runs as are shipped: one seed in six misses three.
NARROW = {
    ("softbound_ex1", "HBF is slightly better than IMM in the second half (velocity)"),
}


def quiet(done, total):
    pass


@pytest.mark.parametrize("name", sorted(config.shipped()))
def test_every_scenario_runs_and_every_verdict_is_the_expected_one(name, shipped):
    folder = shipped.run(name)
    assert results.require_complete(folder)["diverged"] == {}
    for row in results.read_rows(folder, "published"):
        expected = {row["expected_verdict"]}
        if (name, row["claim"]) in NARROW:
            expected.add(UNDECIDED)
        assert row["verdict"] in expected, row


def test_the_recorded_flight_is_what_it_was():
    (case,) = config.load("recorded_flight").cases
    step_s = np.diff(case.times_s)
    assert 4000 < len(step_s) < 4300
    assert step_s.min() >= 4.0
    assert np.unique(step_s).size > 4  # the recording's own uneven times
    assert np.isfinite(case.truth.state).all()


def test_two_models_beat_one_on_the_recorded_flight(shipped):
    """Ratio of position RMSE below .97 by three standard errors, over 20 noise seeds."""
    folder = shipped.run("recorded_flight")
    ratio = outcomes.paired(folder, "IMM", "KF", "position_rmse_m", "all").ratio
    assert ratio.n_runs == 20
    assert ratio.value + 3 * ratio.standard_error < 0.97


def test_no_other_single_filter_does_better(shipped, tmp_path):
    """The Kalman filter compared with has the best psd of 1, 3, 10 and 30 m^2/s^3."""
    summary = read_table(shipped.run("recorded_flight"), "summary")
    summary = summary.set_index(["estimator", "metric", "window"])
    best = summary.loc[("KF", "position_rmse_m", "all"), "value"]
    for psd in (1, 3, 10):
        other = config.load("recorded_flight", [f"modes.any.acceleration_psd_m2_s3={psd}"])
        experiment.run(other, tmp_path / str(psd), 2, quiet)
        table = read_table(tmp_path / str(psd), "summary")
        table = table.set_index(["estimator", "metric", "window"])
        assert table.loc[("KF", "position_rmse_m", "all"), "value"] > best


def test_uneven_times_taken_as_even_are_visibly_worse(tmp_path):
    """The same truth and the same noise, the steps as they are or all of the mean length.

    Thinned by dropping scans at random, as a busy radar would: steps of 4 to 40 s.
    """
    shipped = config.load("recorded_flight")
    (case,) = shipped.cases
    kept = np.sort(np.random.default_rng(3).permutation(len(case.times_s))[:1400])
    times_s = case.times_s[kept]
    truth = case.truth._replace(state=case.truth.state[kept], mode=case.truth.mode[kept])
    position_rmse_m = {}
    for name, used_s in (
        ("as they are", times_s),
        ("even", np.linspace(times_s[0], times_s[-1], times_s.size)),
    ):
        changed = shipped._replace(cases=(case._replace(times_s=used_s, truth=truth),))
        experiment.run(changed, tmp_path / name, 2, quiet)
        table = read_table(tmp_path / name, "summary")
        row = table[(table.estimator == "IMM") & (table.metric == "position_rmse_m")].iloc[0]
        position_rmse_m[name] = row["value"], row["standard_error"]
    (uneven, error), (even, other) = position_rmse_m["as they are"], position_rmse_m["even"]
    assert even > 1.1 * uneven
    assert even - uneven > 5 * np.hypot(error, other)


def test_without_the_package_the_message_names_the_command(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(config.ScenarioError, match=r"pip install --no-deps traffic==2\.13"):
        config.load("recorded_flight")


def test_every_estimator_runs_in_a_scenario(tmp_path):
    """The contract: found by its name, set from YAML, finite estimates in, mode by mode."""
    from hybridtrack.estimators import estimators

    needed = {
        "hbf": "most_transitions: 4",
        "kalman": "mode: turn",
        "rmimm": "residual_floor_m: 1",
        "sbf": "continuation_probability: 0.95",
    }
    starter = (
        config.shipped()["rmimm_fig5"].parent.parent / "hybridtrack/starter.yaml"
    ).read_text()
    head, _, tail = starter.partition("estimators:\n")
    listed = "".join(
        f"  E_{name}: {{type: {name}, {needed.get(name, '')}}}\n".replace(", }", "}")
        for name, estimator in estimators().items()
        if not estimator.nonlinear  # these have scenarios of their own
    )
    text = head + "estimators:\n" + listed + tail[tail.index("compare_with") :]
    path = tmp_path / "all.yaml"
    path.write_text(text.replace("compare_with: IMM", "compare_with: E_imm"))
    loaded = config.load(path, ["monte_carlo.runs=30"])
    assert all(isinstance(mode, Mode) for mode in loaded.bank.modes)
    experiment.run(loaded, tmp_path / "run", 1, quiet)
    assert results.require_complete(tmp_path / "run")["diverged"] == {}
    summary = read_table(tmp_path / "run", "summary")
    linear = [name for name, estimator in estimators().items() if not estimator.nonlinear]
    assert set(summary.estimator) == {"raw", *(f"E_{name}" for name in linear)}
