"""Velocity ramps within acceleration and jerk limits: how a backup trajectory gets from one velocity to another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.kernels.bounds import _speed_to_stop
from qpavoid.kernels.braking_trajectory import jerk_limited_stop
from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array

ROUND_OFF = 1e-12
"""Difference of velocities that counts as none [rad/s, m/s]."""
_JERK_FRACTION = 0.8
"""Fraction of the jerk limits that a ramp is planned with: the reserve brings the robot back onto it [-]."""


class RampLimits(NamedTuple):
    """Largest changes of a velocity from one control step to the next."""

    v_step: Array
    """(n,) largest change of v in a control step; infinite where there is no limit [rad/s or m/s]."""
    dv_step: Array
    """(n,) largest change of that change; very large, but finite, where there is no limit [rad/s or m/s]."""
    max_speed: Array
    """(n,) largest speed; very large, but finite, where there is no limit [rad/s or m/s]."""
    jerk_limited: bool
    """Whether any jerk has a limit."""


@compiled
def velocity_towards(
    gap: Array, change: Array, v_last: Array, max_speed: Array, v_step: Array, dt: float, out: Array
) -> None:
    """Write the velocity that closes a gap in a control step; where that is too fast, one straight towards its end.

    It is at most the fastest from which braking by `v_step` takes no more than the gap, or that at which the end of the
    gap moves, within `max_speed` and `v_step`.

    Args:
        gap: to what is to be reached (n,) [rad or m].
        change: by which its end has moved since the control step before (n,).
        v_last: velocity (n,) of that step [rad/s or m/s].
        max_speed: (n,).
        v_step: largest change of v in a control step (n,), finite.
        dt: control period [s].
        out: (n,).
    """
    passes, slowed = True, 1.0
    for j in range(len(gap)):
        out[j] = gap[j] / dt
        usual = max(abs(change[j]) / dt, v_step[j])
        passes = passes and abs(out[j]) <= min(usual, max_speed[j]) and abs(out[j] - v_last[j]) <= v_step[j]
    if passes:
        return
    for j in range(len(gap)):
        usual = max(abs(change[j]) / dt, v_step[j])
        towards = v_last[j] if out[j] > 0.0 else -v_last[j] if out[j] < 0.0 else 0.0
        fastest = max(_speed_to_stop(abs(gap[j]), v_step[j], dt), usual)
        fastest = min(fastest, max_speed[j], max(towards, 0.0) + v_step[j])
        slowed = max(slowed, abs(out[j]) / fastest)
    for j in range(len(gap)):
        out[j] /= slowed


@compiled
def follow_ramp(x: RampLimits, v: Array, dv: Array, targets: Array, is_constant: bool, stop_when_met: bool) -> Array:
    """Compute velocities of successive control steps, each as close to its target as the limits allow.

    Args:
        x: limits.
        v: velocity (n,) before the first.
        dv: change of velocity in the control step before (n,).
        targets: velocities (k, n).
        is_constant: whether the last target stays for long: then jerk limits do not let the ramp overshoot it. Else
            each is met wherever that is possible, so that a ramp that is followed again comes out the same.
        stop_when_met: whether to end at the first target that is met.

    Returns:
        Velocities until then (<= k, n).
    """
    ramp, v_prev, change, rate = np.empty(targets.shape), v, dv.copy(), np.zeros(len(v))
    for k in range(len(targets)):
        if x.jerk_limited:
            if not is_constant and len(targets) > 1:
                rate[:] = targets[max(k, 1)] - targets[max(k, 1) - 1]
            change = _jerk_limited_change(x, v_prev, change, targets[k], rate, is_constant)
        error = 0.0
        for c in range(len(v)):
            if not x.jerk_limited:
                change[c] = min(max(targets[k, c] - v_prev[c], -x.v_step[c]), x.v_step[c])
            ramp[k, c] = v_prev[c] + change[c]
            error = max(error, abs(ramp[k, c] - targets[k, c]))
        if stop_when_met and error < ROUND_OFF:
            return ramp[: k + 1]
        v_prev = ramp[k]
    return ramp


@compiled
def _jerk_limited_change(x: RampLimits, v: Array, dv: Array, target: Array, rate: Array, is_constant: bool) -> Array:
    """Return the next change of v (n,) towards a target (n,) that changes at `rate` (n,) per control step.

    A change that is out of reach is that of a stop, in the axes of the target. From any greater one than
    `speed_to_stop` allows, v would pass its speed limit.
    """
    dv_step = (_JERK_FRACTION if is_constant else 1.0) * x.dv_step
    change, braked = target - v, is_constant
    for c in range(len(v)):
        low, high = max(-x.v_step[c], dv[c] - dv_step[c]), min(x.v_step[c], dv[c] + dv_step[c])
        braked = braked or change[c] < low - ROUND_OFF or change[c] > high + ROUND_OFF
    if braked:
        change += jerk_limited_stop(rate - change, dv - rate, x.v_step, dv_step)
    for c in range(len(v)):
        low, high = max(-x.v_step[c], dv[c] - dv_step[c]), min(x.v_step[c], dv[c] + dv_step[c])
        down = _speed_to_stop(max(x.max_speed[c] + v[c], 0.0), dv_step[c], 1.0)
        up = _speed_to_stop(max(x.max_speed[c] - v[c], 0.0), dv_step[c], 1.0)
        change[c] = min(max(min(max(change[c], -down), up), low), high)
    return change
