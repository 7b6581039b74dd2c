"""Scenarios for the tests of config: one with everything in matrices, and mutations of any."""

import copy
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from hypothesis import strategies as st

from hybridtrack.config import Experiment, dump, load, shipped, truths
from hybridtrack.config.reader import read
from hybridtrack.errors import UserError

WITH_MODES = tuple(name for name in sorted(shipped()) if load(name).nonlinear is None)

FIG5 = Path(__file__).parent.parent / "configs" / "rmimm_fig5.yaml"

CHAIN = """\
name: chain
dimensions: 1
clock: {step_s: 0.5, duration_s: 5}
truth:
  chain:
    initial: {mean: [0, 10], covariance: [[4, 1], [1, 9]], mode_probabilities: [0.2, 0.8]}
sensor:
  position_std_m: 3
  outliers: {probability: 0.1, size_sigma: 20, from_s: 0.5, until_s: 4}
states: [x, vx]
modes:
  slow:
    state_transition: [[1, 0.5], [0, 1]]
    process_noise_covariance: [[0.01, 0.02], [0.02, 0.1]]
  fast:
    state_transition: [[1, 0.5], [0, 0.9]]
    process_noise_covariance: [[0.1, 0], [0, 1]]
    input_effect: [0, 1]
    measurement_matrix: [[1, 0]]
    measurement_noise_covariance: [[16]]
transition_matrix: [[0.9, 0.1], [0.3, 0.7]]
initial: {mean: [0, 10], position_std_m: 1, velocity_std_m_s: 2}
estimators: {IMM: {type: imm}, KF: {type: kalman, mode: slow}}
windows: {late: {from_s: 2, until_s: 4}}
monte_carlo: {runs: 10, seed: 1}
"""

Keys = tuple[str | int, ...]


def paths(value: Any, here: Keys = ()) -> list[Keys]:
    """The path of every value inside a document."""
    if isinstance(value, dict):
        parts: list[tuple[str | int, Any]] = list(value.items())
    elif isinstance(value, list):
        parts = list(enumerate(value))
    else:
        return []
    return [p for key, part in parts for p in ((*here, key), *paths(part, (*here, key)))]


def words(data: Any) -> list[str]:
    """Every key and every text of a document: the most confusing values there are for it."""
    if isinstance(data, dict):
        return [*data, *(w for part in data.values() for w in words(part))]
    if isinstance(data, list):
        return [w for part in data for w in words(part)]
    return [data] if isinstance(data, str) else []


def values(data: Any) -> st.SearchStrategy[Any]:
    """Scalars, lists and mappings, many of them nearly right."""
    numbers = [0, 1, 2, -1, 0.5, 1.0, 1e-30, 1e30, -1e30, 1e308, 5e-324, 10**12, 2**63]
    scalars = st.one_of(
        st.none(),
        st.booleans(),
        st.sampled_from(numbers),
        st.integers(-(10**9), 10**9),
        st.floats(-1e9, 1e9),
        st.sampled_from([*words(data), "", "a b", "é", "truth", "two_point", "matrices"]),
    )
    keys = st.sampled_from([*words(data), "x"]).filter(lambda key: 0 < len(key) < 64)
    return st.recursive(
        scalars,
        lambda inner: st.lists(inner, max_size=6) | st.dictionaries(keys, inner, max_size=4),
        max_leaves=12,
    )


@st.composite
def mutations(draw: st.DrawFn, original: dict[str, Any]) -> dict[str, Any]:
    """A document with one to three values deleted, replaced, renamed, doubled or swapped."""
    data = copy.deepcopy(original)
    for _ in range(draw(st.integers(1, 3))):
        places = paths(data)
        path = draw(st.sampled_from(places)) if places else None
        if path is None:
            break
        holder: Any = data
        for key in path[:-1]:
            holder = holder[key]
        key = path[-1]
        kind = draw(st.sampled_from(["delete", "replace", "rename", "nest", "swap"]))
        if kind == "replace":
            holder[key] = draw(values(original))
        elif kind == "nest":
            holder[key] = [holder[key]]
        elif kind == "swap":
            other = draw(st.sampled_from(places))
            found: Any = data
            for step in other:
                found = found[step]
            holder[key] = copy.deepcopy(found)
        elif kind == "rename" and isinstance(holder, dict):
            holder[draw(st.sampled_from(words(original)).filter(bool))[:100]] = holder.pop(key)
        else:
            del holder[key]
    return data


def load_or_complain(data: dict[str, Any], file: Path) -> Experiment | None:
    """The experiment, or None after a sentence that a user can read. Neither takes long."""
    file.write_text(dump(data))
    start = time.process_time()
    with patch.object(truths, "MAX_STEPS", 10_000):  # ten million would take seconds, rightly
        try:
            experiment = load(file)
        except UserError as error:
            experiment = None
            check_sentence(str(error), file)
    assert time.process_time() - start < 2.0  # it takes a hundredth of that
    return experiment


JARGON = ("Input should", "Value error", "pydantic", "literal", "union", "https://", "Traceback")


def check_sentence(message: str, file: Path) -> None:
    """One line with the file in front, no machinery showing, of a length that can be read."""
    assert "\n" not in message
    assert message.startswith(f"{file}:")
    assert not any(word.lower() in message.lower() for word in JARGON), message
    assert len(message) - len(str(file)) < 420


def scenario_data(text: str, folder: Path) -> dict[str, Any]:
    """The data of a scenario's text."""
    file = folder / "original.yaml"
    file.write_text(text)
    return read(file).data


def loaded(text: str, folder: Path, *changes: str) -> Experiment:
    """The experiment of a scenario's text after settings."""
    file = folder / "a.yaml"
    file.write_text(text)
    return load(file, changes)


def complaint(text: str, file: Path, settings: tuple[str, ...] = ()) -> str:
    """What loading the scenario complains about."""
    file.write_text(text)
    with pytest.raises(UserError) as caught:
        load(file, settings)
    return str(caught.value)
