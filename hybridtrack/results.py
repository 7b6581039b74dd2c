"""The run folder: the only room that writes data.

Everything is written under a temporary name and moved into place. Tables hold nothing that says
when or where; the manifest says it. While a run is under way `shards/` holds the statistics of
every finished shard (a fixed number of blocks of one case), so that a killed run goes on where it
stopped, and a finished one can be continued to more runs: its result stays as it is until the
longer one's, put together in `unfinished/`, replaces it. Only files named here are ever removed.
"""

import contextlib
import json
import os
import re
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hybridtrack import columns
from hybridtrack.columns import SCHEMAS, Array
from hybridtrack.errors import UserError

MANIFEST = "manifest.json"
RUNNING, COMPLETE = "running", "complete"
CONFIG, CSV = "config.yaml", "summary.csv"
LOCK, PART = ".lock", ".part"
SHARDS, UNFINISHED, FIGURES = "shards", "unfinished", "figures"
REPEAT = "repeat the run with --force"
SHARD_NAME = re.compile(r"(?P<place>\d{4,}-\d{6,})-(?P<runs>\d+)")  # place: case and first block
PART_NAME = re.compile(r"\..+\.\d+\.part(ial)?")
FIGURE_NAME = re.compile(
    r"(trajectory|(position|velocity)_error|error_ratio|(final_)?mode_(probability|likelihood)"
    r"|reliability|sets|bound|operating_points|model_chosen)(-.+)?\.png"
)
FINISHED: dict[str, type | tuple[type, ...]] = {  # what a finished run's manifest is asked for
    "name": str,
    "title": str,
    "seed": int,
    "runs": int,
    "cases": int,
    "estimators": list,
    "modes": list,
    "windows": list,
    "compare_with": (str, type(None)),
    "error": str,
    "diverged": dict,
    "states": dict,
}
DAMAGE = (
    OSError,
    ValueError,
    EOFError,
    LookupError,
    TypeError,
    zipfile.BadZipFile,
    zlib.error,
    pa.ArrowException,
)
Content = TypeVar("Content")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path`; moved onto it when all went well, removed otherwise."""
    if not path.name or path.is_dir():
        raise UserError(f"{path}: this is no file's name; give one")
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


def make_folder(folder: Path) -> None:
    """Raises UserError where it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made ({_reason(error)})") from None


class RunFolder:
    """A run's folder, opened for writing by one process at a time."""

    def __init__(self, path: Path, digest: str) -> None:
        """Makes the folder. Raises UserError where it holds anything else than this run."""
        self.path = path
        self.digest = digest
        make_folder(path)
        manifest = read_manifest(path)
        if manifest is None and _holds_something(path):
            raise UserError(f"{path}: this folder holds something else; name another with --out")
        if manifest is not None and manifest.get("digest") != digest:
            raise UserError(
                f"{path}: this folder holds another run ({manifest.get('name')}, digest "
                f"{manifest.get('digest')}); name another with --out, or add --force"
            )
        self.unfinished = path / UNFINISHED  # the tables, until publish
        self._lock = contextlib.ExitStack()
        self._assembled: list[str] = []  # shards whose runs runs.parquet holds, in its order

    def __enter__(self) -> "RunFolder":
        with contextlib.ExitStack() as stack:
            stack.enter_context(_locked(self.path / LOCK))
            _remove(self.path, PART_NAME.fullmatch)  # of a killed process
            _remove(self.unfinished, _is_table)
            self._assembled = _shards_in(self.path / "runs.parquet")
            self._lock = stack.pop_all()
        return self

    def __exit__(self, *exception: object) -> None:
        with self._lock:
            _remove(self.unfinished, _is_table)

    # ---- shards ----

    @property
    def _shards(self) -> Path:
        return self.path / SHARDS

    def has_shard(self, name: str) -> bool:
        """Whether the statistics and the runs of a shard are at hand."""
        return (self._shards / f"{name}.npz").exists() and (
            (self._shards / f"{name}.arrow").exists() or name in self._assembled
        )

    def save_shard(self, name: str, arrays: Mapping[str, Any], runs: pa.Table) -> None:
        """Put a shard away: its runs first, so that statistics are never without them.

        The runs go into an Arrow file with LZ4, a tenth of the work that Parquet is.
        """
        make_folder(self._shards)
        options = pa.ipc.IpcWriteOptions(compression="lz4")
        with (
            replacing(self._shards / f"{name}.arrow") as temporary,
            temporary.open("wb") as file,
            pa.ipc.new_file(file, runs.schema, options=options) as writer,
        ):
            writer.write_table(runs)
        with replacing(self._shards / f"{name}.npz") as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)

    def load_shard(self, name: str, unpack: Callable[[dict[str, Any]], Content]) -> Content:
        """What `unpack` makes of a shard's arrays. Raises UserError where the file is damaged."""
        path = self._shards / f"{name}.npz"
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                return unpack({key: archive[key] for key in archive.files})
        except DAMAGE as error:
            raise _damaged(path, error) from None

    def assemble_runs(self, names: list[str], look: Callable[[pa.Table], None]) -> None:
        """The next runs.parquet, a row group per shard, each shown to `look` on its way.

        Memory holds one at a time. The file says which shards it holds, so that it can be gone on
        from whenever this process is killed.
        """
        make_folder(self.unfinished)
        with (
            replacing(self.unfinished / "runs.parquet") as temporary,
            contextlib.ExitStack() as stack,
        ):
            writer: pq.ParquetWriter | None = None
            for name in names:
                source = self._shards / f"{name}.arrow"
                if source.exists():
                    table = _arrow_table(source)
                else:
                    source = self.path / "runs.parquet"
                    (table,) = row_groups(source, [self._assembled.index(name)])
                if writer is None:
                    writer = stack.enter_context(columns.writer(temporary, table.schema))
                    writer.add_key_value_metadata({"shards": json.dumps(names)})
                elif not table.schema.equals(writer.schema):
                    raise _damaged(source, ValueError("other columns than the rest"))
                writer.write_table(table, row_group_size=table.num_rows)
                look(table)

    def drop_parts(self, names: list[str]) -> None:
        """Remove what runs.parquet now holds, and shards that have grown.

        Those beyond this run, or longer than its own, stay: of a longer one that was interrupted.
        """
        held = {m["place"]: int(m["runs"]) for name in names if (m := SHARD_NAME.fullmatch(name))}

        def is_done_with(name: str) -> bool:
            stem, _, suffix = name.partition(".")
            shard = SHARD_NAME.fullmatch(stem)
            if PART_NAME.fullmatch(name) or (stem in names and suffix == "arrow"):
                return True
            return shard is not None and int(shard["runs"]) < held.get(shard["place"], 0)

        _remove(self._shards, is_done_with)

    # ---- tables and the manifest ----

    def write_table(self, name: str, rows: Mapping[str, Any]) -> None:
        """One of SCHEMAS from columns (empty ones too), for `publish`."""
        table = columns.table(name, rows)
        make_folder(self.unfinished)
        with (
            replacing(self.unfinished / f"{name}.parquet") as temporary,
            columns.writer(temporary, table.schema) as writer,
        ):
            writer.write_table(table)
        if name == "summary":
            write_text(self.unfinished / CSV, columns.as_csv(table))

    def write_manifest(self, manifest: Mapping[str, Any]) -> None:
        """manifest.json; `status` tells whether everything else is there."""
        write_text(self.path / MANIFEST, json.dumps(manifest, indent=2) + "\n")

    def publish(self, manifest: Mapping[str, Any]) -> None:
        """Put the unfinished files in the place of those that are there; the manifest last."""
        self.write_manifest({**manifest, "status": RUNNING})  # old and new are mixed for a moment
        try:
            for file in sorted(self.unfinished.iterdir()):
                file.replace(self.path / file.name)
        except OSError as error:
            raise UserError(f"{self.path}: cannot be written ({_reason(error)})") from None
        self.write_manifest({**manifest, "status": COMPLETE})


def _holds_something(path: Path) -> bool:
    """Whether a folder without a manifest holds more than a killed run's first files."""
    try:
        return any(p.name != LOCK and not PART_NAME.fullmatch(p.name) for p in path.iterdir())
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({_reason(error)})") from None


def _is_table(name: str) -> bool:
    """Whether a file of this name is one that `publish` moves, or a part of one."""
    tables = {f"{table}.parquet" for table in (*SCHEMAS, "runs")}
    return name in tables | {CSV, CONFIG} or PART_NAME.fullmatch(name) is not None


def _is_shard(name: str) -> bool:
    stem, _, suffix = name.partition(".")
    shard = SHARD_NAME.fullmatch(stem) and suffix in ("npz", "arrow")
    return bool(shard or PART_NAME.fullmatch(name))


def _is_figure(name: str) -> bool:
    return bool(FIGURE_NAME.fullmatch(name) or PART_NAME.fullmatch(name))


def _remove(folder: Path, is_ours: Callable[[str], object]) -> None:
    """Remove a folder's files of the given names, and the folder if nothing else was in it."""
    try:
        for path in folder.iterdir() if folder.is_dir() else ():
            if is_ours(path.name) and not path.is_dir():
                path.unlink()
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    except OSError as error:
        raise UserError(f"{folder}: cannot be cleared ({_reason(error)})") from None


def _damaged(path: Path, error: Exception, remedy: str = REPEAT) -> UserError:
    said = " ".join(str(error).split()).rstrip(".")
    return UserError(f"{path}: this file is damaged ({said}); {remedy}")


def _missing(path: Path) -> UserError:
    return UserError(f"{path}: missing from the run folder; repeat the run with --force")


def _shards_in(path: Path) -> list[str]:
    """The shards whose runs a runs.parquet holds; none where there is no such file."""
    try:
        names = json.loads((pq.read_metadata(path).metadata or {})[b"shards"])
        return [str(name) for name in names]
    except FileNotFoundError:
        return []
    except DAMAGE as error:
        raise _damaged(path, error) from None


def _arrow_table(path: Path) -> pa.Table:
    """The table of an Arrow file. Raises UserError where it is damaged."""
    try:
        with path.open("rb") as file, pa.ipc.open_file(file) as reader:
            return reader.read_all()
    except DAMAGE as error:
        raise _damaged(path, error) from None


def row_groups(
    path: Path, groups: Iterable[int] | None = None, remedy: str = REPEAT
) -> Iterator[pa.Table]:
    """Row groups of a runs.parquet, all or some. Raises UserError where it is damaged."""
    try:
        with pq.ParquetFile(path, read_dictionary=["case", "estimator", "window"]) as file:
            for group in range(file.num_row_groups) if groups is None else groups:
                yield file.read_row_group(group)
    except FileNotFoundError:
        raise _missing(path) from None
    except DAMAGE as error:
        raise _damaged(path, error, remedy) from None


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
    manifest = read_manifest(path)
    if not path.is_dir():
        return
    if manifest is None and _holds_something(path):
        raise UserError(f"{path}: this is no run folder, so it isn't cleared; name another")
    _locked(path / LOCK).close()  # nobody is writing it
    for folder, is_ours in ((SHARDS, _is_shard), (FIGURES, _is_figure), (UNFINISHED, _is_table)):
        _remove(path / folder, is_ours)
    _remove(path, lambda name: _is_table(name) or name in (LOCK, MANIFEST))
    if path.exists():
        write_text(path / MANIFEST, json.dumps({"status": RUNNING, "digest": digest}) + "\n")


def read_manifest(path: Path) -> dict[str, Any] | None:
    """The manifest of a run folder, begun or finished; None where there is none, or another's.

    Raises UserError where it cannot be read.
    """
    file = path / MANIFEST
    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise UserError(f"{file}: cannot be read ({_reason(error)})") from None
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{file}: this is no run's manifest ({error}); name another folder, or move this file "
            "out of the way"
        ) from None
    ours = (
        isinstance(manifest, dict)
        and manifest.get("status") in (RUNNING, COMPLETE)
        and isinstance(manifest.get("digest"), str)
    )
    return manifest if ours else None


def read_finished(path: Path) -> dict[str, Any] | None:
    """The manifest of a finished run, which may be under way to more runs; None where it isn't.

    Raises UserError where it is damaged.
    """
    manifest = read_manifest(path)
    if manifest is None or manifest["status"] != COMPLETE:
        return None
    for key, kind in FINISHED.items():
        if key not in manifest or not isinstance(manifest[key], kind):
            raise _damaged(path / MANIFEST, ValueError(f"no {key} as a run writes it"))
    return manifest


def require_complete(path: Path) -> dict[str, Any]:
    """The manifest of a finished run. Raises UserError where there is none."""
    if read_manifest(path) is None:
        raise UserError(f"{path}: this is no run folder; name one that `hybridtrack run` printed")
    manifest = read_finished(path)
    if manifest is None:
        raise UserError(f"{path}: this run isn't complete; run its scenario again to finish it")
    return manifest


def read_rows(path: Path, name: str) -> list[dict[str, Any]]:
    """The rows of a table of SCHEMAS. Raises UserError where it is missing or damaged."""
    rows: list[dict[str, Any]] = _read(path, name).to_pylist()
    return rows


def read_columns(path: Path, name: str) -> dict[str, Array]:
    """The columns of a long table, steps or tracks, each different text held once.

    Raises UserError where it is missing or damaged.
    """
    texts = [field.name for field in SCHEMAS[name] if pa.types.is_string(field.type)]
    table = _read(path, name, texts)
    return {column: columns.as_numpy(table[column]) for column in table.column_names}


def _read(path: Path, name: str, dictionaries: Sequence[str] = ()) -> pa.Table:
    file = path / f"{name}.parquet"
    try:
        if not pq.read_schema(file).remove_metadata().equals(SCHEMAS[name]):
            raise ValueError(f"not the columns of {name}")
        with pq.ParquetFile(file, read_dictionary=dictionaries) as opened:
            return opened.read()
    except FileNotFoundError:
        raise _missing(file) from None
    except DAMAGE as error:
        raise _damaged(file, error) from None


def read_runs(path: Path) -> Iterator[pa.Table]:
    """The rows of runs.parquet shard by shard, in the order of cases and runs.

    A shard's rows go by estimator, window and run; there is each combination of the three.
    """
    yield from row_groups(path / "runs.parquet")
