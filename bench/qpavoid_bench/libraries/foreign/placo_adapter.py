"""placo 0.10: soft frame tasks and the hard AvoidSelfCollisions constraint, as in its documentation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import placo
from base import Adapter
from pinocchio_bodies import add_bodies


class Library(Adapter):
    """Its model always has a floating base, masked for a fixed robot; obstacles are put into its collision model."""

    def __init__(self, setup: SimpleNamespace) -> None:
        """Set placo up."""
        super().__init__(setup)
        self.robot = placo.RobotWrapper("", 0, setup.urdf)
        model = self.robot.model
        joints = {name: model.joints[model.getJointId(name)] for name, _, _ in setup.joints}
        self.use_indices(pin.neutral(model), lambda name: joints[name].idx_q, lambda name: joints[name].idx_v)
        links = {link: model.frames[model.getFrameId(link)].parentJoint for link in setup.links}
        add_bodies(self.robot.collision_model, setup, {**links, "world": 0})
        self.solver = placo.KinematicsSolver(self.robot)
        self.solver.dt = setup.dt
        self.solver.mask_fbase(not setup.floating)
        self.solver.enable_joint_limits(True)
        self.solver.enable_velocity_limits(True)
        if setup.damping:
            self.solver.add_regularization_task(setup.damping)
        self._set_target = [self._task(name, *weights) for name, _, _, *weights in setup.frames]
        if len(setup.pairs):
            constraint = self.solver.add_avoid_self_collisions_constraint()
            constraint.configure("avoid", "hard", 1.0)
            constraint.self_collisions_margin, constraint.self_collisions_trigger = setup.d1, setup.d2

    def _task(self, frame: str, position: float, orientation: float) -> Callable[[Any], None]:
        """Add a task; return a setter of its target pose."""
        if position and orientation:
            task = self.solver.add_frame_task(frame, np.eye(4))
            task.configure(frame, "soft", position, orientation)
            return lambda pose: setattr(task, "T_world_frame", pose)
        if position:
            task = self.solver.add_position_task(frame, np.zeros(3))
            task.configure(frame, "soft", position)
            return lambda pose: setattr(task, "target_world", pose[:3, 3])
        task = self.solver.add_orientation_task(frame, np.eye(3))
        task.configure(frame, "soft", orientation)
        return lambda pose: setattr(task, "R_world_frame", pose[:3, :3])

    def move(self, placements: Mapping[int, Any]) -> None:
        """Place bodies of the collision model."""
        for number, placement in placements.items():
            self.robot.collision_model.geometryObjects[number].placement = pin.SE3(placement)

    def _place(self, q: Any) -> None:
        self.robot.state.q = q
        self.robot.update_kinematics()

    def step(self, q: Any, targets: Any) -> Any:
        """Raise RuntimeError where it finds nothing; placo returns a displacement."""
        for set_target, target in zip(self._set_target, targets, strict=True):
            set_target(target)
        self._place(q)
        return self.solver.solve(False) / self.setup.dt

    def frames(self, q: Any) -> Any:
        """Return the poses of its frames."""
        self._place(q)
        return np.array([self.robot.get_T_world_frame(frame[0]) for frame in self.setup.frames])

    def distances(self, q: Any) -> Any:
        """Return its distances, matched by its pairs of bodies."""
        self._place(q)
        by_pair = {(near.objA, near.objB): near.min_distance for near in self.robot.distances()}
        return np.array([by_pair[a, b] for a, b in self.setup.pairs.tolist()])
