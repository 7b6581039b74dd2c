"""A run folder's results as text and as JSON; tables in, lines out."""

import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from rich import box
from rich.console import Console, RenderableType
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from hybridtrack import results
from hybridtrack.delays import MOST_ALREADY
from hybridtrack.statistics import FALSE_SWITCHES

# Metric, heading: what the main table shows, where the scenario has it.
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
MOST_DECIMALS = 6  # more than that, and figures of a million on, take an exponent
MOST_DIGITS = 6  # of a figure with an exponent, after its point
SHORTEST_NAME = 12  # what a narrow terminal leaves of a name's column; longer ones go on below
WIDEST = 10_000
LONG_TEXT = 40  # letters of a cell, beyond which it has several lines
MOST_SENTENCES = 4  # of theory
MOST_SWITCHES = 6  # whose delays are printed
VERDICT_STYLES = {
    "reproduced": "green",
    "reproduced with stated assumptions": "green",
    "direction only": "yellow",
    "not reproduced": "yellow",
}

OUTCOMES = (
    ("violated_runs", "violated"),
    ("emptied_runs", "emptied"),
    ("diverged_runs", "diverged"),
    ("useless_runs", "useless"),
)
MEDIAN_BOUND = "median_bound:"
MEANINGLESS = 1000.0

Rows = list[dict[str, Any]]


def figure(value: float, error: float) -> str:
    """A figure with its standard error, to the error's first digit: '17.94±0.04'."""
    if math.isnan(value):
        return ""
    if math.isnan(error):
        return f"{value:.4g}"
    if error == 0.0 or math.isinf(value) or math.isinf(error):
        return f"{value:.4g}±{error:.4g}"
    last = math.floor(math.log10(error))  # place of the error's first digit
    if max(abs(value), error) < 1e6 and -last <= MOST_DECIMALS:
        decimals = max(-last, 0)
        return f"{value:.{decimals}f}±{error:.{decimals}f}"
    first = math.floor(math.log10(abs(value))) if value else last
    return f"{value:.{min(max(first - last, 0), MOST_DIGITS)}e}±{error:.0e}"


def estimate(value: float, error: float) -> str:
    """As `figure`; an error below the value's last bit is rounding, of what every run has alike."""
    alike = math.isfinite(value) and error < math.ulp(value)
    return figure(value, 0.0 if alike else error)


def counted(number: int, thing: str) -> str:
    """'1 run', '2,000 runs'."""
    return f"{number:,} {thing}{'s' * (number != 1)}"


def show(path: Path, console: Console) -> None:
    """Print a finished run: its table, comparisons, the published figures with their verdicts.

    No digit and no letter is left out: a table too wide for a terminal folds its names, then goes
    beyond the edge; on anything else than a terminal it is as wide as it needs to be.
    """
    _print(_parts(path), console)


def show_analysis(record: Mapping[str, Any], console: Console) -> None:
    """Print a finished analysis, of which analysis.json is given, in the same way."""
    _print(_parts_of(record), console)


def _print(parts: Iterable[RenderableType], console: Console) -> None:
    with console.capture() as captured:
        for part in parts:
            if isinstance(part, Table) and not part.expand:
                part.width = _width(part, console)
            console.print(part, crop=False)
    lines = [line.rstrip() for line in captured.get().splitlines()]
    console.file.write("\n".join([*lines, ""]))


def _parts_of(record: Mapping[str, Any]) -> Iterator[RenderableType]:
    yield Text(f"{record['title']}: {record['summary']}\n")
    for one in record["shown"]:
        if one["name"]:
            yield Text(f"{one['name'].replace('_', ' ')}:")
        yield _as_shown(one["columns"])
        yield ""
    for sentence in record["conclusions"]:
        yield Text(sentence)
    if record["notes"]:
        yield ""
        yield from (_hanging(note) for note in record["notes"])
    if record["published"]:
        yield ""
        yield _published(record["published"])


def _as_shown(columns: Mapping[str, list[str]]) -> Table:
    """Texts by heading; names stand in the first column, or the first two, and long texts fold."""
    table = _plain_table()
    for i, (heading, cells) in enumerate(columns.items()):
        long = max(map(len, cells), default=0) > LONG_TEXT
        named = i < _columns_of_names(columns)
        justify: Literal["left", "right"] = "left" if named or long else "right"
        table.add_column(
            Text(heading),
            justify=justify,
            overflow="fold",
            no_wrap=not (named or long),
            max_width=LONG_TEXT if long else None,
        )
    for row in zip(*columns.values(), strict=True):
        table.add_row(*map(Text, row))
    return table


def _columns_of_names(columns: Mapping[str, list[str]]) -> int:
    """How many of the first columns hold names."""
    return 2 if list(columns)[:2] == ["from", "to"] else 1


def _hanging(note: str) -> Table:
    """A note behind a dash, its lines below one another."""
    grid = Table.grid(padding=(0, 1), expand=True)
    grid.add_column(width=1)
    grid.add_column(ratio=1)
    grid.add_row("-", Text(note, style="dim"))
    return grid


def _parts(path: Path) -> Iterator[RenderableType]:
    """What is printed, one below the other. A user's words are Text: nothing in them is markup."""
    manifest = results.require_complete(path)
    summary = results.read_rows(path, "summary")
    runs, cases = manifest["runs"], manifest["cases"]
    over = f" in each of {cases} cases" if cases > 1 else ""
    yield Text(f"{manifest['title']}: {counted(runs, 'run')}{over}, seed {manifest['seed']}\n")
    shown = (*ERRORS[manifest["error"]], *MODES)
    yield _summary("estimator", summary, ["raw", *manifest["estimators"]], shown)
    comparisons = results.read_rows(path, "comparisons")
    if comparisons:
        yield ""
        yield _ratios(comparisons, manifest["compare_with"], shown)
    yield from _sets(results.read_rows(path, "sets"), summary, comparisons, manifest)
    told = {row["estimator"] for row in summary if row["metric"] == FINAL_MODE[0][0]}
    if told:
        yield ""
        labels = [label for label in manifest["estimators"] if label in told]
        yield _summary("mode is the last", summary, labels, FINAL_MODE)
    yield from _delays(results.read_rows(path, "delays"), summary)
    for label, count in manifest.get("diverged", {}).items():
        yield Text(
            f"{label}: {count:,} of {counted(runs * cases, 'run')} diverged and are left out"
        )
    windows = [
        w for w in manifest["windows"] if w != "all" and w in {row["window"] for row in summary}
    ]
    if windows:
        yield Text(f"windows {', '.join(windows)}: see summary.csv")
    yield from _theory(manifest.get("theory", []))
    published = results.read_rows(path, "published")
    if published:
        yield ""
        yield _published(published)


def _theory(sentences: list[str]) -> Iterator[RenderableType]:
    """What theory finds too short in the truth."""
    if sentences:
        yield "\ntoo short by theory (hybridtrack analyze observability):"
        yield from (_hanging(sentence) for sentence in sentences[:MOST_SENTENCES])
        if len(sentences) > MOST_SENTENCES:
            yield f"and {len(sentences) - MOST_SENTENCES} more: hybridtrack validate --theory"


def _sets(
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
    table = _plain_table()
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
        "violated: the truth left the set; emptied: the noise broke its bounds; diverged: not "
        "followed to the end; useless: no heading is excluded; error: (x-c)' S^-1 (x-c), 1 on the "
        "boundary; bounds: medians over runs of the mean over time"
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


def _width(table: Table, console: Console) -> int:
    """All that a table needs; on a terminal less where that is at the expense of names alone."""
    options = console.options.update(width=WIDEST)
    needed = Measurement.get(console, options, table).maximum
    if not console.is_terminal:
        return needed
    names = [column for column in table.columns if not column.no_wrap and column.max_width is None]
    longest = [max(len(str(cell)) for cell in (c.header, *c.cells)) for c in names]
    spare = sum(max(length - SHORTEST_NAME, 0) for length in longest)
    return max(min(needed, console.width), needed - spare)


def _plain_table() -> Table:
    return Table(box=box.SIMPLE, pad_edge=False, padding=(0, 1), show_edge=False)


def _delays(rows: Rows, summary: Rows) -> Iterator[RenderableType]:
    """Steps until switches are noticed, a column for each; the start is none."""
    keys = ("case", "switch", "from_mode", "to_mode")
    found = [row for row in rows if row["from_mode"] is not None]
    switches = list(dict.fromkeys(tuple(row[key] for key in keys) for row in found))
    if not switches:
        return
    yield ""
    several = len({switch[0] for switch in switches}) > 1
    if len(switches) > MOST_SWITCHES or several:
        yield Text(f"delays of {len(switches):,} switches: see delays.parquet")
        return
    table = _plain_table()
    table.add_column(Text("delay in steps"), overflow="fold")
    for switch in switches:
        time_s = next(row["time_s"] for row in found if row["switch"] == switch[1])
        when = "" if time_s is None else f"\n{time_s:g} s"
        table.add_column(Text(f"{switch[2]}\nto {switch[3]}{when}"), justify="right", no_wrap=True)
    table.add_column(Text("false\nper stay"), justify="right", no_wrap=True)
    cells = {(row["estimator"], *(row[key] for key in keys)): delay(row) for row in found}
    false = {
        row["estimator"]: estimate(row["value"], row["standard_error"])
        for row in summary
        if row["metric"] == FALSE_SWITCHES
    }
    for label in dict.fromkeys(row["estimator"] for row in found):
        own = (cells.get((label, *switch), "") for switch in switches)
        table.add_row(Text(label), *own, false.get(label, ""))
    yield table
    if any("%" in cell for cell in cells.values()):
        yield Text("median; in brackets the share of switches that are missed")
    if any("*" in cell for cell in cells.values()):
        yield Text(
            f"*: in over {MOST_ALREADY:.0%} of the runs the estimate was so before the switch"
        )


def delay(row: Mapping[str, Any]) -> str:
    """Of the run-averaged mode estimate; the median where every run has its own switches.

    With the share of switches that are missed, and a star where the estimate had been the new
    mode already.
    """
    if row["averaged_delay"] is not None:
        text = str(row["averaged_delay"])
    else:
        median = row["median_delay_steps"]
        text = "never" if math.isinf(median) else f"{median:.0f}"
        text += f" ({row['missed_share']:.0%})" if row["missed_share"] >= 0.005 else ""
    return text + "*" * bool(row["already_share"] > MOST_ALREADY)


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
    table = _plain_table()
    table.add_column(Text(heading), overflow="fold")
    for _, text in metrics:
        text = text.partition(",")[0] if heading.startswith("ratio") else text
        table.add_column(text, justify="right", no_wrap=True)
    for label in labels:
        table.add_row(Text(label), *(figures.get((label, metric), "") for metric, _ in metrics))
    return table


def _published(published: Rows) -> Table:
    table = _plain_table()
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
    empty = [w for w in results.require_complete(path)["windows"] if w not in there]
    said = [f"window '{w}' holds no measured step, so it has no figures" for w in empty]
    return said + _unexpected(results.read_rows(path, "published"))


def surprises_of(record: Mapping[str, Any]) -> list[str]:
    """The same of an analysis' verdicts."""
    return _unexpected(record["published"])


def _unexpected(published: Rows) -> list[str]:
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
