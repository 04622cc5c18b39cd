"""Surfaces of bodies and obstacles as quadrilaterals."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from qpavoid.problem import Array
from qpavoid.run.log import Log

_AROUND, _ARC = 28, 8
"""Quadrilaterals around a round shape, and along each part of its profile."""
_PLANE = 4.0
"""Side of the square that is drawn of the plane of a half-space [m]: twice the span of a large arm."""


def shape_faces(shape: dict[str, Any]) -> Array:
    """Return outward quadrilaterals (m, 4, 3) of a shape in its own frame [m]; of a half-space, a square of its plane.

    Shapes are cut up, because faces are painted from back to front by their middle.
    """
    kind = shape["type"]
    if kind == "box":
        return _box_faces(np.array(shape["size"]), 6)
    if kind == "half_space":
        return _box_faces(np.array([_PLANE, _PLANE, 0.0]), 40)[-1600:]
    if kind == "ellipsoid":
        return np.asarray(shape_faces({"type": "sphere", "radius": 1.0}) * np.array(shape["radii"]))
    radius, half = shape["radius"], 0.5 * shape.get("length", 0.0)
    side = np.linspace(0.0, 1.0, _ARC)
    if kind == "cone":
        return _revolve(np.r_[0.0, radius * (1.0 - side)], np.r_[-half, half * (2.0 * side - 1.0)])
    if kind == "cylinder":
        return _revolve(np.r_[0.0, np.full(_ARC, radius), 0.0], np.r_[-half, half * (2.0 * side - 1.0), half])
    r, z = radius * np.sin(0.5 * np.pi * side), half + radius * np.cos(0.5 * np.pi * side)
    return _revolve(np.r_[r, r[::-1]], np.r_[-z, z[::-1]])


def _revolve(radius: Array, height: Array) -> Array:
    """Return quadrilaterals (m, 4, 3) of a profile of radius and height revolved about z."""
    angle = np.linspace(0.0, 2.0 * np.pi, _AROUND + 1)
    x, y = np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))
    return _quadrilaterals(np.stack([x, y, np.broadcast_to(height[:, None], x.shape)], axis=-1))


def _box_faces(size: Array, cuts: int) -> Array:
    """Return quadrilaterals (m, 4, 3) of a box of full side lengths `size` (3,) [m], `cuts` by `cuts` a side."""
    u, v = np.meshgrid(np.linspace(-1.0, 1.0, cuts + 1), np.linspace(-1.0, 1.0, cuts + 1))
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            grid = np.roll(np.stack([np.full_like(u, sign), sign * u, v], axis=-1), axis, axis=-1)
            sides.append(_quadrilaterals(grid))
    return np.concatenate(sides) * 0.5 * size


def _quadrilaterals(grid: Array) -> Array:
    """Return the cells (m, 4, 3) of a grid of points (i, j, 3)."""
    corners = [grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]]
    return np.stack(corners, axis=2).reshape(-1, 4, 3)


def capsule_faces(ends: Array, radius: float) -> Array:
    """Return outward quadrilaterals (m, 4, 3) of a capsule about a segment (2, 3) [m]."""
    axis = ends[1] - ends[0]
    length = float(np.linalg.norm(axis))
    z = axis / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    faces = shape_faces({"type": "capsule", "radius": radius, "length": length})
    return np.asarray(faces @ np.stack([x, np.cross(z, x), z]) + ends.mean(axis=0))


def local_faces(obstacle: dict[str, Any]) -> Array:
    """Return outward quadrilaterals (m, 4, 3) of an obstacle of the log in its own frame [m]."""
    if "triangles" in obstacle:
        return np.array(obstacle["triangles"]).reshape(-1, 3, 3)[:, [0, 1, 2, 2]]
    if "voxels" in obstacle:
        voxel = _box_faces(np.full(3, obstacle["shape"]["resolution"]), 1)
        return np.asarray(voxel + np.array(obstacle["voxels"]).reshape(-1, 1, 1, 3)).reshape(-1, 4, 3)
    return shape_faces(obstacle["shape"])


def obstacle_faces(log: Log, index: int, step: int) -> Array:
    """Return outward quadrilaterals (m, 4, 3) of an obstacle at a step, in world axes [m]; none while it is away."""
    faces, position = local_faces(log.meta["obstacles"][index]), log.obstacle_position[step, index]
    faces = faces[: len(faces) if np.isfinite(position).all() else 0]
    return np.asarray(faces @ log.obstacle_rotation[step, index].T + position)


def triangulated(quadrilaterals: Array) -> tuple[Array, Any]:
    """Return vertices (n, 3) and triangles (t, 3) of quadrilaterals (m, 4, 3)."""
    corners = np.arange(4 * len(quadrilaterals)).reshape(-1, 4)
    return quadrilaterals.reshape(-1, 3), np.concatenate((corners[:, :3], corners[:, [0, 2, 3]]))


def inflated_outline(log: Log, index: int, step: int, flat: Callable[[Any], Array], distance: float) -> Array | None:
    """Return the outline (n, 2) [m] of all that is nearer than a distance [m] to an obstacle, in a parallel projection.

    None where there is nothing, or no single convex body.

    Args:
        log: the run.
        index: number of the obstacle.
        step: number of the step.
        flat: projects points (n, 3) into the plane of the picture (n, 2).
        distance: from the obstacle's surface [m].
    """
    described = log.meta["obstacles"][index]
    if is_endless(log, index) or "voxels" in described or "triangles" in described:
        return None
    corners = flat(obstacle_faces(log, index, step).reshape(-1, 3))
    if not len(corners):
        return None
    corners = corners[ConvexHull(corners, qhull_options="QJ").vertices]
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    around = (corners[:, None] + distance * np.column_stack((np.cos(angle), np.sin(angle)))).reshape(-1, 2)
    return np.asarray(around[ConvexHull(around).vertices])


def obstacle_path(log: Log, index: int) -> Array:
    """Return the path (n, 3) of an obstacle's origin [m]: one point where it rests, none where it never was."""
    path = log.obstacle_position[:, index]
    path = path[np.isfinite(path).all(axis=1)]
    return path[:1] if len(path) and np.ptp(path, axis=0).max() < 1e-3 else path


def is_endless(log: Log, index: int) -> bool:
    """Return True if an obstacle is a half-space, which has neither size nor middle."""
    return bool(log.meta["obstacles"][index]["shape"]["type"] == "half_space")


def moving_bodies(log: Log) -> Any:
    """Return for each body (b,) whether it moves by more than 1 mm in the run."""
    return np.any(np.ptp(log.body_ends, axis=0) > 1e-3, axis=(1, 2)) if len(log.t) else np.zeros(0, bool)
