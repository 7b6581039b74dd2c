"""The sojourn analysis of any scenario: what it prints, what it refuses, what it says."""

import itertools
import math

import numpy as np
import pytest

from hybridtrack.analyses._sojourn_numbers import number
from hybridtrack.analyses.sojourn import ANALYSIS, Settings, _second_moment, sojourn_study
from hybridtrack.config import ScenarioError, load
from hybridtrack.errors import Unsuited, UserError
from hybridtrack.tables_of_analyses import LONG_TEXT
from scenarios import WITH_MODES
from test_sojourn import FIGURE_2A, FIGURE_5, KEY, ROUNDING, findings, rows, scalar, study


def check(found):
    """Columns of one type and length, cells that fit a terminal, one to four conclusions."""
    for table in (found.table, *found.tables.values()):
        assert len({len(column) for column in table.columns.values()}) == 1
        for name, column in table.columns.items():
            kinds = {type(cell) for cell in column if cell is not None}
            assert len(kinds) <= 1, (name, kinds)
            assert kinds <= {float, int, bool, str}
            assert not any(isinstance(cell, float) and math.isnan(cell) for cell in column)
        widths = [
            max(min(len(line), LONG_TEXT) for line in (*head.split("\n"), *cells))
            for head, cells in table.shown.items()
        ]
        assert sum(widths) + 3 * (len(widths) - 1) <= 80
    assert 1 <= len(found.conclusions) <= 4
    assert len(found.charts) <= 2
    for chart, panel in itertools.product(found.charts, range(1)):
        for line in chart.panels[panel].lines:
            assert line.x.shape == line.y.shape
            assert (np.isnan(line.y) | (line.y > 0)).all()


@pytest.mark.parametrize("name", WITH_MODES)
def test_every_shipped_scenario_gives_findings_or_says_why(name):
    try:
        found = findings(name, f"{KEY}simulated_runs=200")
    except Unsuited as error:
        refused = str(error)
    else:
        check(found)
        return
    assert name == "observability_scalar"  # without process noise
    assert "no stabilising solution" in refused


NO_NOISE = np.zeros((4, 4)).tolist()


@pytest.mark.parametrize(
    "asked",
    [
        [*FIGURE_2A, f"{KEY}decision_delay_steps=1", f"{KEY}error_bound=20"],
        [*FIGURE_2A, f"{KEY}decision_delay_steps=2", f"{KEY}error_bound=5"],
        [*FIGURE_2A, "transition_matrix=[[1, 0], [0, 1]]"],
        [*FIGURE_2A, "transition_matrix=[[0, 1], [0.3, 0.7]]"],
        [*FIGURE_2A, f"{KEY}simulated_steps=1"],
        [*FIGURE_2A, f"{KEY}convergence_rate=0.558"],
        [*FIGURE_2A, f"{KEY}convergence_rate=0.999999"],
        [
            *FIGURE_5,
            f"{KEY}decision_delay_steps=1",
            f"{KEY}error_bound=1e4",
            f"{KEY}state_bound=[9]",
        ],
        [
            *FIGURE_5,
            f"{KEY}decision_delay_steps=2",
            f"{KEY}error_bound=1e9",
            f"{KEY}state_bound=[1e5, 250, 20, 1e5, 250, 20]",
        ],
        ["softbound_ex1", f"{KEY}convergence_rate=0.723", f"{KEY}simulated_runs=10"],
    ],
)
def test_what_can_be_asked_is_answered(asked):
    check(findings(*asked))


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        (["sojourn_fig2a", f"{KEY}convergence_rate=1.0"], "above 0 and below 1"),
        (["sojourn_fig2a", f"{KEY}convergence_rate=-0.5"], "above 0 and below 1"),
        (
            ["sojourn_fig2a", f"{KEY}convergence_rate=0.55"],
            r"mode 'sharp' decays at 0\.5567 per step: choose 'convergence_rate' above it",
        ),
        (
            ["sojourn_fig2a", f"{KEY}convergence_rate=0.556665"],
            r"mode 'sharp' decays at 0\.55667 per step: .* \(it is 0\.556665\)",
        ),
        (["sojourn_fig2a", f"{KEY}decision_delay_steps=-1"], "at least 0"),
        (["sojourn_fig2a", f"{KEY}decision_delay_steps=0.5"], "whole number"),
        (["sojourn_fig2a", f"{KEY}state_bound=[1, 2]"], "2 numbers; give one, or one for each"),
        (["sojourn_fig2a", f"{KEY}state_bound=[-1]"], "is 0 or more"),
        (["sojourn_fig2a", f"{KEY}simulated_steps=999999"], "lower 'simulated_runs'"),
        (
            [
                "sojourn_fig2a",
                f"{KEY}decision_delay_steps=1",
                f"{KEY}error_bound=null",
            ],
            r"add 'error_bound' under analyses\.sojourn, above 11\.42",
        ),
        (
            ["rmimm_fig5", f"{KEY}decision_delay_steps=1"],
            "how large ax and ay may be; add 'state_b",
        ),
        (["softbound_ex1", f"{KEY}decision_delay_steps=1"], "how large a"),
        (
            ["sojourn_fig2a", f"modes.slow.process_noise_covariance={NO_NOISE}"],
            "the Riccati equation of mode 'slow' has no stabilising solution: no process noise",
        ),
        (
            ["sojourn_fig2a", "modes.sharp.measurement_matrix=[[0, 1, 0, 0], [0, 0, 0, 1]]"],
            "mode 'sharp' is not detectable",
        ),
    ],
)
def test_what_cannot_be_analysed_is_one_sentence(asked, says):
    with pytest.raises((UserError, ScenarioError), match=says) as raised:
        findings(*asked)
    assert "\n" not in str(raised.value)


def test_a_delay_without_an_error_bound_is_infeasible_by_name():
    found = findings("sojourn_fig2a", f"{KEY}decision_delay_steps=1", f"{KEY}error_bound=0")
    for row in rows(found.table, "bound").values():
        assert row["minimum_sojourn_s"] == math.inf
        assert "error_bound is 0" in row["why"]
    assert "No sojourn is long enough" in found.conclusions[0]
    conditions = rows(found.tables["conditions"], "condition")
    assert [conditions[i]["met"] for i in (6, 7)] == [False, False]
    check(found)


def test_settings_are_checked_without_a_scenario_too():
    experiment = load("sojourn_fig2a")
    for settings in (
        Settings(convergence_rate=math.nan),
        Settings(decision_delay_steps=-2),
        Settings(decision_delay_steps=1.5),
        Settings(error_bound=-1.0),
        Settings(state_norm_bound=-1.0),
    ):
        with pytest.raises(UserError):
            sojourn_study(experiment, settings)


def test_what_is_no_different_is_not_told():
    """Scalars don't grow between switches, and of a 1 x 1 matrix all norms are one."""
    found = scalar((0.9, 1.0), (0.5, 1.0), state_bound=[10])
    noted = " ".join([*found.notes, *found.conclusions])
    assert "1-norm" not in noted
    assert "between" not in noted
    assert "may grow" not in noted


def test_large_numbers_are_alike_in_tables_and_sentences():
    """ln(1 - c/M0) / ln alpha of a filter that decays slowly, in thousands of steps."""
    found = scalar(
        (0.9999, 1e-8), (0.9995, 1e-8), convergence_rate=0.99999, decision_delay_steps=1,
        state_bound=[100], error_bound=0.045,
    )  # fmt: skip
    (steps,) = (
        row["minimum_sojourn_steps"]
        for row in rows(found.table, "bound").values()
        if row["bound"] == "direct"
    )
    assert steps > 10_000
    assert found.table.shown["sojourn\nsteps"][2] == f"{steps:.0f}"
    assert f"at least {steps:.0f} steps" in found.conclusions[0]
    assert "the factor 0.99999 per step" in found.conclusions[0]


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ({"simulated_steps": 2}, "fills a run of 2: raise 'simulated_steps'"),
        ({"simulated_runs": 100_000, "simulated_steps": 3}, "fills a run of 3: raise"),
        ({"simulated_runs": 10**5, "decision_delay_steps": 60}, "of 50, as long as 100000 can be"),
        ({"decision_delay_steps": 5000}, "fills a run of 5000, as long as one gets by itself"),
        ({"convergence_rate": 1e-25, "decision_delay_steps": 8}, "the 8 after which 1e-25^t"),
    ],
)
def test_why_nothing_is_simulated(asked, why):
    model = (0.0, 1.0), (0.0, 2.0)
    found = scalar(*model, **({"decision_delay_steps": 3} | asked))
    assert "simulation" not in found.tables
    assert any(why in note for note in found.notes)


@pytest.mark.parametrize(
    ("value", "others", "text"),
    [
        (17.7071, (), "17.71"),
        (10001.4, (), "10001"),
        (123456789.0, (), "123456789"),
        (1e12, (), "1e+12"),
        (0.9999999, (1.0,), "0.9999999"),
        (0.99004, (1.0, 0.99), "0.99004"),
        (1.5, (1.5,), "1.5"),
        (math.inf, (1.0,), "inf"),
    ],
)
def test_as_many_digits_as_it_takes(value, others, text):
    assert number(value, *others) == text


def test_unmet_conditions_say_so_by_their_number():
    """Two axes alike repeat every eigenvalue; a delay of 2 is over eq. 39's 1.431."""
    asked = [*FIGURE_2A, f"{KEY}error_bound=200", f"{KEY}decision_delay_steps=2"]
    shown = findings(*asked).tables["conditions"].shown
    assert shown["by"][5] == "2 steps, eq. 39 allows 1.431"
    shown = findings("rmimm_fig5", f"{KEY}simulated_runs=10").tables["conditions"].shown
    assert shown["condition"][3].startswith("4 ")
    assert shown["met"][3] == "no"
    assert "repeated eigenvalues in" in shown["by"][3]


def test_one_mode_switches_nowhere():
    experiment = load("sojourn_fig2a")
    alone = experiment._replace(
        bank=experiment.bank._replace(
            modes=experiment.bank.modes[:1],
            transition_matrix=np.ones((1, 1)),
            initial_mode_probabilities=np.ones(1),
        )
    )
    found = ANALYSIS.analyse(alone, Settings(decision_delay_steps=2), None)
    check(found)
    assert "simulation" not in found.tables
    assert "one mode" in found.conclusions[0]


def test_stays_that_are_too_short_by_an_asymmetric_chain():
    found = study(*FIGURE_2A, "transition_matrix=[[0.9, 0.1], [0.4, 0.6]]")
    np.testing.assert_allclose(found.too_short_probability, [1 - 0.9**3, 1 - 0.6**3])
    assert found.flown == ("slow", 10)


LEG = "{until_s: 200, turn_rate_deg_s: 2, mode: slow}"


@pytest.mark.parametrize(
    "legs",
    [
        f"[{LEG}]",
        "[{until_s: 100, mode: slow}, {until_s: 200, turn_rate_deg_s: 2, mode: slow}]",
        "[{until_s: 100}, {until_s: 200, turn_rate_deg_s: 2}]",
    ],
)
def test_a_flight_that_never_switches_has_no_shortest_stay(legs):
    assert study(*FIGURE_2A, f"truth.legs={legs}").flown is None
    check(findings(*FIGURE_2A, f"truth.legs={legs}"))


STRAIGHT = np.kron(np.eye(2), [[1.0, 2.0], [0.0, 1.0]]).tolist()
NOISE = np.eye(4).tolist()


def test_one_mode_flown_on_two_legs():
    asked = {
        "truth.legs": "[{until_s: 100, mode: slow}, {until_s: 200, mode: slow}]",
        "modes": f"{{slow: {{state_transition: {STRAIGHT}, process_noise_covariance: {NOISE}}}}}",
        "transition_matrix": "[[1]]",
        "initial.mode_probabilities": "{slow: 1}",
        "estimators": "{KF: {type: kalman, mode: slow}}",
        "compare_with": "null",
    }
    found = findings(*FIGURE_2A, *(f"{key}={value}" for key, value in asked.items()))
    assert "one mode" in found.conclusions[0]
    check(found)


def without_reference(experiment, unknown=slice(None)):
    """The scenario with a truth that isn't known at the given steps."""
    (case,) = experiment.cases
    state = case.truth.state.copy()
    state[unknown] = math.nan
    truth = case.truth._replace(state=state)
    return experiment._replace(cases=(case._replace(truth=truth),))


def test_a_truth_that_is_not_known_bounds_nothing():
    experiment = without_reference(load("sojourn_fig2a"))
    settings = Settings(simulated_runs=10)
    found = ANALYSIS.analyse(experiment, settings, None)
    assert rows(found.table, "bound")["direct"]["disturbance"] is None
    assert rows(found.tables["conditions"], "condition")[5]["met"] is None
    said = " ".join(found.notes)
    assert "the flight itself has" not in said
    assert "taken as 0, since the truth isn't known" in said
    late = settings._replace(decision_delay_steps=1, error_bound=20.0)
    with pytest.raises(UserError, match="how large vx and vy may be; add 'state_bound'"):
        ANALYSIS.analyse(experiment, late, None)


def test_a_truth_with_gaps_bounds_by_what_is_known():
    whole, gaps = load("sojourn_fig2a"), without_reference(load("sojourn_fig2a"), slice(3, 20))
    settings = Settings(simulated_runs=10)
    one, other = (sojourn_study(each, settings) for each in (whole, gaps))
    assert other.disturbance.euclidean == pytest.approx(one.disturbance.euclidean, rel=1e-3)
    assert any("the flight itself has, where it is known" in note for note in other.notes)


def test_the_start_of_a_filter_about_the_truth_has_its_covariance():
    """Pi_0 = x x' + P, with x the truth's and P the filters'."""
    start = "truth.start={position_m: [3, -2], speed_kt: 0, heading_deg: 0}"
    experiment = load("sojourn_fig2a", [start])
    model = study(*FIGURE_2A).model
    moment, (said,) = _second_moment(experiment, model)
    expected = np.diag([1.0, 100.0, 1.0, 100.0])  # of positions 1 m, of velocities 10 m/s
    expected += np.outer([3, 0, -2, 0], [3, 0, -2, 0])
    np.testing.assert_allclose(moment, expected, rtol=ROUNDING)
    assert said.endswith("is that of the truth")


def test_the_same_seed_gives_the_same_findings():
    first, again = (findings(*FIGURE_2A).tables["simulation"] for _ in range(2))
    assert first == again
    other = findings(*FIGURE_2A, "monte_carlo.seed=2").tables["simulation"]
    assert first != other
