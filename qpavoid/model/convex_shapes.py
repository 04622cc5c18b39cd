"""Coal geometries as the convex shapes of kernels, and how the distance of each pair of them is computed."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import coal
import numpy as np

from qpavoid.kernels.distances import BY_COAL, BY_GJK, CLOSED_FORM, TO_HALF_SPACE
from qpavoid.kernels.support import (
    BOX,
    CONE,
    CYLINDER,
    ELLIPSOID,
    HALF_SPACE,
    HULL,
    OTHER,
    POINT,
    SEGMENT,
    Shapes,
)
from qpavoid.problem import IntArray

_SPARE_CORNERS, _SPARE_EDGES = 256, 1536
"""Room for the hull that may come into a spare slot [-]; of triangles, six edges begin at a corner on average."""


def convex_shapes(geometries: Sequence[Any], spare: Collection[int] = ()) -> Shapes:
    """Return g geometries as arrays; triangle meshes, and what else is not convex, as OTHER.

    Args:
        geometries: of coal.
        spare: numbers of those that others may be written over by `write_shape`.
    """
    count, capacity = len(geometries), np.zeros((len(geometries), 2), dtype=np.intp)
    for i, geometry in enumerate(geometries):
        if i in spare:
            capacity[i] = _SPARE_CORNERS + 1, _SPARE_EDGES
        elif core_of(geometry)[0] == HULL:
            capacity[i] = geometry.num_points + 1, sum(map(len, _edges(geometry)))
    corners, edges = np.cumsum(np.vstack(([0, 0], capacity)), axis=0).T
    first = np.zeros(corners[-1] + 1, dtype=np.intp)
    first[corners] = edges
    shapes = Shapes(
        kind=np.zeros(count, dtype=np.intp),
        core=np.zeros((count, 4)),
        span=np.column_stack((corners[:-1], corners[:-1])),
        vertices=np.zeros((corners[-1], 3)),
        first=first,
        neighbours=np.zeros(edges[-1], dtype=np.intp),
    )
    for i, geometry in enumerate(geometries):
        write_shape(shapes, i, geometry)
    return shapes


def write_shape(shapes: Shapes, i: int, geometry: Any) -> None:
    """Write another geometry over that of body i; a hull that there is no room for as OTHER."""
    kind, core = core_of(geometry)
    if kind == HULL:
        points, edges, low = np.array(geometry.points()), _edges(geometry), shapes.span[i, 0]
        high = shapes.span[i + 1, 0] if i + 1 < len(shapes.span) else len(shapes.vertices)
        first = shapes.first[low] + np.cumsum([0, *map(len, edges)])
        if low + len(points) < high and first[-1] <= shapes.first[high]:
            shapes.vertices[low : low + len(points)] = points
            shapes.first[low : low + len(first)] = first
            shapes.neighbours[first[0] : first[-1]] = low + np.concatenate(edges)
            shapes.span[i, 1] = low + len(points)
        else:
            kind = OTHER
    shapes.kind[i], shapes.core[i] = kind, core


def _edges(hull: Any) -> list[IntArray]:
    """Return the corners that edges lead to from each corner of a hull."""
    return [np.array(hull.neighbors(k), dtype=np.intp) for k in range(hull.num_points)]


def core_of(geometry: Any) -> tuple[int, tuple[float, ...]]:
    """Return the kind of a geometry's core; radius around it, and half sizes, see `Shapes.core` [m]."""
    none = (0.0, 0.0, 0.0, 0.0)
    match geometry:
        case coal.Sphere():
            return POINT, (geometry.radius, 0.0, 0.0, 0.0)
        case coal.Capsule():
            return SEGMENT, (geometry.radius, 0.0, 0.0, geometry.halfLength)
        case coal.Box() if (geometry.halfSide > 0.0).all():
            return BOX, (0.0, *geometry.halfSide)
        case coal.Cylinder():
            return CYLINDER, (0.0, geometry.radius, geometry.radius, geometry.halfLength)
        case coal.Cone():
            return CONE, (0.0, geometry.radius, geometry.radius, geometry.halfLength)
        case coal.Ellipsoid() if (np.asarray(geometry.radii) > 0.0).all():
            return ELLIPSOID, (0.0, *geometry.radii)
        case coal.ConvexBase():
            return HULL, none
        case coal.Halfspace() if geometry.d == 0.0 and np.array_equal(geometry.n, [0.0, 0.0, 1.0]):
            return HALF_SPACE, none
    return OTHER, none


def pair_methods(shapes: Shapes, pairs: IntArray) -> IntArray:
    """Choose how the distance of each pair (m, 2) of bodies is computed (m,), see `kernels.distances`."""
    low, high = np.sort(shapes.kind[pairs], axis=1).T
    return np.select(
        [(low <= SEGMENT) & (high <= BOX), high <= HULL, (low <= HULL) & (high == HALF_SPACE)],
        [CLOSED_FORM, BY_GJK, TO_HALF_SPACE],
        BY_COAL,
    ).astype(np.intp)
