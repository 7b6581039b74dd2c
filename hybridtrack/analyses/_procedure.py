"""How many linear models a wanted bound needs, and where: steps 1 to 5 of Otanez 2004, III-B.

1: the steady ellipsoid that the noises alone leave, which no number of models makes smaller. 2 to
5: a point more, the best places of them all, the steady ellipsoid with their worst remainder, until
it is within what is wanted. Here a bank's bound is its widest model's, since any may be chosen.
"""

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from hybridtrack.analyses._enclosures import first_jump, largest_size
from hybridtrack.analyses._linearisation import (
    Nonlinear,
    compiled,
    from_expressions,
    largest_curvature,
    lattice,
    of_bank,
    radii,
)
from hybridtrack.analyses._placement import place_one
from hybridtrack.analyses._placement_search import search
from hybridtrack.analyses._steady_ellipsoids import BEST_CONSTANTS, Steady, steady, with_box
from hybridtrack.analyses._worst_errors import Placement, checked, worst_error
from hybridtrack.models import Array

NARROWED, NARROWINGS = 64, 3  # cells that a pole is looked for in, and again in those with one
OPTIMAL, BEST_FOUND = "optimal", "best found"  # with a certificate, and without
TRIED = 9  # places of the range that the smallest bound is looked for at, and about the best again
ALIKE = 1e-6  # relative: bounds that don't depend on the place


class System(NamedTuple):
    """x_k = f(x_{k-1}) + w, y_k = h(x_k) + v with w in Omega(0, Q), v in Omega(0, R).

    f and h as SymPy expressions in one symbol for each state.
    """

    state_names: tuple[str, ...]
    measurement_names: tuple[str, ...]
    symbols: tuple[Any, ...]  # (n_x,)
    dynamics: tuple[Any, ...]  # (n_x,)
    measurement: tuple[Any, ...]  # (n_y,)
    process_noise: Array  # Q (n_x, n_x)
    measurement_noise: Array  # R (n_y, n_y)
    units: Mapping[str, str] = MappingProxyType({})  # of states and measurements, where given

    @property
    def component_names(self) -> tuple[str, ...]:
        """Of f by its states, of h by what is measured."""
        return self.state_names + tuple(f"measured {name}" for name in self.measurement_names)

    def error_unit(self, components: Sequence[str]) -> str:
        """The unit that errors of some components have in common; '' where they have none."""
        found = {self.units.get(name.removeprefix("measured "), "") for name in components}
        return found.pop() if len(found) == 1 else ""


class Range(NamedTuple):
    """The operating range of the states that matter."""

    low: Array  # (d,)
    high: Array  # (d,)


class Step(NamedTuple):
    """A bank of linear models, and the bound that it settles at."""

    name: str
    placement: Placement
    radius: Array  # (k,) worst error of each nonlinear component, unweighted
    steady: Steady | None  # of the model with the widest bound on the state in question


class Procedure:
    """The steps for one system over one range, by one kind of remainder."""

    def __init__(
        self, system: System, kind: str, weights: Mapping[str, float], seed: int = 0
    ) -> None:
        """weights: of components by name, 1 where they aren't given."""
        import sympy

        self.system, self.kind, self.seed = system, kind, seed
        components = system.component_names
        self.function: Nonlinear = from_expressions(
            system.state_names,
            (*system.dynamics, *system.measurement),
            system.symbols,
            components,
            np.array([weights.get(name, 1.0) for name in components]),
        )
        own = self.function.symbols
        others: dict[Any, int] = {s: 0 for s in system.symbols if s not in own}
        self._alone = [e.subs(others) for e in (*system.dynamics, *system.measurement)]
        n_x, n_y = len(system.dynamics), len(system.measurement)
        slopes = [
            [sympy.diff(e, s).subs(others) for e in expressions for s in system.symbols]
            for expressions in (system.dynamics, system.measurement)
        ]
        self._dynamics = compiled(slopes[0], own, (n_x, n_x))
        self._measurement = compiled(slopes[1], own, (n_y, n_x))
        self._known: dict[tuple[Any, ...], Steady | None] = {}

    def place(self, over: Range, count: int, others: Sequence[Array] = ()) -> Placement:
        """Steps 2 and 3: the best `count` points.

        Where that is a search, it starts from others too, (n, d) of as many or of one fewer, and is
        no worse than those.
        """
        if len(over.low) == 1:
            low, high = float(over.low[0]), float(over.high[0])
            found = place_one(self.function, self.kind, low, high, count)
            if found is not None:
                return found
        known = [points for points in others if count - 1 <= len(points) <= count]
        return search(self.function, self.kind, *over, count, self.seed, known)

    def given(self, over: Range, points: Array) -> Placement:
        """The worst error of points (n, d) that someone else chose."""
        worst, _ = worst_error(self.function, self.kind, *over, points)
        return Placement(points, worst, float("nan"), "")

    def radius(self, over: Range, placement: Placement) -> Array:
        """The worst error (k,) of each component; the largest is the placement's own."""
        x = checked(*over)
        found = radii(self.function, self.kind, x, placement.points)
        # what lies between the places of the lattice
        scale = placement.worst_error / max(float((found * self.function.weights).max()), 1e-300)
        result: Array = found * max(scale, 1.0)
        return result

    def normalised(self, over: Range, error: float) -> float:
        """An error in units of the largest curvature in the range (T v1 in the paper)."""
        return error / self.largest_curvature(over)

    def largest_curvature(self, over: Range) -> float:
        """The largest second derivative in the range, weighted."""
        return largest_curvature(self.function, checked(*over))

    def bank(self, points: Array, radius: Array | None, rule: str, state: int) -> Steady | None:
        """The steady ellipsoid of the model with the widest bound on a state; None if one has none.

        points (n, d) that the models are linearised at; radius (k,) of the remainder, or none.
        """
        found = [one for one in self._each(points, radius, rule, state) if one is not None]
        if len(found) < len(points):
            return None
        return max(found, key=lambda one: float(one.half_widths[state]))

    def smallest(self, over: Range, rule: str, state: int) -> Steady | None:
        """Step 1: without remainder, linearised where in the range the bound is the smallest.

        Of a few places, and of as many about the best of them. None where there is none at any.
        """
        places = lattice(*over, TRIED)
        found = list(self._each(places, None, rule, state))
        bounds = [np.inf if one is None else float(one.half_widths[state]) for one in found]
        best = int(np.argmin(bounds))
        if np.isfinite(bounds[best]) and max(bounds) > (1.0 + ALIKE) * bounds[best]:
            step = (over.high - over.low) / (round(len(places) ** (1.0 / len(over.low))) - 1)
            low = np.maximum(places[best] - step, over.low)
            high = np.minimum(places[best] + step, over.high)
            found += self._each(lattice(low, high, TRIED), None, rule, state)
        kept = [one for one in found if one is not None]
        return min(kept, key=lambda one: float(one.half_widths[state]), default=None)

    def _each(
        self, points: Array, radius: Array | None, rule: str, state: int
    ) -> Iterator[Steady | None]:
        """The steady ellipsoid of every model, kept for the next time."""
        system, n_x = self.system, len(self.system.state_names)
        whole = np.zeros(len(system.component_names))
        if radius is not None:
            places = [system.component_names.index(name) for name in self.function.components]
            whole[places] = radius
        Q = with_box(system.process_noise, whole[:n_x])
        R = with_box(system.measurement_noise, whole[n_x:])
        for A, C in zip(self._dynamics(points), self._measurement(points), strict=True):
            own = state if rule == BEST_CONSTANTS else 0  # what the others weigh has no state
            key = (A.tobytes(), C.tobytes(), Q.tobytes(), R.tobytes(), rule, own)
            if key not in self._known:
                self._known[key] = steady(A, C, Q, R, rule, state)
            yield self._known[key]

    def step(self, over: Range, name: str, placement: Placement, rule: str, state: int) -> Step:
        """Step 4: what a placement's worst remainder makes of the bound."""
        radius = self.radius(over, placement)
        return Step(name, placement, radius, self.bank(placement.points, radius, rule, state))

    def steps(
        self,
        over: Range,
        rule: str,
        wanted: Mapping[int, float],
        least: int,
        most: int,
        others: Sequence[Array] = (),
    ) -> Iterator[Step]:
        """Steps 2 to 5: until the bounds wanted, by state, are met and `least` points tried.

        others: points (n, d) of any number, that the best of as many may be no worse than.
        """
        before: list[Array] = []  # of one point fewer
        state = next(iter(wanted), 0)
        for count in range(1, most + 1):
            placement = self.place(over, count, [*before, *others])
            name = OPTIMAL if placement.certificate else BEST_FOUND
            step = self.step(over, name, placement, rule, state)
            before = [placement.points]
            yield step
            if count >= least and wanted and self.meets(step, rule, wanted):
                return

    def meets(self, step: Step, rule: str, wanted: Mapping[int, float]) -> bool:
        """Step 5: whether a bank's bounds are within what is wanted of each state."""
        for state, bound in wanted.items():
            found = self.bank(step.placement.points, step.radius, rule, state)
            if found is None or not found.half_widths[state] <= bound:
                return False
        return True

    def not_finite(self, over: Range) -> Array | None:
        """A place (d,) of the range where the function or a derivative has no value, if any."""
        x = checked(*over)
        parts: Sequence[Array] = (
            self.function.value(x),
            self.function.jacobian(x).reshape(len(x), -1),
            self.function.hessian(x).reshape(len(x), -1),
        )
        sound = np.logical_and.reduce([np.isfinite(part).all(axis=1) for part in parts])
        if not sound.all():
            result: Array = x[int(np.argmin(sound))]
            return result
        return self._pole(over) if len(over.low) == 1 else None

    def jump(self, over: Range) -> Array | None:
        """A place (d,) of the range where a value jumps, so that no second derivative bounds it."""
        own = set(self.function.symbols)
        expressions = [one for one in self._alone if one.free_symbols and one.free_symbols <= own]
        return first_jump(expressions, self.function.symbols, *over)

    def _pole(self, over: Range) -> Array | None:
        """A place (1,) that the lattice stepped over and a second derivative is not bounded at."""
        import sympy

        (symbol,) = self.function.symbols
        for expression in self.function.expressions:
            second = sympy.diff(expression, symbol, 2)
            cells = [(float(over.low[0]), float(over.high[0]))]
            for _ in range(NARROWINGS):  # a cell's enclosure may be infinite for width alone
                narrowed = []
                for low, high in cells[:NARROWED]:
                    edges = np.linspace(low, high, NARROWED + 1)
                    unbounded = ~np.isfinite(largest_size(second, symbol, edges))
                    narrowed += list(zip(edges[:-1][unbounded], edges[1:][unbounded], strict=True))
                cells = narrowed
            if cells:
                return np.array([0.5 * (cells[0][0] + cells[0][1])])
        return None


def profile(procedure: Procedure, over: Range, points: Array, state: int) -> tuple[Array, Array]:
    """The bank's error along one state of the range, worst over the others: places and errors."""
    x = lattice(*over, 1_001) if len(over.low) == 1 else checked(*over)
    found = of_bank(procedure.function, procedure.kind, x, points)
    along, owner = np.unique(x[:, state], return_inverse=True)
    worst = np.zeros(len(along))
    np.maximum.at(worst, owner, found)
    return along, worst
