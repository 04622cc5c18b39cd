"""Clearance of configurations, and of straight motions between them: what a planner asks thousands of times.

A motion is *clear* if no pair of bodies comes nearer than the distance that it needs. That is certain, not sampled: no
distance changes by more than the travel of the two bodies' fastest points, which `planning_motion` bounds. A sample
whose distances exceed what is needed covers a stretch of the motion on both sides of it. Each next sample is in
the middle of a stretch that is not covered yet (conservative advancement, in both directions), and looks at a pair only
where its bounding sphere, then its box, might come so near that the whole stretch is not covered.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.distances import TO_HALF_SPACE, pair_distance
from qpavoid.kernels.kinematics import REVOLUTE, compose, turn
from qpavoid.kernels.near_pairs import place_body
from qpavoid.kernels.packing import compiled, inlined
from qpavoid.kernels.planning_motion import begin_motion, change_within, fraction_until, write_speeds
from qpavoid.kernels.pose_fit import extrapolate
from qpavoid.problem import Array, IntArray

FINE = 5e-4
"""Distance beyond what it needs that each pair has at every sample [m]: bounds the number of samples near contact."""
_STACK = 64
"""Stretches of a motion that wait to be covered: each is less than half as long as the one before it, so that a few
would do."""


class PlanningArrays(NamedTuple):
    """Memory of a plan: n coordinates, k pairs that count, among g bodies, b of which joints move or may come to.

    A coordinate is an angle or a length of one joint. A pair of a body and a point cloud is one here.
    """

    kinematics: Any
    """Packed `KinematicsArrays` of these coordinates, without Jacobian and frames."""
    frames: Any
    """The same with the Jacobian and the f frames of the targets."""
    distances: Any
    """Packed `DistanceArrays`."""
    joint_poses: Array
    """(J, 12) what both kinematics write."""
    lower: Array
    """(n,) lower ends of the ranges that are planned in [rad or m]."""
    upper: Array
    """(n,) upper ends."""
    speed: Array
    """(n,) speed at which a coordinate moves at most [rad/s or m/s]."""
    travel: Array
    """(n,) the largest lever arm of each coordinate [m/rad or 1]: weights of the metric of the trees."""
    longest: float
    """Length of an edge of the trees at most, by that metric [m]."""
    radius: Array
    """(g,) radius of each body's bounding sphere [m]."""
    boxes: Array
    """(g, 6) box around each body in its frame: centre and half sizes [m]."""
    pairs: IntArray
    """(k,) number of each pair; of a body and a cloud, that of the body and its first proxy sphere."""
    first: IntArray
    """(k,) number of its first body."""
    second: IntArray
    """(k,) number of its second body."""
    radii: Array
    """(k,) sum of the radii of their bounding spheres [m]; infinite of half-spaces and clouds."""
    cloud: IntArray
    """(k,) number of the pair's cloud, -1 of other pairs."""
    row: IntArray
    """(k,) row of `lever`."""
    lever: Array
    """(r, n) bound on the change of a distance per unit of each coordinate [m/rad or 1]."""
    body_lever: Array
    """(g, e) bound on the travel of each body's points per unit of the coordinate of each column [m/rad or 1]."""
    factors: Array
    """(e,) turn or shift of each column per unit of its coordinate: 1, but for joints that mimic others [-]."""
    obstacle: IntArray
    """(k,) number of the obstacle in the pair, that is not attached; -1 for none."""
    point_speed: Array
    """(o + 1,) largest speed of any point of each obstacle [m/s]; 0 in the last row."""
    moving: IntArray
    """Numbers of the obstacles with a twist."""
    states: Array
    """(o, 18) states of the obstacles at the time 0 of the plan."""
    voxels: Array
    """(v, 3) centres of the voxels of all clouds in the world [m]."""
    blocks: Array
    """(w, 4) spheres around the centres of blocks of them: centre and radius [m]."""
    block_start: IntArray
    """(w + 1,) first voxel of each block, those of a cloud one after the other."""
    cloud_start: IntArray
    """(clouds + 1,) first block of each cloud."""
    columns: IntArray
    """(e,) coordinate that moves each column of the Jacobian."""
    frame_support: Array
    """(f + 1, e) 1 for the columns that move each frame; of the last row, the world, all 0."""
    simplex: Array
    """(4, 10) scratch of `kernels.gjk`."""
    between: Array
    """(12,) scratch of the same."""
    result: Array
    """(10,) distance, normal and witness points of the pair that was computed last."""
    state: Array
    """(18,) scratch: an obstacle at some time."""
    row_rates: Array
    """(r,) scratch: bound on the change of distances along the motion that is checked, by rows of `lever` [m]."""
    rates: Array
    """(k,) scratch: the same of each pair, with the motion of its obstacle [m]."""
    change: Array
    """(n,) scratch: change of the coordinates along the motion [rad or m]."""
    bends: Array
    """(g,) scratch: bound on the second derivative of each body's points along the motion [m]."""
    speeds: Array
    """(g,) scratch: largest speed of each body's points at a sample, along the whole motion as 1 [m]."""
    twists: Array
    """(J, 6) scratch: the same of each joint's origin, linear, then angular; 0 of the world."""
    stretches: Array
    """(_STACK, 2) scratch: stretches of a motion that are not covered yet."""
    near: IntArray
    """(k,) scratch: pairs that come near on the motion that is checked, the tightest of the last sample first."""
    tightest: IntArray
    """(1,) the pair that covered least of the last motion, which is looked at first in the next one."""
    q: Array
    """(n,) scratch: a sample of the motion."""
    checks: IntArray
    """(1,) configurations that were checked, counted."""


@compiled
def place(x: Any, q: Array, t: float) -> None:
    """Write the poses of all bodies at coordinates q (n,), and of moving obstacles at t [s]."""
    d = x.distances
    _place_joints(x.kinematics, q)
    joints, poses, local, centers = d.joints, d.poses, d.local, d.centers
    joint_poses, placements = x.joint_poses, d.placements
    for i in range(len(joints)):
        if joints[i] >= 0:
            compose(joint_poses[joints[i]], placements[i], poses[i])
            for r in range(3):
                rotated = poses[i, r] * local[i, 0] + poses[i, 3 + r] * local[i, 1] + poses[i, 6 + r] * local[i, 2]
                centers[i, r] = rotated + poses[i, 9 + r]
    for o in x.moving:
        for c in range(18):
            x.state[c] = x.states[o, c]
        extrapolate(x.state, t)
        for g in range(d.first[o], d.first[o + 1]):
            place_body(d, g, x.state)


@compiled
def _place_joints(kinematics: Any, q: Array) -> None:
    """Write the poses of all joints, which are angles and lengths: `update_kinematics` of these, twice as fast."""
    kind, parents, index, slides = kinematics.kind, kinematics.parents, kinematics.q_index, kinematics.slides
    multiplier, origin, placements = kinematics.multiplier, kinematics.origin, kinematics.placements
    turns, local_poses, joint_poses = kinematics.turns, kinematics.local_poses, kinematics.joint_poses
    for i in range(1, len(parents)):
        value = multiplier[i] * q[index[i]] + origin[i]
        if kind[i] == REVOLUTE:
            turn(placements[i], turns[i], np.cos(value), np.sin(value), local_poses[i])
        else:
            for c in range(12):
                local_poses[i, c] = placements[i, c]
            for r in range(3):
                local_poses[i, 9 + r] += value * slides[i, r]
        compose(joint_poses[parents[i]], local_poses[i], joint_poses[i])


@compiled
def distance_below(x: Any, k: int, limit: float) -> float:
    """Compute the distance of pair k if it is below a limit; otherwise, return the limit [m].

    -∞ where the cores of the bodies meet, which are the bodies themselves without the radius of spheres and capsules.
    """
    d, pair, i, j = x.distances, x.pairs[k], x.first[k], x.second[k]
    if x.cloud[k] < 0:
        return _bodies_below(x, d, pair, i, j, limit)
    best, size, centers, blocks, voxels = limit, d.shapes.core[j, 0], d.centers, x.blocks, x.voxels
    for block in range(x.cloud_start[x.cloud[k]], x.cloud_start[x.cloud[k] + 1]):
        span = best + x.radius[i] + size + blocks[block, 3]
        if span <= 0.0 or _square(centers, i, blocks, block) >= span * span:
            continue
        for voxel in range(x.block_start[block], x.block_start[block + 1]):
            span = best + x.radius[i] + size
            if span > 0.0 and _square(centers, i, voxels, voxel) < span * span:
                for r in range(3):
                    d.poses[j, 9 + r] = voxels[voxel, r]
                    centers[j, r] = voxels[voxel, r]
                best = _bodies_below(x, d, pair, i, j, best)
    return best


@compiled
def _bodies_below(x: Any, d: Any, pair: int, i: int, j: int, limit: float) -> float:
    """Compute the distance of bodies i and j if it is below a limit; see `distance_below`."""
    if d.method[pair] != TO_HALF_SPACE:
        centers, poses, boxes = d.centers, d.poses, x.boxes
        span = limit + x.radius[i]
        if span <= 0.0 or _square_to_box(centers, i, poses, boxes, j) >= span * span:
            return limit
        span = limit + x.radius[j]
        if span <= 0.0 or _square_to_box(centers, j, poses, boxes, i) >= span * span:
            return limit
    is_separate = pair_distance(
        d.shapes, d.poses, i, j, d.method[pair], d.guesses[pair], x.simplex, x.between, x.result
    )
    return min(x.result[0], limit) if is_separate else -np.inf


@inlined
def _square(a: Array, i: int, b: Array, j: int) -> float:
    """Compute the squared distance of the points in row i of a and row j of b, their first three entries [m²]."""
    dx, dy, dz = a[i, 0] - b[j, 0], a[i, 1] - b[j, 1], a[i, 2] - b[j, 2]
    return dx * dx + dy * dy + dz * dz


@inlined
def _square_to_box(centers: Array, i: int, poses: Array, boxes: Array, j: int) -> float:
    """Compute the squared distance of the centre of body i's sphere from the box of body j [m²]."""
    dx, dy, dz = centers[i, 0] - poses[j, 9], centers[i, 1] - poses[j, 10], centers[i, 2] - poses[j, 11]
    square = 0.0
    for r in range(3):
        along = poses[j, 3 * r] * dx + poses[j, 3 * r + 1] * dy + poses[j, 3 * r + 2] * dz - boxes[j, r]
        outside = max(abs(along) - boxes[j, 3 + r], 0.0)
        square += outside * outside
    return square


@compiled
def pair_clearances(x: Any, q: Array, t: float, limit: float, out: Array) -> None:
    """Write the distances (k,) of all pairs at coordinates q (n,) and time t [s], at most `limit` [m]."""
    place(x, q, t)
    for k in range(len(out)):
        out[k] = distance_below(x, k, limit)


@compiled
def is_clear(x: Any, q: Array, t: float, need: Array) -> bool:
    """Return True if every pair has the distance that a sample needs: need (k,) and `FINE` more."""
    place(x, q, t)
    return _covered(x, need, 0.0, _gather(x, need, 0.0)) >= 0.0


@compiled
def _gather(x: Any, need: Array, most: float) -> int:
    """Write which pairs the poses of now do not show to be clear for a fraction of the motion; return their number."""
    centers, first, second, radii = x.distances.centers, x.first, x.second, x.radii
    near, tightest, count = x.near, x.tightest[0], 0
    for k in range(len(need)):
        span = need[k] + max(change_within(x, k, most), FINE) + radii[k]
        if span > 0.0 and _square(centers, first[k], centers, second[k]) < span * span:
            near[count] = k
            if k == tightest:
                near[count], near[0] = near[0], k
            count += 1
    return count


@compiled
def _covered(x: Any, need: Array, most: float, count: int) -> float:
    """Return the fraction of the motion, at most `most`, that a sample covers on each side; -1 where it is not clear.

    Args:
        x: at the poses and speeds of the sample.
        need: distance that each pair needs (k,) [m].
        most: fraction of the motion.
        count: number of near pairs.
    """
    x.checks[0] += 1
    centers, first, second, radii, near, tightest = x.distances.centers, x.first, x.second, x.radii, x.near, -1
    for i in range(count):
        k = near[i]
        limit = need[k] + max(change_within(x, k, most), FINE)
        span = limit + radii[k]
        if span > 0.0 and _square(centers, first[k], centers, second[k]) < span * span:
            distance = distance_below(x, k, limit)
            if distance < limit:
                tightest = i
                if distance < need[k] + FINE:
                    most = -1.0
                    break
                most = min(most, fraction_until(x, k, distance - need[k]))
    if tightest >= 0:
        x.tightest[0] = near[tightest]
        near[tightest], near[0] = near[0], near[tightest]
    return most


@compiled
def is_clear_between(x: Any, a: Array, ta: float, b: Array, tb: float, need: Array) -> bool:
    """Return True if the straight motion from a to b (n,), from time ta to tb [s], is clear all along.

    Conservative: a motion on which some pair has less than `FINE` beyond what it needs (k,) may count as not clear.
    """
    n, stretches, q = len(a), x.stretches, x.q
    begin_motion(x, a, b, abs(tb - ta))
    place(x, b, tb)
    write_speeds(x)
    near = _gather(x, need, 1.0)
    end = _covered(x, need, 1.0, near)
    if end < 0.0:
        return False
    count = 1
    stretches[0, 0], stretches[0, 1] = 0.0, 1.0 - end
    while count > 0:
        count -= 1
        low, high = stretches[count, 0], stretches[count, 1]
        if high <= low:
            continue
        s = 0.5 * (low + high)
        for i in range(n):
            q[i] = a[i] + s * (b[i] - a[i])
        place(x, q, ta + s * (tb - ta))
        write_speeds(x)
        covered = _covered(x, need, s - low, near)
        if covered < 0.0 or count + 2 > _STACK:
            return False
        if covered < s - low:
            stretches[count, 0], stretches[count, 1] = low, s - covered
            stretches[count + 1, 0], stretches[count + 1, 1] = s + covered, high
            count += 2
    return True


def scratch(n: int, rows: int, pairs: int, bodies: int, joints: int) -> dict[str, Any]:
    """Return the memory of `PlanningArrays` that nothing is read from before it is written.

    Args:
        n: number of coordinates.
        rows: number of rows of `lever`.
        pairs: number of pairs that count.
        bodies: number of bodies.
        joints: number of joints, that of the world among them.
    """
    return {
        "simplex": np.empty((4, 10)),
        "between": np.empty(12),
        "result": np.empty(10),
        "state": np.empty(18),
        "row_rates": np.zeros(rows),
        "rates": np.zeros(pairs),
        "stretches": np.empty((_STACK, 2)),
        "change": np.zeros(n),
        "bends": np.zeros(bodies),
        "speeds": np.zeros(bodies),
        "twists": np.zeros((joints, 6)),
        "near": np.empty(pairs, dtype=np.intp),
        "tightest": np.full(1, -1, dtype=np.intp),
        "q": np.empty(n),
        "checks": np.zeros(1, dtype=np.intp),
    }
