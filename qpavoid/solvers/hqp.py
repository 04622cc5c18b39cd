"""Strict priorities: each level is optimised within the optima of all levels before it.

Inequalities have priority over all tasks and hold at every level (Kanoun, Lamiraux and Wieber 2011, "Kinematic control
of redundant manipulators: generalizing the task-priority framework to inequality tasks"); each level is solved in a
basis of the null space of the levels before it (Escande, Mansard and Wieber 2014, "Hierarchical quadratic programming:
fast online humanoid-robot motion generation").
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
_RANK_TOLERANCE = 1e-8
"""Share of a level's largest singular value below which a direction is in its null space [-]: root of round-off."""
_MIN_SINGULAR_VALUE = 1e-12
"""Largest singular value below which a level has rank 0."""


class Hqp(Qp):
    """Hierarchical QP: for each priority p in turn, among the optima of all before it,

        min ‖A_p v - b_p‖² + λ ‖v - v̂‖²  s.t.  J v >= b,  lower <= v <= upper.

    v̂ is the same cascade without the inequalities, v̂ += Z (A_p Z)⁺ (b_p - A_p v̂) with a basis Z of the null space of
    the levels before (Siciliano and Slotine 1991), each inverse damped as J⁺ is: the answer wherever it is safe. In the
    null space of the last level, v is as near to v̂ as possible. Contacts are met by the basis of the first level.

    Where no velocity meets the inequalities, they are relaxed as those of `qp` are, and the cascade is solved within
    the relaxed ones. A level whose QP neither the back end nor daqp solves keeps the velocity of the levels before it,
    and is named in the reasons.
    """

    def solve(self, problem: Problem) -> Solution:
        """Return the lexicographic optimum; relaxed without one; a stop where that fails too."""
        if problem.violation <= 0.0 and not problem.levels:
            return Solution(problem.v_tracking.copy())
        levels = problem.levels or (np.arange(len(problem.tracking.b)),)
        rows, lower, upper = problem.avoidance, problem.lower, problem.upper
        unconstrained, damped = _cascade(problem, levels)
        if kernels.violation(unconstrained, rows.J, rows.b, lower, upper) <= 0.0:
            return Solution(unconstrained)
        if not np.isfinite(unconstrained).all():
            unconstrained = np.zeros_like(unconstrained)
        v, unsolved = self._levels(problem, damped, unconstrained, rows.b, lower, upper)
        if v is not None:
            return Solution(v).with_reasons(*unsolved) if unsolved else Solution(v)
        P, q = kernels.projection_cost(problem.tracking.A, 1e-3, unconstrained)
        relaxed = self._relax(P, q, problem)
        if isinstance(relaxed, Solution):
            return relaxed
        lower, upper = np.minimum(lower, relaxed.v), np.maximum(upper, relaxed.v)
        v, unsolved = self._levels(problem, damped, unconstrained, rows.b - relaxed.slack, lower, upper)
        relaxed = relaxed if v is None else relaxed._replace(v=v)
        return relaxed_solution(relaxed, problem, *unsolved)

    def tracked(self, problem: Problem) -> Array:
        """Return the velocity (nv,) of the cascade without inequalities, v̂ [rad/s or m/s].

        Args:
            problem: with its tasks and priorities.
        """
        return _cascade(problem, problem.levels or (np.arange(len(problem.tracking.b)),))[0]

    def _levels(
        self, problem: Problem, levels: Levels, unconstrained: Array, b: Array, lower: Array, upper: Array
    ) -> tuple[Array | None, tuple[Reason, ...]]:
        """Solve the levels within J v >= b and the bounds.

        Args:
            problem: with J and the contacts.
            levels: rows and right-hand sides of each priority.
            unconstrained: v̂ (nv,).
            b: right-hand sides of the avoidance rows (k,) [m/s].
            lower: lower bounds (nv,).
            upper: upper bounds (nv,).

        Returns:
            Velocity (nv,), None where the first level has no solution; reasons for the levels without one.
        """
        J, (Z, v) = problem.avoidance.J, _start(problem)
        met, unsolved = False, list[Reason]()
        for level, (A, rate) in enumerate((*levels, (np.eye(len(v)), unconstrained))):
            P = A.T @ A
            P.ravel()[:: len(P) + 1] += self.config.regularization
            q = -(A.T @ rate + self.config.regularization * unconstrained)
            # once the inequalities are met, v itself is a solution, in spite of round-off
            better = self._solve(Z, v, P, q, J, b, lower, upper, met)
            if better is not None:
                v, met = better, True
            elif not met:
                return None, ()
            elif level < len(levels):
                unsolved.append(Reason.of(ReasonKind.PRIORITY_UNSOLVED, f"priority level {level + 1}"))
            Z = Z @ _null_space(A @ Z)
            if not Z.shape[1]:
                break
        return np.clip(v, lower, upper), tuple(unsolved)

    def _solve(
        self, Z: Array, v: Array, P: Array, q: Array, J: Array, b: Array, lower: Array, upper: Array, met: bool
    ) -> Array | None:
        """Solve one level among v + Z w; v is feasible if the inequalities are `met`."""
        if met:
            b, lower, upper = np.minimum(b, J @ v), np.minimum(lower, v), np.maximum(upper, v)
        for backend in self._backends:
            better = _solve_level(backend, Z, v, P, q, J, b, lower, upper)
            if better is not None:
                return better
        return None


def _solve_level(
    backend: Backend, Z: Array, v: Array, P: Array, q: Array, J: Array, b: Array, lower: Array, upper: Array
) -> Array | None:
    """Solve one level among v + Z w; None where the back end fails or its answer does not verify."""

    def reduced(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
        return solve_within(backend, Z, v, P, q, G, h, lower, upper)

    return closest(reduced, P, q, J, b, lower, upper)


def _start(problem: Problem) -> tuple[Array, Array]:
    """Return a basis (nv, n) of the null space of the contacts, and a velocity (nv,) that meets them."""
    contacts, nv = problem.contacts, len(problem.lower)
    return (np.eye(nv), np.zeros(nv)) if contacts is None else (contacts.Z, contacts.v_particular)


def _cascade(problem: Problem, levels: tuple[IntArray, ...]) -> tuple[Array, Levels]:
    """Compute the velocity v̂ of the tasks alone, and the levels of which it is the optimum.

    With the singular values s of A_p Z, these have the right-hand sides that damping leaves of the tasks: their part
    along each left singular vector is scaled with s² / (s² + λ²). So nothing jumps where an inequality begins to bind.

    Args:
        problem: with its tracking rows and contacts.
        levels: indices of the rows of each priority.

    Returns:
        v̂ (nv,), NaN where a row has NaN; rows and right-hand sides of each level.
    """
    tracking = problem.tracking
    damped = [(tracking.A[rows], tracking.b[rows]) for rows in levels]
    Z, v = _start(problem)
    for level, (A, b) in enumerate(damped):
        reduced, missing = A @ Z, b - A @ v
        if not (np.isfinite(reduced).all() and np.isfinite(missing).all()):
            return np.full_like(v, np.nan), damped[:level]
        U, s, V = np.linalg.svd(reduced, full_matrices=True)
        in_range = s > _RANK_TOLERANCE * max(float(s[0]), _MIN_SINGULAR_VALUE)
        s, count = s[in_range], int(in_range.sum())
        components = U[:, :count].T @ missing
        step = s / (s**2 + tracking.damping**2) * components
        v = v + Z @ (V[:count].T @ step)
        damped[level] = (A, b - U[:, :count] @ (components - s * step))
        Z = Z @ V[count:].T
        if not Z.shape[1]:
            break
    return v, damped


def _null_space(A: Array) -> Array:
    """Compute an orthonormal basis (n, k) of the null space of A (r, n)."""
    _, s, V = np.linalg.svd(A)
    return np.asarray(V[int((s > _RANK_TOLERANCE * max(float(s[0]), _MIN_SINGULAR_VALUE)).sum()) :].T)
