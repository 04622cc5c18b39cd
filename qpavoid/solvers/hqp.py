"""Strict priorities: what comes first is done as well as it can be, what comes later with what is left.

Inequalities come before all tasks and hold at every level (Kanoun, Lamiraux and Wieber 2011, "Kinematic control of
redundant manipulators: generalizing the task-priority framework to inequality tasks"); each level is solved in a basis
of what the levels before it leave free (Escande, Mansard and Wieber 2014, "Hierarchical quadratic programming: fast
online humanoid-robot motion generation").
"""

from __future__ import annotations

import numpy as np

from qpavoid import kernels
from qpavoid.problem import Array, IntArray, Problem, Solution
from qpavoid.reason import Reason, ReasonKind
from qpavoid.solvers.backends import Backend
from qpavoid.solvers.qp import Qp, relaxed_solution
from qpavoid.solvers.reduced import solve_within
from qpavoid.solvers.relaxation import closest

Levels = list[tuple[Array, Array]]
"""Rows A (r, nv) and right-hand sides b (r,) of each priority, the first one first."""
_FREE = 1e-8
"""Share of a level's largest singular value below which it leaves a direction free [-]."""


class Hqp(Qp):
    """For each priority p in turn, among the velocities that are best for all before it:

        min ‖A_p v - b_p‖² + λ ‖v - v̂‖²  s.t.  J v >= b,  lower <= v <= upper.

    v̂ is the same cascade without the inequalities, v̂ += Z (A_p Z)⁺ (b_p - A_p v̂) with Z a basis of what is free
    (Siciliano and Slotine 1991), each inverse damped as J⁺ is: the answer wherever it is safe. What is free after the
    last level stays as near to v̂ as it can. Contacts are held by the basis of the first level.

    Where no velocity meets the inequalities, they give way as those of `qp` do, and the cascade goes on within what is
    left of them. A level whose QP the back end and daqp fail to solve is left as the ones before it have it, and named.
    """

    def solve(self, problem: Problem) -> Solution:
        """The lexicographically best safe velocity; relaxed where there is none; a stop where that fails too."""
        if problem.violation <= 0.0 and not problem.levels:
            return Solution(problem.v_tracking.copy())
        levels = problem.levels or (np.arange(len(problem.tracking.b)),)
        rows, lower, upper = problem.avoidance, problem.lower, problem.upper
        alone, asked = _cascade(problem, levels)
        if kernels.violation(alone, rows.J, rows.b, lower, upper) <= 0.0:
            return Solution(alone)
        if not np.isfinite(alone).all():
            alone = np.zeros_like(alone)
        v, unsolved = self._levels(problem, asked, alone, rows.b, lower, upper)
        if v is not None:
            return Solution(v).with_reasons(*unsolved) if unsolved else Solution(v)
        P, q = kernels.projection_cost(problem.tracking.A, 1e-3, alone)
        relaxed = self._relax(P, q, problem)
        if isinstance(relaxed, Solution):
            return relaxed
        lower, upper = np.minimum(lower, relaxed.v), np.maximum(upper, relaxed.v)
        v, unsolved = self._levels(problem, asked, alone, rows.b - relaxed.slack, lower, upper)
        relaxed = relaxed if v is None else relaxed._replace(v=v)
        return relaxed_solution(relaxed, problem, *unsolved)

    def tracked(self, problem: Problem) -> Array:
        """The velocity (nv,) of the cascade without inequalities, v̂."""
        return _cascade(problem, problem.levels or (np.arange(len(problem.tracking.b)),))[0]

    def _levels(
        self, problem: Problem, asked: Levels, alone: Array, least: Array, lower: Array, upper: Array
    ) -> tuple[Array | None, tuple[Reason, ...]]:
        """The cascade within J v >= least and the bounds (nv,), and which levels could not be solved.

        None where its first level has no solution.
        """
        J, (Z, v) = problem.avoidance.J, _start(problem)
        met, unsolved = False, list[Reason]()
        for level, (A, b) in enumerate((*asked, (np.eye(len(v)), alone))):
            P = A.T @ A
            P.ravel()[:: len(P) + 1] += self.config.regularization
            q = -(A.T @ b + self.config.regularization * alone)
            # once the inequalities are met, staying is a solution, whatever round-off says
            better = self._solve(Z, v, P, q, J, least, lower, upper, met)
            if better is not None:
                v, met = better, True
            elif not met:
                return None, ()
            elif level < len(asked):
                unsolved.append(Reason.of(ReasonKind.PRIORITY_UNSOLVED, f"priority level {level + 1}"))
            Z = Z @ _free(A @ Z)
            if not Z.shape[1]:
                break
        return np.clip(v, lower, upper), tuple(unsolved)

    def _solve(
        self, Z: Array, v: Array, P: Array, q: Array, J: Array, least: Array, lower: Array, upper: Array, met: bool
    ) -> Array | None:
        if met:
            least, lower, upper = np.minimum(least, J @ v), np.minimum(lower, v), np.maximum(upper, v)
        for backend in self._backends:
            better = _attempt(backend, Z, v, P, q, J, least, lower, upper)
            if better is not None:
                return better
        return None


def _attempt(
    backend: Backend, Z: Array, v: Array, P: Array, q: Array, J: Array, least: Array, lower: Array, upper: Array
) -> Array | None:
    def within(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
        return solve_within(backend, Z, v, P, q, G, h, lower, upper)

    return closest(within, P, q, J, least, lower, upper)


def _start(problem: Problem) -> tuple[Array, Array]:
    """Basis (nv, n) of what contacts leave free, and a velocity (nv,) that holds them."""
    contacts, nv = problem.contacts, len(problem.lower)
    return (np.eye(nv), np.zeros(nv)) if contacts is None else (contacts.Z, contacts.v_particular)


def _cascade(problem: Problem, levels: tuple[IntArray, ...]) -> tuple[Array, Levels]:
    """The velocity (nv,) of the tasks alone, NaN where a row holds one, and the levels of which it is the best.

    These ask for what damping leaves of the tasks, so that where an inequality begins to bind, nothing jumps.
    """
    tracking = problem.tracking
    asked = [(tracking.A[rows], tracking.b[rows]) for rows in levels]
    Z, v = _start(problem)
    for level, (A, b) in enumerate(asked):
        reduced, missing = A @ Z, b - A @ v
        if not (np.isfinite(reduced).all() and np.isfinite(missing).all()):
            return np.full_like(v, np.nan), asked[:level]
        U, s, V = np.linalg.svd(reduced, full_matrices=True)
        used = s > _FREE * max(float(s[0]), 1e-12)
        s, count = s[used], int(used.sum())
        within = U[:, :count].T @ missing
        step = s / (s**2 + tracking.damping**2) * within
        v = v + Z @ (V[:count].T @ step)
        asked[level] = (A, b - U[:, :count] @ (within - s * step))
        Z = Z @ V[count:].T
        if not Z.shape[1]:
            break
    return v, asked


def _free(A: Array) -> Array:
    """Orthonormal basis (n, k) of what the rows A (r, n) leave free."""
    _, s, V = np.linalg.svd(A)
    return np.asarray(V[int((s > _FREE * max(float(s[0]), 1e-12)).sum()) :].T)
