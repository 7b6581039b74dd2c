"""Recorded flights: from a file to tracks in a local plane, thinned and smoothed.

A recording is a table with one row per report: CSV, JSON or Parquet. What comes out is SI:
seconds since a track's first sample, metres east and north.
"""

from hybridtrack.recordings.samples import Source
from hybridtrack.recordings.tracks import (
    MINIMUM_SAMPLES,
    MINIMUM_WINDOW_SAMPLES,
    Track,
    about,
    read_tracks,
    seconds_after,
    smooth,
    thin,
)

__all__ = [
    "MINIMUM_SAMPLES",
    "MINIMUM_WINDOW_SAMPLES",
    "Source",
    "Track",
    "about",
    "read_tracks",
    "seconds_after",
    "smooth",
    "thin",
]
