"""How kernels are compiled, and the layout of a tick as they see it.

The layout crosses from Python as one structure: passing its forty arrays one by one would cost more than the work.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from numba import njit, types
from numba.experimental import structref

from qpavoid.kernels.layout import RowLayout


def digest_of_sources(kernels: Path) -> str:
    """Return the digest of all sources below a folder."""
    digest = hashlib.sha256()
    for source in sorted(kernels.rglob("*.py")):
        digest.update(source.relative_to(kernels).as_posix().encode() + b"\0" + source.read_bytes())
    return digest.hexdigest()


_STAMP = digest_of_sources(Path(__file__).parents[1])


def compiled(function: Any) -> Any:
    """Compile a function with numba; what is cached counts as long as no source of a kernel has changed.

    numba itself compares the file of a function alone, and would go on with what that took from other files. Where the
    cache lies is up to numba: beside the sources, or in the user's folder where these cannot be written.

    Sums may be taken in any order, so that they become vector instructions; NaN stays NaN.
    """
    dispatcher = njit(cache=True, fastmath={"reassoc", "contract", "nsz"})(function)
    cache = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if cache is not None:  # not where NUMBA_DISABLE_JIT leaves functions as they are
        cache._source_stamp = _STAMP
    return dispatcher


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
