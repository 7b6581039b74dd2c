"""The figures of the analysis of operating points."""

import numpy as np

from hybridtrack.analyses import Chart, Line, Mark, Panel
from hybridtrack.analyses._operating_design import Design
from hybridtrack.analyses._procedure import profile

MOST_LINES = 6
FARTHEST_PERCENT = 100.0


def charts(design: Design) -> list[Chart]:
    """The error over the range; and where local solvers end, as figures 2 and 3 of the paper."""
    found = [_error(design, i) for i in range(len(design.over.low))]
    if design.study:
        found += [_ends(design), _shares(design)]
    return found


def _error(design: Design, state: int) -> Chart:
    """The bank's error along a state, for each number of points."""
    states = design.procedure.function.states
    lines = []
    for step in design.steps[:MOST_LINES]:
        points = step.placement.points
        x, y = profile(design.procedure, design.over, points, state)
        lines.append(Line(f"{len(points)} point{'s' * (len(points) > 1)}", x, y))
    several = len(states) > 1
    name = f"linearisation_error_{states[state]}" if several else "linearisation_error"
    others = ", worst over the other states" * several
    caption = f"Linearisation error over the range of {states[state]}{others}"
    label = _with(states[state], design.procedure.system.units.get(states[state], ""))
    panel = Panel(_with("error of the\nbest model", design.error_unit), lines)
    return Chart(name, caption, label, [panel])


def _with(words: str, unit: str) -> str:
    return f"{words} ({unit})" if unit else words


def _ends(design: Design) -> Chart:
    """Figure 2: the objective at the solutions, in ascending order."""
    optimum = design.studied
    scale = design.procedure.largest_curvature(design.over)
    lines = []
    for one in design.study:
        values = np.sort(one.worst_errors) / scale
        share = np.arange(1, len(values) + 1, dtype=float)
        lines.append(Line(one.solver, share, values, steps="pre"))
    all_of_them = np.array([1.0, float(design.starts)])
    level = np.full(2, 1.1 * optimum / scale)
    lines.append(Line(f"110 % of the {design.best}", all_of_them, level, reference=True))
    caption = f"Objective where {design.starts:,} local starts end, in ascending order"
    panel = Panel("normalised\nworst error", lines, log_y=True)
    return Chart("local_starts", caption, "start", [panel])


def _shares(design: Design) -> Chart:
    """Figure 3: the share of starts within a percentage of the optimum."""
    optimum = design.studied
    percent = np.linspace(0.0, FARTHEST_PERCENT, 401)
    lines = [
        Line(one.solver, percent, np.array([one.share_within(p, optimum) for p in percent]))
        for one in design.study
    ]
    panel = Panel("share of starts", lines, (), [Mark("10 %", x=10.0)], y_limits=(-0.02, 1.02))
    caption = f"Share of local starts that end within a percentage of the {design.best}"
    return Chart("share_of_starts", caption, f"per cent above the {design.best}", [panel])
