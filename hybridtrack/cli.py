"""The command line: parse, call, print. Everything heavy is imported where it is used."""

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from hybridtrack import __version__
from hybridtrack.errors import UserError

app = typer.Typer(
    name="hybridtrack",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 80},
    epilog="Examples:\n\n  hybridtrack run rmimm_fig5\n\n  hybridtrack init my_scenario",
)

Function = TypeVar("Function", bound=Callable[..., Any])


def main() -> None:
    """Entry point of the console script."""
    try:
        app()
    except KeyboardInterrupt:
        _interrupted()
    except BrokenPipeError:  # the reader of a pipe went away (| head)
        sys.stderr.close()
        sys.exit(141)


def say(text: str) -> None:
    """A line for the person, not for the pipe."""
    print(text, file=sys.stderr, flush=True)


def _interrupted(hint: str = "") -> None:
    say(f"interrupted{hint}")
    sys.exit(130)


def command(*examples: str, name: str | None = None) -> Callable[[Function], Function]:
    """A command: its mistakes are one sentence on stderr, its help ends in examples."""

    def register(function: Function) -> Function:
        @functools.wraps(function)
        def guarded(*arguments: Any, **options: Any) -> Any:
            try:
                return function(*arguments, **options)
            except UserError as error:
                say(f"error: {error}")
            raise typer.Exit(2)

        epilog = "Examples:\n\n" + "\n\n".join(f"  {example}" for example in examples)
        app.command(name=name, epilog=epilog)(guarded)
        return function

    return register


def _version(wanted: bool) -> None:
    if wanted:
        print(f"hybridtrack {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """State estimation in stochastic hybrid systems: one YAML scenario in, tables and figures
    out. Results go to stdout, progress and errors to stderr; bad input exits with 2."""


@command(
    "hybridtrack run configs/rmimm_fig5.yaml",
    "hybridtrack run rmimm_fig5 --runs 20000 --workers 2",
    "hybridtrack run rmimm_fig5 --set sensor.position_std_m=10 --out runs/quieter",
)
def run(
    config: Annotated[str, typer.Argument(help="A scenario's file, or a shipped one's name.")],
    runs: Annotated[
        int | None, typer.Option(help="Monte Carlo runs instead of the file's.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Random seed instead of the file's.")] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Threads; all cores by default. Same bytes for any.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder instead of runs/NAME-DIGEST.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Repeat a run that is there.")] = False,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY.PATH=VALUE", help="Change a value; may be repeated."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress on stderr.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Results as JSON on stdout.")] = False,
) -> None:
    """Run a scenario and print its table, its verdicts and its folder.

    A complete run is shown, not repeated; more runs continue it, and so does the same command
    after an interruption.
    """
    if not quiet:
        _say_if_compiling()
    from hybridtrack import config as scenarios
    from hybridtrack import experiment as experiments
    from hybridtrack import results
    from hybridtrack.executors import available_cores
    from hybridtrack.progress import progress

    settings = list(set_ or [])
    settings += [f"monte_carlo.runs={runs}"] if runs is not None else []
    settings += [f"monte_carlo.seed={seed}"] if seed is not None else []
    experiment = scenarios.load(config, settings)
    folder = out if out is not None else experiments.default_folder(experiment)
    try:
        if force:
            results.clear(folder, experiments.digest(experiment))
        if experiments.is_complete(folder, experiment):
            if not quiet:
                say(f"complete already: {folder} is shown, not repeated (--force repeats it)")
            if not any((folder / "figures").glob("*.png")):
                draw_figures(folder)
        else:
            with progress(quiet) as report:
                experiments.run(experiment, folder, workers or available_cores(), report)
            if not quiet:
                say("drawing figures")
            draw_figures(folder)
    except KeyboardInterrupt:
        _interrupted(f"; finished shards are kept in {folder}: the same command goes on there")
    print_run(folder, json)


def _say_if_compiling() -> None:
    """Tell why the first use takes a while."""
    from hybridtrack.compiled import kernels_are_cached

    if not kernels_are_cached():
        say(
            "compiling the kernels, once for this version: some twenty seconds (an interruption "
            "waits for it)"
        )


def draw_figures(folder: Path) -> list[Path]:
    """Draw a finished run's figures from its tables alone."""
    from hybridtrack import figures, results

    manifest = results.require_complete(folder)
    information = figures.RunInformation(
        title=manifest["title"],
        runs=manifest["runs"],
        estimators=tuple(manifest["estimators"]),
        modes=tuple(manifest["modes"]),
    )
    steps, tracks = (results.read_table(folder, name) for name in ("steps", "tracks"))
    return figures.save(figures.draw(steps, tracks, information), folder / "figures")


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
    """Check scenarios without running them; exit with 2 if one has a mistake."""
    from hybridtrack import config as scenarios

    mistakes = 0
    for one in config:
        try:
            experiment = scenarios.load(one)
        except UserError as error:
            say(f"error: {error}")
            mistakes += 1
            continue
        steps = sum(len(case.times_s) - 1 for case in experiment.cases)
        cases = len(experiment.cases)
        print(
            f"{one}: ok ({cases} case{'s' * (cases > 1)}, {steps:,} steps, "
            f"{experiment.runs:,} runs, {len(experiment.estimators)} estimators)"
        )
    if mistakes:
        raise typer.Exit(2)


@command("hybridtrack plot runs/rmimm_fig5-0123456789")
def plot(
    run_dir: Annotated[Path, typer.Argument(help="A run folder, as `run` printed it.")],
) -> None:
    """Draw a run's figures again, from its folder alone."""
    for path in draw_figures(run_dir):
        print(path)


@command("hybridtrack list", "hybridtrack list motions", name="list")
def list_(
    what: Annotated[
        str | None, typer.Argument(help="One kind only: estimators, motions, ...")
    ] = None,
) -> None:
    """List estimators, motion models, analyses, metrics and shipped scenarios."""
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
    """Print the published figures and what became of them, as a Markdown table."""
    from hybridtrack.studies.ledger import markdown

    print(markdown(run_dir), end="")
