"""Distances of spheres, capsules and boxes in closed form: exact, and several times as fast as an iteration.

Bodies are cores with a radius around them: points and segments, or boxes. Of cores that are apart, the closest points
are those of a convex function on a segment; where cores meet, and for all other shapes, coal is asked.
"""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray, Mask

APART = 1e-6
"""Distance below which cores are left to coal [m]: the direction between them is lost to round-off."""
_PARALLEL = 1e-14
"""1 - cos² of the angle below which segments count as parallel [-]."""


@compiled
def closed_forms(
    poses: Array, cores: Array, bodies: IntArray, known: Mask, pairs: IntArray, results: Array, left: IntArray
) -> int:
    """Brings the results of pairs that have a closed form up to date.

    Args:
        poses: world poses of all bodies, rotation by columns and translation (g, 12).
        cores: radius, and half-sizes of the core along the axes of each body (g, 4), see `geometry.cores` [m].
        bodies: the two bodies of each pair (m, 2).
        known: which pairs have a closed form (m,).
        pairs: which ones to look at (c,).
        results: [distance, normal, point a, point b] (m, 10), in place.
        left: overwritten with the pairs whose cores meet (m,).

    Returns:
        How many those are.
    """
    a, b, apart = np.empty(3), np.empty(3), np.empty(3)
    count = 0
    for k in pairs:
        if not known[k]:
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
            apart[c] = b[c] - a[c]
            square += apart[c] * apart[c]
        distance = np.sqrt(square)
        if not distance > APART:  # NaN, too
            left[count] = k
            count += 1
            continue
        r, s = cores[i, 0], cores[j, 0]
        result = results[k]
        result[0] = distance - (r + s)
        for c in range(3):
            n = apart[c] / distance
            result[1 + c], result[4 + c], result[7 + c] = n, a[c] + r * n, b[c] - s * n
    return count


@compiled
def _is_box(core: Array) -> bool:
    return core[1] > 0.0


@compiled
def _clamp(x: float, most: float) -> float:
    return min(max(x, -most), most)


@compiled
def _two_segments(one: Array, l1: float, two: Array, l2: float, a: Array, b: Array) -> None:
    """Closest points of two segments ±l along the z axes of their poses (12,); the middle ones, where they are parallel
    and there are many.
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
    """Closest points of a segment ±half along the z axis of its pose (12,), and of a box (12,) with half-sizes.

    The squared distance of the box from a point on the segment is convex along it, and its slope is a line between the
    places where the segment passes a plane of a face; the middle of the places where it is least, if it is so on a
    stretch.
    """
    p, u = np.empty(3), np.empty(3)
    for r in range(3):
        p[r], u[r] = 0.0, 0.0
        for c in range(3):
            p[r] += box[3 * r + c] * (segment[9 + c] - box[9 + c])
            u[r] += box[3 * r + c] * segment[6 + c]
    first, last = _least(p, u, core, half, False), _least(p, u, core, half, True)
    s = 0.5 * (first + last)
    for c in range(3):
        a[c] = segment[9 + c] + s * segment[6 + c]
        b[c] = box[9 + c]
    for r in range(3):
        inside = _clamp(p[r] + s * u[r], core[1 + r])
        for c in range(3):
            b[c] += inside * box[3 * r + c]


@compiled
def _least(p: Array, u: Array, core: Array, half: float, last: bool) -> float:
    """The first, or last, place on p + s u, |s| <= half, that is closest to a box."""
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
    """Of half the squared distance of a box from p + s u, with s."""
    slope = 0.0
    for r in range(3):
        x = p[r] + s * u[r]
        slope += u[r] * (x - _clamp(x, core[1 + r]))
    return slope
