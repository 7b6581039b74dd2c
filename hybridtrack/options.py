"""What several commands share: their options, a scenario loaded, its run finished."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridtrack.console import Interrupted, interrupted, say, work_in
from hybridtrack.errors import UserError

if TYPE_CHECKING:
    from hybridtrack.config import Experiment

ScenarioOrRun = Annotated[
    str, typer.Argument(metavar="CONFIG|RUN_DIR", help="A scenario, or a run's folder.")
]
Runs = Annotated[int | None, typer.Option(help="Monte Carlo runs instead of the file's.")]
Seed = Annotated[int | None, typer.Option(help="Random seed instead of the file's.")]
Detect = Annotated[
    str | None,
    typer.Option(metavar="CHANGE", help="As many runs as find a change like 1% unpaired."),
]
Workers = Annotated[
    int | None, typer.Option(min=1, help="Threads; all cores by default. Same bytes for any.")
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY.PATH=VALUE", help="Change a value; may be repeated."),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress on stderr.")]
Json = Annotated[bool, typer.Option("--json", help="Results as JSON on stdout.")]


def load_scenario(
    config: str, settings: Sequence[str], runs: int | None, seed: int | None
) -> "Experiment":
    """The scenario with the options' values; a mistake in one is told under the option's name."""
    from hybridtrack.config import load

    options = {"monte_carlo.runs": ("--runs", runs), "monte_carlo.seed": ("--seed", seed)}
    given = {
        f"{k}={value}": f"{o} {value}" for k, (o, value) in options.items() if value is not None
    }
    try:
        return load(config, [*settings, *given])
    except UserError as error:
        sentence = str(error)
        for setting, option in given.items():
            sentence = sentence.replace(f"--set {setting}:", f"{option}:")
        raise UserError(sentence) from None


def finish(experiment: "Experiment", folder: Path, workers: int | None, quiet: bool) -> bool:
    """Run what isn't finished in its folder yet; False where there was nothing to do."""
    from hybridtrack import experiment as experiments
    from hybridtrack.executors import available_cores
    from hybridtrack.progress import progress

    work_in(folder)
    if experiments.is_complete(folder, experiment):
        return False
    if not quiet:
        _say_if_compiling()
    try:
        with progress(quiet) as report:
            experiments.run(experiment, folder, workers or available_cores(), report)
    except Interrupted:
        interrupted(_what_is_kept(folder))
    return True


def _what_is_kept(folder: Path) -> str:
    if any((folder / "shards").glob("*.npz")):
        return f"; finished shards are kept in {folder}: the same command goes on there"
    return "; no shard was finished yet: the same command starts anew"


def _say_if_compiling() -> None:
    """Tell why the first use takes a while."""
    from hybridtrack.compiled import kernels_are_cached

    if not kernels_are_cached():
        say(
            "compiling the kernels, once for this version: ten to twenty seconds (an interruption "
            "waits for it)"
        )


def finished_run(
    config: str,
    settings: Sequence[str],
    runs: int | None,
    seed: int | None,
    detect: str | None,
    workers: int | None,
    quiet: bool,
) -> Path:
    """The folder of a finished run: the one named, or the scenario's, which is run if need be."""
    from hybridtrack import experiment as experiments
    from hybridtrack.results import require_complete

    if is_run(config):
        if runs is not None or seed is not None or detect is not None or settings:
            raise UserError(
                f"{config}: this run is finished; --runs, --seed, --detect and --set are for a "
                "scenario"
            )
        require_complete(Path(config))
        return Path(config)
    if runs is not None and detect is not None:
        raise UserError("--runs and --detect both say how many runs; give one of them")
    experiment = load_scenario(config, settings, runs, seed)
    if detect is not None:
        from hybridtrack.studies import reports

        pilot = experiment._replace(runs=min(experiment.runs, reports.PILOT_RUNS))
        folder = experiments.default_folder(pilot)
        finish(pilot, folder, workers, quiet)
        number, decides = reports.runs_wanted(folder, detect)
        if not quiet:
            say(f"{number:,} runs find a change of {detect}, unpaired; {decides} decides")
        experiment = load_scenario(config, settings, number, seed)
    return exact_run(experiment, workers, quiet)


def exact_run(experiment: "Experiment", workers: int | None, quiet: bool) -> Path:
    """The folder of a finished run of just as many runs as are asked for."""
    from hybridtrack import experiment as experiments
    from hybridtrack.results import require_complete

    folder = experiments.default_folder(experiment)
    longer = experiments.is_complete(folder, experiment)
    if longer and require_complete(folder)["runs"] != experiment.runs:  # not what is asked for
        folder = folder.with_name(f"{folder.name}-{experiment.runs}")
    finish(experiment, folder, workers, quiet)
    return folder


def is_run(config: str) -> bool:
    """Whether a folder is meant, and no shipped scenario whose name it has by chance."""
    from hybridtrack.config import shipped
    from hybridtrack.results import read_manifest

    path = Path(config)
    return path.is_dir() and (config not in shipped() or read_manifest(path) is not None)
