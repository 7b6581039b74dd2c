"""Every shipped scenario against its baseline: are its figures still what they were?"""

from pathlib import Path

import pytest

from hybridtrack import config, experiment
from hybridtrack.studies import baselines, reports

BASELINES = Path(__file__).parent / "baselines"


def test_every_shipped_scenario_has_a_baseline():
    assert {path.stem for path in BASELINES.glob("*.parquet")} == set(config.shipped())


@pytest.mark.parametrize("name", sorted(config.shipped()))
def test_figures_are_what_they_were(name, tmp_path):
    """A change that is meant: `make baselines`, and a line in CHANGELOG.md that says why."""
    baseline = baselines.read(BASELINES / f"{name}.parquet")
    chosen = [f"monte_carlo.runs={baseline.runs}", f"monte_carlo.seed={baseline.seed}"]
    experiment.run(config.load(name, chosen), tmp_path, 2, lambda done, total: None)
    report = reports.held_against(tmp_path, baseline)
    assert report.comparison.paired
    assert not report.failed, reports.as_text(report)
    assert not report.of("better"), reports.as_text(report)  # it too has to be explained
