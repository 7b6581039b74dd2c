"""Everything that is asked of one bank: constants, conditions, bounds, a simulated flight."""

from typing import NamedTuple

import numpy as np

from hybridtrack.analyses._definite import is_definite
from hybridtrack.analyses._mixing import (
    ImmRun,
    Rate,
    contraction,
    fly,
    interacting_filters,
    simulated_rate,
    smallest_spread,
)
from hybridtrack.analyses._riccati import (
    Bank,
    Bound,
    Certificate,
    Figures,
    all_sequences,
    bank,
    below,
    ceiling,
    certificate,
    floor,
    largest_prediction,
    one_step_loss,
)
from hybridtrack.errors import Unsuited
from hybridtrack.models import Array, JumpMarkovModel


class Conditions(NamedTuple):
    """What the theorem asks for; N is None where none up to the longest looked at will do."""

    singular: tuple[str, ...]  # modes whose A has no inverse
    controllable_from: int | None
    observable_from: int | None
    longest: int
    same_observation: bool
    driven: tuple[str, ...]  # modes with B Q B' > 0

    @property
    def met(self) -> bool:
        """Conditions 1 to 3, and an inverse of every A."""
        observable = self.observable_from is not None and self.observable_from <= 2
        controllable = self.controllable_from is not None
        return not self.singular and controllable and observable and self.same_observation


def conditions(bank: Bank, figures: tuple[Figures, ...]) -> Conditions:
    """The conditions of Seah 2008, section III-C, each by itself."""
    return Conditions(
        bank.singular,
        next((one.measurements for one in figures if one.controllable), None),
        next((one.measurements for one in figures if one.observable), None),
        figures[-1].measurements,
        all(np.array_equal(C, bank.C[0]) for C in bank.C)
        and all(np.array_equal(R, bank.R[0]) for R in bank.R),
        tuple(name for name, W in zip(bank.modes, bank.W, strict=True) if is_definite(W)),
    )


class Stability(NamedTuple):
    """All that was found, before it is put into tables and sentences."""

    bank: Bank
    figures: tuple[Figures, ...]
    conditions: Conditions
    run: ImmRun
    logs: Array  # log ||Phi(k, 0)|| (n_steps + 1,)
    rate: Rate | None
    spread: Array  # (n_x, n_x), diagonal
    spread_given: bool
    floor: Bound
    ceiling: Bound  # given the spread
    bare_ceiling: Bound  # without one
    certificate: Certificate | None  # by the floor's beta_1
    printed_certificate: Certificate | None  # by beta_1 as printed
    one_step_loss: float | None  # 1 - rho
    step_s: float
    steps_asked: int

    @property
    def ended_early(self) -> bool:
        """Whether the simulation got too large for its numbers before its last step."""
        return len(self.run.mixing) < self.steps_asked

    @property
    def one_rate(self) -> float | None:
        """The simulated rate per step, where the simulation shows one; 0: no error is left."""
        if self.rate is None or not self.rate.known:
            return None
        if self.ended_early and self.rate.per_step > 0.0:
            return None
        return self.rate.per_step


def examine(
    model: JumpMarkovModel, longest: int, steps: int, seed: int, spread: Array | None = None
) -> Stability:
    """All figures of a model with n_times = 1.

    spread (n_x, n_x): the largest of the modes' means; None: what the simulation shows. Raises
    Unsuited where the truth runs away at once.
    """
    system = bank(model)
    figures = all_sequences(system, longest)
    found = conditions(system, figures)
    flight = fly(model, steps, seed)
    run = interacting_filters(model, flight.measurements)
    if len(run.mixing) < 2:
        raise Unsuited(
            "the simulated state gets beyond 1e12 within two steps, so nothing can be simulated; "
            "check the modes' matrices and the initial mean",
            "modes",
        )
    logs = contraction(run)
    largest = smallest_spread(run) if spread is None else spread
    low = floor(system, figures)
    high = ceiling(system, largest, model.initial_covariance)
    bare = ceiling(system, np.zeros_like(largest), model.initial_covariance)
    certified = printed = None
    if found.met and high.matrix is not None:
        beta_3 = largest_prediction(system, high.matrix, largest)
        kappa_3 = figures[1].kappa_3
        assert kappa_3 is not None
        if low.matrix is not None:
            beta_1 = float(np.linalg.eigvalsh(low.matrix)[0])
            certified = certificate(system, beta_1, kappa_3, beta_3)
        first = next(one for one in figures if one.controllable)
        assert first.beta_1_printed is not None
        printed = certificate(system, first.beta_1_printed, kappa_3, beta_3)
    driven = len(found.driven) == len(system.modes)
    loss = None
    if driven and high.matrix is not None:
        loss = one_step_loss(system, high.matrix)
    return Stability(
        system,
        figures,
        found,
        run,
        logs,
        simulated_rate(logs),
        largest,
        spread is not None,
        low,
        high,
        bare,
        certified,
        printed,
        loss,
        float(model.step_s[0]),
        steps,
    )


# ---- against the simulation ------------------------------------------------------------------


class Held(NamedTuple):
    """Whether a bound held in the simulation."""

    checked: int
    broken: int
    first_broken: int | None

    @property
    def share(self) -> float | None:
        """Of the steps looked at, those where some mode broke it; None where none was."""
        return self.broken / self.checked if self.checked else None


def held(found: Stability, bound: Bound, from_step: int, *, above: bool, settled: bool) -> Held:
    """The bound against every mode's P_j(k|k) from a step on.

    settled: the last of the path at every step, not the one that is due at that step.
    """
    covariances = found.run.covariances
    steps = np.arange(max(from_step, 0 if settled else bound.first), len(covariances))
    if not len(bound.path) or not len(steps):
        return Held(0, 0, None)
    here = covariances[steps]
    bounds = (bound.path[-1:] if settled else bound.at(steps))[:, np.newaxis]
    kept = below(here, bounds) if above else below(bounds, here)
    broken = steps[~kept.all(axis=1)]
    return Held(len(steps), len(broken), int(broken[0]) if len(broken) else None)


class Checks(NamedTuple):
    """The bounds against the simulation."""

    floor: Held  # the settled one, from the longest N looked at on
    floor_in_time: Held  # what is due at each step
    ceiling: Held  # given the spread, what is due at each step
    bare_ceiling: Held  # without one, from when on it would be a bound
    spread: Held  # the spread itself against what is given


def checks(found: Stability) -> Checks:
    """All of them."""
    longest = found.conditions.longest
    spread = found.run.spread
    kept = below(spread, np.broadcast_to(found.spread, spread.shape))
    over = np.flatnonzero(np.logical_not(kept.all(axis=1)))
    return Checks(
        floor=held(found, found.floor, longest, above=False, settled=True),
        floor_in_time=held(found, found.floor, 0, above=False, settled=False),
        ceiling=held(found, found.ceiling, 0, above=True, settled=False),
        bare_ceiling=held(
            found, found.bare_ceiling, found.bare_ceiling.from_step, above=True, settled=True
        ),
        spread=Held(len(spread), len(over), int(over[0]) + 1 if len(over) else None),
    )
