"""Which shapes stand for a piece of collision geometry: the cheapest that stand out of it no farther than a bound."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Any, Literal

import coal
import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull, QhullError

from qpavoid.geometry.bodies import enclosing_capsule, hull, hull_points, surface_triangles
from qpavoid.geometry.capsules import CapsuleFit, extreme_points, fit_capsule
from qpavoid.geometry.decompose import decompose as convex_pieces
from qpavoid.geometry.decompose import merge
from qpavoid.geometry.meshes import convex_hull, corners, cut, hull_corners
from qpavoid.geometry.primitives import fit_box, fit_cylinder
from qpavoid.geometry.protrusion import Surface
from qpavoid.problem import Array

Bodies = Literal["auto", "capsule", "capsules", "convex"]
"""`auto`: the cheapest of the others for each piece; `capsule`: one each; `capsules`: up to `MAX_CAPSULES`, while each
further one saves enough; `convex`: hulls of meshes, primitives as they are."""

MAX_CAPSULES = 4
"""Capsules that one piece is cut into at most."""
MAX_VOLUME_RATIO = 2.0
"""Volume of one body, in units of the hull's, from which `auto` takes another one although it stands out little: on
small links, bounds in millimetres say nothing. A capsule around a cylinder takes 1.3 to 2, around a cube 2.7."""
_HARDLY_MORE = 1.1
"""Protrusion with which fewer bodies are taken where none is within the bound, in units of the least [-]."""
MIN_SAVING = 0.15
"""Part of the volume that a further capsule must save."""
_HULLS = 2, 4, 8, 16
"""Numbers of hulls that are tried."""
_DECOMPOSED, _SLABS = 2000, 4
"""Triangles of a mesh that several hulls are tried for, at most, and slabs that it is cut into along each axis: a
robot has dozens of meshes, and each takes a second."""
_CLOSED = 1e-3
"""Sum of a closed surface's area vectors, as a share of its area, that is rounding [-]."""
_CUTS = np.linspace(0.2, 0.8, 7)
"""Where cuts are tried along each principal axis, in parts of the extent."""
_COARSE = 24
"""Directions that are tried for each capsule while cuts are compared."""
_FINE = 4000
"""Triangles of a surface beyond which some stand for all while cuts are compared; what is cut, and enclosed, is all."""


@dataclass(frozen=True)
class Part:
    """A body, or one of several, that stands for a piece of geometry."""

    geometry: Any
    """coal geometry."""
    place: Any
    """Where it is: a pinocchio SE3."""
    is_exact: bool = False
    """Whether it is the piece itself, or the hull of its mesh."""

    @property
    def placed(self) -> tuple[Any, Any]:
        """As `Surface` takes it."""
        return self.geometry, self.place


def capsule_part(fit: CapsuleFit, place: Any) -> Part:
    """Return a capsule, or a sphere, that was fitted in a placed frame."""
    geometry = coal.Capsule(fit.radius, fit.length) if fit.length > 0.0 else coal.Sphere(fit.radius)
    return Part(geometry, place * pin.SE3(fit.rotation, np.asarray(fit.center)))


def fit_piece(geometry: Any, place: Any, how: Bodies, surface: Surface) -> tuple[Part, ...]:
    """Choose bodies that enclose a coal geometry entirely.

    `auto` takes the first of these, in the order of what they cost, that is within the bound: a capsule, a box, a
    cylinder, the hull, several capsules, several hulls. Capsules and boxes have closed forms with capsules, the others
    a search, and every further body has pairs with all others. Where none is within the bound, the first that stands
    out hardly more than the tightest of hull and several: hollows that no hull can follow are not worth more bodies.

    Args:
        geometry: the piece, in its own frame.
        place: where that is, a pinocchio SE3.
        how: which kind of bodies.
        surface: of the piece where it is, with the bound of `auto`.
    """
    exact = Part(hull(geometry), place, is_exact=True)
    if isinstance(geometry, coal.Sphere | coal.Capsule) or how == "convex":
        return (exact,)
    if how == "capsule":
        return (capsule_part(enclosing_capsule(geometry), place),)
    if how == "capsules":
        return _capsules(geometry, place)
    is_primitive = isinstance(geometry, coal.ShapeBase) and not isinstance(geometry, coal.ConvexBase)
    single = single_part(hull_points(geometry), place, surface, hull_volume(geometry), not is_primitive)
    if single is not None:
        return (single,)
    if isinstance(geometry, coal.ShapeBase):
        return (exact,)
    tried = list[tuple[float, tuple[Part, ...]]]()
    for parts in chain([(exact,)], _several(geometry, place)):
        placed = [part.placed for part in parts]
        if surface.holds(placed):
            return parts
        tried.append((surface.protrusion(placed), parts))
    least = min(protrusion for protrusion, _ in tried)
    return next(parts for protrusion, parts in tried if protrusion <= _HARDLY_MORE * least)


def single_part(points: Array, place: Any, surface: Surface, hulls: float, every_kind: bool) -> Part | None:
    """Return the cheapest single body around points (n, 3) that is within the bound, and not gross; None if none is.

    Args:
        points: in their frame [m].
        place: where that is, a pinocchio SE3.
        surface: of the geometry, with the bound.
        hulls: volume of the hulls of the geometry's pieces [m³].
        every_kind: whether boxes and cylinders are tried too.
    """

    def fits() -> Iterator[Part]:
        yield capsule_part(fit_capsule(points), place)
        for fit in (fit_box, fit_cylinder) if every_kind else ():
            geometry, own = fit(points)
            yield Part(geometry, place * own)

    for part in fits():
        if hull_volume(part.geometry) <= MAX_VOLUME_RATIO * hulls and surface.holds([part.placed]):
            return part
    return None


def _several(mesh: Any, place: Any) -> Iterator[tuple[Part, ...]]:
    """Yield several capsules, then more and more hulls, around a mesh whose own hull stands out too far."""
    yield _capsules(mesh, place)
    if mesh.num_tris > _DECOMPOSED:
        return
    pieces = convex_pieces(*corners(mesh), _HULLS[-1], 0.0, _SLABS)
    for count in _HULLS:
        yield tuple(Part(convex_hull(points), place) for points in merge(pieces, count))


def _capsules(geometry: Any, place: Any) -> tuple[Part, ...]:
    capsules = decompose(surface_triangles(geometry), enclosing_capsule(geometry))
    return tuple(capsule_part(fit, place) for fit in capsules)


def decompose(surface: Array, whole: CapsuleFit, most: int = MAX_CAPSULES) -> tuple[CapsuleFit, ...]:
    """Cover a body with capsules, fewer than `most` where more would not pay.

    The piece whose cut saves most is cut in two by a plane across one of its principal axes, again and again.
    Triangles are cut exactly, so that each capsule encloses the whole part of the surface on its side; what is inside
    a closed surface between two planes lies in the hull of the surface between them, and is enclosed as well.

    Args:
        surface: (t, 3, 3) corners of the triangles [m].
        whole: the capsule around all of it.
        most: number of capsules.
    """
    parts = [(surface, whole)]
    cuts = [_halves(surface)]
    while len(parts) < most:
        savings = [part[1].volume - sum(fit.volume for _, fit in two) for part, two in zip(parts, cuts, strict=True)]
        best = int(np.argmax(savings))
        if savings[best] < MIN_SAVING * sum(fit.volume for _, fit in parts):
            break
        parts[best : best + 1] = cuts[best]
        cuts[best : best + 1] = [_halves(half) for half, _ in cuts[best]]
    return tuple(fit for _, fit in parts)


def _halves(surface: Array) -> list[tuple[Array, CapsuleFit]]:
    """Cut a surface into the two halves with the least volume, each with its capsule; the whole if it cannot be."""
    plane = _best_cut(surface[:: len(surface) // _FINE + 1])
    halves = [surface] if plane is None else list(cut(surface, surface @ plane[0] - plane[1]))
    if not all(len(half) for half in halves):
        halves = [surface]
    return [(half, fit_capsule(hull_corners(half.reshape(-1, 3)))) for half in halves]


def _best_cut(surface: Array) -> tuple[Array, float] | None:
    """Find normal (3,) and height [m] of the plane whose halves have the least volume; None where no plane cuts."""
    points = hull_corners(surface.reshape(-1, 3))
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    best, least = None, np.inf
    for axis in axes:
        low, high = (points @ axis).min(), (points @ axis).max()
        for height in low + _CUTS * (high - low):
            halves = [
                extreme_points(half.reshape(-1, 3)) for half in cut(surface, surface @ axis - height) if len(half)
            ]
            volume = sum(fit_capsule(half, _COARSE).volume for half in halves)
            if len(halves) == 2 and volume < least:
                best, least = (axis, float(height)), volume
    return best


def hull_volume(geometry: Any) -> float:
    """Compute the volume of the convex hull of a coal geometry [m³]; 0 where it is flat."""
    if isinstance(geometry, coal.ShapeBase) and not isinstance(geometry, coal.ConvexBase):
        return float(geometry.computeVolume())
    try:
        return float(ConvexHull(hull_points(geometry)).volume)
    except QhullError:
        return 0.0


def inside_volume(geometry: Any) -> float:
    """Compute the volume that a coal geometry encloses [m³].

    Of a mesh its own, by the divergence theorem about the middle of its corners. A surface with holes, or whose
    triangles are not all turned outwards, counts as seen from there: as if each triangle bounded a full cone. Never
    more than the volume of its hull.
    """
    hull = hull_volume(geometry)
    if not isinstance(geometry, coal.BVHModelBase):
        return hull
    surface = surface_triangles(geometry)
    a, b, c = np.moveaxis(surface - surface.mean(axis=(0, 1)), 1, 0)
    cones, areas = np.einsum("ti,ti->t", a, np.cross(b, c)) / 6.0, np.cross(b - a, c - a)
    is_closed = np.linalg.norm(areas.sum(axis=0)) < _CLOSED * np.linalg.norm(areas, axis=1).sum()
    return min(float(abs(cones.sum()) if is_closed else np.abs(cones).sum()), hull)
