"""Observability: can a bank tell its modes apart at all, and after how many scans?

Hwang, Balakrishnan, Tomlin 2003, section 2, asks whether the covariances of the outputs differ.
That is yes or no, and too easily yes: modes whose outputs differ a little may never be told apart.
The headline here is the number of scans after which the best test errs no more often than a target.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from hybridtrack.analyses import Analysis, Measured
from hybridtrack.analyses._findings import Band, Chart, Findings, Line, Mark, Panel, Table
from hybridtrack.analyses._horizons import Horizon
from hybridtrack.analyses._observability_matrices import (
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
        notes=(*known.notes, *warned[1:], *_notes(known, settings, table, scans)),
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
        "any start:\nscan": [_cell(value) for value in columns["initial_state_free_scan"]],
        "told apart:\nscans": [_bracketed(pair.horizon) for pair in known.pairs],
        "switch:\nscans": [_cell(pair.delay.exact) for pair in known.pairs],
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
        "index": [_cell(value) for value in indices],
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
    switches = [p for p in known.pairs if 0.0 < sortable(p.delay.exact) < math.inf]
    if switches:
        slow = max(switches, key=lambda p: sortable(p.delay.exact))
        exact = sortable(slow.delay.exact)
        yield (
            f"A switch from {slow.old.name} to {slow.new.name} is noticed at {error} error after "
            f"{count_of_scans(exact)}, {exact * step_s:.4g} s, at the soonest"
            + (" (the slowest that is noticed)." if len(known.pairs) > 1 else ".")
        )
    if warned:
        more = f" (and {len(warned) - 1} more such, in the notes)" if len(warned) > 1 else ""
        yield f"Mind: {warned[0]}{more}."


def _index(known: Theory, mode: ModeDynamics) -> int:
    return known.model.mode_names.index(mode.name)


def _notes(known: Theory, settings: Settings, table: Table, scans: int) -> Iterator[str]:
    model = known.model
    when = "at the first scan" if settings.initial_at_first_scan else "one step before the first"
    yield (
        f"`initial` is the state {when}, and its mean and covariance decide much; both modes are "
        "equally probable beforehand, nothing is missed, and the noises are what the bank believes"
    )
    yield (
        "a horizon is (soonest - latest) by the Bhattacharyya and Chernoff bounds, and exact by "
        "numerical inversion; inf means never, an empty cell that it lies beyond the scans looked "
        "at"
    )
    yield (
        "a switch is looked for with the old mode's settled filter, whose mean is spread as "
        "`initial` is; the new mode drives the step to the first scan counted"
    )
    printed, ours = table.columns["lemma_3_as_printed"], table.columns["lemma_3"]
    if list(printed) != list(ours):
        yield (
            "lemma 3 as printed lets the old mode drive the state to the scan of the transition, "
            "so that modes which share H and R never pass it; column lemma_3 has it with the new "
            "mode driving that step, as everywhere in this package"
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
        f"the lemmas compare the outputs of {count_of_scans(scans)}; ranks (columns normalised) "
        f"and equality hold to {SAME_TOLERANCE:g} of the larger"
    )
    by_lemma = list(zip(known.pairs, table.columns["lemma_2"], strict=True))
    alike = [p for p, differ in by_lemma if not differ and sortable(p.horizon.exact) < math.inf]
    if alike:
        yield (
            f"lemma 2 as printed finds {alike[0].old.name} and {alike[0].new.name} alike, over so "
            "few scans and without means; with more scans they are told apart"
        )
    apart = [p for p, differ in by_lemma if differ and p.horizon.exact == math.inf]
    if apart:
        yield (
            f"lemma 2 calls {apart[0].old.name} and {apart[0].new.name} distinguishable, since "
            "their covariances differ; yet no number of scans tells them apart at the target"
        )
    if np.any(model.input_effect) or np.any(model.initial_mean):
        yield "the lemmas compare covariances only; horizons and delays use means and inputs too"


def _chart(known: Theory, settings: Settings) -> Chart:
    apart = [pair for pair in known.pairs if _index(known, pair.old) < _index(known, pair.new)]
    hardest = sorted(apart, key=lambda p: -sortable(p.horizon.exact))[:MOST_CURVES]
    lines, bands = [], []
    for pair in hardest:
        label, curve = f"{pair.old.name} or {pair.new.name}", pair.horizon.curve
        if curve is None or not curve.scans.size:  # told apart by the first scan, with certainty
            continue
        lines.append(Line(label, curve.scans, _positive(curve.exact)))
        bands.append(Band(label, curve.scans, _positive(curve.lower), _positive(curve.upper)))
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


def _cell(value: float | None) -> str:
    if value is None:
        return ">"
    return "never" if math.isinf(value) else f"{value:.0f}"


def _bracketed(found: Horizon) -> str:
    if found.exact is None or math.isinf(found.exact):
        return _cell(found.exact)
    return f"{found.exact:.0f} ({_cell(found.lower)}-{_cell(found.upper)})"


ANALYSIS = Analysis(
    name="observability",
    summary="can the bank tell its modes apart, and after how many scans",
    source="Hwang, Balakrishnan, Tomlin 2003, section 2",
    settings=Settings,
    analyse=_analyse,
    example="observability_turns",
    limits={"target_error": (1e-12, 0.49), "most_scans": (1.0, 1000.0)},
)
