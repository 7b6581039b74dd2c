"""The ledger of published figures: claim by claim, what the paper prints and what we get."""

from collections.abc import Sequence
from pathlib import Path

from hybridtrack import results
from hybridtrack.tables import claimed, obtained

HEADER = (
    "| scenario | published claim | published | ours | verdict |\n| --- | --- | --- | --- | --- |\n"
)


def markdown(folders: Sequence[Path]) -> str:
    """A Markdown table over finished run folders. Raises UserError where one isn't."""
    lines = [HEADER]
    for folder in folders:
        name = results.require_complete(folder)["name"]
        for row in results.read_rows(folder, "published"):
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
