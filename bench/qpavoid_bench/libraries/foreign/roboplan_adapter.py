"""roboplan 0.7, OInK: FrameTasks, PositionLimit, VelocityLimit and SelfCollisionBarrier, as in its examples.

`solveIk` and then `enforceBarriers`, with the values of example_oink and example_teleop: barrier gain 1, safe
displacement gain 0.01, Levenberg-Marquardt damping 0.01, regularization 1e-6; 20 collision pairs.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from base import Adapter, urdf_with_bodies
from roboplan import core
from roboplan.optimal_ik import (
    FrameTask,
    FrameTaskOptions,
    Oink,
    PositionLimit,
    SelfCollisionBarrier,
    SelfCollisionBarrierOptions,
    VelocityLimit,
)


class Library(Adapter):
    """Obstacles are geometries that are added to the scene; the barrier knows no motion of theirs."""

    def __init__(self, setup: SimpleNamespace) -> None:
        """Set roboplan up."""
        super().__init__(setup)
        if setup.floating:
            raise ValueError("its URDF scenes have a fixed base")
        urdf = urdf_with_bodies(setup, range(setup.robot_bodies))
        self.scene = core.Scene("scene", core.loadUrdfSceneDescriptionFromXml(urdf))
        for number in range(setup.robot_bodies, len(setup.bodies)):
            self._add(number)
        self._select_pairs()
        self.oink = Oink(self.scene)
        infos = {name: self.scene.getJointPositionIndices([name])[0] for name, _, _ in setup.joints}
        self.use_indices(self.scene.getCurrentJointPositions(), infos.__getitem__, infos.__getitem__)
        speed = np.empty(setup.nv)
        speed[self._v_index] = np.minimum(setup.speed, 1e6)
        self._limits = [PositionLimit(self.oink, 1.0), VelocityLimit(self.oink, setup.dt, speed)]
        self._tasks = []
        for name, _, _, position, orientation in setup.frames:
            goal = core.CartesianConfiguration()
            goal.base_frame, goal.tip_frame, goal.tform = "world", name, np.eye(4)
            costs = FrameTaskOptions(float(np.sqrt(position)), float(np.sqrt(orientation)), 1.0, 0.01)
            self._tasks.append(FrameTask(self.oink, self.scene, goal, costs))
        self._barriers = []
        if count := min(setup.options["n_collision_pairs"], len(setup.pairs)):
            options = SelfCollisionBarrierOptions(count, 1.0, 0.01, setup.d1, 0.0, setup.d2)
            self._barriers.append(SelfCollisionBarrier(self.oink, self.scene, setup.dt, options))
        self._dq = np.zeros(self.oink.num_variables)

    def _add(self, number: int) -> None:
        _, _, kind, size, placement, _ = self.setup.bodies[number]
        if kind not in ("Sphere", "Box", "Cylinder"):
            raise ValueError(f"a {kind} cannot be added to its scene")
        add = getattr(self.scene, f"add{kind}Geometry")
        add(f"body_{number}", "universe", getattr(core, kind)(*size), np.asfortranarray(placement), np.ones(4))

    def _select_pairs(self) -> None:
        """Allow contact of all pairs but those of the setup."""
        required = {tuple(pair) for pair in self.setup.pairs.tolist()}
        every = [(a, b) for b in range(len(self.setup.bodies)) for a in range(min(b, self.setup.robot_bodies))]
        for enable in (False, True):
            chosen = [pair for pair in every if (pair in required) == enable]
            self.scene.setCollisions([(f"body_{a}", f"body_{b}") for a, b in chosen], enable)

    def targets(self, poses: Any) -> Any:
        """Return poses in the order of its memory."""
        return [np.asfortranarray(pose) for pose in poses]

    def move(self, placements: Mapping[int, Any]) -> None:
        """Place geometries of the scene."""
        for number, placement in placements.items():
            self.scene.updateGeometryPlacement(f"body_{number}", "universe", np.asfortranarray(placement))

    def step(self, q: Any, targets: Any) -> Any:
        """Raise RuntimeError where it finds nothing."""
        for task, target in zip(self._tasks, targets, strict=True):
            task.setTargetFrameTransform(target)
        self.oink.solveIk(q, self._tasks, self._limits, self._barriers, self._dq, 1e-6)
        if self._barriers:
            self.oink.enforceBarriers(q, self._barriers, self._dq)
        return self._dq / self.setup.dt

    def frames(self, q: Any) -> Any:
        """Return the poses of its frames."""
        return np.array([self.scene.forwardKinematics(q, frame[0]) for frame in self.setup.frames])
