"""Rotation vectors in closed form: plain Python for tasks, compiled where a kernel calls it."""

from __future__ import annotations

import math
from typing import Any


def rotation_vector(R: Any) -> tuple[float, float, float]:
    """Compute the rotation vector [rad] of a rotation R[i][j], with an angle up to and including π.

    The quaternion [cos ½θ, n sin ½θ] is read from R by its largest component first (Shepperd 1978, "Quaternion from
    rotation matrix"), so that no digits are lost near half a turn; the vector is θ n. At half a turn, n and -n are the
    same rotation: either may be returned.

    Args:
        R: rotation (3, 3), by rows.
    """
    trace = R[0][0] + R[1][1] + R[2][2]
    if trace >= max(R[0][0], R[1][1], R[2][2]):
        w, x, y, z = 1.0 + trace, R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1]
    elif R[0][0] >= max(R[1][1], R[2][2]):
        w, x, y, z = R[2][1] - R[1][2], 1.0 + 2.0 * R[0][0] - trace, R[0][1] + R[1][0], R[0][2] + R[2][0]
    elif R[1][1] >= R[2][2]:
        w, x, y, z = R[0][2] - R[2][0], R[0][1] + R[1][0], 1.0 + 2.0 * R[1][1] - trace, R[1][2] + R[2][1]
    else:
        w, x, y, z = R[1][0] - R[0][1], R[0][2] + R[2][0], R[1][2] + R[2][1], 1.0 + 2.0 * R[2][2] - trace
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-12:
        return 0.5 * x, 0.5 * y, 0.5 * z
    scale = (2.0 if w >= 0.0 else -2.0) * math.atan2(length, abs(w)) / length
    return scale * x, scale * y, scale * z
