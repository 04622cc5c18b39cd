"""placo, on the workload's URDF and, through its collision model, geometry."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio as pin
import placo

from qpavoid_bench.tick.workloads import Array, Workload

_SHAPES = {"sphere": coal.Sphere, "capsule": coal.Capsule, "box": coal.Box}


class Placo:
    """AvoidSelfCollisions constraint with all pairs."""

    def __init__(self, workload: Workload) -> None:
        self.workload = workload
        self.robot = placo.RobotWrapper("", 0, workload.urdf)
        model = self.robot.model
        self._joints = [(joint, model.joints[model.getJointId(joint.name)]) for joint in workload.joints]
        geometry = self.robot.collision_model
        for body in workload.bodies:
            joint = 0 if body.link == "world" else 1
            if joint and body.link != workload.floating:
                joint = model.getJointId(body.link.removeprefix("link_"))
            placement, shape = pin.SE3(body.placement), _SHAPES[body.shape](*body.size)
            geometry.addGeometryObject(pin.GeometryObject(body.name, joint, placement, shape))
        for a, b in workload.pairs.tolist():
            geometry.addCollisionPair(pin.CollisionPair(a, b))
        self._q = self._placo_order(workload.q)
        self.solver = placo.KinematicsSolver(self.robot)
        self.solver.dt = workload.dt
        self.solver.mask_fbase(not workload.floating)
        self.solver.enable_joint_limits(True)
        self.solver.enable_velocity_limits(True)
        self.tasks = []
        for name, _, _ in workload.frames:
            task = self.solver.add_frame_task(name, np.eye(4))
            task.configure(name, "soft", 1.0, 1.0)
            self.tasks.append(task)
        if len(workload.pairs):
            constraint = self.solver.add_avoid_self_collisions_constraint()
            constraint.configure("avoid", "hard", 1.0)
            constraint.self_collisions_margin = workload.d_min
            constraint.self_collisions_trigger = workload.influence

    def _placo_order(self, q: Array) -> list[Array]:
        """Return configurations in placo's order; its floating base is the workload's, or at the origin."""
        out = np.tile(pin.neutral(self.robot.model), (len(q), 1))
        if self.workload.floating:
            out[:, :7] = q[:, :7]
        for joint, own in self._joints:
            out[:, own.idx_q] = q[:, joint.q_index]
        return list(out)

    def _place(self, tick: int) -> None:
        self.robot.state.q = self._q[tick]
        self.robot.update_kinematics()

    def step(self, tick: int) -> Any:
        """One control step; placo returns a displacement."""
        for task, target in zip(self.tasks, self.workload.targets[tick], strict=True):
            task.T_world_frame = target
        self._place(tick)
        return self.solver.solve(False) / self.workload.dt

    def velocity(self, v: Any) -> Array:
        """Coordinates in the workload's order."""
        out = np.empty(self.workload.nv)
        if self.workload.floating:
            out[:6] = v[:6]
        for joint, own in self._joints:
            out[joint.v_index] = v[own.idx_v]
        return out

    def frames(self, tick: int) -> Array:
        """By placo."""
        self._place(tick)
        return np.array([self.robot.get_T_world_frame(name) for name, _, _ in self.workload.frames])

    def distances(self, tick: int) -> Array:
        """By placo, matched by its pairs of bodies."""
        self._place(tick)
        result = {(d.objA, d.objB): d.min_distance for d in self.robot.distances()}
        return np.array([result[a, b] for a, b in self.workload.pairs.tolist()])
