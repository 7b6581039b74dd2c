"""Strict YAML with positions: a file or a `--set` in, plain data and where each value stands out.

Scalars are those of the YAML 1.2 core schema (Ben-Kiki, Evans, doet Net 2021, section 10.3.2):
`no` and `1:30` are text, `1e3` is a number. Anchors, aliases, tags, merge keys, duplicate keys and
several documents are refused, each with a sentence. Built on PyYAML's events, so nothing in a file
is ever constructed, and every limit is kept while the file streams in.
"""

import copy
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import yaml

from hybridtrack.errors import UserError

MAX_BYTES = 1 << 20
MAX_NESTING = 32
MAX_VALUES = 100_000
MAX_KEY_LENGTH = 128  # PyYAML wants a key and its colon within 1024 characters, escapes included
MAX_DIGITS = 250  # of a whole number; even in hexadecimal it still fits a float

Keys: TypeAlias = tuple[str | int, ...]

# Characters no scenario may hold, raw or escaped: control characters, lone surrogates, and the
# line breaks of YAML 1.1 that editors don't show as such.
FORBIDDEN = re.compile(
    "[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\ufeff\ufffe\uffff]"
)
_TOO_MANY = "a scenario holds at most {} values; keep recordings in files of their own"
_NULL = {"", "~", "null", "Null", "NULL"}
_BOOLEAN = {
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
_WHOLE = re.compile(r"[-+]?[0-9]+")
_OCTAL = re.compile(r"0o[0-7]+")
_HEXADECIMAL = re.compile(r"0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")

# What PyYAML says, and what to do about it.
_REMEDIES = (
    ("'\\t' that cannot start", "indent with spaces, not tabs"),
    ("that cannot start any token", "put the text in quotes"),
    ("mapping values are not allowed", "check the indentation, or put text with ': ' in quotes"),
    ("expected ':'", "a key needs ': ' after it"),
    ("expected <block end>", "check the indentation"),
    ("expected ',' or", "close the bracket"),
    ("unexpected end of stream", "close the quotes"),
)


class ScenarioError(UserError):
    """A mistake in a scenario: `FILE:LINE:COL: sentence`, or `--set KEY=VALUE: sentence`."""


class Place(NamedTuple):
    """Where a value stands: its key (or the list item itself), 1-based, and its text if scalar."""

    line: int
    column: int
    text: str | None
    setting: str | None  # "key.path=value", where the value came from the command line


class Document(NamedTuple):
    """A scenario as read; `data` is shared, not copied: treat it as immutable."""

    name: str
    data: dict[str, Any]
    places: Mapping[Keys, Place]

    def position(self, path: Keys) -> tuple[int, int]:
        """Line and column, 1-based, of the key (or list item) at `path`, or of its nearest parent.

        (1, 1) for a value that came from a setting.
        """
        place = self._nearest(path)
        return place.line, place.column

    def source_text(self, path: Keys) -> str | None:
        """The scalar at `path` exactly as written, quotes included; None where there is none."""
        place = self.places.get(tuple(path))
        return place.text if place else None

    def error(self, path: Keys, sentence: str) -> ScenarioError:
        """The error to raise about the value at `path` (or, if missing, about its parent)."""
        place = self._nearest(path)
        return _error(self.name, place.setting, place.line, place.column, sentence)

    def with_setting(self, setting: str) -> "Document":
        """A copy with `key.path=value` put in; the value is read by the rules of the file.

        List items are addressed by number; missing mappings on the way are made; an empty value
        is None. Raises ScenarioError, naming the setting, where it can't be read or has no place.
        """
        keys, value, value_places = _read_setting(setting)
        data = copy.deepcopy(self.data)
        path = _assign(data, keys, value, setting)
        places = {key: place for key, place in self.places.items() if key[: len(path)] != path}
        for length in range(1, len(path)):
            places.setdefault(path[:length], Place(1, 1, None, setting))
        places |= {path + key: place for key, place in value_places.items()}
        return Document(self.name, data, places)

    def _nearest(self, path: Keys) -> Place:
        known = (tuple(path[:length]) for length in range(len(path), 0, -1))
        return next((self.places[key] for key in known if key in self.places), self.places[()])


def read(path: Path) -> Document:
    """Read a scenario file. Raises ScenarioError with the file's name in front."""
    name = str(path)
    try:
        with Path(path).open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise ScenarioError(f"{name}: there is no such file; check the path") from None
    except IsADirectoryError:
        raise ScenarioError(f"{name}: this is a folder; name a YAML file in it") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        remedy = "check its name and rights"
        raise ScenarioError(f"{name}: cannot be read ({reason.lower()}); {remedy}") from None
    return parse(content, name)


def parse(text_or_bytes: str | bytes, name: str) -> Document:
    """Read a scenario from memory; `name` stands in its messages. Raises ScenarioError."""
    source = _open(_decoded(text_or_bytes, name), name, None)
    places: dict[Keys, Place] = {}
    data = _read_only_document(source, (), places)
    if data is None:
        raise ScenarioError(f"{name}: there is nothing in it; a scenario is `key: value` lines")
    if not isinstance(data, dict):
        place = places[()]
        what = "a list" if isinstance(data, list) else f"the single value {shown(place.text)}"
        sentence = f"a scenario is `key: value` lines, but this is {what}"
        raise _error(name, None, place.line, place.column, sentence)
    return Document(name, data, places)


# --- from events to data ---------------------------------------------------------------------


class _Source(NamedTuple):
    """PyYAML's events over one text, and the name under which to complain about it."""

    text: str
    name: str
    setting: str | None
    events: Any  # a yaml.SafeLoader, of which only the events are used

    def next(self) -> Any:
        """The next event. Raises ScenarioError with PyYAML's problem and its place."""
        try:
            return self.events.get_event()
        except yaml.MarkedYAMLError as error:
            problem, mark = error.problem or error.context or "unreadable", error.problem_mark
        except (yaml.YAMLError, ValueError, OverflowError, IndexError):
            # PyYAML lets these out for impossible escapes and version numbers.
            problem, mark = "an escape or a number here has no meaning", None
        mark = mark or self.events.get_mark()
        raise _error(self.name, self.setting, mark.line + 1, mark.column + 1, _syntax(problem))

    def error(self, event: Any, sentence: str) -> ScenarioError:
        mark = event.start_mark
        return _error(self.name, self.setting, mark.line + 1, mark.column + 1, sentence)

    def place(self, event: Any) -> Place:
        if self.setting is not None:
            return Place(1, 1, self.written(event), self.setting)
        mark = event.start_mark
        return Place(mark.line + 1, mark.column + 1, self.written(event), None)

    def written(self, event: Any) -> str | None:
        is_scalar = isinstance(event, yaml.ScalarEvent)
        return self.text[event.start_mark.index : event.end_mark.index] if is_scalar else None


def _open(text: str, name: str, setting: str | None) -> _Source:
    found = FORBIDDEN.search(text)
    if found:
        line = text.count("\n", 0, found.start()) + 1
        column = found.start() - text.rfind("\n", 0, found.start())
        raise _error(name, setting, line, column, _forbidden(found.group()))
    return _Source(text, name, setting, yaml.SafeLoader(text))


def _read_only_document(source: _Source, base: Keys, places: dict[Keys, Place]) -> Any:
    """The data of the one document in `source`, None if there is none; fills `places`."""
    source.next()  # the stream's start
    start = source.next()
    if isinstance(start, yaml.StreamEndEvent):
        return None
    if start.version or start.tags:
        raise source.error(start, "a scenario has no % directives; remove the line")
    first = source.next()
    places[base] = source.place(first)
    data = _value(source, first, base, places)
    source.next()  # the document's end
    after = source.next()
    if not isinstance(after, yaml.StreamEndEvent):
        raise source.error(after, "a second document starts here; a file holds one scenario")
    return data


def _value(source: _Source, event: Any, path: Keys, places: dict[Keys, Place]) -> Any:
    _refuse_references(source, event)
    if len(places) > MAX_VALUES:
        raise source.error(event, _TOO_MANY.format(MAX_VALUES))
    if isinstance(event, yaml.ScalarEvent):
        return _scalar(source, event)
    if len(path) >= MAX_NESTING:
        raise source.error(event, f"nested deeper than {MAX_NESTING} levels; flatten it")
    if isinstance(event, yaml.SequenceStartEvent):
        return _sequence(source, path, places)
    return _mapping(source, path, places)


def _sequence(source: _Source, path: Keys, places: dict[Keys, Place]) -> list[Any]:
    items: list[Any] = []
    while not isinstance(event := source.next(), yaml.SequenceEndEvent):
        here = (*path, len(items))
        places[here] = source.place(event)
        items.append(_value(source, event, here, places))
    return items


def _mapping(source: _Source, path: Keys, places: dict[Keys, Place]) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    while not isinstance(event := source.next(), yaml.MappingEndEvent):
        key = _key(source, event)
        here = (*path, key)
        if key in entries:
            first = places[here].line
            raise source.error(
                event, f"'{shown(key)}' is here twice (first on line {first}); keep one"
            )
        value = source.next()
        places[here] = source.place(event)._replace(text=source.written(value))
        entries[key] = _value(source, value, here, places)
    return entries


def _key(source: _Source, event: Any) -> str:
    _refuse_references(source, event)
    if not isinstance(event, yaml.ScalarEvent):
        what = "[list]" if isinstance(event, yaml.SequenceStartEvent) else "{mapping}"
        raise source.error(event, f"a key is a name, not a {what}; put it in quotes if it's text")
    if event.style is None and event.value == "<<":
        raise source.error(event, "merge keys (<<) are not allowed; write the entries out")
    if not event.value:
        raise source.error(event, "a key is empty; give it a name")
    key, text = _scalar(source, event), shown(event.value)
    if not isinstance(key, str):
        raise source.error(event, f"the key '{text}' is not text; put it in quotes to make it so")
    if len(key) > MAX_KEY_LENGTH:
        limit = f"longer than {MAX_KEY_LENGTH} characters"
        raise source.error(event, f"the key '{text}' is {limit}; shorten it")
    return key


def _refuse_references(source: _Source, event: Any) -> None:
    if event.anchor is not None:
        is_alias = isinstance(event, yaml.AliasEvent)
        what = f"{'aliases (*' if is_alias else 'anchors (&'}{shown(event.anchor)})"
        raise source.error(event, f"{what} are not allowed in a scenario; write the value out")
    if event.tag is not None:
        tag = shown(event.tag.replace("tag:yaml.org,2002:", "!!"))
        sentence = f"tags ({tag}) are not allowed in a scenario; put text in quotes instead"
        raise source.error(event, sentence)


def _scalar(source: _Source, event: Any) -> Any:
    """The core schema's reading of a scalar; quoted and block scalars are text."""
    text: str = event.value
    if event.style is not None:
        found = FORBIDDEN.search(text)
        if found:
            raise source.error(event, _forbidden(found.group()))
        return text
    if text in _NULL:
        return None
    if text in _BOOLEAN:
        return _BOOLEAN[text]
    for pattern, base in ((_WHOLE, 10), (_OCTAL, 8), (_HEXADECIMAL, 16)):
        if pattern.fullmatch(text):
            if len(text) > MAX_DIGITS:
                sentence = f"{shown(text)} has more than {MAX_DIGITS} digits; write a shorter one"
                raise source.error(event, sentence)
            return int(text, base)
    if _FLOAT.fullmatch(text) or _NOT_FINITE.fullmatch(text):
        number = float(text) if _FLOAT.fullmatch(text) else math.inf
        if not math.isfinite(number):
            sentence = f"{shown(text)} is not a finite number; give one that is"
            raise source.error(event, sentence)
        return number
    return text


# --- settings --------------------------------------------------------------------------------


def _read_setting(setting: str) -> tuple[list[str], Any, dict[Keys, Place]]:
    """Keys, value and the value's places (relative to it) of `key.path=value`."""
    left, equals, text = setting.partition("=")
    keys = [key.strip() for key in left.split(".")]
    if not equals or not all(keys):
        sentence = "write a setting as key.path=value, such as monte_carlo.runs=50"
        raise _setting_error(setting, sentence)
    if found := FORBIDDEN.search(left):
        raise _setting_error(setting, _forbidden(found.group()))
    if len(keys) > MAX_NESTING or max(map(len, keys)) > MAX_KEY_LENGTH:
        limits = f"at most {MAX_NESTING} keys of at most {MAX_KEY_LENGTH} characters"
        raise _setting_error(setting, f"a setting has {limits}; shorten it")
    source = _open(_decoded(text, f"--set {shown(setting)}"), "", setting)
    base = tuple(keys)
    places: dict[Keys, Place] = {}
    value = _read_only_document(source, base, places)
    _refuse_loose_value(text, value, places.get(base), setting)
    places.setdefault(base, Place(1, 1, "", setting))
    return keys, value, {key[len(base) :]: place for key, place in places.items()}


def _refuse_loose_value(text: str, value: Any, place: Place | None, setting: str) -> None:
    """A value on a command line is one scalar, [list] or {mapping}; `IMM #3` would lose its end."""
    whole = text.strip()
    if isinstance(value, list | dict):
        loose = whole[0] not in "[{" or whole[-1] not in "]}"
    else:
        loose = whole != (place.text if place and place.text else "")
    if loose:
        sentence = "the value is not one scalar, [list] or {mapping}; put it in quotes if it's text"
        raise _setting_error(setting, sentence)


def _assign(data: dict[str, Any], keys: list[str], value: Any, setting: str) -> Keys:
    """Put `value` into `data` (changed in place); returns the path with list numbers as int."""
    holder: Any = data
    path: Keys = ()
    for depth, key in enumerate(keys):
        if not isinstance(holder, dict | list):
            where = ".".join(keys[:depth])
            sentence = f"{where} is {shown(repr(holder))}, which has no entry '{shown(key)}'"
            raise _setting_error(setting, sentence)
        index = _item_number(holder, key, ".".join(keys[:depth]), setting)
        path = (*path, index)
        if depth == len(keys) - 1:
            holder[index] = value
        elif isinstance(holder, dict) and holder.get(key) is None:
            holder[index] = {}
        holder = holder[index]
    return path


def _item_number(holder: Any, key: str, where: str, setting: str) -> Any:
    """`key` itself in a mapping, its number in a list."""
    if isinstance(holder, dict):
        return key
    count = len(holder)
    if not re.fullmatch("[0-9]{1,9}", key) or int(key) >= count:
        items = f"items 0 to {count - 1}" if count else "no items"
        raise _setting_error(setting, f"the list {where} has {items}, not '{shown(key)}'")
    return int(key)


# --- messages --------------------------------------------------------------------------------


def _decoded(content: str | bytes, name: str) -> str:
    """The text, of lawful size, without a byte order mark."""
    in_bytes = content.encode("utf-8", "surrogatepass") if isinstance(content, str) else content
    if len(in_bytes) > MAX_BYTES:
        remedy = "keep recordings in files of their own"
        raise ScenarioError(f"{name}: larger than {MAX_BYTES // 1024} KiB; {remedy}")
    try:
        text = content if isinstance(content, str) else content.decode()
    except UnicodeDecodeError as error:
        line = in_bytes.count(b"\n", 0, error.start) + 1
        where = f"byte 0x{in_bytes[error.start]:02x} on line {line}"
        raise ScenarioError(f"{name}: not UTF-8 ({where}); save the file as UTF-8") from None
    return text.removeprefix("\ufeff")


def _error(name: str, setting: str | None, line: int, column: int, sentence: str) -> ScenarioError:
    if setting is not None:
        return _setting_error(setting, sentence)
    return ScenarioError(f"{name}:{line}:{column}: {sentence}")


def _setting_error(setting: str, sentence: str) -> ScenarioError:
    return ScenarioError(f"--set {shown(setting)}: {sentence}")


def _syntax(problem: str) -> str:
    remedy = next((cure for sign, cure in _REMEDIES if sign in problem), "check this line")
    return f"this is not YAML: {shown(problem, 120)}; {remedy}"


def _forbidden(character: str) -> str:
    return f"the control character U+{ord(character):04X} is not allowed; remove it"


def shown(text: str | None, width: int = 60) -> str:
    """`text` on one line of bounded length, fit for a terminal."""
    text = text or ""
    short = text if len(text) <= width else f"{text[: width - 1]}…"
    return short if short.isprintable() else ascii(short)[1:-1]
