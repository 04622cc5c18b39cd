"""The bodies of a robot's links, as a robot.yaml lists them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.config import Body, Box, Capsule, Cylinder, Hull, Sphere
from qpavoid.errors import matching
from qpavoid.geometry.bodies import hull_points
from qpavoid.geometry.capsules import CapsuleFit, fit_capsule
from qpavoid.setup.fit import MAX_VOLUME_RATIO, Bodies, fit_piece, hull_volume, inside_volume

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


def kinds_of_links(pieces: Sequence[Piece], kind: Bodies, by_pattern: Mapping[str, Bodies]) -> dict[str, Bodies]:
    """Choose the kind of bodies of each link with geometry; of several patterns that match one, the last one holds.

    Raises:
        UnknownName: a pattern without a link.
    """
    kinds = {piece.link: kind for piece in pieces}
    for pattern, chosen in by_pattern.items():
        kinds.update(dict.fromkeys(matching([pattern], kinds, "--bodies: no link with geometry"), chosen))
    return kinds


def bodies_of_link(pieces: Sequence[Piece], link: str, kind: Bodies) -> LinkBodies:
    """Fit bodies that enclose all pieces of a link.

    One capsule around all pieces takes the place of several shapes where it has no more volume than they have, or, in
    `auto`, where it is not too large.
    """
    pieces = [piece for piece in pieces if piece.link == link]
    hulls = [hull_volume(piece.geometry) for piece in pieces]
    shapes, volume = list[dict[str, Any]](), 0.0
    for piece, hull in zip(pieces, hulls, strict=True):
        fit = fit_piece(piece.geometry, kind, piece.inside)
        shapes += [capsule_fields(capsule, piece.placement) for capsule in fit] or [_exact_fields(piece)]
        volume += sum(capsule.volume for capsule in fit) if fit else hull
    if len(shapes) > 1 and kind != "convex":
        points = [
            hull_points(piece.geometry) @ piece.placement.rotation.T + piece.placement.translation for piece in pieces
        ]
        whole = fit_capsule(np.concatenate(points))
        if whole.volume <= max(volume, MAX_VOLUME_RATIO * sum(hulls) if kind == "auto" else 0.0):
            shapes, volume = [capsule_fields(whole, pin.SE3.Identity())], whole.volume
    names = [link] if len(shapes) == 1 else [f"{link}_{index}" for index in range(len(shapes))]
    bodies = [Body(name=name, frame=link, **shape) for name, shape in zip(names, shapes, strict=True)]
    return LinkBodies(tuple(bodies), volume, sum(hulls), sum(piece.inside for piece in pieces))


def capsule_fields(fit: CapsuleFit, placement: Any) -> dict[str, Any]:
    """Return the fields of a `Body` that encloses a capsule in a placed frame, with five decimals.

    The radius makes up for the rounding of everything else, so that what was enclosed stays so.
    """
    axis = placement.rotation @ fit.rotation[:, 2]
    center = placement.act(np.asarray(fit.center))
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


def _exact_fields(piece: Piece) -> dict[str, Any]:
    """Return the fields of a `Body` that is a primitive, or the hull of a mesh."""
    geometry = piece.geometry
    if isinstance(geometry, coal.Box):
        x, y, z = (_up(2.0 * half) for half in geometry.halfSide)
        shape: Any = Box(size=(x, y, z))
    elif isinstance(geometry, coal.Cylinder):
        shape = Cylinder(radius=_up(geometry.radius), length=_up(2.0 * geometry.halfLength))
    else:
        return {"shape": Hull(geometry=piece.name)}
    angles, origin = pin.rpy.matrixToRpy(piece.placement.rotation), piece.placement.translation
    position, rpy = (np.round(numbers, 2 * _DIGITS) + 0.0 for numbers in (origin, angles))  # no -0.0
    return {"shape": shape, "position": tuple(position.tolist()), "rpy": tuple(rpy.tolist())}


def _up(size: float) -> float:
    """Round a size up, but for rounding errors."""
    return float(math.ceil(size * 10**_DIGITS - 1e-6) / 10**_DIGITS)
