"""The command line: parse, call, print. Everything heavy is imported where it is used."""

import contextlib
import functools
import gc
import io
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeVar

import typer

from hybridtrack import __version__
from hybridtrack.errors import UserError

if TYPE_CHECKING:
    from hybridtrack.config import Experiment

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


class Interrupted(BaseException):
    """Ctrl-C. No KeyboardInterrupt, since typer ends on that without a word."""


def main() -> None:
    """Entry point of the console script."""
    _spare_time()
    _prepare_streams()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _on_interrupt)
    try:
        try:
            app()
        finally:
            sys.stdout.flush()
    except Interrupted:
        _interrupted()
    except OSError as error:
        _cannot_go_on(error)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is said; Python closes down
        _drop_what_stderr_cannot_take()
        gc.freeze()  # and needn't look through all objects for garbage once more: 0.3 s


def _spare_time() -> None:
    """Before numpy comes: no threads for matrices as small as ours, and few looks for garbage.

    Python's own threshold of 700 objects suits programs that live longer than their imports.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(50_000, 20, 20)


def _prepare_streams() -> None:
    """A closed stream swallows what is written; one without our characters gets `?`."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def _drop_what_stderr_cannot_take() -> None:
    """A full disk under stderr is no failure; left alone, Python ends with exit code 120 for it."""
    try:
        sys.stderr.flush()
    except OSError:
        sys.stderr = os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")


def _on_interrupt(number: int, frame: object) -> NoReturn:
    raise Interrupted


def say(text: str) -> None:
    """A line for the person, not for the pipe."""
    with contextlib.suppress(OSError):  # nobody listens: no reason to stop
        print(text, file=sys.stderr, flush=True)


def _interrupted(hint: str = "") -> NoReturn:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # heard: once more would only cut this short
    say(f"interrupted{hint}")
    sys.exit(130)


def _cannot_go_on(error: OSError) -> NoReturn:
    """A reader that went away (| head) ends us in silence; a full disk is told."""
    with contextlib.suppress(OSError, ValueError):  # else Python tries stdout once more at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if isinstance(error, BrokenPipeError):
        sys.exit(141)
    where = error.filename or "the output"
    reason = (error.strerror or str(error)).lower()
    say(f"error: {where}: cannot be read or written ({reason}); make room, or check its rights")
    sys.exit(2)


def command(*examples: str, name: str | None = None) -> Callable[[Function], Function]:
    """A command: its mistakes are one sentence on stderr, its help ends in examples."""

    def register(function: Function) -> Function:
        @functools.wraps(function)
        def guarded(*arguments: Any, **options: Any) -> Any:
            try:
                return function(*arguments, **options)
            except UserError as error:
                say(f"error: {error}")
                raise typer.Exit(2) from None
            except OSError as error:  # typer would take a broken pipe for itself
                _cannot_go_on(error)

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

    A complete run is shown, not repeated. More runs go on from it, and the same command from an
    interrupted one: whole shards (2,048 runs of one case) are kept.
    """
    from hybridtrack import experiment as experiments
    from hybridtrack import pictures, results
    from hybridtrack.executors import available_cores
    from hybridtrack.progress import progress

    experiment = _load(config, set_ or (), runs, seed)
    folder = out if out is not None else experiments.default_folder(experiment)
    if force:
        results.clear(folder, experiments.digest(experiment))
    if not experiments.is_complete(folder, experiment):
        if not quiet:
            _say_if_compiling()
        try:
            with progress(quiet) as report:
                experiments.run(experiment, folder, workers or available_cores(), report)
        except Interrupted:
            _interrupted(_what_is_kept(folder))
    elif not quiet:
        _say_complete(folder, experiment.runs)
    if not pictures.are_drawn(folder):
        if not quiet:
            say("drawing figures")
        try:
            pictures.draw_run(folder)
        except Interrupted:
            _interrupted(f"; {folder} is complete but for figures: the same command draws them")
    print_run(folder, json)


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
