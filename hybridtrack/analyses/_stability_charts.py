"""What was found about a bank's stability, as charts: plain numbers, drawn elsewhere."""

import math

import numpy as np

from hybridtrack.analyses._examination import Stability
from hybridtrack.analyses._findings import Band, Chart, Line, Mark, Panel
from hybridtrack.analyses._stability_words import near_one, stds

DRAWN_STEPS = 100


def bounds_chart(found: Stability) -> Chart:
    simulated = stds(found.run.covariances[: DRAWN_STEPS + 1])
    k = np.arange(len(simulated), dtype=np.float64)
    low, high = found.floor.matrix, found.ceiling.matrix
    panels = []
    for e, state in enumerate(found.bank.states):
        lines = [Line(name, k, simulated[:, j, e]) for j, name in enumerate(found.bank.modes)]
        bands, marks = [], []
        if low is not None and high is not None:
            floor, ceiling = (np.full_like(k, stds(bound)[e]) for bound in (low, high))
            bands.append(Band("floor to ceiling", k, floor, ceiling))
        else:
            for name, bound in (("floor", low), ("ceiling", high)):
                if bound is not None:
                    marks.append(Mark(name, y=float(stds(bound)[e])))
        panels.append(Panel(f"std of {state}", lines, bands, marks))
    origin = "given" if found.spread_given else "simulated"
    return Chart(
        "stability_bounds",
        f"Standard deviations of the modes' filters; the ceiling holds for the {origin} spread",
        "step",
        panels,
    )


def decay_chart(found: Stability) -> Chart:
    logs = found.logs[: DRAWN_STEPS + 1]
    k = np.arange(len(logs), dtype=np.float64)
    # What is gone entirely leaves the curve, and 1e-300 is as good as gone.
    norms = np.where(logs > -690.0, np.exp(np.clip(logs, -690.0, 690.0)), np.nan)
    lines = [Line("largest ||e(k)|| from ||e(0)|| = 1", k, norms)]
    rate = found.rate
    if rate is not None and rate.per_step > 0.0:
        decay = np.exp(np.clip(k * math.log(rate.per_step), -690.0, 690.0))
        lines.append(Line(f"simulated rate {rate.per_step:.3g}", k, decay, reference=True))
    one = found.certificate
    if one is not None:
        certified = np.exp(-k / one.time_constant_steps)
        lines.append(Line(f"certified rate {near_one(one.rate, one.short)}", k, certified))
    if found.one_step_loss is not None and found.one_step_loss < 1.0:
        ours = np.exp(np.maximum(k * math.log1p(-found.one_step_loss) / 2, -690.0))
        lines.append(Line("one-step rate (ours)", k, ours))
    return Chart(
        "stability_decay",
        "How the IMM forgets its start: worst errors of the homogeneous system, and rates",
        "step",
        (Panel("||e||", lines, log_y=True),),
    )
