"""What all configuration blocks share."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

LARGEST = 1e9
"""Largest number that a file may give: beyond it, squares and ratios of finite numbers begin to overflow."""

Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Vec3 = tuple[Number, Number, Number]


class Block(BaseModel):
    """Base of every block: unknown keys, NaN and infinity are errors, and a block never changes once read."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)
