"""Distance of two convex cores: GJK, the search for the point of their difference A - B that is closest to the origin.

Each step holds up to four points of A - B, takes the point v of their hull that is closest to the origin, and adds the
point w of A - B that is farthest towards the origin. Every v is in A - B, and v/|v| separates the cores by v·w/|v|: the
distance is between the two, so that a result is proven by their difference, however the search came there.

Gilbert, Johnson and Keerthi 1988, "A fast procedure for computing the distance between complex objects in
three-dimensional space". Points of last time, in the frames of their bodies, are where a search begins.
"""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import inlined_uncounted, uncounted
from qpavoid.kernels.support import Shapes, any_point, support
from qpavoid.problem import Array

MIN_CORE_DISTANCE = 1e-6
"""Distance of cores below which coal computes the pair [m]: the direction between them is lost to round-off."""
GUESS = 22
"""Numbers that a search leaves for the next one: see `core_distance`."""
_TOLERANCE = 1e-10
"""How far the bounds may be apart, relative to the distance [-]: normals are then good to 1.4e-5."""
_STALLED = 1e-8
"""The same where round-off ends the search [-], with a tenth of the coordinates: long thin triangles tilt normals."""
_ROUND_OFF = 1e-15
"""Of the bounds, relative to coordinates of the points [-]."""
_MAX_ITERATIONS = 60
"""Of one search: polytopes need 11 at most, curved shapes 10 to 20, and more where one is much larger or they touch."""


@inlined_uncounted
def core_distance(
    shapes: Shapes, poses: Array, i: int, j: int, guess: Array, simplex: Array, between: Array, result: Array
) -> bool:
    """Compute the distance of two cores, with the vector from a to b and the points that are closest.

    Args:
        shapes: with both cores.
        poses: world poses of all bodies, rotation by columns and translation (g, 12).
        i: number of body a.
        j: number of body b.
        guess: of this pair (GUESS,), in and out, zeros where there is none: how many points the search ended with, a
            vertex of a, a vertex of b, how many iterations there were, and up to three points of a and b.
        simplex: scratch (4, 10): w = a - b in the axes of a, a in its own frame, b in its own frame, weight.
        between: scratch (12,): pose of b in the frame of a.
        result: out (10,): distance, normal from a to b, point a, point b.

    Returns:
        Whether the result is proven; not where cores meet: coal is to compute these, and `result` is as it was.
    """
    _relative_pose(poses, i, j, between)
    count, u, v = int(guess[0]), int(guess[1]), int(guess[2])
    if count == 0:
        count = 1
        guess[4], guess[5], guess[6] = any_point(shapes, i)
        guess[7], guess[8], guess[9] = any_point(shapes, j)
    _restart(guess, count, between, simplex)
    _closest(simplex, count)
    guess[0] = 0.0
    low = 0.0
    for iteration in range(_MAX_ITERATIONS):
        guess[3] = iteration + 1
        count, x, y, z = _reduce(simplex, count)
        x, y, z = _upright(simplex, count, x, y, z)
        square = x * x + y * y + z * z
        length = np.sqrt(square)
        if not length > MIN_CORE_DISTANCE:  # NaN, too
            return False
        x, y, z = x / length, y / length, z / length
        u, v = _extend(shapes, i, j, u, v, between, simplex, count, -x, -y, -z)
        low = max(low, x * simplex[count, 0] + y * simplex[count, 1] + z * simplex[count, 2])
        extent = _extent(simplex, count)
        is_proven = length - low <= _TOLERANCE * length + _ROUND_OFF * extent
        if not is_proven and (not _closest(simplex, count + 1) < square or iteration == _MAX_ITERATIONS - 1):
            if not length - low <= _STALLED * (length + 0.1 * extent):
                return False
            _closest(simplex, count)
            is_proven = True
        if is_proven:
            _save(guess, count, u, v, simplex)
            _write(poses, i, simplex, count, length, x, y, z, result)
            return True
        count += 1
    return False


@inlined_uncounted
def _relative_pose(poses: Array, i: int, j: int, between: Array) -> None:
    """Write the pose of body j in the frame of body i."""
    px, py, pz = poses[j, 9] - poses[i, 9], poses[j, 10] - poses[i, 10], poses[j, 11] - poses[i, 11]
    for r in range(3):
        x, y, z = poses[i, 3 * r], poses[i, 3 * r + 1], poses[i, 3 * r + 2]
        between[9 + r] = x * px + y * py + z * pz
        for c in range(3):
            between[3 * c + r] = x * poses[j, 3 * c] + y * poses[j, 3 * c + 1] + z * poses[j, 3 * c + 2]


@inlined_uncounted
def _extend(
    shapes: Shapes, i: int, j: int, u: int, v: int, between: Array, simplex: Array, n: int, x: float, y: float, z: float
) -> tuple[int, int]:
    """Write row n of the simplex: the point of A - B farthest along (x, y, z), a unit vector in the axes of a."""
    u, ax, ay, az = support(shapes, i, u, x, y, z)
    bx = -(between[0] * x + between[1] * y + between[2] * z)
    by = -(between[3] * x + between[4] * y + between[5] * z)
    bz = -(between[6] * x + between[7] * y + between[8] * z)
    v, bx, by, bz = support(shapes, j, v, bx, by, bz)
    simplex[n, 3], simplex[n, 4], simplex[n, 5] = ax, ay, az
    simplex[n, 6], simplex[n, 7], simplex[n, 8] = bx, by, bz
    _subtract(simplex, n, between)
    return u, v


@inlined_uncounted
def _subtract(simplex: Array, n: int, between: Array) -> None:
    """Write a - b of row n of the simplex, in the axes of a."""
    x, y, z = simplex[n, 6], simplex[n, 7], simplex[n, 8]
    for c in range(3):
        b = between[9 + c] + between[c] * x + between[3 + c] * y + between[6 + c] * z
        simplex[n, c] = simplex[n, 3 + c] - b


@inlined_uncounted
def _restart(guess: Array, count: int, between: Array, simplex: Array) -> None:
    """Write the simplex with the points where the last search ended."""
    for k in range(count):
        for c in range(6):
            simplex[k, 3 + c] = guess[4 + 6 * k + c]
        _subtract(simplex, k, between)


@inlined_uncounted
def _save(guess: Array, count: int, u: int, v: int, simplex: Array) -> None:
    """Write what the next search starts from."""
    guess[0], guess[1], guess[2] = count, u, v
    for k in range(count):
        for c in range(6):
            guess[4 + 6 * k + c] = simplex[k, 3 + c]


@inlined_uncounted
def _reduce(simplex: Array, count: int) -> tuple[int, float, float, float]:
    """Drop the points without a weight; return how many are left, and their weighted mean."""
    n, x, y, z = 0, 0.0, 0.0, 0.0
    for k in range(count):
        weight = simplex[k, 9]
        if weight > 0.0:
            x, y, z = x + weight * simplex[k, 0], y + weight * simplex[k, 1], z + weight * simplex[k, 2]
            if n < k:
                for c in range(10):
                    simplex[n, c] = simplex[k, c]
            n += 1
    return n, x, y, z


@inlined_uncounted
def _upright(s: Array, count: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the mean of points with its component along their edge, or in their plane, taken off.

    It has none but round-off, which is large beside a short mean of long points, and tilts it.
    """
    square = x * x + y * y + z * z
    if count < 2:
        return x, y, z
    ux, uy, uz = s[1, 0] - s[0, 0], s[1, 1] - s[0, 1], s[1, 2] - s[0, 2]
    uu = ux * ux + uy * uy + uz * uz
    if count == 2:
        if uu > square:
            t = (x * ux + y * uy + z * uz) / uu
            x, y, z = x - t * ux, y - t * uy, z - t * uz
        return x, y, z
    vx, vy, vz = s[2, 0] - s[0, 0], s[2, 1] - s[0, 1], s[2, 2] - s[0, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    nn = nx * nx + ny * ny + nz * nz
    if nn > square * max(uu, vx * vx + vy * vy + vz * vz):
        t = (x * nx + y * ny + z * nz) / nn
        x, y, z = t * nx, t * ny, t * nz
    return x, y, z


@inlined_uncounted
def _extent(s: Array, n: int) -> float:
    """Return how large the coordinates of a point of the simplex, and of what it was made of, are [m]."""
    extent = 0.0
    for c in range(6):
        extent += abs(s[n, c])
    return extent


@inlined_uncounted
def _write(
    poses: Array, i: int, simplex: Array, count: int, length: float, x: float, y: float, z: float, result: Array
) -> None:
    """Write the result in the world: the distance is `length`, the unit vector (x, y, z) from b to a in axes of a."""
    ax, ay, az = 0.0, 0.0, 0.0
    for k in range(count):
        weight = simplex[k, 9]
        ax, ay, az = ax + weight * simplex[k, 3], ay + weight * simplex[k, 4], az + weight * simplex[k, 5]
    result[0] = length
    for r in range(3):
        normal = -(poses[i, r] * x + poses[i, 3 + r] * y + poses[i, 6 + r] * z)
        point = poses[i, 9 + r] + poses[i, r] * ax + poses[i, 3 + r] * ay + poses[i, 6 + r] * az
        result[1 + r], result[4 + r], result[7 + r] = normal, point, point + length * normal


@uncounted
def _closest(s: Array, count: int) -> float:
    """Write the weights of the point of a simplex that is closest to the origin; return its squared distance.

    It is 0 inside a tetrahedron, with weights of 0. The last point is new, and the hull of the others has its closest
    point inside: of a tetrahedron, that face is not the closest one.
    """
    if count == 1:
        s[0, 9] = 1.0
        return s[0, 0] ** 2 + s[0, 1] ** 2 + s[0, 2] ** 2
    if count == 2:
        square, s[0, 9], s[1, 9] = _segment(s, 0, 1)
        return square
    best, last = np.inf, count - 1
    s[0, 9], s[1, 9], s[2, 9], s[last, 9] = 0.0, 0.0, 0.0, 0.0
    for other in range(0 if count == 4 else 2, 3):  # of a triangle, i and j are 0 and 1
        i, j = (other + 1) % 3, (other + 2) % 3
        if count == 3 or _is_beyond(s, i, j, last, other):
            square, a, b, c = _triangle(s, i, j, last)
            if square < best:
                best, s[other, 9], s[i, 9], s[j, 9], s[last, 9] = square, 0.0, a, b, c
    return best if best < np.inf else 0.0


@inlined_uncounted
def _is_beyond(s: Array, i: int, j: int, k: int, other: int) -> bool:
    """Return whether the origin is not on the side of a face on which the fourth point is."""
    ux, uy, uz = s[j, 0] - s[i, 0], s[j, 1] - s[i, 1], s[j, 2] - s[i, 2]
    vx, vy, vz = s[k, 0] - s[i, 0], s[k, 1] - s[i, 1], s[k, 2] - s[i, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    origin = -(nx * s[i, 0] + ny * s[i, 1] + nz * s[i, 2])
    there = nx * (s[other, 0] - s[i, 0]) + ny * (s[other, 1] - s[i, 1]) + nz * (s[other, 2] - s[i, 2])
    return not origin * there > 0.0


@inlined_uncounted
def _segment(s: Array, i: int, j: int) -> tuple[float, float, float]:
    """Return the squared distance of a segment from the origin, and the weights of its ends."""
    ux, uy, uz = s[j, 0] - s[i, 0], s[j, 1] - s[i, 1], s[j, 2] - s[i, 2]
    square = ux * ux + uy * uy + uz * uz
    along = -(s[i, 0] * ux + s[i, 1] * uy + s[i, 2] * uz)
    t = min(max(along / square, 0.0), 1.0) if square > 0.0 else 0.0
    x, y, z = s[i, 0] + t * ux, s[i, 1] + t * uy, s[i, 2] + t * uz
    return x * x + y * y + z * z, 1.0 - t, t


@inlined_uncounted
def _triangle(s: Array, i: int, j: int, k: int) -> tuple[float, float, float, float]:
    """Return the squared distance of a triangle from the origin, and the weights of its corners.

    Those of the point in its plane are (a, b, c)/n²; where some are not positive, the closest point is on the edge
    across from one of these.
    """
    ux, uy, uz = s[j, 0] - s[i, 0], s[j, 1] - s[i, 1], s[j, 2] - s[i, 2]
    vx, vy, vz = s[k, 0] - s[i, 0], s[k, 1] - s[i, 1], s[k, 2] - s[i, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    square = nx * nx + ny * ny + nz * nz
    b = s[i, 0] * (ny * vz - nz * vy) + s[i, 1] * (nz * vx - nx * vz) + s[i, 2] * (nx * vy - ny * vx)
    c = s[i, 0] * (uy * nz - uz * ny) + s[i, 1] * (uz * nx - ux * nz) + s[i, 2] * (ux * ny - uy * nx)
    a = square - b - c
    if a > 0.0 and b > 0.0 and c > 0.0:
        height = nx * s[i, 0] + ny * s[i, 1] + nz * s[i, 2]
        return height * height / square, a / square, b / square, c / square
    best, wa, wb, wc = np.inf, 0.0, 0.0, 0.0
    if not a > 0.0:
        best, wb, wc = _segment(s, j, k)
    if not b > 0.0:
        distance, one, two = _segment(s, i, k)
        if distance < best:
            best, wa, wb, wc = distance, one, 0.0, two
    if not c > 0.0:
        distance, one, two = _segment(s, i, j)
        if distance < best:
            best, wa, wb, wc = distance, one, two, 0.0
    return best, wa, wb, wc
