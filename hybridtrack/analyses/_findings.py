"""What every analysis gives: tables, charts as plain numbers, and sentences for a practitioner.

Nothing here is drawn or written: other rooms do that, for all analyses alike.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from hybridtrack.models import Array

Steps = Literal["", "pre", "post"]


class Table(NamedTuple):
    """Columns of numbers, bools or texts, all of one length; None where there is nothing to say.

    Every column is of one type. `shown` is what a terminal shows of it: cells by heading, as many
    as there are rows; nothing where it is empty.
    """

    columns: Mapping[str, Sequence[Any]]
    shown: Mapping[str, Sequence[str]] = {}


class Line(NamedTuple):
    """A curve; NaN breaks it."""

    label: str
    x: Array  # (n,)
    y: Array  # (n,)
    reference: bool = False  # thin and black: what the others are held against
    steps: Steps = ""  # "pre" or "post": constant before or after each point; else straight lines


class Band(NamedTuple):
    """A shaded range, in the colour of the line with its label if there is one."""

    label: str
    x: Array  # (n,)
    low: Array  # (n,)
    high: Array  # (n,)
    steps: Steps = ""  # as a Line's


class Mark(NamedTuple):
    """A straight line across a panel: at an `x`, or at a `y`."""

    label: str
    x: float | None = None
    y: float | None = None
    like: str = ""  # the label of a line whose colour it has


class Panel(NamedTuple):
    """One set of axes; panels of a chart stand one below the other and share x."""

    y_label: str
    lines: Sequence[Line] = ()
    bands: Sequence[Band] = ()
    marks: Sequence[Mark] = ()
    log_y: bool = False
    y_limits: tuple[float, float] | None = None


class Chart(NamedTuple):
    """A figure: its file's name, what it shows in a sentence, its panels."""

    name: str
    caption: str
    x_label: str
    panels: Sequence[Panel]


class Findings(NamedTuple):
    """The result of an analysis."""

    table: Table  # the main one: printed, and what claims are held against
    conclusions: Sequence[str]  # whole sentences, what a practitioner should conclude first
    notes: Sequence[str] = ()  # what the paper prints wrongly, what was assumed
    tables: Mapping[str, Table] = {}  # more of them, by name
    charts: Sequence[Chart] = ()
