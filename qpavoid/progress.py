"""Notices when avoidance leaves a task no way to go on, says what is in the way, and can try a way round.

A robot that is pushed back exactly against the way it wants to go rests there: the projections of eq. 10 and of the
QP both end in such points. Being blocked is told by how much of the wanted task velocity is left. The way round, where
it is asked for, circulates: the tool is sent along the tangent t = a × n of what blocks it, with n the normal between
the two and a an axis that is chosen once, so that the motion leads round on one side until the way is free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from qpavoid.assembly import Assembly
from qpavoid.config import Detour, Progress
from qpavoid.problem import Array, Problem, Proximity, Solution
from qpavoid.solvers import Solver

_LEFT = 0.1
"""Share of the wanted task velocity below which there is no progress [-]."""
_SLOWEST = 2e-3
"""Wanted task velocity below which nothing needs to progress [m/s, rad/s]."""
_RESTING = 0.01
"""Task velocity below which a task that makes no progress is not under way round something either [m/s, rad/s]."""
_TIGHT = 1e-3
"""How close to its bound a row counts as being in the way [m/s]."""
_DIRECTIONS = 8
_MOST_TRIES = 4
"""Ways round one pair that are tried, on one side and on the other in turn."""
_CALM = 3.0
"""Time without anything in the way after which they may be tried again [s]."""
_EVERY = 5
"""Ticks from one look at the progress to the next."""


@dataclass
class _Way:
    """A way round under way."""

    pair: int
    axis: Array
    """(3,) axis of the circulation, world."""
    frame: int
    """Which task is sent round."""
    ticks: int = 0
    free: int = 0
    """Ticks since the pair last stood in the way."""


class ProgressWatch:
    """Follows the progress of a controller's tasks from tick to tick."""

    def __init__(self, config: Progress, dt: float, pair_names: tuple[tuple[str, str], ...]) -> None:
        self._config, self._dt, self._names = config, dt, pair_names
        self.reset()

    def reset(self) -> None:
        """Forgets everything."""
        self._clock, self._without, self._tried, self._calm, self._last = 0, 0, 0, 0, -1
        self._way: _Way | None = None
        self._culprits: list[int] = []

    def redirect(self, problem: Problem, proximity: Proximity, assembly: Assembly, solver: Solver) -> Problem:
        """The problem to solve: as it is, or with the tool sent round what blocks it."""
        detour = self._config.detour
        if detour is None:
            return problem
        way = self._way
        if way is None:
            if not self.blocked or not self._culprits:
                return problem
            if self._culprits[0] != self._last:
                self._last, self._tried = self._culprits[0], 0
            if self._tried >= _MOST_TRIES:
                return problem
            way = self._begin(problem, proximity, assembly, solver, detour)
            if way is None:
                return problem
            self._way = way
        row = np.flatnonzero(problem.avoidance.pair == way.pair)
        rows = problem.avoidance
        opposed = len(row) and rows.J[row[0]] @ problem.v0 < rows.b[row[0]]
        way.free = 0 if opposed else way.free + 1
        way.ticks += 1
        if not len(row) or way.free * self._dt > detour.settle or way.ticks * self._dt > detour.longest:
            self._tried += 1
            self._way, self._without, self._calm = None, 0, 0
            return problem
        t = _tangent(way.axis, proximity.normal[row[0]])
        back = max(-float(t @ assembly.wanted_velocity(way.frame)), 0.0)  # what the task would have of the way undone
        return assembly.redirected(problem, way.frame, (detour.speed + back) * t)

    def update(self, problem: Problem, solution: Solution) -> tuple[str, ...]:
        """What blocks the tasks, once they have been without progress for long enough; else nothing.

        Args:
            problem: as the tasks had it, without a way round.
            solution: what is commanded.
        """
        A = problem.tracking.A
        if not len(A) or (problem.shortfall <= 0.0 and solution.share == 1.0):
            self._without = 0
            self._calm += 1
            if self._calm * self._dt > _CALM:
                self._tried = 0
            return ()
        self._clock, self._calm = self._clock + 1, 0
        if self._clock % _EVERY and not self.blocked:
            return ()
        wanted, got = A @ problem.v0, A @ solution.v
        size = float(wanted @ wanted)
        resting = float(got @ got) < _RESTING**2
        stuck = resting and size > _SLOWEST**2 and float(got @ wanted) < _LEFT * size
        self._without = max(self._without + (_EVERY if stuck else -_EVERY), 0)
        if not self.blocked:
            return ()
        self._culprits = _culprits(problem, solution.v)
        lines = [f"blocked by {self._names[pair][1]} at {self._names[pair][0]}" for pair in self._culprits]
        return (*lines, *_limits(problem, solution.v)) or ("blocked by several rows together",)

    @property
    def blocked(self) -> bool:
        """Whether there was no progress for long enough."""
        return self._without * self._dt >= self._config.blocked_after

    def _begin(
        self, problem: Problem, proximity: Proximity, assembly: Assembly, solver: Solver, detour: Detour
    ) -> _Way | None:
        """The way round along which the tool gets on fastest, of several directions."""
        pair = self._culprits[0]
        row = np.flatnonzero(proximity.pair == pair)
        if not len(row):
            return None
        n = proximity.normal[row[0]]
        frame = assembly.fastest_frame()
        if frame < 0:
            return None
        across = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
        across /= np.linalg.norm(across)
        best, axis = -np.inf, across
        for angle in np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False) + self._tried * np.pi:
            t = np.cos(angle) * across + np.sin(angle) * np.cross(n, across)
            tried = assembly.redirected(problem, frame, detour.speed * t)
            speed = float(t @ assembly.frame_velocity(frame, solver.solve(tried).v))
            if speed > best + 1e-6:
                best, axis = speed, np.cross(n, t)
        return _Way(pair, axis, frame) if best > 0.1 * detour.speed else None


def _tangent(axis: Array, normal: Array) -> Array:
    t = np.cross(axis, normal)
    return t / max(float(np.linalg.norm(t)), 1e-9)


def _culprits(problem: Problem, v: Array) -> list[int]:
    """Numbers of the pairs whose rows bind and stand against the wanted velocity, the strongest first."""
    rows = problem.avoidance
    against = rows.b - rows.J @ problem.v0
    tight = (rows.J @ v - rows.b < _TIGHT) & (against > 0.0)
    if not tight.any():  # a law that is not made of rows: the nearest of the pairs that the task would have close
        tight = (rows.J @ problem.v0 < -_TIGHT) & (rows.d < rows.d2)
        tight &= rows.d <= np.min(rows.d, where=tight, initial=np.inf)
    found = np.flatnonzero(tight)
    return [int(pair) for pair in rows.pair[found[np.argsort(-against[found], kind="stable")]]]


def _limits(problem: Problem, v: Array) -> list[str]:
    """Joints at a position limit that the wanted velocity goes against."""
    high = (v >= problem.hard_upper - 1e-9) & (problem.v0 > problem.hard_upper)
    low = (v <= problem.hard_lower + 1e-9) & (problem.v0 < problem.hard_lower)
    names = problem.joint_names
    full = np.maximum(problem.hard_upper, -problem.hard_lower)
    return [
        *(f"{names[j]}: at its upper limit" for j in np.flatnonzero(high & (problem.hard_upper < full)).tolist()),
        *(f"{names[j]}: at its lower limit" for j in np.flatnonzero(low & (-problem.hard_lower < full)).tolist()),
    ]
