"""The run folder: whole or not at all, one writer, and one sentence for whatever is wrong."""

import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hybridtrack.columns import as_numpy, names_in
from hybridtrack.errors import UserError
from hybridtrack.experiment import is_complete, run
from hybridtrack.outcomes import paired
from hybridtrack.results import (
    SCHEMAS,
    RunFolder,
    clear,
    read_columns,
    read_manifest,
    read_rows,
    read_runs,
    replacing,
    require_complete,
    write_text,
)
from models import SMALL, scenario


def quiet(done, total):
    """A report that says nothing."""


def sentence(caught):
    """The message, if it is one line that ends in no traceback."""
    text = str(caught.value)
    assert "\n" not in text
    return text


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A small experiment and its finished run's folder, for tests that only read it."""
    folder = tmp_path_factory.mktemp("finished")
    experiment = scenario(folder, SMALL)
    run(experiment, folder / "run", 1, quiet)
    return experiment, folder / "run"


@pytest.fixture
def damaged(tmp_path):
    """The same, for tests that damage it."""
    experiment = scenario(tmp_path, SMALL)
    run(experiment, tmp_path / "run", 1, quiet)
    return experiment, tmp_path / "run"


# ---- whole or not at all ---------------------------------------------------------------------


def fail_halfway(path, error):
    with replacing(path) as temporary:
        temporary.write_text("half of the n")
        raise error


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, error):
    file = tmp_path / "summary.csv"
    write_text(file, "old")
    with pytest.raises(error):
        fail_halfway(file, error())
    assert [path.name for path in tmp_path.iterdir()] == ["summary.csv"]
    assert file.read_text() == "old"


def test_a_full_disk_is_one_sentence(tmp_path):
    with pytest.raises(UserError) as caught:
        fail_halfway(tmp_path / "a", OSError(28, "No space left on device"))
    assert sentence(caught).endswith("a: cannot be written (no space left on device)")
    assert list(tmp_path.iterdir()) == []


def test_a_file_written_anew_replaces_the_old_one(tmp_path):
    write_text(tmp_path / "a", "old")
    write_text(tmp_path / "a", "new\n")
    assert (tmp_path / "a").read_bytes() == b"new\n"
    assert len(list(tmp_path.iterdir())) == 1


# ---- one writer, one run ---------------------------------------------------------------------

HOLDS_IT = """
import sys
from pathlib import Path
from hybridtrack.results import RunFolder
with RunFolder(Path(sys.argv[1]), "d1"):
    print("mine", flush=True)
    sys.stdin.read()
"""


def test_a_second_process_is_told_to_wait(tmp_path):
    pytest.importorskip("fcntl", reason="no such locks here")
    folder = tmp_path / "run"
    arguments = [sys.executable, "-c", HOLDS_IT, str(folder)]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        assert first.stdout.readline() == b"mine\n"
        with pytest.raises(UserError, match="another run is writing this folder") as caught:
            RunFolder(folder, "d1").__enter__()
        sentence(caught)
        with pytest.raises(UserError, match="another run is writing this folder"):
            clear(folder, "d1")  # --force while it runs
        assert folder.exists()
        first.stdin.close()
    with RunFolder(folder, "d1"):  # free again
        pass


def test_what_a_killed_process_left_half_written_is_removed(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / ".manifest.json.123.part").write_text("{")  # killed at its very first file
    with RunFolder(folder, "d1"):
        assert [path.name for path in folder.iterdir()] == [".lock"]


def test_a_folder_with_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match="holds something else; name another with --out") as caught:
        RunFolder(tmp_path, "d1")
    sentence(caught)
    with pytest.raises(UserError, match="no run folder, so it isn't cleared") as caught:
        clear(tmp_path, "d1")
    sentence(caught)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


@pytest.mark.parametrize(
    "manifest",
    [
        '{"name": "My PWA", "display": "standalone"}',
        '{"status": "complete"}',
        '{"status": "ok", "digest": "d1"}',
        '{"status": "running", "digest": 1}',
        "[]",
    ],
)
def test_a_folder_with_somebody_elses_manifest_is_left_alone(tmp_path, finished, manifest):
    (tmp_path / "manifest.json").write_text(manifest)
    (tmp_path / "summary.csv").write_text("theirs")
    for use in (
        lambda: RunFolder(tmp_path, "d1"),
        lambda: clear(tmp_path, "d1"),
        lambda: require_complete(tmp_path),
    ):
        with pytest.raises(UserError, match=r"something else|no run folder") as caught:
            use()
        assert "--force" not in sentence(caught)
    assert not is_complete(tmp_path, finished[0])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["manifest.json", "summary.csv"]


def test_a_folder_with_another_run_is_left_alone(finished):
    experiment, folder = finished
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    other = experiment._replace(resolved={**experiment.resolved, "name": "other"})
    with pytest.raises(UserError, match=r"holds another run \(small, digest \w+\)") as caught:
        run(other, folder, 1, quiet)
    assert "--out" in sentence(caught)
    assert "--force" in sentence(caught)
    assert before == {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "run"):
        assert read_manifest(path) is None
        clear(path, "d1")  # --force doesn't touch it
        with pytest.raises(UserError, match="cannot be made") as caught:
            RunFolder(path, "d1")
        sentence(caught)
    assert (tmp_path / "file").is_file()


def test_a_folder_that_cannot_be_looked_at_is_one_sentence(tmp_path):
    """A name that is too long fails as a folder without permission does, for any user."""
    for use in (require_complete, lambda path: clear(path, "d1")):
        with pytest.raises(UserError, match=r"manifest.json: cannot be read \(\D+\)") as caught:
            use(tmp_path / ("x" * 300))
        assert "remove" not in sentence(caught)


def test_clear_removes_run_folders_finished_or_begun(damaged, tmp_path):
    _, folder = damaged
    clear(folder, "d1")
    assert not folder.exists()
    clear(folder, "d1")  # nothing there: nothing to do
    with RunFolder(tmp_path / "begun", "d1"):
        pass
    clear(tmp_path / "begun", "d1")
    assert not (tmp_path / "begun").exists()


def test_clear_leaves_what_a_run_did_not_write(damaged):
    _, folder = damaged
    mine = {
        "notes.txt",
        "merged.parquet",
        "film.mp4.part",
        "figures/annotated.svg",
        "figures/poster.png",
        "shards/backup/0000-000000-5.npz",
        "shards/mine.npz",
        "unfinished/chapter.tex",
    }
    for name in (*mine, "figures/trajectory.png", "figures/position_error-east.png"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("mine")
    clear(folder, "d2")
    kept = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert kept == mine | {"manifest.json"}
    with RunFolder(folder, "d2"):  # and the folder may be written again
        pass


# ---- damage ----------------------------------------------------------------------------------


def cut(path, keep):
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])


@pytest.mark.parametrize("text", ["", "{", '{"status": ', "\xff\xfe", "[" * 100_000])
def test_a_damaged_manifest_is_one_sentence(damaged, text):
    experiment, folder = damaged
    (folder / "manifest.json").write_text(text, encoding="latin-1")
    for use in (
        lambda: run(experiment, folder, 1, quiet),
        lambda: require_complete(folder),
        lambda: clear(folder, "d1"),
    ):
        with pytest.raises(
            UserError, match=r"manifest.json: this is no run's man.*; name"
        ) as caught:
            use()
        assert "remove" not in sentence(caught)  # it may be somebody else's
    assert (folder / "runs.parquet").exists()


@pytest.mark.parametrize("wrong", [{"title": None}, {"runs": "x"}, {"estimators": 3}])
def test_a_manifest_with_other_content_is_one_sentence(damaged, wrong):
    experiment, folder = damaged
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(manifest | wrong))
    for use in (
        lambda: is_complete(folder, experiment),
        lambda: run(experiment, folder, 1, quiet),
        lambda: require_complete(folder),
    ):
        with pytest.raises(UserError, match=r"manifest.json: .* damaged .*; repeat") as caught:
            use()
        assert next(iter(wrong)) in sentence(caught)
    clear(folder, "d1")  # which is what --force does first
    assert not folder.exists()


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9])
def test_a_damaged_shard_is_one_sentence(damaged, keep):
    experiment, folder = damaged
    (shard,) = (folder / "shards").glob("*.npz")
    cut(shard, keep)
    with pytest.raises(UserError, match=r"npz: this file is damaged .*--force") as caught:
        run(experiment, folder, 1, quiet)
    sentence(caught)


@pytest.mark.parametrize("keys", ['{"steps": []}', "3", "{", '{"steps": 1, "windows": 2}'])
def test_a_shard_with_other_content_is_one_sentence(damaged, keys):
    experiment, folder = damaged
    (shard,) = (folder / "shards").glob("*.npz")
    np.savez(shard, keys=np.array(keys), steps=np.zeros(3))
    with pytest.raises(UserError, match=r"npz: this file is damaged .*--force") as caught:
        run(experiment, folder, 1, quiet)
    sentence(caught)


@pytest.mark.parametrize("name", ["summary", "steps", "comparisons", "published", "tracks"])
def test_another_table_in_its_place_is_one_sentence(damaged, name):
    _, folder = damaged
    pq.write_table(pa.table({"estimator": ["IMM"]}), folder / f"{name}.parquet")
    for read in (read_rows, read_columns):
        with pytest.raises(
            UserError, match=rf"{name}.parquet: this file is damaged \(not"
        ) as caught:
            read(folder, name)
        sentence(caught)


def test_a_part_of_runs_with_other_columns_is_one_sentence(tmp_path):
    names = ["0000-000000-2", "0000-000001-2"]
    with RunFolder(tmp_path / "run", "d1") as folder:
        folder.save_shard(names[0], {}, rows(0))
        folder.save_shard(names[1], {}, rows(0).drop_columns("run"))
        with pytest.raises(UserError, match=r"0001-2.arrow: this file is damaged") as caught:
            folder.assemble_runs(names, unseen)
        sentence(caught)


def test_a_shard_with_a_flipped_bit_is_noticed(damaged):
    experiment, folder = damaged
    (shard,) = (folder / "shards").glob("*.npz")
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    with pytest.raises(UserError, match="this file is damaged"):
        run(experiment, folder, 1, quiet)


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.99])
def test_truncated_tables_are_one_sentence(damaged, keep):
    experiment, folder = damaged
    for name in ("summary", "runs"):
        cut(folder / f"{name}.parquet", keep)
    for use in (
        lambda: read_rows(folder, "summary"),
        lambda: next(read_runs(folder)),
        lambda: paired(folder, "IMM", "KF", "position_rmse_m", "all"),
        lambda: run(experiment, folder, 1, quiet),
    ):
        with pytest.raises(UserError, match=r"parquet: this file is damaged .*--force") as caught:
            use()
        sentence(caught)


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.99])
def test_a_truncated_part_of_runs_is_one_sentence(tmp_path, keep):
    with RunFolder(tmp_path / "run", "d1") as folder:
        folder.save_shard("s", {"steps": np.zeros(3)}, rows(0))
        cut(tmp_path / "run" / "shards" / "s.arrow", keep)
        with pytest.raises(UserError, match=r"s.arrow: this file is damaged") as caught:
            folder.assemble_runs(["s"], unseen)
        sentence(caught)
    assert not (tmp_path / "run" / "runs.parquet").exists()


def test_a_missing_table_is_one_sentence(damaged):
    _, folder = damaged
    for name in ("steps", "runs"):
        (folder / f"{name}.parquet").unlink()
    for use in (lambda: read_columns(folder, "steps"), lambda: next(read_runs(folder))):
        with pytest.raises(UserError, match=r"missing from the run folder; .*--force") as caught:
            use()
        sentence(caught)


def test_lost_runs_are_run_again(damaged):
    """Statistics are of no use without their runs."""
    experiment, folder = damaged
    before = (folder / "runs.parquet").read_bytes()
    (folder / "runs.parquet").unlink()
    run(experiment, folder, 1, quiet)
    assert (folder / "runs.parquet").read_bytes() == before


# ---- shards ----------------------------------------------------------------------------------


def rows(first):
    """Two runs of two estimators."""
    columns = {"case": ["a"] * 4, "estimator": ["raw", "raw", "IMM", "IMM"], "window": ["all"] * 4}
    texts = {name: pa.array(column).dictionary_encode() for name, column in columns.items()}
    return pa.table({**texts, "run": [first, first + 1] * 2})


def unseen(runs):
    """Nobody looks at the runs."""


def test_a_shard_comes_back_as_it_was_put_away(tmp_path):
    arrays = {"keys": np.array('{"a": 1}'), "steps": np.array([[np.nan, np.inf, 1e-320]])}
    with RunFolder(tmp_path / "run", "d1") as folder:
        assert not folder.has_shard("0")
        folder.save_shard("0", arrays, rows(0))
        assert folder.has_shard("0")
        loaded = folder.load_shard("0", dict)
    assert str(loaded["keys"]) == '{"a": 1}'
    assert loaded["steps"].tobytes() == arrays["steps"].tobytes()


def test_runs_are_assembled_in_the_order_asked_for_from_old_and_new(tmp_path):
    runs = tmp_path / "run" / "runs.parquet"
    zero, five, ten = "0000-000000-2", "0000-000005-2", "0000-000010-2"
    seen = []
    with RunFolder(tmp_path / "run", "d1") as folder:
        for name, number in ((zero, 0), (ten, 10)):
            folder.save_shard(name, {"a": np.zeros(1)}, rows(number))
        folder.assemble_runs([zero, ten], seen.append)
        assert not runs.exists()
        folder.publish({"digest": "d1"})
        folder.drop_parts([zero, ten])
    assert pq.read_table(runs)["run"].to_pylist() == [0, 1, 0, 1, 10, 11, 10, 11]
    with RunFolder(tmp_path / "run", "d1") as folder:
        assert folder.has_shard(ten)
        folder.save_shard(five, {"a": np.zeros(1)}, rows(5))
        folder.assemble_runs([five, ten], seen.append)
        folder.publish({"digest": "d1"})
        folder.drop_parts([five, ten])
    table = pq.read_table(runs)
    assert table["run"].to_pylist() == [5, 6, 5, 6, 10, 11, 10, 11]
    assert table["estimator"].to_pylist() == ["raw", "raw", "IMM", "IMM"] * 2
    assert table.schema.field("estimator").type == pa.string()  # not our dictionary
    assert seen == [rows(first) for first in (0, 10, 5, 10)]
    assert not (tmp_path / "run" / "unfinished").exists()


def test_shards_that_have_grown_are_dropped_and_longer_ones_are_kept(tmp_path):
    held, beyond, longer = "0000-000000-2048", "0000-000001-2048", "0001-000000-2048"
    grown, own = "0000-000000-300", "0001-000000-300"
    shards = tmp_path / "run" / "shards"
    with RunFolder(tmp_path / "run", "d1") as folder:
        for name in (grown, held, beyond, own, longer):
            folder.save_shard(name, {}, rows(0))
        (shards / "folder.npz").mkdir()
        (shards / "mine.npz").touch()
        folder.drop_parts([held, own])
    kept = {f"{held}.npz", f"{own}.npz"}  # their runs are in runs.parquet
    kept |= {f"{name}.{suffix}" for name in (beyond, longer) for suffix in ("npz", "arrow")}
    assert {path.name for path in shards.iterdir()} == kept | {"folder.npz", "mine.npz"}


def test_tables_stay_as_they_are_until_they_are_published(tmp_path):
    names = SCHEMAS["published"].names
    run_folder = tmp_path / "run"
    manifest = {"digest": "d1"}
    with RunFolder(run_folder, "d1") as folder:
        folder.write_table("published", {name: [] for name in names})
        folder.publish(manifest)
    before = (run_folder / "published.parquet").read_bytes()
    row = {field.name: pa.nulls(1, field.type) for field in SCHEMAS["published"]}
    with RunFolder(run_folder, "d1") as folder:
        folder.write_table("published", row)
        assert (run_folder / "published.parquet").read_bytes() == before
    with RunFolder(run_folder, "d1") as folder:
        assert not folder.unfinished.exists()
        assert (run_folder / "published.parquet").read_bytes() == before
        folder.write_table("published", row)
        folder.publish(manifest)
    assert read_rows(run_folder, "published") == [dict.fromkeys(names)]
    assert read_manifest(run_folder) == manifest | {"status": "complete"}


# ---- reading ---------------------------------------------------------------------------------


def test_require_complete(finished, tmp_path):
    _, folder = finished
    assert require_complete(folder) == json.loads((folder / "manifest.json").read_text())
    for path in (tmp_path, tmp_path / "nothing", folder / "config.yaml"):
        with pytest.raises(UserError, match="this is no run folder; name one that") as caught:
            require_complete(path)
        sentence(caught)
    (tmp_path / "manifest.json").write_text('{"status": "running", "digest": "d1"}')
    with pytest.raises(UserError, match="isn't complete; run its scenario again"):
        require_complete(tmp_path)
    assert read_manifest(tmp_path / "nothing") is None


def test_runs_come_back_by_estimator_window_and_run(finished):
    experiment, folder = finished
    (runs,) = read_runs(folder)  # five runs: one shard
    table = pd.read_parquet(folder / "runs.parquet")
    labels, windows = names_in(runs["estimator"]), names_in(runs["window"])
    assert labels == ["raw", *(chosen.label for chosen in experiment.estimators)]
    assert windows == [window.name for window in experiment.windows]
    expected = [(e, w, r) for e in labels for w in windows for r in range(experiment.runs)]
    assert list(table[["estimator", "window", "run"]].itertuples(index=False)) == expected
    for name in table.columns.drop(["case", "estimator", "window"]):
        np.testing.assert_array_equal(as_numpy(runs[name]), table[name])


@pytest.mark.parametrize(("estimator", "window"), [("XYZ", "all"), ("IMM", "xyz")])
def test_a_pair_that_is_not_there_is_one_sentence(finished, estimator, window):
    with pytest.raises(UserError, match="holds no estimator") as caught:
        paired(finished[1], "KF", estimator, "position_rmse_m", window)
    assert estimator in sentence(caught)
    assert window in sentence(caught)


@pytest.mark.parametrize("name", SCHEMAS)
def test_tables_have_their_schema_even_when_empty(tmp_path, name):
    with RunFolder(tmp_path / "run", "d1") as folder:
        folder.write_table(name, {field.name: [] for field in SCHEMAS[name]})
        folder.publish({"digest": "d1"})
    assert pq.read_schema(tmp_path / "run" / f"{name}.parquet").equals(SCHEMAS[name])
    assert read_rows(tmp_path / "run", name) == []
    if name in ("steps", "tracks"):
        table = read_columns(tmp_path / "run", name)
        assert list(table) == SCHEMAS[name].names
        assert {len(column) for column in table.values()} == {0}
        assert table["value"].dtype == np.float64
