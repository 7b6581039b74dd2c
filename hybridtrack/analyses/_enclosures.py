"""What holds for certain over intervals, by python-flint's balls: bounds, and where values jump."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from hybridtrack.models import Array
from hybridtrack.remainders import ball_functions, ends, over_balls

PARTS = {1: 64, 2: 8, 3: 4}  # that a doubtful box is cut into along each axis
DEPTH = {1: 4, 2: 5, 3: 6}  # how often
MOST_LOOKS = 20_000


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


def first_jump(
    expressions: Sequence[Any], symbols: Sequence[Any], low: Array, high: Array
) -> Array | None:
    """A place (d,) of a box low (d,), high (d,) where a value jumps or there is none; or None.

    Of atan(tan(x)), or of an atan2 across its cut, no derivative tells. A box in doubt is cut into
    ever smaller ones; what stays in doubt at the smallest is taken for a jump.
    """
    import sympy
    from flint import arb

    angles = [a for one in expressions for a in sorted(one.atoms(sympy.atan2), key=str)]
    sides = [side for angle in angles for side in angle.args]
    function = over_balls(symbols, [*expressions, *sides])
    n, d = len(expressions), len(low)

    def doubtful(begin: Array, end: Array) -> bool:
        balls = [arb(a).union(arb(b)) for a, b in zip(begin.tolist(), end.tolist(), strict=True)]
        try:
            found = [arb(value) for value in function(*balls)]
        except (ZeroDivisionError, ValueError):
            return True
        pairs = zip(found[n::2], found[n + 1 :: 2], strict=True)
        cut = any(not (y > 0 or y < 0 or x > 0) for y, x in pairs)
        return cut or not all(value.is_finite() for value in found[:n])

    waiting, looks = [(low, high, 0)], 0
    while waiting and looks < MOST_LOOKS:
        begin, end, depth = waiting.pop()
        looks += 1
        if not doubtful(begin, end):
            continue
        if depth == DEPTH[d]:
            middle: Array = 0.5 * (begin + end)
            return middle
        step = (end - begin) / PARTS[d]
        for index in np.ndindex(*(PARTS[d],) * d):
            corner = begin + step * np.array(index)
            waiting.append((corner, corner + step, depth + 1))
    return None
