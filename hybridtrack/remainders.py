"""What a linearisation leaves out, enclosed for certain.

r(x) = m(x) - m(c) - J(c) (x - c) over a box. Where a component of m is affine but for waves
A cos(w x_v + phase) of single states, its range is exact: between the ends of an interval the wave
less its tangent is extremal only where the slopes agree, and these places can be told. All other
components are enclosed by interval arithmetic: the mean-value form (J(X) - J(c)) (X - c) and
Lagrange's (X - c)' H(X) (X - c) / 2 (Scholte, Campbell 2003), whichever end is tighter.

Interval arithmetic is python-flint's `arb`: rigorous balls with every elementary function, a
microsecond an operation, wheels for every platform. mpmath's `iv` is rigorous too, but fifty times
slower and without inverse functions; codac is made for contractors and wants a C++ library.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from hybridtrack.maps import Map, Wave, waves
from hybridtrack.models import Array

ROUNDING = 16 * np.finfo(np.float64).eps  # of a sum of five terms, each right to two last bits

Enclosed = tuple[Array, Array]  # lower and upper ends (lanes, n)


class Remainder(NamedTuple):
    """The remainder of one map, ready to be enclosed."""

    map: Map
    waves: tuple[tuple[Wave, ...] | None, ...]  # by component
    balls: "Balls | None"  # for those that are None

    @property
    def is_zero(self) -> bool:
        """Whether the map is affine."""
        return all(found == () for found in self.waves)

    def enclose(self, centre: Array, low: Array, high: Array, u: Array) -> Enclosed:
        """Ends (lanes, n) of r over the box [low, high] (lanes, n_x); c (lanes, n_x), u (n_u,)."""
        lower, upper = np.zeros((2, len(centre), len(self.waves)))
        for i, found in enumerate(self.waves):
            for wave in found or ():
                v, (amplitude, phase) = wave.state, wave.phasor(u)
                ends = (wave.frequency * side[:, v] + phase for side in (centre, low, high))
                with np.errstate(all="ignore"):
                    least, most = wave_range(*ends)
                    lower[:, i] += amplitude * least
                    upper[:, i] += amplitude * most
        general = [i for i, found in enumerate(self.waves) if found is None]
        if general:
            assert self.balls is not None
            with np.errstate(all="ignore"):
                least, most = self.balls.enclose(centre, low, high, u)
            lower[:, general], upper[:, general] = least[:, general], most[:, general]
        # What is no number, as the amplitude log(u) at u = 0, bounds nothing.
        return np.where(np.isnan(lower), -np.inf, lower), np.where(np.isnan(upper), np.inf, upper)

    def at_point(self, centre: Array, x: Array, u: Array) -> Array:
        """|(x - c)' H(x) (x - c)| (lanes, n) at a single point, as Otanez 2004, eq. 40."""
        d = x - centre
        curvature = self.map.hessian(x, u)
        result: Array = np.abs(np.einsum("be,bief,bf->bi", d, curvature, d))
        return result


def remainder(map_: Map, turning: Sequence[int] = ()) -> Remainder:
    """The remainder of a map; turning: components that count but for whole turns of 2 pi."""
    found = waves(map_)
    balls = Balls(map_, turning) if any(one is None for one in found) else None
    return Remainder(map_, found, balls)


def wave_range(centre: Array, low: Array, high: Array) -> Enclosed:
    """Least and most (lanes,) of g(t) = cos t - cos c + sin c (t - c) for t in [low, high].

    g' = sin c - sin t is 0 at t = c + 2 pi k and at t = pi - c + 2 pi k. In each of the two series
    g is linear in k, so the first and the last inside are all that can be extremal. Rounded
    outwards.
    """
    sine, cosine = np.sin(centre), np.cos(centre)
    places = [low, high]
    with np.errstate(all="ignore"):
        for series in (centre, np.pi - centre):
            first = np.ceil((low - series) / (2 * np.pi))
            last = np.floor((high - series) / (2 * np.pi))
            for k in (first, last):  # one that rounding puts outside is moved to the end
                inside = np.clip(series + 2 * np.pi * k, low, high)
                places.append(np.where(first <= last, inside, low))
        t = np.stack(places)
        g = np.cos(t) - cosine + sine * (t - centre)
        size = 2.0 + np.abs(t).max(axis=0) + np.abs(centre)
        # A place is off by a few last bits, and g is flat there; c is by less than eps (2 + |c|),
        # and g's slope by c is up to |t - c|: that is less than this.
        far = np.abs(t - centre).max(axis=0)
        slack = ROUNDING * (size + 0.25 * (2.0 + np.abs(centre)) * far)
        sound = np.isfinite(size)
    least = np.where(sound, g.min(axis=0) - slack, -np.inf)
    most = np.where(sound, g.max(axis=0) + slack, np.inf)
    return least, most


class Balls:
    """Remainders of any map by interval arithmetic, lane by lane."""

    def __init__(self, map_: Map, turning: Sequence[int] = ()) -> None:
        """Compile derivatives to functions of balls; turning: as in `remainder`."""
        import sympy

        arguments = (*map_.states, *map_.inputs)
        # Derivatives of atan2 are smooth across its cut, where it jumps by 2 pi.
        cuts = [
            (i, angle)
            for i, one in enumerate(map_.expressions)
            for angle in sorted(one.atoms(sympy.atan2), key=str)
            if angle.free_symbols & set(map_.states)
            and not (i in turning and _jumps_by_turns(one, angle))
        ]
        self._cut = [i for i, _ in cuts]
        sides = [side for _, angle in cuts for side in angle.args]
        self._sides = over_balls(arguments, sides)
        # Of atan(tan(x)) every derivative is smooth, and the value jumps at the poles of tan.
        self._value = over_balls(arguments, map_.expressions)
        self._shape = (len(map_.expressions), len(map_.states))
        self._jacobian = over_balls(arguments, map_.gradient)
        self._hessian = over_balls(arguments, map_.curvature)

    def enclose(self, centre: Array, low: Array, high: Array, u: Array) -> Enclosed:
        """Ends (lanes, n) over the hull of the box [low, high] and the centre."""
        n, _ = self._shape
        lower, upper = np.full((2, len(centre), n), np.nan)
        lower[:], upper[:] = -np.inf, np.inf
        boxes = zip(centre, np.minimum(low, centre), np.maximum(high, centre), strict=True)
        for b, (c, least, most) in enumerate(boxes):
            if np.isfinite(least).all() and np.isfinite(most).all():
                lower[b], upper[b] = self._one(c, least, most, u)
        return lower, upper

    def _one(self, c: Array, low: Array, high: Array, u: Array) -> Enclosed:
        from flint import arb

        n, n_x = self._shape
        point = [arb(float(value)) for value in c]
        X = [arb(float(a)).union(arb(float(b))) for a, b in zip(low, high, strict=True)]
        inputs = [arb(float(value)) for value in u]
        step = [x - p for x, p in zip(X, point, strict=True)]
        slopes, there = (self._all(self._jacobian, (*at, *inputs), n * n_x) for at in (X, point))
        bends = self._all(self._hessian, (*X, *inputs), n * n_x * n_x)
        lower, upper = np.empty(n), np.empty(n)
        for i in range(n):
            row = range(i * n_x, (i + 1) * n_x)
            mean_value, lagrange = arb(0), arb(0)
            for j, d in zip(row, step, strict=True):
                mean_value += product(slopes[j] - there[j], d)
            for e in range(n_x):
                for f in range(n_x):
                    bend = bends[(i * n_x + e) * n_x + f]
                    square = even_power(step[e], 2) if e == f else step[e] * step[f]
                    lagrange += product(bend, square)
            forms = [ends(mean_value), ends(lagrange / 2)]
            lower[i] = max(form[0] for form in forms)
            upper[i] = min(form[1] for form in forms)
        values = self._all(self._value, (*X, *inputs), n)
        jumps = [i for i, value in enumerate(values) if not value.is_finite()]
        sides = self._all(self._sides, (*X, *inputs), 2 * len(self._cut))
        for i, y, x in zip(self._cut, sides[::2], sides[1::2], strict=True):
            if not (y > 0 or y < 0 or x > 0):  # comparisons of balls hold for all their points
                jumps.append(i)
        lower[jumps], upper[jumps] = -np.inf, np.inf
        return lower, upper

    @staticmethod
    def _all(function: Callable[..., Any], arguments: Sequence[Any], count: int) -> list[Any]:
        """Every element; where one has no meaning on the interval, all are unbounded."""
        from flint import arb

        try:
            return [arb(value) for value in function(*arguments)]
        except (ZeroDivisionError, ValueError):
            return [arb("0 +/- inf")] * count


def _jumps_by_turns(expression: Any, angle: Any) -> bool:
    """Whether an angle stands in an expression as a term, a whole number of times, and no more."""
    import sympy

    rest, found = [], 0
    for term in sympy.Add.make_args(expression):
        times, product = term.as_coeff_Mul()
        if product == angle and times.is_Integer:
            found += 1
        else:
            rest.append(term)
    return found == 1 and not any(term.has(angle) for term in rest)


def over_balls(arguments: Sequence[Any], expressions: Sequence[Any]) -> Callable[..., Any]:
    """SymPy expressions as one function of balls."""
    import sympy
    from sympy.printing.lambdarepr import LambdaPrinter

    class Printer(LambdaPrinter):  # type: ignore[misc]
        def _print_Pow(self, expr: Any, **settings: Any) -> Any:
            if expr.exp.is_Integer and expr.exp % 2 == 0:
                return f"even_power({self._print(expr.base)}, {expr.exp})"
            return super()._print_Pow(expr, **settings)

    words = ball_functions()
    printer = Printer({"allow_unknown_functions": True, "user_functions": {w: w for w in words}})
    compiled: Callable[..., Any] = sympy.lambdify(
        arguments, list(expressions), modules=[words], printer=printer
    )
    return compiled


def product(one: Any, two: Any) -> Any:
    """The range of a product: of balls by middle and radius [0, 2] times [0, 2] begins at -2."""
    corners = [a * b for a in (one.lower(), one.upper()) for b in (two.lower(), two.upper())]
    return corners[0].union(corners[1]).union(corners[2]).union(corners[3])


def even_power(ball: Any, n: int) -> Any:
    """The range of an even power, which a product of the ball with itself would take below 0."""
    from flint import arb

    low, high = (end ** abs(n) for end in (arb(ball).abs_lower(), arb(ball).abs_upper()))
    found = low.union(high)
    return found if n > 0 else 1 / found


def ends(ball: Any) -> tuple[float, float]:
    """Floats at or beyond the ends of a ball; infinite where it has none."""
    if not ball.is_finite():
        return -np.inf, np.inf
    low, high = float(ball.lower()), float(ball.upper())
    if ball.lower() != low:
        low = float(np.nextafter(low, -np.inf))
    if ball.upper() != high:
        high = float(np.nextafter(high, np.inf))
    return low, high


def ball_functions() -> dict[str, Any]:
    """The functions of expressions on balls, by the names that SymPy's printer gives them."""
    from flint import arb

    def of(name: str) -> Callable[[Any], Any]:
        return lambda value: getattr(arb(value), name)()

    plain = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log")
    words: dict[str, Any] = {name: of(name) for name in (*plain, "sqrt")}
    words["even_power"] = even_power
    words["atan2"] = lambda y, x: arb.atan2(arb(y), arb(x))
    return words
