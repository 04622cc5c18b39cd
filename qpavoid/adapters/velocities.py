"""The safety filter and the rows of a controller, in the order of another program's joints."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from qpavoid.adapters.joints import JointMap
from qpavoid.controller import Controller
from qpavoid.errors import ConfigError
from qpavoid.problem import Array, Problem, Solution

_NO_BOUND = 1e6
"""Bound of a coordinate that has none [rad/s or m/s]: not every QP takes infinity."""


class VelocityFilter:
    """The safety filter of a controller, for velocities in the order of another program."""

    def __init__(self, controller: Controller, joints: JointMap) -> None:
        self.controller, self.joints = controller, joints
        self.solution: Solution | None = None
        """What the last call decided, and why."""

    def __call__(self, q: Any, v: Any, t: float | None = None, obstacles: Mapping[str, Any] | None = None) -> Array:
        """Return the velocity to command: v, with that of the robot made safe; see `Controller.filter`."""
        joints = self.joints
        self.solution = self.controller.filter(joints.q(q), joints.v(v), t, obstacles)
        return joints.merged(self.solution.v, v)


class RowLimit:
    """Rows and bounds of a controller as G Δq <= h, in the order of another program, for a QP of its own."""

    def __init__(self, controller: Controller, joints: JointMap) -> None:
        self.controller, self.joints = controller, joints
        one = np.eye(controller.scene.robot.model.nv)
        self._signs = np.concatenate((one, -one))
        self.obstacles: Mapping[str, Any] | None = None
        """Where obstacles are now, for the next step; see `Controller.step`."""
        self.t: float | None = None
        """Time of the next step [s]; one dt after the last one if None."""
        self.solution: Solution | None = None
        """What `command` decided last, and why."""

    def inequalities(self, q: Any, dt: float) -> tuple[Array, Array]:
        """Begin a control step; return G (m, nv) and h (m,) of G Δq <= h.

        Raises:
            ConfigError: dt [s] is not the controller's.
        """
        if abs(dt - self.controller.dt) > 1e-9:
            raise ConfigError(f"dt: {dt} s, but the controller has {self.controller.dt} s")
        problem = self.controller.rows(self.joints.q(q), self.t, self.obstacles)
        self.obstacles = None
        return self.as_inequalities(problem)

    def as_inequalities(self, problem: Problem) -> tuple[Array, Array]:
        """Return rows and bounds of a control step as G (m, nv) and h (m,) of G Δq <= h."""
        rows, sides = problem.avoidance, len(self._signs)
        G = np.empty((sides + len(rows.b), self.joints.nv))
        self.joints.write_columns(np.concatenate((self._signs, -rows.J)), G)
        h = np.concatenate((problem.upper, -problem.lower, -rows.b))
        np.minimum(h, _NO_BOUND, out=h)
        h *= self.controller.dt
        return G, h

    def command(self, v: Any) -> Array:
        """End the step: return the velocity to command, which is v wherever that is safe."""
        self.solution = self.controller.command(self.joints.v(v))
        return self.joints.merged(self.solution.v, v)

    def solve(self, solve_ik: Callable[[], Any], failure: type[Exception]) -> Array:
        """Return the velocity to command of a solver that has this limit; a stop where it fails.

        Args:
            solve_ik: solves with this limit, and returns a velocity.
            failure: what it raises where it finds no solution, as where obstacles come on.
        """
        try:
            v = solve_ik()
        except failure:
            v = np.zeros(self.joints.nv)
        return self.command(v)
