"""Objects attached to the robot for a while, and the pairs that get no rows meanwhile.

All pairs that an attached object may need are laid out at the start. While it is attached it is a body of the robot:
its rows have the support of the joint that moves it. Pairs with what is rigidly connected to it, or hangs below it as
fingers do, are ignored. So are those that touch when it is attached or released (the gripper, a table), until they have
once been farther apart than the safety distance: a row could only ask them to part at once.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from qpavoid.control.distances import DistanceQuery
from qpavoid.errors import ConfigError
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.sample import Sample
from qpavoid.model.scene import Scene
from qpavoid.model.views import read_poses
from qpavoid.problem import Array, IntArray, Mask


class Attachments:
    """Attaches objects to joints in the pair table of some distances, which all others of the controller share."""

    def __init__(self, scene: Scene, query: DistanceQuery, safety_distance: float) -> None:
        """Begin with nothing attached.

        Args:
            scene: robot and obstacles.
            query: distances, which are computed anew where an object is attached or released.
            safety_distance: between surfaces [m].
        """
        self._scene, self._query, self._safety_distance = scene, query, safety_distance
        self._table, self._kinematics = query.table, ForwardKinematics(scene.robot.model)
        self._max_distance = float(self._table.max_extension().max())
        self._touching: IntArray = np.zeros(0, dtype=np.intp)
        self._rigid: Mask = np.zeros(len(scene.pairs), dtype=bool)
        self._allowed: Mask = np.zeros(len(scene.pairs), dtype=bool)

    def attach(self, index: int, frame_id: int, q: Array, pose: Sample) -> None:
        """Attach an obstacle to the joint that moves a frame, where it is now.

        Args:
            index: number of the obstacle.
            frame_id: of a frame that a joint moves.
            q: configuration (nq,).
            pose: world pose of the obstacle.

        Raises:
            ConfigError: the obstacle was not declared graspable, the frame is fixed to the world, or far from it.
        """
        obstacle, frame = self._scene.slots[index], self._scene.robot.model.frames[frame_id]
        if not obstacle.graspable:
            raise ConfigError(f"attach: {obstacle.name!r} cannot be carried: declare it with `graspable: true`")
        joint = int(frame.parentJoint)
        if joint == 0:
            raise ConfigError(f"attach: frame {frame.name!r} is fixed to the world; name one that a joint moves")
        placement = self._joint_pose(joint, q).actInv(pin.SE3(pose.rotation, pose.position))
        center, radius = np.split(self._table.spheres[self._table.first[index]], [3])
        if np.linalg.norm(placement.act(center)) + radius > self._max_distance:
            raise ConfigError(
                f"attach: {obstacle.name!r} is {np.linalg.norm(placement.translation):.2f} m from the joint that moves "
                f"{frame.name!r}: too far to be carried by it"
            )
        self._change(index, joint, read_poses([placement])[0])

    def release(self, index: int, q: Array) -> Sample:
        """Release an attached object where it is, and return its world pose.

        Raises:
            ConfigError: it is not attached.
        """
        if index not in self._table.attached:
            raise ConfigError(f"release: {self._scene.slots[index].name!r} is not carried")
        sample = self.pose(index, q)
        self._change(index, 0, np.zeros(12))
        return sample

    def pose(self, index: int, q: Array) -> Sample:
        """Return the world pose of an attached object at q (nq,)."""
        local = self._table.placements[self._table.first[index]]
        placement = pin.SE3(local[:9].reshape(3, 3).T, local[9:])
        pose = self._joint_pose(self._table.attached[index], q) * placement
        return Sample.at(pose.translation, pose.rotation)

    def ignore_touching(self, index: int, q: Array) -> None:
        """Ignore the pairs of an obstacle, just attached or released, that touch at q (nq,) until they are apart."""
        own, query = self._table.pairs_of(index), self._query
        was_touching = np.isin(np.arange(len(own)), self._touching)
        self._kinematics.compute(q)
        query.compute(self._kinematics.joint_poses, query.influence_distance)
        pairs = np.arange(len(own))
        touching = own & (query.distances_of(pairs) <= self._safety_distance)
        self._touching = np.flatnonzero((touching | (was_touching & ~own)) & ~self._rigid)
        self._update()

    def allow(self, index: int, names: set[str], allowed: bool) -> None:
        """Allow contact of an obstacle with some bodies or obstacles, or take that back.

        Raises:
            ConfigError: there is no such pair.
        """
        name = self._scene.slots[index].name
        chosen = np.array([name in pair and bool(names & set(pair) - {name}) for pair in self._scene.pair_names])
        if not chosen.any():
            raise ConfigError(f"allow_contact: no pair of {name!r} with any of {', '.join(sorted(names))}")
        self._allowed[chosen] = allowed
        self._update()

    def take_over(self, other: Attachments) -> None:
        """Ignore the pairs that touch or may touch in another controller of the same scene."""
        self._touching, self._allowed = other._touching.copy(), other._allowed.copy()
        self._update()

    def forget(self, index: int) -> None:
        """Forget what touched an obstacle, or was allowed to."""
        own = self._table.pairs_of(index)
        self._touching, self._allowed[own] = self._touching[~own[self._touching]], False
        self._update()

    @property
    def is_watching(self) -> bool:
        """Whether there are pairs that touch, and are ignored until they are apart."""
        return len(self._touching) > 0

    def update(self) -> None:
        """Let pairs that touched get rows again, once they are apart in the distances of this step."""
        is_separated = self._query.distances_of(self._touching) > self._safety_distance
        if is_separated.any():
            self._touching = self._touching[~is_separated]
            self._update()

    def _change(self, index: int, joint: int, placement: Array) -> None:
        self._table.attach(index, joint, placement)
        self._rigid = self._table.rigid_pairs()
        self._update()

    def _update(self) -> None:
        ignored = self._rigid | self._allowed
        ignored[self._touching] = True
        self._table.ignored[:] = ignored

    def _joint_pose(self, joint: int, q: Array) -> pin.SE3:
        self._kinematics.compute(q)
        pose = self._kinematics.joint_poses[joint]
        return pin.SE3(pose[:9].reshape(3, 3).T, pose[9:])
