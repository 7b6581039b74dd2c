"""The genie: the Kalman filter that is told the true mode at every step, a floor for all others."""

from typing import NamedTuple

from hybridtrack.estimators import BankEstimator
from hybridtrack.estimators._bank import INHERIT, Recursion


class Settings(NamedTuple):
    """The genie has no settings: it knows."""


def _recursion(settings: Settings) -> Recursion:
    return Recursion(interaction=INHERIT)


ESTIMATOR = BankEstimator(
    name="genie",
    summary="Kalman filter that knows the true modes, as no filter can",
    source="Sigalov 2011, section IV",
    settings=Settings,
    recursion=_recursion,
)
