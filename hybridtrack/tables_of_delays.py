"""What a run says of how soon switches of mode are noticed."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

from rich.console import RenderableType
from rich.text import Text

from hybridtrack.delays import MOST_ALREADY
from hybridtrack.statistics import FALSE_SWITCHES
from hybridtrack.typesetting import estimate, plain_table

MOST_SWITCHES = 6  # whose delays are printed

Rows = list[dict[str, Any]]


def delay_tables(rows: Rows, summary: Rows) -> Iterator[RenderableType]:
    """Steps until switches are noticed, a column for each; the start is none."""
    keys = ("case", "switch", "from_mode", "to_mode")
    found = [row for row in rows if row["from_mode"] is not None]
    switches = list(dict.fromkeys(tuple(row[key] for key in keys) for row in found))
    if not switches:
        return
    yield ""
    several = len({switch[0] for switch in switches}) > 1
    if len(switches) > MOST_SWITCHES or several:
        yield Text(f"delays of {len(switches):,} switches: see delays.parquet")
        return
    table = plain_table()
    table.add_column(Text("delay in steps"), overflow="fold")
    for switch in switches:
        time_s = next(row["time_s"] for row in found if row["switch"] == switch[1])
        when = "" if time_s is None else f"\n{time_s:g} s"
        table.add_column(Text(f"{switch[2]}\nto {switch[3]}{when}"), justify="right", no_wrap=True)
    table.add_column(Text("false\nper stay"), justify="right", no_wrap=True)
    cells = {(row["estimator"], *(row[key] for key in keys)): delay(row) for row in found}
    false = {
        row["estimator"]: estimate(row["value"], row["standard_error"])
        for row in summary
        if row["metric"] == FALSE_SWITCHES
    }
    for label in dict.fromkeys(row["estimator"] for row in found):
        own = (cells.get((label, *switch), "") for switch in switches)
        table.add_row(Text(label), *own, false.get(label, ""))
    yield table
    if any("%" in cell for cell in cells.values()):
        yield Text("median; in brackets the share of switches that are missed")
    if any("*" in cell for cell in cells.values()):
        yield Text(
            f"*: in over {MOST_ALREADY:.0%} of the runs the estimate was so before the switch"
        )


def delay(row: Mapping[str, Any]) -> str:
    """Of the run-averaged mode estimate; the median where every run has its own switches.

    With the share of switches that are missed, and a star where the estimate had been the new
    mode already.
    """
    if row["averaged_delay"] is not None:
        text = str(row["averaged_delay"])
    else:
        median = row["median_delay_steps"]
        text = "never" if math.isinf(median) else f"{median:.0f}"
        text += f" ({row['missed_share']:.0%})" if row["missed_share"] >= 0.005 else ""
    return text + "*" * bool(row["already_share"] > MOST_ALREADY)
