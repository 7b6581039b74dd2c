"""Cases from a recording: one per track, at the recording's own times."""

from datetime import datetime
from pathlib import Path

import numpy as np

from hybridtrack import recordings
from hybridtrack.config.schema import FileForm, RecordingForm
from hybridtrack.errors import UserError
from hybridtrack.models import Array
from hybridtrack.recordings import Source, Track
from hybridtrack.simulation import Case, FixedTruth

STATES = ("x", "vx", "y", "vy")
FEWEST_SCANS = 5


def cases(form: RecordingForm, folder: Path) -> tuple[Case, ...]:
    """The recording's tracks as cases.

    Taken as the truth, a track is smoothed at its (thinned) times; scans where no truth can be
    had, in gaps, are left out. Taken as measurements, the recorded positions are the scans, and
    the truth is the smoothed `reference`, unknown (NaN) where there is none.
    """
    tracks = recordings.read_tracks(_source(form, folder))
    references: dict[str, Track] = {}
    if form.reference is not None:
        if form.as_ == "truth":
            raise UserError("a 'reference' goes with 'as: measurements'; remove one of the two")
        origin = tracks[0].origin_deg
        found = recordings.read_tracks(_source(form.reference, folder)._replace(origin_deg=origin))
        references = {track.name: track for track in found}
        if len(tracks) == 1 and len(found) == 1:
            references = {tracks[0].name: found[0]}
    built = []
    for track in tracks:
        times_s = track.time_s
        if form.thin_to_s is not None:
            times_s = times_s[recordings.thin(times_s, form.thin_to_s)]
        if form.as_ == "truth":
            state = _smoothed(track, times_s, form.smooth_half_window_s)
            known = np.isfinite(state).all(axis=1)
            times_s, state, recorded = times_s[known], state[known], None
        else:
            recorded = track.position_m[np.searchsorted(track.time_s, times_s)]
            state = np.full((len(times_s), 4), np.nan)
            reference = references.get(track.name)
            if reference is not None:
                assert form.reference is not None
                offset = _offset_s(track, reference)
                window = form.reference.smooth_half_window_s
                state = _smoothed(reference, times_s + offset, window)
        if len(times_s) < FEWEST_SCANS:
            raise UserError(
                f"track '{track.name}' leaves {len(times_s)} scans; at least {FEWEST_SCANS} are "
                "needed (see thin_to_s and minimum_altitude_m)"
            )
        mode = np.full(len(times_s), -1, dtype=np.int64)
        built.append(Case(track.name, times_s, FixedTruth(state, mode, STATES), recorded))
    return tuple(built)


def _source(form: FileForm, folder: Path) -> Source:
    return Source(
        file=form.file,
        package=form.package,
        **dict(form.columns),
        minimum_altitude_m=form.minimum_altitude_m,
        altitude_unit=form.altitude_unit,
        folder=folder,
    )


def _smoothed(track: Track, times_s: Array, half_window_s: float) -> Array:
    position, velocity = recordings.smooth(track, times_s, half_window_s)
    return np.stack([position[:, 0], velocity[:, 0], position[:, 1], velocity[:, 1]], axis=1)


def _offset_s(track: Track, reference: Track) -> float:
    """What to add to the track's times to have the reference's."""
    if not track.epoch or not reference.epoch:
        return 0.0
    ours, theirs = (datetime.fromisoformat(t.epoch) for t in (track, reference))
    return (ours - theirs).total_seconds()
