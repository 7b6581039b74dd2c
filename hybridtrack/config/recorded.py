"""Cases from a recording: one per track, at the recording's own times."""

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
    the truth is the smoothed `reference`, unknown (NaN) where there is none. The reference of a
    track is the one of its name, or the only one where both files hold one track.

    Raises:
        UserError: what `read_tracks` can't read, a reference that doesn't fit, or too few scans.
    """
    tracks = recordings.read_tracks(_source(form, folder))
    references = _references(form, tracks, folder)
    return tuple(_case(form, track, references.get(track.name)) for track in tracks)


def _references(form: RecordingForm, tracks: list[Track], folder: Path) -> dict[str, Track]:
    """Reference by the track's name."""
    if form.reference is None:
        return {}
    if form.as_ == "truth":
        raise UserError("a 'reference' goes with 'as: measurements'; remove one of the two")
    found = recordings.read_tracks(_source(form.reference, folder))
    if len(tracks) == 1 and len(found) == 1:
        return {tracks[0].name: found[0]}
    references = {track.name: track for track in found}
    if not references.keys() & {track.name for track in tracks}:
        raise UserError(
            f"the reference has the track '{found[0].name}' and the recording "
            f"'{tracks[0].name}', none of one name; name the right column under 'track'"
        )
    return references


def _case(form: RecordingForm, track: Track, reference: Track | None) -> Case:
    times_s = track.time_s
    if form.thin_to_s is not None:
        times_s = times_s[recordings.thin(times_s, form.thin_to_s)]
    recorded = None
    if form.as_ == "truth":
        state = _smoothed(track, times_s, form.smooth_half_window_s)
        known = np.isfinite(state).all(axis=1)
        times_s, state = times_s[known], state[known]
    else:
        recorded = track.position_m[np.searchsorted(track.time_s, times_s)]
        state = np.full((len(times_s), len(STATES)), np.nan)
        if reference is not None:
            assert form.reference is not None
            state = _referred(track, times_s, reference, form.reference.smooth_half_window_s)
    if len(times_s) < FEWEST_SCANS:
        raise UserError(
            f"track '{track.name}' leaves {len(times_s)} scans; at least {FEWEST_SCANS} are "
            "needed (see thin_to_s and minimum_altitude_m)"
        )
    mode = np.full(len(times_s), -1, dtype=np.int64)
    return Case(track.name, times_s, FixedTruth(state, mode, STATES), recorded)


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


def _referred(track: Track, times_s: Array, reference: Track, half_window_s: float) -> Array:
    """The reference's states at the track's times, in the track's plane."""
    after_s = recordings.seconds_after(track, reference)
    state = _smoothed(recordings.about(reference, track), times_s + after_s, half_window_s)
    if np.isnan(state).all():
        raise UserError(
            f"the reference of track '{track.name}' tells nothing at its times: on the track's own "
            f"clock it lasts from {-after_s:g} to {reference.time_s[-1] - after_s:g} s; mend the "
            "times of one, or widen 'smooth_half_window_s'"
        )
    return state
