"""Convex shapes as arrays, and their points farthest along a direction.

A shape is a core with a radius around it: a sphere is a point, a capsule a segment; all others are cores themselves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.kernels.packing import inlined_uncounted
from qpavoid.problem import Array, IntArray

POINT, SEGMENT, BOX, CYLINDER, CONE, ELLIPSOID, HULL, HALF_SPACE, OTHER = range(9)
"""Kinds of cores; triangle meshes are OTHER."""
_TIE = 1e-12
"""Component of a unit direction up to which a face or edge counts as at right angles to it [-]: its middle is taken."""
_FEW = 24
"""Vertices of a hull up to which looking at all of them is as fast as climbing from one to the next [-]."""


class Shapes(NamedTuple):
    """Cores of g bodies in their own frames, with the vertices of all hulls."""

    kind: IntArray
    """(g,) one of the kinds above."""
    core: Array
    """(g, 4) radius around the core, then its half sizes along x, y and z [m]; of a half-space, [offset, normal]."""
    span: IntArray
    """(g, 2) first vertex of a hull, and the one after its last."""
    vertices: Array
    """(p, 3) of all hulls, in their frames [m]."""
    first: IntArray
    """(p + 1,) first entry of `neighbours` of each vertex, which has those up to the next one's."""
    neighbours: IntArray
    """(e,) numbers of the vertices that edges lead to."""


@inlined_uncounted
def support(shapes: Shapes, i: int, start: int, x: float, y: float, z: float) -> tuple[int, float, float, float]:
    """Find the point of a core that is farthest along a direction.

    Args:
        shapes: with the core.
        i: number of the body.
        start: vertex of a large hull to climb from.
        x: of the unit direction, in the body's frame.
        y: see x.
        z: see x.

    Returns:
        Vertex of a hull, to start from next time; the point [m].
    """
    kind = shapes.kind[i]
    if kind == HULL:
        at = farthest_vertex(shapes, shapes.span[i, 0], shapes.span[i, 1], start, x, y, z)
        return at, shapes.vertices[at, 0], shapes.vertices[at, 1], shapes.vertices[at, 2]
    a, b, c = shapes.core[i, 1], shapes.core[i, 2], shapes.core[i, 3]
    if kind <= BOX:
        return start, _side(x) * a, _side(y) * b, _side(z) * c
    if kind == ELLIPSOID:
        length = np.sqrt((a * x) ** 2 + (b * y) ** 2 + (c * z) ** 2)
        return start, a * a * x / length, b * b * y / length, c * c * z / length
    radial = np.sqrt(x * x + y * y)
    height = _side(z) * c
    if kind == CONE:  # its tip is at +z
        if 2.0 * c * z > a * radial:
            return start, 0.0, 0.0, c
        height = -c
    if radial <= _TIE:
        return start, 0.0, 0.0, height
    return start, a * x / radial, a * y / radial, height


@inlined_uncounted
def any_point(shapes: Shapes, i: int) -> tuple[float, float, float]:
    """Return a point of a core: its centre, but a corner of a hull, which may be anywhere in its frame [m]."""
    if shapes.kind[i] != HULL:
        return 0.0, 0.0, 0.0
    at = shapes.span[i, 0]
    return shapes.vertices[at, 0], shapes.vertices[at, 1], shapes.vertices[at, 2]


@inlined_uncounted
def farthest_vertex(shapes: Shapes, low: int, high: int, start: int, x: float, y: float, z: float) -> int:
    """Find the vertex of a hull, of those from `low` to before `high`, that is farthest along a direction."""
    V = shapes.vertices
    if high - low <= _FEW:
        best, at = -np.inf, low
        for k in range(low, high):
            s = V[k, 0] * x + V[k, 1] * y + V[k, 2] * z
            if s > best:
                best, at = s, k
        return at
    at = start if low <= start < high else low
    best, moved = V[at, 0] * x + V[at, 1] * y + V[at, 2] * z, True
    while moved:  # ends: each vertex is farther than the one before
        moved = False
        for e in range(shapes.first[at], shapes.first[at + 1]):
            k = shapes.neighbours[e]
            s = V[k, 0] * x + V[k, 1] * y + V[k, 2] * z
            if s > best:
                best, at, moved = s, k, True
    return at


@inlined_uncounted
def _side(x: float) -> float:
    """Return the sign of a component of a unit direction; 0 where it counts as none."""
    return 1.0 if x > _TIE else (-1.0 if x < -_TIE else 0.0)
