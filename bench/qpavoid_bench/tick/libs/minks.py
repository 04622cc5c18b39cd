"""mink, on an MJCF with the same joints and geometry."""

from __future__ import annotations

from typing import Any

import mink
import mujoco
import numpy as np

from qpavoid_bench.tick.workloads import Array, Body, Workload


class GivenPairs(mink.CollisionAvoidanceLimit):
    """The limit with exactly the pairs it is given.

    mink leaves out pairs of a body with its parent's, which for the first link means with every obstacle; here all
    libraries watch the same pairs.
    """

    def _construct_geom_id_pairs(self, geom_pairs: Any) -> list[tuple[int, int]]:
        return [(self.model.geom(a).id, self.model.geom(b).id) for a, b in geom_pairs]


class Mink:
    """One CollisionAvoidanceLimit with all pairs."""

    def __init__(self, workload: Workload) -> None:
        self.workload = workload
        self.model = model = mujoco.MjModel.from_xml_string(write_mjcf(workload))
        self.configuration = mink.Configuration(model)
        names = [body.name for body in workload.bodies]
        self.collision = GivenPairs(
            model,
            [(names[a], names[b]) for a, b in workload.pairs],
            minimum_distance_from_collisions=workload.d_min,
            collision_detection_distance=workload.influence,
        )
        speeds = {joint.name: joint.velocity for joint in workload.joints if np.isfinite(joint.velocity)}
        self.limits = [mink.ConfigurationLimit(model), self.collision, mink.VelocityLimit(model, speeds)]
        self.tasks = [
            mink.FrameTask(frame.name, "site", position_cost=1.0, orientation_cost=1.0) for frame in workload.frames
        ]
        self._free = any(joint.kind == "free" for joint in workload.joints)
        self._q = list(self._mujoco_order(workload.q))
        self._targets = [[mink.SE3.from_matrix(target) for target in targets] for targets in workload.targets]

    def _mujoco_order(self, q: Array) -> Array:
        """Pinocchio's configurations in MuJoCo's order (T, nq); quaternions begin with w."""
        out = np.empty_like(q)
        for joint in self.workload.joints[1:]:
            start = self.model.joint(joint.name).qposadr[0]
            if joint.kind == "free":
                out[:, start : start + 7] = q[:, joint.q_index + np.array([0, 1, 2, 6, 3, 4, 5])]
            else:
                out[:, start] = q[:, joint.q_index]
        return out

    def step(self, tick: int) -> Array:
        """One control step."""
        for task, target in zip(self.tasks, self._targets[tick], strict=True):
            task.set_target(target)
        self.configuration.update(self._q[tick])
        return mink.solve_ik(self.configuration, self.tasks, self.workload.dt, solver="daqp", limits=self.limits)

    def velocity(self, v: Any) -> Array:
        """MuJoCo gives a free joint's linear velocity in world axes."""
        out = np.empty(self.workload.nv)
        for joint in self.workload.joints[1:]:
            start = self.model.joint(joint.name).dofadr[0]
            if joint.kind == "free":
                body = self.model.joint(joint.name).bodyid[0]
                rotation = self.configuration.data.xmat[body].reshape(3, 3)
                out[joint.v_index : joint.v_index + 3] = rotation.T @ v[start : start + 3]
                out[joint.v_index + 3 : joint.v_index + 6] = v[start + 3 : start + 6]
            else:
                out[joint.v_index] = v[start]
        return out

    def frames(self, tick: int) -> Array:
        """By MuJoCo."""
        self.configuration.update(self._q[tick])
        frames = self.workload.frames
        return np.array([self.configuration.get_transform_frame_to_world(f.name, "site").as_matrix() for f in frames])

    def distances(self, tick: int) -> Array:
        """By MuJoCo, as the limit asks for them."""
        self.configuration.update(self._q[tick])
        data, nothing = self.configuration.data, np.empty(6)
        far = 100.0
        return np.array(
            [mujoco.mj_geomDistance(self.model, data, a, b, far, nothing) for a, b in self.collision.geom_id_pairs]
        )


def write_mjcf(workload: Workload) -> str:
    """The workload's joints, bodies and frames as MJCF: one MuJoCo body a joint, all masses 1 kg."""
    joints = workload.joints

    def contents(index: int) -> str:
        lines = [_geom(body) for body in workload.bodies if body.joint == index]
        lines += [
            f'<site name="{frame.name}" {_placed(frame.placement)}/>'
            for frame in workload.frames
            if frame.joint == index
        ]
        lines += [body_of(i) for i in range(1, len(joints)) if joints[i].parent == index]
        return "\n".join(lines)

    def body_of(index: int) -> str:
        joint = joints[index]
        if joint.kind == "free":
            element = f'<freejoint name="{joint.name}"/>'
        else:
            element = f'<joint name="{joint.name}" type="{joint.kind}" axis="{_numbers(joint.axis)}"'
            if np.isfinite(joint.lower):
                element += f' limited="true" range="{_numbers((joint.lower, joint.upper))}"'
            element += "/>"
        inertia = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        return f'<body name="{joint.name}" {_placed(joint.placement)}>{element}{inertia}{contents(index)}</body>'

    return '<mujoco><compiler angle="radian" autolimits="false"/><worldbody>' + contents(0) + "</worldbody></mujoco>"


def _geom(body: Body) -> str:
    if body.shape == "capsule":
        size: tuple[float, ...] = (body.size[0], body.size[1] / 2.0)
    elif body.shape == "box":
        size = tuple(side / 2.0 for side in body.size)
    else:
        size = body.size
    return f'<geom name="{body.name}" type="{body.shape}" size="{_numbers(size)}" {_placed(body.placement)}/>'


def _placed(placement: Array) -> str:
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(placement[:3, :3]).ravel())
    return f'pos="{_numbers(placement[:3, 3])}" quat="{_numbers(quaternion)}"'


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)
