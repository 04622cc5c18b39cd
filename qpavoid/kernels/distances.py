"""Distances of convex bodies: closed forms of spheres, capsules and boxes, GJK for all others, and half-spaces.

Bodies are cores with a radius around them. Closed forms are exact, and several times as fast as an iteration: witness
points of disjoint cores are at the minimum of a convex function on a segment. Where cores meet, and for meshes, coal
computes them.
"""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.gjk import MIN_CORE_DISTANCE, core_distance
from qpavoid.kernels.packing import compiled, inlined_uncounted, uncounted
from qpavoid.kernels.support import BOX, HALF_SPACE, Shapes, support
from qpavoid.problem import Array, IntArray

BY_COAL, SPARE_BY_COAL, CLOSED_FORM, BY_GJK, TO_HALF_SPACE = range(5)
"""How the distance of a pair is computed: by coal; by coal, as what has come into a spare slot asks for it; here."""
_PARALLEL = 1e-14
"""1 - cos² of the angle below which segments count as parallel [-]: the round-off of a cosine, with some to spare."""


@compiled
def compute_distances(
    shapes: Shapes,
    poses: Array,
    bodies: IntArray,
    method: IntArray,
    pairs: IntArray,
    guesses: Array,
    results: Array,
    meeting: IntArray,
) -> int:
    """Update the results of pairs that are computed here.

    With witness points a and b of the cores, radii r and s, and the unit vector n from a to b, the distance is
    |b - a| - r - s, the witness points of the bodies are a + r n and b - s n: in penetration, too.

    Args:
        shapes: of all bodies.
        poses: their world poses, rotation by columns and translation (g, 12).
        bodies: the two bodies of each pair (m, 2).
        method: of each pair (m,).
        pairs: numbers of the pairs to update (c,).
        guesses: where the search of each pair starts (m, GUESS), in and out, see `kernels.gjk`.
        results: [distance, normal, point a, point b] (m, 10), in place.
        meeting: out (m,), the first entries: the pairs whose results are not updated, though scenes with such pairs may
            expect that: those whose cores meet, and those of spare slots that coal has to compute.

    Returns:
        Number of these.
    """
    simplex, between = np.empty((4, 10)), np.empty(12)
    return _compute_pairs(shapes, poses, bodies, method, pairs, guesses, simplex, between, results, meeting)


@uncounted
def _compute_pairs(
    shapes: Shapes, poses: Array, bodies: IntArray, method: IntArray, pairs: IntArray, guesses: Array, simplex: Array,
    between: Array, results: Array, meeting: IntArray,
) -> int:  # fmt: skip
    """Do the work of `compute_distances`, with its scratch."""
    count = 0
    for n in range(len(pairs)):
        k = pairs[n]
        how, i, j = method[k], bodies[k, 0], bodies[k, 1]
        if how != BY_COAL and not pair_distance(shapes, poses, i, j, how, guesses[k], simplex, between, results[k]):
            meeting[count] = k
            count += 1
    return count


@inlined_uncounted
def pair_distance(
    shapes: Shapes,
    poses: Array,
    i: int,
    j: int,
    how: int,
    guess: Array,
    simplex: Array,
    between: Array,
    result: Array,
) -> bool:
    """Update the result of one pair, see `compute_distances`; return False where cores meet, or coal has to do it."""
    is_apart = False
    if how == CLOSED_FORM:
        is_apart = _closed_form(shapes, poses, i, j, between, result)
    elif how == BY_GJK:
        is_apart = core_distance(shapes, poses, i, j, guess, simplex, between, result)
    elif how == TO_HALF_SPACE:
        is_apart = _to_half_space(shapes, poses, i, j, guess, result)
    if is_apart:
        _add_radii(shapes.core[i, 0], shapes.core[j, 0], result)
    return is_apart


@inlined_uncounted
def _add_radii(r: float, s: float, result: Array) -> None:
    """Turn the result of two cores into that of the bodies with these radii around them."""
    result[0] -= r + s
    for c in range(3):
        result[4 + c] += r * result[1 + c]
        result[7 + c] -= s * result[1 + c]


@inlined_uncounted
def _closed_form(shapes: Shapes, poses: Array, i: int, j: int, between: Array, result: Array) -> bool:
    """Write the result of two cores, points, segments or one of them a box; return False where they meet."""
    a, b, p, u = result[4:7], result[7:10], between[:3], between[3:6]
    core = shapes.core
    if shapes.kind[i] == BOX:
        _segment_and_box(poses[j], core[j, 3], poses[i], core[i], p, u, b, a)
    elif shapes.kind[j] == BOX:
        _segment_and_box(poses[i], core[i, 3], poses[j], core[j], p, u, a, b)
    else:
        _two_segments(poses[i], core[i, 3], poses[j], core[j, 3], a, b)
    x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    distance = np.sqrt(x * x + y * y + z * z)
    if not distance > MIN_CORE_DISTANCE:  # NaN, too
        return False
    result[0], result[1], result[2], result[3] = distance, x / distance, y / distance, z / distance
    return True


@inlined_uncounted
def _to_half_space(shapes: Shapes, poses: Array, i: int, j: int, guess: Array, result: Array) -> bool:
    """Write the result of a core and a half-space below the plane z = 0 of its pose; return False at NaN.

    The witness points are the core's deepest point, or the middle of its deepest edge or face, and its foot.
    """
    plane, body = (i, j) if shapes.kind[i] == HALF_SPACE else (j, i)
    side = 1.0 if plane == i else -1.0
    nx, ny, nz = poses[plane, 6], poses[plane, 7], poses[plane, 8]
    x = -(nx * poses[body, 0] + ny * poses[body, 1] + nz * poses[body, 2])
    y = -(nx * poses[body, 3] + ny * poses[body, 4] + nz * poses[body, 5])
    z = -(nx * poses[body, 6] + ny * poses[body, 7] + nz * poses[body, 8])
    vertex, x, y, z = support(shapes, body, int(guess[1]), x, y, z)
    guess[1] = vertex
    at, foot = (7, 4) if plane == i else (4, 7)
    distance = 0.0
    for c in range(3):
        point = poses[body, 9 + c] + poses[body, c] * x + poses[body, 3 + c] * y + poses[body, 6 + c] * z
        distance += poses[plane, 6 + c] * (point - poses[plane, 9 + c])
        result[at + c] = point
    for c in range(3):
        result[1 + c] = side * poses[plane, 6 + c]
        result[foot + c] = result[at + c] - distance * poses[plane, 6 + c]
    result[0] = distance
    return bool(abs(distance) < np.inf)


@uncounted
def _clamp(x: float, limit: float) -> float:
    """Return x within ±limit."""
    return min(max(x, -limit), limit)


@uncounted
def _two_segments(one: Array, l1: float, two: Array, l2: float, a: Array, b: Array) -> None:
    """Write the closest points of two segments along the z axes of their poses.

    Of parallel segments, these are the middle ones. With p + s u, |s| <= l1 and q + t w, |t| <= l2, the distance is
    least at the unconstrained s, clamped, then the best t for it, clamped, then the best s for that, clamped (Ericson
    2005, "Real-Time Collision Detection", 5.1.9).

    Args:
        one: pose of the first segment (12,), rotation by columns, then centre [m].
        l1: half of its length [m].
        two: pose of the second segment (12,).
        l2: half of its length [m].
        a: out (3,): point on the first segment [m].
        b: out (3,): point on the second segment [m].
    """
    cosine, along_1, along_2 = 0.0, 0.0, 0.0
    for c in range(3):
        w = one[9 + c] - two[9 + c]
        cosine += one[6 + c] * two[6 + c]
        along_1 += one[6 + c] * w
        along_2 += two[6 + c] * w
    sine2 = 1.0 - cosine * cosine
    if sine2 > _PARALLEL:
        s = _clamp((cosine * along_2 - along_1) / sine2, l1)
    else:
        s = 0.5 * (_clamp(-along_1 - l2, l1) + _clamp(-along_1 + l2, l1))
    t = _clamp(cosine * s + along_2, l2)
    s = _clamp(cosine * t - along_1, l1)
    for c in range(3):
        a[c] = one[9 + c] + s * one[6 + c]
        b[c] = two[9 + c] + t * two[6 + c]


@uncounted
def _segment_and_box(
    segment: Array, half: float, box: Array, core: Array, p: Array, u: Array, a: Array, b: Array
) -> None:
    """Write the closest points of a segment along the z axis of its pose, and of a box.

    The squared distance of the box from a point on the segment is convex along it, and its slope is linear between the
    places where the segment passes the plane of a face. Where it is least on an interval, its middle is taken.

    Args:
        segment: pose of the segment (12,), rotation by columns, then centre [m].
        half: half of its length [m].
        box: pose of the box (12,).
        core: radius and half-sizes of the box (4,) [m].
        p: out (3,): centre of the segment in the frame of the box [m].
        u: out (3,): its direction in that frame.
        a: out (3,): point on the segment [m].
        b: out (3,): point of the box [m].
    """
    for r in range(3):
        p[r], u[r] = 0.0, 0.0
        for c in range(3):
            p[r] += box[3 * r + c] * (segment[9 + c] - box[9 + c])
            u[r] += box[3 * r + c] * segment[6 + c]
    first, last = _closest_place(p, u, core, half, False), _closest_place(p, u, core, half, True)
    s = 0.5 * (first + last)
    for c in range(3):
        a[c] = segment[9 + c] + s * segment[6 + c]
        b[c] = box[9 + c]
    for r in range(3):
        inside = _clamp(p[r] + s * u[r], core[1 + r])
        for c in range(3):
            b[c] += inside * box[3 * r + c]


@uncounted
def _closest_place(p: Array, u: Array, core: Array, half: float, last: bool) -> float:
    """Compute the first, or last, s of p + s u, |s| <= half, that is closest to a box at the origin [m].

    Args:
        p: centre of the segment in the frame of the box (3,) [m].
        u: its unit direction in that frame (3,).
        core: radius and half-sizes of the box (4,) [m].
        half: half of the segment's length [m].
        last: whether the last one is computed.
    """
    low, high = -half, half
    at_low, at_high = _slope(p, u, core, low), _slope(p, u, core, high)
    if at_low > 0.0 or (at_low == 0.0 and not last):
        return low
    if at_high < 0.0 or (at_high == 0.0 and last):
        return high
    for r in range(3):
        if u[r] == 0.0:
            continue
        for side in (-1.0, 1.0):
            s = (side * core[1 + r] - p[r]) / u[r]
            if low < s < high:
                slope = _slope(p, u, core, s)
                if slope < 0.0 or (slope == 0.0 and last):
                    low, at_low = s, slope
                else:
                    high, at_high = s, slope
    return low - at_low * (high - low) / (at_high - at_low) if at_high > at_low else low


@uncounted
def _slope(p: Array, u: Array, core: Array, s: float) -> float:
    """Compute d/ds of half the squared distance of a box from p + s u [m]."""
    slope = 0.0
    for r in range(3):
        x = p[r] + s * u[r]
        slope += u[r] * (x - _clamp(x, core[1 + r]))
    return slope
