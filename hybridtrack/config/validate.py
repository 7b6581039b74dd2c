"""A document against the form, and pydantic's findings as one sentence with its place."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from hybridtrack.config import units
from hybridtrack.config.checks import nearest
from hybridtrack.config.nonlinear_form import AnyForm, NonlinearForm
from hybridtrack.config.reader import Document, Keys, ScenarioError, shown
from hybridtrack.config.schema import MOTION_FORMS, MatricesForm, ModeForm, ScenarioForm
from hybridtrack.containment import FAMILIES, FLAGS, NOISE
from hybridtrack.estimators import estimators
from hybridtrack.statistics import METRICS

# Within these, no product of a few numbers overflows or vanishes: std^2, psd T^5, F P F'.
SMALLEST, LARGEST = 1e-30, 1e30

Mistake = Any  # one entry of pydantic's ValidationError.errors()


def validate(document: Document) -> AnyForm:
    """The document as a form: with `dynamics`, or with modes.

    Raises ScenarioError about the first mistake in the file.
    """
    if "dynamics" in document.data and "modes" in document.data:
        raise document.error(
            ("dynamics",), "a scenario has 'dynamics' or 'modes', and this has both; remove one"
        )
    kind: type[AnyForm] = NonlinearForm if "dynamics" in document.data else ScenarioForm
    try:
        form = kind.model_validate(document.data)
    except ValidationError as error:
        raise _first_mistake(document, error) from None
    outside = [
        as_written(document, location)
        for location, number in _numbers(form.model_dump(by_alias=True), ())
        if number and not SMALLEST <= abs(number) <= LARGEST
    ]
    if outside:
        path = min(outside, key=document.position)
        raise document.error(
            path,
            f"{_label(path)} is {_shown(document, path)}; a number here is 0 or of a size "
            f"between {SMALLEST:g} and {LARGEST:g} in SI units",
        )
    return form


def _numbers(value: Any, path: Keys) -> Iterator[tuple[Keys, float]]:
    if isinstance(value, int | float):
        yield path, value
    elif isinstance(value, dict | list):
        parts = value.items() if isinstance(value, dict) else enumerate(value)
        for key, part in parts:
            yield from _numbers(part, (*path, key))


# ---- which mistake, and where ----------------------------------------------------------------


def _first_mistake(document: Document, error: ValidationError) -> ScenarioError:
    """The mistake that comes first in the file.

    A value that may be of several types (a number, or one per mode) fails once for each: what is
    wrong inside it says more than that it is no number.
    """
    found: dict[Keys, list[Mistake]] = {}
    for mistake in error.errors(include_url=False, include_context=True):
        found.setdefault(_place(document, mistake), []).append(mistake)
    outer = {path[:length] for path in found for length in range(len(path))}
    telling = [
        path
        for path, mistakes in found.items()
        if path not in outer or any(m["type"] == "missing" for m in mistakes)
    ]
    path = min(telling, key=lambda p: (document.position(p), len(p)))
    return document.error(path, _sentence(document, path, found[path]))


def _place(document: Document, mistake: Mistake) -> Keys:
    path = as_written(document, mistake["loc"])
    if mistake["type"] in ("unknown_key", "two_spellings"):
        return (*path, mistake["ctx"]["key"])
    if mistake["type"] == "union_tag_invalid":
        holder, key = value_at(document, path), _tag_key(path)
        return (*path, key) if isinstance(holder, Mapping) and key in holder else path
    return path


def _tag_key(path: Keys) -> str:
    return "type" if path[0] == "estimators" else "motion"


def as_written(document: Document, location: tuple[int | str, ...]) -> Keys:
    """Pydantic's location as a path in the document: SI names as spelled there, tags left out."""
    value: Any = document.data
    path: list[str | int] = []
    for part in location:
        if isinstance(value, Mapping):
            key = next((s for s in _spellings(str(part)) if s in value), None)
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


# ---- in which words --------------------------------------------------------------------------

_BY_MODE = {
    "mode_probabilities",
    *units.spellings("position_std_m"),
    *units.spellings("mean_sojourn_s"),
}


def _shown(document: Document, path: Keys) -> str:
    value = value_at(document, path)
    if isinstance(value, dict | list):
        return "a mapping" if isinstance(value, dict) else "a list"
    text = document.source_text(path)
    return shown(text if text is not None else repr(value)) or "empty"


def _label(path: Keys) -> str:
    """The key at a path: 'until_s', item 3 of 'legs', entry 2 of row 1 of 'transition_matrix'."""
    keys = [i for i, part in enumerate(path) if isinstance(part, str)]
    if not keys:
        return "the scenario"
    last = keys[-1]
    label = f"'{shown(str(path[last]))}'"
    if last and path[last - 1] in _BY_MODE:
        label = f"'{path[last - 1]}' of {label}"
    items = [int(part) + 1 for part in path[last + 1 :]]
    words = ("item",) if len(items) < 2 else ("row", "entry", *["entry"] * len(items))
    for word, item in zip(words, items, strict=False):
        label = f"{word} {item} of {label}"
    return label


def _sentence(document: Document, path: Keys, mistakes: Sequence[Mistake]) -> str:
    telling = [m for m in mistakes if m["type"] not in _KINDS] or mistakes
    mistake = telling[0]
    kind, context = mistake["type"], mistake.get("ctx", {})
    here, label = _shown(document, path), _label(path)
    if _lacks_motion(document, path, mistake):
        return _motion_missing(document, path)
    if kind == "unknown_key":
        return unknown_key(context["key"], context["keys"])
    if kind == "two_spellings":
        return f"{label} gives this quantity a second time; keep one of its spellings"
    if kind == "missing":
        wanted = str(mistake["loc"][-1])
        other = [s for s in _spellings(wanted) if s != wanted]
        where = f" in {label}" if path else ""
        spelled = f" (or {', '.join(other)})" if other else ""
        return f"'{wanted}'{spelled} is missing{where}; add it"
    if kind == "union_tag_invalid":
        return _unknown_tag(document, path, context["expected_tags"])
    if kind == "unknown_metric":
        own = (*FLAGS, *NOISE, *(f"{family}:..." for family in FAMILIES))
        names = [*own, "position_rmse_m"] if "dynamics" in document.data else [*METRICS]
        return f"{label} is {here}, which is not known; {nearest(here, names)}"
    if "[key]" in mistake["loc"]:
        limit = "at most 64 characters" if kind == "string_too_long" else _LETTERS
        return f"{label} is no name; use {limit}"
    if kind == "string_pattern_mismatch":
        return f"{label} is {here}; use {_LETTERS}"
    if kind in ("too_short", "too_long"):
        return _wrong_length(label, kind, context)
    value = value_at(document, path)
    words = [word for m in telling for word in _wanted(m, value)]
    return f"{label} is {here}; it must be {_listed(words)}"


_LETTERS = "letters, digits, _ and - only"


def unknown_key(key: str, keys: Sequence[str]) -> str:
    """What to say of a key that a mapping doesn't have.

    A known quantity with an unknown unit (speed_mph) is answered with the units that there are.
    """
    said = f"'{shown(key)}' is not a key here"
    stems = [(parts[0], k) for k in keys if (parts := units.split(k))]
    spelled = [k for stem, k in stems if key == stem or key.startswith(f"{stem}_")]
    if spelled:
        return f"{said}; write {_listed(spelled)}"
    si = [k for k in keys if not (parts := units.split(k)) or units.UNITS[parts[1]].factor == 1.0]
    close = nearest(key, keys)
    return f"{said}; " + (close if close.endswith("?") else f"the keys are {', '.join(si)}")


def _lacks_motion(document: Document, path: Keys, mistake: Mistake) -> bool:
    """Whether a mode was taken for one by matrices only because it names no motion."""
    if "matrices" not in mistake["loc"] or mistake["type"] not in ("missing", "unknown_key"):
        return False
    at = path if mistake["type"] == "missing" else path[:-1]
    holder = value_at(document, at)
    own = set(MatricesForm.names()) - set(ModeForm.names())
    return isinstance(holder, Mapping) and not own & set(holder)


def _motion_missing(document: Document, path: Keys) -> str:
    names = [name for name in MOTION_FORMS if name != "matrices"]
    if path[-1] == "motion":
        return f"'motion' is {_shown(document, path)}, which is not known; {nearest('', names)}"
    at = path if isinstance(value_at(document, path), Mapping) else path[:-1]
    return (
        f"'motion' is missing in {_label(at)}; add one of {', '.join(names)} "
        "(or give the mode's matrices)"
    )


def _unknown_tag(document: Document, path: Keys, expected: str) -> str:
    names = [tag for tag in (t.strip("' ") for t in expected.split(",")) if tag != "matrices"]
    key, given = _tag_key(path), value_at(document, path)
    if path[-1] == key and isinstance(given, str) and key == "type" and given in estimators():
        needs = "'dynamics'" if estimators()[given].nonlinear else "'modes'"
        return (
            f"'type' is {given}, which is for scenarios with {needs}; there are {', '.join(names)}"
        )
    if path[-1] == key and given is not None:
        return f"'{key}' is {_shown(document, path)}, which is not known; {nearest(given, names)}"
    at = path[:-1] if path[-1] == key else path
    if given is not None and not isinstance(given, Mapping):
        example = f"{{{key}: {names[0]}}}"
        return f"{_label(at)} is {_shown(document, at)}; it must be a mapping, such as {example}"
    return f"'{key}' is missing in {_label(at)}; add one of {', '.join(names)}"


def _wrong_length(label: str, kind: str, context: Mapping[str, Any]) -> str:
    wanted = context["min_length"] if kind == "too_short" else context["max_length"]
    bound = "at least" if kind == "too_short" else "at most"
    number = context["actual_length"]
    entries = "1 entry" if number == 1 else f"{number or 'no'} entries"
    return f"{label} has {entries}; give {bound} {wanted}"


# Mistakes that only say that a value isn't of one of the types it may have.
_KINDS = {
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "string_type": "text",
    "list_type": "a list",
    "dict_type": "a mapping (key: value)",
    "model_type": "a mapping (key: value)",
    "literal_error": "",
}


def _wanted(mistake: Mistake, value: Any) -> list[str]:
    kind, context = mistake["type"], mistake.get("ctx", {})
    if kind == "literal_error":
        return str(context["expected"]).replace("'", "").replace(" or ", ", ").split(", ")
    if kind in _KINDS:
        return [_KINDS[kind] + _remedy(kind, value)]
    if kind == "greater_than_equal" and not 0 < context["ge"] < SMALLEST:
        return [f"at least {context['ge']:.15g}"]
    if kind.startswith("greater_than"):
        return [f"greater than {context.get('gt', 0):g}"]
    if kind == "less_than_equal":
        largest = context["le"]
        return [f"at most {largest if isinstance(largest, int) else f'{largest:g}'}"]
    if kind == "string_too_long":
        return [f"at most {context['max_length']} characters long"]
    return [str(mistake["msg"]).removeprefix("Input should be ")]


def _remedy(kind: str, value: Any) -> str:
    """How a scalar of the wrong type is to be written."""
    if kind == "string_type":
        return " (put it in quotes)" if isinstance(value, int | float) else ""
    if kind.startswith("int") and isinstance(value, float) and value.is_integer():
        return f", written {value:.0f}"
    quoted = isinstance(value, str) and value.lstrip("+-").replace(".", "", 1).isdecimal()
    return " (without quotes)" if quoted and kind in ("int_type", "float_type") else ""


def _listed(words: Sequence[str]) -> str:
    """'a', 'a or b', 'a, b or c', each once."""
    once = list(dict.fromkeys(words))
    return " or ".join([", ".join(once[:-1]), once[-1]] if len(once) > 1 else once)
