"""The bodies of a robot's links, as a robot.yaml lists them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.config import Body, Box, Capsule, Cylinder, Hull, Polytope, Sphere
from qpavoid.errors import matching
from qpavoid.geometry.bodies import hull_points
from qpavoid.geometry.capsules import CapsuleFit, fit_capsule
from qpavoid.geometry.protrusion import Surface
from qpavoid.problem import Array
from qpavoid.setup.fit import Bodies, Part, capsule_part, fit_piece, hull_volume, inside_volume, single_part

_DIGITS = 5
"""Decimals of lengths [m] and angles [rad] in files: 0.01 mm."""


@dataclass(frozen=True)
class Piece:
    """A piece of a robot's geometry, as its file has it."""

    name: str
    link: str
    geometry: Any
    """coal geometry."""
    placement: Any
    """In the frame of its link."""

    @cached_property
    def inside(self) -> float:
        """Volume that it encloses [m³]."""
        return inside_volume(self.geometry)


def pieces_of(geometry: Any, model: Any) -> list[Piece]:
    """List the pieces of a geometry model's objects, each in the frame of its link."""
    result = []
    for piece in geometry:
        frame = model.frames[piece.parentFrame]
        result.append(Piece(piece.name, frame.name, piece.geometry, frame.placement.actInv(piece.placement)))
    return result


@dataclass(frozen=True)
class LinkBodies:
    """The bodies of one link."""

    bodies: tuple[Body, ...]
    volume: float
    """Of all of them, what overlaps counted twice [m³]."""
    hulls: float
    """Of the convex hulls of the link's pieces [m³]."""
    inside: float
    """Of what the link's pieces enclose, meshes as they are [m³]."""
    protrusion: float
    """How far they stand out of the link's pieces [m]."""
    spacing: float
    """Distance of the samples by which that was found [m]."""
    bound: float
    """How far they may, in `auto` [m]."""

    @property
    def limit(self) -> float:
        """That bound, or what samples can tell where it is less [m]."""
        return max(self.bound, self.spacing)


def kinds_of_links(pieces: Sequence[Piece], kind: Bodies, by_pattern: Mapping[str, Bodies]) -> dict[str, Bodies]:
    """Choose the kind of bodies of each link with geometry; of several patterns that match one, the last one holds.

    Raises:
        UnknownName: a pattern without a link.
    """
    kinds = {piece.link: kind for piece in pieces}
    for pattern, chosen in by_pattern.items():
        kinds.update(dict.fromkeys(matching([pattern], kinds, "--bodies: no link with geometry"), chosen))
    return kinds


def bodies_of_link(pieces: Sequence[Piece], link: str, kind: Bodies, bound: float) -> LinkBodies:
    """Fit bodies that enclose all pieces of a link.

    One body around all pieces takes the place of several where it has no more volume than they have, or, in `auto`,
    where it is within the bound and not gross.

    Args:
        pieces: of the robot.
        link: name of the link.
        kind: kind of bodies.
        bound: how far bodies of `auto` may stand out of the pieces [m].
    """
    pieces = [piece for piece in pieces if piece.link == link]
    surface = Surface([(piece.geometry, piece.placement) for piece in pieces], bound)
    hulls = sum(hull_volume(piece.geometry) for piece in pieces)
    chosen = list[tuple[Piece, Part]]()
    for piece in pieces:
        own = surface if len(pieces) == 1 else Surface([(piece.geometry, piece.placement)], bound)
        chosen += [(piece, part) for part in fit_piece(piece.geometry, piece.placement, kind, own)]
    if len(chosen) > 1 and kind != "convex":
        points = [
            hull_points(piece.geometry) @ piece.placement.rotation.T + piece.placement.translation for piece in pieces
        ]
        whole = _whole(np.concatenate(points), kind, surface, hulls, _volume(part for _, part in chosen))
        chosen = chosen if whole is None else [(pieces[0], whole)]
    parts = [part for _, part in chosen]
    names = [link] if len(parts) == 1 else [f"{link}_{index}" for index in range(len(parts))]
    bodies = [
        Body(name=name, frame=link, **_fields(part, piece)) for name, (piece, part) in zip(names, chosen, strict=True)
    ]
    return LinkBodies(
        tuple(bodies), _volume(parts), hulls, sum(piece.inside for piece in pieces),
        surface.protrusion([part.placed for part in parts]), surface.spacing, bound,
    )  # fmt: skip


def _whole(points: Array, kind: Bodies, surface: Surface, hulls: float, volume: float) -> Part | None:
    """Return the one body that may take the place of several, which have a volume [m³]."""
    if kind == "auto":
        return single_part(points, pin.SE3.Identity(), surface, hulls, every_kind=True)
    capsule = capsule_part(fit_capsule(points), pin.SE3.Identity())
    return capsule if hull_volume(capsule.geometry) <= volume else None


def _volume(parts: Iterable[Part]) -> float:
    return sum(hull_volume(part.geometry) for part in parts)


def _fields(part: Part, piece: Piece) -> dict[str, Any]:
    """Return the fields of a `Body`, in the frame of the link."""
    geometry, place = part.geometry, part.place
    match geometry:
        case coal.Sphere():
            return capsule_fields(CapsuleFit(place.translation, place.rotation, geometry.radius, 0.0))
        case coal.Capsule():
            length = 2.0 * geometry.halfLength
            return capsule_fields(CapsuleFit(place.translation, place.rotation, geometry.radius, length))
        case coal.Box():
            x, y, z = (_up(2.0 * half) for half in geometry.halfSide)
            shape: Any = Box(size=(x, y, z))
        case coal.Cylinder():
            shape = Cylinder(radius=_up(geometry.radius), length=_up(2.0 * geometry.halfLength))
        case coal.ConvexBase() if not part.is_exact:
            corners = np.array(geometry.points()) @ place.rotation.T + place.translation
            return {"shape": Polytope(corners=(np.round(corners, _DIGITS + 1) + 0.0).tolist())}
        case _:
            return {"shape": Hull(geometry=piece.name)}
    angles, origin = pin.rpy.matrixToRpy(place.rotation), place.translation
    position, rpy = (np.round(numbers, 2 * _DIGITS) + 0.0 for numbers in (origin, angles))  # no -0.0
    return {"shape": shape, "position": tuple(position.tolist()), "rpy": tuple(rpy.tolist())}


def capsule_fields(fit: CapsuleFit) -> dict[str, Any]:
    """Return the fields of a `Body` that encloses a capsule, with five decimals.

    The radius makes up for the rounding of everything else, so that what was enclosed stays so.
    """
    axis, center = fit.rotation[:, 2], np.asarray(fit.center)
    position = np.round(center, _DIGITS) + 0.0  # no -0.0
    length = round(fit.length, _DIGITS)
    pitch, yaw = round(math.acos(np.clip(axis[2], -1.0, 1.0)), _DIGITS), round(math.atan2(axis[1], axis[0]), _DIGITS)
    if length == 0.0:
        pitch = yaw = 0.0
    axis_rounded = np.array([math.cos(yaw) * math.sin(pitch), math.sin(yaw) * math.sin(pitch), math.cos(pitch)])
    shift = np.linalg.norm(position - center) + 0.5 * np.linalg.norm(length * axis_rounded - fit.length * axis)
    radius = math.ceil((fit.radius + float(shift)) * 10**_DIGITS) / 10**_DIGITS
    shape = Capsule(radius=radius, length=length) if length > 0.0 else Sphere(radius=radius)
    return {"shape": shape, "position": tuple(position.tolist()), "rpy": (0.0, pitch, yaw)}


def _up(size: float) -> float:
    """Round a size up, but for rounding errors."""
    return float(math.ceil(size * 10**_DIGITS - 1e-6) / 10**_DIGITS)
