"""What the recursion does to rows of lanes, and Gaussians merged one at a time.

A row is a (lanes,) array; the functions overwrite their first argument, inline, and become vector
instructions. Covariances are packed lower triangles: element (a, c), a >= c, is row
a (a + 1)/2 + c.
"""

from hybridtrack.compiled import kernel


@kernel
def set_scaled(out, factor, row):
    for b in range(out.size):
        out[b] = factor * row[b]


@kernel
def add_scaled(out, factor, row):
    for b in range(out.size):
        out[b] += factor * row[b]


@kernel
def copy(out, row):
    for b in range(out.size):
        out[b] = row[b]


@kernel
def fill(out, value):
    for b in range(out.size):
        out[b] = value


@kernel
def apply(out, matrix_row, vector, offset):
    """out <- matrix_row . vector + offset; structural zeros are skipped."""
    fill(out, offset)
    for e in range(matrix_row.size):
        if matrix_row[e] != 0.0:
            add_scaled(out, matrix_row[e], vector[e])


@kernel
def packed(a, c):
    return a * (a + 1) // 2 + c if a >= c else c * (c + 1) // 2 + a


# ---- Gaussians merged one at a time ----------------------------------------------------------


@kernel
def merge_share(total, share, factor, row):
    """share <- factor row / (total + factor row), 0 where both are 0; total grows by it."""
    for b in range(total.size):
        weight = factor * row[b]
        total[b] += weight
        share[b] = weight / total[b] if total[b] > 0.0 else 0.0


@kernel
def merge_mean(mean, difference, share, other):
    for b in range(mean.size):
        difference[b] = other[b] - mean[b]
        mean[b] += share[b] * difference[b]


@kernel
def merge_second_moment(out, other, share, difference_a, difference_c):
    for b in range(out.size):
        s = share[b]
        rest = 1.0 - s
        out[b] = rest * (out[b] + s * (difference_a[b] * difference_c[b])) + s * other[b]


@kernel
def merge(mean, covariance, share, other_mean, other_covariance, difference):
    """Merge a second Gaussian into the first, with the given share of the sum of weights.

    P <- (1 - s) P + s P' + s (1 - s) d d', d the difference of the means: positive semidefinite
    in rounding too, since nothing is subtracted.
    """
    n_x = mean.shape[0]
    for e in range(n_x):
        merge_mean(mean[e], difference[e], share, other_mean[e])
    t = 0
    for a in range(n_x):
        for c in range(a + 1):
            merge_second_moment(
                covariance[t], other_covariance[t], share, difference[a], difference[c]
            )
            t += 1
