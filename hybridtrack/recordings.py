"""Recorded flights: from a file to tracks in a local plane, thinned and smoothed.

A recording is a table with one row per report: CSV, JSON or Parquet. What comes out is SI:
seconds since a track's first sample, metres east and north.
"""

from __future__ import annotations

import gzip
import importlib.metadata
import importlib.util
import json
import re
import warnings
import zlib
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hybridtrack.errors import UserError

FloatArray = NDArray[np.float64]

MINIMUM_SAMPLES = 10
"""A track with fewer usable samples is an error."""

MINIMUM_WINDOW_SAMPLES = 6
"""`smooth` answers NaN where its window holds fewer: a cubic has four coefficients."""

_TIME_TOLERANCE_S = 1e-9
_METRES_PER = {"ft": 0.3048, "m": 1.0}

# Lower-case names in order of preference. `track` is no track's id: in surveillance tables it
# is the angle of flight. Where several columns stand together, they make the id together.
_USUAL_NAMES = {
    "time": ("time", "time_s", "timestamp", "datetime", "t"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "lng", "long"),
    "x": ("x", "x_m"),
    "y": ("y", "y_m"),
    "altitude": ("altitude", "altitude_ft", "geoaltitude", "baro_altitude", "baroaltitude"),
}
_USUAL_IDS = (("flight_id",), ("track_id",), ("icao24", "callsign"), ("icao24",), ("callsign",))

# A numeric time at or above the limit counts since 1970 in that unit. Every limit is the same
# day of March 1973; a smaller number is plain seconds.
_EPOCH_UNITS: tuple[tuple[float, Literal["ns", "us", "ms", "s"]], ...]
_EPOCH_UNITS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"), (1e8, "s"))


class Track(NamedTuple):
    """One recorded track in a local tangent plane."""

    name: str
    time_s: FloatArray
    """(n,) seconds since `epoch`, increasing; the first is 0. Gaps are kept."""
    position_m: FloatArray
    """(n, 2) east and north, metres."""
    epoch: str
    """ISO 8601 time (UTC) of the first sample; empty where the file has plain seconds."""
    origin_deg: tuple[float, float] | None = None
    """Latitude and longitude where the plane touches; None where the file has x and y."""


class Source(NamedTuple):
    """Where a recording is and which of its columns to read.

    A column left at None is found by its usual names, whatever their case.
    """

    file: str
    """.csv, .json (each also .gz) or .parquet; relative to `folder`, or to `package`."""
    package: str | None = None
    """A requirement such as `traffic==2.13` whose installed files hold `file`."""
    time: str | None = None
    latitude: str | None = None
    longitude: str | None = None
    x: str | None = None
    """East, metres; taken with `y` as it stands, where there is no latitude and longitude."""
    y: str | None = None
    altitude: str | None = None
    track: str | None = None
    """The column that tells tracks apart; none at all makes one track."""
    minimum_altitude_m: float | None = None
    """Rows lower than this, or without an altitude, are dropped."""
    altitude_unit: Literal["ft", "m"] = "ft"
    folder: Path = Path()
    origin_deg: tuple[float, float] | None = None
    """Where the plane touches, so that two recordings share one; by default each track's start."""


def read_tracks(source: Source) -> list[Track]:
    """Read the tracks of a recording, in order of first appearance.

    Per track and in this order: rows without time or position are dropped; the rest is sorted
    by time; rows below `minimum_altitude_m` are dropped, then duplicate times (the first is
    kept), then held positions: a transponder without a new fix repeats its last one exactly.

    Times are ISO 8601 text (UTC where no zone is given), datetimes, or numbers: since 1970 in
    s, ms, us or ns where they are as large as that, plain seconds otherwise. Latitude and
    longitude (degrees, WGS84) go to the plane that touches the ellipsoid at the track's first
    kept position. All heights are taken as 0, so a distance d from there appears short by about
    d^3 / (6 R^2): 4 m at 100 km, 33 m at 200 km.

    Raises:
        UserError: no such file or package, a file that can't be read, a missing or empty
            column, a latitude or longitude out of range, or a track with fewer than
            `MINIMUM_SAMPLES` usable samples.
    """
    table = _read_table(source)
    names = _track_names(table, source)
    elapsed_s, start = _elapsed_seconds(table, _column(table, source, "time"), source)
    first, second, geographic = _position_columns(table, source)
    samples = pd.DataFrame(
        {
            "time_s": elapsed_s,
            "first": _numbers(table, first, source),
            "second": _numbers(table, second, source),
            "altitude_m": _altitude(table, source),
        }
    )
    if geographic:
        _check_range(samples["first"], first, -90.0, 90.0, source)
        _check_range(samples["second"], second, -180.0, 360.0, source)
    return [
        _track(str(name), rows, start, geographic, source)
        for name, rows in samples.groupby(names, sort=False)
    ]


def thin(time_s: FloatArray, every_s: float) -> NDArray[np.intp]:
    """Indices (k,) that thin increasing times (n,) to at least `every_s` apart.

    The recording's own uneven times stay: the first, then greedily each first one at least
    `every_s` after the last kept.

    Raises:
        UserError: `every_s` isn't positive.
    """
    if not every_s > 0.0:
        raise UserError(f"a recording can't be thinned to {every_s} s: give a positive interval")
    kept = []
    index = 0
    while index < len(time_s):
        kept.append(index)
        earliest = time_s[index] + every_s - _TIME_TOLERANCE_S
        # At least one further: `every_s` itself may be below the tolerance.
        index = max(index + 1, int(np.searchsorted(time_s, earliest)))
    return np.array(kept, dtype=np.intp)


def smooth(
    track: Track, at_time_s: FloatArray, half_window_s: float = 8.0
) -> tuple[FloatArray, FloatArray]:
    """Position (k, 2) in m and velocity (k, 2) in m/s of a track at times (k,).

    A cubic is fitted by least squares, equal weights, to the samples within `half_window_s` of
    each time; its value and slope there are the answer (local polynomial regression: Fan and
    Gijbels 1996, section 3.1; on even times Savitzky and Golay 1964).

    Where the window holds fewer than `MINIMUM_WINDOW_SAMPLES`, or none on one side of the time,
    both are NaN: in gaps and beyond the ends nothing is extrapolated. At the very ends the
    window is one-sided and the slope several times less certain.

    Raises:
        UserError: `half_window_s` isn't positive.
    """
    if not half_window_s > 0.0:
        raise UserError(f"half a window of {half_window_s} s holds no samples: give a positive one")
    time_s, reach_s = track.time_s, half_window_s + _TIME_TOLERANCE_S
    at_time_s = np.asarray(at_time_s, dtype=np.float64)
    starts = np.searchsorted(time_s, at_time_s - reach_s)
    stops = np.searchsorted(time_s, at_time_s + reach_s, side="right")
    position = np.full((len(at_time_s), 2), np.nan)
    velocity = np.full((len(at_time_s), 2), np.nan)
    for k in np.flatnonzero(stops - starts >= MINIMUM_WINDOW_SAMPLES):
        window = slice(starts[k], stops[k])
        # Centred and scaled to -1 .. 1, the powers stay of one size whatever the times.
        offset = (time_s[window] - at_time_s[k]) / half_window_s
        if offset[0] <= 0.0 <= offset[-1]:
            powers = np.vander(offset, 4, increasing=True)
            coefficients = np.linalg.lstsq(powers, track.position_m[window], rcond=None)[0]
            position[k] = coefficients[0]
            velocity[k] = coefficients[1] / half_window_s
    return position, velocity


def _locate(source: Source) -> Path:
    if source.package is None:
        path = source.folder / source.file
        remedy = "give its path from the scenario's folder"
    else:
        folder, install = _package_folder(source.package)
        path = folder / source.file
        remedy = f"correct the file's name, or install the package with: {install}"
    if not path.is_file():
        raise UserError(f"there is no recording {path}: {remedy}")
    return path


def _package_folder(requirement: str) -> tuple[Path, str]:
    """The folder of an installed package, found without importing it, and how to install it."""
    parts = re.fullmatch(r"([A-Za-z0-9_-]+)(?:==([\w.!+-]+))?", requirement)
    if parts is None:
        raise UserError(f"package {requirement!r} isn't a name or name==version: traffic==2.13")
    name, version = parts[1], parts[2]
    install = f"pip install --no-deps {requirement}"
    module = importlib.util.find_spec(name.replace("-", "_"))
    if module is None or module.origin is None:
        raise UserError(f"the recording lies in the package {name}, not installed here: {install}")
    try:
        installed = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        installed = "of unknown version"
    if version is not None and installed != version:
        raise UserError(f"the recording wants {requirement}, installed is {installed}: {install}")
    return Path(module.origin).parent, install


def _read_table(source: Source) -> pd.DataFrame:
    path = _locate(source)
    readers = {
        (".csv", ".csv.gz"): _read_csv,
        (".json", ".json.gz"): _read_json,
        (".parquet",): _read_parquet,
    }
    reader = next((readers[ends] for ends in readers if path.name.lower().endswith(ends)), None)
    if reader is None:
        raise UserError(
            f"{source.file!r} is no recording by its ending: "
            "use .csv, .csv.gz, .json, .json.gz or .parquet"
        )
    try:
        table = reader(path)
    except (OSError, EOFError, zlib.error, ValueError, TypeError, pd.errors.ParserWarning) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"{source.file!r} can't be read ({reason}): mend or replace it") from error
    table.columns = pd.Index([str(column).strip() for column in table.columns])
    return table


def _read_csv(path: Path) -> pd.DataFrame:
    with warnings.catch_warnings():
        # Rows longer than the heading are damage: pandas would drop the surplus.
        warnings.simplefilter("error", pd.errors.ParserWarning)
        # As text: a transponder's address such as 4840e6 is no number.
        return pd.read_csv(path, dtype=str, index_col=False)


def _read_json(path: Path) -> pd.DataFrame:
    content = path.read_bytes()
    if path.suffix.lower() == ".gz":
        content = gzip.decompress(content)
    return pd.DataFrame(json.loads(content))


def _read_parquet(path: Path) -> pd.DataFrame:
    table = pd.read_parquet(path)
    return table if table.index.names == [None] else table.reset_index()


def _find(table: pd.DataFrame, name: str) -> str | None:
    return next((column for column in table.columns if column.lower() == name), None)


def _columns_there(table: pd.DataFrame) -> str:
    return ", ".join(table.columns) or "none"


def _column(table: pd.DataFrame, source: Source, quantity: str) -> str:
    """The column of a quantity: the one that the source names, or one of the usual names."""
    named: str | None = getattr(source, quantity)
    if named is not None:
        if named in table.columns:
            return named
        wanted = repr(named)
    else:
        usual = _USUAL_NAMES[quantity]
        found = next((column for name in usual if (column := _find(table, name))), None)
        if found is not None:
            return found
        wanted = "/".join(usual)
    raise UserError(
        f"{source.file!r} has no {quantity} column {wanted}, only {_columns_there(table)}: "
        f"name one of these under `{quantity}`"
    )


def _position_columns(table: pd.DataFrame, source: Source) -> tuple[str, str, bool]:
    """Both columns of the position, and whether they are latitude and longitude."""
    planar = source.x is not None or source.y is not None
    geographic = source.latitude is not None or source.longitude is not None
    if not planar and not geographic:
        usual = (_USUAL_NAMES["latitude"], _USUAL_NAMES["longitude"])
        geographic = all(any(_find(table, name) for name in names) for names in usual)
        planar = any(_find(table, name) for name in _USUAL_NAMES["x"])
    if geographic:
        return _column(table, source, "latitude"), _column(table, source, "longitude"), True
    if planar:
        return _column(table, source, "x"), _column(table, source, "y"), False
    raise UserError(
        f"{source.file!r} has neither latitude and longitude nor x and y, only "
        f"{_columns_there(table)}: name the position's columns"
    )


def _track_names(table: pd.DataFrame, source: Source) -> pd.Series[str]:
    """Every row's track; the file's name where no column tells."""
    if source.track is not None:
        columns = [_column(table, source, "track")]
    else:
        usual = ([_find(table, name) for name in names] for names in _USUAL_IDS)
        columns = next(([c for c in found if c] for found in usual if all(found)), [])
    names = pd.Series("", index=table.index, dtype=str)
    for column in columns:
        part = table[column].astype(object)
        names = names + " " + part.where(part.notna(), "").map(str)
    return names.str.strip().replace("", Path(source.file).name.split(".")[0])


def _no_values(table: pd.DataFrame, column: str, source: Source, wanted: str) -> UserError:
    present = table[column].dropna()
    seen = f"its first is {str(present.iloc[0])!r}" if len(present) else "it is empty"
    return UserError(f"column {column!r} of {source.file!r} has no value that is {wanted}: {seen}")


def _finite(values: pd.Series) -> pd.Series[float]:
    numbers = pd.to_numeric(values, errors="coerce").astype(np.float64)
    return numbers.where(np.isfinite(numbers))


def _numbers(table: pd.DataFrame, column: str, source: Source) -> pd.Series[float]:
    numbers = _finite(table[column])
    if numbers.notna().any():
        return numbers
    raise _no_values(table, column, source, "a number")


def _altitude(table: pd.DataFrame, source: Source) -> pd.Series[float] | float:
    """Altitude in m; NaN where no one asks for it."""
    if source.minimum_altitude_m is None:
        return np.nan
    column = _column(table, source, "altitude")
    unit = source.altitude_unit
    if column.lower().endswith("_ft" if unit == "m" else "_m"):
        raise UserError(f"column {column!r} is read in {unit!r}: set `altitude_unit` as it says")
    return _numbers(table, column, source) * _METRES_PER[unit]


def _elapsed_seconds(
    table: pd.DataFrame, column: str, source: Source
) -> tuple[pd.Series[float], pd.Timestamp | None]:
    """Seconds since the table's earliest time, and that time where it is a date."""
    values = table[column]
    if not pd.api.types.is_datetime64_any_dtype(values):
        numbers = _finite(values)
        if numbers.notna().any():
            typical = numbers.abs().median()
            unit = next((unit for limit, unit in _EPOCH_UNITS if typical >= limit), None)
            if unit is None:
                return numbers - numbers.min(), None
            values = pd.to_datetime(numbers, unit=unit, utc=True, errors="coerce")
    # Rounded: as a float, a time since 1970 is up to 0.2 us off, enough to make 4 s less than 4 s.
    dates = pd.to_datetime(values, utc=True, format="ISO8601", errors="coerce").dt.round("us")
    if not dates.notna().any():
        raise _no_values(table, column, source, "seconds or an ISO 8601 time")
    earliest = dates.min()
    return (dates - earliest).dt.total_seconds(), earliest


def _check_range(
    degrees: pd.Series[float], column: str, low: float, high: float, source: Source
) -> None:
    outside = degrees[(degrees < low) | (degrees > high)]
    if len(outside):
        raise UserError(
            f"{outside.iloc[0]:g} in column {column!r} of {source.file!r} isn't within "
            f"{low:g} to {high:g} degrees: mend it, or name metres under `x` and `y`"
        )


def _usable(samples: pd.DataFrame, minimum_altitude_m: float | None) -> pd.DataFrame:
    rows = samples.dropna(subset=["time_s", "first", "second"])
    rows = rows.sort_values("time_s", kind="stable")
    if minimum_altitude_m is not None:
        rows = rows[rows["altitude_m"] >= minimum_altitude_m]
    rows = rows.drop_duplicates("time_s")
    position = rows[["first", "second"]]
    return rows[~(position == position.shift()).all(axis="columns")]


def _track(
    name: str, samples: pd.DataFrame, start: pd.Timestamp | None, geographic: bool, source: Source
) -> Track:
    rows = _usable(samples, source.minimum_altitude_m)
    if len(rows) < MINIMUM_SAMPLES:
        raise UserError(
            f"track {name!r} of {source.file!r} has {len(rows)} usable samples out of "
            f"{len(samples)}, fewer than {MINIMUM_SAMPLES}: take it out of the file, or change "
            "`minimum_altitude_m` or the column under `track`"
        )
    time_s = rows["time_s"].to_numpy(np.float64)
    position = rows[["first", "second"]].to_numpy(np.float64)
    origin = None
    if geographic:
        origin = source.origin_deg or (float(position[0, 0]), float(position[0, 1]))
        position = _local_plane(position, origin)
    return Track(
        name=name,
        time_s=time_s - time_s[0],
        position_m=position,
        epoch="" if start is None else _iso(start, time_s[0]),
        origin_deg=origin,
    )


def _iso(start: pd.Timestamp, elapsed_s: float) -> str:
    return (start + pd.Timedelta(seconds=elapsed_s)).round("us").isoformat()


def _local_plane(position_deg: FloatArray, origin_deg: tuple[float, float]) -> FloatArray:
    """East and north (n, 2) in m of latitude and longitude (n, 2) in degrees."""
    try:
        from pymap3d import geodetic2enu
    except ImportError as error:
        raise UserError(
            "latitude and longitude need pymap3d, which is not installed: "
            'pip install "hybridtrack[recordings]"'
        ) from error
    latitude, longitude = position_deg.T
    east, north, _ = geodetic2enu(latitude, longitude, 0.0, *origin_deg, 0.0)
    return np.column_stack([east, north])
