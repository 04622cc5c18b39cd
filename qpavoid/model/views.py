"""Views of C++ vectors as arrays.

Reading a vector of poses or distances element by element through the bindings costs more than computing it. A view
of the whole costs nothing, but rests on the layout of the elements, which is not part of the libraries' interfaces:
each view is checked against the accessors when it is made, and is None where it does not agree.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from qpavoid.problem import Array

RESULT = 10
"""Doubles of a distance result: distance, normal, nearest point 1, nearest point 2."""


def _view(firsts: list[Array], offset: int, writeable: bool, expected: Array) -> Array | None:
    """View memory as rows of doubles (n, fields), each `offset` bytes before an array; None if it is not as expected.

    The view is valid as long as the C++ vector that it looks into lives and is not resized. Memory that nothing was
    written to yet may hold NaN.
    """
    addresses = [int(array.__array_interface__["data"][0]) - offset for array in firsts]
    strides, fields = np.diff(addresses), expected.shape[1]
    if len(strides) == 0 or not (strides == strides[0]).all() or strides[0] < 8 * fields or strides[0] % 8:
        return None
    stride = int(strides[0])
    doubles = (len(addresses) - 1) * stride // 8 + fields  # the last row must not be read past its own end
    memory = np.ctypeslib.as_array((ctypes.c_double * doubles).from_address(addresses[0]))
    view = np.lib.stride_tricks.as_strided(memory, (len(addresses), fields), (stride, 8), writeable=writeable)
    return view if np.array_equal(view, expected, equal_nan=True) else None


def read_poses(poses: Any) -> Array:
    """Read world poses through the accessors (n, 12): rotation by columns, then translation."""
    rows = [np.concatenate((pose.rotation.ravel(order="F"), pose.translation)) for pose in poses]
    return np.array(rows).reshape(-1, 12)


def view_poses(poses: Any, writeable: bool = False) -> Array | None:
    """View what `read_poses` reads; None where the view disagrees with the accessors."""
    return _view([pose.rotation for pose in poses], 0, writeable, read_poses(poses))


def read_results(results: Any) -> Array:
    """Read distance results through the accessors (m, RESULT)."""
    rows = [(r.min_distance, *r.normal, *r.getNearestPoint1(), *r.getNearestPoint2()) for r in results]
    return np.array(rows, dtype=np.float64).reshape(-1, RESULT)


def view_results(results: Any) -> Array | None:
    """View what `read_results` reads; None where the view disagrees with the accessors."""
    return _view([result.normal for result in results], 8, True, read_results(results))  # the distance comes before
