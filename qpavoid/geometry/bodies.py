"""Collision shapes of coal: made of the config's primitives and of meshes, and what encloses them."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.config import Box, Capsule, Cone, Cylinder, Ellipsoid, Shape, Sphere
from qpavoid.geometry.capsules import CapsuleFit, fit_capsule, half_sphere
from qpavoid.geometry.meshes import convex_hull, corners, normals
from qpavoid.problem import Array


def make_shape(shape: Shape) -> Any:
    """Make the coal geometry of a configured primitive."""
    match shape:
        case Sphere():
            return coal.Sphere(shape.radius)
        case Capsule():
            return coal.Capsule(shape.radius, shape.length)
        case Box():
            return coal.Box(*shape.size)
        case Cone():
            return coal.Cone(shape.radius, shape.length)
        case Ellipsoid():
            return coal.Ellipsoid(*shape.radii)
        case Cylinder():
            return coal.Cylinder(shape.radius, shape.length)


def convert_bodies(bodies: Any, kind: str) -> Any:
    """Replace the triangle meshes of a Pinocchio geometry model.

    `convex`: by their hulls, primitives as they are; `capsule`: one capsule around each piece; `mesh`: all as it is.
    """
    converted = pin.GeometryModel()
    for body in bodies.geometryObjects:
        geometry, placement = body.geometry, body.placement
        if kind == "convex":
            geometry = hull(geometry)
        elif kind == "capsule":
            fit = enclosing_capsule(geometry)
            geometry = coal.Capsule(fit.radius, fit.length) if fit.length > 0 else coal.Sphere(fit.radius)
            placement = placement * pin.SE3(fit.rotation, fit.center)
        converted.addGeometryObject(
            pin.GeometryObject(body.name, body.parentJoint, body.parentFrame, placement, geometry)
        )
    return converted


def hull(geometry: Any) -> Any:
    """Return the convex hull of a mesh; primitives as they are."""
    return convex_hull(np.array(geometry.vertices())) if isinstance(geometry, coal.BVHModelBase) else geometry


def triangle_meshes(bodies: Any) -> list[str]:
    """List the bodies of a Pinocchio geometry model that are triangle meshes."""
    return [body.name for body in bodies.geometryObjects if isinstance(body.geometry, coal.BVHModelBase)]


def enclosing_capsule(geometry: Any) -> CapsuleFit:
    """Fit a capsule around a coal shape, in the shape's own frame.

    Spheres and capsules are their own.
    """
    if isinstance(geometry, coal.Sphere):
        return CapsuleFit(np.zeros(3), np.eye(3), geometry.radius, 0.0)
    if isinstance(geometry, coal.Capsule):
        return CapsuleFit(np.zeros(3), np.eye(3), geometry.radius, 2.0 * geometry.halfLength)
    points = np.ascontiguousarray(hull_points(geometry))
    return _fit_once(points.tobytes(), len(points))


@lru_cache(maxsize=256)
def _fit_once(points: bytes, count: int) -> CapsuleFit:
    """Return `fit_capsule` of points (count, 3): the hulls of a robot are the same whenever it is loaded."""
    return fit_capsule(np.frombuffer(points).reshape(count, 3))


def bounding_sphere(geometry: Any) -> tuple[Array, float]:
    """Return centre (3,) and radius of a sphere around a coal shape, in its frame [m].

    The radius is infinite for a half-space.
    """
    center = np.zeros(3)
    match geometry:
        case coal.Halfspace():
            return center, np.inf
        case coal.Ellipsoid():
            return center, float(np.max(geometry.radii))
        case coal.Sphere():
            return center, float(geometry.radius)
        case coal.Capsule():
            return center, float(geometry.radius + geometry.halfLength)
        case coal.Cylinder():
            return center, float(np.hypot(geometry.radius, geometry.halfLength))
    geometry.computeLocalAABB()
    return np.array(geometry.aabb_center), float(geometry.aabb_radius)


def bounding_box(geometry: Any) -> tuple[Array, Array]:
    """Return centre (3,) and half sizes (3,) of a box around a shape, in its frame [m].

    A half-space gets a very large one.
    """
    if isinstance(geometry, coal.Halfspace):
        return np.zeros(3), np.full(3, _ENDLESS)
    geometry.computeLocalAABB()
    low, high = np.array(geometry.aabb_local.min_), np.array(geometry.aabb_local.max_)
    return 0.5 * (low + high), 0.5 * (high - low)


_ENDLESS = 1e6
"""Half the size of the box that stands for a half-space: larger than any scene [m]."""
_AROUND_SPHERE = 1.04 * np.concatenate((half_sphere(100), -half_sphere(100)))
"""Points whose hull encloses the unit sphere (200, 3)."""


def hull_points(geometry: Any) -> Array:
    """Return points whose hull encloses the shape (n, 3) [m]."""
    match geometry:
        case coal.BVHModelBase():  # fine meshes have a hundred times the points of their hulls
            return np.array(hull(geometry).points())
        case coal.ConvexBase():
            return np.array(geometry.points())
        case coal.Cylinder():
            return np.concatenate([rim(geometry.radius, z) for z in (-geometry.halfLength, geometry.halfLength)])
        case coal.Cone():
            return np.concatenate((rim(geometry.radius, -geometry.halfLength), [[0.0, 0.0, geometry.halfLength]]))
        case coal.Ellipsoid():
            return np.asarray(_AROUND_SPHERE * np.asarray(geometry.radii))
    center, half = bounding_box(geometry)
    return np.asarray(center + half * [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def surface_triangles(geometry: Any) -> Array:
    """Return the triangles (t, 3, 3) [m] of a mesh; those of the hull of another shape, which face outwards."""
    if isinstance(geometry, coal.BVHModelBase):
        vertices, triangles = corners(geometry)
        return np.asarray(vertices[triangles])
    from scipy.spatial import ConvexHull  # slow to import

    points = hull_points(geometry)
    faces = points[ConvexHull(points).simplices]
    inwards = np.einsum("ij,ij->i", normals(faces), faces[:, 0] - points.mean(axis=0)) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    return np.asarray(faces)


def rim(radius: float, z: float) -> Array:
    """Return the corners (48, 3) of a polygon around a circle about the z axis [m]."""
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    circumradius = radius / np.cos(np.pi / 48)
    return np.column_stack((circumradius * np.cos(angle), circumradius * np.sin(angle), np.full(48, z)))
