"""Collision shapes: from the config's primitives, and from the meshes of a URDF."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.config import Box, Capsule, Cylinder, Shape, Sphere
from qpavoid.problem import Array


@dataclass(frozen=True, slots=True)
class CapsuleFit:
    """An enclosing capsule: axis along z of `rotation`, centred on `center`; length 0 is a sphere."""

    center: Array
    """(3,) [m]."""
    rotation: Array
    """(3, 3)."""
    radius: float
    """[m]."""
    length: float
    """Between the centres of the caps [m]."""

    @property
    def volume(self) -> float:
        """[m³]."""
        return float(np.pi * self.radius**2 * (self.length + 4.0 / 3.0 * self.radius))


def make_shape(shape: Shape) -> Any:
    """coal geometry of a configured primitive."""
    if isinstance(shape, Sphere):
        return coal.Sphere(shape.radius)
    if isinstance(shape, Capsule):
        return coal.Capsule(shape.radius, shape.length)
    if isinstance(shape, Box):
        return coal.Box(*shape.size)
    assert isinstance(shape, Cylinder)
    return coal.Cylinder(shape.radius, shape.length)


def convert_bodies(bodies: Any, kind: str) -> Any:
    """A geometry model whose triangle meshes are replaced.

    Args:
        bodies: pinocchio geometry model as read from a URDF.
        kind: `convex`: hull of each mesh, primitives as they are; `capsule`: one capsule around each piece;
            `mesh`: everything as it is.
    """
    converted = pin.GeometryModel()
    for body in bodies.geometryObjects:
        geometry, placement = body.geometry, body.placement
        if kind == "convex" and isinstance(geometry, coal.BVHModelBase):
            geometry = _convex_hull(geometry)
        elif kind == "capsule":
            fit = enclosing_capsule(geometry)
            geometry = coal.Capsule(fit.radius, fit.length) if fit.length > 0 else coal.Sphere(fit.radius)
            placement = placement * pin.SE3(fit.rotation, fit.center)
        converted.addGeometryObject(
            pin.GeometryObject(body.name, body.parentJoint, body.parentFrame, placement, geometry)
        )
    return converted


def enclosing_capsule(geometry: Any) -> CapsuleFit:
    """The capsule around a coal shape, in the shape's own frame; spheres and capsules are their own."""
    if isinstance(geometry, coal.Sphere):
        return CapsuleFit(np.zeros(3), np.eye(3), geometry.radius, 0.0)
    if isinstance(geometry, coal.Capsule):
        return CapsuleFit(np.zeros(3), np.eye(3), geometry.radius, 2.0 * geometry.halfLength)
    return fit_capsule(_vertices(geometry))


def _convex_hull(mesh: Any) -> Any:
    mesh.buildConvexHull(True, "Qt")
    return mesh.convex


def _vertices(geometry: Any) -> Array:
    """Points whose hull encloses the shape (n, 3)."""
    if isinstance(geometry, coal.BVHModelBase):
        return np.array(geometry.vertices())
    if isinstance(geometry, coal.ConvexBase):
        return np.array(geometry.points())
    geometry.computeLocalAABB()
    half, center = 0.5 * (geometry.aabb_local.max_ - geometry.aabb_local.min_), geometry.aabb_center
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    return np.asarray(center + corners * half)


def fit_capsule(points: Array, directions: int = 250) -> CapsuleFit:
    """A small capsule that encloses all points.

    Tries the points' principal axes and a spiral of directions over the half sphere, all at once; for each, the axis
    runs through the centre of the smallest circle around the projected points, and the caps are drawn in as far as
    the points allow.

    Args:
        points: (n, 3) [m], at least one.
        directions: how many directions are tried.

    Returns:
        The fit of smallest volume; every point is inside.
    """
    points = np.unique(np.asarray(points, dtype=np.float64), axis=0)
    principal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    rotations = _rotations_to(np.concatenate((principal, _half_sphere(directions))))
    local = points @ rotations
    center, radius = _enclosing_circles(local[..., :2])
    # each point lets the caps' centres come no nearer than this to the far side
    off_axis = np.sum((local[..., :2] - center[:, None]) ** 2, axis=2)
    reach = np.sqrt(np.maximum(radius[:, None] ** 2 - off_axis, 0.0))
    low, high = np.min(local[..., 2] + reach, axis=1), np.max(local[..., 2] - reach, axis=1)
    length = np.maximum(high - low, 0.0)  # where the caps' centres cross, a ball about their middle does
    best = int(np.argmin(np.pi * radius**2 * (length + 4.0 / 3.0 * radius)))
    origin = rotations[best] @ np.array([*center[best], 0.5 * (low[best] + high[best])])
    margin = 1e-10  # against rounding, so that the points on the surface count as inside
    return CapsuleFit(origin, rotations[best], float(radius[best]) + margin, float(length[best]))


def _half_sphere(count: int) -> Array:
    """Evenly spread unit vectors with z >= 0 (count, 3): a golden-angle spiral."""
    i = np.arange(count) + 0.5
    z, angle = i / count, np.pi * (1.0 + np.sqrt(5.0)) * i
    r = np.sqrt(1.0 - z * z)
    return np.column_stack((r * np.cos(angle), r * np.sin(angle), z))


def _rotations_to(axes: Array) -> Array:
    """Rotations (k, 3, 3) whose z columns are the unit vectors `axes` (k, 3)."""
    x = np.cross(np.eye(3)[np.argmin(np.abs(axes), axis=1)], axes)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack((x, np.cross(axes, x), axes), axis=2)


def _enclosing_circles(points: Array) -> tuple[Array, Array]:
    """Nearly smallest circle around each set of 2-D points (k, n, 2): centres (k, 2) and radii (k,).

    Badoiu and Clarkson's iteration for the centre; the radius is then exact for that centre.
    """
    center = 0.5 * (points.min(axis=1) + points.max(axis=1))
    every = np.arange(len(points))
    for step in range(1, 60):
        farthest = np.argmax(np.sum((points - center[:, None]) ** 2, axis=2), axis=1)
        center = center + (points[every, farthest] - center) / (step + 1)
    return center, np.sqrt(np.max(np.sum((points - center[:, None]) ** 2, axis=2), axis=1))
