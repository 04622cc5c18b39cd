"""The collision bodies of a robot: fitted to the shapes of its file, or listed one by one in its robot.yaml."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.config import Body, Hull, Polytope, RobotConfig
from qpavoid.errors import ConfigError, require_known
from qpavoid.geometry.bodies import convert_bodies, hull, make_shape, triangle_meshes
from qpavoid.geometry.meshes import convex_hull
from qpavoid.model.joints import frame_index
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.packages import absolute_entries
from qpavoid.model.shape_checks import note_implausible_sizes
from qpavoid.model.trajectory import rpy_to_matrix
from qpavoid.model.urdf import missing_meshes, read_pieces


def robot_bodies(config: RobotConfig, urdf: Path, model: Any, path: Path, notes: list[Note]) -> Any:
    """Make the geometry model of the collision bodies that a robot.yaml asks for.

    What was left out or replaced is added to the notes.

    Raises:
        ConfigError, UnknownName: a shape that cannot be read, a frame or a piece of geometry that does not exist.
    """
    package_dirs, listed = absolute_entries(config.package_dirs, path.parent), not isinstance(config.bodies, str)

    def read() -> Any:
        notes_of_pieces = [] if listed else notes  # what is not listed is left out on purpose
        return read_pieces(
            urdf, model, package_dirs, path, notes_of_pieces,
            visuals=config.visuals, allow_missing=config.allow_missing_meshes, enclosed=listed,
        )  # fmt: skip

    if not isinstance(config.bodies, str):
        if config.allow_missing_meshes:
            notes += _left_out_of_list(config, urdf, model, package_dirs)
        hulls = any(isinstance(body.shape, Hull) for body in config.bodies)
        return _listed_bodies(config.bodies, model, read().geometryObjects if hulls else (), path)
    pieces = read()
    note_implausible_sizes(model, pieces, notes)
    bodies = convert_bodies(pieces, config.bodies)
    if meshes := triangle_meshes(bodies):
        clause = (
            f"{len(meshes)} triangle meshes cost 100 to 500 µs a pair at every step, some pairs several ms, convex "
            "hulls about 1 µs, capsules 0.1 µs"
        )
        remedy = "set `bodies` to convex or capsule"
        notes.append(Note(NoteKind.MESH, tuple(meshes), clause, remedy, "warning"))
    return bodies


def _left_out_of_list(config: RobotConfig, urdf: Path, model: Any, package_dirs: Sequence[str]) -> list[Note]:
    """Note meshes that are missing still, and links that were left out of the list since theirs was missing."""
    notes, links = missing_meshes(urdf, model, package_dirs, config.visuals)
    assert not isinstance(config.bodies, str)
    listed = {body.frame for body in config.bodies}
    if bare := tuple(link for link in links if link not in listed):
        clause = "none of the listed bodies is theirs, though their shapes are at hand: nothing keeps clear of them"
        remedy = "list some, as `qpavoid robot add` does; or set `allow_missing_meshes: false` if none is meant"
        notes.append(Note(NoteKind.LINK, bare, clause, remedy, "warning"))
    return notes


def _listed_bodies(configs: Sequence[Body], model: Any, pieces: Sequence[Any], path: Path) -> Any:
    """Make bodies of the shapes of a robot.yaml, or of pieces of the URDF that they name."""
    named = {piece.name: piece for piece in pieces}
    bodies = pin.GeometryModel()
    for index, body in enumerate(configs):
        where = f"{path}: bodies.{index}"
        if not model.existFrame(body.frame):
            links = [frame.name for frame in model.frames if frame.type == pin.BODY]
            require_known(body.frame, links, f"{where}.frame: no frame")
        if bodies.existGeometryName(body.name):
            raise ConfigError(f"{where}.name: {body.name!r} is given twice: names must differ")
        frame_id = frame_index(model, body.frame)
        frame = model.frames[frame_id]
        placement = frame.placement * pin.SE3(rpy_to_matrix(body.rpy), np.array(body.position))
        if isinstance(body.shape, Hull):
            name = body.shape.geometry
            require_known(name, named, f"{where}.shape.geometry: no collision geometry")
            geometry = hull(named[name].geometry)
            placement = placement * model.frames[named[name].parentFrame].placement.actInv(named[name].placement)
        elif isinstance(body.shape, Polytope):
            geometry = convex_hull(np.array(body.shape.corners))
        else:
            geometry = make_shape(body.shape)
        bodies.addGeometryObject(pin.GeometryObject(body.name, frame.parentJoint, frame_id, placement, geometry))
    return bodies


def pair_margins(config: RobotConfig, bodies: Any, path: Path) -> dict[frozenset[str], float]:
    """Return the safety distances of pairs of bodies that have one of their own [m]."""
    names = [body.name for body in bodies.geometryObjects]
    for index, own in enumerate(config.pair_margins):
        for name in own.bodies:
            require_known(name, names, f"{path}: pair_margins.{index}.bodies: no body")
    return {frozenset(own.bodies): own.d1 for own in config.pair_margins}
