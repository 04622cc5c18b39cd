"""`kernels.vectorised.ahead` as loops that numba compiles; documented there."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.compiled.packing import compiled
from qpavoid.problem import Array


@compiled
def closest_call(x: Any, v: Array, k: int, reach: float, horizon: float) -> float:
    """See `vectorised.ahead.closest_call`."""
    speeds, joints = x.speeds, len(x.joint_poses)
    joint_speeds(x, v)
    fastest = 0.0
    for i in range(joints):
        fastest = np.maximum(fastest, speeds[i])  # keeps NaN, unlike max
    any_fastest = fastest
    for i in range(joints, len(speeds)):
        any_fastest = np.maximum(any_fastest, speeds[i])
    omega, slide = 0.0, 0.0
    for chain in range(len(x.turning)):
        turning, sliding = 0.0, 0.0
        for c in range(len(v)):
            turning += x.turning[chain, c] * abs(v[c])
            sliding += x.sliding[chain, c] * abs(v[c])
        omega, slide = max(omega, turning), max(slide, sliding)
    bend = horizon * horizon * omega * (omega * x.lever + 2.0 * slide)
    least = reach + x.offset - x.hold - (fastest + any_fastest) * horizon - bend
    for i in range(k):
        pair = x.near[i]
        closing = speeds[x.carriers[pair, 0]] + speeds[x.carriers[pair, 1]]
        least = np.minimum(least, x.d[i] - x.hold - closing * horizon - bend)
    return least


@compiled
def joint_speeds(x: Any, v: Array) -> None:
    """See `vectorised.ahead.joint_speeds`."""
    J, poses, twists = x.J_world, x.joint_poses, np.zeros((len(x.joint_poses), 6))
    c = 0
    for i in range(len(poses)):
        twist, parent = twists[i], twists[x.parents[i]]
        for s in range(6):
            twist[s] = parent[s]
        while c < len(x.column_joints) and x.column_joints[c] == i:
            for s in range(6):
                twist[s] += J[s, c] * v[x.columns[c]]
            c += 1
        px, py, pz, wx, wy, wz = poses[i, 9], poses[i, 10], poses[i, 11], twist[3], twist[4], twist[5]
        vx, vy, vz = twist[0] + wy * pz - wz * py, twist[1] + wz * px - wx * pz, twist[2] + wx * py - wy * px
        x.speeds[i] = np.sqrt(vx * vx + vy * vy + vz * vz)
        x.speeds[i] += np.sqrt(wx * wx + wy * wy + wz * wz) * x.joint_reach[i]


@compiled
def tracking_clear(x: Any, k: int, reach: float) -> bool:
    """See `vectorised.ahead.tracking_clear`."""
    slowing = 0.0
    for j in range(len(x.v0)):
        slowing = max(slowing, abs(x.v0[j]) / x.v_step[j])
    return closest_call(x, x.v0, k, reach, x.dt * (1.0 + 0.5 * slowing)) > 0.0
