"""Sums, boxes and intersections of ellipsoids: what they must contain, and in which digits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridtrack import ellipsoids as el
from reference_ellipsoids import printed_fusion

SEEDS = st.integers(0, 2**32 - 1)


def shapes(generator, n, lanes, spread=2.0):
    """Positive definite shapes: half-axes of 10^-spread to 10^spread in any directions."""
    directions = np.linalg.qr(generator.standard_normal((lanes, n, n)))[0]
    root = directions * 10.0 ** generator.uniform(-spread, spread, (lanes, 1, n))
    return root @ np.swapaxes(root, 1, 2)


def on_boundary(generator, shape):
    """A point (lanes, n) on each boundary."""
    lanes, n, _ = shape.shape
    unit = generator.standard_normal((lanes, n, 1))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return (np.linalg.cholesky(shape) @ unit)[..., 0]


@given(SEEDS, st.sampled_from([None, 0.1, 0.7]))
def test_a_sum_contains_every_sum(seed, beta):
    generator = np.random.default_rng(seed)
    one, two = (shapes(generator, 3, 64) for _ in range(2))
    total = el.add(one, two, beta)
    point = on_boundary(generator, one) + on_boundary(generator, two)
    assert (el.quadratic(point, total.shape) <= 1 + 1e-6).all()  # conditions of 1e8: rounding


@given(SEEDS)
def test_the_sum_of_the_smallest_trace_is_no_larger_than_others(seed):
    generator = np.random.default_rng(seed)
    one, two = (shapes(generator, 3, 8) for _ in range(2))
    best = el.trace(el.add(one, two, None).shape)
    for beta in np.linspace(0.02, 0.98, 49):
        assert (best <= el.trace(el.add(one, two, float(beta)).shape) * (1 + 1e-12)).all()


def test_a_sum_with_a_point_is_the_other():
    nothing, shape = np.zeros((1, 2, 2)), np.diag([2.0, 3.0])[np.newaxis]
    for beta in (None, 0.3):
        np.testing.assert_array_equal(el.add(nothing, shape, beta).shape, shape)
        np.testing.assert_array_equal(el.add(shape, nothing, beta).shape, shape)
        np.testing.assert_array_equal(el.add(nothing, nothing, beta).shape, nothing)


@given(SEEDS, st.sampled_from(["trace", "count"]), st.integers(1, 5))
def test_a_box_lies_inside_and_touches(seed, rule, n):
    generator = np.random.default_rng(seed)
    radius = generator.uniform(0.0, 3.0, (16, n)) * generator.integers(0, 2, (16, n))
    q = el.around_box(radius, rule)
    assert ((q > 0) == (radius > 0)).all()
    far = np.divide(radius**2, q, out=np.zeros_like(q), where=q > 0).sum(axis=1)
    np.testing.assert_allclose(far[(radius > 0).any(axis=1)], 1.0, rtol=1e-12)


def test_the_printed_factor_of_two_leaves_out_the_corners_of_three():
    """Otanez 2004, eq. 22: right for two components, 1.5 for three: outside."""
    for n, distance in ((1, 0.5), (2, 1.0), (3, 1.5)):
        q = el.around_box(np.ones((1, n)), "two")
        assert (1.0 / q).sum() == pytest.approx(distance)


@given(SEEDS, st.floats(0.01, 0.95))
def test_an_intersection_keeps_every_common_point(seed, rho):
    """x in Omega(c, P) and y - C x in Omega(0, R): x is in the fused one, whatever rho."""
    generator = np.random.default_rng(seed)
    lanes = 64
    P, R = shapes(generator, 3, lanes, 1.0), shapes(generator, 2, lanes, 1.0)
    C = generator.standard_normal((2, 3))
    centre = generator.standard_normal((lanes, 3))
    x = centre + on_boundary(generator, P)
    y = x @ C.T + on_boundary(generator, R)
    found = el.update(centre, P, y - centre @ C.T, C, R, np.full(lanes, rho))
    assert (found.distance <= 1 + 1e-8).all()
    shape = (1 - found.distance)[:, np.newaxis, np.newaxis] * found.shape
    inside = el.quadratic(x - found.centre, shape)
    # Both on their boundaries: on the fused one too, where a and delta say so (a = 1).
    np.testing.assert_allclose(inside[found.distance < 0.999], 1.0, atol=1e-4)


@given(SEEDS, st.floats(0.01, 0.9))
def test_joseph_s_form_is_the_printed_one_in_sixty_digits(seed, rho):
    generator = np.random.default_rng(seed)
    P, R = shapes(generator, 3, 1, 1.0), shapes(generator, 2, 1, 1.0)
    C, centre = generator.standard_normal((2, 3)), generator.standard_normal((1, 3))
    y = centre @ C.T + 0.1 * on_boundary(generator, R)
    found = el.update(centre, P, y - centre @ C.T, C, R, np.full(1, rho))
    moved, shape, delta = printed_fusion(centre[0], P[0], y[0], C, R[0], rho)
    scale = np.sqrt(np.outer(np.diag(shape), np.diag(shape)))
    ours = (1 - found.distance[0]) * found.shape[0]
    assert found.distance[0] == pytest.approx(delta, rel=1e-5)
    assert (np.abs(ours - shape) / scale).max() < 1e-5
    assert np.abs((found.centre[0] - moved) / np.sqrt(np.diag(shape))).max() < 1e-4


def test_the_printed_form_cancels_where_joseph_s_keeps_its_digits():
    """A wide P and a sharp R: the difference of two nearly equal matrices loses all of it."""
    P = 1e10 * np.array([[[1.0, 0.5, 0.2], [0.5, 1.0, 0.3], [0.2, 0.3, 1.0]]])
    R, C, rho = 1e-8 * np.eye(2), np.array([[1.0, 0, 0], [0, 1.0, 0]]), 0.05
    _, exact, _ = printed_fusion(np.zeros(3), P[0], np.zeros(2), C, R, rho)
    found = el.update(np.zeros((1, 3)), P, np.zeros((1, 2)), C, R[np.newaxis], np.full(1, rho))
    wide = P[0] / (1 - rho)
    gain = wide @ C.T @ np.linalg.inv(C @ wide @ C.T + R / rho)
    printed = wide - gain @ C @ wide
    assert found.shape[0, 0, 0] == pytest.approx(exact[0, 0], rel=1e-6)
    assert printed[0, 0] != pytest.approx(exact[0, 0], rel=0.5)


@given(SEEDS, st.integers(1, 5))
def test_quadratic_and_inverse_are_numpy_s(seed, n):
    generator = np.random.default_rng(seed)
    shape, vector = shapes(generator, n, 8, 0.5), generator.standard_normal((8, n))
    wanted = np.stack([v @ np.linalg.solve(s, v) for v, s in zip(vector, shape, strict=True)])
    np.testing.assert_allclose(el.quadratic(vector, shape), wanted, rtol=1e-5)
    eye = np.broadcast_to(np.eye(n), shape.shape)
    np.testing.assert_allclose(shape @ el.inverse(shape), eye, atol=1e-5)


def test_a_flat_ellipsoid_contains_only_what_is_flat():
    shape = np.diag([1.0, 0.0])[np.newaxis]
    assert el.quadratic(np.array([[0.5, 0.0]]), shape) == pytest.approx(0.25)
    assert np.isinf(el.quadratic(np.array([[0.5, 1e-9]]), shape))


@pytest.mark.parametrize("measure", ["trace", "determinant", "eigenvalue"])
def test_sizes_are_numpy_s_and_an_infinite_one_is_the_largest(measure):
    shape = np.stack([np.diag([1.0, 4.0]), np.diag([2.0, 2.0]), np.full((2, 2), np.inf)])
    wanted = {"trace": [5, 4], "determinant": [4, 4], "eigenvalue": [4, 2]}[measure]
    found = el.sizes(shape, measure)
    np.testing.assert_allclose(found[:2], wanted)
    assert found[2] == np.inf
