"""What is counted of sets: against plain loops over runs and steps."""

import itertools

import numpy as np
import pytest

from hybridtrack.containment import Names, NoiseTally, SetTally, metrics_of, set_metrics
from hybridtrack.estimators import Sets
from hybridtrack.guarantees import median

STEPS, RUNS, LANES = 30, 12, 32
TIMES_S = 0.1 * np.arange(1, STEPS + 1)
NAMES = Names(("x", "psi"), (1,), ("1", "2", "3"), ("all", "late"))


@pytest.fixture
def case():
    """Random ellipsoids and errors near their boundary; run 3 diverges, run 5 has an empty set."""
    generator = np.random.default_rng(8)
    root = generator.standard_normal((STEPS, 2, 2, LANES)) + 2.0 * np.eye(2)[:, :, np.newaxis]
    shape = np.einsum("kijb,kljb->kilb", root, root)
    unit = generator.standard_normal((STEPS, 2, LANES))
    unit *= generator.uniform(0.2, 1.03, (STEPS, 1, LANES)) / np.linalg.norm(unit, axis=1)[:, None]
    mean = generator.standard_normal((STEPS, 2, LANES))
    truth = mean + np.einsum("kijb,kjb->kib", root, unit)
    truth[:, :, 0] = mean[:, :, 0]  # a run without any error
    mean[20:, :, 3] = np.nan
    empty = np.zeros((STEPS, LANES), dtype=bool)
    empty[7, 0] = True
    chosen = generator.integers(0, 3, (STEPS, LANES))
    chosen[:, 1] = np.repeat([0, 1, 2], 10)
    points = generator.uniform(1, 2, (STEPS, 3, LANES))
    unused = generator.choice([0.0, 0.5], (STEPS, LANES))
    by_point = np.repeat(points[:, :, None], 2, axis=2)
    sets = Sets(shape, chosen, empty, points, by_point, unused)
    held = np.ones((STEPS, 2, 1), dtype=bool)
    held[:15, 1] = False
    return truth, mean, sets, held


def tallied(case, cuts=(0, STEPS)):
    truth, mean, sets, held = case
    tally = SetTally(NAMES, TIMES_S, RUNS)
    for a, b in itertools.pairwise(cuts):
        part = Sets(*(array[a:b] for array in sets))
        tally.add(slice(a, b), truth[a:b], mean[a:b], part, held[a:b])
    return tally


def counted(case, b, first):
    """One run from step `first` on, by plain loops."""
    truth, mean, sets, _ = case
    names = ("violated", "emptied", "useless", "largest", "switched", "number", "unused")
    found = dict.fromkeys(names, 0)
    squares = np.zeros(2)
    bound, when = np.zeros(2), {}
    for k in range(first, STEPS):
        if np.isnan(mean[k, :, b]).any():
            continue
        e, S = truth[k, :, b] - mean[k, :, b], sets.shape[k, :, :, b]
        d = e @ np.linalg.solve(S, e)
        found["violated"] |= int(d > 1 + 1e-9 or sets.empty[k, b])
        found["emptied"] |= int(sets.empty[k, b])
        found["useless"] |= int(np.sqrt(S[1, 1]) > np.pi)
        found["largest"] = max(found["largest"], d)
        found["number"] += 1
        found["switched"] += int(k > 0 and sets.chosen[k, b] != sets.chosen[k - 1, b])
        found["unused"] += sets.unused[k, b]
        squares += e**2
        bound += np.sqrt(np.diag(S))
        when.setdefault(int(sets.chosen[k, b]), TIMES_S[k])
    order = [when.get(i, np.inf) for i in range(3)]
    found["in_order"] = int(order[0] < order[1] < order[2] < np.inf)
    return found, bound, when, squares


def test_runs_are_counted_as_plain_loops_count_them(case):
    sums = dict(tallied(case).sums())
    for window, first in (("all", 0), ("late", 15)):
        for b in range(RUNS):
            found, bound, when, squares = counted(case, b, first)

            def ours(name, part=0, window=window, b=b):
                return sums[window, name][part][b]

            for name in ("violated", "emptied", "useless", "switched", "in_order"):
                assert ours(name) == found[name], (window, b, name)
                assert ours(name, 1) == 1
            assert ours("largest_error") == pytest.approx(found["largest"], rel=1e-9)
            assert ours("unused") == found["unused"]
            assert ours("unused", 1) == found["number"]
            for e, state in enumerate(NAMES.states):
                assert ours(f"squared_error:{state}") == pytest.approx(squares[e], rel=1e-12)
                assert ours(f"bound:{state}") == pytest.approx(bound[e], rel=1e-12)
                assert ours(f"bound:{state}", 1) == found["number"]
            for i in range(3):
                name = f"first_choice_s:{i + 1}"
                assert ours(name, 1) == (i in when)
                assert ours(name) == pytest.approx(when.get(i, 0.0))
    assert {sums["all", "violated"][0][b] for b in range(RUNS)} == {0.0, 1.0}  # both were met


def test_spans_add_up(case):
    whole, parts = tallied(case), tallied(case, (0, 1, 11, 12, STEPS))
    for (cell, ours), (other, theirs) in zip(whole.sums(), parts.sums(), strict=True):
        assert cell == other
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)
    for (name, ours), (_, theirs) in zip(whole.steps(), parts.steps(), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, err_msg=name)


def test_steps_are_the_moments_over_the_runs_counted(case):
    sets = case[2]
    steps = dict(tallied(case).steps())
    bound = np.sqrt(sets.shape[:, 1, 1, :RUNS])
    np.testing.assert_allclose(steps["bound:psi"].mean, bound.mean(axis=1))
    np.testing.assert_allclose(steps["bound:psi"].squares, RUNS * bound.var(axis=1))
    share = sum(steps[f"chosen_share:{i}"].mean for i in (1, 2, 3))
    np.testing.assert_allclose(share, 1.0)
    assert steps["chosen_share:1"].n[[0, -1]].tolist() == [RUNS, RUNS - 1]  # one has diverged


def test_the_tolerance_is_that_of_rounding():
    """1 + 1e-9 on the boundary is inside, 1 + 1e-8 isn't."""
    for excess, violated in ((5e-10, 0.0), (1e-8, 1.0)):
        truth = np.full((1, 2, 1), 0.0)
        truth[0, 0, 0] = np.sqrt(1 + excess)
        shape = np.eye(2)[np.newaxis, :, :, np.newaxis]
        nothing = np.zeros((1, 0, 1))
        integers = np.zeros((1, 1), dtype=np.int64)
        sets = Sets(
            shape, integers, integers > 0, nothing, np.zeros((1, 0, 2, 1)), np.zeros((1, 1))
        )
        tally = SetTally(Names(("x", "psi"), (1,), (), ("all",)), TIMES_S[:1], 1)
        tally.add(slice(0, 1), truth, 0 * truth, sets, np.ones((1, 1, 1), dtype=bool))
        assert dict(tally.sums())["all", "violated"][0][0] == violated


def test_noise_outside_is_counted_by_window():
    outside = np.zeros((10, LANES, 2))
    outside[2:6, 1, 0] = 1.0
    outside[9, :, 1] = 1.0
    held = np.ones((10, 2, 1), dtype=bool)
    held[:5, 1] = False
    tally = NoiseTally(("all", "late"), 3)
    tally.add(outside[:4], held[:4])
    tally.add(outside[4:], held[4:])
    sums = dict(tally.sums())
    assert sums["all", "process_noise_outside"][0].tolist() == [0, 4, 0]
    assert sums["late", "process_noise_outside"][0].tolist() == [0, 1, 0]
    assert sums["late", "measurement_noise_outside"][1].tolist() == [5, 5, 5]


def test_metrics_are_found_again_by_their_quantities():
    every = set_metrics(("x", "psi"), ("1", "2"))
    quantities = tuple(dict.fromkeys(metric.quantity for metric in every.values()))
    assert metrics_of(quantities) == every
    assert metrics_of(("bound:x",)) == {"mean_bound:x": every["mean_bound:x"]}
    assert metrics_of(()) == {}


def test_the_median_s_error_is_that_of_many_medians():
    """Of 401 exponentials: the spread of 2,000 medians, within a tenth the errors' mean."""
    generator = np.random.default_rng(4)
    found = np.array([median(sample) for sample in generator.exponential(size=(2000, 401))])
    assert found[:, 0].mean() == pytest.approx(np.log(2), rel=0.01)
    assert found[:, 1].mean() == pytest.approx(found[:, 0].std(), rel=0.1)


def test_runs_that_diverged_are_the_widest_of_the_median():
    assert median(np.array([1.0, 2.0, 3.0, np.inf, np.inf]))[0] == 3.0
    assert median(np.array([1.0, np.inf, np.inf]))[0] == np.inf
