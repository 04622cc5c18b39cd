"""What pydantic found wrong, in one line: the field as the file has it, what is wrong with it, and the remedy."""

from __future__ import annotations

import typing
from typing import Any

from pydantic import BaseModel, ValidationError

from qpavoid.errors import nearest

_MAX_FAULTS = 5
_NUMBER = "give a number alone, in m, rad, kg and s"
_REMEDIES = {
    "float_parsing": _NUMBER,
    "float_type": _NUMBER,
    "dict_type": "give a mapping by name, as in {joint1: 10.0}",
    "list_type": "give a list, as in [a, b]",
}
"""What to do about faults of which pydantic says in Python's words what they are."""


def explain(error: ValidationError, model: type[BaseModel], data: dict[str, Any]) -> str:
    """Explain all faults of a file in one line: field, fault, nearest valid key."""
    faults = [(_field(fault["loc"], fault["type"], data), fault) for fault in error.errors()]
    # Of a field that may be a list or a mapping, pydantic reports both; the one that was meant got deeper.
    above = {field[:depth] for field, _ in faults for depth in range(len(field))}
    clauses = [": ".join([*[".".join(field)][: len(field)], _clause(fault, model)])
               for field, fault in faults if field not in above]  # fmt: skip
    more = f"; and {len(clauses) - _MAX_FAULTS} more" if len(clauses) > _MAX_FAULTS else ""
    return "; ".join(clauses[:_MAX_FAULTS]) + more


def _field(loc: tuple[int | str, ...], kind: str, data: Any) -> tuple[str, ...]:
    """List the keys and indices of the file in a location; pydantic's also name the members of unions."""
    field = []
    for part in loc:
        try:
            data = data[part]
        except (LookupError, TypeError):
            continue
        field.append(str(part))
    is_absent = kind == "missing" or (kind == "extra_forbidden" and field[-1] != loc[-1])  # the latter: `eq10:daqp`
    return (*field, str(loc[-1])) if is_absent else tuple(field)


def _clause(fault: Any, model: type[BaseModel]) -> str:
    """Say in words what is wrong."""
    kind, loc, got = fault["type"], fault["loc"], f"{fault['input']!r:.60}"
    match kind:
        case "extra_forbidden":
            keys = {key for block in _blocks_at(model, loc[:-1]) for key in block.model_fields}
            return f"unknown key{nearest(str(loc[-1]), keys)}"
        case "missing":
            return "is missing"
        case "model_type" | "model_attributes_type":
            return f"must be a mapping of fields, got {got}"
        case "union_tag_invalid" | "union_tag_not_found":
            key = str(fault["ctx"]["discriminator"]).strip("'")
            tags = sorted(tag for block in _blocks_at(model, loc) for tag in _tags(block))
            if kind == "union_tag_not_found":
                return f"`{key}` is missing; valid are {', '.join(tags)}"
            tag = fault["ctx"]["tag"]
            return f"unknown {key} {tag!r}{nearest(str(tag), tags)}"
        case "value_error":
            return str(fault["msg"].removeprefix("Value error, "))
    return f"{fault['msg']}, got {got}" + (f": {_REMEDIES[kind]}" if kind in _REMEDIES else "")


def _blocks_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[type[BaseModel]]:
    """List the blocks that may stand at a location, where the chosen member of a union is named by its tag."""
    blocks = [model]
    for part in loc:
        fields = [block.model_fields[str(part)] for block in blocks if part in block.model_fields]
        below = [inner for field in fields for inner in _blocks(field.annotation)]
        blocks = below or [block for block in blocks if part in _tags(block)] or blocks
    return blocks


def _blocks(annotation: Any) -> list[type[BaseModel]]:
    """List every block inside an annotation."""
    arguments = typing.get_args(annotation)  # asked first: Python 3.10 takes list[float] as a type
    if not arguments and isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [block for inner in arguments for block in _blocks(inner)]


def _tags(block: type[BaseModel]) -> set[str]:
    """Return the tags that choose a block from a union: its literal `type` or `name`."""
    fields = [block.model_fields[key] for key in ("type", "name") if key in block.model_fields]
    return {tag for field in fields for tag in typing.get_args(field.annotation) if isinstance(tag, str)}
