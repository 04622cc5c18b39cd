"""Closest points of the pairs within reach; by coal, without a Python loop.

Bounding spheres tell which pairs can be within reach at all; the others are switched off, so that one call into C++
does the rest, and its results are viewed as one array.
"""

from __future__ import annotations

from math import hypot, isfinite
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.bodies import bounding_sphere
from qpavoid.errors import NumericalError
from qpavoid.memory import read_poses, read_results, view_poses, view_results
from qpavoid.motion import Sample
from qpavoid.problem import Array, IntArray
from qpavoid.scene import Scene

_CULL_FROM = 48 if kernels.ACCELERATED else 192
"""Number of pairs from which looking at bounding spheres first pays."""


class DistanceQuery:
    """Distances of a scene's pairs; owns the buffers that every call overwrites."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._geometry = pin.GeometryModel(scene.geometry)
        self._data = self._geometry.createData()
        for request in self._data.distanceRequests:
            request.gjk_tolerance = 1e-10  # the default 1e-6 leaves errors of 7e-3 in normals of boxes and hulls
        self._first_obstacle = len(scene.body_names)
        obstacles = len(scene.obstacles)
        self.twists = np.zeros((obstacles + 1, 6))
        """(o + 1, 6) of the obstacles at the world's origin; the last row stays zero: for the robot's own bodies."""
        self.margin = np.zeros(obstacles + 1)
        """(o + 1,) to be taken off the distances to each obstacle [m]; the last one stays zero."""
        self._moving: set[int] = set()
        self._placements = view_poses([body.placement for body in self._geometry.geometryObjects], writeable=True)
        second = scene.pairs[:, 1] - self._first_obstacle
        self.twist_row: IntArray = np.where(second >= 0, second, obstacles)
        """(m,) row of `twists` that moves each pair's second body."""
        model = scene.robot.model
        pin.updateGeometryPlacements(model, model.createData(), self._geometry, self._data, pin.neutral(model))
        pin.computeDistances(self._geometry, self._data)  # so that there is something to compare the view with
        view = view_results(self._data.distanceResults)
        self.results: Array = read_results(self._data.distanceResults) if view is None else view
        """(m, 10) [distance, normal, point a, point b] of all pairs; only those of `pairs` are of this tick."""
        poses = view_poses(self._data.oMg)
        self.poses: Array = read_poses(self._data.oMg) if poses is None else poses
        """(g, 12) world poses of all bodies, the robot's first."""
        self._copy, self._copy_poses = view is None, poses is None
        shapes = [bounding_sphere(body.geometry) for body in self._geometry.geometryObjects]
        self.spheres = np.array([(*center, radius) for center, radius in shapes]).reshape(-1, 4)
        """(g, 4) bounding sphere of each body in its own frame: centre and radius [m]."""
        self._joints = model.njoints
        self.speeds = np.zeros(model.njoints + obstacles)
        """(njoints + o,) largest speed of any point that a joint carries, or of an obstacle [m/s]; here, the latter."""
        self._cull = _Cull(scene, self) if len(scene.pairs) >= _CULL_FROM else None
        self.pairs: IntArray = np.arange(len(scene.pairs))
        """(c,) pairs that were computed, increasing."""

    @property
    def moving(self) -> bool:
        """Whether any obstacle has a velocity or a margin."""
        return bool(self._moving)

    def carriers(self) -> IntArray:
        """(m, 2) what moves the two bodies of each pair: number of a joint, or njoints plus that of an obstacle."""
        joints = np.array([body.parentJoint for body in self._geometry.geometryObjects], dtype=np.intp)
        joints[self._first_obstacle :] = self._joints + np.arange(len(self._scene.obstacles))
        return joints[self._scene.pairs]

    def joint_reach(self) -> Array:
        """(njoints,) distance from each joint's origin to the farthest point of a body that it carries [m]."""
        reach = np.zeros(self._joints)
        for body, (*center, radius) in zip(self._scene.robot.bodies.geometryObjects, self.spheres, strict=False):
            placed = body.placement.rotation @ np.array(center) + body.placement.translation
            reach[body.parentJoint] = max(reach[body.parentJoint], float(np.linalg.norm(placed)) + radius)
        return reach

    def place_obstacle(self, index: int, sample: Sample, margin: float = 0.0) -> None:
        """Puts obstacle number `index` to a pose, with a velocity, and takes a margin [m] off its distances.

        Raises:
            NumericalError: NaN or infinity; names the obstacle, which stays where it was.
        """
        # plain floats: numpy's scalars cost more than the arithmetic
        (x, y, z), (vx, vy, vz) = sample.position.tolist(), sample.linear.tolist()
        wx, wy, wz = sample.angular.tolist()
        if not isfinite(x + y + z + vx + vy + vz + wx + wy + wz + float(np.vdot(sample.rotation, sample.rotation))):
            raise NumericalError(
                f"obstacle {self._scene.obstacles[index].name!r}: NaN or infinity in its pose or twist"
            )
        geometry = self._first_obstacle + index
        self.margin[index] = margin
        if self._placements is None:
            self._geometry.geometryObjects[geometry].placement = pin.SE3(sample.rotation, sample.position)
        else:
            self._placements[geometry, :9] = sample.rotation.T.ravel()
            self._placements[geometry, 9:] = sample.position
        twist = (vx - wy * z + wz * y, vy - wz * x + wx * z, vz - wx * y + wy * x, wx, wy, wz)
        self.twists[index] = twist
        if any(twist) or margin:
            self._moving.add(index)
            reach = float(np.linalg.norm(self.spheres[geometry, :3]) + self.spheres[geometry, 3])
            own = sample.linear.tolist()
            self.speeds[self._joints + index] = hypot(*own) + hypot(wx, wy, wz) * reach
        else:
            self._moving.discard(index)
            self.speeds[self._joints + index] = 0.0
        if self._cull is not None:
            self._cull.place(geometry, sample.rotation, sample.position)

    def compute(self, data: Any, reach: float) -> None:
        """Brings `results` up to date for every pair nearer than `reach`, and says in `pairs` which ones it computed.

        Args:
            data: pinocchio data that holds the joint placements of this tick.
            reach: surface distance [m].
        """
        pin.updateGeometryPlacements(self._scene.robot.model, data, self._geometry, self._data)
        if self._copy_poses:
            self.poses[:] = read_poses(self._data.oMg)
        if self._cull is not None:
            self.pairs = self._cull.switch(reach)
        pin.computeDistances(self._geometry, self._data)
        if self._copy:
            self.results[:] = read_results(self._data.distanceResults)

    def found(self, pairs: IntArray) -> Array:
        """Distances (k,) of some pairs at the last call; infinite for those that were out of reach [m]."""
        distance = self.results[pairs, 0]
        return distance if self._cull is None else np.where(self._cull.active[pairs], distance, np.inf)


class _Cull:
    """Switches pairs off in coal's data whose bounding spheres are out of reach."""

    def __init__(self, scene: Scene, query: DistanceQuery) -> None:
        self._query, self._data = query, query._data
        self._bodies = len(scene.body_names)
        self._local, self._radius = query.spheres[:, :3].copy(), query.spheres[:, 3].copy()
        self._centered = (self._local == 0.0).all(axis=1).tolist()
        self._centers = np.ones((len(self._local), 5))
        for i, body in enumerate(query._geometry.geometryObjects):
            self.place(i, body.placement.rotation, body.placement.translation)
        self._pair_of = np.full((self._bodies, len(self._local)), -1, dtype=np.intp)
        self._pair_of[scene.pairs[:, 0], scene.pairs[:, 1]] = np.arange(len(scene.pairs))
        self._reach = np.nan
        self._within: Array = np.empty(self._pair_of.shape)
        self._found = np.zeros(len(scene.pairs), dtype=np.intp)
        self.active = np.ones(len(scene.pairs), dtype=bool)
        """(m,) which pairs are on."""
        self._last = b""

    def place(self, index: int, rotation: Array, position: Array) -> None:
        """Moves the bounding sphere of one geometry."""
        center = position if self._centered[index] else rotation @ self._local[index] + position
        self._centers[index, :3], self._centers[index, 4] = center, -(center @ center)

    def switch(self, reach: float) -> IntArray:
        """Switches pairs on and off; gives those that are on, in increasing order."""
        if reach != self._reach:
            touching = self._radius[: self._bodies, None] + self._radius + reach
            self._within = np.where(self._pair_of >= 0, touching**2 * (1.0 + 1e-9), -1.0)
            self._reach = reach
        count = kernels.candidates(
            self._query.poses, self._local, self._centers, self._within, self._pair_of, self._found
        )
        pairs = self._found[:count]
        if pairs.tobytes() != self._last:
            self._last = pairs.tobytes()
            wanted = np.zeros_like(self.active)
            wanted[pairs] = True
            for pair in np.flatnonzero(wanted & ~self.active).tolist():
                self._data.activateCollisionPair(pair)
            for pair in np.flatnonzero(self.active & ~wanted).tolist():
                self._data.deactivateCollisionPair(pair)
            self.active = wanted
        return pairs
