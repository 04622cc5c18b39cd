"""The QP of the two tasks: tracking as cost, avoidance rows as inequalities, joint limits as bounds."""

from __future__ import annotations

import numpy as np

from qpavoid import kernels
from qpavoid.config import HqpSolver, QpSolver
from qpavoid.problem import Array, Problem, Solution, Status
from qpavoid.reason import Reason, ReasonKind
from qpavoid.solvers.backends import TOLERANCE, make_backend, solve_daqp, verified, within
from qpavoid.solvers.relaxation import project, relax, relaxed_solution
from qpavoid.solvers.solver import NamedSolver

_LOW_EFFORT = 1.0
"""λ of a solution of low effort [(m/rad)²]: joint speeds count as much as the tool's speed."""


class Qp(NamedSolver):
    """min ‖A (v - v_t)‖² + λ ‖v - v_t‖²  s.t.  J v >= b,  lower <= v <= upper.

    v_t = J⁺ẋ is `v_tracking`, so the answer is the safe velocity closest to it, and v_t itself whenever that is safe.
    As A v_t = b wherever the task can be met, the first term is the tracking cost ‖A v - b‖²; that λ counts from v_t,
    not from 0, leaves tracking without bias. λ is `regularization`, or what the task rows bend within a control step,
    `Problem.bent`, where that is more: the cost does not contain the curvature of the tasks, and where rows keep the
    robot from a target that is far, a flat optimum of it would jump from vertex to vertex. `safety.shake_damping` makes
    it more while a stalled robot shakes.

    Where no velocity meets all constraints, margins are relaxed, then acceleration limits, then contact of pairs, as
    little as possible and the deepest pair least (`solvers.relaxation`). An answer of a back end counts only if it
    verifies: else daqp solves the QP of that control step, and where nothing helps, the solution is a stop.

    Contacts of the robot are met exactly: with v = v_particular + Z w, all of the above is solved for w, by daqp where
    the back end is `native`.
    """

    bounded = True
    holds_contacts = True

    def __init__(self, config: QpSolver | HqpSolver) -> None:
        super().__init__(config)
        self._native = config.backend in ("auto", "native")
        backend = make_backend("daqp" if self._native else config.backend)
        self._backends = (backend,) if self._native or config.backend == "daqp" else (backend, solve_daqp)
        if self._native:
            _warm_up()

    @property
    def compiled_regularization(self) -> float:  # type: ignore[override]
        """λ, unless the QP is left to a back end, or a class of this one has another `solve`."""
        return float(self.config.regularization) if self._native and type(self).solve is Qp.solve else 0.0

    def solve(self, problem: Problem) -> Solution:
        """Return the closest safe velocity; relaxed where there is none; a stop where that fails too."""
        if problem.violation <= 0.0:
            return Solution(problem.v_tracking.copy())
        A, (J, b), (lower, upper) = problem.tracking.A, problem.inequalities, self._bounds(problem)
        regularization, v_tracking, contacts = self._regularization(problem), problem.v_tracking, problem.contacts
        if self._native and contacts is None:
            v, solved = kernels.project(A, regularization, v_tracking, J, b, lower, upper)
            if solved:
                return Solution(v)
        P, q = kernels.projection_cost(A, regularization, v_tracking)
        for backend in self._backends:
            if contacts is not None:
                backend = within(backend, contacts.Z, contacts.v_particular)
            answer = verified(backend, P, q, J, b, lower, upper)
            if answer is not None:
                return Solution(answer)
        relaxed = self._relax(problem)
        return relaxed if isinstance(relaxed, Solution) else relaxed_solution(relaxed, problem)

    def _regularization(self, problem: Problem) -> float:
        """Return λ of this control step."""
        return max(float(self.config.regularization), problem.bent)

    def _bounds(self, problem: Problem) -> tuple[Array, Array]:
        """Return the bounds (nv,), (nv,); at the torque level, with accelerations passed as little as rows need."""
        lower, upper, hard = problem.lower, problem.upper, (problem.hard_lower, problem.hard_upper)
        if problem.dynamics is None or not problem.dynamics.torque_rows or problem.contacts is not None:
            return lower, upper
        A, regularization = problem.tracking.A, self._regularization(problem)
        rows = problem.inequalities
        v, solved = kernels.project_widened(A, regularization, problem.v_tracking, *rows, lower, upper, *hard)
        if not solved:
            return lower, upper
        lower, upper = np.minimum(lower, v - TOLERANCE), np.maximum(upper, v + TOLERANCE)
        return np.maximum(lower, hard[0]), np.minimum(upper, hard[1])

    def low_effort(self, problem: Problem, slack: Array | None) -> Array | None:
        """Compute a solution with the same slacks and bounds that weighs joint speeds as much as the task's.

        The usual one may move joints through the null space of the task at full speed for a few mm/s of a row; rows do
        not contain how distances then curve within a control step.
        """
        b = problem.avoidance.b if slack is None else problem.avoidance.b - slack
        return project(problem, problem.tracking.A, _LOW_EFFORT, problem.avoidance.J, b, problem.lower, problem.upper)

    def _relax(self, problem: Problem) -> Array | Solution:
        """Relax as little as possible; return a stop where no relaxed problem is solved, or a distance is NaN."""
        rows = problem.avoidance
        unknown = np.flatnonzero(~np.isfinite(rows.b + rows.J.sum(axis=1)))
        if len(unknown):
            pairs = [problem.pair_names[rows.pair[i]] for i in unknown.tolist()]
            reasons = tuple([Reason.of(ReasonKind.UNKNOWN_DISTANCE, *pair) for pair in pairs])
            return Solution(problem.v_stop.copy(), Status.STOPPED, reasons)
        v = relax(problem, self._regularization(problem))
        if v is not None:
            return v
        reason = Reason.of(ReasonKind.SOLVER_FAILED, detail="the QP back end returned no usable velocity")
        no_rows = rows.J[:0], rows.b[:0]
        hard = problem.hard_lower, problem.hard_upper
        if problem.contacts is not None and project(problem, problem.tracking.A, 1.0, *no_rows, *hard) is None:
            reason = Reason.of(ReasonKind.CONTACTS_INFEASIBLE, "contacts")
        return Solution(problem.v_stop.copy(), Status.STOPPED, (reason,))


def _warm_up() -> None:
    """Call the back end `native`: no control step waits for the compiler."""
    one, row = np.ones(1), np.ones((1, 1))
    arguments = row, 1.0, one, row, 2.0 * one, -3.0 * one, 3.0 * one
    kernels.project(*arguments)
    kernels.project_soft(*arguments, one)
