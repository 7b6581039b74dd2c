"""Recordings: the reading rules against plain loops, the plane against geocentric coordinates,
the fit against exact cubics, and one real flight against its own ground speed and track."""

from __future__ import annotations

import gzip
import importlib.util
import json
import math
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridtrack.errors import UserError
from hybridtrack.recordings import (
    Source,
    Track,
    about,
    read_tracks,
    seconds_after,
    smooth,
    thin,
)

FLIGHT = Source(
    file="data/samples/featured/belevingsvlucht.json.gz",
    package="traffic==2.13",
    minimum_altitude_m=457.2,
)


# --- oracles: slow and obvious ---------------------------------------------------------------


def usable_rows(rows: list[dict[str, Any]], minimum_altitude: float | None) -> list[dict[str, Any]]:
    """The reading rules, one after the other."""
    rows = [row for row in rows if None not in (row["time"], row["x"], row["y"])]
    rows = sorted(rows, key=lambda row: row["time"])
    if minimum_altitude is not None:
        rows = [row for row in rows if row["altitude"] is not None]
        rows = [row for row in rows if row["altitude"] >= minimum_altitude]
    unique: list[dict[str, Any]] = []
    for row in rows:
        if row["time"] not in [kept["time"] for kept in unique]:
            unique.append(row)
    kept = unique[:1]
    for before, row in pairwise(unique):
        if (row["x"], row["y"]) != (before["x"], before["y"]):
            kept.append(row)
    return kept


def thinned(time_s: list[float], every_s: float) -> list[int]:
    kept = [0]
    for index, time in enumerate(time_s):
        if index > 0 and time >= time_s[kept[-1]] + every_s - 1e-9:
            kept.append(index)
    return kept


def geocentric(latitude: float, longitude: float) -> np.ndarray:
    """Cartesian position in m on the WGS84 ellipsoid."""
    semi_major, flattening = 6378137.0, 1.0 / 298.257223563
    e2 = flattening * (2.0 - flattening)
    phi, lam = math.radians(latitude), math.radians(longitude)
    normal = semi_major / math.sqrt(1.0 - e2 * math.sin(phi) ** 2)
    return normal * np.array(
        [
            math.cos(phi) * math.cos(lam),
            math.cos(phi) * math.sin(lam),
            (1.0 - e2) * math.sin(phi),
        ]
    )


def east_north(latitude: float, longitude: float, origin: tuple[float, float]) -> np.ndarray:
    phi, lam = np.radians(origin)
    east = np.array([-np.sin(lam), np.cos(lam), 0.0])
    north = np.array([-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)])
    away = geocentric(latitude, longitude) - geocentric(*origin)
    return np.array([east @ away, north @ away])


# --- files -----------------------------------------------------------------------------------


def table(n: int = 12, **columns: Any) -> pd.DataFrame:
    """A usable table in metres; a column of None is left out."""
    steps = np.arange(float(n))
    usable = {"time": steps, "x": 10.0 * steps, "y": -3.0 * steps} | columns
    return pd.DataFrame({name: values for name, values in usable.items() if values is not None})


def saved(folder: Path, frame: pd.DataFrame, name: str = "flight.csv", **source: Any) -> Source:
    path = folder / name
    if ".csv" in name:
        frame.to_csv(path, index=False)
    elif ".json" in name:
        frame.to_json(path, orient="records", date_format="iso")
    else:
        frame.to_parquet(path, index=False)
    return Source(file=name, folder=folder, **source)


def only(source: Source) -> Track:
    (track,) = read_tracks(source)
    return track


# --- reading ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["a.csv", "a.csv.gz", "a.CSV", "a.json", "a.json.gz", "a.parquet", "b.c.parquet"]
)
def test_every_format_gives_the_same_track(tmp_path: Path, name: str) -> None:
    frame = table(y=np.arange(12.0) / 3.0)
    if name == "a.CSV":
        frame.to_csv(tmp_path / name, index=False)
        source = Source(file=name, folder=tmp_path)
    else:
        source = saved(tmp_path, frame, name)
    track = only(source)
    assert track.name == name[0]
    assert track.epoch == ""
    np.testing.assert_array_equal(track.time_s, np.arange(12.0))
    # pandas writes JSON with 10 decimals and reads decimal text to the last bit or two.
    np.testing.assert_allclose(track.position_m, frame[["x", "y"]], rtol=0.0, atol=1e-10)


def test_json_may_be_column_by_column(tmp_path: Path) -> None:
    frame = table()
    (tmp_path / "lists.json").write_text(json.dumps(frame.to_dict(orient="list")))
    frame.to_json(tmp_path / "indexed.json", orient="columns")
    for name in ("lists.json", "indexed.json"):
        track = only(Source(file=name, folder=tmp_path))
        np.testing.assert_array_equal(track.position_m, frame[["x", "y"]])


def test_commas_may_be_followed_by_spaces(tmp_path: Path) -> None:
    lines = [f"{i}, {-i}, 2018-05-30 15:21:{i + 10}" for i in range(12)]
    (tmp_path / "a.csv").write_text("\n".join(["x, y, time", *lines]))
    track = only(Source(file="a.csv", folder=tmp_path))
    np.testing.assert_array_equal(track.time_s, np.arange(12.0))


def test_time_may_be_the_index_of_a_parquet_file(tmp_path: Path) -> None:
    table().set_index("time").to_parquet(tmp_path / "a.parquet")
    track = only(Source(file="a.parquet", folder=tmp_path))
    np.testing.assert_array_equal(track.time_s, np.arange(12.0))


EPOCH = "2018-05-30T15:21:38.123000+00:00"
TIMES = pd.date_range(EPOCH, periods=12, freq="4100ms")
SECONDS = TIMES.as_unit("ns").asi8 / 1e9


@pytest.mark.parametrize(
    ("times", "name"),
    [
        pytest.param(TIMES.strftime("%Y-%m-%dT%H:%M:%S.%fZ"), "a.csv", id="text-utc"),
        pytest.param(TIMES.strftime("%Y-%m-%d %H:%M:%S.%f"), "a.csv", id="text-without-zone"),
        pytest.param(
            TIMES.tz_convert("Europe/Amsterdam").map(lambda time: time.isoformat()),
            "a.csv",
            id="text-with-offset",
        ),
        pytest.param(TIMES, "a.parquet", id="datetimes-utc"),
        pytest.param(TIMES.tz_convert("Asia/Tokyo"), "a.parquet", id="datetimes-tokyo"),
        pytest.param(TIMES.tz_localize(None), "a.parquet", id="datetimes-without-zone"),
        pytest.param(TIMES.as_unit("ns"), "a.parquet", id="datetimes-ns"),
        pytest.param(SECONDS, "a.parquet", id="seconds"),
        pytest.param(SECONDS, "a.csv", id="seconds-text"),
        pytest.param(np.rint(SECONDS * 1e3).astype(int), "a.json", id="milliseconds"),
        pytest.param(np.rint(SECONDS * 1e6).astype(int), "a.json", id="microseconds"),
        pytest.param(TIMES.as_unit("ns").asi8, "a.csv", id="nanoseconds"),
    ],
)
def test_every_kind_of_time_gives_seconds_and_the_epoch(
    tmp_path: Path, times: Any, name: str
) -> None:
    track = only(saved(tmp_path, table(time=times), name))
    # Exactly: a step of 4.0999998 s would be thinned as less than 4.1 s.
    np.testing.assert_array_equal(track.time_s, np.arange(12) * 4100 / 1000)
    assert track.epoch == EPOCH


def test_epoch_is_the_time_of_the_first_sample_that_is_used(tmp_path: Path) -> None:
    frame = table(time=TIMES, altitude=[100.0, 100.0, *[9000.0] * 10])
    track = only(saved(tmp_path, frame, "a.parquet", minimum_altitude_m=457.2))
    assert track.epoch == "2018-05-30T15:21:46.323000+00:00"
    assert track.time_s[0] == 0.0


ROW = st.fixed_dictionaries(
    {
        "time": st.none() | st.integers(0, 25),
        "x": st.none() | st.integers(0, 2),
        "y": st.none() | st.integers(0, 1),
        "altitude": st.none() | st.sampled_from([99.0, 100.0, 101.0]),
    }
)


@settings(max_examples=60, deadline=None)
@given(st.lists(ROW, min_size=10, max_size=60), st.sampled_from([None, 100.0]))
def test_rows_are_dropped_by_the_rules_in_their_order(
    tmp_path_factory: pytest.TempPathFactory, rows: list[dict[str, Any]], minimum: float | None
) -> None:
    # Twelve sure rows at the end of time, so that most examples have enough.
    rows = rows + [{"time": 30 + i, "x": i + 5, "y": 0, "altitude": 100.0} for i in range(12)]
    folder = tmp_path_factory.getbasetemp()
    (folder / "rows.json").write_text(json.dumps(rows))
    track = only(Source("rows.json", folder=folder, minimum_altitude_m=minimum, altitude_unit="m"))
    expected = usable_rows(rows, minimum)
    times = np.array([row["time"] for row in expected], dtype=float)
    np.testing.assert_array_equal(track.time_s, times - times[0])
    np.testing.assert_array_equal(track.position_m, [[row["x"], row["y"]] for row in expected])


def test_altitude_is_in_feet_unless_the_source_says_metres(tmp_path: Path) -> None:
    frame = table(24, altitude=np.linspace(900.0, 2050.0, 24))  # 50 apart: 1500 is the 13th
    feet = only(saved(tmp_path, frame, minimum_altitude_m=457.2))
    metres = only(saved(tmp_path, frame, minimum_altitude_m=1500.0, altitude_unit="m"))
    assert len(feet.time_s) == len(metres.time_s) == 12


def test_gaps_are_kept(tmp_path: Path) -> None:
    times = np.where(np.arange(12) < 6, 0.0, 500.0) + np.arange(12)
    np.testing.assert_array_equal(only(saved(tmp_path, table(time=times))).time_s, times)


def test_local_plane_is_the_tangent_plane_at_the_first_kept_position(tmp_path: Path) -> None:
    latitude = np.linspace(52.3, 53.3, 12)
    longitude = np.linspace(4.7, 6.9, 12)
    altitude = [0.0, *[9000.0] * 11]
    frame = table(x=None, y=None, Lat=latitude, LON=longitude, altitude=altitude)
    track = only(saved(tmp_path, frame, "a.parquet", minimum_altitude_m=457.2))
    origin = (latitude[1], longitude[1])
    expected = [
        east_north(*degrees, origin) for degrees in zip(latitude[1:], longitude[1:], strict=True)
    ]
    # Rounding of geocentric coordinates of 6e6 m, a few times 1e-9 m.
    np.testing.assert_allclose(track.position_m, expected, rtol=0.0, atol=1e-7)
    assert tuple(track.position_m[0]) == (0.0, 0.0)


def test_a_track_moves_to_the_plane_of_another(tmp_path: Path) -> None:
    latitude, longitude = np.linspace(52.0, 52.5, 12), np.linspace(5.0, 6.0, 12)
    frame = table(x=None, y=None, lat=latitude, lon=longitude)
    track = only(saved(tmp_path, frame, "a.parquet"))
    other = only(saved(tmp_path, frame.assign(lat=latitude + 1.0), "b.parquet"))
    moved = about(track, other)
    expected = [
        east_north(*degrees, (53.0, 5.0)) for degrees in zip(latitude, longitude, strict=True)
    ]
    np.testing.assert_allclose(moved.position_m, expected, rtol=0.0, atol=1e-7)  # as above
    np.testing.assert_allclose(about(moved, track).position_m, track.position_m, atol=1e-7)
    planar = only(saved(tmp_path, table(), "c.parquet"))
    assert about(planar, planar) is planar
    for one, two in ((track, planar), (planar, track)):
        with pytest.raises(UserError, match="one has latitude and longitude and the other x and y"):
            about(one, two)


def test_how_much_later_a_track_begins(tmp_path: Path) -> None:
    early, late = (
        only(saved(tmp_path, table(time=start + np.arange(12.0)), f"{start}.csv"))
        for start in (-5, 7)
    )
    assert (early.start_s, late.start_s, late.time_s[0]) == (-5.0, 7.0, 0.0)
    assert seconds_after(late, early) == 12.0
    assert seconds_after(early, late) == -12.0
    dated = only(saved(tmp_path, table(time=TIMES), "a.parquet"))
    later = only(saved(tmp_path, table(time=TIMES + pd.Timedelta("90s")), "b.parquet"))
    assert dated.start_s == 0.0
    assert seconds_after(later, dated) == 90.0
    assert seconds_after(dated, later) == -90.0
    with pytest.raises(UserError, match="one has dates and the other plain seconds"):
        seconds_after(dated, late)


def test_plain_seconds_begin_at_the_first_sample_that_is_used(tmp_path: Path) -> None:
    frame = table(time=np.arange(3.0, 15.0), altitude=[100.0, 100.0, *[9000.0] * 10])
    track = only(saved(tmp_path, frame, minimum_altitude_m=457.2))
    assert (track.start_s, track.time_s[0], track.time_s[-1]) == (5.0, 0.0, 9.0)


def test_metres_stand_as_they_are_and_named_columns_come_first(tmp_path: Path) -> None:
    frame = table(latitude=52.0 + np.arange(12.0), longitude=5.0, x=None, east=np.arange(12.0))
    track = only(saved(tmp_path, frame, x="east"))
    np.testing.assert_array_equal(track.position_m, frame[["east", "y"]])


def test_several_tracks_in_order_of_first_appearance(tmp_path: Path) -> None:
    # 4840e6 and 48 are numbers to a careless reader, the first the same as 4840000000.
    frame = pd.concat([table(icao24="4840e6", callsign="KLM1 "), table(icao24="48", callsign="B")])
    frame = pd.concat([frame, table(icao24="4840e6", callsign="KLM2")]).sort_values(
        "time", kind="stable"
    )
    for name in ("a.csv", "a.json", "a.parquet"):
        tracks = read_tracks(saved(tmp_path, frame, name))
        assert [track.name for track in tracks] == ["4840e6 KLM1", "48 B", "4840e6 KLM2"]
        assert {len(track.time_s) for track in tracks} == {12}


def test_track_is_an_angle_and_an_id_only_when_named(tmp_path: Path) -> None:
    frame = pd.concat([table(track=90), table(track=91, time=np.arange(100.0, 112.0))])
    assert [track.name for track in read_tracks(saved(tmp_path, frame))] == ["flight"]
    tracks = read_tracks(saved(tmp_path, frame, track="track"))
    assert [track.name for track in tracks] == ["90", "91"]


# --- mistakes --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "source", "says"),
    [
        (table(time=None), {}, r"no time column .* only x, y: name one .* `time`"),
        (table(), {"time": "when"}, r"no time column 'when', only time, x, y"),
        (table(x=None), {}, r"neither latitude and longitude nor x and y, only time, y"),
        (table(y=None), {}, r"no y column"),
        (table(x=None, lat=1.0), {}, r"neither latitude"),
        (table(latitude=1.0), {"latitude": "latitude"}, r"no longitude column"),
        (table(9), {}, r"'flight' .* has 9 usable samples out of 9, fewer than 10"),
        (table(x=1.0, y=1.0), {}, r"has 1 usable samples out of 12"),
        (table(x=np.nan), {}, r"column 'x' .* no value that is a number: it is empty"),
        (table(x="52,3"), {}, r"column 'x' .* its first is '52,3'"),
        (table(x=np.inf), {}, r"column 'x' .* no value that is a number"),
        (table(time="30/05/2018 15:21"), {}, r"column 'time' .* its first is '30/05/2018 15:21'"),
        (table(time=np.nan), {}, r"column 'time' .* it is empty"),
        (table(lat=90.5, lon=1.0), {}, r"90.5 in column 'lat' .* isn't within -90 to 90 degrees"),
        (table(lat=1.0, lon=-181.0), {}, r"-181 in column 'lon' .* within -180 to 360 degrees"),
        (table(), {"minimum_altitude_m": 10.0}, r"no altitude column"),
        (
            table(height_m=9.0),
            {"minimum_altitude_m": 1.0, "altitude": "height_m"},
            r"'height_m' is read in 'ft': set `altitude_unit`",
        ),
        (table(flight_id=[1] * 11 + [2]), {}, r"track '2' .* 1 usable samples out of 1,"),
    ],
)
def test_a_mistake_in_the_table_is_named_in_a_sentence(
    tmp_path: Path, frame: pd.DataFrame, source: dict[str, Any], says: str
) -> None:
    with pytest.raises(UserError, match=says) as caught:
        read_tracks(saved(tmp_path, frame, **source))
    assert "\n" not in str(caught.value)


# A user's warnings are no errors: damage must be one by itself.
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.xlsx", b"", r"'a.xlsx' is no recording by its ending: use .csv"),
        ("a.parquet.gz", b"", r"by its ending"),
        ("a.csvx", b"", r"by its ending"),
        ("a.csv", b"", r"'a.csv' can't be read"),
        ("a.csv", b"time,x,y\n0,1,2\n1,2,3,4\n", r"can't be read"),
        ("a.csv", b"time,x,y\n0,1,2,3\n", r"can't be read"),
        ("a.csv", b"\xff\xfe\x00", r"can't be read"),
        ("a.csv.gz", b"time,x,y\n0,1,2\n", r"can't be read"),
        ("a.csv.gz", gzip.compress(b"time,x,y\n" * 99)[:-12], r"can't be read"),
        ("a.json", b'[{"time": 1', r"can't be read"),
        ("a.json", b"5", r"can't be read"),
        ("a.json", b"[1, 2]", r"no time column .* only 0"),
        ("a.json", b"[]", r"no time column .* only none"),
        ("a.json.gz", gzip.compress(b"[" + b" " * 99)[:-12], r"can't be read"),
        ("a.parquet", b"PAR1 and nothing more", r"can't be read"),
    ],
)
def test_a_damaged_file_is_named_in_a_sentence(
    tmp_path: Path, name: str, content: bytes, says: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=says) as caught:
        read_tracks(Source(file=name, folder=tmp_path))
    assert "\n" not in str(caught.value)


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"there is no recording .*a\.csv: give its path"):
        read_tracks(Source(file="a.csv", folder=tmp_path))


def test_without_pymap3d_the_error_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pymap3d", None)
    frame = table(lat=np.arange(12.0), lon=1.0)
    with pytest.raises(UserError, match=r'pip install "hybridtrack\[recordings\]"'):
        read_tracks(saved(tmp_path, frame))
    assert len(read_tracks(saved(tmp_path, table()))) == 1


# --- recordings inside packages --------------------------------------------------------------


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """An installed package, version 1.5, that holds a recording and can't be imported."""
    (tmp_path / "flight_data" / "samples").mkdir(parents=True)
    (tmp_path / "flight_data" / "__init__.py").write_text("raise RuntimeError('imported')\n")
    table().to_csv(tmp_path / "flight_data" / "samples" / "a.csv", index=False)
    about = tmp_path / "flight_data-1.5.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: flight-data\nVersion: 1.5\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    return "flight-data"


@pytest.mark.parametrize("pin", ["", "==1.5"])
def test_a_package_is_read_without_being_imported(package: str, pin: str) -> None:
    track = only(Source(file="samples/a.csv", package=package + pin))
    assert len(track.time_s) == 12
    assert "flight_data" not in sys.modules


@pytest.mark.parametrize(
    ("requirement", "file", "says"),
    [
        ("flight-data==1.6", "samples/a.csv", r"installed is 1\.5: pip .* flight-data==1\.6$"),
        ("flight-data==1.5", "a.csv", r"no recording .* pip install --no-deps flight-data==1\.5$"),
        ("no-such-one==2", "a.csv", r"not installed here: pip install --no-deps no-such-one==2$"),
        ("flight-data>=1", "a.csv", r"'flight-data>=1' isn't a name or name==version"),
    ],
)
@pytest.mark.usefixtures("package")
def test_a_missing_package_is_named_with_the_command(
    requirement: str, file: str, says: str
) -> None:
    with pytest.raises(UserError, match=says):
        read_tracks(Source(file=file, package=requirement))


# --- thinning --------------------------------------------------------------------------------


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.integers(1, 80), min_size=1, max_size=60),
    st.sampled_from([0.1, 0.3, 1.0, 4.0, 1e-12]),
)
def test_thin_is_greedy_over_the_recordings_own_times(steps: list[int], every_s: float) -> None:
    # Tenths of seconds are inexact: 0.1 + 0.2 must count as 0.3 s.
    time_s = np.cumsum(0.1 * np.array(steps))
    assert thin(time_s, every_s).tolist() == thinned(time_s.tolist(), every_s)


def test_thin_known_case() -> None:
    time_s = np.array([0.0, 1.0, 3.9, 4.0, 7.0, 8.0, 20.0, 21.0, 24.0])
    assert thin(time_s, 4.0).tolist() == [0, 3, 5, 6, 8]
    assert thin(time_s[:0], 4.0).tolist() == []
    # Sums of tenths: 0.7999999999999999 - 0.5 must count as 0.3 s.
    tenths = np.cumsum(np.full(100, 0.1))
    assert thin(tenths, 0.3).tolist() == list(range(0, 100, 3))


@pytest.mark.parametrize("every_s", [0.0, -1.0, math.nan])
def test_thin_needs_a_positive_interval(every_s: float) -> None:
    with pytest.raises(UserError, match="give a positive interval"):
        thin(np.arange(3.0), every_s)


# --- smoothing -------------------------------------------------------------------------------


def uneven_times(seed: int, n: int, start_s: float = 0.0) -> np.ndarray:
    return start_s + np.cumsum(np.random.default_rng(seed).uniform(0.2, 1.8, n))


def as_track(time_s: np.ndarray, position_m: np.ndarray) -> Track:
    return Track("a", time_s, position_m, "")


def test_smooth_returns_an_exact_cubic_and_its_slope() -> None:
    # Late and far away, where powers of the bare time (1e15) would lose every digit.
    time_s = uneven_times(1, 300, start_s=1e5)
    at_time_s = np.linspace(time_s[0], time_s[-1], 500)
    east = np.polynomial.Polynomial([2e5, 150.0, 1.5, 2e-3], domain=[1e5 - 1, 1e5 + 1])
    north = np.polynomial.Polynomial([-3e5, -90.0, 0.5, -4e-3], domain=[1e5 - 1, 1e5 + 1])
    track = as_track(time_s, np.column_stack([east(time_s), north(time_s)]))
    position, velocity = smooth(track, at_time_s)
    # Rounding: positions of 3e5 m carry 6e-11 m, amplified by a one-sided window up to 100
    # times, and times of 1e5 s carry 1.5e-11 s at up to 1e3 m/s.
    truth = np.column_stack([east(at_time_s), north(at_time_s)])
    np.testing.assert_allclose(position, truth, rtol=0.0, atol=1e-7)
    slope = np.column_stack([east.deriv()(at_time_s), north.deriv()(at_time_s)])
    np.testing.assert_allclose(velocity, slope, rtol=0.0, atol=1e-7)


def test_smooth_is_the_least_squares_cubic_of_its_window() -> None:
    rng = np.random.default_rng(2)
    time_s = uneven_times(3, 60)
    track = as_track(time_s, rng.normal(0.0, 50.0, (60, 2)))
    at_time_s = time_s[20] + np.array([0.0, 0.1, 7.0])
    position, velocity = smooth(track, at_time_s, half_window_s=10.0)
    for k, centre in enumerate(at_time_s):
        inside = np.abs(time_s - centre) <= 10.0
        for axis in range(2):
            fit = np.polynomial.Polynomial.fit(time_s[inside], track.position_m[inside, axis], 3)
            # Two well-conditioned solutions of one problem: rounding only.
            assert position[k, axis] == pytest.approx(fit(centre), rel=1e-9, abs=1e-9)
            assert velocity[k, axis] == pytest.approx(fit.deriv()(centre), rel=1e-9, abs=1e-9)


def test_smooth_answers_nan_in_gaps_and_beyond_the_ends() -> None:
    time_s = np.concatenate([np.arange(0.0, 21.0), np.arange(40.0, 61.0), [100.0, 101.0]])
    track = as_track(time_s, np.column_stack([time_s, -time_s]))
    known = {0.0: True, 20.0: True, 40.0: True, 60.0: True}  # one-sided, but no extrapolation
    known |= {-0.5: False, 20.5: False, 30.0: False, 39.5: False, 60.5: False}  # one side only
    known |= {100.0: False, 100.5: False}  # two samples
    known |= {5.0: True, 5.5: True}
    position, velocity = smooth(track, np.array(list(known)))
    assert np.isfinite(position).all(axis=1).tolist() == list(known.values())
    assert np.isfinite(velocity).all(axis=1).tolist() == list(known.values())
    assert np.isnan(position).all(axis=1).tolist() == [not there for there in known.values()]


def test_smooth_needs_six_samples_the_window_s_ends_included() -> None:
    time_s = 0.1 * np.arange(1000.0)
    track = as_track(time_s, np.column_stack([time_s, time_s]))
    # Six samples lie within 0.25 s, two of them exactly so but for the rounding of tenths.
    middles = time_s[:-5] + 0.25
    assert np.isfinite(smooth(track, middles, half_window_s=0.25)[0]).all()
    assert np.isnan(smooth(track, middles, half_window_s=0.24)[0]).all()


def test_smooth_needs_a_positive_window() -> None:
    with pytest.raises(UserError, match="give a positive one"):
        smooth(as_track(np.arange(12.0), np.ones((12, 2))), np.zeros(1), half_window_s=0.0)


# --- a real flight ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flight() -> Track:
    return only(FLIGHT)


@pytest.fixture(scope="module")
def reports() -> list[dict[str, Any]]:
    """The flight's rows as they stand in the file."""
    module = importlib.util.find_spec("traffic")
    assert module is not None
    assert module.origin is not None
    content = (Path(module.origin).parent / FLIGHT.file).read_bytes()
    rows: list[dict[str, Any]] = json.loads(gzip.decompress(content))
    return rows


def test_flight_keeps_the_rows_that_the_rules_keep(
    flight: Track, reports: list[dict[str, Any]]
) -> None:
    assert len(reports) == 16005
    assert all(None not in row.values() for row in reports)
    times = [row["timestamp"] for row in reports]
    assert all(before < after for before, after in pairwise(times))
    high = [row for row in reports if row["altitude"] >= 1500]
    assert len(reports) - len(high) == 451
    places = [(row["latitude"], row["longitude"]) for row in high]
    held = [now == before for before, now in pairwise(places)]
    assert sum(held) == 352
    assert len(flight.time_s) == 16005 - 451 - 352
    kept = [high[0], *(row for row, hold in zip(high[1:], held, strict=True) if not hold)]
    start_ms = kept[0]["timestamp"]
    np.testing.assert_array_equal(
        flight.time_s, [(row["timestamp"] - start_ms) / 1000 for row in kept]
    )
    assert (flight.name, flight.epoch) == ("484506 TRA051", "2018-05-30T15:22:12+00:00")
    origin = (kept[0]["latitude"], kept[0]["longitude"])
    last = east_north(kept[-1]["latitude"], kept[-1]["longitude"], origin)
    # Rounding, as above.
    np.testing.assert_allclose(flight.position_m[-1], last, rtol=0.0, atol=1e-7)


def test_flight_thins_to_scans_of_four_seconds(flight: Track) -> None:
    scans = thin(flight.time_s, 4.0)
    assert scans.tolist() == thinned(flight.time_s.tolist(), 4.0)
    intervals, counts = np.unique(np.diff(flight.time_s[scans]), return_counts=True)
    assert len(scans) == 4185
    assert dict(zip(intervals.tolist(), counts.tolist(), strict=True)) == {
        4.0: 3604, 5.0: 376, 6.0: 132, 7.0: 52, 8.0: 14, 9.0: 3, 10.0: 2, 11.0: 1,
    }  # fmt: skip


def test_smoothed_velocity_agrees_with_the_aircrafts_own(
    flight: Track, reports: list[dict[str, Any]]
) -> None:
    _, velocity = smooth(flight, flight.time_s)
    by_time = {row["timestamp"]: row for row in reports}
    start_ms = pd.Timestamp(flight.epoch).timestamp() * 1000
    rows = [by_time[round(start_ms + 1000 * time)] for time in flight.time_s]
    own_speed = np.array([row["groundspeed"] for row in rows]) * 1852.0 / 3600.0
    own_track = np.array([row["track"] for row in rows])
    longitude = np.array([row["longitude"] for row in rows])
    # The plane's north is the first position's: meridians converge on it.
    convergence = (longitude - longitude[0]) * np.sin(np.radians(rows[0]["latitude"]))
    heading = np.degrees(np.arctan2(velocity[:, 0], velocity[:, 1])) + convergence
    answered = np.isfinite(heading)
    speed_error = (np.hypot(*velocity.T) - own_speed)[answered]
    track_error = ((heading - own_track + 180.0) % 360.0 - 180.0)[answered]

    # Two samples stand alone after gaps (8 s, 10 s).
    assert (~answered).sum() == 2
    # Whole knots and degrees, rounded or cut, may be off by one on average: 0.51 m/s, 1 degree.
    # A foot, mile or radian in the wrong place is off by more than 10 %, 14 m/s.
    assert abs(np.median(speed_error)) < 1852.0 / 3600.0
    assert abs(np.median(track_error)) < 1.0
    # Whole-second stamps misplace a sample by +-0.5 s, 42 m rms at the usual 144 m/s. A cubic
    # over 14 samples within +-8 s makes sqrt(18.75 / 14) / 8 = 0.145 times that of it (the
    # slopes of the Legendre polynomials at 0), 6.1 m/s or 2.4 degrees rms; the median error of
    # a normal variable is 0.67 of its rms.
    assert np.median(np.abs(speed_error)) < 4.1
    assert np.median(np.abs(track_error)) < 1.6
