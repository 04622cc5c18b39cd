"""Detects tasks that make no progress towards what they ask for, and names what is in the way.

A speed shows nothing: an arm that is pressed on something goes on by self-motion, and one that crosses a singularity
hardly moves. So progress is measured in the errors of the tasks, and in the part of the task velocity that is left.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np

from qpavoid.control.assembler import RowAssembler
from qpavoid.control.settings import ControlSettings
from qpavoid.problem import Array, IntArray, Problem, Solution
from qpavoid.reason import Reason, ReasonKind

_TOLERANCE = 2e-3
"""Error below which a task is at its target [m, rad]."""
_MIN_GAIN = 0.5e-3, 0.01
"""Least decrease of an error that is progress [m, rad], and over that error [-]."""
_JUMP = 0.05
"""Increase of an error between two checks that a new target makes, over that error [-]."""
_MIN_PROGRESS = 0.1
"""Fraction of the task velocity below which there is no progress [-]."""
_CHECKS = 5
"""Checks in the time after which a task counts as stalled: they cost some µs each."""
_FREE = 0.05
"""‖Aᵀr‖ of what a task lacks, r, over σ_1 ‖b‖, below which nothing but the task itself keeps it [-]."""
_SADDLE = 0.02
"""Negative curvature of the task error, over its size, from which the robot could go on from a singularity [-]."""
_ACTIVE_TOLERANCE = 1e-3
"""Excess over its bound below which a row counts as active [m/s]."""
_AT_LIMIT = 0.1
"""Bound on the speed of a coordinate, over its speed limit, below which a position limit makes it [-]."""
_CULPRIT = 0.1
"""Share of the forces in the way from which a pair or limit is named [-]."""
_WEAKEST = 1e-9
"""Sum of the forces in the way below which none is named [m/s]."""
_EXPLAINED = 0.9
"""Share of the task's pull that the named pairs and limits have to balance [-]."""


class _Goal(NamedTuple):
    """A task that has somewhere to go, and its rows."""

    task: int
    rows: IntArray


class ProgressMonitor:
    """Follows the progress of a controller's tasks from control step to control step."""

    def __init__(self, settings: ControlSettings, rows: RowAssembler) -> None:
        self._rows, self._nnls = rows, _import_nnls()
        self._interval = max(1, round(settings.progress.stalled_after / (_CHECKS * settings.dt)))
        self._limit = settings.progress.stalled_after / settings.dt - 0.5
        self._goals = _goals(rows)
        self._owners = rows.row_tasks[: len(rows.frame_errors)].tolist()
        self._others = [goal.task - rows.frame_count for goal in self._goals[rows.frame_count :]]
        self.reset()

    def reset(self) -> None:
        """Drop all counts."""
        self._step, self._stalled = 0, tuple[Reason, ...]()
        self._history, self._since = deque[list[float]](maxlen=_CHECKS + 1), [0] * len(self._goals)

    def warm_up(self) -> None:
        """Call what names reasons once: no control step waits for the kernels."""
        self._rows.curvature(np.zeros_like(self._rows.frame_errors))

    @property
    def is_stalled(self) -> bool:
        """Whether any task was stalled at the last check."""
        return len(self._stalled) > 0

    @property
    def steps_to_check(self) -> int:
        """Steps until the next check, that one included."""
        return self._interval - self._step % self._interval

    def count(self, steps: int) -> None:
        """Count steps in which there was nothing to check."""
        self._step += steps

    @property
    def is_quiet(self) -> bool:
        """Whether there is nothing to check nor to say in the next step."""
        return not self.is_stalled and self.steps_to_check > 1

    def update(self, problem: Problem | None, solution: Solution) -> tuple[Reason, ...]:
        """Return what keeps the tasks from their targets, after long enough without progress.

        Args:
            problem: of the tasks; None for that of the last step.
            solution: what is commanded.
        """
        self._step += 1
        if self._step % self._interval:
            return self._stalled
        problem = self._rows.problem() if problem is None else problem
        stuck = self._stuck(problem, solution)
        self._stalled = self._reasons(problem, solution.v, stuck) if stuck else ()
        return self._stalled

    def _stuck(self, problem: Problem, solution: Solution) -> list[int]:
        """Return the numbers of the tasks that have made no progress for long enough."""
        e = self._errors()
        last = self._history[-1] if self._history else [-np.inf] * len(e)
        for i, (error, error_last) in enumerate(zip(e, last, strict=True)):
            if error < _TOLERANCE or error - error_last > _JUMP * error + _TOLERANCE:
                self._since[i] = self._step
        self._history.append(e)
        stuck = []
        for i, (error, first) in enumerate(zip(e, self._history[0], strict=True)):
            if self._step - self._since[i] < self._limit or first - error >= max(_MIN_GAIN[0], _MIN_GAIN[1] * error):
                continue
            rows = self._goals[i].rows
            asked, achieved = problem.tracking.b_feasible[rows], problem.tracking.A[rows] @ solution.v
            if float(achieved @ asked) < _MIN_PROGRESS * float(asked @ asked):
                stuck.append(i)
        return stuck

    def _errors(self) -> list[float]:
        """Return how far each task is from its target [m, rad]."""
        squares = [0.0] * self._rows.frame_count
        for owner, error in zip(self._owners, self._rows.frame_errors.tolist(), strict=True):
            squares[owner] += error * error
        return [*map(sqrt, squares), *(float(self._rows.task_errors[i]) for i in self._others)]

    def _reasons(self, problem: Problem, v: Array, stuck: Sequence[int]) -> tuple[Reason, ...]:
        """Return why the tasks are stuck: at rest by themselves, or by what balances them."""
        (rows, earlier), tracking = self._of_priority(problem, stuck), problem.tracking
        A, b = tracking.A[rows], tracking.b_feasible[rows]
        pull = A.T @ (b - A @ v)
        if problem.contacts is not None:
            pull = problem.contacts.Z @ (problem.contacts.Z.T @ pull)
        size = float(np.linalg.norm(b))
        if np.linalg.norm(pull) < _FREE * np.linalg.norm(A, 2) * size and np.isfinite(pull).all():
            return tuple(self._at_rest(problem, stuck))
        walls = _Walls(problem, v, tracking.A[earlier])
        return walls.holding(pull, self._nnls) or _nearest(problem)

    def _of_priority(self, problem: Problem, stuck: Sequence[int]) -> tuple[IntArray, IntArray]:
        """Return the rows of the first priority that has a stuck task, and of earlier ones; all without priorities."""
        everything = np.arange(len(problem.tracking.b))
        if problem.cascade is None:
            return everything, everything[:0]
        stuck_rows = np.concatenate([self._goals[i].rows for i in stuck])
        number = next(k for k, level in enumerate(problem.levels) if np.isin(stuck_rows, level).any())
        return problem.levels[number], np.concatenate((everything[:0], *problem.levels[:number]))

    def _at_rest(self, problem: Problem, stuck: Sequence[int]) -> list[Reason]:
        """Return a reason for each task that is stuck though nothing is in the way, with its error."""
        x, A = self._rows, problem.tracking.A
        count, g = len(x.frame_errors), np.ones(len(x.frame_errors))
        b, feasible = problem.tracking.b[:count], problem.tracking.b_feasible[:count]
        np.divide(b, feasible, out=g, where=feasible != 0.0)
        w = x.row_scale[:count] ** 2 * x.frame_errors / g
        size = float(np.linalg.norm(w))
        saddle = size > 0.0 and np.linalg.eigvalsh(A.T @ A - x.curvature(w))[0] < -_SADDLE * size
        kind = ReasonKind.SINGULAR if saddle else ReasonKind.OUT_OF_REACH
        reasons = []
        for i in stuck:
            label, amount, unit = self._missing(i)
            reasons.append(Reason.of(kind, label, amount=amount, unit=unit))
        return reasons

    def _missing(self, i: int) -> tuple[str, float, str]:
        """Return the name of a task and what it lacks: its position, or its orientation where that is there."""
        x, goal = self._rows, self._goals[i]
        task = x.tasks[goal.task]
        amount, unit = self._history[-1][i], task.unit
        if goal.task < x.frame_count:
            parts = [float(np.linalg.norm(part)) for part in x.frame_errors[goal.rows].reshape(-1, 3)]
            if task.moves and (len(parts) == 1 or parts[0] >= _TOLERANCE):
                amount = parts[0]
            else:
                amount, unit = parts[-1], "rad"
        return task.settings.label, amount, unit


def _goals(rows: RowAssembler) -> list[_Goal]:
    """Return the frames, then the other tasks that have somewhere to go."""
    numbers = [number for number, task in enumerate(rows.tasks) if task.has_goal]
    return [_Goal(number, np.flatnonzero(rows.row_tasks == number)) for number in numbers]


class _Walls:
    """Rows, position limits and tasks of earlier priorities that keep a velocity, with the forces they exert."""

    def __init__(self, problem: Problem, v: Array, earlier: Array) -> None:
        rows, names = problem.avoidance, problem.joint_names
        self.forces, self.culprits = list[Array](), list[tuple[ReasonKind, tuple[str, ...]] | None]()
        for i in np.flatnonzero(rows.J @ v - rows.b < _ACTIVE_TOLERANCE).tolist():
            self.forces.append(-rows.J[i])
            self.culprits.append((ReasonKind.STALLED, problem.pair_names[rows.pair[i]]))
        lower, upper, eye = problem.hard_lower, problem.hard_upper, np.eye(len(v))
        fastest = np.maximum(upper, -lower)
        high = (v >= upper - 1e-6) & (upper < _AT_LIMIT * fastest)
        low = (v <= lower + 1e-6) & (-lower < _AT_LIMIT * fastest)
        for kind, side, at_limit in ((ReasonKind.AT_UPPER_LIMIT, 1.0, high), (ReasonKind.AT_LOWER_LIMIT, -1.0, low)):
            for j in np.flatnonzero(at_limit).tolist():
                self.forces.append(side * eye[j])
                self.culprits.append((kind, (names[j],)))
        for row in (*earlier, *-earlier):
            self.forces.append(row)
            self.culprits.append(None)

    def holding(self, pull: Array, nnls: Callable[[Array, Array], tuple[Array, float]]) -> tuple[Reason, ...]:
        """Return those that balance the pull (nv,) of the tasks, the strongest first; none where nothing does."""
        if not self.forces or not np.isfinite(pull).all():
            return ()
        columns = np.array(self.forces).T
        weights, missing = nnls(columns, pull)
        strengths = weights * np.linalg.norm(columns, axis=0)
        shares = strengths / max(float(strengths.sum()), _WEAKEST)
        named = [i for i in np.argsort(-shares, kind="stable").tolist() if shares[i] > _CULPRIT]
        reasons = [
            Reason.of(culprit[0], *culprit[1], amount=100.0 * float(shares[i]), unit="%")
            for i in named
            if (culprit := self.culprits[i]) is not None
        ]
        if len(reasons) < len(named):
            reasons.append(Reason.of(ReasonKind.STALLED, detail="tasks of an earlier priority"))
        elif reasons and missing > (1.0 - _EXPLAINED) * np.linalg.norm(pull):
            reasons.append(Reason.of(ReasonKind.STALLED, detail="and others"))
        return tuple(reasons)


def _import_nnls() -> Callable[[Array, Array], tuple[Array, float]]:
    """Import scipy's non-negative least squares, which takes 60 ms, with the first controller, not with qpavoid."""
    from scipy.optimize import nnls

    return nnls  # type: ignore[no-any-return]


def _nearest(problem: Problem) -> tuple[Reason, ...]:
    """Return the nearest pair that the tasks would have close, for solvers without rows and for the look-ahead."""
    rows = problem.avoidance
    candidates = np.flatnonzero((rows.J @ problem.v_tracking < -_ACTIVE_TOLERANCE) & (rows.d < rows.d2))
    if not len(candidates):
        return (Reason.of(ReasonKind.STALLED, detail="several rows together"),)
    i = int(candidates[np.argmin(rows.d[candidates])])
    return (Reason.of(ReasonKind.STALLED, *problem.pair_names[rows.pair[i]]),)
