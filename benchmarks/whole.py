"""The product as a whole: two threads against one, memory, and a run's CPU time over its filters'.

Memory is the sum of the proportional set sizes of a command's processes (Linux only).
"""

import multiprocessing
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from hybridtrack import config
from hybridtrack.blocks import run_block
from hybridtrack.estimators import Running
from hybridtrack.executors import available_cores, in_order
from hybridtrack.experiment import plan
from hybridtrack.simulation import BLOCK_RUNS

RUNS = 20_000
SAMPLE_S = 0.05
LARGEST_MB = 600
CORES_GAIN = 1.7
GAIN_ROUNDS = 20  # half a second each: many, since others use the machine too


class Study(NamedTuple):
    """A scenario as the figures of a whole run are asked of it."""

    scenario: str
    settings: tuple[str, ...]
    end_to_end: float  # CPU time of the command over its filters', at most


FIGURE_5 = Study("rmimm_fig5", (), 2.0)
EXAMPLE_1 = Study(  # of Sigalov 2011, with its four filters
    "softbound_ex1",
    (
        "estimators={genie: {type: genie}, SBF: {type: sbf, continuation_probability: 0.98}, "
        "HBF: {type: hbf, most_transitions: 4}, IMM: {type: imm}}",
        "published=[]",
    ),
    2.5,
)


def measure(rounds: int) -> list[str]:
    """Every figure of whole runs, as Markdown tables."""
    lines = _gains(rounds) if available_cores() >= 2 else []
    for study in (FIGURE_5, EXAMPLE_1):
        lines += ["", *_costs(study)]
    return lines


def _gains(rounds: int) -> list[str]:
    lines = [f"| {FIGURE_5.scenario}, {RUNS:,} runs | measured | aim |", "| --- | --: | --: |"]
    for name, labels in (("IMM only", ("IMM",)), ("all estimators", None)):
        number = max(rounds, GAIN_ROUNDS)
        threads = _spread(_gain_by_threads(labels, number))
        processes = _spread(_gain_by_processes(labels, number))
        lines += [
            f"| throughput, 2 threads over 1, {name} | {threads} | {CORES_GAIN} |",
            f"| 2 processes that share nothing, {name} | {processes} | |",
        ]
    return lines


def _costs(study: Study) -> list[str]:
    """CPU time and memory of the command at two sizes, its filters measured in the same run."""
    _command(study, BLOCK_RUNS)  # compiles, and warms the files
    filters_s, blocks_s = _blocks_cpu_s(study)
    few, many = (_command(study, runs) for runs in (RUNS, 10 * RUNS))
    return [
        f"| {study.scenario} | {RUNS:,} runs | {10 * RUNS:,} runs | aim |",
        "| --- | --: | --: | --: |",
        f"| CPU time of the command | {few.cpu_s:.2f} s | {many.cpu_s:.1f} s | |",
        f"| CPU time of its filters | {few.filters_s:.2f} s | {many.filters_s:.2f} s | |",
        f"| the command over its filters | {few.ratio:.1f} | {many.ratio:.1f} "
        f"| {study.end_to_end} |",
        f"| blocks alone (drawn, filtered, scored) over filters | {blocks_s / filters_s:.2f} | | |",
        f"| peak memory | {few.megabytes:.0f} MB | {many.megabytes:.0f} MB | {LARGEST_MB} MB |",
    ]


def _spread(values: list[float]) -> str:
    return f"{statistics.median(values):.2f} ({min(values):.2f}-{max(values):.2f})"


def _wall_s(experiment: config.Experiment, workers: int) -> float:
    """Time for all blocks."""
    tasks = [task for shard in plan(experiment) for task in shard.tasks]
    begin = time.perf_counter()
    for _ in in_order(lambda task, stop: run_block(experiment, task, stop), tasks, workers):
        pass
    return time.perf_counter() - begin


Labels = tuple[str, ...] | None  # estimators, None for all


def _experiment(study: Study, labels: Labels = None) -> config.Experiment:
    experiment = config.load(study.scenario, [*study.settings, f"monte_carlo.runs={RUNS}"])
    chosen = tuple(c for c in experiment.estimators if labels is None or c.label in labels)
    return experiment._replace(estimators=chosen)


def _gain_by_threads(labels: Labels, rounds: int) -> list[float]:
    """Throughput of two threads over that of one, round by round."""
    experiment = _experiment(FIGURE_5, labels)
    _wall_s(experiment._replace(runs=BLOCK_RUNS), 1)  # compiles
    return [_wall_s(experiment, 1) / _wall_s(experiment, 2) for _ in range(rounds)]


def _gain_by_processes(labels: Labels, rounds: int) -> list[float]:
    """The same of two processes that share nothing: what the machine allows.

    Less than 2 where others use its cores too.
    """
    experiment = _experiment(FIGURE_5, labels)
    context = multiprocessing.get_context("spawn")
    barrier, times = context.Barrier(3), context.Queue()
    alone = [
        context.Process(target=_alone, args=(labels, rounds, barrier, times)) for _ in range(2)
    ]
    for process in alone:
        process.start()
    gains = []
    for _ in range(rounds):
        barrier.wait()  # both are ready, and rest
        one = _wall_s(experiment, 1)
        barrier.wait()  # they work
        gains.append(2 * one / max(times.get(), times.get()))
    for process in alone:
        process.join()
    return gains


def _alone(labels: Labels, rounds: int, barrier: Any, times: Any) -> None:
    """One of two processes that each do all blocks in one thread, at the same time."""
    experiment = _experiment(FIGURE_5, labels)
    _wall_s(experiment._replace(runs=BLOCK_RUNS), 1)
    for _ in range(rounds):
        barrier.wait()
        barrier.wait()
        times.put(_wall_s(experiment, 1))


@contextmanager
def timed_filters() -> Iterator[list[float]]:
    """CPU time of all threads within Running.advance, summed in the list's one element."""
    spent, lock = [0.0], threading.Lock()
    advance = Running.advance

    def timed(self: Running, *arguments: Any, **keywords: Any) -> Any:
        begin = time.thread_time()
        estimates = advance(self, *arguments, **keywords)
        with lock:
            spent[0] += time.thread_time() - begin
        return estimates

    Running.advance = timed  # type: ignore[method-assign]
    try:
        yield spent
    finally:
        Running.advance = advance  # type: ignore[method-assign]


def _blocks_cpu_s(study: Study) -> tuple[float, float]:
    """CPU time of the filters alone within a run of all blocks, and of all of it, in one thread."""
    experiment = _experiment(study)
    _wall_s(experiment._replace(runs=BLOCK_RUNS), 1)  # loads what is compiled
    with timed_filters() as spent:
        begin = time.process_time()
        _wall_s(experiment, 1)
        return spent[0], time.process_time() - begin


class Cost(NamedTuple):
    """What one command took."""

    cpu_s: float
    filters_s: float
    megabytes: float

    @property
    def ratio(self) -> float:
        """The whole over its filters."""
        return self.cpu_s / self.filters_s


# The command itself, which leaves the CPU time of its filters in a file.
INSIDE = """
import sys
from pathlib import Path
from hybridtrack.cli import main
from hybridtrack.console import spare_time
spare_time()
sys.path.append(sys.argv.pop(1))
import whole
noted = Path(sys.argv.pop(1))
with whole.timed_filters() as spent:
    try:
        main()
    finally:
        noted.write_text(repr(spent[0]))
"""


def _command(study: Study, runs: int) -> Cost:
    """CPU time and peak memory of `hybridtrack run`."""
    with tempfile.TemporaryDirectory() as folder:
        out, noted = Path(folder) / "run", Path(folder) / "filters"
        options = ["--runs", str(runs), "--out", str(out), "--quiet", "--json"]
        for setting in study.settings:
            options += ["--set", setting]
        inside = [sys.executable, "-c", INSIDE, str(Path(__file__).parent), str(noted)]
        before = os.times()
        process = subprocess.Popen(
            [*inside, "run", study.scenario, *options], stdout=subprocess.DEVNULL
        )
        peak = [0.0]
        sampler = threading.Thread(target=_sample, args=(process, peak))
        sampler.start()
        code = process.wait()
        sampler.join()
        if code != 0:
            raise SystemExit(f"hybridtrack run {study.scenario} ended with exit code {code}")
        after = os.times()
        spent = after.children_user + after.children_system
        spent -= before.children_user + before.children_system
        return Cost(spent, float(noted.read_text()), peak[0])


def _sample(process: "subprocess.Popen[bytes]", peak: list[float]) -> None:
    while process.poll() is None:
        peak[0] = max(peak[0], sum(_proportional_mb(pid) for pid in _family(process.pid)))
        time.sleep(SAMPLE_S)


def _family(pid: int) -> list[int]:
    """A process and all its descendants."""
    try:
        children = [
            int(child)
            for task in Path(f"/proc/{pid}/task").iterdir()
            for child in (task / "children").read_text().split()
        ]
    except OSError:  # it has just ended
        return []
    return [pid, *(member for child in children for member in _family(child))]


def _proportional_mb(pid: int) -> float:
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024
