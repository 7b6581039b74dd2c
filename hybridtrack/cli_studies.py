"""The commands about more than one run, or none: baseline, check, analyze."""

from pathlib import Path
from typing import Annotated

import typer

from hybridtrack.console import command, say
from hybridtrack.errors import Unsuited, UserError
from hybridtrack.options import (
    Detect,
    Json,
    Quiet,
    Runs,
    ScenarioOrRun,
    Seed,
    Settings,
    Workers,
    exact_run,
    finished_run,
    is_run,
    load_scenario,
)


@command(
    "hybridtrack baseline softbound_ex1 -o tests/baselines/softbound_ex1.parquet --runs 1000",
    "hybridtrack baseline my_scenario.yaml -o my_scenario.parquet --detect 1%",
)
def baseline(
    config: ScenarioOrRun,
    output: Annotated[Path, typer.Option("--output", "-o", help="The baseline's file.")],
    runs: Runs = None,
    seed: Seed = None,
    detect: Detect = None,
    workers: Workers = None,
    set_: Settings = None,
    quiet: Quiet = False,
) -> None:
    """Write a baseline, which `check` compares with.

    It is a file to be committed: the summary and, so that runs of one seed can be paired, every
    run's sums.
    """
    from hybridtrack.studies import baselines

    folder = finished_run(config, set_ or (), runs, seed, detect, workers, quiet)
    if output.resolve().parent == folder.resolve():
        raise UserError(f"{output}: this lies in the run's own folder; name a file elsewhere")
    baselines.write(folder, output)
    print(output)


@command(
    "hybridtrack check softbound_ex1 --against tests/baselines/softbound_ex1.parquet",
    "hybridtrack check runs/softbound_ex1-0123456789 --against softbound_ex1.parquet --junit r.xml",
)
def check(
    config: ScenarioOrRun,
    against: Annotated[Path, typer.Option(metavar="BASELINE", help="What `baseline` wrote.")],
    runs: Annotated[
        int | None, typer.Option(help="Monte Carlo runs; the baseline's by default.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Random seed; the baseline's by default, to be paired.")
    ] = None,
    detect: Detect = None,
    family_error: Annotated[
        float, typer.Option(help="Chance that any figure cries wolf, or a detectable change isn't.")
    ] = 1e-6,
    workers: Workers = None,
    set_: Settings = None,
    all_: Annotated[bool, typer.Option("--all", help="Print every window's figures.")] = False,
    json: Json = False,
    junit: Annotated[Path | None, typer.Option(help="Write JUnit XML to this file.")] = None,
    markdown: Annotated[Path | None, typer.Option(help="Write a Markdown table to it.")] = None,
    quiet: Quiet = False,
) -> None:
    """Compare a run with a baseline.

    Exits with 1 if any figure is worse. With the baseline's seed runs are compared pair by pair,
    and the same sources on the same kind of machine have to give the same figures. Otherwise every
    figure is tested, with the chance that any of them cries wolf bounded.
    """
    from hybridtrack.studies import baselines, reports

    if not 1e-12 <= family_error <= 0.5:
        raise UserError(f"--family-error {family_error:g}: give a chance from 1e-12 to 0.5")
    for file in (junit, markdown):
        if file is not None and file.resolve() == against.resolve():
            raise UserError(f"{file}: this is the baseline itself; name another file")
    wanted = baselines.read(against)
    if not is_run(config):
        if detect is not None and seed in (None, wanted.seed):
            raise UserError(
                f"--detect {detect}: with the baseline's own seed only its {wanted.runs:,} runs "
                "are compared, pair by pair; give another with --seed"
            )
        runs = wanted.runs if runs is None and detect is None else runs
        seed = wanted.seed if seed is None else seed
    folder = finished_run(config, set_ or (), runs, seed, detect, workers, quiet)
    report = reports.held_against(folder, wanted, family_error)
    for file, text in ((junit, reports.as_junit), (markdown, reports.as_markdown)):
        if file is not None:
            _put(file, text(report))
    print(reports.as_json(report) if json else reports.as_text(report, everything=all_), end="")
    if report.failed:
        raise typer.Exit(1)


def _put(file: Path, text: str) -> None:
    """Write a report: whole or not at all, but into what is no regular file, such as a pipe."""
    from hybridtrack.results import write_text

    if file.exists() and not file.is_file() and not file.is_dir():
        with file.open("a", encoding="utf-8") as stream:
            stream.write(text)
    else:
        write_text(file, text)


@command(
    "hybridtrack analyze delay",
    "hybridtrack analyze delay my_scenario.yaml --runs 500",
    "hybridtrack analyze delay mode_delay_fig4 --as-printed --out delays",
)
def analyze(
    analysis: Annotated[str, typer.Argument(help="See `hybridtrack list analyses`.")],
    config: Annotated[
        str | None,
        typer.Argument(help="A scenario's file, or a shipped one's name; the paper's by default."),
    ] = None,
    runs: Runs = None,
    seed: Seed = None,
    workers: Workers = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder instead of runs/NAME-ANALYSIS-DIGEST.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Repeat what is there.")] = False,
    as_printed: Annotated[
        bool, typer.Option("--as-printed", help="Formulas as the paper prints them, too.")
    ] = False,
    set_: Settings = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Say what theory says of a scenario's modes.

    Prints a table and what to conclude from it, and writes both with figures into a folder. An
    analysis that compares with a Monte Carlo run makes it first, or takes the one that is there.
    """
    from hybridtrack import tables_of_analyses
    from hybridtrack.analyses import analyses
    from hybridtrack.config import located, nearest
    from hybridtrack.studies import analysis as studies

    known = analyses()
    if analysis not in known:
        raise UserError(f"there is no analysis '{analysis}'; {nearest(analysis, tuple(known))}")
    chosen = known[analysis]
    if config is None:
        config = chosen.example
        if not quiet:
            say(f"no scenario given: this is {config}, which `hybridtrack list scenarios` has")
    settings = list(set_ or ())
    if as_printed:
        if "as_printed" not in chosen.settings._fields:
            raise UserError(
                f"--as-printed: {analysis} has what is printed beside what is right already; leave "
                "it out"
            )
        settings.append(f"analyses.{chosen.key}.as_printed=true")
    try:
        experiment = load_scenario(config, settings, runs, seed)
        chosen.check(experiment)
        if chosen.wants_run is not None:
            wanted = chosen.wants_run(experiment)
            if wanted:
                experiment = load_scenario(config, [*settings, *wanted], runs, seed)
        folder = out if out is not None else studies.default_folder(experiment, chosen)
        if force:
            studies.forget(folder)
        record = studies.finished(experiment, chosen, folder)
        if record is None:
            run = None
            if chosen.wants_run is not None:
                run = exact_run(experiment, workers, quiet)
            record = studies.analyse(experiment, chosen, folder, run)
        elif not quiet:
            say(f"complete already: {folder} is shown, not repeated (--force repeats it)")
    except Unsuited as error:
        raise located(config, settings, error.keys, str(error)) from None
    for sentence in tables_of_analyses.surprises_of(record):
        say(f"warning: {sentence}")
    if json:
        import json as encoder

        print(encoder.dumps({"folder": str(folder), **record}, indent=2, allow_nan=False))
        return
    from rich.console import Console

    tables_of_analyses.show_analysis(record, Console(highlight=False))
    if record["figures"]:
        print(f"figures: {folder / 'figures'}")
    print(folder)
