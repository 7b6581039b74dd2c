"""The columns of the tables in a run folder, and Arrow's form of them.

Arrow's own conversions look for pandas, whose import takes longer than writing all tables does.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

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
    "reliability": pa.schema(
        [
            ("estimator", pa.string()),
            ("from_probability", pa.float64()),
            ("to_probability", pa.float64()),
            ("share_of_steps", pa.float64()),
            ("mean_probability", pa.float64()),
            ("frequency", pa.float64()),
            ("standard_error", pa.float64()),
        ]
    ),
    "sets": pa.schema(
        [
            ("estimator", pa.string()),
            ("figure", pa.string()),
            ("value", pa.float64()),
            ("standard_error", pa.float64()),
            ("n_runs", pa.int64()),
        ]
    ),
    "delays": pa.schema(
        [
            ("case", pa.string()),
            ("estimator", pa.string()),
            ("switch", pa.int64()),
            ("from_mode", pa.string()),
            ("to_mode", pa.string()),
            ("step", pa.int64()),
            ("time_s", pa.float64()),
            ("sojourns", pa.int64()),
            ("averaged_delay_steps", pa.float64()),
            ("averaged_delay_steps_low", pa.float64()),
            ("averaged_delay_steps_high", pa.float64()),
            ("detected", pa.int64()),
            ("missed", pa.int64()),
            ("unfinished", pa.int64()),
            ("first_step_share", pa.float64()),
            ("first_step_share_standard_error", pa.float64()),
            ("detection_delay_steps", pa.float64()),
            ("detection_delay_steps_standard_error", pa.float64()),
            ("median_delay_steps", pa.float64()),
            ("missed_share", pa.float64()),
            ("missed_share_standard_error", pa.float64()),
            ("false_switches", pa.float64()),
            ("false_switches_standard_error", pa.float64()),
        ]
    ),
    "delay_distribution": pa.schema(
        [
            ("case", pa.string()),
            ("estimator", pa.string()),
            ("switch", pa.int64()),
            ("from_mode", pa.string()),
            ("to_mode", pa.string()),
            ("delay_steps", pa.int64()),
            ("at_risk", pa.int64()),
            ("detected", pa.int64()),
            ("probability", pa.float64()),
            ("standard_error", pa.float64()),
        ]
    ),
    "published": pa.schema(
        [
            ("claim", pa.string()),
            ("estimator", pa.string()),
            ("metric", pa.string()),
            ("window", pa.string()),
            ("published", pa.float64()),
            ("tolerance", pa.float64()),
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


def table(name: str, columns: Mapping[str, Any]) -> pa.Table:
    """One of SCHEMAS from its columns: lists, NumPy's arrays or Arrow's."""
    return pa.table({field.name: _column(columns[field.name], field) for field in SCHEMAS[name]})


def _column(values: Any, field: pa.Field) -> pa.Array:
    if isinstance(values, pa.Array):
        return values
    if pa.types.is_string(field.type):
        return texts(values)
    return numbers(values, field.type)


def texts(values: Sequence[str | None], times: int | Sequence[int] = 1) -> pa.DictionaryArray:
    """Texts, each so many times; None is null. Each different one is held once."""
    different = [text for text in dict.fromkeys(values) if text is not None]
    place: dict[str | None, int] = {text: i for i, text in enumerate(different)}
    encoded = [text.encode() for text in different]
    ends = np.cumsum([0, *map(len, encoded)], dtype=np.int32)
    names = [None, pa.py_buffer(ends), pa.py_buffer(b"".join(encoded))]
    codes = np.repeat(np.array([place.get(text, -1) for text in values], dtype=np.int32), times)
    return pa.DictionaryArray.from_arrays(
        _with_nulls(codes, codes < 0, pa.int32()),
        pa.Array.from_buffers(pa.string(), len(encoded), names),
    )


def numbers(values: Any, kind: pa.DataType) -> pa.Array:
    """Numbers, or bools; None is null. Not copied where they are an array of this kind already."""
    missing = np.zeros(len(values), dtype=bool)
    if not isinstance(values, np.ndarray):
        missing = np.array([value is None for value in values], dtype=bool)
        values = [0 if value is None else value for value in values]
    return _with_nulls(np.ascontiguousarray(values, dtype=kind.to_pandas_dtype()), missing, kind)


def _with_nulls(values: Any, missing: Any, kind: pa.DataType) -> pa.Array:
    present = pa.py_buffer(np.packbits(~missing, bitorder="little")) if missing.any() else None
    stored = np.packbits(values, bitorder="little") if pa.types.is_boolean(kind) else values
    return pa.Array.from_buffers(kind, len(values), [present, pa.py_buffer(stored)])


def as_numpy(column: pa.ChunkedArray) -> Array:
    """A column of texts or numbers, without nulls; all rows of one text share it."""
    if pa.types.is_dictionary(column.type):
        parts = [_taken(chunk) for chunk in column.chunks] or [np.empty(0, dtype=object)]
    else:
        none = np.empty(0, dtype=column.type.to_pandas_dtype())
        parts = [np.from_dlpack(chunk) for chunk in column.chunks] or [none]
    return np.concatenate(parts) if len(parts) > 1 else parts[0]


def _taken(chunk: pa.DictionaryArray) -> Array:
    names: Array = np.array(chunk.dictionary.to_pylist(), dtype=object)
    taken: Array = names[np.from_dlpack(chunk.indices)]
    return taken


def names_in(column: pa.ChunkedArray) -> list[str]:
    """The texts of a column of one chunk, each once."""
    names: list[str] = column.chunk(0).dictionary.to_pylist()
    return names


def writer(path: Path, schema: pa.Schema) -> pq.ParquetWriter:
    """Of a table as we keep it. The Arrow schema is left out, so that a reader gets text as text.

    Hardly a float repeats: dictionaries of them would take time and room.
    """
    repeated = [field.name for field in schema if not pa.types.is_floating(field.type)]
    return pq.ParquetWriter(
        path, schema, compression="zstd", use_dictionary=repeated, store_schema=False
    )


def as_csv(table: pa.Table) -> str:
    """A table as CSV: NaN is empty, all other figures are exact."""
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(table.column_names)
    for row in table.to_pylist():
        lines.writerow(None if value != value else value for value in row.values())
    return text.getvalue()
