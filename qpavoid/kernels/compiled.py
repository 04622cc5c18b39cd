"""The functions of `qpavoid.kernels.vectorised` as loops that numba compiles; documented there.

Compiled code is cached on disk, so that only the first run after an installation waits for the compiler. The cache
follows this file alone: after a change to what it takes from `vectorised`, remove `__pycache__`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from qpavoid.kernels.vectorised import WELL_CONDITIONED, rotation_vector
from qpavoid.problem import Array, IntArray


@njit(cache=True)
def candidates(poses: Array, local: Array, centers: Array, within: Array, pair_of: IntArray) -> IntArray:
    """See `vectorised.candidates`."""
    bodies, geometries = within.shape
    for i in range(bodies):
        for r in range(3):
            turned = poses[i, r] * local[i, 0] + poses[i, 3 + r] * local[i, 1] + poses[i, 6 + r] * local[i, 2]
            centers[i, r] = turned + poses[i, 9 + r]
        centers[i, 4] = -(centers[i, 0] ** 2 + centers[i, 1] ** 2 + centers[i, 2] ** 2)
    x, y, z = centers[:, 0].copy(), centers[:, 1].copy(), centers[:, 2].copy()
    found = np.empty(bodies * geometries, np.intp)
    near = np.empty(geometries, np.bool_)
    count = 0
    for i in range(bodies):
        for j in range(geometries):  # free of branches, so that it becomes vector instructions
            dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
            near[j] = dx * dx + dy * dy + dz * dz <= within[i, j]
        for j in range(geometries):
            if near[j]:
                found[count] = pair_of[i, j]
                count += 1
    return found[:count].copy()


@njit(cache=True)
def distance_rows(
    results: Array, pairs: IntArray, reach: float, J_world: Array, support: Array, twists: Array, twist_row: IntArray,
    moving: bool,
) -> tuple[IntArray, Array, Array, Array]:  # fmt: skip
    """See `vectorised.distance_rows`."""
    count = 0
    for i in pairs:
        if not results[i, 0] >= reach:
            count += 1
    nv = J_world.shape[1]
    near = np.empty(count, np.intp)
    closest = np.empty((count, 10))
    J = np.empty((count, nv))
    drift = np.zeros(count)
    k = 0
    for i in pairs:
        if not results[i, 0] >= reach:
            near[k] = i
            for c in range(10):
                closest[k, c] = results[i, c]
            nx, ny, nz = results[i, 1], results[i, 2], results[i, 3]
            px, py, pz = results[i, 4], results[i, 5], results[i, 6]
            mx, my, mz = py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx
            for c in range(nv):
                linear = nx * J_world[0, c] + ny * J_world[1, c] + nz * J_world[2, c]
                angular = mx * J_world[3, c] + my * J_world[4, c] + mz * J_world[5, c]
                J[k, c] = (linear + angular) * support[i, c]
            if moving:
                t = twists[twist_row[i]]
                drift[k] = nx * t[0] + ny * t[1] + nz * t[2] + mx * t[3] + my * t[4] + mz * t[5]
            k += 1
    return near, closest, J, drift


@njit(cache=True)
def closing_speed_bound(d: Array, hold: float, gain: float, cap: float, switching: bool, d1: float, d2: float) -> Array:
    """See `vectorised.closing_speed_bound`."""
    bound = np.empty(len(d))
    for k in range(len(d)):
        value = gain * (hold - d[k])
        if switching and not value > 0.0:
            share = min(max((d[k] - d1) / (d2 - d1), 0.0), 1.0)
            value *= 0.5 - 0.5 * np.cos(np.pi * share)
        bound[k] = min(value, cap)
    return bound


_rotation_vector = njit(cache=True)(rotation_vector)


@njit(cache=True)
def frame_rows(
    screws: Array, turns: IntArray, poses: Array, position: Array, rotation: Array, linear: Array, angular: Array,
    gain: Array, scale: Array, J_world: Array, support: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """See `vectorised.frame_rows`."""
    rows, nv = support.shape
    A = np.zeros((rows, nv))
    b = np.empty(rows)
    for f in range(len(poses)):
        r, x, y, z = 3 * f, poses[f, 9], poses[f, 10], poses[f, 11]
        screws[r, 4], screws[r, 5] = z, -y
        screws[r + 1, 3], screws[r + 1, 5] = -z, x
        screws[r + 2, 3], screws[r + 2, 4] = y, -x
        for i in range(3):
            b[r + i] = linear[f, i] + gain[f, 0] * (position[f, i] - poses[f, 9 + i])
    missing = np.empty((3, 3))
    for n in range(len(turns)):
        f = turns[n]
        for i in range(3):
            for j in range(3):
                missing[i, j] = 0.0
                for c in range(3):
                    missing[i, j] += rotation[f, i, c] * poses[f, 3 * c + j]
        errors = _rotation_vector(missing)
        for i in range(3):
            b[3 * (len(poses) + n) + i] = angular[f, i] + gain[f, 0] * errors[i]
    for r in range(rows):
        b[r] *= scale[r]
        for s in range(6):
            e = screws[r, s]
            if e != 0.0:
                for c in range(nv):
                    A[r, c] += e * J_world[s, c]
        for c in range(nv):
            A[r, c] *= support[r, c]
    return A, b


@njit(cache=True)
def velocity_bounds(
    q: Array, q_index: IntArray, v_index: IntArray, q_lower: Array, q_upper: Array, v_max: Array, rate: float
) -> tuple[Array, Array]:
    """See `vectorised.velocity_bounds`."""
    upper = v_max.copy()
    lower = -upper
    for i in range(len(q_index)):
        j, here = v_index[i], q[q_index[i]]
        fastest = v_max[j]
        lower[j] = max(min(rate * (q_lower[i] - here), fastest), -fastest)
        upper[j] = max(min(rate * (q_upper[i] - here), fastest), -fastest)
    return lower, upper


@njit(cache=True)
def damped_solution(A: Array, b: Array, damping: float) -> Array:
    """See `vectorised.damped_solution`: Cholesky factorisation of the Gram matrix, row by row."""
    rows, nv = A.shape
    L = np.empty((rows, rows))
    x = np.empty(rows)
    v = np.zeros(nv)
    smallest, largest = np.inf, 0.0
    for i in range(rows):
        for j in range(i + 1):
            dot = 0.0
            for c in range(nv):
                dot += A[i, c] * A[j, c]
            if i == j:
                dot += damping * damping
            for c in range(j):
                dot -= L[i, c] * L[j, c]
            if i == j:
                smallest, largest = min(smallest, dot), max(largest, dot)
                if not dot > 0.0 or (damping == 0.0 and smallest < WELL_CONDITIONED * largest):
                    v[:] = np.nan
                    return v
                L[i, i] = np.sqrt(dot)
            else:
                L[i, j] = dot / L[j, j]
        total = b[i]
        for c in range(i):
            total -= L[i, c] * x[c]
        x[i] = total / L[i, i]
    for i in range(rows - 1, -1, -1):
        total = x[i]
        for c in range(i + 1, rows):
            total -= L[c, i] * x[c]
        x[i] = total / L[i, i]
        for c in range(nv):
            v[c] += A[i, c] * x[i]
    return v


@njit(cache=True)
def shortfall(v: Array, J: Array, b: Array, lower: Array, upper: Array) -> float:
    """See `vectorised.shortfall`."""
    worst = -np.inf
    for i in range(len(v)):
        worst = np.maximum(worst, np.maximum(v[i] - upper[i], lower[i] - v[i]))  # keeps NaN, unlike max
    for k in range(len(b)):
        short = b[k]
        for i in range(len(v)):
            short -= J[k, i] * v[i]
        worst = np.maximum(worst, short)
    return worst


@njit(cache=True)
def tracking_shortfall(
    A: Array, b: Array, damping: float, J: Array, least: Array, lower: Array, upper: Array
) -> tuple[Array, float]:
    """See `vectorised.tracking_shortfall`."""
    v = damped_solution(A, b, damping)
    return v, shortfall(v, J, least, lower, upper)


@njit(cache=True)
def projection_cost(A: Array, regularization: float, v0: Array) -> tuple[Array, Array]:
    """See `vectorised.projection_cost`."""
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
            q[i] -= P[i, j] * v0[j]
    return P, q
