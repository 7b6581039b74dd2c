"""The lint: stretches of the truth that are too short for the bank to notice or to identify."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hybridtrack.analyses._horizons import Horizon
from hybridtrack.analyses._pairs_of_modes import PairOfModes, Settings, Theory, theory
from hybridtrack.chains import expected_steps_in_mode
from hybridtrack.description import Experiment
from hybridtrack.jumps import ChainTruth, truth_model
from hybridtrack.models import Array
from hybridtrack.simulation import FixedTruth, step_lengths

LONGER = 4  # times the longest stretch: how far the lint looks


class Stretch(NamedTuple):
    """A part of a flown or recorded truth in one mode, without a switch."""

    case: str
    number: int  # from 1, in its case
    mode: str
    from_s: float
    until_s: float
    scans: int
    before: str | None  # the mode that it follows


def stretches(experiment: Experiment) -> tuple[Stretch, ...]:
    """The truth's stretches of one mode; none of a truth that has no modes or draws them."""
    found = []
    for case in experiment.cases:
        if not isinstance(case.truth, FixedTruth) or (case.truth.mode < 0).any():
            continue
        mode = case.truth.mode[1:]  # that which drives each step
        starts = np.flatnonzero(np.diff(mode, prepend=-1))
        before = None
        for number, (begin, end) in enumerate(
            zip(starts, [*starts[1:], len(mode)], strict=True), start=1
        ):
            name = experiment.truth_modes[mode[begin]]
            span_s = float(case.times_s[begin]), float(case.times_s[end])
            found.append(Stretch(case.name, number, name, *span_s, int(end - begin), before))
            before = name
    return tuple(found)


def warnings_about_legs(experiment: Experiment, settings: Settings | None = None) -> list[str]:
    """One sentence for each stretch of the truth that is too short for the bank, if there is any.

    Also for modes of a chain that last too short on average. Two modes at least, else nothing is
    said. Raises Unsuited as `theory` does.
    """
    legs = stretches(experiment)
    longest = max([leg.scans for leg in legs] + _sojourns(experiment), default=0)
    if len(experiment.bank.modes) < 2 or not longest:
        return []
    chosen = settings or experiment.analyses.get("observability", Settings())
    # What takes much longer than anything lasts need not be known to the scan.
    chosen = chosen._replace(most_scans=min(chosen.most_scans, LONGER * longest))
    flown = {leg.mode for leg in legs} or None
    known = theory(experiment, chosen, from_modes=flown, with_curves=False)
    return list(warnings_of(experiment, known, chosen.target_error))


def _sojourns(experiment: Experiment) -> list[int]:
    """The mean sojourns of a chain's modes in scans, rounded up, without those for ever."""
    truth = experiment.cases[0].truth
    if not isinstance(truth, ChainTruth):
        return []
    steps = _steps_in_modes(truth, experiment)[1]
    return [math.ceil(mean) for mean in steps.tolist() if math.isfinite(mean)]


def _steps_in_modes(truth: ChainTruth, experiment: Experiment) -> tuple[Array, Array]:
    """A chain's transition matrix and its modes' mean sojourns in steps, for the median step."""
    step_s = np.array([float(np.median(step_lengths(experiment.cases[0].times_s)))])
    matrix = truth_model(truth, step_s).transition_matrix[0]
    return matrix, expected_steps_in_mode(matrix)


def warnings_of(experiment: Experiment, known: Theory, target: float) -> Iterator[str]:
    by_names = {(pair.old.name, pair.new.name): pair for pair in known.pairs}
    error = f"at {100 * target:g} % error"
    many = len(experiment.cases) > 1
    for leg in stretches(experiment):
        where = f" of '{leg.case}'" if many else ""
        leg_is = (
            f"stretch {leg.number}{where} ({leg.from_s:g} to {leg.until_s:g} s, {leg.mode}) lasts "
            f"{count_of_scans(leg.scans)}"
        )
        pair = by_names.get((leg.before or "", leg.mode))
        if pair is not None and _too_short(leg.scans, pair.delay):
            yield (f"{leg_is}; noticing the switch from {leg.before} {error} {_needed(pair.delay)}")
        # The first has no switch; later ones may yet be too short to be told from scratch.
        others = [p for p in known.pairs if p.old.name == leg.mode]
        slow = [p for p in others if _too_short(leg.scans, p.horizon)]
        if slow and (pair is None or not _too_short(leg.scans, pair.delay)):
            worst = max(slow, key=lambda p: sortable(p.horizon.exact))
            how = "" if leg.before is None else " without knowing the state"
            yield (
                f"{leg_is}; telling {leg.mode} from {worst.new.name}{how} {error} "
                f"{_needed(worst.horizon)}"
            )
    yield from _warnings_of_chain(experiment, by_names, error)


def _warnings_of_chain(
    experiment: Experiment, by_names: dict[tuple[str, str], PairOfModes], error: str
) -> Iterator[str]:
    truth = experiment.cases[0].truth
    if not isinstance(truth, ChainTruth):
        return
    matrix, steps = _steps_in_modes(truth, experiment)
    names = truth.bank.names
    for j, name in enumerate(names):
        entered = [
            by_names[old, name]
            for i, old in enumerate(names)
            if i != j and matrix[i, j] > 0.0 and (old, name) in by_names
        ]
        slow = [pair for pair in entered if _too_short(steps[j], pair.delay)]
        if slow:
            worst = max(slow, key=lambda p: sortable(p.delay.exact))
            yield (
                f"{name} lasts {steps[j]:.3g} scans on average; noticing a switch to it from "
                f"{worst.old.name} {error} {_needed(worst.delay)}"
            )


def _too_short(scans: float, needed: Horizon) -> bool:
    """Whether so many scans are known to be too few."""
    return scans <= needed.looked_at if needed.exact is None else scans < needed.exact


def sortable(scans: float | None) -> float:
    """Not within the scans looked at is more than any."""
    return math.inf if scans is None else scans


def _needed(needed: Horizon) -> str:
    if needed.exact is None:
        return f"needs more than {needed.because.removeprefix('not within ')}"
    if math.isinf(needed.exact):
        return f"never succeeds: {needed.because}"
    return f"needs {needed.exact:.0f}"


def count_of_scans(number: float) -> str:
    return f"{number:.0f} scan" + ("" if number == 1 else "s")
