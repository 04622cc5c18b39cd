"""Distances of points and segments in closed form (paper §2, eqs. 2-7).

Every function works on arrays whose last axis holds the three coordinates [m]; the leading axes broadcast. All points
of one call share one frame. A NaN coordinate gives a NaN distance.
"""

import numpy as np

from qpavoid.problem import Array


def point_segment_distance(p: Array, a: Array, b: Array) -> Array:
    """Compute the distance of points p from segments ab (...) [m].

    Eq. 2, with the projection clamped to the segment, so that the axial part beyond an end counts, which eq. 2 leaves
    out. A segment of zero length is the point a.
    """
    u = b - a
    square = _dot(u, u)
    t = np.divide(_dot(p - a, u), square, out=np.zeros(np.broadcast(p, u).shape[:-1]), where=square > 0.0)
    return np.asarray(np.linalg.norm(p - a - np.clip(t, 0.0, 1.0)[..., None] * u, axis=-1))


def segment_segment_distance(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Compute the distance of segments ab from segments cd (...) [m].

    The least of five: each end from the other segment, and from cd the point of ab where both lines are closest (eq. 6,
    clamped). Where the segments' own closest points are no ends, they are those of the lines.
    """
    u, v = b - a, d - c
    normal = np.cross(u, v)
    # cross products: the Gram determinant |u|²|v|² - (u·v)² loses all its digits at 1e-8 rad
    numerator, square = np.broadcast_arrays(_dot(np.cross(c - a, v), normal), _dot(normal, normal))
    m = np.divide(numerator, square, out=np.zeros(square.shape), where=square > 0.0)
    on_ab = a + np.clip(m, 0.0, 1.0)[..., None] * u
    cases = ((on_ab, c, d), (a, c, d), (b, c, d), (c, a, b), (d, a, b))
    distances = np.broadcast_arrays(*(point_segment_distance(*case) for case in cases))
    return np.asarray(np.min(np.stack(distances), axis=0))


def _dot(x: Array, y: Array) -> Array:
    product: Array = np.einsum("...i,...i->...", x, y)
    return product
