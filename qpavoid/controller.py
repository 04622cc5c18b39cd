"""The controller: state in, joint velocity out. Embed this in your own loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any, NoReturn

import numpy as np

from qpavoid import kernels
from qpavoid.budget import Budget
from qpavoid.config import Avoidance, Dynamics, Limits, Planning, Progress, ScenarioConfig, Sensing, Sphere
from qpavoid.config.scenario import MAX_LATENCY
from qpavoid.control.arguments import Obstacles
from qpavoid.control.builder import ProblemBuilder, StepProblem
from qpavoid.control.contacts import ContactRows, within_contacts
from qpavoid.control.dynamics import make_dynamics
from qpavoid.control.inputs import LARGEST_VELOCITY, check_velocity
from qpavoid.control.scenario import build_parts
from qpavoid.control.scene_changes import SceneChanges
from qpavoid.control.settings import ControlSettings, make_budget
from qpavoid.control.split_step import SplitStep
from qpavoid.control.tasks import RowTask, in_order
from qpavoid.control.tick import Tick, copied
from qpavoid.errors import ConfigError, NumericalError, located
from qpavoid.model.robot import Robot
from qpavoid.model.scene import Obstacle, Scene
from qpavoid.planning.replanning import Replanning
from qpavoid.problem import Array, Solution, State, as_vector, require_finite
from qpavoid.safety.arbiter import Arbiter
from qpavoid.safety.closed_loop import ClosedLoops
from qpavoid.solvers import Solver, as_solver, check_solver, make_solver
from qpavoid.solvers.solver import NamedSolver

_MAX_DT = 1.0
"""Largest control period that is accepted [s]: a longer one is in milliseconds."""
_WARM_UP = "a passing obstacle, to warm up"


class Controller(SceneChanges, SplitStep, ClosedLoops):
    """Follows its tasks and keeps clear of everything in its scene."""

    def __init__(
        self,
        scene: Scene,
        tasks: Sequence[RowTask],
        solver: Solver | Mapping[str, Any] | str = "qp",
        dt: float = 0.01,
        avoidance: Avoidance | None = None,
        limits: Limits | None = None,
        sensing: Sensing | None = None,
        progress: Progress | None = None,
        contacts: ContactRows | None = None,
        latency: float = 0.0,
        planning: Planning | None = None,
        budget: float | Budget | None = None,
        dynamics: Dynamics | None = None,
    ) -> None:
        """Lay out the memory of a control step.

        Args:
            scene: robot and obstacles.
            tasks: what to follow; see `build_tasks`. None are needed for `filter`.
            solver: a `Solver`, a name such as `eq10` or `qp:proxqp`, or a mapping as in a scenario file.
            dt: control period [s]: each velocity is meant to be held that long.
            avoidance: distances and rows; the defaults of a scenario if left out.
            limits: use of the joint limits; the defaults of a scenario if left out.
            sensing: assumptions about obstacles without updates; the defaults of a scenario if left out.
            progress: when a task counts as stalled; the defaults of a scenario if left out.
            contacts: frames that rest, see `build_contacts`; none if left out.
            latency: time after which the actuators follow a command [s], see `step`.
            planning: forecasts and plans; none if left out.
            dynamics: torque level; the command is a velocity alone if left out.
            budget: time after which a step leaves out what is left of relaxation, stop look-ahead and backup search
                [s], and brakes or follows its backup trajectory instead, with a reason of kind BUDGET_SPENT; runs are
                then not reproducible. As long as it takes if left out.

        Raises:
            UnknownName, SolverNotInstalled: of the solver.
            ConfigError: dt, latency, budget or dynamics cannot be meant; a solver that does not hold contacts.
        """
        begin = perf_counter()
        if not 0.0 < dt <= _MAX_DT:
            raise ConfigError(f"dt: {dt} s, expected more than 0 and at most {_MAX_DT}; it is in seconds")
        if not 0.0 <= latency <= MAX_LATENCY:
            raise ConfigError(f"latency: {latency} s, expected 0 to {MAX_LATENCY}; it is in seconds")
        self._another = partial(
            type(self), tasks=tasks, dt=dt, avoidance=avoidance, limits=limits, sensing=sensing, progress=progress,
            contacts=contacts, latency=latency, planning=planning, budget=budget, dynamics=dynamics,
        )  # fmt: skip
        frames, others = in_order(tasks)
        self.scene = scene = scene.own_copy() if scene.spare else scene
        """Robot and obstacles, those that were added among them."""
        self.dt = dt
        self.tasks: tuple[RowTask, ...] = (*frames, *others)
        """Frames with a position to follow, then with an orientation alone, then all other tasks."""
        law, self.has_contacts = as_solver(solver), contacts is not None
        check_solver(law, self.has_contacts and dynamics is None)
        self.limits, self._v_shape = limits or Limits(), (scene.robot.model.nv,)
        self.avoidance, self._no_backup = within_contacts(avoidance or Avoidance(), self.has_contacts, bool(dynamics))
        torques, bounds = make_dynamics(
            dynamics, scene.robot, self.limits, self.avoidance, dt,
            contacts=contacts, latency=latency, planning=planning,
        )  # fmt: skip
        blocks = sensing or Sensing(), progress or Progress()
        settings = ControlSettings(
            scene, bounds, self.avoidance, self.limits, dt, latency, *blocks, make_budget(budget), torques
        )
        self._builder = ProblemBuilder(settings, self.tasks, contacts)
        self._arbiter = Arbiter(settings, law, self._builder.rows, self._builder.tracker)
        self._builder.rows.adapt(law, self.avoidance.look_ahead)
        self._planning: Replanning | None = None
        with settings.budget.suspended():  # loading kernels takes as long as it takes
            self._warm_up()
        if planning is not None:
            self._planning = Replanning(settings, self.tasks, contacts, self._builder, self._arbiter, planning)
        kernels.first_use.end()
        self.warm_up_time = perf_counter() - begin
        """Time to lay out memory and run the first steps, compilation included [s]; no later step compiles."""

    @property
    def solver(self) -> Solver:
        """The law, which may be exchanged between steps.

        Raises:
            ConfigError: on assignment, of a law that lacks something of `Solver`, or does not hold contacts.
        """
        return self._arbiter.solver

    @solver.setter
    def solver(self, solver: Solver | Mapping[str, Any] | str) -> None:
        check_solver(law := as_solver(solver), self.has_contacts and self._builder.rows.dynamics is None)
        self._arbiter.solver = law
        self._builder.rows.adapt(law, self.avoidance.look_ahead)
        if self._planning is not None:
            self._planning.change_law(law)

    def _warm_up(self) -> None:
        """Run the first steps, with a law that ships: one of the user's own may remember what it is asked."""
        q, v, law = self.scene.robot.home, np.zeros(self._v_shape), self._arbiter.solver
        self._arbiter.solver = make_solver("qp")
        self.tick(q, v=v)
        self.filter(q, v, v=v)
        self.rows(q, v=v)
        self.rows(q, v=v)
        self.command(v)
        self._builder.rows.clearance_lower_bound(v, 0, self.dt)
        self._builder.rows.leaves_position_limits(q, v, self.dt)
        self._arbiter.warm_up(q)
        self._builder.tracker.warm_up()
        self._builder.rows.query.place(self._builder.tracker.current)
        kernels.projection_cost(np.zeros((0, len(v))), 1.0, v)
        if self.scene.spare:
            passing = replace(Obstacle.at(_WARM_UP, Sphere(radius=0.05), [2.0, 0.0, 0.0]), moves=True)
            self.add_obstacle(passing)
            self.tick(q, v=v)
            self.remove_obstacle(_WARM_UP)
        self._builder.rows.query.table.forget_guesses()
        self._arbiter.solver = law
        self.reset()

    @classmethod
    def from_scenario(cls, scenario: ScenarioConfig, robot: Robot | None = None) -> tuple[Controller, Array]:
        """Controller and initial configuration of a scenario; `robot` is that of the scenario, if it is loaded already.

        Raises:
            ConfigError, UnknownName, SolverNotInstalled: naming file, field and remedy.
        """
        source, parts = scenario.source, build_parts(scenario, robot)
        with located(str(source)):
            controller = cls(
                parts.scene, parts.tasks, parts.solver, scenario.dt, scenario.avoidance, scenario.limits,
                scenario.sensing, scenario.progress, parts.contacts, scenario.latency, scenario.planning_in_time,
                scenario.budget, scenario.dynamics,
            )  # fmt: skip
        for c in scenario.obstacles:
            if c.attached_to is not None:
                with located(f"{source}: obstacles: {c.name!r}: attached_to"):
                    controller.attach(c.name, c.attached_to, parts.q0)
        return controller, parts.q0

    def step(
        self,
        q: Array,
        t: float | None = None,
        targets: Mapping[str, Any] | None = None,
        obstacles: Obstacles = None,
        v: Array | None = None,
    ) -> Solution:
        """Velocity for the next dt.

        Every call with arguments of the right kind ends in a solution, and one that raises changes nothing. What cannot
        be true ends in a stop that says so, with a reason of kind IMPLAUSIBLE: NaN, infinity, a joint more than 2π
        beyond its limits, a quaternion that is more than 1e-3 off length 1, a matrix that is no rotation, positions
        beyond 1e6 m, twists beyond 1e3 m/s or rad/s, joint velocities beyond a norm of 1e4, a time whose resolution is
        coarser than dt/1000. Of an obstacle, it counts as no update. Where q is unknown, the stop takes the robot to be
        where the last velocity has led it.
        Rotations and quaternions that are less than 1e-3 off are normalised, with a reason of kind NORMALISED.

        With a `latency`, the step is that of t + latency, when the robot follows the command: q is predicted with the
        commands under way, motions are evaluated then, targets and obstacles are moved on at their velocities.

        Args:
            q: configuration (nq,) as measured.
            t: time [s], at which motions are evaluated and from which ages of obstacles count; one dt after the last
                step if left out. Where it goes on by less than dt/2 or more than 3 dt/2, a reason of kind TIMING says
                so; after a gap of more than 10 dt and 0.1 s, or where it goes back, the robot counts as standing still
                unless v is given, and plans are dropped. Where it goes back, ages go on as if dt had passed.
            targets: what tasks should reach now, by their names, in place of their motion: a `Sample`, or to rest at, a
                `Pose`, `pin.SE3`, 4×4 matrix or position (3,), for what is somewhere (frames, a relative pose, the
                centre of mass, a point to look at), a configuration (nq,) for a posture, a direction (3,) for an axis.
                A position alone leaves the target's orientation as in the step before. A frame's task has the frame's
                name unless it was given one.
            obstacles: where obstacles are, by name, in place of their motion: a `Sample`, or if no velocity is known, a
                `Pose`, `pin.SE3`, 4×4 matrix or position, which leaves the orientation as it was; `Points` for a cloud.
                From then on they have to be updated, see `Sensing`, unless they are given `at_rest`. Each may have a
                time stamp of its own. Many at a time cost least as one array, with a row of each of `obstacle_names`:
                (k, 18) as `Sample.row`, or (k, 7), position and quaternion x y z w, if no velocity is known; of some
                obstacles, as {(name, ...): array}.
            v: velocity (nv,) as measured, from which acceleration limits count in the first step, after a gap and after
                `reset`, else from the last command, as for servos that lag; with `dynamics`, all counts from it.

        Raises:
            NumericalError: an argument of the wrong shape, or not made of numbers.
            UnknownName: of a target or obstacle.
        """
        begin, builder = perf_counter(), self._builder
        step = builder.begin(q, t, targets, obstacles, v)
        planning = self._planning
        if step.is_plain and (planning is None or planning.leaves_alone(step)) and self._arbiter.accepts(step.t):
            middle, v = perf_counter(), builder.rows.v.copy()
            builder.remember(v)
            return Solution.solved(v, step.assumptions, middle - begin, perf_counter() - middle)
        return self._decide(step, begin)

    def tick(
        self,
        q: Array,
        t: float | None = None,
        targets: Mapping[str, Any] | None = None,
        obstacles: Obstacles = None,
        v: Array | None = None,
        copy: bool = True,
    ) -> Tick:
        """Like `step`, with everything that led to the velocity; without `copy`, until the next step overwrites it."""
        begin, builder, rows = perf_counter(), self._builder, self._builder.rows
        step = builder.begin(q, t, targets, obstacles, v)
        state, problem = State(step.q, rows.previous.v.copy(), step.t), rows.problem()
        solution = self._decide(step, begin)
        tick = Tick(
            state, tuple(step.targets), rows.task_errors, rows.kinematics, rows.proximity(), problem, solution,
            builder.obstacle_poses(step.q), self.dt * self._arbiter.backup_velocities,
        )  # fmt: skip
        return copied(tick) if copy else tick

    def filter(
        self,
        q: Array,
        v_desired: Array,
        t: float | None = None,
        obstacles: Obstacles = None,
        v: Array | None = None,
    ) -> Solution:
        """The safe velocity that is closest to any command: of a teleoperator, a policy, another controller.

        The command comes back unchanged, bit for bit, where it is safe and within the limits. Tasks play no part.

        Args:
            q: configuration (nq,) as measured.
            v_desired: the command (nv,) [rad/s or m/s].
            t: time [s]; see `step`.
            obstacles: where obstacles are now; see `step`.
            v: velocity (nv,) as measured; see `step`.

        Raises:
            NumericalError, UnknownName: as `step`.
        """
        begin = perf_counter()
        v_desired = as_vector("v_desired", v_desired, self._v_shape)
        if self._planning is not None:
            self._planning.drop()
        step = self._builder.build(self._builder.read(q, t, None, obstacles, v, v_desired))
        return self._decide(step, begin, from_tasks=False)

    def _decide(self, step: StepProblem, begin: float, from_tasks: bool = True) -> Solution:
        """Decide what is commanded; the step began at `begin` [s]."""
        middle, arbiter, builder = perf_counter(), self._arbiter, self._builder
        planning = self._planning if from_tasks else None
        if step.resumed:
            arbiter.reset()
        if step.faults:
            solution = arbiter.stop(step.faults)
        elif planning is not None:
            solution = planning.decide(step)
        else:
            solution = arbiter.decide(step.q, step.t, step.is_settled, from_tasks)
        if builder.rows.dynamics is not None:
            solution = builder.rows.torques(solution)
        builder.remember(solution.v)
        assumptions = step.assumptions
        if self._no_backup and len(builder.tracker.moving):
            assumptions += self._no_backup
        solution = solution._replace(assumptions=assumptions) if assumptions else solution
        return solution.with_times(middle - begin, perf_counter() - middle)

    def reset(self, v: Array | None = None) -> None:
        """Forget the steps before; the robot moves at v (nv,), or stands still. Attached objects stay attached.

        Raises:
            NumericalError: v has the wrong shape, or cannot be true.
        """
        v = np.zeros(self._v_shape) if v is None else require_finite("v", v, self._v_shape)
        if faults := check_velocity("v", v, LARGEST_VELOCITY):
            raise NumericalError(str(faults[0]))
        self._builder.reset(v)
        self._arbiter.reset()
        self._scene_changed("")

    def _scene_changed(self, method: str, *arguments: Any) -> None:
        """Drop all plans, and let forecasts know of a change of the scene."""
        if self._planning is not None:
            self._planning.change_scene(method, *arguments)

    def clone(self) -> Controller:
        """Return another controller that does the same, in memory of its own: for another thread, or to look ahead.

        It has the scene, with what was added and is attached, and all settings; it is as after `reset`. Tasks are
        shared, since they remember nothing; a law of your own is deep-copied.
        """
        law = self.solver
        own = make_solver(law.config) if isinstance(law, NamedSolver) else deepcopy(law)
        controller = self._another(self.scene.emptied(), solver=own, budget=copy(self._another.keywords["budget"]))
        controller.take_over(self)
        return controller

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Refuse to be copied or pickled: a copy would share memory that coal and compiled code look into.

        Raises:
            TypeError: always.
        """
        raise TypeError(
            "a Controller is neither copied nor pickled; `clone()` gives another one, and in another process build "
            "another one of its scenario, or of its scene and tasks"
        )
