"""The unit table against scipy.constants, and the keys of a scenario against the table."""

from collections import Counter

import pytest
from scipy import constants

from hybridtrack.config import units

FACTORS = {
    "m": 1.0,
    "km": constants.kilo,
    "ft": constants.foot,
    "nmi": constants.nautical_mile,
    "m_s": 1.0,
    "km_h": constants.kmh,
    "kt": constants.knot,
    "m_s2": 1.0,
    "ft_s2": constants.foot,
    "g": constants.g,
    "m_s3": 1.0,
    "s": 1.0,
    "min": constants.minute,
    "h": constants.hour,
    "rad": 1.0,
    "deg": constants.degree,
    "rad_s": 1.0,
    "deg_s": constants.degree,
    "m2_s3": 1.0,
    "m2_s5": 1.0,
    "m2": 1.0,
    "km2": constants.kilo**2,
    "m2_s2": 1.0,
    "per_s": 1.0,
    "per_min": 1 / constants.minute,
    "per_h": 1 / constants.hour,
}


def test_the_table_is_closed() -> None:
    assert set(units.UNITS) == set(FACTORS)


@pytest.mark.parametrize("suffix", FACTORS)
def test_factors_are_those_of_scipy(suffix: str) -> None:
    # Exact definitions on both sides; 1e-15 allows for one rounding in a product or quotient.
    assert units.UNITS[suffix].factor == pytest.approx(FACTORS[suffix], rel=1e-15, abs=0)


def test_every_dimension_has_one_si_suffix_which_comes_first() -> None:
    si = Counter(unit.dimension for unit in units.UNITS.values() if unit.factor == 1.0)
    first = {unit.dimension: unit.factor for unit in reversed(units.UNITS.values())}
    assert si == dict.fromkeys((unit.dimension for unit in units.UNITS.values()), 1)
    assert set(first.values()) == {1.0}


@pytest.mark.parametrize(
    ("key", "parts"),
    [
        ("acceleration_std_m_s2", ("acceleration_std", "m_s2")),
        ("speed_m_s", ("speed", "m_s")),
        ("turn_rate_deg_s", ("turn_rate", "deg_s")),
        ("acceleration_psd_m2_s3", ("acceleration_psd", "m2_s3")),
        ("velocity_variance_m2_s2", ("velocity_variance", "m2_s2")),
        ("false_alarms_per_min", ("false_alarms", "per_min")),
        ("step_s", ("step", "s")),
        ("range_km", ("range", "km")),
        ("load_g", ("load", "g")),
        ("runs", None),
        ("transition_matrix", None),
        ("items", None),  # ends in s, but not in _s
        ("m_s", None),  # a suffix without a stem
        ("per_s", None),
        ("_m", None),
        ("", None),
    ],
)
def test_split_takes_the_longest_suffix(key: str, parts: tuple[str, str] | None) -> None:
    assert units.split(key) == parts


@pytest.mark.parametrize("suffix", FACTORS)
def test_split_finds_every_suffix_whole(suffix: str) -> None:
    assert units.split(f"quantity_{suffix}") == ("quantity", suffix)


def test_spellings_are_the_units_of_one_dimension() -> None:
    assert units.spellings("speed_m_s") == ("speed_m_s", "speed_km_h", "speed_kt")
    assert units.spellings("heading_rad") == ("heading_rad", "heading_deg")
    assert units.spellings("jerk_psd_m2_s5") == ("jerk_psd_m2_s5",)
    assert units.spellings("runs") == ("runs",)
    with pytest.raises(ValueError, match="speed_kt isn't named in the SI unit of speed"):
        units.spellings("speed_kt")


# Powers of two and the exact factor 60 below: products without rounding, so == is right.
@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (2, 120.0),
        (0.5, 30.0),
        ([1, [2, 0.5]], [60.0, [120.0, 30.0]]),
        ({"CV": 1, "CT": [2.0]}, {"CV": 60.0, "CT": [120.0]}),
        (True, True),
        (None, None),
        ("2", "2"),
        ([1, "x", None, {"CV": 1}], [60.0, "x", None, {"CV": 1}]),
        ({"CV": {"deeper": 1}}, {"CV": {"deeper": 1}}),
    ],
)
def test_to_si_scales_numbers_and_leaves_the_rest(value: object, expected: object) -> None:
    scaled = units.to_si(value, "min")
    assert scaled == expected
    assert type(scaled) is type(expected)


def test_to_si_changes_nothing_in_place_and_keeps_si_whole() -> None:
    position = [[1, 2], [3, 4]]
    units.to_si(position, "km")
    assert position == [[1, 2], [3, 4]]
    assert type(units.to_si(5, "s")) is int


def test_a_quarter_turn() -> None:
    # pi/180 is rounded once and the product once more: two roundings of 1.1e-16.
    assert units.to_si(90, "deg") == pytest.approx(constants.pi / 2, rel=3e-16, abs=0)
