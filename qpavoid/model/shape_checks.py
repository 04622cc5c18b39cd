"""Shapes as a file has them that are hardly meant: inside another one of their link, or of a size that no robot has."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.geometry.bodies import bounding_box, hull_points
from qpavoid.model.notes import Note, NoteKind
from qpavoid.problem import Array

_ROUND_OFF = 1e-6
"""How far a point may stand out and count as inside [m]: meshes have single precision."""
_LARGEST = 20.0
"""Size of a shape, and distance of a joint from the one before it [m], that only cranes reach."""
_SMALLEST = 1e-3
"""Size of a mesh that is hardly meant [m]; a screw is larger."""


def remove_enclosed(pieces: Any, notes: list[Note]) -> Any:
    """Return a geometry model without the shapes that lie inside others of their link, which are noted.

    What touches an enclosed shape has gone through the one around it, so that distances stay as they are as long as
    they are positive. Files that have a mesh and a simple shape around it for each link need half of them.
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
        counted = [piece for piece in members if piece.name not in enclosing]
        if len({isinstance(piece.geometry, coal.BVHModelBase) for piece in counted}) > 1:
            clause = "meshes and simple shapes of one link, none inside another: all count"
            remedy = "list `bodies` where one set is meant to replace the other"
            notes.append(Note(NoteKind.SHAPE, tuple(piece.name for piece in counted), clause, remedy))
    result = pin.GeometryModel()
    for piece in pieces.geometryObjects:
        if piece.name in enclosing:
            clause = f"left out: it lies inside {enclosing[piece.name]}, a shape of the same link"
            notes.append(Note(NoteKind.SHAPE, (piece.name,), clause))
        else:
            result.addGeometryObject(piece)
    return result


def _encloses(outer: Any, inner: Any) -> bool:
    """Return True if a piece lies inside another one, or is the same."""
    placement = outer.placement.actInv(inner.placement)
    is_mesh = isinstance(inner.geometry, coal.BVHModelBase)
    if placement.isIdentity(_ROUND_OFF) and type(inner.geometry) is type(outer.geometry):
        same = outer.meshPath == inner.meshPath and np.array_equal(outer.meshScale, inner.meshScale)
        if same if is_mesh else outer.geometry == inner.geometry:
            return True
    points = np.array(inner.geometry.vertices()) if is_mesh else hull_points(inner.geometry)
    return bool(_excess(outer.geometry, points @ placement.rotation.T + placement.translation).max() <= _ROUND_OFF)


def _excess(shape: Any, points: Array) -> Array:
    """Return an upper bound on how far points (n, 3) stand out of a simple shape (n,) [m]; negative inside."""
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
        case coal.Capsule():
            return np.asarray(np.hypot(radial, np.maximum(axial - shape.halfLength, 0.0)) - shape.radius)
    return np.full(len(points), np.inf)


def note_implausible_sizes(model: Any, pieces: Any, notes: list[Note]) -> None:
    """Note shapes and joint offsets of more than 20 m, and meshes of less than 1 mm: mostly they are in millimetres."""
    for piece in pieces.geometryObjects:
        size = float(np.max(2.0 * bounding_box(piece.geometry)[1]))
        is_mesh = isinstance(piece.geometry, coal.BVHModelBase)
        kind, clause, remedy = NoteKind.MESH if is_mesh else NoteKind.SHAPE, "", "sizes are in metres"
        if size > _LARGEST:
            clause = f"is {size:.4g} m across"
            remedy = 'if it is in millimetres give it scale="0.001 0.001 0.001"' if is_mesh else remedy
        elif is_mesh and size < _SMALLEST:
            clause, remedy = f"is {1000 * size:.3g} mm across", "if it is in metres take its scale out"
        if clause:
            notes.append(Note(kind, (piece.name,), clause, remedy, "warning"))
    for joint, placement in zip(model.names[1:], model.jointPlacements[1:], strict=True):
        offset = float(np.linalg.norm(placement.translation))
        if offset > _LARGEST:
            clause = f"stands {offset:.4g} m from the joint before it"
            notes.append(Note(NoteKind.JOINT, (joint,), clause, "origins are in metres", "warning"))
