"""Multiple-model adaptive estimation: filters that run alone, weighed by their likelihoods.

The mode probabilities are predicted by the transition matrix (Hwang 2006, eq. 6); with an
identity matrix it is the static bank. A bank without mixing loses a mode once its probability is
tiny or its filter has drifted away; Maybeck 1982, section 10.8, gives two remedies, both here.
"""

from typing import NamedTuple

from hybridtrack.estimators import BankEstimator
from hybridtrack.estimators._bank import NO_INTERACTION, Recursion
from hybridtrack.models import JumpMarkovModel
from hybridtrack.motion import white_acceleration_covariance


class Settings(NamedTuple):
    """Maybeck's remedies, both off by default.

    mode_probability_floor: smaller mode probabilities are raised to it, those of 0 too, and then
    all are normalised, so that they end a little below it;
    added_acceleration_std_m_s2: white acceleration added to every mode's process noise.
    """

    mode_probability_floor: float = 0.0
    added_acceleration_std_m_s2: float = 0.0


def _model(model: JumpMarkovModel, settings: Settings) -> JumpMarkovModel:
    if settings.added_acceleration_std_m_s2 == 0.0:
        return model
    added = white_acceleration_covariance(
        model.step_s, model.state_names, settings.added_acceleration_std_m_s2
    )
    return model._replace(process_noise_covariance=model.process_noise_covariance + added[:, None])


def _recursion(settings: Settings) -> Recursion:
    return Recursion(
        interaction=NO_INTERACTION, mode_probability_floor=settings.mode_probability_floor
    )


ESTIMATOR = BankEstimator(
    name="mmae",
    summary="multiple-model adaptive estimation (MMAE): no mixing",
    source="Maybeck 1982, chapter 10; Hwang, Balakrishnan, Tomlin 2006, eqs. 4-8",
    settings=Settings,
    model=_model,
    recursion=_recursion,
    limits={"mode_probability_floor": (0.0, 0.5), "added_acceleration_std_m_s2": (0.0, None)},
)
