"""From errors to scans: when the error of telling two modes apart falls below a target."""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hybridtrack.analyses._errors_of_tests import (
    Spectrum,
    bhattacharyya_distance,
    error_probability,
    lower_error,
    upper_error,
)
from hybridtrack.analyses._least_errors import without_noise
from hybridtrack.analyses._observability_matrices import ModeDynamics
from hybridtrack.analyses._telling_apart import Outputs, outputs_of, spectrum
from hybridtrack.models import Array

CURVE_POINTS = 24
ALIKE = 1e-20  # a Bhattacharyya distance that rounding alone makes


class ErrorCurve(NamedTuple):
    """The error of the best test after some numbers of scans, and what it is held between."""

    scans: Array  # (n,)
    lower: Array  # (n,)
    exact: Array  # (n,)
    upper: Array  # (n,)


class Horizon(NamedTuple):
    """The smallest numbers of scans with an error at or below the target.

    inf: never; None: not within the scans looked at. `because` says why for both, or is empty.
    """

    lower: float | None  # by the lower bound of the error: no test is sooner
    exact: float | None
    upper: float | None  # by the upper bound of the error
    because: str
    looked_at: int  # scans
    last_error: float  # after the last of these
    curve: ErrorCurve | None  # None unless asked for


def horizon(
    one: ModeDynamics,
    other: ModeDynamics,
    target_error: float,
    most_scans: int,
    *,
    at_first_scan: bool = False,
    told_covariance: Array | None = None,
    with_curve: bool = False,
) -> Horizon:
    """How many scans tell two modes apart with an error of `target_error` or less.

    at_first_scan and told_covariance are those of `outputs_of`. More scans never harm, so that the
    bounds bracket the exact error's scan and bisection finds it. The horizon is inf only where
    there is a reason: the modes are the same, their outputs are alike to rounding, or even without
    noise they would be confused more often than the target (`without_noise`).
    """
    if _same(one, other):
        ends = np.array([1.0, most_scans])
        half = np.full(2, 0.5)
        curve = ErrorCurve(ends, half, half, half) if with_curve else None
        return Horizon(
            math.inf, math.inf, math.inf, "they are the same model", most_scans, 0.5, curve
        )
    scans = min(8, most_scans)
    while True:
        outputs = outputs_of(
            one, other, scans, at_first_scan=at_first_scan, told_covariance=told_covariance
        )
        done = upper_error(spectrum(outputs, outputs.scans)) <= target_error
        if done or outputs.scans < scans or scans == most_scans:
            break
        scans = min(2 * scans, most_scans)
    found = _horizon(outputs, target_error, outputs.scans < scans, with_curve)
    if found.exact is None:
        never = _why_never(one, other, outputs, target_error, at_first_scan, told_covariance)
        if never:
            found = found._replace(lower=math.inf, exact=math.inf, upper=math.inf, because=never)
    return found


def _same(one: ModeDynamics, other: ModeDynamics) -> bool:
    """Whether two modes differ in nothing but their names."""
    return all(map(np.array_equal, one[1:], other[1:]))


def _why_never(
    one: ModeDynamics,
    other: ModeDynamics,
    outputs: Outputs,
    target: float,
    at_first_scan: bool,
    told: Array | None,
) -> str:
    """Why no number of scans meets the target; empty where that isn't known."""
    alike = "their outputs are alike to rounding"
    distance = bhattacharyya_distance(spectrum(outputs, outputs.scans))
    if distance < ALIKE and outputs.scans >= _enough_scans(one) and not _grows(one, other):
        return alike
    best = without_noise(one, other, at_first_scan, told)
    if best is None:
        return ""
    if bhattacharyya_distance(best) < ALIKE:
        return alike
    error = error_probability(best)
    if error <= target * (1.0 + 1e-6):  # the integral's own error, and more
        return ""
    return f"even without noise the best test would err in {_rounded_down(100 * error)} % of cases"


def _enough_scans(mode: ModeDynamics) -> int:
    """Scans over which two modes' outputs are alike only if they are for ever.

    A covariance of two outputs obeys a linear recursion of order 2 n_x in the scans between them,
    and one of order n_x (n_x + 1) + 1 in the first one's: those of both modes' states, by Cayley
    and Hamilton, and a constant.
    """
    n_x = len(mode.initial_mean)
    return 2 * n_x + n_x * (n_x + 1) + 1


def _grows(one: ModeDynamics, other: ModeDynamics) -> bool:
    """Whether a difference lost in rounding may grow out of it exponentially."""
    sizes = [np.abs(np.linalg.eigvals(m.state_transition)).max() for m in (one, other)]
    return bool(max(sizes) > 1.0 + 1e-7)  # as near as a double eigenvalue of 1 is found


def _rounded_down(number: float) -> str:
    """To 3 digits."""
    place = 10.0 ** (math.floor(math.log10(number)) - 2)
    return f"{math.floor(number / place) * place:.3g}"


def _horizon(outputs: Outputs, target: float, cut_short: bool, with_curve: bool) -> Horizon:
    axes = functools.cache(functools.partial(spectrum, outputs))
    exact_error = functools.cache(lambda scans: error_probability(axes(scans)))
    # From the scan on where one mode's outputs are impossible under the other, no test errs.
    end = outputs.scans if outputs.singular_at is None else outputs.singular_at

    def first(error: Callable[[int], float], low: int, high: int) -> float | None:
        """The first scan in low .. high that meets the target; None if high doesn't."""
        if high > outputs.scans:
            if outputs.scans < low or error(outputs.scans) > target:
                return float(high)
            high = outputs.scans
        if error(high) > target:
            return None
        while low < high:
            middle = (low + high) // 2
            low, high = (low, middle) if error(middle) <= target else (middle + 1, high)
        return float(low)

    lower = first(lambda scans: lower_error(axes(scans)), 1, end)
    upper = first(lambda scans: upper_error(axes(scans)), int(lower or end), end)
    exact = first(exact_error, int(lower or end), int(upper or end))
    last = 0.0 if outputs.singular_at is not None else exact_error(outputs.scans)
    because = ""
    if outputs.singular_at is not None and exact == outputs.singular_at:
        because = "from this scan on one's outputs are impossible under the other: too little noise"
    if exact is None:
        because = f"not within {outputs.scans} scan" + ("" if outputs.scans == 1 else "s")
        if cut_short:
            because += ", beyond which the states are too large for numbers"
        elif lower is None and _seems_to_level_off(axes, outputs.scans, target):
            because += f", where the error seems to level off at {last:.3g}"
    curve = None
    if with_curve:
        found = upper is not None and upper < outputs.scans
        stop = math.ceil(1.2 * (upper or 0.0)) if found else outputs.scans
        curve = _curve(axes, exact_error, min(stop, outputs.scans))
    return Horizon(lower, exact, upper, because, end, last, curve)


def _seems_to_level_off(axes: Callable[[int], Spectrum], scans: int, target: float) -> bool:
    """Whether the last two doublings of the scans suggest that the target isn't met at all.

    D(1/2) gained so little by them that, were its gains a geometric series, the lower bound of the
    error would stay above the target. That is no proof: a small difference may grow later.
    """
    if scans < 32:
        return False
    before, middle, last = (bhattacharyya_distance(axes(scans // n)) for n in (4, 2, 1))
    ratio = (last - middle) / max(middle - before, 1e-300)
    if last - middle <= 1e-12 * last:
        limit = last
    elif ratio < 0.75:  # a distance that grows with the logarithm of the scans has 1, at length
        limit = last + (last - middle) * ratio / (1.0 - ratio)
    else:
        return False
    return 0.5 * (1.0 - math.sqrt(-math.expm1(-2.0 * limit))) > target


def _curve(
    axes: Callable[[int], Spectrum], exact_error: Callable[[int], float], stop: int
) -> ErrorCurve:
    # Evenly spaced where that costs little, else more of them where there are few scans.
    spaced = np.linspace if stop <= 2 * CURVE_POINTS else np.geomspace
    at = np.unique(np.round(spaced(1, max(stop, 1), CURVE_POINTS)).astype(int))
    if stop < 1:
        return ErrorCurve(*np.zeros((4, 0)))
    rows = [
        (scans, lower_error(axes(scans)), exact_error(scans), upper_error(axes(scans)))
        for scans in at.tolist()
    ]
    return ErrorCurve(*np.array(rows, dtype=np.float64).T)
