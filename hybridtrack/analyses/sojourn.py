"""How long a mode must last for the filters' mean error to shrink from switch to switch.

After a switch the wrong filter is at work until the switch is noticed, and even the right one may
let the error grow before it shrinks. Hwang, Balakrishnan and Tomlin 2003 bound the time between
switches by which that is paid back (section 3, Theorem 3); their bound is here as printed and as
its proof has it, beside what the powers of the filters' own matrices say.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np

from hybridtrack.analyses import Analysis, Findings, Measured, model_at_one_step
from hybridtrack.analyses._eigenstructure import Eigenstructure, eigenstructure
from hybridtrack.analyses._predictor_filters import predictor_filters
from hybridtrack.analyses._sojourn_bounds import (
    DirectBound,
    Mismatch,
    StateBound,
    delay_errors,
    direct_bound,
    disturbance_bounds,
    mismatch,
    printed_bound,
    rate_correct_bound,
)
from hybridtrack.analyses._sojourn_charts import charts
from hybridtrack.analyses._sojourn_numbers import as_set, number
from hybridtrack.analyses._sojourn_observability import joint_observability
from hybridtrack.analyses._sojourn_study import Study
from hybridtrack.analyses._sojourn_tables import (
    bounds_table,
    conditions_table,
    modes_table,
    simulation_table,
)
from hybridtrack.analyses._sojourn_words import conclusions, listed, notes, plural
from hybridtrack.analyses._switching_runs import (
    MOST_CELLS,
    Claimed,
    SwitchingRuns,
    switching_runs,
    whole_numbers,
)
from hybridtrack.description import Experiment
from hybridtrack.errors import Unsuited
from hybridtrack.jumps import ChainTruth
from hybridtrack.models import Array, JumpMarkovModel
from hybridtrack.simulation import FixedTruth

MOST_SOJOURNS_TRIED = 6
SOJOURNS_LONG = 20  # how many of them a simulated run lasts, unless its length is given
LONGEST_RUN_STEPS = 5000  # unless its length is given
FADED = 1e-200  # what mu^t may come down to in a simulated run
STREAM = 0x50  # of the simulation, apart from those of the scenario's runs


class Settings(NamedTuple):
    """What the error shall do, and what may stand in its way.

    convergence_rate: mu, the factor per step at which the mean error shall shrink, above 0 and
    below 1, and above the rate at which every filter forgets;
    error_bound: M0, the paper's steady-state error bound: the norm of the mean error, over all
    states in SI units, that may remain for ever. 0 without a decision delay, with one it is asked
    for;
    decision_delay_steps: Delta, the steps that a switch may go unnoticed;
    state_bound: the largest the mean of a state may be, in SI units: one number per state, or one
    for all of them (the paper's X); by default what the scenario's flight has. A delay needs it,
    for those states whose effect differs between modes;
    state_norm_bound: the largest 2-norm of those states together, such as a speed; by default the
    flight's, if state_bound isn't given;
    simulated_runs: trajectories that switch at random, per length of sojourn;
    simulated_steps: how long they are; by default 20 sojourns, as far as memory lasts.
    """

    convergence_rate: float = 0.99
    error_bound: float | None = None
    decision_delay_steps: int = 0
    state_bound: tuple[float, ...] | None = None
    state_norm_bound: float | None = None
    simulated_runs: int = 4000
    simulated_steps: int | None = None


def _analyse(experiment: Experiment, settings: Settings, measured: Measured | None) -> Findings:
    study = sojourn_study(experiment, settings)
    return Findings(
        table=bounds_table(study),
        conclusions=conclusions(study),
        notes=notes(study),
        tables={
            "conditions": conditions_table(study),
            "modes": modes_table(study),
            **({"simulation": simulation_table(study)} if study.simulated else {}),
        },
        charts=charts(study),
    )


def sojourn_study(experiment: Experiment, settings: Settings) -> Study:
    """All figures of the analysis.

    Raises Unsuited for settings out of range, for a mode without a settled filter or one that
    forgets too slowly, and for a missing state_bound or error_bound where a delay asks for it.
    """
    rate, delay = settings.convergence_rate, settings.decision_delay_steps
    _check(settings)
    model, said = model_at_one_step(experiment)
    filters = predictor_filters(model)
    structures = tuple(eigenstructure(one.transition) for one in filters)
    _check_rate(model.mode_names, structures, rate)
    wrong = mismatch(model, filters)
    state, of_state = _state_bound(experiment, settings, model, wrong)
    disturbance = disturbance_bounds(wrong, state)
    if delay and disturbance.euclidean is None:
        unknown = [
            name
            for name, counts, largest in zip(
                model.state_names, wrong.counts, state.each, strict=True
            )
            if counts and not math.isfinite(largest)
        ]
        raise Unsuited(
            f"a decision delay needs to know how large {' and '.join(unknown)} may be; add "
            "'state_bound' under analyses.sojourn, one number in SI units for each of the states "
            f"{' '.join(model.state_names)}",
            "analyses",
            "sojourn",
            "state_bound",
        )
    transitions = np.stack([one.transition for one in filters])
    n = transitions.shape[-1]

    def direct_for(error_bound: float) -> DirectBound:
        return direct_bound(
            transitions, disturbance.euclidean, rate, error_bound, delay, model.mode_names
        )

    if settings.error_bound is None and delay:
        smallest = direct_for(math.inf)
        if smallest.delay_error:
            raise Unsuited(
                f"a decision delay of {delay} {plural('step', delay)} leaves an error for "
                "ever, and how large it may be isn't said; add 'error_bound' under "
                f"analyses.sojourn, above {number(smallest.delay_error)} "
                f"({number(smallest.error_bound_at_decay or 0.0)} costs no longer sojourn)",
                "analyses",
                "sojourn",
                "error_bound",
            )
    error_bound = settings.error_bound or 0.0
    direct = direct_for(error_bound)
    printed_errors = delay_errors(structures, disturbance.printed, n, delay)
    corrected_errors = delay_errors(structures, disturbance.infinity, n, delay)
    second_moment, of_start = _second_moment(experiment, model)
    simulated, not_simulated = _simulate(
        experiment, settings, transitions, wrong, state, direct, error_bound
    )
    return Study(
        model=model,
        rate=rate,
        error_bound=error_bound,
        delay_steps=delay,
        filters=filters,
        structures=structures,
        observability=joint_observability(model, second_moment),
        mismatch=wrong,
        state=state,
        disturbance=disturbance,
        printed=printed_bound(structures, printed_errors, rate, error_bound),
        rate_correct=rate_correct_bound(structures, corrected_errors, rate, error_bound),
        direct=direct,
        simulated=simulated,
        flown=_flown(experiment),
        notes=(*not_simulated, *said, *of_start, *of_state),
    )


def _check(settings: Settings) -> None:
    rate, delay = settings.convergence_rate, settings.decision_delay_steps
    if not 0.0 < rate < 1.0:
        raise Unsuited(
            f"'convergence_rate' is {as_set(rate)}; the factor by which an error shrinks per step "
            "lies above 0 and below 1",
            "analyses",
            "sojourn",
            "convergence_rate",
        )
    if delay != int(delay) or delay < 0:
        raise Unsuited(
            f"'decision_delay_steps' is {delay:g}; a delay is a whole number of steps, 0 or more",
            "analyses",
            "sojourn",
            "decision_delay_steps",
        )
    for name in ("error_bound", "state_norm_bound"):
        bound = getattr(settings, name)
        if bound is not None and not bound >= 0.0:
            raise Unsuited(
                f"'{name}' is {bound:g}; a bound on a norm is 0 or more",
                "analyses",
                "sojourn",
                name,
            )
    if settings.simulated_steps is not None:
        cells = settings.simulated_runs * settings.simulated_steps
        if cells > MOST_CELLS:
            raise Unsuited(
                f"{settings.simulated_runs} runs of {settings.simulated_steps} steps are {cells} "
                f"in all; lower 'simulated_runs' or 'simulated_steps' to {MOST_CELLS} or fewer",
                "analyses",
                "sojourn",
                "simulated_runs",
            )


def _check_rate(
    names: tuple[str, ...], structures: tuple[Eigenstructure, ...], rate: float
) -> None:
    slowest = max(range(len(names)), key=lambda j: structures[j].rate)
    alpha = structures[slowest].rate
    if rate <= alpha:
        raise Unsuited(
            f"mode '{names[slowest]}' decays at {number(alpha, 1.0, rate)} per step: choose "
            f"'convergence_rate' above it, and below 1 (it is {as_set(rate)})",
            "analyses",
            "sojourn",
            "convergence_rate",
        )


# ---- what the scenario says of the state -----------------------------------------------------


def _state_bound(
    experiment: Experiment, settings: Settings, model: JumpMarkovModel, wrong: Mismatch
) -> tuple[StateBound, tuple[str, ...]]:
    """As set, else what the scenario's flights have; inf where neither says anything.

    A flight that is known here and there alone has what is known of it.
    """
    names, counts = model.state_names, wrong.counts
    if settings.state_bound is not None or settings.state_norm_bound is not None:
        listed = [math.inf] if settings.state_bound is None else settings.state_bound
        given = np.array(listed, dtype=np.float64)
        if given.size not in (1, len(names)):
            raise Unsuited(
                f"'state_bound' has {given.size} numbers; give one, or one for each of the states "
                f"{' '.join(names)}",
                "analyses",
                "sojourn",
                "state_bound",
            )
        if not (given >= 0.0).all():
            raise Unsuited(
                f"'state_bound' contains {given.min():g}; the largest that a state may be is 0 or "
                "more",
                "analyses",
                "sojourn",
                "state_bound",
            )
        norm = math.inf if settings.state_norm_bound is None else settings.state_norm_bound
        return StateBound(np.minimum(np.broadcast_to(given, len(names)), norm), norm), ()
    each, norm, gaps = np.zeros(len(names)), 0.0, False
    for case in experiment.cases:
        if isinstance(case.truth, ChainTruth):
            return StateBound(np.full(len(names), math.inf), math.inf), ()
        assert isinstance(case.truth, FixedTruth)
        flown = _in_order(case.truth.state, case.truth.state_names, names, math.inf)
        unknown = np.isnan(flown)
        gaps = gaps or bool(unknown[:, counts].any())
        largest = np.where(unknown, -math.inf, np.abs(flown)).max(axis=0)
        each = np.maximum(each, np.where(unknown.all(axis=0), math.inf, largest))
        told = flown[:, counts][~unknown[:, counts].any(axis=1)]
        norm = max(norm, float(np.linalg.norm(told, axis=1).max()) if len(told) else math.inf)
    if not counts.any():
        return StateBound(each, norm), ()
    had = ", ".join(
        f"{name} {number(bound)}"
        for name, bound, count in zip(names, each, counts, strict=True)
        if count and math.isfinite(bound)
    )
    known = ", where it is known" if gaps else ""
    said = f"the states' bounds are what the flight itself has{known} ({had}, SI units)"
    return StateBound(each, norm), (said,) if had else ()


def _in_order(
    state: Array, there: tuple[str, ...], wanted: tuple[str, ...], missing: float
) -> Array:
    """The wanted columns of a state (n, len(there)), `missing` where there is none."""
    ordered = np.full((len(state), len(wanted)), missing)
    for i, name in enumerate(wanted):
        if name in there:
            ordered[:, i] = state[:, there.index(name)]
    return ordered


def _second_moment(experiment: Experiment, model: JumpMarkovModel) -> tuple[Array, tuple[str, ...]]:
    """E[x_0 x_0'] (n_x, n_x), the paper's Pi_0: of the filters' start, or where the truth's is.

    What the truth doesn't say is taken as 0, and said.
    """
    initial, names = experiment.initial, model.state_names
    if not (initial.follows_truth or initial.two_point):
        return np.outer(initial.mean, initial.mean) + initial.covariance, ()
    truth = experiment.cases[0].truth
    if isinstance(truth, ChainTruth):
        start, there = truth.initial_mean, truth.bank.state_names
    else:
        assert isinstance(truth, FixedTruth)
        start, there = truth.state[0], truth.state_names
    mean = _in_order(start[np.newaxis], there, names, math.nan)[0]
    unknown = [name for name, value in zip(names, mean, strict=True) if math.isnan(value)]
    told = "that of the truth"
    if len(experiment.cases) > 1:
        told += f" in '{experiment.cases[0].name}'"
    if len(unknown) == len(names):
        told = "taken as 0, since the truth isn't known"
    elif unknown:
        told += f", and 0 in {listed(unknown)}, of which it says nothing"
    mean = np.where(np.isnan(mean), 0.0, mean)
    said = f"for condition 1 the mean of the start is {told}"
    return np.outer(mean, mean) + initial.covariance, (said,)


def _flown(experiment: Experiment) -> tuple[str, int] | None:
    """The mode of the flight's shortest stay that ends in a switch, and its steps."""
    shortest: tuple[str, int] | None = None
    for case in experiment.cases:
        if not isinstance(case.truth, FixedTruth) or not experiment.truth_modes:
            continue
        mode = case.truth.mode[1:]
        ends = np.flatnonzero(mode[1:] != mode[:-1]) + 1
        for begin, end in itertools.pairwise((0, *ends)):
            if mode[begin] >= 0 and (shortest is None or end - begin < shortest[1]):
                shortest = experiment.truth_modes[mode[begin]], int(end - begin)
    return shortest


# ---- the simulation --------------------------------------------------------------------------


def _simulate(
    experiment: Experiment,
    settings: Settings,
    transitions: Array,
    wrong: Mismatch,
    state: StateBound,
    direct: DirectBound,
    error_bound: float,
) -> tuple[tuple[tuple[int, SwitchingRuns], ...], tuple[str, ...]]:
    """Random switching by its smallest sojourn, up to the direct bound; or else why not."""
    delay, rate = settings.decision_delay_steps, settings.convergence_rate
    if len(transitions) < 2:
        return (), ("there is one mode, and nothing to switch to: nothing is simulated",)
    if not math.isfinite(direct.steps):
        return (), ("nothing is simulated, since no sojourn is long enough",)
    longest = round(direct.steps)
    steps, why = _run_length(settings, longest + delay)
    if steps <= longest + delay:  # no run would come to a switch
        asked = f"{longest + delay} {plural('step', longest + delay)}"
        return (), (f"nothing is simulated, since a sojourn of {asked} {why}",)
    claimed = Claimed(rate, error_bound, max(direct.growth))
    # Every second run starts without an error where a delay leaves one: M0 alone is its bound then.
    start = np.full(settings.simulated_runs, 10.0 * error_bound or 1.0)
    if error_bound and delay:
        start[1::2] = 0.0
    found = []
    for sojourn in whole_numbers(longest, MOST_SOJOURNS_TRIED):
        seed = np.random.SeedSequence(experiment.seed, spawn_key=(STREAM, sojourn))
        found.append(
            (
                sojourn + delay,
                switching_runs(
                    transitions,
                    wrong,
                    state,
                    claimed,
                    sojourn_steps=sojourn + delay,
                    extra_steps=longest - 1,
                    delay_steps=delay,
                    runs=settings.simulated_runs,
                    steps=steps,
                    start=start,
                    generator=np.random.default_rng(seed),
                ),
            )
        )
    return tuple(found), ()


def _run_length(settings: Settings, sojourn: int) -> tuple[int, str]:
    """The steps of a simulated run, and what keeps it from having more."""
    runs, rate = settings.simulated_runs, settings.convergence_rate
    faded = int(math.log(FADED) / math.log(rate))
    limits = [(faded, f"outlasts the {faded} after which {as_set(rate)}^t is below {FADED:g}")]
    if settings.simulated_steps is not None:
        set_steps = settings.simulated_steps
        limits.append((set_steps, f"fills a run of {set_steps}: raise 'simulated_steps'"))
    else:
        by_memory = MOST_CELLS // runs
        limits += [
            (SOJOURNS_LONG * sojourn, ""),
            (
                LONGEST_RUN_STEPS,
                f"fills a run of {LONGEST_RUN_STEPS}, as long as one gets by itself: set "
                "'simulated_steps' to more",
            ),
            (
                by_memory,
                f"fills a run of {by_memory}, as long as {runs} can be: lower 'simulated_runs'",
            ),
        ]
    return min(limits)


ANALYSIS = Analysis(
    name="sojourn",
    summary="how long a mode must last for the mean error to shrink from switch to switch",
    source="Hwang, Balakrishnan, Tomlin 2003, section 3, Theorem 3; 2006, Theorem 4.1",
    settings=Settings,
    analyse=_analyse,
    example="sojourn_fig2a",
    limits={
        "error_bound": (0.0, None),
        "decision_delay_steps": (0, 10_000),
        "state_norm_bound": (0.0, None),
        "simulated_runs": (1, 100_000),
        "simulated_steps": (1, 1_000_000),
    },
)
