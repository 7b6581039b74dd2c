"""An experiment from its blocks to its run folder: shards, merging, tables, verdicts."""

import hashlib
import json
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hybridtrack import __version__, outcomes, results
from hybridtrack.analyses import lint
from hybridtrack.blocks import run_block
from hybridtrack.compiled import PACKAGE, host_processor, source_digest
from hybridtrack.config import Experiment, dump
from hybridtrack.delays import Delays
from hybridtrack.detections import delay_rows
from hybridtrack.executors import in_order
from hybridtrack.groups import BlockTask, GroupStatistics, Track, merge, summarise
from hybridtrack.guarantees import SetRuns
from hybridtrack.results import RunFolder
from hybridtrack.simulation import BLOCK_RUNS
from hybridtrack.statistics import Moments, SumMoments, VectorMoments

SHARD_BLOCKS = 8  # blocks whose statistics are put away together

Report = Callable[[int, int], None]  # runs done, runs in all


class Shard(NamedTuple):
    """Some blocks of one case, in order."""

    name: str  # says how many runs it holds, so that a longer study doesn't take it for its own
    tasks: tuple[BlockTask, ...]

    @property
    def runs(self) -> int:
        """Runs in all its blocks."""
        return sum(task.runs for task in self.tasks)


def digest(experiment: Experiment) -> str:
    """What a run folder is named by: the scenario without `runs`, its recordings, our sources."""
    resolved = json.loads(json.dumps(experiment.resolved))
    del resolved["monte_carlo"]["runs"]
    resolved.pop("analyses", None)
    claims = resolved.pop("published", [])
    resolved["published"] = [claim for claim in claims if "analysis" not in claim]
    recording = resolved["truth"].get("recording", {})
    for holder in (recording, recording.get("reference", {})):
        holder.pop("file", None)  # what was recorded counts, not where the file lies
    hashed = hashlib.sha256(json.dumps(resolved, sort_keys=True).encode())
    hashed.update(source_digest().encode())
    if recording:
        for case in experiment.cases:
            for array in (case.times_s, *case.truth[:1], case.recorded):
                if isinstance(array, np.ndarray):
                    hashed.update(array.tobytes())
    return hashed.hexdigest()[:10]


def default_folder(experiment: Experiment, root: Path = Path("runs")) -> Path:
    """Where a run goes that isn't told otherwise."""
    return root / f"{experiment.name}-{digest(experiment)}"


def is_complete(path: Path, experiment: Experiment) -> bool:
    """Whether a folder holds this experiment, finished, with as many runs or more.

    So it does while a longer one is under way, or was interrupted. Raises UserError where the
    folder's manifest is damaged.
    """
    manifest = results.read_finished(path)
    return (
        manifest is not None
        and manifest["digest"] == digest(experiment)
        and bool(manifest["runs"] >= experiment.runs)
    )


def run(experiment: Experiment, path: Path, workers: int, report: Report) -> None:
    """Run an experiment into its folder, going on from whatever shards are there.

    Nothing already written is lost on the way: the result of a shorter run stays, and counts as
    finished, until this one's replaces it; that of a longer run stays for good.
    """
    shards = plan(experiment)
    with RunFolder(path, digest(experiment)) as folder:
        manifest = _manifest(experiment)
        held = results.read_finished(path)
        if held is None:
            folder.write_manifest(manifest)
            results.write_text(path / results.CONFIG, dump(experiment.resolved))
        elif held["runs"] > experiment.runs:
            return
        else:
            under_way = {name: manifest[name] for name in ("runs", "started")}
            folder.write_manifest({**held, "under_way": under_way})
        cases: dict[int, GroupStatistics] = {}
        tracks: list[tuple[int, Track]] = []
        for shard, group, kept in _shard_statistics(experiment, folder, shards, workers, report):
            case = shard.tasks[0].case
            cases[case] = merge(cases[case], group) if case in cases else group
            tracks += [(case, track) for track in kept]
        names = [shard.name for shard in shards]
        pairs = outcomes.pairs_wanted(experiment)
        sets = SetRuns(experiment)

        def look(runs: Any) -> None:
            pairs.add(runs)
            sets.add(runs)

        folder.assemble_runs(names, look)
        merged = [cases[c] for c in range(len(experiment.cases))]
        folder.write_table("steps", outcomes.steps_rows(experiment, merged))
        folder.write_table("tracks", outcomes.tracks_rows(experiment, tracks))
        folder.write_table("summary", outcomes.summary_rows(experiment, merged))
        folder.write_table("comparisons", outcomes.comparisons_rows(experiment, pairs))
        folder.write_table("reliability", outcomes.reliability_rows(experiment, merged))
        folder.write_table("sets", sets.rows())
        delays = delay_rows(experiment, merged)
        folder.write_table("delays", delays.switches)
        folder.write_table("delay_distribution", delays.distribution)
        folder.write_table("published", outcomes.published_rows(experiment, pairs, merged))
        manifest |= {
            "finished": _now(),
            "theory": lint(experiment),
            "diverged": {
                label: count
                for label in merged[0].diverged
                if (count := sum(group.diverged[label] for group in merged))
            },
        }
        results.write_text(folder.unfinished / results.CONFIG, dump(experiment.resolved))
        folder.publish(manifest)
        folder.drop_parts(names)


def plan(experiment: Experiment) -> list[Shard]:
    """The shards of an experiment, in the order in which they are merged."""
    shards = []
    blocks = -(-experiment.runs // BLOCK_RUNS)
    for case in range(len(experiment.cases)):
        for first in range(0, blocks, SHARD_BLOCKS):
            tasks = tuple(
                BlockTask(
                    case,
                    block,
                    min(BLOCK_RUNS, experiment.runs - block * BLOCK_RUNS),
                    experiment.keep_tracks if block == 0 else 0,
                )
                for block in range(first, min(first + SHARD_BLOCKS, blocks))
            )
            runs = sum(task.runs for task in tasks)
            shards.append(Shard(f"{case:04d}-{first // SHARD_BLOCKS:06d}-{runs}", tasks))
    return shards


def _shard_statistics(
    experiment: Experiment,
    folder: RunFolder,
    shards: list[Shard],
    workers: int,
    report: Report,
) -> Iterator[tuple[Shard, GroupStatistics, list[Track]]]:
    """Each shard's statistics in order, from disk or by running its blocks."""
    at_hand = {shard.name for shard in shards if folder.has_shard(shard.name)}
    tasks = [task for shard in shards if shard.name not in at_hand for task in shard.tasks]
    total = sum(shard.runs for shard in shards)
    done = 0
    block_results = in_order(lambda task, stop: run_block(experiment, task, stop), tasks, workers)
    try:
        for shard in shards:
            if shard.name in at_hand:
                group, tracks = folder.load_shard(shard.name, _unpack)
                done += shard.runs
                report(done, total)
            else:
                blocks = []
                for _ in shard.tasks:
                    blocks.append(next(block_results))
                    done += blocks[-1].task.runs
                    report(done, total)
                group = summarise(blocks[0])
                for block in blocks[1:]:
                    group = merge(group, summarise(block))
                tracks = [track for block in blocks for track in block.tracks]
                runs = outcomes.runs_table(experiment, blocks)
                folder.save_shard(shard.name, _pack(group, tracks), runs)
            yield shard, group, tracks
    finally:
        block_results.close()  # type: ignore[attr-defined]  # stops the threads


# ---- shards on disk --------------------------------------------------------------------------


def _pack(group: GroupStatistics, tracks: list[Track]) -> dict[str, Any]:
    keys = {
        "steps": [list(key) for key in group.steps],
        "windows": [list(key) for key in group.windows],
        "final_bins": list(group.final_bins),
        "delays": list(group.delays),
        "diverged": group.diverged,
        "tracks": [[t.run, t.estimator, t.quantity] for t in tracks],
    }
    return {
        "keys": np.array(json.dumps(keys)),
        "steps": np.array([list(moments) for moments in group.steps.values()]),
        "windows": np.array([list(moments) for moments in group.windows.values()], dtype=float),
        "tracks": np.array([track.values for track in tracks]),
        **{
            f"final_{field}": np.array([getattr(m, field) for m in group.final_bins.values()])
            for field in VectorMoments._fields
        },
        **{
            f"delays_{field}": np.array([getattr(d, field) for d in group.delays.values()])
            for field in Delays._fields
        },
    }


def _unpack(arrays: dict[str, Any]) -> tuple[GroupStatistics, list[Track]]:
    keys = json.loads(str(arrays["keys"]))
    steps = {(k[0], k[1]): Moments(*a) for k, a in zip(keys["steps"], arrays["steps"], strict=True)}
    windows = {
        (k[0], k[1], k[2]): SumMoments(*a)
        for k, a in zip(keys["windows"], arrays["windows"], strict=True)
    }
    bins = zip(*(arrays[f"final_{field}"] for field in VectorMoments._fields), strict=True)
    final_bins = {
        label: VectorMoments(*moments)
        for label, moments in zip(keys["final_bins"], bins, strict=True)
    }
    followed = zip(*(arrays[f"delays_{field}"] for field in Delays._fields), strict=True)
    delays = {
        label: Delays(detected, missed, unfinished, already, SumMoments(*false_switches))
        for label, (detected, missed, unfinished, already, false_switches) in zip(
            keys["delays"], followed, strict=True
        )
    }
    tracks = [
        Track(int(k[0]), str(k[1]), str(k[2]), a)
        for k, a in zip(keys["tracks"], arrays["tracks"], strict=True)
    ]
    return GroupStatistics(steps, windows, final_bins, delays, keys["diverged"]), tracks


# ---- what made it ----------------------------------------------------------------------------


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _manifest(experiment: Experiment) -> dict[str, Any]:
    packages = ("numpy", "scipy", "numba", "pyarrow", "pandas")
    return {
        "status": results.RUNNING,
        "name": experiment.name,
        "title": experiment.title,
        "seed": experiment.seed,
        "runs": experiment.runs,
        "digest": digest(experiment),
        "estimators": [chosen.label for chosen in experiment.estimators],
        "modes": list(experiment.bank.names),
        "windows": [window.name for window in experiment.windows],
        "compare_with": experiment.compare_with,
        "error": experiment.error,
        "states": experiment.states,
        "cases": len(experiment.cases),
        "versions": {
            "hybridtrack": __version__,
            "sources": source_digest(),
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in packages},
        },
        "git": _git(),
        "host": {
            "system": platform.platform(),
            "machine": platform.machine(),
            "processor": host_processor(),
        },
        "command": sys.argv[1:],
        "started": _now(),
    }


def _git() -> dict[str, Any] | None:
    """Commit of the checkout that the package runs from; None where it is none."""
    root = PACKAGE.parent
    if not (root / ".git").exists():
        return None
    try:
        commit, status = (
            subprocess.run(
                ["git", "-C", str(root), *command],
                capture_output=True,
                text=True,
                timeout=10,
                check=True,
            ).stdout.strip()
            for command in (["rev-parse", "HEAD"], ["status", "--porcelain"])
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return {"commit": commit, "dirty": bool(status)}
