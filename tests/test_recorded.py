"""Cases from recorded measurements: what the reference says at the scans' times, in their plane."""

import numpy as np
import pandas as pd
import pytest

from hybridtrack.errors import UserError
from models import scenario
from test_recordings import east_north

SCANS_S = np.arange(100.0, 160.0, 4.0)
REFERENCE_S = np.arange(80.0, 200.0)  # begins 20 s before the scans and outlasts them
NORTH_SEA, ALPS = (54.0, 3.0), (47.0, 10.0)  # 900 km apart: one plane for both would show
BIAS = 1e-3  # of every scan, in the unit of its first coordinate
TEXT = """
name: recorded
truth:
  recording: {file: scans.csv, as: measurements, reference: {file: reference.csv}}
sensor: {position_std_m: 30}
modes: {steady: {motion: constant_velocity, acceleration_psd_m2_s3: 1}}
initial: {from_measurements: two_point}
estimators: {KF: {type: kalman, mode: steady}}
monte_carlo: {runs: 1}
"""
DRAWN = "initial: {mean: drawn_about_truth, position_std_m: 30, velocity_std_m_s: 10}"
ABOUT_TRUTH = TEXT.replace("initial: {from_measurements: two_point}", DRAWN)
ALONE = TEXT.replace(", reference: {file: reference.csv}", "")


def metres(t, track, bias=0.0):
    """Position at a time: a quadratic, which a local cubic returns exactly."""
    sign = {"a": 1.0, "b": -1.0}[track]
    return bias + sign * (200.0 * t - 0.5 * t**2), 3000.0 + 120.0 * t + 0.3 * t**2


def degrees(t, track, bias=0.0):
    """Latitude and longitude at a time, about 200 m/s."""
    latitude, longitude = {"a": NORTH_SEA, "b": ALPS}[track]
    return bias + latitude + 1e-3 * t + 1e-6 * t**2, longitude - 2e-3 * t


def plane(t, track, bias=0.0):
    """The same in metres, in the plane that touches at the track's first scan."""
    return east_north(*degrees(t, track, bias), degrees(SCANS_S[0], track, BIAS))


def rows(track, times_s, where, dates, bias=0.0):
    first, second = where(times_s, track, bias)
    time = times_s
    if dates:
        zero = pd.Timestamp("2020-02-29T23:58:00Z")
        time = [(zero + pd.Timedelta(seconds=t)).isoformat() for t in times_s]
    names = ("x", "y") if where is metres else ("lat", "lon")
    columns = dict(zip(names, (first, second), strict=True))
    return pd.DataFrame({"flight_id": track, "time": time} | columns)


def save(folder, name, *tables):
    pd.concat(tables).to_csv(folder / name, index=False)


@pytest.mark.parametrize("dates", [False, True], ids=["plain seconds", "dates"])
@pytest.mark.parametrize("where", [metres, degrees], ids=["metres", "degrees"])
def test_a_reference_is_the_truth_at_the_scans_times_in_their_plane(tmp_path, where, dates):
    save(tmp_path, "scans.csv", *(rows(t, SCANS_S, where, dates, bias=BIAS) for t in "ab"))
    save(tmp_path, "reference.csv", *(rows(t, REFERENCE_S, where, dates) for t in "ba"))
    experiment = scenario(tmp_path, TEXT)
    position = metres if where is metres else plane
    assert [case.name for case in experiment.cases] == ["a", "b"]
    for case in experiment.cases:
        np.testing.assert_array_equal(case.times_s, SCANS_S - 100.0)
        at = np.array([position(t, case.name) for t in SCANS_S])
        step = 0.5  # s; central differences of a (nearly) quadratic path
        ahead = np.array([position(t + step, case.name) for t in SCANS_S])
        behind = np.array([position(t - step, case.name) for t in SCANS_S])
        velocity = (ahead - behind) / (2 * step)
        # A local cubic misses the plane's terms of fourth order, 1e-8 m; the rest is rounding of
        # the files' decimals. One second too early or late is 100 m or more.
        np.testing.assert_allclose(case.truth.state[:, [0, 2]], at, rtol=0, atol=1e-5)
        np.testing.assert_allclose(case.truth.state[:, [1, 3]], velocity, rtol=0, atol=1e-5)
        scans = np.array([position(t, case.name, BIAS) for t in SCANS_S])
        np.testing.assert_allclose(case.recorded, scans, rtol=0, atol=1e-6)  # the same rounding


def test_files_of_one_track_each_need_no_common_name(tmp_path):
    save(tmp_path, "scans.csv", rows("a", SCANS_S, metres, False))
    save(tmp_path, "reference.csv", rows("a", REFERENCE_S, metres, False).assign(flight_id="z"))
    (case,) = scenario(tmp_path, TEXT).cases
    np.testing.assert_allclose(case.truth.state[:, [0, 2]], case.recorded, atol=1e-6)  # rounding


def test_a_track_without_a_namesake_has_no_truth(tmp_path):
    save(tmp_path, "scans.csv", *(rows(t, SCANS_S, metres, False) for t in "ab"))
    save(tmp_path, "reference.csv", rows("b", REFERENCE_S, metres, False))
    unknown, known = scenario(tmp_path, TEXT).cases
    assert np.isnan(unknown.truth.state).all()
    assert np.isfinite(known.truth.state).all()


@pytest.mark.parametrize(
    ("reference", "says"),
    [
        (rows("a", REFERENCE_S, metres, True), "'a' and 'a' one has dates and the other plain"),
        (
            rows("a", REFERENCE_S, degrees, False),
            "'a' and 'a' one has latitude and longitude and the other x and y: give both the same",
        ),
        (
            rows("a", REFERENCE_S + 500.0, metres, False),
            "of track 'a' tells nothing at its times: on the track's own clock it lasts from 480 "
            "to 599 s; mend the times of one",
        ),
        (
            pd.concat([rows(t, REFERENCE_S, metres, False).assign(flight_id=t * 2) for t in "ab"]),
            "the reference has the track 'aa' and the recording 'a', none of one name",
        ),
    ],
    ids=["dates", "degrees", "late", "names"],
)
def test_a_reference_that_does_not_fit_is_refused(tmp_path, reference, says):
    save(tmp_path, "scans.csv", rows("a", SCANS_S, metres, False))
    save(tmp_path, "reference.csv", reference)
    with pytest.raises(UserError) as caught:
        scenario(tmp_path, TEXT)
    assert says in str(caught.value)
    assert str(caught.value).startswith(f"{tmp_path / 'scenario.yaml'}:4:")
    assert "\n" not in str(caught.value)


def test_recorded_measurements_are_run_once(tmp_path):
    save(tmp_path, "scans.csv", rows("a", SCANS_S, metres, False))
    says = r":9:15: recorded measurements are the same in every run; set 'runs' to 1$"
    with pytest.raises(UserError, match=says):
        scenario(tmp_path, ALONE.replace("runs: 1", "runs: 2"))
    assert scenario(tmp_path, ALONE).runs == 1
    noisy = ALONE.replace("as: measurements", "as: truth, smooth_half_window_s: 20")
    assert scenario(tmp_path, noisy.replace("runs: 1", "runs: 2")).runs == 2


@pytest.mark.parametrize(
    ("key", "value"),
    [("outliers", "{probability: 0, size_sigma: 1}"), ("detection_probability", "0.9")],
)
def test_a_sensor_leaves_recorded_measurements_as_they_are(tmp_path, key, value):
    save(tmp_path, "scans.csv", rows("a", SCANS_S, metres, False))
    text = ALONE.replace("std_m: 30}", f"std_m: 30, {key}: {value}}}")
    says = rf":5:30: recorded measurements are taken as they are; remove '{key}' from the sensor$"
    with pytest.raises(UserError, match=says):
        scenario(tmp_path, text)
    assert scenario(tmp_path, text.replace("0.9", "1"), "sensor.outliers=").runs == 1
    noisy = text.replace("as: measurements", "as: truth, smooth_half_window_s: 20")
    sensor = scenario(tmp_path, noisy).sensor
    assert (sensor.outliers is not None) == (key == "outliers")
    assert (sensor.detection_probability == 0.9) == (key == "detection_probability")


@pytest.mark.parametrize("mean", ["truth", "drawn_about_truth"])
def test_a_start_from_a_truth_that_nobody_knows_is_refused(tmp_path, mean):
    save(tmp_path, "scans.csv", rows("a", SCANS_S, metres, False))
    save(tmp_path, "reference.csv", rows("a", REFERENCE_S, metres, False))
    text = ABOUT_TRUTH.replace("mean: drawn_about_truth", f"mean: {mean}")
    assert np.isfinite(scenario(tmp_path, text).cases[0].truth.state[0]).all()
    says = r":7:11: the truth at the first scan of 'a' is unknown.* give 'from_measurements: two_p"
    with pytest.raises(UserError, match=says):
        scenario(tmp_path, text.replace(", reference: {file: reference.csv}", ""))
    # Nor does a reference help that begins later than the scans.
    save(tmp_path, "reference.csv", rows("a", REFERENCE_S + 30.0, metres, False))
    with pytest.raises(UserError, match=says):
        scenario(tmp_path, text)
