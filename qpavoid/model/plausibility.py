"""Sizes that no robot has: mostly of meshes in millimetres that are read in metres."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np

from qpavoid.geometry.bodies import bounding_box
from qpavoid.model.notes import Note, NoteKind

_LARGEST = 20.0
"""Size of a shape, and distance of a joint from the one before it [m], that only cranes reach."""
_SMALLEST = 1e-3
"""Size of a mesh that is hardly meant [m]; a screw is larger."""
_MILLIMETRES = 'if it is in millimetres give it scale="0.001 0.001 0.001"'


def note_implausible_sizes(model: Any, pieces: Any, notes: list[Note]) -> None:
    """Note shapes and joint offsets of more than 20 m, and meshes of less than 1 mm.

    Args:
        model: Pinocchio model.
        pieces: its geometry model.
        notes: they are added to these.
    """
    for piece in pieces.geometryObjects:
        if isinstance(piece.geometry, coal.Halfspace | coal.Plane):
            continue
        size = float(np.max(2.0 * bounding_box(piece.geometry)[1]))
        mesh = isinstance(piece.geometry, coal.BVHModelBase)
        kind, remedy = (NoteKind.MESH, _MILLIMETRES) if mesh else (NoteKind.SHAPE, "sizes are in metres")
        if size > _LARGEST:
            notes.append(Note(kind, (piece.name,), f"is {size:.4g} m across", remedy, "warning"))
        elif mesh and size < _SMALLEST:
            clause = f"is {1000 * size:.3g} mm across"
            notes.append(Note(kind, (piece.name,), clause, "if it is in metres take its scale out", "warning"))
    placements = list(model.jointPlacements)
    for joint, placement in zip(list(model.names)[1:], placements[1:], strict=True):
        offset = float(np.linalg.norm(placement.translation))
        if offset > _LARGEST:
            clause = f"stands {offset:.4g} m from the joint before it"
            notes.append(Note(NoteKind.JOINT, (joint,), clause, "origins are in metres", "warning"))
