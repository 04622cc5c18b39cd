"""What the ROS 2 node does, without ROS: joint states, obstacles and commands in, safe joint velocities out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid.adapters.joints import JointMap
from qpavoid.config.loading import load_scenario
from qpavoid.controller import Controller
from qpavoid.errors import ConfigError
from qpavoid.model.sample import Pose
from qpavoid.problem import Array, Solution

MODES = "filter", "tasks"


class Command(NamedTuple):
    """What is to be sent for one control period."""

    names: Sequence[str]
    velocities: Array
    """(nv,) [rad/s or m/s]."""
    positions: Array
    """(nv,) where the joints are to be at the end of the period, added up from where they were at first [rad or m]."""
    solution: Solution


class NodeLogic:
    """A controller of a scenario between topics, in one thread; times are those of the node's clock [s].

    In the mode `filter` the velocities that are given are made safe, in `tasks` those of the scenario are followed,
    with the targets that are given.
    """

    def __init__(self, scenario: str, mode: str = "filter", timeout: float = 0.1) -> None:
        """Build the controller.

        Args:
            scenario: shipped name or path.
            mode: filter or tasks.
            timeout: after which a command counts as zero, and the robot stops where joint states are missing [s].

        Raises:
            ConfigError, UnknownName: of the scenario, or of the mode.
        """
        if mode not in MODES:
            raise ConfigError(f"mode: {mode!r}, expected one of {', '.join(MODES)}")
        self.controller, _ = Controller.from_scenario(load_scenario(scenario))
        robot = self.controller.scene.robot
        if robot.model.nq != robot.model.nv:
            raise ConfigError(f"{robot.name}: a joint has no limits, or several coordinates; lock it")
        self._mode, self._timeout, self.names = mode, timeout, robot.joint_names
        self._q: Array | None = None
        self._setpoint: Array | None = None
        self._last_state, self._last_command = -np.inf, -np.inf
        self._joints: dict[tuple[str, ...], JointMap] = {}
        self._v_desired = np.zeros(robot.model.nv)
        self._obstacles, self._targets = dict[str, Pose](), dict[str, Pose]()

    def joint_state(self, names: Sequence[str], positions: Sequence[float], t: float) -> None:
        """Take a `sensor_msgs/JointState`; one that lacks joints of the robot, as of a gripper alone, is not of it."""
        if joints := self._map(names):
            self._q, self._last_state = joints.q(positions).copy(), t

    def desired(self, names: Sequence[str], velocities: Sequence[float], t: float) -> None:
        """Take a velocity to make safe; without names, one for each joint of the robot, in its order."""
        if joints := self._map(names or self.names):
            self._v_desired, self._last_command = joints.v(velocities), t

    def obstacle(self, name: str, position: Sequence[float], quaternion: Sequence[float], t: float) -> None:
        """Take the pose of an obstacle, with its quaternion x, y, z, w and its time stamp."""
        self._obstacles[name] = Pose(position, _rotation(quaternion), t)

    def target(self, name: str, position: Sequence[float], quaternion: Sequence[float]) -> None:
        """Take the target of a task, by its name, until another one comes."""
        self._targets[name] = Pose(position, _rotation(quaternion))

    def step(self, t: float) -> Command | None:
        """Return what is to be sent now; None before the first joint state."""
        if self._q is None:
            return None
        is_known = t - self._last_state <= self._timeout
        q = self._q if is_known else np.full_like(self._q, np.nan)  # the controller stops where q is unknown
        obstacles, self._obstacles = self._obstacles, {}
        if self._mode == "tasks":
            solution = self.controller.step(q, t, self._targets, obstacles)
        else:
            is_fresh = t - self._last_command <= self._timeout
            v = self._v_desired if is_fresh else np.zeros_like(self._v_desired)
            solution = self.controller.filter(q, v, t, obstacles)
        start = self._q if self._setpoint is None else self._setpoint
        self._setpoint = start + self.controller.dt * solution.v
        return Command(self.names, solution.v, self._setpoint, solution)

    def _map(self, names: Sequence[str]) -> JointMap | None:
        key = tuple(names)
        if key not in self._joints and set(self.names) <= set(key):
            self._joints[key] = JointMap.of_names(self.controller.scene.robot, key)
        return self._joints.get(key)


def _rotation(quaternion: Any) -> Array:
    """Return the rotation (3, 3) of a quaternion x, y, z, w; NaN, which no update has, of one that is none."""
    q = np.asarray(quaternion, dtype=np.float64)
    length = np.linalg.norm(q)
    return np.asarray(pin.Quaternion(q / length).toRotationMatrix()) if length > 0.5 else np.full((3, 3), np.nan)
