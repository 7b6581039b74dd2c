"""How kernels are compiled and where their machine code is kept.

Every kernel of the package is decorated here, so all compiler options stand in one place.
The cache folder carries a digest of the package's sources in its name: Numba's own cache does
not see an edit in another file (numba issue 1833), a new folder does.
"""

import functools
import hashlib
import math
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
KERNELS_MIB = 8  # 3 to 6 as compiled today


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

import numba  # noqa: E402  (the cache folder must be known before)
from numba import types  # noqa: E402
from numba.extending import intrinsic  # noqa: E402

numba.config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]


def kernel(function: Callable[..., Any]) -> Any:
    """Compile on first use, keep the machine code on disk, let other threads run meanwhile."""
    return numba.njit(function, cache=True, nogil=True, fastmath=FAST, error_model="numpy")


def lane_kernel(function: Callable[..., Any]) -> Any:
    """The same for code that allocates nothing: without counting references to arrays.

    Every view of a row would count one up and down again: a third of the recursion's time.
    """
    options: dict[str, Any] = {"fastmath": FAST, "error_model": "numpy", "_nrt": False}
    return numba.njit(function, cache=True, nogil=True, **options)


def row_kernel(function: Callable[..., Any]) -> Any:
    """A lane kernel of a few lines, put in its caller's place."""
    options: dict[str, Any] = {"fastmath": FAST, "error_model": "numpy", "_nrt": False}
    return numba.njit(function, cache=True, nogil=True, forceinline=True, **options)


def exact_kernel(function: Callable[..., Any]) -> Any:
    """The same without reassociation: for code that counts on the order of its operations."""
    return numba.njit(function, cache=True, nogil=True, fastmath=EXACT, error_model="numpy")


def kernels_are_cached() -> bool:
    """Whether this version's kernels were compiled before (the first use takes a while)."""
    return any(Path(numba.config.CACHE_DIR).rglob("_bank.advance-*.nbi"))


@intrinsic
def _float_bits(typing_context: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], context.get_value_type(types.int64))

    return types.int64(types.float64), generate


@intrinsic
def _bits_float(typing_context: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], context.get_value_type(types.float64))

    return types.float64(types.int64), generate


LOG2_E = 1.4426950408889634
LN2_HIGH = 0.693147180369123816490  # the upper 32 bits of ln 2, and the rest (fdlibm)
LN2_LOW = 1.90821492927058770002e-10
SQRT_HALF_BITS = 0x3FE6A09E667F3BCD


def _exp(x: float) -> float:
    """e**x for x <= 0 (larger x up to 700 too); below -708, where subnormals begin, 0.

    Cody-Waite reduction to |r| <= ln(2)/2 and the Taylor polynomial of degree 13, whose remainder
    there is below 1e-17. Branch-free, so that a loop over lanes becomes vector instructions:
    the C library's exp does not.
    """
    y = -708.0 if x <= -708.0 else x  # NaN stays NaN
    n = np_rint(y * LOG2_E)
    r = (y - n * LN2_HIGH) - n * LN2_LOW
    p = 1.0 / 6227020800.0
    p = p * r + 1.0 / 479001600.0
    p = p * r + 1.0 / 39916800.0
    p = p * r + 1.0 / 3628800.0
    p = p * r + 1.0 / 362880.0
    p = p * r + 1.0 / 40320.0
    p = p * r + 1.0 / 5040.0
    p = p * r + 1.0 / 720.0
    p = p * r + 1.0 / 120.0
    p = p * r + 1.0 / 24.0
    p = p * r + 1.0 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    # Adding 1.5 * 2**52 leaves n as an integer in the low bits; shifted, it is the exponent of 2.
    scale = _bits_float((_float_bits(n + 6755399441055744.0) + 1023) << 52)
    value = p * scale
    return value if not x <= -708.0 else 0.0


def _log(x: float) -> float:
    """Natural logarithm for finite x >= 0 (log 0 = -inf), to about one unit in the last place.

    log(m) = 2 atanh((m - 1)/(m + 1)) for the mantissa in [sqrt(1/2), sqrt(2)); the series'
    remainder after eleven terms is below 1e-17. Branch-free like `exp`.
    """
    tiny = x < 2.2250738585072014e-308
    y = x * 18014398509481984.0 if tiny else x  # 2**54 brings subnormals up
    bits = _float_bits(y) - SQRT_HALF_BITS
    exponent = bits >> 52
    m = _bits_float((bits & 0xFFFFFFFFFFFFF) + SQRT_HALF_BITS)
    n = float(exponent) - (54.0 if tiny else 0.0)
    f = (m - 1.0) / (m + 1.0)
    g = f * f
    p = 1.0 / 21.0
    p = p * g + 1.0 / 19.0
    p = p * g + 1.0 / 17.0
    p = p * g + 1.0 / 15.0
    p = p * g + 1.0 / 13.0
    p = p * g + 1.0 / 11.0
    p = p * g + 1.0 / 9.0
    p = p * g + 1.0 / 7.0
    p = p * g + 1.0 / 5.0
    p = p * g + 1.0 / 3.0
    value = n * LN2_HIGH + (n * LN2_LOW + 2.0 * (f * g * p + f))
    return value if x > 0.0 else (-math.inf if x == 0.0 else math.nan)


if numba.config.DISABLE_JIT:  # tests of small cases, line by line in Python

    def exp(x: float) -> float:
        return math.exp(x) if x > -708.0 or x != x else 0.0

    def log(x: float) -> float:
        return math.log(x) if x > 0.0 else (-math.inf if x == 0.0 else math.nan)
else:
    import numpy as np

    np_rint = np.rint
    exp = exact_kernel(_exp)
    log = exact_kernel(_log)
