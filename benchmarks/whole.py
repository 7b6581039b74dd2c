"""The product as a whole: two threads against one, memory, and a run's CPU time over its filters'.

Memory is the sum of the proportional set sizes of a command's processes (Linux only).
"""

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


def measure(rounds: int) -> list[str]:
    """Every figure of a whole run, as a Markdown table."""
    everything = config.load(SCENARIO, [f"monte_carlo.runs={RUNS}"])
    imm = tuple(chosen for chosen in everything.estimators if chosen.label == "IMM")
    lines = [f"| {SCENARIO}, {RUNS:,} runs | measured | aim |", "| --- | --: | --: |"]
    if available_cores() >= 2:
        gains = [_machine_gain() for _ in range(rounds)]
        lines.append(f"| throughput, 2 cores over 1, the machine itself | {_spread(gains)} | |")
        for name, experiment in (
            ("IMM only", everything._replace(estimators=imm)),
            ("all estimators", everything),
        ):
            figure = _spread(_gains_by_two(experiment, rounds))
            lines.append(f"| throughput, 2 threads over 1, {name} | {figure} | {CORES_GAIN} |")
    filters_s = _filters_cpu_s(everything)
    _command(BLOCK_RUNS)  # compiles what no block needs, and warms the files
    for runs in (RUNS, 10 * RUNS):
        cpu_s, megabytes = _command(runs)
        if runs == RUNS:
            lines += [
                f"| CPU time of the command | {cpu_s:.1f} s | |",
                f"| CPU time of its filters | {filters_s:.1f} s | |",
                f"| the one over the other | {cpu_s / filters_s:.2f} | {END_TO_END} |",
            ]
        lines.append(f"| peak memory, {runs:,} runs | {megabytes:.0f} MB | {LARGEST_MB} MB |")
    return lines


def _spread(values: list[float]) -> str:
    return f"{statistics.median(values):.2f} ({min(values):.2f}-{max(values):.2f})"


def _machine_gain() -> float:
    """What two processes that share nothing gain: less than 2 where others use the cores too."""
    counting = [sys.executable, "-c", "for i in range(30_000_000): pass"]
    spent = []
    for number in (1, 2):
        begin = time.perf_counter()
        processes = [subprocess.Popen(counting) for _ in range(number)]
        for process in processes:
            process.wait()
        spent.append(time.perf_counter() - begin)
    return 2 * spent[0] / spent[1]


def _wall_s(experiment: config.Experiment, workers: int) -> float:
    """Time for all blocks."""
    tasks = [task for shard in plan(experiment) for task in shard.tasks]
    begin = time.perf_counter()
    for _ in in_order(lambda task, stop: run_block(experiment, task, stop), tasks, workers):
        pass
    return time.perf_counter() - begin


def _gains_by_two(experiment: config.Experiment, rounds: int) -> list[float]:
    """Throughput of two threads over that of one, in alternating order."""
    _wall_s(experiment._replace(runs=BLOCK_RUNS), 1)  # compiles
    gains = []
    for turn in range(rounds):
        spent = {workers: _wall_s(experiment, workers) for workers in ((1, 2), (2, 1))[turn % 2]}
        gains.append(spent[1] / spent[2])
    return gains


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


def _filters_cpu_s(experiment: config.Experiment) -> float:
    """CPU time of the filters alone, within a run of all blocks."""
    with _timed_filters() as spent:
        _wall_s(experiment, 1)
    return spent[0]


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
