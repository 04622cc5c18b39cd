"""How kernels are compiled, and the layout of a tick as they see it.

The layout crosses from Python as one structure: passing its forty arrays one by one would cost more than the work.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from numba import njit, types
from numba.experimental import structref

from qpavoid.kernels.layout import RowLayout


def forget_stale_code(kernels: Path) -> None:
    """Takes code out of the cache below a folder that is older than any of its sources.

    numba looks at the file of a function alone, and would go on with what that took from other files.
    """
    newest = max(source.stat().st_mtime for source in kernels.rglob("*.py"))
    for code in kernels.rglob("__pycache__/*.nb[ic]"):
        with suppress(OSError):
            if code.stat().st_mtime < newest:
                code.unlink()


forget_stale_code(Path(__file__).parents[1])
compiled = njit(cache=True, fastmath={"reassoc", "contract", "nsz"})
"""How kernels are compiled: sums may be taken in any order, so that they become vector instructions; NaN stays NaN."""


class PackedRows(structref.StructRefProxy):  # type: ignore[misc]
    """A `RowLayout` as compiled code sees it."""


@structref.register
class PackedRowsType(types.StructRef):  # type: ignore[misc]
    """Its type, made of those of the fields."""

    def preprocess_fields(self, fields: Any) -> Any:
        """Types of fields, not of the values that they happen to have."""
        return tuple((name, types.unliteral(field)) for name, field in fields)


structref.define_boxing(PackedRowsType, PackedRows)
structref.define_constructor(PackedRows, PackedRowsType, list(RowLayout._fields))


@compiled
def _pack(fields: Any) -> Any:
    return PackedRows(*fields)


def pack(layout: RowLayout) -> Any:
    """The layout in the form that the kernels take."""
    return _pack(tuple(layout))
