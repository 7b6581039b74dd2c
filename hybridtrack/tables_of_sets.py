"""What a run says of set-membership filters: outcomes, bounds, and what the noise did."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

from rich.console import RenderableType
from rich.text import Text

from hybridtrack.typesetting import estimate, plain_table

OUTCOMES = (
    ("violated_runs", "violated"),
    ("emptied_runs", "emptied"),
    ("diverged_runs", "diverged"),
    ("useless_runs", "useless"),
)
MEDIAN_BOUND = "median_bound:"
MEANINGLESS = 1000.0

Rows = list[dict[str, Any]]


def set_tables(
    sets: Rows, summary: Rows, comparisons: Rows, manifest: Mapping[str, Any]
) -> Iterator[RenderableType]:
    """What came of the sets, in how many runs; how wide they were; and sentences on both."""
    found = {(row["estimator"], row["figure"]): row for row in sets}
    labels = [label for label in manifest["estimators"] if (label, OUTCOMES[0][0]) in found]
    if not labels:
        return
    bounds = [f for f in dict.fromkeys(r["figure"] for r in sets) if f.startswith(MEDIAN_BOUND)]
    switches = {
        row["estimator"]: estimate(row["value"], row["standard_error"])
        for row in summary
        if (row["metric"], row["window"]) == ("model_switches", "all")
    }
    yield ""
    table = plain_table()
    table.add_column("sets: runs that", overflow="fold")
    headings = [heading for _, heading in OUTCOMES]
    headings += ["largest\nerror", *(f"bound on\n{f.removeprefix(MEDIAN_BOUND)}" for f in bounds)]
    for heading in [*headings, *(["switches"] if switches else [])]:
        table.add_column(Text(heading), justify="right", no_wrap=True)
    for label in labels:
        cells = [f"{found[label, figure]['value']:,.0f}" for figure, _ in OUTCOMES]
        cells.append(largest(found[label, "largest_normalised_error"]["value"]))
        medians = [found[label, figure] for figure in bounds]
        cells += [estimate(row["value"], row["standard_error"]) for row in medians]
        table.add_row(Text(label), *cells, *([switches.get(label, "")] if switches else []))
    yield table
    yield ""
    yield Text(
        "violated: the truth left the set; emptied: a measurement left nothing of the set (noise "
        "or remainder beyond what the filter believes); diverged: its set grew past `growth` times "
        "its first width, or a value was lost; useless: no heading is excluded at some step; "
        "error: (x-c)' S^-1 (x-c), 1 on the boundary; bounds: medians over runs of the mean over "
        "time"
    )
    yield from map(Text, _of_noise(summary))
    yield from map(Text, _of_bounds(comparisons, manifest["compare_with"], found))


def largest(error: float) -> str:
    """A largest normalised error; how far beyond all measure it is tells of rounding alone."""
    return f"{error:.3g}" if error < MEANINGLESS else f"> {MEANINGLESS:,.0f}"


def _of_noise(summary: Rows) -> Iterator[str]:
    """Whether the noise kept the bounds that filters believe in."""
    for kind in ("process", "measurement"):
        for row in summary:
            metric = f"{kind}_noise_outside_share"
            if (row["metric"], row["window"]) == (metric, "all") and row["value"] > 0:
                share = estimate(100 * row["value"], 100 * row["standard_error"])
                yield f"the {kind} noise leaves its ellipsoid in {share} % of draws"


def _of_bounds(
    comparisons: Rows, reference: str | None, found: Mapping[tuple[str, str], dict[str, Any]]
) -> Iterator[str]:
    """How much wider the sets are than the reference's, of estimators that keep the truth."""
    wider: dict[str, list[str]] = {}
    sound = {
        label for (label, f), row in found.items() if f == "violated_runs" and not row["value"]
    }
    for row in comparisons:
        metric, first = row["metric"], row["first"]
        if (
            metric.startswith("mean_bound:")
            and row["window"] == "all"
            and {first, reference} <= sound
        ):
            state = metric.removeprefix("mean_bound:")
            ours, theirs = (
                found[x, MEDIAN_BOUND + state]["value"] for x in (first, reference or "")
            )
            more = 100 * (ours / theirs - 1)
            if math.isfinite(more):
                wider.setdefault(first, []).append(f"{state} {more:+.1f} %".replace("-", "−"))
    for first, states in wider.items():
        yield f"bounds of {first} against {reference}'s (medians): {', '.join(states)}"
