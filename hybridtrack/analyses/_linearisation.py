"""How far a function is from its linear models over a range: eqs. 31 and 40 of Otanez 2004.

Shapes: m places x, n points c that models are linearised at, d varied states, k components. SymPy
is imported where a function is built, which only scenarios with expressions need.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from hybridtrack.models import Array

Function = Callable[[Array], Array]  # of places (m, d)

EXACT = "exact"
PRINTED = "printed_eq40"


class Nonlinear(NamedTuple):
    """The components of a function that are not linear, in the states that matter for that.

    A state matters where a second derivative along it is not zero; along all others a linear model
    is exact, so they stand at 0.
    """

    states: tuple[str, ...]  # (d,)
    components: tuple[str, ...]  # (k,)
    value: Function  # (m, k)
    jacobian: Function  # (m, k, d)
    hessian: Function  # (m, k, d, d)
    weights: Array  # (k,) what an error in a component is multiplied by to be compared
    expressions: tuple[Any, ...] = ()  # SymPy's, for enclosures; empty for plain callables
    symbols: tuple[Any, ...] = ()


def matters(expressions: Sequence[Any], symbols: Sequence[Any]) -> list[int]:
    """Which of the symbols the linearisation errors of SymPy expressions depend on."""
    import sympy

    found = []
    for i, symbol in enumerate(symbols):
        first = [sympy.diff(expression, symbol) for expression in expressions]
        if any(not _is_zero(sympy.diff(one, other)) for one in first for other in symbols):
            found.append(i)
    return found


def _is_zero(expression: Any) -> bool:
    """Also where only simplifying shows it, as in the derivatives of sin^2 + cos^2."""
    import sympy

    if expression.is_zero:
        return True
    return bool(sympy.simplify(expression) == 0)


def from_expressions(
    names: Sequence[str],
    expressions: Sequence[Any],
    symbols: Sequence[Any],
    components: Sequence[str],
    weights: Array,
) -> Nonlinear:
    """Of SymPy expressions in symbols called names; weights (one per component)."""
    import sympy

    varied = matters(expressions, symbols)
    own = [symbols[i] for i in varied]
    kept = [j for j, expression in enumerate(expressions) if matters([expression], own)]
    others: dict[Any, int] = {s: 0 for s in symbols if s not in own}
    chosen = [expressions[j].subs(others) for j in kept]
    first = [[sympy.diff(e, s) for s in own] for e in chosen]
    second = [[[sympy.diff(one, s) for s in own] for one in row] for row in first]
    d, k = len(own), len(chosen)
    return Nonlinear(
        tuple(names[i] for i in varied),
        tuple(components[j] for j in kept),
        compiled(chosen, own, (k,)),
        compiled([e for row in first for e in row], own, (k, d)),
        compiled([e for rows in second for row in rows for e in row], own, (k, d, d)),
        np.asarray(weights, dtype=float)[kept],
        tuple(chosen),
        tuple(own),
    )


def compiled(
    expressions: Sequence[Any], symbols: Sequence[Any], shape: tuple[int, ...]
) -> Function:
    """SymPy expressions as one function of places (m, d) that gives (m, *shape)."""
    import sympy

    # numpy alone: SciPy's special functions have no place in a motion model
    parts = [sympy.lambdify(symbols, expression, modules="numpy") for expression in expressions]

    def function(x: Array) -> Array:
        columns = np.moveaxis(np.asarray(x, dtype=float), -1, 0)
        result = np.empty((len(x), len(parts)))
        with np.errstate(all="ignore"):  # what isn't finite is told by whoever asks
            for i, part in enumerate(parts):
                result[:, i] = part(*columns)
        return result.reshape(len(x), *shape)

    return function


def on_places(function: Nonlinear, kind: str, x: Array) -> Function:
    """Weighted errors at places x (m, d), of the models at any points c (n, d): (m, n, k).

    exact: |f(x) - f(c) - f'(c) (x - c)|. printed_eq40: |(x - c)' f''(x) (x - c)|, which has the
    curvature at the state, where (31) has it at the point, and no factor of a half.
    """
    if kind == PRINTED:
        return _printed(function, x)
    known = function.value(x)[:, np.newaxis]

    def exact(c: Array) -> Array:
        slopes = function.jacobian(c)  # (n, k, d)
        offsets = function.value(c) - np.einsum("nkd,nd->nk", slopes, c)
        n, k, d = slopes.shape
        tangents = (x @ slopes.reshape(n * k, d).T).reshape(len(x), n, k) + offsets
        result: Array = np.abs(known - tangents) * function.weights
        return result

    return exact


def largest_on_places(function: Nonlinear, kind: str, x: Array) -> Function:
    """As on_places, of whichever component is the worst: (m, n)."""
    if kind == PRINTED and len(function.states) == 1:  # whichever is, is so for all points
        sizes = (np.abs(function.hessian(x)[:, :, 0, 0]) * function.weights).max(axis=1)

        def of_one(c: Array) -> Array:
            away = x - c[:, 0]
            result: Array = away * away * sizes[:, np.newaxis]
            return result

        return of_one

    judge = on_places(function, kind, x)

    def largest(c: Array) -> Array:
        found = judge(c)
        # over an axis so short, one comparison after the other is three times as fast as max
        result: Array = found[:, :, 0]
        for j in range(1, found.shape[2]):
            result = np.maximum(result, found[:, :, j])
        return result

    return largest


def _printed(function: Nonlinear, x: Array) -> Function:
    """As (40) has it, multiplied out where there are several states: then it is one product."""
    bends = function.hessian(x)  # (m, k, d, d)
    m, k, d = bends.shape[:3]
    if d == 1:
        sizes = np.abs(bends[:, np.newaxis, :, 0, 0]) * function.weights

        def of_one(c: Array) -> Array:
            away = x[:, np.newaxis, :] - c[np.newaxis, :, :]
            result: Array = away * away * sizes
            return result

        return of_one

    middle = 0.5 * (x.min(axis=0) + x.max(axis=0))  # what cancels is small about here
    own = x - middle
    through = np.einsum("mkde,me->mkd", bends, own)
    constant = np.einsum("mkd,md->mk", through, own)
    features = np.concatenate(
        [constant.reshape(m * k, 1), -2.0 * through.reshape(m * k, d), bends.reshape(m * k, d * d)],
        axis=1,
    )

    def of_several(c: Array) -> Array:
        off = c - middle
        n = len(off)
        squares = (off[:, :, np.newaxis] * off[:, np.newaxis, :]).reshape(n, d * d)
        terms = np.concatenate([np.ones((n, 1)), off, squares], axis=1)
        found = (features @ terms.T).reshape(m, k, n)
        result: Array = np.abs(np.moveaxis(found, 1, 2)) * function.weights
        return result

    return of_several


def errors(function: Nonlinear, kind: str, x: Array, c: Array) -> Array:
    """As on_places, for points that are known at once."""
    return on_places(function, kind, x)(c)


def of_bank(function: Nonlinear, kind: str, x: Array, c: Array) -> Array:
    """The error (m,) of whichever model is the best at each place, by its largest component.

    Eqs. 32 and 33, but one model serves all components of a state: (32) lets each take its own.
    """
    result: Array = errors(function, kind, x, c).max(axis=-1).min(axis=-1)
    return result


def worst_of(found: Array) -> float:
    """The objective of eq. 33, of errors (m, n, k) at places."""
    return float(found.max(axis=-1).min(axis=-1).max())


def radii(function: Nonlinear, kind: str, x: Array, c: Array) -> Array:
    """The largest error (k,) of each component, unweighted, by the models of `of_bank`."""
    found = errors(function, kind, x, c)
    best = found.max(axis=-1).argmin(axis=-1)
    own = found[np.arange(len(x)), best]
    result: Array = own.max(axis=0) / function.weights
    return result


def largest_curvature(function: Nonlinear, x: Array) -> float:
    """The largest weighted second derivative at places x (m, d), by the spectral norm.

    What a normalised error is divided by: T v1 in the paper's example.
    """
    norms = np.linalg.norm(function.hessian(x), ord=2, axis=(-2, -1))
    return float((norms * function.weights).max())


def lattice(low: Array, high: Array, most: int) -> Array:
    """Evenly spaced places (m, d) of a box, its corners among them, about as many as asked for."""
    d = len(low)
    per_axis = max(round(most ** (1.0 / d)), 3)
    axes = [np.linspace(a, b, per_axis) for a, b in zip(low, high, strict=True)]
    grid = np.meshgrid(*axes, indexing="ij")
    result: Array = np.stack([part.ravel() for part in grid], axis=-1)
    return result
