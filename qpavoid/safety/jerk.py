"""Velocity ramps within acceleration and jerk limits: how a backup trajectory gets from one velocity to another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid import kernels
from qpavoid.model.limits import JointBounds
from qpavoid.problem import Array

_JERK_FRACTION = 0.8
"""Fraction of the jerk limits that a ramp is planned with: the reserve brings the robot back onto it [-]."""
_UNLIMITED = 1e9
"""Stands for no limit of a speed, or of the change of its change [rad/s, m/s]: finite, so that 0 times it is 0."""


class StepLimits(NamedTuple):
    """Largest changes of a velocity from one control step to the next."""

    v_step: Array
    """(nv,) largest change of v in a control step; infinite where there is no limit."""
    dv_step: Array
    """(nv,) largest change of that change; very large where there is no limit."""


class Ramps:
    """Velocity ramps of one robot."""

    def __init__(self, bounds: JointBounds, dt: float) -> None:
        """Read the limits of the joints, for control steps of dt [s]."""
        self.limits = StepLimits(bounds.acceleration * dt, np.minimum(bounds.jerk * dt * dt, _UNLIMITED))
        self.has_acceleration_limits = bool(np.isfinite(bounds.acceleration).any())
        """Whether any joint has one; without, every velocity is reached in one control step."""
        self.has_jerk_limits = bool(np.isfinite(bounds.jerk).any())
        """Whether any joint has one."""
        self._max_speed = np.minimum(bounds.velocity, _UNLIMITED)
        if self.has_jerk_limits:
            zero = np.zeros(len(bounds.jerk))
            kernels.easing_stop(zero, zero, self.limits.v_step, self.limits.dv_step)  # compiled before the loop starts

    def follow(
        self, v: Array, dv: Array, targets: Array, is_constant: bool = False, stop_when_met: bool = False
    ) -> Array:
        """Compute velocities of successive control steps, each as close to its target as the limits allow.

        Args:
            v: velocity (nv,).
            dv: change of velocity in the control step before (nv,).
            targets: velocities (k, nv).
            is_constant: whether the last target stays for long: then jerk limits do not let the ramp overshoot it. Else
                each is met wherever that is possible, so that a ramp that is followed again comes out the same.
            stop_when_met: whether to end at the first target that is met.

        Returns:
            Velocities until then (<= k, nv).
        """
        if not self.has_jerk_limits:
            return kernels.rate_limit(v, targets, self.limits.v_step, stop_when_met)
        ramp = np.empty_like(targets)
        for k, target in enumerate(targets):
            rate = 0.0 if is_constant or len(targets) < 2 else targets[max(k, 1)] - targets[max(k, 1) - 1]
            dv = self._change(v, dv, target, rate, is_constant)
            v = v + dv
            ramp[k] = v
            if stop_when_met and np.abs(v - target).max() < kernels.ROUND_OFF:
                return ramp[: k + 1]
        return ramp

    def _change(self, v: Array, dv: Array, target: Array, rate: Array | float, is_constant: bool) -> Array:
        """Compute the next change of v (nv,) towards a target (nv,) that changes at `rate` (nv,) per control step."""
        v_step, dv_step = self.limits.v_step, (_JERK_FRACTION if is_constant else 1.0) * self.limits.dv_step
        low, high, change = np.maximum(-v_step, dv - dv_step), np.minimum(v_step, dv + dv_step), target - v
        if is_constant or ((change < low - kernels.ROUND_OFF) | (change > high + kernels.ROUND_OFF)).any():
            change = change + kernels.easing_stop(rate - change, dv - rate, v_step, dv_step)
        margin = np.maximum(np.array([self._max_speed + v, self._max_speed - v]), 0.0)
        down, up = kernels.speed_to_stop(margin, dv_step, 1.0)  # from any greater change it would pass its speed limit
        change = np.minimum(np.maximum(change, -down), up)
        return np.asarray(np.minimum(np.maximum(change, low), high))
