"""What there is to choose from, by name, with a line each."""

from hybridtrack.analyses import analyses
from hybridtrack.config import shipped
from hybridtrack.containment import set_metrics
from hybridtrack.estimators import estimators
from hybridtrack.motion import MOTION_MODELS
from hybridtrack.statistics import CALIBRATION, FALSE_SWITCHES, METRICS


def catalogue() -> dict[str, dict[str, str]]:
    """Kinds of things, their names and summaries."""
    return {
        "estimators": {name: e.summary for name, e in estimators().items()},
        "motions": {name: m.summary.rstrip(".") for name, m in MOTION_MODELS.items()},
        "analyses": {name: one.summary for name, one in analyses().items()},
        "metrics": {name: m.summary for name, m in METRICS.items()}
        | {
            CALIBRATION: "mean distance of that probability from how often it came true (ECE)",
            FALSE_SWITCHES: "how often the mode estimate leaves the true mode, per stay in it",
        }
        | {name: m.summary for name, m in set_metrics(("STATE",), ("MODEL",)).items()},
        "scenarios": {name: _title(name) for name in shipped()},
    }


def _title(name: str) -> str:
    from hybridtrack.config import read

    title = read(shipped()[name]).data.get("title", "")
    return str(title)
