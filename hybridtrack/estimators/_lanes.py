"""What the recursion does to rows of lanes, and Gaussians merged one at a time.

A row is a (lanes,) array; the functions overwrite their first argument, inline, and become vector
instructions. Covariances are packed lower triangles: element (a, c), a >= c, is row
a (a + 1)/2 + c.
"""

import math

import numpy as np
from numpy.typing import NDArray

from hybridtrack.compiled import lane_kernel, row_kernel

CACHE_LINE_BYTES = 64


def aligned_zeros(*shape: int) -> NDArray[np.float64]:
    """Zeros at a cache line's beginning: vectors that straddle two lines cost a quarter more."""
    size = math.prod(shape)
    memory = np.zeros(size + CACHE_LINE_BYTES // 8)
    first = -memory.ctypes.data % CACHE_LINE_BYTES // 8
    return memory[first : first + size].reshape(shape)


@row_kernel
def set_scaled(out, factor, row):
    for b in range(out.size):
        out[b] = factor * row[b]


@row_kernel
def add_scaled(out, factor, row):
    for b in range(out.size):
        out[b] += factor * row[b]


@row_kernel
def copy(out, row):
    for b in range(out.size):
        out[b] = row[b]


@lane_kernel
def copy_all(out, rows):
    for e in range(out.shape[0]):
        copy(out[e], rows[e])


@row_kernel
def fill(out, value):
    for b in range(out.size):
        out[b] = value


@lane_kernel
def apply(out, matrix_row, vector, offset):
    """out <- matrix_row . vector + offset; structural zeros are skipped."""
    fill(out, offset)
    for e in range(matrix_row.size):
        if matrix_row[e] != 0.0:
            add_scaled(out, matrix_row[e], vector[e])


@row_kernel
def packed(a, c):
    return a * (a + 1) // 2 + c if a >= c else c * (c + 1) // 2 + a


# ---- Gaussians merged one at a time ----------------------------------------------------------


@row_kernel
def merge_share(total, share, factor, row):
    """share <- factor row / (total + factor row), 0 where both are 0; total grows by it."""
    for b in range(total.size):
        weight = factor * row[b]
        total[b] += weight
        share[b] = weight / total[b] if total[b] > 0.0 else 0.0


@row_kernel
def merge_mean(out, difference, share, mean, other):
    for b in range(out.size):
        difference[b] = other[b] - mean[b]
        out[b] = mean[b] + share[b] * difference[b]


@row_kernel
def merge_second_moment(out, one, other, share, difference_a, difference_c):
    for b in range(out.size):
        s = share[b]
        rest = 1.0 - s
        out[b] = rest * (one[b] + s * (difference_a[b] * difference_c[b])) + s * other[b]


@row_kernel
def merge(
    out_mean, out_covariance, share, mean, covariance, other_mean, other_covariance, difference
):
    """Merge two Gaussians, the other with the given share of the sum of weights.

    The outcome may take the first one's place.

    P <- (1 - s) P + s P' + s (1 - s) d d', d the difference of the means: positive semidefinite
    in rounding too, since nothing is subtracted.
    """
    n_x = mean.shape[0]
    for e in range(n_x):
        merge_mean(out_mean[e], difference[e], share, mean[e], other_mean[e])
    t = 0
    for a in range(n_x):
        for c in range(a + 1):
            merge_second_moment(
                out_covariance[t],
                covariance[t],
                other_covariance[t],
                share,
                difference[a],
                difference[c],
            )
            t += 1
