"""Puts the balls of a point cloud to the voxels that are nearest to each body, tick by tick.

A cloud has a fixed number of balls for each body of the robot: to coal and to the rows they are spheres like any other,
so that memory is laid out once and the QP stays small, however many points there are.
"""

from __future__ import annotations

from typing import Any

import coal
import numpy as np

from qpavoid import kernels
from qpavoid.geometry.bodies import enclosing_capsule, hull_points
from qpavoid.model.cloud import Voxels, voxel_radius
from qpavoid.model.sample import Sample
from qpavoid.model.scene import PARKING_DISTANCE
from qpavoid.problem import Array, IntArray

_PLACES = 3
"""Into how many stretches a body's axis counts as divided: voxels that face the same one in one direction are alike."""


class CloudProxies:
    """The balls of one cloud, for every body that can move."""

    def __init__(
        self, bodies: list[Any], geometries: IntArray, resolution: float, nearest: int, voxels: Voxels
    ) -> None:
        """Lays the memory out.

        Args:
            bodies: coal geometries of the b bodies that can move.
            geometries: numbers of the cloud's balls (b nearest,), those of a body one after the other.
            resolution: edge of a voxel [m].
            nearest: balls of each body.
            voxels: what the cloud holds at first.
        """
        count = len(bodies)
        self.geometries = geometries.reshape(count, nearest)
        self._ball, self._resolution = voxel_radius(resolution), resolution
        self._bodies, self._planes = list[Any](bodies), dict[int, tuple[Array, Array]]()
        self._ends, self._radii, self._spacing = np.zeros((count, 2, 3)), np.zeros(count), np.zeros(count)
        for number, body in enumerate(bodies):
            self.set_body(number, body)
        self._slots = np.full((count, nearest), -1, dtype=np.intp)
        self._previous = np.full((count, nearest), -1, dtype=np.intp)
        self._first = np.zeros(count + 1, dtype=np.intp)
        self._capacity = -1
        self.fill_with(voxels)

    def set_body(self, number: int, body: Any) -> None:
        """Take another coal geometry for body `number`."""
        fit = enclosing_capsule(body)
        half = 0.5 * fit.length * fit.rotation[:, 2]
        self._bodies[number], self._ends[number] = body, (fit.center - half, fit.center + half)
        self._radii[number] = fit.radius + self._ball
        self._spacing[number] = max(fit.length / _PLACES, 2.0 * self._resolution)
        self._planes.pop(number, None)
        if not _is_capsule(body):
            self._planes[number] = _planes(body)

    def fill_with(self, voxels: Voxels) -> None:
        """Takes other voxels, in place of all that there were."""
        self.voxels = voxels
        capacity = len(self._bodies) * len(voxels.centers)
        if capacity > self._capacity:
            self._capacity = capacity
            self._point = np.zeros(capacity, dtype=np.intp)
            self._distance, self._place = np.zeros(capacity), np.zeros((capacity, 4))

    @property
    def radius(self) -> float:
        """Distance of the farthest ball's surface from the cloud's origin [m]."""
        farthest = np.sqrt(np.square(self.voxels.centers).sum(axis=1).max(initial=0.0))
        return float(farthest) + self._ball

    def places(self, poses: Array, off: Any, pose: Sample, influence_distance: float) -> Array:
        """World positions (b, nearest, 3) of the balls [m]; far away where they stand for no voxel.

        Args:
            poses: world poses of the bodies, rotation by columns and translation (b, 12).
            off: bodies that do not move with the robot now (k,).
            pose: of the cloud.
            influence_distance: surface distance up to which voxels are looked for [m].
        """
        rotation, voxels = pose.rotation, self.voxels
        turned = np.matmul(self._ends, poses[:, :9].reshape(-1, 3, 3)) + poses[:, None, 9:]
        axes = ((turned - pose.position) @ rotation).reshape(-1, 6)
        axes[off] = np.nan
        candidates = self._first, self._point, self._distance, self._place
        kernels.voxels_within(
            axes, self._radii, influence_distance, voxels.centers, voxels.blocks, voxels.starts, *candidates
        )
        for body in self._planes:
            if self._first[body] < self._first[body + 1]:
                self._refine(body, poses[body], pose)
        kernels.select_voxels(*candidates, self._spacing, voxels.keys, self._slots, self._previous)
        places = np.full((*self._slots.shape, 3), PARKING_DISTANCE)
        is_placed = self._slots >= 0
        places[is_placed] = voxels.centers[self._slots[is_placed]] @ rotation.T + pose.position
        return places

    def _refine(self, body: int, placement: Array, pose: Sample) -> None:
        """Distances of a body that is no capsule: exact for as many of its nearest voxels as get slots for nearness.

        Planes of the faces, and the capsule around the body, bound the distances of the others from below.
        """
        here = slice(self._first[body], self._first[body + 1])
        centers = self.voxels.centers[self._point[here]] @ pose.rotation.T + pose.position
        rotation = placement[:9].reshape(3, 3)  # by columns: its transpose
        normals, offsets = self._planes[body]
        beyond = np.max((centers - placement[9:]) @ rotation.T @ normals.T + offsets, axis=1) - self._ball
        bound = np.maximum(self._distance[here], beyond)
        request, result, ball = coal.DistanceRequest(), coal.DistanceResult(), coal.Sphere(self._ball)
        request.gjk_tolerance = 1e-10
        if isinstance(self._bodies[body], coal.Cylinder):
            ball = coal.Capsule(self._ball, 0.0)
        where = coal.Transform3s(rotation.T.copy(), placement[9:].copy())
        count_exact = (self._slots.shape[1] + 1) // 2
        exact: list[float] = []
        for i in np.argsort(bound, kind="stable").tolist():
            if len(exact) >= count_exact and bound[i] >= sorted(exact)[count_exact - 1]:
                break
            result.clear()
            there = coal.Transform3s(np.eye(3), centers[i])
            bound[i] = coal.distance(self._bodies[body], where, ball, there, request, result)
            exact.append(float(bound[i]))
        self._distance[here] = bound


def _is_capsule(body: Any) -> bool:
    return isinstance(body, coal.Sphere | coal.Capsule)


def _planes(body: Any) -> tuple[Array, Array]:
    """Outward normals (f, 3) and offsets (f,) of the faces of a polytope that encloses a body."""
    from scipy.spatial import ConvexHull  # slow to import

    equations = ConvexHull(hull_points(body)).equations
    return equations[:, :3].copy(), equations[:, 3].copy()
