"""Baselines: what a run's figures were, small enough to commit, whole enough to be paired with.

A baseline is one Parquet file. Its rows are those of the run's runs.parquet, a row group a shard,
without the quantities that the scenario doesn't have; its metadata say what made them.
"""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from hybridtrack import columns, results
from hybridtrack.config import load
from hybridtrack.errors import UserError
from hybridtrack.statistics import QUANTITIES

RENEW = "renew it with `hybridtrack baseline`"
KEY = b"hybridtrack_baseline"
FORM = 1  # of the file, for later readers
# Of the resolved scenario, what only tells of it, or is about no run.
TOLD = ("title", "source", "assumptions", "published", "analyses")


class Baseline(NamedTuple):
    """What a baseline says of itself."""

    path: Path
    name: str
    digest: str  # of the run folder: scenario and sources
    scenario: dict[str, Any]  # as resolved, without what only tells of it
    seed: int
    runs: int
    made: dict[str, str]  # versions and machine: where they are the same, so are the bytes
    summary: list[dict[str, Any]]
    remedy: str = RENEW  # should its rows be damaged

    def shards(self) -> Iterator[pa.Table]:
        """The rows, shard by shard. Raises UserError where they are damaged."""
        yield from results.row_groups(self.path, None, self.remedy)


def describe(folder: Path) -> Baseline:
    """A finished run as a baseline has it; its shards are read from the folder's runs.parquet."""
    manifest = results.require_complete(folder)
    experiment = load(folder / results.CONFIG)
    scenario = experiment.resolved
    monte_carlo = {k: v for k, v in scenario["monte_carlo"].items() if k not in ("runs", "seed")}
    kept = {k: v for k, v in scenario.items() if k not in TOLD} | {"monte_carlo": monte_carlo}
    kept = json.loads(json.dumps(kept))
    recording = kept["truth"].get("recording", {})
    for holder in (recording, recording.get("reference", {})):
        if "package" not in holder:
            holder.pop("file", None)  # lies elsewhere on another machine
    if recording:  # by its times, since smoothed positions depend on the machine's last bits
        times = hashlib.sha256(b"".join(case.times_s.tobytes() for case in experiment.cases))
        recording["times"] = times.hexdigest()[:16]
    versions = manifest.get("versions", {})
    made = {name: str(versions[name]) for name in sorted(versions) if name != "pandas"}
    host = manifest.get("host", {})
    made |= {name: str(host.get(name)) for name in ("system", "machine", "processor")}
    return Baseline(
        folder / "runs.parquet",
        manifest["name"],
        manifest["digest"],
        kept,
        manifest["seed"],
        manifest["runs"],
        made,
        results.read_rows(folder, "summary"),
        results.REPEAT,
    )


def write(folder: Path, file: Path) -> None:
    """Make a baseline of a finished run. Raises UserError where either can't be read or written."""
    told = describe(folder)
    facts = {
        "form": FORM,
        "name": told.name,
        "digest": told.digest,
        "scenario": told.scenario,
        "seed": told.seed,
        "runs": told.runs,
        "made": told.made,
        "summary": told.summary,
    }
    absent = _absent(told)
    results.make_folder(file.parent)
    writer: pq.ParquetWriter | None = None
    with results.replacing(file) as temporary:
        try:
            for shard in told.shards():
                table = shard.drop_columns(absent)
                if writer is None:
                    writer = columns.writer(temporary, table.schema)
                    writer.add_key_value_metadata({KEY.decode(): json.dumps(facts)})
                writer.write_table(table, row_group_size=table.num_rows)
        finally:
            if writer is not None:
                writer.close()


def _absent(told: Baseline) -> list[str]:
    """Columns of quantities that no row has."""
    present: set[str] = set()
    for shard in told.shards():
        present |= {q for q in QUANTITIES if columns.as_numpy(shard[f"{q}_count"]).any()}
    return [f"{q}_{kind}" for q in QUANTITIES if q not in present for kind in ("sum", "count")]


def read(file: Path) -> Baseline:
    """What a baseline says of itself. Raises UserError where the file is none, or damaged."""
    try:
        metadata = pq.read_metadata(file)
        facts = json.loads((metadata.metadata or {})[KEY])
        if facts["form"] != FORM:
            raise UserError(
                f"{file}: this baseline is of form {facts['form']} and this version reads {FORM}; "
                "renew it with `hybridtrack baseline`"
            )
        if not metadata.num_rows:
            raise UserError(f"{file}: this baseline holds no run; renew it")
        names = ("name", "digest", "scenario", "seed", "runs", "made", "summary")
        return Baseline(file, *(facts[name] for name in names))
    except FileNotFoundError:
        raise UserError(
            f"{file}: there is no such baseline; make it with `hybridtrack baseline`"
        ) from None
    except KeyError:
        raise UserError(
            f"{file}: this Parquet file is no baseline; make one with `hybridtrack baseline`"
        ) from None
    except results.DAMAGE as error:
        said = " ".join(str(error).split()).rstrip(".")
        raise UserError(f"{file}: this baseline is damaged ({said}); renew it") from None
