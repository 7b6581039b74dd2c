"""Bounds of a derivative over intervals that hold for certain, by python-flint's balls."""

import itertools
from typing import Any

import numpy as np

from hybridtrack.models import Array
from hybridtrack.remainders import ball_functions, ends


def largest_size(expression: Any, symbol: Any, edges: Array) -> Array:
    """An upper bound (n,) of |expression| in one symbol over each cell between edges (n + 1,).

    Infinite where there is none.
    """
    import sympy
    from flint import arb

    function = sympy.lambdify([symbol], expression, modules=[ball_functions()])
    result = np.full(len(edges) - 1, np.inf)
    for i, (low, high) in enumerate(itertools.pairwise(edges)):
        try:
            found = arb(function(arb(float(low)).union(arb(float(high)))))
        except (ZeroDivisionError, ValueError):
            continue
        result[i] = max(map(abs, ends(found)))
    return result
