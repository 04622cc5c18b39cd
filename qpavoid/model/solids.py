"""coal geometries of an obstacle: one of a primitive, several of a mesh that is decomposed."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import coal
import numpy as np
from scipy.spatial import ConvexHull

from qpavoid.config import HalfSpace, Mesh, ObstacleShape, PointCloud
from qpavoid.config.base import LARGEST
from qpavoid.errors import ConfigError
from qpavoid.geometry.bodies import MeshWarning, make_shape, run_qhull
from qpavoid.geometry.decompose import decompose
from qpavoid.model.cloud import voxel_radius
from qpavoid.model.urdf import find_resource
from qpavoid.problem import Array, IntArray

_LARGEST = 100_000_000
"""Size of a file [bytes]: the reader takes it into memory as a whole before it looks at it."""
_MOST_TRIANGLES = 200_000
"""Triangles of a mesh that is decomposed, at most: these take some seconds."""
_THINNEST = 1e-4
"""Thickness of the hull of flat points [m]: a hull needs an inside."""


def make_solids(shape: ObstacleShape, folder: Path, where: str) -> list[Any]:
    """Make the coal geometries of an obstacle, all in the obstacle's own frame.

    Args:
        shape: of a point cloud, the sphere that stands for one of its voxels.
        folder: where relative paths start.
        where: the obstacle's `shape`, to name in errors.

    Raises:
        ConfigError: a mesh that cannot be found, read or used.
    """
    if isinstance(shape, HalfSpace):
        return [coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)]
    if isinstance(shape, PointCloud):
        return [coal.Sphere(voxel_radius(shape.resolution))]
    if not isinstance(shape, Mesh):
        return [make_shape(shape)]
    mesh = read_mesh(shape, folder, f"{where}.path")
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
        return [hull_of(vertices)]
    if len(triangles) > _MOST_TRIANGLES:
        raise ConfigError(
            f"{where}.path: {len(triangles)} triangles; at most {_MOST_TRIANGLES} are decomposed: make it "
            "coarser, or set `method: convex`"
        )
    return [hull_of(piece) for piece in decompose(vertices, triangles, shape.max_pieces, shape.tolerance)]


def read_mesh(shape: Mesh, folder: Path, where: str) -> Any:
    """Read a triangle mesh from a file into a coal geometry.

    Raises:
        ConfigError: no such file, too large, not a mesh, or corners that are no numbers.
    """
    path = find_resource(shape.path, folder, where)
    if path.stat().st_size > _LARGEST:
        raise ConfigError(f"{where}: {path.stat().st_size} bytes; at most {_LARGEST} are read, make it coarser")
    try:
        mesh = coal.MeshLoader().load(str(path), np.full(3, shape.scale))
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split()).rpartition("message: ")[2]
        raise ConfigError(f"{where}: {path.name}: {reason}; give an STL, OBJ, PLY or DAE file") from None
    points = np.array(mesh.vertices())
    if points.ndim != 2 or len(points) < 3 or not mesh.num_tris:
        raise ConfigError(f"{where}: {path.name} has no triangle; export it again")
    if not np.all(np.abs(points) <= LARGEST):  # False for NaN too
        raise ConfigError(f"{where}: {path.name}: a corner is NaN, infinite or beyond {LARGEST:g} m; export it again")
    return mesh


def corners(mesh: Any) -> tuple[Array, IntArray]:
    """Return the corners (n, 3) [m] and triangles (t, 3) of a coal mesh."""
    triangles = [[mesh.tri_indices(i)[k] for k in range(3)] for i in range(mesh.num_tris)]
    return np.array(mesh.vertices()), np.array(triangles, dtype=np.intp)


def surface_triangles(geometry: Any) -> Array:
    """Return the triangles (t, 3, 3) of a mesh or a hull.

    They face outwards as far as the file's do.
    """
    if isinstance(geometry, coal.BVHModelBase):
        vertices, triangles = corners(geometry)
        return np.asarray(vertices[triangles])
    points = np.array([geometry.point(i) for i in range(geometry.num_points)])
    faces = points[ConvexHull(points).simplices]
    outwards = np.einsum(
        "ij,ij->i", np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]), faces[:, 0] - points.mean(axis=0)
    )
    faces[outwards < 0.0] = faces[outwards < 0.0][:, ::-1]
    return np.asarray(faces)


def hull_of(points: Array) -> Any:
    """Make coal's convex hull of points (n, 3).

    A flat set of points becomes 0.1 mm thick.
    """
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    for axis in axes:
        if np.ptp(points @ axis) < _THINNEST:
            points = np.concatenate((points + 0.5 * _THINNEST * axis, points - 0.5 * _THINNEST * axis))
    model = coal.BVHModelOBBRSS()
    model.beginModel(0, len(points))
    model.addVertices(points)
    return run_qhull(model)
