"""More regularization for a robot that is stalled at something that rests, and shakes.

Where rows keep a robot from its target, the cost of the QP is flat in some direction, and the rows turn as the robot
moves in it: at an edge by more than the tasks bend, whatever their velocity. The optimum then jumps from bound to
bound. So λ grows as long as commands of a stalled robot go to and fro, and falls again some time after it has moved on.
Where there is progress, λ stays as it is: more of it costs ways around obstacles; and so among obstacles that move,
which robots have to dodge.
"""

from __future__ import annotations

import numpy as np

from qpavoid.problem import Array, Problem

_INTERVAL = 0.1
"""Time over which shaking is measured [s]."""
_SHAKING = 0.015
"""Mean of a control step's Σ_j |Δv_j| from which on a robot shakes, less what changes v for good [rad/s, m/s]."""
_CALM = 5
"""Intervals after which λ of a robot that is not stalled falls [-]."""
_MAX_FACTOR = 64.0
"""Largest factor on λ [-]."""
_MAX_BENT = 4.0
"""Largest λ, over dt ‖b_feasible‖ [-]."""


class ShakeDamping:
    """The factor on `Problem.bent` of a controller whose robot is stalled and shakes."""

    def __init__(self, dt: float) -> None:
        self._dt, self._interval = dt, max(1, round(_INTERVAL / dt))
        self.reset()

    def reset(self) -> None:
        """Drop what is known of earlier control steps."""
        self.factor, self._calm = 1.0, 0
        """Factor on λ [-]."""
        self._begin(None)

    def _begin(self, v: list[float] | None) -> None:
        """Begin an interval after a command v, or none."""
        self.is_idle, self._steps, self._change = v is None, 0, 0.0
        """Whether no command has been taken in: nothing is lost while `update` is not called and no task is stalled."""
        self._v_first = self._v_last = v

    def apply(self, problem: Problem) -> Problem:
        """Return the problem with more regularization, if the robot has been shaking."""
        if self.factor == 1.0 or problem.bent == 0.0:
            return problem
        most = _MAX_BENT * self._dt * float(np.linalg.norm(problem.tracking.b_feasible))
        return problem._replace(bent=max(problem.bent, min(self.factor * problem.bent, most)))

    def update(self, v: Array, feedforward: Array, stalled: bool) -> None:
        """Take in what is commanded.

        Args:
            v: the command (nv,).
            feedforward: rate of each near distance due to the obstacles (k,) [m/s].
            stalled: whether any task is.
        """
        if not stalled and self.factor == 1.0:
            self._begin(None)
            return
        if feedforward.any():
            self.reset()
            return
        command = v.tolist()
        if self._v_first is None or self._v_last is None:
            self._begin(command)
            return
        self._change += _difference(command, self._v_last)
        self._steps, self._v_last = self._steps + 1, command
        if self._steps == self._interval:
            self._adapt(self._change - _difference(command, self._v_first) > _SHAKING * self._steps, stalled)
            self._begin(command)

    def _adapt(self, shakes: bool, stalled: bool) -> None:
        """Change the factor at the end of an interval."""
        self._calm = 0 if stalled else self._calm + 1
        if stalled and shakes:
            self.factor = min(2.0 * self.factor, _MAX_FACTOR)
        elif self._calm == _CALM:
            self.factor, self._calm = max(0.5 * self.factor, 1.0), 0


def _difference(v: list[float], other: list[float]) -> float:
    """Return Σ_j |Δv_j|; for a few dozen numbers, quicker than numpy."""
    return sum([abs(a - b) for a, b in zip(v, other, strict=True)])
