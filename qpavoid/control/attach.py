"""Obstacles that the robot carries for a while: who carries what, and which pairs that switches on and off.

All pairs that carrying may need are laid out at the start. While an obstacle is carried it is a body of the robot: its
rows have the support of the joint that carries it. Pairs with what is rigidly connected to it, or hangs below it as
fingers do, are off. So are those that touch when it is picked up or put down (the gripper, a table), until they have
once been apart by more than the safe distance: a row could only ask them to part at once.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from qpavoid.control.assembler import Assembly
from qpavoid.control.distances import DistanceQuery
from qpavoid.errors import ConfigError
from qpavoid.model.kinematics import support_masks
from qpavoid.model.scene import Scene
from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, IntArray


class Attachments:
    """Who carries what, in the distances of the tick, in those ahead and in the rows."""

    def __init__(self, scene: Scene, queries: tuple[DistanceQuery, ...], assembly: Assembly, hold: float) -> None:
        """Begins with nothing carried.

        Args:
            scene: robot and obstacles.
            queries: all distances that have to know; those of the tick first.
            assembly: of the tick's rows.
            hold: safe distance between surfaces [m].
        """
        self._scene, self._queries, self._assembly, self._hold = scene, queries, assembly, hold
        self._model = scene.robot.model
        self._data = self._model.createData()
        self._masks = support_masks(self._model)
        self._longest = float(queries[0].max_extension().max())
        self._touching: IntArray = np.zeros(0, dtype=np.intp)
        self._rigid = np.zeros(len(scene.pairs), dtype=bool)
        self._allowed = np.zeros(len(scene.pairs), dtype=bool)

    def attach(self, index: int, frame_id: int, q: Array) -> None:
        """Lets a frame carry an obstacle, where it is now.

        Args:
            index: number of the obstacle.
            frame_id: of a frame that a joint moves.
            q: configuration (nq,).

        Raises:
            ConfigError: the obstacle was not declared graspable, the frame is fixed to the world, or far from it.
        """
        obstacle, frame = self._scene.obstacles[index], self._model.frames[frame_id]
        if not obstacle.graspable:
            raise ConfigError(f"attach: {obstacle.name!r} cannot be carried: declare it with `graspable: true`")
        joint = int(frame.parentJoint)
        if joint == 0:
            raise ConfigError(f"attach: frame {frame.name!r} is fixed to the world; name one that a joint moves")
        placement = self._placement(joint, q).actInv(self._pose(index, q))
        center, radius = np.split(self._queries[0].spheres[self._geometry(index)], [3])
        if np.linalg.norm(placement.act(center)) + radius > self._longest:
            raise ConfigError(
                f"attach: {obstacle.name!r} is {np.linalg.norm(placement.translation):.2f} m from the joint that moves "
                f"{frame.name!r}: too far to be carried by it"
            )
        self._carry(index, joint, Sample.at(placement.translation, placement.rotation), q)

    def release(self, index: int, q: Array) -> Sample:
        """Puts a carried obstacle down where it is, and gives its pose.

        Raises:
            ConfigError: it is not carried.
        """
        if index not in self._queries[0].carried:
            raise ConfigError(f"release: {self._scene.obstacles[index].name!r} is not carried")
        pose = self._pose(index, q)
        sample = Sample.at(pose.translation, pose.rotation)
        self._carry(index, 0, sample, q)
        return sample

    def allow(self, index: int, names: set[str], allowed: bool) -> None:
        """Whether an obstacle and some bodies or obstacles may touch.

        Raises:
            ConfigError: there is no such pair.
        """
        name = self._scene.obstacles[index].name
        chosen = np.array([name in pair and bool(names & set(pair) - {name}) for pair in self._scene.pair_names])
        if not chosen.any():
            raise ConfigError(f"allow_contact: no pair of {name!r} with any of {', '.join(sorted(names))}")
        self._allowed[chosen] = allowed
        self._look_away()

    def update(self) -> None:
        """Watches pairs again that touched and have come apart since."""
        if not len(self._touching):
            return
        apart = self._queries[0].found(self._touching) > self._hold
        if apart.any():
            self._touching = self._touching[~apart]
            self._look_away()

    def sync(self, query: DistanceQuery) -> None:
        """Bring other distances of the same scene up to date with the attached objects."""
        if query.carried != self.carried:
            for index in {*query.carried, *self.carried}:
                body = self._queries[0].bodies[self._geometry(index)]
                placement = Sample.at(body.placement.translation, body.placement.rotation)
                query.carry(index, int(body.parentJoint), placement)
        query.disabled_pairs = self._queries[0].disabled_pairs

    def pose(self, index: int, q: Array) -> Sample:
        """World pose of an obstacle at q (nq,)."""
        pose = self._pose(index, q)
        return Sample.at(pose.translation, pose.rotation)

    @property
    def carried(self) -> dict[int, int]:
        """Joint that carries each obstacle which is carried."""
        return self._queries[0].carried

    def _carry(self, index: int, joint: int, sample: Sample, q: Array) -> None:
        for query in self._queries:
            query.carry(index, joint, sample)
        self._assembly.carry(self._queries[0])
        self._rigid[:] = False
        joints = np.array([body.parentJoint for body in self._queries[0].bodies], dtype=np.intp)
        first, second = self._scene.pairs.T
        a, b = joints[first], joints[second]
        for carried, carrier in self.carried.items():
            # what moves with the carrier or hangs below it: its support has all of the carrier's coordinates
            below = np.all(self._masks[:, self._masks[carrier] > 0.0] > 0.0, axis=1, keepdims=True)[:, 0]
            self._rigid |= (first == self._geometry(carried)) & below[b]
            self._rigid |= (second == self._geometry(carried)) & below[a]
        mine = (first == self._geometry(index)) | (second == self._geometry(index))
        was = np.zeros(len(mine), dtype=bool)
        was[self._touching] = True
        query = self._queries[0]
        query.disabled_pairs = None
        pin.forwardKinematics(self._model, self._data, q)
        query.compute(self._data, self._hold)
        found = query.pairs[query.results[query.pairs, 0] <= self._hold]
        touching = np.zeros(len(mine), dtype=bool)
        touching[query.group[found]] = True
        touching = touching[query.group] & mine
        self._touching = np.flatnonzero((touching | (was & ~mine)) & ~self._rigid)
        self._look_away()

    def _look_away(self) -> None:
        off = self._rigid | self._allowed
        off[self._touching] = True
        for query in self._queries:
            query.disabled_pairs = off if off.any() else None

    def _geometry(self, index: int) -> int:
        return int(np.flatnonzero(self._scene.obstacle_of == index)[0])

    def _placement(self, joint: int, q: Array) -> pin.SE3:
        pin.forwardKinematics(self._model, self._data, q)
        return self._data.oMi[joint]

    def _pose(self, index: int, q: Array) -> pin.SE3:
        body = self._queries[0].bodies[self._geometry(index)]
        if not body.parentJoint:
            return pin.SE3(body.placement)
        return self._placement(int(body.parentJoint), q) * body.placement
