"""What every command has in common: streams, Ctrl-C, exit codes, help that ends in examples."""

import contextlib
import functools
import gc
import io
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

import typer

from hybridtrack import __version__
from hybridtrack.errors import UserError

TRACEBACK = "traceback.txt"

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


def run_app() -> None:
    """Parse the command line and do what it says; ends the process where that went wrong."""
    spare_time()
    _prepare_streams()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _on_interrupt)
    try:
        try:
            app()
        finally:
            sys.stdout.flush()
    except Interrupted:
        interrupted()
    except OSError as error:
        _cannot_go_on(error)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is said; Python closes down
        _drop_what_stderr_cannot_take()
        gc.freeze()  # and needn't look through all objects for garbage once more: 0.3 s


def spare_time() -> None:
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


def interrupted(hint: str = "") -> NoReturn:
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


def work_in(folder: Path) -> None:
    """Where the traceback of a bug goes, should there be one from here on."""
    _at_work.append(folder)


_at_work: list[Path] = []


def _tell_bug(error: Exception) -> NoReturn:
    """A fault of ours: what is needed to mend it in a file, one line that asks for it."""
    text = f"hybridtrack {__version__}, {sys.argv[1:]}\n\n{traceback.format_exc()}"
    where = "what follows"
    for folder in (*reversed(_at_work), Path(), Path(tempfile.gettempdir())):
        with contextlib.suppress(OSError):
            (folder / TRACEBACK).write_text(text, encoding="utf-8")
            where = str(folder / TRACEBACK)
            break
    kind = type(error).__name__
    say(f"error: this is a bug of hybridtrack ({kind}); please report it with {where}")
    if where == "what follows":
        say(text)
    sys.exit(101)


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
            except typer.Exit:
                raise
            except Exception as error:
                _tell_bug(error)

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
    out. Results go to stdout, progress and errors to stderr. Exit codes: 0 done, 1 a regression,
    2 bad input, 101 a bug of ours, 130 interrupted."""
