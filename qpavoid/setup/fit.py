"""Which shapes stand for a piece of collision geometry: one capsule, several, or its convex hull."""

from __future__ import annotations

from typing import Any, Literal

import coal
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from qpavoid.geometry.bodies import enclosing_capsule, hull_points, surface_triangles
from qpavoid.geometry.capsules import CapsuleFit, extreme_points, fit_capsule
from qpavoid.geometry.meshes import cut, hull_corners
from qpavoid.problem import Array

Bodies = Literal["auto", "capsule", "capsules", "convex"]
"""`auto`: the leanest of the others for each piece; `capsule`: one each; `capsules`: up to `MAX_CAPSULES`, while each
further one saves enough; `convex`: hulls of meshes, primitives as they are."""

MAX_CAPSULES = 4
"""Capsules that one piece is cut into at most."""
MAX_VOLUME_RATIO = 2.0
"""Volume of capsules, in units of the hull's, from which `auto` takes the hull instead, although a hull costs a pair
twenty times what a capsule costs. A capsule around a cylinder takes 1.3 to 2, around a cube 2.7."""
MIN_CONCAVITY = 1.5
"""Volume of a mesh's hull, in units of what the mesh encloses, from which `auto` compares several capsules [-]."""
MIN_SAVING = 0.15
"""Part of the volume that a further capsule must save."""
_CLOSED = 1e-3
"""Sum of a closed surface's area vectors, as a share of its area, that is rounding [-]."""
_CUTS = np.linspace(0.2, 0.8, 7)
"""Where cuts are tried along each principal axis, in parts of the extent."""
_COARSE = 24
"""Directions that are tried for each capsule while cuts are compared."""
_FINE = 4000
"""Triangles of a surface beyond which some stand for all while cuts are compared; what is cut, and enclosed, is all."""


def fit_piece(geometry: Any, how: Bodies, inside: float | None = None) -> tuple[CapsuleFit, ...]:
    """Fit capsules that enclose a coal geometry entirely, in its own frame; `inside` is its `inside_volume` [m³].

    None where its hull, or the primitive itself, is to stand for it.
    """
    if isinstance(geometry, coal.Sphere | coal.Capsule):
        return (enclosing_capsule(geometry),)
    if how == "convex":
        return ()
    one = enclosing_capsule(geometry)
    if how == "capsule":
        return (one,)
    if how == "capsules":
        return decompose(surface_triangles(geometry), one)
    hull, is_mesh = hull_volume(geometry), isinstance(geometry, coal.BVHModelBase)
    is_gross = one.volume > MAX_VOLUME_RATIO * hull
    is_concave = is_mesh and hull > MIN_CONCAVITY * (inside_volume(geometry) if inside is None else inside)
    if is_concave or (is_gross and (is_mesh or isinstance(geometry, coal.ConvexBase))):
        several = decompose(surface_triangles(geometry), one)
        volume = sum(fit.volume for fit in several)
        if is_concave and volume < min(hull, one.volume):  # they may follow a bend that the hull spans
            return several
        if is_gross and volume <= MAX_VOLUME_RATIO * hull:
            return several
    return () if is_gross else (one,)  # boxes and cylinders are exact as they are


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
