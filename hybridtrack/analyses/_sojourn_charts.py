"""The sojourn analysis as charts: the filters' powers, and the worst of the simulated runs."""

import math

import numpy as np

from hybridtrack.analyses._eigenstructure import power_bound
from hybridtrack.analyses._findings import Chart, Line, Mark, Panel
from hybridtrack.analyses._sojourn_bounds import PowerNorms
from hybridtrack.analyses._sojourn_study import Study
from hybridtrack.models import Array

MOST_DRAWN = 2000  # points of a curve
SMALLEST_DRAWN = 1e-200  # of what is left of an error


def charts(study: Study) -> list[Chart]:
    """What a filter's error may do after a switch, and the worst of the simulated runs."""
    found = [_powers_chart(study)]
    if study.simulated:
        found.append(_worst_run_chart(study))
    return found


def _powers_chart(study: Study) -> Chart:
    """||F_m^t|| and the paper's k alpha^t, beside mu^t."""
    steps = min(max(4 * study.direct.decay_steps, 20), MOST_DRAWN)
    steps = min(steps, int(math.log(SMALLEST_DRAWN) / math.log(study.rate)) + 1)
    transitions = np.stack([one.transition for one in study.filters])
    t = np.arange(float(steps))
    allowed = study.rate**t
    norms = PowerNorms(transitions, study.rate).until(steps) * allowed[:, np.newaxis]
    lines = [Line("mu^t", t, allowed, reference=True)]
    for name, norm, structure in zip(study.names, norms.T, study.structures, strict=True):
        lines.append(Line(name, t, _drawable(norm)))
        by_paper = np.array([power_bound(structure, i) for i in range(steps)])
        lines.append(Line(f"{name}, k alpha^t", t, _drawable(by_paper)))
    marks = (Mark("shortest sojourn without a delay", x=float(study.direct.decay_steps)),)
    return Chart(
        "sojourn_powers",
        "How much of an error a filter has left after so many steps in its own mode",
        "steps since a switch was noticed",
        (Panel("of the error", lines, marks=marks, log_y=True),),
    )


def _worst_run_chart(study: Study) -> Chart:
    """The error's norm in the run that went furthest, with mu^t and k_t mu^t."""
    sojourn, runs = study.simulated[-1]
    k = np.arange(float(min(len(runs.worst), MOST_DRAWN)))
    start = float(runs.worst[0])
    allowed = study.rate**k * start + study.error_bound
    growth = max(study.direct.growth)
    envelope = growth * allowed
    time_s = k * study.step_s
    floor = "" if study.error_bound == 0.0 else " + M0"
    lines = [
        Line(f"mu^k{floor}", time_s, allowed, reference=True),
        Line(f"what may happen between, {growth:.3g} times that", time_s, envelope),
        Line("mean error", time_s, _drawable(runs.worst[: len(k)])),
    ]
    return Chart(
        "sojourn_worst_run",
        f"The worst of the simulated runs with sojourns of at least {sojourn} steps",
        "time, s",
        (Panel("norm of the mean error", lines, log_y=True),),
    )


def _drawable(values: Array) -> Array:
    """What a logarithmic axis can show."""
    shown: Array = np.where((values > 0.0) & np.isfinite(values), values, np.nan)
    return shown
