"""The folder of an analysis: tables, analysis.json and figures, written whole or not at all.

analysis.json is written last; a folder without it is unfinished. It holds all that is printed, so
that a finished analysis is shown again from it alone.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from hybridtrack import columns, results
from hybridtrack.analyses import Table
from hybridtrack.errors import UserError

ANALYSIS = "analysis.json"
TABLE = "table"


def arrow(table: Table) -> pa.Table:
    """The table as Arrow's: every column of one type, None and no column at all as null."""
    return pa.table({name: _column(values) for name, values in table.columns.items()})


def _column(values: Sequence[Any]) -> pa.Array:
    plain = [_plain(value) for value in values]
    kinds = {type(value) for value in plain if value is not None}
    if kinds <= {int, float} and float in kinds:
        plain = [None if value is None else float(value) for value in plain]
        kinds = {float}
    if len(kinds) > 1:
        raise TypeError(f"a column of {', '.join(sorted(kind.__name__ for kind in kinds))}")
    types = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}
    return pa.array(plain, types[kinds.pop()] if kinds else pa.float64(), from_pandas=False)


def _plain(value: Any) -> Any:
    """A Python object of what may be NumPy's."""
    return value.item() if hasattr(value, "item") else value


def rows(table: Table) -> list[dict[str, Any]]:
    """The table row by row, of Python's own types."""
    names = list(table.columns)
    cells = zip(*table.columns.values(), strict=True)
    return [dict(zip(names, map(_plain, row), strict=True)) for row in cells]


def finite(value: Any) -> Any:
    """The same for JSON, which has neither: NaN is null, infinity (never) the text "inf"."""
    if isinstance(value, Mapping):
        return {str(key): finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [finite(part) for part in value]
    value = _plain(value)
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0 else "-inf"
    return None if isinstance(value, float) and math.isnan(value) else value


def prepare(folder: Path, digest: str) -> None:
    """Make the folder. Raises UserError where it holds anything else than this analysis."""
    results.make_folder(folder)
    held = read(folder)
    try:
        others = [path.name for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise UserError(f"{folder}: cannot be read ({error.strerror})") from None
    if held is None and (results.MANIFEST in others or (others and not _is_ours(others))):
        raise UserError(f"{folder}: this folder holds something else; name another with --out")
    if held is not None and held.get("digest") != digest:
        raise UserError(
            f"{folder}: this folder holds another analysis ({held.get('analysis')} of "
            f"{held.get('scenario')}); name another with --out, or add --force"
        )


def _is_ours(names: Sequence[str]) -> bool:
    """Whether a folder without analysis.json holds what an interrupted analysis may leave."""
    known = (results.CONFIG, "figures", "run")
    return all(name in known or name.endswith((".parquet", ".csv")) for name in names)


def write(folder: Path, table: Table, tables: Mapping[str, Table], config: str) -> None:
    """The tables, as Parquet, the main one as CSV too, and the scenario."""
    results.write_text(folder / results.CONFIG, config)
    for name, one in {TABLE: table, **tables}.items():
        content = arrow(one)
        with (
            results.replacing(folder / f"{name}.parquet") as temporary,
            columns.writer(temporary, content.schema) as writer,
        ):
            writer.write_table(content)
        if name == TABLE:
            results.write_text(folder / f"{name}.csv", columns.as_csv(content))


def finish(folder: Path, record: Mapping[str, Any]) -> None:
    """analysis.json: what was asked, found and concluded."""
    text = json.dumps(finite(record), indent=2, allow_nan=False, ensure_ascii=False)
    results.write_text(folder / ANALYSIS, text + "\n")


def read(folder: Path) -> dict[str, Any] | None:
    """What a finished analysis left, None where there is none. Raises UserError if damaged."""
    file = folder / ANALYSIS
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(record["digest"], str) or not isinstance(record["table"], list):
            raise ValueError("not as an analysis writes it")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise UserError(f"{file}: cannot be read ({error.strerror})") from None
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        said = " ".join(str(error).split())
        raise UserError(
            f"{file}: this file is damaged ({said}); repeat the analysis with --force"
        ) from None
    return dict(record)


def clear(folder: Path) -> None:
    """Forget a finished analysis, so that it is repeated. Raises UserError where it is no such."""
    if folder.is_dir() and not (folder / ANALYSIS).exists() and any(folder.iterdir()):
        names = [path.name for path in folder.iterdir() if not path.name.startswith(".")]
        if results.MANIFEST in names or not _is_ours(names):
            raise UserError(f"{folder}: this is no analysis' folder, so it isn't cleared")
    try:
        (folder / ANALYSIS).unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be cleared ({error.strerror})") from None
