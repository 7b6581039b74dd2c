"""From a valid form to the Experiment that runs: checks across keys, and everything in arrays."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hybridtrack.config import checks, recorded
from hybridtrack.config.reader import Document, Keys
from hybridtrack.config.schema import (
    ChainForm,
    ClaimForm,
    Form,
    InitialForm,
    MatricesForm,
    ScenarioForm,
    TruthForm,
    WindowForm,
)
from hybridtrack.errors import UserError
from hybridtrack.estimators import BankEstimator, estimators
from hybridtrack.models import Array, Mode, ModeBank, generator_from_sojourns
from hybridtrack.motion import MOTION_MODELS, Motion, state_names
from hybridtrack.simulation import Case, ChainTruth, FixedTruth, Leg, Sensor, fly
from hybridtrack.verdicts import Claim, printed_tolerance

MAX_STEPS = 10_000_000


class Initial(NamedTuple):
    """How the filters start."""

    two_point: bool  # from the first two scans; what follows is unused then
    follows_truth: bool  # the mean is the run's true start, plus a draw if `drawn`
    drawn: bool
    mean: Array  # (n_x,)
    covariance: Array  # (n_x, n_x)


class Window(NamedTuple):
    """Steps scored by themselves; every condition that isn't None must hold."""

    name: str
    from_s: float = -np.inf
    until_s: float = np.inf
    mode: int | None = None  # the truth's
    after_switch_s: float | None = None
    within_switch_s: float | None = None
    skip_scans: int = 0


class ChosenEstimator(NamedTuple):
    """An estimator of the scenario: its label there, and how it is set."""

    label: str
    estimator: BankEstimator
    settings: Any


class Experiment(NamedTuple):
    """What a scenario asks for, in SI and arrays; nothing of YAML is left in it."""

    name: str
    title: str
    source: str
    assumptions: tuple[str, ...]
    cases: tuple[Case, ...]
    truth_modes: tuple[str, ...]
    bank: ModeBank
    sensor: Sensor
    initial: Initial
    estimators: tuple[ChosenEstimator, ...]
    compare_with: str | None
    windows: tuple[Window, ...]
    runs: int
    seed: int
    keep_tracks: int
    claims: tuple[Claim, ...]
    resolved: dict[str, Any]  # the scenario as it can be run again


def build(form: ScenarioForm, document: Document, folder: Path) -> Experiment:
    """The experiment of a form. Raises ScenarioError about what doesn't fit together."""
    bank = _bank(form, form, document, ())
    truth_modes, cases = _cases(form, bank, document, folder)
    steps = [np.diff(case.times_s) for case in cases]
    if bank.transition_matrix is not None and any(np.ptp(s) > 1e-9 * s.mean() for s in steps):
        shortest, longest = min(s.min() for s in steps), max(s.max() for s in steps)
        raise document.error(
            ("transition_matrix",),
            f"'transition_matrix' holds for steps of one length and these last {shortest:g} to "
            f"{longest:g} s; give 'mean_sojourn_s' or 'generator_per_s' instead",
        )
    _try_bank(bank, float(steps[0][0]), document)
    initial = _initial(form.initial, bank, document, ("initial",))
    if initial.two_point and any(len(s) < 3 for s in steps):
        raise document.error(
            ("initial", "from_measurements"), "a start from two scans needs three steps or more"
        )
    chosen = tuple(_estimator(label, form, bank, document) for label in form.estimators)
    if form.compare_with is not None and form.compare_with not in form.estimators:
        raise document.error(
            ("compare_with",),
            f"'compare_with' is {form.compare_with}, which is no estimator here; "
            f"there are {', '.join(form.estimators)}",
        )
    windows = [Window("all", skip_scans=form.scoring.skip_scans)]
    for name, window in form.windows.items():
        windows.append(_window(name, window, form, truth_modes, document))
    claims = tuple(_claim(i, form, document) for i in range(len(form.published)))
    return Experiment(
        name=form.name,
        title=form.title or form.name,
        source=form.source,
        assumptions=tuple(form.assumptions),
        cases=cases,
        truth_modes=truth_modes,
        bank=bank,
        sensor=_sensor(form, truth_modes, initial.two_point, document),
        initial=initial,
        estimators=chosen,
        compare_with=form.compare_with,
        windows=tuple(windows),
        runs=form.monte_carlo.runs,
        seed=form.monte_carlo.seed,
        keep_tracks=min(form.monte_carlo.keep_tracks, form.monte_carlo.runs),
        claims=claims,
        resolved=_resolved(form, claims, folder),
    )


# ---- the bank --------------------------------------------------------------------------------


def _bank(
    chain: ScenarioForm | ChainForm, form: ScenarioForm, document: Document, path: Keys
) -> ModeBank:
    """The bank of the scenario, or of a chain's truth with modes or a matrix of its own."""
    modes = chain.modes if chain.modes is not None else form.modes
    modes_path: Keys = (*path, "modes") if chain.modes is not None else ("modes",)
    names = _state_names(form, modes, document, modes_path)
    noise = _noise_by_mode(form, tuple(modes), document)
    built = tuple(
        _mode(name, modes[name], names, form.dimensions, noise[name], document, (*modes_path, name))
        for name in modes
    )
    given = [
        key
        for key in ("transition_matrix", "mean_sojourn_s", "generator_per_s")
        if getattr(chain, key) is not None
    ]
    source = chain
    if not given and path:  # a chain's truth follows the scenario's matrix by default
        return _bank(form, form, document, ())._replace(
            initial_mode_probabilities=_mode_probabilities(
                chain.initial, tuple(modes), document, (*path, "initial")
            )
        )
    if len(given) > 1:
        raise document.error(
            (*path, given[1]), f"'{given[1]}' and '{given[0]}' say the same; keep one of them"
        )
    matrix, generator = None, None
    if not given:
        if len(built) > 1:
            raise document.error(
                path, "'transition_matrix' (or mean_sojourn_s, generator_per_s) is missing; add it"
            )
        matrix = np.ones((1, 1))
    elif source.transition_matrix is not None:
        matrix = checks.transition_matrix(
            source.transition_matrix, tuple(modes), document, (*path, "transition_matrix")
        )
    elif source.mean_sojourn_s is not None:
        sojourns = checks.by_mode(
            source.mean_sojourn_s, tuple(modes), document, (*path, "mean_sojourn_s")
        )
        generator = generator_from_sojourns(np.array(sojourns))
    else:
        assert source.generator_per_s is not None
        generator = checks.generator(
            source.generator_per_s, tuple(modes), document, (*path, "generator_per_s")
        )
    return ModeBank(
        modes=built,
        state_names=names,
        dimensions=form.dimensions,
        transition_matrix=matrix,
        generator_per_s=generator,
        initial_mode_probabilities=_mode_probabilities(
            chain.initial, tuple(modes), document, (*path, "initial")
        ),
    )


def _state_names(
    form: ScenarioForm, modes: dict[str, Any], document: Document, path: Keys
) -> tuple[str, ...]:
    first: tuple[str, tuple[str, ...]] | None = None
    for name, mode in modes.items():
        if isinstance(mode, MatricesForm):
            if form.states is None:
                raise document.error(
                    (*path, name),
                    f"mode '{name}' is given by matrices, so 'states' must name the state vector, "
                    "such as [x, vx, y, vy]",
                )
            states = tuple(form.states)
        else:
            states = state_names(MOTION_MODELS[mode.motion], form.dimensions)
        if first is not None and states != first[1]:
            raise document.error(
                (*path, name),
                f"mode '{name}' has states {' '.join(states)} and mode '{first[0]}' "
                f"{' '.join(first[1])}; all modes need one state vector "
                "(constant_velocity_zero_acceleration fits beside wiener_acceleration)",
            )
        first = first or (name, states)
    assert first is not None
    if form.states is not None and tuple(form.states) != first[1]:
        raise document.error(
            ("states",), f"the modes have states {' '.join(first[1])}, not those given"
        )
    return first[1]


def _mode(
    name: str,
    mode: Any,
    states: tuple[str, ...],
    dimensions: int,
    noise: Array,
    document: Document,
    path: Keys,
) -> Mode:
    if isinstance(mode, MatricesForm):
        return _explicit_mode(name, mode, states, dimensions, noise, document, path)
    parameters = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in mode
        if key not in ("motion", "position_std_m") and value is not None
    }
    built = Mode(name, mode.motion, parameters, noise)
    try:
        MOTION_MODELS[mode.motion].discretise(np.ones(1), dimensions, **parameters)
    except UserError as error:
        raise document.error(path, f"mode '{name}': {str(error).rstrip('.')}") from None
    return built


def _explicit_mode(
    name: str,
    mode: MatricesForm,
    states: tuple[str, ...],
    dimensions: int,
    noise: Array,
    document: Document,
    path: Keys,
) -> Mode:
    n_x = len(states)
    H = None
    n_y = dimensions
    if mode.measurement_matrix is not None:
        H = checks.matrix(mode.measurement_matrix, document, (*path, "measurement_matrix"))
        n_y = len(H)
        checks.shape(H, (dimensions, n_x), document, (*path, "measurement_matrix"))
    elif any(axis not in states for axis in "xy"[:dimensions]):
        raise document.error(path, f"mode '{name}' needs a 'measurement_matrix': no state is 'x'")
    if mode.measurement_noise_covariance is not None:
        key: Keys = (*path, "measurement_noise_covariance")
        noise = checks.covariance(mode.measurement_noise_covariance, n_y, document, key, True)
    F = checks.matrix(mode.state_transition, document, (*path, "state_transition"))
    checks.shape(F, (n_x, n_x), document, (*path, "state_transition"))
    Q = checks.covariance(
        mode.process_noise_covariance, n_x, document, (*path, "process_noise_covariance")
    )
    b = np.zeros(n_x) if mode.input_effect is None else np.array(mode.input_effect, dtype=float)
    if b.shape != (n_x,):
        raise document.error(
            (*path, "input_effect"), f"'input_effect' has {b.size} entries for {n_x} states"
        )
    return Mode(name, None, {}, noise, Motion(F[None], b[None], Q[None]), H)


def _noise_by_mode(
    form: ScenarioForm, names: tuple[str, ...], document: Document
) -> dict[str, Array]:
    """What each mode believes of the measurement noise: its own, else the sensor's."""
    sensor = form.sensor.position_std_m
    noise = {}
    for name in names:
        own = form.modes[name].position_std_m if name in form.modes else None
        path: Keys = ("modes", name, "position_std_m")
        if own is None:
            path = ("sensor", "position_std_m")
            if isinstance(sensor, dict):
                if name not in sensor:
                    raise document.error(
                        path, f"'position_std_m' has no value for mode '{name}'; add it"
                    )
                own = sensor[name]
            else:
                own = sensor
        noise[name] = checks.noise_covariance(own, form.dimensions, document, path)
    return noise


def _mode_probabilities(
    initial: InitialForm, names: tuple[str, ...], document: Document, path: Keys
) -> Array:
    given = initial.mode_probabilities
    if given is None:
        return np.full(len(names), 1.0 / len(names))
    path = (*path, "mode_probabilities")
    values = checks.by_mode(given, names, document, path)
    if abs(sum(values) - 1.0) > 1e-9:
        raise document.error(
            path, f"'mode_probabilities' sum to {sum(values):g}; they must sum to 1"
        )
    return np.array(values, dtype=float)


def _try_bank(bank: ModeBank, step_s: float, document: Document) -> None:
    """Build the matrices once, so that nothing can fail later."""
    n_x = len(bank.state_names)
    try:
        bank.discretise(np.array([step_s]), np.zeros(n_x), np.eye(n_x))
    except UserError as error:
        raise document.error(("modes",), str(error)) from None


# ---- truth -----------------------------------------------------------------------------------


def _cases(
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
        if form.clock is not None:
            raise document.error(
                ("clock",), "a recording has times of its own; remove 'clock' (see thin_to_s)"
            )
        if form.dimensions != 2:
            raise document.error(("dimensions",), "a recording has two dimensions")
        try:
            return (), recorded.cases(truth.recording, folder)
        except UserError as error:
            raise document.error(("truth", "recording"), str(error)) from None
    times_s = _times(form, document)
    if truth.legs is not None:
        fixed = _legs(form, truth, times_s, bank.names, document)
        return bank.names, (Case(form.name, times_s, fixed),)
    assert truth.chain is not None
    path: Keys = ("truth", "chain")
    truth_bank = _bank(truth.chain, form, document, path)
    start = _initial(truth.chain.initial, truth_bank, document, (*path, "initial"))
    if start.two_point or start.follows_truth:
        raise document.error(
            (*path, "initial"), "the truth's own start needs a 'mean' of numbers, one per state"
        )
    chain = ChainTruth(truth_bank, start.mean, start.covariance)
    return truth_bank.names, (Case(form.name, times_s, chain),)


def _times(form: ScenarioForm, document: Document) -> Array:
    clock = form.clock
    if clock is None:
        raise document.error((), "'clock' is missing; add it")
    if clock.times_s is not None:
        if clock.step_s is not None or clock.duration_s is not None:
            raise document.error(
                ("clock",), "'times_s' lists every step; remove 'step_s' and 'duration_s'"
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
            f"{clock.step_s:g} s; make it one",
        )
    if steps > MAX_STEPS:
        raise document.error(
            ("clock", "duration_s"), f"these are {steps:,} steps; at most {MAX_STEPS:,} go"
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
        raise document.error(("truth",), "'start' is missing: the legs need a start; add it")
    if form.dimensions != 2:
        raise document.error(("dimensions",), "legs are flown in two dimensions")
    legs: list[Leg] = []
    speed, end = truth.start.speed_m_s, float(times_s[0])
    for i, leg in enumerate(truth.legs):
        path: Keys = ("truth", "legs", i)
        begin = end if leg.from_s is None else leg.from_s
        if begin != end:
            said = "overlaps the leg before it" if begin < end else "leaves a gap before it"
            raise document.error(
                (*path, "from_s"),
                f"this leg {said}: 'from_s' is {begin:g} s and the last one ends at {end:g} s; "
                "leave 'from_s' out",
            )
        if leg.until_s <= end:
            raise document.error(
                (*path, "until_s"),
                f"'until_s' is {leg.until_s:g} s and the leg begins at {end:g} s; legs must "
                "follow one another in time",
            )
        mode = modes[0] if leg.mode is None else leg.mode
        checks.known_mode(mode, modes, document, (*path, "mode"))
        speed = speed if leg.speed_m_s is None else leg.speed_m_s
        legs.append(Leg(leg.until_s, leg.turn_rate_rad_s, speed, modes.index(mode)))
        end = leg.until_s
    if end < times_s[-1]:
        raise document.error(
            ("truth", "legs", len(legs) - 1, "until_s"),
            f"the legs end at {end:g} s and the clock at {times_s[-1]:g} s; fly on until then",
        )
    x, y = truth.start.position_m
    return fly(tuple(legs), times_s, (x, y), truth.start.heading_rad)


def _sensor(
    form: ScenarioForm, truth_modes: tuple[str, ...], two_point: bool, document: Document
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
    return Sensor(np.stack(values), form.sensor.detection_probability, 2 if two_point else 0)


# ---- the filters' start, estimators, windows, claims -----------------------------------------


def _initial(form: InitialForm, bank: ModeBank, document: Document, path: Keys) -> Initial:
    n_x = len(bank.state_names)
    stds = {
        "": form.position_std_m,
        "v": form.velocity_std_m_s,
        "a": form.acceleration_std_m_s2,
    }
    spread = form.covariance is not None or any(std is not None for std in stds.values())
    if form.from_measurements is not None:
        if form.mean is not None or spread:
            raise document.error(
                (*path, "from_measurements"),
                "a start from measurements needs no mean and no spread; remove them",
            )
        return Initial(True, False, False, np.zeros(n_x), np.zeros((n_x, n_x)))
    if form.mean is None:
        raise document.error(
            path,
            "'mean' is missing: truth, drawn_about_truth or a number per state "
            "(or from_measurements: two_point)",
        )
    covariance = np.zeros((n_x, n_x))
    if form.covariance is not None:
        if len([s for s in stds.values() if s is not None]):
            raise document.error(
                (*path, "covariance"), "'covariance' says all; remove the standard deviations"
            )
        covariance = checks.covariance(form.covariance, n_x, document, (*path, "covariance"))
    elif spread:
        variances = []
        for name in bank.state_names:
            std = stds.get(name[:-1] if name[-1:] in "xy" else "?")
            if std is None:
                raise document.error(
                    path, f"the spread of state '{name}' is missing; give its standard deviation"
                )
            variances.append(std**2)
        covariance = np.diag(variances)
    if form.mean == "drawn_about_truth" and not spread:
        raise document.error(
            (*path, "mean"), "a start drawn about the truth needs a spread; add position_std_m, ..."
        )
    if isinstance(form.mean, str):
        drawn = form.mean == "drawn_about_truth"
        return Initial(False, True, drawn, np.zeros(n_x), covariance)
    mean = np.array(form.mean, dtype=float)
    if mean.shape != (n_x,):
        raise document.error(
            (*path, "mean"),
            f"'mean' has {mean.size} numbers for the {n_x} states {' '.join(bank.state_names)}",
        )
    return Initial(False, False, False, mean, covariance)


def _estimator(
    label: str, form: ScenarioForm, bank: ModeBank, document: Document
) -> ChosenEstimator:
    if label in ("raw", "truth"):
        raise document.error(
            ("estimators", label), f"'{label}' names a row of every table; call it otherwise"
        )
    chosen: Any = form.estimators[label]
    estimator = estimators()[chosen.type]
    values = {key: value for key, value in chosen if key != "type"}
    if "mode" in values:
        checks.known_mode(values["mode"], bank.names, document, ("estimators", label, "mode"))
    return ChosenEstimator(label, estimator, estimator.settings(**values))


def _window(
    name: str,
    window: WindowForm,
    form: ScenarioForm,
    truth_modes: tuple[str, ...],
    document: Document,
) -> Window:
    path: Keys = ("windows", name)
    if name == "all":
        raise document.error(path, "'all' is every scored step already; call it otherwise")
    mode = None
    if window.mode is not None:
        checks.known_mode(window.mode, truth_modes, document, (*path, "mode"))
        mode = truth_modes.index(window.mode)
    return Window(
        name,
        -np.inf if window.from_s is None else window.from_s,
        np.inf if window.until_s is None else window.until_s,
        mode,
        window.after_switch_s,
        window.within_switch_s,
        form.scoring.skip_scans,
    )


def _claim(i: int, form: ScenarioForm, document: Document) -> Claim:
    claim: ClaimForm = form.published[i]
    path: Keys = ("published", i)
    labels = ("raw", *form.estimators)
    if (claim.estimator is None) == (claim.compare is None):
        raise document.error(path, "a claim is on one 'estimator' or on two ('compare'); give one")
    for key, names in (("estimator", [claim.estimator]), ("compare", claim.compare or [])):
        for label in names:
            if label is not None and label not in labels:
                raise document.error(
                    (*path, key), f"'{label}' is no estimator here; there are {', '.join(labels)}"
                )
    if claim.estimator is not None and claim.value is None:
        raise document.error(path, "a claim on one estimator needs the published 'value'")
    if claim.compare is not None and claim.sign is None:
        raise document.error(path, "a comparison needs its 'sign': less or greater")
    if claim.window != "all" and claim.window not in form.windows:
        raise document.error((*path, "window"), f"there is no window '{claim.window}'")
    tolerance = claim.tolerance
    if tolerance is None and claim.value is not None:
        text = document.source_text((*path, "value"))
        tolerance = printed_tolerance(text if text is not None else repr(claim.value))
    return Claim(
        claim=claim.claim,
        estimator=claim.estimator,
        compare=None if claim.compare is None else (claim.compare[0], claim.compare[1]),
        metric=claim.metric,
        window=claim.window,
        value=claim.value,
        tolerance=tolerance or 0.0,
        sign=claim.sign,
        expect=claim.expect,
        because=claim.because,
    )


def _resolved(form: Form, claims: tuple[Claim, ...], folder: Path) -> dict[str, Any]:
    data = form.model_dump(by_alias=True, exclude_none=True)
    for written, claim in zip(data["published"], claims, strict=True):
        if claim.value is not None:
            written["tolerance"] = claim.tolerance
    recording = data["truth"].get("recording", {})
    for holder in (recording, recording.get("reference", {})):
        if "file" in holder and "package" not in holder:
            holder["file"] = str((folder / holder["file"]).resolve())
    return {key: value for key, value in data.items() if value not in ("", [], {})}
