"""`make bench`: ours against its peers side by side, then the product as a whole.

Every round times every competitor once, in an order that rotates from round to round: a machine
that slows down for a minute slows all of them down. CPU time of one thread, never the wall's.
"""

import os

ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}
os.environ.update(ONE_THREAD)  # before anything that reads it is imported

import argparse  # noqa: E402
import statistics  # noqa: E402
import time  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import NamedTuple  # noqa: E402

import filters  # noqa: E402
import machine  # noqa: E402
import numpy as np  # noqa: E402
import whole  # noqa: E402
from problem import Array, Problem, problem  # noqa: E402

STEPS = 200
RUNS = 2048
COMPARED_RUNS = 256  # whose estimates are held against ours
OURS = "hybridtrack"
# Times ours, with 3 and with 6 states; of C++ at most a factor 1.3 behind it.
AIMS = {
    "FilterPy": ("6000", "2500"),
    "NumPy, batched": ("25", "25"),
    "C++, textbook": ("0.77", "0.77"),
    "C++, ours": ("1", "1"),
}


class Contest(NamedTuple):
    """One competitor's figures for one problem."""

    name: str
    seconds: list[float]  # CPU time per run and step, round by round
    mean_difference: float  # from our estimates, relative to the component's largest
    probability_difference: float


def contest(whole_problem: Problem, rounds: int, seconds: float) -> list[Contest]:
    """Time every competitor in every round; prepared, compiled and warm beforehand."""
    found = filters.available()
    ours = found[OURS](_first(whole_problem, COMPARED_RUNS))(True)
    prepared: dict[str, tuple[filters.Filter, int, int]] = {}
    differences = {}
    for name, competitor in found.items():
        runs, repeats, difference = _scaled(whole_problem, competitor, seconds, ours)
        prepared[name] = (competitor(_first(whole_problem, runs)), runs, repeats)
        prepared[name][0](False)
        differences[name] = difference
    times: dict[str, list[float]] = {name: [] for name in prepared}
    names = list(prepared)
    for turn in range(rounds):
        for name in names[turn % len(names) :] + names[: turn % len(names)]:
            function, runs, repeats = prepared[name]
            begin = time.process_time()
            for _ in range(repeats):
                function(False)
            spent = time.process_time() - begin
            times[name].append(spent / (repeats * runs * STEPS))
    return [Contest(name, times[name], *differences[name]) for name in names]


def _first(of: Problem, runs: int) -> Problem:
    return of._replace(measurements=of.measurements[..., :runs])


def _scaled(
    of: Problem, competitor: filters.Competitor, seconds: float, ours: tuple[Array, Array]
) -> tuple[int, int, tuple[float, float]]:
    """Runs and repetitions that take about `seconds`, and the estimates' differences from ours."""
    batch = competitor not in filters.RUN_BY_RUN
    runs = COMPARED_RUNS if batch else 2
    estimates = competitor(_first(of, runs))(True)
    assert estimates is not None
    runs_timed = RUNS if batch else runs
    function = competitor(_first(of, runs_timed))
    function(False)  # compiles
    begin = time.process_time()
    function(False)
    once = time.process_time() - begin
    difference = tuple(
        float(max(np.abs(a - b[..., :runs]).max(axis=(0, 2)) / np.abs(b).max(axis=(0, 2))))
        for a, b in zip(estimates, ours, strict=True)
    )
    if batch:
        return RUNS, max(1, round(seconds / once)), difference
    return max(1, round(seconds / once * runs)), 1, difference


def table(of: Problem, contests: list[Contest], column: int) -> list[str]:
    """Markdown, 80 columns."""
    ours = next(c for c in contests if c.name == OURS)
    lines = [
        f"IMM of two modes, {of.name}: CPU time per run and step",
        "",
        f"| {'':<14} | {'us':>6} | {'times ours (spread)':>22} |  aim |  mean | prob. |",
        "| --- | --: | --: | --: | --: | --: |",
    ]
    for c in contests:
        ratios = [a / b for a, b in zip(c.seconds, ours.seconds, strict=True)]
        ratio = statistics.median(ratios)
        spread = f"{_figure(ratio)} ({_figure(min(ratios))}-{_figure(max(ratios))})"
        aim = AIMS.get(c.name, ("", ""))[column]
        lines.append(
            f"| {c.name:<14} | {_figure(statistics.median(c.seconds) * 1e6):>6} "
            f"| {spread:>22} | {aim:>4} | {c.mean_difference:.0e} "
            f"| {c.probability_difference:.0e} |"
        )
    return lines


def _figure(value: float) -> str:
    """Three significant digits, thousands with commas."""
    digits = max(0, 2 - int(np.floor(np.log10(value)))) if value > 0 else 0
    return f"{value:,.{digits}f}"


def main() -> None:
    """Run what is asked for; print Markdown and put it away."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.0, help="a competitor's turn, about")
    parser.add_argument("--skip", choices=["peers", "whole"], help="leave one half out")
    parser.add_argument("--out", type=Path, default=Path("runs/bench.md"))
    args = parser.parse_args()
    lines = machine.describe()
    if args.skip != "peers":
        for column, dimensions in enumerate((1, 2)):
            given = problem(dimensions, RUNS, STEPS)
            lines += ["", *table(given, contest(given, args.rounds, args.seconds), column)]
    if args.skip != "whole":
        lines += ["", *whole.measure(args.rounds)]
    text = "\n".join(lines)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(text + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
