"""The command line: parse, call, print. Everything heavy is imported where it is used."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridtrack.console import Interrupted, app, command, interrupted, run_app, say, work_in
from hybridtrack.errors import UserError

if TYPE_CHECKING:
    from hybridtrack.config import Experiment

__all__ = ["app", "main"]

# What several commands take.
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


def main() -> None:
    """Entry point of the console script."""
    run_app()


@command(
    "hybridtrack run configs/rmimm_fig5.yaml",
    "hybridtrack run rmimm_fig5 --runs 20000 --workers 2",
    "hybridtrack run rmimm_fig5 --set sensor.position_std_m=10 --out runs/quieter",
)
def run(
    config: Annotated[str, typer.Argument(help="A scenario's file, or a shipped one's name.")],
    runs: Runs = None,
    seed: Seed = None,
    workers: Workers = None,
    out: Annotated[Path | None, typer.Option(help="Folder instead of runs/NAME-DIGEST.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Repeat a run that is there.")] = False,
    set_: Settings = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Run a scenario and print its table, its verdicts and its folder.

    A complete run is shown, not repeated. More runs go on from it, and the same command from an
    interrupted one: whole shards (2,048 runs of one case) are kept.
    """
    from hybridtrack import experiment as experiments
    from hybridtrack import pictures, results

    experiment = _load(config, set_ or (), runs, seed)
    folder = out if out is not None else experiments.default_folder(experiment)
    if force:
        results.clear(folder, experiments.digest(experiment))
    if not _finish(experiment, folder, workers, quiet) and not quiet:
        _say_complete(folder, experiment.runs)
    if not pictures.are_drawn(folder):
        if not quiet:
            say("drawing figures")
        try:
            pictures.draw_run(folder)
        except Interrupted:
            interrupted(f"; {folder} is complete but for figures: the same command draws them")
    print_run(folder, json)


def _finish(experiment: "Experiment", folder: Path, workers: int | None, quiet: bool) -> bool:
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


def _load(config: str, settings: Sequence[str], runs: int | None, seed: int | None) -> "Experiment":
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


def _what_is_kept(folder: Path) -> str:
    if any((folder / "shards").glob("*.npz")):
        return f"; finished shards are kept in {folder}: the same command goes on there"
    return "; no shard was finished yet: the same command starts anew"


def _say_complete(folder: Path, asked: int) -> None:
    from hybridtrack.results import require_complete

    there = require_complete(folder)["runs"]
    more = f"; it holds {there:,} runs, you asked for {asked:,}" if there != asked else ""
    say(f"complete already: {folder} is shown, not repeated (--force repeats it){more}")


def _say_if_compiling() -> None:
    """Tell why the first use takes a while."""
    from hybridtrack.compiled import kernels_are_cached

    if not kernels_are_cached():
        say(
            "compiling the kernels, once for this version: ten to twenty seconds (an interruption "
            "waits for it)"
        )


def print_run(folder: Path, json: bool) -> None:
    """A finished run on stdout; on stderr what should not be overlooked."""
    from hybridtrack import tables

    for sentence in tables.surprises(folder):
        say(f"warning: {sentence}")
    if json:
        import json as encoder

        print(encoder.dumps(tables.as_json(folder), indent=2, allow_nan=False))
        return
    from rich.console import Console

    console = Console(highlight=False)
    tables.show(folder, console)
    print(f"figures: {folder / 'figures'}")
    print(folder)


@command("hybridtrack init", "hybridtrack init two_turns --force")
def init(
    name: Annotated[str, typer.Argument(help="Name of the scenario and of its file.")] = "scenario",
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
) -> None:
    """Write a commented starter scenario, NAME.yaml, ready to run."""
    import re

    from hybridtrack.results import write_text

    if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name):
        raise UserError(f"'{name}' is no name for a scenario: use letters, digits, _ and - only")
    path = Path(f"{name}.yaml")
    if path.exists() and not force:
        raise UserError(f"{path}: there is such a file already; choose another name, or --force")
    starter = (Path(__file__).parent / "starter.yaml").read_text(encoding="utf-8")
    write_text(path, starter.replace("name: scenario", f"name: {name}", 1))
    print(path)
    say(f"now: hybridtrack run {path}")


@command("hybridtrack validate configs/rmimm_fig5.yaml", "hybridtrack validate configs/*.yaml")
def validate(
    config: Annotated[list[str], typer.Argument(help="Scenarios' files, or shipped ones' names.")],
) -> None:
    """Check scenarios without running them.

    Exits with 2 if one has a mistake.
    """
    from hybridtrack import config as scenarios
    from hybridtrack.tables import counted

    mistakes = 0
    for one in config:
        try:
            experiment = scenarios.load(one)
        except UserError as error:
            say(f"error: {error}")
            mistakes += 1
            continue
        steps = sum(len(case.times_s) - 1 for case in experiment.cases)
        print(
            f"{one}: ok ({counted(len(experiment.cases), 'case')}, {counted(steps, 'step')}, "
            f"{counted(experiment.runs, 'run')}, "
            f"{counted(len(experiment.estimators), 'estimator')})"
        )
    if mistakes:
        raise typer.Exit(2)


@command(
    "hybridtrack plot runs/rmimm_fig5-0123456789",
    "hybridtrack plot --chain rmimm_fig5 --out pictures",
)
def plot(
    run_dir: Annotated[
        Path | None, typer.Argument(help="A run folder, as `run` printed it.")
    ] = None,
    chain: Annotated[
        str | None,
        typer.Option(metavar="CONFIG", help="Draw this scenario's Markov chains instead."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="With --chain: folder instead of runs/NAME-chain.")
    ] = None,
) -> None:
    """Draw a run's figures again, or a scenario's Markov chains.

    A run's figures are drawn from its folder alone. --chain takes a scenario's file, or a shipped
    one's name, and draws the state transition diagrams of its truth and estimators, whose modes may
    be bounded in how often they change.
    """
    if run_dir is not None and chain is not None:
        raise UserError(f"{run_dir} and --chain {chain} are two things to draw; give one of them")
    from hybridtrack import pictures

    if chain is not None:
        paths = pictures.draw_chains(chain, out)
    elif run_dir is None:
        raise UserError("there is nothing to draw; give a run folder, or a scenario to --chain")
    elif out is not None:
        raise UserError(f"--out {out}: a run's figures go to its own folder; leave --out away")
    else:
        paths = pictures.draw_run(run_dir)
    for path in paths:
        print(path)


@command("hybridtrack list", "hybridtrack list motions", name="list")
def list_(
    what: Annotated[
        str | None, typer.Argument(help="One kind only: estimators, motions, ...")
    ] = None,
) -> None:
    """List estimators, motions, metrics, shipped scenarios."""
    from hybridtrack.catalogue import catalogue

    kinds = catalogue()
    if what is not None and what not in kinds:
        raise UserError(f"there is no list of '{what}'; there are {', '.join(kinds)}")
    for kind, entries in kinds.items():
        if what in (None, kind):
            print(f"{kind}:")
            width = max((len(name) for name in entries), default=0)
            for name, summary in entries.items():
                print(f"  {name:<{width}}  {summary}")
            if not entries:
                print("  none in this version")


@command("hybridtrack schema > scenario.schema.json")
def schema() -> None:
    """Print the JSON Schema of a scenario, for editors."""
    import json as encoder

    from hybridtrack.config import json_schema

    print(encoder.dumps(json_schema(), indent=2))


@command("hybridtrack ledger runs/rmimm_fig5-0123456789")
def ledger(
    run_dir: Annotated[list[Path], typer.Argument(help="Finished run folders.")],
) -> None:
    """Print published figures and their verdicts in Markdown."""
    from hybridtrack.studies.ledger import markdown

    print(markdown(run_dir), end="")


@command(
    "hybridtrack baseline softbound_ex1 -o tests/baselines/softbound_ex1.parquet --runs 1000",
    "hybridtrack baseline my_scenario.yaml -o my_scenario.parquet --detect 1%",
)
def baseline(
    config: ScenarioOrRun,
    output: Annotated[Path, typer.Option("--output", "-o", help="The baseline's file.")],
    runs: Runs = None,
    seed: Seed = None,
    detect: Detect = None,
    workers: Workers = None,
    set_: Settings = None,
    quiet: Quiet = False,
) -> None:
    """Write a baseline, which `check` compares with.

    It is a file to be committed: the summary and, so that runs of one seed can be paired, every
    run's sums.
    """
    from hybridtrack.studies import baselines

    folder = _run_of(config, set_ or (), runs, seed, detect, workers, quiet)
    if output.resolve().parent == folder.resolve():
        raise UserError(f"{output}: this lies in the run's own folder; name a file elsewhere")
    baselines.write(folder, output)
    print(output)


@command(
    "hybridtrack check softbound_ex1 --against tests/baselines/softbound_ex1.parquet",
    "hybridtrack check runs/softbound_ex1-0123456789 --against softbound_ex1.parquet --junit r.xml",
)
def check(
    config: ScenarioOrRun,
    against: Annotated[Path, typer.Option(metavar="BASELINE", help="What `baseline` wrote.")],
    runs: Annotated[
        int | None, typer.Option(help="Monte Carlo runs; the baseline's by default.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Random seed; the baseline's by default, to be paired.")
    ] = None,
    detect: Detect = None,
    family_error: Annotated[
        float, typer.Option(help="Chance that any figure cries wolf, or a detectable change isn't.")
    ] = 1e-6,
    workers: Workers = None,
    set_: Settings = None,
    all_: Annotated[bool, typer.Option("--all", help="Print every window's figures.")] = False,
    json: Json = False,
    junit: Annotated[Path | None, typer.Option(help="Write JUnit XML to this file.")] = None,
    markdown: Annotated[Path | None, typer.Option(help="Write a Markdown table to it.")] = None,
    quiet: Quiet = False,
) -> None:
    """Compare a run with a baseline.

    Exits with 1 if any figure is worse. With the baseline's seed runs are compared pair by pair,
    and the same sources on the same kind of machine have to give the same figures. Otherwise every
    figure is tested, with the chance that any of them cries wolf bounded.
    """
    from hybridtrack.studies import baselines, reports

    if not 1e-12 <= family_error <= 0.5:
        raise UserError(f"--family-error {family_error:g}: give a chance from 1e-12 to 0.5")
    for file in (junit, markdown):
        if file is not None and file.resolve() == against.resolve():
            raise UserError(f"{file}: this is the baseline itself; name another file")
    wanted = baselines.read(against)
    if not _is_run(config):
        if detect is not None and seed in (None, wanted.seed):
            raise UserError(
                f"--detect {detect}: with the baseline's own seed only its {wanted.runs:,} runs "
                "are compared, pair by pair; give another with --seed"
            )
        runs = wanted.runs if runs is None and detect is None else runs
        seed = wanted.seed if seed is None else seed
    folder = _run_of(config, set_ or (), runs, seed, detect, workers, quiet)
    report = reports.held_against(folder, wanted, family_error)
    for file, text in ((junit, reports.as_junit), (markdown, reports.as_markdown)):
        if file is not None:
            _put(file, text(report))
    print(reports.as_json(report) if json else reports.as_text(report, everything=all_), end="")
    if report.failed:
        raise typer.Exit(1)


def _run_of(
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

    if _is_run(config):
        if runs is not None or seed is not None or detect is not None or settings:
            raise UserError(
                f"{config}: this run is finished; --runs, --seed, --detect and --set are for a "
                "scenario"
            )
        require_complete(Path(config))
        return Path(config)
    if runs is not None and detect is not None:
        raise UserError("--runs and --detect both say how many runs; give one of them")
    experiment = _load(config, settings, runs, seed)
    if detect is not None:
        from hybridtrack.studies import reports

        pilot = experiment._replace(runs=min(experiment.runs, reports.PILOT_RUNS))
        folder = experiments.default_folder(pilot)
        _finish(pilot, folder, workers, quiet)
        number, decides = reports.runs_wanted(folder, detect)
        if not quiet:
            say(f"{number:,} runs find a change of {detect}, unpaired; {decides} decides")
        experiment = _load(config, settings, number, seed)
    folder = experiments.default_folder(experiment)
    longer = experiments.is_complete(folder, experiment)
    if longer and require_complete(folder)["runs"] != experiment.runs:  # not what is asked for
        folder = folder.with_name(f"{folder.name}-{experiment.runs}")
    _finish(experiment, folder, workers, quiet)
    return folder


def _is_run(config: str) -> bool:
    """Whether a folder is meant, and no shipped scenario whose name it has by chance."""
    from hybridtrack.config import shipped
    from hybridtrack.results import read_manifest

    path = Path(config)
    return path.is_dir() and (config not in shipped() or read_manifest(path) is not None)


def _put(file: Path, text: str) -> None:
    """Write a report: whole or not at all, but into what is no regular file, such as a pipe."""
    from hybridtrack.results import write_text

    if file.exists() and not file.is_file() and not file.is_dir():
        with file.open("a", encoding="utf-8") as stream:
            stream.write(text)
    else:
        write_text(file, text)
