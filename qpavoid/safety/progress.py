"""Notices when avoidance leaves a task no way to go on, says what is in the way, and can try a way round.

A robot that is pushed back exactly against the way it wants to go rests there: the projections of eq. 10 and of the
QP both end in such points. Being blocked is told by how much of the wanted task velocity is left. What is done about
it, where that is asked for, is in `detour`.
"""

from __future__ import annotations

import numpy as np

from qpavoid.config import Progress
from qpavoid.control.assembler import Assembly
from qpavoid.problem import Array, Problem, Proximity, Solution
from qpavoid.reason import Reason, ReasonKind
from qpavoid.safety.detour import Detours
from qpavoid.solvers import Solver

_LEFT = 0.1
"""Share of the wanted task velocity below which there is no progress [-]."""
_SLOWEST = 2e-3
"""Wanted task velocity below which nothing needs to progress [m/s, rad/s]."""
_RESTING = 0.01
"""Task velocity below which a task that makes no progress is not under way round something either [m/s, rad/s]."""
_TIGHT = 1e-3
"""How close to its bound a row counts as being in the way [m/s]."""
_EVERY = 5
"""Control steps from one look at the progress to the next, while the tasks are not stalled."""
_CAP = 1.1
"""Time without progress that counts at the most, in `stalled_after`: what moves again is no longer stalled soon."""


class ProgressWatch:
    """Follows the progress of a controller's tasks from tick to tick."""

    def __init__(
        self, config: Progress, dt: float, pair_names: tuple[tuple[str, str], ...], detours: Detours | None = None
    ) -> None:
        self._config, self._dt, self._names, self._detours = config, dt, pair_names, detours
        self._most = _CAP * config.stalled_after / dt + _EVERY
        self.reset()

    def reset(self) -> None:
        """Forgets everything."""
        self._clock, self._without = 0, 0.0
        self._culprits: list[tuple[int, float]] = []
        if self._detours is not None:
            self._detours.reset()

    def redirect(self, problem: Problem, proximity: Proximity, assembly: Assembly, solver: Solver) -> Problem:
        """The problem to solve: as it is, or with the tool sent round what blocks it."""
        detours = self._detours
        if detours is None:
            return problem
        detours.notice(problem, assembly)
        if detours.way is None and self.stalled and self._culprits:
            detours.begin(problem, proximity, assembly, solver, [pair for pair, _ in self._culprits])
        if detours.way is None:
            return problem
        redirected = detours.follow(problem, proximity, assembly, self._config.stalled_after)
        if redirected is None:
            self._without = 0.0
            return problem
        return redirected

    def update(self, problem: Problem, solution: Solution) -> tuple[Reason, ...]:
        """What is given up, and what blocks the tasks, once they have been without progress for long enough.

        Args:
            problem: as the tasks had it, without a way round.
            solution: what is commanded.
        """
        A, given_up = problem.tracking.A, self._detours.given_up if self._detours is not None else ()
        if not len(A) or (problem.violation <= 0.0 and solution.command_scale == 1.0):
            self._without = 0.0
            return given_up
        self._clock += 1
        if self._clock % _EVERY and not self.stalled:
            return given_up
        since = 1 if self.stalled else _EVERY
        wanted, got = A @ problem.v_tracking, A @ solution.v
        size = float(wanted @ wanted)
        resting = float(got @ got) < _RESTING**2
        stuck = resting and size > _SLOWEST**2 and float(got @ wanted) < _LEFT * size
        self._without = min(max(self._without + (since if stuck else -since), 0), self._most)
        if not self.stalled:
            return given_up
        self._culprits = _culprits(problem, solution.v)
        pairs = [
            Reason.of(ReasonKind.STALLED, *self._names[pair], amount=amount, unit="m/s")
            for pair, amount in self._culprits
        ]
        several = Reason.of(ReasonKind.STALLED, detail="several rows together")
        return (*given_up, *((*pairs, *_limits(problem, solution.v)) or (several,)))

    @property
    def stalled(self) -> bool:
        """Whether there was no progress for long enough."""
        return self._without * self._dt >= self._config.stalled_after


def _culprits(problem: Problem, v: Array) -> list[tuple[int, float]]:
    """Pairs whose rows bind and oppose v0, the strongest first, with the amount by which v0 violates them [m/s]."""
    rows = problem.avoidance
    against = rows.b - rows.J @ problem.v_tracking
    tight = (rows.J @ v - rows.b < _TIGHT) & (against > 0.0)
    if not tight.any():  # a law that is not made of rows: the nearest of the pairs that the task would have close
        tight = (rows.J @ problem.v_tracking < -_TIGHT) & (rows.d < rows.d2)
        tight &= rows.d <= np.min(rows.d, where=tight, initial=np.inf)
    found = np.flatnonzero(tight)
    order = found[np.argsort(-against[found], kind="stable")]
    return list(zip(rows.pair[order].tolist(), against[order].tolist(), strict=True))


def _limits(problem: Problem, v: Array) -> list[Reason]:
    """Joints at a position limit that the wanted velocity goes against."""
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
