"""Expressions of a scenario: text to SymPy by a whitelist, then to functions over lanes.

Text is never evaluated. Python's `ast` takes it apart, and nodes that are on the list are put
together again with SymPy, which differentiates; eval, and `sympify` on raw text, would execute what
stands there. SymPy takes a third of a second to import, so it is where a scenario needs it only.
"""

import ast
import difflib
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.errors import UserError
from hybridtrack.models import Array

LONGEST, DEEPEST, MOST_PARTS = 1000, 60, 150  # so that differentiating takes no second
LARGEST_POWER = 20
LARGEST_NUMBER = 1e30
MOST_OPERATIONS = 5000  # of one derivative
MOST_TERMS = 200  # that an expression may be expanded to, to look what it is made of
DIGITS = 17  # of a float, so that it is the same when read again
FUNCTIONS = (
    *("sin", "cos", "tan", "asin", "acos", "atan", "atan2"),
    *("sinh", "cosh", "tanh", "exp", "log", "sqrt"),
)
KNOWN_NUMBERS = {"pi": math.pi}
TWO_ARGUMENTS = ("atan2",)

Lanes = Callable[[Array, Array], Array]


class ExpressionError(UserError):
    """What is wrong with an expression and what to write instead, without its place."""

    component = 0  # which of several expressions it is about


def parse(text: str, names: Mapping[str, Any]) -> Any:
    """The SymPy expression of a text; names: what each name in it stands for (symbols, numbers).

    Raises ExpressionError with one sentence.
    """
    if _brackets(text) > DEEPEST:
        raise ExpressionError(f"it is nested deeper than {DEEPEST} levels; flatten it")
    if len(text) > LONGEST:
        raise ExpressionError(f"it has {len(text)} characters and may have {LONGEST}; shorten it")
    try:
        with warnings.catch_warnings():  # "1if x else y" is refused below, and need not warn
            warnings.simplefilter("ignore")
            tree = ast.parse(text.strip(), mode="eval").body
    except (RecursionError, MemoryError):
        raise ExpressionError(f"it is nested deeper than {DEEPEST} levels; flatten it") from None
    except (SyntaxError, ValueError) as error:
        offset = error.offset if isinstance(error, SyntaxError) else None
        where = f" at character {offset}" if offset else ""
        raise ExpressionError(
            f"it is no expression{where}; write it as x + T*v*cos(psi), powers as x**2"
        ) from None
    found = _Reader(names).read(tree, 0)
    _refuse_undefined(found)
    _refuse_unknown(found)
    return found


def number(value: float) -> Any:
    """SymPy's form of a float, which loses no digit on the way to compiled code."""
    import sympy

    return sympy.Float(value, DIGITS)


def _brackets(text: str) -> int:
    depth = deepest = 0
    for character in text:
        depth += (character in "([{") - (character in ")]}")
        deepest = max(deepest, depth)
    return deepest


def _refuse_undefined(expression: Any) -> None:
    import sympy

    if expression.has(sympy.nan, sympy.zoo, sympy.oo, sympy.I):
        raise ExpressionError(
            "it has no real value (a division by zero, or a root or logarithm of a negative "
            "number); change it"
        )


def _refuse_unknown(expression: Any) -> None:
    """SymPy makes of sqrt(x**2) an Abs, and of its derivatives sign and DiracDelta."""
    import sympy

    known = (sympy.Add, sympy.Mul, sympy.Pow, sympy.Symbol, sympy.Number, sympy.NumberSymbol)
    functions = tuple(getattr(sympy, name) for name in FUNCTIONS if name != "sqrt")
    for part in sympy.preorder_traversal(expression):
        if isinstance(part, known + functions):
            continue
        if isinstance(part, sympy.Abs | sympy.sign | sympy.DiracDelta | sympy.Heaviside):
            raise ExpressionError(
                "it has a kink (as sqrt(x**2) has where x = 0), so it has no derivative there; "
                "write it without"
            )
        raise ExpressionError(
            f"it or a derivative comes to hold {type(part).__name__}, which is not known here; "
            "write it otherwise"
        )


class _Reader:
    """The whitelist: numbers, names, + - * / **, and FUNCTIONS."""

    def __init__(self, names: Mapping[str, Any]) -> None:
        self._names = names
        self._parts = 0

    def read(self, node: ast.expr, depth: int) -> Any:
        """The expression of a node; all numbers on the way are finite and of moderate size."""
        if depth > DEEPEST:
            raise ExpressionError(f"it is nested deeper than {DEEPEST} levels; flatten it")
        self._parts += 1
        if self._parts > MOST_PARTS:
            raise ExpressionError(f"it has more than {MOST_PARTS} numbers and names; shorten it")
        found = self._made(node, depth)
        if found.is_number:
            _refuse_undefined(found)
            if not abs(found) <= LARGEST_NUMBER:
                raise ExpressionError(
                    f"a number in it is above {LARGEST_NUMBER:g}; change its unit"
                )
        return found

    def _made(self, node: ast.expr, depth: int) -> Any:
        if isinstance(node, ast.Constant):
            return self._number(node)
        if isinstance(node, ast.Name):
            return self._name(node.id)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            value = self.read(node.operand, depth + 1)
            return -value if isinstance(node.op, ast.USub) else value
        if isinstance(node, ast.BinOp):
            return self._operation(node, depth)
        if isinstance(node, ast.Call):
            return self._call(node, depth)
        what = {
            ast.Attribute: "an attribute (a.b)",
            ast.Subscript: "an index (a[b])",
            ast.Compare: "a comparison",
            ast.Lambda: "a lambda",
            ast.IfExp: "an if",
            ast.BoolOp: "and or or",
            ast.Tuple: "a list",
            ast.List: "a list",
        }.get(type(node), "something else")
        raise ExpressionError(
            f"it holds {what}; only numbers, names, + - * / ** and functions have a place in it"
        )

    def _number(self, node: ast.Constant) -> Any:
        import sympy

        value = node.value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ExpressionError(
                f"it holds {str(value)[:40]!r}, which is no number; write a number or a name"
            )
        if not abs(value) <= LARGEST_NUMBER:
            raise ExpressionError(f"a number in it is above {LARGEST_NUMBER:g}; change its unit")
        return sympy.Integer(value) if isinstance(value, int) else number(value)

    def _name(self, name: str) -> Any:
        if name in self._names:
            return self._names[name]
        if name in KNOWN_NUMBERS:
            return number(KNOWN_NUMBERS[name])
        if name in FUNCTIONS:
            raise ExpressionError(f"'{name}' is a function; write {name}(...)")
        raise ExpressionError(f"'{name}' is not known; {_nearest(name, self._names)}")

    def _operation(self, node: ast.BinOp, depth: int) -> Any:
        if isinstance(node.op, ast.BitXor):
            raise ExpressionError("it holds ^; write a power as x**2")
        left = self.read(node.left, depth + 1)
        right = self.read(node.right, depth + 1)
        match node.op:
            case ast.Add():
                return left + right
            case ast.Sub():
                return left - right
            case ast.Mult():
                return left * right
            case ast.Div():
                if right.is_zero:
                    raise ExpressionError("it divides by zero; change the divisor")
                return left / right
            case ast.Pow():
                return self._power(left, right)
        raise ExpressionError("it holds an operation besides + - * / **; write it with these")

    def _power(self, left: Any, right: Any) -> Any:
        import sympy

        if not right.is_number or not abs(right) <= LARGEST_POWER:
            shown = f"an exponent is {right}" if right.is_number else "an exponent is no number"
            raise ExpressionError(
                f"{shown[:80]}; give a number of at most {LARGEST_POWER} (exp(...) is there for "
                "others)"
            )
        if left.is_zero and right.is_negative:
            raise ExpressionError("it divides by zero; change the divisor")
        found = sympy.sqrt(left) if abs(right - 0.5) == 0 else left**right
        if found.is_Pow and not abs(found.exp) <= LARGEST_POWER:  # (x**20)**20
            raise ExpressionError(f"a power in it is above {LARGEST_POWER}; lower it")
        return found

    def _call(self, node: ast.Call, depth: int) -> Any:
        import sympy

        if not isinstance(node.func, ast.Name):
            raise ExpressionError(f"it calls what is no function's name; {_there_are()}")
        name = node.func.id
        if name not in FUNCTIONS:
            close = difflib.get_close_matches(name, FUNCTIONS, 1, 0.6)
            hint = f"did you mean '{close[0]}'?" if close else _there_are()
            raise ExpressionError(f"'{name}' is no function here; {hint}")
        wanted = 1 + (name in TWO_ARGUMENTS)
        if len(node.args) != wanted or node.keywords:
            raise ExpressionError(f"'{name}' takes {wanted} argument{'s' * (wanted > 1)}; give it")
        arguments = [self.read(argument, depth + 1) for argument in node.args]
        if all(argument.is_number for argument in arguments):  # in floats: exp(1e30) takes for ever
            try:
                return number(getattr(math, name)(*map(float, arguments)))
            except (ValueError, OverflowError):
                raise ExpressionError(f"{name} of such a number has no value; change it") from None
        return getattr(sympy, name)(*arguments)


def _there_are() -> str:
    return f"there are {', '.join(FUNCTIONS)}"


def _nearest(name: str, names: Mapping[str, Any]) -> str:
    close = difflib.get_close_matches(name, [*names, *KNOWN_NUMBERS], 1, 0.6)
    return f"did you mean '{close[0]}'?" if close else f"there are {', '.join(names)}"


# ---- functions over lanes --------------------------------------------------------------------


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
    _refuse_unknown(found)
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
