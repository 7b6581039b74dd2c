"""The command line as a user meets it: real folders, and real processes where they matter."""

import ast
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hybridtrack import cli, progress

CONFIGS = Path(__file__).parent.parent / "configs"
HEAVY = {"numpy", "numba", "pandas", "matplotlib", "pydantic", "scipy", "pyarrow", "yaml"}
SMALL = ["run", "rmimm_fig5", "--runs", "40"]


def hybridtrack(*arguments, cwd, **environment):
    """Run a command; NO_COLOR and COLUMNS as given, no terminal."""
    return subprocess.run(
        [sys.executable, "-m", "hybridtrack", *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        stdin=subprocess.DEVNULL,
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished small run: the folder where it was started, and what it printed."""
    cwd = tmp_path_factory.mktemp("finished")
    return cwd, hybridtrack(*SMALL, cwd=cwd)


def one_sentence(done):
    """The only line on stderr; nothing on stdout, exit code 2."""
    assert done.returncode == 2
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    return lines[0]


@pytest.mark.parametrize(
    ("arguments", "allowed"),
    # typer itself takes pydantic to read a command's options
    [(["--help"], set()), (["--version"], set()), (["run", "--help"], {"pydantic"})],
)
def test_help_imports_nothing_heavy(arguments, allowed):
    code = (
        "import sys\n"
        f"sys.argv = ['hybridtrack', *{arguments!r}]\n"
        "from hybridtrack.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        f"print(sorted({HEAVY!r} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(ast.literal_eval(done.stdout.splitlines()[-1])) <= allowed


def test_every_command_has_help_with_examples(tmp_path, said):
    for command in cli.app.registered_commands:
        name = command.name or command.callback.__name__
        done = said(name, "--help", cwd=tmp_path)
        assert done.returncode == 0
        assert f"  hybridtrack {name}" in done.stdout.partition("Examples:")[2]
        assert max(map(len, done.stdout.splitlines())) <= 80


def test_version_both_ways(tmp_path):
    from hybridtrack import __version__

    assert hybridtrack("--version", cwd=tmp_path).stdout == f"hybridtrack {__version__}\n"
    script = Path(sys.executable).parent / "hybridtrack"
    done = subprocess.run([script, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"hybridtrack {__version__}\n"


def test_run_prints_table_verdicts_and_folder_last(finished):
    cwd, done = finished
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    folder = cwd / lines[-1]
    assert folder.parent.name == "runs"
    names = {path.name for path in folder.iterdir()}
    tables = ("summary", "steps", "runs", "tracks", "published", "comparisons", "reliability")
    assert names >= {f"{t}.parquet" for t in tables}
    assert names >= {"config.yaml", "manifest.json", "summary.csv", "figures"}
    assert not [name for name in names if name.endswith(".part")]
    assert {p.stem for p in (folder / "figures").iterdir()} == {
        "trajectory",
        "position_error",
        "velocity_error",
        "error_ratio",
        "mode_probability",
        "mode_likelihood",
    }
    for label in ("raw", "KF_CV", "KF_CA", "MMAE", "IMM", "RMIMM", "RMIMM_zero"):
        assert any(line.startswith(label) for line in lines)
    assert "published claim" in done.stdout
    assert max(map(len, lines)) <= 80
    assert "\x1b" not in done.stdout + done.stderr
    assert json.loads((folder / "manifest.json").read_text())["status"] == "complete"


def test_a_complete_run_is_shown_and_force_repeats_it(finished):
    cwd, first = finished
    folder = cwd / first.stdout.splitlines()[-1]
    before = {p: p.stat().st_mtime_ns for p in folder.iterdir() if p.is_file()}
    again = hybridtrack(*SMALL, cwd=cwd)
    assert again.stdout == first.stdout
    assert "complete already" in again.stderr
    assert before == {p: p.stat().st_mtime_ns for p in folder.iterdir() if p.is_file()}
    bytes_before = {p.name: p.read_bytes() for p in folder.glob("*.parquet")}
    forced = hybridtrack(*SMALL, "--force", "--workers", "1", cwd=cwd)
    assert forced.stdout == first.stdout
    assert bytes_before == {p.name: p.read_bytes() for p in folder.glob("*.parquet")}


def test_json_and_quiet_leave_nothing_else(finished):
    cwd, _ = finished
    done = hybridtrack(*SMALL, "--json", "--quiet", cwd=cwd)
    assert done.stderr == ""
    data = json.loads(done.stdout)
    assert data["runs"] == 40
    rows = {(r["estimator"], r["metric"], r["window"]): r for r in data["summary"]}
    assert 15 < rows["IMM", "position_rmse_m", "all"]["value"] < 21
    assert {row["verdict"] for row in data["published"]}
    assert all(Path(cwd, name).exists() for name in data["figures"])


def test_plot_draws_the_same_figures_from_the_folder_alone(finished, tmp_path):
    cwd, first = finished
    folder = cwd / first.stdout.splitlines()[-1]
    figures = {p.name: p.read_bytes() for p in (folder / "figures").iterdir()}
    for path in (folder / "figures").iterdir():
        path.unlink()
    done = hybridtrack("plot", folder, cwd=tmp_path)
    assert done.returncode == 0
    assert {Path(line).name for line in done.stdout.splitlines()} == set(figures)
    assert figures == {p.name: p.read_bytes() for p in (folder / "figures").iterdir()}


def test_plot_draws_the_chains_of_a_scenario_that_was_never_run(tmp_path):
    bounded = ["  SBF: {type: sbf, continuation_probability: 0.98}"]
    bounded += ["  HBF: {type: hbf, most_transitions: 2}"]
    text = (CONFIGS / "rmimm_fig5.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(
        text.replace("estimators:\n", "\n".join(["estimators:", *bounded, ""]), 1)
    )
    done = hybridtrack("plot", "--chain", "mine.yaml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    folder = Path("runs/rmimm_fig5-chain")
    expected = [folder / f"{name}.png" for name in ("modes", "SBF", "HBF")]
    assert done.stdout.splitlines() == list(map(str, expected))
    assert {p.name for p in (tmp_path / folder).iterdir()} == {p.name for p in expected}
    again = hybridtrack("plot", "--chain", "mine.yaml", "--out", "here", cwd=tmp_path)
    assert again.stdout.splitlines() == ["here/modes.png", "here/SBF.png", "here/HBF.png"]
    for path in expected:
        bytes_of_png = (tmp_path / path).read_bytes()
        assert bytes_of_png.startswith(b"\x89PNG")
        assert bytes_of_png == (tmp_path / "here" / path.name).read_bytes()


def test_resolved_configuration_runs_again_to_the_same_digest(finished, tmp_path):
    cwd, first = finished
    folder = cwd / first.stdout.splitlines()[-1]
    done = hybridtrack("run", folder / "config.yaml", "--quiet", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.splitlines()[-1]).name == folder.name


def test_out_names_the_folder_and_other_runs_are_safe_in_it(tmp_path):
    small = ["run", "rmimm_fig5", "--runs", "5", "--quiet"]
    done = hybridtrack(*small, "--out", "here", cwd=tmp_path)
    assert done.stdout.splitlines()[-1] == "here"
    summary = (tmp_path / "here/summary.csv").read_bytes()
    sentence = one_sentence(hybridtrack(*small, "--seed", "6", "--out", "here", cwd=tmp_path))
    assert "holds another run" in sentence
    assert (tmp_path / "here/summary.csv").read_bytes() == summary
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.tex").write_text("x")
    for force in ([], ["--force"]):
        one_sentence(hybridtrack(*small, "--out", "mine", *force, cwd=tmp_path))
    assert (tmp_path / "mine/thesis.tex").read_text() == "x"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "nothing.yaml"], ["nothing.yaml", "no such file"]),
        (["run", "rmimm_fig6"], ["rmimm_fig6", "rmimm_fig5"]),
        (["run", "rmimm_fig5", "--runs", "0"], ["error: --runs 0: ", "at least 1"]),
        (["run", "rmimm_fig5", "--seed", "-1"], ["error: --seed -1: "]),
        (["run", "rmimm_fig5", "--set", "monte_carlo.runs=0"], ["--set monte_carlo.runs=0"]),
        (["validate", "x" * 300], ["cannot be read"]),
        (["run", "rmimm_fig5", "--set", "monte_carlo.sede=1"], ["sede", "did you mean 'seed'?"]),
        (["run", "rmimm_fig5", "--set", "foo"], ["foo"]),
        (["plot", "."], ["run folder"]),
        (["plot", "nowhere"], ["nowhere"]),
        (["plot"], ["run folder", "--chain"]),
        (["plot", "nowhere", "--chain", "rmimm_fig5"], ["nowhere", "--chain rmimm_fig5", "one"]),
        (["plot", "nowhere", "--out", "here"], ["--out here", "leave --out away"]),
        (["plot", "--chain", "rmimm_fig6"], ["rmimm_fig6", "rmimm_fig5"]),
        (["plot", "--chain", "rmimm_fig5", "--out", "/dev/null/x"], ["/dev/null/x"]),
        (["ledger", "nowhere"], ["nowhere"]),
        (["init", "a b"], ["a b", "letters"]),
        (["list", "foo"], ["foo", "estimators"]),
        (["run", "rmimm_fig5", "--out", "/dev/null/x", "--runs", "2", "-q"], ["/dev/null/x"]),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, said, arguments, words):
    sentence = one_sentence(said(*arguments, cwd=tmp_path))
    for word in words:
        assert word in sentence


def test_a_process_says_the_same_as_its_command_here(tmp_path, said):
    for arguments in (["run", "rmimm_fig6"], ["plot", "."], ["list", "motions"], ["schema"]):
        there, here = hybridtrack(*arguments, cwd=tmp_path), said(*arguments, cwd=tmp_path)
        assert (here.returncode, here.stdout) == (there.returncode, there.stdout)
        assert here.stderr == there.stderr


@pytest.mark.parametrize(
    "arguments", [["fly"], ["run"], ["run", "rmimm_fig5", "--runs", "many"], ["run", "--what"]]
)
def test_wrong_usage_exits_with_2_and_no_traceback(tmp_path, said, arguments):
    done = said(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "Usage:" in done.stderr
    assert done.stdout == ""


def test_init_validate_and_run_the_starter(tmp_path):
    done = hybridtrack("init", "first-try", cwd=tmp_path)
    assert done.stdout == "first-try.yaml\n"
    assert "no such file" not in done.stderr
    assert one_sentence(hybridtrack("init", "first-try", cwd=tmp_path)).count("first-try.yaml")
    valid = hybridtrack("validate", "first-try.yaml", *CONFIGS.glob("*.yaml"), cwd=tmp_path)
    assert valid.returncode == 0, valid.stderr
    assert valid.stdout.count(": ok") == 1 + len(list(CONFIGS.glob("*.yaml")))
    run = hybridtrack("run", "first-try.yaml", "--runs", "40", "--quiet", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert "KF_straight" in run.stdout


def test_validate_tells_every_file_and_exits_with_2(tmp_path):
    good = (CONFIGS / "rmimm_fig5.yaml").read_text()
    (tmp_path / "good.yaml").write_text(good)
    (tmp_path / "bad.yaml").write_text(good.replace("seed: 5", "sede: 5"))
    (tmp_path / "empty.yaml").write_text("")
    done = hybridtrack("validate", "bad.yaml", "good.yaml", "empty.yaml", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout.startswith("good.yaml: ok")
    line = good[: good.index("seed: 5")].count("\n") + 1
    first, second = done.stderr.splitlines()
    assert first.startswith(f"error: bad.yaml:{line}:")
    assert "'sede' is not a key here; did you mean 'seed'?" in first
    assert second.startswith("error: empty.yaml")


def test_list_and_schema(tmp_path):
    done = hybridtrack("list", cwd=tmp_path)
    for word in ("rmimm", "wiener_acceleration", "analyses", "mode_brier", "recorded_flight"):
        assert word in done.stdout
    only = hybridtrack("list", "motions", cwd=tmp_path).stdout
    assert "coordinated_turn" in only
    assert "rmimm" not in only
    schema = json.loads(hybridtrack("schema", cwd=tmp_path).stdout)
    for form in ("ScenarioForm", "NonlinearForm"):
        assert "monte_carlo" in schema["$defs"][form]["properties"]


def test_a_folder_of_a_shipped_name_is_no_scenario(tmp_path):
    (tmp_path / "rmimm_fig5").mkdir()
    done = hybridtrack("validate", "rmimm_fig5", cwd=tmp_path)
    assert done.stdout.startswith("rmimm_fig5: ok (1 case, ")
    assert "folder" in one_sentence(hybridtrack("validate", ".", cwd=tmp_path))


def test_no_summary_is_cut_in_the_list_of_commands(tmp_path):
    text = hybridtrack("--help", cwd=tmp_path, COLUMNS="80").stdout
    assert "..." not in text.partition("Commands:")[2]


def test_figures_that_are_missing_are_drawn_again(finished):
    cwd, first = finished
    figures = cwd / first.stdout.splitlines()[-1] / "figures"
    before = {p.name: p.read_bytes() for p in figures.iterdir()}
    (figures / "trajectory.png").unlink()
    again = hybridtrack(*SMALL, cwd=cwd)
    assert "drawing figures" in again.stderr
    assert before == {p.name: p.read_bytes() for p in figures.iterdir()}
    assert "drawing figures" not in hybridtrack(*SMALL, cwd=cwd).stderr


def test_a_bigger_run_is_shown_as_what_it_is(finished):
    cwd, first = finished
    fewer = hybridtrack("run", "rmimm_fig5", "--runs", "1", cwd=cwd)
    assert fewer.stdout == first.stdout
    assert "holds 40 runs, you asked for 1" in fewer.stderr
    assert "asked" not in hybridtrack(*SMALL, cwd=cwd).stderr


def through_shell(line, cwd, **environment):
    """A command line with `{}` for hybridtrack, run by a shell."""
    command = line.replace("{}", f"'{sys.executable}' -m hybridtrack")
    return subprocess.run(
        ["bash", "-o", "pipefail", "-c", command],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )


def test_an_output_that_takes_nothing(tmp_path):
    for command in ("list", "--help", "schema"):
        full = through_shell(f"{{}} {command} >/dev/full", tmp_path)
        assert full.returncode == 2, full.stderr
        assert full.stderr.startswith("error: the output: cannot be ")
        assert full.stderr.count("\n") == 1
    gone = through_shell("{} schema | sleep 0", tmp_path)  # it ends before there is a schema
    assert (gone.returncode, gone.stderr) == (141, "")


def test_streams_that_are_closed(finished):
    cwd, first = finished
    command = "{} " + " ".join(SMALL)
    silent = through_shell(command + " 2>&-", cwd)
    assert (silent.returncode, silent.stdout) == (0, first.stdout)
    for buffered in ("PYTHONUNBUFFERED= ", "PYTHONUNBUFFERED=yes "):
        deaf = through_shell(buffered + command + " 2>/dev/full", cwd)
        assert (deaf.returncode, deaf.stdout) == (0, first.stdout)
    unheard = through_shell(command + " -q >&-", cwd)
    assert (unheard.returncode, unheard.stderr) == (0, "")


def test_an_output_without_our_characters(finished):
    cwd, first = finished
    done = hybridtrack(*SMALL, cwd=cwd, PYTHONIOENCODING="ascii")
    assert done.returncode == 0, done.stderr
    assert done.stdout.isascii()
    assert done.stdout.count("?") >= first.stdout.count("±")


@pytest.mark.parametrize(
    "place", ["config.load", "experiment.is_complete", "tables.show", "compiled.source_digest"]
)
def test_interrupts_anywhere_are_one_line_and_130(finished, place):
    """A SIGINT from within a function that is called on the way; two more while it ends."""
    cwd, _ = finished
    module, _, name = place.partition(".")
    code = (
        "import os, signal, sys, atexit\n"
        f"sys.argv = ['hybridtrack', *{SMALL!r}, '-q']\n"
        "from hybridtrack import cli\n"
        f"from hybridtrack import {module} as module\n"
        "again = lambda: os.kill(os.getpid(), signal.SIGINT)\n"
        "atexit.register(again)\n"
        f"module.{name} = lambda *_: again()\n"
        "cli.main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


def test_an_interrupt_tells_what_is_kept(tmp_path):
    from hybridtrack.options import _what_is_kept

    assert "no shard was finished" in _what_is_kept(tmp_path)
    (tmp_path / "shards").mkdir()
    (tmp_path / "shards/0.npz").write_text("")
    assert "finished shards are kept in" in _what_is_kept(tmp_path)


OURS = ("-m", "hybridtrack")


def start_long_run(cwd, program=OURS):
    """A run of many minutes, once it has finished its first shard."""
    arguments = ["run", "rmimm_fig5", "--runs", "2000000", "--out", "long"]
    process = subprocess.Popen(
        [sys.executable, *program, *arguments],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 120
    while not list(Path(cwd).glob("long/shards/*.npz")):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return process


def test_interrupt_is_one_line_and_130_and_keeps_what_is_finished(tmp_path):
    process = start_long_run(tmp_path)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert out == ""
    assert "Traceback" not in err
    lines = [line for line in err.splitlines() if "runs," not in line and "compiling" not in line]
    assert len(lines) == 1
    assert lines[0].startswith("interrupted; finished shards are kept in long")
    kept = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "long/shards").glob("*.npz")}
    assert kept
    again = start_long_run(tmp_path)  # goes on: the shards that were there stay as they are
    again.send_signal(signal.SIGINT)
    again.communicate(timeout=30)
    now = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "long/shards").glob("*.npz")}
    assert kept.items() <= now.items()


def test_plain_progress_without_a_terminal(tmp_path):
    """A plain line every five seconds, here every one."""
    assert progress.QUIET_S == 5.0
    begun = time.monotonic()
    code = "from hybridtrack import cli, progress; progress.QUIET_S = 1.0; cli.main()"
    process = start_long_run(tmp_path, ("-c", code))
    time.sleep(2)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    lines = [line for line in err.splitlines() if "of 2,000,000 runs, " in line]
    assert all(line.endswith(" s left") for line in lines)
    assert 1 <= len(lines) <= time.monotonic() - begun
    assert "\x1b" not in err


def test_a_bar_on_a_terminal(tmp_path):
    """On a pseudo-terminal there is a bar with the count of runs; NO_COLOR has no colours."""
    import pty

    master, slave = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "hybridtrack", "run", "rmimm_fig5", "--runs", "3000"],
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
        stderr=slave,
        env={**os.environ, "NO_COLOR": "1", "TERM": "xterm", "COLUMNS": "80"},
    )
    os.close(slave)
    shown = b""
    while True:
        try:
            part = os.read(master, 65536)
        except OSError:
            break
        if not part:
            break
        shown += part
    assert process.wait(timeout=120) == 0
    os.close(master)
    assert b"/3000" in shown
    assert b"\x1b[3" not in shown  # no colour
