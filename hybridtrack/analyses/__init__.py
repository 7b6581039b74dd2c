"""The analyses: what theory says of a scenario's modes before anything flies; one file each.

A new analysis is one file here that defines ANALYSIS; it is found by its name. Its settings are a
NamedTuple with types and defaults, which stand under `analyses:` in a scenario; the checked form
is derived from it. It takes a scenario as numbers and gives numbers and sentences (Findings):
reading, running, writing and drawing are done elsewhere, for all alike.
"""

import functools
import importlib
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from hybridtrack.analyses._findings import Band, Chart, Findings, Line, Mark, Panel, Table
from hybridtrack.description import Experiment
from hybridtrack.errors import Unsuited
from hybridtrack.models import JumpMarkovModel
from hybridtrack.simulation import step_lengths

__all__ = [
    "Analysis",
    "Band",
    "Chart",
    "Findings",
    "Line",
    "Mark",
    "Measured",
    "Panel",
    "Table",
    "analyses",
    "lint",
    "model_at_one_step",
]

Row = Mapping[str, Any]


class Measured(NamedTuple):
    """What a run of the scenario gave, for an analysis that wants one."""

    runs: int
    delays: Sequence[Row]  # rows of the tables of the same names
    delay_distribution: Sequence[Row]
    steps: Mapping[str, Any]  # columns


class Analysis(NamedTuple):
    """What can be asked about a scenario, by its name."""

    name: str
    summary: str
    source: str  # author, year, section
    settings: type[Any]  # a NamedTuple: types, and defaults
    # (experiment, settings, measured): Findings. Raises Unsuited where a scenario cannot be
    # analysed, in one sentence with the remedy.
    analyse: Callable[[Experiment, Any, Measured | None], Findings]
    example: str  # a shipped scenario that it is about
    limits: Mapping[str, tuple[float | None, float | None]] = {}  # smallest, largest by setting
    # What it wants run before, as the scenario's settings (KEY.PATH=VALUE); None: no run.
    wants_run: Callable[[Experiment], tuple[str, ...]] | None = None
    of_dynamics: bool = False  # about scenarios with `dynamics`, and not about modes

    def check(self, experiment: Experiment) -> None:
        """Raises Unsuited where a scenario is of the other kind."""
        if experiment.nonlinear is not None and not self.of_dynamics:
            raise Unsuited(
                f"{self.name} is about modes, and this scenario has 'dynamics' instead; name one "
                "with 'modes', or analyze operating-points",
                "dynamics",
            )

    @property
    def key(self) -> str:
        """What its settings stand under in a scenario, where names have no hyphens."""
        return self.name.replace("-", "_")


@functools.cache
def analyses() -> Mapping[str, Analysis]:
    """Every analysis by its name, in alphabetical order."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        if not module.name.startswith("_"):
            analysis = importlib.import_module(f"{__name__}.{module.name}").ANALYSIS
            found[analysis.name] = analysis
    return dict(sorted(found.items()))


def lint(experiment: Experiment) -> list[str]:
    """What theory finds too short in a scenario's truth, in whole sentences; quick.

    Nothing where theory has nothing to say of it.
    """
    from hybridtrack.analyses._short_stretches import warnings_about_legs

    if experiment.nonlinear is not None:
        return []
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return warnings_about_legs(experiment)
    except Unsuited:
        return []


def model_at_one_step(experiment: Experiment) -> tuple[JumpMarkovModel, tuple[str, ...]]:
    """The bank's model at one length of step, and a note where there are several.

    Uneven steps are represented by their median.
    """
    steps_s = np.concatenate([step_lengths(case.times_s) for case in experiment.cases])
    step_s = float(steps_s[0])
    notes: tuple[str, ...] = ()
    if np.ptp(steps_s) > 1e-9 * steps_s.mean():
        step_s = float(np.median(steps_s))
        notes = (
            f"the steps last {steps_s.min():.4g} to {steps_s.max():.4g} s; all of this is for "
            f"steps of their median, {step_s:.4g} s",
        )
    initial = experiment.initial
    model = experiment.bank.discretise(np.array([step_s]), initial.mean, initial.covariance)
    return model, notes
