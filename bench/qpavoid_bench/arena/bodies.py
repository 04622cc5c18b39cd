"""Robots that a rollout moves: one that follows velocities exactly, and one with torque motors in MuJoCo."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import pinocchio as pin

from qpavoid.config import ScenarioConfig
from qpavoid.model.robot import Robot
from qpavoid.problem import Array, Solution
from qpavoid.run.simulate import make_plant
from qpavoid_bench.arena.world import World

FALL = 0.3
"""Way of a base downwards from which on a robot has fallen [m]."""


class Body(Protocol):
    """A robot in a closed loop."""

    q: Array
    """(nq,) configuration."""
    v: Array
    """(nv,) velocity: as commanded in the last step, or of a plant, as it is."""
    torque: Array
    """(m,) commanded torques of the last step [Nm or N]; of a robot that follows velocities, there are none."""
    torque_limit: Array
    """(m,) largest torques of its motors [Nm or N]."""
    slip: float
    """Way of a contact point along the floor since the start, the longest one [m]."""
    has_fallen: bool

    def measure(self) -> tuple[Array, Array | None]:
        """Return configuration (nq,) and velocity (nv,) as measured; None where it is as commanded."""
        ...

    def follow(self, solution: Solution | None, dt: float) -> None:
        """Do what a solution says for dt [s]; None where there is none."""
        ...


class ExactBody:
    """Follows velocities exactly; without a solution it stays still."""

    has_fallen, slip = False, 0.0

    def __init__(self, robot: Robot, q: Array) -> None:
        self._model = robot.model
        self.q, self.v, self.torque, self.torque_limit = q, np.zeros(robot.model.nv), np.zeros(0), np.zeros(0)

    def measure(self) -> tuple[Array, Array | None]:
        """Return the configuration; the velocity is as commanded."""
        return self.q.copy(), None

    def follow(self, solution: Solution | None, dt: float) -> None:
        """Move at the velocity of a solution for dt [s], or stay still."""
        self.v = np.zeros(self._model.nv) if solution is None else solution.v
        self.q = pin.integrate(self._model, self.q, self.v * dt)


class TorqueBody:
    """Has motors that take torques; without a solution these stay as they are."""

    slip = 0.0

    def __init__(self, robot: Robot, q: Array, scenario: ScenarioConfig) -> None:
        assert scenario.plant is not None
        self._plant = make_plant(robot, q, scenario.plant, scenario.contacts)
        self._is_floating = robot.model.nq > robot.model.nv
        self._lowest = float(q[2]) - FALL if self._is_floating else -np.inf
        self.q, self.v, self.has_fallen = q, np.zeros(robot.model.nv), False
        self.torque, self.torque_limit = self._plant.torque.copy(), self._plant.torque_limit

    def measure(self) -> tuple[Array, Array | None]:
        """Return configuration and velocity, with noise."""
        return self._plant.measure()

    def follow(self, solution: Solution | None, dt: float) -> None:
        """Apply the torques of a solution for dt [s], or those of the step before."""
        if solution is not None:
            self.torque = np.asarray(solution.torque)
        self._plant.apply(self.torque, dt)
        self.q, self.v = self._plant.q, self._plant.v
        self.slip = float(self._plant.slip().max(initial=0.0))
        self.has_fallen = bool(self._is_floating and self.q[2] < self._lowest)


def make_body(scenario: ScenarioConfig, world: World) -> Body:
    """Make the robot of a case, at its start."""
    robot = world.scene.robot
    return ExactBody(robot, world.q0) if scenario.plant is None else TorqueBody(robot, world.q0, scenario)
