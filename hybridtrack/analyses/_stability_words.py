"""What was found about a bank's stability, in sentences."""

import math
from collections.abc import Sequence

import numpy as np

from hybridtrack.analyses._examination import Checks, Held, Stability
from hybridtrack.models import Array

PRINTED = (
    "lemma 1 (Deyst and Price) is no bound in general: in one test of 2,000 time-invariant "
    "two-state systems, with normal entries of A, B and C, R = 1 and N = 2, some 9 % violated the "
    "lower bound, and as many the upper; other ensembles give 5 to 16 %. The two are computed as "
    "printed under beta_1_printed and upper_bound_printed, and used for nothing but the rate so "
    "labelled",
    "definition 3 is printed with N + 1 terms and measurements at i + 1; N here counts "
    "measurements, as section III-C needs it: N = 2 are those at k and k - 1",
    "lemma 5 takes the spread of the modes' means, Q^e (eq. 32), as bounded, and nothing in the "
    "paper bounds it; so the ceiling, beta_2 to beta_5, c_1 and the certified rates hold only as "
    "long as the spread does",
    "section III-C prints A^-T C' R^-1 C A^-1 where beta_4 and 1 / xi_3 first come in, and both "
    "times it must be A^-T C' C A^-1; beta_5 = min(beta_4 xi_3, 1) is right all the same",
    "stability is that of the homogeneous errors (18); the mismatch phi(k) of a filter whose mode "
    "is not the true one drives them all the time and isn't covered",
)


USELESS = 1_000  # times the simulated time constant


def number(value: float | None) -> str:
    """Four digits, or a dash where there is nothing to say."""
    return "-" if value is None else f"{value:.4g}"


def near_one(rate: float, short: float) -> str:
    """A rate so near 1 that its digits don't tell, as 1 less what it is short of it."""
    return f"1 - {short:.2g}" if 0.0 < short < 1e-3 else f"{rate:.4g}"


def _duration(seconds: float) -> str:
    """A time that may be years."""
    for unit, length in (("years", 365.25 * 86400), ("days", 86400), ("hours", 3600)):
        if seconds > 2 * length:
            return f"{seconds / length:.2g} {unit}"
    return f"{seconds:.3g} s"


def _share(part: Held) -> str:
    assert part.share is not None
    return f"{100 * part.share:.4g} % of {_steps(part.checked)}"


def _steps(n: int) -> str:
    return "1 step" if n == 1 else f"{n:,} steps"


def listed(names: Sequence[str]) -> str:
    """a, b and c."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def modes(names: Sequence[str]) -> str:
    """mode a; modes a and b."""
    return f"mode{'s' if len(names) > 1 else ''} {listed(names)}"


def _spread_words(found: Stability) -> str:
    """Each state's spread, and where it is from."""
    origin = "given" if found.spread_given else "the simulation shows no more"
    return f"{_each(found.bank.states, found.spread)} ({origin})"


def verdict(found: Stability) -> str:
    """What the theorem says of the bank, in a sentence without its end."""
    asked = found.conditions
    if asked.singular:
        return f"theorem not applicable: A of {modes(asked.singular)} is singular"
    if asked.met:
        return (
            "conditions met: errors die away exponentially, if the spread of the modes' means is "
            "bounded"
        )
    unmet = []
    if asked.controllable_from is None:
        unmet.append(f"condition 1 not met (not controllable up to N = {asked.longest})")
    if not asked.same_observation:
        unmet.append("condition 3 not met (C and R differ between modes)")
    if asked.observable_from is None:
        unmet.append(f"condition 2 not met (not observable up to N = {asked.longest})")
    elif asked.observable_from > 2:
        need = f"condition 2 not met (needs N = {asked.observable_from})"
        if not unmet:
            return f"{need}: the paper conjectures stability"
        unmet.append(need)
    return f"{listed(unmet)}: the theorem says nothing"


def _simulated_words(found: Stability) -> str:
    steps = len(found.logs) - 1
    rate = found.rate
    missing = no_rate(found)
    if rate is None or missing:
        return missing
    if rate.per_step == 0.0:
        return "in the simulation nothing is left of the first errors, to double precision"
    short = 1 - rate.per_step
    error = "" if rate.standard_error is None else f" (standard error {rate.standard_error:.1g})"
    words = f"simulated rate {near_one(rate.per_step, short)}{error} per step over {steps:,} steps"
    if rate.per_step < 1.0:
        constant = -1 / math.log(rate.per_step)
        return (
            f"{words}, so that a wrong start is forgotten with a time constant of "
            f"{constant:.3g} steps ({constant * found.step_s:.3g} s)"
        )
    return f"{words}: errors don't die away"


def no_rate(found: Stability) -> str:
    """Why the simulation shows no rate, in a clause; empty where it shows one."""
    if found.one_rate is not None:
        return ""
    steps, rate = len(found.logs) - 1, found.rate
    if rate is None:
        return "nothing could be simulated"
    if found.ended_early:
        return (
            f"the simulation ends after {steps:,} of its {found.steps_asked:,} steps, too short "
            "for a rate"
        )
    if rate.standard_error is None:
        return f"the simulation of {steps:,} steps is too short for a rate"
    earlier, later = rate.halves
    if later >= 0.0:
        return "in the simulation's later half errors don't die away, and there is no one rate"
    if earlier >= 0.0:
        return "in the simulation errors die away in the later half only: no rate"
    if rate.trend == "rising":
        return "in the simulation errors die away, but slower and slower: no rate"
    return "in the simulation errors die away faster and faster: no rate"


def _certified_words(found: Stability, checked: Checks) -> str | None:
    one = found.certificate
    parts = []
    if one is not None:
        steps = one.time_constant_steps
        useless, times = "", ""
        if found.one_rate is not None and 0.0 < found.one_rate < 1.0:
            ratio = -steps * math.log(found.one_rate)
            if ratio > USELESS:
                useless = ", valid and useless"
            else:
                times = f", {ratio:.3g} times the simulated one"
        parts.append(
            f"the theorem certifies {near_one(one.rate, one.short)} per step{useless}: its time "
            f"constant is {_duration(steps * found.step_s)}{times}"
        )
    if found.one_step_loss is not None:
        parts.append(
            "our own one-step bound, for B Q B' > 0, certifies "
            f"{near_one(*one_step_rate(found.one_step_loss))} per step"
        )
    if not parts:
        return None
    rest = "both rest" if len(parts) > 1 else "this rests"
    sentence = "; ".join(parts)
    return (
        f"{sentence[0].upper()}{sentence[1:]}; {rest} on the spread of the means"
        f"{_exceeded(found, checked)}."
    )


def _exceeded(found: Stability, checked: Checks) -> str:
    """A clause about a spread that is given, and that the simulation shows to be too small."""
    part = checked.spread
    return f", which the simulation exceeded at {_share(part)}" if part.broken else ""


def conclusions(found: Stability, checked: Checks) -> tuple[str, ...]:
    """The verdict and the rates, what is certified, the bounds, and what they hang on."""
    sentences = [f"{verdict(found)[0].upper()}{verdict(found)[1:]}; {_simulated_words(found)}."]
    certified = _certified_words(found, checked)
    if certified is not None:
        sentences.append(certified)
    sentences.append(_bounds_words(found, checked))
    if checked.bare_ceiling.checked and found.spread.any():
        sentences.append(
            "Without the spread of the modes' means, which the paper nowhere bounds, the ceiling "
            + (
                f"is exceeded at {_share(checked.bare_ceiling)}."
                if checked.bare_ceiling.broken
                else f"holds here too, at all of {_steps(checked.bare_ceiling.checked)}."
            )
        )
    return tuple(sentences)


def _bounds_words(found: Stability, checked: Checks) -> str:
    low, high = found.floor.matrix, found.ceiling.matrix
    states = found.bank.states
    if low is None and high is None:
        return f"There is no floor ({found.floor.why}) and no ceiling ({found.ceiling.why})."
    if high is None:
        assert low is not None
        figures = _each(states, low)
        return (
            f"From step {found.floor.from_step} on no filter's standard deviations fall below "
            f"{figures}; there is no ceiling: {found.ceiling.why}."
        )
    given = (
        f"as long as the spread of the modes' means is at most {_spread_words(found)}"
        f"{_exceeded(found, checked)}"
    )
    if low is None:
        return (
            f"From step {found.ceiling.from_step} on no filter's standard deviations rise above "
            f"{_each(states, high)}, {given}; there is no floor: {found.floor.why}."
        )
    parts = [
        f"{name} {a:.3g} to {b:.3g}"
        for name, a, b in zip(states, stds(low), stds(high), strict=True)
    ]
    start = max(found.floor.from_step, found.ceiling.from_step)
    return (
        f"From step {start} on every filter's standard deviations live in {listed(parts)}; the "
        f"upper ones {given}."
    )


def _each(states: Sequence[str], covariance: Array) -> str:
    return listed([f"{name} {std:.3g}" for name, std in zip(states, stds(covariance), strict=True)])


def stds(covariance: Array) -> Array:
    """Standard deviations (..., n_x) of covariances (..., n_x, n_x)."""
    return np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))


def one_step_rate(loss: float) -> tuple[float, float]:
    """sqrt(rho), and what it is short of 1 with all its digits, from 1 - rho."""
    root = math.sqrt(1 - loss)
    return root, loss / (1 + root)


def _conditions_words(found: Stability) -> str:
    """Each condition with its verdict, whatever the others are."""
    asked = found.conditions
    parts = [
        "1 (controllable) "
        + ("not met" if asked.controllable_from is None else f"met, N = {asked.controllable_from}")
    ]
    if asked.singular:
        second = f"not applicable, A of {modes(asked.singular)} is singular"
    elif asked.observable_from is None:
        second = f"not met up to N = {asked.longest}"
    elif asked.observable_from > 2:
        second = f"not met, needs N = {asked.observable_from}"
    else:
        second = f"met, N = {asked.observable_from}"
    parts.append(f"2 (observable with N <= 2) {second}")
    third = "met" if asked.same_observation else "not met"
    parts.append(f"3 (the same C and R in all modes) {third}")
    return f"conditions: {'; '.join(parts)}"


def _constants_words(found: Stability) -> list[str]:
    if found.ceiling.matrix is None:
        return []
    beta_2 = float(np.linalg.eigvalsh(found.ceiling.matrix)[-1])
    words = f"constants, as long as the spread of the means is no larger: beta_2 {beta_2:.4g}"
    one, printed = found.certificate, found.printed_certificate
    if one is not None and printed is not None:
        words += (
            f", beta_3 {one.beta_3:.4g}, beta_4 {one.beta_4:.4g}, beta_5 {one.beta_5:.4g}; c_1 "
            f"{one.c_1:.4g} with beta_1 {one.beta_1:.4g} of the floor, {printed.c_1:.4g} with "
            f"{printed.beta_1:.4g} as printed"
        )
    return [words]


def notes(found: Stability, checked: Checks) -> tuple[str, ...]:
    """What the simulation and the iterations have to say for themselves."""
    steps = len(found.run.mixing)
    said = [
        _conditions_words(found),
        *_constants_words(found),
        f"simulated: {steps:,} steps of a flight drawn from the bank's own chain, start and "
        "noises; eigenvalues mix the states' units, as the paper's do",
    ]
    if found.ended_early:
        said.append(
            f"the simulation ends before its {found.steps_asked:,} steps, since a state or a "
            "covariance gets too large (1e12)"
        )
    low, high = found.floor, found.ceiling
    if low.matrix is not None:
        part = checked.floor
        if part.broken:
            said.append(
                f"the settled floor didn't hold at {_share(part)} from N = "
                f"{found.conditions.longest} on, first at step {part.first_broken}; it is a bound "
                f"from step {low.from_step} on"
            )
        elif part.checked:
            said.append(
                f"the floor held at all of {_steps(part.checked)} from N = "
                f"{found.conditions.longest} on"
            )
        else:
            said.append(
                f"the floor isn't checked from N = {found.conditions.longest} on: the simulation "
                f"has only {steps:,} steps"
            )
        if checked.floor_in_time.broken:
            said.append(
                f"the floor due at each step was broken at {_share(checked.floor_in_time)}, which "
                "rounding alone can do: the bank's figures are too far apart for double precision"
            )
    bare = found.bare_ceiling
    if bare.matrix is not None and not checked.bare_ceiling.checked and found.spread.any():
        said.append(
            f"the ceiling without spread, due from step {bare.from_step:,} on, isn't checked: the "
            f"simulation has only {steps:,} steps"
        )
    for name, bound in (("floor", low), ("ceiling", high)):
        if bound.matrix is not None and bound.why:
            said.append(f"the {name} is valid, but {bound.why}")
    if found.spread_given:
        broken = checked.spread
        said.append(
            f"in the simulation the spread of the means exceeded what is given at {_share(broken)}"
            if broken.broken
            else "in the simulation the spread of the means never exceeded what is given"
        )
    else:
        said.append(
            "the spread is the smallest multiple of the states' largest spreads in the simulation "
            "that bounds their matrix; another flight may exceed it (give 'spread_std' to fix it)"
        )
    if checked.ceiling.broken:
        said.append(f"the ceiling given the spread was exceeded at {_share(checked.ceiling)}")
    if found.one_step_loss is not None:
        said.append(
            "the one-step factor is ours, not the paper's: rho = max_j lambda_max(A X A' (A X A' + "
            "B Q B')^-1) with the ceiling X; it needs neither N <= 2 nor common C and R"
        )
    return (*said, *PRINTED)
