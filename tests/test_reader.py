"""The strict YAML reader: what it reads, what it refuses in which words, and where things stand."""

import re
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hybridtrack.config import reader
from hybridtrack.config.reader import ScenarioError, parse, read
from hybridtrack.config.writer import dump
from hybridtrack.errors import UserError

# The database is off so that tests leave nothing behind; no deadline, since machines differ.
quick = settings(deadline=None, max_examples=150, database=None)


def value_of(text: str) -> Any:
    return parse(f"key: {text}\n", "a.yaml").data["key"]


def message_of(text: str | bytes) -> str:
    with pytest.raises(ScenarioError) as caught:
        parse(text, "a.yaml")
    message = str(caught.value)
    assert "\n" not in message
    return message


def data_or_message(call: Callable[[], reader.Document]) -> dict[str, Any] | str:
    try:
        return call().data
    except ScenarioError as error:
        return str(error)


# --- scalars: the table of the YAML 1.2 core schema, section 10.3.2 ------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", None),
        ("~", None),
        ("null", None),
        ("NULL", None),
        ("true", True),
        ("True", True),
        ("FALSE", False),
        ("no", "no"),
        ("yes", "yes"),
        ("on", "on"),
        ("off", "off"),
        ("tRUE", "tRUE"),
        ("0", 0),
        ("-7", -7),
        ("+7", 7),
        ("010", 10),
        ("0o17", 15),
        ("0x1F", 31),
        ("0b11", "0b11"),
        ("0o8", "0o8"),
        ("1_000", "1_000"),
        ("1:30", "1:30"),
        ("1.00", 1.0),
        ("1e3", 1000.0),
        (".5", 0.5),
        ("5.", 5.0),
        ("-1.5E-3", -0.0015),
        ("-0.0", -0.0),
        ("1e-999", 0.0),
        (".", "."),
        ("e3", "e3"),
        ("1.2.3", "1.2.3"),
        ("2020-01-01", "2020-01-01"),
        ("=", "="),
        ("nan", "nan"),
        ("٣", "٣"),  # a digit, but not an ASCII one
        ("'1'", "1"),
        ('"true"', "true"),
        ('""', ""),
        ('"\\u00e9\\t"', "é\t"),
        ("|\n  1\n  2", "1\n2\n"),
        (">-\n  null", "null"),
        ("[1, a, {b: .5}, []]", [1, "a", {"b": 0.5}, []]),
    ],
)
def test_scalars_follow_the_core_schema(text: str, expected: object) -> None:
    value = value_of(text)
    # repr tells 1 from 1.0 and True, and 0.0 from -0.0.
    assert repr(value) == repr(expected)


@pytest.mark.parametrize("text", [".inf", "-.INF", "+.Inf", ".nan", ".NaN", "1e999", "-1e999"])
def test_a_number_that_is_not_finite_is_refused(text: str) -> None:
    expected = f"a.yaml:1:6: {text} is not a finite number; give one that is"
    assert message_of(f"key: {text}") == expected


@pytest.mark.parametrize("text", ["9" * 5000, "0x" + "f" * 5000, "0o" + "7" * 300, "-" + "9" * 250])
def test_absurdly_long_whole_numbers_get_a_sentence(text: str) -> None:
    message = message_of(f"key: {text}")
    assert re.fullmatch(r"a.yaml:1:6: \S+ has more than 250 digits; write a shorter one", message)
    assert len(message) < 150


def test_every_whole_number_that_is_read_fits_a_float() -> None:
    longest = "0x" + "f" * (reader.MAX_DIGITS - 2)
    assert float(value_of(longest)) > 1e290  # float() would raise OverflowError beyond 1.8e308


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nseed: 1\nb: 2\nseed: 3\n", "4:1: 'seed' is here twice (first on line 2); keep one"),
        ("{a: 1, a: 2}", "1:8: 'a' is here twice (first on line 1); keep one"),
        ("a: {b: 1,\n 'b': 2}", "2:2: 'b' is here twice (first on line 1); keep one"),
        (
            "a: &name 1",
            "1:4: anchors (&name) are not allowed in a scenario; write the value out",
        ),
        ("a: &x {b: 1}", "1:4: anchors (&x) are not allowed in a scenario; write the value out"),
        ("&k a: 1", "1:1: anchors (&k) are not allowed in a scenario; write the value out"),
        ("a: *name", "1:4: aliases (*name) are not allowed in a scenario; write the value out"),
        ("*k : 1", "1:1: aliases (*k) are not allowed in a scenario; write the value out"),
        (
            "a: !!str 1",
            "1:4: tags (!!str) are not allowed in a scenario; put text in quotes instead",
        ),
        (
            "a: !!python/object/apply:os.system [ls]",
            "1:4: tags (!!python/object/apply:os.system) are not allowed in a scenario; "
            "put text in quotes instead",
        ),
        ("a: ! x", "1:4: tags (!) are not allowed in a scenario; put text in quotes instead"),
        (
            "a: !local [1]",
            "1:4: tags (!local) are not allowed in a scenario; put text in quotes instead",
        ),
        (
            "a:\n  <<: {b: 1}",
            "2:3: merge keys (<<) are not allowed; write the entries out",
        ),
        ("1: a", "1:1: the key '1' is not text; put it in quotes to make it so"),
        ("true: a", "1:1: the key 'true' is not text; put it in quotes to make it so"),
        ("? \n: a", "1:2: a key is empty; give it a name"),
        ("'': a", "1:1: a key is empty; give it a name"),
        ("[a]: 1", "1:1: a key is a name, not a [list]; put it in quotes if it's text"),
        ("? {a: 1}\n: 1", "1:3: a key is a name, not a {mapping}; put it in quotes if it's text"),
        ("a: 1\n---\nb: 2", "2:1: a second document starts here; a file holds one scenario"),
        ("%YAML 1.1\n---\na: 1", "1:1: a scenario has no % directives; remove the line"),
        ("- 1\n", "1:1: a scenario is `key: value` lines, but this is a list"),
        (
            "# c\n\n word",
            "3:2: a scenario is `key: value` lines, but this is the single value word",
        ),
        ("a: \0", "1:4: the control character U+0000 is not allowed; remove it"),
        ("a: 1\nbc: \x1b[0m", "2:5: the control character U+001B is not allowed; remove it"),
        ('a: "\\0"', "1:4: the control character U+0000 is not allowed; remove it"),
        ('a: "\\ud800"', "1:4: the control character U+D800 is not allowed; remove it"),
        ("a: \ud800", "1:4: the control character U+D800 is not allowed; remove it"),
        ("a: x\u2028y", "1:5: the control character U+2028 is not allowed; remove it"),
    ],
)
def test_what_is_refused_and_in_which_words(text: str, message: str) -> None:
    assert message_of(text) == f"a.yaml:{message}"


@pytest.mark.parametrize(
    ("text", "place", "remedy"),
    [
        ("a:\n\tb: 1", "2:1", "indent with spaces, not tabs"),
        ("a: `x`", "1:4", "put the text in quotes"),
        ("a: b: c", "1:5", "check the indentation, or put text with ': ' in quotes"),
        ("a: 1\n b: 2", "2:3", "check the indentation, or put text with ': ' in quotes"),
        ("a: 1\nruns 5\nb: 1", "3:1", "a key needs ': ' after it"),
        ("a:\n  b: 1\n c: 1", "3:2", "check the indentation"),
        ("a: [1, 2", "1:9", "close the bracket"),
        ('a: "x', "1:6", "close the quotes"),
        ('a: "\\U00110000"', "1:7", "check this line"),
        ("%YAML 1." + "1" * 5000 + "\n---\na: 1", "1:9", "check this line"),
        ("a: %x", "1:4", "put the text in quotes"),
        ("!e!x a", "1:1", "check this line"),
    ],
)
def test_broken_syntax_gets_one_sentence_with_a_remedy(text: str, place: str, remedy: str) -> None:
    message = message_of(text)
    assert message.startswith(f"a.yaml:{place}: this is not YAML: ")
    assert message.endswith(f"; {remedy}")


@pytest.mark.parametrize("text", ["", "\n\n", "# only a comment\n", "---\n", "\ufeff", b"", "~"])
def test_an_empty_file_has_a_sentence_of_its_own(text: str | bytes) -> None:
    assert message_of(text) == "a.yaml: there is nothing in it; a scenario is `key: value` lines"


def test_a_long_key_is_refused() -> None:
    longest = "k" * reader.MAX_KEY_LENGTH
    assert parse(f"{longest}: 1", "a.yaml").data == {longest: 1}
    assert "is longer than 128 characters; shorten it" in message_of(f"{longest}k: 1")


# --- hostile input -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "[" * 500_000,
        "[\n" * 500_000,
        "- " * 500_000,
        "a: " + "{a: " * 200_000,
        "a: " + "[{a: " * 200_000,
        "\n".join(" " * depth + "a:" for depth in range(1000)),
    ],
)
def test_deep_nesting_is_refused_as_it_streams_in(text: str) -> None:
    start = time.process_time()
    message = message_of(text)
    # It takes about 0.1 s; reading to the end, or in quadratic time, would take over 5 s.
    assert time.process_time() - start < 2.0
    assert message.endswith("nested deeper than 32 levels; flatten it")


def test_the_limit_of_nesting_is_exact() -> None:
    def nested(levels: int) -> str:
        return "a: " + "[" * (levels - 1) + "]" * (levels - 1)  # the mapping is a level too

    parse(nested(32), "a.yaml")
    assert message_of(nested(33)).startswith("a.yaml:1:35: nested deeper")


@pytest.mark.parametrize(
    "text", ["]" * 300_000, "&a " * 300_000, "*a " * 300_000, "? " * 500_000, "}{" * 400_000]
)
def test_floods_of_punctuation_end_soon(text: str) -> None:
    start = time.process_time()
    message_of(text)
    assert time.process_time() - start < 2.0  # as above


def test_a_bomb_of_aliases_never_expands() -> None:
    doublings = (f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, 40))
    lines = ["a0: &a0 [x, x]", *doublings]
    assert message_of("\n".join(lines)).startswith("a.yaml:1:5: anchors (&a0)")


def test_too_many_values_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "MAX_VALUES", 10)  # 100,000 would take a second
    parse("a: [1, 2, 3, 4, 5, 6, 7, 8]", "a.yaml")  # with `a` and the top level: 10
    assert message_of("a: [1, 2, 3, 4, 5, 6, 7, 8, 9]") == (
        "a.yaml:1:29: a scenario holds at most 10 values; keep recordings in files of their own"
    )


def test_size_is_limited_in_bytes() -> None:
    parse("a: 1 #" + "x" * (reader.MAX_BYTES - 6), "a.yaml")
    expected = "a.yaml: larger than 1024 KiB; keep recordings in files of their own"
    assert message_of("a: 1 #" + "x" * (reader.MAX_BYTES - 5)) == expected
    assert message_of("a: 1 #" + "é" * (reader.MAX_BYTES // 2)) == expected


YAML_PIECES = st.sampled_from(
    [
        *"[]{}:,-?&*!|>'\"%@`#~=.\\\t\n\r ab01é",
        *(
            ": ",
            "- ",
            "? ",
            "a: ",
            "\n  ",
            "<<: ",
            "---\n",
            "...",
            "!!str ",
            "%YAML ",
            "\\x",
            "1e3",
        ),
    ]
)


@quick
@given(st.one_of(st.lists(YAML_PIECES, max_size=40).map("".join), st.text(), st.binary()))
@example('"\\U00110000"')
@example("%YAML 1." + "1" * 5000)
@example(b"\xff\xfea\x00")
@example("a: !%ff x")
def test_any_text_parses_or_raises_a_scenario_error(text: str | bytes) -> None:
    outcome = data_or_message(partial(parse, text, "a.yaml"))
    assert isinstance(outcome, dict) or re.fullmatch(r"a\.yaml:(\d+:\d+:)? \S.*", outcome)


@quick
@given(st.lists(YAML_PIECES, max_size=20).map("".join))
def test_any_setting_is_taken_or_raises_a_scenario_error(value: str) -> None:
    document = parse("a: {b: [1]}", "a.yaml")
    for setting in (value, f"a.b.0={value}"):
        outcome = data_or_message(partial(document.with_setting, setting))
        assert isinstance(outcome, dict) or re.fullmatch(r"--set .*: .*", outcome)


# --- positions -----------------------------------------------------------------------------------

SCENARIO = """\
# a comment

name: fig5   # and another
truth:
  legs:
    - {until_s: 30}
    - until_s: 50
      turn_rate_deg_s: -3.00
  matrix: [[0.95, 0.05],
           [0.05, 0.950]]
"title": 'é: "x"'
empty:
block: |
  two
  lines
"""


@pytest.mark.parametrize(
    ("path", "place", "text"),
    [
        ((), (3, 1), None),
        (("name",), (3, 1), "fig5"),
        (("truth",), (4, 1), None),
        (("truth", "legs"), (5, 3), None),
        (("truth", "legs", 0), (6, 7), None),
        (("truth", "legs", 0, "until_s"), (6, 8), "30"),
        (("truth", "legs", 1), (7, 7), None),
        (("truth", "legs", 1, "turn_rate_deg_s"), (8, 7), "-3.00"),
        (("truth", "matrix", 1), (10, 12), None),
        (("truth", "matrix", 1, 1), (10, 19), "0.950"),
        (("title",), (11, 1), "'é: \"x\"'"),
        (("empty",), (12, 1), ""),
        (("block",), (13, 1), "|\n  two\n  lines\n"),
        # Deeper than the document: the nearest parent, and no text.
        (("truth", "legs", 1, "mode"), (7, 7), None),
        (("truth", "legs", 7, "mode"), (5, 3), None),
        (("name", "deeper", 3), (3, 1), None),
        (("clock",), (3, 1), None),
    ],
)
@pytest.mark.parametrize("prefix", ["", "\ufeff"])
def test_positions_and_source_text(
    path: tuple[str | int, ...], place: tuple[int, int], text: str | None, prefix: str
) -> None:
    document = parse((prefix + SCENARIO).encode(), "a.yaml")
    assert document.position(path) == place
    assert document.source_text(path) == text
    error = document.error(path, "it is wrong; mend it")
    assert str(error) == f"a.yaml:{place[0]}:{place[1]}: it is wrong; mend it"
    assert isinstance(error, UserError)


def test_windows_line_ends_count_once() -> None:
    document = parse(SCENARIO.replace("\n", "\r\n"), "a.yaml")
    assert document.position(("truth", "legs", 1, "turn_rate_deg_s")) == (8, 7)
    assert document.data == parse(SCENARIO, "a.yaml").data


# --- files ---------------------------------------------------------------------------------------


def test_read_names_the_file(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_bytes(b"\xef\xbb\xbfa: [1\xc2\xb2]\n")
    document = read(file)
    assert document.name == str(file)
    assert document.data == {"a": ["1²"]}
    file.write_bytes(b"a: 1\nb: caf\xe9\n")
    with pytest.raises(ScenarioError) as caught:
        read(file)
    assert str(caught.value) == f"{file}: not UTF-8 (byte 0xe9 on line 2); save the file as UTF-8"


def test_what_cannot_be_read_gets_a_sentence(tmp_path: Path) -> None:
    absent = tmp_path / "absent.yaml"
    for path, sentence in (
        (absent, "there is no such file; check the path"),
        (tmp_path, "this is a folder; name a YAML file in it"),
        (tmp_path / ("x" * 5000), "cannot be read (file name too long); check its name and rights"),
    ):
        with pytest.raises(ScenarioError) as caught:
            read(path)
        assert str(caught.value) == f"{path}: {sentence}"
    with pytest.raises(ScenarioError, match="cannot be read"):
        read(Path("a\0b"))


# --- settings ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("setting", "path", "value"),
    [
        ("name=fig6", ("name",), "fig6"),
        (" name = fig6 ", ("name",), "fig6"),
        ("name=", ("name",), None),
        ("name=no", ("name",), "no"),
        ("name='5'", ("name",), "5"),
        ("name=a=b", ("name",), "a=b"),
        ("truth.legs.0.until_s=20", ("truth", "legs", 0, "until_s"), 20),
        ("truth.legs.1={until_s: 1e2}", ("truth", "legs", 1), {"until_s": 100.0}),
        ("truth.matrix=[1, [2]]", ("truth", "matrix"), [1, [2]]),
        ("truth.legs={}", ("truth", "legs"), {}),
        ("monte_carlo.runs=50", ("monte_carlo", "runs"), 50),
        ("a.b.0.c=true", ("a", "b", "0", "c"), True),
        ("empty.x=.5", ("empty", "x"), 0.5),
    ],
)
def test_a_setting_changes_one_place(
    setting: str, path: tuple[str | int, ...], value: object
) -> None:
    document = parse(SCENARIO, "a.yaml")
    changed = document.with_setting(setting)
    found: Any = changed.data
    for key in path:
        found = found[key]
    assert repr(found) == repr(value)
    assert str(changed.error(path, "wrong")) == f"--set {setting}: wrong"
    assert str(changed.error((*path, "deeper"), "wrong")) == f"--set {setting}: wrong"
    # All the rest is as it was, and so is the original.
    assert document.data == parse(SCENARIO, "a.yaml").data
    others = {key: item for key, item in document.data.items() if key != path[0]}
    assert {key: changed.data[key] for key in others} == others
    assert str(changed.error(("title",), "wrong")) == "a.yaml:11:1: wrong"


def test_positions_around_a_setting() -> None:
    document = parse(SCENARIO, "a.yaml").with_setting("truth.legs.1={mode: 1.00}")
    where = ("truth", "legs", 1)
    assert document.source_text((*where, "mode")) == "1.00"
    # The file's leg had a turn rate, the setting's has none: the old position is forgotten.
    wrong = document.error((*where, "turn_rate_deg_s"), "missing")
    assert str(wrong) == "--set truth.legs.1={mode: 1.00}: missing"
    assert document.position(("truth", "legs", 0, "until_s")) == (6, 8)
    assert document.position(("truth", "legs")) == (5, 3)


def test_the_later_setting_wins() -> None:
    document = parse("a: 1", "a.yaml").with_setting("b.c=2").with_setting("b.c=3")
    assert document.data == {"a": 1, "b": {"c": 3}}
    assert str(document.error(("b", "c"), "wrong")) == "--set b.c=3: wrong"
    assert str(document.error(("b", "d"), "wrong")) == "--set b.c=2: wrong"


MALFORMED = "write a setting as key.path=value, such as monte_carlo.runs=50"
LOOSE = "the value is not one scalar, [list] or {mapping}; put it in quotes if it's text"


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("foo", MALFORMED),
        ("", MALFORMED),
        ("=3", MALFORMED),
        ("a..b=1", MALFORMED),
        ("a.=1", MALFORMED),
        ("truth.legs.2.until_s=1", "the list truth.legs has items 0 to 1, not '2'"),
        ("truth.legs.-1.until_s=1", "the list truth.legs has items 0 to 1, not '-1'"),
        ("truth.legs.until_s=1", "the list truth.legs has items 0 to 1, not 'until_s'"),
        ("truth.legs.²=1", "the list truth.legs has items 0 to 1, not '²'"),
        ("name.x=1", "name is 'fig5', which has no entry 'x'"),
        ("name=IMM: a", LOOSE),
        ("name=- 1", LOOSE),
        ("name=IMM #3", LOOSE),
        ("name=[1] # all", LOOSE),
        ("name=# all", LOOSE),
        ("name=--- 1", LOOSE),
        ("name=1\n---\n2", "a second document starts here; a file holds one scenario"),
        ("name=&x 1", "anchors (&x) are not allowed in a scenario; write the value out"),
        ("name=.inf", ".inf is not a finite number; give one that is"),
        ("name={a: 1, a: 2}", "'a' is here twice (first on line 1); keep one"),
        ("na\0me=1", "the control character U+0000 is not allowed; remove it"),
        ("name=\x1b", "the control character U+001B is not allowed; remove it"),
        (".".join("a" * 33) + "=1", "a setting has at most 32 keys of at most 128 characters"),
    ],
)
def test_a_setting_that_cannot_be_taken_is_named(setting: str, sentence: str) -> None:
    with pytest.raises(UserError) as caught:
        parse(SCENARIO, "a.yaml").with_setting(setting)
    message = str(caught.value)
    shown = setting if setting.isprintable() else ascii(setting)[1:-1]
    assert message.startswith(f"--set {shown[:59]}")
    assert f": {sentence}" in message


def test_a_setting_keeps_the_limit_of_nesting() -> None:
    document = parse("a: 1", "a.yaml")
    keys = ".".join("b" * 31)
    document.with_setting(f"{keys}=[1]")
    with pytest.raises(ScenarioError, match="nested deeper than 32 levels"):
        document.with_setting(f"{keys}=[[1]]")


# --- writing -------------------------------------------------------------------------------------

TRICKY = [
    *("no", "Yes", "on", "n", "null", "~", "", " ", "true", "1", "010", "1e3", "1:30", "0o7"),
    *("0x1F", "=", "<<", "2020-01-01", ".inf", ".nan", "-", "---", "...", "a: b", "a #b", "[a]"),
    *("é", "😀", "a\nb", "\ttab", "'", '"', "\\", "a\r", "x ", "&a", "*a", "!t", "%d", "@", "a:"),
    *("key", "IMM, RMIMM", "it's", "section 5 (figure 5)", "a/b_c.csv", "\xa0"),
]
texts = st.one_of(
    st.sampled_from(TRICKY),
    st.text(max_size=12).filter(lambda text: not reader.FORBIDDEN.search(text)),
)
scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(allow_nan=False, allow_infinity=False),
    texts,
)
trees = st.recursive(
    scalars,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(texts.filter(bool), inner, max_size=4)
    ),
    max_leaves=12,
)


@quick
@given(st.dictionaries(texts.filter(bool), trees, max_size=5))
def test_what_is_dumped_is_read_back_by_both_dialects(data: dict[str, Any]) -> None:
    text = dump(data)
    # repr tells types and the sign of zero apart, where == does not.
    assert repr(parse(text, "a.yaml").data) == repr(data)
    assert repr(yaml.safe_load(text)) == repr(data)


@pytest.mark.parametrize("text", TRICKY)
def test_tricky_text_comes_back_as_text_and_as_key(text: str) -> None:
    data = {"value": [text, {text or "key": text}]}
    assert parse(dump(data), "a.yaml").data == data
    assert yaml.safe_load(dump(data)) == data


def test_dump_is_in_block_style_with_rows_of_numbers() -> None:
    data = {
        "name": "rmimm_fig5",
        "claim": "1e3",
        "clock": {"step_s": 1.0, "tiny": 1e-05, "huge": 1e22},
        "legs": [{"until_s": 30}, {"until_s": 50, "mode": "CT"}],
        "matrix": ((0.95, 0.05), (0.05, 0.95)),
        "names": ["CV", ["no"]],
        "nothing": {},
        "none": None,
        "keep": True,
        "items": [],
    }
    assert (
        dump(data)
        == """\
name: rmimm_fig5
claim: "1e3"
clock:
  step_s: 1.0
  tiny: 1.0e-05
  huge: 1.0e+22
legs:
  - until_s: 30
  - until_s: 50
    mode: CT
matrix:
  - [0.95, 0.05]
  - [0.05, 0.95]
names:
  - CV
  - - "no"
nothing: {}
none: null
keep: true
items: []
"""
    )


@pytest.mark.parametrize(
    "data",
    [
        {"a": float("nan")},
        {"a": [float("inf")]},
        {"a": 10**reader.MAX_DIGITS},
        {"a": 10**5000},  # str() itself refuses this one
        {"a": "\0"},
        {"a": "\ud800"},
        {"": 1},
        {1: 1},
        {"k" * 129: 1},
        {"a": object()},
        {"a": {1}},
    ],
)
def test_dump_refuses_what_could_not_be_read_back(data: object) -> None:
    with pytest.raises(ValueError):
        dump(data)
