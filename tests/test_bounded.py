"""Bounded noise: which kinds keep their ellipsoid, how they are spread, and which leave it."""

import math

import numpy as np
import pytest
from scipy import stats

from hybridtrack import bounded, ellipsoids
from hybridtrack.simulation import stream
from set_models import Q, R, aircraft, opposed, truth

SHAPE = np.diag([4.0, 1.0, 0.25])
HALF_AXES = np.sqrt(np.diag(SHAPE))


def drawn(kind, steps=200, runs=500, seed=1, shape=SHAPE, hold=40):
    noise = bounded.Noise(kind, shape, hold)
    return bounded.NoiseRuns(noise, np.random.default_rng(seed), runs).advance(steps)


def distance(noise, shape=SHAPE):
    return ellipsoids.quadratic(noise, np.broadcast_to(shape, (*noise.shape, noise.shape[-1])))


@pytest.mark.parametrize("kind", ["none", "ball", "sphere", "persistent_ball"])
def test_what_is_inside_stays_inside(kind):
    assert not bounded.outside(drawn(kind), SHAPE).any()


def test_the_ball_is_filled_evenly():
    """The n-th power of the distance's root is uniform, and so is each direction's sign."""
    w = drawn("ball")
    radius = np.sqrt(distance(w)).ravel()
    assert stats.kstest(radius**3, "uniform").pvalue > 1e-3
    assert abs(np.sign(w).mean(axis=(0, 1))).max() < 4 / math.sqrt(w[..., 0].size)
    # Along an axis the variance is half-axis^2 / (n + 2).
    np.testing.assert_allclose(w.var(axis=(0, 1)) / HALF_AXES**2, 1 / 5, rtol=0.03)


def test_the_sphere_is_the_boundary():
    np.testing.assert_allclose(distance(drawn("sphere")), 1.0, rtol=1e-9)


@pytest.mark.parametrize(("kind", "share"), [("persistent_ball", 1 / 3), ("persistent_box", 1.0)])
def test_persistent_noise_stays_for_forty_steps(kind, share):
    """|w_i| is sigma_i/sqrt(n) or sigma_i; signs are redrawn at steps 0, 40, 80 and no other."""
    w = drawn(kind, steps=120)
    np.testing.assert_allclose(
        np.sort(np.abs(w) ** 2, axis=-1)[..., ::-1],
        share * 4.0 ** (1 - np.arange(3)) * np.ones_like(w),
        rtol=1e-12,
    )
    changed = (np.diff(np.sign(w), axis=0) != 0).any(axis=(1, 2))
    assert np.flatnonzero(changed).tolist() == [39, 79]


@pytest.mark.parametrize("kind", bounded.PRINTED)
def test_the_printed_noise_is_inside_the_box_and_not_the_ellipsoid(kind):
    """16 to 80 % of draws leave it, by each reading; 3 Q contains them all."""
    w = drawn(kind)
    assert (np.abs(w) <= np.sort(HALF_AXES)[::-1].max() + 1e-12).all()
    share = bounded.outside(w, SHAPE).mean()
    assert 0.07 < share < 0.81
    assert not bounded.outside(w, 3 * SHAPE).any()


def test_how_often_the_printed_noise_leaves_is_what_integration_says():
    """Of 2 and of 3 components, truncated: the mass of the box outside the unit ball."""
    grid = (np.arange(2000) + 0.5) / 1000 - 1
    density = np.exp(-(grid**2) / 2)
    density /= density.sum()
    two = np.add.outer(grid**2, grid**2)
    wanted = float((np.multiply.outer(density, density) * (two > 1)).sum())
    share = bounded.outside(drawn("truncated_gaussian", shape=np.eye(2)), np.eye(2)).mean()
    assert share == pytest.approx(wanted, abs=4 * math.sqrt(wanted / 100_000))
    # Zeroed: a component passes with probability .683; clipped: any at its end leaves.
    p = math.erf(1 / math.sqrt(2))
    zeroed = bounded.outside(drawn("zeroed_gaussian", shape=np.eye(2)), np.eye(2)).mean()
    assert zeroed == pytest.approx(p**2 * wanted, abs=0.004)
    clipped = bounded.outside(drawn("clipped_gaussian", shape=np.eye(2)), np.eye(2)).mean()
    assert clipped == pytest.approx(p**2 * wanted + 1 - p**2, abs=0.006)


@pytest.mark.parametrize("kind", [k for k in bounded.KINDS if k != "adversary"])
def test_runs_depend_neither_on_spans_nor_on_how_many_are_kept(kind):
    model = aircraft()

    def begin(lanes):
        return bounded.BoundedRuns(
            truth(model, kind, "ball"), lambda p: stream(3, 0, 0, p), 64, lanes
        )

    whole, parts, few = begin(64), begin(64), begin(8)
    states, measurements, _ = whole.advance(90)
    pieces = [parts.advance(n)[0] for n in (7, 75, 8)]
    np.testing.assert_array_equal(states, np.concatenate(pieces))
    np.testing.assert_array_equal(few.advance(90)[1], measurements[:, :8])


def test_starts_lie_in_the_first_ellipsoid():
    model = aircraft()
    for spread, least in (("none", 0.0), ("ball", 0.0), ("sphere", 1.0)):
        runs = bounded.BoundedRuns(
            truth(model, "none", spread), lambda p: stream(1, 0, 0, p), 256, 256
        )
        far = ellipsoids.quadratic(runs.state, np.broadcast_to(model.initial_shape, (256, 3, 3)))
        assert least - 1e-9 <= far.min() <= far.max() <= 1 + 1e-9
        assert (np.ptp(runs.state, axis=0) > 0).all() == (spread != "none")


def test_the_adversary_is_worse_than_any_random_noise():
    """One step from a given ellipsoid: no draw inside the noise's ellipsoid leads farther."""
    model, runs = aircraft(), 512
    generator = np.random.default_rng(2)
    whole = bounded.BoundedRuns(
        truth(model, "adversary", "sphere", "it"), lambda p: stream(1, 0, 0, p), runs, runs
    )
    shape = np.tile(model.initial_shape, (runs, 1, 1))
    whole.opponent = bounded.Opponent(np.zeros((runs, 3)), shape, lambda y: (None, None))
    before, none = whole.state.copy(), np.zeros(0)
    ahead = model.dynamics.value(before, none)
    A = model.dynamics.jacobian(np.zeros((1, 3)), none)[0]
    P = np.broadcast_to(A @ model.initial_shape @ A.T + Q, shape.shape)
    centre = model.dynamics.value(np.zeros((1, 3)), none)
    states = whole.advance(1)[0][0]
    assert not bounded.outside(states - ahead, Q).any()
    pushed = ellipsoids.quadratic(states - centre, P)
    for _ in range(200):
        w = bounded.NoiseRuns(bounded.Noise("sphere", Q, 1), generator, runs).advance(1)[0]
        assert (ellipsoids.quadratic(ahead + w - centre, P) <= pushed * (1 + 1e-3)).all()


def test_the_adversary_never_cheats():
    assert opposed(aircraft(), {}, 16, steps=60).largest <= 1 + 1e-9  # asserts its draws are inside


@pytest.mark.parametrize("contains_box", [False, True])
def test_outside_is_what_leaves_the_filters_ellipsoid(contains_box):
    """Corners of the box lie outside Q and R, and inside 3 Q and 2 R where those are believed."""
    model = aircraft(contains_box)
    runs = bounded.BoundedRuns(truth(model, "persistent_box"), lambda p: stream(1, 0, 0, p), 16, 16)
    assert (runs.advance(50)[2] == (not contains_box)).all()


def test_half_axes_of_measurement_noise_are_its_own():
    w = drawn("persistent_box", shape=R)
    np.testing.assert_allclose(np.abs(w), 0.09, rtol=1e-12)
