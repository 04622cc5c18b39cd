"""Which shapes stand for a piece of collision geometry: one capsule, several, or its convex hull."""

from __future__ import annotations

from typing import Any, Literal

import coal
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from qpavoid.geometry.bodies import enclosing_capsule, hull_points
from qpavoid.geometry.capsules import CapsuleFit, extreme_points, fit_capsule
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
_FINE, _GRID = 4000, 32
"""Triangles from which cuts are chosen on a coarser surface, and cells of that along its longest side; what is cut,
and enclosed, is the surface itself."""


def fit_piece(geometry: Any, how: Bodies, inside: float | None = None) -> tuple[CapsuleFit, ...]:
    """Fit capsules that enclose a coal geometry entirely.

    None where its hull, or the primitive itself, is to stand for it.

    Args:
        geometry: as read from a URDF.
        how: which kind of shapes.
        inside: `inside_volume` of the geometry, where it is known [m³].

    Returns:
        Capsules in the geometry's own frame.
    """
    if isinstance(geometry, coal.Sphere | coal.Capsule):
        return (enclosing_capsule(geometry),)
    if how == "convex":
        return ()
    one = enclosing_capsule(geometry)
    if how == "capsule":
        return (one,)
    if how == "capsules":
        return decompose(triangles(geometry), one)
    hull, is_mesh = hull_volume(geometry), isinstance(geometry, coal.BVHModelBase)
    is_gross = one.volume > MAX_VOLUME_RATIO * hull
    is_concave = is_mesh and hull > MIN_CONCAVITY * (inside_volume(geometry) if inside is None else inside)
    if is_concave or (is_gross and (is_mesh or isinstance(geometry, coal.ConvexBase))):
        several = decompose(triangles(geometry), one)
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
        savings = [part[1].volume - sum(fit.volume for _, fit in cut) for part, cut in zip(parts, cuts, strict=True)]
        best = int(np.argmax(savings))
        if savings[best] < MIN_SAVING * sum(fit.volume for _, fit in parts):
            break
        parts[best : best + 1] = cuts[best]
        cuts[best : best + 1] = [_halves(half) for half, _ in cuts[best]]
    return tuple(fit for _, fit in parts)


def _halves(surface: Array) -> list[tuple[Array, CapsuleFit]]:
    """Cut a surface into the two halves with the least volume, each with its capsule; the whole if it cannot be."""
    plane = _best_cut(_coarse(surface))
    halves = [surface] if plane is None else [cut(surface, *plane, side) for side in (-1.0, 1.0)]
    if not all(len(half) for half in halves):
        halves = [surface]
    return [(half, fit_capsule(_corners(half))) for half in halves]


def _best_cut(surface: Array) -> tuple[Array, float] | None:
    """Find normal (3,) and height [m] of the plane whose halves have the least volume; None where no plane cuts."""
    points = _corners(surface)
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    candidates = []
    for axis in axes:
        low, high = (points @ axis).min(), (points @ axis).max()
        for height in low + _CUTS * (high - low):
            halves = [cut(surface, axis, height, side) for side in (-1.0, 1.0)]
            if all(len(half) for half in halves):
                volume = sum(fit_capsule(extreme_points(half.reshape(-1, 3)), _COARSE).volume for half in halves)
                candidates.append((volume, axis, float(height)))
    return min(candidates, key=lambda candidate: candidate[0])[1:] if candidates else None


def _coarse(surface: Array) -> Array:
    """Coarsen a surface of many triangles: corners on a grid, without triangles that vanish or coincide."""
    if len(surface) <= _FINE:
        return surface
    low, cell = surface.min(axis=(0, 1)), float(np.ptp(surface.reshape(-1, 3), axis=0).max()) / _GRID
    index = np.round(surface / cell).astype(np.int64)
    index -= index.min(axis=(0, 1))
    corners = np.sort(index @ [1, 1024, 1024 * 1024], axis=1)
    is_solid = (np.diff(corners, axis=1) > 0).all(axis=1)
    first = np.unique(corners[is_solid], axis=0, return_index=True)[1]
    return np.asarray(low + cell * index[is_solid][np.sort(first)]) if len(first) else surface[:_FINE]


def cut(surface: Array, normal: Array, height: float, side: float) -> Array:
    """Return the part of a surface on one side of the plane normalᵀx = height (t, 3, 3).

    Triangles are cut at the plane.

    Args:
        surface: (t, 3, 3) corners of triangles [m].
        normal: (3,) of the plane.
        height: of the plane along it [m].
        side: 1 keeps what is above, -1 what is below.
    """
    above = side * (surface @ normal - height)
    is_cut = (above > 0.0).any(axis=1) & (above < 0.0).any(axis=1)
    parts = [surface[(above >= 0.0).all(axis=1)]]
    for turn in range(3):  # each corner in turn as the one that is alone on its side
        a, b, c = np.moveaxis(np.roll(surface[is_cut], turn, axis=1), 1, 0)
        h_a, h_b, h_c = np.roll(above[is_cut], turn, axis=1).T
        is_single = (h_a > 0.0) & (h_b <= 0.0) & (h_c <= 0.0)
        is_double = (h_a < 0.0) & (h_b > 0.0) & (h_c > 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            ab = a + (h_a / (h_a - h_b))[:, None] * (b - a)
            ac = a + (h_a / (h_a - h_c))[:, None] * (c - a)
        parts.append(np.stack((a, ab, ac), axis=1)[is_single])
        parts += [np.stack((ab, b, c), axis=1)[is_double], np.stack((ab, c, ac), axis=1)[is_double]]
    return np.concatenate(parts)


def triangles(geometry: Any) -> Array:
    """Return the triangles of a coal geometry's surface (t, 3, 3) [m]; those of its hull where it is no mesh."""
    if isinstance(geometry, coal.BVHModelBase):
        corners, index = np.array(geometry.vertices()), map(geometry.tri_indices, range(geometry.num_tris))
        return corners[np.array([(t[0], t[1], t[2]) for t in index], dtype=np.intp)]
    points = hull_points(geometry)
    return np.asarray(points[ConvexHull(points).simplices])


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
    surface = triangles(geometry)
    a, b, c = np.moveaxis(surface - surface.mean(axis=(0, 1)), 1, 0)
    cones, areas = np.einsum("ti,ti->t", a, np.cross(b, c)) / 6.0, np.cross(b - a, c - a)
    is_closed = np.linalg.norm(areas.sum(axis=0)) < _CLOSED * np.linalg.norm(areas, axis=1).sum()
    return min(float(abs(cones.sum()) if is_closed else np.abs(cones).sum()), hull)


def _corners(surface: Array) -> Array:
    """Return the corners of the hull of a surface (n, 3); all of its points where it is flat."""
    points = surface.reshape(-1, 3)
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:
        return points
