"""Compilation of the kernels, and the layout of a control step in compiled code.

The layout crosses from Python as one structure: to pass its forty arrays one by one would cost more than the work.

With `NUMBA_DISABLE_JIT=1` the same loops run as plain Python, slowly, for a debugger: then the layout is
passed as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import config, njit, types
from numba.experimental import structref

from qpavoid.kernels.cache import KernelCache
from qpavoid.kernels.layout import RowLayout

_F = TypeVar("_F", bound=Callable[..., Any])


def compiled(function: _F) -> _F:
    """Compile a kernel at its first call with arguments of some types, or load its code from disk.

    Sums may be taken in any order, so that they become vector instructions. NaN and infinities are preserved, but the
    compiler may drop `np.isfinite` of a sum: compare with infinity instead.

    Args:
        function: the loops; every function that they call is compiled as well.
    """
    kernel = njit(fastmath={"reassoc", "contract", "nsz"})(function)
    if not config.DISABLE_JIT:
        kernel._cache = KernelCache(function)  # what `cache=True` does, with another place on disk
    return kernel


class PackedRows(structref.StructRefProxy):  # type: ignore[misc]
    """A `RowLayout` in compiled code."""


@structref.register
class PackedRowsType(types.StructRef):  # type: ignore[misc]
    """Type of `PackedRows`, made of those of its fields."""

    def preprocess_fields(self, fields: Any) -> Any:
        """Return the types of the fields, without the literal values that numba infers."""
        return tuple((name, types.unliteral(field)) for name, field in fields)


structref.define_boxing(PackedRowsType, PackedRows)
structref.define_constructor(PackedRows, PackedRowsType, list(RowLayout._fields))


@compiled
def _pack(fields: Any) -> Any:
    """Return a structure of the fields of a layout."""
    return PackedRows(*fields)


def pack(layout: RowLayout) -> Any:
    """Return the layout in the form that the kernels take; both look into the same memory."""
    return layout if config.DISABLE_JIT else _pack(tuple(layout))
