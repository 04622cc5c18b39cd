"""Triangle meshes and convex hulls of coal: read, checked, and taken apart into triangles."""

from __future__ import annotations

import os
from typing import Any

import coal
import numpy as np
from scipy.spatial import ConvexHull

from qpavoid.config.base import LARGEST
from qpavoid.problem import Array, IntArray

_LARGEST_FILE = 100_000_000
"""Size of a mesh [bytes]: the reader takes files into memory as a whole before it looks at them."""
_THINNEST = 1e-4
"""Thickness of the hull of flat points [m]: a hull needs an inside; thin beside any safety distance."""


class MeshWarning(UserWarning):
    """Distances will be slow: something is made of triangle meshes."""


def load_mesh(path: str, scale: Array) -> Any:
    """Load a mesh from a file into a coal geometry.

    Args:
        path: of an STL, OBJ, PLY or DAE file.
        scale: factors (3,) of its coordinates [-].

    Raises:
        ValueError: too large, not a mesh, no triangle in it, or corners that are no numbers; with a remedy.
    """
    size = os.path.getsize(path)
    if size > _LARGEST_FILE:
        raise ValueError(f"{size} bytes; at most {_LARGEST_FILE} are read, make it coarser")
    try:
        mesh = coal.MeshLoader().load(path, scale)
    except (ValueError, RuntimeError) as error:
        with open(path, "rb") as file:
            if file.read(40).startswith(b"version https://git-lfs"):
                raise ValueError("it is a pointer of Git LFS and no mesh; run `git lfs pull`") from None
        reason = " ".join(str(error).split()).rpartition("message: ")[2].rstrip(".")
        raise ValueError(f"{reason}; export it again, as an STL, OBJ, PLY or DAE file") from None
    check_mesh(mesh)
    return mesh


def check_mesh(mesh: Any) -> None:
    """Check that a mesh has triangles, and that its corners are numbers: hulls and distances need them.

    Raises:
        ValueError: with a remedy.
    """
    points = np.array(mesh.vertices())
    if points.ndim != 2 or len(points) < 3 or not mesh.num_tris:
        raise ValueError("has no triangle; export it again")
    if not np.all(np.abs(points) <= LARGEST):  # False for NaN too
        raise ValueError(f"a corner is NaN, infinite or beyond {LARGEST:g} m; export it again")


def corners(mesh: Any) -> tuple[Array, IntArray]:
    """Return the corners (n, 3) [m] and triangles (t, 3) of a coal mesh."""
    triangles = [[triangle[0], triangle[1], triangle[2]] for triangle in map(mesh.tri_indices, range(mesh.num_tris))]
    return np.array(mesh.vertices()), np.array(triangles, dtype=np.intp)


def surface_triangles(geometry: Any) -> Array:
    """Return the triangles (t, 3, 3) [m] of a mesh or a hull; those of a hull face outwards."""
    if isinstance(geometry, coal.BVHModelBase):
        vertices, triangles = corners(geometry)
        return np.asarray(vertices[triangles])
    points = np.array(geometry.points())
    faces = points[ConvexHull(points).simplices]
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    inwards = np.einsum("ij,ij->i", normals, faces[:, 0] - points.mean(axis=0)) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    return np.asarray(faces)


def convex_hull(points: Array) -> Any:
    """Make coal's convex hull of points (n, 3) [m].

    A flat set of points becomes 0.1 mm thick: it has no hull with an inside, and qhull ends the process over it.
    """
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    for axis in axes:
        if np.ptp(points @ axis) < _THINNEST:
            points = np.concatenate((points + 0.5 * _THINNEST * axis, points - 0.5 * _THINNEST * axis))
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(0, len(points))
    mesh.addVertices(points)
    try:
        mesh.buildConvexHull(True, "Qt")
    except RuntimeError:
        # a corner with more than 255 neighbours, as where a round flat face is cut into a fan of triangles: qhull's
        # other way with flat faces moves corners by rounding errors and makes no fans
        mesh.buildConvexHull(True, "QJ")
    return mesh.convex
