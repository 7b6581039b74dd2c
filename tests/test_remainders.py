"""Remainders contain everything that is sampled, and no more where they are exact."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hybridtrack import maps, remainders
from reference_ellipsoids import scanned_remainder
from set_models import NAMES, aircraft, system

U = np.zeros(0)
ANGLE = st.floats(-30.0, 30.0, allow_nan=False)
WIDTH = st.floats(0.0, 40.0, allow_nan=False)


def sampled(map_, centre, low, high, generator, points=20_000):
    """Remainders at random points of a box, its corners among them."""
    x = generator.uniform(low, high, (points, len(centre)))
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(len(centre), -1).T
    x = np.concatenate([x, corners])
    base = map_.value(centre[np.newaxis], U) + (x - centre) @ map_.jacobian(centre[None], U)[0].T
    return map_.value(x, U) - base


@settings(max_examples=200, deadline=None)
@given(ANGLE, ANGLE, WIDTH)
@example(30.0, -22.0, 0.0)  # far from the centre, where rounding is worth the most
def test_the_range_of_a_wave_less_its_tangent_is_exact(centre, low, width):
    """Any width, the centre inside or far away: a scan comes as near as its grid lets it."""
    high = low + width
    least, most = (float(v[0]) for v in remainders.wave_range(*np.array([[centre], [low], [high]])))
    t = np.linspace(low, high, 40_001)
    g = np.cos(t) - np.cos(centre) + np.sin(centre) * (t - centre)
    assert least <= g.min()
    assert most >= g.max()
    grid = (
        0.5 * (width / 40_000) ** 2 + 1e-11
    )  # what a parabola of curvature 1 hides between points
    assert least >= g.min() - grid
    assert most <= g.max() + grid


@given(st.floats(-4, 4), st.floats(-4, 4), st.floats(0, 6))
@settings(max_examples=50, deadline=None)
def test_the_aircraft_s_remainder_is_the_scanned_one(at, middle, reach):
    found = aircraft().dynamics_remainder
    assert all(waves is not None for waves in found.waves)  # no interval arithmetic needed
    centre = np.array([[3.0, -7.0, at]])
    low, high = np.array([[0.0, 0.0, middle - reach]]), np.array([[9.0, 9.0, middle + reach]])
    least, most = found.enclose(centre, low, high, U)
    wanted = scanned_remainder(at, middle - reach, middle + reach, 20_001)
    np.testing.assert_allclose(least[0], wanted[0], atol=1e-8)
    np.testing.assert_allclose(most[0], wanted[1], atol=1e-8)


MAPS = {
    "range and bearing": ("sqrt(x**2 + y**2)", "atan2(y, x)"),
    "several waves": ("sin(2*x + .3) - 3*cos(2*x) + cos(y)", "x*y"),
    "two frequencies": ("sin(x) + sin(3*x)", "exp(-x/4)"),
    "products": ("x*cos(psi) + y*sin(psi)", "x**3 - y**2*psi"),
    "quotient": ("y/(x + 10)", "log(x + 10)"),
    "hyperbolic": ("tanh(x)", "atan(y)*cosh(psi/3)"),
}


@pytest.mark.parametrize("texts", MAPS.values(), ids=MAPS)
def test_every_sampled_remainder_is_inside(texts):
    map_ = system(texts)
    whole = remainders.remainder(map_)
    generator = np.random.default_rng(2)
    for _ in range(40):
        centre = generator.uniform(1.0, 5.0, 3)
        reach = generator.uniform(0.0, 0.9, 3)
        middle = centre + generator.uniform(-0.05, 0.05, 3)
        low, high = middle - reach, middle + reach
        least, most = whole.enclose(centre[None], low[None], high[None], U)
        found = sampled(map_, centre, low, high, generator, 500)
        slack = 1e-13 * (1 + np.abs(found).max())  # of the sample's own rounding
        assert (found >= least[0] - slack).all()
        assert (found <= most[0] + slack).all()


def test_balls_enclose_what_is_exact_and_are_not_absurdly_wide():
    """Interval arithmetic on the aircraft against the exact range: wider, within a factor 4."""
    exact, balls = aircraft().dynamics_remainder, remainders.Balls(aircraft().dynamics)
    centre = np.array([[0.0, 0.0, 0.7]])
    low, high = centre - 0.3, centre + 0.3
    narrow, wide = exact.enclose(centre, low, high, U), balls.enclose(centre, low, high, U)
    assert (wide[0][:, :2] <= narrow[0][:, :2]).all()
    assert (wide[1][:, :2] >= narrow[1][:, :2]).all()
    assert ((wide[1] - wide[0])[0, :2] < 4 * (narrow[1] - narrow[0])[0, :2]).all()


def test_affine_maps_leave_nothing():
    whole = remainders.remainder(system(("x + 2*y - 3", "psi/4")))
    assert whole.is_zero
    box = np.array([[1.0, 2, 3]])
    least, most = whole.enclose(box, box - 1, box + 1, U)
    assert not least.any()
    assert not most.any()


def test_where_a_map_has_no_value_its_remainder_is_unbounded():
    whole = remainders.remainder(system(("1/x", "sqrt(y)")))
    box = np.array([[1.0, 1.0, 0.0]])
    least, most = whole.enclose(box, box - 2, box + 2, U)
    assert (least == -np.inf).all()
    assert (most == np.inf).all()
    least, most = whole.enclose(box, np.full((1, 3), np.nan), box, U)
    assert (most == np.inf).all()


@pytest.mark.parametrize("text", ["atan(tan(x))", "atan(sin(x)/cos(x))", "atan2(tan(x), 1)"])
def test_a_jump_that_no_derivative_knows_is_unbounded(text):
    """SymPy's derivative of atan(tan(x)) is 1, and its value falls by pi at pi/2."""
    whole = remainders.remainder(system((text,)))
    centre = np.array([[1.4, 0.0, 0.0]])
    least, most = whole.enclose(centre, centre - 0.4, centre + 0.4, U)
    assert (least[0, 0], most[0, 0]) == (-np.inf, np.inf)
    assert np.isfinite(whole.enclose(centre, centre - 0.1, centre + 0.1, U)).all()


def test_negative_powers_are_enclosed():
    """Dense places of x^-2 and x^-4, which are no x^2 and x^4."""
    map_ = system(("x**-2", "x**-4", "(x + y)**-3"))
    whole = remainders.remainder(map_)
    centre = np.array([2.0, 0.5, 0.0])
    low, high = centre - 0.7, centre + 0.7
    least, most = whole.enclose(centre[None], low[None], high[None], U)
    found = sampled(map_, centre, low, high, np.random.default_rng(3), 2000)
    assert (found >= least[0]).all()
    assert (found <= most[0]).all()
    assert (most[0] - least[0] < 12 * np.ptp(found, axis=0)).all()


@pytest.mark.parametrize(
    ("bearing", "bounded"),
    [
        ("atan2(y, x)", True),
        ("psi - 2*atan2(y, x)", True),
        ("atan2(y, x)/2", False),
        ("cos(psi)*atan2(y, x)", False),
        ("atan2(y, x) + sin(atan2(y, x)/2)", False),
    ],
)
def test_what_counts_but_for_whole_turns_has_no_cut(bearing, bounded):
    """A jump of a whole turn is none, of half a turn it is one."""
    whole = remainders.remainder(system((bearing,)), turning=(0,))
    centre = np.array([[-3.0, 0.2, 0.1]])
    least, most = whole.enclose(centre, centre - 0.3, centre + 0.3, U)
    assert np.isfinite([least, most]).all() == bounded
    round_the_pole = whole.enclose(centre, centre - 3.2, centre + 3.2, U)
    assert np.isinf(round_the_pole).all()


def test_in_front_a_bearing_is_bounded():
    """The cut is behind: y about 0 is no matter where x is positive."""
    whole = remainders.remainder(system(("atan2(y, x)",)))
    centre = np.array([[3.0, 0.0, 0.0]])
    assert np.isfinite(whole.enclose(centre, centre - 0.4, centre + 0.4, U)).all()


def test_waves_of_high_frequency_allow_for_their_rounding():
    """Against 40 digits, where the angle's own last bits are worth 1e-8 of the remainder."""
    import mpmath

    w, c = 1e6, 1.0
    whole = remainders.remainder(system((f"sin({w:.0f}*x)",)))
    centre, reach = np.array([[c, 0.0, 0.0]]), np.array([[1e-3, 0.0, 0.0]])
    least, most = whole.enclose(centre, centre - reach, centre + reach, U)
    with mpmath.workdps(40):
        slope, value = w * mpmath.cos(w * c), mpmath.sin(w * c)
        for t in np.linspace(-1e-3, 1e-3, 4001):
            exact = mpmath.sin(w * (c + mpmath.mpf(t))) - value - slope * mpmath.mpf(t)
            assert least[0, 0] <= exact <= most[0, 0]


def test_a_wave_of_an_input_has_its_amplitude():
    """A x_v-wave whose amplitude an input gives is exact as well."""
    from hybridtrack import expressions as ex

    x, u = maps.symbols(NAMES, "state"), maps.symbols(("v",), "input")
    names = dict(zip((*NAMES, "v"), (*x, *u), strict=True))
    map_ = maps.compiled([ex.parse("x + v*cos(psi)", names)], x, u)
    whole = remainders.remainder(map_)
    assert whole.waves[0] is not None
    centre = np.array([[0.0, 0.0, 0.4]])
    one, three = (
        whole.enclose(centre, centre - 1, centre + 1, np.array([v]))[1] for v in (1.0, 3.0)
    )
    np.testing.assert_allclose(three, 3 * one, rtol=1e-9)


@pytest.mark.parametrize("bearing", ["atan2(y, x)", "psi + 2*atan2(y, x)", "cos(psi)*atan2(y, x)"])
def test_across_the_cut_of_atan2_the_remainder_is_unbounded(bearing):
    """Its derivatives are smooth there and it jumps by 2 pi; beside it all is as ever."""
    whole = remainders.remainder(system((bearing, "sqrt(x**2 + y**2)")))
    centre = np.array([[-3.0, 0.2, 0.1]])
    least, most = whole.enclose(centre, centre - 0.3, centre + 0.3, U)
    assert (least[0, 0], most[0, 0]) == (-np.inf, np.inf)
    assert np.isfinite([least[0, 1], most[0, 1]]).all()
    for beside in ([-3.0, 0.4, 0.1], [-3.0, -0.4, 0.1], [3.0, 0.4, 0.1]):
        c = np.array([beside])
        assert np.isfinite(whole.enclose(c, c - 0.3, c + 0.3, U)).all()
    # The hull with the centre counts: the box alone lies on one side.
    low, high = np.array([[-3.0, -0.3, 0.1]]), np.array([[-2.9, -0.1, 0.1]])
    assert whole.enclose(centre, low, high, U)[1][0, 0] == np.inf


@pytest.mark.filterwarnings("error")
def test_inputs_without_a_value_leave_a_wave_unbounded():
    """The logarithm of 0 is no crash: what isn't known bounds nothing."""
    from hybridtrack import expressions as ex

    x, u = maps.symbols(NAMES, "state"), maps.symbols(("v",), "input")
    names = dict(zip((*NAMES, "v"), (*x, *u), strict=True))
    whole = remainders.remainder(maps.compiled([ex.parse("x + log(v)*cos(psi)", names)], x, u))
    assert whole.waves[0] is not None
    box = np.array([[0.0, 0.0, 0.4]])
    for v in (0.0, -1.0, np.nan):
        least, most = whole.enclose(box, box - 1, box + 1, np.array([v]))
        assert (least[0, 0], most[0, 0]) == (-np.inf, np.inf)


def test_even_powers_and_products_don_t_begin_below_their_range():
    """Of x^4 about 0 nothing is below 0; by middles and radii it would begin at -48."""
    low, high = -np.ones((1, 3)), 2 * np.ones((1, 3))
    found = remainders.remainder(system(("x**4", "y", "psi")))
    least, most = found.enclose(np.zeros((1, 3)), low, high, np.zeros(0))
    assert -1e-5 < least[0, 0] <= 0.0
    assert 16.0 <= most[0, 0] < 64.001
