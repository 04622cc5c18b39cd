"""How near anything may come on the way of a velocity, by bounds alone: no distance on the way is computed."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array

TOLERANCE = 2e-4
"""How much nearer than its safe distance a pair may come along the way of a velocity [m]."""


@compiled
def clearance_lower_bound(x: Any, v: Array, k: int, reach: float, horizon: float) -> float:
    """Bound from below what is left of the safe distance of every pair on the straight way of v until `horizon`.

    No distance falls faster than the fastest points of its two bodies move. A point that a joint carries moves at most
    at the speed of the joint's origin plus its angular speed times the distance. It comes at most s h + ½ a h² far in
    the time h, if it starts at speed s and its acceleration stays below a; at constant joint rates that is at most
    Ω² R + 2 Ω V, with the sums Ω of the angular and V of the linear rates of the joints that carry it and the longest
    lever R. Where that leaves nothing of a pair, `_left_along_normal` may.

    Args:
        x: reads what the tick found; writes the speeds and spins of the joints.
        v: velocity (n,).
        k: number of near pairs.
        reach: surface distance below which a pair is near; all others are at least so far apart [m].
        horizon: h [s].

    Returns:
        Least of distance - hold [m] on the way, or less; NaN where there is one.
    """
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
    bend = horizon * horizon * omega * (omega * x.lever_arm + 2.0 * slide)
    least = reach + x.offset - x.hold - (fastest + any_fastest) * horizon - bend
    for i in range(k):
        pair = x.near[i]
        closing = speeds[x.moved_by[pair, 0]] + speeds[x.moved_by[pair, 1]]
        left = x.d[i] - x.hold - closing * horizon - bend
        if left <= 0.0:
            left = max(left, _left_along_normal(x, v, i, horizon, bend))
        least = np.minimum(least, left)
    return least


@compiled
def _left_along_normal(x: Any, v: Array, i: int, horizon: float, bend: float) -> float:
    """Bound from below what is left of the safe distance of near pair i until `horizon`.

    Two convex bodies are at least as far apart as along any direction: as far along it as the nearest points of the
    two. In the direction of the normal n, these move with the witness points, and with the turning of the bodies: x, of
    a body that turns with ω, comes by (x - p)·(n × ω) closer in a second than the witness point p. Of the box around
    the body, no point comes closer than |n × ω| along its edges says. An obstacle that turns bends its way by no more
    than ½ ω h² times the speed of its fastest point. A stop within jerk limits may lead backwards, and an obstacle need
    not move as long as the robot does.

    Args:
        x: reads what the tick found, and the spins of the joints.
        v: velocity (n,).
        i: number of the near pair.
        horizon: h [s].
        bend: what the curved ways of two bodies of the robot may add [m].

    Returns:
        Bound [m]; -∞ for a pair of bodies that are not convex, or that stands for others.
    """
    pair, found = x.near[i], x.closest[i]
    if not x.convex[pair]:
        return -np.inf
    approach = 0.0
    for c in range(len(v)):
        approach += x.J[i, c] * v[c]
    closing = (abs(approach) if x.jerked else max(-approach, 0.0)) + max(-x.feedforward[i], 0.0)
    joints, bent = len(x.joint_poses), 0.0
    for side in range(2):
        carrier, body = x.moved_by[pair, side], x.bodies[pair, side]
        spin = x.omega[carrier] if carrier < joints else x.twists[carrier - joints, 3:]
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
def leaves_position_limits(x: Any, q: Array, v: Array, horizon: float) -> bool:
    """Return True if a coordinate would pass its position limit on the way of v, so that it brakes harder than others.

    Args:
        x: reads the position limits.
        q: configuration (nq,).
        v: velocity (n,).
        horizon: time for which v leads on [s].
    """
    for i in range(len(x.q_index)):
        ahead = q[x.q_index[i]] + horizon * v[x.v_index[i]]
        if ahead < x.q_lower[i] or ahead > x.q_upper[i]:
            return True
    return False


@compiled
def joint_speeds(x: Any, v: Array) -> None:
    """Write the largest speed of any point that each joint carries.

    That of its origin, plus its angular speed times the distance of the farthest point.

    Args:
        x: reads J_world, joint_poses and joint_reach; writes spins and the first J of speeds.
        v: velocity (n,).
    """
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
        x.omega[i, 0], x.omega[i, 1], x.omega[i, 2] = wx, wy, wz
        x.speeds[i] = np.sqrt(vx * vx + vy * vy + vz * vz)
        x.speeds[i] += np.sqrt(wx * wx + wy * wy + wz * wz) * x.joint_radius[i]


@compiled
def tracking_clear(x: Any, q: Array, k: int, reach: float) -> bool:
    """Return True if, by `clearance_lower_bound`, nothing comes too near on the way of v0 and a stop from it.

    Args:
        x: reads what the tick found, v0 among it.
        q: configuration (nq,).
        k: number of near pairs.
        reach: surface distance below which a pair is near [m].
    """
    slowing = 0.0
    for j in range(len(x.v_tracking)):
        slowing = max(slowing, abs(x.v_tracking[j]) / x.v_step[j])
    horizon = x.dt * (1.0 + 0.5 * slowing)
    if slowing > 0.0 and leaves_position_limits(x, q, x.v_tracking, horizon):
        return False
    return clearance_lower_bound(x, x.v_tracking, k, reach, horizon) > -TOLERANCE
