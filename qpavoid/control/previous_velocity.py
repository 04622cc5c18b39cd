"""The velocity that was commanded when a control step begins, from which accelerations and jerks count."""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.layout import RowLayout
from qpavoid.problem import Array


class PreviousVelocity:
    """Velocity of the previous step and its change, in the memory of the kernels: what was commanded.

    Where contacts are held, the kernels count from the nearest velocity that holds them, as they have turned a little
    since; what was really commanded is kept beside it.
    """

    def __init__(self, layout: RowLayout, has_contacts: bool) -> None:
        """Begin at rest."""
        self._x = layout
        self._commanded, self._change = np.zeros_like(layout.v_prev), np.zeros_like(layout.v_prev)
        self.needs_report = layout.jerk_limited or (has_contacts and layout.acceleration_limited)
        """Whether `excess` has to be asked: bounds alone do not keep to accelerations and jerks then."""

    @property
    def v(self) -> Array:
        """Velocity (nv,) at which the robot moves until this step."""
        return self._x.v_prev

    @property
    def dv(self) -> Array:
        """Change of velocity (nv,) in the step before; 0 where jerks have no limits."""
        return self._x.dv_prev

    def remember(self, v: Array) -> None:
        """Take v (nv,) as the velocity at which the robot moves from this step to the next one."""
        if self.needs_report:
            np.subtract(v, self._commanded, out=self._change)
            self._commanded[:] = v
            np.clip(self._change, -self._x.v_step, self._x.v_step, out=self._x.dv_prev)
        self._x.v_prev[:] = v

    def measure(self, v: Array) -> None:
        """Take v (nv,) as measured: what is commanded next counts from it, jerks from the change commanded last."""
        self._x.v_prev[:] = v
        self._commanded[:] = v

    def restart(self, v: Array) -> None:
        """Take v (nv,) as the velocity at which the robot has been moving, without any acceleration."""
        self._x.v_prev[:], self._x.dv_prev[:] = v, 0.0
        self._commanded[:], self._change[:] = v, 0.0

    def excess(self, v: Array) -> tuple[Array, Array]:
        """Return the excess of v (nv,) over what accelerations and what jerks allow (nv,) each [rad/s or m/s].

        Negative within the limits.
        """
        change = v - self._commanded
        return np.abs(change) - self._x.v_step, np.abs(change - self._change) - self._x.dv_step

    def tighten_bounds(self) -> None:
        """Narrow the bounds of this step to what accelerations and jerks allow from what was commanded."""
        x = self._x
        low = np.maximum(self._commanded - x.v_step, self._commanded + x.dv_prev - x.dv_step)
        high = np.minimum(self._commanded + x.v_step, self._commanded + x.dv_prev + x.dv_step)
        low, high = np.minimum(low, x.upper), np.maximum(high, x.lower)
        np.maximum(x.lower, low, out=x.lower)
        np.minimum(x.upper, high, out=x.upper)
