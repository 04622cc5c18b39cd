"""Rows of frames in contact: velocities that bring them back to where they rest."""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.kernels.tasks import _rotation_vector
from qpavoid.problem import Array, IntArray, Mask

_CORRECTION = 0.02
"""Largest speed at which what has slid is put right [m/s, rad/s]."""


@compiled
def contact_rows(
    J_world: Array, columns: IntArray, support: Array, poses: Array, frame_ids: IntArray, anchors: Array,
    gains: Array, surfaces: Mask, shares: Array, jacobians: Array,
) -> tuple[Array, Array, IntArray]:  # fmt: skip
    """Compute the rows J v = b of the active contacts: of a surface, linear and angular; of a point, linear ones.

    Args:
        J_world: (6, e) see `Kinematics.J`.
        columns: (e,) coordinate that moves each column.
        support: (f, e) 1 of the columns that move each frame, else 0.
        poses: (frames, 12) of all frames.
        frame_ids: (f,) those in contact.
        anchors: (f, 12) where they rest.
        gains: (f,) feedback on what has slid [1/s].
        surfaces: (f,) whether it may not turn, either.
        shares: (f,) 0 of those that are not active.
        jacobians: (f, 6, n) out: of each frame, in world axes; zero of those that are not active.

    Returns:
        J (c, n), b (c,) [m/s, rad/s], contact of each row (c,).
    """
    count, n = 0, jacobians.shape[2]
    for i in range(len(frame_ids)):
        if shares[i] > 0.0:
            count += 6 if surfaces[i] else 3
    J, b, owners, turn = np.empty((count, n)), np.empty(count), np.empty(count, dtype=np.intp), np.empty((3, 3))
    jacobians[:] = 0.0
    r, largest = 0, 1e-12
    for i in range(len(frame_ids)):
        if not shares[i] > 0.0:
            continue
        pose, anchor, own = poses[frame_ids[i]], anchors[i], jacobians[i]
        px, py, pz = pose[9], pose[10], pose[11]
        for c in range(len(columns)):
            if support[i, c] != 0.0:
                j, wx, wy, wz = columns[c], J_world[3, c], J_world[4, c], J_world[5, c]
                own[0, j] += J_world[0, c] + wy * pz - wz * py
                own[1, j] += J_world[1, c] + wz * px - wx * pz
                own[2, j] += J_world[2, c] + wx * py - wy * px
                own[3, j] += wx
                own[4, j] += wy
                own[5, j] += wz
        for a in range(3):
            for c in range(3):
                turn[a, c] = 0.0
                for k in range(3):
                    turn[a, c] += anchor[3 * k + a] * pose[3 * k + c]
        turned = _rotation_vector(turn)
        for a in range(6 if surfaces[i] else 3):
            missing = anchor[9 + a] - pose[9 + a] if a < 3 else turned[a - 3]
            J[r], b[r], owners[r] = own[a], gains[i] * missing, i
            largest = max(largest, abs(b[r]))
            r += 1
    fraction = min(1.0, _CORRECTION / largest)
    for r in range(count):
        b[r] *= fraction
    return J, b, owners
