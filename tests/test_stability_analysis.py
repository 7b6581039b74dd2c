"""The stability analysis of any bank: its findings, its notes, and what it refuses."""

import numpy as np
import pytest

from hybridtrack.analyses import stability as room
from hybridtrack.analyses._examination import examine
from hybridtrack.analyses._stability_words import verdict
from hybridtrack.analyses.stability import findings, longest_sequence
from hybridtrack.config import load
from hybridtrack.errors import UserError
from models import RANDOM, SMALL, scenario
from scenarios import CHAIN, WITH_MODES
from test_stability import CREEPING, ENDLESS, analyse, model_of, row


def check_shape(found):
    """Tables of equal, uniform columns; charts of equal lengths; whole sentences."""
    for table in (found.table, *found.tables.values()):
        lengths = {len(values) for values in table.columns.values()}
        assert len(lengths) == 1
        for name, values in table.columns.items():
            kinds = {type(value) for value in values if value is not None}
            assert len(kinds) <= 1, (name, kinds)
            assert kinds <= {int, float, bool, str}
            assert not any(value != value for value in values), name
        for cells in table.shown.values():
            assert {len(cells)} == lengths
        widths = [
            max(len(text) for text in (*heading.split("\n"), *cells))
            for heading, cells in table.shown.items()
        ]
        assert sum(widths) + 2 * len(widths) <= 80
    assert len(found.charts) == 2
    for chart in found.charts:
        for panel in chart.panels:
            for line in panel.lines:
                assert len(line.x) == len(line.y)
    assert 1 <= len(found.conclusions) <= 4
    assert all(s[0].isupper() and s.endswith(".") and "nan" not in s for s in found.conclusions)


@pytest.mark.parametrize("name", WITH_MODES)
def test_every_shipped_scenario_has_findings(name):
    found = analyse(load(name, ["analyses.stability.steps=200"]))
    check_shape(found)


ODD = {
    "zero noise": ["modes.slow.process_noise_covariance=[[0, 0], [0, 0]]"],
    "no noise at all": [
        f"modes.{mode}.process_noise_covariance=[[0, 0], [0, 0]]" for mode in ("slow", "fast")
    ],
    "a mode that sees nothing": ["modes.fast.measurement_matrix=[[0, 0]]"],
    "an unstable mode": ["modes.fast.state_transition=[[1.5, 0.5], [0, 2]]"],
    "unstable and unseen": [
        "modes.fast.state_transition=[[1.5, 0.5], [0, 2]]",
        "modes.fast.measurement_matrix=[[0, 1]]",
    ],
    "a mode without memory": ["modes.fast.state_transition=[[0, 0], [0, 0]]"],
    "no memory at all": [
        f"modes.{mode}.state_transition=[[0, 0], [0, 0]]" for mode in ("slow", "fast")
    ],
    "hardly any noise": CREEPING,
    "a position never measured": ENDLESS,
    "huge noise": ["modes.fast.process_noise_covariance=[[1e20, 0], [0, 1e20]]"],
    "a perfect sensor": ["modes.fast.measurement_noise_covariance=[[1e-30]]"],
    "modes that never change": ["transition_matrix=[[1, 0], [0, 1]]"],
    "modes that always change": ["transition_matrix=[[0, 1], [1, 0]]"],
    "a mode that none leads to": ["transition_matrix=[[1, 0], [1, 0]]"],
    "an exact start": ["initial={mean: [0, 10]}"],
    "a spread that is given": ["analyses.stability.spread_std=[1, 2]"],
    "no spread": ["analyses.stability.spread_std=[0]"],
    "two measurements": ["analyses.stability.measurements=2"],
}


@pytest.mark.parametrize("name", ODD)
def test_odd_banks_have_findings_too(name, tmp_path):
    changes = [*ODD[name], "analyses.stability.steps=300"]
    check_shape(analyse(scenario(tmp_path, CHAIN, *changes)))


@pytest.mark.parametrize("text", [SMALL, RANDOM])
def test_starts_that_are_left_to_runs_are_told(text, tmp_path):
    found = analyse(scenario(tmp_path, text, "analyses.stability.steps=200"))
    check_shape(found)
    assert any("starts about the truth's first state" in note for note in found.notes)
    assert any("every scan as detected" in note for note in found.notes)


def test_a_flight_that_runs_away_ends_early_and_says_so(tmp_path):
    away = "modes.fast.state_transition=[[1.5, 0.5], [0, 2]]"
    found = analyse(scenario(tmp_path, CHAIN, away))
    assert any("the simulation ends before its 5,000 steps" in note for note in found.notes)
    both = [f"modes.{m}.state_transition=[[1e7, 0.5], [0, 1e7]]" for m in ("slow", "fast")]
    with pytest.raises(UserError, match="within two steps"):
        analyse(scenario(tmp_path, CHAIN, *both))


def test_a_floor_that_doesnt_hold_yet_is_told(tmp_path):
    """Without a position ever measured, its doubt grows for ever, and the floor with it."""
    found = analyse(scenario(tmp_path, CHAIN, *ENDLESS))
    note = next(note for note in found.notes if "settled floor didn't hold" in note)
    assert "it is a bound from step" in note
    assert row(found.tables["eigenvalues"], bound="floor")["steps_broken"] > 0


def test_a_given_spread_is_held_against_the_simulation():
    narrow = analyse(load("stability_cv_ct", ["analyses.stability.spread_std=[10, 1, 10, 1]"]))
    note = next(note for note in narrow.notes if "exceeded what is given at" in note)
    share = note[note.index(" at ") :]
    assert narrow.conclusions[1].endswith(
        f"rests on the spread of the means, which the simulation exceeded{share}."
    )
    assert f"vy 1 (given), which the simulation exceeded{share}." in narrow.conclusions[2]
    wide = analyse(load("stability_cv_ct", ["analyses.stability.spread_std=[300]"]))
    assert any("never exceeded what is given" in note for note in wide.notes)
    assert wide.conclusions[2].endswith("(given).")
    assert not any("the simulation exceeded" in sentence for sentence in wide.conclusions)
    assert row(wide.tables["eigenvalues"], bound="ceiling given the spread")["steps_broken"] == 0


def test_no_spread_is_told_once():
    """The ceiling given a spread of 0 is the one without a spread."""
    none = analyse(load("stability_cv_ct", ["analyses.stability.spread_std=[0]"]))
    assert not any(sentence.startswith("Without the spread") for sentence in none.conclusions)
    assert "(given), which the simulation exceeded at 99." in none.conclusions[2]
    some = analyse(load("stability_cv_ct"))
    assert some.conclusions[3].startswith("Without the spread of the modes' means")


def test_what_could_not_be_checked_is_told():
    """11 steps are fewer than N = 12, and than the ceiling takes to settle."""
    changes = ["analyses.stability.steps=11", "analyses.stability.measurements=12"]
    notes = analyse(load("stability_cv_ct", changes)).notes
    assert "the floor isn't checked from N = 12 on: the simulation has only 11 steps" in notes
    note = next(note for note in notes if note.startswith("the ceiling without spread, due from"))
    assert note.endswith("on, isn't checked: the simulation has only 11 steps")
    long = analyse(load("stability_cv_ct", ["analyses.stability.steps=200"])).notes
    assert not any("isn't checked" in note for note in long)


def test_a_certified_rate_is_useless_only_where_it_is():
    """Time constants of 4 / log(1 + c_1) steps, against some 6 simulated."""
    found = examine(model_of("stability_cv_ct"), 2, 300, 1)
    simulated = -1 / np.log(found.rate.per_step)
    for times, useless in ((1010, True), (990, False), (12, False)):
        c_1 = np.expm1(4 / (times * simulated))
        certificate = found.certificate._replace(c_1=c_1)
        sentence = findings(found._replace(certificate=certificate)).conclusions[1]
        assert ("valid and useless" in sentence) == useless
        assert (f", {times} times the simulated one; this rests" in sentence) == (not useless)
    rate = found.rate._replace(trend="rising")
    sentence = findings(found._replace(rate=rate)).conclusions[1]
    assert "useless" not in sentence
    assert "times" not in sentence


def test_one_mode_is_no_imm(tmp_path):
    text = CHAIN.replace("estimators: {IMM: {type: imm}, ", "estimators: {")
    changes = [
        "modes={slow: {state_transition: [[1, 1], [0, 1]], "
        "process_noise_covariance: [[1, 0], [0, 1]]}}",
        "transition_matrix=[[1]]",
        "truth.chain.initial.mode_probabilities=[1]",
    ]
    with pytest.raises(UserError, match="'slow' is the only mode, and an IMM needs two or more"):
        analyse(scenario(tmp_path, text, *changes))


def test_too_many_sequences_and_steps_are_refused():
    assert longest_sequence(2, None) == 10
    assert longest_sequence(3, None) == 7
    assert longest_sequence(4, None) == 6
    assert longest_sequence(100, None) == 2
    with pytest.raises(UserError, match=r"1,048,576 sequences.*'measurements'.*to 14 or less"):
        longest_sequence(2, 20)
    with pytest.raises(UserError) as refused:
        longest_sequence(2, 20)
    assert refused.value.keys == ("analyses", "stability", "measurements")
    for measurements in (None, 3):
        with pytest.raises(UserError, match="name fewer modes") as refused:
            longest_sequence(200, measurements)
        assert refused.value.keys == ("modes",)
    six = ["analyses.stability.steps=100000", "analyses.stability.measurements=2"]
    analyse(load("stability_ca", ["analyses.stability.steps=10"]))
    with pytest.raises(UserError, match="'spread_std' has 3 numbers for the states x vx y vy"):
        analyse(load("stability_cv_ct", ["analyses.stability.spread_std=[1, 2, 3]"]))
    with pytest.raises(UserError, match="'spread_std' contains -1"):
        analyse(load("stability_cv_ct", ["analyses.stability.spread_std=[-1]"]))
    many = room.MOST_NUMBERS
    try:
        room.MOST_NUMBERS = 1_000_000
        with pytest.raises(UserError, match=r"100,000 steps of 2 modes.*to 4,629 or less"):
            analyse(load("stability_ca", six))
    finally:
        room.MOST_NUMBERS = many
    for key, value in (("measurements", 1), ("steps", 5), ("seed", -1)):
        with pytest.raises(UserError, match=key):
            load("stability_cv_ct", [f"analyses.stability.{key}={value}"])


def test_verdicts_are_the_tables_too():
    found = examine(model_of("stability_cv_ct"), 2, 20, 1)
    assert verdict(found).startswith("conditions met")
    table = findings(found).tables["conditions"]
    assert table.columns["verdict"] == ["met", "met", "met", "met", "assumed", "not met"]
