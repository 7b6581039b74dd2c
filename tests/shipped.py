"""Shipped scenarios as shipped, run and analysed once for all that look at them."""

from pathlib import Path
from typing import Any

from hybridtrack import config, experiment
from hybridtrack.analyses import analyses
from hybridtrack.studies import analysis as studies


class Shipped:
    """Their folders, each made when it is first asked for; they are to be read only."""

    def __init__(self, root: Path):
        self.root = root
        self._runs: dict[tuple[str, ...], Path] = {}
        self._analyses: dict[tuple[str, str], tuple[Path, dict[str, Any]]] = {}

    def run(self, name: str, *settings: str) -> Path:
        """The run of a scenario at its full size, after `key.path=value` settings."""
        asked = (name, *settings)
        if asked not in self._runs:
            folder = self.root / f"{name}-{len(self._runs)}"
            experiment.run(config.load(name, settings), folder, 2, lambda done, total: None)
            self._runs[asked] = folder
        return self._runs[asked]

    def analysis(self, name: str, analysis: str) -> tuple[Path, dict[str, Any]]:
        """An analysis of a scenario, of its run where it wants one: folder, and analysis.json."""
        if (name, analysis) not in self._analyses:
            one, loaded, run = analyses()[analysis], config.load(name), None
            if one.wants_run is not None:
                wanted = one.wants_run(loaded)
                loaded, run = config.load(name, wanted), self.run(name, *wanted)
            folder = self.root / f"{name}-{analysis}"
            self._analyses[name, analysis] = folder, studies.analyse(loaded, one, folder, run)
        return self._analyses[name, analysis]
