"""mink, on a MuJoCo model of the workload's URDF, with its geometry added."""

from __future__ import annotations

from typing import Any

import mink
import mujoco
import numpy as np

from qpavoid_bench.tick.workloads import Array, Body, Workload


class GivenPairs(mink.CollisionAvoidanceLimit):  # type: ignore[misc]
    """The limit with exactly the pairs it is given.

    mink leaves out pairs of a body with its parent's, which for the first link means with every obstacle; here all
    libraries check the same pairs.
    """

    def _construct_geom_id_pairs(self, geom_pairs: Any) -> list[tuple[int, int]]:
        return [(self.model.geom(a).id, self.model.geom(b).id) for a, b in geom_pairs]


class Mink:
    """One CollisionAvoidanceLimit with all pairs."""

    def __init__(self, workload: Workload) -> None:
        self.workload = workload
        self.model = model = build(workload)
        self.configuration = mink.Configuration(model)
        names = [body.name for body in workload.bodies]
        self.collision = GivenPairs(
            model,
            [(names[a], names[b]) for a, b in workload.pairs],
            minimum_distance_from_collisions=workload.d_min,
            collision_detection_distance=workload.influence,
        )
        speeds = {joint.name: joint.speed for joint in workload.joints if np.isfinite(joint.speed)}
        self.limits = [mink.ConfigurationLimit(model), self.collision, mink.VelocityLimit(model, speeds)]
        self.tasks = [mink.FrameTask(f"{name} site", "site", 1.0, 1.0) for name, _, _ in workload.frames]
        self._q = list(self._mujoco_order(workload.q))
        self._targets = [[mink.SE3.from_matrix(target) for target in targets] for targets in workload.targets]

    def _mujoco_order(self, q: Array) -> Array:
        """Return Pinocchio's configurations in MuJoCo's order (T, nq); a quaternion begins with w."""
        out = np.empty_like(q)
        out[:, :7] = q[:, [0, 1, 2, 6, 3, 4, 5]]  # of a floating base; without one, joints take its place below
        for joint in self.workload.joints:
            out[:, self.model.joint(joint.name).qposadr[0]] = q[:, joint.q_index]
        return out

    def step(self, tick: int) -> Any:
        """One control step."""
        for task, target in zip(self.tasks, self._targets[tick], strict=True):
            task.set_target(target)
        self.configuration.update(self._q[tick])
        return mink.solve_ik(self.configuration, self.tasks, self.workload.dt, solver="daqp", limits=self.limits)

    def velocity(self, v: Any) -> Array:
        """MuJoCo gives a floating base's linear velocity in world axes."""
        out = np.empty(self.workload.nv)
        if self.workload.floating:
            rotation = self.configuration.data.xmat[self.model.body(self.workload.floating).id].reshape(3, 3)
            out[:6] = np.concatenate((rotation.T @ v[:3], v[3:6]))
        for joint in self.workload.joints:
            out[joint.v_index] = v[self.model.joint(joint.name).dofadr[0]]
        return out

    def frames(self, tick: int) -> Array:
        """By MuJoCo."""
        self.configuration.update(self._q[tick])
        transform = self.configuration.get_transform_frame_to_world
        return np.array([transform(task.frame_name, "site").as_matrix() for task in self.tasks])

    def distances(self, tick: int) -> Array:
        """By MuJoCo, as the limit asks for them."""
        self.configuration.update(self._q[tick])
        data, points, far = self.configuration.data, np.empty(6), 100.0
        pairs = self.collision.geom_id_pairs
        return np.array([mujoco.mj_geomDistance(self.model, data, a, b, far, points) for a, b in pairs])


def build(workload: Workload) -> Any:
    """Return the MuJoCo model of a workload."""
    spec = mujoco.MjSpec.from_string(workload.urdf)
    spec.compiler.fusestatic, spec.compiler.boundmass, spec.compiler.boundinertia = False, 1.0, 1.0
    if workload.floating:
        spec.body(workload.floating).add_freejoint()
    for body in workload.bodies:
        place = spec.worldbody if body.link == "world" else spec.body(body.link)
        place.add_geom(name=body.name, **_shape(body), **_placed(body.placement))
    for name, link, placement in workload.frames:
        spec.body(link).add_site(name=f"{name} site", **_placed(placement))
    return spec.compile()


def _shape(body: Body) -> dict[str, Any]:
    """Return kind and size of a geom: half lengths, where a body has whole ones."""
    size = np.zeros(3)
    match body.shape:
        case "sphere":
            kind, size[0] = mujoco.mjtGeom.mjGEOM_SPHERE, body.size[0]
        case "capsule":
            kind, size[:2] = mujoco.mjtGeom.mjGEOM_CAPSULE, (body.size[0], 0.5 * body.size[1])
        case _:
            kind, size[:] = mujoco.mjtGeom.mjGEOM_BOX, 0.5 * np.array(body.size)
    return {"type": kind, "size": size}


def _placed(placement: Array) -> dict[str, Array]:
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(placement[:3, :3]).ravel())
    return {"pos": placement[:3, 3], "quat": quaternion}
