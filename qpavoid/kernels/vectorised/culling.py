"""Which pairs can be within reach at all, by bounding spheres."""

from __future__ import annotations

import numpy as np

from qpavoid.problem import Array, IntArray

_SWAPPED, _DOUBLED = np.array([0, 1, 2, 4, 3]), np.array([2.0, 2.0, 2.0, 1.0, 1.0])


def candidates(poses: Array, local: Array, centers: Array, within: Array, pair_of: IntArray, found: IntArray) -> int:
    """Pairs whose bounding spheres are within reach of each other.

    Args:
        poses: world poses of all geometries, rotation by columns and translation (g, 12).
        local: centres of their bounding spheres in their own frames (g, 3) [m].
        centers: the same in the world, as rows [c, 1, -|c|²] (g, 5) [m]; those of the b bodies of the robot, which
            come first, are overwritten.
        within: squared distance of centres up to which each combination counts (b, g) [m²]; negative where there is no
            pair.
        pair_of: index of the pair of each combination (b, g), increasing along the rows, one after the other.
        found: overwritten with the indices of these pairs, increasing (m,).

    Returns:
        How many there are.
    """
    bodies = len(pair_of)
    body = centers[:bodies]
    body[:, :3] = np.matmul(local[:bodies, None], poses[:bodies, :9].reshape(-1, 3, 3))[:, 0] + poses[:bodies, 9:]
    np.einsum("ij,ij->i", body[:, :3], -body[:, :3], out=body[:, 4])
    # 2 a·c - |a|² - |c|² >= -within, the left side as one matrix product
    pairs = pair_of[np.dot(body[:, _SWAPPED] * _DOUBLED, centers.T) + within >= 0.0]
    found[: len(pairs)] = pairs
    return len(pairs)


def in_one_alone(a: IntArray, b: IntArray) -> IntArray:
    """What is in one of two increasing arrays (m,), (n,) and not in the other, increasing (k,)."""
    return np.setxor1d(a, b, assume_unique=True)
