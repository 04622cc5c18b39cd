"""From a solver's answer to a command: limits, stop look-ahead, backup trajectories, progress.

A solver may be a user's own, and may be wrong. Its velocity is commanded as far as it is finite, of the right shape,
within the limits, clear of contact along its control period and the stop after it, and leaves a backup trajectory where
obstacles move.
"""

from __future__ import annotations

import numpy as np

from qpavoid.config import Avoidance, Limits, Progress
from qpavoid.control.assembler import Assembly
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.errors import NumericalError
from qpavoid.kernels import TOLERANCE
from qpavoid.model.limits import JointBounds, saturate
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, Problem, Proximity, Solution, Status, is_finite_and_bounded
from qpavoid.reason import Reason, ReasonKind, Severity
from qpavoid.safety.backup import BackupPlanner
from qpavoid.safety.braking import BrakingCheck
from qpavoid.safety.progress import ProgressMonitor
from qpavoid.safety.rollout import BackupRollouts
from qpavoid.solvers import Solver
from qpavoid.solvers.hqp import Hqp
from qpavoid.solvers.qp import Qp

_LIMIT_TOLERANCE = 2e-6
"""Excess over acceleration or jerk limits that is not reported [rad/s, m/s]: the tolerance of the QP."""


class Arbiter:
    """Solves the problem of a control step, and decides what is commanded."""

    def __init__(
        self,
        scene: Scene,
        solver: Solver,
        assembly: Assembly,
        query: DistanceQuery,
        obstacles: ObstacleTracker,
        bounds: JointBounds,
        avoidance: Avoidance,
        limits: Limits,
        progress: Progress,
        dt: float,
    ) -> None:
        """Build the checks, each with memory of its own.

        Args:
            scene: robot and obstacles.
            solver: the control law.
            assembly: of the problems.
            query: distances of the control step.
            obstacles: states of the obstacles.
            bounds: limits of the joints.
            avoidance: distances and rows.
            limits: use of the joint limits.
            progress: when a task counts as stalled.
            dt: control period [s].
        """
        self._scene, self.solver, self._assembly, self._query = scene, solver, assembly, query
        self._bounds, self._avoidance, self._limits = bounds, avoidance, limits
        self._v_shape = (scene.robot.model.nv,)
        self._influence_distance = avoidance.d2 - avoidance.offset
        safety_distance = avoidance.safety_distance - avoidance.offset
        self.braking = BrakingCheck(scene, bounds, limits.position_gain, safety_distance, dt)
        self.progress = ProgressMonitor(progress, dt, scene.pair_names)
        self.backup: BackupPlanner | None = None
        if avoidance.backup is not None and scene.obstacles:
            rollouts = BackupRollouts(scene, bounds, obstacles, avoidance, limits, dt, avoidance.backup)
            self.backup = BackupPlanner(rollouts, scene, bounds, obstacles, dt)

    @property
    def queries(self) -> tuple[DistanceQuery, ...]:
        """Distances of predicted states, which need to be given attached objects and points."""
        return (self.braking.query, *([self.backup.rollouts.query] if self.backup else []))

    def invalidate(self) -> None:
        """Take in that attached objects, or the disabled pairs, have changed."""
        if self.backup is not None:
            self.backup.invalidate()

    def reset(self) -> None:
        """Drop all that is known of earlier control steps."""
        self.progress.reset()
        if self.backup is not None:
            self.backup.reset()

    def decide(self, q: Array, t: float, problem: Problem, proximity: Proximity, tasks: bool) -> Solution:
        """Return the solution that is commanded.

        Args:
            q: configuration (nq,).
            t: time [s].
            problem: of this control step.
            proximity: distances of this control step.
            tasks: whether the problem is of the tasks, whose progress is monitored; else it is of a given velocity.
        """
        solution = self._solve(q, problem, tasks)
        if tasks and (stalled := self.progress.update(problem, solution)):
            solution = solution._replace(stalled=stalled)
        if self.backup is not None and self.solver.bounded:
            solution = self._ensure_backup(self.backup, q, t, proximity, problem, solution)
        return self._report_limits(problem, solution)

    def stop(self, problem: Problem, reasons: tuple[Reason, ...]) -> Solution:
        """Return the stop of this control step, with its reasons."""
        return self._report_limits(problem, _stop(problem, reasons))

    def _solve(self, q: Array, problem: Problem, from_tasks: bool) -> Solution:
        """Return the solution within the limits, after the stop look-ahead."""
        try:
            if from_tasks:
                if problem.levels and isinstance(self.solver, Hqp):  # v_tracking is not a cascade's
                    problem = self._assembly.prioritised(problem, self.solver.tracked)
                elif problem.jerk_limited:
                    problem = self._assembly.eased(problem)
            solution = self.solver.solve(problem)
            v = solution.v
            usable = (
                v.dtype == np.float64
                and v.shape == self._v_shape
                and is_finite_and_bounded(v)
                and _well_formed(problem, solution)
            )
        except Exception as error:  # a user's solver may raise anything; the robot must get a velocity
            raised = Reason.of(ReasonKind.SOLVER_FAILED, detail=f"it raised {type(error).__name__}: {error}")
            return _stop(problem, (raised,))
        if not usable:
            detail = "no finite velocity of the right shape, or no status, reasons or slack of the right kind"
            failed = Reason.of(ReasonKind.SOLVER_FAILED, detail=detail)
            given = solution.reasons if _well_formed(problem, solution) else ()
            return _stop(problem, (*given, failed))
        if not self.solver.bounded:
            if self._limits.saturate:
                v, change = saturate(v, problem.lower, problem.upper, self._bounds.velocity)
                return solution._replace(v=v, saturation=change)
            return solution
        if not isinstance(self.solver, Qp):
            met = solution.status is Status.SOLVED
            limits = (problem.lower, problem.upper) if met else (problem.hard_lower, problem.hard_upper)
            v = np.clip(v, *limits)
            solution = solution._replace(v=v, saturation=float(np.max(np.abs(v - solution.v), initial=0.0)))
        if self._avoidance.look_ahead:
            return self._check_braking(q, problem, solution)
        return solution

    def _check_braking(self, q: Array, problem: Problem, solution: Solution) -> Solution:
        """Scale the velocity towards the stop, where its path leads too near."""

        def low_effort() -> Array | None:
            return self.solver.low_effort(problem, solution.slack) if isinstance(self.solver, Qp) else None

        result = self.braking.check(
            q, solution, problem, low_effort, self._assembly, self._query, self._influence_distance
        )
        if result is None:
            return solution
        v, scale, violation, pair, distance = result
        if violation <= TOLERANCE:
            return solution._replace(v=v, command_scale=scale)
        names = self._scene.pair_names[pair]
        if violation != violation:  # NaN
            return _stop(problem, (*solution.reasons, Reason.of(ReasonKind.UNKNOWN_DISTANCE, *names)))
        severity = Severity.ALARM if distance < 0.0 else Severity.WARNING
        reason = Reason.of(ReasonKind.PREDICTED_TOO_NEAR, *names, amount=violation, unit="m", severity=severity)
        return solution._replace(v=v, command_scale=scale).with_reasons(reason)

    def _ensure_backup(
        self, backup: BackupPlanner, q: Array, t: float, proximity: Proximity, problem: Problem, solution: Solution
    ) -> Solution:
        """Replace the velocity by that of the backup trajectory, where none would be left after it."""
        try:
            v = backup.check(q, solution.v, t, self._assembly.v_prev, self._assembly.dv_prev, proximity)
        except NumericalError as error:  # of a predicted state; raised by `step` once it is the present one
            why = f"prediction of an {error}"
            return solution.with_reasons(Reason.of(ReasonKind.NO_BACKUP, severity=Severity.WARNING, detail=why))
        if v is None:
            return solution
        return solution._replace(v=np.clip(v, problem.lower, problem.upper)).with_reasons(Reason.of(ReasonKind.BACKUP))

    def _report_limits(self, problem: Problem, solution: Solution) -> Solution:
        """Name the accelerations and jerks beyond their limits, where bounds had to allow them.

        They do after a relaxed control step, before a position or velocity limit, and to hold contacts.
        """
        if not (self._assembly.limits_may_give_way and self.solver.bounded):
            return solution
        kinds = (ReasonKind.ACCELERATION_RELAXED, ReasonKind.JERK_RELAXED)
        named = {reason.subject for reason in solution.reasons if reason.kind in kinds}
        excesses = [
            Reason.of(kind, problem.joint_names[j], amount=float(excess[j]), unit=f"{problem.joint_units[j]}/s")
            for kind, excess in zip(kinds, self._assembly.beyond_limits(solution.v), strict=True)
            for j in np.flatnonzero(excess > _LIMIT_TOLERANCE).tolist()
            if (problem.joint_names[j],) not in named
        ]
        return solution.with_reasons(*excesses) if excesses else solution


def _well_formed(problem: Problem, solution: Solution) -> bool:
    """Return whether all fields but the velocity of a solver's answer are of the right kind."""
    slack, k = solution.slack, len(problem.avoidance.d)
    if type(solution) is Solution and solution.status is Status.SOLVED and solution.reasons == () and slack is None:
        return True
    return (
        isinstance(solution, Solution)
        and isinstance(solution.status, Status)
        and isinstance(solution.reasons, tuple)
        and (not solution.reasons or all(isinstance(reason, Reason) for reason in solution.reasons))
        and (slack is None or (getattr(slack, "shape", None) == (k,) and bool(np.isfinite(slack).all())))
    )


def _stop(problem: Problem, reasons: tuple[Reason, ...]) -> Solution:
    return Solution(problem.v_stop.copy(), Status.STOPPED, reasons)
