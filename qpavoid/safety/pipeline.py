"""The pipeline of a control step: arguments to problem, problem to command."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any, NoReturn

import numpy as np
import pinocchio as pin

from qpavoid.control.arguments import Arguments
from qpavoid.control.assembler import Assembly
from qpavoid.control.attach import Attachments
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.inputs import Clock
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.errors import ConfigError
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.limits import OUTSIDE, JointBounds
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, Problem, Proximity, Solution
from qpavoid.reason import Reason, ReasonKind
from qpavoid.safety.arbiter import Arbiter
from qpavoid.solvers import Solver

Built = tuple[Array, float, Sequence[Any], Proximity, Problem, tuple[Reason, ...], tuple[Reason, ...]]
"""Configuration, time, targets, distances and problem of a step, faults and assumptions."""


NO_BACKUP_WITH_CONTACTS = Reason.of(
    ReasonKind.NO_BACKUP, "contacts", detail="backup trajectories do not hold contacts: avoidance.backup"
)
"""Assumption where obstacles move and the robot stands on something."""


class Pipeline:
    """State of a controller and the order of a step; `Controller` lays it out and has the public methods."""

    scene: Scene
    dt: float
    _clock: Clock
    _obstacles: ObstacleTracker
    _kinematics: ForwardKinematics
    _query: DistanceQuery
    _assembly: Assembly
    _commander: Arbiter
    _grasps: Attachments
    _bounds: JointBounds
    _influence_distance: float
    _q_last: Array
    _no_backup: tuple[Reason, ...]

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Refuse to be copied or pickled: a copy would share memory that coal and compiled code look into.

        Raises:
            TypeError: always.
        """
        raise TypeError("a Controller is neither copied nor pickled; build another one of its scene and tasks")

    def _build(self, arguments: Arguments) -> Built:
        """Take over the arguments of a step, and build its problem."""
        times, q, v, v_desired, targets, update, faults, assumptions = arguments
        if times.resumed:
            self._assembly.restart(np.zeros(self.scene.robot.model.nv))
            self._commander.reset()
        if v is not None:
            self._assembly.measured(v)
        if q is None:  # where the robot is if it moved as commanded
            q = np.asarray(pin.integrate(self.scene.robot.model, self._q_last, self.dt * self._assembly.v_prev))
        self._q_last[:] = q
        self._clock.set(times.t)
        observed = self._obstacles.advance(update)
        if observed is not None:
            for index, voxels in observed.voxels.items():
                for query in (self._query, *self._commander.queries):
                    query.fill(index, voxels)
            self._query.placing.place(*observed.now)
            self._commander.braking.mark_updated(observed.now.which)
            faults, assumptions = faults + observed.stop, assumptions + observed.assumptions
        self._kinematics.compute(q)
        self._query.compute(self._kinematics.data, self._influence_distance)
        if self._query.disabled_pairs is not None:
            self._grasps.update()
        proximity, problem = self._assembly.compute(q, targets, self._query, self._influence_distance)
        if v_desired is not None:
            problem = self._assembly.follow(v_desired, problem)
        return q, times.t, targets, proximity, problem, faults, assumptions

    def _solve(self, built: Built, begin: float, from_tasks: bool = True) -> Solution:
        """Decide what is commanded; the step began at `begin` [s]."""
        q, t, _, proximity, problem, faults, assumptions = built
        middle = perf_counter()
        if faults:
            solution = self._commander.stop(problem, faults)
        else:
            solution = self._commander.decide(q, t, problem, proximity, tasks=from_tasks)
        self._assembly.remember(solution.v)
        if self._no_backup and len(self._obstacles.moving):
            assumptions += self._no_backup
        if problem.position_margin < -OUTSIDE:
            assumptions += self._bounds.outside(q, problem.joint_names, problem.joint_units)
        solution = solution._replace(assumptions=assumptions) if assumptions else solution
        return solution.with_times(middle - begin, perf_counter() - middle)


def check_solver(law: Solver, name: Solver | str, contacts: bool) -> None:
    """Check that a solver can be used; `name` is what the user gave, `contacts` whether there are any.

    Raises:
        ConfigError: it has no `solve` or `bounded`, or does not hold contacts.
    """
    if not callable(getattr(law, "solve", None)) or not hasattr(law, "bounded"):
        raise ConfigError(f"solver: {type(law).__name__} is no law; it needs `solve(problem)` and `bounded`")
    if contacts and not getattr(law, "holds_contacts", False):
        raise ConfigError(f"contacts: {_name(name)} cannot hold them; use qp or hqp")


def _name(solver: Solver | str) -> str:
    if isinstance(solver, str):
        return f"solver {solver!r}"
    return f"solver {solver.config.name!r}" if hasattr(solver, "config") else f"the solver {type(solver).__name__}"
