"""Tests may import the references and models that lie beside them."""

import signal
import sys
from pathlib import Path

import pytest

from hybridtrack.console import spare_time

sys.path.insert(0, str(Path(__file__).parent))

# As every command begins, and before numpy comes: with BLAS's own threads a Riccati equation of
# four states takes seven times as long, and the analyses solve thousands.
spare_time()

# A shell that starts us in the background ignores Ctrl-C, and our children would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def shipped(tmp_path_factory):
    """The shipped scenarios' runs and analyses at their full size, to be read only."""
    from shipped import Shipped

    return Shipped(tmp_path_factory.mktemp("shipped"))
