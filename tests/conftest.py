"""Tests may import the references and models that lie beside them."""

import gc
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hybridtrack import cli, console

sys.path.insert(0, str(Path(__file__).parent))

# As every command begins, and before numpy comes: where other processes are at work too, BLAS's
# own threads take fifty times as long for a Riccati equation of four states.
console.spare_time()

# A shell that starts us in the background ignores Ctrl-C, and our children would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def shipped(tmp_path_factory):
    """The shipped scenarios' runs and analyses at their full size, to be read only."""
    from shipped import Shipped

    return Shipped(tmp_path_factory.mktemp("shipped"))


@pytest.fixture
def said(monkeypatch, capsys):
    """A command of ours in this process, in a tenth of a new one's time: for what it says.

    What becomes of streams, signals and imports takes a process of its own.
    """

    def command(*arguments, cwd):
        handler, work = signal.getsignal(signal.SIGINT), list(console._at_work)
        monkeypatch.chdir(cwd)
        monkeypatch.setattr(sys, "argv", ["hybridtrack", *map(str, arguments)])
        try:
            with pytest.raises(SystemExit) as ended:
                cli.main()
        finally:
            signal.signal(signal.SIGINT, handler)
            console._at_work[:] = work
            gc.unfreeze()
        return subprocess.CompletedProcess(arguments, ended.value.code, *capsys.readouterr())

    return command
