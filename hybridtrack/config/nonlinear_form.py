"""The form of a scenario with `dynamics` instead of modes: expressions, bounded noise, sets."""

from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from pydantic import Field

from hybridtrack.bounded import KINDS
from hybridtrack.config.schema import (
    ESTIMATOR_FORMS,
    AnalysesForm,
    ClaimForm,
    ClockForm,
    Form,
    MonteCarloForm,
    Name,
    NonNegative,
    Positive,
    ScenarioForm,
    ScoringForm,
    WindowForm,
    tagged,
)
from hybridtrack.estimators import estimators

Expression = str | float
Unit = Annotated[str, Field(min_length=1, max_length=12)]

if TYPE_CHECKING:
    SetEstimatorUnion: TypeAlias = Any
    NoiseKind: TypeAlias = str
else:
    SetEstimatorUnion = tagged(
        {name: form for name, form in ESTIMATOR_FORMS.items() if estimators()[name].nonlinear},
        "type",
        "",
    )
    NoiseKind = Literal[KINDS]


class SimulatedForm(Form):
    """The truth's start: one point, or spread over the ellipsoid of the filters' start about it."""

    start: list[float]
    spread: Literal["none", "ball", "sphere"] = "none"


class NoiseForm(Form):
    """Half-axes of the noise's ellipsoids, in the states' units, and how noise is drawn.

    With `contains_box` filters believe in ellipsoids around the box of the half-axes: n times Q,
    n_y times R.
    """

    kind: NoiseKind
    process: dict[str, NonNegative]
    measurement: dict[str, Positive]
    hold_steps: Annotated[int, Field(ge=1, le=10**9)] = 40
    against: str | None = None
    contains_box: bool = False
    detection_probability: Annotated[float, Field(gt=0, le=1)] = 1.0  # of a whole scan


class StartForm(Form):
    """The filters' first ellipsoid: centre, and half-axes by state."""

    mean: Literal["truth"] | list[float]
    half_axes: dict[str, Positive]


class NonlinearForm(Form):
    """A whole scenario with `dynamics`."""

    name: Name
    title: str = ""
    source: str = ""
    assumptions: list[str] = Field(default_factory=list)
    clock: ClockForm
    states: Annotated[list[Name], Field(min_length=1, max_length=12)]
    angles: list[str] = Field(default_factory=list)
    units: dict[str, Unit] = Field(default_factory=dict)  # of states and measurements, as written
    constants: dict[Name, float] = Field(default_factory=dict)
    inputs: dict[Name, float | list[float]] = Field(default_factory=dict)
    dynamics: dict[str, Expression]
    measurement: Annotated[dict[Name, Expression], Field(min_length=1, max_length=12)]
    truth: SimulatedForm
    noise: NoiseForm
    initial: StartForm
    estimators: Annotated[dict[Name, SetEstimatorUnion], Field(min_length=1)]
    compare_with: str | None = None
    windows: dict[Name, WindowForm] = Field(default_factory=dict)
    scoring: ScoringForm = ScoringForm()
    analyses: AnalysesForm = Field(default={}, validate_default=True)
    monte_carlo: MonteCarloForm
    published: list[ClaimForm] = Field(default_factory=list)


AnyForm = ScenarioForm | NonlinearForm
