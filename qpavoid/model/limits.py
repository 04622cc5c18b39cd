"""Joint limits as bounds on the joint velocity of one control step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from qpavoid.config import Limits
from qpavoid.errors import ConfigError
from qpavoid.kernels.bounds import OUTSIDE
from qpavoid.problem import Array, IntArray
from qpavoid.reason import Reason, ReasonKind

_TURN = 2.0 * np.pi
"""Excess above which q is probably in degrees: a turn, which no joint exceeds its limit by [rad]."""
_NOISE = 3e-3
"""Excess below which it may be noise of the measurement alone [rad or m]."""
_RECOVERY_SHARE = 0.1
"""Share of its speed limit at which a coordinate recovers [-]."""
_MAX_RECOVERY_SPEED = 0.2
"""Speed at which it recovers at most [rad/s or m/s]."""
_NO_LIMIT = 1e9
"""Stands for a change of velocity without a limit [rad/s or m/s]: finite, so that 0 times it is 0."""


@dataclass(frozen=True, slots=True)
class JointBounds:
    """Limits of a robot in tangent space; joints without a position limit have none listed."""

    velocity: Array
    """(nv,) largest speed [rad/s or m/s], infinite where there is none."""
    q_index: IntArray
    """(nb,) index in q of each joint coordinate with a position limit."""
    v_index: IntArray
    """(nb,) index in v of the same coordinates."""
    lower: Array
    """(nb,) lower position limits [rad or m]."""
    upper: Array
    """(nb,) upper position limits [rad or m]."""
    acceleration: Array
    """(nv,) largest acceleration [rad/s² or m/s²], infinite where there is none."""
    jerk: Array
    """(nv,) largest jerk [rad/s³ or m/s³], infinite where there is none."""

    @property
    def recovery(self) -> Array:
        """Return the speeds (nv,) at which joints return into their limits, and part what is too near [rad/s or m/s].

        These are demands that no task makes: a robot must not start fast for them.
        """
        return np.minimum(_RECOVERY_SHARE * self.velocity, _MAX_RECOVERY_SPEED)

    def finite_dv_step(self, dt: float) -> Array:
        """Return the largest change (nv,) of the changes of v in two successive control steps of dt [s] [rad/s or m/s].

        Where there is no limit, it is very large, but finite, as `kernels.speed_to_stop` takes it.
        """
        return np.minimum(self.jerk * dt**2, _NO_LIMIT)

    def within(self, config: Limits) -> JointBounds:
        """Return the part of the limits that a scenario allows to be used.

        Raises:
            ConfigError: a coordinate has a jerk limit, and none of its acceleration.
        """
        acceleration, jerk = (
            limits if default is None else np.where(np.isfinite(limits), limits, default)
            for limits, default in ((self.acceleration, config.acceleration), (self.jerk, config.jerk))
        )
        missing = np.isfinite(jerk) & np.isinf(acceleration)
        if missing.any():
            raise ConfigError(
                f"limits.jerk: {missing.sum()} of {len(jerk)} coordinates have no acceleration limit, which a jerk "
                "limit needs; give limits.acceleration"
            )
        return replace(
            self,
            velocity=config.velocity_scale * self.velocity,
            acceleration=config.acceleration_scale * acceleration,
            jerk=jerk,
        )

    def outside(
        self, q: Array, names: Sequence[str], units: Sequence[str], tolerance: float = OUTSIDE
    ) -> tuple[Reason, ...]:
        """List the coordinates outside their position limits; the amount is negative below the lower one.

        Args:
            q: configuration (nq,).
            names: of all nv coordinates.
            units: their units, rad or m.
            tolerance: excess from which they are listed [rad or m].
        """
        below, above = self.lower - q[self.q_index], q[self.q_index] - self.upper
        reasons = []
        for i in np.flatnonzero(np.maximum(below, above) > tolerance).tolist():
            amount, j = float(-below[i] if below[i] > 0.0 else above[i]), int(self.v_index[i])
            size = abs(amount)
            hint = "is it in degrees?" if size > _TURN else "noise of the measurement?" if size < _NOISE else ""
            reasons.append(Reason.of(ReasonKind.LIMIT_RECOVERY, names[j], amount=amount, unit=units[j], detail=hint))
        return tuple(reasons)


def limit_layout(joints: JointBounds, position_gain: float, dt: float) -> dict[str, Any]:
    """Make the arrays of the bounds lower <= v <= upper, as `RowLayout` has them.

    The bounds keep the next configuration inside its limits. A joint without an acceleration limit uses at most a
    share `position_gain` of the margin to a position limit in one control period; a joint with one keeps to the speeds
    from which it can still brake (`kernels.speed_to_stop`), so that position, velocity and acceleration
    limits never contradict each other once they are met; where its jerk has a limit, too, it keeps to the velocities
    from which a stop within all of these ends in time (`kernels.braking_bounds`). A joint outside its limits moves
    back, at no more than its `recovery` speed. Bounds never cross: from a state that no braking can save, the jerk
    limit is relaxed, then that of the acceleration.

    Args:
        joints: the robot's limits.
        position_gain: share of the margin to a position limit that one control period may use [-].
        dt: control period [s].
    """
    nv = len(joints.velocity)
    acceleration_limited = bool(np.isfinite(joints.acceleration).any())
    lower, upper = np.zeros(nv), np.zeros(nv)
    return {
        "q_index": joints.q_index,
        "v_index": joints.v_index,
        "q_lower": joints.lower,
        "q_upper": joints.upper,
        "v_max": joints.velocity,
        "v_recovery": joints.recovery,
        "v_step": joints.acceleration * dt,
        "v_prev": np.zeros(nv),
        "dv_step": joints.jerk * dt**2,
        "dv_prev": np.zeros(nv),
        "centering": np.zeros(nv),
        "v_stop": np.zeros(nv),
        "hard_lower": np.zeros(nv) if acceleration_limited else lower,
        "hard_upper": np.zeros(nv) if acceleration_limited else upper,
        "lower": lower,
        "upper": upper,
        "position_rate": position_gain / dt,
        "dt": dt,
        "acceleration_limited": acceleration_limited,
        "jerk_limited": bool(np.isfinite(joints.jerk).any()),
    }


def saturate(v: Array, lower: Array, upper: Array, v_max: Array) -> tuple[Array, float]:
    """Scale a raw velocity to the speed limits, which keeps its direction, then clip each joint to its bounds.

    Args:
        v: raw velocity (nv,).
        lower: lower bounds (nv,).
        upper: upper bounds (nv,).
        v_max: largest speeds (nv,).

    Returns:
        The velocity within the bounds, and the largest change that was made to a joint.
    """
    excess = float(np.max(np.abs(v) / v_max, initial=0.0))
    within = np.clip(v / max(excess, 1.0), lower, upper)
    return within, float(np.max(np.abs(within - v), initial=0.0))
