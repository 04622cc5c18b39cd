"""Shapes of a link that lie inside another shape of it: nothing can touch them, and each costs a pair."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.geometry.bodies import hull_points
from qpavoid.model.notes import Note, NoteKind
from qpavoid.problem import Array

_ROUND_OFF = 1e-6
"""How far a point may stand out and count as inside [m]: meshes have single precision."""


def remove_enclosed(pieces: Any, notes: list[Note]) -> Any:
    """Remove the shapes of a geometry model that lie inside others of their link.

    What touches an enclosed shape has gone through the one around it, so that distances stay as they are as long as
    they are positive. Files that have a mesh and a simple shape around it for each link need half of them.

    Args:
        pieces: Pinocchio geometry model.
        notes: what was left out is added to them.
    """
    objects = list(pieces.geometryObjects)
    links: dict[int, list[int]] = {}
    for i, piece in enumerate(objects):
        links.setdefault(piece.parentFrame, []).append(i)
    result = pin.GeometryModel()
    enclosed_by: dict[int, int] = {}
    for members in links.values():
        for i in members:
            candidates = (j for j in members if j != i and enclosed_by.get(j) != i and j not in enclosed_by)
            enclosing = next((j for j in candidates if _encloses(objects[j], objects[i])), None)
            if enclosing is not None:
                enclosed_by[i] = enclosing
        _name_mixture([objects[i] for i in members if i not in enclosed_by], notes)
    for i, piece in enumerate(objects):
        if i in enclosed_by:
            clause = f"left out: it lies inside {objects[enclosed_by[i]].name}, a shape of the same link"
            notes.append(Note(NoteKind.SHAPE, (piece.name,), clause))
        else:
            result.addGeometryObject(piece)
    return result


def _name_mixture(pieces: list[Any], notes: list[Note]) -> None:
    """Note the shapes of a link that has meshes beside simple shapes.

    Often one set is meant to replace the other.
    """
    meshes = [piece for piece in pieces if isinstance(piece.geometry, coal.BVHModelBase)]
    if meshes and len(meshes) < len(pieces):
        names = tuple(piece.name for piece in pieces)
        clause = "meshes and simple shapes of one link, none inside another: all count"
        notes.append(Note(NoteKind.SHAPE, names, clause, "list `bodies` where one set is meant to replace the other"))


def _encloses(outer: Any, inner: Any) -> bool:
    """Return True if a piece lies inside another one, or is the same."""
    placement = outer.placement.actInv(inner.placement)
    if _same(outer, inner) and placement.isIdentity(_ROUND_OFF):
        return True
    if not isinstance(outer.geometry, coal.Box | coal.Sphere | coal.Capsule | coal.Cylinder | coal.Ellipsoid):
        return False
    mesh = isinstance(inner.geometry, coal.BVHModelBase)
    points = np.array(inner.geometry.vertices()) if mesh else hull_points(inner.geometry)
    if not len(points) or not np.isfinite(points).all():
        return False
    return bool(_depth(outer.geometry, points @ placement.rotation.T + placement.translation).min() >= -_ROUND_OFF)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a.geometry, coal.BVHModelBase):
        return bool(a.meshPath == b.meshPath and np.array_equal(a.meshScale, b.meshScale))
    return type(a.geometry) is type(b.geometry) and bool(a.geometry == b.geometry)


def _depth(shape: Any, points: Array) -> Array:
    """Return a lower bound on the depth of points (n, 3) inside a shape (n,) [m].

    Negative outside.
    """
    if isinstance(shape, coal.Box):
        return np.asarray((shape.halfSide - np.abs(points)).min(axis=1))
    if isinstance(shape, coal.Sphere):
        return np.asarray(shape.radius - np.linalg.norm(points, axis=1))
    if isinstance(shape, coal.Ellipsoid):
        scaled = np.linalg.norm(points / shape.radii, axis=1)
        return np.asarray((1.0 - scaled) * np.min(shape.radii))
    height_excess = np.abs(points[:, 2]) - shape.halfLength
    radius = np.linalg.norm(points[:, :2], axis=1)
    if isinstance(shape, coal.Cylinder):
        return np.asarray(np.minimum(shape.radius - radius, -height_excess))
    return np.asarray(shape.radius - np.hypot(radius, np.maximum(height_excess, 0.0)))
