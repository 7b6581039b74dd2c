"""`hybridtrack analyze`: what it prints, what it writes, what it refuses, its verdicts."""

import json
import math

import numpy as np
import pandas as pd
import pytest

from hybridtrack import charts, config, dossiers, experiment, figures
from hybridtrack.analyses import (
    Analysis,
    Band,
    Chart,
    Findings,
    Line,
    Mark,
    Panel,
    Table,
    analyses,
)
from hybridtrack.errors import UserError
from hybridtrack.studies import analysis as studies
from hybridtrack.verdicts import AnalysisClaim, Interval, judge_interval
from test_cli import hybridtrack, one_sentence

SMALL = ("analyze", "delay", "mode_delay_fig4", "--runs", "300")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    cwd = tmp_path_factory.mktemp("analyzed")
    return cwd, hybridtrack(*SMALL, cwd=cwd)


def folder_of(finished):
    cwd, done = finished
    assert done.returncode == 0, done.stderr
    return cwd / done.stdout.splitlines()[-1]


def test_it_prints_a_table_conclusions_verdicts_and_the_folder_last(finished):
    folder = folder_of(finished)
    assert folder.parent.name == "runs"
    assert folder.name.startswith("mode_delay_fig4-delay-")
    assert {path.name for path in folder.iterdir()} == {
        "analysis.json",
        "config.yaml",
        "figures",
        "pairs.parquet",
        "table.csv",
        "table.parquet",
        "tuning.parquet",
    }
    assert {path.stem for path in (folder / "figures").iterdir()} == {
        "mode_estimate",
        "delay_distribution",
    }
    lines = finished[1].stdout.splitlines()
    assert max(map(len, lines)) <= 84  # a table is as wide as it needs to be
    text = " ".join(finished[1].stdout.split())
    assert "Measurements without noise predict 4 of 4 delays exactly" in text
    assert "IMM is the soonest" in text
    assert "published claim" in text


def test_its_tables_are_what_it_prints(finished):
    folder = folder_of(finished)
    table = pd.read_parquet(folder / "table.parquet")
    assert list(zip(table.switch, table.estimator, strict=True)) == [
        (1, "IMM"),
        (1, "MMAE"),
        (2, "IMM"),
        (2, "MMAE"),
    ]
    assert table.averaged_delay_steps.tolist() == [1, 6, 2, 10]
    assert table.mean_trajectory_delay_steps.tolist() == [1, 6, 2, 10]
    assert np.isinf(table.proposition_4_2_condition_1_delay_steps).all()
    assert table.proposition_4_2_condition_1_result.unique().tolist() == ["never satisfied"]
    assert table.proposition_4_2_condition_2_delay_steps.isna().all()
    ingredients = ["alpha", "beta", "sigma_max_F_T", "sigma_min_F_i", "error_T", "error_i"]
    assert np.isfinite(table[[*ingredients, "log_determinant_ratio"]]).all(axis=None)
    written = pd.read_csv(folder / "table.csv")
    assert written.columns.tolist() == table.columns.tolist()
    record = json.loads((folder / "analysis.json").read_text())
    assert [row["averaged_delay_steps"] for row in record["table"]] == [1, 6, 2, 10]
    assert record["conclusions"]
    assert {row["verdict"] for row in record["published"]} == {
        "reproduced",
        "reproduced with stated assumptions",
        "not reproduced",
    }
    assert not any(row["differs"] for row in record["published"])


def test_a_finished_analysis_is_shown_and_force_repeats_it(finished):
    cwd, first = finished
    folder = folder_of(finished)
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    times = {p: p.stat().st_mtime_ns for p in before}
    again = hybridtrack(*SMALL, cwd=cwd)
    assert again.stdout == first.stdout
    assert "complete already" in again.stderr
    assert times == {p: p.stat().st_mtime_ns for p in before}
    forced = hybridtrack(*SMALL, "--force", "--workers", "1", cwd=cwd)
    assert forced.stdout == first.stdout
    assert before == {p: p.read_bytes() for p in before}


def test_json_is_alone_on_stdout_and_has_no_infinity(finished):
    cwd, _ = finished
    done = hybridtrack(*SMALL, "--json", "--quiet", cwd=cwd)
    assert done.stderr == ""
    record = json.loads(done.stdout, parse_constant=pytest.fail)
    assert record["analysis"] == "delay"
    assert record["table"][0]["proposition_4_3_delay_steps"] == "inf"
    assert record["table"][0]["proposition_4_2_condition_2_delay_steps"] is None
    assert record["table"][0]["proposition_4_3_result"] == "never satisfied"


def test_without_a_scenario_the_papers_is_taken(tmp_path):
    done = hybridtrack("analyze", "delay", "--runs", "20", cwd=tmp_path)
    assert done.returncode == 0
    assert "no scenario given: this is mode_delay_fig4" in done.stderr


def test_the_run_is_the_one_that_run_makes(finished, tmp_path):
    cwd, _ = finished
    done = hybridtrack("run", "mode_delay_fig4", "--runs", "300", cwd=cwd)
    assert "complete already" in done.stderr
    assert "delay in steps" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("analyze", "dely"), ("no analysis 'dely'", "did you mean 'delay'?")),
        (("analyze", "delay", "nowhere"), ("no such file",)),
        (
            ("analyze", "delay", "recorded_flight"),
            ("recorded_flight.yaml:", "no switch of mode", "legs"),
        ),
        (
            ("analyze", "sojourn", "observability_scalar"),
            ("observability_scalar.yaml:", "mode 'single' has no stabilising solution"),
        ),
        (("analyze", "stability", "--as-printed"), ("--as-printed", "leave it out")),
        (
            ("analyze", "delay", "mode_delay_fig4", "--set", "analyses.delay.as_printd=true"),
            ("'as_printd' is not a key here",),
        ),
        (
            ("analyze", "delay", "mode_delay_fig4", "--set", "published.0.figure=averaged_dely"),
            ("has no column 'averaged_dely'", "--set published.0.figure=averaged_dely"),
        ),
        (
            ("analyze", "delay", "mode_delay_fig4", "--set", "published.0.figure=averaged_delay"),
            ("'averaged_delay' is a text (1)",),
        ),
        (
            ("analyze", "delay", "mode_delay_fig4", "--set", "published.0.where={switch: 1}"),
            ("2 rows", "'where' has to tell one"),
        ),
        (
            ("analyze", "delay", "mode_delay_fig4", "--set", "published.0.where={switch: 7}"),
            ("no row", "switch 7"),
        ),
    ],
)
def test_bad_input_is_one_sentence(arguments, words, finished, said):
    cwd, _ = finished
    done = said(*arguments, "--runs", "20", "--quiet", cwd=cwd)
    sentence = one_sentence(done)
    for word in words:
        assert word in sentence


def test_a_folder_of_something_else_stays_as_it_is(finished, tmp_path):
    cwd, _ = finished
    (tmp_path / "notes.txt").write_text("mine")
    done = hybridtrack(*SMALL, "--out", tmp_path, "--quiet", cwd=cwd)
    assert "holds something else" in one_sentence(done)
    done = hybridtrack(*SMALL, "--out", tmp_path, "--force", "--quiet", cwd=cwd)
    assert "so it isn't cleared" in one_sentence(done)
    run = next(p for p in (cwd / "runs").iterdir() if (p / "manifest.json").exists())
    done = hybridtrack(*SMALL, "--out", run, "--force", "--quiet", cwd=cwd)
    assert "so it isn't cleared" in one_sentence(done)
    other = ("analyze", "delay", "mode_delay_fig4", "--runs", "20", "--out", folder_of(finished))
    assert "holds another analysis" in one_sentence(hybridtrack(*other, "--quiet", cwd=cwd))


def test_a_damaged_analysis_is_told(finished, tmp_path):
    cwd, _ = finished
    out = tmp_path / "out"
    assert hybridtrack(*SMALL, "--out", out, "--quiet", cwd=cwd).returncode == 0
    (out / "analysis.json").write_text("{")
    done = hybridtrack(*SMALL, "--out", out, "--quiet", cwd=cwd)
    assert "this file is damaged" in one_sentence(done)
    assert "--force" in done.stderr
    assert hybridtrack(*SMALL, "--out", out, "--force", "--quiet", cwd=cwd).returncode == 0


CLAIMED = [
    (name, analysis)
    for name in sorted(config.shipped())
    for analysis in sorted({c.analysis for c in config.load(name).analysis_claims})
]
OTHERS = [
    (name, analysis)
    for analysis in analyses()
    for name in sorted(config.shipped())
    if (name, analysis) not in CLAIMED
]


def check_record(record, folder):
    """An analysis that found something, and drew it."""
    assert record["table"]
    assert record["conclusions"]
    for drawn in record["figures"]:
        assert (folder / "figures" / drawn).exists()


@pytest.mark.parametrize(("name", "analysis"), OTHERS)
def test_every_shipped_scenario_can_be_analysed_or_says_why(name, analysis, tmp_path):
    one, settings, run = analyses()[analysis], ["monte_carlo.runs=10"], None
    refused = None
    try:
        loaded = config.load(name, settings)
        if one.wants_run is not None:
            loaded = config.load(name, [*settings, *one.wants_run(loaded)])
            run = tmp_path / "run"
            experiment.run(loaded, run, 2, lambda done, total: None)
        record = studies.analyse(loaded, one, tmp_path / analysis, run)
    except UserError as error:
        refused = str(error)
    if refused is not None:
        assert "\n" not in refused
        return
    check_record(record, tmp_path / analysis)


@pytest.mark.parametrize(("name", "analysis"), CLAIMED)
def test_every_verdict_is_the_expected_one(name, analysis, shipped):
    folder, record = shipped.analysis(name, analysis)
    check_record(record, folder)
    assert record["published"]
    for row in record["published"]:
        assert row["verdict"] == row["expected_verdict"], row


def test_what_is_too_short_is_said_of_runs_and_by_validate(tmp_path):
    done = hybridtrack("validate", "--theory", "observability_turns", "rmimm_fig5", cwd=tmp_path)
    assert done.returncode == 0
    first, said, second = done.stdout.splitlines()
    assert first.startswith("observability_turns: ok")
    assert said.strip().startswith("stretch 2 (60 to 72 s, hard) lasts 6 scans")
    assert second.startswith("rmimm_fig5: ok")
    plain = hybridtrack("validate", "observability_turns", cwd=tmp_path)
    assert plain.stdout.splitlines() == [first]
    run = hybridtrack("run", "observability_turns", "--runs", "20", "-q", cwd=tmp_path)
    assert "too short by theory" in run.stdout
    assert "stretch 2 (60 to 72 s, hard) lasts 6 scans" in " ".join(run.stdout.split())
    again = hybridtrack("run", "observability_turns", "--runs", "20", "-q", "--json", cwd=tmp_path)
    assert json.loads(again.stdout)["theory"] == [said.strip()]


# ---- verdicts --------------------------------------------------------------------------------


def claim(**changes):
    fixed = {
        "claim": "c",
        "analysis": "a",
        "figure": "f",
        "where": {},
        "than": None,
        "value": 2.0,
        "tolerance": 0.5,
        "sign": None,
        "expect": "reproduced",
        "because": "",
        "place": "s.yaml:1:1",
    }
    return AnalysisClaim(**(fixed | changes))


@pytest.mark.parametrize(
    ("changes", "interval", "verdict"),
    [
        ({}, (2.1, 2.0, 2.2), "reproduced"),
        ({}, (2.4, 2.2, 2.6), "undecided: too few runs"),
        ({}, (3.0, 2.6, 3.4), "not reproduced"),
        ({}, (math.inf, math.inf, math.inf), "not reproduced"),
        ({}, (math.nan, math.nan, math.nan), "not reproduced"),
        ({"sign": "less"}, (1.0, 0.5, 1.5), "reproduced"),
        ({"sign": "less"}, (2.0, 2.0, 2.0), "not reproduced"),
        ({"sign": "less"}, (1.9, 1.5, 2.3), "undecided: too few runs"),
        ({"sign": "greater"}, (3.0, 2.5, 3.5), "reproduced"),
        ({"sign": "greater"}, (math.inf, math.inf, math.inf), "reproduced"),
        ({"sign": "greater", "value": None}, (-1.0, -2.0, -0.5), "not reproduced"),
        ({"sign": "less", "value": None}, (-1.0, -2.0, -0.5), "reproduced"),
    ],
)
def test_verdicts_on_figures_of_analyses(changes, interval, verdict):
    assert judge_interval(claim(**changes), Interval(*interval), assumptions=False) == verdict


def test_stated_assumptions_are_part_of_a_verdict():
    met = judge_interval(claim(), Interval(2.0, 2.0, 2.0), assumptions=True)
    assert met == "reproduced with stated assumptions"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("analysis: delay, value: 1", "'figure' is missing"),
        ("analysis: dely, figure: f, value: 1", "'analysis' is dely; it must be"),
        ("analysis: delay, figure: f", "'value' is missing"),
        ("analysis: delay, figure: f, value: 1, estimator: IMM", "'estimator' is a run's"),
        ("analysis: delay, figure: f, value: 1, window: w", "'window' is a run's"),
        ("analysis: delay, figure: f, than: {a: 1}", "needs 'sign', less or greater"),
        ("analysis: delay, figure: f, than: {a: 1}, sign: equal", "needs 'sign', less or greater"),
        ("figure: f, where: {a: 1}, value: 1", "'where' is a row of an analysis' table"),
        ("figure: f, value: 1", "'figure' is f, which needs an 'analysis'"),
    ],
)
def test_claims_on_analyses_that_do_not_fit(text, sentence):
    setting = f"published=[{{claim: c, expect: reproduced, {text}}}]"
    with pytest.raises(UserError) as caught:
        config.load("mode_delay_fig4", [setting])
    assert sentence in str(caught.value)


def test_printed_digits_are_a_figures_tolerance():
    setting = (
        "published=[{claim: c, expect: reproduced, analysis: delay, figure: alpha, value: 3.70}]"
    )
    (one,) = config.load("mode_delay_fig4", [setting]).analysis_claims
    assert one.tolerance == pytest.approx(0.005)


# ---- any analysis ----------------------------------------------------------------------------


def findings(**columns):
    return Findings(Table(columns), ["A conclusion."])


def made(result, tmp_path, claims="published=[]"):
    loaded = config.load("mode_delay_fig4", [claims])
    template = analyses()["delay"]
    one = Analysis(
        name="delay",
        summary="s",
        source="s",
        settings=template.settings,
        analyse=lambda experiment, settings, measured: result,
        example="x",
    )
    return studies.analyse(loaded, one, tmp_path / "out", None)


def test_columns_keep_their_types(tmp_path):
    record = made(
        findings(
            a=[1, None, 3],
            b=[1, 2.5, None],
            c=["x", None, "z"],
            d=[True, False, None],
            e=[np.float64(1.0), np.inf, np.nan],
            f=[None, None, None],
            g=[np.int64(4), 5, 6],
        ),
        tmp_path,
    )
    table = pd.read_parquet(tmp_path / "out/table.parquet")
    kinds = {name: str(kind) for name, kind in table.dtypes.items()}
    assert kinds["b"] == kinds["e"] == kinds["f"] == "float64"
    assert kinds["g"] == "int64"
    assert table.e.tolist()[:2] == [1.0, math.inf]
    assert [row["e"] for row in record["table"]] == [1.0, "inf", None]
    assert record["table"][0]["d"] is True


def test_a_column_of_two_types_is_a_bug(tmp_path):
    with pytest.raises(TypeError, match="float, str"):
        dossiers.arrow(Table({"a": [1.0, "x"]}))


def test_a_figures_error_decides(tmp_path):
    columns = {"name": ["a", "b"], "x": [1.0, 1.2], "x_standard_error": [0.01, 0.2]}
    text = (
        "published=[{claim: c, analysis: delay, figure: x, where: {name: a}, value: 1, "
        "tolerance: 0.1, expect: reproduced}, "
        "{claim: d, analysis: delay, figure: x, where: {name: a}, than: {name: b}, sign: less, "
        "expect: reproduced}]"
    )
    first, second = made(findings(**columns), tmp_path, text)["published"]
    assert first["verdict"] == "reproduced with stated assumptions"
    assert first["standard_error"] == pytest.approx(0.01)
    assert second["verdict"] == "undecided: too few runs"
    assert not second["differs"]


# ---- charts ----------------------------------------------------------------------------------


def test_every_part_of_a_chart_is_drawn(tmp_path):
    x = np.linspace(1.0, 10.0, 50)
    chart = Chart(
        "name",
        "A caption with $ signs",
        "steps",
        [
            Panel(
                "first",
                [Line("a", x, x**2), Line("truth", x, x, reference=True)],
                [Band("a", x, x**2 - 1, x**2 + 1), Band("alone", x, x, 2 * x)],
                [Mark("here", x=3.0, like="a"), Mark("level", y=10.0)],
                log_y=True,
            ),
            Panel("second", [Line("b", x, -x, steps="post")], y_limits=(-11.0, 0.0)),
        ],
    )
    figure = charts.draw([chart], "A title")["name"]
    first, second = figure.axes
    assert first.get_yscale() == "log"
    assert second.get_ylim() == (-11.0, 0.0)
    assert len(first.lines) == 4
    assert len(first.collections) == 2
    colours = {line.get_label(): line.get_color() for line in first.lines}
    assert colours["here"] == colours["a"] != colours["level"]
    labels = {text.get_text() for text in figure.legends[0].get_texts()}
    assert labels == {"a", "truth", "alone", "here", "level", "b"}
    (path,) = figures.save({"name": figure}, tmp_path)
    assert path.read_bytes()[:4] == b"\x89PNG"
