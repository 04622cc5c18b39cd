"""What all configuration blocks share."""

from __future__ import annotations

import ast
from inspect import cleandoc, getsource
from itertools import pairwise
from textwrap import dedent
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, GetJsonSchemaHandler

LARGEST = 1e9
"""Largest number that a file may give: beyond it, squares and ratios of finite numbers begin to overflow."""

Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Vec3 = tuple[Number, Number, Number]


class Block(BaseModel):
    """Base of every block: unknown keys, NaN and infinity are errors, and a block never changes once read."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: GetJsonSchemaHandler) -> Any:
        """Describe each field by the docstring after it: here, as pydantic would read all sources at every import."""
        schema = handler(core_schema)
        properties = handler.resolve_ref_schema(schema).get("properties", {})
        for block in reversed(cls.mro()):
            for field, text in _field_docs(block).items() if issubclass(block, Block) else ():
                if field in properties:
                    properties[field]["description"] = text
        return schema


def _field_docs(block: type[Block]) -> dict[str, str]:
    """Return the docstrings of the fields that stand in the source of a block."""
    (source,) = ast.parse(dedent(getsource(block))).body
    docs = dict[str, str]()
    for field, doc in pairwise(getattr(source, "body", [])):
        if isinstance(field, ast.AnnAssign) and isinstance(doc, ast.Expr) and isinstance(doc.value, ast.Constant):
            docs[ast.unparse(field.target)] = cleandoc(str(doc.value.value))
    return docs
