"""Rows of balance: the capture point of the centre of mass stays over what the robot stands on.

A robot at c that moves at ċ comes to rest over ζ = c + ċ/ω, ω = √(g/z), if it pushes there at once (Pratt, Carff,
Drakunov and Goswami 2006, "Capture point: a step toward humanoid push recovery"). For an edge of the convex hull of the
contact points, with d how far c is inside, n·ζ stays inside where n·ċ >= -ω d: a velocity row as that of a pair.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray

_GRAVITY = 9.81
"""[m/s²]"""
_LEAST_HEIGHT = 0.05
"""Height of the centre of mass over the contact points that counts at the least [m]."""
_LEAST_EDGE = 1e-3
"""Length of an edge that counts [m]."""


@compiled
def balance_rows(points: Array, x: Any, y: Any, z: Any) -> tuple[Array, Array]:
    """Compute the rows of the edges, approached at the rate of rows.

    Args:
        points: (k, 3) contact points that bear fully, world [m].
        x: reads v_prev.
        y: reads row_factor.
        z: reads center, center_jacobian and support_margin.

    Returns:
        Rows (e, n) and right-hand sides (e,) [m/s]; none where the points span no area.
    """
    hull, n = convex_hull(points[:, :2]), len(x.v_prev)
    count = len(hull) if len(hull) > 2 else 0
    rows, rhs, height, at = np.zeros((count, n)), np.empty(count), 0.0, 0
    for k in range(len(points)):
        height += (z.center[2] - points[k, 2]) / len(points)
    omega = np.sqrt(_GRAVITY / max(height, _LEAST_HEIGHT))
    for e in range(count):
        p, q = points[hull[e]], points[hull[(e + 1) % count]]
        dx, dy = q[0] - p[0], q[1] - p[1]
        size = np.sqrt(dx * dx + dy * dy)
        if size < _LEAST_EDGE:
            continue
        nx, ny, rate = -dy / size, dx / size, 0.0
        inside = nx * (z.center[0] - p[0]) + ny * (z.center[1] - p[1]) - z.support_margin
        for j in range(n):
            rows[at, j] = nx * z.center_jacobian[0, j] + ny * z.center_jacobian[1, j]
            rate += rows[at, j] * x.v_prev[j]
        rhs[at] = rate + y.row_factor * (-omega * inside - rate)
        at += 1
    return rows[:at], rhs[:at]


@compiled
def convex_hull(points: Array) -> IntArray:
    """List the corners of the convex hull of points (k, 2), by number, counterclockwise (Andrew's monotone chain)."""
    count = len(points)
    order, hull, size = np.arange(count), np.zeros(2 * count + 1, dtype=np.intp), 0
    if count < 3:
        return hull[:0]
    for i in range(1, count):  # by x, then y
        k, j = order[i], i
        while j > 0 and (
            points[order[j - 1], 0] > points[k, 0]
            or (points[order[j - 1], 0] == points[k, 0] and points[order[j - 1], 1] > points[k, 1])
        ):
            order[j] = order[j - 1]
            j -= 1
        order[j] = k
    for half in range(2):
        begin = size
        for i in range(count):
            k = order[i] if half == 0 else order[count - 1 - i]
            while size - begin >= 2:
                a, b = points[hull[size - 2]], points[hull[size - 1]]
                if (b[0] - a[0]) * (points[k, 1] - a[1]) - (b[1] - a[1]) * (points[k, 0] - a[0]) > 0.0:
                    break
                size -= 1
            hull[size] = k
            size += 1
        size -= 1  # the last one begins the other half
    return hull[:size]
