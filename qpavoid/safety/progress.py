"""Detects tasks that make no progress because of avoidance, names what is in the way, and can start a detour.

A robot that is pushed back exactly against its task velocity rests there: the projections of eq. 10 and of the QP both
end in such points. A task counts as stalled by the fraction of its velocity that is left. Detours, where they are asked
for, are those of `qpavoid.safety.detour`.
"""

from __future__ import annotations

import numpy as np

from qpavoid.config import Progress
from qpavoid.control.assembler import Assembly
from qpavoid.problem import Array, Problem, Proximity, Solution
from qpavoid.reason import Reason, ReasonKind
from qpavoid.safety.detour import Detours
from qpavoid.solvers import Solver

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

    def __init__(
        self, config: Progress, dt: float, pair_names: tuple[tuple[str, str], ...], detours: Detours | None = None
    ) -> None:
        self._config, self._dt, self._names, self._detours = config, dt, pair_names, detours
        self._max_stalled_steps = _MAX_STALL * config.stalled_after / dt + _CHECK_STEPS
        self.reset()

    def reset(self) -> None:
        """Drop all counts, detours and searches."""
        self._step, self._stalled_steps = 0, 0.0
        self._blocking_pairs: list[tuple[int, float]] = []
        if self._detours is not None:
            self._detours.reset()

    def redirect(self, problem: Problem, proximity: Proximity, assembly: Assembly, solver: Solver) -> Problem:
        """Return the problem to solve: the given one, or that of a detour around the pair in the way."""
        detours = self._detours
        if detours is None:
            return problem
        detours.update(problem, assembly)
        if detours.active is None and self.stalled and self._blocking_pairs:
            detours.begin(problem, proximity, assembly, solver, [pair for pair, _ in self._blocking_pairs])
        if detours.active is None:
            return problem
        redirected = detours.follow(problem, proximity, assembly, self._config.stalled_after)
        if redirected is None:
            self._stalled_steps = 0.0
            return problem
        return redirected

    def update(self, problem: Problem, solution: Solution) -> tuple[Reason, ...]:
        """Return the reasons why searches ended, and what stalls the tasks, after long enough without progress.

        Args:
            problem: of the tasks, without a detour.
            solution: what is commanded.
        """
        A, ended = problem.tracking.A, self._detours.failures if self._detours is not None else ()
        if not len(A) or (problem.violation <= 0.0 and solution.command_scale == 1.0):
            self._stalled_steps = 0.0
            return ended
        self._step += 1
        if self._step % _CHECK_STEPS and not self.stalled:
            return ended
        steps = 1 if self.stalled else _CHECK_STEPS
        wanted, achieved = A @ problem.v_tracking, A @ solution.v
        size = float(wanted @ wanted)
        is_at_rest = float(achieved @ achieved) < _MAX_SPEED_AT_REST**2
        is_stuck = is_at_rest and size > _MIN_TASK_SPEED**2 and float(achieved @ wanted) < _MIN_PROGRESS * size
        stalled_steps = self._stalled_steps + (steps if is_stuck else -steps)
        self._stalled_steps = min(max(stalled_steps, 0), self._max_stalled_steps)
        if not self.stalled:
            return ended
        self._blocking_pairs = _find_blocking_pairs(problem, solution.v)
        pairs = [
            Reason.of(ReasonKind.STALLED, *self._names[pair], amount=amount, unit="m/s")
            for pair, amount in self._blocking_pairs
        ]
        several = Reason.of(ReasonKind.STALLED, detail="several rows together")
        return (*ended, *((*pairs, *_blocking_limits(problem, solution.v)) or (several,)))

    @property
    def stalled(self) -> bool:
        """Whether there was no progress for long enough."""
        return self._stalled_steps * self._dt >= self._config.stalled_after


def _find_blocking_pairs(problem: Problem, v: Array) -> list[tuple[int, float]]:
    """Return the pairs whose rows are active and oppose v_tracking, with its violation of them [m/s], largest first."""
    rows = problem.avoidance
    violation = rows.b - rows.J @ problem.v_tracking
    active = (rows.J @ v - rows.b < _ACTIVE_TOLERANCE) & (violation > 0.0)
    if not active.any():  # a solver without rows: the nearest of the pairs that the task would have close
        active = (rows.J @ problem.v_tracking < -_ACTIVE_TOLERANCE) & (rows.d < rows.d2)
        active &= rows.d <= np.min(rows.d, where=active, initial=np.inf)
    found = np.flatnonzero(active)
    order = found[np.argsort(-violation[found], kind="stable")]
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
