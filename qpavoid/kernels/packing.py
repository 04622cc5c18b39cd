"""Compilation of the kernels.

With `NUMBA_DISABLE_JIT=1` the same loops run as plain Python, slowly, for a debugger.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import config, njit

from qpavoid.kernels.cache import KernelCache

_F = TypeVar("_F", bound=Callable[..., Any])
FASTMATH = {"reassoc", "contract", "nsz"}
"""What the compiler may do with floating point in all kernels but those that are `exact`."""


def released(function: _F) -> _F:
    """Compile a kernel that releases Python's lock while it runs, as those that take milliseconds should.

    Args:
        function: see `compiled`.
    """
    return compiled(function, nogil=True)


def exact(function: _F) -> _F:
    """Compile a kernel whose sums are rounded in the order in which they stand, as numpy and Pinocchio round them.

    Args:
        function: see `compiled`.
    """
    return compiled(function, fastmath=set())


def uncounted(function: _F) -> _F:
    """Compile a kernel that counts no references to arrays: it makes none, and takes no structures.

    Each view of an array, as of one row, is counted while it exists, by instructions that take as long as 20 others.

    Args:
        function: see `compiled`; what it calls has to be `uncounted` or `inlined_uncounted` as well.
    """
    return compiled(function, counts=False)


def compiled(function: _F, nogil: bool = False, fastmath: set[str] = FASTMATH, counts: bool = True) -> _F:
    """Compile a kernel at its first call with arguments of some types, or load its code from disk.

    Sums may be taken in any order, so that they become vector instructions. NaN and infinities are preserved, but the
    compiler may drop `np.isfinite` of a sum: compare with infinity instead.

    Args:
        function: the loops; every function that they call is compiled as well.
        nogil: whether other threads may run meanwhile.
        fastmath: what the compiler may do with floating point.
        counts: whether references to arrays are counted.
    """
    kernel = njit(fastmath=fastmath, nogil=nogil, _nrt=counts)(function)
    if not config.DISABLE_JIT:
        kernel._cache = KernelCache(function)  # what `cache=True` does, with another place on disk
    return kernel


def inlined(function: _F) -> _F:
    """Compile a part of a kernel into each of its callers: for parts whose arguments cost as much as their work."""
    return njit(fastmath=FASTMATH, forceinline=True)(function)


def inlined_uncounted(function: _F) -> _F:
    """Compile a part of `uncounted` kernels into each of them; see `inlined`."""
    return njit(fastmath=FASTMATH, forceinline=True, _nrt=False)(function)
