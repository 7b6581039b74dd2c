"""A run folder's results as text and as JSON; tables in, lines out."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hybridtrack import results

# Metric, heading: what the main table shows, where the scenario has it.
COLUMNS = (
    ("position_rmse_m", "position\nRMS, m"),
    ("velocity_rmse_m_s", "velocity\nRMS, m/s"),
    ("mode_accuracy", "mode\naccuracy"),
    ("mode_brier", "Brier\nscore"),
)
MOST_DECIMALS = 4  # four columns of them fit into 80 characters
VERDICT_STYLES = {
    "reproduced": "green",
    "reproduced with stated assumptions": "green",
    "direction only": "yellow",
    "not reproduced": "yellow",
}


def figure(value: float, error: float) -> str:
    """A figure with its standard error, to the error's first digit: '17.94±0.04'."""
    if math.isnan(value):
        return ""
    if math.isnan(error):
        return f"{value:.4g}"
    if error == 0.0:
        return f"{value:.4g}±0"
    decimals = min(max(-math.floor(math.log10(error)), 0), MOST_DECIMALS)
    return f"{value:.{decimals}f}±{error:.{decimals}f}"


def show(path: Path, console: Console) -> None:
    """Print a finished run: its table, comparisons, the published figures with their verdicts."""
    manifest = results.require_complete(path)
    summary = results.read_table(path, "summary")
    runs, cases = manifest["runs"], manifest["cases"]
    over = f" in each of {cases} cases" if cases > 1 else ""
    console.print(f"{manifest['title']}: {runs:,} runs{over}, seed {manifest['seed']}")
    console.print()
    console.print(_summary(summary, manifest["estimators"]))
    comparisons = results.read_table(path, "comparisons")
    if len(comparisons):
        console.print()
        console.print(_ratios(comparisons, manifest["compare_with"]))
    for label, count in manifest.get("diverged", {}).items():
        console.print(f"{label}: {count:,} of {runs * cases:,} runs diverged and are left out")
    windows = [window for window in manifest["windows"] if window != "all"]
    if windows:
        console.print(f"windows {', '.join(windows)}: see summary.csv", highlight=False)
    published = results.read_table(path, "published")
    if len(published):
        console.print()
        console.print(_published(published))


def _plain_table() -> Table:
    return Table(box=box.SIMPLE, pad_edge=False, padding=(0, 1), show_edge=False)


def _summary(summary: pd.DataFrame, estimators: list[str]) -> Table:
    figures = {
        (row["estimator"], row["metric"]): figure(row["value"], row["standard_error"])
        for row in summary.to_dict("records")
        if row["window"] == "all"
    }
    return _by_metric("estimator", ["raw", *estimators], figures)


def _ratios(comparisons: pd.DataFrame, reference: str) -> Table:
    figures = {
        (row["first"], row["metric"]): figure(row["ratio"], row["ratio_standard_error"])
        for row in comparisons.to_dict("records")
        if row["window"] == "all"
    }
    return _by_metric(f"ratio to {reference}", list(dict.fromkeys(k[0] for k in figures)), figures)


def _by_metric(heading: str, labels: list[str], figures: dict[tuple[str, str], str]) -> Table:
    """A row per estimator, a column per metric that there is."""
    metrics = [(m, h) for m, h in COLUMNS if any(key[1] == m for key in figures)]
    table = _plain_table()
    table.add_column(heading, no_wrap=True)
    for _, text in metrics:
        text = text.partition(",")[0] if heading.startswith("ratio") else text
        table.add_column(text, justify="right", no_wrap=True)
    for label in labels:
        table.add_row(label, *(figures.get((label, metric), "") for metric, _ in metrics))
    return table


def _published(published: pd.DataFrame) -> Table:
    table = _plain_table()
    table.add_column("verdict", width=18)
    table.add_column("published claim", ratio=1)
    for row in published.to_dict("records"):
        verdict = Text(row["verdict"], style=VERDICT_STYLES.get(row["verdict"], ""))
        if row["differs"]:
            verdict = Text(f"{row['verdict']} (expected: {row['expected_verdict']})", "bold red")
        claim = Text(row["claim"])
        because = f"; {row['because']}" if row["because"] else ""
        claim.append(f"\npublished {claimed(row)}, ours {obtained(row)}{because}", style="dim")
        table.add_row(verdict, claim)
    return table


def claimed(row: Mapping[Any, Any]) -> str:
    """What was published: a figure, or the sign of a difference."""
    if math.isnan(row["published"]):
        return "Δ < 0" if row["sign"] == "less" else "Δ > 0"
    return f"{row['published']:g}"


def obtained(row: Mapping[Any, Any]) -> str:
    """What we get: the figure, or the paired difference."""
    difference = "Δ = " if math.isnan(row["published"]) else ""
    return difference + figure(row["ours"], row["standard_error"])


def surprises(path: Path) -> list[str]:
    """A sentence for every verdict that isn't the expected one."""
    return [
        f"'{row['claim']}' came out as: {row['verdict']}; expected: {row['expected_verdict']}"
        for row in results.read_table(path, "published").to_dict("records")
        if row["differs"]
    ]


def as_json(path: Path) -> dict[str, Any]:
    """The same for programs; NaN is null."""
    manifest = results.require_complete(path)
    tables = {
        name: [_without_nan(row) for row in results.read_table(path, name).to_dict("records")]
        for name in ("summary", "comparisons", "published")
    }
    return {
        "folder": str(path),
        "name": manifest["name"],
        "runs": manifest["runs"],
        "seed": manifest["seed"],
        "diverged": manifest.get("diverged", {}),
        **tables,
        "figures": [str(figure) for figure in sorted((path / "figures").glob("*.png"))],
    }


def _without_nan(row: Mapping[Any, Any]) -> dict[str, Any]:
    return {
        str(key): None if isinstance(value, float) and math.isnan(value) else value
        for key, value in row.items()
    }
