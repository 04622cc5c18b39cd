"""Joint limits as bounds on the joint velocity of one tick."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from qpavoid import kernels
from qpavoid.problem import Array, IntArray


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

    def slowed(self, share: float) -> JointBounds:
        """The same with a share of the speeds."""
        return replace(self, velocity=share * self.velocity)


def velocity_bounds(joints: JointBounds, q: Array, rate: float) -> tuple[Array, Array]:
    """Bounds lower <= v <= upper that keep the next configuration inside its limits.

    At most a share rate * dt of what is left to a position limit is used in one tick of length dt; a joint outside
    its limits is sent back at no more than its largest speed. The bounds never cross.

    Args:
        joints: the robot's limits.
        q: configuration (nq,).
        rate: at most 1 / dt [1/s].

    Returns:
        lower (nv,), upper (nv,) [rad/s or m/s].
    """
    return kernels.velocity_bounds(q, joints.q_index, joints.v_index, joints.lower, joints.upper, joints.velocity, rate)


def saturate(v: Array, lower: Array, upper: Array, v_max: Array) -> tuple[Array, float]:
    """Brings a raw velocity within the limits.

    First one factor for all joints, so that the direction is kept while only speeds are exceeded; then each joint
    is clipped to what its position limit leaves.

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
