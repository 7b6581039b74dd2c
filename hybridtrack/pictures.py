"""Figures on disk: a run's in its folder, a scenario's chains where asked."""

import json
from pathlib import Path

from hybridtrack import results


def draw_run(folder: Path) -> list[Path]:
    """Draw a finished run's figures from its tables alone, and note in its manifest which.

    Raises UserError where the folder holds no finished run, is damaged or cannot be written.
    """
    from hybridtrack import figures

    manifest = results.require_complete(folder)
    information = figures.RunInformation(
        title=manifest["title"],
        runs=manifest["runs"],
        estimators=tuple(manifest["estimators"]),
        modes=tuple(manifest["modes"]),
        error=manifest["error"],
        compare_with=manifest["compare_with"],
        units=manifest["states"] or None,
    )
    steps, tracks, reliability = (
        results.read_columns(folder, name) for name in ("steps", "tracks", "reliability")
    )
    drawn = figures.draw(steps, tracks, information, reliability)
    paths = figures.save(drawn, folder / results.FIGURES)
    noted = manifest | {"figures": [path.name for path in paths]}
    if noted != manifest and results.read_manifest(folder) == manifest:  # nobody went on meanwhile
        results.write_text(folder / results.MANIFEST, json.dumps(noted, indent=2) + "\n")
    return paths


def are_drawn(folder: Path) -> bool:
    """Whether all figures of the tables as they are were drawn, and are still there."""
    names = results.require_complete(folder).get("figures")
    held = folder / results.FIGURES
    return isinstance(names, list) and all((held / str(name)).exists() for name in names)


def draw_chains(config: str, out: Path | None) -> list[Path]:
    """Draw the state transition diagrams of a scenario's Markov chains, to runs/NAME-chain.

    Raises UserError where the scenario has a mistake, or no chain that could be drawn.
    """
    from hybridtrack import diagrams, figures
    from hybridtrack.config import load

    experiment = load(config)
    drawn = diagrams.draw(diagrams.chains(experiment), experiment.title)
    return figures.save(drawn, out or Path("runs") / f"{experiment.name}-chain")
