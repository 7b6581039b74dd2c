"""The sojourn analysis in sentences: what to do about it, and what was assumed."""

import math
from collections.abc import Sequence

import numpy as np

from hybridtrack.analyses._sojourn_study import Study


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
        smallest, at_decay = study.direct.delay_error, study.direct.error_bound_at_decay
        delay = f"{study.delay_steps} {plural('step', study.delay_steps)}"
        return (
            f"No sojourn is long enough: a decision delay of {delay} adds up to "
            f"{smallest:.4g} to the error at every switch, and error_bound is "
            f"{study.error_bound:.4g}; it has to be above {smallest:.4g}, and {at_decay:.4g} "
            "costs no longer sojourn than the decay does."
        )
    kept = f", down to the error bound of {study.error_bound:.4g}" if study.error_bound else ""
    if len(study.names) == 1:
        return (
            f"There is one mode, so nothing switches; its filter's mean error is below "
            f"{study.rate:g}^t from {sojourn:.0f} {plural('step', sojourn)} "
            f"({sojourn * step_s:.4g} s) on."
        )
    return (
        f"Every mode must last at least {sojourn:.0f} {plural('step', sojourn)} "
        f"({sojourn * step_s:.4g} s) for the mean error to shrink by the factor "
        f"{study.rate:g} per step from switch to switch{kept}; the paper's bound "
        f"{_asks(study.rate_correct_sojourn, step_s)} once corrected, and "
        f"{_asks(study.printed_sojourn, step_s)} as printed."
    )


def _asks(steps: float, step_s: float) -> str:
    if not math.isfinite(steps):
        return "can't be met"
    return f"asks for {steps:.0f} ({steps * step_s:.4g} s)"


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
    if growth <= 1.0 + 1e-9:
        return []
    if len(study.names) == 1:
        return [f"Before that it may grow to {growth:.4g} times that."]
    return [
        f"Between switches the mean error may grow to {growth:.4g} times what it shall be, in "
        f"'{study.names[worst]}', before it shrinks: leave room for that."
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
        "the paper has the error below mu^t between switches too; it is so when a switch is "
        f"noticed, and {max(study.direct.growth):.4g} times that at most between",
    ]
    bound = study.disturbance
    if bound.printed is not None and bound.infinity is not None and bound.printed > 0:
        found.append(
            f"U as printed takes the 1-norm, which bounds no entry of u: {bound.printed:.4g} "
            f"instead of {bound.infinity:.4g} by the infinity norm"
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
    if len(study.names) == 1:
        found.append("there is one mode, and nothing to switch to: nothing is simulated")
    elif not math.isfinite(study.direct.steps):
        found.append("nothing is simulated, since no sojourn is long enough")
    elif not study.simulated:
        found.append(
            "nothing is simulated, since a run would end before its first switch; raise "
            "'simulated_steps' or lower 'simulated_runs'"
        )
    else:
        found.append(
            "simulated sojourns last from their smallest to "
            f"{round(study.direct.steps) - 1} steps more, all equally likely"
        )
        if study.error_bound and study.delay_steps:
            found.append(
                "every second simulated run starts without an error, which holds M0 against what "
                f"the delay leaves, the others at 10 M0 ({10 * study.error_bound:.4g})"
            )
    return [*found, *study.notes]


def listed(names: Sequence[str]) -> str:
    """Names as a sentence has them: a, b and c."""
    return " and ".join(", ".join(names).rsplit(", ", 1))


def pairs(of: Sequence[tuple[str, str]]) -> str:
    """Pairs of modes, whatever their order, the first three by name."""
    shown = [f"{a} and {b}" for a, b in dict.fromkeys(tuple(sorted(pair)) for pair in of)]
    return ", ".join(shown[:3]) + (f" and {len(shown) - 3} pairs more" if len(shown) > 3 else "")
