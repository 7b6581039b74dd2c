"""What a run says of set-membership filters: outcomes, bounds, and what the noise did."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

from rich.console import RenderableType
from rich.table import Table
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
    switches = {
        row["estimator"]: estimate(row["value"], row["standard_error"])
        for row in summary
        if (row["metric"], row["window"]) == ("model_switches", "all")
    }
    outcomes = {
        label: [
            *(f"{found[label, figure]['value']:,.0f}" for figure, _ in OUTCOMES),
            largest(found[label, "largest_normalised_error"]["value"]),
            *([switches.get(label, "")] if switches else []),
        ]
        for label in labels
    }
    headings = [*(heading for _, heading in OUTCOMES), "largest\nerror"]
    yield ""
    yield _table("sets: runs that", [*headings, *(["switches"] if switches else [])], outcomes)
    yield ""
    yield Text(
        "violated: the truth left the set; emptied: a measurement left nothing of the set (noise "
        "or remainder beyond what the filter believes); diverged: a bound grew past `growth` times "
        "the first one, or a value was lost; useless: the bound on an angle exceeds pi at some "
        "step; "
        "error: (x-c)' S^-1 (x-c), 1 on the boundary"
    )
    units = manifest["states"]
    bounds = {
        label: [
            estimate(row["value"], row["standard_error"])
            for row in (found[label, MEDIAN_BOUND + state] for state in units)
        ]
        for label in labels
    }
    yield ""
    headings = [f"{state}, {unit}" if unit else state for state, unit in units.items()]
    yield _table("bounds (half-widths)", headings, bounds)
    yield ""
    yield Text("bounds: medians over runs of the mean over time; inf: half of the runs diverged")
    yield from map(Text, _of_noise(summary))
    yield from map(Text, _of_bounds(comparisons, manifest["compare_with"], found))


def _table(first: str, headings: list[str], cells: Mapping[str, list[str]]) -> Table:
    """A row per estimator."""
    table = plain_table()
    table.add_column(first, overflow="fold")
    for heading in headings:
        table.add_column(Text(heading), justify="right", no_wrap=True)
    for label, row in cells.items():
        table.add_row(Text(label), *row)
    return table


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
