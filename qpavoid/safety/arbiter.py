"""From a solver's answer to a command: limits, stop look-ahead, backup trajectories, progress.

A solver may be a user's own, and may be wrong. Its velocity is commanded as far as it is finite, of the right shape,
within the limits, clear of contact along its control period and the stop after it, and leaves a backup trajectory where
obstacles move.
"""

from __future__ import annotations

import numpy as np

from qpavoid.budget import BudgetSpent
from qpavoid.control.assembler import RowAssembler
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.settings import ControlSettings
from qpavoid.errors import NumericalError
from qpavoid.kernels import TOLERANCE
from qpavoid.model.limits import saturate
from qpavoid.problem import Array, Problem, Proximity, Solution, Status, is_finite_and_bounded
from qpavoid.reason import Reason, ReasonKind, Severity
from qpavoid.safety.backup import BackupPlanner
from qpavoid.safety.braking import BrakingCheck
from qpavoid.safety.progress import ProgressMonitor
from qpavoid.safety.recovery import recovery_limits, slow_recovery, slowed
from qpavoid.safety.shake_damping import ShakeDamping
from qpavoid.solvers import Solver

_LIMIT_TOLERANCE = 2e-6
"""Excess over acceleration or jerk limits that is not reported [rad/s, m/s]: the tolerance of the QP."""


class Arbiter:
    """Solves the problem of a control step, and decides what is commanded."""

    def __init__(
        self, settings: ControlSettings, solver: Solver, rows: RowAssembler, obstacles: ObstacleTracker
    ) -> None:
        """Build the checks, each with memory of its own."""
        self.settings = settings
        self.solver, self._rows, self._obstacles = solver, rows, obstacles
        self._reports_limits = rows.previous.needs_report
        self._v_shape = (settings.scene.robot.model.nv,)
        self.braking = BrakingCheck(settings, rows, obstacles)
        self.progress, self._shake_damping = ProgressMonitor(settings, rows), ShakeDamping(settings.dt)
        has_backup = settings.avoidance.backup and len(settings.scene.slots) > 0
        self.backup = BackupPlanner(settings, rows, obstacles) if has_backup else None

    def reset(self) -> None:
        """Drop all that is known of earlier control steps."""
        self.progress.reset()
        self._shake_damping.reset()
        if self.backup is not None:
            self.backup.reset()

    def warm_up(self, q: Array) -> None:
        """Run all checks once at q (nq,), where a control step has been."""
        self.braking.warm_up(q)
        self.progress.warm_up()

    @property
    def backup_velocities(self) -> Array:
        """Return the velocities (k, nv) of the control steps of the backup trajectory; none without one."""
        return np.zeros((0, *self._v_shape)) if self.backup is None else self.backup.velocities

    def accepts(self, t: float) -> bool:
        """Count a settled step of the tasks at t [s] if it is commanded as it is, else change nothing; see `decide`."""
        backup = self.backup
        if not (self._is_calm and self.progress.is_quiet):
            return False
        if backup is not None and not backup.allows(self._rows.v, t):
            return False
        self.progress.count(1)
        return True

    def decide(self, q: Array, t: float, is_settled: bool, from_tasks: bool) -> Solution:
        """Return the solution that is commanded.

        Args:
            q: configuration (nq,).
            t: time [s].
            is_settled: whether it is the velocity that the rows have come to, see `RowAssembler.compute`.
            from_tasks: whether the step is of the tasks, whose progress is monitored; else of a given velocity.
        """
        rows, problem, damping = self._rows, None, self._shake_damping
        if is_settled and damping.factor == 1.0:
            solution = Solution.solved(rows.v.copy())
        else:
            problem = rows.problem()
            if from_tasks:
                problem = damping.apply(problem)
                if problem.levels and self.solver.prioritised:
                    problem = rows.prioritised(problem)
            if self.settings.budget.is_limited:
                problem = problem._replace(budget=self.settings.budget)
            try:
                solution = self._solve(q, problem, rows.proximity(), from_tasks)
            except BudgetSpent as error:
                solution = _stop(problem, (Reason.of(ReasonKind.BUDGET_SPENT, str(error)),))
        if from_tasks:
            solution = self.monitor(problem, solution)
        backup = self.backup
        if backup is not None and self.solver.bounded and (backup.is_active or len(self._obstacles.moving)):
            solution = self._ensure_backup(backup, q, t, solution)
        return self._report_limits(solution) if self._reports_limits else solution

    @property
    def is_plain_ahead(self) -> bool:
        """Whether settled steps of the tasks will be commanded as they are while no obstacle comes near."""
        return self._is_calm and not self.progress.is_stalled and (self.backup is None or self.backup.is_idle)

    @property
    def _is_calm(self) -> bool:
        """Whether nothing but obstacles and progress can change or comment on a settled velocity."""
        damping = self._shake_damping
        return not self._reports_limits and damping.factor == 1.0 and damping.is_idle

    def monitor(self, problem: Problem | None, solution: Solution) -> Solution:
        """Take in what is commanded in a step of the tasks; return the solution with why they are stalled, if they are.

        Args:
            problem: of the tasks; None for that of the last step.
            solution: what is commanded.
        """
        damping, stalled = self._shake_damping, self.progress.update(problem, solution)
        if stalled or not damping.is_idle:
            damping.update(solution.v, self._rows.proximity().feedforward, bool(stalled))
        return solution._replace(stalled=stalled) if stalled else solution

    def stop(self, reasons: tuple[Reason, ...]) -> Solution:
        """Return the stop of this control step, with its reasons."""
        solution = _stop(self._rows.problem(), reasons)
        return self._report_limits(solution) if self._reports_limits else solution

    def _solve(self, q: Array, problem: Problem, proximity: Proximity, from_tasks: bool) -> Solution:
        """Return the solution within the limits, after the stop look-ahead."""
        try:
            if from_tasks and problem.jerk_limited and problem.cascade is None:
                problem = self._rows.within_jerks(problem)
            dynamics = self._rows.dynamics
            solution = self.solver.solve(problem) if dynamics is None else dynamics.solve(self.solver, problem)
            v = solution.v
            usable = (
                v.dtype == np.float64
                and v.shape == self._v_shape
                and is_finite_and_bounded(v)
                and _well_formed(problem, solution)
            )
        except BudgetSpent:
            raise
        except Exception as error:  # a user's solver may raise anything; the robot must get a velocity
            raised = Reason.of(ReasonKind.SOLVER_FAILED, detail=f"it raised {type(error).__name__}: {error}")
            return _stop(problem, (raised,))
        if not usable:
            detail = "no finite velocity of the right shape, or no status, reasons or slack of the right kind"
            failed = Reason.of(ReasonKind.SOLVER_FAILED, detail=detail)
            given = solution.reasons if _well_formed(problem, solution) else ()
            return _stop(problem, (*given, failed))
        if not self.solver.bounded:
            if self._rows.dynamics is not None:
                v = self._rows.dynamics.approach(v, self._rows.previous.v)
                solution = solution._replace(v=v)
            if not self.settings.limits.saturate:
                return solution
            v, change = saturate(v, problem.lower, problem.upper, self.settings.bounds.velocity)
            return solution._replace(v=v, saturation=change)
        is_own = problem.violation <= 0.0 and v.tobytes() == problem.v_tracking.tobytes()
        if is_own and problem.tracking_is_clear:
            return solution
        solution = solution if is_own else _clipped(problem, solution)
        limits = None if solution.status is Status.STOPPED else self._recovery_limits(problem, proximity)
        if limits is not None:
            solution = slow_recovery(q, problem, solution, None if is_own else limits, self.settings.bounds)
        return self._check_braking(q, problem, solution, limits) if self.settings.avoidance.look_ahead else solution

    def _recovery_limits(self, problem: Problem, proximity: Proximity) -> tuple[Array, Array] | None:
        """Return the bounds on a velocity in recovery, see `recovery_limits`."""
        x = self.settings
        return recovery_limits(problem, proximity.feedforward, x.bounds, self._rows.previous.v, x.dt)

    def _check_braking(
        self, q: Array, problem: Problem, solution: Solution, limits: tuple[Array, Array] | None
    ) -> Solution:
        """Scale the velocity towards the stop, where its path leads too near, or another one within recovery limits."""

        def low_effort(problem: Problem, slack: Array | None) -> Array | None:
            v = self.solver.low_effort(problem, slack)
            return v if v is None or limits is None else slowed(v, problem.v_stop, limits)[0]

        result = self.braking.check(q, solution, problem, low_effort)
        if result is None:
            return solution
        v, scale, violation, pair, distance = result
        if violation <= TOLERANCE:
            return solution._replace(v=v, command_scale=scale * solution.command_scale)
        names = self.settings.scene.pair_names[pair]
        if violation != violation:  # NaN
            return _stop(problem, (*solution.reasons, Reason.of(ReasonKind.UNKNOWN_DISTANCE, *names)))
        severity = Severity.ALARM if distance < 0.0 else Severity.WARNING
        reason = Reason.of(ReasonKind.PREDICTED_TOO_NEAR, *names, amount=violation, unit="m", severity=severity)
        return solution._replace(v=v, command_scale=scale * solution.command_scale).with_reasons(reason)

    def _ensure_backup(self, backup: BackupPlanner, q: Array, t: float, solution: Solution) -> Solution:
        """Replace the velocity by that of the backup trajectory, where none would be left after it."""
        rows = self._rows
        if rows.dynamics is not None:
            backup.brake_with(self.settings.bounds.acceleration)
        try:
            v = backup.check(q, solution.v, t, rows.previous.v, rows.previous.dv, rows.proximity)
        except NumericalError as error:  # of a predicted state; raised by `step` once it is the present one
            why = f"prediction of an {error}"
            return solution.with_reasons(Reason.of(ReasonKind.NO_BACKUP, severity=Severity.WARNING, detail=why))
        if v is None and backup.is_cut:
            return _stop(rows.problem(), (*solution.reasons, Reason.of(ReasonKind.BUDGET_SPENT, "backup search")))
        if v is None:
            return solution
        problem = rows.problem()
        if (limits := self._recovery_limits(problem, rows.proximity())) is not None:
            v, _ = slowed(v, problem.v_stop, limits)
        return solution._replace(v=np.clip(v, problem.lower, problem.upper)).with_reasons(Reason.of(ReasonKind.BACKUP))

    def _report_limits(self, solution: Solution) -> Solution:
        """Name the accelerations and jerks beyond their limits, where bounds had to allow them.

        They do after a relaxed control step, before a position or velocity limit, and to hold contacts.
        """
        if not self.solver.bounded:
            return solution
        names, units = self._rows.joint_names, self._rows.joint_units
        kinds = (ReasonKind.ACCELERATION_RELAXED, ReasonKind.JERK_RELAXED)
        named = {reason.subject for reason in solution.reasons if reason.kind in kinds}
        excesses = [
            Reason.of(kind, names[j], amount=float(excess[j]), unit=f"{units[j]}/s")
            for kind, excess in zip(kinds, self._rows.previous.excess(solution.v), strict=True)
            for j in np.flatnonzero(excess > _LIMIT_TOLERANCE).tolist()
            if (names[j],) not in named
        ]
        return solution.with_reasons(*excesses) if excesses else solution


def _limits_torques(problem: Problem) -> bool:
    return problem.dynamics is not None and problem.dynamics.torque_rows > 0


def _clipped(problem: Problem, solution: Solution) -> Solution:
    """Clip the velocity of a `bounded` solver to the bounds that it has to keep, in case it does not."""
    is_solved, v = solution.status is Status.SOLVED and not _limits_torques(problem), solution.v
    lower, upper = (problem.lower, problem.upper) if is_solved else (problem.hard_lower, problem.hard_upper)
    within = np.minimum(np.maximum(v, lower), upper)
    if within.tobytes() == v.tobytes():
        return solution
    return solution._replace(v=within, saturation=float(np.abs(within - v).max()))


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
