"""The observability analysis of any scenario: its findings, and what is printed of them."""

import io
import math

import numpy as np
import pytest
from rich.console import Console

from hybridtrack import charts, config, page, tables_of_analyses
from hybridtrack.analyses._short_stretches import warnings_about_legs
from hybridtrack.errors import UserError
from hybridtrack.verdicts import Interval, judge_interval
from scenarios import WITH_MODES
from test_observability import analysed, cell, horizons


def check_findings(findings):
    """Columns of one type and one length, sentences, curves of numbers."""
    for table in (findings.table, *findings.tables.values()):
        assert len({len(column) for column in table.columns.values()}) == 1
        for name, column in table.columns.items():
            types = {type(value) for value in column if value is not None}
            assert len(types) <= 1, name
            assert types <= {float, int, bool, str}, name
            assert not any(isinstance(v, float) and math.isnan(v) for v in column), name
        for shown in table.shown.values():
            assert len(shown) == len(next(iter(table.columns.values())))
            assert all(isinstance(text, str) for text in shown)
    widths = [
        max(map(len, [*heading.split("\n"), *cells]))
        for heading, cells in findings.table.shown.items()
    ]
    assert sum(widths) + 3 * len(widths) <= 80
    assert 1 <= len(findings.conclusions) <= 4
    assert all(text.endswith(".") for text in findings.conclusions)
    for chart in findings.charts:
        for panel in chart.panels:
            for line, band in zip(panel.lines, panel.bands, strict=True):
                assert len(line.x) == len(line.y) == len(band.low) == len(band.high)
                assert (np.diff(line.x) > 0).all()


@pytest.mark.parametrize("name", [name for name in WITH_MODES if name != "recorded_flight"])
def test_every_scenario_gives_findings_or_a_sentence(name):
    if len(config.load(name).bank.modes) < 2:
        with pytest.raises(UserError, match="one mode"):
            analysed(name)
        return
    check_findings(analysed(name))


def test_the_papers_claims_on_the_analysis():
    experiment = config.load("observability_scalar")
    columns = analysed("observability_scalar").table.columns
    assert len(experiment.analysis_claims) == 2
    for claim in experiment.analysis_claims:
        assert claim.analysis == "observability"
        (row,) = [
            row
            for row in range(len(columns["from_mode"]))
            if all(columns[key][row] == value for key, value in claim.where.items())
        ]
        value = columns[claim.figure][row]
        assert judge_interval(claim, Interval(value, value, value), True) == claim.expect


def test_a_recording_with_uneven_steps():
    found = analysed("recorded_flight")
    check_findings(found)
    assert any("steps of their median" in note for note in found.notes)
    assert any("two scans" in note for note in found.notes)


@pytest.mark.parametrize("mean", ["truth", "drawn_about_truth"])
def test_starts_that_follow_a_chains_truth(mean):
    found = analysed("softbound_three_modes", f"initial.mean={mean}")
    check_findings(found)
    assert any("the mean of the chain's own start" in note for note in found.notes)


def test_one_mode_is_refused_by_name():
    one = ["mean_sojourn_s={gentle: 60}", "truth.legs=[{until_s: 200}]"]
    with pytest.raises(UserError, match="one mode, 'gentle'"):
        analysed("observability_turns", *one)


def test_identical_modes_are_never_told_apart_by_name():
    found = analysed("observability_turns", "modes.hard.turn_rate_deg_s=2")
    check_findings(found)
    assert horizons(found, "gentle", "hard") == (math.inf,) * 3
    assert cell(found, "gentle", "hard", "switch_delay_scans") == math.inf
    assert cell(found, "gentle", "hard", "lemma_2") is False
    assert found.conclusions[0] == (
        "gentle and hard can never be told apart at 1 % error: they are the same model."
    )


@pytest.mark.parametrize(
    "changes",
    [
        ["initial.covariance=[[0]]"],
        ["modes.single.state_transition=[[0]]"],
        ["modes.single.measurement_matrix=[[0]]", "modes.double.measurement_matrix=[[0]]"],
        ["modes.double.measurement_noise_covariance=[[1e-20]]"],
        ["modes.double.process_noise_covariance=[[1e20]]"],
        ["initial.covariance=[[1e20]]"],
        ["modes.double.measurement_matrix=[[1e20]]"],
        ["modes.single.state_transition=[[-2]]"],
        ["modes.double.input_effect=[1e20]"],
        ["analyses.observability.most_scans=1"],
    ],
)
def test_numbers_of_any_size_give_findings(changes):
    check_findings(analysed("observability_scalar", *changes))


def test_a_gain_out_of_all_proportion_is_seen_at_once():
    found = analysed("observability_scalar", "modes.double.measurement_matrix=[[1e20]]")
    assert horizons(found, "single", "double") == (1, 1, 1)
    assert horizons(found, "double", "single") == (1, 1, 1)


def test_numbers_that_grow_out_of_bounds_give_findings_that_say_so():
    grow = [f"modes.{mode}.state_transition=[[1e30]]" for mode in ("single", "double")]
    found = analysed("observability_scalar", *grow)
    check_findings(found)
    assert horizons(found, "single", "double") == (None, None, None)
    assert "too large for numbers" in cell(found, "single", "double", "horizon_because")
    assert "too large for numbers" in found.conclusions[0]


def test_the_chart_has_the_target_and_the_bracket():
    found = analysed("softbound_three_modes")
    (chart,) = found.charts
    (panel,) = chart.panels
    assert panel.log_y
    assert [mark.y for mark in panel.marks] == [0.01]
    assert len(panel.lines) == len(panel.bands) == 3
    for line, band in zip(panel.lines, panel.bands, strict=True):
        assert line.label == band.label
        assert (band.low <= line.y * (1 + 1e-7)).all()
        assert (line.y <= band.high * (1 + 1e-7)).all()
        assert line.y[0] > 0.01 > line.y[-1]


# ---- what is printed -------------------------------------------------------------------------


def noted(findings, *words):
    """The notes with all of some words."""
    return [note for note in findings.notes if all(word in note for word in words)]


def test_the_main_table_has_theorem_1_and_the_scans_looked_at():
    found = analysed("observability_turns")
    shown = found.table.shown
    assert shown["theo-\nrem 1"] == ["yes", "yes"]
    assert shown["lemma 2,\n3, ours"] == ["yes no yes"] * 2
    assert shown["told apart:\nscans"] == ["23 (13-34)"] * 2
    few = analysed("observability_turns", "analyses.observability.most_scans=20").table.shown
    assert few["told apart:\nscans"] == [">20 (13-...)"] * 2
    fewer = analysed("observability_turns", "analyses.observability.most_scans=7").table.shown
    assert fewer["told apart:\nscans"] == fewer["switch:\nscans"] == [">7"] * 2
    same = analysed("observability_turns", "modes.hard.turn_rate_deg_s=2").table.shown
    assert same["told apart:\nscans"] == same["switch:\nscans"] == ["never"] * 2
    assert same["any\nstart"] == ["alike"] * 2
    assert same["theo-\nrem 1"] == ["no"] * 2


def test_lemma_3_as_printed_is_said_to_fail_where_modes_share_h_and_r_and_only_there():
    assert noted(analysed("observability_turns"), "all modes here share H and R", "violated")
    same = analysed("observability_turns", "modes.hard.turn_rate_deg_s=2")  # ours fails, too
    assert noted(same, "all modes here share H and R", "violated")
    assert not noted(analysed("observability_scalar"), "all modes here share")
    (note,) = noted(analysed("observability_turns"), "lemma 3 those of")
    assert "of 2 scans" in note
    assert "a transition 2 after the first" in note


def test_notes_say_when_initial_is():
    assert noted(analysed("observability_turns"), "`initial` is the state at the first scan")
    setting = "analyses.observability.initial_at_first_scan"
    assert noted(analysed("observability_turns", f"{setting}=false"), "one step before the first")
    for at, said in ((True, 1), (False, 0)):
        found = analysed("recorded_flight", f"{setting}={str(at).lower()}")
        assert not noted(found, "`initial` is the state")
        assert len(noted(found, "initial_at_first_scan isn't used")) == said


def test_switches_that_are_not_noticed_are_named():
    found = analysed("observability_turns")
    assert found.conclusions[1].endswith("at the soonest (no switch takes longer).")
    few = analysed("observability_turns", "analyses.observability.most_scans=7")
    assert few.conclusions[1] == (
        "No switch is noticed at 1 % error: gentle to hard, hard to gentle (within 7 scans)."
    )
    same = analysed("observability_turns", "modes.hard.turn_rate_deg_s=2")
    assert same.conclusions[1] == (
        "No switch is noticed at 1 % error: gentle to hard, hard to gentle (never)."
    )
    assert noted(found, "a test that knows when the switch took place")


def test_a_switch_that_shows_at_once_is_a_switch():
    found = analysed("observability_scalar", "modes.double.measurement_noise_covariance=[[1e20]]")
    assert cell(found, "single", "double", "switch_delay_scans") == 1
    assert cell(found, "double", "single", "switch_delay_scans") == 1
    assert any("is noticed at 1 % error after 1 scan, 1 s" in text for text in found.conclusions)


def test_modes_alike_by_lemma_2_are_said_to_be_so_for_a_true_reason():
    """A mean, or more scans: outputs of one scan have the variances 1 + 1 and 4 / 4 + 1."""
    quarter = ["modes.double.measurement_noise_covariance=[[1]]"]
    moved = analysed(
        "observability_turns",
        "modes.hard.turn_rate_deg_s=2",
    )
    assert not noted(moved, "finds gentle and hard alike")
    by_mean = analysed(
        "observability_scalar",
        *quarter,
        "modes.double.measurement_matrix=[[-1]]",
        "initial.mean=[9]",
    )
    assert cell(by_mean, "single", "double", "lemma_2") is False
    assert noted(by_mean, "lemma 2 finds single and double alike", "by their means")
    by_scans = analysed(
        "observability_scalar",
        *quarter,
        "modes.double.measurement_matrix=[[1]]",
        "modes.double.process_noise_covariance=[[1]]",
    )
    assert cell(by_scans, "single", "double", "lemma_2") is False
    assert noted(by_scans, "lemma 2 finds single and double alike by the covariances of 1 scan;")


def of_three(*changes):
    """The scenario of two turns with a third that is hardly another than the first."""
    third = "modes.third={motion: coordinated_turn, turn_rate_deg_s: 2.5, acceleration_std_m_s2: 1}"
    return (third, "mean_sojourn_s={gentle: 60, hard: 40, third: 40}", *changes)


def test_a_stretch_has_the_longest_of_its_modes_horizons():
    found = analysed("observability_turns", *of_three("modes.third.turn_rate_deg_s=3.5"))
    table = found.tables["stretches"].columns
    own = {
        old: [
            cell(found, old, new, "horizon_scans")
            for new in ("gentle", "hard", "third")
            if new != old
        ]
        for old in ("gentle", "hard")
    }
    assert len(set(own["gentle"])) == 2
    expected = [max(own[mode]) for mode in table["mode"]]
    assert table["horizon_scans"] == expected


def test_a_stretch_of_just_the_scans_needed_is_long_enough():
    for until, warned in ((44, 1), (46, 0)):
        legs = f"truth.legs=[{{until_s: {until}, mode: gentle}}, {{until_s: 200, mode: hard}}]"
        warnings = warnings_about_legs(config.load("observability_turns", [legs]))
        assert len(warnings) == warned  # 23 scans are needed


def test_a_lint_without_proof_does_not_say_never():
    still = analysed(
        "observability_scalar",
        "modes.double.measurement_noise_covariance=[[1]]",
        "modes.double.input_effect=[0.0001]",
        "analyses.observability.most_scans=64",
    )
    assert cell(still, "single", "double", "horizon_scans") is None
    assert "seems to level off" in still.conclusions[0]
    assert not any("can never" in text for text in still.conclusions)


def test_a_curve_that_never_gets_there_ends_with_those_that_do():
    found = analysed("observability_turns", *of_three("modes.third.turn_rate_deg_s=2"))
    (panel,) = found.charts[0].panels
    ends = {line.label: line.x[-1] for line in panel.lines}
    assert max(ends.values()) == ends["gentle or hard"] == 41  # 1.2 times 34, rounded up
    assert all(
        len(line.x) == len(band.x) for line, band in zip(panel.lines, panel.bands, strict=True)
    )


def test_a_target_has_no_colour_of_the_first_curves():
    assert not set(charts.MARKS) & set(page.COLOURS[:3])


def test_long_names_of_modes_fold_on_a_narrow_terminal():
    columns = {"from": ["constant_velocity"], "to": ["coordinated_turning"], "n": ["1" * 40]}
    record = {
        "title": "t",
        "summary": "s",
        "shown": [{"name": "", "columns": columns}],
        "conclusions": [],
        "notes": [],
        "published": [],
    }
    out = io.StringIO()
    tables_of_analyses.show_analysis(
        record, Console(file=out, width=70, force_terminal=True, color_system=None)
    )
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= 70
    assert any("1" * 40 in line for line in lines)
    assert not any("coordinated_turning" in line for line in lines)


def test_the_first_claim_asks_for_more_than_rounding():
    claim = config.load("observability_scalar").analysis_claims[0]
    assert judge_interval(claim, Interval(1e-12, 1e-12, 1e-12), True) != claim.expect
