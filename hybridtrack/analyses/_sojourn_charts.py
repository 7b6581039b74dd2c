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
SMALLEST_RATIO = 1e-3  # of an error to what is claimed of it: less has no room to break the claim
SOJOURNS_DRAWN = 3  # of the worst run, at least
MOST_SWITCHES = 50  # marked in a run
SAME_CURVE = 1e-3  # relative: curves that differ by less can't be told apart


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
    lines = []
    for name, norm, structure in zip(study.names, norms.T, study.structures, strict=True):
        lines.append(Line(name, t, _drawable(norm)))
        by_paper = np.array([power_bound(structure, i) for i in range(steps)])
        lines.append(Line(f"{name}, k alpha^t", t, _drawable(by_paper)))
    claim = Line("mu^t", t, allowed, reference=True)
    marks = (Mark("shortest sojourn without a delay", x=float(study.direct.decay_steps)),)
    return Chart(
        "sojourn_powers",
        "How much of an error a filter has left after so many steps in its own mode",
        "steps since a switch was noticed",
        (Panel("left of an error's norm", [claim, *_apart(lines)], marks=marks, log_y=True),),
    )


def _worst_run_chart(study: Study) -> Chart:
    """The error's norm in the run that went furthest, as a multiple of what is claimed of it."""
    sojourn, runs = study.simulated[-1]
    k = np.arange(float(min(len(runs.worst), MOST_DRAWN)))
    start, growth = float(runs.worst[0]), max(study.direct.growth)
    ratio = runs.worst[: len(k)] / (study.rate**k * start + study.error_bound)
    last = int(np.flatnonzero(ratio >= SMALLEST_RATIO)[-1])
    k = k[: max(last + 2, SOJOURNS_DRAWN * sojourn)]
    claim = _claim(start, study.error_bound)
    time_s, ratio = k * study.step_s, ratio[: len(k)]
    lines = [
        Line(claim, time_s, np.ones(len(k)), reference=True),
        Line(f"what may happen between, {growth:.3g} times that", time_s, np.full(len(k), growth)),
        Line("mean error", time_s, _drawable(ratio)),
    ]
    noticed = runs.switches[runs.switches < len(k)][:MOST_SWITCHES] * study.step_s
    return Chart(
        "sojourn_worst_run",
        f"The worst of the simulated runs with sojourns of at least {sojourn} steps, beside what "
        "its error shall be at the switches",
        "time, s",
        (
            Panel(
                f"mean error's norm over\n{claim}",
                lines,
                marks=[Mark("a switch is noticed", x=time) for time in noticed.tolist()],
                log_y=True,
                y_limits=(SMALLEST_RATIO, 2.0 * max(growth, float(ratio.max()))),
            ),
        ),
    )


def _claim(start: float, error_bound: float) -> str:
    """What the error of a run is held against."""
    if start == 0.0:
        return "M0"
    decays = "mu^k" if start == 1.0 else "mu^k ||e0||"
    return decays if error_bound == 0.0 else f"{decays} + M0"


def _apart(lines: list[Line]) -> list[Line]:
    """The lines, of those that lie on one another the first alone, with all of their labels."""
    found: list[Line] = []
    for line in lines:
        for i, other in enumerate(found):
            if np.allclose(line.y, other.y, rtol=SAME_CURVE, atol=0.0, equal_nan=True):
                found[i] = other._replace(label=f"{other.label} = {line.label}")
                break
        else:
            found.append(line)
    return found


def _drawable(values: Array) -> Array:
    """What a logarithmic axis can show."""
    shown: Array = np.where((values > 0.0) & np.isfinite(values), values, np.nan)
    return shown
