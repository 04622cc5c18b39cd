"""Coal geometries as the convex shapes of kernels, and how the distance of each pair of them is computed."""

from __future__ import annotations

from collections.abc import Sequence
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


def convex_shapes(geometries: Sequence[Any]) -> Shapes:
    """Return g geometries as arrays; triangle meshes, and what else is not convex, as OTHER."""
    count, points, edges = len(geometries), [np.zeros((0, 3))], list[IntArray]()
    kind, core, span = np.zeros(count, dtype=np.intp), np.zeros((count, 4)), np.zeros((count, 2), dtype=np.intp)
    total = 0
    for i, geometry in enumerate(geometries):
        kind[i], core[i] = core_of(geometry)
        if kind[i] == HULL:
            corners = np.array(geometry.points())
            points.append(corners)
            edges += [total + np.array(geometry.neighbors(k), dtype=np.intp) for k in range(len(corners))]
            span[i] = total, total + len(corners)
            total += len(corners)
    first = np.cumsum([0, *map(len, edges)]).astype(np.intp)
    return Shapes(kind, core, span, np.concatenate(points), first, np.concatenate([np.zeros(0, dtype=np.intp), *edges]))


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
