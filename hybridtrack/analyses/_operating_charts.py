"""The figures of the analysis of operating points."""

from typing import TYPE_CHECKING

import numpy as np

from hybridtrack.analyses import Chart, Line, Mark, Panel
from hybridtrack.analyses._procedure import profile

if TYPE_CHECKING:
    from hybridtrack.analyses.operating_points import Said

MOST_LINES = 6
FARTHEST_PERCENT = 100.0


def charts(said: "Said") -> list[Chart]:
    """The error over the range; and where local solvers end, as figures 2 and 3 of the paper."""
    found = [_error(said, i) for i in range(len(said.over.low))]
    if said.study:
        found += [_ends(said), _shares(said)]
    return found


def _error(said: "Said", state: int) -> Chart:
    """The bank's error along a state, for each number of points."""
    states = said.procedure.function.states
    lines = []
    for step in said.steps[:MOST_LINES]:
        points = step.placement.points
        x, y = profile(said.procedure, said.over, points, state)
        lines.append(Line(f"{len(points)} point{'s' * (len(points) > 1)}", x, y))
    several = len(states) > 1
    name = f"linearisation_error_{states[state]}" if several else "linearisation_error"
    others = ", worst over the other states" * several
    caption = f"Linearisation error over the range of {states[state]}{others}"
    return Chart(name, caption, states[state], [Panel("error of the\nbest model", lines)])


def _ends(said: "Said") -> Chart:
    """Figure 2: the objective at the solutions, in ascending order."""
    optimum = said.steps[said.settings.starts_points - 1].placement.worst_error
    scale = said.procedure.largest_curvature(said.over)
    lines = []
    for one in said.study:
        values = np.sort(one.worst_errors) / scale
        share = np.arange(1, len(values) + 1, dtype=float)
        lines.append(Line(one.solver, share, values, steps="pre"))
    marks = [Mark("optimum", y=optimum / scale), Mark("110 % of it", y=1.1 * optimum / scale)]
    caption = f"Objective where {said.settings.starts:,} local starts end, in ascending order"
    return Chart("local_starts", caption, "start", [Panel("normalised\nworst error", lines, (), marks)])


def _shares(said: "Said") -> Chart:
    """Figure 3: the share of starts within a percentage of the optimum."""
    optimum = said.steps[said.settings.starts_points - 1].placement.worst_error
    percent = np.linspace(0.0, FARTHEST_PERCENT, 401)
    lines = [
        Line(one.solver, percent, np.array([one.share_within(p, optimum) for p in percent]))
        for one in said.study
    ]
    panel = Panel("share of starts", lines, (), [Mark("10 %", x=10.0)], y_limits=(-0.02, 1.02))
    caption = "Share of local starts that end within a percentage of the optimum"
    return Chart("share_of_starts", caption, "per cent above the optimum", [panel])
