"""Square roots of covariances of any rank, in any units."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridtrack.motion import MOTION_MODELS
from hybridtrack.roots import square_root, thin_square_root

SEEDS = st.integers(0, 2**32 - 1)


def squared(root):
    return root @ root.swapaxes(-1, -2)


def assert_covariance(root, covariance):
    """L L' is the covariance, each entry to some eps of the two standard deviations it joins."""
    std = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    error = np.abs(squared(root) - covariance)
    # n eps for the eigenvalues, and the largest that is dropped: 1e-14 per state.
    assert (error <= 1e-13 * std[..., :, np.newaxis] * std[..., np.newaxis, :]).all()


@settings(max_examples=50, deadline=None)
@given(SEEDS, st.integers(1, 5), st.integers(0, 5))
def test_square_root_of_covariances_of_any_rank(seed, n, rank):
    thin = np.random.default_rng(seed).normal(size=(3, n, rank))
    covariance = squared(thin)
    # Backward stable eigenvalues: some eps times the norm, which is below 100 here.
    np.testing.assert_allclose(squared(square_root(covariance)), covariance, rtol=0.0, atol=1e-12)


@settings(max_examples=100, deadline=None)
@given(SEEDS, st.integers(1, 6), st.integers(0, 6))
def test_a_thin_root_has_as_many_columns_as_the_rank(seed, n, rank):
    rng = np.random.default_rng(seed)
    units = 10.0 ** rng.uniform(-6, 6, (2, 3, n, 1))
    factor = units * rng.normal(size=(2, 3, n, rank))
    factor[0, 1] = 0.0  # a mode without noise
    factor[1, :, 0] = 0.0  # a state without noise
    root = thin_square_root(squared(factor))
    assert root.shape == (2, 3, n, min(rank, n))
    assert_covariance(root, squared(factor))
    assert not root[0, 1].any()
    assert not root[1, :, 0].any()


def test_the_rank_is_the_highest_of_all_matrices_and_may_be_that_of_more():
    one = np.array([[4.0, 2.0], [2.0, 1.0]])
    two = np.diag([9.0, 1e-20])  # a small variance is a variance
    assert thin_square_root(one[np.newaxis]).shape == (1, 2, 1)
    assert thin_square_root(np.stack([one, two])).shape == (2, 2, 2)
    wide = thin_square_root(one, 2)
    assert_covariance(wide, one)
    assert not wide[:, 1].any()
    assert thin_square_root(np.zeros((1, 2, 3, 3))).shape == (1, 2, 3, 0)


@pytest.mark.parametrize(
    ("name", "parameters", "rank"),
    [
        ("constant_velocity", {"acceleration_std_m_s2": 0.3}, 1),
        ("constant_velocity", {"acceleration_psd_m2_s3": 0.3}, 2),
        ("constant_velocity_zero_acceleration", {"acceleration_std_m_s2": 0.3}, 1),
        ("wiener_acceleration", {"acceleration_std_m_s2": 0.3}, 1),
        ("wiener_acceleration", {"jerk_psd_m2_s5": 0.3}, 3),
    ],
)
@pytest.mark.parametrize("dimensions", [1, 2])
def test_motion_models_have_the_noise_of_their_sources(name, parameters, rank, dimensions):
    """Also where steps are so short that positions have next to no noise."""
    step_s = np.array([1e-4, 0.1, 0.3, 1.0, 7.0, 1e4])
    covariance = MOTION_MODELS[name].discretise(step_s, dimensions, **parameters)[2]
    root = thin_square_root(covariance)
    assert root.shape[-1] == rank * dimensions
    assert_covariance(root, covariance)
    for matrix in covariance:
        assert thin_square_root(matrix).shape[-1] == rank * dimensions
