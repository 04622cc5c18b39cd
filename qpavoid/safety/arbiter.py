"""What is commanded: a solver's answer, brought within limits, looked ahead, and left only where a way out stays.

A law may be anyone's, and may be wrong. What it says counts as far as it is finite, of the right shape, within the
limits, clear of contact along its tick and the stop after it and, where obstacles move, not a trap.
"""

from __future__ import annotations

import numpy as np

from qpavoid.config import Avoidance, Limits, Progress
from qpavoid.control.assembler import Assembly
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.tasks.frames import FrameTask
from qpavoid.errors import NumericalError
from qpavoid.kernels import TOLERANCE
from qpavoid.model.limits import JointBounds, saturate
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, Problem, Proximity, Solution, Status, sane
from qpavoid.reason import Reason, ReasonKind, Severity
from qpavoid.safety.backup import BackupPlanner
from qpavoid.safety.braking import BrakingCheck
from qpavoid.safety.detour import Detours
from qpavoid.safety.progress import ProgressWatch
from qpavoid.safety.rollout import Flights
from qpavoid.solvers import Solver
from qpavoid.solvers.hqp import Hqp
from qpavoid.solvers.qp import Qp

_LIMIT_TOLERANCE = 2e-6
"""What a velocity may pass limits of acceleration or jerk by without a word: the tolerance of the QP [rad/s, m/s]."""


class Arbiter:
    """Has problems solved, and decides what is commanded."""

    def __init__(
        self,
        scene: Scene,
        solver: Solver,
        assembly: Assembly,
        query: DistanceQuery,
        obstacles: ObstacleTracker,
        bounds: JointBounds,
        frames: list[FrameTask],
        avoidance: Avoidance,
        limits: Limits,
        progress: Progress,
        dt: float,
    ) -> None:
        """Lays the memory out.

        Args:
            scene: robot and obstacles.
            solver: the law.
            assembly: of the tick's problems.
            query: the tick's distances.
            obstacles: what is known of the obstacles.
            bounds: limits of the joints.
            frames: tasks that may be sent a way round.
            avoidance: distances and rows.
            limits: use of the joint limits.
            progress: when a task counts as stalled, and whether a way round is tried.
            dt: control period [s].
        """
        self._scene, self.solver, self._assembly, self._query = scene, solver, assembly, query
        self._bounds, self._avoidance, self._limits = bounds, avoidance, limits
        self._v_shape = (scene.robot.model.nv,)
        self._reach, keep = avoidance.d2 - avoidance.offset, avoidance.hold - avoidance.offset
        self.guard = BrakingCheck(scene, bounds, limits.position_gain, keep, dt)
        detours = Detours(progress.detour, dt, scene, frames, query, keep) if progress.detour else None
        self.progress = ProgressWatch(progress, dt, scene.pair_names, detours)
        self.backup: BackupPlanner | None = None
        if avoidance.backup is not None and scene.obstacles:
            flights = Flights(scene, bounds, obstacles, avoidance, limits, dt, avoidance.backup)
            self.backup = BackupPlanner(flights, scene, bounds, obstacles, dt)

    @property
    def queries(self) -> tuple[DistanceQuery, ...]:
        """Distances ahead, which have to know who carries what, and what points are seen."""
        return (self.guard.ahead, *([self.backup.flights.query] if self.backup else []))

    def invalidate(self) -> None:
        """What the robot carries, or what may touch, has changed."""
        if self.backup is not None:
            self.backup.invalidate()

    def reset(self) -> None:
        """Forgets the ticks before."""
        self.progress.reset()
        if self.backup is not None:
            self.backup.reset()

    def decide(self, q: Array, t: float, problem: Problem, proximity: Proximity, tasks: bool) -> Solution:
        """The velocity that is commanded.

        Args:
            q: configuration (nq,).
            t: now [s].
            problem: of this tick.
            proximity: distances of this tick.
            tasks: whether the problem is of the tasks, whose progress is watched; else it is of a command.
        """
        if tasks:
            solution = self._solve(q, problem, proximity)
            stalled = self.progress.update(problem, solution)
            solution = solution._replace(stalled=stalled) if stalled else solution
        else:
            solution = self._solve(q, problem)
        if self.backup is not None and self.solver.bounded:
            solution = self._with_a_way_out(self.backup, q, t, proximity, problem, solution)
        return self._with_limits_passed(problem, solution)

    def stop(self, problem: Problem, reasons: tuple[Reason, ...]) -> Solution:
        """The stop of this tick, and why."""
        return self._with_limits_passed(problem, _stop(problem, reasons))

    def _solve(self, q: Array, problem: Problem, proximity: Proximity | None = None) -> Solution:
        """What the solver says, within the limits and looked ahead; with a proximity, ways round may be tried."""
        try:
            if proximity is not None:
                problem = self.progress.redirect(problem, proximity, self._assembly, self.solver)
                if problem.levels and isinstance(self.solver, Hqp):  # v0 is not a cascade's
                    problem = self._assembly.prioritised(problem, self.solver.tracked)
                elif problem.jerked:
                    problem = self._assembly.eased(problem)
            solution = self.solver.solve(problem)
            v = solution.v
            usable = v.dtype == np.float64 and v.shape == self._v_shape and sane(v) and _well_formed(problem, solution)
        except Exception as error:  # a law of the user's own may raise anything; the robot must get a velocity
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
            return self._looked_ahead(q, problem, solution)
        return solution

    def _looked_ahead(self, q: Array, problem: Problem, solution: Solution) -> Solution:
        def low_effort() -> Array | None:
            return self.solver.low_effort(problem, solution.slack) if isinstance(self.solver, Qp) else None

        checked = self.guard.check(q, solution, problem, low_effort, self._assembly, self._query, self._reach)
        if checked is None:
            return solution
        v, share, short, pair, distance = checked
        if short <= TOLERANCE:
            return solution._replace(v=v, share=share)
        names = self._scene.pair_names[pair]
        if short != short:
            return _stop(problem, (*solution.reasons, Reason.of(ReasonKind.UNKNOWN_DISTANCE, *names)))
        severity = Severity.ALARM if distance < 0.0 else Severity.WARNING
        missing = Reason.of(ReasonKind.PREDICTED_TOO_NEAR, *names, amount=short, unit="m", severity=severity)
        return solution._replace(v=v, share=share).relaxed(missing)

    def _with_a_way_out(
        self, backup: BackupPlanner, q: Array, t: float, proximity: Proximity, problem: Problem, solution: Solution
    ) -> Solution:
        try:
            v = backup.check(q, solution.v, t, self._assembly.v_prev, self._assembly.dv_prev, proximity)
        except NumericalError as error:  # of what is to come; it is raised when it has come
            why = f"prediction of an {error}"
            return solution.relaxed(Reason.of(ReasonKind.NO_BACKUP, severity=Severity.WARNING, detail=why))
        if v is None:
            return solution
        return solution._replace(v=np.clip(v, problem.lower, problem.upper)).relaxed(Reason.of(ReasonKind.BACKUP))

    def _with_limits_passed(self, problem: Problem, solution: Solution) -> Solution:
        """Says which accelerations and jerks pass their limits, where bounds had to: to get back from where a relaxed
        tick has led to, before a position or velocity limit, or to hold contacts.
        """
        if not (self._assembly.limits_may_give_way and self.solver.bounded):
            return solution
        kinds = (ReasonKind.ACCELERATION_RELAXED, ReasonKind.JERK_RELAXED)
        named = {reason.subject for reason in solution.reasons if reason.kind in kinds}
        passed = [
            Reason.of(kind, problem.joint_names[j], amount=float(excess[j]), unit=f"{problem.joint_units[j]}/s")
            for kind, excess in zip(kinds, self._assembly.beyond_limits(solution.v), strict=True)
            for j in np.flatnonzero(excess > _LIMIT_TOLERANCE).tolist()
            if (problem.joint_names[j],) not in named
        ]
        return solution.relaxed(*passed) if passed else solution


def _well_formed(problem: Problem, solution: Solution) -> bool:
    """Return whether all but the velocity of a law's answer is of the right kind."""
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
