"""The Kalman filter: one mode of the bank, always."""

from typing import NamedTuple

from hybridtrack.estimators import BankEstimator
from hybridtrack.estimators._bank import NO_INTERACTION, Recursion
from hybridtrack.models import JumpMarkovModel


class Settings(NamedTuple):
    """mode: the name of the one mode that is believed."""

    mode: str


def _model(model: JumpMarkovModel, settings: Settings) -> JumpMarkovModel:
    return model.only(settings.mode)


def _recursion(settings: Settings) -> Recursion:
    return Recursion(interaction=NO_INTERACTION)


ESTIMATOR = BankEstimator(
    name="kalman",
    summary="Kalman filter of one mode",
    source="Kalman 1960; Bar-Shalom, Li, Kirubarajan 2001, section 5.2",
    settings=Settings,
    model=_model,
    recursion=_recursion,
)
