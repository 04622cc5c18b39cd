"""Shapes of a link that lie inside another shape of it: nothing can touch them, and each costs a pair."""

from __future__ import annotations

from collections import defaultdict
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
    links: dict[int, list[Any]] = defaultdict(list)
    for piece in pieces.geometryObjects:
        links[piece.parentFrame].append(piece)
    enclosing: dict[str, str] = {}
    for members in links.values():
        for inner in members:
            outers = (piece for piece in members if piece.name != inner.name and piece.name not in enclosing)
            outer = next((piece for piece in outers if _encloses(piece, inner)), None)
            if outer is not None:
                enclosing[inner.name] = outer.name
        _name_mixture([piece for piece in members if piece.name not in enclosing], notes)
    result = pin.GeometryModel()
    for piece in pieces.geometryObjects:
        if piece.name in enclosing:
            clause = f"left out: it lies inside {enclosing[piece.name]}, a shape of the same link"
            notes.append(Note(NoteKind.SHAPE, (piece.name,), clause))
        else:
            result.addGeometryObject(piece)
    return result


def _name_mixture(pieces: list[Any], notes: list[Note]) -> None:
    """Note the shapes of a link that has meshes beside simple shapes: often one set is meant to replace the other."""
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
    return bool(_excess(outer.geometry, points @ placement.rotation.T + placement.translation).max() <= _ROUND_OFF)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a.geometry, coal.BVHModelBase):
        return bool(a.meshPath == b.meshPath and np.array_equal(a.meshScale, b.meshScale))
    return type(a.geometry) is type(b.geometry) and bool(a.geometry == b.geometry)


def _excess(shape: Any, points: Array) -> Array:
    """Return an upper bound on how far points (n, 3) stand out of a shape (n,) [m]; negative inside."""
    radial, axial = np.linalg.norm(points[:, :2], axis=1), np.abs(points[:, 2])
    match shape:
        case coal.Box():
            return np.asarray((np.abs(points) - shape.halfSide).max(axis=1))
        case coal.Sphere():
            return np.asarray(np.linalg.norm(points, axis=1) - shape.radius)
        case coal.Ellipsoid():
            return np.asarray((np.linalg.norm(points / shape.radii, axis=1) - 1.0) * np.min(shape.radii))
        case coal.Cylinder():
            return np.asarray(np.maximum(radial - shape.radius, axial - shape.halfLength))
    return np.asarray(np.hypot(radial, np.maximum(axial - shape.halfLength, 0.0)) - shape.radius)
