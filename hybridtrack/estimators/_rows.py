"""What the recursion does to rows of vectors: products, and Gaussians merged one at a time.

A row is an array of vectors (hybridtrack.vectors), one for each state, say. Covariances are packed
lower triangles: element (a, c), a >= c, is at a (a + 1)/2 + c.
"""

import numpy as np

from hybridtrack.compiled import row_kernel
from hybridtrack.elementary import exp, maximum
from hybridtrack.vectors import repeat, select


@row_kernel
def copy(out, row, size):
    for e in range(size):
        out[e] = row[e]


@row_kernel
def packed(a, c):
    """Where element (a, c) of a symmetric matrix is."""
    return (a * (a + 1) >> 1) + c if a >= c else (c * (c + 1) >> 1) + a


@row_kernel
def product(matrix_row, row):
    """matrix_row . row; structural zeros are skipped."""
    total = repeat(0.0)
    for e in range(matrix_row.shape[0]):
        if matrix_row[e] != 0.0:
            total += matrix_row[e] * row[e]
    return total


@row_kernel
def apply(out, maps, time, j, row, offset):
    """out <- A row + offset, with A the j-th of sparse maps at the given time."""
    first, column, weight = maps.first[j], maps.column[j], maps.weight[time, j]
    for t in range(offset.shape[0]):
        total = repeat(offset[t])
        for s in range(first[t], first[t + 1]):
            total += weight[s] * row[column[s]]
        out[t] = total


@row_kernel
def merge_means(out, share, other, n_x):
    for e in range(n_x):
        out[e] = out[e] + share * (other[e] - out[e])


@row_kernel
def merge(
    out_mean,
    out_covariance,
    share,
    mean,
    covariance,
    other_mean,
    other_covariance,
    difference,
    n_x,
):
    """Merge two Gaussians, the other with the given share of the sum of weights.

    The outcome may take the first one's place.

    P <- (1 - s) (P + s d d') + s P', d the difference of the means: positive semidefinite in
    rounding too, since nothing is subtracted.
    """
    rest = 1.0 - share
    t = 0
    for a in range(n_x):
        d = other_mean[a] - mean[a]
        difference[a] = d
        moved = share * d
        out_mean[a] = mean[a] + moved
        for c in range(a + 1):
            spread = covariance[t] + moved * difference[c]
            out_covariance[t] = rest * spread + share * other_covariance[t]
            t += 1


@row_kernel
def normalise(out, factor, exponent, n_modes):
    """out_j <- factor_j e**exponent_j over their sum, with no underflow.

    Returns the largest exponent of those with a factor, and the sum over e to that power.
    """
    largest = repeat(-np.inf)
    for j in range(n_modes):
        largest = maximum(largest, select(factor[j] > 0.0, exponent[j], -np.inf))
    total = repeat(0.0)
    for j in range(n_modes):
        out[j] = select(factor[j] == 0.0, 0.0, factor[j] * exp(exponent[j] - largest))
        total += out[j]
    inverse = 1.0 / total
    for j in range(n_modes):
        out[j] = out[j] * inverse
    return largest, total
