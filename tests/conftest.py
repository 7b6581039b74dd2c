"""Tests may import the references and models that lie beside them."""

import os
import signal
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

# As the commands do (console.spare_time): SciPy's SLSQP ends elsewhere with BLAS's threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A shell that starts us in the background ignores Ctrl-C, and our children would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
