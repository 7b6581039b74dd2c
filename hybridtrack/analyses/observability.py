"""Observability: can a bank tell its modes apart at all, and after how many scans?

Hwang, Balakrishnan, Tomlin 2003, section 2, asks whether the covariances of the outputs differ.
That is yes or no, and too easily yes: modes whose outputs differ a little may never be told apart.
The headline here is the number of scans after which the best test errs no more often than a target.

Without measurement noise (R = 0) the functions work, as in the paper's opening example; a scenario
can't have it, since filters can't.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from hybridtrack.analyses import Analysis, Measured
from hybridtrack.analyses._findings import Band, Chart, Findings, Line, Mark, Panel, Table
from hybridtrack.analyses._horizons import Horizon
from hybridtrack.analyses._observability_matrices import (
    RANK_TOLERANCE,
    SAME_TOLERANCE,
    ModeDynamics,
    initial_mode_test,
    initial_state_free_scan,
    joint_observability_index,
    mode_dynamics,
    observability_indices,
    transition_test,
    transition_test_as_printed,
    unseen_states,
)
from hybridtrack.analyses._pairs_of_modes import PairOfModes, Settings, Theory, theory
from hybridtrack.analyses._short_stretches import (
    count_of_scans,
    sortable,
    stretches,
    warnings_of,
)
from hybridtrack.description import Experiment
from hybridtrack.models import Array, JumpMarkovModel

MOST_CURVES = 6  # that one picture holds
MOST_SWITCHES = 3  # that a sentence names


def _analyse(experiment: Experiment, settings: Settings, measured: Measured | None) -> Findings:
    with np.errstate(over="ignore", invalid="ignore"):
        known = theory(experiment, settings)
        index = joint_observability_index(known.model)
        # Where a mode is unobservable its rank has stopped growing by n_x scans.
        scans = int(index) if math.isfinite(index) else len(known.model.state_names)
        table = _pairs_table(known, index, scans)
        modes = _modes_table(known.model)
    warned = list(warnings_of(experiment, known, settings.target_error))
    return Findings(
        table=table,
        conclusions=tuple(_conclusions(known, settings, warned)),
        notes=(
            *known.notes,
            *warned[1:],
            *_notes(known, settings, table, scans, experiment.initial.two_point),
        ),
        tables={"modes": modes, "stretches": _stretches_table(experiment, known)},
        charts=(_chart(known, settings),),
    )


def _pairs_table(known: Theory, index: float, scans: int) -> Table:
    rows = [_row(pair, index, scans, float(known.model.step_s[0])) for pair in known.pairs]
    columns: dict[str, list[Any]] = {name: [row[name] for row in rows] for name in rows[0]}
    shown = {
        "from": columns["from_mode"],
        "to": columns["to_mode"],
        "lemma 2,\n3, ours": [
            " ".join(_yes(row[name]) for name in ("lemma_2", "lemma_3_as_printed", "lemma_3"))
            for row in rows
        ],
        "theo-\nrem 1": [_yes(row["theorem_1"]) for row in rows],
        "any\nstart": [_free(value) for value in columns["initial_state_free_scan"]],
        "told apart:\nscans": [_bracketed(pair.horizon) for pair in known.pairs],
        "switch:\nscans": [_cell(pair.delay) for pair in known.pairs],
    }
    return Table(columns, shown)


def _row(pair: PairOfModes, index: float, scans: int, step_s: float) -> dict[str, Any]:
    old, new = pair.old, pair.new
    initial = initial_mode_test(old, new, scans)
    printed = transition_test_as_printed(old, new, scans)
    ours = transition_test(old, new, scans)
    observable = math.isfinite(index)
    row: dict[str, Any] = {
        "from_mode": old.name,
        "to_mode": new.name,
        "joint_observability_index": index,
        "lemma_2": initial.differ,
        "lemma_2_difference": initial.difference,
        "lemma_3_as_printed": printed.differ,
        "lemma_3_as_printed_difference": printed.difference,
        "lemma_3": ours.differ,
        "lemma_3_difference": ours.difference,
        "theorem_1_as_printed": observable and initial.differ and printed.differ,
        "theorem_1": observable and initial.differ and ours.differ,
        "initial_state_free_scan": initial_state_free_scan(old, new),
    }
    for name, found in (("horizon", pair.horizon), ("switch_delay", pair.delay)):
        row |= {
            f"{name}_lower_scans": found.lower,
            f"{name}_scans": found.exact,
            f"{name}_upper_scans": found.upper,
            f"{name}_s": None if found.exact is None else found.exact * step_s,
            f"{name}_because": found.because,
            f"{name}_last_error": found.last_error,
        }
    return row


def _modes_table(model: JumpMarkovModel) -> Table:
    indices = observability_indices(model)
    unseen = [
        unseen_states(mode.state_transition, mode.measurement_matrix, model.state_names)
        for mode in mode_dynamics(model)
    ]
    columns: dict[str, list[Any]] = {
        "mode": list(model.mode_names),
        "observability_index": list(indices),
        "unseen_states": [" ".join(names) for names in unseen],
    }
    shown = {
        "mode": list(model.mode_names),
        "observability index": ["none" if math.isinf(k) else f"{k:.0f}" for k in indices],
        "not in the outputs": columns["unseen_states"],
    }
    return Table(columns, shown)


def _stretches_table(experiment: Experiment, known: Theory) -> Table:
    by_names = {(pair.old.name, pair.new.name): pair for pair in known.pairs}
    legs = stretches(experiment)
    delays = [by_names.get((leg.before or "", leg.mode)) for leg in legs]
    horizons = []
    for leg in legs:
        of_mode = [p.horizon.exact for p in known.pairs if p.old.name == leg.mode]
        unsaid = not of_mode or None in of_mode
        horizons.append(None if unsaid else max(map(sortable, of_mode)))
    columns: dict[str, list[Any]] = {
        "case": [leg.case for leg in legs],
        "stretch": [leg.number for leg in legs],
        "mode": [leg.mode for leg in legs],
        "from_s": [leg.from_s for leg in legs],
        "until_s": [leg.until_s for leg in legs],
        "scans": [leg.scans for leg in legs],
        "switch_delay_scans": [None if pair is None else pair.delay.exact for pair in delays],
        "horizon_scans": horizons,
    }
    return Table(columns)


def _conclusions(known: Theory, settings: Settings, warned: Sequence[str]) -> Iterator[str]:
    error = f"{100 * settings.target_error:g} %"
    step_s = float(known.model.step_s[0])
    apart = [pair for pair in known.pairs if _index(known, pair.old) < _index(known, pair.new)]
    never = [p for p in apart if p.horizon.exact == math.inf]
    late = [p for p in apart if p.horizon.exact is None]
    for pair in never[:1]:
        more = f" (and {len(never) - 1} more such pairs)" if len(never) > 1 else ""
        yield (
            f"{pair.old.name} and {pair.new.name} can never be told apart at {error} error: "
            f"{pair.horizon.because}{more}."
        )
    for pair in late[:1]:
        more = f" (and {len(late) - 1} more such pairs)" if len(late) > 1 else ""
        yield (
            f"{pair.old.name} and {pair.new.name} are not told apart at {error} error "
            f"{pair.horizon.because.removeprefix('not ')}: the best test then still errs in "
            f"{100 * pair.horizon.last_error:.3g} % of cases{more}."
        )
    rest = [p for p in apart if p.horizon.exact is not None and p.horizon.exact < math.inf]
    if rest:
        slow = max(rest, key=lambda p: sortable(p.horizon.exact))
        exact = sortable(slow.horizon.exact)
        hardest = " (the hardest such pair)" if len(rest) > 1 else ""
        yield (
            f"From `initial`, {slow.old.name} and {slow.new.name} are told apart at {error} error "
            f"after {count_of_scans(exact)}, {exact * step_s:.4g} s{hardest}; no estimator does it "
            "sooner, even if the bank's models are true."
        )
    switches = [p for p in known.pairs if sortable(p.delay.exact) < math.inf]
    missed = [p for p in known.pairs if p not in switches]
    if switches:
        slow = max(switches, key=lambda p: sortable(p.delay.exact))
        exact = sortable(slow.delay.exact)
        yield (
            f"A switch from {slow.old.name} to {slow.new.name} is noticed at {error} error after "
            f"{count_of_scans(exact)}, {exact * step_s:.4g} s, at the soonest"
            + (
                " (the slowest of those that are noticed)"
                if missed
                else " (no switch takes longer)"
            )
            + (f"; not noticed: {_switches(missed)}." if missed else ".")
        )
    else:
        yield f"No switch is noticed at {error} error: {_switches(missed)}."
    if warned:
        more = f" (and {len(warned) - 1} more such, in the notes)" if len(warned) > 1 else ""
        yield f"Mind: {warned[0]}{more}."


def _switches(missed: Sequence[PairOfModes]) -> str:
    """Those that are never noticed, and those that aren't within the scans looked at."""
    never = [pair for pair in missed if pair.delay.exact == math.inf]
    late = [pair for pair in missed if pair.delay.exact is None]
    said = []
    for pairs, when in (
        (never, "never"),
        (late, f"within {count_of_scans(max((p.delay.looked_at for p in late), default=0))}"),
    ):
        if pairs:
            named = ", ".join(f"{p.old.name} to {p.new.name}" for p in pairs[:MOST_SWITCHES])
            more = f" and {len(pairs) - MOST_SWITCHES} more" if len(pairs) > MOST_SWITCHES else ""
            said.append(f"{named}{more} ({when})")
    return "; ".join(said)


def _index(known: Theory, mode: ModeDynamics) -> int:
    return known.model.mode_names.index(mode.name)


def _notes(
    known: Theory, settings: Settings, table: Table, scans: int, two_point: bool
) -> Iterator[str]:
    model = known.model
    # Filters that start from two scans say so in a note of their own.
    if not two_point:
        at = "at the first scan" if settings.initial_at_first_scan else "one step before the first"
        yield f"`initial` is the state {at}, and its mean and covariance decide much"
    elif settings.initial_at_first_scan:
        yield "initial_at_first_scan isn't used, since filters start from two scans"
    yield (
        "both modes are equally probable beforehand, nothing is missed, and the noises are what "
        "the bank believes"
    )
    yield (
        "a horizon is exact by numerical inversion, and in brackets the soonest and the latest by "
        "the Bhattacharyya and Chernoff bounds; >N means not within the N scans looked at, and "
        "... an end of the bracket beyond them; never: proven, or outputs alike to rounding"
    )
    yield (
        "a switch is looked for with the old mode's settled filter, whose mean is spread as "
        "`initial` is, by a test that knows when the switch took place, if it did; the new mode "
        "drives the step to the first scan counted"
    )
    if _share_outputs(model):
        yield (
            "lemma 3 as printed lets the old mode drive the state to the scan of the transition: "
            "all modes here share H and R, so that it is identically violated, and theorem 1 with "
            "it; lemma 3 ours, and theorem 1 here, have the new mode drive that step, as "
            "everywhere in this package"
        )
    else:
        yield (
            "lemma 3 as printed lets the old mode drive the state to the scan of the transition, "
            "so that modes which share H and R never pass it; lemma 3 ours, and theorem 1 here, "
            "have the new mode drive that step, as everywhere in this package"
        )
    indices = observability_indices(model)
    if math.isinf(max(indices)):
        named = zip(model.mode_names, indices, strict=True)
        unseen = ", ".join(name for name, index in named if math.isinf(index))
        yield (
            f"{unseen}: not every state is in the outputs (table modes), so that the premise of "
            "lemma 2 fails and theorem 1 with it"
        )
    yield (
        f"lemma 2 compares the outputs of {count_of_scans(scans)}, lemma 3 those of the scan of a "
        f"transition {scans} after the first; all take `initial` at the first scan"
    )
    yield (
        "any start: the scan from which noises and inputs alone tell the modes apart, whatever "
        f"their states; alike: equal to {SAME_TOLERANCE:g} over all scans that could show a "
        "difference"
    )
    yield (
        f"ranks (columns normalised) hold to {RANK_TOLERANCE:g} of the largest singular value, "
        f"equal covariances to {SAME_TOLERANCE:g} of the variance in any direction"
    )
    by_lemma = list(zip(known.pairs, table.columns["lemma_2"], strict=True))
    alike = [p for p, differ in by_lemma if not differ and sortable(p.horizon.exact) < math.inf]
    if alike:
        yield _why_alike(alike[0], scans)
    apart = [p for p, differ in by_lemma if differ and p.horizon.exact == math.inf]
    if apart:
        yield (
            f"lemma 2 calls {apart[0].old.name} and {apart[0].new.name} distinguishable, since "
            "their covariances differ; yet no number of scans tells them apart at the target"
        )
    if np.any(model.input_effect) or np.any(model.initial_mean):
        yield "the lemmas compare covariances only; horizons and delays use means and inputs too"


def _share_outputs(model: JumpMarkovModel) -> bool:
    """Whether all modes have the same H and R."""
    H, R = model.measurement_matrix, model.measurement_noise_covariance
    return bool((H[0] == H).all() and (R[0] == R).all())


def _why_alike(pair: PairOfModes, scans: int) -> str:
    """Why lemma 2 finds two modes alike that are told apart after some scans."""
    says = f"lemma 2 finds {pair.old.name} and {pair.new.name} alike"
    needed = int(sortable(pair.horizon.exact))
    if needed > scans and initial_mode_test(pair.old, pair.new, needed).differ:
        return (
            f"{says} by the covariances of {count_of_scans(scans)}; those of {needed} scans differ"
        )
    return (
        f"{says}, which compares covariances with `initial` at the first scan; they are told "
        "apart by their means, or by the step that leads to the first scan"
    )


def _chart(known: Theory, settings: Settings) -> Chart:
    apart = [pair for pair in known.pairs if _index(known, pair.old) < _index(known, pair.new)]
    hardest = sorted(apart, key=lambda p: -sortable(p.horizon.exact))[:MOST_CURVES]
    found = [pair.horizon for pair in hardest if sortable(pair.horizon.exact) < math.inf]
    # Curves that never get there would squeeze the others.
    ends = [f.curve.scans[-1] for f in found if f.curve is not None and f.curve.scans.size]
    end = max(ends, default=math.inf)
    lines, bands = [], []
    for pair in hardest:
        label, curve = f"{pair.old.name} or {pair.new.name}", pair.horizon.curve
        if curve is None or not curve.scans.size:  # told apart by the first scan, with certainty
            continue
        x, lower, exact, upper = (part[curve.scans <= end] for part in curve)
        lines.append(Line(label, x, _positive(exact)))
        bands.append(Band(label, x, _positive(lower), _positive(upper)))
    panel = Panel(
        "probability of error",
        lines=lines,
        bands=bands,
        marks=(Mark(f"target {100 * settings.target_error:g} %", y=settings.target_error),),
        log_y=True,
    )
    left = len(apart) - len(hardest)
    caption = "How often the best test between two modes errs, within its bounds"
    if left:
        caption += f"; the {MOST_CURVES} hardest of {len(apart)} pairs"
    return Chart("error_over_scans", caption, "scans", (panel,))


def _positive(error: Array) -> Array:
    """A logarithmic axis has no 0."""
    return np.where(error > 0.0, error, np.nan)


def _yes(passed: bool) -> str:
    return "yes" if passed else "no"


def _free(scan: float) -> str:
    return "alike" if math.isinf(scan) else f"{scan:.0f}"


def _cell(found: Horizon) -> str:
    if found.exact is None:
        return f">{found.looked_at}"
    return "never" if math.isinf(found.exact) else f"{found.exact:.0f}"


def _bracketed(found: Horizon) -> str:
    """With what the bounds say; an end of the bracket that isn't known is '...'."""
    if found.lower is None or math.isinf(found.lower):
        return _cell(found)
    upper = "..." if found.upper is None else f"{found.upper:.0f}"
    return f"{_cell(found)} ({found.lower:.0f}-{upper})"


ANALYSIS = Analysis(
    name="observability",
    summary="can the bank tell its modes apart, and after how many scans",
    source="Hwang, Balakrishnan, Tomlin 2003, section 2",
    settings=Settings,
    analyse=_analyse,
    example="observability_turns",
    limits={"target_error": (1e-12, 0.49), "most_scans": (1.0, 1000.0)},
)
