"""The closed table of unit suffixes: a scenario may say `speed_kt`, inside it is `speed_m_s`.

Factors: the foot, nautical mile and knot are exact by international agreement (1959, 1929);
g is the standard acceleration of free fall (CGPM 1901).
"""

import math
from typing import Any, NamedTuple


class Unit(NamedTuple):
    """What a suffix measures, and how many SI units one of it is."""

    dimension: str
    factor: float


# The SI spelling (factor 1) comes first in its dimension.
UNITS: dict[str, Unit] = {
    "m": Unit("length", 1.0),
    "km": Unit("length", 1000.0),
    "ft": Unit("length", 0.3048),
    "nmi": Unit("length", 1852.0),
    "m_s": Unit("speed", 1.0),
    "km_h": Unit("speed", 1000.0 / 3600.0),
    "kt": Unit("speed", 1852.0 / 3600.0),
    "m_s2": Unit("acceleration", 1.0),
    "ft_s2": Unit("acceleration", 0.3048),
    "g": Unit("acceleration", 9.80665),
    "m_s3": Unit("jerk", 1.0),
    "s": Unit("time", 1.0),
    "min": Unit("time", 60.0),
    "h": Unit("time", 3600.0),
    "rad": Unit("angle", 1.0),
    "deg": Unit("angle", math.pi / 180.0),
    "rad_s": Unit("angular_rate", 1.0),
    "deg_s": Unit("angular_rate", math.pi / 180.0),
    "m2_s3": Unit("acceleration_psd", 1.0),
    "m2_s5": Unit("jerk_psd", 1.0),
    "m2": Unit("area", 1.0),
    "km2": Unit("area", 1e6),
    "m2_s2": Unit("speed_variance", 1.0),
    "per_s": Unit("rate", 1.0),
    "per_min": Unit("rate", 1.0 / 60.0),
    "per_h": Unit("rate", 1.0 / 3600.0),
}

_LONGEST_FIRST = sorted(UNITS, key=len, reverse=True)


def split(key: str) -> tuple[str, str] | None:
    """Stem and unit suffix of a key, the longest suffix winning; None for a key without a unit.

    `acceleration_std_m_s2` is ("acceleration_std", "m_s2"), not a time squared.
    """
    if key in UNITS:
        return None
    for suffix in _LONGEST_FIRST:
        stem = key.removesuffix(f"_{suffix}")
        if stem and stem != key:
            return stem, suffix
    return None


def spellings(si_key: str) -> tuple[str, ...]:
    """Every key accepted for one named in SI: `speed_m_s` is also `speed_km_h` and `speed_kt`.

    A key without a unit has itself as its only spelling. Raises ValueError for a key whose suffix
    isn't the SI one: that is a slip in the schema, not the user's mistake.
    """
    parts = split(si_key)
    if parts is None:
        return (si_key,)
    stem, suffix = parts
    unit = UNITS[suffix]
    if unit.factor != 1.0:
        raise ValueError(f"{si_key} isn't named in the SI unit of {unit.dimension}")
    return tuple(
        f"{stem}_{name}" for name, other in UNITS.items() if other.dimension == unit.dimension
    )


def to_si(value: Any, suffix: str) -> Any:
    """`value` in SI units: a number, nested lists of numbers, or a dict of those (one per mode).

    Whatever isn't a number stays as it is, for the schema to complain about. With the SI suffix
    the value comes back untouched, so that whole numbers stay whole.
    """
    factor = UNITS[suffix].factor
    if factor == 1.0:
        return value
    if isinstance(value, dict):
        return {key: _scaled(item, factor) for key, item in value.items()}
    return _scaled(value, factor)


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, list):
        return [_scaled(item, factor) for item in value]
    if isinstance(value, int | float) and not isinstance(value, bool):
        return value * factor
    return value
