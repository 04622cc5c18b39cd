"""`kernels.vectorised.ahead` as loops that numba compiles; documented there."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.compiled.packing import compiled
from qpavoid.kernels.vectorised.ahead import TOLERANCE
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
        left = x.d[i] - x.hold - closing * horizon - bend
        if left <= 0.0:
            left = max(left, _left_along_normal(x, v, i, horizon, bend))
        least = np.minimum(least, left)
    return least


@compiled
def _left_along_normal(x: Any, v: Array, i: int, horizon: float, bend: float) -> float:
    """See `vectorised.ahead._left_along_normal`; of near pair number i."""
    pair, found = x.near[i], x.closest[i]
    if not x.convex[pair]:
        return -np.inf
    approach = 0.0
    for c in range(len(v)):
        approach += x.J[i, c] * v[c]
    closing = (abs(approach) if x.jerked else max(-approach, 0.0)) + max(-x.drift[i], 0.0)
    joints, bent = len(x.joint_poses), 0.0
    for side in range(2):
        carrier, body = x.carriers[pair, side], x.bodies[pair, side]
        spin = x.spins[carrier] if carrier < joints else x.twists[carrier - joints, 3:]
        sign, n, p = 1.0 - 2.0 * side, found[1:4], found[4 + 3 * side : 7 + 3 * side]
        mx, my, mz = (
            sign * (n[1] * spin[2] - n[2] * spin[1]),
            sign * (n[2] * spin[0] - n[0] * spin[2]),
            sign * (n[0] * spin[1] - n[1] * spin[0]),
        )
        pose, box, farther = x.body_poses[body], x.boxes[body], 0.0
        for a in range(3):
            rx, ry, rz = pose[3 * a], pose[3 * a + 1], pose[3 * a + 2]
            along = rx * mx + ry * my + rz * mz
            here = rx * (p[0] - pose[9]) + ry * (p[1] - pose[10]) + rz * (p[2] - pose[11])
            farther += along * (box[a] - here) + abs(along) * box[3 + a]
        closing += max(farther, 0.0)
        if carrier >= joints:
            turned = np.sqrt(spin[0] * spin[0] + spin[1] * spin[1] + spin[2] * spin[2]) * x.speeds[carrier]
            bent += 0.5 * horizon * horizon * turned
        else:
            bent += 0.5 * bend
    return x.d[i] - x.hold - horizon * closing - bent


@compiled
def bends(x: Any, q: Array, v: Array, horizon: float) -> bool:
    """See `vectorised.ahead.bends`."""
    for i in range(len(x.q_index)):
        ahead = q[x.q_index[i]] + horizon * v[x.v_index[i]]
        if ahead < x.q_lower[i] or ahead > x.q_upper[i]:
            return True
    return False


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
        x.spins[i, 0], x.spins[i, 1], x.spins[i, 2] = wx, wy, wz
        x.speeds[i] = np.sqrt(vx * vx + vy * vy + vz * vz)
        x.speeds[i] += np.sqrt(wx * wx + wy * wy + wz * wz) * x.joint_reach[i]


@compiled
def tracking_clear(x: Any, q: Array, k: int, reach: float) -> bool:
    """See `vectorised.ahead.tracking_clear`."""
    slowing = 0.0
    for j in range(len(x.v0)):
        slowing = max(slowing, abs(x.v0[j]) / x.v_step[j])
    horizon = x.dt * (1.0 + 0.5 * slowing)
    if slowing > 0.0 and bends(x, q, x.v0, horizon):
        return False
    return closest_call(x, x.v0, k, reach, horizon) > -TOLERANCE
