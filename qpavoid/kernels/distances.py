"""Distances of spheres, capsules and boxes in closed form: exact, and several times as fast as an iteration.

Bodies are cores with a radius around them: points and segments, or boxes. Of disjoint cores, the witness points are at
the minimum of a convex function on a segment; where cores meet, and for all other shapes, coal computes them.
"""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray

BY_COAL, CLOSED_FORM, SPARE_BY_COAL = range(3)
"""How the distance of a pair is computed: by coal; here; by coal, as what has come into a spare slot asks for it."""
MIN_CORE_DISTANCE = 1e-6
"""Distance of cores below which coal computes the pair [m]: the direction between them is lost to round-off."""
_PARALLEL = 1e-14
"""1 - cos² of the angle below which segments count as parallel [-]: the round-off of a cosine, with some to spare."""


@compiled
def closed_forms(
    poses: Array,
    cores: Array,
    bodies: IntArray,
    method: IntArray,
    pairs: IntArray,
    results: Array,
    meeting: IntArray,
) -> int:
    """Update the results of pairs that have a closed form.

    With witness points a and b of the cores, radii r and s, and the unit vector n from a to b, the distance is
    |b - a| - r - s, the witness points of the bodies are a + r n and b - s n: in penetration, too.

    Args:
        poses: world poses of all bodies, rotation by columns and translation (g, 12).
        cores: radius, and half-sizes of the core along the axes of each body (g, 4), see `geometry.cores` [m].
        bodies: the two bodies of each pair (m, 2).
        method: BY_COAL, CLOSED_FORM or SPARE_BY_COAL, of each pair (m,).
        pairs: numbers of the pairs to update (c,).
        results: [distance, normal, point a, point b] (m, 10), in place.
        meeting: out (m,), the first entries: the pairs whose results are not updated, though scenes with such pairs may
            expect that: those whose cores meet, and those of spare slots that coal has to compute.

    Returns:
        Number of these.
    """
    a, b, separation = np.empty(3), np.empty(3), np.empty(3)
    count = 0
    for k in pairs:
        if method[k] != CLOSED_FORM:
            if method[k] == SPARE_BY_COAL:
                meeting[count] = k
                count += 1
            continue
        i, j = bodies[k, 0], bodies[k, 1]
        if _is_box(cores[i]):
            _segment_and_box(poses[j], cores[j, 3], poses[i], cores[i], b, a)
        elif _is_box(cores[j]):
            _segment_and_box(poses[i], cores[i, 3], poses[j], cores[j], a, b)
        else:
            _two_segments(poses[i], cores[i, 3], poses[j], cores[j, 3], a, b)
        square = 0.0
        for c in range(3):
            separation[c] = b[c] - a[c]
            square += separation[c] * separation[c]
        distance = np.sqrt(square)
        if not distance > MIN_CORE_DISTANCE:  # NaN, too
            meeting[count] = k
            count += 1
            continue
        r, s = cores[i, 0], cores[j, 0]
        result = results[k]
        result[0] = distance - (r + s)
        for c in range(3):
            n = separation[c] / distance
            result[1 + c], result[4 + c], result[7 + c] = n, a[c] + r * n, b[c] - s * n
    return count


@compiled
def _is_box(core: Array) -> bool:
    """Return True if a core [radius, half-sizes] (4,) is a box, not a point or a segment along z."""
    return core[1] > 0.0


@compiled
def _clamp(x: float, limit: float) -> float:
    """Return x within ±limit."""
    return min(max(x, -limit), limit)


@compiled
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


@compiled
def _segment_and_box(segment: Array, half: float, box: Array, core: Array, a: Array, b: Array) -> None:
    """Write the closest points of a segment along the z axis of its pose, and of a box.

    The squared distance of the box from a point on the segment is convex along it, and its slope is linear between the
    places where the segment passes the plane of a face. Where it is least on an interval, its middle is taken.

    Args:
        segment: pose of the segment (12,), rotation by columns, then centre [m].
        half: half of its length [m].
        box: pose of the box (12,).
        core: radius and half-sizes of the box (4,) [m].
        a: out (3,): point on the segment [m].
        b: out (3,): point of the box [m].
    """
    p, u = np.empty(3), np.empty(3)
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


@compiled
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


@compiled
def _slope(p: Array, u: Array, core: Array, s: float) -> float:
    """Compute d/ds of half the squared distance of a box from p + s u [m]."""
    slope = 0.0
    for r in range(3):
        x = p[r] + s * u[r]
        slope += u[r] * (x - _clamp(x, core[1 + r]))
    return slope
