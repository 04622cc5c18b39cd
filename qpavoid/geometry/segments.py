"""Distances between points, segments and capsules in closed form (paper §2, eqs. 2-7).

Every function works on arrays whose last axis holds the three coordinates [m]; the leading axes broadcast:
one pair is a call with shape (3,), m pairs are the same call with shape (m, 3). All points of one call share
one frame. Input is not searched for NaN: a NaN coordinate gives a NaN distance.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from qpavoid.problem import Array

PARALLEL = 1e-10
"""Sine of the angle [-] up to which axes count as parallel: the ends are then right to 1e-10 of a length."""

TOUCHING = 1e-10
"""Axis distance [m] up to which two axes count as intersecting: their difference has no direction left."""


class PointSegment(NamedTuple):
    """Closest point of a segment to a point."""

    distance: Array
    """Euclidean distance [m], (...)."""
    point: Array
    """Point on the segment [m], (..., 3)."""


class LineParameters(NamedTuple):
    """Where two lines come closest: at a + m (b - a) and at c + n (d - c)."""

    m: Array
    """Parameter on the line ab [-], (...)."""
    n: Array
    """Parameter on the line cd [-], (...)."""


class SegmentSegment(NamedTuple):
    """Closest points of two segments."""

    distance: Array
    """Axis distance [m], (...)."""
    point_ab: Array
    """Witness point on ab [m], (..., 3)."""
    point_cd: Array
    """Witness point on cd [m], (..., 3)."""


class CapsuleDistances(NamedTuple):
    """Signed surface distances of m pairs of capsules; point_b - point_a = distance * normal."""

    distance: Array
    """Axis distance less both radii [m], (m,); negative when the capsules overlap."""
    normal: Array
    """Unit vector from body a to body b, the gradient of the distance for a translation of b, (m, 3)."""
    point_a: Array
    """Witness point on the surface of a [m], (m, 3)."""
    point_b: Array
    """Witness point on the surface of b [m], (m, 3)."""


def point_segment(p: Array, a: Array, b: Array) -> PointSegment:
    """Find the closest point of the segment ab to p.

    Eq. 2, with the projection clamped to the segment.

    Takes points [m] of shape (..., 3). The distance contains the axial part beyond an end, which eq. 2 leaves
    out. A segment of zero length is the point a.
    """
    u = b - a
    length2 = _dot(u, u)
    t = np.divide(_dot(p - a, u), length2, out=np.zeros(np.broadcast(p, u).shape[:-1]), where=length2 > 0.0)
    point = a + np.clip(t, 0.0, 1.0)[..., None] * u
    return PointSegment(_norm(p - point), point)


def line_parameters(a: Array, b: Array, c: Array, d: Array) -> LineParameters:
    """Find the parameters m, n [-] of the closest points of the lines ab and cd (eqs. 6, 7).

    Takes points [m] of shape (..., 3). Both are NaN where they are not unique: for parallel lines and for a
    segment of zero length.
    """
    u, v = b - a, d - c
    cross = _cross(u, v)
    # Cross products, not the Gram determinant |u|²|v|² - (u·v)²: that one loses all its digits at 1e-8 rad.
    numerator = _dot(_cross(c - a, v), cross)
    skew = ~_parallel(u, v, cross)
    m = np.divide(numerator, _dot(cross, cross), out=np.full(numerator.shape, np.nan), where=skew)
    # n is the foot of the point m: independent rounding of m and n would cost eps / angle in the distance.
    foot = _dot(a + m[..., None] * u - c, v)
    n = np.divide(foot, _dot(v, v), out=np.full(numerator.shape, np.nan), where=skew)
    return LineParameters(m, n)


def segment_segment(a: Array, b: Array, c: Array, d: Array) -> SegmentSegment:
    """Find the distance of the segments ab and cd, with its witness points (eqs. 3-7).

    See Fig. 4.

    Takes points [m] of shape (..., 3). Where m and n both lie in [0, 1] they give the minimum; where one does
    not, or the axes are parallel or of zero length, it is the best of the four cases end point to segment.
    For parallel axes side by side the witnesses are not unique: they are those at one of the ends. The
    distance is right to rounding; the vector between the witnesses, where cases tie, to its root (1e-8).
    """
    a, b, c, d = np.broadcast_arrays(a, b, c, d)
    m, n = line_parameters(a, b, c, d)
    ends = point_segment(np.stack([a, b, c, d]), np.stack([c, c, a, a]), np.stack([d, d, b, b]))
    # m, n are a fifth candidate: inside they win, and near the border rounding cannot pick a worse one.
    on_ab = np.stack([a + m[..., None] * (b - a), a, b, ends.point[2], ends.point[3]])
    on_cd = np.stack([c + n[..., None] * (d - c), ends.point[0], ends.point[1], c, d])
    inside = (m >= 0.0) & (m <= 1.0) & (n >= 0.0) & (n <= 1.0)
    interior = np.where(inside, _norm(on_cd[0] - on_ab[0]), np.inf)
    distances = np.concatenate([interior[None], ends.distance])
    best = np.argmin(distances, axis=0)[None]
    return SegmentSegment(
        np.take_along_axis(distances, best, axis=0)[0],
        np.take_along_axis(on_ab, best[..., None], axis=0)[0],
        np.take_along_axis(on_cd, best[..., None], axis=0)[0],
    )


def capsule_distances(ends_a: Array, radii_a: Array, ends_b: Array, radii_b: Array) -> CapsuleDistances:
    """Compute signed surface distances of m pairs of capsules, all at once.

    A sphere is a capsule with equal ends.

    Takes the axes' ends [m], (m, 2, 3), and the radii [m], (m,), of both bodies. The paper's d_m is
    `distance + radii_a + radii_b`. Where the axes intersect (to TOUCHING) the normal is their common
    perpendicular, with an arbitrary sign: the distance has a kink there and no gradient.

    Raises:
        ValueError: the shapes are not (m, 2, 3) and (m,) with one m.
    """
    m = len(radii_a)
    if not (ends_a.shape == ends_b.shape == (m, 2, 3) and radii_a.shape == radii_b.shape == (m,)):
        shapes = [x.shape for x in (ends_a, radii_a, ends_b, radii_b)]
        raise ValueError(f"capsule_distances wants shapes (m, 2, 3), (m,), (m, 2, 3), (m,), got {shapes}")
    axis, on_a, on_b = segment_segment(ends_a[:, 0], ends_a[:, 1], ends_b[:, 0], ends_b[:, 1])
    touching = axis <= TOUCHING
    normal = (on_b - on_a) / np.where(touching, 1.0, axis)[:, None]
    if touching.any():
        u, v = ends_a[:, 1] - ends_a[:, 0], ends_b[:, 1] - ends_b[:, 0]
        normal[touching] = _common_perpendicular(u[touching], v[touching])
    return CapsuleDistances(
        axis - radii_a - radii_b,
        normal,
        on_a + radii_a[:, None] * normal,
        on_b - radii_b[:, None] * normal,
    )


def _common_perpendicular(u: Array, v: Array) -> Array:
    """Return unit vectors perpendicular to u and v (k, 3).

    Some perpendicular of parallel ones; z where both are points.
    """
    cross = _cross(u, v)
    longer = np.where((_norm(u) >= _norm(v))[:, None], u, v)
    # The coordinate axis furthest from the capsule's own gives the best conditioned perpendicular.
    other = _cross(longer, np.eye(3)[np.argmin(np.abs(longer), axis=1)])
    direction = np.where(_parallel(u, v, cross)[:, None], other, cross)
    direction[_norm(direction) == 0.0] = (0.0, 0.0, 1.0)
    unit: Array = direction / _norm(direction)[:, None]
    return unit


def _parallel(u: Array, v: Array, cross: Array) -> NDArray[np.bool_]:
    """Return True if the sine of the angle between u and v is at most PARALLEL.

    True also for a zero vector.
    """
    parallel: NDArray[np.bool_] = _dot(cross, cross) <= PARALLEL**2 * _dot(u, u) * _dot(v, v)
    return parallel


def _cross(x: Array, y: Array) -> Array:
    """Return the vector product over the last axis."""
    return np.asarray(np.cross(x, y), dtype=np.float64)


def _dot(x: Array, y: Array) -> Array:
    """Return the scalar product over the last axis."""
    product: Array = np.einsum("...i,...i->...", x, y)
    return product


def _norm(x: Array) -> Array:
    """Return the Euclidean length over the last axis."""
    return np.sqrt(_dot(x, x))
