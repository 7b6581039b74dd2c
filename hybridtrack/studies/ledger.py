"""The ledger of published figures: claim by claim, what the paper prints and what we get."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hybridtrack import dossiers, results
from hybridtrack.tables import claimed, obtained

HEADER = (
    "| scenario | published claim | published | ours | verdict |\n| --- | --- | --- | --- | --- |\n"
)


def markdown(folders: Sequence[Path]) -> str:
    """A Markdown table over folders of finished runs and analyses.

    Raises UserError where one isn't.
    """
    lines = [HEADER]
    for folder in folders:
        name, rows = _published(folder)
        for row in rows:
            because = f": {row['because']}" if row["because"] else ""
            cells = (
                name,
                row["claim"],
                claimed(row),
                obtained(row),
                f"**{row['verdict']}**{because}",
            )
            lines.append(f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |\n")
    return "".join(lines)


def _published(folder: Path) -> tuple[str, list[dict[str, Any]]]:
    """The scenario, and what became of its claims."""
    record = dossiers.read(folder)
    if record is not None:
        return record["scenario"], record["published"]
    return results.require_complete(folder)["name"], results.read_rows(folder, "published")
