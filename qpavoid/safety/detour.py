"""Ways round what blocks a task: tried one after the other, and given up.

A way round circulates: the tool is sent along the tangent t = a × n of what blocks it, with n the normal between the
two and a an axis that is chosen once, so that the motion leads round on one side until the way is free. The other side
is next. The search for one goal is bounded, in ways and in time, and only what brings the tool nearer to its goal than
it ever was renews the bound: a share nearer each time, so that this, too, comes to an end. A goal that certainly cannot
be reached (`reach`) is not searched for at all.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import starmap

import numpy as np

from qpavoid.config import Detour
from qpavoid.control.assembler import Assembly
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.tasks.frames import FrameTask
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, Problem, Proximity
from qpavoid.reason import Reason, ReasonKind
from qpavoid.safety.reach import arm, too_near
from qpavoid.solvers import Solver

_DIRECTIONS = 8
"""Directions of which the best becomes a way round."""
_HEADWAY = 0.1
"""Share of the speed along a way below which it leads nowhere [-]."""
_NEARER = 0.75
"""Share of the distance to the goal that a tool must come within to be nearer than before [-]."""
_MOVED, _TURNED = 0.02, 0.1
"""How far a goal or an obstacle moves, and how far the latter turns, until it is somewhere else [m, rad]."""
_CERTAIN = 2e-3
"""By how much a goal must be out of reach to be so for certain [m]."""
_SLOWEST = 2e-3
"""Speed that a task asks for below which it is at its goal [m/s]."""


@dataclass
class _Way:
    """A way round under way."""

    pair: int
    axis: Array
    """(3,) axis of the circulation, world."""
    frame: int
    """Which task is sent round."""
    free: int = 0
    """Ticks since the pair last stood in the way."""
    stalled: int = 0
    """Ticks since the tool last made headway."""
    ticks: int = 0


@dataclass
class _Search:
    """What has been tried for the goal of one task."""

    goal: Array
    """(3,) where it is [m]."""
    nearest: float
    """Distance to it from which the budget counts [m]."""
    tries: int = 0
    ticks: int = 0
    """In which something was in the way."""
    given_up: Reason | None = None
    """Why; None while it goes on."""
    culprits: dict[int, Array] = field(default_factory=dict)
    """Poses (12,) of the geometries of obstacles that were in the way then."""

    def renew(self, goal: Array, distance: float) -> None:
        """Begins anew."""
        self.goal, self.nearest = goal, distance
        self.tries, self.ticks, self.given_up, self.culprits = 0, 0, None, {}


class Detours:
    """Looks for ways round, one search for each task that has a position to reach."""

    def __init__(
        self, config: Detour, dt: float, scene: Scene, frames: list[FrameTask], query: DistanceQuery, keep: float
    ) -> None:
        """Knows what goals are out of reach from the start on.

        Args:
            config: bounds of the search.
            dt: control period [s].
            scene: robot and obstacles.
            frames: tasks with a position to reach, in the order of their rows.
            query: distances of the tick.
            keep: distance between surfaces that is kept [m].
        """
        self._config, self._dt, self._scene, self._query, self._keep = config, dt, scene, query, keep
        self._frame_ids = [task.frame_id for task in frames]
        self._names = [task.settings.label for task in frames]
        self._arms = [arm(scene.robot, frame_id) for frame_id in self._frame_ids]
        self.reset()

    def reset(self) -> None:
        """Forgets everything."""
        self.way: _Way | None = None
        """What is being tried."""
        self._searches: dict[int, _Search] = {}

    @property
    def given_up(self) -> tuple[Reason, ...]:
        """Why the goals of some tasks are not tried any more."""
        return tuple([search.given_up for search in self._searches.values() if search.given_up])

    def follow(self, problem: Problem, proximity: Proximity, assembly: Assembly, patience: float) -> Problem | None:
        """The problem with the tool sent along the way round that is being tried; None once that has ended.

        Args:
            problem: as the tasks have it.
            proximity: of the same tick.
            assembly: likewise.
            patience: time without headway after which a way has ended [s].
        """
        way, rows, config, dt = self.way, problem.avoidance, self._config, self._dt
        assert way is not None
        search = self._searches[way.frame]
        row = np.flatnonzero(rows.pair == way.pair)
        opposed = len(row) and rows.J[row[0]] @ problem.v_tracking < rows.b[row[0]]
        way.free = 0 if opposed else way.free + 1
        way.ticks += 1
        if len(row):
            t = _tangent(way.axis, proximity.normal[row[0]])
            headway = t @ assembly.frame_velocity(way.frame, assembly.v_prev)
            way.stalled = 0 if headway > _HEADWAY * config.speed else way.stalled + 1
        late = way.ticks * dt > config.longest or search.ticks * dt > config.patience
        if not len(row) or way.free * dt > config.settle or way.stalled * dt > patience or late:
            search.tries += 1
            self.way = None
            return None
        back = max(-float(t @ assembly.wanted_velocity(way.frame)), 0.0)  # what the task would have of the way undone
        return assembly.redirected(problem, way.frame, (config.speed + back) * t)

    def begin(
        self, problem: Problem, proximity: Proximity, assembly: Assembly, solver: Solver, culprits: list[int]
    ) -> None:
        """Sets out on a way round one of the pairs that are in the way, if there is any left to try."""
        frame = self._blocked_frame(assembly)
        if frame < 0:
            return
        goal, distance = assembly.goal(frame)
        search = self._searches.setdefault(frame, _Search(goal, distance))
        obstacles = [self._scene.pairs[pair, 1] for pair in culprits]
        seconds = search.ticks * self._dt
        if self._hopeless(frame, goal):
            return
        if search.tries >= self._config.tries or seconds > self._config.patience:
            tried = f"{search.tries} detours"
            self._give_up(frame, self._reason(ReasonKind.DETOUR_ENDED, frame, seconds, "s", tried), obstacles)
            return
        for pair in culprits:
            self.way = self._way_round(pair, frame, problem, proximity, assembly, solver)
            if self.way is not None:
                return
        self._give_up(frame, self._reason(ReasonKind.DETOUR_ENDED, frame, seconds, "s", "none possible"), obstacles)

    def _way_round(
        self, pair: int, frame: int, problem: Problem, proximity: Proximity, assembly: Assembly, solver: Solver
    ) -> _Way | None:
        """The way round a pair along which the tool gets on fastest; None where it does along none."""
        row = np.flatnonzero(proximity.pair == pair)
        if not len(row):
            return None
        n, speed = proximity.normal[row[0]], self._config.speed
        across = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
        across /= np.linalg.norm(across)
        best, axis = -np.inf, across
        begin = self._searches[frame].tries * np.pi  # every other try on the other side
        for angle in np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False) + begin:
            t = np.cos(angle) * across + np.sin(angle) * np.cross(n, across)
            tried = assembly.at_length(assembly.redirected(problem, frame, speed * t))
            headway = float(t @ assembly.frame_velocity(frame, solver.solve(tried).v))
            if headway > best + 1e-6:
                best, axis = headway, np.cross(n, t)
        return _Way(pair, axis, frame) if best > _HEADWAY * speed else None

    def notice(self, problem: Problem, assembly: Assembly) -> None:
        """Counts the time, and begins anew where a goal or an obstacle has moved, or a tool is nearer than before."""
        for frame, search in self._searches.items():
            search.ticks += problem.violation > 0.0
            goal, distance = assembly.goal(frame)
            if float(np.linalg.norm(goal - search.goal)) > _MOVED:
                search.renew(goal, distance)
            elif distance < _NEARER * search.nearest or any(starmap(self._has_moved, search.culprits.items())):
                search.renew(search.goal, min(distance, search.nearest))

    def _blocked_frame(self, assembly: Assembly) -> int:
        """Of the tasks that make no headway and are not given up, the one that asks for the largest speed; -1: none."""
        fastest, found = _SLOWEST, -1
        for i in range(len(self._frame_ids)):
            wanted = assembly.wanted_velocity(i)
            speed = float(np.linalg.norm(wanted))
            headway = float(wanted @ assembly.frame_velocity(i, assembly.v_prev))
            given_up = i in self._searches and self._searches[i].given_up
            if speed > fastest and headway < _HEADWAY * speed**2 and not given_up:
                fastest, found = speed, i
        return found

    def _hopeless(self, frame: int, goal: Array) -> bool:
        """Gives up a goal that is certainly out of reach."""
        root, length = self._arms[frame]
        beyond = float(np.linalg.norm(goal - root)) - length
        if beyond > _CERTAIN:
            self._give_up(frame, self._reason(ReasonKind.OUT_OF_REACH, frame, beyond, "m"), [])
            return True
        short, geometry = too_near(self._scene, self._query, self._frame_ids[frame], goal, self._keep)
        if short > _CERTAIN:
            name = self._scene.obstacle_names[self._scene.obstacle_of[geometry]]
            reason = Reason.of(ReasonKind.TARGET_OBSTRUCTED, self._names[frame], name, amount=short, unit="m")
            self._give_up(frame, reason, [geometry])
            return True
        return False

    def _reason(self, kind: ReasonKind, frame: int, amount: float, unit: str, detail: str = "") -> Reason:
        return Reason.of(kind, self._names[frame], amount=amount, unit=unit, detail=detail)

    def _give_up(self, frame: int, why: Reason, obstacles: list[int]) -> None:
        """Gives up the goal of a task, until some geometries have moved, or what else `notice` sees.

        Those of the robot, of what it carries and of points do not count: where they are also depends on the robot.
        """
        search, of = self._searches[frame], self._scene.obstacle_of
        rigid = [i for i in obstacles if of[i] >= 0 and of[i] not in (*self._scene.clouds, *self._query.carried)]
        search.given_up, search.culprits = why, {i: self._query.poses[i].copy() for i in rigid}

    def _has_moved(self, geometry: int, pose: Array) -> bool:
        turn, shift = np.split(self._query.poses[geometry] - pose, [9])
        return bool(np.linalg.norm(shift) > _MOVED or np.linalg.norm(turn) > _TURNED)


def _tangent(axis: Array, normal: Array) -> Array:
    t = np.cross(axis, normal)
    return t / max(float(np.linalg.norm(t)), 1e-9)
