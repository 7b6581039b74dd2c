"""A recording's file as samples: which file, which of its columns, which row in which track.

What comes out is SI for times and heights; positions are as the file has them.
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

from hybridtrack.errors import UserError

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


class Samples(NamedTuple):
    """A recording's rows as they stand, NaN where a value is missing or no number."""

    rows: pd.DataFrame
    """Columns track, time_s, first, second and altitude_m: latitude and longitude in degrees
    where `geographic`, else metres east and north."""
    start: pd.Timestamp | None
    """What `time_s` counts from; None where the file has plain seconds."""
    geographic: bool


def read_samples(source: Source) -> Samples:
    """Read the rows of a recording.

    Raises:
        UserError: no such file or package, a file that can't be read, a missing or empty
            column, or a latitude or longitude out of range.
    """
    table = _read_table(source)
    names = _track_names(table, source)
    elapsed_s, start = _elapsed_seconds(table, _column(table, source, "time"), source)
    first, second, geographic = _position_columns(table, source)
    rows = pd.DataFrame(
        {
            "track": names,
            "time_s": elapsed_s,
            "first": _numbers(table, first, source),
            "second": _numbers(table, second, source),
            "altitude_m": _altitude(table, source),
        }
    )
    if geographic:
        _check_range(rows["first"], first, -90.0, 90.0, source)
        _check_range(rows["second"], second, -180.0, 360.0, source)
    return Samples(rows, start, geographic)


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
    """Seconds since the table's earliest date, and that; plain seconds as they stand."""
    values = table[column]
    if not pd.api.types.is_datetime64_any_dtype(values):
        numbers = _finite(values)
        if numbers.notna().any():
            typical = numbers.abs().median()
            unit = next((unit for limit, unit in _EPOCH_UNITS if typical >= limit), None)
            if unit is None:
                return numbers, None
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
