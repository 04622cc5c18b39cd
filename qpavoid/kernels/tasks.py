"""Rows of the frames that follow targets, and the cost of a QP that tracks."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.kernels.rotation import rotation_vector
from qpavoid.kernels.rows import _fold
from qpavoid.problem import Array

_rotation_vector = compiled(rotation_vector)


@compiled
def frame_rows(x: Any) -> None:
    """Write the rows A v = b of f frames that follow targets.

    The right-hand side is feed-forward plus gain times error, capped and scaled. A linear row has the direction e of a
    world axis: e·(v_p + ω × p) = [e, p × e]ᵀ J_world v with the frame's position p, and b = ẋ_ref + K (x_ref - x). An
    angular row is e·ω with b = ω_ref + K e·θ, where θ is the rotation vector of R_ref Rᵀ, see `rotation_vector`. The
    three right-hand sides of a frame are scaled down together to its largest speed, then every row with the root of its
    weight. Three linear rows for each frame whose position counts come first, then three angular rows for each whose
    orientation does; rows after these are not changed.

    Args:
        x: reads J_world, frame_poses, frame_ids, targets, oriented, gain, cap, scale and task_support; writes poses
            (f, 12), the moments of row_wrenches, errors and feedback (3 (p + t),), and the first rows of A (r, n) and b
            (r,) [m/s, rad/s].
    """
    poses, targets, row_wrenches, support, A, b = x.poses, x.targets, x.row_wrenches, x.task_support, x.A, x.b
    errors, feedback, J_world = x.errors, x.feedback, x.J_world
    rows, columns = len(row_wrenches), J_world.shape[1]
    positioned = rows // 3 - len(x.oriented)
    for f in range(len(poses)):
        for c in range(12):
            poses[f, c] = x.frame_poses[x.frame_ids[f], c]
    for f in range(positioned):
        r, px, py, pz = 3 * f, poses[f, 9], poses[f, 10], poses[f, 11]
        row_wrenches[r, 4], row_wrenches[r, 5] = pz, -py
        row_wrenches[r + 1, 3], row_wrenches[r + 1, 5] = -pz, px
        row_wrenches[r + 2, 3], row_wrenches[r + 2, 4] = py, -px
        for i in range(3):
            errors[r + i] = targets[f, 9 + i] - poses[f, 9 + i]
            feedback[r + i] = x.gain[f] * errors[r + i]
            b[r + i] = targets[f, 12 + i] + feedback[r + i]
    R_error = np.empty((3, 3))
    for n in range(len(x.oriented)):
        f = x.oriented[n]
        for i in range(3):
            for j in range(3):
                R_error[i, j] = 0.0
                for c in range(3):
                    R_error[i, j] += targets[f, 3 * c + i] * poses[f, 3 * c + j]
        turn, r = _rotation_vector(R_error), 3 * (positioned + n)
        for i in range(3):
            errors[r + i] = turn[i]
            feedback[r + i] = x.gain[f] * turn[i]
            b[r + i] = targets[f, 15 + i] + feedback[r + i]
    for part in range(len(x.cap)):
        r = 3 * part
        speed = np.sqrt(b[r] * b[r] + b[r + 1] * b[r + 1] + b[r + 2] * b[r + 2])
        if speed > x.cap[part]:
            for i in range(3):
                b[r + i] *= x.cap[part] / speed
                feedback[r + i] *= x.cap[part] / speed
    for r in range(rows):
        b[r] *= x.scale[r]
        feedback[r] *= x.scale[r]
        row = x.unfolded_row if x.has_mimics else A[r]
        lx, ly, lz, ax, ay, az = (
            row_wrenches[r, 0],
            row_wrenches[r, 1],
            row_wrenches[r, 2],
            row_wrenches[r, 3],
            row_wrenches[r, 4],
            row_wrenches[r, 5],
        )
        for c in range(columns):
            linear = lx * J_world[0, c] + ly * J_world[1, c] + lz * J_world[2, c]
            angular = ax * J_world[3, c] + ay * J_world[4, c] + az * J_world[5, c]
            row[c] = (linear + angular) * support[r, c]
        if x.has_mimics:
            _fold(row, x.columns, A[r])


@compiled
def projection_cost(A: Array, regularization: float, v_tracking: Array) -> tuple[Array, Array]:
    """Compute the cost ½ vᵀP v + qᵀv that is smallest at v_tracking.

    But for a constant it is ½ ‖A (v - v_tracking)‖² + ½ λ ‖v - v_tracking‖².

    Args:
        A: task rows (r, n).
        regularization: λ.
        v_tracking: velocity of least cost (n,).

    Returns:
        P = AᵀA + λ I (n, n) and q = -P v_tracking (n,).
    """
    rows, nv = A.shape
    P = np.empty((nv, nv))
    q = np.zeros(nv)
    for i in range(nv):
        for j in range(i + 1):
            dot = 0.0
            for r in range(rows):
                dot += A[r, i] * A[r, j]
            P[i, j] = dot
            P[j, i] = dot
        P[i, i] += regularization
    for i in range(nv):
        for j in range(nv):
            q[i] -= P[i, j] * v_tracking[j]
    return P, q
