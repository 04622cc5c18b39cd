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

    def warn(kind: NoteKind, name: str, clause: str, remedy: str) -> None:
        notes.append(Note(kind, (name,), clause, remedy, "warning"))

    for piece in pieces.geometryObjects:
        size = float(np.max(2.0 * bounding_box(piece.geometry)[1]))
        mesh = isinstance(piece.geometry, coal.BVHModelBase)
        if size > _LARGEST:
            kind, remedy = (NoteKind.MESH, _MILLIMETRES) if mesh else (NoteKind.SHAPE, "sizes are in metres")
            warn(kind, piece.name, f"is {size:.4g} m across", remedy)
        elif mesh and size < _SMALLEST:
            warn(NoteKind.MESH, piece.name, f"is {1000 * size:.3g} mm across", "if it is in metres take its scale out")
    for joint, placement in zip(model.names[1:], model.jointPlacements[1:], strict=True):
        offset = float(np.linalg.norm(placement.translation))
        if offset > _LARGEST:
            warn(NoteKind.JOINT, joint, f"stands {offset:.4g} m from the joint before it", "origins are in metres")
