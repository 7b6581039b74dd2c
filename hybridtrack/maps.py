"""Maps of a nonlinear model: expressions differentiated, as functions over lanes, and their waves.

SymPy takes a third of a second to import, so it is where a scenario needs it only.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.expressions import LARGEST_POWER, ExpressionError, refuse_unknown
from hybridtrack.models import Array

MOST_OPERATIONS = 5000  # of one derivative
MOST_TERMS = 200  # that an expression may be expanded to, to look what it is made of

Lanes = Callable[[Array, Array], Array]


class Map(NamedTuple):
    """A vector function m(x, u) with its derivatives; x (lanes, n_x), u (n_u,) at one step."""

    expressions: tuple[Any, ...]  # SymPy's, in `states` and `inputs`
    states: tuple[Any, ...]
    inputs: tuple[Any, ...]
    gradient: tuple[Any, ...]  # (n n_x,) SymPy's derivatives, row by row
    curvature: tuple[Any, ...]  # (n n_x n_x,)
    value: Lanes  # -> (lanes, n)
    jacobian: Lanes  # -> (lanes, n, n_x)
    hessian: Lanes  # -> (lanes, n, n_x, n_x)


def symbols(names: Sequence[str], kind: str) -> tuple[Any, ...]:
    """A real symbol for each name, called otherwise: no name becomes a word of generated code."""
    import sympy

    return tuple(sympy.Symbol(f"{kind}_{i}", real=True) for i in range(len(names)))


def compiled(expressions: Sequence[Any], states: Sequence[Any], inputs: Sequence[Any]) -> Map:
    """Differentiate and compile expressions in the symbols of states and inputs.

    Raises ExpressionError, with its component, about one whose derivatives are none or too long.
    """
    n, n_x = len(expressions), len(states)
    gradient: list[Any] = []
    curvature: list[Any] = []
    for i, one in enumerate(expressions):
        try:
            slopes = [_derivative(one, x) for x in states]
            curvature += [_derivative(slope, x) for slope in slopes for x in states]
        except ExpressionError as error:
            error.component = i
            raise
        gradient += slopes
    arguments = (*states, *inputs)
    return Map(
        expressions=tuple(expressions),
        states=tuple(states),
        inputs=tuple(inputs),
        gradient=tuple(gradient),
        curvature=tuple(curvature),
        value=_over_lanes(arguments, list(expressions), (n,)),
        jacobian=_over_lanes(arguments, gradient, (n, n_x)),
        hessian=_over_lanes(arguments, curvature, (n, n_x, n_x)),
    )


def _derivative(expression: Any, symbol: Any) -> Any:
    import sympy

    found = sympy.diff(expression, symbol)
    if sympy.count_ops(found) > MOST_OPERATIONS:
        raise ExpressionError(
            f"a derivative of it has more than {MOST_OPERATIONS:,} operations; shorten it"
        )
    refuse_unknown(found)
    return found


def constants_of_states(map_: Map) -> tuple[Any, ...]:
    """The largest parts of a map and of its derivatives that hold inputs and no states."""
    inputs, found, seen = set(map_.inputs), dict[Any, None](), set[Any]()
    waiting = [*map_.expressions, *map_.gradient, *map_.curvature]
    while waiting:
        one = waiting.pop()
        if one in seen or not one.free_symbols & inputs:
            continue
        seen.add(one)
        if one.free_symbols <= inputs:
            found[one] = None
        else:
            waiting.extend(one.args)
    return tuple(sorted(found, key=str))


def not_finite(expression: Any, map_: Map, inputs: Array) -> NDArray[np.bool_]:
    """At which inputs (m, n_u) an expression of them alone has no finite value."""
    values = _over_lanes(map_.inputs, [expression], (1,))(inputs, np.zeros(0))
    return ~np.isfinite(values[:, 0])


def _over_lanes(arguments: Sequence[Any], flat: list[Any], shape: tuple[int, ...]) -> Lanes:
    """One function of all elements; those that are constant are written once and for all."""
    import sympy

    fixed = np.array([_as_float(one) if one.is_number else np.nan for one in flat])
    moving = [i for i, one in enumerate(flat) if not one.is_number]
    calculate = sympy.lambdify(arguments, [flat[i] for i in moving], modules="numpy", cse=True)

    def function(x: Array, u: Array) -> Array:
        out = np.empty((len(x), len(flat)))
        out[:] = fixed
        if moving:
            with np.errstate(all="ignore"):
                for i, values in zip(moving, calculate(*x.T, *u), strict=True):
                    out[:, i] = values
        return out.reshape(len(x), *shape)

    return function


def _as_float(expression: Any) -> float:
    try:
        return float(expression)
    except (OverflowError, TypeError, ValueError):  # beyond floats, or no real number
        return math.nan


# ---- what a component is made of -------------------------------------------------------------


class Wave(NamedTuple):
    """A cos(w x_v + phase) of one state, amplitude and phase by the inputs."""

    state: int
    frequency: float  # w > 0
    parts: tuple[tuple[Callable[..., Any], float], ...]  # amplitude(u), phase: several are added

    def phasor(self, u: Array) -> tuple[float, float]:
        """Amplitude and phase of the sum of its parts."""
        u = np.asarray(u, dtype=np.float64)  # NumPy has NaN where `math` raises
        with np.errstate(all="ignore"):
            total = sum(complex(a(*u)) * complex(math.cos(p), math.sin(p)) for a, p in self.parts)
        return math.hypot(total.real, total.imag), math.atan2(total.imag, total.real)


def waves(map_: Map) -> tuple[tuple[Wave, ...] | None, ...]:
    """By component: the waves that remain beside an affine part; () where it is affine.

    None where there is more than that, or several frequencies of one state.
    """
    return tuple(_waves(one, map_) for one in map_.expressions)


def _waves(expression: Any, map_: Map) -> tuple[Wave, ...] | None:
    import sympy

    if _terms(expression) > MOST_TERMS:
        return None
    found: dict[tuple[int, float], list[tuple[Any, float]]] = {}
    states = set(map_.states)
    for term in sympy.Add.make_args(_expanded(expression)):
        factors = [one for one in sympy.Mul.make_args(term) if one.free_symbols & states]
        if not factors or (len(factors) == 1 and factors[0] in states):
            continue  # a constant, or a state times one
        if len(factors) > 1 or factors[0].func not in (sympy.sin, sympy.cos):
            return None
        turning = _turning(factors[0].args[0], map_)
        if turning is None:
            return None
        state, w, phase = turning
        shift = phase - (math.pi / 2 if factors[0].func is sympy.sin else 0.0)
        amplitude = sympy.lambdify(map_.inputs, term / factors[0], modules="numpy")
        # cos is even: a negative frequency turns the phase round.
        found.setdefault((state, abs(w)), []).append((amplitude, shift if w > 0 else -shift))
    if len({state for state, _ in found}) < len(found):
        return None
    return tuple(Wave(state, w, tuple(parts)) for (state, w), parts in found.items())


def _turning(angle: Any, map_: Map) -> tuple[int, float, float] | None:
    """State, frequency and phase of an angle w x_v + phase with numbers for w and phase."""
    import sympy

    state, w, phase = -1, 0.0, 0.0
    for term in sympy.Add.make_args(_expanded(angle)):
        coefficient, rest = term.as_independent(*map_.states, as_Add=False)
        if not coefficient.is_number or (rest != 1 and rest not in map_.states):
            return None
        if rest == 1:
            phase += float(coefficient)
        elif state in (-1, map_.states.index(rest)):
            state, w = map_.states.index(rest), w + float(coefficient)
        else:
            return None
    return (state, w, phase) if w else None


def _expanded(expression: Any) -> Any:
    """Multiplied out, but for what is inside of functions."""
    import sympy

    if expression.is_Add:
        return sympy.Add(*map(_expanded, expression.args))
    found = sympy.expand_mul(sympy.expand_multinomial(expression, deep=False), deep=False)
    return found if found == expression else _expanded(found)


def _terms(expression: Any) -> float:
    """At most how many terms an expression has when expanded, without expanding it.

    Those of functions' arguments and of divisors count too.
    """
    if not expression.args:
        return 1.0
    if expression.is_Mul:
        found = math.prod(_terms(one) for one in expression.args)
    elif expression.is_Pow and expression.exp.is_Integer:
        found = _terms(expression.base) ** min(abs(int(expression.exp)), LARGEST_POWER)
    elif expression.is_Pow:
        found = _terms(expression.base)
    else:
        found = sum(_terms(one) for one in expression.args)
    return min(found, MOST_TERMS + 1.0)  # no power of it overflows
