"""How long a mode must last: the paper's example, what is wrong in it, and the bounds' promises."""

import json
import math
import re

import numpy as np
import pytest
from scipy.stats import ortho_group

import reference_sojourn as slow
from hybridtrack.analyses._eigenstructure import (
    clusters,
    eigenstructure,
    power_bound,
    steps_until_below,
)
from hybridtrack.analyses._predictor_filters import lost_eigenvalues, predictor_filters
from hybridtrack.analyses._sojourn_bounds import (
    Mismatch,
    StateBound,
    delay_errors,
    direct_bound,
    disturbance_bounds,
    mismatch,
    printed_bound,
    rate_correct_bound,
    state_effects,
)
from hybridtrack.analyses._sojourn_charts import charts
from hybridtrack.analyses._sojourn_observability import joint_observability
from hybridtrack.analyses._switching_runs import Claimed, switching_runs
from hybridtrack.analyses.sojourn import ANALYSIS, sojourn_study
from hybridtrack.config import load
from hybridtrack.errors import UserError
from models import figure_5_model, random_model

PRINTED = 1e-4  # relative: the figures are held to this; four digits or more were noted
ROUNDING = 1e-9  # relative: a few thousand products at 1e-16 each, and conditions of some 1e3
SPEED_M_S = 150 * 1852 / 3600
KEY = "analyses.sojourn."
FIGURE_5 = ["rmimm_fig5", f"{KEY}simulated_runs=100"]
FIGURE_2A = ["sojourn_fig2a", f"{KEY}simulated_runs=100"]


def findings(name, *overrides):
    experiment = load(name, [*overrides])
    return ANALYSIS.analyse(experiment, experiment.analyses["sojourn"], None)


def study(name, *overrides):
    experiment = load(name, [*overrides])
    return sojourn_study(experiment, experiment.analyses["sojourn"])


def rows(table, key):
    """A table's rows by one of its columns."""
    columns = table.columns
    return {
        cell: {name: column[i] for name, column in columns.items()}
        for i, cell in enumerate(columns[key])
    }


def stable(rng, n, n_modes=2):
    """Matrices whose powers grow before they shrink, as those of filters do."""
    found = rng.normal(size=(n_modes, n, n))
    for F in found:
        F *= rng.uniform(0.3, 0.9) / np.abs(np.linalg.eigvals(F)).max()
    return found


def direct(transitions, disturbance=0.0, rate=0.99, error_bound=0.0, delay=0):
    names = [f"m{j}" for j in range(len(transitions))]
    return direct_bound(np.asarray(transitions), disturbance, rate, error_bound, delay, names)


SCALAR = {
    "truth": {"chain": {"initial": {"mean": [0], "covariance": [[1]]}}},
    "states": ["x"],
    "initial": {"mean": [0], "covariance": [[1]]},
    "transition_matrix": [[0.9, 0.1], [0.1, 0.9]],
    "estimators": {"IMM": {"type": "imm"}},
    "compare_with": None,
    "dimensions": 1,
}


def scalar(slow_mode, fast_mode, **sojourn):
    """Findings of two modes of one state each, which is measured; A and its noise."""
    modes = {
        name: {"state_transition": [[A]], "process_noise_covariance": [[Q]]}
        for name, (A, Q) in (("slow", slow_mode), ("fast", fast_mode))
    }
    asked = SCALAR | {"modes": modes, "analyses": {"sojourn": {"simulated_runs": 10} | sojourn}}
    return findings(
        "sojourn_fig2a", *(f"{key}={json.dumps(value)}" for key, value in asked.items())
    )


@pytest.fixture(scope="module")
def figure_2a():
    return findings("sojourn_fig2a")


# ---- figure 2 of the paper -------------------------------------------------------------------


def test_the_published_8_s(figure_2a):
    bounds = rows(figure_2a.table, "bound")
    for bound, steps in (("as printed", 3.484), ("rate-correct", 3.545), ("direct", 4)):
        # Three decimals are known of the first two.
        assert bounds[bound]["sojourn_bound_steps"] == pytest.approx(steps, abs=5e-4)
        assert bounds[bound]["minimum_sojourn_steps"] == 4
        assert bounds[bound]["minimum_sojourn_s"] == 8
    assert bounds["direct"]["largest_growth"] == pytest.approx(2.262, abs=5e-4)


def test_condition_number_and_decay_of_the_papers_filters(figure_2a):
    modes = rows(figure_2a.tables["modes"], "mode")
    for mode, k, alpha in (("slow", 7.764, 0.5529), ("sharp", 7.698, 0.5567)):
        assert modes[mode]["condition_number"] == pytest.approx(k, rel=PRINTED)
        assert modes[mode]["alpha"] == pytest.approx(alpha, rel=PRINTED)
        assert modes[mode]["distinct_eigenvalues"]
        assert modes[mode]["largest_jordan_block"] == 1


def test_three_norms_of_the_wrong_filters_effect(figure_2a):
    bounds = rows(figure_2a.table, "bound")
    for bound, U in (("as printed", 17.707), ("rate-correct", 9.001), ("direct", 11.422)):
        assert bounds[bound]["disturbance"] == pytest.approx(U, rel=PRINTED)


def test_which_noises_give_4_steps():
    """As printed rho from .0612 to .1769, and none outside; directly from .0587 to .1725."""

    def found(rho):
        Q = (rho * np.eye(4)).tolist()
        noise = [f"modes.{mode}.process_noise_covariance={Q}" for mode in ("slow", "sharp")]
        return study("sojourn_fig2a", f"{KEY}simulated_runs=1", *noise)

    assert found(0.06115).printed.decay_steps > 4 > found(0.06125).printed.decay_steps
    assert found(0.17685).printed.decay_steps > 3 > found(0.17695).printed.decay_steps
    steps = [found(rho).direct.decay_steps for rho in (0.0586, 0.0587, 0.1725, 0.1726)]
    assert steps == [5, 4, 4, 3]


def test_seven_conditions_of_the_papers_example(figure_2a):
    conditions = rows(figure_2a.tables["conditions"], "condition")
    assert list(conditions) == [1, 2, 3, 4, 5, 6, 7]
    assert [row["met"] for row in conditions.values()] == [False] + [True] * 6
    assert "Lemma 2 holds after 2 outputs" in conditions[1]["remark"]
    assert "Lemma 3 fails" in conditions[1]["remark"]
    assert conditions[4]["figure"] == pytest.approx(0.5567, rel=PRINTED)
    assert conditions[5]["figure"] == pytest.approx(9.001, rel=PRINTED)
    assert conditions[7]["figure"] == 4
    said = " ".join(figure_2a.conclusions)
    assert "4 steps (8 s)" in said
    assert "Condition 1 isn't met, by the paper's own Lemma 3" in said
    assert "2.262 times what it shall be, in 'slow'" in said
    noted = " ".join(figure_2a.notes)
    assert "no bound in general; of what the states add it is 17.71, and by the" in noted
    assert "2.262 times that at most between" in noted


def test_random_switching_breaks_the_claim_below_4_steps_alone(figure_2a):
    """52, 31, 12 and 0 % of 4,000 runs, within four standard errors of their difference.

    How long those lasted beyond their smallest sojourn isn't known. Of seven laws tried, ours (up
    to 3 steps more, equally likely) came nearest and was chosen for it, so the first three shares
    hold this law in place and confirm nothing; sojourns of exactly the smallest give 83, 77 and
    44 %. The fourth is 0 by any law.
    """
    simulated = rows(figure_2a.tables["simulation"], "sojourn_steps")
    for steps, share in ((1, 0.52), (2, 0.31), (3, 0.12)):
        error = math.sqrt(2 * share * (1 - share) / 4000)
        assert simulated[steps]["violated_at_switches"] == pytest.approx(share, abs=4 * error)
    assert simulated[4]["violated_at_switches"] == 0
    # The paper's claim between switches fails in most runs, ours in none.
    assert simulated[4]["violated_between"] > 0.5
    assert simulated[4]["envelope_violated"] == 0
    assert 2.2 < simulated[4]["largest_ratio"] <= 2.2617


def test_the_envelope_stands_beside_the_claim_in_the_chart(figure_2a):
    _, chart = figure_2a.charts
    (panel,) = chart.panels
    claim, envelope, error = panel.lines
    assert claim.label == "mu^k"
    assert (claim.y == 1).all()
    np.testing.assert_allclose(envelope.y, 2.261678, rtol=PRINTED)
    assert (error.y > claim.y).any()
    assert (error.y <= envelope.y).all()
    assert panel.y_limits[0] == 1e-3
    # It starts at what is claimed of it, and switches are marked within what is drawn.
    assert error.y[0] == 1
    assert {mark.label for mark in panel.marks} == {"a switch is noticed"}
    times = [mark.x for mark in panel.marks]
    assert min(np.diff([0.0, *times])) >= 8
    assert max(times) <= error.x[-1]


def test_an_error_bound_is_part_of_what_the_worst_run_is_held_against():
    asked = [*FIGURE_2A, f"{KEY}decision_delay_steps=1", f"{KEY}error_bound=20"]
    found = study(*asked)
    _, chart = charts(found)
    claim, _, error = chart.panels[0].lines
    _, runs = found.simulated[-1]
    start = runs.worst[0]
    assert start == 200
    assert claim.label == "mu^k ||e0|| + M0"
    k = np.arange(len(error.y))
    np.testing.assert_allclose(error.y * (0.99**k * start + 20), runs.worst[k], rtol=ROUNDING)


def test_curves_that_lie_on_one_another_are_drawn_once():
    """Of a scalar ||F^t|| is k alpha^t, and both modes are one."""
    chart = scalar((0.9, 1.0), (0.9, 1.0)).charts[0]
    labels = [line.label for line in chart.panels[0].lines]
    assert labels == ["mu^t", "slow = slow, k alpha^t = fast = fast, k alpha^t"]
    assert len(scalar((0.9, 1.0), (0.5, 1.0)).charts[0].panels[0].lines) == 3


def test_the_largest_delay_that_condition_6_allows():
    """M0 / (sqrt(n) U max k) = 200 / (2 * 9.0013 * 7.7644); as printed with 17.707."""
    asked = [*FIGURE_2A, f"{KEY}error_bound=200", f"{KEY}decision_delay_steps=2"]
    condition = rows(findings(*asked).tables["conditions"], "condition")[6]
    assert condition["figure"] == pytest.approx(200 / (2 * 9.0013 * 7.7644), rel=PRINTED)
    assert condition["met"] is False
    assert condition["remark"] == "as printed, 0.7273 steps"
    allowed = rows(
        findings(*asked[:3], f"{KEY}decision_delay_steps=1").tables["conditions"], "condition"
    )
    assert allowed[6]["met"] is True


def test_the_same_dynamics_with_different_noise():
    found = findings("sojourn_fig2b")
    conditions = rows(found.tables["conditions"], "condition")
    assert not conditions[1]["met"]
    assert "Lemma 2 holds after 2 outputs; Lemma 3 fails" in conditions[1]["remark"]
    bounds = rows(found.table, "bound")
    assert bounds["direct"]["told_apart_after_steps"] == 2
    assert [row["disturbance"] for row in bounds.values()] == [0, 0, 0]
    # A wrong filter adds no error, so a delay costs its own steps and nothing else.
    late = findings("sojourn_fig2b", f"{KEY}decision_delay_steps=3")
    assert rows(late.table, "bound")["direct"]["minimum_sojourn_steps"] == 4 + 3


def test_the_same_noise_too_is_never_told():
    same = np.eye(4).tolist()
    modes = [f"modes.{mode}.process_noise_covariance={same}" for mode in ("calm", "rough")]
    found = findings("sojourn_fig2b", *modes)
    assert rows(found.table, "bound")["direct"]["told_apart_after_steps"] == math.inf
    assert "Lemma 2 fails: calm and rough never differ" in str(found.tables["conditions"])


@pytest.mark.parametrize("name", ["sojourn_fig2a", "sojourn_fig2b"])
def test_published_claims_are_what_is_expected_of_them(name):
    from hybridtrack.verdicts import Interval, judge_interval

    experiment = load(name)
    assert experiment.analysis_claims
    bounds = rows(ANALYSIS.analyse(experiment, experiment.analyses["sojourn"], None).table, "bound")
    for claim in experiment.analysis_claims:
        ours = bounds[claim.where["bound"]][claim.figure]
        assert judge_interval(claim, Interval(ours, ours, ours), True) == claim.expect


def test_condition_7_says_by_what_it_is_judged(figure_2a):
    flown = rows(figure_2a.tables["conditions"], "condition")[7]
    assert flown["remark"].startswith(
        "judged by the flight, whose shortest stay, in slow, lasts 10"
    )
    assert "0.271 of the stays in slow" in flown["remark"]
    drawn = rows(findings("sojourn_fig2b", f"{KEY}simulated_runs=10").tables["conditions"], "asks")
    assert drawn["sojourn long enough"]["remark"].startswith("judged by the modes' chain: by the")
    shown = scalar((0.0, 1.0), (0.0, 2.0)).tables["conditions"].shown
    assert shown["by"][6] == "1 step; none of the chain's is less"


# ---- what is printed wrongly -----------------------------------------------------------------


def test_counterexample_to_the_printed_bound():
    """alpha .98, mu .99, U = Delta = k = 1, M0 = 1.5: printed 0, and far too short."""
    F = np.array([[[0.98]]])
    structures = [eigenstructure(F[0])]
    b = delay_errors(structures, 1.0, 1, 1)
    assert b == (1.0,)
    printed = printed_bound(structures, b, 0.99, 1.5)
    assert printed.steps == 0
    assert printed.repair_steps < 0
    assert slow.error_left(0.98, 1.0, 2) == pytest.approx(25.25, abs=5e-3)
    corrected = rate_correct_bound(structures, b, 0.99, 1.5)
    assert corrected.steps == pytest.approx(109.31, abs=5e-3)
    assert slow.error_left(0.98, 1.0, 111) == pytest.approx(1.119, abs=5e-4)
    # Directly: 1/(1 - .98^L) <= 1.5 from L = ln 3 / |ln .98| = 54.4 on.
    found = direct(F, 1.0, 0.99, 1.5, 1)
    assert found.steps == 55
    assert slow.error_left(0.98, 1.0, 55) <= 1.5 < slow.error_left(0.98, 1.0, 54)
    assert found.delay_error == 1.0


def test_eq_41_letter_by_letter():
    """With M0 below, about and above b."""
    rng = np.random.default_rng(3)
    for error_bound in (0.5, 5.0, 30.0, 1e3):
        structures = [eigenstructure(F) for F in stable(rng, 3, 3)]
        ks, alphas = zip(*((one.condition_number, one.rate) for one in structures), strict=True)
        first, second = slow.printed_terms(ks, alphas, 0.7, 0.95, error_bound, 2, 3)
        errors = delay_errors(structures, 0.7, 3, 2)
        printed = printed_bound(structures, errors, 0.95, error_bound)
        assert printed.decay_steps == pytest.approx(second, rel=ROUNDING)
        assert printed.repair_steps == pytest.approx(first, rel=1e-7)  # b may be near M0
        assert printed.steps == max(printed.decay_steps, printed.repair_steps)


def test_the_1_norm_bounds_no_entry():
    """One row of ones: its 1-norm is 1, and what it makes of (1, 1, 1) is 3."""
    effect = np.zeros((2, 2, 3, 3))
    effect[0, 1, 0] = effect[1, 0, 0] = 1.0
    found = disturbance_bounds(Mismatch(effect, np.zeros((2, 2, 3))), StateBound(np.ones(3), 9.0))
    assert found.printed == 1
    assert found.infinity == 3
    assert found.euclidean == pytest.approx(3)
    # With inputs the second bounds more, and what the states add of it is what it was.
    driven = Mismatch(effect, np.full((2, 2, 3), 5.0))
    assert disturbance_bounds(driven, StateBound(np.ones(3), 9.0)).infinity == 3 + 5
    assert state_effects(driven, 1.0) == (1, 3)


# ---- the bounds' promises --------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_the_direct_bound_is_the_smallest_there_is(seed):
    rng = np.random.default_rng(seed)
    Fs = stable(rng, int(rng.integers(1, 5)))
    delay = int(rng.integers(0, 4))
    c = direct(Fs, 1.0, 0.93, 1e9, delay).delay_error
    for error_bound in (1.05 * c, 1.5 * c, 20 * c):
        found = direct(Fs, 1.0, 0.93, error_bound, delay)
        expected = slow.smallest_sojourn(Fs, 1.0, 0.93, error_bound, delay, 600)
        assert found.steps == expected
    growth = [max(slow.power_norms(F, 300) / 0.93 ** np.arange(300)) for F in Fs]
    np.testing.assert_allclose(found.growth, growth, rtol=ROUNDING)


@pytest.mark.parametrize("seed", range(10))
def test_the_direct_bound_never_asks_for_more_than_the_corrected_one(seed):
    rng = np.random.default_rng(100 + seed)
    Fs, delay = stable(rng, 4), int(rng.integers(0, 3))
    effect = 0.1 * rng.normal(size=(2, 2, 4, 4))
    bounds = disturbance_bounds(Mismatch(effect, np.zeros((2, 2, 4))), StateBound(np.ones(4), 2.0))
    structures = [eigenstructure(F) for F in Fs]
    errors = delay_errors(structures, bounds.infinity, 4, delay)
    for error_bound in (times * max(errors) for times in (1.01, 2, 100)):
        corrected = rate_correct_bound(structures, errors, 0.95, error_bound)
        found = direct(Fs, bounds.euclidean, 0.95, error_bound, delay)
        assert found.steps <= max(math.ceil(corrected.steps), 1)


def test_more_delay_asks_for_more_and_a_larger_error_bound_for_less():
    Fs = stable(np.random.default_rng(5), 3)
    c = direct(Fs, 1.0, 0.95, 1e9, 3).delay_error
    by_delay = [direct(Fs, 1.0, 0.95, 1.1 * c, delay).steps for delay in range(4)]
    assert by_delay == sorted(by_delay)
    assert by_delay[0] < by_delay[-1]
    by_bound = [direct(Fs, 1.0, 0.95, times * c, 3).steps for times in (1.001, 1.1, 2, 50)]
    assert by_bound == sorted(by_bound, reverse=True)
    assert by_bound[0] > by_bound[-1]
    by_rate = [direct(Fs, rate=rate).steps for rate in (0.91, 0.95, 0.999)]
    assert by_rate == sorted(by_rate, reverse=True)


def test_the_smallest_error_bound_is_one():
    Fs = stable(np.random.default_rng(8), 3)
    c = direct(Fs, 1.0, 0.95, 1e9, 2).delay_error
    assert direct(Fs, 1.0, 0.95, c, 2).steps == math.inf
    assert direct(Fs, 1.0, 0.95, 0.0, 2).steps == math.inf
    near = direct(Fs, 1.0, 0.95, c * (1 + 1e-6), 2)
    assert near.steps < math.inf
    # At this M0 the decay is all that is asked for, a little below it isn't.
    enough = near.error_bound_at_decay
    assert direct(Fs, 1.0, 0.95, enough * (1 + 1e-12), 2).steps == near.decay_steps
    assert direct(Fs, 1.0, 0.95, enough * 0.99, 2).steps > near.decay_steps


def test_an_error_that_comes_back_counts():
    """||F^t|| is 2, .6, 1.2, .36, .72, .216, .432: below .99^t from 4 on, and .72 after that."""
    F = np.array([[[0.0, 2.0], [0.3, 0.0]]])
    found = direct(F, 1.0, 0.99, 1e9, 1)
    assert found.decay_steps == found.steps == 4
    assert found.error_bound_at_decay == pytest.approx(1 / (1 - 0.72))
    for error_bound in (3.7, 3.5, 1.8, 1.7):
        expected = slow.smallest_sojourn(F, 1.0, 0.99, error_bound, 1, 200)
        assert direct(F, 1.0, 0.99, error_bound, 1).steps == expected


def test_what_stays_below_for_long_may_come_back():
    """A ring of 70 states, one link of 1600, others .8: over .99^t up to 35, and again at 71."""
    links = np.full(70, 0.8)
    links[0] = 1600.0
    F = np.roll(np.diag(links), 1, axis=0)[np.newaxis]
    norms = slow.power_norms(F[0], 73)
    assert (norms[36:71] <= 0.99 ** np.arange(36, 71)).all()
    assert norms[71] > 0.99**71
    assert direct(F).steps == slow.smallest_sojourn(F, 0.0, 0.99, 0.0, 0, 300) == 72


def test_axes_and_names_make_no_difference():
    """A rotation of the state changes neither norms nor eigenvalues."""
    rng = np.random.default_rng(4)
    Fs = stable(rng, 4)
    turn = ortho_group.rvs(4, random_state=7)
    turned = np.stack([turn @ F @ turn.T for F in Fs])
    assert direct(turned).steps == direct(Fs[::-1]).steps == direct(Fs).steps
    for F, G in zip(Fs, turned, strict=True):
        one, other = eigenstructure(F), eigenstructure(G)
        assert other.condition_number == pytest.approx(one.condition_number, rel=1e-8)


def test_a_deadbeat_filter_needs_as_many_steps_as_its_chain_is_long():
    F = np.array([[[0.0, 5.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]])
    structure = eigenstructure(F[0])
    assert structure.largest_block == 3
    assert structure.rate == 0
    assert steps_until_below(structure) == 3
    assert direct(F).steps == 3
    # Nothing is left after it, so M0 = c can be kept.
    c = direct(F, 1.0, 0.99, 1e9, 2).delay_error
    assert direct(F, 1.0, 0.99, c, 2).steps == 3


def test_a_bound_beyond_all_measure_says_so():
    why = (
        "mode 'm0' would have to last more than 50000 steps: it decays at 0.9899999 per step, and "
        "'convergence_rate' is 0.99; choose it further above that"
    )
    with pytest.raises(UserError, match=re.escape(why)):
        direct([np.array([[0.9899999, 1e4], [0.0, 0.9]])])
    why = "it decays at 0.9999 per step, and the delay adds up to 1, where 'error_bound' is 1.001;"
    with pytest.raises(UserError, match=re.escape(why)):
        direct([[[0.9999]]], 1.0, 0.99999, 1.001, 1)


# ---- eigenvalues -----------------------------------------------------------------------------


def test_two_axes_are_conditioned_as_one():
    """Every eigenvalue twice: with bases as they come the number would be arbitrary."""
    rng = np.random.default_rng(11)
    for _ in range(10):
        (F,) = stable(rng, 3, 1)
        turn = ortho_group.rvs(6, random_state=rng)
        one, two = eigenstructure(F), eigenstructure(turn @ np.kron(np.eye(2), F) @ turn.T)
        assert two.condition_number == pytest.approx(one.condition_number, rel=1e-6)
        assert one.distinct
        assert not two.distinct
        assert two.largest_block == 1


def test_a_condition_number_is_that_of_unit_eigenvectors():
    rng = np.random.default_rng(2)
    for _ in range(10):
        (F,) = stable(rng, 4, 1)
        _, V = np.linalg.eig(F)
        assert eigenstructure(F).condition_number == pytest.approx(np.linalg.cond(V), rel=1e-9)


@pytest.mark.parametrize("blocks", [(2,), (3,), (2, 2), (2, 1), (3, 1), (1, 1, 1)])
@pytest.mark.parametrize("eigenvalue", [0.6, -0.6])
def test_jordan_blocks_are_found_and_eq_30_holds(blocks, eigenvalue):
    n = sum(blocks) + 1
    J = np.diag([eigenvalue] * (n - 1) + [0.2])
    edges = np.cumsum(blocks)
    for i in range(n - 2):
        J[i, i + 1] = 0.0 if i + 1 in edges else 1.0
    turn = ortho_group.rvs(n, random_state=n) if n > 1 else np.eye(1)
    F = turn @ J @ turn.T
    found = eigenstructure(F)
    assert found.largest_block == max(blocks)
    # Rounding moves the eigenvalues of a block of size m by the m-th root of 1e-16.
    assert found.rate == pytest.approx(0.6, rel=1e-4)
    assert not found.distinct or n == 2
    # There is an orthonormal frame in which it is in Jordan form; chains needn't be that good.
    assert found.condition_number < 10
    norms = slow.power_norms(F, 120)
    assert all(norms[t] <= power_bound(found, t) * (1 + 1e-5) for t in range(120))


@pytest.mark.parametrize("rate", [0.9, 1.0])
def test_the_last_root_is_the_last(rate):
    F = np.array([[0.7, 3.0, 0.0], [0.0, 0.7, 2.0], [0.0, 0.0, 0.7]])
    structure = eigenstructure(F)
    assert structure.largest_block == 3
    root = steps_until_below(structure, rate)
    later = np.arange(math.ceil(root), math.ceil(root) + 300)
    assert all(power_bound(structure, int(t)) <= rate**t * (1 + 1e-9) for t in later)
    assert power_bound(structure, math.floor(root)) > rate ** math.floor(root)


# ---- filters ---------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [figure_5_model(), random_model(np.random.default_rng(1))])
def test_filters_are_what_the_riccati_recursion_settles_at(model):
    for j, one in enumerate(predictor_filters(model)):
        F, K = slow.settled_predictor(
            model.state_transition[0, j],
            model.measurement_matrix[j],
            model.process_noise_covariance[0, j],
            model.measurement_noise_covariance[j],
            cycles=3000,
        )
        np.testing.assert_allclose(one.gain, K, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(one.transition, F, rtol=1e-7, atol=1e-9)


def test_exact_jordan_blocks_leave_other_eigenvalues_alone():
    """Two integrators beside zeros, as the motion model that zeroes its acceleration has them."""
    A = figure_5_model().state_transition[0, 0]
    found = sorted((round(c.eigenvalue.real, 6), c.members) for c in clusters(A))
    assert found == [(0.0, 2), (1.0, 4)]
    assert sorted(z.real for z in lost_eigenvalues(A, np.zeros((6, 0)))) == pytest.approx([0, 1])
    apart = np.diag([1.0, 1.0, 0.99]) + np.diag([1.0, 0.0], 1)
    assert sorted(c.members for c in clusters(apart)) == [1, 2]


def test_lost_eigenvalues_by_kalmans_rank():
    rng = np.random.default_rng(6)
    for _ in range(20):
        A, B = rng.normal(size=(4, 4)), rng.normal(size=(4, 1))
        assert slow.controllable(A, B)
        assert lost_eigenvalues(A, B) == ()
        assert lost_eigenvalues(A, 1e-12 * B) == ()  # in whatever unit
        A[2:, :2], B[2:] = 0.0, 0.0  # the last two go their own way
        assert not slow.controllable(A, B)
        lost = sorted(lost_eigenvalues(A, B), key=lambda e: (e.real, e.imag))
        own = sorted(np.linalg.eigvals(A[2:, 2:]).tolist(), key=lambda e: (e.real, e.imag))
        np.testing.assert_allclose(lost, own, rtol=1e-9)


def test_disturbances_by_every_corner():
    """Correlated everything, inputs, and measurement matrices of their own."""
    model = random_model(np.random.default_rng(9), n_modes=3, n_x=3)
    filters = predictor_filters(model)
    each = np.array([3.0, 0.5, 2.0])
    found = disturbance_bounds(mismatch(model, filters), StateBound(each, math.inf))
    A, b, C = model.state_transition[0], model.input_effect[0], model.measurement_matrix
    K = [one.gain for one in filters]
    wrong = mismatch(model, filters)
    # The filter of mode 2 while mode 0 is at work, and not the other way round.
    np.testing.assert_allclose(
        wrong.state_effect[2, 0], A[2] - A[0] - K[2] @ (C[2] - C[0]), rtol=ROUNDING
    )
    np.testing.assert_array_equal(wrong.input_effect[2, 0], b[2] - b[0])
    _, euclidean = slow.largest_disturbance(A, b, C, K, each)
    assert found.euclidean == pytest.approx(euclidean, rel=ROUNDING)
    cube = disturbance_bounds(mismatch(model, filters), StateBound(np.full(3, 2.0), math.inf))
    infinity, _ = slow.largest_disturbance(A, b, C, K, np.full(3, 2.0))
    assert cube.infinity >= infinity * (1 - ROUNDING)
    no_input = model._replace(input_effect=0 * model.input_effect)
    plain = disturbance_bounds(mismatch(no_input, filters), StateBound(np.full(3, 2.0), math.inf))
    infinity, _ = slow.largest_disturbance(A, 0 * b, C, K, np.full(3, 2.0))
    assert plain.infinity == pytest.approx(infinity, rel=ROUNDING)


def test_positions_that_cancel_do_not_count():
    near = study("sojourn_fig2a", f"{KEY}state_bound=[0, 77, 0, 77]")
    far = study("sojourn_fig2a", f"{KEY}state_bound=[1e9, 77, 1e9, 77]")
    assert near.disturbance == far.disturbance
    # Both velocities at once, or a speed: the difference is sqrt(2).
    speed = study(
        "sojourn_fig2a", f"{KEY}state_bound=[1e9, 77, 1e9, 77]", f"{KEY}state_norm_bound=77"
    )
    ratio = far.disturbance.euclidean / speed.disturbance.euclidean
    assert ratio == pytest.approx(math.sqrt(2), rel=ROUNDING)


# ---- condition 1 -----------------------------------------------------------------------------


def test_lemma_2_by_the_matrices_written_out():
    model = random_model(np.random.default_rng(12), n_modes=2, n_x=3, n_y=1)
    Pi = np.diag([1.0, 2.0, 0.5])
    told = joint_observability(model, Pi)
    assert told.met
    assert told.state_steps == 3
    assert told.joint_index == 6
    # Where the modes have one C and one R, the first output can't tell them, the second can.
    shared = model._replace(
        measurement_matrix=model.measurement_matrix[[0, 0]],
        measurement_noise_covariance=model.measurement_noise_covariance[[0, 0]],
    )
    told = joint_observability(shared, Pi)
    covariances = [
        [
            slow.output_covariance(
                shared.state_transition[0, j],
                shared.measurement_matrix[j],
                shared.process_noise_covariance[0, j],
                shared.measurement_noise_covariance[j],
                Pi,
                steps,
            )
            for j in range(2)
        ]
        for steps in (1, 2)
    ]
    assert [np.allclose(*pair, rtol=1e-12) for pair in covariances] == [True, False]
    assert told.covariance_steps == 3  # the state shows after three
    assert set(told.unseen_switches) == {("m0", "m1"), ("m1", "m0")}
    assert not told.met


def test_noise_alone_tells_two_modes_apart_that_no_rank_does():
    """The paper's example: x stays, the sensor's noise differs."""
    model = random_model(np.random.default_rng(13), n_modes=2, n_x=1, n_y=1)
    model = model._replace(
        state_transition=np.ones((1, 2, 1, 1)),
        process_noise_covariance=np.zeros((1, 2, 1, 1)),
        measurement_matrix=np.ones((2, 1, 1)),
        measurement_noise_covariance=np.array([[[1.0]], [[2.0]]]),
    )
    told = joint_observability(model, np.eye(1))
    assert told.joint_index is None
    assert told.covariance_steps == 1
    assert told.met
    same = model._replace(measurement_noise_covariance=np.ones((2, 1, 1)))
    told = joint_observability(same, np.eye(1))
    assert told.same_covariances == (("m0", "m1"),)
    assert not told.met


def test_lemma_2_may_need_one_output_more_than_the_recursions_order():
    """One state, decaying by .9 or by .5, started at exactly 0: the third output tells."""
    model = random_model(np.random.default_rng(14), n_modes=2, n_x=1, n_y=1)
    model = model._replace(
        state_transition=np.array([0.9, 0.5]).reshape(1, 2, 1, 1),
        process_noise_covariance=np.ones((1, 2, 1, 1)),
        measurement_matrix=np.ones((2, 1, 1)),
        measurement_noise_covariance=np.ones((2, 1, 1)),
    )
    alike = [
        np.allclose(
            *(
                slow.output_covariance(A, np.eye(1), np.eye(1), np.eye(1), 0.0, steps)
                for A in (np.array([[0.9]]), np.array([[0.5]]))
            )
        )
        for steps in (1, 2, 3)
    ]
    assert alike == [True, True, False]
    assert joint_observability(model, np.zeros((1, 1))).covariance_steps == 3


# ---- the simulation --------------------------------------------------------------------------


def simulated(transitions, claimed, *, seed=0, effect=None, **how):
    n_modes, n, _ = np.shape(transitions)
    effect = np.zeros((n_modes, n_modes, n, n)) if effect is None else effect
    state = StateBound(np.ones(n), math.inf)
    how = {"extra_steps": 2, "delay_steps": 0, "runs": 2000, "steps": 60, "start": 1.0} | how
    return switching_runs(
        np.asarray(transitions),
        Mismatch(effect, np.zeros((n_modes, n_modes, n))),
        state,
        claimed,
        generator=np.random.default_rng(seed),
        **how,
    )


def test_the_simulation_is_what_a_run_by_run_one_gives():
    """Within four standard errors of the difference of two shares."""
    Fs = [one.transition for one in study(*FIGURE_2A).filters]
    Fs.append(Fs[0] @ Fs[1])
    for sojourn in (1, 2):
        ours = simulated(Fs, Claimed(0.99, 0.0, 1.0), sojourn_steps=sojourn).at_switches
        runs, rng = 1000, np.random.default_rng(5)
        theirs = slow.share_that_breaks_the_claim(Fs, 0.99, sojourn, 2, runs, 60, rng)
        error = math.sqrt(theirs * (1 - theirs) * (1 / runs + 1 / 2000))
        assert 0.1 < theirs < 0.9
        assert ours == pytest.approx(theirs, abs=4 * error)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("delay", [0, 1, 3])
def test_no_run_breaks_the_direct_bound(seed, delay):
    """With the largest u there is at every wrong step, in any direction, and delays up to Delta."""
    rng = np.random.default_rng(30 + seed)
    Fs = stable(rng, 3, 3)
    effect = rng.normal(size=(3, 3, 3, 3))
    effect[range(3), range(3)] = 0.0
    wrong = Mismatch(effect, np.zeros((3, 3, 3)))
    U = disturbance_bounds(wrong, StateBound(np.ones(3), math.inf)).euclidean
    c = direct(Fs, U, 0.95, 1e12, delay).delay_error
    bound = direct(Fs, U, 0.95, 1.2 * c, delay)
    found = simulated(
        Fs,
        Claimed(0.95, 1.2 * c, max(bound.growth)),
        effect=effect,
        sojourn_steps=int(bound.steps) + delay,
        delay_steps=delay,
        start=np.tile([1e3 * c, 10 * c, 0.0, 0.0], 500) if c else 1.0,
        steps=250,
    )
    assert found.at_switches == 0
    assert found.over_envelope == 0
    # It is the switches that are bounded: in between it goes over wherever a filter lets it grow.
    assert (found.between > 0) == (max(bound.growth) > 1.0)


def test_what_the_paper_claims_of_steps_between_fails_and_what_is_printed_is_too_short():
    """Two modes whose bound is 6 steps where the printed one is 1: half of the runs show it."""
    F = np.array([[0.98, 0.0], [0.0, 0.5]])
    found = simulated(
        [F, F],
        Claimed(0.99, 1.5, 1.0),
        effect=np.tile(np.eye(2), (2, 2, 1, 1)),
        sojourn_steps=2,
        extra_steps=0,
        delay_steps=1,
        start=1.0,
        steps=300,
    )
    assert found.at_switches > 0.5


def test_the_envelope_is_as_near_as_it_can_be():
    """Of three quarters of the growth a fair share of runs is over, of all of it none."""
    Fs = [one.transition for one in study(*FIGURE_2A).filters]
    growth = max(direct(Fs).growth)
    over = [
        simulated(Fs, Claimed(0.99, 0.0, share * growth), sojourn_steps=4).over_envelope
        for share in (0.75, 1.0)
    ]
    assert over[0] > 0.1
    assert over[1] == 0


def test_what_a_delay_adds_does_not_widen_the_envelope():
    """A filter that never lets an error grow has the claim itself for an envelope."""
    F = np.array([[0.98]])
    effect = np.ones((2, 2, 1, 1))
    too_short = simulated(
        [F, F],
        Claimed(0.99, 1.5, 1.0),
        effect=effect,
        sojourn_steps=2,
        extra_steps=0,
        delay_steps=1,
        start=15.0,
        steps=300,
    )
    assert too_short.over_envelope == too_short.between > 0.1


def test_m0_is_held_against_errors_that_come_of_the_delay_alone():
    """From 10 M0 no error would pass mu^t e_0 + M0 at these switches: mu^t alone hides them."""
    F = np.array([[0.9]])
    bound = direct([F, F], 1.0, 0.999, 1.05, 1)
    assert bound.steps == 29  # 1 / (1 - .9^29) <= 1.05

    def share(sojourn, start):
        found = simulated(
            [F, F],
            Claimed(0.999, 1.05, 1.0),
            effect=np.ones((2, 2, 1, 1)),
            sojourn_steps=sojourn,
            extra_steps=0,
            delay_steps=1,
            start=start,
            steps=400,
        )
        return found.at_switches

    assert share(30, 0.0) == share(30, 10.5) == share(20, 10.5) == 0
    assert share(20, 0.0) > 0.5


def test_half_of_the_runs_start_without_an_error_where_one_may_remain():
    """M0 = 11.5, a little above c = 11.42, asks for 12 steps; 8 are too few, which those show."""
    asked = [*FIGURE_2A, f"{KEY}decision_delay_steps=1", f"{KEY}error_bound=11.5"]
    found = dict(study(*asked, f"{KEY}simulated_runs=400").simulated)
    assert found[8].at_switches > 0.05
    assert found[12].at_switches == 0
    assert any(
        "every second simulated run starts without" in note for note in findings(*asked).notes
    )
