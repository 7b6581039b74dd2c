"""Hard bound filter: an IMM that counts the transitions and allows no more than a given number.

Sigalov 2011 compares with a filter of an earlier paper (his reference 15) and says of it that its
number of Kalman filters is linear in the number of manoeuvres, that they interact before each
cycle, and that the start is known. This filter is so; that it equals the earlier one is unproven.

Merging costs its count more than its estimates: in example 2, where it is right about the chain, in
some 3 % of runs it holds a transition to be still missing for 100 steps and more after the fourth
(the sequences kept apart, in best_sequences, have no such doubt there).
"""

from typing import NamedTuple

from hybridtrack.chains import Bound
from hybridtrack.estimators import BankEstimator
from hybridtrack.estimators._bank import MIXING, Recursion


class Settings(NamedTuple):
    """most_transitions: how often the mode changes at most (r_max)."""

    most_transitions: int


def _bound(settings: Settings) -> Bound:
    return Bound(most_transitions=settings.most_transitions)


def _recursion(settings: Settings) -> Recursion:
    return Recursion(interaction=MIXING)


ESTIMATOR = BankEstimator(
    name="hbf",
    summary="hard bound filter: an IMM over modes and the number of transitions so far",
    source="as described by Sigalov 2011, sections I and III-C",
    settings=Settings,
    recursion=_recursion,
    limits={"most_transitions": (0.0, 100.0)},
    bound=_bound,
)
