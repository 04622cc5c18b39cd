"""Every field that a scenario or a robot.yaml may have, as one page, made of the configuration's own types."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from qpavoid.config import RobotConfig, ScenarioConfig

_LARGE = 1e8
"""Bound from which a limit of a field only excludes errors, and is not printed."""


def schema_of(root: type[BaseModel]) -> dict[str, Any]:
    """Make the JSON Schema of a block and all that it may hold.

    The tag that distinguishes blocks of a union is required.
    """
    schema = root.model_json_schema()
    for name, tag in _tags(schema):
        block = schema["$defs"][name]
        if "const" in block["properties"][tag] and tag not in block.get("required", ()):
            block["required"] = [tag, *block.get("required", ())]
    return schema


def page() -> str:
    """Write the page of all fields in Markdown.

    One table for each block of a scenario and of a robot.yaml, outer ones first.
    """
    lines, visited_names = _HEAD.splitlines(), set[str]()
    for root in (ScenarioConfig, RobotConfig):
        schema = schema_of(root)
        blocks, queue = {root.__name__: schema, **schema.get("$defs", {})}, [root.__name__]
        while queue:
            name = queue.pop(0)
            if name not in visited_names and "properties" in blocks[name]:
                lines += _section(name, blocks)
                queue += [ref for spec in blocks[name]["properties"].values() for ref in _refs(spec, blocks)]
            visited_names.add(name)
    return "\n".join(lines)


_HEAD = """# Fields of a scenario and of a robot.yaml

Written by `qpavoid fields`. `qpavoid fields --schema scenario` (or `robot`) prints a JSON Schema: an editor that is
given it completes fields and marks errors while you type. Unknown fields, NaN and infinity are errors.

A scenario begins at [ScenarioConfig](#scenarioconfig), a robot.yaml at [RobotConfig](#robotconfig).
"""


def _section(name: str, blocks: dict[str, Any]) -> list[str]:
    block = blocks[name]
    lines = ["", f"## {name}", "", _flat(block.get("description", "")), ""]
    if block["properties"]:
        lines += ["| field | what it may be | left out | meaning |", "|---|---|---|---|"]
    for field, spec in block["properties"].items():
        default = "required" if field in block.get("required", ()) else _default_text(spec.get("default"))
        kind, meaning = _kind(spec, blocks), _flat(spec.get("description", ""))
        lines.append(f"| `{field}` | {kind} | {default} | {meaning} |")
    return lines


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
        case "number" | "integer":
            return _number(spec)
        case "null":
            return "nothing"
        case kind:
            return {"string": "text", "boolean": "`true` or `false`"}.get(str(kind), "anything")


def _number(spec: dict[str, Any]) -> str:
    bounds = [
        f"{sign} {spec[key]:g}"
        for key, sign in (("exclusiveMinimum", ">"), ("minimum", ">="), ("exclusiveMaximum", "<"), ("maximum", "<="))
        if key in spec and abs(spec[key]) < _LARGE
    ]
    return " ".join(["integer" if spec["type"] == "integer" else "number", ", ".join(bounds)]).strip()


def _refs(spec: Any, blocks: dict[str, Any]) -> Iterator[str]:
    """Yield the names of the blocks that a field may hold."""
    if isinstance(spec, dict):
        for key, value in spec.items():
            if key == "$ref":
                name = value.rsplit("/", 1)[-1]
                yield name
                if "properties" not in blocks[name]:
                    yield from _refs(blocks[name], blocks)
            elif key not in ("default", "discriminator"):
                yield from _refs(value, blocks)
    elif isinstance(spec, list):
        for each in spec:
            yield from _refs(each, blocks)


def _tags(spec: Any) -> Iterator[tuple[str, str]]:
    """Yield each block of a union with the field that distinguishes it."""
    if isinstance(spec, dict) and "discriminator" in spec:
        for ref in spec["discriminator"]["mapping"].values():
            yield ref.rsplit("/", 1)[-1], spec["discriminator"]["propertyName"]
    for each in spec.values() if isinstance(spec, dict) else spec if isinstance(spec, list) else ():
        yield from _tags(each)


def _default_text(default: Any) -> str:
    """Write a default as a YAML file would give it."""
    if isinstance(default, dict) and ("name" in default or "type" in default):
        return f"`{default.get('name') or default['type']}`"
    if isinstance(default, dict):
        return "its defaults" if default else "none"
    if default is None or default == "":
        return "nothing"
    if isinstance(default, bool | float):
        return f"`{default:g}`" if isinstance(default, float) else f"`{str(default).lower()}`"
    return f"`{default}`" if default != [] else "none"


def _flat(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
