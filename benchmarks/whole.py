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
from typing import Any

from hybridtrack import config
from hybridtrack.blocks import run_block
from hybridtrack.estimators import Running
from hybridtrack.executors import available_cores, in_order
from hybridtrack.experiment import plan
from hybridtrack.simulation import BLOCK_RUNS

SCENARIO = "rmimm_fig5"
RUNS = 20_000
SAMPLE_S = 0.05
LARGEST_MB = 600
CORES_GAIN = 1.7
END_TO_END = 2.0
GAIN_ROUNDS = 20  # half a second each: many, since others use the machine too


def measure(rounds: int) -> list[str]:
    """Every figure of a whole run, as a Markdown table."""
    everything = config.load(SCENARIO, [f"monte_carlo.runs={RUNS}"])
    lines = [f"| {SCENARIO}, {RUNS:,} runs | measured | aim |", "| --- | --: | --: |"]
    if available_cores() >= 2:
        for name, labels in (("IMM only", ("IMM",)), ("all estimators", None)):
            number = max(rounds, GAIN_ROUNDS)
            threads = _spread(_gain_by_threads(labels, number))
            processes = _spread(_gain_by_processes(labels, number))
            lines += [
                f"| throughput, 2 threads over 1, {name} | {threads} | {CORES_GAIN} |",
                f"| 2 processes that share nothing, {name} | {processes} | |",
            ]
    filters_s, blocks_s = _blocks_cpu_s(everything)
    _command(BLOCK_RUNS)  # compiles what no block needs, and warms the files
    for runs in (RUNS, 10 * RUNS):
        cpu_s, megabytes = _command(runs)
        if runs == RUNS:
            lines += [
                f"| CPU time of the command | {cpu_s:.1f} s | |",
                f"| CPU time of its blocks: drawn, filtered, scored | {blocks_s:.2f} s | |",
                f"| CPU time of its filters | {filters_s:.2f} s | |",
                f"| the command over its filters | {cpu_s / filters_s:.1f} | {END_TO_END} |",
                f"| its blocks over its filters | {blocks_s / filters_s:.2f} | |",
            ]
        lines.append(f"| peak memory, {runs:,} runs | {megabytes:.0f} MB | {LARGEST_MB} MB |")
    return lines


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


def _experiment(labels: Labels) -> config.Experiment:
    experiment = config.load(SCENARIO, [f"monte_carlo.runs={RUNS}"])
    chosen = tuple(c for c in experiment.estimators if labels is None or c.label in labels)
    return experiment._replace(estimators=chosen)


def _gain_by_threads(labels: Labels, rounds: int) -> list[float]:
    """Throughput of two threads over that of one, round by round."""
    experiment = _experiment(labels)
    _wall_s(experiment._replace(runs=BLOCK_RUNS), 1)  # compiles
    return [_wall_s(experiment, 1) / _wall_s(experiment, 2) for _ in range(rounds)]


def _gain_by_processes(labels: Labels, rounds: int) -> list[float]:
    """The same of two processes that share nothing: what the machine allows.

    Less than 2 where others use its cores too.
    """
    experiment = _experiment(labels)
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
    experiment = _experiment(labels)
    _wall_s(experiment._replace(runs=BLOCK_RUNS), 1)
    for _ in range(rounds):
        barrier.wait()
        barrier.wait()
        times.put(_wall_s(experiment, 1))


@contextmanager
def _timed_filters() -> Iterator[list[float]]:
    """CPU time of this thread within Running.advance, summed in the list's one element."""
    spent = [0.0]
    advance = Running.advance

    def timed(self: Running, *arguments: Any, **keywords: Any) -> Any:
        begin = time.thread_time()
        estimates = advance(self, *arguments, **keywords)
        spent[0] += time.thread_time() - begin
        return estimates

    Running.advance = timed  # type: ignore[method-assign]
    try:
        yield spent
    finally:
        Running.advance = advance  # type: ignore[method-assign]


def _blocks_cpu_s(experiment: config.Experiment) -> tuple[float, float]:
    """CPU time of the filters alone within a run of all blocks, and of all of it."""
    with _timed_filters() as spent:
        begin = time.process_time()
        _wall_s(experiment, 1)
        return spent[0], time.process_time() - begin


def _command(runs: int) -> tuple[float, float]:
    """CPU time (s) and peak memory (MB) of `hybridtrack run`, kernels compiled beforehand."""
    with tempfile.TemporaryDirectory() as folder:
        out = str(Path(folder) / "run")
        options = ["--runs", str(runs), "--out", out, "--quiet", "--json"]
        before = os.times()
        process = subprocess.Popen(
            [sys.executable, "-m", "hybridtrack", "run", SCENARIO, *options],
            stdout=subprocess.DEVNULL,
        )
        peak = [0.0]
        sampler = threading.Thread(target=_sample, args=(process, peak))
        sampler.start()
        code = process.wait()
        sampler.join()
        if code != 0:
            raise SystemExit(f"hybridtrack run {SCENARIO} ended with exit code {code}")
        after = os.times()
    spent = after.children_user + after.children_system
    return spent - before.children_user - before.children_system, peak[0]


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
