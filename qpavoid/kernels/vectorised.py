"""Array work of a tick in numpy: no Python loop over pairs, few calls, each on small arrays.

`qpavoid.kernels.compiled` has the same functions as loops for numba; both pass the same tests.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.linalg.lapack import dposv

from qpavoid.problem import Array, IntArray

WELL_CONDITIONED = 1e-6
"""Ratio of the smallest to the largest pivot of J Jᵀ down to which J⁺ is taken from it without damping."""

_SWAPPED, _DOUBLED = np.array([0, 1, 2, 4, 3]), np.array([2.0, 2.0, 2.0, 1.0, 1.0])
_CYCLE = np.array([1, 2, 0, 2, 0, 1])
_ANTICYCLE = np.array([2, 0, 1, 1, 2, 0])
_SKEW = np.zeros((3, 9))
_SKEW[2, [1, 3]] = 1.0, -1.0
_SKEW[1, [2, 6]] = -1.0, 1.0
_SKEW[0, [5, 7]] = 1.0, -1.0


def candidates(poses: Array, local: Array, centers: Array, within: Array, pair_of: IntArray) -> IntArray:
    """Pairs whose bounding spheres are within reach of each other.

    Args:
        poses: world poses of all geometries, rotation by columns and translation (g, 12).
        local: centres of their bounding spheres in their own frames (g, 3) [m].
        centers: the same in the world, as rows [c, 1, -|c|²] (g, 5) [m]; those of the b bodies of the robot, which
            come first, are overwritten.
        within: squared distance up to which each combination counts (b, g) [m²]; negative where there is no pair.
        pair_of: index of the pair of each combination (b, g), increasing along the rows, one after the other.

    Returns:
        (c,) indices of pairs, increasing.
    """
    bodies = len(within)
    body = centers[:bodies]
    body[:, :3] = np.matmul(local[:bodies, None], poses[:bodies, :9].reshape(-1, 3, 3))[:, 0] + poses[:bodies, 9:]
    np.einsum("ij,ij->i", body[:, :3], -body[:, :3], out=body[:, 4])
    # 2 a·c - |a|² - |c|² >= -within, the left side as one matrix product
    return np.asarray(pair_of[(body[:, _SWAPPED] * _DOUBLED) @ centers.T + within >= 0.0])


def distance_rows(
    results: Array, pairs: IntArray, reach: float, J_world: Array, support: Array, twists: Array, twist_row: IntArray,
    moving: bool,
) -> tuple[IntArray, Array, Array, Array]:  # fmt: skip
    """Closest points and rates of the pairs that are nearer than `reach`, or whose distance is NaN.

    The normal n is parallel to the line between the witness points, so p × n is the same at both, and every row is
    J = [n, p × n]ᵀ J_world, masked with the difference of the supports of the two bodies.

    Args:
        results: [distance, normal, point a, point b] of all pairs (m, 10).
        pairs: which of them to look at (c,), increasing.
        reach: distance below which a pair is near [m].
        J_world: world Jacobian of all joints (6, nv).
        support: difference of the supports of each pair's bodies (m, nv).
        twists: velocity of each obstacle at the world's origin, [linear, angular] (o + 1, 6); the last row is zero.
        twist_row: row of `twists` that moves each pair's second body (m,).
        moving: whether any of the twists is not zero.

    Returns:
        near (k,), closest points (k, 10), J (k, nv), drift (k,).
    """
    distance = results[:, 0] if len(pairs) == len(results) else results[pairs, 0]
    near = pairs[~(distance >= reach)]  # a NaN is near, not hidden
    if not len(near):
        return near, np.empty((0, 10)), np.empty((0, J_world.shape[1])), np.empty(0)
    closest = results[near]
    screws = np.empty((6, len(near)))
    columns = closest.T
    normal, point = columns[1:4], columns[4:7]
    screws[:3] = normal
    products = point[_CYCLE] * normal[_ANTICYCLE]
    np.subtract(products[:3], products[3:], out=screws[3:])
    J = screws.T @ J_world
    J *= support[near]
    drift = np.einsum("ij,ji->i", twists[twist_row[near]], screws) if moving else np.zeros(len(near))
    return near, closest, J, drift


def closing_speed_bound(d: Array, hold: float, gain: float, cap: float, switching: bool, d1: float, d2: float) -> Array:
    """See `qpavoid.avoidance.closing_speed_bound`."""
    bound = gain * (hold - d)
    if not len(d):
        return bound
    if switching:
        quarter = 0.5 * np.pi
        root = np.sin(np.minimum(np.maximum((d - d1) * (quarter / (d2 - d1)), 0.0), quarter))
        # 1 - β = root² is 0 below d1, where the row asks for recovery instead, which β does not weaken
        bound = np.maximum(bound, 0.0) + root * root * bound
    return np.minimum(bound, cap)


def rotation_vector(R: Any) -> tuple[float, float, float]:
    """Rotation vector [rad] of a rotation R[i][j], with an angle up to and including π.

    By way of the quaternion, whose largest component is taken first, so that nothing is lost near half a turn.
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


def frame_rows(
    screws: Array, turns: IntArray, poses: Array, position: Array, rotation: Array, linear: Array, angular: Array,
    gain: Array, scale: Array, J_world: Array, support: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Rows A v = b of f frames that follow targets: feed-forward plus gain times what is missing, scaled.

    Three linear rows for each frame come first, then three angular rows for each frame whose orientation counts.

    Args:
        screws: directions of the rows (r, 6), overwritten: the moments p × e of the linear rows.
        turns: which frames have angular rows (t,).
        poses: of the frames (f, 12), rotation by columns and position.
        position: of the targets (f, 3) [m].
        rotation: of the targets (f, 3, 3).
        linear: velocities of the targets (f, 3) [m/s].
        angular: their angular velocities (f, 3) [rad/s].
        gain: feedback gain of each frame (f, 1) [1/s].
        scale: of b (r,).
        J_world: world Jacobian of all joints (6, nv).
        support: scale of the coordinates that move each row's frame, 0 for the others (r, nv).

    Returns:
        A (r, nv), b (r,).
    """
    here = poses[:, 9:]
    split = 3 * len(here)
    screws[:split, 3:] = (here @ _SKEW).reshape(split, 3)
    b = np.empty(len(screws))
    b[:split] = (linear + gain * (position - here)).ravel()
    if len(turns):
        # poses hold rotations by columns, so these are their transposes
        missing = (rotation @ poses[:, :9].reshape(-1, 3, 3)).tolist()
        errors = np.array([rotation_vector(missing[f]) for f in turns])
        turning = turns if len(turns) < len(here) else slice(None)
        b[split:] = (angular[turning] + gain[turning] * errors).ravel()
    A = screws @ J_world
    A *= support
    b *= scale
    return A, b


def velocity_bounds(
    q: Array, q_index: IntArray, v_index: IntArray, q_lower: Array, q_upper: Array, v_max: Array, rate: float
) -> tuple[Array, Array]:
    """See `qpavoid.limits.velocity_bounds`; `rate` is position_gain / dt [1/s]."""
    if len(q_index) == len(q) == len(v_max):  # every joint has one coordinate and position limits
        slowest = -v_max
        lower = np.maximum(np.minimum(rate * (q_lower - q), v_max), slowest)
        return lower, np.maximum(np.minimum(rate * (q_upper - q), v_max), slowest)
    upper = v_max.copy()
    lower = -upper
    here, fastest = q[q_index], v_max[v_index]
    slowest = -fastest
    lower[v_index] = np.maximum(np.minimum(rate * (q_lower - here), fastest), slowest)
    upper[v_index] = np.maximum(np.minimum(rate * (q_upper - here), fastest), slowest)
    return lower, upper


def damped_solution(A: Array, b: Array, damping: float) -> Array:
    """A⁺b with A⁺ = Aᵀ (A Aᵀ + λ²)⁻¹.

    Args:
        A: rows (r, nv).
        b: right-hand sides (r,).
        damping: λ [-].

    Returns:
        (nv,); NaN where there is no damping and A Aᵀ is close to singular.
    """
    gram = A @ A.T
    gram.ravel()[:: len(gram) + 1] += damping * damping
    factor, x, info = dposv(gram, b)
    if damping == 0.0 and info == 0:
        pivots = factor.diagonal() ** 2
        info = int(pivots.min() < WELL_CONDITIONED * pivots.max())
    return x @ A if info == 0 else np.full(A.shape[1], np.nan)


def shortfall(v: Array, J: Array, b: Array, lower: Array, upper: Array) -> float:
    """Largest violation of J v >= b and lower <= v <= upper; negative inside, NaN where there is one."""
    over = np.maximum(v - upper, lower - v).max()
    return float(np.maximum(over, np.max(b - J @ v)) if len(b) else over)


def tracking_shortfall(
    A: Array, b: Array, damping: float, J: Array, least: Array, lower: Array, upper: Array
) -> tuple[Array, float]:
    """`damped_solution`, and its `shortfall` of the rows J v >= least and the bounds."""
    v = damped_solution(A, b, damping)
    return v, shortfall(v, J, least, lower, upper)


def projection_cost(A: Array, regularization: float, v0: Array) -> tuple[Array, Array]:
    """P = AᵀA + λ (nv, nv) and q = -P v0 (nv,): ½ vᵀP v + qᵀv is smallest at v0."""
    P = A.T @ A
    P.ravel()[:: len(P) + 1] += regularization
    return P, -(P @ v0)
