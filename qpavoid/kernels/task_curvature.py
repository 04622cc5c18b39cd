"""Second derivatives of the poses of frames: how the rows of a task turn as the robot moves."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.kernels.task_scaling import APPROACH_RATE
from qpavoid.problem import Array


@compiled
def add_curvature(x: Any, part: int, w: Array, G: Array) -> None:
    """Add to G the curvature Σ_r w_r ∂²x_r/∂q² of a frame's position, or of its orientation.

    With the columns (Jp_j, ω_j) of its Jacobian, and i before j on the way from the base to the frame, that is
    w·(ω_i × Jp_j) of the position and ½ w·(ω_i × ω_j) of the orientation, at (i, j) as at (j, i). Columns of the same
    joint count half in each order; columns that the same coordinate moves are added up. vᵀG v is what w sees of the
    frame's acceleration at the constant velocity v.

    Args:
        x: reads J_world, poses, oriented, task_support, columns and column_joints.
        part: number of the three rows, the first 3 part of A.
        w: weights of the rows in world axes (3,).
        G: out (n, n).
    """
    J_world, joints, columns = x.J_world, x.column_joints, x.columns
    support, count = x.task_support[3 * part], J_world.shape[1]
    positioned = len(x.task_support) // 3 - len(x.oriented)
    is_linear = part < positioned
    pose = x.poses[part if is_linear else x.oriented[part - positioned]]
    moved = np.empty((count, 3))  # by column: velocity of the position, or angular velocity
    for j in range(count):
        ax, ay, az = J_world[3, j], J_world[4, j], J_world[5, j]
        if is_linear:
            moved[j, 0] = J_world[0, j] + ay * pose[11] - az * pose[10]
            moved[j, 1] = J_world[1, j] + az * pose[9] - ax * pose[11]
            moved[j, 2] = J_world[2, j] + ax * pose[10] - ay * pose[9]
        else:
            moved[j, 0], moved[j, 1], moved[j, 2] = 0.5 * ax, 0.5 * ay, 0.5 * az
    for i in range(count):
        if support[i] == 0.0:
            continue
        ax, ay, az = J_world[3, i], J_world[4, i], J_world[5, i]
        tx, ty, tz = w[1] * az - w[2] * ay, w[2] * ax - w[0] * az, w[0] * ay - w[1] * ax  # w × ω_i
        a = columns[i]
        if is_linear:
            G[a, a] += tx * moved[i, 0] + ty * moved[i, 1] + tz * moved[i, 2]
        for j in range(i + 1, count):
            if support[j] == 0.0:
                continue
            value = tx * moved[j, 0] + ty * moved[j, 1] + tz * moved[j, 2]
            if joints[i] == joints[j]:
                bx, by, bz = J_world[3, j], J_world[4, j], J_world[5, j]
                value += moved[i, 0] * (w[1] * bz - w[2] * by) + moved[i, 1] * (w[2] * bx - w[0] * bz)
                value = 0.5 * (value + moved[i, 2] * (w[0] * by - w[1] * bx))
            G[a, columns[j]] += value
            G[columns[j], a] += value


@compiled
def curvature_weights(x: Any, b: Array, g: Array) -> Array:
    """Compute w = (2 dt b + f/κ)/g of the rows that bend, given b/g and g (c,); f is all of b but of frames."""
    w = np.empty(len(b))
    for k in range(len(b)):
        r = x.bending_rows[k]
        feedback = x.feedback[r] / g[k] if r < len(x.feedback) else b[k]
        w[k] = x.scale[r] * (2.0 * x.dt * b[k] + feedback / APPROACH_RATE)
    return w
