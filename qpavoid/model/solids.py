"""coal geometries of an obstacle: one of a primitive, several of a mesh that is decomposed."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import coal
import numpy as np

from qpavoid.config import HalfSpace, Mesh, ObstacleShape, PointCloud
from qpavoid.errors import ConfigError
from qpavoid.geometry.bodies import make_shape
from qpavoid.geometry.meshes import MeshWarning, convex_hull, corners, load_mesh
from qpavoid.model.cloud import voxel_radius
from qpavoid.model.urdf import find_resource

_MOST_TRIANGLES = 200_000
"""Triangles of a mesh that is decomposed, at most: these take some seconds."""


def make_solids(shape: ObstacleShape, folder: Path, where: str) -> list[Any]:
    """Make the coal geometries of an obstacle, all in its own frame; of a point cloud, the sphere around one voxel.

    Raises:
        ConfigError: a mesh that cannot be found from the folder, read or used; naming the obstacle's `shape`.
    """
    if isinstance(shape, HalfSpace):
        return [coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)]
    if isinstance(shape, PointCloud):
        return [coal.Sphere(voxel_radius(shape.resolution))]
    if not isinstance(shape, Mesh):
        return [make_shape(shape)]
    path = find_resource(shape.path, folder, f"{where}.path")
    try:
        mesh = load_mesh(str(path), np.full(3, shape.scale))
    except ValueError as fault:
        raise ConfigError(f"{where}.path: {path.name}: {fault}") from None
    vertices, triangles = corners(mesh)
    if shape.method == "surface":
        warnings.warn(
            f"{where}.method: surface: {len(triangles)} triangles cost 100 to 500 µs a pair at every step, "
            "some pairs several ms; set `method` to decomposed or convex",
            MeshWarning,
            stacklevel=5,
        )
        return [mesh]
    if shape.method == "convex":
        return [convex_hull(vertices)]
    if len(triangles) > _MOST_TRIANGLES:
        raise ConfigError(
            f"{where}.path: {len(triangles)} triangles; at most {_MOST_TRIANGLES} are decomposed: make it "
            "coarser, or set `method: convex`"
        )
    from qpavoid.geometry.decompose import decompose  # needs scipy, which is slow to import

    return [convex_hull(piece) for piece in decompose(vertices, triangles, shape.max_pieces, shape.tolerance)]
