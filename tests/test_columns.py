"""Tables to and from Arrow as Arrow's own conversions have them, and without pandas."""

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest

from hybridtrack.columns import SCHEMAS, as_numpy, names_in, numbers, table, texts


@pytest.mark.parametrize(
    "values", [[], [""], ["a"], ["é", "", "a", "é"], [None], ["b", None, "a", "b", None]]
)
def test_texts_are_what_they_were(values):
    ours = texts(values)
    ours.validate(full=True)
    assert ours.to_pylist() == values
    assert ours.null_count == values.count(None)
    assert len(ours.dictionary) == len(set(values) - {None})


def test_texts_are_repeated():
    assert texts(["a", "b"], 2).to_pylist() == ["a", "a", "b", "b"]
    assert texts(["b", "a", "b"], [1, 0, 2]).to_pylist() == ["b", "b", "b"]


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        ([], pa.float64()),
        ([1.5, np.nan, np.inf], pa.float64()),
        ([1.5, None, -0.0], pa.float64()),
        ([None] * 9, pa.float64()),
        ([2**53 + 1, None], pa.int64()),
        ([1, -1], pa.int32()),
        ([True, False, None] * 5, pa.bool_()),
        (np.arange(9)[::2], pa.int64()),
        (np.arange(9.0), pa.float64()),
    ],
)
def test_numbers_are_what_they_were(values, kind):
    ours = numbers(values, kind)
    ours.validate(full=True)
    assert ours.type == kind
    assert str(ours) == str(pa.array(values, kind))  # NaN too


def test_numpy_gets_back_what_arrow_has():
    parts = [texts(["a", "b"], 2), texts(["b", "c"])]
    assert as_numpy(pa.chunked_array(parts)).tolist() == ["a", "a", "b", "b", "b", "c"]
    assert names_in(pa.chunked_array(parts[:1])) == ["a", "b"]
    values = np.array([0.1, np.nan, -0.0])
    chunks = pa.chunked_array([numbers(values, pa.float64())] * 2)
    assert as_numpy(chunks).tobytes() == np.tile(values, 2).tobytes()
    assert as_numpy(chunks.slice(1, 2)).tobytes() == values[1:].tobytes()
    assert as_numpy(pa.chunked_array([], pa.float64())).dtype == np.float64


def test_a_run_imports_no_pandas():
    """Neither does it import what Arrow brings for the purpose."""
    code = (
        "import sys; from hybridtrack import experiment, figures, tables;"
        "from hybridtrack.columns import SCHEMAS, table;"
        "table('published', {name: [] for name in SCHEMAS['published'].names});"
        "print({'pandas', 'pyarrow.compute', 'pyarrow.dataset'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_a_table_has_the_columns_of_its_schema():
    columns = {name: [] for name in reversed(SCHEMAS["published"].names)}
    assert table("published", columns).column_names == SCHEMAS["published"].names
    with pytest.raises(KeyError):
        table("published", {})
