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
    bounds bracket the exact error's scan and bisection finds it. An error that isn't below the
    target after `most_scans` is called a plateau, and the horizon inf, if the distance D(1/2)
    gained so little over the last doublings of the scans that by its geometric series it never
    will be.
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
    return _horizon(outputs, target_error, outputs.scans < scans, with_curve)


def _same(one: ModeDynamics, other: ModeDynamics) -> bool:
    """Whether two modes differ in nothing but their names."""
    return all(map(np.array_equal, one[1:], other[1:]))


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
        if not cut_short and bhattacharyya_distance(axes(outputs.scans)) < ALIKE:
            lower = exact = upper = math.inf
            because = "their outputs are alike to rounding"
        elif lower is None and _levels_off(axes, outputs.scans, target):
            lower = exact = upper = math.inf
            because = f"the error levels off at {last:.3g}"
    curve = None
    if with_curve:
        found = upper is not None and upper < outputs.scans
        stop = math.ceil(1.2 * (upper or 0.0)) if found else outputs.scans
        curve = _curve(axes, exact_error, min(stop, outputs.scans))
    return Horizon(lower, exact, upper, because, end, last, curve)


def _levels_off(axes: Callable[[int], Spectrum], scans: int, target: float) -> bool:
    """Whether the lower bound stays above the target for ever, by D(1/2)'s last two doublings."""
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
