"""Array work of a tick in numpy: no Python loop over pairs, few calls, each on small arrays.

`qpavoid.kernels.compiled` has the same functions as loops for numba; both pass the same tests.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dposv

from qpavoid.problem import Array, IntArray

_CYCLE = np.array([1, 2, 0, 2, 0, 1])
_ANTICYCLE = np.array([2, 0, 1, 1, 2, 0])


def candidates(spheres: Array, others: Array, within: Array, pair_of: IntArray) -> IntArray:
    """Pairs whose bounding spheres are within reach of each other.

    One matrix product gives all squared distances |a|² + |b|² - 2 a·b.

    Args:
        spheres: rows [a, 1, |a|²] of the b bodies' centres a (b, 5).
        others: columns [-2 c; |c|²; 1] of all g centres c (5, g).
        within: squared distance up to which each combination counts (b, g) [m²]; negative where there is no pair.
        pair_of: index of the pair of each combination (b * g,).

    Returns:
        (c,) indices of pairs, increasing.
    """
    return pair_of[np.flatnonzero(spheres @ others <= within)]


def distance_rows(
    results: Array, pairs: IntArray, reach: float, J_world: Array, support: Array, twists: Array, twist_row: IntArray
) -> tuple[IntArray, Array, Array, Array]:
    """Closest points and rates of the pairs that are nearer than `reach`.

    The normal n is parallel to the line between the witness points, so p × n is the same at both, and every row is
    J = [n, p × n]ᵀ J_world, masked with the difference of the supports of the two bodies.

    Args:
        results: [distance, normal, point a, point b] of all pairs (m, 10).
        pairs: which of them to look at (c,).
        reach: distance below which a pair is near [m].
        J_world: world Jacobian of all joints (6, nv).
        support: difference of the supports of each pair's bodies (m, nv).
        twists: velocity of each obstacle at the world's origin, [linear, angular] (o + 1, 6); the last row is zero.
        twist_row: row of `twists` that moves each pair's second body (m,).

    Returns:
        near (k,), closest points (k, 10), J (k, nv), drift (k,).
    """
    closest = results[pairs]
    keep = np.flatnonzero(closest[:, 0] < reach)
    near, closest = pairs[keep], closest[keep]
    screws = np.empty((6, len(near)))
    columns = closest.T
    normal, point = columns[1:4], columns[4:7]
    screws[:3] = normal
    products = point[_CYCLE] * normal[_ANTICYCLE]
    np.subtract(products[:3], products[3:], out=screws[3:])
    J = (screws.T @ J_world) * support[near]
    return near, closest, J, np.einsum("ij,ji->i", twists[twist_row[near]], screws)


def velocity_bounds(
    q: Array, q_index: IntArray, v_index: IntArray, q_lower: Array, q_upper: Array, v_max: Array, rate: float
) -> tuple[Array, Array]:
    """See `qpavoid.limits.velocity_bounds`; `rate` is position_gain / dt [1/s]."""
    upper = v_max.copy()
    lower = -upper
    here, fastest = q[q_index], v_max[v_index]
    lower[v_index] = np.maximum(np.minimum(rate * (q_lower - here), fastest), -fastest)
    upper[v_index] = np.maximum(np.minimum(rate * (q_upper - here), fastest), -fastest)
    return lower, upper


def tracking_velocity(A: Array, b: Array, weight: Array, damping: float) -> Array:
    """J⁺ẋ with J = W½ A, ẋ = W½ b and J⁺ = Jᵀ (J Jᵀ + λ²)⁻¹; NaN where the Gram matrix is singular."""
    root = np.sqrt(weight)
    J = root[:, None] * A
    gram = J @ J.T
    gram.ravel()[:: len(gram) + 1] += damping * damping
    _, x, info = dposv(gram, root * b)
    return J.T @ x if info == 0 else np.full(A.shape[1], np.nan)


def shortfall(v: Array, J: Array, least: Array, lower: Array, upper: Array) -> float:
    """Largest violation of J v >= least and lower <= v <= upper; negative inside, NaN stays NaN."""
    over = float(np.maximum(v - upper, lower - v).max())
    return max(over, float((least - J @ v).max())) if len(least) else over
