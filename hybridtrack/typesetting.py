"""How figures and tables are set: digits to the error's first, tables as wide as they need."""

import math
from collections.abc import Iterable

from rich import box
from rich.console import Console, RenderableType
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

MOST_DECIMALS = 7  # more than that, and figures of a million on, take an exponent
MOST_DIGITS = 6  # of a figure with an exponent, after its point
SHORTEST_NAME = 12  # what a narrow terminal leaves of a name's column; longer ones go on below
WIDEST = 10_000
ROUNDING = 1e-14  # relative; of sums over a run


def figure(value: float, error: float) -> str:
    """A figure with its standard error, to the error's first digit: '17.94±0.04'."""
    if math.isnan(value):
        return ""
    if math.isnan(error):
        return f"{value:.4g}"
    if math.isinf(value):
        return f"{value:g}"
    if error == 0.0 or math.isinf(error):
        return f"{value:.4g}±{error:.4g}"
    last = math.floor(math.log10(error))  # place of the error's first digit
    if max(abs(value), error) < 1e6 and -last <= MOST_DECIMALS:
        decimals = max(-last, 0)
        return f"{value:.{decimals}f}±{error:.{decimals}f}"
    first = math.floor(math.log10(abs(value))) if value else last
    return f"{value:.{min(max(first - last, 0), MOST_DIGITS)}e}±{error:.0e}"


def estimate(value: float, error: float) -> str:
    """As `figure`; an error that small is rounding, of what every run has alike."""
    alike = math.isfinite(value) and error < ROUNDING * abs(value)
    return figure(value, 0.0 if alike else error)


def counted(number: int, thing: str) -> str:
    """'1 run', '2,000 runs'."""
    return f"{number:,} {thing}{'s' * (number != 1)}"


def print_parts(parts: Iterable[RenderableType], console: Console) -> None:
    with console.capture() as captured:
        for part in parts:
            if isinstance(part, Table) and not part.expand:
                part.width = _width(part, console)
            console.print(part, crop=False)
    lines = [line.rstrip() for line in captured.get().splitlines()]
    console.file.write("\n".join([*lines, ""]))


def hanging(note: str) -> Table:
    """A note behind a dash, its lines below one another."""
    grid = Table.grid(padding=(0, 1), expand=True)
    grid.add_column(width=1)
    grid.add_column(ratio=1)
    grid.add_row("-", Text(note, style="dim"))
    return grid


def _width(table: Table, console: Console) -> int:
    """All that a table needs; on a terminal less where that is at the expense of names alone."""
    options = console.options.update(width=WIDEST)
    needed = Measurement.get(console, options, table).maximum
    if not console.is_terminal:
        return needed
    names = [column for column in table.columns if not column.no_wrap and column.max_width is None]
    longest = [max(len(str(cell)) for cell in (c.header, *c.cells)) for c in names]
    spare = sum(max(length - SHORTEST_NAME, 0) for length in longest)
    return max(min(needed, console.width), needed - spare)


def plain_table() -> Table:
    return Table(box=box.SIMPLE, pad_edge=False, padding=(0, 1), show_edge=False)
