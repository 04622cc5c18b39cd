"""A control step in two halves, for programs with a QP of their own: its rows first, then what they make of them."""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter
from typing import Any

import numpy as np

from qpavoid.control.builder import ProblemBuilder, StepProblem
from qpavoid.control.inputs import LARGEST_COMMAND, check_velocity
from qpavoid.errors import ConfigError
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, Problem, Solution, as_vector


class SplitStep:
    """Part of a `Controller` that takes a step in two halves: `rows` and `command` are `filter`."""

    scene: Scene
    _builder: ProblemBuilder
    _planning: Any

    def _decide(self, step: StepProblem, begin: float, from_tasks: bool = True) -> Solution:
        raise NotImplementedError

    def rows(
        self,
        q: Array,
        t: float | None = None,
        obstacles: Mapping[str, Any] | None = None,
        v: Array | None = None,
    ) -> Problem:
        """Begin a control step: return its rows and bounds, for a QP of your own.

        A velocity with `avoidance.J @ v >= avoidance.b` and `lower <= v <= upper` keeps clear and within the limits;
        there may be none, where obstacles come on. `command` ends the step. Where it is not called, the robot is taken
        to have moved at constant velocity to the q of the next step.

        Args:
            q: configuration (nq,) as measured.
            t: time [s]; see `step`.
            obstacles: where obstacles are now; see `step`.
            v: velocity (nv,) as measured; see `step`.

        Returns:
            The problem, whose arrays the next step overwrites: copy what you keep.

        Raises:
            NumericalError, UnknownName: as `step`.
        """
        arguments = self._builder.read(q, t, None, obstacles, v)
        if self._planning is not None:
            self._planning.drop()
        self._builder.build(arguments)
        return self._builder.rows.problem()

    def command(self, v_desired: Array) -> Solution:
        """End the step that `rows` began: return the safe velocity that is closest to a command.

        That is the command itself, bit for bit, where it is safe and within the limits: what your QP has found.

        Args:
            v_desired: the command (nv,) [rad/s or m/s].

        Raises:
            NumericalError: v_desired has the wrong shape, or is not made of numbers.
            ConfigError: `rows` has not begun a step.
        """
        begin, nv = perf_counter(), self.scene.robot.model.nv
        v_desired, step = as_vector("v_desired", v_desired, (nv,)), self._builder.begun
        if step is None:
            raise ConfigError("command: no step has begun; call `rows` before it")
        if faults := check_velocity("v_desired", v_desired, LARGEST_COMMAND):
            v_desired = np.zeros(nv)
        step.is_settled, step.faults = self._builder.rows.follow(v_desired, at_once=True), step.faults + faults
        return self._decide(step, begin, from_tasks=False)
