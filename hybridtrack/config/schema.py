"""The form of a scenario: every key, its type and its limits, SI inside.

A key whose name ends in an SI suffix may be spelled in any unit of the same dimension
(`speed_m_s`, `speed_kt`, `speed_km_h`); see units. Motion models and estimators bring their own
keys: their forms are derived from the signature, or the settings, where they are defined.
"""

import inspect
import math
import types
import typing
from functools import reduce
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import pydantic
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, create_model
from pydantic_core import PydanticCustomError

from hybridtrack.analyses import analyses
from hybridtrack.config import units
from hybridtrack.containment import FAMILIES, FLAGS, NOISE
from hybridtrack.estimators import estimators
from hybridtrack.motion import MOTION_MODELS
from hybridtrack.statistics import METRICS

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Probability = Annotated[float, Field(ge=0, le=1)]
Matrix = list[list[float]]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$", max_length=64)]


class Form(BaseModel):
    """A mapping of a scenario: its keys and no others, units converted to SI."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, populate_by_name=False
    )

    @pydantic.model_validator(mode="before")
    @classmethod
    def _to_si(cls, data: Any) -> Any:
        """Rename keys to their SI spelling; refuse unknown keys and two spellings of one."""
        if not isinstance(data, dict):
            return data
        known = {s: name for name in cls.names() for s in units.spellings(name)}
        converted: dict[str, Any] = {}
        for key, value in data.items():
            name = known.get(key)
            if name is None:
                raise PydanticCustomError(
                    "unknown_key", "{key}", {"key": key, "keys": sorted(known)}
                )
            if name in converted:
                raise PydanticCustomError("two_spellings", "{key}", {"key": key})
            suffix = units.split(key)
            converted[name] = units.to_si(value, suffix[1]) if suffix else value
        return converted

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The keys as a scenario writes them in SI."""
        return tuple(field.alias or name for name, field in cls.model_fields.items())


class ClockForm(Form):
    """Times of the steps: even ones, or every one listed from k = 0."""

    step_s: Positive | None = None
    duration_s: Positive | None = None
    times_s: Annotated[list[float], Field(min_length=2)] | None = None


class StartForm(Form):
    """Where a flight of legs begins; headings run clockwise from north, x east, y north."""

    position_m: Annotated[list[float], Field(min_length=2, max_length=2)] = [0.0, 0.0]
    speed_m_s: NonNegative
    heading_rad: float


class LegForm(Form):
    """A straight flight, a coordinated turn (positive rates turn right), an acceleration.

    The acceleration is constant, to the east and to the north.
    """

    from_s: float | None = None
    until_s: float
    turn_rate_rad_s: float = 0.0
    acceleration_m_s2: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    speed_m_s: NonNegative | None = None
    mode: str | None = None


class InitialForm(Form):
    """The start of the filters (or of a chain's truth): mean, spread, mode probabilities."""

    mean: Literal["truth", "drawn_about_truth"] | list[float] | None = None
    position_std_m: NonNegative | None = None
    velocity_std_m_s: NonNegative | None = None
    acceleration_std_m_s2: NonNegative | None = None
    covariance: Matrix | None = None
    from_measurements: Literal["two_point"] | None = None
    mode_probabilities: dict[str, Probability] | list[Probability] | None = None


def _annotation(annotation: Any, limits: tuple[float | None, float | None] | None = None) -> Any:
    """A parameter's type as a form wants it: tuples are lists in YAML."""
    origin = typing.get_origin(annotation)
    if origin is tuple:
        return list[float]
    if limits:
        smallest, largest = limits
        return Annotated[annotation, Field(ge=smallest, le=largest)]
    if origin in (types.UnionType, typing.Union):
        return reduce(lambda a, b: a | b, map(_annotation, typing.get_args(annotation)))
    return annotation


class ModeForm(Form):
    """What every mode may say of the measurement noise; by default the sensor's."""

    position_std_m: Positive | list[Positive] | None = None


class MatricesForm(ModeForm):
    """A mode by its matrices, for steps of one length."""

    state_transition: Matrix
    process_noise_covariance: Matrix
    input_effect: list[float] | None = None
    measurement_matrix: Matrix | None = None
    measurement_noise_covariance: Matrix | None = None


def _motion_form(name: str) -> type[Form]:
    fields: dict[str, Any] = {"motion": (Literal[name], ...)}
    model = MOTION_MODELS[name]
    for parameter in inspect.signature(model.discretise).parameters.values():
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY:
            default = ... if parameter.default is inspect.Parameter.empty else parameter.default
            stem, _ = units.split(parameter.name) or (parameter.name, "")
            limits = (0.0, None) if stem.endswith(("_std", "_psd")) else None
            fields[parameter.name] = (_annotation(parameter.annotation, limits), default)
    return create_model(f"mode_{name}", __base__=ModeForm, __doc__=model.summary, **fields)


def _settings_form(kind: str, one: Any, **fields: Any) -> type[Form]:
    """The form of an estimator's or an analysis' settings, besides some fields more."""
    defaults = one.settings._field_defaults
    for setting, annotation in typing.get_type_hints(one.settings).items():
        limits = one.limits.get(setting)
        fields[setting] = (_annotation(annotation, limits), defaults.get(setting, ...))
    return create_model(f"{kind}_{one.name}", __base__=Form, __doc__=one.summary, **fields)


def tagged(forms: dict[str, type[Form]], key: str, otherwise: str) -> Any:
    """Which of the forms it is, the value under `key` says."""

    def tag(value: Any) -> str:
        chosen = value.get(key) if isinstance(value, dict) else getattr(value, key, None)
        return otherwise if chosen is None else str(chosen)

    union = reduce(lambda a, b: a | b, [Annotated[form, Tag(name)] for name, form in forms.items()])
    return Annotated[union, Discriminator(tag)]


MOTION_FORMS = {name: _motion_form(name) for name in MOTION_MODELS} | {"matrices": MatricesForm}
ESTIMATOR_FORMS = {
    name: _settings_form("estimator", estimator, type=(Literal[name], ...))
    for name, estimator in estimators().items()
}
ANALYSIS_FORMS = {one.key: _settings_form("analysis", one) for one in analyses().values()}
ANALYSES = tuple(analyses())

if TYPE_CHECKING:  # which form it is, the scenario decides
    ModeUnion: TypeAlias = Any
    EstimatorUnion: TypeAlias = Any
    AnalysisName: TypeAlias = str
    AnalysesForm: TypeAlias = Any
else:
    AnalysisName = Literal[ANALYSES]
    AnalysesForm = create_model(
        "analyses",
        __base__=Form,
        __doc__="Settings of `hybridtrack analyze`, by analysis.",
        **{key: (form, form()) for key, form in ANALYSIS_FORMS.items()},
    )
    ModeUnion = tagged(MOTION_FORMS, "motion", "matrices")
    EstimatorUnion = tagged(
        {n: form for n, form in ESTIMATOR_FORMS.items() if not estimators()[n].nonlinear},
        "type",
        "",
    )


class ChainForm(Form):
    """Truth simulated from a jump Markov model: the scenario's modes unless it has its own.

    With `continuation_probability` a transition may be the last (soft bound), with
    `most_transitions` there are no more than so many (hard bound).
    """

    initial: InitialForm
    modes: dict[Name, ModeUnion] | None = None
    transition_matrix: Matrix | None = None
    mean_sojourn_s: dict[str, Positive] | None = None
    generator_per_s: Matrix | None = None
    continuation_probability: Probability | None = None
    most_transitions: Annotated[int, Field(ge=0, le=100)] | None = None


class ColumnsForm(Form):
    """Names of a recording's columns, where they aren't the usual ones."""

    time: str | None = None
    latitude: str | None = None
    longitude: str | None = None
    x: str | None = None
    y: str | None = None
    altitude: str | None = None
    track: str | None = None


class FileForm(Form):
    """A recorded track (or several) in a file."""

    file: str
    package: str | None = None
    columns: ColumnsForm = ColumnsForm()
    altitude_unit: Literal["ft", "m"] = "ft"
    minimum_altitude_m: float | None = None
    smooth_half_window_s: Positive = 8.0


class RecordingForm(FileForm):
    """A recording taken as the truth (smoothed), or as the measurements."""

    as_: Literal["truth", "measurements"] = Field("truth", alias="as")
    thin_to_s: Positive | None = None
    reference: FileForm | None = None


class TruthForm(Form):
    """What really happens: legs flown, a chain simulated, or a recorded flight."""

    start: StartForm | None = None
    legs: Annotated[list[LegForm], Field(min_length=1)] | None = None
    chain: ChainForm | None = None
    recording: RecordingForm | None = None


class OutliersForm(Form):
    """Errors of so many sigmas (Mahalanobis) in a random direction, added to the noise of a scan.

    Each scan between `from_s` and `until_s` (all, if these aren't given) is one with the
    probability given.
    """

    probability: Probability
    size_sigma: NonNegative
    from_s: float | None = None
    until_s: float | None = None


class SensorForm(Form):
    """What the truth's positions are measured with; per mode where a mapping of modes is given."""

    position_std_m: Positive | list[Positive] | dict[str, Positive]
    detection_probability: Annotated[float, Field(gt=0, le=1)] = 1.0
    outliers: OutliersForm | None = None


class WindowForm(Form):
    """Steps to be scored by themselves; all conditions must hold."""

    from_s: float | None = None
    until_s: float | None = None
    mode: str | None = None
    after_switch_s: NonNegative | None = None
    within_switch_s: Positive | None = None


class ScoringForm(Form):
    """What isn't scored at all, and whether tables and figures show squared errors or roots."""

    skip_scans: Annotated[int, Field(ge=0)] = 0
    error: Literal["rmse", "mse"] = "rmse"


class MonteCarloForm(Form):
    """How many runs are drawn, and from which seed."""

    runs: Annotated[int, Field(ge=1, le=100_000_000)]
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0
    keep_tracks: Annotated[int, Field(ge=0, le=256)] = 1


Cells = dict[str, str | int | float | bool]  # which row of an analysis' table: its cells


class ClaimForm(Form):
    """A published claim: a figure of one estimator, a comparison of two, or an exact figure.

    With `analysis` it is about a figure (a column) of that analysis' table, in the row that `where`
    tells; with `than` it compares that with another row's.
    """

    claim: str
    metric: Annotated[
        str | None, Field(json_schema_extra={"enum": [*METRICS, *FLAGS, *NOISE, None]})
    ] = None
    figure: str | None = None
    analysis: AnalysisName | None = None
    where: Cells | None = None
    than: Cells | None = None
    mode: str | None = None
    estimator: str | None = None
    compare: Annotated[list[str], Field(min_length=2, max_length=2)] | None = None
    window: str = "all"
    value: float | None = None
    tolerance: NonNegative | None = None
    sign: Literal["less", "greater", "equal"] | None = None
    expect: Literal[
        "reproduced", "reproduced with stated assumptions", "direction only", "not reproduced"
    ]
    because: str = ""

    @pydantic.field_validator("metric")
    @classmethod
    def _known_metric(cls, metric: str | None) -> str | None:
        known = (*METRICS, *FLAGS, *NOISE)
        family, colon, _ = (metric or "").partition(":")
        if metric is not None and metric not in known and not (colon and family in FAMILIES):
            raise PydanticCustomError(
                "unknown_metric", "must be one of {names}", {"names": ", ".join(known)}
            )
        return metric


class ScenarioForm(Form):
    """A whole scenario."""

    name: Name
    title: str = ""
    source: str = ""
    assumptions: list[str] = []
    dimensions: Literal[1, 2] = 2
    clock: ClockForm | None = None
    truth: TruthForm
    sensor: SensorForm
    states: Annotated[list[Name], Field(min_length=1)] | None = None
    modes: Annotated[dict[Name, ModeUnion], Field(min_length=1)]
    transition_matrix: Matrix | None = None
    mean_sojourn_s: dict[str, Positive] | None = None
    generator_per_s: Matrix | None = None
    initial: InitialForm
    estimators: Annotated[dict[Name, EstimatorUnion], Field(min_length=1)]
    compare_with: str | None = None
    windows: dict[Name, WindowForm] = {}
    scoring: ScoringForm = ScoringForm()
    analyses: AnalysesForm = Field(default={}, validate_default=True)
    monte_carlo: MonteCarloForm
    published: list[ClaimForm] = []


def is_number(value: Any) -> bool:
    """A finite number and no bool."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
