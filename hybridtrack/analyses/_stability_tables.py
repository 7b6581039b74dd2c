"""What was found about a bank's stability, in tables."""

import math
from typing import Any

import numpy as np

from hybridtrack.analyses._examination import Checks, Stability
from hybridtrack.analyses._findings import Table
from hybridtrack.analyses._riccati import Bound, Certificate
from hybridtrack.analyses._stability_words import (
    modes,
    near_one,
    no_rate,
    number,
    one_step_rate,
    stds,
    verdict,
)


def sequences(found: Stability) -> Table:
    figures = found.figures
    simulated = found.one_rate
    certificate = found.certificate
    certified = certificate.rate if certificate is not None else None
    short = certificate.short if certificate is not None else None
    columns: dict[str, list[Any]] = {
        "measurements": [one.measurements for one in figures],
        "sequences": [len(found.bank.modes) ** one.measurements for one in figures],
        "kappa_1": [one.kappa_1 for one in figures],
        "kappa_2": [one.kappa_2 for one in figures],
        "kappa_3": [one.kappa_3 for one in figures],
        "kappa_4": [one.kappa_4 for one in figures],
        "controllable": [one.controllable for one in figures],
        "observable": [one.observable for one in figures],
        "beta_1_printed": [one.beta_1_printed for one in figures],
        "beta_1": [one.beta_1 for one in figures],
        "upper_bound_printed": [one.upper_printed for one in figures],
        # of no one N: here because claims are held against this table
        "certified_rate_per_step": [certified] * len(figures),
        "certified_one_minus_rate": [short] * len(figures),
        "simulated_rate_per_step": [simulated] * len(figures),
    }
    shown = {"N": [str(one.measurements) for one in figures]}
    for name in ("kappa_1", "kappa_2", "kappa_3", "kappa_4"):
        shown[name] = [number(value) for value in columns[name]]
    shown["beta_1\nprinted"] = [number(value) for value in columns["beta_1_printed"]]
    shown["beta_1\nvalid"] = [number(value) for value in columns["beta_1"]]
    return Table(columns, shown)


def conditions(found: Stability) -> Table:
    """Nothing of it is shown: a note says it in a sentence."""
    asked, bank, last = found.conditions, found.bank, found.figures[-1]
    longest = asked.longest
    singular = f"A of {modes(asked.singular)} is singular" if asked.singular else ""
    rows: list[tuple[str, str, int | None, str]] = [
        ("A has an inverse in every mode", "not met" if singular else "met", None, singular)
    ]
    if asked.controllable_from is None:
        rows.append(("1: uniformly controllable", "not met", None, found.floor.why))
    else:
        rows.append(("1: uniformly controllable", "met", asked.controllable_from, ""))
    observable = "2: uniformly observable with N <= 2"
    if singular:
        rows.append(
            (observable, "not applicable", None, f"{singular}, and definition 3 inverts it")
        )
    elif asked.observable_from is None:
        assert last.unseen is not None
        mode, state = last.unseen
        why = f"up to N = {longest} nothing may be seen of {state}, such as when {mode} is last"
        rows.append((observable, "not met", None, why))
    elif asked.observable_from > 2:
        why = f"needs N = {asked.observable_from}; the paper conjectures that any N will do"
        rows.append((observable, "not met", asked.observable_from, why))
    else:
        rows.append((observable, "met", asked.observable_from, ""))
    rows.append(
        (
            "3: C and R are the same in all modes",
            "met" if asked.same_observation else "not met",
            None,
            "" if asked.same_observation else "they differ between modes",
        )
    )
    origin = "given" if found.spread_given else "taken from the simulation"
    rows.append(("(not in the paper) spread of the means bounded", "assumed", None, origin))
    missing = [name for name in bank.modes if name not in asked.driven]
    why = f"B Q B' is singular in {modes(missing)}" if missing else ""
    rows.append(("(ours) B Q B' > 0 in every mode", "not met" if missing else "met", None, why))
    names, verdicts, needs, reasons = (list(column) for column in zip(*rows, strict=True))
    return Table(
        {
            "condition": names,
            "verdict": verdicts,
            "needs_measurements": needs,
            "because": reasons,
        },
    )


def rates(found: Stability) -> Table:
    asked = found.conditions
    missing = ""
    if not asked.met:
        missing = verdict(found)
    elif found.ceiling.matrix is None:
        missing = f"no ceiling: {found.ceiling.why}"
    elif found.certificate is None:
        missing = f"no floor: {found.floor.why}"
    rows: list[tuple[Any, ...]] = []

    def certified(kind: str, one: Certificate | None) -> None:
        if one is None:
            rows.append((kind, None, None, None, None, None, True, missing))
        else:
            steps = one.time_constant_steps
            rows.append((kind, one.c_1, one.rate, one.short, None, steps, True, ""))

    certified("certified, beta_1 as printed", found.printed_certificate)
    certified("certified, beta_1 of the floor", found.certificate)
    if found.one_step_loss is None:
        undriven = [name for name in found.bank.modes if name not in asked.driven]
        reason = f"B Q B' is singular in {modes(undriven)}" if undriven else "no ceiling"
        rows.append(("one step, ours", None, None, None, None, None, True, reason))
    else:
        root, short = one_step_rate(found.one_step_loss)
        constant = _time_constant(root, short)
        rows.append(("one step, ours", None, root, short, None, constant, True, ""))
    rate = found.rate
    if rate is None or found.one_rate is None:
        rows.append(("simulated", None, None, None, None, None, False, no_rate(found)))
    else:
        rows.append(
            (
                "simulated",
                None,
                rate.per_step,
                1 - rate.per_step,
                rate.standard_error,
                _time_constant(rate.per_step, 1 - rate.per_step),
                False,
                "errors don't die away" if rate.per_step >= 1.0 else "",
            )
        )
    kinds, c_1, rates, shorts, errors, steps, conditional, why = (
        list(column) for column in zip(*rows, strict=True)
    )
    seconds = [None if value is None else value * found.step_s for value in steps]
    return Table(
        {
            "kind": kinds,
            "c_1": c_1,
            "rate_per_step": rates,
            "one_minus_rate": shorts,
            "standard_error": errors,
            "time_constant_steps": steps,
            "time_constant_s": seconds,
            "conditional_on_spread": conditional,
            "because": why,
        },
        {
            "rate": kinds,
            "c_1": [number(value) for value in c_1],
            "per step": [
                "-" if rate is None else near_one(rate, short)
                for rate, short in zip(rates, shorts, strict=True)
            ],
            "1/e after\nsteps": [number(value) for value in steps],
            "1/e after\ns": [number(value) for value in seconds],
        },
    )


def bounds(found: Stability) -> Table:
    longest = min(found.conditions.longest, len(found.run.covariances) - 1)
    simulated = stds(found.run.covariances[longest:])
    n = len(found.bank.states)

    def of(bound: Bound) -> list[float | None]:
        return [None] * n if bound.matrix is None else stds(bound.matrix).tolist()

    columns: dict[str, list[Any]] = {
        "state": list(found.bank.states),
        "floor_std": of(found.floor),
        "ceiling_std": of(found.ceiling),
        "ceiling_std_without_spread": of(found.bare_ceiling),
        "spread_std": np.sqrt(np.diag(found.spread)).tolist(),
        "simulated_smallest_std": simulated.min(axis=(0, 1)).tolist(),
        "simulated_largest_std": simulated.max(axis=(0, 1)).tolist(),
    }
    shown = {"std of": list(found.bank.states)}
    for heading, name in {
        "floor": "floor_std",
        "smallest\nsimulated": "simulated_smallest_std",
        "largest\nsimulated": "simulated_largest_std",
        "ceiling\nif spread": "ceiling_std",
        "spread\nassumed": "spread_std",
        "ceiling,\nno spread": "ceiling_std_without_spread",
    }.items():
        shown[heading] = [number(value) for value in columns[name]]
    return Table(columns, shown)


def eigenvalues(found: Stability, checked: Checks) -> Table:
    longest = min(found.conditions.longest, len(found.run.covariances) - 1)
    values = np.linalg.eigvalsh(found.run.covariances[longest:])
    rows: list[tuple[Any, ...]] = []
    for name, bound, part, conditional in (
        ("floor", found.floor, checked.floor, False),
        ("ceiling given the spread", found.ceiling, checked.ceiling, True),
        ("ceiling without spread", found.bare_ceiling, checked.bare_ceiling, True),
    ):
        smallest = largest = from_step = None
        if bound.matrix is not None:
            eigenvalues = np.linalg.eigvalsh(bound.matrix)
            smallest, largest = float(eigenvalues[0]), float(eigenvalues[-1])
            from_step = bound.from_step
        rows.append((name, smallest, largest, from_step, *part, part.share, conditional, bound.why))
    smallest, largest = max(float(values[..., 0].min()), 0.0), float(values[..., -1].max())
    rows.append(("simulated", smallest, largest, None, 0, 0, None, None, False, ""))
    names, smallest_, largest_, first, steps, broken, first_broken, share, conditional_, why = (
        list(column) for column in zip(*rows, strict=True)
    )
    return Table(
        {
            "bound": names,
            "smallest_eigenvalue": smallest_,
            "largest_eigenvalue": largest_,
            "bound_from_step": first,
            "steps_checked": steps,
            "steps_broken": broken,
            "first_step_broken": first_broken,
            "share_broken": share,
            "conditional_on_spread": conditional_,
            "because": why,
        },
        {
            "P_j(k|k)": [
                "floor (smallest: beta_1)",
                "ceiling if spread (largest: beta_2)",
                "ceiling, no spread",
                f"simulated, from step {longest}",
            ],
            "smallest\neigenvalue": [number(value) for value in smallest_],
            "largest\neigenvalue": [number(value) for value in largest_],
            "broken at\n% of steps": [
                "-" if value is None else f"{100 * value:.4g}" for value in share
            ],
        },
    )


def constants(found: Stability) -> Table:
    """The betas and c_1; None where the theorem doesn't get so far.

    Nothing of it is shown: beta_1 and beta_2 are among the eigenvalues, and a note has the others.
    """
    one, printed = found.certificate, found.printed_certificate
    first = next((figures for figures in found.figures if figures.controllable), None)
    high, low = found.ceiling.matrix, found.floor.matrix
    rows: list[tuple[str, float | None, bool, str]] = [
        (
            "beta_1 as printed",
            first.beta_1_printed if first else None,
            False,
            "kappa_1 / (1 + kappa_1 kappa_4), first N that is controllable; no bound in general",
        ),
        (
            "beta_1",
            first.beta_1 if first else None,
            False,
            "smallest eigenvalue of the Riccati map from 0, the same N",
        ),
        (
            "beta_1 of the floor",
            None if low is None else float(np.linalg.eigvalsh(low)[0]),
            False,
            "smallest eigenvalue of the floor",
        ),
        (
            "beta_2",
            None if high is None else float(np.linalg.eigvalsh(high)[-1]),
            True,
            "largest eigenvalue of the ceiling",
        ),
    ]
    some = one or printed
    rows += [
        ("beta_3", some.beta_3 if some else None, True, "P_j(k|k-1) <= beta_3 I, by the ceiling"),
        ("beta_4", some.beta_4 if some else None, True, "by beta_3"),
        ("beta_5", some.beta_5 if some else None, True, "min(beta_4 xi_3, 1)"),
        ("c_1 as printed", printed.c_1 if printed else None, True, "with beta_1 as printed"),
        ("c_1", one.c_1 if one else None, True, "beta_1 beta_5 kappa_3, beta_1 of the floor"),
        (
            "1 - rho",
            found.one_step_loss,
            True,
            "ours: what the Lyapunov function loses in one step where B Q B' > 0",
        ),
    ]
    names, values, conditional, sources = (list(column) for column in zip(*rows, strict=True))
    return Table(
        {
            "constant": names,
            "value": values,
            "conditional_on_spread": conditional,
            "from": sources,
        },
    )


def over_time(found: Stability) -> Table:
    """Nothing of it is shown: it is as long as the simulation."""
    values = np.linalg.eigvalsh(found.run.covariances)
    steps = np.arange(len(values))
    return Table(
        {
            "step": steps.tolist(),
            "time_s": (steps * found.step_s).tolist(),
            "smallest_eigenvalue": values[..., 0].min(axis=1).clip(0.0).tolist(),
            "largest_eigenvalue": values[..., -1].max(axis=1).tolist(),
            "log10_error_norm": (found.logs / math.log(10)).tolist(),
        }
    )


def _time_constant(rate: float, short: float) -> float:
    """Steps in which a rate of 1 - short takes errors to 1/e; 0 where at once, inf where never."""
    if short <= 0.0:
        return math.inf
    return 0.0 if rate == 0.0 else -1 / math.log1p(-short)
