"""How kernels are compiled and where their machine code is kept.

Every kernel of the package is decorated here, so all compiler options stand in one place.
The cache folder carries a digest of the package's sources in its name: Numba's own cache does
not see an edit in another file (numba issue 1833), a new folder does.
"""

import functools
import hashlib
import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).parent

# Missing detections and modes of probability zero make NaN and infinity legitimate values, so
# the flags that assume there are none (nnan, ninf) are left off.
FAST = {"contract", "reassoc", "arcp", "nsz"}
EXACT = {"contract"}
UNCOUNTED: dict[str, Any] = {"error_model": "numpy", "_nrt": False}
KERNELS_MIB = 8  # about 2 as compiled today


@functools.cache
def source_digest() -> str:
    """Digest of every Python source of the package: what was run, to the letter."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """The first folder that has room: the user's cache, the user's own among temporary files."""
    for parent in (_user_cache, _user_temporary):
        try:
            folder = parent() / f"kernels-{source_digest()}"
            folder.mkdir(parents=True, exist_ok=True)
            if not any(folder.iterdir()):
                _require_room(folder)
            tempfile.TemporaryFile(dir=folder).close()
            return folder
        except (OSError, RuntimeError):  # RuntimeError: a user without a home
            continue
    return Path(tempfile.mkdtemp(prefix="hybridtrack-kernels-"))


def _user_cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(base) if base else Path.home() / ".cache") / "hybridtrack"


def _user_temporary() -> Path:
    """The same folder at every start; nobody else's, for machine code is run from it."""
    if not hasattr(os, "getuid"):  # no shared folder of temporary files there
        return Path(tempfile.gettempdir()) / "hybridtrack"
    folder = Path(tempfile.gettempdir()) / f"hybridtrack-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if (found.st_uid, stat.S_IFMT(found.st_mode)) != (os.getuid(), stat.S_IFDIR):
        raise PermissionError(f"{folder} belongs to someone else")
    if stat.S_IMODE(found.st_mode) & 0o022:
        raise PermissionError(f"{folder} can be written by others")
    return folder


def _require_room(folder: Path) -> None:
    """Numba gives up with a traceback where its files don't fit: raise OSError before that."""
    with tempfile.TemporaryFile(dir=folder) as file:
        for _ in range(KERNELS_MIB):
            file.write(bytes(1 << 20))


if "NUMBA_CACHE_DIR" not in os.environ:
    os.environ["NUMBA_CACHE_DIR"] = str(_cache_folder())

import llvmlite.binding  # noqa: E402
import numba  # noqa: E402  (the cache folder must be known before)

numba.config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]
# Loops over a few states, unrolled fourfold with a remainder, make the recursion's code too long
# for the cache of instructions, and a third slower.
llvmlite.binding.set_option("", "-unroll-runtime=false")
COMPILED = not numba.config.DISABLE_JIT


def kernel(function: Callable[..., Any]) -> Any:
    """Compile on first use, keep the machine code on disk, let other threads run meanwhile."""
    return numba.njit(function, cache=True, nogil=True, fastmath=FAST, error_model="numpy")


def lane_kernel(function: Callable[..., Any]) -> Any:
    """The same for code that allocates nothing: without counting references to arrays.

    Every view of a row would count one up and down again: a third of the recursion's time.
    """
    return numba.njit(function, cache=True, nogil=True, fastmath=FAST, **UNCOUNTED)


def short_kernel(function: Callable[..., Any]) -> Any:
    """A lane kernel that keeps Python's lock: done before another thread would be awake."""
    return numba.njit(function, cache=True, fastmath=FAST, **UNCOUNTED)


def row_kernel(function: Callable[..., Any]) -> Any:
    """A part of a lane kernel, put in its caller's place: a call has a hundred arguments."""
    return numba.njit(function, cache=True, forceinline=True, fastmath=FAST, **UNCOUNTED)


def exact_row_kernel(function: Callable[..., Any]) -> Any:
    """The same without reassociation: for code that counts on the order of its operations."""
    return numba.njit(function, cache=True, forceinline=True, fastmath=EXACT, **UNCOUNTED)


def host_processor() -> str:
    """The kind of processor that kernels are compiled for: its instructions decide on last bits."""
    return str(llvmlite.binding.get_host_cpu_name())


def kernels_are_cached() -> bool:
    """Whether this version's kernels were compiled before (the first use takes a while)."""
    return any(Path(numba.config.CACHE_DIR).rglob("_bank.advance-*.nbi"))
