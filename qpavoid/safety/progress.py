"""Detects tasks that make no progress because of avoidance, and names what is in the way.

A robot that is pushed back exactly against its task velocity rests there: the projections of eq. 10 and of the QP both
end in such points. A task counts as stalled by the fraction of its velocity that is left.
"""

from __future__ import annotations

import numpy as np

from qpavoid.control.settings import ControlSettings
from qpavoid.problem import Array, Problem, Solution
from qpavoid.reason import Reason, ReasonKind

_MIN_PROGRESS = 0.1
"""Fraction of the task velocity below which there is no progress [-]."""
_MIN_TASK_SPEED = 2e-3
"""Task velocity below which no progress is needed [m/s, rad/s]: the task is at its target."""
_MAX_SPEED_AT_REST = 0.01
"""Speed below which a task without progress rests, and is not passing an obstacle either [m/s, rad/s]."""
_ACTIVE_TOLERANCE = 1e-3
"""Excess over its bound below which a row counts as active [m/s]."""
_CHECK_STEPS = 5
"""Control steps between two checks of the progress, while the tasks are not stalled: a check costs some µs."""
_MAX_STALL = 1.1
"""Cap on the time without progress, in `stalled_after` [-], so that a task that moves again is soon not stalled."""


class ProgressMonitor:
    """Follows the progress of a controller's tasks from control step to control step."""

    def __init__(self, settings: ControlSettings) -> None:
        self._limit = settings.progress.stalled_after / settings.dt  # control steps
        self.reset()

    def reset(self) -> None:
        """Drop all counts."""
        self._step, self._stalled_steps = 0, 0.0

    def update(self, problem: Problem, solution: Solution) -> tuple[Reason, ...]:
        """Return what stalls the tasks, after long enough without progress.

        Args:
            problem: of the tasks.
            solution: what is commanded.
        """
        A = problem.tracking.A
        if not len(A) or (problem.violation <= 0.0 and solution.command_scale == 1.0):
            self._stalled_steps = 0.0
            return ()
        self._step += 1
        if self._step % _CHECK_STEPS and not self.stalled:
            return ()
        steps = 1 if self.stalled else _CHECK_STEPS
        desired, achieved = A @ problem.v_tracking, A @ solution.v
        size = float(desired @ desired)
        is_at_rest = float(achieved @ achieved) < _MAX_SPEED_AT_REST**2
        is_stuck = is_at_rest and size > _MIN_TASK_SPEED**2 and float(achieved @ desired) < _MIN_PROGRESS * size
        stalled_steps = self._stalled_steps + (steps if is_stuck else -steps)
        self._stalled_steps = min(max(stalled_steps, 0), _MAX_STALL * self._limit + _CHECK_STEPS)
        if not self.stalled:
            return ()
        pairs = [
            Reason.of(ReasonKind.STALLED, *problem.pair_names[pair], amount=amount, unit="m/s")
            for pair, amount in _find_blocking_pairs(problem, solution.v)
        ]
        several = Reason.of(ReasonKind.STALLED, detail="several rows together")
        return (*pairs, *_blocking_limits(problem, solution.v)) or (several,)

    @property
    def stalled(self) -> bool:
        """Whether there was no progress for long enough."""
        return self._stalled_steps >= self._limit


def _find_blocking_pairs(problem: Problem, v: Array) -> list[tuple[int, float]]:
    """Return the pairs whose rows are active and oppose v_tracking, with its violation of them [m/s], largest first."""
    rows = problem.avoidance
    violation = rows.b - rows.J @ problem.v_tracking
    active = (rows.J @ v - rows.b < _ACTIVE_TOLERANCE) & (violation > 0.0)
    if not active.any():  # a solver without rows: the nearest of the pairs that the task would have close
        active = (rows.J @ problem.v_tracking < -_ACTIVE_TOLERANCE) & (rows.d < rows.d2)
        active &= rows.d <= np.min(rows.d, where=active, initial=np.inf)
    indices = np.flatnonzero(active)
    order = indices[np.argsort(-violation[indices], kind="stable")]
    return list(zip(rows.pair[order].tolist(), violation[order].tolist(), strict=True))


def _blocking_limits(problem: Problem, v: Array) -> list[Reason]:
    """Return the joints at a position limit that v_tracking goes against."""
    high = (v >= problem.hard_upper - 1e-9) & (problem.v_tracking > problem.hard_upper)
    low = (v <= problem.hard_lower + 1e-9) & (problem.v_tracking < problem.hard_lower)
    names, units = problem.joint_names, problem.joint_units
    full = np.maximum(problem.hard_upper, -problem.hard_lower)
    return [
        Reason.of(kind, names[j], amount=float(bound[j]) + 0.0, unit=f"{units[j]}/s")
        for kind, bound, at_limit in (
            (ReasonKind.AT_UPPER_LIMIT, problem.hard_upper, high & (problem.hard_upper < full)),
            (ReasonKind.AT_LOWER_LIMIT, problem.hard_lower, low & (-problem.hard_lower < full)),
        )
        for j in np.flatnonzero(at_limit).tolist()
    ]
