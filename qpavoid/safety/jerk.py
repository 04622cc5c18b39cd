"""From one velocity to others within the limits of accelerations and jerks: how flights change theirs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid import kernels
from qpavoid.model.limits import JointBounds
from qpavoid.problem import Array

_PLANNED = 0.8
"""Share of the jerk limits that a ramp is planned with: what is left brings the robot back onto it [-]."""
_UNLIMITED = 1e9
"""What stands for no limit of a speed, or of the change of its change [rad/s, m/s]."""


class Steps(NamedTuple):
    """How fast velocities may change."""

    v_step: Array
    """(nv,) largest change of v in a tick; infinite where there is no limit."""
    dv_step: Array
    """(nv,) largest change of that change from tick to tick; very large where there is no limit."""


class Ramps:
    """Ramps of a robot."""

    def __init__(self, bounds: JointBounds, dt: float) -> None:
        """Reads the limits of the joints, for ticks of a length [s]."""
        self.steps = Steps(bounds.acceleration * dt, np.minimum(bounds.jerk * dt * dt, _UNLIMITED))
        self.accelerated = bool(np.isfinite(bounds.acceleration).any())
        """Whether any acceleration has a limit; else whatever is wanted is had at once."""
        self.jerked = bool(np.isfinite(bounds.jerk).any())
        """Whether any jerk has one."""
        self._fastest = np.minimum(bounds.velocity, _UNLIMITED)
        if self.jerked:
            rest = np.zeros(len(bounds.jerk))
            kernels.jerk_limited_stop(
                rest, rest, self.steps.v_step, self.steps.dv_step
            )  # no tick waits for the compiler

    def towards(self, v: Array, w: Array, wanted: Array, held: bool = False, meets: bool = False) -> Array:
        """The velocities of some ticks, as close to what is wanted as the limits allow.

        Args:
            v: velocity (nv,).
            w: by how much it has just changed (nv,).
            wanted: velocities (k, nv).
            held: whether the same is wanted for long: then jerk limits do not let the ramp pass it. Else it is met
                wherever that is possible, so that a ramp which is followed again comes out the same.
            meets: whether to end where what is wanted is met.

        Returns:
            As many as there are until then (<= k, nv).
        """
        if not self.jerked:
            return kernels.rate_limit(v, wanted, self.steps.v_step, meets)
        rate_limit = np.empty_like(wanted)
        for k, target in enumerate(wanted):
            rate = 0.0 if held or len(wanted) < 2 else wanted[max(k, 1)] - wanted[max(k, 1) - 1]
            w = self._change(v, w, target, rate, held)
            v = v + w
            rate_limit[k] = v
            if meets and np.abs(v - target).max() < kernels.ROUND_OFF:
                return rate_limit[: k + 1]
        return rate_limit

    def _change(self, v: Array, w: Array, target: Array, rate: Array | float, held: bool) -> Array:
        """The next change of v (nv,) towards a target (nv,) that itself changes at a rate (nv,) from tick to tick."""
        v_step, dv_step = self.steps.v_step, (_PLANNED if held else 1.0) * self.steps.dv_step
        low, high, change = np.maximum(-v_step, w - dv_step), np.minimum(v_step, w + dv_step), target - v
        if held or ((change < low - kernels.ROUND_OFF) | (change > high + kernels.ROUND_OFF)).any():
            change = change + kernels.jerk_limited_stop(rate - change, w - rate, v_step, dv_step)
        room = np.maximum(np.array([self._fastest + v, self._fastest - v]), 0.0)
        down, up = kernels.speed_to_stop(room, dv_step, 1.0)  # from any greater change it would pass its speed limit
        change = np.minimum(np.maximum(change, -down), up)
        return np.asarray(np.minimum(np.maximum(change, low), high))
