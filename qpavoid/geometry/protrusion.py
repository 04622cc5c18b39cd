"""How far bodies stand out of the geometry that they stand for: their protrusion, a one-sided Hausdorff distance.

Both surfaces are sampled, that of the bodies where no other body of them covers it; of each sample of the bodies that
is not inside the geometry, the distance to the nearest sample of the geometry counts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import coal
import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from qpavoid.geometry.bodies import hull_points, surface_triangles
from qpavoid.geometry.capsules import half_sphere
from qpavoid.geometry.meshes import normals
from qpavoid.problem import Array

Placed = tuple[Any, Any]
"""A coal geometry, and where it is: a pinocchio SE3."""

SAMPLES_IN_BOUND = 4
"""Samples along the length of a bound: a figure at the bound is then too large by less than 1 %, one of 0 by an eighth
of the bound, and misses what is between the samples of the body, an eighth of the bound as well."""
_MAX_SAMPLES = 40_000
"""Of the geometry of a link, about: their distances grow beyond the above where it is large."""
_FIRST = 16
"""Every so many samples of a body are looked at first: most bodies that stand out too far are found so."""
_ORIENTED = 4000
"""Points that stand for a surface where it is asked whether it winds around something."""
_CHUNK = 100
"""Samples of which it is found at a time whether they are inside."""
_NEXT_TO_NOTHING = 1e-6
"""Height above a body at which a sample counts as covered by another one [m]."""


class Surface:
    """The surface of a link's geometry, to compare bodies with."""

    def __init__(self, pieces: Sequence[Placed], bound: float) -> None:
        """Sample the surface.

        Args:
            pieces: the geometry.
            bound: largest protrusion that is of interest [m]: the samples are a quarter of it apart, or more where
                there would be too many.
        """
        area = sum(_area(geometry) for geometry, _ in pieces)
        self.bound = bound
        self.spacing = max(bound / SAMPLES_IN_BOUND, float(np.sqrt(area / _MAX_SAMPLES)))
        """Distance of samples of both surfaces [m]."""
        self._tree = cKDTree(np.concatenate([_placed(piece, self.spacing)[0] for piece in pieces]))
        self._points, self._areas = _oriented_areas(
            np.concatenate(
                [surface_triangles(geometry) @ place.rotation.T + place.translation for geometry, place in pieces]
            )
        )

    def holds(self, bodies: Sequence[Placed]) -> bool:
        """Return True if no body stands out farther than the bound, or than samples can tell."""
        limit = max(self.bound, self.spacing)
        samples = self._samples(bodies)
        for chosen in (samples[::_FIRST], samples):
            far = chosen[np.isinf(self._tree.query(chosen, distance_upper_bound=limit)[0])]
            if any(not self._encloses(points).all() for points in _in_chunks(far)):
                return False
        return True

    def protrusion(self, bodies: Sequence[Placed]) -> float:
        """Return how far the bodies stand out of the geometry [m]."""
        samples = self._samples(bodies)
        distances = self._tree.query(samples)[0]
        order = np.argsort(-distances)
        for chosen in _in_chunks(order):
            is_inside = self._encloses(samples[chosen])
            if not is_inside.all():
                return float(distances[chosen[int(np.argmin(is_inside))]])
        return 0.0

    def _encloses(self, points: Array) -> Array:
        """Tell which points (n, 3), not too close to the surface, are inside the geometry (n,): it winds around them.

        Of a surface with holes, more than half of all directions have to meet it.
        """
        offsets = self._points - points[:, None]
        solid_angles = (
            np.einsum("nki,ki->nk", offsets, self._areas) / np.maximum(np.linalg.norm(offsets, axis=2), 1e-9) ** 3
        )
        return np.asarray(np.abs(solid_angles.sum(axis=1)) > 2.0 * np.pi)

    def _samples(self, bodies: Sequence[Placed]) -> Array:
        """Sample the surface of the union of some bodies (n, 3)."""
        parts = []
        for number, body in enumerate(bodies):
            points, outwards = _placed(body, self.spacing)
            above = points + _NEXT_TO_NOTHING * outwards
            for other, (geometry, place) in enumerate(bodies):
                if other != number and len(points):
                    is_free = np.logical_not(_is_inside(geometry, (above - place.translation) @ place.rotation))
                    points, above = points[is_free], above[is_free]
            parts.append(points)
        return np.concatenate(parts)


def _oriented_areas(triangles: Array) -> tuple[Array, Array]:
    """Spread points evenly over triangles (t, 3, 3): points (k, 3) [m], and area vectors that they stand for [m²]."""
    vectors = 0.5 * normals(triangles)
    areas = np.linalg.norm(vectors, axis=1)
    total, k = np.cumsum(areas), np.arange(_ORIENTED)
    chosen = np.minimum(np.searchsorted(total, (k + 0.5) / _ORIENTED * total[-1]), len(areas) - 1)
    u, v = (0.5 + 0.754877666 * k) % 1.0, (0.5 + 0.569840291 * k) % 1.0  # Roberts' sequence, which leaves no gaps
    u, v = np.where(u + v > 1.0, (1.0 - u, 1.0 - v), (u, v))
    a, b, c = np.moveaxis(triangles[chosen], 1, 0)
    scale = total[-1] / _ORIENTED / np.maximum(areas[chosen], 1e-300)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), vectors[chosen] * scale[:, None]


def _in_chunks(items: Any) -> Iterator[Any]:
    """Yield some of the items at a time: what they are compared with takes memory."""
    for start in range(0, len(items), _CHUNK):
        yield items[start : start + _CHUNK]


def surface_samples(geometry: Any, spacing: float) -> tuple[Array, Array]:
    """Sample the surface of a coal geometry.

    Args:
        geometry: in its own frame.
        spacing: largest distance of neighbours, about [m].

    Returns:
        Points (n, 3) [m] and the normals there (n, 3).
    """
    match geometry:
        case coal.Sphere():
            directions = _directions(geometry.radius, spacing)
            return geometry.radius * directions, directions
        case coal.Ellipsoid():
            radii = np.asarray(geometry.radii)
            directions = _directions(float(radii.max()), spacing)
            outwards = directions / radii
            return radii * directions, outwards / np.linalg.norm(outwards, axis=1, keepdims=True)
        case coal.Capsule():
            directions = _directions(geometry.radius, spacing)
            caps = geometry.radius * directions
            caps[:, 2] += np.copysign(geometry.halfLength, directions[:, 2])
            side, outwards = _side(geometry.radius, geometry.halfLength, spacing)
            return np.concatenate((caps, side)), np.concatenate((directions, outwards))
        case coal.Cylinder():
            side, outwards = _side(geometry.radius, geometry.halfLength, spacing)
            rings = np.arange(int(np.ceil(geometry.radius / spacing)))[::-1] * spacing
            discs = [_side(r, geometry.halfLength, 2.0 * geometry.halfLength, spacing)[0] for r in rings]
            flat = np.concatenate(discs)
            return np.concatenate((side, flat)), np.concatenate((outwards, np.sign(flat) * [0.0, 0.0, 1.0]))
    parts = list(_triangle_samples(surface_triangles(geometry), spacing))
    return np.concatenate([points for points, _ in parts]), np.concatenate([outwards for _, outwards in parts])


def _placed(body: Placed, spacing: float) -> tuple[Array, Array]:
    geometry, place = body
    points, outwards = surface_samples(geometry, spacing)
    return points @ place.rotation.T + place.translation, outwards @ place.rotation.T


def _directions(radius: float, spacing: float) -> Array:
    """Return unit vectors that are so far apart on a sphere (n, 3)."""
    half = half_sphere(max(int(2.0 * np.pi * (radius / spacing) ** 2), 30))
    return np.concatenate((half, -half))


def _side(radius: float, half_length: float, along: float, around: float | None = None) -> tuple[Array, Array]:
    """Sample the side of a cylinder, at distances `along` the axis and `around` it."""
    count = max(int(np.ceil(2.0 * np.pi * radius / (around or along))), 1 if radius == 0.0 else 12)
    angles = 2.0 * np.pi / count * np.arange(count)
    heights = np.linspace(-half_length, half_length, int(np.ceil(2.0 * half_length / along)) + 1)
    outwards = np.column_stack((np.cos(angles), np.sin(angles), np.zeros(count)))
    points = radius * outwards[:, None] + heights[:, None] * np.array([0.0, 0.0, 1.0])
    return points.reshape(-1, 3), np.repeat(outwards, len(heights), axis=0)


def _triangle_samples(triangles: Array, spacing: float) -> Iterator[tuple[Array, Array]]:
    """Sample triangles (t, 3, 3) in rows along their longest edges, which are both at most so far apart."""
    edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
    order = (edges.argmax(axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(triangles, order[..., None], axis=1), 1, 0)
    outwards, longest = normals(triangles), edges.max(axis=1)
    size = np.linalg.norm(outwards, axis=1)
    outwards = outwards / np.maximum(size, 1e-300)[:, None]
    rows = np.ceil(size / np.maximum(longest, 1e-300) / spacing).astype(int)
    columns = np.ceil(longest / spacing).astype(int)
    for row_count, column_count in np.unique(np.column_stack((rows, columns)), axis=0).tolist():
        chosen = (rows == row_count) & (columns == column_count)
        for row in range(row_count + 1):
            t = row / max(row_count, 1)
            s = np.linspace(0.0, 1.0, int(np.ceil(column_count * (1.0 - t))) + 1)[:, None, None]
            begin, end = a[chosen] + t * (c - a)[chosen], b[chosen] + t * (c - b)[chosen]
            yield (begin + s * (end - begin)).reshape(-1, 3), np.tile(outwards[chosen], (len(s), 1))


def _area(geometry: Any) -> float:
    """Estimate the area of a surface [m²]."""
    return 0.5 * float(np.linalg.norm(normals(surface_triangles(geometry)), axis=1).sum())


def _is_inside(geometry: Any, points: Array) -> Array:
    """Tell which points (n, 3) are inside a convex geometry (n,)."""
    match geometry:
        case coal.Sphere():
            return np.asarray(np.linalg.norm(points, axis=1) < geometry.radius)
        case coal.Capsule():
            z = np.clip(points[:, 2], -geometry.halfLength, geometry.halfLength)
            return np.asarray(np.linalg.norm(points - z[:, None] * [0.0, 0.0, 1.0], axis=1) < geometry.radius)
        case coal.Cylinder():
            is_between = np.abs(points[:, 2]) < geometry.halfLength
            return np.asarray((np.hypot(points[:, 0], points[:, 1]) < geometry.radius) & is_between)
    equations = ConvexHull(hull_points(geometry)).equations
    return np.asarray((points @ equations[:, :3].T + equations[:, 3] < 0.0).all(axis=1))
