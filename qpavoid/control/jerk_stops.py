"""Stops within jerk limits, step by step, and the tracking velocity that can be had now without swinging past it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid import kernels
from qpavoid.kernels.layout import RowLayout
from qpavoid.problem import Array

_MAX_STEPS = 1000
"""Control steps of a stop that are followed."""
_ROUND_OFF = 1e-9
"""Fraction of a coordinate's largest change of speed in a step that counts as round-off [-]."""


class JerkStop(NamedTuple):
    """A control step at a velocity v and the stop within jerk limits after it, of m steps in all."""

    velocities: Array
    """(m, nv); memory that the next stop overwrites."""
    equivalent_time: Array
    """(m,) for how long v would lead as far [s]."""
    lateral_bound: Array
    """(m,) bound on the motion of any point beside that [m]."""
    joint_travel: Array
    """(nv,) how far each coordinate moves in all [rad or m]."""


class JerkStops:
    """Computes stops within jerk limits from the state of a control step."""

    def __init__(self, layout: RowLayout, packed: Any) -> None:
        """Lay out memory beside that of the control step."""
        names = "v_prev", "dv_prev", "lower", "upper", "hard_lower", "hard_upper", "v_stop"
        self._x, self._rows = layout, packed
        self._packed = kernels.pack(layout._replace(**{name: getattr(layout, name).copy() for name in names}))
        self._velocities = np.zeros((_MAX_STEPS, len(layout.v_prev)))

    def stop(self, q: Array, v: Array) -> JerkStop:
        """Compute a step at v and the stop after it.

        All of it is along v and the change that has led to v, but for what position and velocity limits forbid.

        Args:
            q: configuration (nq,) at which the step begins.
            v: velocity (nv,).
        """
        x = self._x
        w = np.clip(v - x.v_prev, -x.v_step, x.v_step)
        self._velocities[0] = v
        velocities = self._velocities[: kernels.roll_out_stop(self._packed, q, w, self._velocities)]
        size = max(float(v @ v), 1e-300)
        fractions = velocities @ v / size
        across = w - (w @ v / size) * v
        lateral = velocities - fractions[:, None] * v
        parts = lateral @ across / max(float(across @ across), 1e-300)
        lateral -= parts[:, None] * across
        kernels.joint_speeds(self._rows, across)
        bound = np.abs(parts) * x.speeds[: len(x.joint_poses)].max()
        if (np.abs(lateral).max(axis=0) > _ROUND_OFF * x.v_step).any():
            turned, slid = np.abs(lateral) @ x.chain_rotation.T, np.abs(lateral) @ x.chain_translation.T
            bound += turned.max(axis=1) * x.lever_arm + slid.max(axis=1)
        travel = x.dt * np.abs(velocities).sum(axis=0)
        return JerkStop(velocities, x.dt * np.abs(fractions), x.dt * bound, travel)

    def clearance_lost(self, stop: JerkStop, v: Array, horizon: float) -> float:
        """Bound how much nearer a stop may come than v (nv,) does until `horizon` [s], beside its straight part [m]."""
        lateral = 2.0 * float(stop.lateral_bound.sum())
        return lateral + self._deviation(stop.joint_travel) - self._deviation(horizon * np.abs(v))

    def _deviation(self, travel: Array) -> float:
        """Bound what turning bodies add [m], where coordinates travel (nv,) in all."""
        x = self._x
        turned, slid = float(np.max(x.chain_rotation @ travel)), float(np.max(x.chain_translation @ travel))
        return turned * (turned * x.lever_arm + 2.0 * slid)

    def reachable(self, v_tracking: Array) -> Array:
        """Return as much of a tracking velocity (nv,) as can be had now without swinging past it.

        The way to it within jerk limits is a stop, seen from it. The velocity that is closest to it in every step gets
        there with an acceleration that cannot be taken back at once: it swings to and fro for ever.
        """
        x = self._x
        return v_tracking + kernels.jerk_limited_stop(x.v_prev - v_tracking, x.dv_prev, x.v_step, x.dv_step)
