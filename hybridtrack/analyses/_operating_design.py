"""What is asked of the analysis of operating points, and what was found."""

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from hybridtrack.analyses._local_starts import LocalStarts
from hybridtrack.analyses._procedure import BEST_FOUND, OPTIMAL, Procedure, Range, Step

PAPER = "Otanez, Campbell 2004"
WITHOUT = "without remainder"
RESERVED = (WITHOUT, OPTIMAL, BEST_FOUND)  # what no other placement is called
TEN = 10.0  # per cent above the optimum that the paper counts starts within


class Settings(NamedTuple):
    """range: low and high by state; wanted: the largest half-width by state; both in its unit.

    weights: of components of the dynamics (by state) or of the measurement ("measured NAME"), to
    compare errors of unlike units. placements: points by a name, to be compared: a number each, or
    a list where several states vary. least_points: how many are tried although fewer would do.
    starts: of the local solvers (0: none; by default 1,000 in one state, 100 in several, where each
    takes longer), with starts_points points.
    """

    range: dict[str, list[float]] | None = None
    wanted: dict[str, float] | None = None
    remainder: Literal["exact", "printed_eq40"] = "exact"
    rule: Literal[
        "trace_trace",
        "trace_sqrt",
        "determinant_determinant",
        "trace_determinant",
        "best_constants",
    ] = "trace_trace"
    weights: dict[str, float] | None = None
    placements: dict[str, list[float | list[float]]] | None = None
    least_points: int = 3
    most_points: int = 6
    starts: int | None = None
    starts_points: int = 3


STARTS, STARTS_OF_SEVERAL = 1000, 100


class Design(NamedTuple):
    """All that tables, sentences and figures are made of."""

    procedure: Procedure
    over: Range
    wanted: Mapping[int, float]  # by state
    state: int  # whose bound is told
    steps: Sequence[Step]  # with 1, 2, ... points
    given: Sequence[Step]
    study: Sequence[LocalStarts]
    needed: int | None  # the fewest points that meet what is wanted
    settings: Settings
    of_paper: bool  # whether the scenario is the paper's own

    @property
    def state_name(self) -> str:
        """The state whose bound is told."""
        return self.procedure.system.state_names[self.state]

    @property
    def error_unit(self) -> str:
        """Of the worst error; '' where none is given, or components of several are compared."""
        if self.settings.weights:
            return ""
        return self.procedure.system.error_unit(self.procedure.function.components)

    @property
    def best(self) -> str:
        """What the best placements may be called: the optimum only with a certificate."""
        certain = all(step.placement.certificate for step in self.steps)
        return "optimum" if certain else "best found"

    @property
    def starts(self) -> int:
        """Of each local solver."""
        return len(self.study[0].worst_errors)

    @property
    def studied(self) -> float:
        """The best that local starts are held against."""
        return self.steps[self.settings.starts_points - 1].placement.worst_error


def coarse(share: float) -> float:
    """A share of starts to a fifth: it depends on the draw, and another machine's last bits send
    some starts elsewhere. shares.parquet has it as it is.
    """
    return round(5.0 * share) / 5.0
