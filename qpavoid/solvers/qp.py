"""The QP of the two tasks: tracking as cost, avoidance rows as inequalities, joint limits as bounds."""

from __future__ import annotations

import numpy as np

from qpavoid import kernels
from qpavoid.config import HqpSolver, QpSolver
from qpavoid.problem import Array, Problem, Solution, Status
from qpavoid.reason import Reason, ReasonKind
from qpavoid.solvers.analytic import tracking_velocity
from qpavoid.solvers.backends import Backend, Daqp, make_backend, solve_daqp
from qpavoid.solvers.reasons import relaxation_reasons
from qpavoid.solvers.reduced import in_contact_null_space
from qpavoid.solvers.relaxation import Closest, Relaxed, by_back_end, closest, relax

_LOW_EFFORT = 1.0
"""λ of a solution of low effort [(m/rad)²]: joint speeds count as much as the tool's speed."""


class Qp:
    """min ‖A (v - v_t)‖² + λ ‖v - v_t‖²  s.t.  J v >= b,  lower <= v <= upper.

    v_t = J⁺ẋ is `v_tracking`, so the answer is the safe velocity closest to it, and v_t itself whenever that is safe.
    As A v_t = b wherever the task can be met, the first term is the tracking cost ‖A v - b‖²; that λ counts from v_t,
    not from 0, leaves tracking without bias.

    Where no velocity meets all constraints, margins are relaxed, then acceleration limits, then contact of pairs, as
    little as possible and the deepest pair least (`solvers.relaxation`): in compiled code with `native`, by daqp with
    every other back end. An answer counts only if it verifies: of a back end that fails or returns no solution, daqp
    solves the QP of that control step, and where that fails too, the solution is a stop.

    Contacts of the robot are met exactly: with v = v_particular + Z w, all of the above is solved for w
    (`solvers.reduced`), by daqp where the back end is `native`.
    """

    bounded = True
    holds_contacts = True

    def __init__(self, config: QpSolver | HqpSolver) -> None:
        self.config = config
        self._native = config.backend in ("auto", "native")
        self._backend = make_backend("daqp" if self._native else config.backend)
        if self._native:
            _warm_up()

    @property
    def _backends(self) -> tuple[Backend, ...]:
        """Return the chosen back end, then daqp where that is another one."""
        return (self._backend,) if isinstance(self._backend, Daqp) else (self._backend, solve_daqp)

    def solve(self, problem: Problem) -> Solution:
        """Return the closest safe velocity; relaxed where there is none; a stop where that fails too."""
        if problem.violation <= 0.0:
            return Solution(problem.v_tracking.copy())
        A, rows, lower, upper, v_tracking = (
            problem.tracking.A,
            problem.avoidance,
            problem.lower,
            problem.upper,
            problem.v_tracking,
        )
        if v_tracking[0] != v_tracking[0]:
            v_tracking = tracking_velocity(problem)
            if problem.contacts is None and kernels.violation(v_tracking, rows.J, rows.b, lower, upper) <= 0.0:
                return Solution(v_tracking)
        if self._native and problem.contacts is None:
            answer, solved = kernels.project(A, self.config.regularization, v_tracking, rows.J, rows.b, lower, upper)
            if solved:
                return Solution(answer)
        P, q = kernels.projection_cost(A, self.config.regularization, v_tracking)
        for backend in self._backends:
            v = closest(in_contact_null_space(problem.contacts, backend), P, q, rows.J, rows.b, lower, upper)
            if v is not None:
                return Solution(v)
        relaxed = self._relax(P, q, problem)
        return relaxed if isinstance(relaxed, Solution) else relaxed_solution(relaxed, problem)

    def low_effort(self, problem: Problem, slack: Array | None) -> Array | None:
        """Compute a solution with the same slacks and bounds that weighs joint speeds as much as the task's.

        The usual one may move joints through the null space of the task at full speed for a few mm/s of a row; rows do
        not contain how distances then curve within a control step.

        Args:
            problem: rows and bounds.
            slack: violation of the rows (k,) [m/s]; None where there is none.

        Returns:
            (nv,), or None without a solution.
        """
        rows = problem.avoidance
        b = rows.b if slack is None else rows.b - slack
        P, q = kernels.projection_cost(problem.tracking.A, _LOW_EFFORT, tracking_velocity(problem))
        return closest(
            in_contact_null_space(problem.contacts, solve_daqp), P, q, rows.J, b, problem.lower, problem.upper
        )

    def _relax(self, P: Array, q: Array, problem: Problem) -> Relaxed | Solution:
        """Relax as little as possible; return a stop where no relaxed problem is solved, or a distance is NaN."""
        rows = problem.avoidance
        unknown = np.flatnonzero(~np.isfinite(rows.b + rows.J.sum(axis=1)))
        if len(unknown):
            pairs = [problem.pair_names[rows.pair[i]] for i in unknown.tolist()]
            reasons = tuple([Reason.of(ReasonKind.UNKNOWN_DISTANCE, *pair) for pair in pairs])
            return Solution(problem.v_stop.copy(), Status.STOPPED, reasons)
        relaxed = None
        if self._native and problem.contacts is None:
            relaxed = relax(problem, self._compiled(problem))
        backend = in_contact_null_space(problem.contacts, solve_daqp)
        if relaxed is None:
            relaxed = relax(problem, by_back_end(backend, P, q, tracking_velocity(problem)))
        if relaxed is not None:
            return relaxed
        reason = Reason.of(ReasonKind.SOLVER_FAILED, detail="the QP back end returned no usable velocity")
        hard = problem.hard_lower, problem.hard_upper
        if problem.contacts is not None and closest(backend, P, q, rows.J[:0], rows.b[:0], *hard) is None:
            reason = Reason.of(ReasonKind.CONTACTS_INFEASIBLE, "contacts")
        return Solution(problem.v_stop.copy(), Status.STOPPED, (reason,))

    def _compiled(self, problem: Problem) -> Closest:
        """Return a function that solves the QPs of a problem's tracking cost in compiled code."""
        A, v_tracking, plain = problem.tracking.A, tracking_velocity(problem), np.zeros((0, len(problem.lower)))

        def solve(J: Array, b: Array, soft: Array, lower: Array, upper: Array) -> Array | None:
            cost = (plain, 1.0) if soft.any() else (A, self.config.regularization)
            v, solved = kernels.project_soft(*cost, v_tracking, J, b, lower, upper, soft)
            return v if solved else None

        return solve


def relaxed_solution(relaxed: Relaxed, problem: Problem, *reasons: Reason) -> Solution:
    """Return the solution with its reasons.

    It is SOLVED where nothing is relaxed by more than the tolerance of a QP.

    Args:
        relaxed: the velocity, with its slacks.
        problem: the one that it solves.
        reasons: added to those of the relaxation.
    """
    reasons = (*relaxation_reasons(relaxed, problem), *reasons)
    if not reasons:
        return Solution(np.clip(relaxed.v, problem.lower, problem.upper))
    return Solution(relaxed.v, Status.RELAXED, reasons, relaxed.slack if relaxed.slack.any() else None)


def _warm_up() -> None:
    """Call the back end `native`: no control step waits for the compiler."""
    one, row = np.ones(1), np.ones((1, 1))
    arguments = row, 1.0, one, row, 2.0 * one, -3.0 * one, 3.0 * one
    kernels.project(*arguments)
    kernels.project_soft(*arguments, one)
