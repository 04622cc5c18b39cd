"""The tick: state in, joint velocity out. Embed this in your own loop."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from qpavoid import kernels
from qpavoid.assembly import Assembly
from qpavoid.config import Avoidance, Limits, ScenarioConfig
from qpavoid.errors import UnknownName, located
from qpavoid.kinematics import ForwardKinematics, Kinematics
from qpavoid.limits import saturate
from qpavoid.loading import nearest
from qpavoid.motion import Sample
from qpavoid.problem import Array, Problem, Proximity, Solution, State, require_finite
from qpavoid.proximity import DistanceQuery
from qpavoid.robot import Robot
from qpavoid.scene import Scene, build_obstacles, build_scene
from qpavoid.solvers import Solver, make_solver
from qpavoid.tasks import FrameTask, build_tasks

_log = logging.getLogger(__name__)


class Tick(NamedTuple):
    """Everything that one tick computed."""

    state: State
    targets: tuple[Sample, ...]
    kinematics: Kinematics
    proximity: Proximity
    problem: Problem
    solution: Solution


class Controller:
    """Follows its tasks and keeps clear of everything in its scene."""

    def __init__(
        self,
        scene: Scene,
        tasks: Sequence[FrameTask],
        solver: Solver | str = "qp",
        dt: float = 0.01,
        avoidance: Avoidance | None = None,
        limits: Limits | None = None,
        tracking_damping: float = 0.01,
    ) -> None:
        """Lays out the memory of the tick.

        Args:
            scene: robot and obstacles.
            tasks: what to follow; see `build_tasks`.
            solver: anything with `solve`, or a name such as `eq10` or `qp:proxqp`.
            dt: control period [s]: each velocity is meant to be held that long.
            avoidance: distances and rows; the defaults of a scenario if left out.
            limits: use of the joint limits; the defaults of a scenario if left out.
            tracking_damping: λ of the damped J⁺ [-].

        Raises:
            UnknownName, SolverNotInstalled: of the solver.
        """
        self.scene, self.tasks, self.dt = scene, tuple(tasks), dt
        self.solver: Solver = make_solver(solver) if isinstance(solver, str) else solver
        self.avoidance, self.limits = avoidance or Avoidance(), limits or Limits()
        model = scene.robot.model
        self._kinematics = ForwardKinematics(model, [task.frame_id for task in tasks])
        self._query = DistanceQuery(scene)
        self._q_shape = (model.nq,)
        self._frame_index = {task.settings.frame: i for i, task in enumerate(tasks)}
        self._obstacle_index = {name: i for i, name in enumerate(scene.obstacle_names)}
        self._moving = [i for i, obstacle in enumerate(scene.obstacles) if obstacle.moves]
        self._reach = self.avoidance.d2 - self.avoidance.offset
        self._bounds = scene.robot.bounds().within(self.limits)
        self._assembly = Assembly(
            scene, self.tasks, self._bounds, self._kinematics, self._query, self.avoidance,
            self.limits.position_gain, tracking_damping, dt,
        )  # fmt: skip
        begin = perf_counter()
        self.tick(scene.robot.home)
        self.warm_up_time = perf_counter() - begin
        """Time that the first tick took, compilation included [s]; no later one waits for the compiler."""
        _log.info("warmed up in %.3f s, compiled kernels: %s", self.warm_up_time, kernels.ACCELERATED)

    @classmethod
    def from_scenario(cls, scenario: ScenarioConfig) -> tuple[Controller, Array]:
        """Controller and initial configuration of a scenario.

        Raises:
            ConfigError, UnknownName, SolverNotInstalled: naming file, field and remedy.
        """
        source = scenario.source
        with located(f"{source}: robot"):
            robot = Robot.load(scenario.robot, source.parent)
        with located(f"{source}: solver"):
            solver = make_solver(scenario.solver)
        q0 = robot.configuration(scenario.q0, f"{source}: q0")
        robot, q0 = robot.lock(scenario.lock, q0, f"{source}: lock")
        obstacles = build_obstacles(scenario.obstacles, source)
        with located(str(source)):
            scene = build_scene(robot, obstacles)
        controller = cls(
            scene,
            build_tasks(scenario.tasks, robot, q0, source),
            solver,
            scenario.dt,
            scenario.avoidance,
            scenario.limits,
            scenario.tracking_damping,
        )
        return controller, q0

    def step(
        self,
        q: Array,
        t: float = 0.0,
        targets: Mapping[str, Sample] | None = None,
        obstacles: Mapping[str, Sample] | None = None,
    ) -> Solution:
        """Velocity for the next dt.

        Args:
            q: configuration (nq,) as measured.
            t: time [s] at which motions are evaluated.
            targets: where frames should be now, by frame name, in place of their motion.
            obstacles: where obstacles are now and how they move, by name, in place of their motion.

        Raises:
            NumericalError: q of the wrong shape; NaN or infinity in q or in an obstacle.
            UnknownName: of a target or obstacle.
        """
        return self._compute(q, t, targets, obstacles)[-1]

    def tick(
        self,
        q: Array,
        t: float = 0.0,
        targets: Mapping[str, Sample] | None = None,
        obstacles: Mapping[str, Sample] | None = None,
    ) -> Tick:
        """Like `step`, with everything that led to the velocity."""
        samples, proximity, problem, solution = self._compute(q, t, targets, obstacles)
        state = State(np.array(q, dtype=np.float64), solution.v, t)
        kinematics = _copied(self._assembly.kinematics)
        return Tick(state, samples, kinematics, _copied(proximity), _copied(problem), solution)

    def _compute(
        self, q: Array, t: float, targets: Mapping[str, Sample] | None, obstacles: Mapping[str, Sample] | None
    ) -> tuple[tuple[Sample, ...], Proximity, Problem, Solution]:
        begin = perf_counter()
        q = require_finite("q", q, self._q_shape)
        samples = self._targets(t, targets)
        if obstacles or self._moving:
            self._place_obstacles(t, obstacles or {})
        self._kinematics.compute(q)
        self._query.compute(self._kinematics.data, self._reach)
        proximity, problem = self._assembly.compute(q, samples, self._query, self._reach)
        built = perf_counter()
        v, status, reasons, slack, *_ = self.solver.solve(problem)
        saturation = 0.0
        if self.limits.saturate and not self.solver.bounded:
            v, saturation = saturate(v, problem.lower, problem.upper, self._bounds.velocity)
        solution = Solution(v, status, reasons, slack, saturation, built - begin, perf_counter() - built)
        return samples, proximity, problem, solution

    def _targets(self, t: float, given: Mapping[str, Sample] | None) -> tuple[Sample, ...]:
        if not given:
            return tuple([task.motion.sample(t) for task in self.tasks])
        for frame in given:
            _index(self._frame_index, frame, "target")
        return tuple([given.get(task.settings.frame) or task.motion.sample(t) for task in self.tasks])

    def _place_obstacles(self, t: float, given: Mapping[str, Sample]) -> None:
        for i in self._moving:
            if self.scene.obstacles[i].name not in given:
                self._query.place_obstacle(i, self.scene.obstacles[i].motion.sample(t))
        for name, sample in given.items():
            self._query.place_obstacle(_index(self._obstacle_index, name, "obstacle"), sample)


def _copied(value: Any) -> Any:
    """The same with arrays of its own: what a tick computed stays as it was when the next one comes."""
    if isinstance(value, np.ndarray):
        return value.copy()
    if hasattr(value, "_fields"):
        return type(value)(*map(_copied, value))
    return value


def _index(names: Mapping[str, int], name: str, what: str) -> int:
    if name not in names:
        raise UnknownName(f"no {what} {name!r}{nearest(name, names)}")
    return names[name]
