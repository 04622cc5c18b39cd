"""More regularization for a robot that is stalled and shakes.

Where rows keep a robot from its target, the cost of the QP is flat in some direction, and the rows turn as the robot
moves in it. The optimum may then jump from bound to bound, whatever λ is in proportion to the task velocity alone. So λ
grows as long as a stalled robot shakes, and falls again as it moves on: where tasks progress, nothing is damped.
"""

from __future__ import annotations

import numpy as np

from qpavoid.problem import Array, Problem

_INTERVAL = 0.1
"""Time over which shaking is measured [s]."""
_SHAKING = 0.01
"""Mean Σ_j |Δv_j| of a control step from which on a robot shakes [rad/s, m/s]."""
_MAX_FACTOR = 64.0
"""Largest factor on λ [-]."""
_MAX_BENT = 4.0
"""Largest λ, over dt ‖b_feasible‖ [-]."""


class StallDamping:
    """The factor on `Problem.bent` while a controller's tasks are stalled."""

    def __init__(self, dt: float) -> None:
        self._dt, self._interval = dt, max(1, round(_INTERVAL / dt))
        self.reset()

    def reset(self) -> None:
        """Drop what is known of earlier control steps."""
        self._factor, self._steps, self._change = 1.0, 0, 0.0
        self._v_last: Array | None = None

    def apply(self, problem: Problem) -> Problem:
        """Return the problem with more regularization, if the robot has been shaking."""
        if self._factor == 1.0 or problem.bent == 0.0:
            return problem
        most = _MAX_BENT * self._dt * float(np.linalg.norm(problem.tracking.b_feasible))
        return problem._replace(bent=max(problem.bent, min(self._factor * problem.bent, most)))

    def update(self, v: Array, stalled: bool) -> None:
        """Take in the velocity v (nv,) of a control step, and whether any task is stalled."""
        if not stalled and self._factor == 1.0:
            self._v_last = None
            return
        if self._v_last is not None:
            self._change += float(np.abs(v - self._v_last).sum())
            self._steps += 1
        self._v_last = v.copy()
        if self._steps < self._interval:
            return
        if not stalled:
            self._factor = max(0.5 * self._factor, 1.0)
        elif self._change > _SHAKING * self._steps:
            self._factor = min(2.0 * self._factor, _MAX_FACTOR)
        self._steps, self._change = 0, 0.0
