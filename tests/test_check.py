"""`hybridtrack baseline` and `check` as a user has them: words, files, exit codes."""

import json
import subprocess
import sys
from xml.etree import ElementTree

import pytest

from hybridtrack.console import TRACEBACK
from models import SMALL

QUIETER = "estimators.IMM"


def hybridtrack(cwd, *arguments):
    return subprocess.run(
        [sys.executable, "-m", "hybridtrack", *arguments], cwd=cwd, capture_output=True, text=True
    )


@pytest.fixture(scope="module")
def cwd(tmp_path_factory):
    """A scenario of 60 runs with its baseline."""
    folder = tmp_path_factory.mktemp("check")
    (folder / "small.yaml").write_text(SMALL)
    done = hybridtrack(folder, "baseline", "small.yaml", "-o", "b/small.parquet", "--runs", "60")
    assert (done.returncode, done.stdout) == (0, "b/small.parquet\n"), done.stderr
    return folder


def check(cwd, *options, config="small.yaml"):
    return hybridtrack(cwd, "check", config, "--against", "b/small.parquet", "-q", *options)


def test_the_same_run_is_identical(cwd):
    done = check(cwd)
    assert (done.returncode, done.stderr) == (0, "")
    first, *_, last = done.stdout.splitlines()
    assert "60 runs of seed 3 against a baseline of 60 runs of seed 3, pair by pair" in first
    assert last.startswith("identical to the last bit: ")


def test_another_seed_is_no_regression(cwd):
    done = check(cwd, "--seed", "4", "--all")
    assert (done.returncode, done.stderr) == (0, "")
    assert "unpaired" in done.stdout
    assert "so many runs find changes from" in done.stdout
    shorter = check(cwd, "--seed", "4").stdout
    assert len(shorter) < len(done.stdout)
    assert max(map(len, shorter.splitlines()[3:])) <= 96


def test_a_finished_run_is_checked_as_it_is(cwd):
    done = hybridtrack(cwd, "run", "small.yaml", "--runs", "90", "--out", "longer", "-q")
    assert done.returncode == 0
    assert "60 runs" in check(cwd, config="longer").stdout  # those that both have
    refused = check(cwd, "--runs", "5", config="longer")
    assert refused.returncode == 2
    assert "this run is finished" in refused.stderr


def of_seed_3(cwd):
    """A run of the scenario as the baseline is of."""
    found = [path for path in sorted((cwd / "runs").iterdir()) if told(path)["seed"] == 3]
    return next(path for path in found if told(path)["runs"] == 60)


def told(folder):
    return json.loads((folder / "manifest.json").read_text())


@pytest.fixture
def worse(cwd, tmp_path):
    """A finished run whose IMM is a Kalman filter, under the names of the baseline's scenario."""
    text = SMALL.replace("IMM: {type: imm}", "IMM: {type: kalman, mode: straight}")
    text = text.replace("compare_with: IMM", "compare_with: MMAE")
    (tmp_path / "small.yaml").write_text(text)
    done = hybridtrack(tmp_path, "run", "small.yaml", "--runs", "60", "--out", "worse", "-q")
    assert done.returncode == 0, done.stderr
    for name in ("config.yaml", "manifest.json"):  # as if a change in the sources had done it
        good = of_seed_3(cwd) / name
        text = good.read_text().replace('"sources": "', '"sources": "other')
        (tmp_path / "worse" / name).write_text(text)
    return tmp_path / "worse"


def test_a_regression_is_exit_code_1_in_every_form(cwd, worse, tmp_path):
    files = {"--junit": tmp_path / "r.xml", "--markdown": tmp_path / "r.md"}
    options = [part for option, file in files.items() for part in (option, str(file))]
    done = check(cwd, *options, config=str(worse))
    assert done.returncode == 1, done.stderr
    assert "worse" in done.stdout
    suite = ElementTree.fromstring(files["--junit"].read_text())
    failed = [case.get("name") for case in suite if case.find("failure") is not None]
    assert "position_rmse_m IMM all" in failed
    assert not any(" KF " in name for name in failed)
    assert int(suite.get("failures")) == len(failed)
    assert files["--markdown"].read_text().startswith("**worse** small: 60 runs")
    found = json.loads(check(cwd, "--json", config=str(worse)).stdout)
    assert found["failed"]
    assert {c["verdict"] for c in found["changes"] if c["estimator"] == "KF"} == {"same"}


def test_the_same_sources_must_give_the_same_bytes(cwd, worse):
    manifest = worse / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"sources": "other', '"sources": "'))
    done = check(cwd, config=str(worse))
    assert done.returncode == 1
    assert "something is not reproducible" in done.stdout


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--set", "sensor.position_std_m=21"], "'sensor.position_std_m' is 21.0 here and 20.0"),
        (
            ["--set", "estimators.KF.mode=straight"],
            "'estimators.KF.mode' is \"straight\" here",
        ),
        (
            ["--set", "estimators.NEW={type: imm}"],
            "'estimators.NEW' is present here and missing",
        ),
        (["--family-error", "2"], "--family-error 2: give a chance from 1e-12 to 0.5"),
        (["--family-error", "1e-323"], "give a chance from 1e-12 to 0.5"),
        (["--seed=4", "--runs=50", "--detect=1%"], "--runs and --detect both say how many runs"),
        (["--seed=4", "--detect", "much"], "--detect much: give a change such as 1% or 0.01"),
        (["--seed=4", "--detect", "1e-200"], "--detect 1e-200: give a change such as 1% or 0.01"),
        (
            ["--seed=4", "--set", "monte_carlo.runs=60", "--detect", "0.0005%"],
            "runs; look for a larger change",
        ),
        (["--detect", "1%"], "with the baseline's own seed only its 60 runs are compared"),
        (["--junit", "."], "this is no file's name"),
        (["--markdown", "b/small.parquet"], "this is the baseline itself; name another file"),
        (["--set", "truth.legs.1.turn_rate_deg_s=2"], "'truth.legs[1].turn_rate_rad_s' is 0.03"),
    ],
)
def test_what_does_not_fit_is_one_sentence(cwd, options, sentence, said):
    arguments = ("small.yaml", "--against", "b/small.parquet", "-q")
    done = said("check", *arguments, *options, cwd=cwd)
    assert (done.returncode, done.stdout) == (2, "")
    assert sentence in done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


def test_wanted_changes_tell_the_number_of_runs(cwd):
    done = hybridtrack(cwd, "baseline", "small.yaml", "-o", "d.parquet", "--detect", "60%")
    assert done.returncode == 0
    assert "runs find a change of 60%, unpaired; " in done.stderr
    assert done.stderr.endswith(" decides\n")


def test_as_many_runs_are_compared_as_are_asked_for(cwd):
    """Though a longer run is at hand."""
    assert hybridtrack(cwd, "run", "small.yaml", "--runs", "80", "-q").returncode == 0
    done = hybridtrack(cwd, "baseline", "small.yaml", "-o", "fewer.parquet", "--runs", "20", "-q")
    assert done.returncode == 0, done.stderr
    found = hybridtrack(cwd, "check", "small.yaml", "--against", "fewer.parquet", "-q").stdout
    assert "20 runs of seed 3 against a baseline of 20 runs" in found


def test_a_baseline_does_not_go_into_a_runs_own_folder(cwd):
    folder = of_seed_3(cwd)
    done = hybridtrack(cwd, "baseline", str(folder), "-o", str(folder / "runs.parquet"))
    assert done.returncode == 2
    assert "this lies in the run's own folder" in done.stderr


def test_a_bug_of_ours_is_101_with_its_traceback_in_the_run_folder(tmp_path):
    (tmp_path / "small.yaml").write_text(SMALL)
    code = (
        "import sys\n"
        "sys.argv = ['hybridtrack', 'run', 'small.yaml', '--out', 'here', '-q']\n"
        "from hybridtrack import cli, outcomes\n"
        "def broken(*_): raise ZeroDivisionError('planted')\n"
        "outcomes.summary_rows = broken\n"
        "cli.main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (101, "")
    file = tmp_path / "here" / TRACEBACK
    assert done.stderr.splitlines() == [
        f"error: this is a bug of hybridtrack (ZeroDivisionError); please report it with "
        f"{file.relative_to(tmp_path)}"
    ]
    assert "ZeroDivisionError: planted" in file.read_text()
    # The folder goes on as if nothing had been.
    done = hybridtrack(tmp_path, "run", "small.yaml", "--out", "here", "-q")
    assert done.returncode == 0, done.stderr
