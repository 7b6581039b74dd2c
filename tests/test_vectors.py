"""Vectors of lanes as numbers, compiled, against NumPy."""

import numpy as np

from hybridtrack.compiled import lane_kernel
from hybridtrack.elementary import exp, log, maximum
from hybridtrack.vectors import WIDTH, load, repeat, select, sqrt, store, vectors


@lane_kernel
def calculate(memory, scale, out):
    """One of each operation; x and y are rows of two vectors."""
    rows = vectors(memory)
    x, y = rows[0, 1], rows[1][1]
    shown = vectors(out)
    shown[0] = x + y
    shown[1] = x - scale
    shown[2] = scale * x * y
    shown[3] = 1.0 / y
    shown[4] = -x
    shown[5] = select((x < y) & (y <= scale), x, 7.0)
    shown[6] = select(x > 0.0, sqrt(x), repeat(scale))
    shown[7] = select(x == x, maximum(x, y), 0.0)
    total = repeat(1.0)
    total += x
    total -= y
    total *= scale
    shown[8] = total


def test_every_operation():
    rng = np.random.default_rng(1)
    memory = rng.normal(size=(2, 3, WIDTH))
    memory[0, 1, :3] = 0.0, np.nan, -np.inf
    out = np.empty((9, WIDTH))
    x, y = memory[:, 1]
    with np.errstate(all="ignore"):  # of NumPy's, where this is not compiled
        calculate(memory, 0.5, out)
        expected = [
            x + y,
            x - 0.5,
            0.5 * x * y,
            1 / y,
            -x,
            np.where((x < y) & (y <= 0.5), x, 7.0),
            np.where(x > 0, np.sqrt(x), 0.5),
            np.where(np.isnan(x), 0.0, np.maximum(x, y)),
            (1 + x - y) * 0.5,
        ]
    np.testing.assert_allclose(out, expected, rtol=1e-15)


@lane_kernel
def turn_around(table, out):
    """Rows of three indices, indexed all at once and bit by bit; stored in reverse."""
    rows = vectors(table)
    shown = vectors(out)
    n, m, r = table.shape[:3]
    for a in range(n):
        for c in range(m):
            for e in range(r):
                shown[n - 1 - a, m - 1 - c, r - 1 - e] = rows[a][c, e] + 0.0 * rows[a, c][e]


def test_rows_of_several_indices():
    table = np.random.default_rng(2).normal(size=(2, 3, 4, WIDTH))
    out = np.empty_like(table)
    turn_around(table, out)
    np.testing.assert_array_equal(out, table[::-1, ::-1, ::-1])


@lane_kernel
def swap(row, out):
    store(out, 0, load(row, 1))
    store(out, 1, load(row, 0))


def test_vectors_of_a_row_of_lanes():
    """A row need not begin where a cache line does."""
    row = np.arange(2.0 * WIDTH + 3)[3:]
    out = np.empty(2 * WIDTH)
    swap(row, out)
    np.testing.assert_array_equal(out, np.concatenate([row[WIDTH:], row[:WIDTH]]))


@lane_kernel
def exp_of(x, out):
    for v in range(x.size // WIDTH):
        store(out, v, exp(load(x, v)))


@lane_kernel
def log_of(x, out):
    for v in range(x.size // WIDTH):
        store(out, v, log(load(x, v)))


def applied(function, x):
    padded = np.concatenate([x, np.ones(-x.size % WIDTH)])
    out = np.empty_like(padded)
    with np.errstate(all="ignore"):  # of NumPy's, where this is not compiled
        function(padded, out)
    return out[: x.size]


def test_exp_is_good_to_two_units_in_the_last_place():
    rng = np.random.default_rng(1)
    x = np.concatenate([-707.9 * rng.random(20000), -(10.0 ** rng.uniform(-20, 0, 2000)), [0.0]])
    np.testing.assert_allclose(applied(exp_of, x), np.exp(x), rtol=5e-16)


def test_exp_at_its_ends():
    x = np.array([0.0, -708.1, -1e6, -np.inf, np.nan])
    np.testing.assert_array_equal(applied(exp_of, x), [1.0, 0.0, 0.0, 0.0, np.nan])


def test_log_is_good_to_two_units_in_the_last_place():
    rng = np.random.default_rng(2)
    x = np.concatenate([10.0 ** rng.uniform(-307, 307, 20000), 1 + rng.uniform(-1, 1, 2000) / 1e6])
    np.testing.assert_allclose(applied(log_of, x), np.log(x), rtol=5e-16)


def test_log_at_its_ends():
    x = np.array([0.0, 1.0, 5e-324, 1e-310, -1.0, np.nan])
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(applied(log_of, x), np.log(x), rtol=5e-16)
