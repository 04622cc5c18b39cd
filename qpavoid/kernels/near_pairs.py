"""Distances of the pairs that are near: poses of bodies and obstacles, bounding spheres, then witness points.

A *state* of an obstacle is a row of 18, see `qpavoid.kernels.obstacles`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.kernels.broadphase import candidates
from qpavoid.kernels.distances import SPARE_BY_COAL, compute_distances
from qpavoid.kernels.kinematics import compose
from qpavoid.kernels.packing import compiled, inlined
from qpavoid.kernels.support import Shapes
from qpavoid.problem import Array, IntArray, Mask


class DistanceArrays(NamedTuple):
    """Memory of the distances of m pairs among g bodies: those of the robot, c that can be attached to it, all others.

    They belong to o obstacles, the first c of which are those that can be attached.
    """

    # --- shared by all distances of a controller, changed where an object is attached or released
    joints: IntArray
    """(b + c,) joint that moves each body; 0 for none, -1 of an obstacle that is not attached."""
    placements: Array
    """(b + c, 12) its pose in that joint: rotation by columns, then position."""
    twist_row: IntArray
    """(m,) row of `twists` that moves each pair."""
    enabled: Mask
    """(m,) pairs that are computed at all."""
    ignored: Mask
    """(m,) pairs that are computed, but are to get no row."""
    # --- constant
    pairs: IntArray
    """(m, 2) the two bodies of each pair."""
    pair_of: IntArray
    """(b + c, g) number of the pair of two bodies, -1 where there is none; increasing along the rows."""
    local: Array
    """(g, 3) centre of each body's bounding sphere in its frame [m]."""
    shapes: Shapes
    """Shape of each body, see `kernels.support`."""
    method: IntArray
    """(m,) how the distance of each pair is computed, see `kernels.distances`."""
    first: IntArray
    """(o + 1,) first body of each obstacle, which has those up to the next one's."""
    is_cloud: Mask
    """(o,) obstacles whose bodies are placed one by one, as they stand for points."""
    bounding_radius: Array
    """(o,) distance from each obstacle's origin to its farthest point, 0 of a half-space that does not turn [m]."""
    # --- of one configuration
    max_square: Array
    """(b + c, g) squared distance of the centres up to which two bodies are near [m²]; negative without a pair."""
    states: Array
    """(o, 18) state of each obstacle."""
    twists: Array
    """(o + 1 + c, 6) twists at the world's origin, linear before angular [m/s, rad/s]; row o stays zero, the last c are
    the negative twists of the first c: of pairs that they come first in."""
    margin: Array
    """(o + 1 + c,) taken off the distances to each obstacle, in the order of `twists` but never negative [m]."""
    speeds: Array
    """(J + o,) largest speed of any point of a joint's bodies and of each obstacle [m/s]; here, of obstacles."""
    poses: Array
    """(g, 12) pose of each body in the world."""
    centers: Array
    """(g, 5) centres of the bounding spheres in the world, as rows [c, 1, -|c|²] [m]."""
    radius: Array
    """(g,) of the bounding spheres [m]."""
    travels: Array
    """(g,) bound on the path that any point of each body has travelled so far [m]."""
    limits: Array
    """(m,) distance of each pair when it was computed plus the travels of its bodies until then: less those until now,
    it bounds the distance from below; -∞ of pairs that coal computes, and of those that are not known [m]."""
    guesses: Array
    """(m, GUESS) where the search for the witness points of each pair starts, see `kernels.gjk`."""
    near: IntArray
    """(m,) out, the first entries: pairs whose bounding spheres are near, increasing."""
    rows: IntArray
    """(m,) out, the first entries: those of them that are not ignored."""
    meeting: IntArray
    """(m,) out, the first entries: pairs whose cores meet, and those of spare slots that coal has to compute."""
    counts: IntArray
    """(3,) out: how many entries of near, rows and meeting count."""
    results: Array
    """(m, 10) out: distance, normal, point a, point b of the near pairs."""


@compiled
def place_bodies(x: DistanceArrays, joint_poses: Array) -> None:
    """Write the poses of all bodies that joints move, their sphere centres and travels.

    Args:
        x: reads joints and placements; writes poses, centers and travels.
        joint_poses: (J, 12).
    """
    pose = np.empty(12)
    for i in range(len(x.joints)):
        if x.joints[i] >= 0:
            compose(joint_poses[x.joints[i]], x.placements[i], pose)
            place_body(x, i, pose)


@compiled
def near_pairs(x: DistanceArrays, beyond: float) -> tuple[int, int, int]:
    """Find the near pairs, and write the distances of those that coal is not needed for.

    No distance changes by more than its two bodies travel: pairs that are certainly beyond a distance, since they were
    computed last, are left out.

    Args:
        x: reads poses, margin and travels; writes centers of movable bodies, near, rows, meeting, counts, results and
            limits.
        beyond: that distance, less the margin [m]; infinite to leave none out.

    Returns:
        `counts`.
    """
    near, count, rows = candidate_pairs(x), 0, 0
    for n in range(near):
        k = x.near[n]
        if not least_distance(x, k) - x.margin[x.twist_row[k]] >= beyond:  # NaN, too
            x.near[count] = k
            count += 1
            if not x.ignored[k]:
                x.rows[rows] = k
                rows += 1
    meeting = measure_pairs(x, x.near[:count])
    x.counts[0], x.counts[1], x.counts[2] = count, rows, meeting
    return count, rows, meeting


@compiled
def candidate_pairs(x: DistanceArrays) -> int:
    """Write the pairs whose bounding spheres are near into `near`; return how many there are."""
    bodies = len(x.joints)
    while bodies > 0 and x.joints[bodies - 1] < 0:  # from there on, both bodies of each pair are obstacles
        bodies -= 1
    return candidates(x.poses, x.local, x.centers, x.max_square[:bodies], x.pair_of[:bodies], x.enabled, x.near)


@inlined
def least_distance(x: DistanceArrays, k: int) -> float:
    """Bound the distance of pair k from below by where its bodies have been since it was computed [m]."""
    return x.limits[k] - x.travels[x.pairs[k, 0]] - x.travels[x.pairs[k, 1]]


@compiled
def measure_pairs(x: DistanceArrays, pairs: IntArray) -> int:
    """Write results and limits of some pairs (k,), and those of them that coal has to compute; return how many."""
    meeting = compute_distances(x.shapes, x.poses, x.pairs, x.method, pairs, x.guesses, x.results, x.meeting)
    for k in pairs:
        if x.method[k] > SPARE_BY_COAL:
            x.limits[k] = x.results[k, 0] + x.travels[x.pairs[k, 0]] + x.travels[x.pairs[k, 1]]
    for k in x.meeting[:meeting]:
        x.limits[k] = -np.inf
    return meeting


@compiled
def place_obstacles(x: DistanceArrays, numbers: IntArray, states: Array, margin: Array) -> tuple[int, bool]:
    """Write the states of some obstacles, with twists, speeds, poses and sphere centres.

    The twist at the world's origin is [v - ω × p, ω]; the largest speed of any point is |v| + |ω| R with the bounding
    radius R.

    Args:
        x: overwritten; not changed where a number is NaN or infinite.
        numbers: of the obstacles (k,): all that ever had another state than at first.
        states: of all obstacles (o, 18); rows `numbers` are read.
        margin: taken off the distances to each obstacle (o,) [m]; entries `numbers` are read.

    Returns:
        Number of the first obstacle with NaN or infinity, -1 where there is none; whether any has a velocity or a
        margin.
    """
    obstacles, moving = len(x.states), False
    negative, joints = len(x.twists) - obstacles - 1, len(x.speeds) - obstacles
    for i in numbers:
        total = 0.0
        for c in range(18):
            total += states[i, c]
        if not abs(total) < np.inf:  # isfinite does not survive the reordering of sums
            return i, True
    for i in numbers:
        state, twist = states[i], x.twists[i]
        for c in range(18):
            x.states[i, c] = state[c]
        px, py, pz = state[9], state[10], state[11]
        vx, vy, vz, wx, wy, wz = state[12], state[13], state[14], state[15], state[16], state[17]
        twist[0], twist[1], twist[2] = vx - wy * pz + wz * py, vy - wz * px + wx * pz, vz - wx * py + wy * px
        twist[3], twist[4], twist[5] = wx, wy, wz
        x.margin[i] = margin[i]
        if i < negative:
            x.margin[obstacles + 1 + i] = margin[i]
            for c in range(6):
                x.twists[obstacles + 1 + i, c] = -twist[c]
        speed, turning = np.sqrt(vx * vx + vy * vy + vz * vz), np.sqrt(wx * wx + wy * wy + wz * wz)
        x.speeds[joints + i] = speed + turning * x.bounding_radius[i]
        moving = moving or speed > 0.0 or turning > 0.0 or margin[i] != 0.0
        if not x.is_cloud[i]:
            for g in range(x.first[i], x.first[i + 1]):
                place_body(x, g, state)
    return -1, moving


@compiled
def place_body(x: DistanceArrays, g: int, pose: Array) -> None:
    """Write pose and sphere centre of a body, and add to its travel what no point of it exceeds.

    With ‖δR‖ r for points at r from the centre; of a rotation, the Frobenius norm is √2 times that.

    Args:
        x: writes poses, centers and travels.
        g: number of the body.
        pose: new pose, the first entries (>= 12,).
    """
    shift, turned, length = 0.0, 0.0, 0.0
    for c in range(9):
        turned += (pose[c] - x.poses[g, c]) ** 2
    for c in range(12):
        x.poses[g, c] = pose[c]
    for r in range(3):
        center = pose[r] * x.local[g, 0] + pose[3 + r] * x.local[g, 1] + pose[6 + r] * x.local[g, 2] + pose[9 + r]
        shift += (center - x.centers[g, r]) ** 2
        length += center * center
        x.centers[g, r] = center
    x.centers[g, 4] = -length
    travel = np.sqrt(shift)
    if turned > 0.0:  # radii may be infinite
        travel += np.sqrt(0.5 * turned) * x.radius[g]
    x.travels[g] += travel
