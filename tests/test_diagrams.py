"""State transition diagrams: what is drawn is the transition matrix, and all of it can be read."""

import functools
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch

import hybridtrack
from hybridtrack.chains import Bound
from hybridtrack.diagrams import Chain, chains, draw, short
from hybridtrack.errors import UserError
from hybridtrack.estimators import estimators
from hybridtrack.figures import save
from models import figure_5_model, scenario
from scenarios import CHAIN

NAMES = ("CV", "CA", "CT", "H", "J")
LONG = ("nonmaneuvering_flight_with_constant_velocity", "turn", "W" * 64)
SOFT, LEAKING = Bound(continuation_probability=0.98), Bound(0.9, leak=0.00123)

BOUNDED = (
    CHAIN.replace("  chain:\n", "  chain:\n    most_transitions: 2\n")
    .replace("IMM: {type: imm}", "IMM: {type: imm}, MMAE: {type: mmae}, S: {type: sbf, SOFT}")
    .replace("SOFT", "continuation_probability: 0.98")
    .replace("S: {", "HBF: {type: hbf, most_transitions: 3}, SBF: {")
)


UNEVEN = """\
name: uneven
clock: {times_s: [0, 2, 3, 7]}
truth:
  start: {position_m: [0, 0], speed_m_s: 100, heading_deg: 0}
  legs: [{until_s: 7}]
sensor: {position_std_m: 3}
modes:
  slow: {motion: constant_velocity, acceleration_std_m_s2: 1}
  fast: {motion: constant_velocity, acceleration_std_m_s2: 9}
mean_sojourn_s: {slow: 10, fast: 4}
initial: {mean: truth, position_std_m: 1, velocity_std_m_s: 2}
estimators: {IMM: {type: imm}}
monte_carlo: {runs: 10, seed: 1}
"""


def one_chain(modes: int, bound: Bound, start=None, names=NAMES) -> Chain:
    """A chain of so many modes whose probabilities, diagonal and all, are all different."""
    weights = np.arange(1.0, modes**2 + 1).reshape(modes, modes) ** 2 + 40 * np.eye(modes)
    matrix = weights / weights.sum(axis=1, keepdims=True)
    start = np.full(modes, 1 / modes) if start is None else np.array(start)
    supermodes = bound.supermodes(matrix[np.newaxis], start)
    return Chain("SBF", tuple(names[:modes]), supermodes, bound, "a step of 10 s")


SHOWN = {
    "plain, 2 modes": one_chain(2, Bound()),
    "plain, 3 modes": one_chain(3, Bound()),
    "soft, 1 mode": one_chain(1, SOFT),
    "soft, 2 modes": one_chain(2, SOFT, (1.0, 0.0)),
    "soft, 2 modes, leaking": one_chain(2, LEAKING),
    "soft, 3 modes": one_chain(3, SOFT),
    "soft, 3 modes, leaking": one_chain(3, LEAKING),
    "soft, 4 modes": one_chain(4, SOFT),
    "hard, 2 modes": one_chain(2, Bound(most_transitions=2)),
    "hard, 2 modes, zigzag": one_chain(2, Bound(most_transitions=4), (1.0, 0.0)),
    "hard, 3 modes": one_chain(3, Bound(most_transitions=2)),
    "hard, 4 modes": one_chain(4, Bound(most_transitions=2)),
    "plain, 5 modes": one_chain(5, Bound()),
    "plain, long names": one_chain(3, Bound(), names=LONG),
    "soft, long names": one_chain(3, SOFT, names=LONG),
}
# Colours tell whose label it is where many lines cross.
FEW_CROSSINGS = [name for name in SHOWN if not name.startswith(("hard, 3", "hard, 4", "plain, 5"))]


@functools.cache  # each is looked at by many tests
def drawn(name: str) -> Figure:
    chain = SHOWN[name]
    figure = draw({"chain": chain}, "A title")["chain"]
    figure.canvas.draw()
    return figure


def circles(figure: Figure) -> np.ndarray:
    """The middles of the circles, in the order of supermodes; the inner rings are left out."""
    found = [p for p in figure.axes[0].patches if isinstance(p, Circle)]
    return np.array([p.center for p in found if p.get_facecolor()[3]])


def arrows(figure: Figure) -> list[FancyArrowPatch]:
    return [p for p in figure.axes[0].patches if isinstance(p, FancyArrowPatch)]


def ends(figure: Figure, arrow: FancyArrowPatch) -> tuple[int, int]:
    """The supermodes where an arrow begins and where its head is, from what is drawn alone."""
    vertices = arrow.get_path().vertices  # the line's four points, its head's three, a closing one
    assert len(vertices) == 8
    away = [np.hypot(*(circles(figure) - p).T) for p in (vertices[0], vertices[4:7].mean(axis=0))]
    assert away[0].min() == pytest.approx(0.31, abs=1e-6)
    assert 0.31 < away[1].min() < 0.4
    return int(away[0].argmin()), int(away[1].argmin())


def polyline(arrow: FancyArrowPatch) -> np.ndarray:
    t = np.linspace(0, 1, 400)[:, None]
    a, b, c, d = arrow._path_original.vertices
    return a * (1 - t) ** 3 + 3 * b * t * (1 - t) ** 2 + 3 * c * t**2 * (1 - t) + d * t**3


def boxes(figure: Figure) -> list[tuple[str, np.ndarray]]:
    """Every text and the corners of what it covers (2, 2), inches of the axes."""
    back = figure.axes[0].transData.inverted()
    found = figure.axes[0].texts
    return [(t.get_text(), back.transform(t.get_window_extent().get_points())) for t in found]


def labels(figure: Figure) -> list[tuple[str, np.ndarray]]:
    """The probabilities among the texts."""
    small = [t.get_fontsize() == 8.0 and t.get_color() != "black" for t in figure.axes[0].texts]
    return [box for box, is_label in zip(boxes(figure), small, strict=True) if is_label]


def from_box(box: np.ndarray, points: np.ndarray) -> float:
    """The distance of the nearest of some points from a box."""
    off = np.maximum(np.maximum(box[0] - points, points - box[1]), 0.0)
    return float(np.hypot(*off.T).min())


@pytest.mark.parametrize("name", SHOWN)
def test_arrows_are_the_nonzero_entries_from_row_to_column(name):
    chain = SHOWN[name]
    matrix = chain.supermodes.transition_matrix[0]
    figure = drawn(name)
    assert len(circles(figure)) == len(matrix)
    found = sorted(ends(figure, arrow) for arrow in arrows(figure))
    assert found == [tuple(pair) for pair in np.argwhere(matrix).tolist()]


@pytest.mark.parametrize("name", SHOWN)
def test_a_column_per_mode_and_a_row_per_stage(name):
    mode, stage = SHOWN[name].supermodes[:2]
    across, up = circles(drawn(name)).T
    for values, places in ((mode, across), (-stage, up)):
        order = np.argsort(places, kind="stable")
        np.testing.assert_array_equal(np.diff(places[order]) > 0, np.diff(values[order]) > 0)


@pytest.mark.parametrize("name", FEW_CROSSINGS)
def test_the_label_nearest_to_an_arrow_says_its_probability(name):
    chain = SHOWN[name]
    matrix = chain.supermodes.transition_matrix[0]
    figure = drawn(name)
    assert len(labels(figure)) == np.count_nonzero(matrix)
    for text, box in labels(figure):
        nearest = min(arrows(figure), key=lambda arrow: from_box(box, polyline(arrow)))
        assert text == short(matrix[ends(figure, nearest)])


@pytest.mark.parametrize("name", SHOWN)
def test_a_label_has_the_colour_of_the_mode_that_its_arrow_leaves(name):
    chain = SHOWN[name]
    figure = drawn(name)
    written = [t for t in figure.axes[0].texts if t.get_fontsize() == 8.0]
    written = [(t.get_text(), np.array(t.get_color())) for t in written if t.get_color() != "black"]
    expected = {}
    for arrow in arrows(figure):
        i, j = ends(figure, arrow)
        assert arrow.get_edgecolor()[:3] == circle_colour(figure, i)
        text = short(chain.supermodes.transition_matrix[0, i, j])
        expected.setdefault(text, []).append(0.7 * np.array(circle_colour(figure, i)))
    for text, colour in written:
        assert any(np.allclose(colour, one) for one in expected[text])
    assert sorted(t for t, _ in written) == sorted(t for t, all_ in expected.items() for _ in all_)


def circle_colour(figure: Figure, supermode: int) -> tuple[float, ...]:
    found = [p for p in figure.axes[0].patches if isinstance(p, Circle) and p.get_facecolor()[3]]
    return found[supermode].get_edgecolor()[:3]


@pytest.mark.parametrize("name", SHOWN)
def test_no_text_covers_another_or_a_line_or_a_circle(name):
    figure = drawn(name)
    lines = [polyline(arrow) for arrow in arrows(figure)]
    everything = boxes(figure)
    for a, (_, one) in enumerate(everything):
        for _, other in everything[:a]:
            assert (np.maximum(one[0], other[0]) >= np.minimum(one[1], other[1])).any()
    for text, box in everything:
        assert all(from_box(box, line) > 0.0 for line in lines), text
        for centre in circles(figure):
            inside = (np.abs(box.mean(axis=0) - centre) < 0.1).all()
            corners = np.array([(x, y) for x in box[:, 0] for y in box[:, 1]])
            if inside:  # the supermode's own name, within the inner ring
                assert np.hypot(*(corners - centre).T).max() < 0.33, text
            else:
                assert from_box(box, centre[np.newaxis]) > 0.31, text


@pytest.mark.parametrize("name", SHOWN)
def test_no_line_meets_a_circle_on_its_way_or_another_ones_loop(name):
    figure = drawn(name)
    lines = {ends(figure, arrow): polyline(arrow) for arrow in arrows(figure)}
    for pair, line in lines.items():
        for s, centre in enumerate(circles(figure)):
            assert s in pair or np.hypot(*(line - centre).T).min() > 0.4
            loop = lines.get((s, s))
            if loop is not None and pair != (s, s):
                assert np.hypot(*np.moveaxis(line[:, None] - loop, -1, 0)).min() > 0.04


@pytest.mark.parametrize("name", SHOWN)
def test_nothing_is_cut_off(name):
    figure = drawn(name)
    ax = figure.axes[0]
    corners = np.concatenate([box for _, box in boxes(figure)])
    points = np.concatenate([corners, *(polyline(arrow) for arrow in arrows(figure))])
    low, high = np.transpose([ax.get_xlim(), ax.get_ylim()])
    assert (points > low).all()
    assert (points < high).all()
    np.testing.assert_allclose(figure.get_size_inches(), high - low, rtol=1e-12)  # 1:1


def test_rows_columns_and_starts_are_named():
    def texts(name):
        return {text for text, _ in boxes(drawn(name))}

    soft = texts("soft, 2 modes")
    assert soft >= {"CV", "CA", "0: may change", "1: ended", "CV\n0", "CA\n1"}
    zigzag = texts("hard, 2 modes, zigzag")
    assert zigzag >= {"0 transitions", "1 transition", "4 transitions", "CV\n4"}
    plain = texts("plain, 2 modes")
    assert {"CV", "CA"} < plain
    assert not any("0\n" in text or "transition" in text for text in plain)
    long = texts("plain, long names")
    assert "m1: nonmaneuvering_\nflight_with_constant_\nvelocity" in long
    assert {"m1", "m2", "m3"} < long
    assert not any("$" in text.replace(r"\$", "") for text in long)


def test_a_double_ring_is_a_possible_start():
    for name, starts in (("soft, 2 modes", [0]), ("soft, 2 modes, leaking", [0, 1])):
        figure = drawn(name)
        rings = [p for p in figure.axes[0].patches if isinstance(p, Circle)]
        inner = [p.center for p in rings if not p.get_facecolor()[3]]
        np.testing.assert_array_equal(inner, circles(figure)[starts])
    heading = boxes(drawn("soft, 2 modes"))[-1][0].replace("\n", " ")
    assert heading.startswith("A title Markov chain of SBF: probabilities of a step of 10 s")
    assert heading.endswith("double ring: possible at the start (CV\N{NO-BREAK SPACE}1)")


def test_a_title_is_no_mathematics_and_fits_whatever_it_says():
    title = r"$\nothing$ for $5 " + "W" * 150
    figure = draw({"chain": SHOWN["plain, 2 modes"]}, title)["chain"]
    heading, box = boxes(figure)[-1]
    assert heading.startswith(r"$\nothing$ for $5 W")
    assert figure.axes[0].get_xlim()[1] > box[1, 0]


@pytest.mark.parametrize(
    ("probability", "text"),
    [
        (0.98 * 0.92, "0.9016"),
        (1 - 0.98, "0.02"),
        (1.0, "1"),
        (1 - 1e-16, "1"),
        (1 / 3, "0.3333"),
        (0.99999, "1 − 1e-5"),
        (1e-5, "1e-5"),
        (2.5e-12, "2.5e-12"),
        (0.99994, "0.9999"),
    ],
)
def test_probabilities_are_short(probability, text):
    assert short(probability) == text


def test_the_same_chain_gives_the_same_bytes(tmp_path):
    chosen = {"a": SHOWN["hard, 3 modes"], "b": SHOWN["soft, long names"]}
    first = save(draw(chosen, "A title"), tmp_path / "first")
    second = save(draw(chosen, "A title"), tmp_path / "second")
    assert [path.name for path in first] == ["a.png", "b.png"]
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]


# ---- the chains of a scenario ----


def test_the_truth_the_modes_and_every_bounded_filter(tmp_path):
    found = chains(scenario(tmp_path, BOUNDED))
    assert list(found) == ["truth", "modes", "HBF", "SBF"]
    assert found["modes"].owner == "the modes (IMM, MMAE)"
    matrix = np.array([[0.9, 0.1], [0.3, 0.7]])
    np.testing.assert_array_equal(found["modes"].supermodes.transition_matrix, [matrix])
    assert found["truth"].supermodes.stage.tolist() == [0, 0, 1, 1, 2, 2]
    np.testing.assert_array_equal(found["truth"].supermodes.initial_probabilities[:2], [0.2, 0.8])
    assert found["HBF"].supermodes.stage.max() == 3
    assert found["SBF"].supermodes.transition_matrix[0, 1, 0] == pytest.approx(0.98 * 0.3)


def test_an_estimators_bound_is_its_models():
    """The chain that is drawn is the chain that filters."""
    given = {"sbf": (0.9, 0.01), "hbf": (3,), "rmimm": (1.0,)}
    model = figure_5_model()
    for name, estimator in estimators().items():
        if name != "kalman" and not estimator.nonlinear:  # which has one mode of a bank's
            settings = estimator.settings(*given.get(name, ()))
            chain = estimator.bound(settings).supermodes(
                model.transition_matrix, model.initial_mode_probabilities
            )
            if not hasattr(estimator, "model"):  # it has no other chain than this
                assert name == "best_sequences"
                continue
            own = estimator.prepare(settings, model).model
            np.testing.assert_array_equal(chain.transition_matrix, own.transition_matrix)
            np.testing.assert_array_equal(
                chain.initial_probabilities, own.initial_mode_probabilities
            )
            assert [model.mode_names[mode] for mode in chain.mode] == list(own.mode_names)


def test_a_bound_that_changes_nothing_is_the_modes(tmp_path):
    never = BOUNDED.replace("continuation_probability: 0.98", "continuation_probability: 1")
    found = chains(scenario(tmp_path, never))
    assert list(found) == ["truth", "modes", "HBF"]
    assert found["modes"].owner == "the modes (IMM, MMAE, SBF)"


def test_one_mode_that_may_end_is_a_chain_of_two(tmp_path):
    one = UNEVEN.replace("  fast: {motion: constant_velocity, acceleration_std_m_s2: 9}\n", "")
    one = one.replace("mean_sojourn_s: {slow: 10, fast: 4}\n", "")
    one = one.replace("{type: imm}", "{type: sbf, continuation_probability: 0.9}")
    found = chains(scenario(tmp_path, one))
    assert list(found) == ["IMM"]
    assert found["IMM"].supermodes.stage.tolist() == [0, 1]


def test_a_filter_called_modes_keeps_its_picture(tmp_path):
    found = chains(scenario(tmp_path, BOUNDED.replace("SBF: {", "modes: {")))
    assert list(found) == ["truth", "modes", "HBF", "modes_own"]
    assert found["modes_own"].owner == "modes"


def test_uneven_steps_take_the_first_and_say_so(tmp_path):
    chain = chains(scenario(tmp_path, UNEVEN))["modes"]
    assert chain.step == "the first step, 2 s (the steps are uneven)"
    away, back = 1 / 10, 1 / 4  # rates per second of a chain of two modes, which has a closed form
    left = away / (away + back) * (1 - np.exp(-2 * (away + back)))
    assert chain.supermodes.transition_matrix[0, 0, 1] == pytest.approx(left, rel=1e-12)
    even = chains(scenario(tmp_path, CHAIN))["modes"]
    assert even.step == "a step of 0.5 s"


def test_a_chain_that_is_too_large_names_its_filter_and_the_remedy(tmp_path):
    large = BOUNDED.replace("most_transitions: 3", "most_transitions: 20")
    with pytest.raises(UserError, match=r"HBF has 42 supermodes .* at most 40 .* a smaller most_t"):
        chains(scenario(tmp_path, large))
    assert "HBF" in chains(
        scenario(tmp_path, large.replace("most_transitions: 20", "most_transitions: 19"))
    )


def test_one_filter_alone_has_no_chain(tmp_path):
    starter = (Path(hybridtrack.__file__).parent / "starter.yaml").read_text("utf-8")
    alone = starter.replace("  IMM: {type: imm}\n", "").replace("compare_with: IMM", "")
    assert list(chains(scenario(tmp_path, starter))) == ["modes"]
    with pytest.raises(UserError, match="scenario: there is no Markov chain of several modes"):
        chains(scenario(tmp_path, alone))
