"""A robot with torque motors in MuJoCo, on a fixed base or on a floor: what a torque controller meets outside."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.config.plant import Payload, PlantSettings
from qpavoid.errors import ConfigError
from qpavoid.model.robot import Robot
from qpavoid.problem import Array, Solution, require_finite
from qpavoid.run.mujoco import FLOATING, add_joint, body_inertia, mujoco, quaternion

STEP = 1e-3
"""Largest time step of the dynamics [s]."""
_POINT_RADIUS = 5e-3
"""Radius of the sphere that stands for a contact point [m]: small beside a foot, large beside its penetration."""
_LEAST = 1e-9
"""Mass [kg] and moments of inertia [kg m²] of a body that has none."""
_PAYLOAD_RADIUS = 0.03
"""Radius of a payload [m]."""
ContactPoints = Sequence[tuple[str, Array]]
"""Frames, and points (k, 3) in each [m] that touch the floor."""


class TorquePlant:
    """Dynamics of a robot under torques; obstacles and its own bodies go through each other, as distances are checked.

    The floor carries the contact points and nothing else: who falls, falls through it.
    """

    def __init__(
        self,
        robot: Robot,
        q0: Array,
        settings: PlantSettings | None = None,
        points: ContactPoints = (),
        torque_limit: Array | None = None,
    ) -> None:
        """Begin at rest.

        Args:
            robot: its model; joints are hinges and slides, and one that floats may be the base.
            q0: configuration (nq,).
            settings: what differs from the model; nothing if left out.
            points: what touches the floor; there is none if left out.
            torque_limit: largest torques (m,) of the m actuated coordinates [Nm or N]; the URDF's if left out.

        Raises:
            ValueError: a joint that MuJoCo does not know.
            UnknownName: of a frame.
        """
        self.settings = settings = settings or PlantSettings()
        self._model, self._kinematics = robot.model, robot.model.createData()
        self.actuated = np.array([j.idx_v for j in list(robot.model.joints)[1:] if j.nv == 1], dtype=np.intp)
        """(m,) coordinates that have a motor."""
        limit = robot.model.effortLimit[self.actuated] if torque_limit is None else torque_limit
        self.torque_limit: Array = np.where(limit > 0.0, limit, np.inf)
        """(m,) largest torques of the motors [Nm or N]."""
        self.torque = np.zeros(len(self.actuated))
        """(m,) torques of the motors in the last time step [Nm or N]."""
        self.t = 0.0
        """Time [s]."""
        self._points = [(robot.frame_id(frame, "points"), np.asarray(at, dtype=np.float64)) for frame, at in points]
        self.point_names = [f"{frame} {i}" for frame, at in points for i in range(len(at))]
        """Name of each contact point."""
        self._pushes = [(push, robot.frame_id(push.frame, "pushes")) for push in settings.pushes]
        self._compile(robot, q0)
        self._under_way: deque[Array] = deque()
        self._rng = np.random.default_rng(settings.seed)
        self._start = self.point_positions()

    def _compile(self, robot: Robot, q0: Array) -> None:
        """Make the MuJoCo model, with the robot at q0 (nq,)."""
        model, settings, spec = robot.model, self.settings, mujoco.MjSpec()
        spec.compiler.degree = False
        spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        inertias = [_scaled(inertia, settings.mass_scale) for inertia in list(model.inertias)]
        if settings.payload is not None:
            carrying, payload = _payload(robot, settings.payload)
            inertias[carrying] += payload
        bodies = [spec.worldbody]
        for i in range(1, model.njoints):
            placement, joint = model.jointPlacements[i], model.joints[i]
            body = bodies[model.parents[i]].add_body(
                name=model.names[i], pos=placement.translation, quat=quaternion(placement.rotation),
                explicitinertial=True, **body_inertia(inertias[i]),
            )  # fmt: skip
            if joint.shortname() == FLOATING:
                body.add_freejoint(name=model.names[i])
            else:
                armature = model.armature[joint.idx_v] if settings.armature is None else settings.armature
                made = add_joint(body, model, i)
                made.armature, made.frictionloss = np.array((armature, settings.friction)) * settings.mass_scale
                made.damping = np.resize([settings.damping * settings.mass_scale, 0.0, 0.0], np.shape(made.damping))
                spec.add_actuator(
                    name=model.names[i], target=model.names[i], trntype=mujoco.mjtTrn.mjTRN_JOINT
                ).set_to_motor()
            bodies.append(body)
        self._add_floor(spec, bodies, q0)
        self._mujoco = spec.compile()
        self._data = mujoco.MjData(self._mujoco)
        self._index(q0)

    def _add_floor(self, spec: Any, bodies: Sequence[Any], q0: Array) -> None:
        """Add the contact points, spheres whose lowest point they are at q0 (nq,), and the floor under them."""
        if not self._points:
            return
        surface = {"condim": 3, "friction": [self.settings.floor_friction, 0.0, 0.0]}
        pin.framesForwardKinematics(self._model, self._kinematics, q0)
        heights = []
        for name, (frame_id, at) in enumerate(self._points):
            frame, pose = self._model.frames[frame_id], self._kinematics.oMf[frame_id]
            up = _POINT_RADIUS * pose.rotation.T[:, 2]
            for i, point in enumerate(at):
                heights.append(pose.act(point)[2])
                bodies[frame.parentJoint].add_geom(
                    name=f"point {name} {i}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[_POINT_RADIUS, 0.0, 0.0],
                    pos=frame.placement.act(point + up), mass=0.0, **surface,
                )  # fmt: skip
        height = min(heights) if self.settings.floor_height is None else self.settings.floor_height
        spec.worldbody.add_geom(
            name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, pos=[0.0, 0.0, height], size=[5.0, 5.0, 0.1], **surface
        )

    def _index(self, q0: Array) -> None:
        """Find the places of coordinates and contact points in MuJoCo's arrays, and go to q0 (nq,)."""
        model, names = self._mujoco, list(self._model.names)
        self._q_index, self._v_index = np.zeros(self._model.nq, dtype=np.intp), np.zeros(self._model.nv, dtype=np.intp)
        self._floating: int | None = None
        for name, joint in zip(names[1:], list(self._model.joints)[1:], strict=True):
            q_at, v_at = model.joint(name).qposadr[0], model.joint(name).dofadr[0]
            if joint.nv == 6:
                self._floating = joint.idx_v
                self._q_index[joint.idx_q : joint.idx_q + 7] = q_at + np.array([0, 1, 2, 4, 5, 6, 3])
                self._v_index[joint.idx_v : joint.idx_v + 6] = v_at + np.arange(6)
            else:
                self._q_index[joint.idx_q], self._v_index[joint.idx_v] = q_at, v_at
        self._bodies = np.array([model.body(name).id if i else 0 for i, name in enumerate(names)], dtype=np.intp)
        geoms = [model.geom(f"point {n} {i}").id for n, (_, at) in enumerate(self._points) for i in range(len(at))]
        self._geoms = np.array(geoms, dtype=np.intp)
        self._data.qpos[self._q_index] = q0
        mujoco.mj_forward(model, self._data)

    @property
    def q(self) -> Array:
        """(nq,) configuration."""
        return np.array(self._data.qpos[self._q_index])

    @property
    def v(self) -> Array:
        """(nv,) velocity."""
        v = np.array(self._data.qvel[self._v_index])
        if self._floating is not None:  # MuJoCo has the linear part of a free joint in world axes, pinocchio in its own
            linear = slice(self._floating, self._floating + 3)
            v[linear] = self._base_rotation().T @ v[linear]
        return v

    def measure(self) -> tuple[Array, Array]:
        """Return configuration (nq,) and velocity (nv,) as measured, with noise."""
        settings, q, v = self.settings, self.q, self.v
        if settings.position_noise:
            q = np.asarray(pin.integrate(self._model, q, self._rng.normal(0.0, settings.position_noise, len(v))))
        if settings.velocity_noise:
            v += self._rng.normal(0.0, settings.velocity_noise, len(v))
        return q, v

    def apply(self, torque: Array, dt: float) -> None:
        """Let motors follow a torque command (m,) for dt [s], after their delay and within their limits.

        Raises:
            NumericalError: it is not finite, or of another shape.
        """
        torque = require_finite("torque", torque, self.torque.shape)
        count = max(1, int(np.ceil(dt / STEP - 1e-9)))
        self._mujoco.opt.timestep = dt / count
        late = round(self.settings.delay * count / dt)
        for _ in range(count):
            self._under_way.append(torque)
            command = self._under_way.popleft() if len(self._under_way) > late else self._under_way[0]
            self.torque = np.clip(command, -self.torque_limit, self.torque_limit)
            self._data.ctrl[:] = self.torque
            self._push()
            mujoco.mj_step(self._mujoco, self._data)
            self.t += dt / count

    def follow(self, solution: Solution, dt: float) -> None:
        """Apply the torques of a solution for dt [s].

        Raises:
            ConfigError: it has none.
        """
        torque = getattr(solution, "torque", None)
        if torque is None:
            raise ConfigError("plant: the controller commands no torques; give the scenario a `dynamics` block")
        self.apply(torque, dt)

    def _push(self) -> None:
        """Set the forces from outside that act now."""
        if not self._pushes:
            return
        data = self._data
        data.xfrc_applied[:] = 0.0
        for push, frame_id in self._pushes:
            if push.start <= self.t + 1e-9 < push.start + push.duration:
                frame = self._model.frames[frame_id]
                body = self._bodies[frame.parentJoint]
                at = data.xpos[body] + data.xmat[body].reshape(3, 3) @ frame.placement.translation
                data.xfrc_applied[body, :3] += push.force
                data.xfrc_applied[body, 3:] += np.cross(at - data.xipos[body], push.force)

    def _base_rotation(self) -> Array:
        """Return the orientation (3, 3) of the floating base."""
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, self._data.qpos[3:7])
        return rotation.reshape(3, 3)

    def point_positions(self) -> Array:
        """Return the contact points (c, 3), world [m]."""
        if not len(self._geoms):
            return np.zeros((0, 3))
        mujoco.mj_kinematics(self._mujoco, self._data)
        return np.asarray(self._data.geom_xpos[self._geoms] - [0.0, 0.0, _POINT_RADIUS])

    def forces(self) -> Array:
        """Return the forces (c, 3) of the floor on the contact points, world [N]."""
        forces, place = np.zeros((len(self._geoms), 3)), {int(g): i for i, g in enumerate(self._geoms)}
        wrench = np.empty(6)
        for i in range(self._data.ncon):
            contact = self._data.contact[i]
            mujoco.mj_contactForce(self._mujoco, self._data, i, wrench)
            force = contact.frame.reshape(3, 3).T @ wrench[:3]  # of the first geom on the second
            for geom, sign in zip(contact.geom, (-1.0, 1.0), strict=True):
                if int(geom) in place:
                    forces[place[int(geom)]] += sign * force
        return forces

    def slip(self) -> Array:
        """Return how far each contact point is from where it was at the start, along the floor (c,) [m]."""
        return np.asarray(np.linalg.norm((self.point_positions() - self._start)[:, :2], axis=1))


def _scaled(inertia: Any, scale: float) -> Any:
    """Return an inertia with its mass and moments multiplied, and enough of both for MuJoCo."""
    return pin.Inertia(scale * inertia.mass + _LEAST, inertia.lever, scale * inertia.inertia + _LEAST * np.eye(3))


def _payload(robot: Robot, payload: Payload) -> tuple[int, Any]:
    """Return the joint that carries a payload, and its inertia there."""
    frame = robot.model.frames[robot.frame_id(payload.frame, "payload.frame")]
    center = frame.placement.act(np.array(payload.position))
    return frame.parentJoint, pin.Inertia(payload.mass, center, 0.4 * payload.mass * _PAYLOAD_RADIUS**2 * np.eye(3))
