"""Interacting multiple models: each filter starts every cycle from the mix of all."""

from typing import NamedTuple

from hybridtrack.estimators import BankEstimator
from hybridtrack.estimators._bank import MIXING, Recursion


class Settings(NamedTuple):
    """The IMM has no settings of its own."""


def _recursion(settings: Settings) -> Recursion:
    return Recursion(interaction=MIXING)


ESTIMATOR = BankEstimator(
    name="imm",
    summary="interacting multiple models (IMM)",
    source="Blom and Bar-Shalom 1988; Hwang, Balakrishnan, Tomlin 2006, eqs. 9-12",
    settings=Settings,
    recursion=_recursion,
)
