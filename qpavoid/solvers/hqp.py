"""Strict priorities: each level is optimised within the optima of all levels before it.

Inequalities have priority over all tasks and hold at every level (Kanoun, Lamiraux and Wieber 2011, "Kinematic control
of redundant manipulators: generalizing the task-priority framework to inequality tasks"); each level is solved in a
basis of the null space of the levels before it (Escande, Mansard and Wieber 2014, "Hierarchical quadratic programming:
fast online humanoid-robot motion generation").
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from qpavoid import kernels
from qpavoid.problem import Array, IntArray, Problem, Solution, least_squares
from qpavoid.reason import Reason, ReasonKind
from qpavoid.solvers.backends import verified, within
from qpavoid.solvers.qp import Qp
from qpavoid.solvers.relaxation import relaxed_solution

Levels = list[tuple[Array, Array]]
"""Rows A (r, nv) and right-hand sides b (r,) of each priority, the first one first."""
_RANK_TOLERANCE = 1e-8
"""Share of a level's largest singular value below which a direction is in its null space [-]: root of round-off."""
_BENDING_TOLERANCE = 1e-6
"""Second-order cost c of a level, over ‖A‖², from which motion of later ones is slowed down [-]."""
_MIN_SINGULAR_VALUE = 1e-12
"""Largest singular value below which a level has rank 0."""


class Hqp(Qp):
    """Hierarchical QP: for each priority p in turn, among the optima of all before it,

        min ‖A_p v - b_p‖² + λ ‖v - v̂‖²  s.t.  J v >= b,  lower <= v <= upper.

    v̂ is the same cascade without the inequalities, v̂ += Z (A_p Z)⁺ (b_p - A_p v̂) with a basis Z of the null space of
    the levels before (Siciliano and Slotine 1991), each inverse that of the tracking law: the answer wherever it is
    safe. A level's b_p is A_p v̂ once it is met. In the null space of the last level, v is as near to v̂ as possible.
    Contacts are met by the basis of the first level.

    Where no velocity meets the inequalities, they are relaxed as those of `qp` are, and the cascade is solved within
    the relaxed ones. A level whose QP neither the back end nor daqp solves keeps the velocity of the levels before it,
    and is named in the reasons.
    """

    prioritised = True

    def solve(self, problem: Problem) -> Solution:
        """Return the lexicographic optimum; relaxed without one; a stop where that fails too."""
        levels = problem.levels or (np.arange(len(problem.tracking.b)),)
        velocities = problem.cascade
        if velocities is None:
            velocities = cascade(problem, least_squares) if problem.levels else problem.v_tracking[None]
        unconstrained = velocities[-1].copy()
        (J, b), (lower, upper) = problem.inequalities, self._bounds(problem)
        if kernels.violation(unconstrained, J, b, lower, upper) <= 0.0:
            return Solution(unconstrained)
        if not np.isfinite(velocities).all():
            unconstrained = np.zeros_like(unconstrained)
            velocities = np.zeros_like(velocities)
        A = problem.tracking.A
        reduced = [(A[index], A[index] @ v) for index, v in zip(levels, velocities, strict=True)]
        v, unsolved = self._levels(problem, reduced, unconstrained, J, b, lower, upper)
        if v is not None:
            return Solution(v).with_reasons(*unsolved) if unsolved else Solution(v)
        relaxed = self._relax(problem)
        if isinstance(relaxed, Solution):
            return relaxed
        slack = np.maximum(b - J @ relaxed, 0.0)
        lower, upper = np.minimum(lower, relaxed), np.maximum(upper, relaxed)
        v, unsolved = self._levels(problem, reduced, unconstrained, J, b - slack, lower, upper)
        return relaxed_solution(relaxed if v is None else v, problem, *unsolved)

    def _levels(
        self, problem: Problem, levels: Levels, unconstrained: Array, J: Array, b: Array, lower: Array, upper: Array
    ) -> tuple[Array | None, tuple[Reason, ...]]:
        """Solve the levels within J v >= b and the bounds, as near to the unconstrained v̂ (nv,) as each leaves it.

        Returns:
            Velocity (nv,), None where the first level has no solution; reasons for the levels without one.
        """
        (Z, v), regularization = _start(problem), self._regularization(problem)
        is_satisfied, unsolved = False, list[Reason]()
        for level, (A, rate) in enumerate((*levels, (np.eye(len(v)), unconstrained))):
            P = A.T @ A
            P.ravel()[:: len(P) + 1] += regularization
            q = -(A.T @ rate + regularization * unconstrained)
            limits = b, lower, upper
            if is_satisfied:  # v itself is a solution, in spite of round-off
                limits = np.minimum(b, J @ v), np.minimum(lower, v), np.maximum(upper, v)
            answers = (verified(within(backend, Z, v), P, q, J, *limits) for backend in self._backends)
            better = next((answer for answer in answers if answer is not None), None)
            if better is not None:
                v, is_satisfied = better, True
            elif not is_satisfied:
                return None, ()
            elif level < len(levels):
                unsolved.append(Reason.of(ReasonKind.PRIORITY_UNSOLVED, f"priority level {level + 1}"))
            Z = Z @ _null_space(A @ Z)
            if not Z.shape[1]:
                break
        return np.clip(v, lower, upper), tuple(unsolved)


def _start(problem: Problem) -> tuple[Array, Array]:
    """Return a basis (nv, n) of the null space of the contacts, and a velocity (nv,) that meets them."""
    contacts, nv = problem.contacts, len(problem.lower)
    return (np.eye(nv), np.zeros(nv)) if contacts is None else (contacts.Z, contacts.v_particular)


def cascade(
    problem: Problem,
    inverse: Callable[[Array, Array], Array],
    bending: Callable[[IntArray, Array], Array] | None = None,
) -> Array:
    """Compute the velocities v̂ of the tasks down to each priority, without inequalities (levels, nv).

    Where a level is left short of its target, as beyond reach, the null space of its rows turns as fast as the arm
    moves in it, and motion there costs the level at second order. So a later level moves only by the share
    1 / (1 + c / ε) along null directions in which the levels before bend by c.

    Args:
        problem: of several levels.
        inverse: gives the velocity (nv,) of the rows A (r, nv) with b (r,), zero but for one level and the null space
            of the levels before.
        bending: gives the second-order cost (nv, nv) of motion from the velocity (nv,) of a level with some rows, over
            ‖A‖² of these; none if left out.
    """
    A, b = problem.tracking.A, problem.tracking.b
    velocities = np.empty((len(problem.levels), A.shape[1]))
    (Z, v), bent, is_bent = _start(problem), np.zeros((A.shape[1], A.shape[1])), False
    for level, rows in enumerate(problem.levels):
        reduced, missing = np.zeros_like(A), np.zeros_like(b)
        reduced[rows], missing[rows] = A[rows] @ Z @ Z.T, b[rows] - A[rows] @ v
        change = inverse(reduced, missing)
        if not np.isfinite(reduced).all():
            return np.full_like(velocities, np.nan)
        if is_bent:
            costs, directions = np.linalg.eigh(Z.T @ bent @ Z)
            shares = 1.0 / (1.0 + np.maximum(costs, 0.0) / _BENDING_TOLERANCE)
            change = Z @ (directions @ (shares * (directions.T @ (Z.T @ change))))
        v = velocities[level] = v + change
        if bending is not None and level + 1 < len(problem.levels):
            bent += bending(rows, change)
            is_bent = bool(bent.any())
        Z = Z @ _null_space(A[rows] @ Z)
        if not Z.shape[1]:
            velocities[level:] = v
            break
    return velocities


def _null_space(A: Array) -> Array:
    """Compute an orthonormal basis (n, k) of the null space of A (r, n)."""
    _, s, V = np.linalg.svd(A)
    return np.asarray(V[int((s > _RANK_TOLERANCE * max(float(s[0]), _MIN_SINGULAR_VALUE)).sum()) :].T)
