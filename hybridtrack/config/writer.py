"""Plain data as YAML that every dialect reads alike: what resolved scenarios are written with."""

import json
import math
import re
from typing import Any

from hybridtrack.config.reader import FORBIDDEN, MAX_DIGITS, MAX_KEY_LENGTH, shown

# Plain text that no dialect of YAML reads as anything else; all the rest is quoted.
_PLAIN = re.compile(r"[A-Za-z_]([A-Za-z0-9_ ,;./+()%=*'-]*[A-Za-z0-9_./+()%=*'-])?")
_WORDS_OF_YAML = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}


def dump(data: Any) -> str:
    """`data` as block-style YAML, rows of numbers on one line, in the order given.

    `parse` and any YAML 1.1 reader get the same values and types back (a tuple as a list).
    Raises ValueError for what `parse` would refuse: numbers that aren't finite, control
    characters, keys that aren't text; and for types that aren't plain data.
    """
    if isinstance(data, dict | list | tuple) and data:
        return "\n".join(_block(data)) + "\n"
    return _inline(data) + "\n"


def _block(data: Any) -> list[str]:
    """Lines of a collection that isn't empty."""
    if isinstance(data, dict):
        return [line for key, value in data.items() for line in _entry(_written_key(key), value)]
    return [line for value in data for line in _item(value)]


def _entry(key: str, value: Any) -> list[str]:
    if _fits_one_line(value):
        return [f"{key}: {_inline(value)}"]
    return [f"{key}:", *(f"  {line}" for line in _block(value))]


def _item(value: Any) -> list[str]:
    if _fits_one_line(value):
        return [f"- {_inline(value)}"]
    first, *rest = _block(value)
    return [f"- {first}", *(f"  {line}" for line in rest)]


def _fits_one_line(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(isinstance(x, int | float) and not isinstance(x, bool) for x in value)
    return not isinstance(value, dict) or not value


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_inline(item) for item in value)}]"
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, str):
        return _written_text(value)
    if isinstance(value, int) and len(text := int.__repr__(value)) <= MAX_DIGITS:
        return text
    if isinstance(value, float) and math.isfinite(value):
        # YAML 1.1 wants a point in a float: 1e-05 would be text there.
        mantissa, e, exponent = float.__repr__(value).partition("e")
        return f"{mantissa if '.' in mantissa else mantissa + '.0'}{e}{exponent}"
    raise ValueError(f"{type(value).__name__} {shown(repr(value))} has no place in a scenario")


def _written_key(key: Any) -> str:
    if not isinstance(key, str) or not 0 < len(key) <= MAX_KEY_LENGTH:
        raise ValueError(f"{shown(repr(key))} can't be a key in a scenario")
    return _written_text(key)


def _written_text(text: str) -> str:
    if FORBIDDEN.search(text):
        raise ValueError(f"{shown(text)} holds a control character")
    if _PLAIN.fullmatch(text) and text.lower() not in _WORDS_OF_YAML:
        return str(text)
    # JSON's strings are YAML's double-quoted ones. An emoji stays itself: ensure_ascii would
    # write it as two surrogates, which YAML doesn't join.
    return json.dumps(text, ensure_ascii=False)
