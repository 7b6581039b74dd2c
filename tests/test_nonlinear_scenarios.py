"""Scenarios with dynamics: what their mistakes are called, what a run puts into its folder."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hybridtrack import config, experiment, outcomes, results, tables
from hybridtrack.config.reader import read
from hybridtrack.errors import UserError
from models import read_table
from scenarios import check_sentence, complaint, load_or_complain, mutations

AIRCRAFT = """\
name: aircraft
clock: {step_s: 0.01, duration_s: 0.6}
states: [x, y, psi]
angles: [psi]
units: {x: m, y: m}
constants: {T: 0.01, v1: 10, w1: 0.5}
inputs: {v0: 0}
dynamics:
  x: x + T*(-v0 + v1*cos(psi))
  y: y + T*v1*sin(psi)
  psi: psi + T*w1
measurement: {x: x, y: y}
truth: {start: [0, 0, 0]}
noise:
  kind: persistent_ball
  process: {x: 0.01, y: 0.01, psi: 0.01}
  measurement: {x: 0.09, y: 0.09}
initial: {mean: truth, half_axes: {x: 0.1, y: 0.1, psi: 0.1}}
estimators:
  ESMF: {type: esmf}
  RESET:
    {type: esmf, operation: bank_reset, operating_points: [[0, 0, 0.2], [0, 0, 0.4]]}
  EKF: {type: ekf}
compare_with: ESMF
windows: {late: {from_s: 0.3}}
monte_carlo: {runs: 40, seed: 1}
"""

MISTAKES = [
    ("x + T*(-v0 + v1*cos(psi))", "__import__('os').system('x')", "calls what is no function"),
    ("x + T*(-v0 + v1*cos(psi))", "x.y", "'x' is x.y: it holds an attribute"),
    ("x + T*(-v0 + v1*cos(psi))", "x**10**10", "an exponent is 10000000000"),
    ("x + T*(-v0 + v1*cos(psi))", "x + T*cos(pssi)", "'pssi' is not known; did you mean 'psi'"),
    ("x + T*(-v0 + v1*cos(psi))", "(" * 1000 + "x" + ")" * 1000, "nested deeper than"),
    ("x + T*(-v0 + v1*cos(psi))", "x + 1/y", "no finite value at the start"),
    ("y + T*v1*sin(psi)", "y + sqrt(x**2)", "'y' is y + sqrt(x**2): it has a kink"),
    (
        "y + T*v1*sin(psi)",
        f"y + {'sin(' * 58}x{')' * 58}",
        "a derivative of it has more than 5,000 operations",
    ),
    (
        "inputs: {v0: 0}\ndynamics:\n  x: x + T*(-v0",
        f"inputs: {{v0: {[1] * 59 + [0]}}}\ndynamics:\n  x: x + T*(-log(v0)",
        "where 'v0' is 0, an expression or a derivative of it has no finite value",
    ),
    (
        "inputs: {v0: 0}\ndynamics:\n  x: x + T*(-v0 + v1",
        f"inputs: {{v0: {[1] * 59 + [-2]}}}\ndynamics:\n  x: x + T*(-v0 + log(v0)",
        "where 'v0' is -2, an expression",
    ),
    ("x + T*(-v0 + v1*cos(psi))", "sqrt(x)", "no finite derivative at the start"),
    ("x + T*(-v0 + v1*cos(psi))", "log(x)", "no finite value at the start"),
    ("x + T*(-v0 + v1*cos(psi))", "[1]", "'x' of 'dynamics' is a list|'x' is a list"),
    ("psi: psi + T*w1", "phi: psi + T*w1", "'phi' is no state; there are x, y, psi"),
    ("  psi: psi + T*w1\n", "", "'dynamics' has no expression for 'psi'"),
    ("measurement: {x: x, y: y}", "measurement: {x: x, y: z}", "'z' is not known"),
    ("measurement: {x: x, y: y}", "measurement: {}", "'measurement' has no entries"),
    ("angles: [psi]", "angles: [phi]", "'phi' is no state and no measurement"),
    ("units: {x: m,", 'units: {x: "m\\n",', "has letters that no figure can show"),
    ("start: [0, 0, 0]", "start: [1.0e17, 0, 0]", "where numbers are too far apart for that"),
    ("  psi: psi + T*w1\n", "  psi: ''\n", "it is empty"),
    (
        "windows: {late: {from_s: 0.3}}",
        "windows: {late: {after_switch_s: 1}}",
        "no modes here that could switch",
    ),
    ("units: {x: m,", "units: {q: m,", "'q' is no state and no measurement"),
    ("units: {x: m,", "units: {psi: deg, x: m,", "are in rad, and its unit is deg"),
    ("x + T*(-v0 + v1*cos(psi))", "(x + 1)**2", "has no finite value at step"),
    ("  EKF: {type: ekf}", "  noise_free: {type: ekf}", "means something else"),
    ("constants: {T: 0.01,", "constants: {T: 0.01, x: 1,", "'x' is among the states already"),
    ("constants: {T: 0.01,", "constants: {T: 0.01, cos: 1,", "'cos' has a meaning"),
    ("constants: {T: 0.01,", "constants: {T: 0.01, lambda: 1,", "cannot stand in an expression"),
    ("constants: {T: 0.01,", "constants: {T: 0.01, a-b: 1,", "cannot stand in an expression"),
    ("inputs: {v0: 0}", "inputs: {v0: [0, 1]}", "'v0' has 2 numbers and there are 60 steps"),
    ("start: [0, 0, 0]", "start: [0, 0]", "needs one number for each of the states x y psi"),
    ("mean: truth", "mean: [0, 0]", "needs one number for each of the states x y psi"),
    ("process: {x: 0.01,", "process: {q: 0.01,", "'q' is not known here"),
    ("process: {x: 0.01, ", "process: {", "'process' has no half-axis of 'x'"),
    ("measurement: {x: 0.09,", "measurement: {x: 0,", "greater than 0"),
    ("kind: persistent_ball", "kind: gaussian", "'kind' is gaussian; it must be"),
    ("kind: persistent_ball", "kind: adversary", "add it"),
    ("kind: persistent_ball", "kind: adversary\n  against: QQ", "no estimator here"),
    ("kind: persistent_ball", "kind: ball\n  against: ESMF", "belongs to the kind adversary"),
    ("{type: esmf}", "{type: imm}", "which is for scenarios with 'modes'"),
    ("{type: esmf}", "{type: esmff}", "'type' is esmff"),
    ("{type: esmf}", "{type: esmf, operation: bank_reset}", "needs 'operating_points'"),
    ("{type: esmf}", "{type: esmf, rho: 2}", "'rho' is 2; give a number between"),
    ("{type: esmf}", "{type: esmf, rho: best}", "'rho' is best; it must be"),
    ("[0, 0, 0.4]", "[0, 0.4]", "an operating point has 2 numbers"),
    ("compare_with: ESMF", "compare_with: ESMP", "did you mean 'ESMF'"),
    ("name: aircraft", "name: aircraft\nmodes: {}", "has 'dynamics' or 'modes', and this has both"),
    ("clock: {step_s: 0.01, duration_s: 0.6}", "clock: {times_s: [0, 1, 3]}", "uneven"),
    ("  ESMF: {type: esmf}", "  raw: {type: esmf}", "means something else"),
    ("states: [x, y, psi]", "states: [x, y, psi, psi]", "already"),
]


@pytest.mark.parametrize(("old", "new", "said"), MISTAKES, ids=range(len(MISTAKES)))
def test_mistakes_are_one_sentence_with_their_place(old, new, said, tmp_path):
    assert old in AIRCRAFT
    message = complaint(AIRCRAFT.replace(old, new, 1), tmp_path / "scenario.yaml")
    check_sentence(message, tmp_path / "scenario.yaml")
    assert any(part in message for part in said.split("|")), message


def test_an_esmf_among_modes_is_told_so(tmp_path):
    text = config.shipped()["rmimm_fig5"].read_text().replace("type: imm", "type: esmf")
    message = complaint(text, tmp_path / "s.yaml")
    assert "which is for scenarios with 'dynamics'" in message


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_mutated_scenarios_load_or_complain_in_one_sentence(data, tmp_path):
    file = tmp_path / "original.yaml"
    file.write_text(AIRCRAFT)
    load_or_complain(data.draw(mutations(read(file).data)), tmp_path / "mutated.yaml")


def loaded(tmp_path, text=AIRCRAFT, *settings_):
    file = tmp_path / "aircraft.yaml"
    file.write_text(text)
    return config.load(file, settings_)


def run(tmp_path, name="run", text=AIRCRAFT, settings_=(), workers=1):
    one = loaded(tmp_path, text, *settings_)
    experiment.run(one, tmp_path / name, workers, lambda done, total: None)
    return one, tmp_path / name


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return run(tmp_path_factory.mktemp("sets"))


def test_the_resolved_scenario_runs_again(finished, tmp_path):
    one, folder = finished
    again = config.load(folder / "config.yaml")
    assert experiment.digest(again) == experiment.digest(one)


def test_figures_are_the_runs(finished):
    """summary, sets and runs.parquet say one thing."""
    _, folder = finished
    runs = read_table(folder, "runs")
    runs = runs[(runs.window == "all") & (runs.estimator == "RESET")]
    summary = read_table(folder, "summary").set_index(["estimator", "metric", "window"])
    mean = summary.loc[("RESET", "mean_bound:psi", "all"), "value"]
    by_run = (runs["bound:psi_sum"] / runs["bound:psi_count"]).to_numpy()
    assert mean == pytest.approx(by_run.mean(), rel=1e-12)
    error = summary.loc[("RESET", "mean_bound:psi", "all"), "standard_error"]
    assert error == pytest.approx(by_run.std(ddof=1) / np.sqrt(40), rel=1e-9)
    sets = read_table(folder, "sets").set_index(["estimator", "figure"])
    assert sets.loc[("RESET", "median_bound:psi"), "value"] == pytest.approx(np.median(by_run))
    largest = sets.loc[("RESET", "largest_normalised_error"), "value"]
    assert largest == pytest.approx(runs["largest_error_sum"].max())
    assert sets.loc[("EKF", "violated_runs"), "value"] == pytest.approx(
        40 * summary.loc[("EKF", "violation_share", "all"), "value"]
    )
    switches = summary.loc[("RESET", "model_switches", "all"), "value"]
    assert switches == pytest.approx(runs["switched_sum"].mean())


def test_metrics_are_there_where_they_apply(finished):
    _, folder = finished
    summary = read_table(folder, "summary")
    of = {label: set(rows.metric) for label, rows in summary.groupby("estimator")}
    assert "model_switches" not in of["ESMF"]
    assert {"model_switches", "first_choice_s:1", "models_in_order_share"} <= of["RESET"]
    assert {"process_noise_outside_share", "position_rmse_m"} <= of["raw"]
    assert not any(metric.startswith("velocity") for metric in of["ESMF"])
    assert set(summary.window) == {"all", "late"}


def test_errors_of_every_state_are_scored(finished):
    """Against a plain mean over the runs' and steps' own errors, from the kept tracks."""
    _, folder = finished
    summary = read_table(folder, "summary").set_index(["estimator", "metric", "window"]).value
    runs = read_table(folder, "runs")
    runs = runs[(runs.window == "all") & (runs.estimator == "EKF")]
    tracks = read_table(folder, "tracks").pivot_table("value", "step", ["estimator", "quantity"])
    for state in ("x", "y", "psi"):
        squares = ((tracks["EKF", state] - tracks["truth", state]) ** 2).sum()
        of_run = runs.loc[runs.run == 0, f"squared_error:{state}_sum"].item()
        assert of_run == pytest.approx(squares, rel=1e-9)
        mean = runs[f"squared_error:{state}_sum"].sum() / runs[f"squared_error:{state}_count"].sum()
        assert summary["EKF", f"mse:{state}", "all"] == pytest.approx(mean, rel=1e-12)
        assert summary["EKF", f"rmse:{state}", "all"] == pytest.approx(mean**0.5, rel=1e-12)
    both = sum(summary["EKF", f"mse:{state}", "all"] for state in "xy")
    assert summary["EKF", "position_mse_m2", "all"] == pytest.approx(both, rel=1e-12)


def test_positions_are_scored_in_metres_only(tmp_path, capsys):
    from rich.console import Console

    _, folder = run(tmp_path, text=AIRCRAFT.replace("units: {x: m, y: m}", "units: {x: ft, y: ft}"))
    assert not any("position" in metric for metric in read_table(folder, "summary").metric)
    tables.show(folder, Console(width=80))
    said = capsys.readouterr().out
    assert "RMS, ft" in said
    assert "RMS, rad" in said
    assert "RMS, m" not in said


def test_the_course_without_noise_is_kept(finished):
    one, folder = finished
    course = one.nonlinear.course(one.cases[0].truth.start, 60)[1:]
    tracks = read_table(folder, "tracks")
    for e, state in enumerate(one.nonlinear.state_names):
        mine = tracks[(tracks.estimator == "noise_free") & (tracks.quantity == state)]
        np.testing.assert_array_equal(mine.value, course[:, e])


def test_missed_scans_are_predicted_over(tmp_path):
    """Half of them: bounds are wider, and the truth is still contained; raw is scored at scans."""
    chosen = ("noise.detection_probability=0.5", "monte_carlo.keep_tracks=40")
    _, folder = run(tmp_path, settings_=chosen)
    tracks = read_table(folder, "tracks")
    seen = tracks[(tracks.estimator == "measurement") & (tracks.quantity == "x")].value.notna()
    assert abs(seen.mean() - 0.5) < 4 * np.sqrt(0.25 / seen.size)  # k = 4
    sets = read_table(folder, "sets").set_index(["estimator", "figure"]).value
    assert sets["ESMF", "violated_runs"] == 0
    summary = read_table(folder, "summary").set_index(["estimator", "metric", "window"]).value
    assert summary["raw", "position_rmse_m", "all"] == pytest.approx(0.09, rel=1e-9)
    _, complete = run(tmp_path, "complete")
    wider = read_table(complete, "summary").set_index(["estimator", "metric", "window"]).value
    bound = ("ESMF", "mean_bound:x", "all")
    assert summary[bound] > wider[bound]


RUNS_AWAY = """\
name: runs_away
clock: {step_s: 1, duration_s: 60}
states: [x]
dynamics: {x: x**2}
measurement: {x: x}
truth: {start: [0.9]}
noise: {kind: ball, process: {x: 0.2}, measurement: {x: 0.1}}
initial: {mean: truth, half_axes: {x: 0.1}}
estimators: {ESMF: {type: esmf}, EKF: {type: ekf}}
compare_with: EKF
monte_carlo: {runs: 40, seed: 1}
"""


def test_a_truth_that_runs_away_is_told_and_left_out(tmp_path, capsys):
    from rich.console import Console

    _, folder = run(tmp_path, text=RUNS_AWAY)
    runs = read_table(folder, "runs").set_index(["estimator", "run"]).status
    lost = runs["raw"] > 0
    assert 0 < lost.sum() < 40
    for label in ("ESMF", "EKF"):
        assert (runs[label][lost] > 0).all()
        assert (runs[label][lost] <= runs["raw"][lost]).all()
    summary = read_table(folder, "summary")
    assert np.isfinite(summary.value).all()
    tables.show(folder, Console(width=200))
    said = capsys.readouterr().out
    assert f"raw: in {lost.sum()} of 40 runs the truth itself runs away" in " ".join(said.split())


def test_steps_have_bounds_and_models(finished):
    _, folder = finished
    steps = read_table(folder, "steps")
    shares = steps[steps.metric.str.startswith("chosen_share") & (steps.estimator == "RESET")]
    np.testing.assert_allclose(shares.groupby("step").value.sum(), 1.0)
    assert (steps[steps.metric == "bound:psi"].value > 0).all()
    tracks = read_table(folder, "tracks")
    assert set(tracks[tracks.quantity == "model"].value) <= {1.0, 2.0}


def test_workers_and_continued_runs_give_the_same_bytes(tmp_path):
    longer = AIRCRAFT.replace("runs: 40", "runs: 300")
    _, one = run(tmp_path, "one", longer)
    _, two = run(tmp_path, "two", longer, workers=2)
    _, three = run(tmp_path, "three")
    three.rename(tmp_path / "gone_on")
    _, three = run(tmp_path, "gone_on", longer)
    for table in ("summary", "sets", "steps", "runs"):
        for other in (two, three):
            left, right = (read_table(folder, table) for folder in (one, other))
            assert left.equals(right), table


def test_the_printed_output_says_what_came_of_the_sets(finished, capsys):
    from rich.console import Console

    _, folder = finished
    tables.show(folder, Console(width=200))
    said = capsys.readouterr().out
    assert "sets: runs that" in said
    assert "bounds of RESET against ESMF's (medians): x +" in said
    assert "leaves its ellipsoid" not in said
    told = " ".join(said.split())
    assert "emptied: a measurement left nothing of the set (noise or remainder beyond" in told
    assert "diverged: a bound grew past `growth` times the first one, or a value was" in told
    assert "useless: the bound on an angle exceeds pi at some step" in told
    assert json.dumps(tables.as_json(folder)["sets"][0])


def test_noise_that_leaves_its_ellipsoid_is_told(tmp_path, capsys):
    from rich.console import Console

    _, folder = run(tmp_path, settings_=("noise.kind=truncated_gaussian",))
    tables.show(folder, Console(width=200))
    said = capsys.readouterr().out
    assert "the process noise leaves its ellipsoid in 3" in said
    assert "the measurement noise leaves its ellipsoid in 1" in said


def test_noise_in_the_ellipsoid_that_filters_believe_in_is_inside(tmp_path, capsys):
    from rich.console import Console

    chosen = ("noise.kind=persistent_box", "noise.contains_box=true")
    _, folder = run(tmp_path, settings_=chosen)
    tables.show(folder, Console(width=200))
    assert "leaves its ellipsoid" not in capsys.readouterr().out
    one = loaded(tmp_path, AIRCRAFT, *chosen).nonlinear
    np.testing.assert_allclose(np.diag(one.process_noise_shape), 3 * 0.01**2)
    np.testing.assert_allclose(np.diag(one.measurement_noise_shape), 2 * 0.09**2)


def test_units_with_signs_of_mathematics_are_drawn_as_they_are(tmp_path):
    from hybridtrack import pictures

    text = AIRCRAFT.replace("units: {x: m, y: m}", "units: {x: '$\\frac{$', y: ''}")
    _, folder = run(tmp_path, text=text)
    assert {path.stem for path in pictures.draw_run(folder)} >= {"sets", "bound"}


def test_what_cannot_be_bounded_is_told(tmp_path, capsys):
    """A heading that jumps by pi every half turn: there it is left out, and the run says so."""
    from rich.console import Console

    text = AIRCRAFT.replace("measurement: {x: x, y: y}", "measurement: {x: x, y: atan(tan(psi))}")
    chosen = ("truth.start=[0, 0, 1.4]", "noise.kind=ball", "estimators.RESET={type: esmf}")
    _, folder = run(tmp_path, text=text, settings_=chosen)
    sets = read_table(folder, "sets").set_index(["estimator", "figure"]).value
    assert sets["ESMF", "violated_runs"] == 0
    tables.show(folder, Console(width=200))
    assert "ESMF leaves out" in capsys.readouterr().out


def test_an_adversary_plays_against_one_estimator(tmp_path):
    chosen = ("noise.kind=adversary", "noise.against=ESMF", "truth.spread=sphere")
    _, folder = run(tmp_path, settings_=(*chosen, "initial.mean=[0, 0, 0]"))
    sets = read_table(folder, "sets").set_index(["estimator", "figure"]).value
    assert 0.8 < sets["ESMF", "largest_normalised_error"] <= 1 + 1e-9
    assert sets["ESMF", "violated_runs"] == 0
    assert sets["EKF", "violated_runs"] == 40


def test_runs_that_diverge_are_kept_apart(tmp_path):
    """A filter that is only allowed to grow by a tenth: all diverge, none is violated."""
    _, folder = run(
        tmp_path,
        settings_=("estimators.ESMF.growth=1.1",),
    )
    sets = read_table(folder, "sets").set_index(["estimator", "figure"]).value
    assert sets["ESMF", "diverged_runs"] == 40
    assert sets["ESMF", "violated_runs"] == 0
    assert np.isinf(sets["ESMF", "median_bound:psi"])
    assert results.require_complete(folder)["diverged"] == {"ESMF": 40}


def test_figures_are_drawn(finished):
    from hybridtrack import pictures

    _, folder = finished
    names = {path.stem for path in pictures.draw_run(folder)}
    assert {"trajectory", "sets", "bound", "operating_points", "model_chosen"} <= names


def test_a_baseline_holds_set_figures_too(tmp_path, monkeypatch):
    from hybridtrack.estimators import esmf
    from hybridtrack.studies import baselines, reports

    _, folder = run(tmp_path)
    baselines.write(folder, tmp_path / "base.parquet")
    held = baselines.read(tmp_path / "base.parquet")
    assert not reports.held_against(folder, held).failed
    box = esmf.around_box
    monkeypatch.setattr(esmf, "around_box", lambda radius, rule: 9 * box(radius, rule))
    _, other = run(tmp_path, "worse")
    found = reports.held_against(other, held).comparison.changes
    assert "mean_bound:psi" in {c.metric for c in found if c.verdict == "worse"}


CLAIMS = """\
published:
  - claim: a
    figure: jacobian
    where: {row: x, column: psi, psi: 0.22}
    value: -0.02
    expect: reproduced
  - {claim: b, figure: end_point, where: {state: psi}, value: 0.3, expect: reproduced}
  - {claim: c, estimator: ESMF, metric: violation_share, value: 0, tolerance: 0, expect: reproduced}
  - {claim: d, compare: [RESET, ESMF], metric: "mean_bound:psi", sign: less, expect: not reproduced}
"""


def test_claims_on_sets_are_judged(tmp_path):
    _, folder = run(tmp_path, text=AIRCRAFT + CLAIMS)
    rows = results.read_rows(folder, "published")
    assert [row["verdict"] for row in rows] == [
        "reproduced",
        "reproduced",
        "reproduced",
        "not reproduced",
    ]
    assert rows[0]["ours"] == pytest.approx(-0.1 * np.sin(0.22))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("row: x", "row: q", "needs 'row', a state"),
        ("psi: 0.22", "phi: 0.22", "'phi' has no place in 'where'"),
        ("figure: end_point", "figure: end_points", "did you mean 'end_point'"),
        ('"mean_bound:psi"', '"mean_bound:q"', "which RESET doesn't have"),
        ("metric: violation_share", "metric: model_switche", "which is not known"),
        ("metric: violation_share", "metric: velocity_rmse_m_s", "which ESMF doesn't have"),
        ("metric: violation_share", "metric: process_noise_outside_share", "which ESMF doesn't"),
    ],
)
def test_claims_that_fit_nothing_are_refused(old, new, said, tmp_path):
    assert old in CLAIMS
    message = complaint(AIRCRAFT + CLAIMS.replace(old, new, 1), tmp_path / "s.yaml")
    assert said in message


def test_other_scenarios_don_t_load_sympy():
    import subprocess
    import sys

    code = (
        "import sys; from hybridtrack import config; config.load('rmimm_fig5');"
        "assert not {'sympy', 'flint', 'mpmath'} & {*sys.modules}"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_chains_and_analyses_need_modes(tmp_path):
    from hybridtrack import pictures
    from hybridtrack.analyses import analyses

    file = tmp_path / "aircraft.yaml"
    file.write_text(AIRCRAFT)
    with pytest.raises(UserError, match="no modes"):
        pictures.draw_chains(str(file), None)
    with pytest.raises(UserError, match="no switch of mode"):
        analyses()["delay"].wants_run(loaded(tmp_path))


def test_pairs_of_a_finished_folder(finished):
    _, folder = finished
    pair = outcomes.paired(folder, "RESET", "ESMF", "mean_bound:psi", "all")
    assert pair.ratio.value > 1
