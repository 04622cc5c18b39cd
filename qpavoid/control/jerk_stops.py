"""Stops within jerk limits, step by step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid import kernels
from qpavoid.kernels.layout import RowLayout
from qpavoid.problem import Array

_MAX_STEPS = 1000
"""Control steps of a stop that are followed."""


class Stop(NamedTuple):
    """A tick at a velocity v and the stop within jerk limits after it, of m ticks in all."""

    way: Array
    """(m, nv) velocities; memory that the next stop overwrites."""
    forwards: Array
    """(m,) for how long v would lead as far [s]."""
    aside: Array
    """(m,) how far any point moves beside that, at most [m]."""
    ways: Array
    """(nv,) how far each coordinate moves in all [rad or m]."""


class StopFollower:
    """Follows stops within jerk limits, in memory of its own."""

    def __init__(self, layout: RowLayout) -> None:
        names = "v_prev", "dv_prev", "lower", "upper", "hard_lower", "hard_upper", "v_stop"
        self._packed = kernels.pack(layout._replace(**{name: getattr(layout, name).copy() for name in names}))
        self._way = np.zeros((_MAX_STEPS, len(layout.v_prev)))

    def way(self, q: Array, v: Array, w: Array) -> Array:
        """See `kernels.roll_out_stop`; a view of memory that the next call overwrites."""
        self._way[0] = v
        return self._way[: kernels.roll_out_stop(self._packed, q, w, self._way)]
