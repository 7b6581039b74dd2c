"""Bounds of an expression over intervals that hold for certain, by mpmath's interval arithmetic.

mpmath comes with SymPy, so nothing is installed for it; it is slow, and asked for a few hundred
intervals only.
"""

from typing import Any

import numpy as np

from hybridtrack.models import Array

FUNCTIONS = ("sin", "cos", "tan", "exp", "log")


class NotEnclosed(Exception):
    """An expression that has a function without an interval form, or no bound on an interval."""


def largest_size(expression: Any, symbol: Any, edges: Array) -> Array:
    """An upper bound of |expression| over each cell between edges (n + 1,), in one symbol: (n,).

    Raises NotEnclosed where there is none.
    """
    from mpmath import iv

    result = np.empty(len(edges) - 1)
    for i, (low, high) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        found = enclosure(expression, {symbol: iv.mpf([float(low), float(high)])})
        result[i] = np.nextafter(max(abs(float(found.a)), abs(float(found.b))), np.inf)
    if not np.isfinite(result).all():
        raise NotEnclosed(str(expression))
    return result


def enclosure(expression: Any, intervals: dict[Any, Any]) -> Any:
    """The expression over intervals (mpmath's), by its tree: natural interval extension."""
    import sympy
    from mpmath import iv

    if expression in intervals:
        return intervals[expression]
    if expression.is_Integer:
        return iv.mpf(int(expression))
    if expression.is_Rational:
        return iv.mpf(int(expression.p)) / iv.mpf(int(expression.q))
    if expression.is_Float:
        return iv.mpf(float(expression))
    if expression is sympy.pi:
        return iv.pi
    if expression is sympy.E:
        return iv.e
    parts = [enclosure(part, intervals) for part in expression.args]
    try:
        if expression.is_Add:
            return sum(parts[1:], parts[0])
        if expression.is_Mul:
            product = parts[0]
            for part in parts[1:]:
                product = product * part
            return product
        if expression.is_Pow:
            return _power(parts[0], parts[1], expression.exp)
        name = expression.func.__name__
        if name in FUNCTIONS:
            return getattr(iv, name)(parts[0])
    except (ValueError, ZeroDivisionError, TypeError, NotImplementedError) as error:
        raise NotEnclosed(str(expression)) from error
    raise NotEnclosed(str(expression))


def _power(base: Any, exponent: Any, symbolic: Any) -> Any:
    from mpmath import iv

    if symbolic.is_Integer:
        n = int(symbolic)
        if n < 0 and 0 in base:
            raise NotEnclosed("division by an interval that holds 0")
        return base**n
    if base.a <= 0 and not (symbolic.is_Rational and int(symbolic.q) == 2 and base.a == 0):
        raise NotEnclosed("a root of an interval that holds negative numbers")
    if symbolic.is_Rational and int(symbolic.q) == 2:
        return iv.sqrt(base) ** int(symbolic.p)
    return iv.exp(exponent * iv.log(base))
