"""Bounds of a derivative over intervals that hold for certain, by python-flint's balls."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from hybridtrack.models import Array
from hybridtrack.remainders import ball_functions, ends


def largest_size(expression: Any, symbol: Any, edges: Array) -> Array:
    """An upper bound (n,) of |expression| in one symbol over each cell between edges (n + 1,).

    Infinite where there is none.
    """
    return largest_sizes(expression, (symbol,), edges[:-1, np.newaxis], edges[1:, np.newaxis])


def largest_sizes(expression: Any, symbols: Sequence[Any], low: Array, high: Array) -> Array:
    """The same (n,) over boxes low (n, d), high (n, d) of d symbols."""
    import sympy
    from flint import arb

    function = sympy.lambdify(list(symbols), expression, modules=[ball_functions()])
    result = np.full(len(low), np.inf)
    for i, (begin, end) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
        balls = [arb(a).union(arb(b)) for a, b in zip(begin, end, strict=True)]
        try:
            found = arb(function(*balls))
        except (ZeroDivisionError, ValueError):
            continue
        result[i] = max(map(abs, ends(found)))
    return result
