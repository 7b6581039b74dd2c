"""The sojourn analysis in sentences: what to do about it, and what was assumed."""

import math
from collections.abc import Sequence

import numpy as np

from hybridtrack.analyses._sojourn_bounds import state_effects
from hybridtrack.analyses._sojourn_numbers import as_set, number
from hybridtrack.analyses._sojourn_study import Study

GROWS = 1.0 + 1e-9  # a growth up to this is none but for rounding
SAME = 1e-9  # relative: two norms that differ by less differ by rounding


def conclusions(study: Study) -> list[str]:
    """What to do about it, in one to four sentences."""
    return [
        _headline(study),
        *_in_the_scenario(study),
        *_between(study),
        *_condition_1_sentence(study),
    ]


def _headline(study: Study) -> str:
    sojourn, step_s = study.direct_sojourn, study.step_s
    if not math.isfinite(sojourn):
        smallest = study.direct.delay_error or 0.0
        at_decay = study.direct.error_bound_at_decay or 0.0
        delay = f"{study.delay_steps} {plural('step', study.delay_steps)}"
        return (
            f"No sojourn is long enough: a decision delay of {delay} adds up to "
            f"{number(smallest, study.error_bound)} to the error at every switch, and error_bound "
            f"is {as_set(study.error_bound)}; it has to be above "
            f"{number(smallest, study.error_bound)}, and {number(at_decay, smallest)} "
            "costs no longer sojourn than the decay does."
        )
    kept = f", down to the error bound of {number(study.error_bound)}" if study.error_bound else ""
    if len(study.names) == 1:
        return (
            f"There is one mode, so nothing switches; its filter's mean error is below "
            f"{as_set(study.rate)}^t from {sojourn:.0f} {plural('step', sojourn)} "
            f"({number(sojourn * step_s)} s) on."
        )
    return (
        f"Every mode must last at least {sojourn:.0f} {plural('step', sojourn)} "
        f"({number(sojourn * step_s)} s) for the mean error to shrink by the factor "
        f"{as_set(study.rate)} per step from switch to switch{kept}; the paper's bound "
        f"{_asks(study.rate_correct_sojourn, step_s)} once corrected, and "
        f"{_asks(study.printed_sojourn, step_s)} as printed."
    )


def _asks(steps: float, step_s: float) -> str:
    if not math.isfinite(steps):
        return "can't be met"
    return f"asks for {steps:.0f} ({number(steps * step_s)} s)"


def plural(word: str, number: float) -> str:
    """The word as it goes with the number."""
    return word if number == 1 else f"{word}s"


def _in_the_scenario(study: Study) -> list[str]:
    if not math.isfinite(study.direct_sojourn) or len(study.names) == 1:
        return []
    found = ""
    if study.flown is not None:
        mode, steps = study.flown
        found = (
            f"The flight's shortest stay, in '{mode}', lasts {steps} {plural('step', steps)}, "
            f"{'long enough' if steps >= study.direct_sojourn else 'too short'}; "
        )
    short = study.too_short_probability
    worst = int(np.argmax(short))
    by_chain = (
        f"by the transition matrix {100 * short[worst]:.3g} % of the stays in "
        f"'{study.names[worst]}' are shorter than that."
        if short[worst] > 0
        else "by the transition matrix no stay is shorter than that."
    )
    return [found + by_chain if found else by_chain[0].upper() + by_chain[1:]]


def _between(study: Study) -> list[str]:
    worst = int(np.argmax(study.direct.growth))
    growth = study.direct.growth[worst]
    if growth <= GROWS:
        return []
    if len(study.names) == 1:
        return [f"Before that it may grow to {number(growth, 1.0)} times that."]
    return [
        f"Between switches the mean error may grow to {number(growth, 1.0)} times what it shall "
        f"be, in '{study.names[worst]}', before it shrinks: leave room for that."
    ]


def _condition_1_sentence(study: Study) -> list[str]:
    told = study.observability
    if told.met or len(study.names) == 1:
        return []
    lemma = []
    if told.covariance_steps is None:
        why = "a state never shows"
        if told.same_covariances:
            why = f"the outputs of {pairs(told.same_covariances)} never differ"
        lemma.append(f"Lemma 2 ({why})")
    if told.unseen_switches:
        lemma.append("Lemma 3 (the output at a switch has one covariance before and after)")
    holds = (
        f"; Lemma 2 holds after {told.covariance_steps} outputs"
        if told.covariance_steps is not None
        else ""
    )
    return [
        f"Condition 1 isn't met, by the paper's own {' and '.join(lemma)}{holds}; the bound is "
        "for a mode decision that is right after the delay, however it is reached."
    ]


def notes(study: Study) -> list[str]:
    """What is printed wrongly, and what was assumed."""
    found = [
        "eq. 41 as printed waits until k alpha^t is 1; for the error to shrink at mu it has to be "
        "mu^t: ln k / ln(mu/alpha), not ln k / |ln alpha|",
        "the first term of eq. 41 as printed is negative for every M0 above b, so it never asks "
        "for anything; it is |ln(1 - b/M0)| / |ln mu| that keeps M0",
    ]
    growth = max(study.direct.growth)
    if growth > GROWS:
        found.append(
            "the paper has the error below mu^t between switches too; it is so when a switch is "
            f"noticed, and {number(growth, 1.0)} times that at most between"
        )
    if study.disturbance.printed is not None:
        largest_state = float(study.state.each[study.mismatch.counts].max(initial=0.0))
        columns, rows = state_effects(study.mismatch, largest_state)
        if not math.isclose(columns, rows, rel_tol=SAME):
            found.append(
                "U as printed takes the 1-norm, which is no bound in general; of what the states "
                f"add it is {number(columns, rows)}, and by the infinity norm "
                f"{number(rows, columns)}"
            )
    if np.any(study.mismatch.input_effect):
        found.append(
            "the modes' inputs differ; the paper's U leaves inputs out, the corrected ones don't"
        )
    if np.any(study.model.measurement_matrix != study.model.measurement_matrix[0]):
        found.append(
            "measurement matrices differ between modes; as in the paper, a mode drives the step "
            "after its measurement, where the scenario's drives the step before"
        )
    for name, one in zip(study.names, study.structures, strict=True):
        if one.largest_block > 1:
            found.append(
                f"the filter of '{name}' has a Jordan block of size {one.largest_block}: eq. 30 "
                "stands for eq. 29, and k depends on how its chains are scaled"
            )
    if study.simulated:
        more = round(study.direct.steps) - 1
        found.append(
            f"simulated sojourns last from their smallest to {more} {plural('step', more)} more, "
            "all equally likely"
            if more
            else "simulated sojourns last as long as their smallest"
        )
        if study.error_bound and study.delay_steps:
            found.append(
                "every second simulated run starts without an error, which holds M0 against what "
                f"the delay leaves, the others at 10 M0 ({number(10 * study.error_bound)})"
            )
    return [*found, *study.notes]


def listed(names: Sequence[str]) -> str:
    """Names as a sentence has them: a, b and c."""
    return " and ".join(", ".join(names).rsplit(", ", 1))


def pairs(of: Sequence[tuple[str, str]]) -> str:
    """Pairs of modes, whatever their order, the first three by name."""
    shown = [f"{a} and {b}" for a, b in dict.fromkeys(tuple(sorted(pair)) for pair in of)]
    return ", ".join(shown[:3]) + (f" and {len(shown) - 3} pairs more" if len(shown) > 3 else "")
