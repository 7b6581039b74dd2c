"""The run folder: the only room that writes data.

Everything is written under a temporary name and moved into place. Tables hold nothing that says
when or where; the manifest says it. While a run is under way `shards/` holds the statistics of
every finished shard (a fixed number of blocks of one case), so that a killed run goes on where it
stopped, and a finished one can be continued to more runs.
"""

import contextlib
import json
import os
import shutil
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from hybridtrack.errors import UserError

MANIFEST = "manifest.json"
RUNNING, COMPLETE = "running", "complete"
LOCK, PART = ".lock", ".part"
DAMAGE = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    zipfile.BadZipFile,
    zlib.error,
    pa.ArrowException,
)
Array = NDArray[Any]

SCHEMAS = {
    "summary": pa.schema(
        [
            ("estimator", pa.string()),
            ("metric", pa.string()),
            ("window", pa.string()),
            ("value", pa.float64()),
            ("standard_error", pa.float64()),
            ("n_runs", pa.int64()),
        ]
    ),
    "steps": pa.schema(
        [
            ("case", pa.string()),
            ("estimator", pa.string()),
            ("step", pa.int32()),
            ("time_s", pa.float64()),
            ("metric", pa.string()),
            ("value", pa.float64()),
            ("standard_error", pa.float64()),
        ]
    ),
    "comparisons": pa.schema(
        [
            ("first", pa.string()),
            ("second", pa.string()),
            ("metric", pa.string()),
            ("window", pa.string()),
            ("difference", pa.float64()),
            ("difference_standard_error", pa.float64()),
            ("ratio", pa.float64()),
            ("ratio_standard_error", pa.float64()),
            ("n_pairs", pa.int64()),
        ]
    ),
    "published": pa.schema(
        [
            ("claim", pa.string()),
            ("estimator", pa.string()),
            ("metric", pa.string()),
            ("window", pa.string()),
            ("published", pa.float64()),
            ("sign", pa.string()),
            ("ours", pa.float64()),
            ("standard_error", pa.float64()),
            ("verdict", pa.string()),
            ("expected_verdict", pa.string()),
            ("differs", pa.bool_()),
            ("because", pa.string()),
        ]
    ),
    "tracks": pa.schema(
        [
            ("case", pa.string()),
            ("run", pa.int64()),
            ("estimator", pa.string()),
            ("step", pa.int32()),
            ("time_s", pa.float64()),
            ("quantity", pa.string()),
            ("value", pa.float64()),
        ]
    ),
}


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path`; moved onto it when all went well, removed otherwise."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}{PART}")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({_reason(error)})") from None
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()


class RunFolder:
    """A run's folder, opened for writing by one process at a time."""

    def __init__(self, path: Path, digest: str) -> None:
        """Makes the folder. Raises UserError where it holds anything else than this run."""
        self.path = path
        self.digest = digest
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"{path}: cannot be made ({_reason(error)})") from None
        manifest = read_manifest(path)
        if manifest is None and _holds_something(path):
            raise UserError(f"{path}: this folder holds something else; name another with --out")
        if manifest is not None and manifest.get("digest") != digest:
            raise UserError(
                f"{path}: this folder holds another run ({manifest.get('name')}, digest "
                f"{manifest.get('digest')}); name another with --out, or add --force"
            )
        self._lock = contextlib.ExitStack()
        self._assembled: list[str] = []  # shards whose runs runs.parquet holds, in its order

    def __enter__(self) -> "RunFolder":
        with contextlib.ExitStack() as stack:
            stack.enter_context(_locked(self.path / LOCK))
            for part in self.path.glob(f".*{PART}"):  # of a killed process
                part.unlink(missing_ok=True)
            self._assembled = _shards_in(self.path / "runs.parquet")
            self._lock = stack.pop_all()
        return self

    def __exit__(self, *exception: object) -> None:
        self._lock.close()

    # ---- shards ----

    @property
    def _shards(self) -> Path:
        return self.path / "shards"

    def has_shard(self, name: str) -> bool:
        """Whether the statistics and the runs of a shard are at hand."""
        return (self._shards / f"{name}.npz").exists() and (
            (self._shards / f"{name}.parquet").exists() or name in self._assembled
        )

    def save_shard(self, name: str, arrays: Mapping[str, Any], cells: Sequence[pa.Table]) -> None:
        """Put a shard away: its runs first, so that statistics are never without them.

        cells: a table of runs per estimator and window, always in the same order; each becomes a
        row group, so that one can be read without the others.
        """
        try:
            self._shards.mkdir(exist_ok=True)
        except OSError as error:
            raise UserError(f"{self._shards}: cannot be made ({_reason(error)})") from None
        with (
            replacing(self._shards / f"{name}.parquet") as temporary,
            pq.ParquetWriter(temporary, cells[0].schema, compression="zstd") as writer,
        ):
            for cell in cells:
                writer.write_table(cell)
        with replacing(self._shards / f"{name}.npz") as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)

    def load_shard(self, name: str) -> dict[str, Any]:
        """The arrays of a shard. Raises UserError where the file is damaged."""
        path = self._shards / f"{name}.npz"
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                return {key: archive[key] for key in archive.files}
        except DAMAGE as error:
            raise _damaged(path, error) from None

    def assemble_runs(self, names: list[str], n_cells: int) -> None:
        """runs.parquet from the shards' row groups; memory holds one of these at a time.

        The file says which shards it holds, so that it can be gone on from whenever this process
        is killed.
        """
        target = self.path / "runs.parquet"
        with replacing(target) as temporary, contextlib.ExitStack() as stack:
            writer: pq.ParquetWriter | None = None
            for name in names:
                source, first = self._shards / f"{name}.parquet", 0
                if not source.exists():
                    source, first = target, n_cells * self._assembled.index(name)
                for table in _row_groups(source, first, n_cells):
                    if writer is None:
                        schema = table.schema.with_metadata({"shards": json.dumps(names)})
                        writer = pq.ParquetWriter(temporary, schema, compression="zstd")
                        stack.callback(writer.close)
                    writer.write_table(table)

    def drop_parts(self, names: list[str]) -> None:
        """Remove what runs.parquet now holds, and shards that are no part of this run."""
        for path in self._shards.iterdir():
            if path.suffix != ".npz" or path.stem not in names:
                path.unlink(missing_ok=True)

    # ---- tables and the manifest ----

    def write_table(self, name: str, rows: Mapping[str, Any]) -> None:
        """One of TABLES from columns (empty ones too)."""
        table = pa.table(dict(rows), schema=SCHEMAS[name])
        with replacing(self.path / f"{name}.parquet") as temporary:
            pq.write_table(table, temporary, compression="zstd")
        if name == "summary":
            write_text(self.path / "summary.csv", table.to_pandas().to_csv(index=False))

    def write_manifest(self, manifest: Mapping[str, Any]) -> None:
        """manifest.json; `status` tells whether everything else is there."""
        write_text(self.path / MANIFEST, json.dumps(manifest, indent=2) + "\n")


def _holds_something(path: Path) -> bool:
    """Whether a folder without a manifest holds more than a killed run's first files."""
    return any(p.name != LOCK and not p.name.endswith(PART) for p in path.iterdir())


def _damaged(path: Path, error: Exception) -> UserError:
    said = " ".join(str(error).split()).rstrip(".")
    return UserError(f"{path}: this file is damaged ({said}); repeat the run with --force")


def _missing(path: Path) -> UserError:
    return UserError(f"{path}: missing from the run folder; repeat the run with --force")


def _shards_in(path: Path) -> list[str]:
    """The shards whose runs a runs.parquet holds; none where there is no such file."""
    try:
        names: list[str] = json.loads((pq.read_schema(path).metadata or {})[b"shards"])
        return names
    except FileNotFoundError:
        return []
    except DAMAGE as error:
        raise _damaged(path, error) from None


def _row_groups(path: Path, first: int, number: int) -> Iterator[pa.Table]:
    """Some row groups of a file, in order. Raises UserError where it is damaged."""
    try:
        with pq.ParquetFile(path) as file:
            for group in range(first, first + number):
                yield file.read_row_group(group)
    except DAMAGE as error:
        raise _damaged(path, error) from None


def _locked(path: Path) -> IO[str]:
    try:
        file = path.open("w")
    except OSError as error:
        raise UserError(f"{path.parent}: cannot be written ({_reason(error)})") from None
    try:
        import fcntl
    except ImportError:  # no such lock on this system: two runs at once are the user's affair
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise UserError(
            f"{path.parent}: another run is writing this folder; wait for it, or use --out"
        ) from None
    return file


def clear(path: Path, digest: str) -> None:
    """Remove what a run wrote into a folder, and the folder if nothing else is in it.

    Whatever else is in it stays, and the folder is then the given run's. Raises UserError where
    it isn't a run folder, or in use.
    """
    if not path.exists():
        return
    if read_manifest(path) is None and _holds_something(path):
        raise UserError(f"{path}: this is no run folder, so it isn't cleared; name another")
    _locked(path / LOCK).close()  # nobody is writing it
    try:
        for pattern in ("shards", "figures/*.png", "*.parquet", "*.part", "summary.csv"):
            for found in path.glob(pattern):
                shutil.rmtree(found) if found.is_dir() else found.unlink()
        for name in ("config.yaml", LOCK, MANIFEST):
            (path / name).unlink(missing_ok=True)
        for folder in (path / "figures", path):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
        if path.exists():
            begun = {"status": RUNNING, "digest": digest}
            write_text(path / MANIFEST, json.dumps(begun) + "\n")
    except OSError as error:
        raise UserError(f"{path}: cannot be cleared ({_reason(error)})") from None


def read_manifest(path: Path) -> dict[str, Any] | None:
    """The manifest of a run folder; None where there is none. Raises UserError if damaged."""
    try:
        manifest = json.loads((path / MANIFEST).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise UserError(f"{path / MANIFEST}: cannot be read ({error}); remove the folder") from None
    return manifest if isinstance(manifest, dict) else None


def require_complete(path: Path) -> dict[str, Any]:
    """The manifest of a finished run. Raises UserError where there is none."""
    manifest = read_manifest(path) if path.is_dir() else None
    if manifest is None:
        raise UserError(f"{path}: this is no run folder; name one that `hybridtrack run` printed")
    if manifest.get("status") != COMPLETE:
        raise UserError(f"{path}: this run isn't complete; run its scenario again to finish it")
    return manifest


def read_table(path: Path, name: str) -> pd.DataFrame:
    """A table of a run folder. Raises UserError where it is missing or damaged."""
    file = path / f"{name}.parquet"
    try:
        table: pd.DataFrame = pq.read_table(file).to_pandas()
        return table
    except FileNotFoundError:
        raise _missing(file) from None
    except DAMAGE as error:
        raise _damaged(file, error) from None


def read_run_sums(
    path: Path, estimator: str, window: str
) -> tuple[dict[str, tuple[Array, Array]], Array, Array]:
    """One estimator's runs in one window, in the order of cases and runs.

    Gives by quantity (sums, numbers), each (n_runs,), then the case numbers and the statuses.
    """
    parts: list[pa.Table] = []
    path = path / "runs.parquet"
    try:
        with pq.ParquetFile(path) as file:
            names = file.schema_arrow.names
            place = [names.index(name) for name in ("estimator", "window")]
            for group in range(file.num_row_groups):
                columns = [file.metadata.row_group(group).column(i).statistics for i in place]
                if [column.min for column in columns] == [estimator, window]:
                    parts.append(file.read_row_group(group))
    except FileNotFoundError:
        raise _missing(path) from None
    except DAMAGE as error:
        raise _damaged(path, error) from None
    if not parts:
        raise UserError(f"{path}: holds no estimator '{estimator}' with a window '{window}'")
    table = pa.concat_tables(parts)
    quantities = [name.removesuffix("_sum") for name in names if name.endswith("_sum")]
    sums = {q: (_column(table, f"{q}_sum"), _column(table, f"{q}_count")) for q in quantities}
    return sums, _column(table, "case_number"), _column(table, "status")


def _column(table: pa.Table, name: str) -> Array:
    values: Array = table[name].to_numpy(zero_copy_only=False)
    return values
