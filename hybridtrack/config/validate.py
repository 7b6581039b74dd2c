"""A document against the form, and pydantic's findings as one sentence with its place."""

import difflib
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from hybridtrack.config import units
from hybridtrack.config.reader import Document, Keys, ScenarioError
from hybridtrack.config.schema import ScenarioForm


def validate(document: Document) -> ScenarioForm:
    """The document as a form. Raises ScenarioError about the first mistake in the file."""
    try:
        return ScenarioForm.model_validate(document.data)
    except ValidationError as error:
        raise _first_mistake(document, error) from None


def _first_mistake(document: Document, error: ValidationError) -> ScenarioError:
    """Of several mistakes the one that comes first; of one value's several, the last tried."""
    found: dict[Keys, list[Any]] = {}
    for mistake in error.errors(include_url=False):
        path = as_written(document, mistake["loc"])
        if mistake["type"] in ("unknown_key", "two_spellings"):
            path = (*path, mistake["ctx"]["key"])
        found.setdefault(path, []).append(mistake)
    path = min(found, key=lambda p: (document.position(p), len(p)))
    return document.error(path, _sentence(document, path, found[path]))


def as_written(document: Document, location: tuple[int | str, ...]) -> Keys:
    """Pydantic's location as a path in the document: SI names as spelled there, tags left out."""
    value: Any = document.data
    path: list[str | int] = []
    for part in location:
        if isinstance(value, Mapping):
            assert isinstance(part, str)
            key = next((s for s in _spellings(part) if s in value), None)
            if key is None:
                continue
            value = value[key]
            path.append(key)
        elif isinstance(value, list) and isinstance(part, int) and part < len(value):
            value = value[part]
            path.append(part)
    return tuple(path)


def _spellings(key: str) -> tuple[str, ...]:
    parts = units.split(key)
    if parts is None or units.UNITS[parts[1]].factor != 1.0:
        return (key,)
    return units.spellings(key)


def value_at(document: Document, path: Keys) -> Any:
    """The value at a path of the document; None where there is none."""
    value: Any = document.data
    for part in path:
        if isinstance(value, Mapping):
            value = value.get(part)
        elif isinstance(value, list) and isinstance(part, int) and part < len(value):
            value = value[part]
        else:
            return None
    return value


def _shown(document: Document, path: Keys) -> str:
    text = document.source_text(path)
    value = value_at(document, path)
    if text is None:
        kinds = ((dict, "a mapping"), (list, "a list"))
        text = next((said for kind, said in kinds if isinstance(value, kind)), repr(value))
    text = text or "empty"
    return text if len(text) <= 60 else text[:57] + "..."


def _label(path: Keys) -> str:
    """The key at a path, with its place in a list: 'until_s' or 'transition_matrix'[1]."""
    keys = [i for i, part in enumerate(path) if isinstance(part, str)]
    if not keys:
        return "the scenario"
    last = keys[-1]
    return f"'{path[last]}'" + "".join(f"[{part}]" for part in path[last + 1 :])


def _sentence(document: Document, path: Keys, mistakes: list[Any]) -> str:
    mistake = mistakes[-1]
    kind, context = mistake["type"], mistake.get("ctx", {})
    if kind == "unknown_key":
        return unknown_key(context["key"], context["keys"])
    if kind == "two_spellings":
        return f"'{context['key']}' gives this quantity a second time; keep one of its spellings"
    if kind == "missing":
        wanted = str(mistake["loc"][-1])
        other = [s for s in _spellings(wanted) if s != wanted]
        where = f" in {_label(path)}" if path else ""
        spelled = f" (or {', '.join(other)})" if other else ""
        return f"'{wanted}'{spelled} is missing{where}; add it"
    if kind.startswith("union_tag"):
        tags = [tag.strip("' ") for tag in context.get("expected_tags", "").split(",")]
        key = "motion" if "motion" in repr(document.data) and path[0] != "estimators" else "type"
        inner = (*path, key)
        given = value_at(document, inner)
        if given is None and key == "type":
            return f"'type' is missing in {_label(path)}; add one of {', '.join(tags)}"
        names = [tag for tag in tags if tag != "matrices"]
        close = difflib.get_close_matches(str(given), names, 1)
        hint = f"did you mean '{close[0]}'?" if close else f"there are {', '.join(names)}"
        return f"'{key}' is {_shown(document, inner)}, which is not known; {hint}"
    if kind == "string_pattern_mismatch":
        if "[key]" in map(str, mistake["loc"]):
            return f"{_label(path)} is no name: use letters, digits, _ and - only"
        return f"{_label(path)} is {_shown(document, path)}; use letters, digits, _ and - only"
    wants = " or ".join(dict.fromkeys(_wanted(m) for m in mistakes))
    return f"{_label(path)} is {_shown(document, path)}; it must be {wants}"


def unknown_key(key: str, keys: list[str]) -> str:
    """What to say of a key that a mapping doesn't have."""
    close = difflib.get_close_matches(key, keys, 1, 0.7)
    if close:
        return f"'{key}' is not a key here; did you mean '{close[0]}'?"
    parts = [k for k in keys if k.rsplit("_", 1)[0] == key.rsplit("_", 1)[0]]
    return f"'{key}' is not a key here; the keys are {', '.join(parts or keys)}"


_WANTED = {
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "string_type": "text (put it in quotes)",
    "bool_type": "true or false",
    "list_type": "a list",
    "dict_type": "a mapping (key: value)",
    "model_type": "a mapping (key: value)",
    "model_attributes_type": "a mapping (key: value)",
    "finite_number": "a finite number",
    "recursion_loop": "a plain value",
}


def _wanted(mistake: Any) -> str:
    kind, context = mistake["type"], mistake.get("ctx", {})
    if kind in _WANTED:
        return _WANTED[kind]
    if kind == "too_short":
        return f"a list or mapping of at least {context['min_length']}"
    if kind == "too_long":
        return f"a list or mapping of at most {context['max_length']}"
    if kind == "literal_error":
        return str(context["expected"]).replace("'", "")
    message = str(mistake["msg"])
    return message.removeprefix("Input should be ").removeprefix("must be ")
