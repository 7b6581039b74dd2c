"""Outliers: of what length, in which directions, how often and when; and that nothing else changes.

Monte Carlo tolerances are 5 standard errors (`assert_mean`), with fixed seeds.
"""

import numpy as np
import pytest

from hybridtrack.sensors import Outliers, Sensor
from hybridtrack.simulation import BLOCK_RUNS, Case, FixedTruth
from test_simulation import CORRELATED, assert_mean, chain, flight_bank, simulate, still

UNEQUAL = np.diag([400.0, 1.0])
SIZE = 60.0
# An offset is a difference of two measurements: rounding of 1e4 m, 1e-16 relative, in units of
# the smallest standard deviation of all, 1 m.
ROUNDING = 1e-11


def scans(case, sensor, **options):
    """Modes and measurements of one block."""
    _, _, mode, _, z = simulate(case, sensor, **options)
    return mode, z


def offsets(case, sensor, **options):
    """Modes; what the outliers add (n_steps, n_y, runs); which scans are outliers."""
    mode, ordinary = scans(case, sensor._replace(outliers=None), **options)
    _, z = scans(case, sensor, **options)
    assert (np.isnan(z) == np.isnan(ordinary)).all()
    added = np.nan_to_num(z - ordinary)
    return mode, added, (added != 0.0).any(axis=1)


def along_a_line(n_steps):
    """A truth in one dimension, at rest."""
    states = np.tile([50.0, 0.0], (n_steps + 1, 1))
    truth = FixedTruth(states, np.zeros(n_steps + 1, dtype=np.int64), ("x", "vx"))
    return Case("line", np.arange(n_steps + 1.0), truth)


def whitened(offset, covariance):
    """In units of the noise: (n_y, n) of offsets (n_y, n)."""
    return np.linalg.solve(np.linalg.cholesky(covariance), offset)


@pytest.mark.parametrize("covariance", [9.0 * np.eye(2), UNEQUAL, CORRELATED])
def test_an_outlier_has_its_mahalanobis_length_in_a_random_direction(covariance):
    sensor = Sensor(covariance[np.newaxis], 1.0, 0, Outliers(1.0, SIZE))
    _, added, outlying = offsets(still(100), sensor)
    assert outlying.all()
    added = np.moveaxis(added, 1, 0).reshape(2, -1)
    squared = np.einsum("mb,ml,lb->b", added, np.linalg.inv(covariance), added)
    np.testing.assert_allclose(np.sqrt(squared), SIZE, rtol=0.0, atol=ROUNDING)
    direction = whitened(added, covariance) / SIZE
    # Uniform on a circle: no mean, E u u' = I/2, E u_m^4 = 3/8; and half of them in each half.
    assert_mean(direction, 0.0)
    assert_mean(direction[:, np.newaxis] * direction, 0.5 * np.eye(2))
    assert_mean(direction**4, 0.375)
    assert_mean((direction > 0.0).astype(float), 0.5)


def test_in_one_dimension_an_outlier_has_a_random_sign():
    sensor = Sensor(np.full((1, 1, 1), 4.0), 1.0, 0, Outliers(1.0, 10.0))
    _, added, _ = offsets(along_a_line(100), sensor)
    np.testing.assert_allclose(np.abs(added), 20.0, rtol=0.0, atol=ROUNDING)
    assert_mean((added > 0.0).astype(float).ravel(), 0.5)


@pytest.mark.parametrize("kind", ["fixed", "chain"])
def test_an_outlier_is_as_large_as_the_noise_of_the_truths_mode(kind):
    covariances = np.stack([UNEQUAL, CORRELATED])
    case = still(40, np.arange(41) // 3 % 2)
    if kind == "chain":
        bank = flight_bank(transition_matrix=np.array([[0.8, 0.2], [0.4, 0.6]]))
        case = Case("chain", np.arange(41.0), chain(bank))
    mode, added, _ = offsets(case, Sensor(covariances, 1.0, 0, Outliers(1.0, SIZE)))
    mode = np.broadcast_to(mode, (40, BLOCK_RUNS))
    for j in range(2):
        assert (mode == j).any()
        direction = whitened(np.moveaxis(added, 1, 0)[:, mode == j], covariances[j])
        length = np.sqrt((direction**2).sum(axis=0))
        np.testing.assert_allclose(length, SIZE, rtol=0.0, atol=ROUNDING)


def test_outliers_are_as_often_as_stated_and_by_themselves():
    sensor = Sensor(CORRELATED[np.newaxis], 1.0, 0, Outliers(0.3, SIZE))
    _, _, outlying = offsets(still(200), sensor)
    often = outlying.astype(float)
    assert_mean(often.ravel(), 0.3)
    # Independent of the scan before and of the next run.
    assert_mean((often[1:] * often[:-1]).ravel(), 0.09)
    assert_mean((often[:, 1:] * often[:, :-1]).ravel(), 0.09)


def test_a_scan_that_is_no_outlier_is_what_it_was():
    case = still(50)
    sensor = Sensor(CORRELATED[np.newaxis], 0.7, 0, Outliers(0.2, SIZE))
    _, z = scans(case, sensor)
    _, ordinary = scans(case, sensor._replace(outliers=None))
    same = (z == ordinary).all(axis=1)
    missed = np.isnan(ordinary).any(axis=1)
    assert (np.isnan(z).all(axis=1) == missed).all()  # an outlier doesn't bring a scan back
    assert_mean(1.0 - same[~missed], 0.2)


@pytest.mark.parametrize("outliers", [Outliers(0.0, SIZE), Outliers(1.0, 0.0)])
def test_no_outliers_and_outliers_of_no_size_change_nothing(outliers):
    sensor = Sensor(CORRELATED[np.newaxis], 1.0, 0, outliers)
    _, added, _ = offsets(still(20), sensor)
    assert not added.any()


@pytest.mark.parametrize("length", [1, 7, 1000])
@pytest.mark.parametrize(("from_s", "until_s"), [(12.0, 12.0), (-np.inf, 3.0), (17.5, np.inf)])
def test_outliers_stay_within_their_span(from_s, until_s, length):
    sensor = Sensor(CORRELATED[np.newaxis], 1.0, 0, Outliers(1.0, SIZE, from_s, until_s))
    _, _, outlying = offsets(still(20), sensor, length=length)
    times_s = np.arange(1.0, 21.0)
    held = (times_s >= from_s) & (times_s <= until_s)
    assert 0 < held.sum() < 20
    assert (outlying == held[:, np.newaxis]).all()


def test_the_span_of_outliers_isnt_decided_by_rounding():
    # 0.1 * 3 is 0.30000000000000004 and 0.1 * 7 is 0.7000000000000001.
    case = still(9)._replace(times_s=0.1 * np.arange(10.0))
    for at_s, scan in ((0.3, 3), (0.7, 7), (0.5, 5)):
        sensor = Sensor(CORRELATED[np.newaxis], 1.0, 0, Outliers(1.0, SIZE, at_s, at_s))
        assert np.flatnonzero(sensor.may_be_outliers(case.times_s)).tolist() == [scan - 1]
        _, _, outlying = offsets(case, sensor)
        assert np.flatnonzero(outlying.all(axis=1)).tolist() == [scan - 1]


@pytest.mark.parametrize("length", [1, 2, 1000])
def test_the_scans_of_a_start_are_no_outliers(length):
    sensor = Sensor(CORRELATED[np.newaxis], 1.0, 2, Outliers(1.0, SIZE))
    _, _, outlying = offsets(still(6), sensor, length=length)
    assert not outlying[:2].any()
    assert outlying[2:].all()


def test_a_wider_span_leaves_the_outliers_that_there_were():
    narrow = Sensor(CORRELATED[np.newaxis], 1.0, 0, Outliers(0.5, SIZE, 5.0, 8.0))
    wide = narrow._replace(outliers=Outliers(0.5, SIZE))
    (_, few), (_, many) = (scans(still(20), sensor) for sensor in (narrow, wide))
    assert few[4:8].tobytes() == many[4:8].tobytes()
    assert (few[8:] != many[8:]).any()
