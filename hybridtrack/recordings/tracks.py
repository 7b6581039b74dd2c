"""Tracks in a local plane: made of a recording's samples, thinned and smoothed."""

from __future__ import annotations

from datetime import datetime
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hybridtrack.errors import UserError
from hybridtrack.recordings.samples import Samples, Source, read_samples

FloatArray = NDArray[np.float64]

MINIMUM_SAMPLES = 10
"""A track with fewer usable samples is an error."""

MINIMUM_WINDOW_SAMPLES = 6
"""`smooth` answers NaN where its window holds fewer: a cubic has four coefficients."""

_TIME_TOLERANCE_S = 1e-9


class Track(NamedTuple):
    """One recorded track in a local tangent plane."""

    name: str
    time_s: FloatArray
    """(n,) seconds since the first sample, increasing; the first is 0. Gaps are kept."""
    position_m: FloatArray
    """(n, 2) east and north, metres."""
    epoch: str
    """ISO 8601 time (UTC) of the first sample; empty where the file has plain seconds."""
    start_s: float = 0.0
    """The first sample's time as a file of plain seconds counts it; 0 where `epoch` says it."""
    position_deg: FloatArray | None = None
    """(n, 2) latitude and longitude; None where the file has x and y."""


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
    samples = read_samples(source)
    return [
        _track(str(name), rows, samples, source)
        for name, rows in samples.rows.groupby("track", sort=False)
    ]


def about(track: Track, other: Track) -> Track:
    """A track in the plane of another: the one that touches at the other's first position.

    Raises:
        UserError: one has latitude and longitude, the other x and y.
    """
    if (track.position_deg is None) != (other.position_deg is None):
        raise UserError(
            f"of the tracks {other.name!r} and {track.name!r} one has latitude and longitude and "
            "the other x and y: give both the same"
        )
    if track.position_deg is None or other.position_deg is None:
        return track
    return track._replace(position_m=_local_plane(track.position_deg, other.position_deg[0]))


def seconds_after(track: Track, other: Track) -> float:
    """How much later a track begins than another, in s; negative where it begins earlier.

    Raises:
        UserError: one has dates, the other plain seconds.
    """
    if bool(track.epoch) != bool(other.epoch):
        raise UserError(
            f"of the tracks {track.name!r} and {other.name!r} one has dates and the other plain "
            "seconds, so nobody knows how they lie in time: give both the same"
        )
    if not track.epoch:
        return track.start_s - other.start_s
    begin, begin_other = (datetime.fromisoformat(each.epoch) for each in (track, other))
    return (begin - begin_other).total_seconds()


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


def _usable(samples: pd.DataFrame, minimum_altitude_m: float | None) -> pd.DataFrame:
    rows = samples.dropna(subset=["time_s", "first", "second"])
    rows = rows.sort_values("time_s", kind="stable")
    if minimum_altitude_m is not None:
        rows = rows[rows["altitude_m"] >= minimum_altitude_m]
    rows = rows.drop_duplicates("time_s")
    position = rows[["first", "second"]]
    return rows[~(position == position.shift()).all(axis="columns")]


def _track(name: str, rows: pd.DataFrame, samples: Samples, source: Source) -> Track:
    usable = _usable(rows, source.minimum_altitude_m)
    if len(usable) < MINIMUM_SAMPLES:
        raise UserError(
            f"track {name!r} of {source.file!r} has {len(usable)} usable samples out of "
            f"{len(rows)}, fewer than {MINIMUM_SAMPLES}: take it out of the file, or change "
            "`minimum_altitude_m` or the column under `track`"
        )
    time_s = usable["time_s"].to_numpy(np.float64)
    position = usable[["first", "second"]].to_numpy(np.float64)
    return Track(
        name=name,
        time_s=time_s - time_s[0],
        position_m=_local_plane(position, position[0]) if samples.geographic else position,
        epoch="" if samples.start is None else _iso(samples.start, time_s[0]),
        start_s=float(time_s[0]) if samples.start is None else 0.0,
        position_deg=position if samples.geographic else None,
    )


def _iso(start: pd.Timestamp, elapsed_s: float) -> str:
    return (start + pd.Timedelta(seconds=elapsed_s)).round("us").isoformat()


def _local_plane(position_deg: FloatArray, origin_deg: FloatArray) -> FloatArray:
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
