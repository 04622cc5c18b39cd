"""Kernels of backup trajectories: rows of near pairs, clearance of paths."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.bounds import velocity_bounds
from qpavoid.kernels.kinematics import update_kinematics
from qpavoid.kernels.near_pairs import place_bodies
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.rows import distance_rows
from qpavoid.problem import Array, IntArray, Mask


@compiled
def backup_rows(
    x: Any, q: Array, pairs: IntArray, influence_distance: float, moving: bool, enabled: Mask, touch: float
) -> tuple[int, int, float, float]:
    """Write velocity bounds, and the rows of the enabled pairs that are near and not in contact, less their margins.

    Args:
        x: see `velocity_bounds` and `distance_rows`.
        q: configuration (nq,).
        pairs: which pairs to consider (c,), increasing.
        influence_distance: distance below which a pair is near [m].
        moving: whether any obstacle moves.
        enabled: (m,) enabled pairs; those in contact are disabled.
        touch: distance below which a pair is in contact [m].

    Returns:
        Number of rows, number of enabled pairs in contact, and the least distance with these and without [m], at most
        `influence_distance`.
    """
    velocity_bounds(x, q)
    k = distance_rows(x, pairs, influence_distance, moving)
    n, touching, nearest, nearest_separable = 0, 0, influence_distance, influence_distance
    for i in range(k):
        if not enabled[x.near_pairs[i]]:
            continue
        x.closest[i, 0] -= x.margin[x.twist_row[x.near_pairs[i]]]
        distance, slack = x.closest[i, 0], x.distance_allowance[x.near_pairs[i]]
        nearest = np.minimum(nearest, distance + slack)  # keeps NaN, unlike min
        if not distance >= touch:
            enabled[x.near_pairs[i]] = False
            touching += 1
            continue
        nearest_separable = min(nearest_separable, distance + slack)
        if n < i:
            x.near_pairs[n], x.feedforward[n] = x.near_pairs[i], x.feedforward[i]
            for c in range(10):
                x.closest[n, c] = x.closest[i, c]
            for c in range(x.J.shape[1]):
                x.J[n, c] = x.J[i, c]
        n += 1
    return n, touching, nearest, nearest_separable


@compiled
def closes_below(closest: Array, J: Array, feedforward: Array, v: Array, span: float, distance: float) -> bool:
    """Return whether a pair is nearer than `distance` after `span`, to first order.

    Args:
        closest: distances first (k, 10) [m].
        J: velocity Jacobian of these (k, n).
        feedforward: their rates due to the obstacles (k,) [m/s].
        v: velocity (n,).
        span: time [s].
        distance: threshold [m].
    """
    for i in range(len(feedforward)):
        rate = feedforward[i]
        for c in range(len(v)):
            rate += J[i, c] * v[c]
        if closest[i, 0] + span * rate < distance:
            return True
    return False


@compiled
def max_offset(offset: Array, ramp: Array, targets: Array, dt: float) -> float:
    """Compute the largest sum over the joints of how far they are from a trajectory, on the way back to it [rad, m].

    Args:
        offset: of the configuration now (n,) [rad or m].
        ramp: velocities (k, n) of successive control steps.
        targets: velocities (>= k, n) of the trajectory.
        dt: control period [s].
    """
    sums, largest = offset.copy(), np.sum(np.abs(offset))
    for i in range(len(ramp)):
        total = 0.0
        for j in range(len(sums)):
            sums[j] += dt * (ramp[i, j] - targets[i, j])
            total += abs(sums[j])
        largest = max(largest, total)
    return largest


@compiled
def braking_travel(v: Array, dt: float, braking: Array) -> float:
    """Compute the sum of the ways of all coordinates in a control period and in braking after it [rad, m].

    Args:
        v: velocity (n,) [rad/s or m/s].
        dt: control period [s].
        braking: way on which each coordinate brakes, over the square of its speed (n,) [s²/rad or s²/m].
    """
    travel = 0.0
    for i in range(len(v)):
        travel += dt * abs(v[i]) + braking[i] * v[i] * v[i]
    return travel


@compiled
def line_clearance(
    x: Any, q: Array, spheres: Array, numbers: IntArray, states: Array, twists: Array, radii: Array, horizon: float
) -> tuple[float, float]:
    """Compute the least distance between bounding spheres of the robot at rest and of obstacles on straight lines.

    Args:
        x: memory of a control step, in which joints and the bodies that they move are placed.
        q: configuration (nq,).
        spheres: bounding sphere of each body in its frame, centre and radius (g, 4) [m].
        numbers: of the obstacles (k,); those that do not move do not count.
        states: of all obstacles (o, 18).
        twists: velocities that they keep (o, 6) [m/s, rad/s].
        radii: of their bounding spheres (o,) [m].
        horizon: time for which they go on [s].

    Returns:
        The distance, infinite without any [m]; largest speed of any point of an obstacle [m/s].
    """
    update_kinematics(x.kinematics, q)
    place_bodies(x.distances, x.joint_poses)
    joints, poses = x.distances.joints, x.distances.poses
    least, fastest, center = np.inf, 0.0, np.empty(3)
    for i in numbers:
        p, u, w, r = states[i, 9:12], twists[i, :3], twists[i, 3:], radii[i]
        square, turning = u[0] ** 2 + u[1] ** 2 + u[2] ** 2, np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
        if not (square > 0.0 or turning > 0.0):
            continue
        fastest = max(fastest, np.sqrt(square) + (turning * r if turning > 0.0 else 0.0))
        for b in range(len(joints)):
            if joints[b] < 0:
                continue
            pose, sphere, toward = poses[b], spheres[b], 0.0
            for c in range(3):
                center[c] = pose[c] * sphere[0] + pose[3 + c] * sphere[1] + pose[6 + c] * sphere[2] + pose[9 + c]
                toward += (center[c] - p[c]) * u[c]
            t = min(max(toward / square, 0.0), horizon) if square > 0.0 else 0.0
            distance = 0.0
            for c in range(3):
                distance += (p[c] + t * u[c] - center[c]) ** 2
            least = np.minimum(least, np.sqrt(distance) - r - sphere[3])
    return least, fastest


@compiled
def min_sphere_distance(paths: Array, centers: Array, radii: Array) -> float:
    """Compute the least distance between spheres along paths and spheres at rest [m]; infinite without any.

    Args:
        paths: sampled centers of the moving ones (t, o, 3) [m].
        centers: of those at rest (b, 3) [m].
        radii: sum of the two radii of each combination (o, b) [m].
    """
    least = np.inf
    for o in range(paths.shape[1]):
        for b in range(len(centers)):
            nearest = np.inf
            for t in range(len(paths)):
                x, y, z = paths[t, o, 0] - centers[b, 0], paths[t, o, 1] - centers[b, 1], paths[t, o, 2] - centers[b, 2]
                nearest = np.minimum(nearest, x * x + y * y + z * z)  # keeps NaN, unlike min
            least = np.minimum(least, np.sqrt(nearest) - radii[o, b])
    return least
