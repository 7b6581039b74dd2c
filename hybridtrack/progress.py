"""Progress on stderr: a bar on a terminal, a few plain lines elsewhere."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

QUIET_S = 5.0  # plain lines come no closer than this

Report = Callable[[int, int], None]


@contextlib.contextmanager
def progress(quiet: bool) -> Iterator[Report]:
    """A callback for (runs done, runs in all)."""
    if quiet:
        yield lambda done, total: None
    elif sys.stderr.isatty():
        yield from _bar()
    else:
        yield _lines()


def _bar() -> Iterator[Report]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    columns = (TextColumn("runs"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("runs", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _lines() -> Report:
    begun = last = time.monotonic()

    def report(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= QUIET_S and done < total:
            last = now
            left = (now - begun) * (total - done) / done
            with contextlib.suppress(OSError):  # nobody listens: no reason to stop
                print(f"{done:,} of {total:,} runs, {left:.0f} s left", file=sys.stderr, flush=True)

    return report
