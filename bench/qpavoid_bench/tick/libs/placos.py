"""placo, in an environment of its own, on a URDF with the same joints and, through its collision model, geometry."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio as pin
import placo

from qpavoid_bench.tick.workloads import Array, Body, Workload


class Placo:
    """AvoidSelfCollisions constraint with all pairs."""

    def __init__(self, workload: Workload) -> None:
        self.workload = workload
        self._free = any(joint.kind == "free" for joint in workload.joints)
        self.robot = placo.RobotWrapper("", 0, write_urdf(workload))
        model = self.robot.model
        # its joints by name; its floating base stands for the free joint, or for the fixed world
        self._joint_id = [0, *(1 if j.kind == "free" else model.getJointId(j.name) for j in workload.joints[1:])]
        self._add_bodies()
        self._q = self._placo_order(workload.q)
        self.solver = placo.KinematicsSolver(self.robot)
        self.solver.dt = workload.dt
        self.solver.mask_fbase(not self._free)
        self.solver.enable_joint_limits(True)
        self.solver.enable_velocity_limits(True)
        self.tasks = []
        for frame in workload.frames:
            task = self.solver.add_frame_task(frame.name, np.eye(4))
            task.configure(frame.name, "soft", 1.0, 1.0)
            self.tasks.append(task)
        if len(workload.pairs):
            constraint = self.solver.add_avoid_self_collisions_constraint()
            constraint.configure("avoid", "hard", 1.0)
            constraint.self_collisions_margin = workload.d_min
            constraint.self_collisions_trigger = workload.influence

    def _add_bodies(self) -> None:
        geometry = self.robot.collision_model
        for body in self.workload.bodies:
            placement = pin.SE3(body.placement)
            geometry.addGeometryObject(
                pin.GeometryObject(body.name, self._joint_id[body.joint], placement, _shape(body))
            )
        for a, b in self.workload.pairs.tolist():
            geometry.addCollisionPair(pin.CollisionPair(a, b))

    def _placo_order(self, q: Array) -> list[Array]:
        model = self.robot.model
        out = np.tile(pin.neutral(model), (len(q), 1))
        for joint, index in zip(self.workload.joints[1:], self._joint_id[1:], strict=True):
            start, width = model.joints[index].idx_q, model.joints[index].nq
            out[:, start : start + width] = q[:, joint.q_index : joint.q_index + width]
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
        out, model = np.empty(self.workload.nv), self.robot.model
        for joint, index in zip(self.workload.joints[1:], self._joint_id[1:], strict=True):
            start, width = model.joints[index].idx_v, model.joints[index].nv
            out[joint.v_index : joint.v_index + width] = v[start : start + width]
        return out

    def frames(self, tick: int) -> Array:
        """By placo."""
        self._place(tick)
        return np.array([self.robot.get_T_world_frame(frame.name) for frame in self.workload.frames])

    def distances(self, tick: int) -> Array:
        """By placo, matched by its pairs of bodies."""
        self._place(tick)
        found = {(d.objA, d.objB): d.min_distance for d in self.robot.distances()}
        return np.array([found[a, b] for a, b in self.workload.pairs.tolist()])


def write_urdf(workload: Workload) -> str:
    """The workload's joints and frames as a URDF, without geometry: one link a joint, a fixed one for each frame."""
    lines = ['<robot name="workload">']
    links = [joint.name if joint.kind == "world" else f"link_{joint.name}" for joint in workload.joints]
    free = {i for i, joint in enumerate(workload.joints) if joint.kind == "free"}
    # placo puts its floating base under the root link: the link of the free joint where there is one
    lines += [f'<link name="{link}"/>' for i, link in enumerate(links) if not (free and i == 0)]
    for i, joint in enumerate(workload.joints):
        if joint.kind in ("hinge", "slide"):
            kind = {"hinge": "revolute", "slide": "prismatic"}[joint.kind]
            lines.append(
                f'<joint name="{joint.name}" type="{kind}"><parent link="{links[joint.parent]}"/>'
                f'<child link="{links[i]}"/>{_origin(joint.placement)}<axis xyz="{_numbers(joint.axis)}"/>'
                f'<limit lower="{joint.lower!r}" upper="{joint.upper!r}" velocity="{joint.velocity!r}" effort="1e6"/>'
                "</joint>"
            )
    for frame in workload.frames:
        lines.append(
            f'<link name="{frame.name}"/><joint name="to_{frame.name}" type="fixed">'
            f'<parent link="{links[frame.joint]}"/>'
            f'<child link="{frame.name}"/>{_origin(frame.placement)}</joint>'
        )
    return "\n".join([*lines, "</robot>"])


def _shape(body: Body) -> Any:
    shapes = {"sphere": coal.Sphere, "capsule": coal.Capsule, "box": coal.Box}
    return shapes[body.shape](*body.size)


def _origin(placement: Array) -> str:
    rpy = pin.rpy.matrixToRpy(placement[:3, :3])
    return f'<origin xyz="{_numbers(placement[:3, 3])}" rpy="{_numbers(rpy)}"/>'


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)
