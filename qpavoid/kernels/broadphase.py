"""Broad phase: the pairs whose bounding spheres are near, and the difference of two such sets."""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray, Mask


@compiled
def candidates(
    poses: Array, local: Array, centers: Array, max_square: Array, pair_of: IntArray, enabled: Mask, pairs: IntArray
) -> int:
    """Find the pairs whose bounding spheres are near each other.

    Args:
        poses: world poses of all geometries, rotation by columns and translation (g, 12).
        local: centres of their bounding spheres in their own frames (g, 3) [m].
        centers: the same in the world, as rows [c, 1, -|c|²] (g, 5) [m]; those of the b bodies of the robot, which
            come first, are overwritten.
        max_square: squared distance of centres up to which each combination is near (b, g) [m²]; negative where there
            is no pair.
        pair_of: index of the pair of each combination (b, g), increasing along the rows, one after the other.
        enabled: pairs that are considered (m,).
        pairs: out (m,), the first entries: indices of the near pairs, increasing.

    Returns:
        Number of near pairs.
    """
    bodies, geometries = pair_of.shape
    for i in range(bodies):
        for r in range(3):
            rotated = poses[i, r] * local[i, 0] + poses[i, 3 + r] * local[i, 1] + poses[i, 6 + r] * local[i, 2]
            centers[i, r] = rotated + poses[i, 9 + r]
        centers[i, 4] = -(centers[i, 0] ** 2 + centers[i, 1] ** 2 + centers[i, 2] ** 2)
    x, y, z = centers[:, 0].copy(), centers[:, 1].copy(), centers[:, 2].copy()
    near = np.empty(geometries, np.bool_)
    count = 0
    for i in range(bodies):
        for j in range(geometries):  # free of branches, so that it becomes vector instructions
            dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
            near[j] = dx * dx + dy * dy + dz * dz <= max_square[i, j]
        for j in range(geometries):
            if near[j] and enabled[pair_of[i, j]]:
                pairs[count] = pair_of[i, j]
                count += 1
    return count


@compiled
def sorted_setxor(a: IntArray, b: IntArray) -> IntArray:
    """Compute the symmetric difference (k,) of two increasing arrays (m,), (n,), increasing.

    Args:
        a: increasing (m,).
        b: increasing (n,).
    """
    difference = np.empty(len(a) + len(b), np.intp)
    i, j, count = 0, 0, 0
    while i < len(a) or j < len(b):
        if j == len(b) or (i < len(a) and a[i] < b[j]):
            difference[count], i, count = a[i], i + 1, count + 1
        elif i == len(a) or b[j] < a[i]:
            difference[count], j, count = b[j], j + 1, count + 1
        else:
            i, j = i + 1, j + 1
    return difference[:count]
