"""What a check found, in words: for a terminal, a pull request, a CI server and other programs."""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

from hybridtrack.errors import UserError
from hybridtrack.studies import baselines
from hybridtrack.studies.baselines import Baseline
from hybridtrack.studies.regression import (
    BETTER,
    DIVERGED,
    FAMILY_ERROR,
    SAME,
    UNTOLD,
    WORSE,
    Change,
    Comparison,
    Mismatch,
    hold_against,
    is_beyond_rounding,
    runs_to_detect,
)

PILOT_RUNS = 1000  # tell how far figures scatter
MOST_RUNS = 100_000_000
SMALLEST_CHANGE = 1e-6


class Report(NamedTuple):
    """A run held against its baseline."""

    name: str
    run: Baseline
    baseline: Baseline
    comparison: Comparison
    must_be_identical: bool  # same seed, sources, versions and kind of machine
    family_error: float

    def of(self, verdict: str) -> list[Change]:
        """The changes of one verdict."""
        return [change for change in self.comparison.changes if change.verdict == verdict]

    @property
    def irreproducible(self) -> bool:
        """Whether what has to be the same isn't, by more than last bits: those a library turns."""
        moved = any(is_beyond_rounding(change) for change in self.comparison.changes)
        return self.must_be_identical and not self.comparison.identical and moved

    @property
    def failed(self) -> bool:
        """Whether anything is worse than in the baseline."""
        return self.irreproducible or bool(self.of(WORSE))


def held_against(folder: Path, baseline: Baseline, family_error: float = FAMILY_ERROR) -> Report:
    """Compare a finished run with a baseline. Raises UserError where they don't belong together."""
    run = baselines.describe(folder)
    _check_scenarios(run, baseline)
    paired = run.seed == baseline.seed
    try:
        comparison = hold_against(
            run.shards(), baseline.shards(), paired=paired, family_error=family_error
        )
    except Mismatch as error:
        raise UserError(f"{baseline.path}: {error}") from None
    return Report(
        run.name, run, baseline, comparison, paired and run.made == baseline.made, family_error
    )


def _check_scenarios(run: Baseline, baseline: Baseline) -> None:
    found = _difference(run.scenario, baseline.scenario)
    if found is not None:
        key, here, there = found
        raise UserError(
            f"{baseline.path}: this baseline is of another scenario: '{key}' is {here} here and "
            f"{there} there; renew it with `hybridtrack baseline`, or check what it is of"
        )


def _difference(one: Any, other: Any, key: str = "") -> tuple[str, str, str] | None:
    """The first place where two resolved scenarios differ, and what stands there."""
    if isinstance(one, dict) and isinstance(other, dict):
        for name in [*one, *(name for name in other if name not in one)]:
            path = f"{key}.{name}" if key else name
            if name not in one or name not in other:
                here, there = ("present" if name in of else "missing" for of in (one, other))
                return path, here, there
            found = _difference(one[name], other[name], path)
            if found is not None:
                return found
        return None
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        pairs = enumerate(zip(one, other, strict=True))
        found_in = (_difference(a, b, f"{key}[{i}]") for i, (a, b) in pairs)
        return next((found for found in found_in if found is not None), None)
    same = one == other
    return None if same else (key, _short(one), _short(other))


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:39]}…"


def runs_wanted(folder: Path, detect: str) -> tuple[int, str]:
    """How many runs find a relative change, from a finished run's scatter.

    Against a baseline of as many runs of another seed; the figure that decides is named. Raises
    UserError where that says nothing.
    """
    try:
        wanted = float(detect.removesuffix("%")) / (100 if detect.endswith("%") else 1)
    except ValueError:
        wanted = math.nan
    if not SMALLEST_CHANGE <= wanted < 1.0:
        raise UserError(f"--detect {detect}: give a change such as 1% or 0.01")
    run = baselines.describe(folder)
    alone = hold_against(run.shards(), run.shards(), paired=False)
    number, decides = runs_to_detect(alone, wanted)
    figure = f"{decides.metric} of {decides.estimator}"
    if number > MOST_RUNS:
        raise UserError(
            f"--detect {detect}: {figure} takes {number:,} runs; look for a larger change"
        )
    return number, figure


# ---- in words --------------------------------------------------------------------------------


def _percent(change: Change, value: float, digits: int = 2) -> str:
    """A change in per cent of the baseline, or as it is where that is 0."""
    if math.isnan(value):
        return ""
    if change.baseline == 0.0 or change.metric == DIVERGED:
        return f"{value:+.{digits}g}"
    return f"{100 * value / abs(change.baseline):+.{digits}g} %"


def _interval(change: Change) -> str:
    if math.isnan(change.low):
        return ""
    return f"{_percent(change, change.low).removesuffix(' %')} to {_percent(change, change.high)}"


def _headline(report: Report) -> str:
    comparison, baseline = report.comparison, report.baseline
    how = "pair by pair" if comparison.paired else "unpaired"
    return (
        f"{report.name}: {comparison.runs:,} runs of seed {report.run.seed} against a baseline of "
        f"{baseline.runs:,} runs of seed {baseline.seed}, {how}"
    )


def _conclusion(report: Report) -> str:
    changes, comparison = report.comparison.changes, report.comparison
    if comparison.identical:
        return f"identical to the last bit: {len(changes)} figures"
    counts = {verdict: len(report.of(verdict)) for verdict in (WORSE, BETTER, UNTOLD)}
    rest = len(changes) - sum(counts.values())
    said = [f"{number} {verdict}" for verdict, number in counts.items() if number]
    text = ", ".join([*said, f"{rest} not changed"])
    if report.irreproducible:
        text += (
            "; seed, sources, versions and machine are the baseline's, so all should be the same: "
            "something is not reproducible"
        )
    elif report.must_be_identical:
        text += "; only last bits differ"
    return text


def _guide(report: Report) -> str:
    """What could have been seen, in per cent of the whole window's figures."""
    seen = sorted(
        100 * change.detectable / abs(change.baseline)
        for change in report.comparison.changes
        if change.window == "all" and change.baseline and change.verdict != SAME
        if math.isfinite(change.detectable)
    )
    if not seen or report.comparison.identical:
        return ""
    return (
        f"so many runs find changes from {seen[0]:.2g} % (the surest figure) to {seen[-1]:.2g} % "
        f"(the least sure), in the\nmedian {seen[len(seen) // 2]:.2g} %, with a chance of "
        f"{report.family_error:g} to cry wolf over all figures, and of as much to miss one"
    )


HEADINGS = ("figure", "baseline", "change", "interval", "detectable", "")


def _shown(report: Report, everything: bool) -> dict[str, list[tuple[str, ...]]]:
    """Rows of what is to be shown, by estimator and window: the whole window, and what changed."""
    groups: dict[str, list[tuple[str, ...]]] = {}
    for change in report.comparison.changes:
        told = change.verdict in (WORSE, BETTER, UNTOLD)
        if everything or told or (change.window in ("all", "") and change.verdict != SAME):
            elsewhere = f", {change.window}" if change.window not in ("all", "") else ""
            groups.setdefault(change.estimator + elsewhere, []).append(
                (
                    change.metric,
                    f"{change.baseline:.4g}",
                    _percent(change, change.change, 3),
                    _interval(change),
                    _percent(change, change.detectable).lstrip("+"),
                    change.verdict if told or everything else "",
                )
            )
    return groups


def as_text(report: Report, *, everything: bool = False) -> str:
    """For a terminal: the figures of the whole window, and whatever changed elsewhere."""
    groups = _shown(report, everything)
    rows = [HEADINGS, *(row for group in groups.values() for row in group)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(HEADINGS))]

    def line(row: tuple[str, ...]) -> str:
        first, *rest = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        return " ".join([f"  {first}", *rest]).rstrip()

    lines = [_headline(report)]
    if groups:
        lines += ["", line(HEADINGS)]
        for name, group in groups.items():
            lines += [name, *map(line, group)]
    lines += ["", _conclusion(report), _guide(report)]
    return "\n".join(lines).rstrip() + "\n"


def as_markdown(report: Report) -> str:
    """For a pull request."""
    mark = "worse" if report.failed else "passed"
    lines = [f"**{mark}** {_headline(report)}", "", _conclusion(report)]
    groups = _shown(report, everything=False)
    if groups:
        headings = ("estimator", *HEADINGS)
        lines += ["", f"| {' | '.join(headings)} |", "| --- " * len(headings) + "|"]
        lines += [f"| {n} | {' | '.join(row)} |" for n, group in groups.items() for row in group]
    lines += ["", _guide(report)]
    return "\n".join(lines).rstrip() + "\n"


def as_junit(report: Report) -> str:
    """JUnit XML: a test case for every figure."""
    changes = report.comparison.changes
    failures = len(report.of(WORSE)) + report.irreproducible
    suite = ElementTree.Element(
        "testsuite",
        name=f"hybridtrack check {report.name}",
        tests=str(len(changes) + 1),
        failures=str(failures),
        skipped=str(len(report.of(UNTOLD))),
    )
    case = ElementTree.SubElement(suite, "testcase", classname=report.name, name="reproducible")
    if report.irreproducible:
        ElementTree.SubElement(case, "failure", message=_conclusion(report))
    for change in changes:
        name = " ".join(part for part in (change.metric, change.estimator, change.window) if part)
        case = ElementTree.SubElement(suite, "testcase", classname=report.name, name=name)
        if change.verdict == WORSE:
            said = (
                f"{change.baseline:.6g} in the baseline, {change.now:.6g} now "
                f"({_percent(change, change.change)})"
            )
            ElementTree.SubElement(case, "failure", message=said)
        elif change.verdict == UNTOLD:
            ElementTree.SubElement(case, "skipped", message="too few runs to tell")
    return ElementTree.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


def as_json(report: Report) -> str:
    """For programs; NaN and infinity are null."""
    changes = [
        {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in {**change._asdict(), "change": change.change}.items()
        }
        for change in report.comparison.changes
    ]
    told = {
        "name": report.name,
        "failed": report.failed,
        "identical": report.comparison.identical,
        "paired": report.comparison.paired,
        "runs": report.comparison.runs,
        "seed": report.run.seed,
        "baseline_runs": report.baseline.runs,
        "baseline_seed": report.baseline.seed,
        "family_error": report.family_error,
        "changes": changes,
    }
    return json.dumps(told, indent=2, allow_nan=False) + "\n"
