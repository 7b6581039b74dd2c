"""Does tuning that shrinks the first term of Hwang 2006, eq. 21, shorten delays? Tried out."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from hybridtrack.analyses._mean_course import (
    Course,
    Switch,
    mode_probabilities,
    predicted_delay,
)
from hybridtrack.analyses._steady_filters import (
    NoSteadyState,
    SteadyFilter,
    difference,
    steady_filters,
)
from hybridtrack.description import ChosenEstimator, Experiment
from hybridtrack.models import Array, JumpMarkovModel

FACTORS = (0.25, 0.5, 2.0, 4.0)  # of the noise that filters believe in, one at a time
MOST_STEPS = 5000  # of a course whose tuning is tried


class Tuned(NamedTuple):
    mode: str
    parameter: str
    factor: float
    filters: list[SteadyFilter | NoSteadyState]
    probabilities: Array


def tuned(
    experiment: Experiment, course: Course, chosen: ChosenEstimator, model: JumpMarkovModel
) -> list[Tuned]:
    """The course again with the noise that the filters believe in changed, one at a time."""
    if len(course.measurements) > MOST_STEPS:
        return []
    found = []
    changes: list[tuple[str, str, float]] = [("", "", 1.0)]
    moving = {name for switch in course.switches for name in (switch.from_mode, switch.to_mode)}
    changes += [
        (mode, parameter, factor)
        for mode in model.mode_names
        if mode in moving
        for parameter in ("process_noise_covariance", "measurement_noise_covariance")
        for factor in FACTORS
    ]
    for mode, parameter, factor in changes:
        change = _scaling(mode, parameter, factor)
        probabilities = mode_probabilities(experiment, course, chosen, change)
        own = chosen.estimator.prepare(chosen.settings, change(model)).model
        found.append(Tuned(mode, parameter, factor, steady_filters(own), probabilities))
    return found


def _scaling(
    mode: str, parameter: str, factor: float
) -> Callable[[JumpMarkovModel], JumpMarkovModel]:
    def change(model: JumpMarkovModel) -> JumpMarkovModel:
        if not parameter:
            return model
        j = model.mode_names.index(mode)
        scaled = getattr(model, parameter).copy()
        scaled[..., j, :, :] *= factor
        return model._replace(**{parameter: scaled})

    return change


def of_switch(
    tuned_courses: Sequence[Tuned], switch: Switch, names: tuple[str, ...]
) -> list[dict[str, Any]]:
    """The first term of eq. 21 and the delay of a switch, tuning by tuning of its two modes."""
    found = []
    new, left = names.index(switch.to_mode), names.index(switch.from_mode)
    for one in tuned_courses:
        T, i = one.filters[new], one.filters[left]
        if one.mode not in ("", switch.from_mode, switch.to_mode):
            continue
        if isinstance(T, SteadyFilter) and isinstance(i, SteadyFilter):
            found.append(
                {
                    "mode": one.mode,
                    "parameter": one.parameter,
                    "factor": one.factor,
                    "first_term": 1.0 / difference(i, T).alpha,
                    "delay_steps": predicted_delay(one.probabilities, new, switch),
                }
            )
    return found


def concordance(
    parameters: Sequence[tuple[str, str]], terms: Sequence[float], delays: Sequence[float]
) -> float | None:
    """Pairs of tunings that the smaller term makes sooner, less those it makes later, over both.

    Of tunings of one parameter, the untuned ("", "") being of any. 1 where a smaller term always
    comes with a shorter delay, -1 with a longer one (Goodman and Kruskal's gamma); None where no
    delay changes.
    """
    sooner = later = 0
    for a in range(len(terms)):
        for b in range(a):
            of_one = parameters[a] == parameters[b] or ("", "") in (parameters[a], parameters[b])
            moved = delays[a] != delays[b]
            if of_one and moved and not math.isclose(terms[a], terms[b], rel_tol=1e-9):
                same = (terms[a] < terms[b]) == (delays[a] < delays[b])
                sooner, later = sooner + same, later + (not same)
    return (sooner - later) / (sooner + later) if sooner + later else None
