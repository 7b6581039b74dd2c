"""The kernels' cache, and life without compilation."""

import os
import subprocess
import sys
from pathlib import Path

from hybridtrack import compiled


def test_cache_folder_is_named_by_the_sources():
    code = "import hybridtrack.compiled as c, os; print(os.environ['NUMBA_CACHE_DIR'])"
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip().endswith(f"kernels-{compiled.source_digest()}")


def chosen_folder(code="", **environment):
    """The cache folder that a fresh process takes; a value of None unsets a variable."""
    code += "\nimport hybridtrack.compiled as c; print(c.os.environ['NUMBA_CACHE_DIR'])"
    merged = os.environ | {"NUMBA_CACHE_DIR": None} | environment
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={k: str(v) for k, v in merged.items() if v is not None},
        capture_output=True,
        text=True,
        check=True,
    )
    return Path(done.stdout.strip())


def own(tmp_path):
    """The user's own folder among temporary files, and the kernels' in it."""
    folder = tmp_path / f"hybridtrack-{os.getuid()}"
    return folder, folder / f"kernels-{compiled.source_digest()}"


def test_an_unwritable_cache_falls_back_to_one_temporary_folder(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    parent, kernels = own(tmp_path)
    for _ in range(2):  # the same at every start, so that nothing is compiled again
        assert chosen_folder(XDG_CACHE_HOME=blocked, TMPDIR=tmp_path) == kernels
    assert parent.stat().st_mode & 0o777 == 0o700
    assert sorted(tmp_path.iterdir()) == sorted([blocked, parent])


def test_machine_code_is_never_taken_from_a_folder_that_others_can_write(tmp_path):
    parent, kernels = own(tmp_path)
    parent.mkdir()
    parent.chmod(0o777)
    assert chosen_folder(XDG_CACHE_HOME="/dev/null/x", TMPDIR=tmp_path) != kernels
    parent.rmdir()
    (tmp_path / "elsewhere").mkdir()
    parent.symlink_to(tmp_path / "elsewhere")
    assert chosen_folder(XDG_CACHE_HOME="/dev/null/x", TMPDIR=tmp_path) != kernels


def test_a_user_without_a_home(tmp_path):
    nobody = "import pwd, pathlib\ndef none(*_): raise KeyError\npwd.getpwuid = none"
    environment = {"HOME": None, "XDG_CACHE_HOME": None, "LOCALAPPDATA": None}
    assert chosen_folder(nobody, TMPDIR=tmp_path, **environment) == own(tmp_path)[1]


def test_a_cache_without_room(tmp_path):
    """A limit on the size of files stands for the full disk: both make write() fail."""
    limit = "import resource as r, signal\nsignal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
    limit += "r.setrlimit(r.RLIMIT_FSIZE, (1 << 20, r.RLIM_INFINITY))"
    full = tmp_path / "full"
    found = chosen_folder(limit, XDG_CACHE_HOME=full, TMPDIR=tmp_path)
    assert full not in found.parents


def test_small_cases_run_without_compilation():
    tests = Path(__file__).parent
    chosen = ["-k", "vectors or reference or spans or hand or unreachable or exact"]
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            tests / "test_vectors.py",
            tests / "test_bank.py",
            tests / "test_best_sequences.py",
            *chosen,
        ],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    assert "passed" in done.stdout
