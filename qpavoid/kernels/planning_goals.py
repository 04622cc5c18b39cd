"""Inverse kinematics for a planner: clear configurations at which frames are where they should be."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.cholesky import factorise, solve_factored
from qpavoid.kernels.kinematics import compose, update_kinematics
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.planning import is_clear
from qpavoid.kernels.planning_tree import draw, travel_between
from qpavoid.kernels.rotation import rotation_vector
from qpavoid.problem import Array, IntArray, Mask

_rotation_vector = compiled(rotation_vector)
_STEPS = 60
"""Steps of one search, at most: most need 5 to 20."""
_MAX_STEP = 0.4
"""Largest change of a coordinate in a step [rad or m]: the rows are of first order."""
_DAMPING, _LEAST_DAMPING = 0.05, 1e-6
"""Damping of a step: relative to the squared error, so that the last steps converge quadratically, and the least."""
_SAME = 0.05
"""Travel below which two configurations count as one goal, by the metric of the trees [m]."""


class FrameTargets(NamedTuple):
    """Where f frames should be, in the axes of other frames or of the world."""

    base: IntArray
    """(f,) row of the frame whose axes count, among all frames; -1 for the world."""
    pose: Array
    """(f, 12) rotation by columns, then position [m]."""
    has_position: Mask
    """(f,) whether the position counts."""
    has_rotation: Mask
    """(f,) whether the orientation counts."""
    rows: int
    """Number of the rows: three for each position and each orientation that counts."""


@compiled
def _world_pose(x: Any, targets: FrameTargets, f: int, pose: Array) -> None:
    """Write where frame f should be in the world (12,)."""
    if targets.base[f] < 0:
        for c in range(12):
            pose[c] = targets.pose[f, c]
    else:
        compose(x.frames.frame_poses[targets.base[f]], targets.pose[f], pose)


@compiled
def _rows(x: Any, targets: FrameTargets, J: Array, errors: Array) -> tuple[float, float]:
    """Write Jacobian (r, n) and errors (r,) of the targets at the last kinematics.

    A frame at p that should be at s on another frame has the error s - p, which changes by the velocity of the point s
    of the other one minus that of p. The rotation vector of R_s Rᵀ changes by the difference of the angular velocities.

    Returns:
        Largest distance [m], and largest angle [rad].
    """
    d, pose, r = x.frames, np.empty(12), 0
    J[:] = 0.0
    R, distance, angle = np.empty((3, 3)), 0.0, 0.0
    for f in range(len(targets.base)):
        _world_pose(x, targets, f, pose)
        frame = d.frame_poses[f]
        if targets.has_position[f]:
            square = 0.0
            for i in range(3):
                errors[r + i] = pose[9 + i] - frame[9 + i]
                square += errors[r + i] ** 2
            for c in range(len(x.columns)):
                here, there = x.frame_support[f, c], x.frame_support[targets.base[f], c]
                for i in range(3):
                    j, k = (i + 1) % 3, (i + 2) % 3
                    v = d.J[3 + j, c] * frame[9 + k] - d.J[3 + k, c] * frame[9 + j] + d.J[i, c]
                    w = d.J[3 + j, c] * pose[9 + k] - d.J[3 + k, c] * pose[9 + j] + d.J[i, c]
                    J[r + i, x.columns[c]] += here * v - there * w
            distance, r = max(distance, np.sqrt(square)), r + 3
        if targets.has_rotation[f]:
            for i in range(3):
                for j in range(3):
                    R[i, j] = pose[i] * frame[j] + pose[3 + i] * frame[3 + j] + pose[6 + i] * frame[6 + j]
            turn = _rotation_vector(R)
            for i in range(3):
                errors[r + i] = turn[i]
                for c in range(len(x.columns)):
                    support = x.frame_support[f, c] - x.frame_support[targets.base[f], c]
                    J[r + i, x.columns[c]] += support * d.J[3 + i, c]
            angle, r = max(angle, np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)), r + 3
    return distance, angle


@compiled
def attain(x: Any, targets: FrameTargets, tolerance: float, q: Array) -> bool:
    """Move coordinates q (n,) to where the targets are attained, within their ranges; return False if they are not.

    Damped least squares; a coordinate at an end of its range that a step would lead beyond it is left out of the step.

    Args:
        x: memory of the plan, see `PlanningArrays`.
        targets: what is to be attained.
        tolerance: distance up to which they are [m]; of angles, ten times as many radians.
        q: in and out.
    """
    n, rows = len(q), targets.rows
    J, errors, y = np.empty((rows, n)), np.empty(rows), np.empty(rows)
    M, L, step, is_free = np.empty((rows, rows)), np.empty((rows, rows)), np.empty(n), np.empty(n, np.bool_)
    for _ in range(_STEPS):
        update_kinematics(x.frames, q)
        distance, angle = _rows(x, targets, J, errors)
        if distance <= tolerance and angle <= 10.0 * tolerance:
            return True
        square = 0.0
        for r in range(rows):
            square += errors[r] ** 2
        damping = _DAMPING * min(square, 1.0) + _LEAST_DAMPING
        is_free[:] = True
        for _ in range(3):
            for r in range(rows):
                for c in range(r + 1):
                    total = damping if r == c else 0.0
                    for i in range(n):
                        if is_free[i]:
                            total += J[r, i] * J[c, i]
                    M[r, c] = total
            factorise(M, L, rows)
            solve_factored(L, errors, y, rows)
            is_limited, largest = False, 0.0
            for i in range(n):
                step[i] = 0.0
                if is_free[i]:
                    for r in range(rows):
                        step[i] += J[r, i] * y[r]
                    beyond = (q[i] >= x.upper[i] and step[i] > 0.0) or (q[i] <= x.lower[i] and step[i] < 0.0)
                    if beyond:
                        is_free[i], is_limited, step[i] = False, True, 0.0
                largest = max(largest, abs(step[i]))
            if not is_limited:
                break
        if not largest > 1e-9:  # NaN, too: no step is left
            return False
        scale = min(1.0, _MAX_STEP / largest)
        for i in range(n):
            q[i] = min(max(q[i] + scale * step[i], x.lower[i]), x.upper[i])
    return False


@compiled
def clear_goals(
    x: Any,
    targets: FrameTargets,
    near: Array,
    t: float,
    need: Array,
    tolerance: float,
    most: int,
    seed: int,
    attained: Array,
    counts: IntArray,
) -> Array:
    """Find configurations that attain some targets and are clear.

    Searches start at a configuration, then at random ones, farther and farther from it.

    Args:
        x: memory of the plan, see `PlanningArrays`.
        targets: what is to be attained.
        near: where the first search starts (n,).
        t: time of the goals [s].
        need: distance that each pair needs (k,) [m].
        tolerance: see `attain`.
        most: number of goals after which no more are looked for.
        seed: of the draws.
        attained: results of all searches for these targets (s, n), clear or not; s is how many are made.
        counts: how many searches were made, and how many attained the targets (2,), in and out.

    Returns:
        Goals (g, n), the one next to `near` first.
    """
    n, count, number = len(near), 0, 0
    goals, travel = np.empty((most, n)), np.empty(most)
    while count < most:
        if number == counts[1] and not _search_on(x, targets, near, tolerance, seed, attained, counts):
            break
        q = attained[number]
        number += 1
        is_new = is_clear(x, q, t, need)
        for k in range(count):
            is_new = is_new and travel_between(x, q, goals[k]) > _SAME
        if is_new:
            goals[count], travel[count] = q, travel_between(x, q, near)
            count += 1
    order = np.argsort(travel[:count])
    return goals[:count][order]


@compiled
def _search_on(
    x: Any, targets: FrameTargets, near: Array, tolerance: float, seed: int, attained: Array, counts: IntArray
) -> bool:
    """Append one more configuration that attains the targets; return False once all searches are made."""
    n, tries = len(near), len(attained)
    while counts[0] < tries:
        s, q = np.sqrt(counts[0] / tries), attained[counts[1]]
        for i in range(n):
            u = draw(seed, counts[0] * n + i)
            q[i] = near[i] + s * (x.lower[i] + u * (x.upper[i] - x.lower[i]) - near[i])
        counts[0] += 1
        if attain(x, targets, tolerance, q):
            counts[1] += 1
            return True
    return False
