"""Expressions of a scenario: text to SymPy by a whitelist.

Text is never evaluated. Python's `ast` takes it apart, and nodes that are on the list are put
together again with SymPy, which differentiates; eval, and `sympify` on raw text, would execute what
stands there. SymPy takes a third of a second to import, so it is where a scenario needs it only.
"""

import ast
import difflib
import math
import warnings
from collections.abc import Mapping
from typing import Any

from hybridtrack.errors import UserError

LONGEST, DEEPEST, MOST_PARTS = 1000, 60, 150  # so that differentiating takes no second
LARGEST_POWER = 20
LARGEST_NUMBER = 1e30
DIGITS = 17  # of a float, so that it is the same when read again
FUNCTIONS = (
    *("sin", "cos", "tan", "asin", "acos", "atan", "atan2"),
    *("sinh", "cosh", "tanh", "exp", "log", "sqrt"),
)
KNOWN_NUMBERS = {"pi": math.pi}
TWO_ARGUMENTS = ("atan2",)


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
    refuse_unknown(found)
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


def refuse_unknown(expression: Any) -> None:
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
