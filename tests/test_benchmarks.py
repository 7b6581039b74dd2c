"""The benchmark's filters are the same filter: otherwise its ratios compare nothing."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
import filters
from problem import problem

RUNS = 256  # one block of lanes
STEPS = 40  # a span and a piece of one

needs_compiler = pytest.mark.skipif(shutil.which(filters.CXX) is None, reason="no C++ compiler")


@pytest.fixture(scope="module", params=[1, 2], ids=["3 states", "6 states"])
def solved(request):
    """A problem and our estimates."""
    given = problem(request.param, RUNS, STEPS)
    return given, filters.ours(given)(True)


@pytest.mark.parametrize(
    ("name", "runs"),
    [
        pytest.param("C++, textbook", RUNS, marks=needs_compiler),
        pytest.param("C++, ours", RUNS, marks=needs_compiler),
        ("NumPy, batched", RUNS),
        ("FilterPy", 3),
    ],
)
def test_same_estimates_as_ours(solved, name, runs):
    given, (means, probabilities) = solved
    assert means.shape == (STEPS, len(given.model.state_names), RUNS)
    some = given._replace(measurements=given.measurements[..., :runs])
    other_means, other_probabilities = filters.available()[name](some)(True)
    # Rounding alone: 1e-13 of each component's largest value was seen, wrong algebra gives 1e-3.
    for e in range(means.shape[1]):
        largest = np.abs(means[:, e]).max()
        np.testing.assert_allclose(
            other_means[:, e], means[:, e, :runs], rtol=0, atol=1e-10 * largest
        )
    np.testing.assert_allclose(other_probabilities, probabilities[..., :runs], rtol=0, atol=1e-10)


def test_both_modes_are_at_work(solved):
    """Agreement says little where one mode has all the probability."""
    _, (_, probabilities) = solved
    assert probabilities[:, 1].min() < 0.2
    assert probabilities[:, 1].max() > 0.8


def test_timed_filters_keep_nothing(solved):
    given, _ = solved
    assert filters.ours(given)(False) is None
