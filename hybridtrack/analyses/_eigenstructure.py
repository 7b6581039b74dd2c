"""How fast the powers of a matrix decay, told by its eigenvalues: rate, condition, Jordan blocks.

Eigenvalues that rounding alone tells apart are one cluster. Within a cluster the eigenvectors are
an orthonormal basis: any other choice would make the condition number arbitrary, and every motion
model that is the same on two axes has such clusters.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.models import Array

ComplexArray = NDArray[np.complex128]

SAME = 1e-6  # eigenvalues this close, relative to the largest, are one
LARGEST_BLOCK = 4  # that is looked for: no motion model has more integrators to an axis
ERROR = 1e-14  # of a well-conditioned eigenvalue, relative to the matrix: some 50 roundings


class Cluster(NamedTuple):
    """Eigenvalues that are one but for rounding."""

    eigenvalue: complex  # their mean, which rounding moves far less than each of them
    members: int


class Eigenstructure(NamedTuple):
    """What bounds the powers of a matrix F.

    ||F^t|| <= condition_number rate^t where largest_block is 1 (Hwang 2003, eq. 29), with
    largest_block > 1 see `power_bound` (eq. 30).
    """

    rate: float  # alpha, the largest modulus of an eigenvalue
    condition_number: float  # k = ||V|| ||V^-1||, 2-norms
    largest_block: int  # m, the size of the largest Jordan block
    largest_cluster: int  # how many eigenvalues are one but for rounding

    @property
    def distinct(self) -> bool:
        """Whether no two eigenvalues are one but for rounding."""
        return self.largest_cluster == 1


def clusters(matrix: Array) -> list[Cluster]:
    """The eigenvalues of a matrix (n, n), those that rounding alone tells apart taken together.

    Those within SAME of each other; and those whose own error, that of rounding over the cosine
    between left and right eigenvectors, reaches as far: the three of a Jordan block of size 3 lie
    1e-5 apart.
    """
    from scipy.linalg import eig

    balanced, _ = _balanced(matrix)
    eigenvalues, left, right = eig(balanced, left=True, right=True)
    cosine = np.abs(np.einsum("ij,ij->j", left.conj(), right))
    # At a Jordan block the cosine is 0, and an error e moves its eigenvalues by e^(1/size).
    most = ERROR ** (1.0 / min(len(matrix), LARGEST_BLOCK))
    relative = np.minimum(ERROR / np.maximum(cosine, ERROR), most)
    error = float(np.linalg.norm(balanced, 2)) * relative
    same = SAME * float(np.abs(eigenvalues).max())
    waiting, found = list(range(len(eigenvalues))), []
    while waiting:
        group = [waiting.pop(0)]
        for one in group:  # grows while it is walked: a chain of neighbours is one cluster
            gaps = np.abs(eigenvalues - eigenvalues[one])
            close = [i for i in waiting if gaps[i] <= max(same, error[i] + error[one])]
            group += close
            waiting = [i for i in waiting if i not in close]
        found.append(Cluster(complex(eigenvalues[group].mean()), len(group)))
    return found


def _balanced(matrix: Array) -> tuple[Array, Array]:
    """B and d with matrix = diag(d) B diag(d)^-1, B's rows and columns of like size.

    Whether eigenvalues are one must not depend on units.
    """
    from scipy.linalg import matrix_balance

    with np.errstate(invalid="ignore"):  # scipy takes the scales for a permutation, too
        balanced, (scales, _) = matrix_balance(matrix, permute=False, separate=True)
    return balanced, scales


def eigenstructure(matrix: Array) -> Eigenstructure:
    """Rate, condition number and largest Jordan block of a matrix (n, n).

    The condition number is inf where no n independent vectors can be found in floating point.
    """
    balanced, scales = _balanced(matrix)
    found = clusters(matrix)
    rate = float(np.abs(np.linalg.eigvals(balanced)).max())
    columns: list[ComplexArray] = []
    largest = 1
    for cluster in found:
        chains = [scales[:, np.newaxis] * chain for chain in _chains(balanced, cluster)]
        if all(chain.shape[1] == 1 for chain in chains):
            columns.append(np.linalg.qr(np.hstack(chains))[0])
        else:
            columns += [chain / np.linalg.norm(chain[:, -1]) for chain in chains]
        largest = max(largest, *(chain.shape[1] for chain in chains))
    basis, condition = np.hstack(columns), math.inf
    if basis.shape[1] == len(matrix):
        singular = np.linalg.svd(basis, compute_uv=False)
        condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else math.inf
    return Eigenstructure(rate, condition, largest, max(one.members for one in found))


def _chains(matrix: Array, cluster: Cluster) -> list[ComplexArray]:
    """The cluster's eigenvectors and Jordan chains, each (n, length) and ending in its head.

    As many vectors as the cluster has members, or fewer where rounding hides the others.
    """
    shifted: ComplexArray = matrix - cluster.eigenvalue * np.eye(len(matrix))
    size = max(float(np.linalg.norm(shifted, 2)), float(np.finfo(np.float64).tiny))
    space = _null_space(shifted / size, cluster.members)
    if cluster.members == 1 or float(np.linalg.norm(shifted @ space, 2)) <= SAME * size:
        return [space[:, [i]] for i in range(cluster.members)]
    space = _null_space(np.linalg.matrix_power(shifted / size, cluster.members), cluster.members)
    return [space @ chain for chain in _nilpotent_chains(space.conj().T @ shifted @ space)]


def _null_space(matrix: ComplexArray, dimension: int) -> ComplexArray:
    """Orthonormal right singular vectors (n, dimension) of the smallest singular values."""
    _, _, rows = np.linalg.svd(matrix)
    vectors: ComplexArray = rows[len(rows) - dimension :].conj().T
    return vectors


def _nilpotent_chains(nilpotent: ComplexArray) -> list[ComplexArray]:
    """Jordan chains N^(r-1) v, .., v of a nilpotent matrix (p, p), the longest first.

    Each begins with a v of unit length whose N^(r-1) v the chains before it don't reach.
    """
    p = len(nilpotent)
    scale = max(float(np.linalg.norm(nilpotent, 2)), float(np.finfo(np.float64).tiny))
    powers = [np.linalg.matrix_power(nilpotent / scale, r) for r in range(p + 1)]
    chains: list[ComplexArray] = []
    ends: list[ComplexArray] = []  # the eigenvectors that longer chains have
    left = p
    for length in range(p, 0, -1):
        null = _null_space(powers[length], _nullity(powers[length]))
        image = powers[length - 1] @ null
        if ends:
            taken, _ = np.linalg.qr(np.stack(ends, axis=1))
            image = image - taken @ (taken.conj().T @ image)
        _, strengths, rows = np.linalg.svd(image)
        for strength, row in zip(strengths, rows, strict=False):
            if strength <= SAME or left < length:
                continue
            head = null @ row.conj()
            links = [powers[r] @ head for r in range(length)]
            ends.append(links[-1] / np.linalg.norm(links[-1]))
            chains.append(np.stack([links[r] * scale**r for r in reversed(range(length))], axis=1))
            left -= length
    return chains or [np.eye(p, dtype=np.complex128)[:, :1]]


def _nullity(matrix: ComplexArray) -> int:
    return int((np.linalg.svd(matrix, compute_uv=False) <= SAME).sum())


def power_bound(structure: Eigenstructure, steps: int) -> float:
    """What ||F^t|| is at most after t = `steps`, by eqs. 29 and 30 of Hwang 2003.

    k alpha^t, with a Jordan block of size m > 1 m k alpha^t max over r < m of t^r alpha^-r.
    """
    alpha, k, m, _ = structure
    if not math.isfinite(k):
        return math.inf
    if alpha == 0.0:  # nilpotent: nothing is left after m steps, and J^t is no larger than 1
        return k if steps < m else 0.0
    largest: float = max(float(steps) ** r * alpha ** (steps - r) for r in range(m))
    return m * k * largest


def steps_until_below(structure: Eigenstructure, rate: float = 1.0) -> float:
    """From which t on `power_bound` is at most rate^t; a real number of steps.

    rate in (alpha, 1]. ln k / ln(rate / alpha) where the eigenvectors are complete; with rate 1
    that is the paper's ln k / |ln alpha| (Hwang 2003, eq. 41). With Jordan blocks the last root
    of m k t^r alpha^(t - r) = rate^t over r < m.
    """
    alpha, k, m, _ = structure
    if alpha == 0.0:
        return float(m if m > 1 else 0)
    if not math.isfinite(k):
        return math.inf
    slope = math.log(rate / alpha)

    def excess(t: float, r: int) -> float:
        return math.log(m * k) + r * (math.log(t) if r else 0.0) - r * math.log(alpha) - t * slope

    last = max(math.log(m * k), 0.0) / slope
    for r in range(1, m):
        peak = r / slope
        if excess(peak, r) <= 0.0:
            continue
        from scipy.optimize import brentq

        high = 2.0 * peak
        while excess(high, r) > 0.0:
            high *= 2.0
        last = max(last, float(brentq(excess, peak, high, args=(r,))))
    return last
