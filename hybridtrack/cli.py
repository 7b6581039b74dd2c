"""The command line: parse, call, print. Everything heavy is imported where it is used."""

from pathlib import Path
from typing import Annotated

import typer

from hybridtrack.console import Interrupted, app, command, interrupted, run_app, say
from hybridtrack.errors import UserError
from hybridtrack.options import (
    Json,
    Quiet,
    Runs,
    Seed,
    Settings,
    Workers,
    finish,
    load_scenario,
)

__all__ = ["app", "main"]


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

    experiment = load_scenario(config, set_ or (), runs, seed)
    folder = out if out is not None else experiments.default_folder(experiment)
    if force:
        results.clear(folder, experiments.digest(experiment))
    if not finish(experiment, folder, workers, quiet) and not quiet:
        _say_complete(folder, experiment.runs)
    if not pictures.are_drawn(folder):
        if not quiet:
            say("drawing figures")
        try:
            pictures.draw_run(folder)
        except Interrupted:
            interrupted(f"; {folder} is complete but for figures: the same command draws them")
    print_run(folder, json)


def _say_complete(folder: Path, asked: int) -> None:
    from hybridtrack.results import require_complete

    there = require_complete(folder)["runs"]
    more = f"; it holds {there:,} runs, you asked for {asked:,}" if there != asked else ""
    say(f"complete already: {folder} is shown, not repeated (--force repeats it){more}")


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


@command(
    "hybridtrack validate configs/rmimm_fig5.yaml",
    "hybridtrack validate configs/*.yaml",
    "hybridtrack validate --theory my_scenario.yaml",
)
def validate(
    config: Annotated[list[str], typer.Argument(help="Scenarios' files, or shipped ones' names.")],
    theory: Annotated[
        bool, typer.Option("--theory", help="Say what is too short for the filters, too.")
    ] = False,
) -> None:
    """Check scenarios without running them.

    Exits with 2 if one has a mistake. --theory compares how long each mode lasts with how many
    scans it takes to notice it and to tell it from the others; what it finds is no mistake.
    """
    from hybridtrack import config as scenarios
    from hybridtrack.analyses import lint
    from hybridtrack.typesetting import counted

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
        for sentence in lint(experiment) if theory else ():
            print(f"  {sentence}")
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
    run_dir: Annotated[list[Path], typer.Argument(help="Folders of finished runs and analyses.")],
) -> None:
    """Print published figures and their verdicts in Markdown."""
    from hybridtrack.studies.ledger import markdown

    print(markdown(run_dir), end="")


from hybridtrack import cli_studies  # noqa: E402, F401  (its commands come after these in the help)
