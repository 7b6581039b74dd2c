"""JSON Schema of a scenario for editors."""

from typing import Any

import pydantic

from hybridtrack.config import units
from hybridtrack.config.nonlinear_form import NonlinearForm
from hybridtrack.config.schema import ScenarioForm


def json_schema() -> dict[str, Any]:
    """JSON Schema of a scenario for editors, every unit's spelling included."""
    schema = pydantic.TypeAdapter(ScenarioForm | NonlinearForm).json_schema()
    _refuse_other_names(schema)
    for form in schema["$defs"].values():
        properties = form.get("properties", {})
        for name in list(properties):
            spelled = units.spellings(name)
            for other in spelled[1:]:
                properties[other] = properties[name]
            if len(spelled) > 1 and name in form.get("required", []):
                form["required"].remove(name)
                form.setdefault("allOf", []).append(
                    {"oneOf": [{"required": [key]} for key in spelled]}
                )
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    return schema


def _refuse_other_names(node: Any) -> None:
    """Names by `propertyNames`: `patternProperties` alone lets every other key pass unchecked."""
    parts = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    for part in parts:
        _refuse_other_names(part)
    if isinstance(node, dict) and "patternProperties" in node:
        ((pattern, value),) = node.pop("patternProperties").items()
        node["additionalProperties"] = value
        node["propertyNames"] = {**node.get("propertyNames", {}), "pattern": pattern}
