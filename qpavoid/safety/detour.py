"""Detours around what stalls a task: tried one after the other, in a bounded search.

A detour circulates: the tool is sent along the tangent t = a × n of what stalls it, with n the normal between the two
and a an axis that is chosen once, so that the motion leads past it on one side until the task can go on. The other side
is next. The search for one target is bounded, in detours and in time, and only what brings the tool nearer to its
target than it ever was renews the bound: by a constant ratio each time, so that this, too, comes to an end. No search
begins for a target that certainly cannot be reached (`qpavoid.safety.reachability`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import starmap

import numpy as np

from qpavoid.config import Detour
from qpavoid.control.assembler import Assembly
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.tasks import FrameTask
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, Problem, Proximity
from qpavoid.reason import Reason, ReasonKind
from qpavoid.safety.reachability import arm, target_violation
from qpavoid.solvers import Solver

_DIRECTIONS = 8
"""Tangent directions of which the best becomes a detour [-]."""
_MIN_PROGRESS = 0.1
"""Fraction of the speed along a detour below which it leads nowhere [-]."""
_PROGRESS_RATIO = 0.75
"""Ratio of distances to the target below which the tool has come nearer [-]: the bound is renewed finitely often."""
_MIN_SHIFT, _MIN_TURN = 0.02, 0.1
"""Motion of a target or an obstacle, and rotation of the latter, that begins a new search [m, rad]: above noise."""
_MIN_EXCESS = 2e-3
"""Excess from which on a target is certainly out of reach [m]: above the error of distances and of control."""
_MIN_TASK_SPEED = 2e-3
"""Task velocity below which a tool is at its target [m/s]."""


@dataclass
class _Circulation:
    """A detour in progress."""

    pair: int
    axis: Array
    """(3,) axis of the circulation, world."""
    frame: int
    """Index of the task."""
    free_steps: int = 0
    """Control steps since the pair last opposed the task."""
    stalled_steps: int = 0
    """Control steps since the tool last made progress."""
    steps: int = 0
    """Control steps since it began."""


@dataclass
class _Search:
    """Detours that were tried for the target of one task."""

    goal: Array
    """(3,) position of the target [m]."""
    nearest: float
    """Distance to it from which the bound counts [m]."""
    tries: int = 0
    """Detours that have ended."""
    steps: int = 0
    """Control steps in which a row opposed the tasks."""
    failure: Reason | None = None
    """Why the search ended; None while it goes on."""
    obstacle_poses: dict[int, Array] = field(default_factory=dict)
    """Poses (12,) of the geometries of obstacles that were in the way at its end."""

    def renew(self, goal: Array, distance: float) -> None:
        """Begin a new search."""
        self.goal, self.nearest = goal, distance
        self.tries, self.steps, self.failure, self.obstacle_poses = 0, 0, None, {}


class Detours:
    """Detours of a controller's tasks, with one search for each task that has a target position."""

    def __init__(
        self,
        config: Detour,
        dt: float,
        scene: Scene,
        frames: list[FrameTask],
        query: DistanceQuery,
        safety_distance: float,
    ) -> None:
        """Measure the arms, so that targets out of reach are known.

        Args:
            config: bounds of the search.
            dt: control period [s].
            scene: robot and obstacles.
            frames: tasks with a target position, in the order of their rows.
            query: distances of the control step.
            safety_distance: between surfaces [m].
        """
        self._config, self._dt, self._scene, self._query = config, dt, scene, query
        self._safety_distance = safety_distance
        self._frame_ids = [task.frame_id for task in frames]
        self._names = [task.settings.label for task in frames]
        self._arms = [arm(scene.robot, frame_id) for frame_id in self._frame_ids]
        self.reset()

    def reset(self) -> None:
        """Drop the detour and all searches."""
        self.active: _Circulation | None = None
        """The detour in progress."""
        self._searches: dict[int, _Search] = {}

    @property
    def failures(self) -> tuple[Reason, ...]:
        """Why searches have ended without reaching their target."""
        return tuple([search.failure for search in self._searches.values() if search.failure])

    def follow(self, problem: Problem, proximity: Proximity, assembly: Assembly, patience: float) -> Problem | None:
        """Return the problem with the tool sent along the detour; None once that has ended.

        Args:
            problem: of the tasks.
            proximity: of the same control step.
            assembly: of the same control step.
            patience: time without progress after which a detour ends [s].
        """
        detour, rows, config, dt = self.active, problem.avoidance, self._config, self._dt
        assert detour is not None
        search = self._searches[detour.frame]
        row = np.flatnonzero(rows.pair == detour.pair)
        opposed = len(row) and rows.J[row[0]] @ problem.v_tracking < rows.b[row[0]]
        detour.free_steps = 0 if opposed else detour.free_steps + 1
        detour.steps += 1
        if len(row):
            t = _tangent(detour.axis, proximity.normal[row[0]])
            progress = t @ assembly.frame_velocity(detour.frame, assembly.v_prev)
            detour.stalled_steps = 0 if progress > _MIN_PROGRESS * config.speed else detour.stalled_steps + 1
        is_late = detour.steps * dt > config.longest or search.steps * dt > config.patience
        is_free, is_stalled = detour.free_steps * dt > config.settle, detour.stalled_steps * dt > patience
        if not len(row) or is_free or is_stalled or is_late:
            search.tries += 1
            self.active = None
            return None
        back = max(-float(t @ assembly.wanted_velocity(detour.frame)), 0.0)  # what of the task opposes the detour
        return assembly.redirected(problem, detour.frame, (config.speed + back) * t)

    def begin(
        self, problem: Problem, proximity: Proximity, assembly: Assembly, solver: Solver, blocking_pairs: list[int]
    ) -> None:
        """Begin a detour around one of the blocking pairs; end the search if there is none, or its bound is met."""
        frame = self._stalled_frame(assembly)
        if frame < 0:
            return
        goal, distance = assembly.goal(frame)
        search = self._searches.setdefault(frame, _Search(goal, distance))
        obstacles = [self._scene.pairs[pair, 1] for pair in blocking_pairs]
        seconds = search.steps * self._dt
        if self._is_unreachable(frame, goal):
            return
        if search.tries >= self._config.tries or seconds > self._config.patience:
            tried = f"{search.tries} detours"
            self._end_search(frame, self._reason(ReasonKind.DETOUR_ENDED, frame, seconds, "s", tried), obstacles)
            return
        for pair in blocking_pairs:
            self.active = self._circulation(pair, frame, problem, proximity, assembly, solver)
            if self.active is not None:
                return
        self._end_search(frame, self._reason(ReasonKind.DETOUR_ENDED, frame, seconds, "s", "none possible"), obstacles)

    def _circulation(
        self, pair: int, frame: int, problem: Problem, proximity: Proximity, assembly: Assembly, solver: Solver
    ) -> _Circulation | None:
        """Return the circulation of a pair with the fastest progress of the tool; None without any."""
        row = np.flatnonzero(proximity.pair == pair)
        if not len(row):
            return None
        n, speed = proximity.normal[row[0]], self._config.speed
        across = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
        across /= np.linalg.norm(across)
        best, axis = -np.inf, across
        first = self._searches[frame].tries * np.pi  # every other try on the other side
        for angle in np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False) + first:
            t = np.cos(angle) * across + np.sin(angle) * np.cross(n, across)
            tried = assembly.at_length(assembly.redirected(problem, frame, speed * t))
            progress = float(t @ assembly.frame_velocity(frame, solver.solve(tried).v))
            if progress > best + 1e-6:
                best, axis = progress, np.cross(n, t)
        return _Circulation(pair, axis, frame) if best > _MIN_PROGRESS * speed else None

    def update(self, problem: Problem, assembly: Assembly) -> None:
        """Count the time; renew a search where its target or an obstacle has moved, or the tool has come nearer."""
        for frame, search in self._searches.items():
            search.steps += problem.violation > 0.0
            goal, distance = assembly.goal(frame)
            if float(np.linalg.norm(goal - search.goal)) > _MIN_SHIFT:
                search.renew(goal, distance)
            elif distance < _PROGRESS_RATIO * search.nearest or any(
                starmap(self._has_moved, search.obstacle_poses.items())
            ):
                search.renew(search.goal, min(distance, search.nearest))

    def _stalled_frame(self, assembly: Assembly) -> int:
        """Return, of the tasks without progress whose search goes on, the one with the largest speed; -1: none."""
        max_speed, stalled = _MIN_TASK_SPEED, -1
        for i in range(len(self._frame_ids)):
            wanted = assembly.wanted_velocity(i)
            speed = float(np.linalg.norm(wanted))
            progress = float(wanted @ assembly.frame_velocity(i, assembly.v_prev))
            has_failed = i in self._searches and self._searches[i].failure
            if speed > max_speed and progress < _MIN_PROGRESS * speed**2 and not has_failed:
                max_speed, stalled = speed, i
        return stalled

    def _is_unreachable(self, frame: int, goal: Array) -> bool:
        """Return whether a target is certainly out of reach; if so, end its search."""
        root, length = self._arms[frame]
        excess = float(np.linalg.norm(goal - root)) - length
        if excess > _MIN_EXCESS:
            self._end_search(frame, self._reason(ReasonKind.OUT_OF_REACH, frame, excess, "m"), [])
            return True
        frame_id, distance = self._frame_ids[frame], self._safety_distance
        violation, geometry = target_violation(self._scene, self._query, frame_id, goal, distance)
        if violation > _MIN_EXCESS:
            name = self._scene.obstacle_names[self._scene.obstacle_of[geometry]]
            reason = Reason.of(ReasonKind.TARGET_OBSTRUCTED, self._names[frame], name, amount=violation, unit="m")
            self._end_search(frame, reason, [geometry])
            return True
        return False

    def _reason(self, kind: ReasonKind, frame: int, amount: float, unit: str, detail: str = "") -> Reason:
        return Reason.of(kind, self._names[frame], amount=amount, unit=unit, detail=detail)

    def _end_search(self, frame: int, why: Reason, obstacles: list[int]) -> None:
        """End the search of a task, until `update` renews it; what counts is the motion of some obstacle geometries.

        Those of the robot, of attached objects and of points do not count: their poses also depend on the robot.
        """
        search, of = self._searches[frame], self._scene.obstacle_of
        rigid = [i for i in obstacles if of[i] >= 0 and of[i] not in (*self._scene.clouds, *self._query.carried)]
        search.failure, search.obstacle_poses = why, {i: self._query.poses[i].copy() for i in rigid}

    def _has_moved(self, geometry: int, pose: Array) -> bool:
        turn, shift = np.split(self._query.poses[geometry] - pose, [9])
        return bool(np.linalg.norm(shift) > _MIN_SHIFT or np.linalg.norm(turn) > _MIN_TURN)


def _tangent(axis: Array, normal: Array) -> Array:
    t = np.cross(axis, normal)
    return t / max(float(np.linalg.norm(t)), 1e-9)
