"""The README's generated parts: what the commands print today. `make ledger` writes them."""

import contextlib
import io
import re
import sys
import tempfile
from pathlib import Path

from rich.console import Console

from hybridtrack import (
    config,
    dossiers,
    results,
    tables,
    tables_of_analyses,
    tables_of_sets,
    typesetting,
)
from hybridtrack.analyses import analyses
from hybridtrack.studies.ledger import markdown
from shipped import Shipped

README = Path(__file__).parent.parent / "README.md"
PART = re.compile(r"(<!-- generated: (?P<what>[^>]+) -->\n)(?P<text>.*?)(<!-- end -->)", re.DOTALL)
SHOWN = ("rmimm_fig5", "recorded_flight")
ANALYSED = {
    "delay": "mode_delay_fig4",
    "observability": "observability_turns",
    "operating-points": "switched_esmf",
}  # whose output is shown
EXAMPLES = {  # of Sigalov 2011, and what the truth is in each
    "softbound_ex1": "a soft bound",
    "softbound_ex2": "at most 4 transitions",
    "softbound_ex3": "no bound",
}
YARDSTICKS = {  # the same, with the most probable sequences on the truth's own chain besides
    "softbound_ex1+BEST": "a soft bound",
    "softbound_ex3+BEST": "no bound",
}


def finished_runs(shipped: Shipped) -> dict[str, Path]:
    """Every scenario that the README shows or that has published claims, at its full size."""
    folders = {}
    for name in config.shipped():
        if name in SHOWN or config.load(name).claims:
            folders[name] = shipped.run(name)
    for name, bound in (
        ("softbound_ex1", ", continuation_probability: 0.98"),
        ("softbound_ex3", ""),
    ):
        best = f"estimators.BEST={{type: best_sequences{bound}}}"
        folders[f"{name}+BEST"] = shipped.run(
            name, "monte_carlo.runs=2400", best, "compare_with=BEST"
        )
    return folders | finished_analyses(shipped)


def finished_analyses(shipped: Shipped) -> dict[str, Path]:
    """Every analysis that is shown, or that claims are on; `analyze NAME SCENARIO` by its words."""
    found = {}
    for name in config.shipped():
        claimed = {claim.analysis for claim in config.load(name).analysis_claims}
        for analysis in analyses():
            if analysis in claimed or ANALYSED.get(analysis) == name:
                found[f"analyze {analysis} {name}"], _ = shipped.analysis(name, analysis)
    return found


def generated(what: str, folders: dict[str, Path]) -> str:
    """The text of one part."""
    if what == "ledger":
        claimed = [folders[n] for n in config.shipped() if config.load(n).claims]
        claimed += [folder for words, folder in folders.items() if words.startswith("analyze ")]
        return "\n" + markdown(claimed) + "\n"
    if what.startswith("sets of "):
        return "\n" + sets(folders[what.removeprefix("sets of ")]) + "\n"
    if what == "ratios to the genie":
        return "\n" + ratios(folders, EXAMPLES, ("SBF", "HBF", "IMM", "KF_m2")) + "\n"
    if what == "ratios to the best sequences":
        return "\n" + ratios(folders, YARDSTICKS, ("genie", "SBF", "HBF", "IMM")) + "\n"
    out = io.StringIO()
    if what.startswith("hybridtrack analyze "):
        words = what.removeprefix("hybridtrack ")
        words = words if words in folders else f"{words} {ANALYSED[words.split()[1]]}"
        record = dossiers.read(folders[words])
        assert record is not None
        console = Console(file=out, width=80, highlight=False, no_color=True)
        tables_of_analyses.show_analysis(record | {"published": []}, console)
        folder = f"runs/{record['scenario']}-{record['analysis']}-DIGEST"
        lines = [line.rstrip() for line in out.getvalue().splitlines()]
        lines += ["..."] * bool(record["published"])  # the verdicts, which the ledger has
        lines += [f"figures: {folder}/figures", folder]
        return "\n".join(["```text", f"$ {what}", *lines, "```", ""])
    name = what.removeprefix("hybridtrack run ")
    tables.show(folders[name], Console(file=out, width=80, highlight=False, no_color=True))
    lines = [line.rstrip() for line in out.getvalue().splitlines()]
    lines += [f"figures: runs/{name}-DIGEST/figures", f"runs/{name}-DIGEST"]
    return "\n".join(["```text", f"$ {what}", *lines, "```", ""])


def sets(folder: Path) -> str:
    """What came of the sets of a run's estimators."""
    rows = results.read_rows(folder, "sets")
    found = {(row["estimator"], row["figure"]): row for row in rows}
    heads = [heading for _, heading in tables_of_sets.OUTCOMES] + ["largest error"]
    units = results.require_complete(folder)["states"]
    heads += [f"bound on {state}, {unit}" for state, unit in units.items()]
    lines = [f"| | {' | '.join(heads)} |", "| --- " * (len(heads) + 1) + "|"]
    for label in dict.fromkeys(row["estimator"] for row in rows):
        cells = [f"{found[label, figure]['value']:,.0f}" for figure, _ in tables_of_sets.OUTCOMES]
        cells.append(tables_of_sets.largest(found[label, "largest_normalised_error"]["value"]))
        medians = [found[label, tables_of_sets.MEDIAN_BOUND + state] for state in units]
        cells += [typesetting.figure(row["value"], row["standard_error"]) for row in medians]
        lines.append(f"| `{label}` | {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def ratios(folders: dict[str, Path], scenarios: dict[str, str], labels: tuple[str, ...]) -> str:
    """Mean square errors over those of the estimator compared with, position and velocity."""
    lines = [f"| scenario | | {' | '.join(labels)} |", "| --- " * (len(labels) + 2) + "|"]
    for name, said in scenarios.items():
        found = {
            (row["first"], row["metric"]): typesetting.figure(
                row["ratio"], row["ratio_standard_error"]
            )
            for row in results.read_rows(folders[name], "comparisons")
            if row["window"] == "all"
        }
        metrics = ("position_mse_m2", "velocity_mse_m2_s2")
        cells = [" / ".join(found[label, metric] for metric in metrics) for label in labels]
        lines.append(f"| `{name.removesuffix('+BEST')}` | {said} | {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def renewed(text: str, folders: dict[str, Path]) -> str:
    """The README with its generated parts made anew."""
    return PART.sub(lambda m: m[1] + generated(m["what"], folders) + m[4], text)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        README.write_text(
            renewed(README.read_text("utf-8"), finished_runs(Shipped(Path(temporary)))), "utf-8"
        )
    with contextlib.suppress(BrokenPipeError):
        sys.stdout.write(f"{README.name} renewed\n")
