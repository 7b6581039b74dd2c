"""State transition diagrams of a scenario's Markov chains, as figure 1 of Sigalov 2011.

Drawn as figures are: on the Agg canvas, no global state changed, the same bytes for the same chain.
One unit of the axes is one inch of the page, so texts have sizes that can be laid out.
"""

import functools
import textwrap
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch
from matplotlib.path import Path
from matplotlib.textpath import TextPath

from hybridtrack.arrows import RADIUS, Arrow, lay_out, place_labels
from hybridtrack.chains import Bound, Supermodes
from hybridtrack.config import Experiment
from hybridtrack.errors import UserError
from hybridtrack.jumps import ChainTruth
from hybridtrack.models import Array, ModeBank
from hybridtrack.page import COLOURS, DPI, WIDTH_IN, style
from hybridtrack.simulation import step_lengths

MOST_SUPERMODES, MOST_ARROWS = 40, 100  # what can still be read

MARGIN, COLUMN = 0.15, 2.05  # around things; what a column's name may take
LABEL_PT, NAME_PT, HEADING_PT = 8.0, 9.0, 9.5
LINE = 1.25 / 72  # inches from line to line, per point of their size
HEIGHT = 0.76 / 72  # inches that a line's digits are high, per point


class Chain(NamedTuple):
    """A chain to be drawn."""

    owner: str  # as the caption names it
    mode_names: tuple[str, ...]
    supermodes: Supermodes  # at the first step
    bound: Bound
    step: str  # whose probabilities they are, in words


# ---- the chains of a scenario ----


def chains(experiment: Experiment) -> dict[str, Chain]:
    """Every chain of several supermodes by a name for its file: the truth's and the estimators'.

    The scenario's own chain, which many estimators share, is there once, as `modes`. Raises
    UserError where there is none, or one is too large.
    """
    if not experiment.bank.modes:
        raise UserError(f"{experiment.name}: there are no modes here, and so no chain to draw")
    found: dict[str, Chain] = {}
    truth = experiment.cases[0].truth
    if isinstance(truth, ChainTruth):
        found["truth"] = _chain("the truth", truth.bank, truth.bound, experiment)
    own = {
        c.label: _chain(c.label, c.bank, c.estimator.bound(c.settings), experiment)
        for c in experiment.estimators
    }
    plain = _chain("the modes", experiment.bank, Bound(), experiment)
    shared = [label for label, chain in own.items() if _same(chain, plain)]
    if shared:
        found["modes"] = plain._replace(owner=f"the modes ({', '.join(shared)})")
    for label, chain in own.items():
        if label not in shared:
            found[f"{label}_own" if label in found else label] = chain
    found = {name: chain for name, chain in found.items() if len(chain.supermodes.mode) > 1}
    if not found:
        raise UserError(
            f"{experiment.name}: there is no Markov chain of several modes to draw, neither the "
            "truth's nor a filter's; add an estimator of several modes, as imm or sbf"
        )
    for chain in found.values():
        _check_size(chain)
    return found


def _chain(owner: str, bank: ModeBank, bound: Bound, experiment: Experiment) -> Chain:
    """The chain at the first step of the first case."""
    steps_s = np.concatenate([step_lengths(case.times_s) for case in experiment.cases])
    first_s = steps_s[:1]
    uneven = not np.allclose(steps_s, first_s, rtol=1e-9, atol=0.0)
    model = bank.discretise(first_s, experiment.initial.mean, experiment.initial.covariance)
    step = f"a step of {first_s[0]:.4g} s"
    if uneven and bank.generator_per_s is not None:
        step = f"the first step, {first_s[0]:.4g} s (the steps are uneven)"
    elif uneven:
        step = "a step"
    chain = bound.supermodes(model.transition_matrix, model.initial_mode_probabilities)
    return Chain(owner, bank.names, chain, bound, step)


def _same(one: Chain, other: Chain) -> bool:
    if one.mode_names != other.mode_names:
        return False
    return all(map(np.array_equal, one.supermodes, other.supermodes))


def _check_size(chain: Chain) -> None:
    supermodes = len(chain.supermodes.mode)
    arrows = int(np.count_nonzero(chain.supermodes.transition_matrix[0]))
    if supermodes <= MOST_SUPERMODES and arrows <= MOST_ARROWS:
        return
    fewer = "a smaller most_transitions" if chain.bound.most_transitions else "fewer modes"
    raise UserError(
        f"the chain of {chain.owner} has {supermodes:,} supermodes and {arrows:,} arrows, and a "
        f"diagram shows at most {MOST_SUPERMODES} and {MOST_ARROWS}; draw a copy of the scenario "
        f"with {fewer}"
    )


# ---- drawing ----


def short(probability: float) -> str:
    """Four significant digits, and no 1 for what is only nearly so."""
    text = f"{probability:.4g}"
    if text == "1" and 1.0 - probability > 1e-12:
        text = f"1 − {1.0 - probability:.2g}"
    return text.replace("e-0", "e-")


@functools.lru_cache  # the same few probabilities and names again and again
def _size(text: str, points: float) -> Array:
    """Width and height of a text in inches, (2,)."""
    lines = text.replace("$", r"\$").split("\n")  # no mathematics
    width = max(TextPath((0, 0), line, size=points).get_extents().width for line in lines) / 72
    size = np.array([width, points * (LINE * (len(lines) - 1) + HEIGHT)])
    size.flags.writeable = False
    return size


def draw(chains: Mapping[str, Chain], title: str) -> dict[str, Figure]:
    """A state transition diagram of each chain, under the same names."""
    with style():
        return {name: _draw(chain, title) for name, chain in chains.items()}


def _draw(chain: Chain, title: str) -> Figure:
    figure = Figure(figsize=(WIDTH_IN, WIDTH_IN), dpi=DPI)
    FigureCanvasAgg(figure)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set_axis_off()
    centres, arrows = lay_out(chain.supermodes)
    sizes = np.stack([_size(short(arrow.probability), LABEL_PT) for arrow in arrows])
    labels = place_labels(arrows, centres, sizes)
    _draw_supermodes(ax, chain, centres)
    for arrow, label in zip(arrows, labels, strict=True):
        _draw_arrow(ax, arrow, label, int(chain.supermodes.mode[arrow.origin]))
    everything = [centres - RADIUS, centres + RADIUS, labels - sizes / 2, labels + sizes / 2]
    everything += [arrow.points for arrow in arrows]
    low, high = (f(np.concatenate(everything), axis=0) for f in (np.min, np.max))
    corners = _draw_edges(ax, chain, centres, low, high)
    heading = f"{textwrap.fill(title, 88)}\n{textwrap.fill(_caption(chain), 96)}"
    _frame(figure, ax, heading, corners)
    return figure


def _colour(mode: int, darker: float = 1.0) -> tuple[float, ...]:
    return tuple(darker * part for part in to_rgb(COLOURS[mode % len(COLOURS)]))


def _draw_supermodes(ax: Axes, chain: Chain, centres: Array) -> None:
    """Circles with the mode's name, or its number if names are too long, and the stage."""
    mode, stage, _, initial, _ = chain.supermodes
    for s, centre in enumerate(centres):
        edge: dict[str, Any] = {"edgecolor": _colour(int(mode[s])), "linewidth": 1.2}
        ax.add_patch(Circle(tuple(centre), RADIUS, facecolor="white", **edge))
        if initial[s] > 0.0:
            ax.add_patch(Circle(tuple(centre), RADIUS - 0.04, facecolor="none", **edge))
        text = _symbol(chain, mode[s]) + f"\n{stage[s]}" * _has_stages(chain)
        _write(ax, text, centre, _symbol_pt(chain) or NAME_PT)


def _symbol(chain: Chain, mode: int) -> str:
    return chain.mode_names[mode] if _symbol_pt(chain) else f"m{mode + 1}"


def _symbol_pt(chain: Chain) -> float | None:
    """The largest size at which all names fit into their circles; None if they never do."""
    for points in (NAME_PT, NAME_PT - 1.0, NAME_PT - 2.0):
        if all(_size(name, points)[0] < 1.45 * RADIUS for name in chain.mode_names):
            return points
    return None


def _has_stages(chain: Chain) -> bool:
    return bool(chain.supermodes.stage.any())


def _draw_arrow(ax: Axes, arrow: Arrow, label: Array, mode: int) -> None:
    """The arrow and its label in the colour of the mode that it leaves."""
    path = Path(arrow.curve, [Path.MOVETO, Path.CURVE4, Path.CURVE4, Path.CURVE4])
    ax.add_patch(
        FancyArrowPatch(
            path=path,
            arrowstyle="-|>,head_length=0.5,head_width=0.22",
            mutation_scale=11,
            color=_colour(mode),
            linewidth=1.0,
        )
    )
    _write(ax, short(arrow.probability), label, LABEL_PT, color=_colour(mode, 0.7))


def _write(ax: Axes, text: str, place: Array, points: float = NAME_PT, **look: Any) -> None:
    centred: dict[str, Any] = {"ha": "center", "va": "center"}
    ax.text(place[0], place[1], text, fontsize=points, parse_math=False, **(centred | look))


def _draw_edges(ax: Axes, chain: Chain, centres: Array, low: Array, high: Array) -> Array:
    """Modes above their columns, stages beside their rows; gives the corners with them (2, 2)."""
    corners = [low, high]
    if _has_stages(chain) or not _symbol_pt(chain):
        for x, mode in dict(zip(centres[:, 0], chain.supermodes.mode, strict=True)).items():
            name = chain.mode_names[mode]
            name = name if _symbol_pt(chain) else _wrapped(f"m{mode + 1}: {name}")
            place = np.array([x, high[1] + MARGIN])
            _write(ax, name, place, va="bottom")
            size = _size(name, NAME_PT)
            corners += [place + size * side for side in ((-0.5, 0.0), (0.5, 1.3))]
    if _has_stages(chain):
        for y, stage in dict(zip(centres[:, 1], chain.supermodes.stage, strict=True)).items():
            text = _stage(chain.bound, int(stage))
            place = np.array([low[0] - MARGIN, y])
            _write(ax, text, place, ha="right")
            corners.append(place - (_size(text, NAME_PT)[0], 0.0))
    return np.stack([np.min(corners, axis=0), np.max(corners, axis=0)])


def _wrapped(name: str) -> str:
    """No wider than a column; names have no spaces, so lines end after _ and -."""
    folded = (textwrap.fill(name.replace("_", "_ "), n).replace("_ ", "_") for n in (24, 20, 16))
    return next(text for text in folded if _size(text, NAME_PT)[0] < COLUMN)


def _stage(bound: Bound, stage: int) -> str:
    if bound.continuation_probability is not None:
        return ("0: may change", "1: ended")[stage]
    return f"{stage} transition{'s' * (stage != 1)}"


def _caption(chain: Chain) -> str:
    mode, initial = chain.supermodes.mode, chain.supermodes.initial_probabilities
    starts = ", ".join(  # no line ends between a mode and its probability
        f"{_symbol(chain, mode[s])}\N{NO-BREAK SPACE}{short(initial[s])}"
        for s in np.flatnonzero(initial)
    )
    return (
        f"Markov chain of {chain.owner}: probabilities of {chain.step}, in the colour of the mode "
        f"that they leave; double ring: possible at the start ({starts})"
    )


def _frame(figure: Figure, ax: Axes, heading: str, corners: Array) -> None:
    """Title and caption at the top left, the diagram in the middle below them."""
    low, high = corners
    lines = heading.count("\n") + 1
    needed = max(high[0] - low[0], _size(heading, HEADING_PT)[0])
    wide = max(WIDTH_IN, needed + 2 * MARGIN)
    left, bottom = (low[0] + high[0] - wide) / 2, low[1] - MARGIN
    top = high[1] + 2 * MARGIN + lines * LINE * HEADING_PT
    _write(ax, heading, np.array([left + 0.07, top - 0.07]), HEADING_PT, ha="left", va="top")
    figure.set_size_inches(wide, top - bottom)
    ax.set(xlim=(left, left + wide), ylim=(bottom, top))
