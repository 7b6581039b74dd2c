"""The columns of the tables in a run folder."""

import pyarrow as pa

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
