"""Published claims: what they need, and whether the scenario can be held against them."""

from collections.abc import Iterator

from hybridtrack.config import checks
from hybridtrack.config.exact import exact_figure
from hybridtrack.config.nonlinear_form import AnyForm, NonlinearForm
from hybridtrack.config.reader import Document, Keys
from hybridtrack.config.schema import ClaimForm
from hybridtrack.containment import NOISE, set_metrics
from hybridtrack.description import ChosenEstimator
from hybridtrack.sensors import Sensor
from hybridtrack.simulation import Case
from hybridtrack.statistics import METRICS
from hybridtrack.verdicts import AnalysisClaim, Claim, printed_tolerance


def analysis_claim(i: int, form: AnyForm, document: Document) -> AnalysisClaim:
    """The i-th claim, on a figure of an analysis."""
    claim = form.published[i]
    path: Keys = ("published", i)
    assert claim.analysis is not None
    if claim.figure is None:
        raise document.error(
            path, "'figure' is missing in this claim: the column of the analysis' table; add it"
        )
    for key in ("estimator", "compare", "metric", "mode"):
        if getattr(claim, key) is not None:
            raise document.error(
                (*path, key), f"'{key}' is a run's, and this claim is on an analysis; see 'where'"
            )
    if claim.window != "all":
        raise document.error((*path, "window"), "'window' is a run's; remove it")
    if claim.than is None and (claim.value is None or claim.sign == "equal"):
        raise document.error(path, "'value' is missing in this claim on one figure; add it")
    if claim.than is not None and (
        claim.sign not in ("less", "greater") or claim.value is not None
    ):
        raise document.error(
            path, "a comparison with 'than' needs 'sign', less or greater, and no 'value'"
        )
    return AnalysisClaim(
        claim=claim.claim,
        analysis=claim.analysis,
        figure=claim.figure,
        where=claim.where or {},
        than=claim.than,
        value=claim.value,
        tolerance=_tolerance(claim, document, path),
        sign=claim.sign,
        expect=claim.expect,
        because=claim.because,
        place=str(document.error((*path, "figure"), "").args[0]).rstrip(": "),
    )


def built_claim(
    i: int,
    form: AnyForm,
    chosen: tuple[ChosenEstimator, ...],
    truth_modes: tuple[str, ...],
    cases: tuple[Case, ...],
    sensor: Sensor,
    document: Document,
) -> Claim:
    """The i-th claim: on one estimator, on two, or on the scenario alone."""
    claim = form.published[i]
    path: Keys = ("published", i)
    kinds = ("estimator", "compare", "figure")
    given = [kind for kind in kinds if getattr(claim, kind) is not None]
    if len(given) != 1:
        raise document.error(path, "a claim needs one of 'estimator', 'compare' and 'figure'")
    exact = None
    for key in ("where", "than"):
        if key == "where" and claim.figure is not None and isinstance(form, NonlinearForm):
            continue
        if getattr(claim, key) is not None:
            raise document.error(
                (*path, key),
                f"'{key}' is a row of an analysis' table; add 'analysis', or remove it",
            )
    if claim.figure is not None:
        _check_exact(claim, document, path)
        exact = exact_figure(claim, cases, sensor, document, path)
    else:
        _check_of_runs(claim, form, chosen, truth_modes, document, path)
    if claim.compare is None and claim.value is None:
        raise document.error(path, "'value' is missing in this claim on one figure; add it")
    signs = (None, "less", "greater") if exact is None else (None,)  # of a claim on one figure
    if claim.compare is None and claim.sign not in signs:
        raise document.error(
            (*path, "sign"), f"'sign' {claim.sign} has no place in this claim; remove it"
        )
    figure = claim.figure if claim.mode is None else f"{claim.figure} of {claim.mode}"
    if claim.where is not None:
        figure = f"{claim.figure} ({', '.join(f'{k} {v}' for k, v in claim.where.items())})"
    value = 1.0 if claim.sign == "equal" else claim.value
    return Claim(
        claim=claim.claim,
        estimator=claim.estimator,
        compare=None if claim.compare is None else (claim.compare[0], claim.compare[1]),
        metric=claim.metric or str(figure),
        window=claim.window,
        value=value,
        tolerance=_tolerance(claim, document, path),
        sign=claim.sign,
        expect=claim.expect,
        because=claim.because,
        exact=exact,
    )


def _check_exact(claim: ClaimForm, document: Document, path: Keys) -> None:
    for key, of_runs in (("metric", claim.metric is not None), ("window", claim.window != "all")):
        if of_runs:
            raise document.error(
                (*path, key), f"'{key}' is a run's, and 'figure' needs none; remove one of them"
            )


def _check_of_runs(
    claim: ClaimForm,
    form: AnyForm,
    chosen: tuple[ChosenEstimator, ...],
    truth_modes: tuple[str, ...],
    document: Document,
    path: Keys,
) -> None:
    """Estimators, metric and window that there are."""
    labels = ("raw", *form.estimators)
    if claim.metric is None:
        raise document.error(path, "'metric' is missing in this claim; add it")
    if claim.mode is not None:
        raise document.error((*path, "mode"), "'mode' belongs to a claim with 'figure'; remove it")
    for key, names in (("estimator", [claim.estimator]), ("compare", claim.compare or [])):
        for label in names:
            if label is not None and label not in labels:
                raise document.error(
                    (*path, key),
                    f"'{label}' is no estimator here; {checks.nearest(label, labels)}",
                )
            if label is not None and isinstance(form, NonlinearForm):
                _check_set_metric(label, claim.metric, form, document, path)
            elif label is not None:
                _check_metric(label, claim.metric, chosen, truth_modes, document, path)
    if claim.compare is not None and claim.compare[0] == claim.compare[1]:
        raise document.error(
            (*path, "compare"), f"'compare' names {claim.compare[0]} twice; name two estimators"
        )
    if claim.compare is not None and claim.sign is None:
        raise document.error(
            path, "'sign' is missing in this comparison; add less, greater or equal"
        )
    equal = claim.compare is not None and claim.sign == "equal"
    judged = claim.compare is not None and claim.value is not None
    if claim.tolerance is not None and claim.sign in ("less", "greater") and not judged:
        raise document.error(
            (*path, "tolerance"), f"'tolerance' has no part in a claim of {claim.sign}; remove it"
        )
    if equal and claim.tolerance == 0.0:
        raise document.error(
            (*path, "tolerance"), "'tolerance' is 0, which no two ever meet; make it larger"
        )
    if equal and claim.value is not None:
        raise document.error((*path, "value"), "'value' of two that are equal is 1; remove it")
    if equal and claim.tolerance is None:
        raise document.error(
            path,
            "'tolerance' is missing in this comparison; add how far from 1 the ratio of two that "
            "are equal may be, such as 0.05",
        )
    if claim.window != "all" and claim.window not in form.windows:
        raise document.error(
            (*path, "window"),
            f"window '{claim.window}' is not defined; "
            f"{checks.nearest(claim.window, ('all', *form.windows))}",
        )


def _check_metric(
    label: str,
    metric: str,
    chosen: tuple[ChosenEstimator, ...],
    truth_modes: tuple[str, ...],
    document: Document,
    path: Keys,
) -> None:
    """A metric that the estimator has: raw measurements are positions, one mode needs no guess."""
    known: tuple[str, ...] = ("position_",)
    for one in chosen:
        if one.label == label:
            known = (*known, "velocity_", *_of_modes(one, bool(truth_modes)))
    if not metric.startswith(known):
        there = ", ".join(name for name in METRICS if name.startswith(known))
        raise document.error(
            (*path, "metric"), f"'metric' is {metric}, which {label} doesn't have; it has {there}"
        )


def _check_set_metric(
    label: str, metric: str, form: NonlinearForm, document: Document, path: Keys
) -> None:
    """A metric of sets, of position where it is measured or estimated, or of the noise."""
    own = set_metrics(tuple(form.states), point_names(form))
    there = [name for name in own if (name in NOISE) == (label == "raw")]
    seen = form.measurement if label == "raw" else form.states
    there += [name for name in METRICS if name.startswith("position_") and {*"xy"} & {*seen}]
    if metric not in there:
        raise document.error(
            (*path, "metric"),
            f"'metric' is {metric}, which {label} doesn't have; it has {', '.join(there)}",
        )


def point_names(form: NonlinearForm) -> tuple[str, ...]:
    """Operating points by number, of the estimator that has the most."""
    most = max(len(getattr(one, "operating_points", ())) for one in form.estimators.values())
    return tuple(str(i + 1) for i in range(most))


def _of_modes(one: ChosenEstimator, truth: bool) -> Iterator[str]:
    """How the metrics of modes begin that an estimator has.

    Where several supermodes are one mode, there is no likelihood of that.
    """
    bounded = one.estimator.bound(one.settings).is_set
    if len(one.bank.modes) > 1 and not bounded and one.estimator.has_likelihoods:
        yield "likelihood_"
    if len(one.bank.modes) > 1 and truth:
        yield from ("mode_", "true_mode_")
    if bounded and truth:
        yield "final_mode_"


def _tolerance(claim: ClaimForm, document: Document, path: Keys) -> float:
    """As given, else half a unit of the last digit that is printed; a bound has none."""
    bound = claim.compare is None and claim.sign is not None
    if claim.tolerance is not None or claim.value is None or bound:
        return claim.tolerance or 0.0
    try:
        return printed_tolerance(document.source_text((*path, "value")) or "")
    except (ValueError, OverflowError):  # not in plain decimals
        return printed_tolerance(f"{claim.value:.15g}")
