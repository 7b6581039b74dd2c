"""Figures over time: errors, their ratios, probabilities of modes and of the last mode."""

import math
from collections.abc import Iterable, Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from hybridtrack.curves import (
    Array,
    Case,
    Curve,
    Truth,
    broken_at_gaps,
    chosen_curves,
    mode_names,
    switch_times,
)
from hybridtrack.page import (
    TRUTH_COLOUR,
    Look,
    Looks,
    RunInformation,
    finish,
    panels,
    plain,
    plain_numbers,
    plot_curve,
    plot_line,
)

LOG_SCALE_RATIO = 15.0
LEAVES_THE_FRAME = 1e5  # a curve this many times the best one's median has nothing left to tell
RATIO_LOG_SCALE = 5.0
HOPELESS = 100.0  # a curve whose own median is so many times the best's is named, not drawn
NEARLY_AS_GOOD = 1.3  # ratios whose median is within this of the best's make the frame
TRUE_MODE_COLOUR, SWITCH_COLOUR = "0.88", "0.6"

# By what errors are and of what: metric, and unit of the axis.
ERRORS = {
    ("rmse", "position"): ("position_rmse_m", "m"),
    ("rmse", "velocity"): ("velocity_rmse_m_s", "m/s"),
    ("mse", "position"): ("position_mse_m2", "m²"),
    ("mse", "velocity"): ("velocity_mse_m2_s2", "m²/s²"),
}
ERROR_NAMES = {"rmse": "RMS", "mse": "mean square"}


def draw_error(
    case: Case, quantity: str, looks: Looks, information: RunInformation
) -> Figure | None:
    metric, unit = ERRORS[information.error, quantity]
    curves, beyond = _worth_drawing(chosen_curves(case.curves, metric, looks))
    if not curves:
        return None
    figure, (ax,) = panels(1, 1, 3.0)
    for name, curve in curves.items():
        plot_curve(ax, curve, looks[name])
    _mark_switches(ax, switch_times(case.truth))
    leaving = beyond + _scale_error(ax, {name: curve.value for name, curve in curves.items()})
    _frame_time([ax], curves.values(), case.truth)
    name = ERROR_NAMES[information.error]
    ax.set_ylabel(f"{quantity} {name} error ({unit})")
    caption = f"{name[0].upper() + name[1:]} {_over(curves.values(), information.runs)}"
    finish(figure, case.title, caption, leaving)
    return figure


def _worth_drawing(curves: Mapping[str, Curve]) -> tuple[dict[str, Curve], list[str]]:
    """The curves that are not hopeless beside the best one, and the names of those that are."""
    middle = {name: float(np.nanmedian(curve.value)) for name, curve in curves.items()}
    limit = HOPELESS * min(middle.values(), default=math.nan)
    beyond = [name for name in curves if middle[name] > limit > 0.0]
    return {name: curve for name, curve in curves.items() if name not in beyond}, beyond


def draw_ratios(case: Case, looks: Looks, information: RunInformation) -> Figure | None:
    """Errors over those of one estimator: what tells estimators apart that are nearly as good."""
    drawn = {
        quantity: curves
        for quantity in ("position", "velocity")
        if (curves := chosen_curves(case.curves, f"{quantity}_{information.error}_ratio", looks))
    }
    if not drawn or information.compare_with is None:
        return None
    figure, axes = panels(len(drawn), 1, 0.4 + 2.1 * len(drawn), sharey=False)
    leaving: dict[str, list[str]] = {}
    for ax, quantity in zip(axes, drawn, strict=True):
        curves, beyond = _worth_drawing(drawn[quantity])
        drawn[quantity] = curves
        ax.axhline(1.0, color=TRUTH_COLOUR, linewidth=0.7, zorder=0.5)
        leaves = beyond + _scale_ratio(ax, curves)
        for name, curve in curves.items():
            if _is_inside(ax, curve):
                plot_curve(ax, curve, looks[name])
        _mark_switches(ax, switch_times(case.truth))
        leaving |= {name: [*leaving.get(name, []), quantity] for name in leaves}
        ax.set_ylabel(f"{quantity} error ratio")
    every = [curve for curves in drawn.values() for curve in curves.values()]
    _frame_time(axes[-1:], every, case.truth)
    name = ERROR_NAMES[information.error]
    caption = f"Ratio of {name} errors to {information.compare_with}'s, over the same "
    caption += _over(every, information.runs).removeprefix("over ")
    gone = [n if len(k) == len(drawn) else f"{n} ({', '.join(k)})" for n, k in leaving.items()]
    finish(figure, case.title, caption, gone)
    return figure


def draw_modes(case: Case, metric: str, looks: Looks, information: RunInformation) -> Figure | None:
    """One panel per mode on shared axes, so that a panel compares the estimators."""
    named = mode_names((name for _, name in case.curves), metric)
    modes = dict.fromkeys([*information.modes, *named])
    by_mode = {mode: chosen_curves(case.curves, f"{metric}:{mode}", looks) for mode in modes}
    by_mode = {mode: curves for mode, curves in by_mode.items() if curves}
    if not by_mode:
        return None
    columns = 1 if len(by_mode) <= 3 else 2
    rows = math.ceil(len(by_mode) / columns)
    height = 0.4 + 1.5 * rows + 0.35 * (len(by_mode) % columns)  # an odd one needs a second x-axis
    figure, axes = panels(rows, columns, height)
    for unused in axes[len(by_mode) :]:
        unused.remove()
    axes = axes[: len(by_mode)]
    for ax, (mode, curves) in zip(axes, by_mode.items(), strict=True):
        _show_true_mode(ax, case.truth, mode)
        for estimator, curve in curves.items():
            plot_curve(ax, curve, looks[estimator])
        ax.set_title(plain(mode, 60), loc="left")
    drawn = [curve for curves in by_mode.values() for curve in curves.values()]
    _frame_time(axes[-columns:], drawn, case.truth)
    axes[0].set_ylim(-0.02, 1.02 * max(1.0, *(np.nanmax(curve.value) for curve in drawn)))
    for ax in axes[::columns]:
        ax.set_ylabel(metric.replace("_", " "))
    name = {"mode_likelihood": "normalised mode likelihood"}.get(metric, "mode probability")
    finish(figure, case.title, f"Mean {name} {_over(drawn, information.runs)}", [])
    return figure


def draw_final_mode(case: Case, looks: Looks, information: RunInformation) -> Figure | None:
    """How likely the mode now is the last one: by the scans, and by the time alone."""
    curves = chosen_curves(case.curves, "final_mode_probability", looks)
    if not curves:
        return None
    figure, (ax,) = panels(1, 1, 2.6)
    for name, curve in curves.items():
        plot_curve(ax, curve, looks[name])
        prior = case.curves.get((name, "final_mode_prior"))
        if prior is not None:
            label = f"{looks[name].label}, before any scan"
            plot_line(ax, prior.time, prior.value, Look(label, looks[name].colour, (0, (1, 2))))
    truth = case.curves.get(("truth", "final_mode_probability"))
    if truth is not None:
        look = Look("truth: share of runs", TRUTH_COLOUR, (0, (4, 3)))
        plot_line(ax, truth.time, truth.value, look)
    _frame_time([ax], curves.values(), case.truth)
    ax.set(ylim=(-0.02, 1.02), ylabel="probability")
    over = _over(curves.values(), information.runs)
    finish(figure, case.title, f"Mean probability that the mode now is the last one, {over}", [])
    return figure


def _scale_error(ax: Axes, values: Mapping[str, Array]) -> list[str]:
    """A log scale if one curve would squash the others; returns the curves that leave the frame."""
    ax.set_ylim(bottom=0.0)
    ax.yaxis.set_major_formatter(plain_numbers())
    positive = [value[value > 0] for value in values.values() if (value > 0).any()]
    best = min((float(np.median(value)) for value in positive), default=math.inf)
    highest = max((float(value.max()) for value in positive), default=0.0)
    if highest <= LOG_SCALE_RATIO * best:
        return []
    low = 0.8 * max(min(float(value.min()) for value in positive), best / 100)
    high = 1.25 * min(highest, LEAVES_THE_FRAME * best)
    _set_log_scale(ax, low, high)
    return [name for name, value in values.items() if (value > high).any()]


def _scale_ratio(ax: Axes, curves: Mapping[str, Curve]) -> list[str]:
    """A frame about what is nearly as good as the best; returns the curves that leave it for long.

    A few steps may go beyond it, such as the first after a start that is known exactly.
    """
    middle = {name: float(np.nanmedian(curve.value)) for name, curve in curves.items()}
    near = [
        curves[name].value
        for name, m in middle.items()
        if m <= NEARLY_AS_GOOD * min(middle.values())
    ]
    low = min(1.0, *(float(np.nanquantile(value, 0.02)) for value in near))
    high = max(1.0, *(float(np.nanquantile(value, 0.98)) for value in near))
    if high > RATIO_LOG_SCALE:
        low, high = max(low, 1e-3) / 1.2, 1.2 * high
        _set_log_scale(ax, low, high)
    else:
        room = 0.08 * max(high - low, 1e-3)
        low, high = low - room, high + room
        ax.set_ylim(low, high)
        ax.yaxis.set_major_formatter(plain_numbers())
    return [
        name
        for name, curve in curves.items()
        if ((curve.value < low) | (curve.value > high)).mean() > 0.05
    ]


def _is_inside(ax: Axes, curve: Curve) -> bool:
    """Whether more than a few points of a curve lie in the frame: else its legend says nothing."""
    low, high = ax.get_ylim()
    return bool(((curve.value >= low) & (curve.value <= high)).mean() > 0.05)


def _set_log_scale(ax: Axes, low: float, high: float) -> None:
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 3000 * low else (1,)))
    ax.yaxis.set_major_formatter(plain_numbers())
    ax.yaxis.set_minor_formatter(NullFormatter())


def _over(curves: Iterable[Curve], runs: int) -> str:
    curves = list(curves)
    bands = any(np.isfinite(curve.standard_error).any() for curve in curves)
    steps = max(curve.pooled for curve in curves)
    said = f"over {runs:,} run{'s' * (runs != 1)}"
    said += f" and {steps} steps a point" * (steps > 1)
    return said + "; bands: ±2 standard errors" * bands


def _mark_switches(ax: Axes, times: Array) -> None:
    if len(times):
        width = 0.8 if len(times) <= 40 else 0.4
        transform = ax.get_xaxis_transform()
        lines = ax.vlines(times, 0, 1, SWITCH_COLOUR, linewidth=width, transform=transform)
        lines.set(zorder=0.5, label="mode switch", gid="mode switch")


def _show_true_mode(ax: Axes, truth: Truth | None, mode: str) -> None:
    """Shade the stays of a fixed truth in `mode`; dash the share of runs if the truth is random."""
    if truth is None or mode not in truth.modes:
        return
    share = truth.share[:, truth.modes.index(mode)]
    if truth.fixed:
        transform = ax.get_xaxis_transform()
        inside = np.nan_to_num(share)
        shade = ax.stairs(inside, truth.edges, fill=True, transform=transform)
        shade.set(facecolor=TRUE_MODE_COLOUR, zorder=0.5, label="true mode", gid="true mode")
    else:
        time, share = broken_at_gaps(truth.edges[1:], share)
        plot_line(ax, time, share, Look("truth: share of runs", TRUTH_COLOUR, (0, (4, 3))))


def _frame_time(bottom: Iterable[Axes], curves: Iterable[Curve], truth: Truth | None) -> None:
    edges = [] if truth is None else [truth.edges]
    times = np.concatenate([*(curve.time for curve in curves), *edges])
    for ax in bottom:
        ax.set_xlabel("time (s)")
        ax.tick_params(labelbottom=True)
        if np.ptp(times) > 0:
            ax.set_xlim(times.min(), times.max())
