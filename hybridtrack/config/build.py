"""From a valid form to the Experiment that runs: checks across keys, and everything in arrays."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hybridtrack.analyses import analyses
from hybridtrack.config import banks, checks, starts, truths
from hybridtrack.config.claims import analysis_claim, built_claim
from hybridtrack.config.nonlinear_form import AnyForm
from hybridtrack.config.reader import Document, Keys, ScenarioError
from hybridtrack.config.schema import ScenarioForm, WindowForm
from hybridtrack.description import ChosenEstimator, Experiment, Initial, Window
from hybridtrack.errors import UserError
from hybridtrack.estimators import estimators
from hybridtrack.models import Array, ModeBank
from hybridtrack.sensors import Sensor
from hybridtrack.simulation import Case, FixedTruth
from hybridtrack.verdicts import AnalysisClaim, Claim

Claims = tuple[tuple[Claim, ...], tuple[AnalysisClaim, ...]]  # on runs, on analyses


def build(form: ScenarioForm, document: Document, folder: Path) -> Experiment:
    """The experiment of a form. Raises ScenarioError about what doesn't fit together."""
    bank = banks.bank(form, form, document, ())
    truth_modes, cases = truths.cases(form, bank, document, folder)
    steps = [np.diff(case.times_s) for case in cases]
    initial = starts.initial(form.initial, bank, document, ("initial",))
    if initial.two_point and any(len(s) < 3 for s in steps):
        raise document.error(
            ("initial", "from_measurements"), "a start from two scans needs three steps or more"
        )
    _check_recorded(form, cases, initial, document)
    banks.try_out(bank, steps, document, ())
    chosen = tuple(
        _estimator(label, form, bank, truth_modes, steps, document) for label in form.estimators
    )
    if form.compare_with is not None and form.compare_with not in form.estimators:
        raise document.error(
            ("compare_with",),
            f"'compare_with' is {form.compare_with}, which is no estimator here; "
            f"{checks.nearest(form.compare_with, tuple(form.estimators))}",
        )
    windows = window_of(form, truth_modes, cases, document)
    sensor = truths.sensor(form, truth_modes, cases, initial.two_point, document)
    claims = claims_of(form, chosen, truth_modes, cases, sensor, document)
    return Experiment(
        name=form.name,
        title=form.title or form.name,
        source=form.source,
        assumptions=tuple(form.assumptions),
        cases=cases,
        truth_modes=truth_modes,
        bank=bank,
        sensor=sensor,
        initial=initial,
        estimators=chosen,
        compare_with=form.compare_with,
        error=form.scoring.error,
        windows=windows,
        runs=form.monte_carlo.runs,
        seed=form.monte_carlo.seed,
        keep_tracks=min(form.monte_carlo.keep_tracks, form.monte_carlo.runs),
        claims=claims[0],
        analysis_claims=claims[1],
        analyses=analyses_of(form),
        resolved=_resolved(form, claims, folder),
    )


def _check_recorded(
    form: ScenarioForm, cases: tuple[Case, ...], initial: Initial, document: Document
) -> None:
    """Recorded measurements leave nothing to draw, and no truth to start from but a reference's."""
    for case in cases:
        if case.recorded is None:
            continue
        if form.monte_carlo.runs > 1:
            raise document.error(
                ("monte_carlo", "runs"),
                "recorded measurements are the same in every run; set 'runs' to 1",
            )
        if form.sensor.detection_probability < 1.0 or form.sensor.outliers is not None:
            key = "detection_probability" if form.sensor.outliers is None else "outliers"
            raise document.error(
                ("sensor", key),
                f"recorded measurements are taken as they are; remove '{key}' from the sensor",
            )
        assert isinstance(case.truth, FixedTruth)
        if initial.follows_truth and np.isnan(case.truth.state[0]).any():
            raise document.error(
                ("initial", "mean"),
                f"the truth at the first scan of '{case.name}' is unknown, so no filter can start "
                "there; give 'from_measurements: two_point' instead",
            )


def _check_modes_can_be_told(
    label: str, truth_modes: tuple[str, ...], bank: ModeBank, document: Document
) -> None:
    """The genie needs a truth with modes, all of them its own."""
    path: Keys = ("estimators", label, "type")
    if not truth_modes:
        raise document.error(
            path, f"'{label}' is told the true modes, and a recording has none; remove it"
        )
    unknown = [name for name in truth_modes if name not in bank.names]
    if unknown:
        raise document.error(
            path,
            f"'{label}' is told the true modes, and has no '{unknown[0]}' among its own "
            f"({', '.join(bank.names)}); remove it, or call the modes alike",
        )


def _estimator(
    label: str,
    form: ScenarioForm,
    bank: ModeBank,
    truth_modes: tuple[str, ...],
    steps_s: Sequence[Array],
    document: Document,
) -> ChosenEstimator:
    checks.label(label, document)
    chosen: Any = form.estimators[label]
    estimator = estimators()[chosen.type]
    values = {key: value for key, value in chosen if key != "type"}
    if "mode" in values:
        path: Keys = ("estimators", label, "mode")
        checks.known_mode(values["mode"], tuple(form.modes), document, path)
        bank = banks.single_mode_bank(values["mode"], form, document)
    settings = estimator.settings(**values)
    if estimator.is_told_modes(settings):
        _check_modes_can_be_told(label, truth_modes, bank, document)
    try:
        estimator.prepare(settings, banks.try_out(bank, steps_s, document, ()))
    except ScenarioError:
        raise
    except UserError as error:
        sentence = f"'{label}': {str(error).rstrip('.')}"
        raise document.error(("estimators", label), sentence) from None
    return ChosenEstimator(label, estimator, settings, bank)


def analyses_of(form: AnyForm) -> dict[str, Any]:
    """The settings of every analysis, by its name."""
    return {
        name: one.settings(**dict(getattr(form.analyses, one.key)))
        for name, one in analyses().items()
    }


def claims_of(
    form: AnyForm,
    chosen: tuple[ChosenEstimator, ...],
    truth_modes: tuple[str, ...],
    cases: tuple[Case, ...],
    sensor: Sensor,
    document: Document,
) -> Claims:
    """Claims on runs, and on analyses."""
    of_runs = tuple(
        built_claim(i, form, chosen, truth_modes, cases, sensor, document)
        for i, claim in enumerate(form.published)
        if claim.analysis is None
    )
    of_analyses = tuple(
        analysis_claim(i, form, document)
        for i, claim in enumerate(form.published)
        if claim.analysis is not None
    )
    return of_runs, of_analyses


def window_of(
    form: AnyForm, truth_modes: tuple[str, ...], cases: tuple[Case, ...], document: Document
) -> tuple[Window, ...]:
    """The scenario's windows, after that of all scored steps."""
    most = max(len(case.times_s) - 1 for case in cases)
    if form.scoring.skip_scans >= most:
        raise document.error(
            ("scoring", "skip_scans"),
            f"'skip_scans' is {form.scoring.skip_scans} of {most} scans; leave some to be scored",
        )
    windows = [Window("all", skip_scans=form.scoring.skip_scans)]
    for name, window in form.windows.items():
        windows.append(_window(name, window, form, truth_modes, document))
        _check_span(name, window, cases, document)
    return tuple(windows)


def _window(
    name: str,
    window: WindowForm,
    form: AnyForm,
    truth_modes: tuple[str, ...],
    document: Document,
) -> Window:
    path: Keys = ("windows", name)
    if name == "all":
        raise document.error(path, "'all' is every scored step already; call it otherwise")
    after_s, within_s = window.after_switch_s, window.within_switch_s
    if not truth_modes and (after_s, within_s) != (None, None):
        raise document.error(
            path, "the truth has no modes here that could switch; use 'from_s' and 'until_s'"
        )
    if after_s is not None and within_s is not None and after_s >= within_s:
        raise document.error(
            (*path, "after_switch_s"),
            f"no step is both after {after_s:g} s and within {within_s:g} s of a switch; lower "
            "'after_switch_s'",
        )
    mode = None
    if window.mode is not None:
        checks.known_mode(window.mode, truth_modes, document, (*path, "mode"))
        mode = truth_modes.index(window.mode)
    return Window(
        name,
        -np.inf if window.from_s is None else window.from_s,
        np.inf if window.until_s is None else window.until_s,
        mode,
        after_s,
        within_s,
        form.scoring.skip_scans,
    )


def _check_span(name: str, window: WindowForm, cases: tuple[Case, ...], document: Document) -> None:
    """A window that some scan can lie in."""
    first = min(float(case.times_s[1]) for case in cases)
    last = max(float(case.times_s[-1]) for case in cases)
    path: Keys = ("windows", name)
    begin, end = truths.span(window.from_s, window.until_s, document, path)
    if begin > last or end < first:
        raise document.error(
            path, f"window '{name}' holds no scan: they last from {first:g} to {last:g} s; move it"
        )


def written(form: AnyForm, claims: Claims) -> dict[str, Any]:
    """The form as a scenario has it, with tolerances that were printed digits written out."""
    data = form.model_dump(by_alias=True, exclude_none=True)
    data["analyses"] = form.analyses.model_dump(exclude_defaults=True)
    of_runs, of_analyses = iter(claims[0]), iter(claims[1])
    for claimed in data["published"]:
        if "analysis" in claimed:
            figure = next(of_analyses)
            judged = figure.value is not None and figure.sign is None
            tolerance = figure.tolerance
        else:
            claim = next(of_runs)
            judged = claim.value is not None and (claim.sign is None or claim.compare is not None)
            tolerance = claim.tolerance
        if judged:
            claimed["tolerance"] = tolerance
    return data


def _resolved(form: ScenarioForm, claims: Claims, folder: Path) -> dict[str, Any]:
    data = written(form, claims)
    recording = data["truth"].get("recording", {})
    for holder in (recording, recording.get("reference", {})):
        if "file" in holder and "package" not in holder:
            holder["file"] = str((folder / holder["file"]).resolve())
    return {key: value for key, value in data.items() if value not in ("", [], {})}
