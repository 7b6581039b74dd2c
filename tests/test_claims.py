"""Claims of Sigalov 2011's kinds: equality, bounds, and figures that need no run."""

import pytest

from hybridtrack.config import load, shipped
from hybridtrack.verdicts import NOT_REPRODUCED, REPRODUCED, judge_exact
from scenarios import complaint

EXAMPLE = shipped()["softbound_ex1"].read_text("utf-8").partition("published:")[0]
PRINTED_Q = shipped()["softbound_ex1_printed_q"].read_text("utf-8").partition("published:")[0]
METRIC = "metric: position_mse_m2"


def with_claim(text, folder, *, example=EXAMPLE, settings=()):
    file = folder / "claim.yaml"
    file.write_text(f"{example}published:\n  - {{claim: c, {text}, expect: reproduced}}\n")
    return load(file, settings).claims[0]


def said_of(text, folder, *, example=EXAMPLE):
    text = f"{example}published:\n  - {{claim: c, {text}, expect: reproduced}}\n"
    return complaint(text, folder / "claim.yaml").partition(": ")[2]


@pytest.mark.parametrize(
    ("figure", "exact"),
    [
        ("figure: expected_steps_to_end, value: 50.", 50.0),
        ("figure: expected_steps_in_mode, mode: m2, value: 12.5", 12.5),
        ("figure: expected_transitions, value: 4", 0.98 * 0.08 / 0.02),
        ("figure: manoeuvring_index, mode: m1, value: 0.2", 0.3 * 100 / 140),
        ("figure: manoeuvring_index, mode: m2, value: 4.2", 6 * 100 / 140),
    ],
)
def test_figures_that_need_no_run(figure, exact, tmp_path):
    claim = with_claim(figure, tmp_path)
    assert claim.exact == pytest.approx(exact, rel=1e-12)
    assert (claim.estimator, claim.compare) == (None, None)
    assert claim.metric.startswith(figure.partition(": ")[2].partition(",")[0])
    verdict = NOT_REPRODUCED if "4.2" in figure else REPRODUCED  # 4.286 is 4.3 in two digits
    assert judge_exact(claim).verdict == verdict


def test_equality_is_a_ratio_of_one_within_a_tolerance(tmp_path):
    claim = with_claim(f"compare: [SBF, HBF], {METRIC}, sign: equal, tolerance: 0.05", tmp_path)
    assert (claim.sign, claim.value, claim.tolerance) == ("equal", 1.0, 0.05)


def test_a_bound_is_a_figure_with_a_sign(tmp_path):
    claim = with_claim(f"estimator: SBF, {METRIC}, sign: less, value: 13600", tmp_path)
    assert (claim.estimator, claim.sign, claim.value) == ("SBF", "less", 13600.0)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("value: 1", "a claim needs one of 'estimator', 'compare' and 'figure'"),
        ("figure: manoeuvring_index, mode: m1", "'value' is missing in this claim on one figure"),
        (
            "figure: manoeuvring_indx, mode: m1, value: 1",
            "'figure' is manoeuvring_indx, which needs an 'analysis'",
        ),
        ("figure: manoeuvring_index, value: 1", "'mode' is missing: 'manoeuvring_index' is one mo"),
        ("figure: manoeuvring_index, mode: m3, value: 1", "mode 'm3' is not defined; there are m1"),
        ("figure: expected_transitions, mode: m1, value: 4", "is the whole chain's; remove 'mode'"),
        (f"figure: expected_transitions, {METRIC}, value: 4", "'metric' is a run's, and 'fig"),
        (
            "figure: expected_transitions, window: after_50, value: 4",
            "'window' is a run's, and 'fig",
        ),
        (
            "figure: expected_transitions, sign: less, value: 4",
            "'sign' less has no place in thi",
        ),
        (
            f"estimator: SBF, {METRIC}, sign: equal, value: 1",
            "'sign' equal has no place in thi",
        ),
        (
            f"estimator: SBF, {METRIC}, mode: m1, value: 1",
            "'mode' belongs to a claim with 'fig",
        ),
        ("estimator: SBF, value: 1", "'metric' is missing in this claim; add it"),
        (
            f"compare: [SBF, HBF], {METRIC}, sign: less, tolerance: 1",
            "'tolerance' has no part in a",
        ),
        (
            f"estimator: SBF, {METRIC}, sign: less, value: 1, tolerance: 1",
            "'tolerance' has no part",
        ),
        (
            f"compare: [SBF, HBF], {METRIC}, sign: equal, tolerance: 0",
            "is 0, which no two ever meet",
        ),
        ("estimator: SBF, metric: likelihood_distinctness, value: 1", "which SBF doesn't have; it"),
        (f"compare: [SBF, HBF], {METRIC}, sign: equal, value: 2", "'value' of two that are equal"),
        (f"estimator: SBF, {METRIC}", "'value' is missing in this claim on one"),
        (f"compare: [SBF, HBF], {METRIC}, sign: equal", "'tolerance' is missing in this compari"),
        (
            "estimator: IMM, metric: final_mode_brier, value: 1",
            "which IMM doesn't have; it has",
        ),
        (
            "estimator: KF_m1, metric: mode_brier, value: 1",
            "which KF_m1 doesn't have; it has",
        ),
        (
            "estimator: raw, metric: velocity_rmse_m_s, value: 1",
            "which raw doesn't have; it has",
        ),
    ],
)
def test_claims_that_do_not_fit(text, sentence, tmp_path):
    assert sentence in said_of(text, tmp_path)


def test_bounded_filters_have_scores_of_the_last_mode(tmp_path):
    for label in ("SBF", "HBF"):
        claim = with_claim(f"estimator: {label}, metric: final_mode_brier, value: 1", tmp_path)
        assert claim.metric == "final_mode_brier"


@pytest.mark.parametrize(
    ("old", "new", "figure", "sentence"),
    [
        (
            "    continuation_probability: 0.98     #",
            "#",
            "expected_steps_to_end",
            "is that of a soft bound, and the truth's chain has no 'continuation_probability'",
        ),
        (
            "sensor: {position_std_m: 140}",
            "sensor: {position_std_m: {m1: 140, m2: 20}}",
            "manoeuvring_index, mode: m1",
            "needs a mode with an 'acceleration_std_m_s2' and one 'position_std_m'",
        ),
    ],
)
def test_figures_that_a_scenario_does_not_have(old, new, figure, sentence, tmp_path):
    assert old in EXAMPLE
    found = said_of(f"figure: {figure}, value: 1", tmp_path, example=EXAMPLE.replace(old, new))
    assert sentence in found


def test_figures_of_a_chain_need_one(tmp_path):
    legs = shipped()["rmimm_fig5"].read_text("utf-8").partition("published:")[0]
    found = said_of("figure: expected_transitions, value: 4", tmp_path, example=legs)
    assert "'expected_transitions' is a chain's, and the truth has none" in found


def test_steps_of_several_lengths_have_no_expected_number(tmp_path):
    uneven = EXAMPLE.replace(
        "clock: {step_s: 10, duration_s: 2000}", "clock: {times_s: [0, 10, 15, 2000]}"
    )
    uneven = uneven.replace(
        "transition_matrix: [[0.92, 0.08], [0.08, 0.92]]", "mean_sojourn_s: {m1: 100, m2: 100}"
    )
    found = said_of("figure: expected_transitions, value: 4", tmp_path, example=uneven)
    assert "counts steps of one length, and these are uneven" in found
