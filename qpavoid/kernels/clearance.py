"""Lower bounds on the clearance along a velocity, from speeds alone: no distance ahead is computed."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array

TOLERANCE = 2e-4
"""Distance by which a pair may come below its safety distance along a velocity [m]: rows are of first order, and
distances curve within a control step."""


@compiled
def clearance_lower_bound(x: Any, v: Array, k: int, influence_distance: float, horizon: float) -> float:
    """Bound the clearance of all pairs from below, at constant v until `horizon`.

    The clearance is the distance minus the safety distance. No distance falls faster than the fastest points of its two
    bodies move. A point of a body moves at most at the speed of its joint's origin plus the joint's angular speed times
    the distance from the origin. It moves at most s h + ½ a h² in the time h, if it starts at speed s and its
    acceleration stays below a; at constant joint rates that is at most Ω² R + 2 Ω V, with the sums Ω of the angular and
    V of the linear rates of the joints that move it and the longest lever arm R. Of a pair of which that leaves
    nothing, `_clearance_along_normal` may be positive.

    Args:
        x: reads the results of the step; writes speeds and omega of the joints.
        v: velocity (n,) [rad/s or m/s].
        k: number of near pairs.
        influence_distance: surface distance below which a pair is near; all others are at least so far apart [m].
        horizon: h [s].

    Returns:
        Bound [m]; NaN where there is one.
    """
    speeds, joints = x.speeds, len(x.joint_poses)
    joint_speeds(x, v)
    fastest = 0.0
    for i in range(joints):
        fastest = np.maximum(fastest, speeds[i])  # keeps NaN, unlike max
    any_fastest = fastest
    for i in range(joints, len(speeds)):
        any_fastest = np.maximum(any_fastest, speeds[i])
    omega, linear = 0.0, 0.0
    for chain in range(len(x.chain_rotation)):
        rotation, translation = 0.0, 0.0
        for c in range(len(v)):
            rotation += x.chain_rotation[chain, c] * abs(v[c])
            translation += x.chain_translation[chain, c] * abs(v[c])
        omega, linear = max(omega, rotation), max(linear, translation)
    curvature = horizon * horizon * omega * (omega * x.lever_arm + 2.0 * linear)
    bound = influence_distance + x.offset - x.d1 - (fastest + any_fastest) * horizon - curvature
    for i in range(k):
        pair = x.near_pairs[i]
        closing = speeds[x.moved_by[pair, 0]] + speeds[x.moved_by[pair, 1]]
        clearance = x.d[i] - x.d1 - closing * horizon - curvature
        if clearance <= 0.0:
            clearance = max(clearance, _clearance_along_normal(x, v, i, horizon, curvature))
        bound = np.minimum(bound, clearance)
    return bound


@compiled
def _clearance_along_normal(x: Any, v: Array, i: int, horizon: float, curvature: float) -> float:
    """Bound the clearance of near pair i from below until `horizon`, along its normal.

    The clearance is the distance minus the safety distance. Two convex bodies are at least as far apart as along any
    direction: as far along it as the nearest points of the two. In the direction of the normal n, these move with the
    witness points, and with the rotation of the bodies: a point r of a body that turns at ω approaches by (r - p)·(n ×
    ω) faster than the witness point p. Of the box around the body, the corner where that is largest counts, which |n ×
    ω| along its edges gives. The path of a point of an obstacle that turns deviates from a line by no more than ½ ω h²
    times the speed of its fastest point. A stop within jerk limits may lead backwards, so both signs of the closing
    speed count; an obstacle need not move as long as the robot does, so that it recedes does not count.

    Args:
        x: reads the results of the step, and omega of the joints.
        v: velocity (n,) [rad/s or m/s].
        i: number of the near pair.
        horizon: h [s].
        curvature: distance by which the paths of points of two bodies of the robot may deviate from lines [m].

    Returns:
        Bound [m]; -∞ for a pair of bodies that are not convex, or whose distance stands for other pairs.
    """
    pair, result = x.near_pairs[i], x.closest[i]
    if not x.convex[pair]:
        return -np.inf
    approach = 0.0
    for c in range(len(v)):
        approach += x.J[i, c] * v[c]
    closing = (abs(approach) if x.jerk_limited else max(-approach, 0.0)) + max(-x.feedforward[i], 0.0)
    joints, deviation = len(x.joint_poses), 0.0
    for side in range(2):
        mover, body = x.moved_by[pair, side], x.bodies[pair, side]
        omega = x.omega[mover] if mover < joints else x.twists[mover - joints, 3:]
        sign, n, p = 1.0 - 2.0 * side, result[1:4], result[4 + 3 * side : 7 + 3 * side]
        mx, my, mz = (
            sign * (n[1] * omega[2] - n[2] * omega[1]),
            sign * (n[2] * omega[0] - n[0] * omega[2]),
            sign * (n[0] * omega[1] - n[1] * omega[0]),
        )
        pose, box, corner = x.body_poses[body], x.boxes[body], 0.0
        for a in range(3):
            rx, ry, rz = pose[3 * a], pose[3 * a + 1], pose[3 * a + 2]
            edge = rx * mx + ry * my + rz * mz
            witness = rx * (p[0] - pose[9]) + ry * (p[1] - pose[10]) + rz * (p[2] - pose[11])
            corner += edge * (box[a] - witness) + abs(edge) * box[3 + a]
        closing += max(corner, 0.0)
        if mover >= joints:
            acceleration = np.sqrt(omega[0] * omega[0] + omega[1] * omega[1] + omega[2] * omega[2]) * x.speeds[mover]
            deviation += 0.5 * horizon * horizon * acceleration
        else:
            deviation += 0.5 * curvature
    return x.d[i] - x.d1 - horizon * closing - deviation


@compiled
def leaves_position_limits(x: Any, q: Array, v: Array, horizon: float) -> bool:
    """Return True if a coordinate at constant v passes a position limit until `horizon`.

    Then it brakes harder than the others, and a stop is no multiple of v.

    Args:
        x: reads the position limits.
        q: configuration (nq,).
        v: velocity (n,) [rad/s or m/s].
        horizon: duration [s].
    """
    for i in range(len(x.q_index)):
        end = q[x.q_index[i]] + horizon * v[x.v_index[i]]
        if end < x.q_lower[i] or end > x.q_upper[i]:
            return True
    return False


@compiled
def joint_speeds(x: Any, v: Array) -> None:
    """Write the angular velocity of each joint, and the largest speed of its points.

    The latter is the speed of the joint's origin, plus its angular speed times the distance of the farthest point. The
    twist of a joint at the world's origin is that of its parent plus its own columns of the Jacobian times their rates.

    Args:
        x: reads J_world, joint_poses, parents, column_joints and joint_radius; writes omega (J, 3) [rad/s] and the
            first J of speeds [m/s].
        v: velocity (n,) [rad/s or m/s].
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
def is_clear(x: Any, q: Array, v: Array, k: int, influence_distance: float) -> bool:
    """Return True if bounds show that a velocity and a stop from it are clear.

    Clear is what keeps the safety distance of every pair, up to `TOLERANCE`. A stop takes s = max |v_j| / v_step_j
    steps, in which the robot moves ½ s dt times v at most: one step of v and that make the horizon of
    `clearance_lower_bound`. False says nothing: the distances themselves have to be computed.

    Args:
        x: reads the results of the step.
        q: configuration (nq,).
        v: velocity (n,) [rad/s or m/s].
        k: number of near pairs.
        influence_distance: surface distance below which a pair is near [m].
    """
    steps = 0.0
    for j in range(len(v)):
        steps = max(steps, abs(v[j]) / x.v_step[j])
    horizon = x.dt * (1.0 + 0.5 * steps)
    if steps > 0.0 and leaves_position_limits(x, q, v, horizon):
        return False
    return clearance_lower_bound(x, v, k, influence_distance, horizon) > -TOLERANCE
