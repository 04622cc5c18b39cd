"""MuJoCo: q and obstacles out of a simulation of your own, commands into its servos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from qpavoid.adapters.joints import JointMap
from qpavoid.adapters.mujoco_scene import geoms_of
from qpavoid.controller import Controller
from qpavoid.errors import ConfigError
from qpavoid.model.sample import Pose, Sample
from qpavoid.problem import Array, Solution


class MujocoRobot:
    """The robot of a controller in a simulation: its joints and servos by the names of the joints."""

    def __init__(self, controller: Controller, model: Any, obstacles: Sequence[str] = ()) -> None:
        """Find joints, servos and obstacles.

        Args:
            controller: of the robot and the obstacles.
            model: MuJoCo's; each joint of the robot has a position or velocity servo.
            obstacles: names of the bodies whose geoms move, as `obstacles_of` had them: mocap bodies, and others.

        Raises:
            UnknownName: the model lacks a joint of the robot.
            ConfigError: a joint without a servo, a base that floats.
        """
        self.controller, self._model = controller, model
        robot = controller.scene.robot
        self.joints = JointMap.of_mujoco(robot, model)
        servos = {int(model.actuator_trnid[i, 0]): i for i in range(model.nu) if model.actuator_trntype[i] == 0}
        numbers = [model.joint(name).id for name in robot.joint_names if robot.model.nq == robot.model.nv]
        if not numbers or not servos.keys() >= set(numbers):
            lacking = [model.joint(number).name for number in numbers if number not in servos]
            raise ConfigError(
                f"no servo for {', '.join(lacking) or 'a base that floats'}; add a position or velocity one"
            )
        self._servos = np.array([servos[number] for number in numbers])
        gains = model.actuator_gainprm[self._servos, 0]
        biases = model.actuator_biasprm[self._servos]
        self._is_position = (gains > 0.0) & (biases[:, 1] == -gains)
        is_velocity = (gains > 0.0) & (biases[:, 1] == 0.0) & (biases[:, 2] == -gains)
        if not (self._is_position | is_velocity).all():
            wrong = model.actuator(int(self._servos[np.argmin(self._is_position | is_velocity)])).name
            raise ConfigError(f"actuator {wrong!r} is neither a position nor a velocity servo")
        self._gear = model.actuator_gear[self._servos, 0].copy()
        self._geoms = geoms_of(model, obstacles)
        self._setpoint: Array | None = None

    def q(self, data: Any) -> Array:
        """Return the configuration (nq,), in memory that the next call overwrites."""
        return self.joints.q(data.qpos)

    def obstacles(self, data: Any, t: float | None = None) -> dict[str, Pose | Sample]:
        """Return where the obstacles are; mocap bodies as poses, whose velocity MuJoCo does not know.

        Args:
            data: after `mj_forward` or `mj_step`.
            t: their time stamp [s]; the time of the control step if left out.
        """
        poses: dict[str, Pose | Sample] = {}
        for name, geom in self._geoms:
            position, rotation = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
            if self._model.body_mocapid[self._model.body_rootid[self._model.geom_bodyid[geom]]] >= 0:
                poses[name] = Pose(position, rotation, t)
            else:
                twist = np.zeros(6)
                mujoco.mj_objectVelocity(self._model, data, mujoco.mjtObj.mjOBJ_GEOM, geom, twist, 0)
                poses[name] = Sample(position, rotation, twist[3:], twist[:3], t)
        return poses

    def command(self, data: Any, v: Array) -> None:
        """Send a velocity (nv,): as it is to velocity servos, added up to the position servos' setpoints."""
        if self._setpoint is None:
            self._setpoint = self.q(data).copy()
        self._setpoint += self.controller.dt * v
        data.ctrl[self._servos] = self._gear * np.where(self._is_position, self._setpoint, v)

    def step(self, data: Any, targets: Mapping[str, Any] | None = None) -> Solution:
        """Take a control step with what is in `data`, and send its velocity."""
        solution = self.controller.step(self.q(data), data.time, targets, self.obstacles(data))
        self.command(data, solution.v)
        return solution

    def reset(self) -> None:
        """Let the setpoints begin where the robot is, as after `mj_resetData`."""
        self._setpoint = None
        self.controller.reset()
