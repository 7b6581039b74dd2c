"""What a finished run looks like on a screen: every digit, every letter, no markup."""

import io
import json
import math

import pytest
from rich.console import Console

from hybridtrack import results, tables, typesetting

LONG = "a_name_of_sixty_three_characters_" + "x" * 30


@pytest.fixture
def folder(tmp_path):
    """A run folder with one estimator of a long name and a title that looks like markup."""
    manifest = {
        "status": results.COMPLETE,
        "digest": "0123456789",
        "name": "brackets",
        "title": "Flight [a] of [/b] :smile:",
        "seed": 5,
        "runs": 1,
        "diverged": {},
        "cases": 1,
        "estimators": [LONG],
        "modes": ["CV"],
        "windows": ["all", "turn", "nowhere"],
        "compare_with": None,
        "error": "rmse",
        "states": {},
    }
    (tmp_path / results.MANIFEST).write_text(json.dumps(manifest))
    rows = [
        (LONG, metric, window, value, error, 1)
        for window in ("all", "turn")
        for metric, value, error in (
            ("position_rmse_m", 123456.789, 0.001),
            ("velocity_rmse_m_s", 1.5e-9, 2e-12),
            ("mode_accuracy", 0.5, math.inf),
            ("mode_brier", 3.14e30, 2e27),
        )
    ]
    published = [
        ("long " + "Y" * 90, LONG, "m", "all", 1.0, 0.5, None, 2.0, 0.1, "[x]", "x", False, "[/z]")
    ]
    for name, filled in (
        ("summary", rows),
        ("published", published),
        ("comparisons", []),
        ("reliability", []),
        ("sets", []),
        ("delays", []),
    ):
        columns = results.SCHEMAS[name].names
        table = results.pa.table(
            {column: [row[i] for row in filled] for i, column in enumerate(columns)},
            schema=results.SCHEMAS[name],
        )
        results.pq.write_table(table, tmp_path / f"{name}.parquet")
    return tmp_path


def shown(folder, width, terminal=False):
    out = io.StringIO()
    tables.show(folder, Console(file=out, width=width, force_terminal=terminal, no_color=True))
    return out.getvalue()


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (17.94, 0.04, "17.94±0.04"),
        (94.4184, 0.0031, "94.418±0.003"),
        (1234.5, 12.0, "1234±12"),
        (-0.101, 0.001, "-0.101±0.001"),
        (0.0, 0.0, "0±0"),
        (18.0, math.nan, "18"),
        (math.nan, math.nan, ""),
        (0.99993, 0.00003, "0.99993±0.00003"),
        (0.0002, 0.0004, "0.0002±0.0004"),
        (1.5e-9, 2e-12, "1.500e-09±2e-12"),
        (3.14159e15, 2e12, "3.142e+15±2e+12"),
        (5.0, 2e7, "5e+00±2e+07"),
        (0.0, 3e-8, "0e+00±3e-08"),
        (1.0, 1e-300, "1.000000e+00±1e-300"),
        (math.inf, math.inf, "inf"),
        (1.0, math.inf, "1±inf"),
        (-math.inf, 0.1, "-inf"),
    ],
)
def test_a_figure_to_the_first_digit_of_its_error(value, error, text):
    assert typesetting.figure(value, error) == text


def test_counts_agree_with_their_noun():
    assert typesetting.counted(1, "run") == "1 run"
    assert typesetting.counted(2000, "run") == "2,000 runs"
    assert typesetting.counted(0, "step") == "0 steps"


@pytest.mark.parametrize(
    ("value", "error", "told"),
    [
        (0.6894482687867965, 1.2e-18, "0.6894±0"),
        (-0.6894482687867965, 1.2e-18, "-0.6894±0"),
        (0.09, 2e-17, "0.09±0"),
        (0.5, 2e-12, "5.000000e-01±2e-12"),
        (0.0, 3e-8, "0e+00±3e-08"),
        (17.94, 0.04, "17.94±0.04"),
        (0.6, math.nan, "0.6"),
        (math.nan, math.nan, ""),
        (math.inf, 0.1, "inf"),
    ],
)
def test_an_error_of_rounding_is_none(value, error, told):
    assert typesetting.estimate(value, error) == told


FIGURES = ("123456.789±0.001", "1.500e-09±2e-12", "0.5±inf", "3.140e+30±2e+27")


@pytest.mark.parametrize("width", [80, 40])
def test_nothing_is_left_out_without_a_terminal(folder, width):
    text = shown(folder, width)
    row = next(line for line in text.splitlines() if line.startswith(LONG))
    assert all(figure in row for figure in FIGURES)
    assert "Flight [a] of [/b] :smile:" in " ".join(text.split())
    assert "[x]" in text
    assert "[/z]" in text
    assert text.count("Y") == 90
    assert "…" not in text


def test_a_terminal_folds_names_and_keeps_figures_whole(folder):
    for width in (110, 80, 40):
        text = shown(folder, width, terminal=True)
        rows = text.partition("─")[2].partition("windows")[0]
        assert all(figure in rows for figure in FIGURES)
        folded = "".join(line.split(" ")[0] for line in rows.splitlines()[1:])
        assert folded == LONG
        if width == 110:
            assert max(map(len, rows.splitlines())) <= width


def test_no_blank_ends_a_line(folder):
    assert not [line for line in shown(folder, 80).splitlines() if line != line.rstrip()]


def test_a_window_without_steps_is_told(folder):
    assert "windows turn: see summary.csv" in shown(folder, 80)
    assert tables.surprises(folder) == [
        "window 'nowhere' holds no measured step, so it has no figures"
    ]


def test_json_has_neither_nan_nor_infinity(folder):
    data = tables.as_json(folder)
    text = json.dumps(data, allow_nan=False)  # raises where there is one
    assert json.loads(text) == data
    assert {row["standard_error"] for row in data["summary"]} >= {None}


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ({"published": 18.0, "sign": None, "estimator": "IMM"}, "18"),
        ({"published": 18.0, "sign": "less", "estimator": "IMM"}, "< 18"),
        ({"published": 18.0, "sign": "greater", "estimator": "IMM"}, "> 18"),
        ({"published": 0.8, "sign": "less", "estimator": "A / B"}, "0.8"),
        ({"published": None, "sign": "less", "estimator": "A / B"}, "Δ < 0"),
        ({"published": None, "sign": "greater", "estimator": "A / B"}, "Δ > 0"),
        ({"published": 1.0, "sign": "equal", "estimator": "A / B"}, "ratio 1±0.05"),
        ({"published": 50.0, "sign": None, "estimator": None}, "50"),
    ],
)
def test_what_was_claimed_in_few_words(row, said):
    assert tables.claimed({"tolerance": 0.05, **row}) == said


def test_squared_errors_are_shown_where_the_scenario_asks(folder):
    manifest = json.loads((folder / results.MANIFEST).read_text())
    (folder / results.MANIFEST).write_text(json.dumps(manifest | {"error": "mse"}))
    rows = results.read_rows(folder, "summary")
    names = {"position_rmse_m": "position_mse_m2", "velocity_rmse_m_s": "velocity_mse_m2_s2"}
    for row in rows:
        row["metric"] = names.get(row["metric"], row["metric"])
    squared = results.pa.Table.from_pylist(rows, schema=results.SCHEMAS["summary"])
    results.pq.write_table(squared, folder / "summary.parquet")
    text = shown(folder, 200)
    assert "MSE, m²/s²" in text
    assert "RMS" not in text
    assert "123456.789±0.001" in text


def test_the_scores_of_the_last_mode_have_a_table_of_their_own(folder):
    assert "mode is the last" not in shown(folder, 80)
    told = [
        (LONG, "final_mode_brier", "all", 0.0833, 0.0004, 100),
        (LONG, "final_mode_prior_brier", "all", 0.1162, 0.0009, 100),
        (LONG, "final_mode_calibration_error", "all", 0.0103, 0.0007, 100),
    ]
    rows = results.read_rows(folder, "summary")
    names = results.SCHEMAS["summary"].names
    rows += [dict(zip(names, row, strict=True)) for row in told]
    table = results.pa.Table.from_pylist(rows, schema=results.SCHEMAS["summary"])
    results.pq.write_table(table, folder / "summary.parquet")
    text = shown(folder, 200)
    assert "mode is the last" in text
    line = next(line for line in text.splitlines() if "0.0833" in line)
    assert line.split()[1:] == ["0.0833±0.0004", "0.1162±0.0009", "0.0103±0.0007"]
