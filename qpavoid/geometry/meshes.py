"""Triangle meshes and convex hulls of coal: read, checked, and taken apart into triangles."""

from __future__ import annotations

import os
from typing import Any

import coal
import numpy as np

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


def hull_corners(points: Array) -> Array:
    """Return those of points (n, 3) that are corners of their hull; all where they are flat or few."""
    from scipy.spatial import ConvexHull, QhullError  # slow to import, and few robots have meshes

    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except (QhullError, ValueError):
        return points


def normals(triangles: Array) -> Array:
    """Return the normals (t, 3) of triangles (t, 3, 3), twice as long as their areas [m²]."""
    return np.asarray(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))


def cut(triangles: Array, heights: Array) -> tuple[Array, Array]:
    """Cut triangles (t, 3, 3) at a plane; return those below and those above it, (k, 3, 3) each.

    Args:
        triangles: their corners [m].
        heights: of the corners above the plane (t, 3) [m]; triangles that lie in it are in both results.
    """
    below, above = (heights <= 0.0).all(axis=1), (heights >= 0.0).all(axis=1)
    crossed = ~(below | above)
    corners, h = triangles[crossed], heights[crossed]
    # the corner that is alone on its side comes first
    lone = np.where((h < 0.0).sum(axis=1) == 1, (h < 0.0).argmax(axis=1), (h > 0.0).argmax(axis=1))
    order = (lone[:, None] + np.arange(3)) % 3
    (a, b, c), h = (
        np.moveaxis(np.take_along_axis(corners, order[..., None], axis=1), 1, 0),
        np.take_along_axis(h, order, 1),
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.clip(h[:, :1] / (h[:, :1] - h[:, 1:]), 0.0, 1.0)
    ab, ac = a + fraction[:, :1] * (b - a), a + fraction[:, 1:] * (c - a)
    tip, low = np.stack((a, ab, ac), axis=1), h[:, 0] < 0.0
    base = np.stack((ab, b, c, ab, c, ac), axis=1)
    sides = [
        np.concatenate((triangles[whole], tip[tips], base[~tips].reshape(-1, 3, 3)))
        for whole, tips in ((below, low), (above, ~low))
    ]
    return sides[0], sides[1]


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
