"""Figures from made tables: a seven-leg flight like the paper's, and an uneven recorded track."""

import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import StepPatch
from PIL import Image

from hybridtrack.errors import UserError
from hybridtrack.figures import RunInformation, draw, save

ESTIMATORS = ("KF_CV", "KF_CA", "MMAE", "IMM", "RMIMM", "RMIMM_zero")
LEGS = ((30, 0.0), (50, -3.0), (70, 0.0), (90, 1.5), (110, 0.0), (130, -4.5), (150, 0.0))
SWITCHES_S = [30.0, 50.0, 70.0, 90.0, 110.0, 130.0]
SPEED_M_S = 246.9  # 480 knots

Tables = tuple[pd.DataFrame, pd.DataFrame, RunInformation]


def rows(time_s: np.ndarray, name: str, value: np.ndarray | float, **columns: object):
    """A few rows of a long table; `name` is 'ESTIMATOR METRIC'."""
    estimator, metric = name.split()
    step = np.arange(1, len(time_s) + 1)
    table = {"case": "flight", "estimator": estimator, "step": step, "time_s": time_s}
    return pd.DataFrame(table | {"metric": metric, "value": value} | columns)


def track_rows(time_s: np.ndarray, name: str, value: np.ndarray) -> pd.DataFrame:
    return rows(time_s, name, value, run=0).rename(columns={"metric": "quantity"})


def turn_rate(time_s: np.ndarray) -> np.ndarray:
    ends, rates = np.array(LEGS).T
    return np.deg2rad(rates[np.searchsorted(ends, time_s)])


def lagged(target: np.ndarray, memory: float) -> np.ndarray:
    weights = memory ** np.arange(60.0)
    return np.convolve(target, weights / weights.sum())[: len(target)]


def seven_legs(estimators: tuple[str, ...] = ESTIMATORS, modes=("CV", "CT")) -> Tables:
    """150 steps of 1 s; KF_CV is 900 m off in turns; the truth is in modes[0] or modes[1]."""
    rng = np.random.default_rng(5)
    t = np.arange(1.0, 151.0)
    turning = (turn_rate(t) != 0).astype(float)
    heading = np.cumsum(turn_rate(t))
    flown = {"x": SPEED_M_S * np.cumsum(np.cos(heading)), "y": np.cumsum(-np.sin(heading) * 246.9)}
    steps = [rows(t, "raw position_rmse_m", 25.0, standard_error=0.4)]
    for mode, share in zip(modes, (1 - turning, turning), strict=False):
        steps.append(rows(t, f"truth mode_probability:{mode}", share, standard_error=np.nan))
    tracks = []
    for quantity, path in flown.items():
        tracks.append(track_rows(t, f"truth {quantity}", path))
        noisy = path + rng.normal(0, 17.7, 150)
        tracks.append(track_rows(t, f"measurement {quantity}", noisy))
    for i, name in enumerate(estimators):
        late = lagged(turning, 0.5 + 0.05 * i)
        error = 14 + (900 if name == "KF_CV" else 12 - i) * late
        steps.append(rows(t, f"{name} position_rmse_m", error, standard_error=error / 50))
        steps.append(rows(t, f"{name} velocity_rmse_m_s", error / 3, standard_error=error / 90))
        for quantity, path in flown.items():
            tracks.append(track_rows(t, f"{name} {quantity}", path + error * rng.normal(size=150)))
        if name.startswith("KF"):
            continue
        for j, mode in enumerate(modes):
            share = np.abs(1 - j % 2 - late) / ((len(modes) + 1) // 2)
            steps.append(rows(t, f"{name} mode_probability:{mode}", share, standard_error=0.01))
            steps.append(rows(t, f"{name} mode_likelihood:{mode}", share, standard_error=0.01))
    information = RunInformation("IMM and RMIMM on seven legs", 1000, estimators, modes)
    return pd.concat(steps), pd.concat(tracks), information


def recorded() -> Tables:
    """3,000 uneven steps with a gap of 400 s after step 1200, no truth, no velocity, NaN."""
    rng = np.random.default_rng(7)
    jumps = rng.uniform(3.5, 5.5, 3000)
    jumps[1200] = 400.0
    t = np.cumsum(jumps)
    steps, tracks = [], []
    for name in ("KF", "IMM"):
        error = 60 + lagged(rng.normal(0, 9, 3000), 0.9)
        error[700:760] = np.nan
        steps.append(rows(t, f"{name} position_rmse_m", error, standard_error=error / 20))
        tracks += [track_rows(t, f"{name} {q}", 200 * t + rng.normal(0, 20, 3000)) for q in "xy"]
    share = 0.5 + lagged(rng.normal(0, 0.2, 3000), 0.9)
    steps.append(rows(t, "IMM mode_probability:CV", share, standard_error=np.nan))
    steps.append(rows(t, "IMM mode_probability:CT", 1 - share, standard_error=np.nan))
    tracks += [track_rows(t, f"measurement {q}", 200 * t) for q in "xy"]
    return pd.concat(steps), pd.concat(tracks), RunInformation("A", 20, ("KF", "IMM"), ())


@pytest.fixture(scope="module")
def flight() -> dict[str, Figure]:
    return draw(*seven_legs())


def line(ax: Axes, label: str) -> Line2D:
    (found,) = [one for one in ax.lines if one.get_label() == label]
    return found


def switch_times(figure: Figure) -> list[float]:
    marks = [c for c in figure.axes[0].collections if c.get_gid() == "mode switch"]
    assert all(isinstance(mark, LineCollection) for mark in marks)
    return [float(segment[0, 0]) for mark in marks for segment in mark.get_segments()]


def shades(ax: Axes) -> list[StepPatch]:
    return [p for p in ax.patches if isinstance(p, StepPatch) and p.get_gid() == "true mode"]


def assert_nothing_hidden(figure: Figure) -> None:
    figure.canvas.draw()
    (legend,) = figure.legends
    box = legend.get_window_extent()
    for ax in figure.axes:
        assert not box.overlaps(ax.get_tightbbox())  # with its labels, not only its box
    drawn = figure.get_tightbbox(figure.canvas.get_renderer())  # type: ignore[attr-defined]
    width, height = figure.get_size_inches()
    edge = 1e-3  # inches: a fifth of a pixel at 200 dpi
    assert min(drawn.x0, drawn.y0, width - drawn.x1, height - drawn.y1) > -edge


def test_all_five_figures(flight):
    assert list(flight) == [
        "trajectory",
        "position_error",
        "velocity_error",
        "mode_probability",
        "mode_likelihood",
    ]
    assert flight["position_error"].axes[0].get_ylabel() == "position RMS error (m)"
    assert flight["velocity_error"].axes[0].get_ylabel() == "velocity RMS error (m/s)"
    assert flight["position_error"].axes[0].get_xlabel() == "time (s)"
    assert "1,000 runs; bands: ±2 standard errors" in flight["position_error"].get_suptitle()


def test_curves_and_bands_are_the_tables():
    steps, tracks, information = seven_legs()
    figure = draw(steps.sample(frac=1, random_state=1), tracks, information)["position_error"]
    curve = line(figure.axes[0], "IMM").get_xydata()
    chosen = steps[(steps["estimator"] == "IMM") & (steps["metric"] == "position_rmse_m")]
    np.testing.assert_array_equal(curve, chosen[["time_s", "value"]])
    bands = [c.get_paths()[0].get_extents() for c in figure.axes[0].collections[:-1]]
    # raw comes first: 25 ± 2 * 0.4, up to rounding
    np.testing.assert_allclose([bands[0].y0, bands[0].y1], [24.2, 25.8], rtol=1e-12)


def test_switches_are_marked_where_the_legs_end(flight):
    assert switch_times(flight["position_error"]) == SWITCHES_S
    assert switch_times(flight["velocity_error"]) == SWITCHES_S


def test_the_true_mode_is_shaded(flight):
    for name in ("mode_probability", "mode_likelihood"):
        straight, turn = flight[name].axes
        assert straight.get_title(loc="left") == "CV"
        (shade,) = shades(turn)
        values, edges, _ = shade.get_data()
        assert edges[0] == 0.0  # step 1 lasts from 0 to 1 s
        np.testing.assert_array_equal(edges[1:][values == 1], np.r_[31:51, 71:91, 111:131])
        np.testing.assert_array_equal(shades(straight)[0].get_data().values, 1 - values)


def test_random_truth_is_a_dashed_share_without_switches():
    steps, tracks, information = seven_legs()
    is_truth = steps["estimator"] == "truth"
    steps.loc[is_truth, "value"] = 0.25 + 0.5 * steps.loc[is_truth, "value"]
    figures = draw(steps, tracks, information)
    assert switch_times(figures["position_error"]) == []
    for ax in figures["mode_probability"].axes:
        assert shades(ax) == []
        share = line(ax, "truth: share of runs")
        assert set(share.get_ydata()) == {0.25, 0.75}
        assert share.is_dashed()


def test_no_truth_no_shading():
    steps, tracks, information = seven_legs()
    figures = draw(steps[steps["estimator"] != "truth"], tracks, information)
    assert switch_times(figures["position_error"]) == []
    assert all(not ax.patches for ax in figures["mode_probability"].axes)


def test_unknown_true_modes_are_neither_switch_nor_shade():
    steps, tracks, information = seven_legs()
    steps.loc[(steps["estimator"] == "truth") & steps["time_s"].between(28, 35), "value"] = np.nan
    figures = draw(steps, tracks, information)
    assert switch_times(figures["position_error"]) == SWITCHES_S[1:]
    values, edges, _ = shades(figures["mode_probability"].axes[1])[0].get_data()
    assert edges[1:][values == 1][0] == 36


def test_an_estimator_looks_the_same_in_all_figures(flight):
    looks = {name: set() for name in ESTIMATORS}
    for figure in flight.values():
        for ax in figure.axes:
            for one in ax.lines:
                if one.get_label() in looks:
                    looks[one.get_label()].add((one.get_color(), str(one._dash_pattern)))
    assert all(len(look) == 1 for look in looks.values())
    assert len(set.union(*looks.values())) == len(ESTIMATORS)


def test_a_look_depends_on_the_scenarios_order_only():
    steps, tracks, information = seven_legs()
    full = draw(steps, tracks, information)["position_error"].axes[0]
    absent = draw(steps[steps["estimator"] != "KF_CV"], tracks, information)["position_error"]
    for name in ESTIMATORS[1:]:
        assert line(absent.axes[0], name).get_color() == line(full, name).get_color()


def test_log_scale_only_when_one_curve_would_squash_the_others():
    steps, tracks, information = seven_legs()
    assert draw(steps, tracks, information)["position_error"].axes[0].get_yscale() == "log"
    calm = steps[steps["estimator"] != "KF_CV"]
    ax = draw(calm, tracks, information)["position_error"].axes[0]
    assert ax.get_yscale() == "linear"
    assert ax.get_ylim()[0] == 0.0


def test_a_filter_that_explodes_leaves_the_frame_and_is_named(tmp_path):
    steps, tracks, information = seven_legs()
    steps.loc[(steps["estimator"] == "KF_CV") & (steps["time_s"] > 100), "value"] = 1e300
    steps.loc[(steps["estimator"] == "KF_CV") & (steps["time_s"] > 120), "value"] = np.inf
    tracks.loc[(tracks["estimator"] == "KF_CV") & (tracks["time_s"] > 100), "value"] = 1e300
    steps = steps[steps["metric"] == "position_rmse_m"]
    figures = draw(steps, tracks, information)
    save(figures, tmp_path)
    for name in ("position_error", "trajectory"):
        assert "leaves the frame: KF_CV" in figures[name].get_suptitle()
        assert figures[name].axes[0].get_ylim()[1] < 1e8
    t, error = line(figures["position_error"].axes[0], "KF_CV").get_data()
    np.testing.assert_array_equal(np.isnan(error), t > 120)
    assert "leaves" not in draw(*seven_legs())["trajectory"].get_suptitle()


def test_trajectory_is_true_to_shape_in_km(flight):
    ax = flight["trajectory"].axes[0]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x, east (km)", "y, north (km)")
    flight["trajectory"].canvas.draw()
    (x0, y0), (x1, y1) = ax.transData.transform([(0, 0), (1000, 1000)])
    assert x1 - x0 == pytest.approx(y1 - y0, rel=1e-9)  # rounding
    assert ax.xaxis.get_major_formatter()(15_000) == "15"
    dots, truth = line(ax, "measurements"), line(ax, "truth")
    assert dots.get_linestyle() == "None"
    assert dots.get_markersize() > truth.get_linewidth()
    assert all(dots.zorder > one.zorder for one in ax.lines if one.get_linestyle() != "None")


def test_the_first_scan_is_not_called_the_start(flight):
    ax = flight["trajectory"].axes[0]  # the start, k = 0, isn't in the tables
    (x,), (y,) = line(ax, "first scan").get_data()
    truth = line(ax, "truth")
    assert (x, y) == (truth.get_xdata()[0], truth.get_ydata()[0])
    assert "start" not in [one.get_label() for one in ax.lines]


def test_a_target_at_rest_frames_its_estimates():
    steps, tracks, information = seven_legs(("IMM",))
    rest = tracks[tracks["estimator"] == "truth"].assign(value=0.0)
    figure = draw(steps, pd.concat([rest, tracks[tracks["estimator"] == "IMM"]]), information)
    assert "leaves" not in figure["trajectory"].get_suptitle()


def test_one_dimension_is_position_over_time():
    steps, tracks, information = seven_legs()
    tracks = tracks[tracks["quantity"] == "x"]
    ax, below = draw(steps, tracks, information)["trajectory"].axes
    assert (below.get_xlabel(), ax.get_ylabel()) == ("time (s)", "position x (km)")
    np.testing.assert_array_equal(line(ax, "truth").get_xdata(), np.arange(1, 151))


def test_in_one_dimension_errors_are_drawn_below():
    steps, tracks, information = seven_legs()
    tracks = tracks[tracks["quantity"] == "x"]
    figure = draw(steps, tracks, information)["trajectory"]
    below = figure.axes[1]
    assert (below.get_xlabel(), below.get_ylabel()) == ("time (s)", "position error (m)")
    value = {name: rows["value"].to_numpy() for name, rows in tracks.groupby("estimator")}
    drawn = line(below, "IMM").get_ydata()
    np.testing.assert_allclose(drawn, value["IMM"] - value["truth"], atol=1e-9)  # of km
    # The frame is for what is as good as the measurements: KF_CV is 900 m off in turns.
    assert "leaves the frame: KF_CV" in figure.get_suptitle()
    assert max(below.get_ylim()) < 200
    assert_nothing_hidden(figure)


def with_ratios(estimators=("SBF", "IMM", "FAR", "KF")):
    """Mean square errors and their ratios to a genie's; FAR is worse, KF is hopeless."""
    t = np.arange(1.0, 101.0)
    steps = [rows(t, "genie position_mse_m2", 100.0, standard_error=1.0)]
    for name, factor in zip(estimators, (1.02, 1.07, 2.5, 5000.0), strict=True):
        start = 1 + (factor - 1) * (1 + 4 * (t < 3))
        for kind, unit in (("position", "m2"), ("velocity", "m2_s2")):
            steps.append(rows(t, f"{name} {kind}_mse_{unit}", 100 * start, standard_error=1.0))
            steps.append(rows(t, f"{name} {kind}_mse_ratio", start, standard_error=0.003))
    _, tracks, _ = seven_legs()
    names = ("genie", *estimators)
    information = RunInformation("Ratios", 20_000, names, (), error="mse", compare_with="genie")
    return pd.concat(steps), tracks, information


def test_squared_errors_are_drawn_where_the_scenario_asks_and_a_hopeless_filter_is_named():
    figure = draw(*with_ratios())["position_error"]
    (ax,) = figure.axes
    assert ax.get_ylabel() == "position mean square error (m²)"
    assert "leaves the frame: KF" in figure.get_suptitle()
    assert "KF" not in [one.get_label() for one in ax.lines]
    assert (ax.get_yscale(), max(ax.get_ylim()) < 1500) == ("linear", True)


def test_ratios_to_one_estimator_make_small_differences_visible():
    figure = draw(*with_ratios())["error_ratio"]
    assert "genie's, over the same 20,000 runs" in figure.get_suptitle()
    assert "leaves the frame: KF, FAR" in figure.get_suptitle().replace("\n", " ")
    for ax, kind in zip(figure.axes, ("position", "velocity"), strict=True):
        assert ax.get_ylabel() == f"{kind} error ratio"
        low, high = ax.get_ylim()
        assert low < 1.0 < 1.07 < high < 1.4
        np.testing.assert_allclose(line(ax, "SBF").get_ydata()[5:], 1.02)
        assert not {"KF", "FAR"} & {one.get_label() for one in ax.lines}
    assert_nothing_hidden(figure)


def test_ratios_over_several_powers_of_ten_are_logarithmic():
    steps, tracks, information = with_ratios()
    late = (steps["metric"] == "velocity_mse_ratio") & (steps["step"] > 90)
    steps.loc[late, "value"] = 300.0
    position, velocity = draw(steps, tracks, information)["error_ratio"].axes
    assert (position.get_yscale(), velocity.get_yscale()) == ("linear", "log")
    assert velocity.get_ylim()[0] < 1.0 < 300.0 < velocity.get_ylim()[1]


def test_without_a_reference_there_are_no_ratios():
    steps, tracks, information = with_ratios()
    assert "error_ratio" not in draw(steps, tracks, information._replace(compare_with=None))


RELIABILITY = pd.DataFrame(
    {
        "estimator": ["SBF"] * 4,
        "from_probability": [0.0, 0.25, 0.5, 0.75],
        "to_probability": [0.25, 0.5, 0.75, 1.0],
        "share_of_steps": [0.1, 0.0, 0.3, 0.6],
        "mean_probability": [0.2, np.nan, 0.6, 0.9],
        "frequency": [0.15, np.nan, 0.62, 0.95],
        "standard_error": [0.01, np.nan, 0.02, 0.01],
    }
)


def test_reliability_and_the_probability_of_a_last_mode():
    steps, tracks, information = with_ratios()
    t = np.arange(1.0, 101.0)
    name = "final_mode_probability"
    steps = pd.concat(
        [
            steps,
            rows(t, f"SBF {name}", t / 100, standard_error=0.01),
            rows(t, "SBF final_mode_prior", t / 200, standard_error=0.0),
            rows(t, f"truth {name}", t / 150, standard_error=0.01),
        ]
    )
    figures = draw(steps, tracks, information, RELIABILITY)
    (ax,) = figures[name].axes
    for label, values in (
        ("SBF", t / 100),
        ("SBF, before any scan", t / 200),
        ("truth: share of runs", t / 150),
    ):
        np.testing.assert_array_equal(line(ax, label).get_ydata(), values)
    above, below = figures["reliability"].axes
    (drawn,) = above.containers
    x, y = drawn.lines[0].get_data()
    np.testing.assert_array_equal(x, RELIABILITY["mean_probability"])
    np.testing.assert_array_equal(y, RELIABILITY["frequency"])
    assert [bar.get_height() for bar in below.patches] == RELIABILITY["share_of_steps"].tolist()
    for drawn in (figures[name], figures["reliability"]):
        assert_nothing_hidden(drawn)


def test_the_first_run_of_the_first_case_is_drawn():
    steps, tracks, information = seven_legs()
    later = [tracks.assign(run=1, value=0.0), tracks.assign(case="second", value=0.0)]
    figure = draw(steps, pd.concat([tracks, *later]), information)["trajectory"]
    truth = tracks[(tracks["estimator"] == "truth") & (tracks["quantity"] == "y")]
    np.testing.assert_array_equal(line(figure.axes[0], "truth").get_ydata(), truth["value"])
    assert "case flight, run 0" in figure.get_suptitle()


def test_a_recorded_track_is_broken_at_gaps_and_nan(tmp_path):
    steps, tracks, information = recorded()
    figures = draw(steps, tracks, information)
    assert list(figures) == ["trajectory", "position_error", "mode_probability"]
    assert "bands" not in figures["mode_probability"].get_suptitle()
    x, y = line(figures["position_error"].axes[0], "IMM").get_data()
    rows = steps[(steps["metric"] == "position_rmse_m") & (steps["estimator"] == "IMM")]
    time = rows["time_s"].to_numpy()
    (gap,) = np.flatnonzero(np.isnan(x))  # 3,000 steps are pooled, but not across the gap
    assert time[1199 - 6] < x[gap - 1] < time[1200] < x[gap + 1] < time[1200 + 6]
    unknown = np.isnan(y)
    unknown[gap] = False
    assert unknown.sum() == 9  # points whose six steps are all among the sixty unknown ones
    assert ((x[unknown] >= time[700]) & (x[unknown] < time[760])).all()
    assert "6 steps a point" in figures["position_error"].get_suptitle()
    estimate = line(figures["trajectory"].axes[0], "IMM")
    assert np.isnan(estimate.get_xdata()[1200])
    # 3,000 measurements in a row would hide it
    assert line(figures["trajectory"].axes[0], "measurements").zorder < estimate.zorder
    save(figures, tmp_path)  # a warning of matplotlib's on NaN would be an error here
    for figure in figures.values():
        assert_nothing_hidden(figure)


def test_a_point_between_gaps_is_a_dot():
    steps, tracks, information = seven_legs(("IMM",))
    mine = (steps["metric"] == "position_rmse_m") & (steps["estimator"] == "IMM")
    steps.loc[mine & steps["step"].isin([9, 11]), "value"] = np.nan
    ax = draw(steps, tracks, information)["position_error"].axes[0]
    dots = [one for one in ax.lines if one.get_marker() == "."]
    assert [one.get_xdata().tolist() for one in dots] == [[10.0]]
    (bars,) = [c for c in ax.collections if isinstance(c, LineCollection) and not c.get_gid()]
    (row,) = steps[mine & (steps["step"] == 10)].itertuples()
    two_errors = 2 * row.standard_error
    expected = [[10.0, row.value - two_errors], [10.0, row.value + two_errors]]
    np.testing.assert_array_equal(bars.get_segments(), [expected])  # a band would be invisible


def test_one_step_and_one_run(tmp_path):
    steps, tracks, information = seven_legs(("IMM",))
    first, start = steps[steps["step"] == 1], tracks[tracks["step"] == 1]
    figures = draw(first.assign(standard_error=np.nan), start, information._replace(runs=1))
    save(figures, tmp_path)
    assert figures["position_error"].get_suptitle().endswith("RMS over 1 run")


def test_absent_data_leave_figures_out():
    steps, tracks, information = seven_legs()
    assert draw(steps.iloc[:0], tracks.iloc[:0], information) == {}
    unknown = steps["metric"] == "velocity_rmse_m_s"
    figures = draw(steps.assign(value=steps["value"].mask(unknown)), tracks.iloc[:0], information)
    assert list(figures) == ["position_error", "mode_probability", "mode_likelihood"]


def test_cases_have_figures_of_their_own_up_to_six():
    steps, tracks, information = seven_legs(("IMM",))
    steps = steps[steps["metric"] == "position_rmse_m"]
    cases = ["a/b", "a b", "c", "d", "e-1", "f", "g"]
    many = pd.concat([steps.assign(case=case) for case in cases])
    figures = draw(many, tracks.iloc[:0], information)
    suffixes = ["a_b", "a_b-2", "c", "d", "e-1", "f"]
    assert list(figures) == [f"position_error-{suffix}" for suffix in suffixes]
    assert "case a b (2 of 7)" in figures["position_error-a_b-2"].get_suptitle()


def test_legend_hides_nothing_and_nothing_is_clipped(flight):
    for figure in flight.values():
        assert_nothing_hidden(figure)


def test_the_largest_bank_with_long_names_still_fits():
    estimators = tuple(f"estimator_with_a_long_name_{i}" for i in range(8))
    modes = ("CV", "CT_left", "CT_right", "CA", "climb")
    steps, tracks, information = seven_legs(estimators, modes)
    title = "A title that costs $5 to $6 and goes on" + ", and on" * 12
    figures = draw(steps, tracks, information._replace(title=title))
    for figure in figures.values():
        assert r"\$5 to \$6" in figure.get_suptitle()  # else a formula in italics
        assert_nothing_hidden(figure)
        inch = figure.dpi
        assert all(ax.get_window_extent().height > 1.0 * inch for ax in figure.axes)
    panels = figures["mode_probability"].axes
    assert len(panels) == len(modes)
    assert [ax.get_xlabel() for ax in panels] == ["", "", "", "time (s)", "time (s)"]


def test_same_tables_same_bytes_whatever_the_users_settings(tmp_path):
    steps, tracks, information = seven_legs(("IMM",))
    steps = steps[steps["metric"] != "velocity_rmse_m_s"]  # drawn like the position's
    before = save(draw(steps, tracks, information), tmp_path / "first")
    with matplotlib.rc_context({"font.size": 20, "axes.grid": True, "lines.linewidth": 5}):
        after = save(draw(steps, tracks, information), tmp_path / "second")
        assert matplotlib.rcParams["font.size"] == 20
    assert [path.name for path in before] == [path.name for path in after]
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(before, after, strict=True))


def test_png_has_200_dpi_and_no_text_chunks(tmp_path, flight):
    (path,) = save({"trajectory": flight["trajectory"]}, tmp_path)
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert int.from_bytes(data[16:20]) == 1400  # 7 inches
    assert not any(chunk in data for chunk in (b"tEXt", b"iTXt", b"tIME", b"Software"))


def test_a_figure_that_fails_leaves_the_old_file_and_no_partial_one(tmp_path, monkeypatch):
    figure = Figure()
    FigureCanvasAgg(figure)
    old = tmp_path / "trajectory.png"
    old.write_bytes(b"old")

    def fail(image: Image.Image, partial: Path, **settings: object) -> None:
        partial.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(UserError, match=r"cannot be written here \(disk full\)"):
        save({"trajectory": figure}, tmp_path)
    assert list(tmp_path.iterdir()) == [old]
    assert old.read_bytes() == b"old"


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path, flight):
    (tmp_path / "figures").write_text("a file in the way")
    with pytest.raises(UserError, match="figures: figures cannot be written here") as caught:
        save({"trajectory": flight["trajectory"]}, tmp_path / "figures")
    assert "\n" not in str(caught.value)


def test_pyplot_is_never_imported():
    code = (
        "import sys, pandas as pd; from hybridtrack.figures import *;"
        "s = pd.DataFrame([['c', 'IMM', k, k, 'position_rmse_m', 9.0, 1.0] for k in (1, 2)],"
        "columns='case estimator step time_s metric value standard_error'.split());"
        "t = s.assign(run=0, quantity='x');"
        "from io import BytesIO;"
        "[f.savefig(BytesIO()) for f in draw(s, t, RunInformation('', 1, ('IMM',), ())).values()];"
        "print('matplotlib.figure' in sys.modules, 'matplotlib.pyplot' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False"]
