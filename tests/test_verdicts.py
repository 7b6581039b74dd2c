"""Verdicts on either side of every boundary, and on honest claims with few runs."""

import math

import numpy as np
import pytest
from scipy.special import stdtrit

from hybridtrack.statistics import NOTHING, Estimate, Paired
from hybridtrack.verdicts import (
    ASSUMED,
    DIRECTION,
    FEW_RUNS,
    NO_DATA,
    NOT_REPRODUCED,
    ONE_SIDED,
    REPRODUCED,
    UNDECIDED,
    Claim,
    _student,
    judge_comparison,
    judge_exact,
    judge_figure,
    printed_tolerance,
)

MANY = 1_000_000  # runs: 3 standard errors are 3, whatever the number of runs says


def claim(value=None, tolerance=0.0, *, sign=None, expect=REPRODUCED):
    pair = ("A", "B") if sign else None
    return Claim(
        "it is so", None if sign else "A", pair, "m", "all", value, tolerance, sign, expect, ""
    )


def figure(value, error, *, n_runs=MANY, assumptions=False, published=18.0, tolerance=0.5):
    ours = Estimate(value, error, n_runs)
    return judge_figure(claim(published, tolerance), ours, assumptions).verdict


def comparison(difference, error, *, sign="less", value=None, tolerance=0.0, ratio=NOTHING, n=MANY):
    ours = Paired(1.0 + difference, 1.0, Estimate(difference, error, n), ratio)
    return judge_comparison(claim(value, tolerance, sign=sign), ours, assumptions=False).verdict


def equal(ratio, error, *, tolerance=0.05, value=1.0, assumptions=False):
    given = claim(value, tolerance, sign="equal")
    ours = Paired(ratio, 1.0, Estimate(ratio - 1.0, 0.0, MANY), Estimate(ratio, error, MANY))
    outcome = judge_comparison(given, ours, assumptions)
    assert outcome.ours == ours.ratio
    return outcome.verdict


@pytest.mark.parametrize(
    ("ratio", "error", "verdict"),
    [
        (1.02, 0.001, REPRODUCED),
        (0.98, 0.001, REPRODUCED),
        (1.02, 0.0099, REPRODUCED),  # three errors are .0297
        (1.02, 0.0101, UNDECIDED),  # three errors reach beyond what is called equal
        (1.05, 0.001, UNDECIDED),
        (1.06, 0.001, NOT_REPRODUCED),
        (0.94, 0.001, NOT_REPRODUCED),
        (1.09, 0.016, UNDECIDED),
        (1.06, 0.02, UNDECIDED),
    ],
)
def test_two_that_are_said_to_be_equal(ratio, error, verdict):
    assert equal(ratio, error) == verdict
    if verdict == REPRODUCED:
        assert equal(ratio, error, assumptions=True) == ASSUMED


@pytest.mark.parametrize(
    ("sign", "value", "verdict"),
    [
        ("less", 16.9, REPRODUCED),
        ("less", 17.5, UNDECIDED),
        ("less", 18.5, UNDECIDED),
        ("less", 19.1, NOT_REPRODUCED),
        ("greater", 19.1, REPRODUCED),
        ("greater", 16.9, NOT_REPRODUCED),
    ],
)
def test_a_figure_on_one_side_of_a_bound(sign, value, verdict):
    """A bound of 18, three standard errors of 1/3."""
    given = claim(18.0, 0.5)._replace(sign=sign)
    ours = Estimate(value, 1 / 3, MANY)
    assert judge_figure(given, ours, assumptions=True).verdict == verdict
    resting = given._replace(expect=ASSUMED)  # the sign itself rests on what was assumed
    rests = ASSUMED if verdict == REPRODUCED else verdict
    assert judge_figure(resting, ours, assumptions=True).verdict == rests
    assert judge_figure(resting, ours, assumptions=False).verdict == verdict


@pytest.mark.parametrize(
    ("exact", "verdict"), [(0.2143, REPRODUCED), (0.25, REPRODUCED), (0.26, NOT_REPRODUCED)]
)
def test_a_figure_that_needs_no_run(exact, verdict):
    outcome = judge_exact(claim(0.2, 0.05)._replace(exact=exact))
    assert outcome.verdict == verdict
    assert outcome.ours.value == exact
    assert outcome.differs == (verdict != REPRODUCED)


# ---- printed digits --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "tolerance"),
    [
        ("18", 0.5),
        ("2.3", 0.05),
        ("2.10", 0.005),
        ("-0.05", 0.005),
        ("+7", 0.5),
        ("1e3", 500.0),
        ("1.2e-3", 0.00005),
        ("4.50E+2", 0.5),
        (".5", 0.05),
        ("5.", 0.5),
        ("0", 0.5),
        (" '18' ", 0.5),
        ('"2.3"', 0.05),
    ],
)
def test_half_a_unit_of_the_last_printed_digit(text, tolerance):
    # A power of ten: one rounding or two.
    assert printed_tolerance(text) == pytest.approx(tolerance, rel=1e-15)


@pytest.mark.parametrize("text", ["", ".", "-", "e3", "18 m", "nan", "inf", "1,000", "0x10"])
def test_what_is_no_printed_number(text):
    with pytest.raises(ValueError, match="not a printed number"):
        printed_tolerance(text)


# ---- figures ---------------------------------------------------------------------------------

# Within the printed digits at once, with 3 errors' slack; beyond both; or too uncertain to say.
# Binary fractions, so that the boundaries are exact up to 3.0000004, the factor of MANY runs.


@pytest.mark.parametrize(
    ("value", "error", "verdict"),
    [
        (18.0, 0.0, REPRODUCED),
        (18.5, 0.0, REPRODUCED),
        (17.5, 0.0, REPRODUCED),
        (18.5625, 0.0, NOT_REPRODUCED),
        (17.4375, 0.0, NOT_REPRODUCED),
        (18.5 + 0.125 * 2.99, 0.125, REPRODUCED),
        (18.5 + 0.125 * 3.01, 0.125, NOT_REPRODUCED),
        (17.5 - 0.125 * 2.99, 0.125, REPRODUCED),
        (17.5 - 0.125 * 3.01, 0.125, NOT_REPRODUCED),
        (18.0, 0.166, REPRODUCED),  # 3 errors are 0.498
        (18.0, 0.167, UNDECIDED),
        (19.0, 0.2, UNDECIDED),
        (19.2, 0.2, NOT_REPRODUCED),
        (math.nan, math.nan, UNDECIDED),
    ],
)
def test_a_figure_within_its_printed_digits(value, error, verdict):
    assert figure(value, error) == verdict


def test_assumptions_are_named_only_where_the_figure_is_met():
    assert figure(18.0, 0.01, assumptions=True) == ASSUMED
    assert figure(25.0, 0.01, assumptions=True) == NOT_REPRODUCED
    assert figure(18.0, 1.0, assumptions=True) == UNDECIDED


# ---- comparisons -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gap", "verdict"),
    [
        (0.125 * 3.01, REPRODUCED),
        (0.125 * 2.99, UNDECIDED),
        (0.0, UNDECIDED),
        (-0.125 * 2.99, UNDECIDED),
        (-0.125 * 3.01, NOT_REPRODUCED),
    ],
)
def test_a_comparison_needs_the_claimed_sign_by_three_errors(gap, verdict):
    assert comparison(gap, 0.125, sign="greater") == verdict
    assert comparison(-gap, 0.125, sign="less") == verdict


@pytest.mark.parametrize(
    ("ratio", "error", "verdict"),
    [
        (0.8, 0.001, REPRODUCED),
        (0.82, 0.001, DIRECTION),
        (0.80, 0.05, UNDECIDED),  # the sign is certain, the ratio isn't
        (0.90, 0.001, DIRECTION),
    ],
)
def test_a_published_ratio_is_judged_beside_the_sign(ratio, error, verdict):
    keywords = {"value": 0.8, "tolerance": 0.005, "ratio": Estimate(ratio, error, MANY)}
    assert comparison(-0.2, 0.001, **keywords) == verdict
    assert comparison(0.2, 0.001, **keywords) == NOT_REPRODUCED
    assert comparison(0.0, 0.001, **keywords) == UNDECIDED


def test_a_published_ratio_rests_on_the_scenarios_assumptions():
    ours = Paired(0.8, 1.0, Estimate(-0.2, 0.001, MANY), Estimate(0.8, 0.001, MANY))
    outcome = judge_comparison(claim(0.8, 0.005, sign="less"), ours, assumptions=True)
    assert outcome.verdict == ASSUMED
    assert outcome.ours == ours.ratio
    plain = judge_comparison(claim(sign="less"), ours, assumptions=True)
    assert plain.verdict == REPRODUCED
    assert plain.ours == ours.difference


# ---- what was expected -----------------------------------------------------------------------


@pytest.mark.parametrize("expect", [REPRODUCED, ASSUMED, DIRECTION, NOT_REPRODUCED])
def test_a_verdict_differs_unless_expected_or_undecided(expect):
    stated = claim(18.0, 0.5, expect=expect)
    verdicts = {}
    for value, error in ((18.0, 0.01), (25.0, 0.01), (18.0, 5.0)):
        outcome = judge_figure(stated, Estimate(value, error, MANY), assumptions=True)
        verdicts[outcome.verdict] = outcome.differs
    assert verdicts == {
        ASSUMED: expect != ASSUMED,
        NOT_REPRODUCED: expect != NOT_REPRODUCED,
        UNDECIDED: False,
    }


# ---- few runs --------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [18.0, 25.0, 1e6])
def test_one_run_decides_nothing(value):
    assert figure(value, math.nan, n_runs=1) == UNDECIDED
    assert comparison(value, math.nan, n=1) == UNDECIDED
    assert comparison(-value, math.nan, n=1) == UNDECIDED
    ratio = Estimate(value, math.nan, 1)
    assert comparison(-1.0, math.nan, n=1, value=0.8, tolerance=0.01, ratio=ratio) == UNDECIDED


def test_a_window_without_steps_is_not_a_lack_of_runs():
    assert figure(*NOTHING[:2], n_runs=0) == NO_DATA
    assert comparison(*NOTHING[:2], n=0) == NO_DATA
    assert not judge_figure(claim(18.0, 0.5), NOTHING, assumptions=False).differs


@pytest.mark.parametrize("n_runs", [2, 3, 5, 10, 30])
def test_few_runs_dont_cry_wolf(n_runs):
    # The claim is true to the last digit; its error is estimated from the few runs themselves.
    rng = np.random.default_rng(21)
    repetitions = 4000
    runs = rng.normal(18.0, 3.0, (repetitions, n_runs))
    error = runs.std(axis=1, ddof=1) / math.sqrt(n_runs)
    figures, signs = 0, 0
    for mean, e in zip(runs.mean(axis=1).tolist(), error.tolist(), strict=True):
        figures += figure(mean, e, n_runs=n_runs, tolerance=0.0005) == NOT_REPRODUCED
        signs += comparison(mean - 18.0, e, n=n_runs) != UNDECIDED
    # 0.27 % miss by more than 3 standard deviations; 4 standard errors of that share on top.
    share = math.erfc(3.0 / math.sqrt(2.0))
    allowed = share + 4.0 * math.sqrt(share / repetitions)
    assert figures / repetitions <= allowed
    assert signs / repetitions <= allowed


@pytest.mark.parametrize("freedom", [1, 30, FEW_RUNS - 1, FEW_RUNS, 1000, 10**6])
def test_the_error_allowed_is_students(freedom):
    expected = -stdtrit(freedom, ONE_SIDED)
    assert _student(freedom) == pytest.approx(expected, rel=1e-11)
