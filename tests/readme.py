"""The README's generated parts: what the commands print today. `make ledger` writes them."""

import contextlib
import io
import re
import sys
import tempfile
from pathlib import Path

from rich.console import Console

from hybridtrack import config, experiment, tables
from hybridtrack.studies.ledger import markdown

README = Path(__file__).parent.parent / "README.md"
PART = re.compile(r"(<!-- generated: (?P<what>[^>]+) -->\n)(?P<text>.*?)(<!-- end -->)", re.DOTALL)
RECORDED, FIGURE_5 = "recorded_flight", "rmimm_fig5"


def finished_runs(root: Path) -> dict[str, Path]:
    """Every scenario that the README shows, run at its full size."""
    folders = {}
    for name in (FIGURE_5, RECORDED):
        folders[name] = root / name
        experiment.run(config.load(name), folders[name], 2, lambda done, total: None)
    return folders


def generated(what: str, folders: dict[str, Path]) -> str:
    """The text of one part."""
    if what == "ledger":
        return "\n" + markdown([folders[FIGURE_5]]) + "\n"
    name = what.removeprefix("hybridtrack run ")
    out = io.StringIO()
    tables.show(folders[name], Console(file=out, width=80, highlight=False, no_color=True))
    lines = [line.rstrip() for line in out.getvalue().splitlines()]
    lines += [f"figures: runs/{name}-DIGEST/figures", f"runs/{name}-DIGEST"]
    return "\n".join(["```text", f"$ {what}", *lines, "```", ""])


def renewed(text: str, folders: dict[str, Path]) -> str:
    """The README with its generated parts made anew."""
    return PART.sub(lambda m: m[1] + generated(m["what"], folders) + m[4], text)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        README.write_text(
            renewed(README.read_text("utf-8"), finished_runs(Path(temporary))), "utf-8"
        )
    with contextlib.suppress(BrokenPipeError):
        sys.stdout.write(f"{README.name} renewed\n")
