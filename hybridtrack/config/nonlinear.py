"""From a valid form with `dynamics` to the Experiment that runs."""

import keyword
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hybridtrack.bounded import BoundedTruth, Noise
from hybridtrack.config import checks
from hybridtrack.config.build import Claims, analyses_of, claims_of, window_of, written
from hybridtrack.config.claims import point_names
from hybridtrack.config.nonlinear_form import NonlinearForm
from hybridtrack.config.reader import Document, Keys, shown
from hybridtrack.config.truths import times_of
from hybridtrack.description import ChosenEstimator, Experiment, Initial
from hybridtrack.errors import Unsuited, UserError
from hybridtrack.estimators import estimators
from hybridtrack.expressions import (
    FUNCTIONS,
    KNOWN_NUMBERS,
    ExpressionError,
    number,
    parse,
)
from hybridtrack.maps import Map, compiled, constants_of_states, not_finite, symbols
from hybridtrack.models import Array, ModeBank
from hybridtrack.nonlinear import NonlinearModel
from hybridtrack.remainders import remainder
from hybridtrack.sensors import Sensor
from hybridtrack.simulation import Case, step_lengths

RADIANS = "rad"
ROUNDINGS = 100  # that a set has to be wider than, to hold the truth for certain
LARGEST_STATE = 1e30  # a truth beyond it runs away
MOST_STEPS = 100_000  # of a nonlinear course, which Python steps through


def build_nonlinear(form: NonlinearForm, document: Document) -> Experiment:
    """The experiment of a form. Raises ScenarioError about what doesn't fit together."""
    times_s = times_of(form.clock, document)
    if np.ptp(step_lengths(times_s)):
        raise document.error(
            ("clock",), "'dynamics' hold for steps of one length, and these are uneven; even them"
        )
    if len(times_s) > MOST_STEPS + 1:
        raise document.error(
            ("clock",),
            f"there are {len(times_s) - 1:,} steps and may be {MOST_STEPS:,}; shorten it",
        )
    model = _model(form, len(times_s) - 1, document)
    truth = _truth(form, model, document)
    _check_inputs(model, tuple(form.inputs), document)
    _check_start(model, truth.start, document)
    _check_course(model, truth.start, times_s, document)
    _check_resolution(model, truth.start, document)
    case = Case(form.name, times_s, truth)
    nothing = ModeBank((), model.state_names, 1, None, None, np.zeros(0))
    chosen = tuple(_estimator(label, form, model, nothing, document) for label in form.estimators)
    _check_labels(form, document)
    windows = window_of(form, (), (case,), document)
    sensor = Sensor(model.measurement_noise_shape[np.newaxis], 1.0, 0)
    claims = claims_of(form, chosen, (), (case,), sensor, document)
    return Experiment(
        name=form.name,
        title=form.title or form.name,
        source=form.source,
        assumptions=tuple(form.assumptions),
        cases=(case,),
        truth_modes=(),
        bank=nothing,
        sensor=sensor,
        initial=_initial(form, model, document),
        estimators=chosen,
        compare_with=form.compare_with,
        error=form.scoring.error,
        windows=windows,
        runs=form.monte_carlo.runs,
        seed=form.monte_carlo.seed,
        keep_tracks=min(form.monte_carlo.keep_tracks, form.monte_carlo.runs),
        claims=claims[0],
        analysis_claims=claims[1],
        analyses=analyses_of(form),
        resolved=_resolved(form, claims),
        nonlinear=model,
        point_names=point_names(form),
        units=_units(form, document),
    )


def _units(form: NonlinearForm, document: Document) -> dict[str, str]:
    """Units by name of state or measurement; an angle is in radians, the rest as written."""
    known = tuple(dict.fromkeys([*form.states, *form.measurement]))
    for name, unit in form.units.items():
        if not unit.isprintable():
            raise document.error(
                ("units", name), f"the unit of '{shown(name)}' has letters that no figure can show"
            )
        if name not in known:
            raise document.error(
                ("units", name),
                f"'{shown(name)}' is no state and no measurement; {checks.nearest(name, known)}",
            )
    for angle in form.angles:
        if form.units.get(angle, RADIANS) != RADIANS:
            raise document.error(
                ("units", angle),
                f"'{angle}' is among the angles, which are in {RADIANS}, and its unit is "
                f"{shown(form.units[angle])}; remove one",
            )
    return dict.fromkeys(form.angles, RADIANS) | form.units


# ---- the maps --------------------------------------------------------------------------------


def _model(form: NonlinearForm, n_steps: int, document: Document) -> NonlinearModel:
    states, inputs = tuple(form.states), tuple(form.inputs)
    _check_names(form, document)
    known = tuple(dict.fromkeys([*states, *form.measurement]))
    for i, angle in enumerate(form.angles):
        if angle not in known:
            raise document.error(
                ("angles", i),
                f"'{shown(angle)}' is no state and no measurement; {checks.nearest(angle, known)}",
            )
    x, u = symbols(states, "state"), symbols(inputs, "input")
    names = dict(zip(states, x, strict=True)) | dict(zip(inputs, u, strict=True))
    names |= {name: number(value) for name, value in form.constants.items()}
    for name in form.dynamics:
        _known_state(name, states, document, ("dynamics", name))
    for name in states:
        if name not in form.dynamics:
            raise document.error(
                ("dynamics",), f"'dynamics' has no expression for '{name}'; add it"
            )
    ordered = {name: form.dynamics[name] for name in states}
    dynamics = _map("dynamics", ordered, names, x, u, document)
    measurement = _map("measurement", form.measurement, names, x, u, document)
    process, noise = form.noise.process, form.noise.measurement
    measured = tuple(form.measurement)
    turning = tuple(i for i, name in enumerate(measured) if name in form.angles)
    scale = (len(states), len(measured)) if form.noise.contains_box else (1, 1)
    return NonlinearModel(
        dynamics=dynamics,
        measurement=measurement,
        dynamics_remainder=remainder(dynamics),
        measurement_remainder=remainder(measurement, turning),
        state_names=states,
        measurement_names=measured,
        angles=tuple(states.index(angle) for angle in form.angles if angle in states),
        measured_angles=turning,
        inputs=_inputs(form, n_steps, document),
        process_noise_shape=scale[0] * _ellipsoid(process, states, document, ("noise", "process")),
        measurement_noise_shape=scale[1]
        * _ellipsoid(noise, measured, document, ("noise", "measurement")),
        initial_shape=_ellipsoid(
            form.initial.half_axes, states, document, ("initial", "half_axes")
        ),
    )


def _check_names(form: NonlinearForm, document: Document) -> None:
    """Names that an expression can hold, each with one meaning."""
    taken: dict[str, str] = {}
    kinds: dict[str, Sequence[str]] = {
        "states": form.states,
        "constants": tuple(form.constants),
        "inputs": tuple(form.inputs),
    }
    for kind, names in kinds.items():
        for i, name in enumerate(names):
            path: Keys = (kind, i if kind == "states" else name)
            if not name.isidentifier() or keyword.iskeyword(name):
                raise document.error(
                    path,
                    f"'{name}' cannot stand in an expression; use letters, digits and _, a letter "
                    "first",
                )
            if name in FUNCTIONS or name in KNOWN_NUMBERS:
                raise document.error(
                    path, f"'{name}' has a meaning in expressions already; call it otherwise"
                )
            if name in taken:
                raise document.error(
                    path, f"'{name}' is among the {taken[name]} already; every name stands once"
                )
            taken[name] = kind


def _known_state(name: str, states: tuple[str, ...], document: Document, path: Keys) -> None:
    if name not in states:
        raise document.error(path, f"'{shown(name)}' is no state; {checks.nearest(name, states)}")


def _map(
    kind: str,
    texts: Mapping[str, str | float],
    names: Mapping[str, Any],
    x: Sequence[Any],
    u: Sequence[Any],
    document: Document,
) -> Map:
    found = []
    for name, text in texts.items():
        written = text if isinstance(text, str) else repr(text)
        try:
            found.append(parse(written, names))
        except ExpressionError as error:
            said = f"'{shown(name)}' is {shown(written)}: {error}"
            raise document.error((kind, name), said) from None
    try:
        return compiled(found, x, u)
    except ExpressionError as error:
        name, text = list(texts.items())[error.component]
        said = f"'{shown(name)}' is {shown(str(text))}: {error}"
        raise document.error((kind, name), said) from None


def _check_start(model: NonlinearModel, start: Array, document: Document) -> None:
    """Every map and its derivatives have finite values at the start."""
    u = model.inputs_at(0)
    for kind, map_, names in (
        ("dynamics", model.dynamics, model.state_names),
        ("measurement", model.measurement, model.measurement_names),
    ):
        for derivative, what in (
            (map_.value, "value"),
            (map_.jacobian, "derivative"),
            (map_.hessian, "second derivative"),
        ):
            values = derivative(start[np.newaxis], u)[0]
            for i, name in enumerate(names):
                if not np.isfinite(values[i]).all():
                    raise document.error(
                        (kind, name),
                        f"'{shown(name)}' has no finite {what} at the start of the truth (a "
                        "division by zero?); change it, or 'start'",
                    )


def _check_course(model: NonlinearModel, start: Array, times_s: Array, document: Document) -> None:
    """The truth keeps its value to the end, at least without noise."""
    with np.errstate(all="ignore"):
        course = model.course(start, len(times_s) - 1)
        lost = ~(np.abs(course).max(axis=1) < LARGEST_STATE)
    if lost.any():
        k = int(np.argmax(lost))
        raise document.error(
            ("dynamics",),
            f"without noise the truth has no finite value at step {k} ({times_s[k]:g} s); end "
            "'clock' before, or change 'dynamics' or 'start'",
        )


def _check_resolution(model: NonlinearModel, start: Array, document: Document) -> None:
    """What the truth starts at, and what is measured of it, can be told within the half-axes."""
    seen = model.measurement.value(start[np.newaxis], model.inputs_at(0))[0]
    for path, names, values, shape in (
        (("initial", "half_axes"), model.state_names, start, model.initial_shape),
        (("noise", "measurement"), model.measurement_names, seen, model.measurement_noise_shape),
    ):
        for name, value, width in zip(names, values, np.sqrt(np.diagonal(shape)), strict=True):
            if width < ROUNDINGS * np.spacing(abs(value)):
                raise document.error(
                    (*path, name),
                    f"the half-axis of '{name}' is {width:g}, and it starts at {value:g}, where "
                    "numbers are too far apart for that; move the origin, or widen it",
                )


def _check_inputs(model: NonlinearModel, names: tuple[str, ...], document: Document) -> None:
    """What the maps make of inputs alone has a finite value at all of their values."""
    rows = np.unique(model.inputs, axis=0)
    for map_ in (model.dynamics, model.measurement):
        for part in constants_of_states(map_):
            lost = not_finite(part, map_, rows)
            if not lost.any():
                continue
            row = rows[np.flatnonzero(lost)[0]]
            held = [i for i, symbol in enumerate(map_.inputs) if symbol in part.free_symbols]
            values = " and ".join(f"'{shown(names[i])}' is {row[i]:g}" for i in held)
            raise document.error(
                ("inputs", names[held[0]]),
                f"where {values}, an expression or a derivative of it has no finite value (a "
                "division by zero, or a root or logarithm of a negative number?); change it",
            )


def _inputs(form: NonlinearForm, n_steps: int, document: Document) -> Array:
    """u (n_steps or 1, n_u)."""
    lists = {name: value for name, value in form.inputs.items() if isinstance(value, list)}
    for name, values in lists.items():
        if len(values) != n_steps:
            raise document.error(
                ("inputs", name),
                f"'{name}' has {len(values)} numbers and there are {n_steps} steps; give a "
                "number, or one for each step",
            )
    rows = n_steps if lists else 1
    columns = [
        np.broadcast_to(np.array(value, dtype=np.float64), (rows,))
        for value in form.inputs.values()
    ]
    return np.stack(columns, axis=1) if columns else np.zeros((1, 0))


def _ellipsoid(
    half_axes: Mapping[str, float], names: tuple[str, ...], document: Document, path: Keys
) -> Array:
    """Its shape (n, n) from a half-axis for every name."""
    for name in half_axes:
        if name not in names:
            near = checks.nearest(name, names)
            raise document.error((*path, name), f"'{shown(name)}' is not known here; {near}")
    for name in names:
        if name not in half_axes:
            raise document.error(path, f"'{path[-1]}' has no half-axis of '{name}'; add it")
    return np.diag([half_axes[name] ** 2 for name in names])


# ---- truth, start, estimators ----------------------------------------------------------------


def _truth(form: NonlinearForm, model: NonlinearModel, document: Document) -> BoundedTruth:
    noise, states = form.noise, model.state_names
    start = _vector(form.truth.start, states, document, ("truth", "start"))
    if (noise.kind == "adversary") != (noise.against is not None):
        said = (
            "an adversary plays 'against' an estimator; add it"
            if noise.against is None
            else "'against' belongs to the kind adversary; remove it"
        )
        raise document.error(("noise", "kind" if noise.against is None else "against"), said)
    if noise.against is not None and noise.against not in form.estimators:
        raise document.error(
            ("noise", "against"),
            f"'against' is {noise.against}, which is no estimator here; "
            f"{checks.nearest(noise.against, tuple(form.estimators))}",
        )
    process = _ellipsoid(noise.process, states, document, ("noise", "process"))
    measured = _ellipsoid(
        noise.measurement, model.measurement_names, document, ("noise", "measurement")
    )
    return BoundedTruth(
        model=model,
        start=start,
        spread=form.truth.spread,
        process=Noise(noise.kind, process, noise.hold_steps),
        measurement=Noise(noise.kind, measured, noise.hold_steps),
        against=noise.against,
        detection_probability=noise.detection_probability,
    )


def _vector(
    values: Sequence[float], states: tuple[str, ...], document: Document, path: Keys
) -> Array:
    if len(values) != len(states):
        raise document.error(
            path,
            f"'{path[-1]}' needs one number for each of the states {' '.join(states)}, and has "
            f"{len(values)}",
        )
    return np.array(values, dtype=np.float64)


def _initial(form: NonlinearForm, model: NonlinearModel, document: Document) -> Initial:
    follows = form.initial.mean == "truth"
    mean = np.zeros(len(model.state_names))
    if not isinstance(form.initial.mean, str):
        mean = _vector(form.initial.mean, model.state_names, document, ("initial", "mean"))
    return Initial(False, follows, False, mean, model.initial_shape)


def _estimator(
    label: str, form: NonlinearForm, model: NonlinearModel, bank: ModeBank, document: Document
) -> ChosenEstimator:
    checks.label(label, document)
    chosen: Any = form.estimators[label]
    estimator = estimators()[chosen.type]
    settings = estimator.settings(**{key: value for key, value in chosen if key != "type"})
    try:
        estimator.prepare(settings, model)
    except UserError as error:
        said = str(error).rstrip(".")
        keys = error.keys if isinstance(error, Unsuited) else ()
        raise document.error(("estimators", label, *keys), f"'{label}': {said}") from None
    return ChosenEstimator(label, estimator, settings, bank)


def _check_labels(form: NonlinearForm, document: Document) -> None:
    if form.compare_with is not None and form.compare_with not in form.estimators:
        raise document.error(
            ("compare_with",),
            f"'compare_with' is {form.compare_with}, which is no estimator here; "
            f"{checks.nearest(form.compare_with, tuple(form.estimators))}",
        )


def _resolved(form: NonlinearForm, claims: Claims) -> dict[str, Any]:
    data = written(form, claims)
    return {key: value for key, value in data.items() if value not in ("", [], {})}
