"""The bank of modes: motion models or matrices, measurement noise, and the Markov chain."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hybridtrack.config import checks
from hybridtrack.config.reader import Document, Keys
from hybridtrack.config.schema import ChainForm, InitialForm, MatricesForm, ScenarioForm
from hybridtrack.errors import UserError
from hybridtrack.models import Array, JumpMarkovModel, Mode, ModeBank, generator_from_sojourns
from hybridtrack.motion import MOTION_MODELS, Motion, state_names

CHAIN_KEYS = ("transition_matrix", "mean_sojourn_s", "generator_per_s")


def bank(
    chain: ScenarioForm | ChainForm, form: ScenarioForm, document: Document, path: Keys
) -> ModeBank:
    """The bank of the scenario, or of a chain's truth (at `path`) with what it has of its own.

    Modes left out of `mean_sojourn_s` belong to no chain: a Kalman filter may still use them.
    """
    own = chain.modes is not None
    modes = chain.modes if chain.modes is not None else form.modes
    built = _modes(modes, form, document, (*path, "modes") if own else ("modes",))
    given = [key for key in CHAIN_KEYS if getattr(chain, key) is not None]
    if len(given) > 1:
        raise document.error(
            (*path, given[1]), f"'{given[1]}' and '{given[0]}' say the same; keep one of them"
        )
    matrices, matrices_path = (chain, path) if given else (form, ())
    names = tuple(modes)
    if matrices.mean_sojourn_s is not None:
        if not matrices.mean_sojourn_s:
            raise document.error(
                (*matrices_path, "mean_sojourn_s"),
                f"'mean_sojourn_s' is empty; give seconds by mode: {', '.join(names)}",
            )
        for name in matrices.mean_sojourn_s:
            checks.known_mode(name, names, document, (*matrices_path, "mean_sojourn_s", name))
        names = tuple(name for name in names if name in matrices.mean_sojourn_s)
    matrix, generator = _chain(matrices, names, document, matrices_path)
    return ModeBank(
        modes=tuple(mode for mode in built if mode.name in names),
        state_names=_state_names(form, modes, document, (*path, "modes") if own else ("modes",)),
        dimensions=form.dimensions,
        transition_matrix=matrix,
        generator_per_s=generator,
        initial_mode_probabilities=_mode_probabilities(
            chain.initial, names, tuple(modes), document, (*path, "initial")
        ),
    )


def single_mode_bank(name: str, form: ScenarioForm, document: Document) -> ModeBank:
    """The bank of one mode, for a Kalman filter."""
    built = {mode.name: mode for mode in _modes(form.modes, form, document, ("modes",))}
    return ModeBank(
        modes=(built[name],),
        state_names=_state_names(form, form.modes, document, ("modes",)),
        dimensions=form.dimensions,
        transition_matrix=None,
        generator_per_s=np.zeros((1, 1)),
        initial_mode_probabilities=np.ones(1),
    )


def try_out(
    bank: ModeBank, steps_s: Sequence[Array], document: Document, path: Keys
) -> JumpMarkovModel:
    """The bank's model at the shortest and longest steps, so that nothing can fail later.

    steps_s: the steps of each case. Raises ScenarioError where they are uneven and the chain or a
    mode holds for one length only, and where numbers are too large to compute with.
    """
    shortest, longest = min(s.min() for s in steps_s), max(s.max() for s in steps_s)
    uneven = longest - shortest > 1e-9 * longest
    these = f"for steps of one length and these last {shortest:g} to {longest:g} s"
    if uneven and bank.transition_matrix is not None:
        raise document.error(
            _whence(document, path, "transition_matrix"),
            f"'transition_matrix' holds {these}; give 'mean_sojourn_s' or 'generator_per_s'",
        )
    for mode in bank.modes:
        if uneven and mode.motion is None:
            raise document.error(
                _whence(document, path, "modes", mode.name),
                f"the matrices of mode '{mode.name}' hold {these}; name a motion instead",
            )
    n_x = len(bank.state_names)
    ends_s = np.array([shortest, longest] if uneven else [shortest])
    with np.errstate(all="ignore"):
        for mode in bank.modes:
            if mode.motion is not None:
                _try_motion(mode, ends_s, bank.dimensions, document, path)
        model = bank.discretise(ends_s, np.zeros(n_x), np.eye(n_x))
    for j, name in enumerate(bank.names):
        parts = (model.state_transition, model.process_noise_covariance, model.input_effect)
        if not all(np.isfinite(part[:, j]).all() for part in parts):
            raise document.error(
                _whence(document, path, "modes", name),
                f"mode '{name}' has numbers too large to compute with; check its units",
            )
    if not np.isfinite(model.transition_matrix).all():
        raise document.error(
            path, "the rates of the chain are too large to compute with; check their units"
        )
    return model


def _try_motion(
    mode: Mode, steps_s: Array, dimensions: int, document: Document, path: Keys
) -> None:
    """A motion model may refuse a step's length."""
    assert mode.motion is not None
    try:
        MOTION_MODELS[mode.motion].discretise(steps_s, dimensions, **mode.parameters)
    except UserError as error:
        said = str(error).rstrip(".")
        place = _whence(document, path, "modes", mode.name, "motion")
        raise document.error(place, f"mode '{mode.name}': {said}") from None


def _whence(document: Document, path: Keys, *keys: str) -> Keys:
    """Where a chain's truth has something: of its own, or from the scenario."""
    return (*path, *keys) if (*path, *keys) in document.places else keys


def _chain(
    form: ScenarioForm | ChainForm, names: tuple[str, ...], document: Document, path: Keys
) -> tuple[Array | None, Array | None]:
    """The transition matrix for steps of one length, or the generator for any."""
    if form.transition_matrix is not None:
        key = (*path, "transition_matrix")
        return checks.transition_matrix(form.transition_matrix, names, document, key), None
    if form.mean_sojourn_s is not None:
        sojourns = [form.mean_sojourn_s[name] for name in names]
        return None, generator_from_sojourns(np.array(sojourns, dtype=np.float64))
    if form.generator_per_s is not None:
        key = (*path, "generator_per_s")
        return None, checks.generator(form.generator_per_s, names, document, key)
    if len(names) > 1:
        raise document.error(
            path, "'transition_matrix' (or mean_sojourn_s, generator_per_s) is missing; add it"
        )
    return None, np.zeros((1, 1))


def _modes(
    modes: Mapping[str, Any], form: ScenarioForm, document: Document, path: Keys
) -> tuple[Mode, ...]:
    states = _state_names(form, modes, document, path)
    noise = _noise_by_mode(form, tuple(modes), document)
    return tuple(
        _mode(name, modes[name], states, form.dimensions, noise[name], document, (*path, name))
        for name in modes
    )


def _state_names(
    form: ScenarioForm, modes: Mapping[str, Any], document: Document, path: Keys
) -> tuple[str, ...]:
    if form.states is not None and len(set(form.states)) < len(form.states):
        raise document.error(("states",), "'states' names a state twice; every name stands once")
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
            ("states",),
            f"'states' are {' '.join(form.states)} and those of the modes {' '.join(first[1])}; "
            "remove 'states', or make them equal",
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
        said = str(error).rstrip(".")
        raise document.error(path, f"mode '{name}': {said[0].lower()}{said[1:]}") from None
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
    if mode.measurement_matrix is not None:
        H = checks.matrix(mode.measurement_matrix, document, (*path, "measurement_matrix"))
        why = f"one row per dimension, the states are {' '.join(states)}"
        checks.shape(H, (dimensions, n_x), document, (*path, "measurement_matrix"), why)
    elif any(axis not in states for axis in "xy"[:dimensions]):
        missing = next(axis for axis in "xy" if axis not in states)
        raise document.error(
            path,
            f"mode '{name}' has no state '{missing}' that could be measured; add a "
            "'measurement_matrix'",
        )
    if mode.measurement_noise_covariance is not None:
        key: Keys = (*path, "measurement_noise_covariance")
        noise = checks.covariance(
            mode.measurement_noise_covariance, tuple("xy"[:dimensions]), document, key, True
        )
    F = checks.matrix(mode.state_transition, document, (*path, "state_transition"))
    why = f"the states are {' '.join(states)}"
    checks.shape(F, (n_x, n_x), document, (*path, "state_transition"), why)
    Q = checks.covariance(
        mode.process_noise_covariance, states, document, (*path, "process_noise_covariance")
    )
    b = np.zeros(n_x) if mode.input_effect is None else np.array(mode.input_effect, dtype=float)
    if b.shape != (n_x,):
        raise document.error(
            (*path, "input_effect"),
            f"'input_effect' needs one number for each of the states {' '.join(states)}, and has "
            f"{b.size}",
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
                        path,
                        f"'position_std_m' has no value for mode '{name}'; add it, or give the "
                        "mode a 'position_std_m' of its own",
                    )
                own = sensor[name]
            else:
                own = sensor
        noise[name] = checks.noise_covariance(own, form.dimensions, document, path)
    return noise


def _mode_probabilities(
    initial: InitialForm,
    names: tuple[str, ...],
    defined: tuple[str, ...],
    document: Document,
    path: Keys,
) -> Array:
    given = initial.mode_probabilities
    if given is None:
        return np.full(len(names), 1.0 / len(names))
    path = (*path, "mode_probabilities")
    values = checks.by_mode(given, names, document, path, defined)
    if abs(sum(values) - 1.0) > 1e-9:
        raise document.error(
            path, f"'mode_probabilities' sum to {sum(values):.10g}; make them sum to 1"
        )
    return np.array(values, dtype=float)
