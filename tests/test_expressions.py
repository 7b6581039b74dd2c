"""Expressions: what they mean, what is refused, and that nothing in them is ever executed."""

import math
import time
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridtrack import expressions as ex
from hybridtrack import maps
from set_models import NAMES, system

NONE = np.zeros(0)
SYMBOLS = dict(zip(NAMES, maps.symbols(NAMES, "state"), strict=True))


def value(text, **names):
    """An expression's value at numbers for x, y, psi."""
    at = np.array([[names.get(name, 0.0) for name in NAMES]])
    return float(system((text,)).value(at, NONE)[0, 0])


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("x + 0.01*(-3 + 10*cos(psi) + 2*y)", 2 + 0.01 * (-3 + 10 * math.cos(0.5) + 2 * -1.5)),
        ("-x**2 + +y", -4 - 1.5),
        ("x**0.5 - sqrt(x)", 0.0),
        ("2**-2 + x/4", 0.75),
        ("atan2(y, x)", math.atan2(-1.5, 2)),
        ("exp(-x) + log(x) + tanh(y)", math.exp(-2) + math.log(2) + math.tanh(-1.5)),
        ("sin(pi/2)", 1.0),
        ("asin(psi) + acos(psi) + atan(psi)", math.pi / 2 + math.atan(0.5)),
        ("  x  ", 2.0),
    ],
)
def test_expressions_mean_what_they_say(text, wanted):
    assert value(text, x=2.0, y=-1.5, psi=0.5) == pytest.approx(wanted, rel=1e-15, abs=1e-15)


def test_no_digit_of_a_number_is_lost():
    for number in (0.1 + 0.2, 1 / 3, 1e-17, math.pi, 123456789.123456789):
        assert value(f"x*{number!r}", x=1.0) == number


def test_derivatives_are_the_differences():
    map_ = system(("x*cos(psi) - y**3", "atan2(y, x)*exp(psi)"))
    at = np.array([[1.2, 0.7, 0.3]])
    h = 1e-6
    for e in range(3):
        step = h * np.eye(3)[e]
        slope = (map_.value(at + step, NONE) - map_.value(at - step, NONE)) / (2 * h)
        np.testing.assert_allclose(map_.jacobian(at, NONE)[..., e], slope, atol=1e-8)
        bend = (map_.jacobian(at + step, NONE) - map_.jacobian(at - step, NONE)) / (2 * h)
        np.testing.assert_allclose(map_.hessian(at, NONE)[..., e], bend, atol=1e-8)


def test_lanes_are_independent():
    map_ = system(("x*y + 1", "3"))
    x = np.random.default_rng(1).standard_normal((7, 3))
    together = map_.value(x, NONE)
    for b in range(7):
        np.testing.assert_array_equal(together[b : b + 1], map_.value(x[b : b + 1], NONE))
    np.testing.assert_array_equal(together[:, 1], 3.0)


REFUSED = [
    ("__import__('os').system('true')", "calls what is no function's name"),
    ("__import__('os')", "'__import__' is no function here"),
    ("eval(x)", "'eval' is no function here"),
    ("x.real", "an attribute"),
    ("x.__class__", "an attribute"),
    ("x[0]", "an index"),
    ("(lambda: x)()", "calls what is no function's name"),
    ("lambda: x", "a lambda"),
    ("x if y else psi", "an if"),
    ("x < y", "a comparison"),
    ("x and y", "and or or"),
    ("[x, y]", "a list"),
    ("x, y", "a list"),
    ("[x for x in y]", "something else"),
    ("(z := x)", "something else"),
    ("f'{x}'", "something else"),
    ("'x'", "no number"),
    ("True", "no number"),
    ("1j*x", "no number"),
    ("None", "no number"),
    ("...", "no number"),
    ("*x", "no expression"),
    ("x = 1", "no expression"),
    ("x +", "no expression"),
    ("", "no expression"),
    ("x; y", "no expression"),
    ("x\x00", "no expression"),
    ("psii", "did you mean 'psi'"),
    ("q", "'q' is not known; there are x, y, psi"),
    ("cos", "'cos' is a function; write cos(...)"),
    ("coz(x)", "did you mean 'cos'"),
    ("cos(x, y)", "'cos' takes 1 argument"),
    ("atan2(x)", "'atan2' takes 2 arguments"),
    ("cos(x=1)", "'cos' takes 1 argument"),
    ("cos(*x)", "something else"),
    ("x^2", "write a power as x**2"),
    ("x//2", "an operation besides"),
    ("x % 2", "an operation besides"),
    ("x @ y", "an operation besides"),
    ("not x", "something else"),
    ("~x", "something else"),
    ("x**y", "an exponent is no number"),
    ("x**10**10", "an exponent is 10000000000"),
    ("9**9**9", "an exponent is 387420489"),
    ("x**21", "an exponent is 21"),
    ("((x**20)**20)**20", "a power in it is above 20"),
    ("x/0", "divides by zero"),
    ("x/(2 - 2)", "divides by zero"),
    ("0**-1", "divides by zero"),
    ("1/(x - x)", "divides by zero"),
    ("sqrt(-1)", "no value"),
    ("(-1)**0.5 + x", "no real value"),
    ("log(0)", "no value"),
    ("exp(1000)", "no value"),
    ("exp(exp(exp(1000)))", "no value"),
    ("1e400", "above 1e+30"),
    ("1e20*1e20", "above 1e+30"),
    ("10**20*10**20", "above 1e+30"),
    ("(" * 1000 + "x" + ")" * 1000, "nested deeper"),
    ("-" * 999 + "x", "nested deeper"),
    ("cos(" * 100 + "x" + ")" * 100, "nested deeper"),
    ("x" + "+x*1" * 300, "characters"),
    ("+".join("x" * 40), "OK"),
    ("+".join(["cos(x+x+x+x+x+x+x+x+x+x)"] * 8), "numbers and names"),
]


@pytest.mark.parametrize(("text", "said"), REFUSED, ids=range(len(REFUSED)))
def test_what_is_refused_is_one_sentence_in_no_time(text, said):
    begin = time.process_time()
    if said == "OK":
        ex.parse(text, SYMBOLS)
        return
    with pytest.raises(ex.ExpressionError) as caught:
        ex.parse(text, SYMBOLS)
    message = str(caught.value)
    assert said in message
    assert "\n" not in message
    assert ";" in message  # what is wrong; what to do
    assert len(message) < 250
    assert time.process_time() - begin < 0.5


KINKS = ["sqrt(x**2)", "sqrt((x + y)**2)*psi", "(x**2)**1.5", "cos(sqrt(cos(x)**2))"]


@pytest.mark.parametrize("text", KINKS)
def test_kinks_are_refused(text):
    with pytest.raises(ex.ExpressionError, match=r"it has a kink .*; write it without"):
        ex.parse(text, SYMBOLS)


def test_what_is_unknown_is_refused_after_differentiation_too():
    import sympy

    x = SYMBOLS["x"]
    for one, said in ((sympy.Abs(x), "a kink"), (sympy.gamma(x), "not known here")):
        with pytest.raises(ex.ExpressionError, match=said) as caught:
            maps.compiled([x, one], (x,), ())
        assert caught.value.component == 1


@pytest.mark.parametrize("text", ["sin(" * 58 + "x" + ")" * 58, "sin(x*" * 28 + "y" + ")" * 28])
def test_derivatives_that_are_too_long_are_refused(text):
    with pytest.raises(ex.ExpressionError, match="more than 5,000 operations; shorten it"):
        system((text,))


def test_no_expression_is_multiplied_out_at_length():
    """In functions and in divisors neither; powers of powers overflow no float."""
    inside = "(x + y + psi + 1)**20"
    nested = f"((({inside} + 1)**20 + 1)**20 + 1)**20"
    for text in (f"cos({inside}*{inside})", f"1/({inside} + 1)**20", f"x*cos({inside})", nested):
        map_ = system((text,))
        assert maps._terms(map_.expressions[0]) > maps.MOST_TERMS, text
        assert maps.waves(map_) == (None,)
    found = maps.waves(system(("2*(x + 3*(cos(psi) + 4*(y + 1)))", "(x + 1)**2 - x**2")))
    assert [len(one) for one in found] == [1, 0]


def test_no_warning_leaks_from_python_s_own_parser():
    """Recorded: as errors they would be the parser's SyntaxErrors, and refused as such."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for text in ("1if x else y", "1or x", "'\\d'", "1in x"):
            with pytest.raises(ex.ExpressionError):
                ex.parse(text, SYMBOLS)
    assert not caught


def test_names_never_become_code(tmp_path, monkeypatch):
    """A state may be called like a builtin; generated code knows it by a number."""
    monkeypatch.chdir(tmp_path)
    names = ("exec", "numpy", "open")
    map_ = system(("exec + 2*numpy", "cos(open)"), names)
    np.testing.assert_array_equal(map_.value(np.array([[1.0, 2.0, 0.0]]), NONE), [[5.0, 1.0]])
    assert not any(name in str(map_.expressions) for name in names)


SIGNS = [*"()+-*/,.[]:=~^@0", "**", " ", "\n", "é", "1", "2.5", "1e5"]
CODE = ["__import__", "'os'", "lambda", "eval"]
WORDS = st.sampled_from([*NAMES, *ex.FUNCTIONS, "pi", *SIGNS, *CODE])


@settings(max_examples=1500, deadline=None)
@given(st.one_of(st.lists(WORDS, max_size=14).map("".join), st.text(max_size=40)))
def test_any_text_is_an_expression_or_one_sentence(text):
    try:
        found = ex.parse(text, SYMBOLS)
    except ex.ExpressionError as error:
        said = str(error)
    else:
        assert found.free_symbols <= set(SYMBOLS.values())
        return
    assert "\n" not in said
    assert len(said) < 300


@st.composite
def formulas(draw, depth=0):
    """Well-formed expressions of moderate values."""
    leaf = st.sampled_from([*NAMES, "0.5", "3", "pi"])
    if depth > 3 or draw(st.booleans()):
        return draw(leaf)
    kind = draw(st.sampled_from(["sum", "product", "sin", "cos", "tanh", "square", "minus"]))
    one = draw(formulas(depth + 1))
    if kind in ("sum", "product"):
        return f"({one} {'+' if kind == 'sum' else '*'} {draw(formulas(depth + 1))})"
    return {"square": f"({one})**2", "minus": f"(-{one})"}.get(kind, f"{kind}({one})")


@settings(max_examples=60, deadline=None)
@given(formulas(), st.integers(0, 2**32 - 1))
def test_well_formed_ones_are_what_python_makes_of_them(text, seed):
    """Against Python's own eval, of text that is made here and nowhere else."""
    x = np.random.default_rng(seed).uniform(-1, 1, 3)
    names = dict(zip(NAMES, x, strict=True))
    words = {name: getattr(math, name) for name in ("sin", "cos", "tanh", "pi")}
    wanted = eval(text, {"__builtins__": {}}, words | names)
    found = float(system((text,)).value(x[np.newaxis], NONE)[0, 0])
    assert found == pytest.approx(wanted, rel=1e-9, abs=1e-9)
