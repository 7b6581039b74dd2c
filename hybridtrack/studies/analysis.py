"""An analysis of a scenario from its numbers to its folder: the run it wants, verdicts, figures."""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hybridtrack import __version__, charts, dossiers, figures, results
from hybridtrack import experiment as experiments
from hybridtrack.analyses import Analysis, Findings, Measured, Table
from hybridtrack.config import Experiment, dump
from hybridtrack.errors import UserError
from hybridtrack.verdicts import UNDECIDED, AnalysisClaim, Interval, K, judge_interval


def digest(experiment: Experiment, analysis: Analysis) -> str:
    """What an analysis' folder is named by: the scenario, its settings for it, our sources."""
    mine = [c for c in experiment.analysis_claims if c.analysis == analysis.name]
    claims = [str(c._replace(place="")) for c in mine]
    settings = experiment.analyses[analysis.name]._asdict()
    asked = [analysis.name, settings, claims, experiments.digest(experiment)]
    if analysis.wants_run is not None:
        asked.append(experiment.runs)
    return hashlib.sha256(json.dumps(asked).encode()).hexdigest()[:10]


def default_folder(experiment: Experiment, analysis: Analysis, root: Path = Path("runs")) -> Path:
    """Where an analysis goes that isn't told otherwise."""
    return root / f"{experiment.name}-{analysis.name}-{digest(experiment, analysis)}"


def measured(run: Path) -> Measured:
    """What a finished run of the scenario says."""
    return Measured(
        runs=results.require_complete(run)["runs"],
        delays=results.read_rows(run, "delays"),
        delay_distribution=results.read_rows(run, "delay_distribution"),
        steps=results.read_columns(run, "steps"),
    )


def finished(experiment: Experiment, analysis: Analysis, folder: Path) -> dict[str, Any] | None:
    """What analysis.json holds, where this analysis of this scenario is finished in a folder."""
    record = dossiers.read(folder)
    if record is None or record["digest"] != digest(experiment, analysis):
        return None
    drawn = all((folder / results.FIGURES / name).exists() for name in record["figures"])
    return record if drawn else None


def forget(folder: Path) -> None:
    """Have a finished analysis repeated. Raises UserError where the folder is another's."""
    dossiers.clear(folder)


def analyse(
    experiment: Experiment, analysis: Analysis, folder: Path, run: Path | None
) -> dict[str, Any]:
    """Analyse a scenario into a folder; gives what analysis.json holds.

    run: the finished run that the analysis wants. Raises UserError where the scenario cannot be
    analysed, or the folder is another's.
    """
    analysis.check(experiment)
    own = digest(experiment, analysis)
    dossiers.prepare(folder, own)
    settings = experiment.analyses[analysis.name]
    findings = analysis.analyse(experiment, settings, None if run is None else measured(run))
    dossiers.write(folder, findings.table, findings.tables, dump(experiment.resolved))
    drawn = charts.draw(findings.charts, experiment.title)
    paths = figures.save(drawn, folder / results.FIGURES)
    record = {
        "analysis": analysis.name,
        "scenario": experiment.name,
        "title": experiment.title,
        "summary": analysis.summary,
        "source": analysis.source,
        "digest": own,
        "version": __version__,
        "settings": settings._asdict(),
        "run": None if run is None else str(run),
        "table": dossiers.rows(findings.table),
        "shown": [
            {"name": name, "columns": {heading: list(cells) for heading, cells in shown.items()}}
            for name, shown in _shown_tables(findings)
        ],
        "tables": {name: dossiers.rows(table) for name, table in findings.tables.items()},
        "conclusions": list(findings.conclusions),
        "notes": [*findings.notes, *(f"assumed: {text}" for text in experiment.assumptions)],
        "published": _published(experiment, analysis, findings),
        "figures": [path.name for path in paths],
    }
    dossiers.finish(folder, record)
    return dict(dossiers.finite(record))


def _shown_tables(findings: Findings) -> Iterator[tuple[str, Mapping[str, Sequence[str]]]]:
    """What is printed: the main table, then those of the others that show something, by name."""
    for name, table in {"": findings.table, **findings.tables}.items():
        if table.shown:
            yield name, table.shown


# ---- published figures -----------------------------------------------------------------------


def _published(
    experiment: Experiment, analysis: Analysis, findings: Findings
) -> list[dict[str, Any]]:
    """What became of the claims on this analysis, in the columns of a run's `published`."""
    rows = []
    assumed = bool(experiment.assumptions)
    for claim in experiment.analysis_claims:
        if claim.analysis != analysis.name:
            continue
        ours = _interval(claim, claim.where, findings.table)
        if claim.than is not None:
            other = _interval(claim, claim.than, findings.table)
            ours = _difference(ours, other)
        verdict = judge_interval(claim, ours, assumed)
        rows.append(
            {
                "claim": claim.claim,
                "estimator": _words(claim.where, claim.than),
                "metric": claim.figure,
                "window": f"analyze {analysis.name}",
                "published": claim.value,
                "tolerance": claim.tolerance if claim.value is not None else None,
                "sign": claim.sign,
                "ours": ours.value,
                "standard_error": max(ours.high - ours.low, 0.0) / (2 * K),
                "shown": _shown(claim, ours),
                "verdict": verdict,
                "expected_verdict": claim.expect,
                "differs": verdict not in (claim.expect, UNDECIDED),
                "because": claim.because,
            }
        )
    return rows


def _words(where: Mapping[str, Any], than: Mapping[str, Any] | None) -> str:
    words = ", ".join(f"{key} {value}" for key, value in where.items())
    return words if than is None else f"{words} / {_words(than, None)}"


def _shown(claim: AnalysisClaim, ours: Interval) -> str:
    """Our figure in words: infinity is never."""
    if math.isnan(ours.value):
        return "none"
    value = "never" if math.isinf(ours.value) else f"{ours.value:.5g}"
    if claim.than is not None:
        value = f"Δ = {ours.value:.5g}"
    if ours.low != ours.high:
        value += f" ({ours.low:.5g} to {ours.high:.5g})"
    return value


def _difference(first: Interval, second: Interval) -> Interval:
    """First less second; two that never come are equally late."""
    if math.isinf(first.value) and first.value == second.value:
        return Interval(0.0, 0.0, 0.0)
    low, high = first.low - second.high, first.high - second.low
    value = first.value - second.value
    return Interval(value, value if math.isnan(low) else low, value if math.isnan(high) else high)


def _interval(claim: AnalysisClaim, where: Mapping[str, Any], table: Table) -> Interval:
    """The figure of the one row that has these cells, and what chance allows it."""
    found = dossiers.rows(table)
    unknown = [name for name in (*where, claim.figure) if name not in table.columns]
    if unknown:
        raise UserError(
            f"{claim.place}: the table of {claim.analysis} has no column '{unknown[0]}'; it has "
            f"{', '.join(table.columns)}"
        )
    rows = [row for row in found if all(row[name] == value for name, value in where.items())]
    if len(rows) != 1:
        how_many = "no row" if not rows else f"{len(rows)} rows"
        raise UserError(
            f"{claim.place}: the table of {claim.analysis} has {how_many} with "
            f"{_words(where, None) or 'nothing asked for'}; 'where' has to tell one"
        )
    row, name = rows[0], claim.figure
    if isinstance(row[name], str):
        raise UserError(f"{claim.place}: '{name}' is a text ({row[name]}); name a figure")
    value = math.nan if row[name] is None else float(row[name])
    error = row.get(f"{name}_standard_error")
    if f"{name}_low" in row and row[f"{name}_low"] is not None:
        return Interval(value, float(row[f"{name}_low"]), float(row[f"{name}_high"]))
    if error is not None and math.isfinite(error):
        return Interval(value, value - K * error, value + K * error)
    return Interval(value, value, value)
