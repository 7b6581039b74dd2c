"""The config room under good input: what it understands, and what its JSON Schema knows."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridtrack.chains import Bound
from hybridtrack.config import Experiment, dump, json_schema, load, shipped
from hybridtrack.config.reader import read
from hybridtrack.experiment import digest
from hybridtrack.jumps import ChainTruth
from hybridtrack.simulation import FixedTruth
from scenarios import CHAIN, FIG5, complaint, loaded, scenario_data
from test_config import CHAIN_START, CT, MATRIX, MEAN, NOISE, ONE, SPAN, SPREAD, diagonal


def same(one: Any, other: Any, rtol: float = 0.0) -> bool:
    """Equality through NamedTuples, mappings and arrays.

    Numbers may differ by `rtol` of the largest of their array: y = 6e-17 m is a rounded 0 m.
    """
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k], rtol) for k in one)
    if isinstance(one, tuple | list):
        pairs = zip(one, other, strict=False)
        return len(one) == len(other) and all(same(a, b, rtol) for a, b in pairs)
    if isinstance(one, float | np.ndarray):
        if np.shape(one) != np.shape(other):
            return False
        largest = np.max(np.abs(other), initial=0.0, where=np.isfinite(other))
        return np.allclose(one, other, 0.0, rtol * largest, equal_nan=True)
    if callable(one):  # compiled of expressions, which are compared
        return callable(other)
    return bool(one == other)


# How many SI units one is, from the definitions of the foot, the nautical mile and g.
LENGTHS = {"m": 1, "km": 1000, "ft": 0.3048, "nmi": 1852}
TIMES = {"s": 1, "min": 60, "h": 3600}
ANGLES = {"rad": 1, "deg": np.pi / 180}
SPELLINGS: list[tuple[str, str, float, Mapping[str, float]]] = [
    ("clock", "step_s", 1, TIMES),
    ("clock", "duration_s", 150, TIMES),
    ("truth.start", "heading_deg", np.pi / 2, ANGLES),
    ("truth.start", "speed_kt", 480 * 1852 / 3600, {"m_s": 1, "km_h": 1 / 3.6, "kt": 1852 / 3600}),
    ("truth.legs.0", "until_s", 30, TIMES),
    ("truth.legs.1", "turn_rate_deg_s", -np.pi / 60, {"rad_s": 1, "deg_s": np.pi / 180}),
    ("sensor", "position_std_m", 17.7, LENGTHS),
    ("modes.CT", "acceleration_std_m_s2", 3, {"m_s2": 1, "ft_s2": 0.3048, "g": 9.80665}),
    ("initial", "velocity_std_m_s", 10, {"m_s": 1, "km_h": 1 / 3.6, "kt": 1852 / 3600}),
    ("estimators.RMIMM", "residual_floor_m", 1, LENGTHS),
    ("windows.straight_settled", "after_switch_s", 10, TIMES),
]


@pytest.mark.parametrize(
    ("where", "key", "si", "unit", "factor"),
    [
        (where, key, si, unit, factor)
        for where, key, si, units in SPELLINGS
        for unit, factor in units.items()
    ],
)
def test_every_spelling_of_a_unit_means_the_same(
    where: str, key: str, si: float, unit: str, factor: float, tmp_path: Path
) -> None:
    data = read(FIG5).data
    holder: Any = data
    for part in where.split("."):
        holder = holder[int(part) if part.isdigit() else part]
    suffixes = ("deg_s", "m_s2", "m_s", "deg", "kt", "m", "s")
    stem = next(key.removesuffix(f"_{s}") for s in suffixes if key.endswith(f"_{s}"))
    del holder[key]
    holder[f"{stem}_{unit}"] = si / factor
    original = without_claims(load(FIG5))
    spelled = without_claims(loaded(dump(data), tmp_path))
    is_same = same(spelled, original, 1e-12)  # the few roundings of a conversion and of an arc
    assert is_same
    if where != "clock":  # a change of 1e-9 is seen; the clock's would be no whole number of steps
        holder[f"{stem}_{unit}"] *= 1 + 1e-9
        is_same = same(without_claims(loaded(dump(data), tmp_path)), original, 1e-12)
        assert not is_same


def without_claims(experiment: Experiment) -> Experiment:
    """For comparing: a dump forgets how many digits a claim was printed with."""
    return experiment._replace(resolved={}, claims=())


def test_lists_and_times_are_converted_item_by_item(tmp_path: Path) -> None:
    text = (
        FIG5.read_text()
        .replace(SPAN, "times_min: [0, 1, 2.5]")
        .replace(MATRIX, "mean_sojourn_min: {CV: 2, CT: 0.5}")
    )
    text = text.replace(NOISE, "position_std_km: [0.01, 0.02]}").replace("[0, 0]", "[0, 2]")
    text = text.replace("position_m:", "position_nmi:")
    experiment = loaded(text, tmp_path)
    case = experiment.cases[0]
    assert case.times_s.tolist() == [0, 60, 150]
    assert experiment.sensor.noise_covariance.tolist() == [[[100, 0], [0, 400]]]
    assert isinstance(case.truth, FixedTruth)
    assert case.truth.state[0, [0, 2]].tolist() == [0, 3704]
    assert experiment.bank.generator_per_s is not None
    np.testing.assert_allclose(
        experiment.bank.generator_per_s, [[-1 / 120, 1 / 120], [1 / 30, -1 / 30]], rtol=1e-15
    )


@pytest.mark.parametrize("name", sorted(shipped()))
def test_a_resolved_scenario_is_the_scenario(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment = load(name)
    monkeypatch.chdir(tmp_path)
    again = loaded(dump(experiment.resolved), tmp_path)
    again, experiment = (
        one._replace(analysis_claims=[c._replace(place="") for c in one.analysis_claims])
        for one in (again, experiment)
    )
    is_same = same(again, experiment)  # bit for bit: dump writes every digit
    assert is_same
    assert digest(again) == digest(experiment)


def test_a_resolved_chain_is_the_chain(tmp_path: Path) -> None:
    experiment = loaded(CHAIN, tmp_path)
    again = loaded(dump(experiment.resolved), tmp_path)
    again, experiment = (
        one._replace(analysis_claims=[c._replace(place="") for c in one.analysis_claims])
        for one in (again, experiment)
    )
    is_same = same(again, experiment)
    assert is_same
    assert digest(again) == digest(experiment)


def test_the_digest_knows_what_matters() -> None:
    digests = {
        setting: digest(load(FIG5, [setting]))
        for setting in (
            "monte_carlo.seed=5",
            "monte_carlo.runs=50",
            "sensor.position_std_m=17.70",
            "monte_carlo.seed=6",
            "sensor.position_std_m=17.71",
            "estimators.KF_CA.mode=CV",
            "published.0.value=18.0",
        )
    }
    unchanged, *changed = list(digests.values())[:1] + list(digests.values())[3:]
    assert list(digests.values())[:3] == [unchanged] * 3
    assert len({unchanged, *changed}) == 1 + len(changed)


def test_legs_and_the_claims_of_figure_5() -> None:
    experiment = load(FIG5)
    case = experiment.cases[0]
    assert experiment.name == "rmimm_fig5"
    assert experiment.truth_modes == experiment.bank.names == ("CV", "CT")
    assert case.times_s.tolist() == list(range(151))
    truth = case.truth
    assert isinstance(truth, FixedTruth)
    # The mode of a step is that of the leg in which it ends: the first turn is steps 31 to 50.
    turning = [*range(31, 51), *range(71, 91), *range(111, 131)]
    assert np.flatnonzero(truth.mode[1:] == 1).tolist() == [k - 1 for k in turning]
    # Half a unit of the last printed digit: 18, 2.3, 15, 2.1; comparisons have none.
    assert [claim.tolerance for claim in experiment.claims[:4]] == [0.5, 0.05, 0.5, 0.05]
    assert [window.name for window in experiment.windows] == [
        "all",
        "straight_settled",
        "turn_onset",
    ]
    assert experiment.windows[1].after_switch_s == 10
    assert experiment.windows[2].mode == 1


def test_a_chain_by_its_matrices(tmp_path: Path) -> None:
    experiment = loaded(CHAIN, tmp_path)
    truth = experiment.cases[0].truth
    assert isinstance(truth, ChainTruth)
    assert truth.bank.state_names == ("x", "vx")
    assert truth.bank.transition_matrix is not None
    assert truth.bank.transition_matrix.tolist() == [[0.9, 0.1], [0.3, 0.7]]
    assert truth.bank.initial_mode_probabilities.tolist() == [0.2, 0.8]
    assert truth.initial_mean.tolist() == [0, 10]
    assert truth.initial_covariance.tolist() == [[4, 1], [1, 9]]
    assert experiment.bank.initial_mode_probabilities.tolist() == [0.5, 0.5]
    assert experiment.initial.covariance.tolist() == [[1, 0], [0, 4]]
    slow, fast = experiment.bank.modes
    assert slow.measurement_noise_covariance.tolist() == [[9]]  # the sensor's
    assert fast.measurement_noise_covariance.tolist() == [[16]]  # its own
    assert fast.matrices is not None
    assert fast.matrices.state_transition.tolist() == [[[1, 0.5], [0, 0.9]]]
    assert fast.matrices.input_effect.tolist() == [[0, 1]]
    assert fast.measurement_matrix is not None
    assert experiment.windows[1][:3] == ("late", 2, 4)


def test_a_chain_with_modes_and_a_matrix_of_its_own(tmp_path: Path) -> None:
    text = CHAIN.replace(
        CHAIN_START,
        "initial: {mean: [0, 10]}\n"
        "    modes:\n"
        "      A: {motion: constant_velocity, acceleration_psd_m2_s3: 2}\n"
        "      B: {motion: constant_velocity, acceleration_psd_m2_s3: 3}\n"
        "      C: {motion: constant_velocity, acceleration_psd_m2_s3: 4}\n"
        "    transition_matrix: [[0.5, 0.5, 0], [0, 0.5, 0.5], [1, 0, 0]]",
    )
    experiment = loaded(text, tmp_path)
    truth = experiment.cases[0].truth
    assert isinstance(truth, ChainTruth)
    assert experiment.truth_modes == truth.bank.names == ("A", "B", "C")
    assert truth.bank.transition_matrix is not None
    assert truth.bank.transition_matrix.tolist() == [[0.5, 0.5, 0], [0, 0.5, 0.5], [1, 0, 0]]
    assert truth.bank.modes[2].parameters == {"acceleration_psd_m2_s3": 4}
    assert not truth.initial_covariance.any()  # a fixed start
    assert experiment.bank.names == ("slow", "fast")
    # The scenario's matrix is for two modes and can't serve three.
    message = complaint(text.replace("    transition_matrix: [[0.5", "    #"), tmp_path / "b.yaml")
    assert "is 2 x 2 and must be 3 x 3: the modes are A, B, C" in message


@pytest.mark.parametrize(
    ("key", "bound"),
    [
        ("", Bound()),
        ("continuation_probability: 0.9", Bound(continuation_probability=0.9)),
        ("most_transitions: 3", Bound(most_transitions=3)),
    ],
)
def test_a_chain_with_a_bound(tmp_path: Path, key: str, bound: Bound) -> None:
    experiment = loaded(CHAIN.replace(CHAIN_START, f"{CHAIN_START}\n    {key}"), tmp_path)
    truth = experiment.cases[0].truth
    assert isinstance(truth, ChainTruth)
    assert truth.bound == bound


def test_a_chain_with_a_matrix_of_its_own_and_the_modes_of_the_scenario(tmp_path: Path) -> None:
    own = "initial: {mean: [0, 10]}\n    generator_per_s: [[-1, 1], [2, -2]]"
    experiment = loaded(CHAIN.replace(CHAIN_START, own), tmp_path)
    truth = experiment.cases[0].truth
    assert isinstance(truth, ChainTruth)
    assert same(truth.bank.modes, experiment.bank.modes)
    assert truth.bank.transition_matrix is None
    assert truth.bank.generator_per_s is not None
    assert truth.bank.generator_per_s.tolist() == [[-1, 1], [2, -2]]
    assert experiment.bank.generator_per_s is None


def test_sojourns_and_generator_at_uneven_times(tmp_path: Path) -> None:
    text = FIG5.read_text().replace(SPAN, "times_s: [0, 1, 3, 150]")
    sojourns = loaded(text.replace(MATRIX, "mean_sojourn_s: {CV: 20, CT: 5}"), tmp_path)
    generator = loaded(
        text.replace(MATRIX, "generator_per_s: [[-0.05, 0.05], [0.2, -0.2]]"), tmp_path
    )
    step_s = np.diff(sojourns.cases[0].times_s)
    for experiment in (sojourns, generator):
        model = experiment.bank.discretise(step_s, np.zeros(6), np.eye(6))
        # The exponential of a 2 x 2 generator in closed form: away = a / (a + b) (1 - e^-(a+b)T).
        away = 0.05 / 0.25 * (1 - np.exp(-0.25 * step_s))
        back = 0.2 / 0.25 * (1 - np.exp(-0.25 * step_s))
        expected = np.array([[1 - away, away], [back, 1 - back]]).transpose(2, 0, 1)
        np.testing.assert_allclose(model.transition_matrix, expected, rtol=1e-13)  # rounding


def test_steps_in_decimals_are_even(tmp_path: Path) -> None:
    # Multiples of 0.1 differ in their last bits; they still are steps of one length.
    text = CHAIN.replace("from_s: 2", "from_s: 0")
    for clock in (
        "step_s: 0.1, duration_s: 0.7",
        "times_s: [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]",
    ):
        experiment = loaded(text.replace("step_s: 0.5, duration_s: 5", clock), tmp_path)
        assert len(set(np.diff(experiment.cases[0].times_s).tolist())) > 1
        assert experiment.bank.transition_matrix is not None


def test_noise_by_mode_by_axis_and_as_a_filter_believes_it(tmp_path: Path) -> None:
    text = FIG5.read_text()
    by_mode = loaded(text.replace(NOISE, "position_std_m: {CT: 3, CV: 2}}"), tmp_path)
    assert by_mode.sensor.noise_covariance[:, 0, 0].tolist() == [4, 9]  # in the modes' order
    assert [m.measurement_noise_covariance[1, 1] for m in by_mode.bank.modes] == [4, 9]
    believed = text.replace(NOISE, "position_std_m: [2, 3], detection_probability: 0.9}").replace(
        CT, CT.replace("}", ", position_std_m: [4, 5]}")
    )
    experiment = loaded(believed, tmp_path)
    assert experiment.sensor.noise_covariance.tolist() == [[[4, 0], [0, 9]]]
    assert experiment.sensor.detection_probability == 0.9
    covariances = [np.diag(m.measurement_noise_covariance) for m in experiment.bank.modes]
    assert np.array(covariances).tolist() == [[4, 9], [16, 25]]


def test_outliers_of_the_sensor(tmp_path: Path) -> None:
    assert load(FIG5).sensor.outliers is None
    often = load(FIG5, ["sensor.outliers={probability: 0.01, size_sigma: 60}"])
    assert often.sensor.outliers == (0.01, 60.0, -np.inf, np.inf)
    # Exactly one, by any unit of time.
    for at in ("from_s: 120, until_s: 120", "from_min: 2, until_min: 2", "from_h: 0.0333333333333"):
        text = FIG5.read_text().replace(NOISE, f"position_std_m: 1, outliers: {{{ONE}, {at}}}}}")
        sensor = loaded(text, tmp_path).sensor
        assert sensor.outliers is not None
        assert sensor.outliers.from_s == pytest.approx(120.0, abs=1e-6)  # less than the slack
        assert np.flatnonzero(sensor.may_be_outliers(np.arange(151.0)))[0] == 119
    one = load(FIG5, [f"sensor.outliers={{{ONE}, from_s: 120, until_s: 120}}"])
    assert one.sensor.may_be_outliers(np.arange(151.0)).sum() == 1
    digests = {digest(e) for e in (load(FIG5), often, one)}
    assert len(digests) == 3


def test_the_ways_to_start(tmp_path: Path) -> None:
    text = FIG5.read_text()
    drawn = load(FIG5).initial
    assert (drawn.two_point, drawn.follows_truth, drawn.drawn) == (False, True, True)
    axis = [17.7**2, 100, 1e-6]
    np.testing.assert_allclose(np.diag(drawn.covariance), axis * 2, rtol=1e-15)
    exact = loaded(text.replace(MEAN, "mean: truth").replace(SPREAD, ""), tmp_path).initial
    assert (exact.follows_truth, exact.drawn) == (True, False)
    assert not exact.covariance.any()
    numbers = text.replace(MEAN, "mean: [1, 2, 3, 4, 5, 6]").replace(
        SPREAD, f"  covariance: {diagonal(first=(2, 1)).replace('[0, 1', '[1, 1', 1)}\n"
    )
    given = loaded(numbers, tmp_path).initial
    assert (given.follows_truth, given.mean.tolist()) == (False, [1, 2, 3, 4, 5, 6])
    assert given.covariance[:2, :2].tolist() == [[2, 1], [1, 1]]
    scans = text.replace(MEAN, "from_measurements: two_point").replace(SPREAD, "")
    experiment = loaded(scans, tmp_path)
    assert experiment.initial.two_point
    assert experiment.sensor.certain_scans == 2  # the two scans are always seen


def test_a_claim_in_other_digits(tmp_path: Path) -> None:
    text = FIG5.read_text()
    for written, tolerance in (("18.0", 0.05), ("1.8e1", 0.5), ("0x12", 0.5), ("180e-1", 0.05)):
        claim = loaded(text.replace("value: 18\n", f"value: {written}\n"), tmp_path).claims[0]
        assert claim.value == 18
        assert claim.tolerance == pytest.approx(tolerance, rel=1e-15)
    assert load(FIG5, ["published.0.tolerance=2"]).claims[0].tolerance == 2


# --- the JSON Schema -----------------------------------------------------------------------------


def forms(schema: dict[str, Any], node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The alternatives that a node stands for, references followed."""
    if "$ref" in node:
        yield from forms(schema, schema["$defs"][node["$ref"].rpartition("/")[2]])
    for key in ("anyOf", "oneOf"):
        for part in node.get(key, []):
            yield from forms(schema, part)
    if "type" in node or "properties" in node:
        yield node


def described(schema: dict[str, Any], node: dict[str, Any], value: Any) -> bool:
    """Whether the schema knows every key of the value."""
    if isinstance(value, list):
        kinds = [form for form in forms(schema, node) if form.get("type") == "array"]
        items = [form.get("items", {}) for form in kinds]
        return any(all(described(schema, item, part) for part in value) for item in items)
    if not isinstance(value, dict):
        return bool(value == node.get("const", value))
    for form in forms(schema, node):
        known = form.get("properties", {})
        others = [*form.get("patternProperties", {}).values()]
        if isinstance(form.get("additionalProperties"), dict):
            others.append(form["additionalProperties"])
        parts = [(known.get(key) or next(iter(others), None), part) for key, part in value.items()]
        if form.get("type") == "object" and all(
            found is not None and described(schema, found, part) for found, part in parts
        ):
            return True
    return False


def test_the_json_schema_knows_every_key_of_every_scenario(tmp_path: Path) -> None:
    schema = json.loads(json.dumps(json_schema()))
    assert schema["$schema"].startswith("https://json-schema.org/")
    for path in shipped().values():
        assert described(schema, schema, read(path).data), path.name
    chain = scenario_data(CHAIN, tmp_path)
    assert described(schema, schema, chain)
    spelled = read(FIG5).data
    spelled["truth"]["start"] = {"position_nmi": [0, 0], "speed_km_h": 900, "heading_rad": 1}
    assert described(schema, schema, spelled)


@pytest.mark.parametrize("path", ["sede", "clock.stepp_s", "modes.CV.x", "estimators.IMM.mode"])
def test_the_json_schema_knows_no_other_key(path: str) -> None:
    schema = json_schema()
    data = read(FIG5).with_setting(f"{path}=1").data
    assert not described(schema, schema, data)


def test_the_json_schema_knows_the_names_and_the_metrics() -> None:
    schema = json.loads(json.dumps(json_schema()))
    assert "patternProperties" not in json.dumps(schema)  # would let every other name pass
    names = schema["$defs"]["ScenarioForm"]["properties"]["estimators"]["propertyNames"]
    assert names == {"pattern": "^[A-Za-z0-9_-]+$", "maxLength": 64}
    assert "position_rmse_m" in schema["$defs"]["ClaimForm"]["properties"]["metric"]["enum"]
