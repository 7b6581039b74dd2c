"""What was found about a bank's stability, as charts: plain numbers, drawn elsewhere."""

import math

import numpy as np

from hybridtrack.analyses._examination import Stability
from hybridtrack.analyses._findings import Band, Chart, Line, Panel
from hybridtrack.analyses._riccati import Bound
from hybridtrack.analyses._stability_words import near_one, stds
from hybridtrack.models import Array

DRAWN_STEPS = 100
FACTOR = "up to a constant factor"


def bounds_chart(found: Stability) -> Chart:
    """The bounds due at each step: the settled ones hold only later."""
    simulated = stds(found.run.covariances[: DRAWN_STEPS + 1])
    k = np.arange(len(simulated), dtype=np.float64)
    low, high = (_over_time(bound, len(k)) for bound in (found.floor, found.ceiling))
    both = ~np.isnan(low + high).any(axis=1)
    tops = [simulated.max(axis=(0, 1))]
    if found.ceiling.matrix is not None:
        tops.append(stds(found.ceiling.matrix))
    top = 1.1 * np.max(tops, axis=0)
    panels = []
    for e, state in enumerate(found.bank.states):
        lines = [Line(name, k, simulated[:, j, e]) for j, name in enumerate(found.bank.modes)]
        bands = []
        if both.any():
            bands.append(Band("floor to ceiling", k[both], low[both, e], high[both, e]))
        else:
            for name, bound in (("floor", low), ("ceiling", high)):
                if not np.isnan(bound).all():
                    lines.append(Line(name, k, bound[:, e], reference=True))
        # A ceiling begins far above all that follows, and would press it down.
        limits = (0.0, float(top[e])) if top[e] > 0.0 else None
        panels.append(Panel(f"std of {state}", lines, bands, y_limits=limits))
    origin = "given" if found.spread_given else "simulated"
    return Chart(
        "stability_bounds",
        f"Standard deviations of the modes' filters; the ceiling holds for the {origin} spread",
        "step",
        panels,
    )


def _over_time(bound: Bound, n: int) -> Array:
    """The standard deviations (n, n_x) due at steps 0 .. n - 1; NaN where there is no bound."""
    due = np.full((n, bound.path.shape[-1]), np.nan)
    steps = np.arange(bound.first, n)
    if len(bound.path) and len(steps):
        due[steps] = stds(bound.at(steps))
    return due


def decay_chart(found: Stability) -> Chart:
    logs = found.logs[: DRAWN_STEPS + 1]
    k = np.arange(len(logs), dtype=np.float64)
    # What is gone entirely leaves the curve, and 1e-300 is as good as gone.
    norms = np.where(logs > -690.0, np.exp(np.clip(logs, -690.0, 690.0)), np.nan)
    lines = [Line("largest ||e(k)|| from ||e(0)|| = 1", k, norms)]
    rate = found.one_rate
    if rate is not None and rate > 0.0:
        decay = np.exp(np.clip(k * math.log(rate), -690.0, 690.0))
        label = f"simulated rate {near_one(rate, 1 - rate)}"
        lines.append(Line(label, k, decay, reference=True))
    # Both are of V, which lies between ||e||^2 times two constants, and hold once the bounds do.
    one = found.certificate
    if one is not None:
        certified = np.exp(-k / one.time_constant_steps)
        label = f"certified rate {near_one(one.rate, one.short)}, {FACTOR}"
        lines.append(Line(label, k, certified))
    if found.one_step_loss is not None and found.one_step_loss < 1.0:
        ours = np.exp(np.maximum(k * math.log1p(-found.one_step_loss) / 2, -690.0))
        lines.append(Line(f"one-step rate (ours), {FACTOR}", k, ours))
    return Chart(
        "stability_decay",
        "How the IMM forgets its start: worst errors of the homogeneous system, and rates",
        "step",
        (Panel("||e||", lines, log_y=True),),
    )
