"""Every field that a scenario or a robot.yaml may have, as one page, made of the configuration's own JSON Schema."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel

from qpavoid.config import RobotConfig, ScenarioConfig

_LARGE = 1e8
"""Bound from which a limit of a field only excludes errors, and is not printed."""
_HEAD = """# Fields of a scenario and of a robot.yaml

Written by `qpavoid fields`. `qpavoid fields --schema scenario` (or `robot`) prints a JSON Schema: an editor that is
given it completes fields and marks errors while you type. Unknown fields, NaN and infinity are errors.

A scenario begins at [ScenarioConfig](#scenarioconfig), a robot.yaml at [RobotConfig](#robotconfig); the blocks they
hold follow by name.
"""


def schema_of(root: type[BaseModel]) -> dict[str, Any]:
    """Make the JSON Schema of a block and all that it may hold.

    The tag that distinguishes blocks of a union is required.
    """
    schema = root.model_json_schema()
    for block in schema["$defs"].values():
        for tag in ("type", "name"):
            if "const" in block.get("properties", {}).get(tag, {}):
                block["required"] = [tag, *block.get("required", ())]
    return schema


def page() -> str:
    """Write the page of all fields in Markdown: one table for each block."""
    roots, inner = dict[str, Any](), dict[str, Any]()
    for root in (ScenarioConfig, RobotConfig):
        roots[root.__name__] = schema_of(root)
        inner |= roots[root.__name__]["$defs"]
    lines = _HEAD.splitlines()
    for name, block in [*roots.items(), *sorted(inner.items())]:
        if "properties" not in block:
            continue
        lines += ["", f"## {name}", "", _flat(block.get("description", "")), ""]
        if block["properties"]:
            lines += ["| field | what it may be | left out | meaning |", "|---|---|---|---|"]
        for field, spec in block["properties"].items():
            default = "required" if field in block.get("required", ()) else _default_text(spec.get("default"))
            lines.append(f"| `{field}` | {_kind(spec, inner)} | {default} | {_flat(spec.get('description', ''))} |")
    return "\n".join(lines)


def _kind(spec: dict[str, Any], blocks: dict[str, Any]) -> str:
    """Say in words what a value may be."""
    if "$ref" in spec:
        name = spec["$ref"].rsplit("/", 1)[-1]
        return f"[{name}](#{name.lower()})" if "properties" in blocks[name] else _kind(blocks[name], blocks)
    if choices := spec.get("anyOf") or spec.get("oneOf"):
        return " or ".join(dict.fromkeys(_kind(choice, blocks) for choice in choices))
    if "const" in spec or "enum" in spec:
        return " or ".join(f"`{value}`" for value in spec.get("enum", [spec.get("const")]))
    match spec.get("type"):
        case "array" if "prefixItems" in spec:
            return f"{len(spec['prefixItems'])} of {_kind(spec['prefixItems'][0], blocks)}"
        case "array":
            return f"list of {_kind(spec.get('items', {}), blocks)}"
        case "object":
            return f"name: {_kind(spec.get('additionalProperties', {}), blocks)}"
        case "number" | "integer" as kind:
            signs = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
            bounds = [f"{sign} {spec[key]:g}" for key, sign in signs.items() if abs(spec.get(key, _LARGE)) < _LARGE]
            return f"{kind} {', '.join(bounds)}".strip()
        case kind:
            names = {"string": "text", "boolean": "`true` or `false`", "null": "nothing"}
            return names.get(str(kind), "anything")


def _default_text(default: Any) -> str:
    """Write a default as a YAML file would give it."""
    if isinstance(default, dict) and default:
        return f"`{tag}`" if (tag := default.get("name") or default.get("type")) else "its defaults"
    if default is None or default == "":
        return "nothing"
    if isinstance(default, bool | float):
        return f"`{default:g}`" if isinstance(default, float) else f"`{str(default).lower()}`"
    return f"`{default}`" if default not in ([], {}) else "none"


def _flat(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
