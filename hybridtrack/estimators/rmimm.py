"""Residual-mean IMM: each likelihood is divided by the norm of its residual's mean.

Hwang, Balakrishnan, Tomlin 2006, eqs. 26-29. As printed, the index of (28) is both the filter and
the index of the sum, and the true mode T is unknown. Read here: the candidate true mode i is
marginalised with the predicted mode probabilities w. With x0_j the mixed estimate, ebar0_j the
mean errors mixed the same way, y_j = x0_j + ebar0_j and b_i the input's effect:

    rbar_j    = (sum_i w_i C_i A_i) y_j - C_j A_j x0_j + sum_i w_i C_i b_i - C_j b_j
    ebar_j(k) = (sum_i w_i A_i) y_j - A_j x0_j + sum_i w_i b_i - b_j - K_j rbar_j,   ebar(0) = 0
    N_j       = 1/max(||rbar_j||, floor),   mu_j(k) proportional to N_j Lambda_j mu-_j(k)

The mixing of ebar, the use of x0 and the floor are ours. Unmixed, the mean residual of a filter
whose states add nothing to the others' predictions is 0 for ever (the CV filter of figure 5, its
acceleration zeroed); and the printed N (no floor) holds the filter in one mode far into a turn.
With an infinite floor it is the IMM.
"""

from typing import Literal, NamedTuple

from hybridtrack.estimators import BankEstimator
from hybridtrack.estimators._bank import (
    COMMON_RESIDUAL_MEAN,
    MIXING,
    RESIDUAL_MEAN,
    Recursion,
)


class Settings(NamedTuple):
    """residual_floor_m: smallest norm of a residual's mean, in the measurement's unit (m).

    residual_error: ebar by its recursion, or 0. residual_mean: each filter its own, or `common`,
    the formula as printed, summed over the filters: then N cancels and the filter is the IMM.
    """

    residual_floor_m: float
    residual_error: Literal["recursive", "zero"] = "recursive"
    residual_mean: Literal["own", "common"] = "own"


def _recursion(settings: Settings) -> Recursion:
    return Recursion(
        interaction=MIXING,
        weighting=RESIDUAL_MEAN if settings.residual_mean == "own" else COMMON_RESIDUAL_MEAN,
        recursive_residual_error=settings.residual_error == "recursive",
        residual_floor=settings.residual_floor_m,
    )


ESTIMATOR = BankEstimator(
    name="rmimm",
    summary="residual-mean IMM (RMIMM): likelihoods over the norm of the residual's mean",
    source="Hwang, Balakrishnan, Tomlin 2006, eqs. 26-29, with the indices as read here",
    settings=Settings,
    recursion=_recursion,
    limits={"residual_floor_m": (1e-300, None)},
)
