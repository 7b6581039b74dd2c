"""Truth and sensor: the clock, legs flown, chains simulated, recordings read."""

import re
from pathlib import Path

import numpy as np

from hybridtrack.chains import Bound
from hybridtrack.config import banks, checks, starts
from hybridtrack.config.reader import Document, Keys
from hybridtrack.config.schema import ClockForm, FileForm, RecordingForm, ScenarioForm, TruthForm
from hybridtrack.config.validate import as_written
from hybridtrack.errors import UserError
from hybridtrack.jumps import ChainTruth
from hybridtrack.models import Array, ModeBank
from hybridtrack.sensors import Outliers, Sensor
from hybridtrack.simulation import Case, FixedTruth, Leg, fly

MAX_STEPS = 10_000_000


def cases(
    form: ScenarioForm, bank: ModeBank, document: Document, folder: Path
) -> tuple[tuple[str, ...], tuple[Case, ...]]:
    truth = form.truth
    kinds = [k for k in ("legs", "chain", "recording") if getattr(truth, k) is not None]
    if len(kinds) != 1:
        said = f"both '{kinds[0]}' and '{kinds[1]}'" if kinds else "none of legs, chain, recording"
        raise document.error(("truth",), f"'truth' has {said}; give one of them")
    if truth.start is not None and truth.legs is None:
        raise document.error(("truth", "start"), "'start' belongs to 'legs', which aren't given")
    if truth.recording is not None:
        from hybridtrack.config import recorded  # pandas, which nothing else needs

        if form.clock is not None:
            raise document.error(
                ("clock",), "a recording has times of its own; remove 'clock' (see thin_to_s)"
            )
        if form.dimensions != 2:
            raise document.error(
                ("dimensions",), "'dimensions' is 1 and a recording has 2; remove it"
            )
        try:
            return (), recorded.cases(truth.recording, folder)
        except UserError as error:
            place = _recording_place(truth.recording, str(error), document)
            raise document.error(place, str(error)) from None
    if form.clock is None:
        raise document.error((), "'clock' is missing; add it")
    times_s = times_of(form.clock, document)
    if truth.legs is not None:
        fixed = _legs(form, truth, times_s, bank.names, document)
        return bank.names, (Case(form.name, times_s, fixed),)
    assert truth.chain is not None
    path: Keys = ("truth", "chain")
    for name, mode in (truth.chain.modes or {}).items():
        for key in ("position_std_m", "measurement_noise_covariance", "measurement_matrix"):
            if getattr(mode, key, None) is not None:
                raise document.error(
                    (*path, "modes", name, key),
                    f"'{key}' has no place in the truth's modes, since the sensor measures; remove "
                    "it (see 'sensor')",
                )
    truth_bank = banks.bank(truth.chain, form, document, path)
    banks.try_out(truth_bank, [np.diff(times_s)], document, path)
    start = starts.initial(truth.chain.initial, truth_bank, document, (*path, "initial"))
    if start.two_point or start.follows_truth:
        raise document.error(
            (*path, "initial"), "the truth's own start needs a 'mean' of numbers, one per state"
        )
    unknown = set("xy"[: form.dimensions]) - set(truth_bank.state_names)
    if unknown:
        raise document.error(
            path,
            f"the truth has no state '{min(unknown)}' that could be measured; name its positions "
            "x (and y) in 'states'",
        )
    if (
        truth.chain.continuation_probability is not None
        and truth.chain.most_transitions is not None
    ):
        raise document.error(
            (*path, "most_transitions"),
            "'most_transitions' bounds a chain hard and 'continuation_probability' softly; remove "
            "one of them",
        )
    bound = Bound(
        continuation_probability=truth.chain.continuation_probability,
        most_transitions=truth.chain.most_transitions,
    )
    chain = ChainTruth(truth_bank, start.mean, start.covariance, bound)
    return truth_bank.names, (Case(form.name, times_s, chain),)


def _recording_place(recording: RecordingForm, sentence: str, document: Document) -> Keys:
    """The key that a complaint about a recording names, or whose value it is about."""
    path: Keys = ("truth", "recording")
    holder: FileForm = recording
    other = None if _is_about(recording, sentence) else recording.reference
    if other is not None and ("reference" in sentence or _is_about(other, sentence)):
        path, holder = (*path, "reference"), other
    keys = [key.strip("`") for key in re.findall(r"`\w+`|[a-z]+_[a-z_]+", sentence)]
    keys += ["file"] if Path(holder.file).name in sentence else []
    keys += ["package"] if holder.package and holder.package in sentence else []
    for key in keys:
        for location in ((*path, key), (*path, "columns", key)):
            written = as_written(document, location)
            if len(written) == len(location):
                return written
    return path


def _is_about(form: FileForm, sentence: str) -> bool:
    return Path(form.file).name in sentence or bool(form.package and form.package in sentence)


def times_of(clock: ClockForm, document: Document) -> Array:
    """Times (n_steps + 1,) from k = 0."""
    if clock.times_s is not None:
        if clock.step_s is not None or clock.duration_s is not None:
            raise document.error(
                ("clock", "times_s"),
                "'times_s' lists every time already; remove 'step_s' and 'duration_s'",
            )
        times_s = np.array(clock.times_s, dtype=float)
        late = np.flatnonzero(np.diff(times_s) <= 0)
        if late.size:
            raise document.error(
                ("clock", "times_s", int(late[0]) + 1),
                f"'times_s' must increase, and {times_s[late[0] + 1]:g} follows "
                f"{times_s[late[0]]:g}",
            )
        return times_s
    if clock.step_s is None or clock.duration_s is None:
        raise document.error(
            ("clock",), "'clock' needs 'step_s' and 'duration_s', or 'times_s' with every time"
        )
    steps = round(clock.duration_s / clock.step_s)
    if steps < 1 or abs(steps * clock.step_s - clock.duration_s) > 1e-6 * clock.step_s:
        raise document.error(
            ("clock", "duration_s"),
            f"'duration_s' is {clock.duration_s:g} s, no whole number of steps of "
            f"{clock.step_s:g} s; the nearest is {max(steps, 1) * clock.step_s:g} s",
        )
    if steps > MAX_STEPS:
        raise document.error(
            ("clock", "duration_s"),
            f"'duration_s' makes {steps:,} steps of 'step_s', and at most {MAX_STEPS:,} are "
            "possible; shorten it",
        )
    return np.arange(steps + 1, dtype=np.float64) * clock.step_s


def _legs(
    form: ScenarioForm,
    truth: TruthForm,
    times_s: Array,
    modes: tuple[str, ...],
    document: Document,
) -> FixedTruth:
    assert truth.legs is not None
    if truth.start is None:
        raise document.error(
            ("truth",), "'start' is missing in 'truth'; add it: the legs begin there"
        )
    if form.dimensions != 2:
        raise document.error(("dimensions",), "'dimensions' is 1 and legs need 2; remove it")
    legs: list[Leg] = []
    end = float(times_s[0])
    for i, leg in enumerate(truth.legs):
        path: Keys = ("truth", "legs", i)
        begin = end if leg.from_s is None else leg.from_s
        if begin != end:
            said = "overlaps the one before" if begin < end else "leaves a gap to the one before"
            raise document.error(
                (*path, "from_s"),
                f"the leg {said}, which ends at {end:g} s: 'from_s' is {begin:g} s; leave it out",
            )
        if leg.until_s <= end:
            raise document.error(
                (*path, "until_s"),
                f"'until_s' is {leg.until_s:g} s and the leg begins at {end:g} s; let it end later",
            )
        mode = modes[0] if leg.mode is None else leg.mode
        checks.known_mode(mode, modes, document, (*path, "mode"), tuple(form.modes))
        speed = truth.start.speed_m_s if i == 0 and leg.speed_m_s is None else leg.speed_m_s
        east, north = leg.acceleration_m_s2 or (0.0, 0.0)
        acceleration = (east, north)
        if leg.turn_rate_rad_s and any(acceleration):
            raise document.error(
                as_written(document, (*path, "acceleration_m_s2")),
                "a leg is a turn or has an acceleration, and this has both; remove one of them",
            )
        number = modes.index(mode)
        legs.append(Leg(leg.until_s, leg.turn_rate_rad_s, speed, number, acceleration))
        end = leg.until_s
    if times_s[-1] - end > 1e-6 * np.diff(times_s).min():
        raise document.error(
            ("truth", "legs", len(legs) - 1, "until_s"),
            f"'until_s' of the last leg is {end:g} s and the clock ends at {times_s[-1]:g} s; fly "
            "on until then",
        )
    x, y = truth.start.position_m
    return fly(tuple(legs), times_s, (x, y), truth.start.heading_rad)


def sensor(
    form: ScenarioForm,
    truth_modes: tuple[str, ...],
    cases: tuple[Case, ...],
    two_point: bool,
    document: Document,
) -> Sensor:
    std = form.sensor.position_std_m
    path: Keys = ("sensor", "position_std_m")
    if isinstance(std, dict):
        if not truth_modes:
            raise document.error(path, "a recording has no modes; give one 'position_std_m'")
        values = [
            checks.noise_covariance(v, form.dimensions, document, path)
            for v in checks.by_mode(std, truth_modes, document, path)
        ]
    else:
        values = [checks.noise_covariance(std, form.dimensions, document, path)]
    given, outliers = form.sensor.outliers, None
    if given is not None:
        begin, end = span(given.from_s, given.until_s, document, ("sensor", "outliers"))
        outliers = Outliers(given.probability, given.size_sigma, begin, end)
    certain = 2 if two_point else 0
    sensor = Sensor(np.stack(values), form.sensor.detection_probability, certain, outliers)
    _check_outliers(sensor, cases, document)
    return sensor


def _check_outliers(sensor: Sensor, cases: tuple[Case, ...], document: Document) -> None:
    """Some scan lies in the span of outliers, besides those that a start is made from."""
    outliers = sensor.outliers
    if outliers is None or any(sensor.may_be_outliers(case.times_s).any() for case in cases):
        return
    scans = np.concatenate([case.times_s[1 + sensor.certain_scans :] for case in cases])
    outside = np.maximum(outliers.from_s - scans, scans - outliers.until_s)
    raise document.error(
        ("sensor", "outliers"),
        "the span of 'outliers' holds no scan that could be one; move it (the nearest is at "
        f"{scans[np.argmin(outside)]:.10g} s)",
    )


def span(
    from_s: float | None, until_s: float | None, document: Document, path: Keys
) -> tuple[float, float]:
    """A span of time, open where an end isn't given; `path` leads to what has the two."""
    begin = -np.inf if from_s is None else from_s
    end = np.inf if until_s is None else until_s
    if begin > end:
        raise document.error(
            as_written(document, (*path, "from_s")),
            f"'from_s' is {begin:g} s, after 'until_s' ({end:g} s); swap them",
        )
    return begin, end
