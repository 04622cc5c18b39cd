"""mink 1.3: FrameTasks on sites of a MuJoCo model, CollisionAvoidanceLimit, ConfigurationLimit, VelocityLimit."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import mink
import mujoco
import numpy as np
from base import Adapter


class GivenPairs(mink.CollisionAvoidanceLimit):  # type: ignore[misc]
    """The limit with exactly the pairs it is given.

    mink leaves out pairs of a body with its parent's, which for the first link means with every obstacle of the world;
    here all libraries have the same pairs.
    """

    def _construct_geom_id_pairs(self, geom_pairs: Any) -> list[tuple[int, int]]:
        return [(self.model.geom(a).id, self.model.geom(b).id) for a, b in geom_pairs]


class Library(Adapter):
    """Obstacles that move are mocap bodies; its limit knows nothing of their motion."""

    def __init__(self, setup: SimpleNamespace) -> None:
        """Build a MuJoCo model, and mink's tasks and limits."""
        super().__init__(setup)
        self._model = model = _build(setup)
        self.use_indices(
            mujoco.MjData(model).qpos,
            lambda name: model.joint(name).qposadr[0],
            lambda name: model.joint(name).dofadr[0],
            (0, 1, 2, 4, 5, 6, 3),  # MuJoCo's quaternion begins with w
        )
        self._configuration = mink.Configuration(model, self.configuration(setup.q))
        self._mocap = {n: model.body(body[0]).mocapid[0] for n, body in enumerate(setup.bodies) if body[5]}
        self.move({number: setup.bodies[number][4] for number in self._mocap})
        names = [body[0] for body in setup.bodies]
        self._collision = GivenPairs(
            model,
            [(names[a], names[b]) for a, b in setup.pairs.tolist()],
            minimum_distance_from_collisions=setup.d1,
            collision_detection_distance=setup.d2,
        )
        speeds = {name: setup.speed[v] for name, _, v in setup.joints if np.isfinite(setup.speed[v])}
        self._limits = [mink.ConfigurationLimit(model), self._collision, mink.VelocityLimit(model, speeds)]
        self._tasks = [
            mink.FrameTask(f"{name} site", "site", np.sqrt(position), np.sqrt(orientation))
            for name, _, _, position, orientation in setup.frames
        ]
        self._damping = max(setup.damping, 1e-12)

    def targets(self, poses: Any) -> Any:
        """Return poses as mink's."""
        return [mink.SE3.from_matrix(np.ascontiguousarray(pose)) for pose in poses]

    def move(self, placements: Mapping[int, Any]) -> None:
        """Place mocap bodies."""
        data = self._configuration.data
        for number, placement in placements.items():
            pose = _placed(placement)
            data.mocap_pos[self._mocap[number]], data.mocap_quat[self._mocap[number]] = pose["pos"], pose["quat"]

    def step(self, q: Any, targets: Any) -> Any:
        """Raise NoSolutionFound where it finds nothing."""
        self._configuration.update(q)
        for task, target in zip(self._tasks, targets, strict=True):
            task.set_target(target)
        return mink.solve_ik(
            self._configuration, self._tasks, self.setup.dt, solver="daqp", damping=self._damping, limits=self._limits
        )

    def velocity(self, v: Any) -> Any:
        """Turn a floating base's linear velocity, which MuJoCo gives in world axes."""
        out = super().velocity(v)
        if self.setup.floating:
            out[:3] = self._configuration.data.xmat[1].reshape(3, 3).T @ out[:3]
        return out

    def frames(self, q: Any) -> Any:
        """Return the poses of the sites."""
        self._configuration.update(q)
        transform = self._configuration.get_transform_frame_to_world
        return np.array([transform(task.frame_name, "site").as_matrix() for task in self._tasks])

    def distances(self, q: Any) -> Any:
        """Return MuJoCo's distances, as the limit asks for them."""
        self._configuration.update(q)
        data, points, far = self._configuration.data, np.empty(6), 100.0
        pairs = self._collision.geom_id_pairs
        return np.array([mujoco.mj_geomDistance(self._model, data, a, b, far, points) for a, b in pairs])


def _build(setup: SimpleNamespace) -> Any:
    """Return the MuJoCo model of a scene."""
    spec = mujoco.MjSpec.from_string(setup.urdf)
    spec.compiler.fusestatic, spec.compiler.boundmass, spec.compiler.boundinertia = False, 1.0, 1.0
    spec.option.ccd_tolerance, spec.option.ccd_iterations = 1e-9, 200
    if setup.floating:
        spec.body(setup.floating).add_freejoint()
    for name, link, kind, size, placement, moves in setup.bodies:
        if moves:
            spec.worldbody.add_body(name=name, mocap=True).add_geom(name=name, **_shape(spec, name, kind, size))
        else:
            place = spec.worldbody if link == "world" else spec.body(link)
            place.add_geom(name=name, **_shape(spec, name, kind, size), **_placed(placement))
    for name, link, placement, _, _ in setup.frames:
        place = spec.worldbody if link == "world" else spec.body(link)
        place.add_site(name=f"{name} site", **_placed(placement))
    return spec.compile()


def _shape(spec: Any, name: str, kind: str, size: Any) -> dict[str, Any]:
    """Return kind and size of a geom: half lengths, where a body has whole ones."""
    if kind == "Convex":
        spec.add_mesh(name=name, uservert=np.ravel(size)).inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        return {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": name}
    if kind not in ("Sphere", "Capsule", "Cylinder", "Box", "Ellipsoid"):
        raise ValueError(f"{name}: MuJoCo has no {kind} whose distance it computes")
    halves = {"Capsule": (1.0, 0.5), "Cylinder": (1.0, 0.5), "Box": (0.5,) * 3}.get(kind, (1.0,) * len(size))
    padded = np.zeros(3)
    padded[: len(size)] = np.multiply(size, halves)
    return {"type": getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), "size": padded}


def _placed(placement: Any) -> dict[str, Any]:
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(placement[:3, :3]).ravel())
    return {"pos": placement[:3, 3], "quat": quaternion}
