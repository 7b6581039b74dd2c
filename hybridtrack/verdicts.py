"""What became of a published claim: the one place where a verdict is reached.

A claim is a figure ("IMM position RMS is 18 m") or a comparison ("RMIMM has the smaller RMS"), on
a metric of a run; or a figure that follows from the scenario alone ("50 steps on average"). A
figure is met if ours, give or take K standard errors, lies within what the printed digits can mean;
a comparison holds if the paired difference has the claimed sign by more than K standard errors, or
if the paired ratio of two that are said to be equal, give or take as much, is 1 within the
scenario's tolerance. Agreement within an error wider than the printed digits decides nothing.
The error is itself estimated from the runs: where these are few, Student's quantile of the same
probability stands for K, and one run decides nothing. A window that holds no step, or no run that
didn't diverge, leaves nothing to judge.
"""

import math
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from hybridtrack.statistics import Estimate, Paired

FEW_RUNS = 300
K = 3.0  # standard errors allowed: 0.27 % of honest claims miss by more
ONE_SIDED = 0.5 * math.erfc(K / math.sqrt(2.0))

REPRODUCED = "reproduced"
ASSUMED = "reproduced with stated assumptions"
DIRECTION = "direction only"
NOT_REPRODUCED = "not reproduced"
UNDECIDED = "undecided: too few runs"
NO_DATA = "undecided: no data"


class Claim(NamedTuple):
    """A published claim as the scenario states it."""

    claim: str
    estimator: str | None  # of a figure of a run
    compare: tuple[str, str] | None  # of a comparison: first, second
    metric: str  # or the name of an exact figure
    window: str
    value: float | None  # the figure, or the published ratio first/second of a comparison
    tolerance: float  # half a unit of the last printed digit of `value`, or as the scenario says
    sign: str | None  # less | greater | equal: first against second; a figure against `value`
    expect: str  # the verdict when last looked at
    because: str
    exact: float | None = None  # what follows from the scenario alone


class AnalysisClaim(NamedTuple):
    """A published claim on a figure of an analysis, or on which of two is the larger."""

    claim: str
    analysis: str
    figure: str  # a column of the analysis' table
    where: Mapping[str, Any]  # the row's cells by column
    than: Mapping[str, Any] | None  # another row's, of a comparison
    value: float | None
    tolerance: float
    sign: str | None  # less | greater
    expect: str
    because: str
    place: str  # where the scenario says it


class Interval(NamedTuple):
    """A figure, and what it may be: what chance allows it, or itself where there is no chance."""

    value: float
    low: float
    high: float


class Outcome(NamedTuple):
    """A claim with our figure and the verdict; `differs` where it isn't the expected one."""

    claim: Claim
    ours: Estimate
    verdict: str
    differs: bool


def printed_tolerance(text: str) -> float:
    """Half a unit of the last digit of a number as printed: '18' gives 0.5, '2.10' gives 0.005."""
    match = re.fullmatch(r"[-+]?(\d*)\.?(\d*)(?:[eE]([-+]?\d+))?", text.strip("'\" "))
    if match is None or not match[1] + match[2]:
        raise ValueError(f"not a printed number: {text!r}")
    return 0.5 * 10.0 ** (int(match[3] or 0) - len(match[2]))


def judge_figure(claim: Claim, ours: Estimate, assumptions: bool) -> Outcome:
    """The verdict on a published figure, or bound where there is a sign.

    assumptions: the scenario filled in what is missing.
    """
    if claim.sign is not None:
        assert claim.value is not None
        distance = Estimate(ours.value - claim.value, ours.standard_error, ours.n_runs)
        return _outcome(claim, ours, _sign(claim, distance, assumptions))
    return _outcome(claim, ours, _figure(claim, ours, assumptions))


def judge_exact(claim: Claim) -> Outcome:
    """The verdict on a figure that needs no run: no chance, no assumption."""
    assert claim.exact is not None
    ours = Estimate(claim.exact, math.nan, 0)
    assert claim.value is not None
    met = abs(claim.exact - claim.value) <= claim.tolerance
    return _outcome(claim, ours, REPRODUCED if met else NOT_REPRODUCED)


def judge_interval(claim: AnalysisClaim, ours: Interval, assumptions: bool) -> str:
    """The verdict on a figure of an analysis, or on the difference of two (first - second)."""
    if math.isnan(ours.value):
        return NOT_REPRODUCED
    if claim.sign is not None:
        bound = 0.0 if claim.value is None else claim.value
        ours = ours if claim.sign == "less" else Interval(-ours.value, -ours.high, -ours.low)
        bound = bound if claim.sign == "less" else -bound
        if ours.high < bound:
            return REPRODUCED
        return NOT_REPRODUCED if ours.low >= bound else UNDECIDED
    assert claim.value is not None
    low, high = claim.value - claim.tolerance, claim.value + claim.tolerance
    if low <= ours.low and ours.high <= high:
        return ASSUMED if assumptions else REPRODUCED
    return NOT_REPRODUCED if ours.high < low or ours.low > high else UNDECIDED


def judge_comparison(claim: Claim, ours: Paired, assumptions: bool) -> Outcome:
    """The verdict on a comparison; a published ratio is judged too, where there is one.

    Two that are said to be equal are so if their ratio is 1 within the scenario's tolerance.
    """
    assert claim.sign is not None
    if claim.sign == "equal":
        return _outcome(claim, ours.ratio, _equality(claim, ours.ratio, assumptions))
    figure = ours.ratio if claim.value is not None else ours.difference
    verdict = _sign(claim, ours.difference, assumptions)
    if verdict in (REPRODUCED, ASSUMED) and claim.value is not None:
        met = _figure(claim, ours.ratio, assumptions)
        verdict = DIRECTION if met == NOT_REPRODUCED else met
    return _outcome(claim, figure, verdict)


def _sign(claim: Claim, difference: Estimate, assumptions: bool) -> str:
    """Whether a difference has the claimed sign by more than chance may do.

    A sign stands for itself, unless whoever wrote the claim says that it rests on the assumptions.
    """
    gap = difference.value if claim.sign == "greater" else -difference.value
    allowed = _allowed(difference)
    if gap > allowed:
        return ASSUMED if assumptions and claim.expect == ASSUMED else REPRODUCED
    return NOT_REPRODUCED if gap < -allowed else _undecided(difference)


def _figure(claim: Claim, ours: Estimate, assumptions: bool) -> str:
    assert claim.value is not None
    allowed = _allowed(ours)
    if abs(ours.value - claim.value) > claim.tolerance + allowed:
        return NOT_REPRODUCED
    if allowed <= claim.tolerance:
        return ASSUMED if assumptions else REPRODUCED
    return _undecided(ours)


def _equality(claim: Claim, ratio: Estimate, assumptions: bool) -> str:
    """All that chance may do has to lie within the tolerance, which is no rounding here."""
    distance, allowed = abs(ratio.value - 1.0), _allowed(ratio)
    if distance + allowed <= claim.tolerance:
        return ASSUMED if assumptions else REPRODUCED
    return NOT_REPRODUCED if distance - allowed > claim.tolerance else _undecided(ratio)


def _undecided(ours: Estimate) -> str:
    return UNDECIDED if ours.n_runs else NO_DATA


def _allowed(ours: Estimate) -> float:
    """What chance may do: K standard errors, more where few runs tell the error; NaN for one."""
    if ours.n_runs < 2:
        return math.nan
    return _student(ours.n_runs - 1) * ours.standard_error


def _student(freedom: int) -> float:
    """Student's quantile of K's probability.

    Of many runs by Fisher's series (Abramowitz and Stegun 1964, eq. 26.7.5), here to 1e-10: scipy
    takes longer to import than all verdicts take.
    """
    if freedom < FEW_RUNS:
        from scipy.special import stdtrit

        return float(-stdtrit(freedom, ONE_SIDED))
    x = K
    terms = (
        x,
        (x**3 + x) / 4,
        (5 * x**5 + 16 * x**3 + 3 * x) / 96,
        (3 * x**7 + 19 * x**5 + 17 * x**3 - 15 * x) / 384,
        (79 * x**9 + 776 * x**7 + 1482 * x**5 - 1920 * x**3 - 945 * x) / 92160,
    )
    return sum(term / float(freedom) ** i for i, term in enumerate(terms))


def _outcome(claim: Claim, ours: Estimate, verdict: str) -> Outcome:
    return Outcome(claim, ours, verdict, verdict not in (claim.expect, UNDECIDED, NO_DATA))
