"""Collision shapes: from the config's primitives, and from the meshes of a URDF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.config import Box, Capsule, Cone, Cylinder, Ellipsoid, Shape, Sphere
from qpavoid.config.base import LARGEST
from qpavoid.errors import ConfigError
from qpavoid.geometry.cache import load_or_make
from qpavoid.geometry.capsules import CapsuleFit, fit_capsule, half_sphere
from qpavoid.problem import Array


class MeshWarning(UserWarning):
    """Distances will be slow: a robot is made of triangle meshes."""


def make_shape(shape: Shape) -> Any:
    """Make the coal geometry of a configured primitive."""
    if isinstance(shape, Sphere):
        return coal.Sphere(shape.radius)
    if isinstance(shape, Capsule):
        return coal.Capsule(shape.radius, shape.length)
    if isinstance(shape, Box):
        return coal.Box(*shape.size)
    if isinstance(shape, Cone):
        return coal.Cone(shape.radius, shape.length)
    if isinstance(shape, Ellipsoid):
        return coal.Ellipsoid(*shape.radii)
    assert isinstance(shape, Cylinder)
    return coal.Cylinder(shape.radius, shape.length)


def convert_bodies(bodies: Any, kind: str) -> Any:
    """Replace the triangle meshes of a geometry model.

    Args:
        bodies: pinocchio geometry model as read from a URDF.
        kind: `convex`: hull of each mesh, primitives as they are; `capsule`: one capsule around each piece;
            `mesh`: everything as it is.
    """
    converted = pin.GeometryModel()
    for body in bodies.geometryObjects:
        geometry, placement = body.geometry, body.placement
        if kind == "convex" and isinstance(geometry, coal.BVHModelBase):
            geometry, inside = _convex_hull(geometry)
            placement = placement * inside
        elif kind == "capsule":
            fit = enclosing_capsule(geometry)
            geometry = coal.Capsule(fit.radius, fit.length) if fit.length > 0 else coal.Sphere(fit.radius)
            placement = placement * pin.SE3(fit.rotation, fit.center)
        converted.addGeometryObject(
            pin.GeometryObject(body.name, body.parentJoint, body.parentFrame, placement, geometry)
        )
    return converted


def check_meshes(bodies: Any, origin: str) -> None:
    """Check that meshes have corners and that all are numbers.

    Hulls and distances need them.

    Args:
        bodies: pinocchio geometry model as read from a URDF.
        origin: file to name in errors.

    Raises:
        ConfigError: naming the mesh.
    """
    for body in bodies.geometryObjects:
        if isinstance(body.geometry, coal.BVHModelBase):
            points = np.array(body.geometry.vertices())
            where = f"{origin}: {body.name}: mesh {body.meshPath}"
            if points.ndim != 2 or len(points) < 3:
                raise ConfigError(f"{where}: has no triangle; export it again")
            if not np.all(np.abs(points) <= LARGEST):  # False for NaN too
                raise ConfigError(f"{where}: a corner is NaN, infinite or beyond {LARGEST:g} m; export it again")


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
    points = hull_points(geometry)
    return load_or_make("capsule", points, lambda: fit_capsule(points), _pack_fit, _unpack_fit)


def bounding_sphere(geometry: Any) -> tuple[Array, float]:
    """Return centre (3,) and radius of a sphere around a coal shape, in its frame [m].

    The radius is infinite for a half-space.
    """
    if isinstance(geometry, coal.Halfspace):
        return np.zeros(3), np.inf
    if isinstance(geometry, coal.Ellipsoid):
        return np.zeros(3), float(np.max(geometry.radii))
    if isinstance(geometry, coal.Sphere | coal.Capsule | coal.Cylinder):
        half = getattr(geometry, "halfLength", 0.0)
        wide = isinstance(geometry, coal.Cylinder)
        return np.zeros(3), float(np.hypot(geometry.radius, half) if wide else geometry.radius + half)
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


def _convex_hull(mesh: Any) -> tuple[Any, Any]:
    """Return the hull of a mesh, and its placement in the mesh's frame.

    A thin box stands for a flat mesh.

    A flat point set has no hull with an inside, and qhull ends the process over it.
    """
    points = np.array(mesh.vertices())
    center = points.mean(axis=0)
    axes = np.linalg.svd(points - center, full_matrices=False)[2]
    axes[2] *= np.sign(np.linalg.det(axes))
    local = (points - center) @ axes.T
    low, high = local.min(axis=0), local.max(axis=0)
    size = high - low
    if size.min() > 1e-6 * size.max():
        return load_or_make("hull", points, lambda: run_qhull(mesh), _pack_hull, _unpack_hull), pin.SE3.Identity()
    middle = center + axes.T @ (0.5 * (low + high))
    return coal.Box(*np.maximum(size, _THINNEST)), pin.SE3(np.ascontiguousarray(axes.T), middle)


def run_qhull(mesh: Any) -> Any:
    """Make coal's convex hull of the vertices of a mesh that are not all in one plane.

    qhull ends the process over those.
    """
    try:
        mesh.buildConvexHull(True, "Qt")
    except RuntimeError:
        # a corner with more than 255 neighbours, as where a round flat face is cut into a fan of triangles: qhull's
        # other way with flat faces moves corners by rounding errors and makes no fans
        mesh.buildConvexHull(True, "QJ")
    return mesh.convex


def _pack_hull(hull: Any) -> bytes:
    """Serialise a hull in coal's own format.

    Making a hull of points and triangles takes as long as finding it.
    """
    buffer = pin.serialization.StreamBuffer()
    hull.saveToBuffer(buffer)
    return bytes(buffer.tobytes())


def _unpack_hull(path: Path) -> Any:
    hull = coal.Convex()
    hull.loadFromBinary(str(path))
    return hull


def _pack_fit(fit: CapsuleFit) -> bytes:
    return np.concatenate((fit.center, fit.rotation.ravel(), (fit.radius, fit.length))).tobytes()


def _unpack_fit(path: Path) -> CapsuleFit:
    numbers = np.fromfile(path, count=14)
    return CapsuleFit(numbers[:3], numbers[3:12].reshape(3, 3), float(numbers[12]), float(numbers[13]))


_AROUND_SPHERE = 1.04 * np.concatenate((half_sphere(100), -half_sphere(100)))
"""Points whose hull encloses the unit sphere (200, 3)."""
_ENDLESS = 1e6
"""Half the size of the box that stands for a half-space: larger than any scene [m]."""
_THINNEST = 1e-4
"""Side of the box that stands for a flat mesh, across its plane: thin beside any safety distance [m]."""


def hull_points(geometry: Any) -> Array:
    """Return points whose hull encloses the shape (n, 3) [m]."""
    if isinstance(geometry, coal.BVHModelBase):
        hull, _ = _convex_hull(geometry)  # fine meshes have a hundred times the points of their hulls
        return np.array(hull.points() if isinstance(hull, coal.ConvexBase) else geometry.vertices())
    if isinstance(geometry, coal.ConvexBase):
        return np.array(geometry.points())
    if isinstance(geometry, coal.Cylinder):
        return np.concatenate([rim(geometry.radius, z) for z in (-geometry.halfLength, geometry.halfLength)])
    if isinstance(geometry, coal.Cone):
        return np.concatenate((rim(geometry.radius, -geometry.halfLength), [[0.0, 0.0, geometry.halfLength]]))
    if isinstance(geometry, coal.Ellipsoid):
        return np.asarray(_AROUND_SPHERE * np.asarray(geometry.radii))
    geometry.computeLocalAABB()
    half, center = 0.5 * (geometry.aabb_local.max_ - geometry.aabb_local.min_), geometry.aabb_center
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    return np.asarray(center + corners * half)


def rim(radius: float, z: float) -> Array:
    """Return the corners (48, 3) of a polygon around a circle about the z axis [m]."""
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    circumradius = radius / np.cos(np.pi / 48)
    return np.column_stack((circumradius * np.cos(angle), circumradius * np.sin(angle), np.full(48, z)))
