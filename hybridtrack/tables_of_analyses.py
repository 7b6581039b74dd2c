"""A finished analysis as text; analysis.json in, lines out."""

from collections.abc import Iterator, Mapping
from typing import Any, Literal

from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from hybridtrack.tables import published_table, unexpected
from hybridtrack.typesetting import hanging, plain_table, print_parts

LONG_TEXT = 40  # letters of a cell, beyond which it has several lines


def show_analysis(record: Mapping[str, Any], console: Console) -> None:
    """Print a finished analysis, of which analysis.json is given, in the same way."""
    print_parts(_parts_of(record), console)


def _parts_of(record: Mapping[str, Any]) -> Iterator[RenderableType]:
    yield Text(f"{record['title']}: {record['summary']}\n")
    for one in record["shown"]:
        if one["name"]:
            yield Text(f"{one['name'].replace('_', ' ')}:")
        yield _as_shown(one["columns"])
        yield ""
    for sentence in record["conclusions"]:
        yield Text(sentence)
    if record["notes"]:
        yield ""
        yield from (hanging(note) for note in record["notes"])
    if record["published"]:
        yield ""
        yield published_table(record["published"])


def _as_shown(columns: Mapping[str, list[str]]) -> Table:
    """Texts by heading; names stand in the first column, or the first two, and long texts fold."""
    table = plain_table()
    for i, (heading, cells) in enumerate(columns.items()):
        long = max(map(len, cells), default=0) > LONG_TEXT
        named = i < _columns_of_names(columns)
        justify: Literal["left", "right"] = "left" if named or long else "right"
        table.add_column(
            Text(heading),
            justify=justify,
            overflow="fold",
            no_wrap=not (named or long),
            max_width=LONG_TEXT if long else None,
        )
    for row in zip(*columns.values(), strict=True):
        table.add_row(*map(Text, row))
    return table


def _columns_of_names(columns: Mapping[str, list[str]]) -> int:
    """How many of the first columns hold names."""
    return 2 if list(columns)[:2] == ["from", "to"] else 1


def surprises_of(record: Mapping[str, Any]) -> list[str]:
    """The same of an analysis' verdicts."""
    return unexpected(record["published"])
