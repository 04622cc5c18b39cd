"""MuJoCo model of a scene: the same joints, bodies and obstacles, with kinematics, distances and dynamics of its own.

Importing this raises a ConfigError where MuJoCo is not installed; nothing of the package imports it by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.errors import ConfigError
from qpavoid.model.joints import hinge_or_slide
from qpavoid.model.sample import Sample
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, IntArray

try:
    import mujoco as mujoco  # the other modules take it from here, so that one line says what is missing
except ImportError:
    raise ConfigError("MuJoCo is not installed: pip install mujoco, or 'qpavoid[arena]'") from None

FLOATING = "JointModelFreeFlyer"
"""What pinocchio calls the joint of a base that floats."""
_ORDERS = {1: np.arange(1), 7: np.array([0, 1, 2, 4, 5, 6, 3])}
"""Places of a joint's coordinates among MuJoCo's, of which a quaternion's w comes first, by their number."""
MAX_DISTANCE = 100.0
"""Largest distance that MuJoCo looks for [m]: beyond any scene."""


@dataclass(frozen=True)
class MujocoModel:
    """A scene and its MuJoCo model.

    Configurations and velocities go in and out in the scene's order.
    """

    scene: Scene
    q0: Array
    """(nq,) configuration at the start."""
    model: Any
    data: Any
    geoms: IntArray
    """(g,) MuJoCo geom of each of the scene's geometries."""
    q_index: IntArray
    """(nq,) place in qpos of each coordinate."""
    v_index: IntArray
    """(nv,) place in qvel of each coordinate."""
    bodies: int
    """Number of geometries of the robot; those of obstacles come after them."""

    @property
    def movable(self) -> Any:
        """Return for each pair (m,) whether the robot can change its distance at all."""
        return np.any(self.scene.support != 0.0, axis=1)

    def place(self, q: Array, t: float) -> None:
        """Put the robot to q (nq,) and the obstacles to their poses at t [s]."""
        self.data.qpos[self.q_index] = q
        for i, obstacle in enumerate(self.scene.slots):
            if obstacle.moves:
                place_mocap(self.data, i, obstacle.motion.sample(t))
        mujoco.mj_kinematics(self.model, self.data)

    def integrate(self, q: Array, v: Array, dt: float) -> Array:
        """Integrate v (nv,) from q (nv,) over dt [s] by MuJoCo; return q (nv,).

        Raises:
            ValueError: the base floats, whose velocity MuJoCo has in other axes.
        """
        if len(q) != len(v):
            raise ValueError("a base that floats is placed, not integrated")
        position, velocity = np.zeros(self.model.nq), np.zeros(self.model.nv)
        position[self.q_index], velocity[self.v_index] = q, v
        mujoco.mj_integratePos(self.model, position, velocity, dt)
        return position[self.q_index]

    def poses(self) -> tuple[Array, Array]:
        """Return centres (g, 3) [m] and axes (g, 9) of the geometries in the current pose."""
        return self.data.geom_xpos[self.geoms], self.data.geom_xmat[self.geoms]

    def distance(self, pair: int, ends: Array | None = None) -> float:
        """Return the signed distance of a pair [m]; its witness points go to `ends` (6,)."""
        a, b = self.geoms[self.scene.pairs[pair]]
        return float(
            mujoco.mj_geomDistance(self.model, self.data, a, b, MAX_DISTANCE, np.empty(6) if ends is None else ends)
        )


def place_mocap(data: Any, index: int, sample: Sample) -> None:
    """Put an obstacle, by its number, to a pose; call MuJoCo's kinematics afterwards."""
    data.mocap_pos[index] = sample.position
    mujoco.mju_mat2Quat(data.mocap_quat[index], np.ascontiguousarray(sample.rotation).ravel())


def build(scene: Scene, q0: Array, has_servos: bool = False) -> MujocoModel:
    """Build the MuJoCo model of a scene: one body a joint, one mocap body an obstacle; a base may float.

    Args:
        scene: what is written.
        q0: where the robot starts (nq,).
        has_servos: whether bodies have the masses of the robot's model, and each joint a motor, without any gain yet.

    Raises:
        ValueError: another joint that is neither a hinge nor a slide, or a shape that MuJoCo does not know.
    """
    spec, robot = mujoco.MjSpec(), scene.robot.model
    spec.compiler.degree = False
    # the default, 1e-6, is of the size of the penetrations to be compared
    spec.option.ccd_tolerance, spec.option.ccd_iterations = 1e-9, 200
    bounds = scene.robot.bounds()
    ranges_by_joint = np.clip(np.stack((bounds.lower, bounds.upper), axis=1), -mujoco.mjMAXVAL, mujoco.mjMAXVAL)
    ranges = dict(zip(bounds.q_index.tolist(), ranges_by_joint, strict=True))
    bodies = [spec.worldbody]
    for i in range(1, robot.njoints):
        placement = robot.jointPlacements[i]
        body = bodies[robot.parents[i]].add_body(
            name=robot.names[i], pos=placement.translation, quat=quaternion(placement.rotation),
            explicitinertial=True, **body_inertia(robot.inertias[i] if has_servos else pin.Inertia.Zero()),
        )  # fmt: skip
        if robot.joints[i].shortname() == FLOATING:
            body.add_freejoint(name=robot.names[i])
            bodies.append(body)
            continue
        joint = add_joint(body, robot, i)
        if robot.joints[i].idx_q in ranges:  # neither kinematics nor integration heed them; who reads the model may
            joint.limited, joint.range = True, ranges[robot.joints[i].idx_q]
        if has_servos:
            motor = spec.add_actuator(name=robot.names[i], target=robot.names[i], trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        bodies.append(body)
    first = len(scene.body_names)
    obstacles = [spec.worldbody.add_body(name=f"obstacle {i}", mocap=True) for i in range(len(scene.slots))]
    for i, geometry in enumerate(scene.geometry.geometryObjects):
        if i < first:
            _add_geom(spec, bodies[geometry.parentJoint], geometry, f"geometry {i}", geometry.placement)
        else:
            _add_geom(spec, obstacles[scene.obstacle_of[i]], geometry, f"geometry {i}", pin.SE3.Identity())
    model = spec.compile()
    joints = [model.joint(name) for name in list(robot.names)[1:]]
    mujoco_model = MujocoModel(
        scene=scene,
        q0=np.array(q0),
        model=model,
        data=mujoco.MjData(model),
        geoms=np.array([model.geom(f"geometry {i}").id for i in range(scene.geometry.ngeoms)], dtype=np.intp),
        q_index=np.concatenate([joint.qposadr[0] + _ORDERS[len(joint.qpos0)] for joint in joints]),
        v_index=np.concatenate([joint.dofadr[0] + np.arange(len(joint.damping)) for joint in joints]),
        bodies=first,
    )
    for i, obstacle in enumerate(scene.slots):
        place_mocap(mujoco_model.data, i, obstacle.motion.sample(0.0))
    mujoco_model.place(mujoco_model.q0, 0.0)
    return mujoco_model


def add_joint(body: Any, model: Any, index: int) -> Any:
    """Add a hinge or slide of a pinocchio model to a body, and return it; see `hinge_or_slide`."""
    slides, axis = hinge_or_slide(model, index)
    kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
    return body.add_joint(name=model.names[index], type=kind, axis=axis)


def body_inertia(inertia: Any) -> dict[str, Any]:
    """Return mass and inertia of a body; units where the model gives none, which kinematics do not heed."""
    moments, axes = np.linalg.eigh(inertia.inertia)
    if not (inertia.mass > 0.0 and moments[0] > 0.0):
        return {"mass": 1.0, "inertia": [1.0, 1.0, 1.0]}
    axes[:, 0] *= np.linalg.det(axes)
    return {"mass": inertia.mass, "ipos": inertia.lever, "inertia": moments, "iquat": quaternion(axes)}


def _add_geom(spec: Any, body: Any, geometry: Any, name: str, placement: Any) -> None:
    """Add a geometry by a name to a body of the MuJoCo model."""
    kinds, shape = mujoco.mjtGeom, geometry.geometry
    place = {"name": name, "pos": placement.translation, "quat": quaternion(placement.rotation)}
    match shape:
        case coal.Sphere():
            body.add_geom(type=kinds.mjGEOM_SPHERE, size=_three(shape.radius), **place)
        case coal.Capsule() if shape.halfLength == 0.0:
            body.add_geom(type=kinds.mjGEOM_SPHERE, size=_three(shape.radius), **place)
        case coal.Capsule():
            body.add_geom(type=kinds.mjGEOM_CAPSULE, size=_three(shape.radius, shape.halfLength), **place)
        case coal.Cylinder():
            body.add_geom(type=kinds.mjGEOM_CYLINDER, size=_three(shape.radius, shape.halfLength), **place)
        case coal.Box():
            body.add_geom(type=kinds.mjGEOM_BOX, size=_three(*shape.halfSide), **place)
        case coal.Ellipsoid():
            body.add_geom(type=kinds.mjGEOM_ELLIPSOID, size=_three(*shape.radii), **place)
        case coal.Halfspace():
            body.add_geom(
                type=kinds.mjGEOM_BOX,
                size=_three(_HALF_SPACE_SIDE, _HALF_SPACE_SIDE, _HALF_SPACE_SIDE),
                **_below_plane(place),
            )
        case coal.ConvexBase():
            mesh = spec.add_mesh(name=name, uservert=np.array(shape.points()).ravel())
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            body.add_geom(type=kinds.mjGEOM_MESH, meshname=name, **place)
        case _:
            raise ValueError(f"body {geometry.name!r}: {type(shape).__name__} has no counterpart")


_HALF_SPACE_SIDE = 20.0
"""Half the side of the box that stands for a half-space [m]: MuJoCo computes no distance to planes."""


def _below_plane(place: dict[str, Any]) -> dict[str, Any]:
    """Return the placement of a box whose top face is the plane of that placement."""
    up = np.empty(9)
    mujoco.mju_quat2Mat(up, place["quat"])
    return {**place, "pos": np.asarray(place["pos"]) - _HALF_SPACE_SIDE * up[2::3]}


def _three(*sizes: float) -> Sequence[float]:
    """Return up to three sizes, filled up with zeros."""
    return [*sizes, 0.0, 0.0][:3]


def quaternion(rotation: Array) -> Array:
    """Return the quaternion (4,), w first, of a rotation (3, 3)."""
    wxyz = np.empty(4)
    mujoco.mju_mat2Quat(wxyz, np.ascontiguousarray(rotation).ravel())
    return wxyz
