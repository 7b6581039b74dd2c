"""Tables in, matplotlib Figures out: which figures there are, and their files."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from hybridtrack.courses import draw_error, draw_final_mode, draw_modes, draw_ratios
from hybridtrack.curves import Table, split_cases
from hybridtrack.errors import UserError
from hybridtrack.page import (
    COLOURS,
    DASHES,
    RAW_COLOUR,
    TRUTH_COLOUR,
    Look,
    Looks,
    RunInformation,
    finish,
    panels,
    plain,
    save_one,
    style,
)
from hybridtrack.set_courses import draw_bounds, draw_models, draw_points, draw_sets
from hybridtrack.trajectories import draw_trajectory

__all__ = ["RunInformation", "draw", "save"]


def draw(
    steps: Table, tracks: Table, information: RunInformation, reliability: Table | None = None
) -> dict[str, Figure]:
    """Draw what the tables of a run folder hold; a figure whose data are absent is left out.

    Args:
        steps: long, columns case, estimator, step, time_s, metric, value, standard_error.
        tracks: long, columns case, run, estimator, step, time_s, quantity, value (SI units).
        information: title, number of runs, the order of estimators and modes, what is compared.
        reliability: columns estimator, from_probability, to_probability, share_of_steps,
            mean_probability, frequency, standard_error; if there are any.

    Returns:
        Figures by name: trajectory (of the first run in `tracks`), position_error,
        velocity_error, error_ratio, mode_probability, mode_likelihood, final_mode_probability and
        reliability; of sets sets, bound, operating_points and model_chosen. With several cases the
        figures over time are drawn for each of the first six, and their names end in `-CASE`.
    """
    with style():
        looks = _looks(steps, tracks, information)
        figures = {"trajectory": draw_trajectory(tracks, looks, information)}
        for case in split_cases(steps, information.title):
            for quantity in ("position", "velocity"):
                figure = draw_error(case, quantity, looks, information)
                figures[f"{quantity}_error{case.suffix}"] = figure
            figures["error_ratio" + case.suffix] = draw_ratios(case, looks, information)
            for metric in ("mode_probability", "mode_likelihood"):
                figures[metric + case.suffix] = draw_modes(case, metric, looks, information)
            name = "final_mode_probability"
            figures[name + case.suffix] = draw_final_mode(case, looks, information)
            figures["sets" + case.suffix] = draw_sets(case, tracks, looks, information)
            figures["bound" + case.suffix] = draw_bounds(case, looks, information)
            figures["operating_points" + case.suffix] = draw_points(case, looks, information)
            figures["model_chosen" + case.suffix] = draw_models(case, tracks, looks, information)
        if reliability is not None:
            figures["reliability"] = _draw_reliability(reliability, looks, information)
    return {name: figure for name, figure in figures.items() if figure is not None}


def save(figures: Mapping[str, Figure], folder: Path) -> list[Path]:
    """Write each figure to `folder`/NAME.png, whole or not at all; the folder is made if missing.

    The same tables give the same bytes: the PNG carries neither date nor software. Raises
    UserError where the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return [save_one(figure, folder / f"{name}.png") for name, figure in figures.items()]
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise UserError(
            f"{folder}: figures cannot be written here ({reason}); make room or name another folder"
        ) from None


def _looks(steps: Table, tracks: Table, information: RunInformation) -> dict[str, Look]:
    """Colour and dashes by the scenario's order of estimators; the raw measurements come first."""
    names = dict.fromkeys([*information.estimators, *steps["estimator"], *tracks["estimator"]])
    others = ("raw", "truth", "measurement", "noise_free")
    estimators = [name for name in names if name not in others]
    n = len(COLOURS)
    return {"raw": Look("measurements", RAW_COLOUR, (0, (1, 1)))} | {
        name: Look(plain(name, 60), COLOURS[i % n], DASHES[(i + i // n) % n])
        for i, name in enumerate(estimators)
    }


def _draw_reliability(table: Table, looks: Looks, information: RunInformation) -> Figure | None:
    """Frequencies over the probabilities that foretold them; below, how often each was given."""
    names = [name for name in looks if name in set(table["estimator"])]
    if not names:
        return None
    figure, (ax, below) = panels(2, 1, 3.6, sharey=False, heights=(3, 1))
    ax.plot([0, 1], [0, 1], color=TRUTH_COLOUR, linewidth=0.7, zorder=0.5)
    for i, name in enumerate(names):
        mine = np.asarray(table["estimator"]) == name
        columns = ("mean_probability", "frequency", "standard_error", "share_of_steps")
        given, came, error, share = (np.asarray(table[column])[mine] for column in columns)
        look = looks[name]
        style: dict[str, Any] = {"color": look.colour, "linestyle": look.dashes, "clip_on": False}
        ax.errorbar(given, came, 2 * error, marker="o", markersize=3, label=look.label, **style)
        edges = np.asarray(table["from_probability"])[mine]
        width = (edges[1] - edges[0]) / (len(names) + 1)
        below.bar(edges + (i + 1) * width, share, width, color=look.colour)
    ax.set(xlim=(0, 1), ylim=(-0.02, 1.02), ylabel="share that was the last")
    below.set(xlabel="probability that the mode now is the last one", ylabel="share of\nsteps")
    below.set_ylim(bottom=0.0)
    errors = np.isfinite(np.asarray(table["standard_error"], dtype=float)).any()
    caption = f"Reliability over {information.runs:,} run{'s' * (information.runs != 1)}"
    caption += "; bars: ±2 standard errors" * bool(errors)
    finish(figure, information.title, caption, [])
    return figure
