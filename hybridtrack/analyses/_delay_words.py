"""The analysis of delays in words: its table, its conclusions, and what is wrong in print."""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]

NOTES = (
    "bounds are for filters in steady state that run alone; an IMM mixes, so for it they are right "
    "at the first step only; no: never satisfied, –: a premise fails (table.csv says which)",
    "(14) and after print 2 ln |S_i|/|S_T|: the density needs |S|^(-1/2), so it is ln",
    "(18) bounds the wrong filter's residual by the least singular values of wide matrices; the "
    "greatest lower bound is 0, and 0 is taken",
    "condition 2 of proposition 4.2 needs sigma_min(F_i) > sigma_max(F_T), or its inequality turns "
    "round; it also drops the cross term of ||a + b||^2",
    "condition 1 of proposition 4.2 is a prediction with beta at the switch; with the mode "
    "probabilities after it, it holds once the mode was noticed (..._along)",
    "proposition 4.4 needs P(T next | j now)/P(j next | j now): row j here, the transpose as "
    "printed; and its errors are those at k_l, not at k_l - 1",
    "tuning_concordance: 1 where a smaller first term of (21) always comes with a shorter delay, "
    "-1 with a longer one, over noises of a quarter to four times (tuning.parquet)",
)


def steps(delay: float | None) -> str:
    """A delay in words of a table."""
    if delay is None or math.isnan(delay):
        return ""
    return "never" if math.isinf(delay) else f"{delay:.0f}"


def measured_delay(row: Row) -> float | None:
    """Of the run-averaged mode estimate; the runs' median where each has its own switches."""
    averaged: float | None = row["averaged_delay_steps"]
    median: float | None = row["median_delay_steps"]
    return median if averaged is None else averaged


def _measured(row: Row) -> str:
    averaged = row["averaged_delay_steps"]
    if averaged is None:
        mean, error = row["detection_delay_steps"], row["detection_delay_steps_standard_error"]
        if mean is None:
            return "no switch"
        spread = "" if math.isnan(mean) else f", mean {mean:.2f}±{error:.2f}"
        return f"{steps(row['median_delay_steps'])}{spread}"
    low, high = row["averaged_delay_steps_low"], row["averaged_delay_steps_high"]
    return steps(averaged) + (f" ({steps(low)} to {steps(high)})" if low != high else "")


def name(row: Row, several_cases: bool = False) -> str:
    """A switch as a table names it."""
    modes = f"{row['from_mode']} to {row['to_mode']}"
    case = f"{row['case']}: " * several_cases
    if row["switch"] is None:
        return case + modes
    return f"{case}{row['switch']}: {modes}, {row['time_s']:g} s"


def shown(rows: Sequence[Row]) -> dict[str, list[str]]:
    """What a terminal shows; the first of a switch's rows names it."""
    several = len({row["case"] for row in rows}) > 1
    names = [name(row, several) for row in rows]
    cells = {
        "switch": [n if i == 0 or n != names[i - 1] else "" for i, n in enumerate(names)],
        "estimator": [row["estimator"] for row in rows],
        "delay,\nsteps": [_measured(row) for row in rows],
        "pre-\ndicted": [steps(row["mean_trajectory_delay_steps"]) for row in rows],
    }
    for heading, key in (
        ("4.1", "proposition_4_1"),
        ("4.2\n(1)", "proposition_4_2_condition_1"),
        ("4.2\n(2)", "proposition_4_2_condition_2"),
        ("4.3", "proposition_4_3"),
        ("4.4", "proposition_4_4"),
    ):
        cells[heading] = [_bound(row, key) for row in rows]
    return cells


def _bound(row: Row, key: str) -> str:
    if row[f"{key}_result"] is None:
        return ""
    delay = row[f"{key}_delay_steps"]
    return "–" if delay is None else "no" if math.isinf(delay) else f"{delay:.0f}"


# ---- conclusions -----------------------------------------------------------------------------


def conclusions(rows: Sequence[Row], pairs: Sequence[Row], runs: int) -> list[str]:
    """What a practitioner should conclude, in whole sentences."""
    said = _who_notices(rows, runs)
    said += _how_predicted(rows)
    said += _which_direction(rows, pairs)
    said += _what_is_promised(rows)
    alike = [p for p in pairs if p.get("means_indistinguishable")]
    if alike:
        named = ", ".join(f"{p['from_mode']} to {p['to_mode']}" for p in alike)
        said.append(
            "These modes have the same mean, so that a switch shows in the noise alone and no mean "
            f"trajectory tells of it: {named}."
        )
    return said


def _by_estimator(rows: Sequence[Row]) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row["estimator"], []).append(row)
    return found


def _who_notices(rows: Sequence[Row], runs: int) -> list[str]:
    parts, totals = [], {}
    for estimator, own in _by_estimator(rows).items():
        delays = [d for row in own if (d := measured_delay(row)) is not None]
        noticed = [d for d in delays if math.isfinite(d)]
        never = len(delays) - len(noticed)
        if not delays:
            continue
        words = f"{estimator} in "
        words += "no" if not noticed else _range(noticed)
        words += " step" if noticed and max(noticed) == 1 else " steps"
        words += f" and {never} of {len(delays)} never" * bool(never)
        parts.append(words)
        totals[estimator] = sum(math.inf if math.isinf(d) else d for d in delays)
    if not parts:
        return ["No switch happened in any run, so nothing was measured."]
    count = len({(row["case"], row["switch"], row["from_mode"], row["to_mode"]) for row in rows})
    kind = "kinds of switches" if rows[0]["switch"] is None else "switches"
    sentence = f"Over {runs:,} runs and {count} {kind}, a switch is noticed by {', '.join(parts)}."
    best = min(totals, key=lambda label: totals[label])
    alone = [label for label, total in totals.items() if total == totals[best]]
    if len(totals) > 1 and len(alone) == 1:
        sentence += f" {best} is the soonest."
    return [sentence]


def _range(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.0f}" if low == high else f"{low:.0f} to {high:.0f}"


def _how_predicted(rows: Sequence[Row]) -> list[str]:
    held = [
        (row["mean_trajectory_delay_steps"], delay)
        for row in rows
        if (delay := measured_delay(row)) is not None
        and not math.isnan(delay)
        and not math.isnan(row["mean_trajectory_delay_steps"])
    ]
    if not held:
        return []
    exact = sum(one == other for one, other in held)
    close = sum(one == other or abs(one - other) <= 1 for one, other in held)
    return [
        f"Measurements without noise predict {exact} of {len(held)} delays exactly and {close} "
        "within one step."
    ]


def _which_direction(rows: Sequence[Row], pairs: Sequence[Row]) -> list[str]:
    """By the first term, and whether the measured delays agree."""
    said = []
    terms = {(p["from_mode"], p["to_mode"]): p.get("first_term") for p in pairs}
    for (a, b), term in terms.items():
        back = terms.get((b, a))
        if term is None or back is None or not term < back:
            continue
        delays = {
            modes: [
                d
                for row in rows
                if (row["from_mode"], row["to_mode"]) == modes
                and (d := measured_delay(row)) is not None
            ]
            for modes in ((a, b), (b, a))
        }
        sentence = (
            f"By the residual covariances {a} to {b} is easier to notice than {b} to {a} (first "
            f"term of eq. 21: {term:.3g} against {back:.3g})"
        )
        there, other = (delays[m] for m in ((a, b), (b, a)))
        if there and other:
            one, two = (statistics.median(part) for part in (there, other))
            agree = "as" if one < two else "but not as"
            words = "never" if math.isinf(one) else f"{one:.3g}"
            others = "never" if math.isinf(two) else f"{two:.3g}"
            sentence += f", {agree} measured: {words} against {others} steps"
            sentence += " (medians over estimators and switches)"
        said.append(sentence + ".")
    return said[:3]


def _what_is_promised(rows: Sequence[Row]) -> list[str]:
    names = ("4_2_condition_1", "4_2_condition_2", "4_3", "4_4")
    bounded = [row for row in rows if row["proposition_4_1_result"] is not None]
    promised = [
        row
        for row in bounded
        if any((row[f"proposition_{n}_delay_steps"] or math.inf) < math.inf for n in names)
    ]
    if not bounded:
        return []
    if not promised:
        return ["None of the propositions 4.2 to 4.4 promises that any of these is noticed at all."]
    return [
        f"Propositions 4.2 to 4.4 promise a delay for {len(promised)} of {len(bounded)} of these."
    ]
