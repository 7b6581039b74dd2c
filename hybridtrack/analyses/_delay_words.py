"""The analysis of delays in words: its table, its conclusions, and what is wrong in print."""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hybridtrack.delays import MOST_ALREADY

Row = Mapping[str, Any]

NOTES = (
    "bounds are for filters in steady state that run alone; an IMM mixes, so for it they are right "
    "at the first step only; no: never satisfied, –: a premise fails (table.csv says which)",
    f"*: in over {MOST_ALREADY:.0%} of the runs the estimate was the new mode before the switch "
    "already",
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
    "-1 with a longer one, over noises of a quarter to four times, one at a time (tuning.parquet)",
)
THIRD = "third_term_"
BOUNDS = tuple(f"proposition_4_{name}" for name in ("2", "3", "4"))


NEARLY = 0.05  # relative difference of two terms that are alike


def is_noticed(row: Row) -> bool:
    """Whether a delay was measured that is one: most runs weren't in the new mode already."""
    return measured_delay(row) is not None and row["already_share"] <= MOST_ALREADY


def measured_delay(row: Row) -> float | None:
    """Of the run-averaged mode estimate; the runs' median where each has its own switches.

    None where there was no switch, or where the data ended before the mode was noticed.
    """
    averaged: float | None = row["averaged_delay_steps"]
    if averaged is None:
        median: float | None = row["median_delay_steps"]
        return median
    return None if str(row["averaged_delay"]).startswith("over") else averaged


def _measured(row: Row) -> str:
    """A delay as a table says it, with what it may be, or the share of switches that are missed."""
    if row["median_delay_steps"] is None:
        return "no switch"
    star = "*" * bool(row["already_share"] > MOST_ALREADY)
    if row["averaged_delay_steps"] is None:
        median, missed = row["median_delay_steps"], row["missed_share"]
        text = "never" if math.isinf(median) else f"{median:.0f}"
        return text + f" ({missed:.0%} missed)" * bool(missed >= 0.005) + star
    low, high = row["averaged_delay_steps_low"], row["averaged_delay_steps_high"]
    text = str(row["averaged_delay"])
    return text + (f" ({_plain(low)}-{_plain(high)})" if low != high else "") + star


def _plain(delay: float) -> str:
    return "∞" if math.isinf(delay) else f"{delay:.0f}"


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
    return {
        "switch": [n if i == 0 or n != names[i - 1] else "" for i, n in enumerate(names)],
        "estimator": [row["estimator"] for row in rows],
        "delay,\nsteps": [_measured(row) for row in rows],
        "pre-\ndicted": [row["mean_trajectory_delay"] for row in rows],
        "4.1": [_bound(row, ["proposition_4_1"]) for row in rows],
        "4.2 to\n4.4": [_bound(row, BOUNDS) for row in rows],
    }


def _bound(row: Row, keys: Sequence[str]) -> str:
    """The least of several bounds."""
    if row[f"{keys[0]}_result"] is None:
        return ""
    delays = [d for key in keys if (d := row[f"{key}_delay_steps"]) is not None]
    if not delays:
        return "–"
    return "no" if math.isinf(min(delays)) else f"{min(delays):.0f}"


def shown_pairs(pairs: Sequence[Row]) -> dict[str, list[str]]:
    """What a terminal shows of ordered pairs: the terms of eq. 21, and the residual in the end."""
    third = [key for key in dict.fromkeys(k for p in pairs for k in p) if key.startswith(THIRD)]
    columns = {"from": "from_mode", "to": "to_mode", "first\nterm": "first_term"}
    columns |= {"second": "second_term"}
    columns |= {f"third,\n{key.removeprefix(THIRD)}": key for key in third}
    columns |= {"residual\nleft, m": "settled_residual_m", "(15)": "condition_15"}
    return {heading: [_cell(pair.get(key)) for pair in pairs] for heading, key in columns.items()}


def _cell(value: Any) -> str:
    if value is None or value != value:
        return "–"
    if isinstance(value, bool):
        return "met" if value else "not met"
    return value if isinstance(value, str) else "∞" if math.isinf(value) else f"{value:.3g}"


# ---- conclusions -----------------------------------------------------------------------------


def conclusions(rows: Sequence[Row], pairs: Sequence[Row], runs: int) -> list[str]:
    """What a practitioner should conclude, in whole sentences."""
    return [
        *_who_notices(rows, runs),
        *_how_predicted(rows),
        *_which_direction(rows, pairs),
        *_what_is_bounded(rows),
    ]


def _by_estimator(rows: Sequence[Row]) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row["estimator"], []).append(row)
    return found


def _who_notices(rows: Sequence[Row], runs: int) -> list[str]:
    parts, left_out = [], 0
    bounds: dict[str, tuple[float, float]] = {}
    for estimator, all_rows in _by_estimator(rows).items():
        own = [row for row in all_rows if is_noticed(row)]
        left_out += sum(row["already_share"] > MOST_ALREADY for row in all_rows if _happened(row))
        delays = [d for row in own if (d := measured_delay(row)) is not None]
        noticed = [d for d in delays if math.isfinite(d)]
        if not delays:
            continue
        words = f"{estimator} " + ("never" if not noticed else f"after {_range(noticed)}")
        if noticed:
            words += " step" if max(noticed) == 1 else " steps"
            never = len(delays) - len(noticed)
            words += f" ({never} of {len(delays)} never)" * bool(never)
        parts.append(words)
        if len(own) == len(all_rows) and own[0]["averaged_delay_steps"] is not None:
            ends = ("averaged_delay_steps_low", "averaged_delay_steps_high")
            low, high = (sum(row[end] for row in own) for end in ends)
            bounds[estimator] = (low, high)
    if not parts:
        return ["No switch was there to be noticed in any run."]
    count = len({(row["case"], row["switch"], row["from_mode"], row["to_mode"]) for row in rows})
    kind = "kind of switch" if rows[0]["switch"] is None else "switch"
    kinds = kind if count == 1 else kind.replace("kind", "kinds").replace("switch", "switches")
    sentence = (
        f"Over {runs:,} run{'s' * (runs != 1)} and {count} {kinds}, a switch is noticed by "
        f"{', by '.join(parts)}."
    )
    for best, (_, high) in bounds.items():
        others = [low for label, (low, _) in bounds.items() if label != best]
        if len(bounds) == len(_by_estimator(rows)) > 1 and high < min(others):
            sentence += f" {best} is the soonest."
    if left_out:
        sentence += (
            f" Not counted: {left_out} delays (*) of estimates that had been in the new mode "
            "before the switch."
        )
    return [sentence, *_what_is_false(rows)]


def _happened(row: Row) -> bool:
    return row["already_share"] is not None


def _what_is_false(rows: Sequence[Row]) -> list[str]:
    """Who leaves the right mode again."""
    worst: dict[str, float] = {}
    for row in rows:
        if row["false_switches"] is not None and not math.isnan(row["false_switches"]):
            label = row["estimator"]
            worst[label] = max(worst.get(label, 0.0), row["false_switches"])
    named = [f"{label} up to {value:.2g}" for label, value in worst.items() if value >= 0.05]
    if not named:
        return []
    return [f"False switches per stay, away from the right mode: {', '.join(named)} times."]


def _range(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.0f}" if low == high else f"{low:.0f} to {high:.0f}"


def _how_predicted(rows: Sequence[Row]) -> list[str]:
    held = [
        (row["mean_trajectory_delay_steps"], delay)
        for row in rows
        if is_noticed(row)
        and (delay := measured_delay(row)) is not None
        and not math.isnan(row["mean_trajectory_delay_steps"])
    ]
    if not held:
        return []
    exact = sum(one == other for one, other in held)
    close = sum(one == other or abs(one - other) <= 1 for one, other in held)
    delays = "delay" if len(held) == 1 else "delays"
    return [
        f"Measurements without noise predict {exact} of {len(held)} {delays} exactly and {close} "
        "within one step."
    ]


def _which_direction(rows: Sequence[Row], pairs: Sequence[Row]) -> list[str]:
    """By the first term, by all of eq. 21, and whether the measured delays agree."""
    said = []
    terms = {(p["from_mode"], p["to_mode"]): p.get("first_term") for p in pairs}
    for (a, b), term in terms.items():
        back = terms.get((b, a))
        if term is None or back is None or not term < (1.0 - NEARLY) * back:
            continue
        sentence = (
            f"By the residual covariances {a} to {b} is easier to notice than {b} to {a} (first "
            f"term of eq. 21: {term:.3g} against {back:.3g})"
        )
        there, other = (_median(rows, modes, measured_delay) for modes in ((a, b), (b, a)))
        if there is not None and other is not None:
            agree = "and so it is" if there < other else "but it is not"
            agree = "but both take as long" if there == other else agree
            sentence += (
                f", {agree}: {_plain_or_never(there)} against {_plain_or_never(other)} steps"
            )
        sums = [
            _median(rows, modes, lambda row: _finite(row["sum_of_logarithms"]))
            for modes in ((a, b), (b, a))
        ]
        if sums[0] is not None and sums[1] is not None and sums[0] > sums[1]:
            sentence += (
                f"; all three terms together say the opposite ({sums[0]:.3g} against "
                f"{sums[1]:.3g}), for the errors at the switch"
            )
        said.append(sentence + ".")
    return said[:3]


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else value


def _plain_or_never(delay: float) -> str:
    return "never" if math.isinf(delay) else f"{delay:.3g}"


def _median(
    rows: Sequence[Row], modes: tuple[str, str], of: Callable[[Row], float | None]
) -> float | None:
    """Over estimators and switches of one kind."""
    own = [row for row in rows if (row["from_mode"], row["to_mode"]) == modes and is_noticed(row)]
    values = [value for row in own if (value := of(row)) is not None]
    return statistics.median(values) if values else None


def _what_is_bounded(rows: Sequence[Row]) -> list[str]:
    bounded = [row for row in rows if row["proposition_4_1_result"] is not None]
    some = [row for row in bounded if _bound(row, BOUNDS).isdecimal()]
    if not bounded:
        return []
    if not some:
        return ["None of the propositions 4.2 to 4.4 has a bound for any of these delays."]
    return [f"Propositions 4.2 to 4.4 have a bound for {len(some)} of {len(bounded)} of these."]
