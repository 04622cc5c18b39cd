"""Forward kinematics: poses of joints and frames, and the world Jacobian.

A pose is a row of 12: rotation by columns, then position [-, m].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray

REVOLUTE, UNBOUNDED, PRISMATIC, TRANSLATION, PLANAR, SPHERICAL, FREE = range(7)
"""Kinds of joints: an angle, its cosine and sine, a length, a position, a position and an angle in a plane (cosine and
sine), a quaternion, a position and a quaternion."""


class KinematicsArrays(NamedTuple):
    """A tree of J joints, of which number 0 is the world, and f frames; its Jacobian has e columns."""

    kind: IntArray
    """(J,) kind of each joint."""
    parents: IntArray
    """(J,) parent of each joint, which comes before it."""
    q_index: IntArray
    """(J,) index in q of its first coordinate."""
    multiplier: Array
    """(J,) by which its coordinate is multiplied: 1, but for a joint that mimics another one [-]."""
    origin: Array
    """(J,) added to that [rad or m]."""
    placements: Array
    """(J, 12) pose P of each joint in its parent, at zero."""
    turns: Array
    """(J, 2, 9) P K and P K² by columns, K = [a]× of the axis a: P + sin θ P K + (1 - cos θ) P K² is turned by θ."""
    slides: Array
    """(J, 3) axis of each joint in its parent."""
    column_joints: IntArray
    """(e,) joint that each column of the Jacobian belongs to."""
    motions: Array
    """(e, 6) twist of each column in the axes of its joint: linear, then angular."""
    frame_ids: IntArray
    """(f,) rows of `frame_poses` that are kept up to date."""
    frame_joints: IntArray
    """(f,) joint of each of these frames."""
    frame_placements: Array
    """(f, 12) its pose in the joint."""
    local_poses: Array
    """(J, 12) out: pose of each joint in its parent."""
    joint_poses: Array
    """(J, 12) out: pose of each joint in the world; row 0 is the identity."""
    frame_poses: Array
    """(frames, 12) out: poses of the frames `frame_ids` in the world."""
    J: Array
    """(6, e) out: world Jacobian, twists at the world's origin, linear before angular."""


@compiled
def update_kinematics(x: KinematicsArrays, q: Array) -> None:
    """Write the poses of all joints and of some frames, and the world Jacobian.

    Args:
        x: tree, overwritten.
        q: configuration (nq,).
    """
    for i in range(1, len(x.parents)):
        _local_pose(x, i, q, x.local_poses[i])
        compose(x.joint_poses[x.parents[i]], x.local_poses[i], x.joint_poses[i])
    for c in range(len(x.column_joints)):
        _write_column(x.joint_poses[x.column_joints[c]], x.motions[c], x.J, c)
    for f in range(len(x.frame_ids)):
        compose(x.joint_poses[x.frame_joints[f]], x.frame_placements[f], x.frame_poses[x.frame_ids[f]])


@compiled
def compose(a: Array, b: Array, product: Array) -> None:
    """Write the product of two poses (12,).

    Args:
        a: pose (12,).
        b: pose (12,), in the axes of `a`.
        product: out (12,).
    """
    for c in range(4):
        x, y, z = b[3 * c], b[3 * c + 1], b[3 * c + 2]
        for r in range(3):
            product[3 * c + r] = a[r] * x + a[3 + r] * y + a[6 + r] * z
    for r in range(3):
        product[9 + r] += a[9 + r]


@compiled
def _write_column(pose: Array, motion: Array, J: Array, c: int) -> None:
    """Write the twist at the world's origin [R v + p × R w; R w] of a motion [v; w] in the axes of a pose."""
    px, py, pz = pose[9], pose[10], pose[11]
    vx, vy, vz = _rotated(pose, motion[0], motion[1], motion[2])
    wx, wy, wz = _rotated(pose, motion[3], motion[4], motion[5])
    J[0, c], J[1, c], J[2, c] = vx + py * wz - pz * wy, vy + pz * wx - px * wz, vz + px * wy - py * wx
    J[3, c], J[4, c], J[5, c] = wx, wy, wz


@compiled
def _rotated(pose: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Compute a vector in world axes that is x, y, z in those of a pose."""
    return (
        pose[0] * x + pose[3] * y + pose[6] * z,
        pose[1] * x + pose[4] * y + pose[7] * z,
        pose[2] * x + pose[5] * y + pose[8] * z,
    )


@compiled
def _local_pose(x: KinematicsArrays, i: int, q: Array, pose: Array) -> None:
    """Write the pose (12,) of joint i in its parent."""
    kind, k, placement = x.kind[i], x.q_index[i], x.placements[i]
    if kind == REVOLUTE:
        angle = x.multiplier[i] * q[k] + x.origin[i]
        turn(placement, x.turns[i], np.cos(angle), np.sin(angle), pose)
    elif kind == UNBOUNDED:
        turn(placement, x.turns[i], q[k], q[k + 1], pose)
    elif kind == PRISMATIC:
        length = x.multiplier[i] * q[k] + x.origin[i]
        pose[:9] = placement[:9]
        for r in range(3):
            pose[9 + r] = placement[9 + r] + length * x.slides[i, r]
    elif kind == PLANAR:
        turn(placement, x.turns[i], q[k + 2], q[k + 3], pose)
        _shift(placement, q[k], q[k + 1], 0.0, pose)
    else:
        if kind == TRANSLATION:
            pose[:9] = placement[:9]
        else:
            _rotate(placement, q[k + 3 : k + 7] if kind == FREE else q[k : k + 4], pose)
        if kind == SPHERICAL:
            pose[9:] = placement[9:]
        else:
            _shift(placement, q[k], q[k + 1], q[k + 2], pose)


@compiled
def turn(placement: Array, turns: Array, cos: float, sin: float, pose: Array) -> None:
    """Write a placement (12,) that is turned about the axis of its joint."""
    for c in range(9):
        pose[c] = placement[c] + sin * turns[0, c] + (1.0 - cos) * turns[1, c]
    pose[9:] = placement[9:]


@compiled
def _shift(placement: Array, x: float, y: float, z: float, pose: Array) -> None:
    """Write the position of a placement (12,) that is shifted along its own axes [m]."""
    for r in range(3):
        pose[9 + r] = placement[9 + r] + placement[r] * x + placement[3 + r] * y + placement[6 + r] * z


@compiled
def _rotate(placement: Array, quaternion: Array, pose: Array) -> None:
    """Write the rotation of a placement (12,) that is turned by a quaternion x, y, z, w (4,)."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    turned = np.empty(9)
    turned[0], turned[1], turned[2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)
    turned[3], turned[4], turned[5] = 2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)
    turned[6], turned[7], turned[8] = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
    for c in range(3):
        for r in range(3):
            pose[3 * c + r] = (
                placement[r] * turned[3 * c]
                + placement[3 + r] * turned[3 * c + 1]
                + placement[6 + r] * turned[3 * c + 2]
            )
