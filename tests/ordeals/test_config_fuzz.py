"""Mutated scenarios by the thousand: each loads, or is refused with one sentence."""

import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hybridtrack.config import dump
from hybridtrack.experiment import digest
from scenarios import CHAIN, FIG5, load_or_complain, mutations, scenario_data

with tempfile.TemporaryDirectory() as folder:
    ORIGINALS = [scenario_data(text, Path(folder)) for text in (FIG5.read_text(), CHAIN)]


@pytest.mark.parametrize("original", ORIGINALS, ids=["legs", "chain"])
@settings(max_examples=3000, deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_mutated_scenario_loads_or_is_refused(
    original: dict[str, Any], data: st.DataObject
) -> None:
    mutated = data.draw(mutations(original))
    with tempfile.TemporaryDirectory() as folder:
        experiment = load_or_complain(mutated, Path(folder) / "a.yaml")
        if experiment is not None:
            again = Path(folder) / "again.yaml"
            again.write_text(dump(experiment.resolved))
            resolved = load_or_complain(experiment.resolved, again)
            assert resolved is not None
            assert digest(resolved) == digest(experiment)
