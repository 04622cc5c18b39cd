"""Bodies and pairs of a scene as arrays, and what moves each body: one table for all distances of a controller.

An obstacle that is attached to the robot is moved by a joint from then on. All distances look into the same arrays, so
that no change has to be passed on.
"""

from __future__ import annotations

from typing import Any
from weakref import WeakSet

import coal
import numpy as np

from qpavoid.geometry.bodies import bounding_box, bounding_sphere
from qpavoid.kernels.distances import BY_COAL, SPARE_BY_COAL
from qpavoid.kernels.support import Shapes
from qpavoid.model.convex_shapes import convex_shapes, pair_methods, write_shape
from qpavoid.model.kinematics import support_masks
from qpavoid.model.scene import Scene
from qpavoid.model.views import read_poses
from qpavoid.problem import Array, IntArray, Mask

_MAX_GRASP = 0.5
"""Largest gap between the robot and an object that is attached to it [m]."""


class PairTable:
    """Bodies and pairs of a scene: g bodies, of which joints move the first b or may come to, m pairs, o obstacles."""

    def __init__(self, scene: Scene) -> None:
        """Read all constants off a scene; no obstacle is attached."""
        self._scene, bodies = scene, scene.geometry.geometryObjects
        geometries, count = [body.geometry for body in bodies], len(scene.pairs)
        robot, movable, obstacles = len(scene.body_names), scene.movable, len(scene.slots)
        self.spheres: Array = np.array([(*c, r) for c, r in map(bounding_sphere, geometries)]).reshape(-1, 4)
        """(g, 4) bounding sphere of each body in its frame: centre and radius [m]; infinite of a half-space."""
        self.boxes: Array = np.array([np.concatenate(bounding_box(body)) for body in geometries]).reshape(-1, 6)
        """(g, 6) box around each body in its frame: centre and half its sizes [m]."""
        spare = np.flatnonzero(np.isin(scene.obstacle_of, scene.spare)).tolist()
        self.shapes: Shapes = convex_shapes(geometries, spare)
        """Shapes of all bodies."""
        self.method: IntArray = pair_methods(self.shapes, scene.pairs)
        """(m,) how the distance of each pair is computed, see `kernels.distances`."""
        self.is_mesh: Mask = np.array([isinstance(body, coal.BVHModelBase) for body in geometries], dtype=bool)
        """(g,) bodies that are triangle meshes."""
        self.is_plane: Mask = np.array([isinstance(body, coal.Halfspace) for body in geometries], dtype=bool)
        """(g,) bodies that are half-spaces."""
        self.pair_of: IntArray = np.full((movable, len(bodies)), -1, dtype=np.intp)
        """(b, g) number of the pair of two bodies, -1 where there is none."""
        self.pair_of[scene.pairs[:, 0], scene.pairs[:, 1]] = np.arange(count)
        self.first: IntArray = robot + np.searchsorted(scene.obstacle_of[robot:], np.arange(obstacles + 1))
        """(o + 1,) first body of each obstacle, which has those up to the next one's."""
        self.group: IntArray = np.arange(count)
        """(m,) first of the pairs of the same body and point cloud; of other pairs, their own number."""
        self.is_grouped: Mask = np.isin(scene.obstacle_of[scene.pairs[:, 1]], list(scene.clouds))
        """(m,) pairs with a point of a cloud."""
        for cloud in scene.clouds:
            pairs = np.flatnonzero(scene.obstacle_of[scene.pairs[:, 1]] == cloud)
            partners = scene.pairs[pairs, 0]
            self.group[pairs] = pairs[np.searchsorted(partners, partners)]

        self.is_empty: Mask = np.isin(scene.obstacle_of, scene.spare)
        """(g,) spare slots for obstacles that no obstacle has taken."""
        self.method[self.is_empty[scene.pairs].any(axis=1) & (self.method == BY_COAL)] = SPARE_BY_COAL
        self.attached: dict[int, int] = {}
        """Joint that each attached obstacle is attached to, by number of the obstacle."""
        joints = [body.parentJoint for body in bodies[:robot]] if robot else []
        self.joints: IntArray = np.array([*joints, *[-1] * (movable - robot)], dtype=np.intp)
        """(b,) joint that moves each body, 0 for none; -1 of an obstacle that is not attached."""
        self.placements: Array = read_poses([bodies[i].placement for i in range(movable)])
        """(b, 12) its pose in that joint: rotation by columns, then position."""
        self.ignored: Mask = np.zeros(count, dtype=bool)
        """(m,) pairs that are computed, but are to get no row."""
        self.enabled: Mask = np.ones(count, dtype=bool)
        """(m,) pairs that are computed at all."""
        self.twist_row: IntArray = np.zeros(count, dtype=np.intp)
        """(m,) row of `twists` that moves each pair, see `DistanceArrays`."""
        self.moved_by: IntArray = np.zeros((count, 2), dtype=np.intp)
        """(m, 2) what moves the two bodies of each pair: number of a joint, or njoints plus that of an obstacle."""
        self.joint_radius: Array = np.zeros(scene.robot.model.njoints)
        """(njoints,) distance from each joint's origin to the farthest point of a body that it moves [m]."""
        self.queries: WeakSet[Any] = WeakSet()
        """Distances that look into this table, which have to take over what is in a spare slot."""
        self._masks = support_masks(scene.robot.model)
        self.support: Array = np.zeros((count, self._masks.shape[1]))
        """(m, e) support of the second body minus that of the first, see `support_masks`."""
        self.separable: Mask = np.zeros(count, dtype=bool)
        """(m,) pairs whose distance depends on a joint."""
        self._update()

    def attach(self, index: int, joint: int, placement: Array) -> None:
        """Attach an obstacle to a joint, or release it.

        Args:
            index: number of the obstacle.
            joint: number of the joint; 0 for none.
            placement: pose (12,) in the joint; not read where there is none.
        """
        body = self.first[index]
        self.attached.pop(index, None)
        self.joints[body] = joint or -1
        if joint:
            self.placements[body], self.attached[index] = placement, joint
        self._update()

    def put(self, index: int, solid: Any, is_empty: bool) -> None:
        """Put the geometry of another obstacle into a spare slot, or of none.

        Args:
            index: number of the slot.
            solid: coal geometry.
            is_empty: whether it stands for none.
        """
        body, pairs = self.first[index], self.pairs_of(index)
        self.is_empty[body] = is_empty
        self.spheres[body] = np.append(*bounding_sphere(solid))
        self.boxes[body] = np.concatenate(bounding_box(solid))
        write_shape(self.shapes, body, solid)
        method = pair_methods(self.shapes, self._scene.pairs[pairs])
        self.method[pairs] = np.where(method == BY_COAL, SPARE_BY_COAL, method)
        self._enable()
        for query in self.queries:
            query.update_slot(index)

    def forget_guesses(self) -> None:
        """Let the searches of all distances that look into this table start anew."""
        for query in self.queries:
            query.forget_guesses()

    def rigid_pairs(self) -> Mask:
        """Return the pairs (m,) of an attached object with what moves along with it or hangs below it."""
        (first, second), rigid = self._scene.pairs.T, np.zeros(len(self.group), dtype=bool)
        joints = np.array([*np.maximum(self.joints, 0), *[0] * (len(self.spheres) - len(self.joints))], dtype=np.intp)
        for index, joint in self.attached.items():
            below = np.all(self._masks[:, self._masks[joint] > 0.0] > 0.0, axis=1, keepdims=True)[:, 0]
            body = self.first[index]
            rigid |= (first == body) & below[joints[second]] | (second == body) & below[joints[first]]
        return rigid

    def pairs_of(self, index: int) -> Mask:
        """Return the pairs (m,) of an obstacle that is one body."""
        return np.asarray(np.any(self._scene.pairs == self.first[index], axis=1))

    def max_extension(self) -> Array:
        """Return `joint_radius` (njoints,) as large as it may ever become [m]."""
        radii = self.spheres[len(self._scene.body_names) : len(self.joints), 3]
        if not len(radii):
            return np.array(self.joint_radius)
        return np.full_like(self.joint_radius, self.joint_radius.max() + 2.0 * radii.max() + _MAX_GRASP)

    def _enable(self) -> None:
        """Enable the pairs of bodies of which one at least is the robot's, and none is an empty slot."""
        free, empty, (first, second) = self._free, self.is_empty, self._scene.pairs.T
        self.enabled[:] = ~(free[first] & free[second] | empty[first] | empty[second])
        self.separable[:] = self.enabled & self._is_moved

    def _update(self) -> None:
        """Write everything that depends on which obstacles are attached, in place."""
        scene, of, obstacles = self._scene, self._scene.obstacle_of, len(self._scene.slots)
        first, second = scene.pairs.T
        free = (of >= 0) & ~np.isin(of, list(self.attached))
        joints = np.array([*self.joints, *[0] * (len(of) - len(self.joints))], dtype=np.intp)
        self.moved_by[:] = np.where(free, scene.robot.model.njoints + of, joints)[scene.pairs]
        self.twist_row[:] = np.where(
            free[second], of[second], np.where(free[first], obstacles + 1 + of[first], obstacles)
        )
        attached_joints = np.where(free, 0, joints)
        self.support[:] = self._masks[attached_joints[second]] - self._masks[attached_joints[first]]
        self._free, self._is_moved = free, np.any(self.support != 0.0, axis=1)
        self._enable()
        self.joint_radius[:] = 0.0
        for joint, pose, (*center, radius) in zip(
            self.joints.tolist(), self.placements, self.spheres.tolist(), strict=False
        ):
            if joint >= 0:
                placed = np.array(center) @ pose[:9].reshape(3, 3) + pose[9:]
                extension = float(np.linalg.norm(placed)) + radius
                self.joint_radius[joint] = max(self.joint_radius[joint], extension)
