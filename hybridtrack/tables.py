"""A run folder's results as text and as JSON; tables in, lines out."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from hybridtrack import results
from hybridtrack.tables_of_delays import delay_tables
from hybridtrack.tables_of_sets import set_tables
from hybridtrack.typesetting import counted, estimate, hanging, plain_table, print_parts

# Metric, heading: what the main table shows, where the scenario has it.
RAW = "raw"
ERRORS = {
    "rmse": (
        ("position_rmse_m", "position\nRMS, m"),
        ("velocity_rmse_m_s", "velocity\nRMS, m/s"),
    ),
    "mse": (
        ("position_mse_m2", "position\nMSE, m²"),
        ("velocity_mse_m2_s2", "velocity\nMSE, m²/s²"),
    ),
}
MODES = (("mode_accuracy", "mode\naccuracy"), ("mode_brier", "Brier\nscore"))
FINAL_MODE = (
    ("final_mode_brier", "Brier\nscore"),
    ("final_mode_prior_brier", "by the\ntime alone"),
    ("final_mode_calibration_error", "calibration\nerror"),
)
MOST_SENTENCES = 4  # of theory
VERDICT_STYLES = {
    "reproduced": "green",
    "reproduced with stated assumptions": "green",
    "direction only": "yellow",
    "not reproduced": "yellow",
}


Rows = list[dict[str, Any]]


def show(path: Path, console: Console) -> None:
    """Print a finished run: its table, comparisons, the published figures with their verdicts.

    No digit and no letter is left out: a table too wide for a terminal folds its names, then goes
    beyond the edge; on anything else than a terminal it is as wide as it needs to be.
    """
    print_parts(_parts(path), console)


def _parts(path: Path) -> Iterator[RenderableType]:
    """What is printed, one below the other. A user's words are Text: nothing in them is markup."""
    manifest = results.require_complete(path)
    summary = results.read_rows(path, "summary")
    runs, cases = manifest["runs"], manifest["cases"]
    over = f" in each of {cases} cases" if cases > 1 else ""
    yield Text(f"{manifest['title']}: {counted(runs, 'run')}{over}, seed {manifest['seed']}\n")
    error, units = manifest["error"], manifest["states"]
    of_states = [(f"{error}:{s}", heading(s, u, error)) for s, u in units.items()]
    shown = (*ERRORS[error], *of_states, *MODES)
    if summary:
        yield _summary("estimator", summary, [RAW, *manifest["estimators"]], shown)
    comparisons = results.read_rows(path, "comparisons")
    if comparisons:
        yield ""
        yield _ratios(comparisons, manifest["compare_with"], shown)
    yield from set_tables(results.read_rows(path, "sets"), summary, comparisons, manifest)
    told = {row["estimator"] for row in summary if row["metric"] == FINAL_MODE[0][0]}
    if told:
        yield ""
        labels = [label for label in manifest["estimators"] if label in told]
        yield _summary("mode is the last", summary, labels, FINAL_MODE)
    yield from delay_tables(results.read_rows(path, "delays"), summary)
    for label, count in manifest.get("diverged", {}).items():
        yield Text(f"{label}: {_left_out(label, count, runs * cases)}")
    windows = [
        w for w in manifest["windows"] if w != "all" and w in {row["window"] for row in summary}
    ]
    if windows:
        yield Text(f"windows {', '.join(windows)}: see summary.csv")
    yield from _theory(manifest.get("theory", []))
    published = results.read_rows(path, "published")
    if published:
        yield ""
        yield published_table(published)


def heading(state: str, unit: str, error: str) -> str:
    """Of a column of one state's errors."""
    if unit and error == "mse":
        unit = f"{unit}²" if unit.isalpha() else f"({unit})²"
    kind = "MSE" if error == "mse" else "RMS"
    return f"{state}\n{kind}, {unit}" if unit else f"{state}\n{kind}"


def _left_out(label: str, count: int, runs: int) -> str:
    if label != RAW:
        return f"{count:,} of {counted(runs, 'run')} diverged and are left out"
    return (
        f"in {count:,} of {counted(runs, 'run')} the truth itself runs away; they are left out of "
        "everything (at which step: 'status' in runs.parquet); shorten 'clock', or mend 'dynamics'"
    )


def _theory(sentences: list[str]) -> Iterator[RenderableType]:
    """What theory finds too short in the truth."""
    if sentences:
        yield "\ntoo short by theory (hybridtrack analyze observability):"
        yield from (hanging(sentence) for sentence in sentences[:MOST_SENTENCES])
        if len(sentences) > MOST_SENTENCES:
            yield f"and {len(sentences) - MOST_SENTENCES} more: hybridtrack validate --theory"


Columns = tuple[tuple[str, str], ...]  # metrics and their headings


def _summary(heading: str, summary: Rows, labels: list[str], shown: Columns) -> Table:
    figures = {
        (row["estimator"], row["metric"]): estimate(row["value"], row["standard_error"])
        for row in summary
        if row["window"] == "all"
    }
    return _by_metric(heading, labels, figures, shown)


def _ratios(comparisons: Rows, reference: str, shown: Columns) -> Table:
    figures = {
        (row["first"], row["metric"]): estimate(row["ratio"], row["ratio_standard_error"])
        for row in comparisons
        if row["window"] == "all"
    }
    firsts = list(dict.fromkeys(key[0] for key in figures))
    return _by_metric(f"ratio to {reference}", firsts, figures, shown)


def _by_metric(
    heading: str, labels: list[str], figures: dict[tuple[str, str], str], shown: Columns
) -> Table:
    """A row per estimator, a column per metric that there is."""
    metrics = [(m, h) for m, h in shown if any(key[1] == m for key in figures)]
    labels = [label for label in labels if any((label, m) in figures for m, _ in metrics)]
    table = plain_table()
    table.add_column(Text(heading), overflow="fold")
    for _, text in metrics:
        text = text.partition(",")[0] if heading.startswith("ratio") else text
        table.add_column(Text(text), justify="right", no_wrap=True)
    for label in labels:
        table.add_row(Text(label), *(figures.get((label, metric), "") for metric, _ in metrics))
    return table


def published_table(published: Rows) -> Table:
    table = plain_table()
    table.expand = True
    table.add_column("verdict", width=18, overflow="fold")
    table.add_column("published claim", ratio=1, overflow="fold")
    for row in published:
        verdict = Text(row["verdict"], style=VERDICT_STYLES.get(row["verdict"], ""))
        if row["differs"]:
            verdict = Text(f"{row['verdict']} (expected: {row['expected_verdict']})", "bold red")
        claim = Text(row["claim"])
        because = f"; {row['because']}" if row["because"] else ""
        claim.append(f"\npublished {claimed(row)}, ours {obtained(row)}{because}", style="dim")
        table.add_row(verdict, claim)
    return table


def claimed(row: Mapping[Any, Any]) -> str:
    """What was published: a figure, the sign of a difference, or that two are equal."""
    if row["sign"] == "equal":
        return f"ratio {row['published']:g}±{row['tolerance']:g}"
    if row["published"] is None:
        return "Δ < 0" if row["sign"] == "less" else "Δ > 0"
    if row["sign"] and " / " not in row["estimator"]:
        return f"{'<' if row['sign'] == 'less' else '>'} {row['published']:g}"
    return f"{row['published']:g}"


def obtained(row: Mapping[Any, Any]) -> str:
    """What we get: the figure, or the paired difference."""
    if "shown" in row:
        return str(row["shown"])
    difference = "Δ = " if row["published"] is None else ""
    return difference + estimate(row["ours"], row["standard_error"])


def surprises(path: Path) -> list[str]:
    """A sentence for every window without a step and every verdict that isn't the expected one."""
    there = {row["window"] for row in results.read_rows(path, "summary")}
    windows = results.require_complete(path)["windows"]
    empty = [w for w in windows if there and w not in there]  # all runs lost: told in the table
    said = [f"window '{w}' holds no measured step, so it has no figures" for w in empty]
    return said + unexpected(results.read_rows(path, "published"))


def unexpected(published: Rows) -> list[str]:
    return [
        f"'{row['claim']}' came out as: {row['verdict']}; expected: {row['expected_verdict']}"
        for row in published
        if row["differs"]
    ]


def as_json(path: Path) -> dict[str, Any]:
    """The same for programs; NaN and infinity are null."""
    manifest = results.require_complete(path)
    tables = {
        name: [_finite(row) for row in results.read_rows(path, name)]
        for name in ("summary", "comparisons", "reliability", "sets", "delays", "published")
    }
    return {
        "folder": str(path),
        "name": manifest["name"],
        "runs": manifest["runs"],
        "seed": manifest["seed"],
        "diverged": manifest.get("diverged", {}),
        "theory": manifest.get("theory", []),
        **tables,
        "figures": [str(figure) for figure in sorted((path / "figures").glob("*.png"))],
    }


def _finite(row: Mapping[Any, Any]) -> dict[str, Any]:
    return {
        str(key): None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }
