"""Soft bound filter: an IMM that knows that the target will stop manoeuvring, but not when."""

from typing import NamedTuple

from hybridtrack.chains import Bound
from hybridtrack.estimators import BankEstimator
from hybridtrack.estimators._bank import MIXING, Recursion


class Settings(NamedTuple):
    """What is believed of the last transition.

    continuation_probability: p0, that the step just made was not the last that may change the
    mode; leak: that a mode which has ended comes back to life. Without a leak the filter locks in:
    one outlier may make a wrong mode the last for ever.
    """

    continuation_probability: float
    leak: float = 0.0


def _bound(settings: Settings) -> Bound:
    return Bound(continuation_probability=settings.continuation_probability, leak=settings.leak)


def _recursion(settings: Settings) -> Recursion:
    return Recursion(interaction=MIXING)


ESTIMATOR = BankEstimator(
    name="sbf",
    summary="soft bound filter: an IMM over modes that may have ended",
    source="Sigalov 2011, section III",
    settings=Settings,
    recursion=_recursion,
    limits={"continuation_probability": (0.0, 1.0), "leak": (0.0, 1.0)},
    bound=_bound,
)
