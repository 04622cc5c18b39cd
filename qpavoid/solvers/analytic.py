"""Closed-form solvers: tracking alone, and the task-switching law of eq. 10 in its two readings."""

from __future__ import annotations

import numpy as np

from qpavoid import kernels
from qpavoid.config import Eq10Solver
from qpavoid.problem import Array, Problem, Solution, Tracking
from qpavoid.solvers.solver import NamedSolver

_MIN_SQUARE = 1e-12
"""Squared length below which a projected row counts as zero [m²/rad²]: an absolute cut-off, since a relative one
inverts round-off (J_d N is zero exactly when the tool tip is the key point of a 3-D task)."""
_RANK_TOLERANCE = 1e-10
"""Share of the largest singular value of J below which one is round-off [-]."""


def null_space_part(row: Array, tracking: Tracking) -> Array:
    """Project a row, or a velocity, to the null space of the task: row N with the symmetric N = I - J⁺J.

    Args:
        row: (nv,).
        tracking: task rows.

    Returns:
        (nv,).
    """
    J = tracking.A
    return np.asarray(row - (row @ np.linalg.pinv(J, rcond=_RANK_TOLERANCE)) @ J)


class TrackingOnly(NamedSolver):
    """q̇ = J⁺ẋ of `kernels.tracking_law`: the baseline, without avoidance."""

    def solve(self, problem: Problem) -> Solution:
        """Return J⁺ẋ; see `Solver.solve`."""
        return Solution(problem.v_tracking.copy())


class Eq10(NamedSolver):
    """Eq. 10 of the task-switching paper, for the closest pair:

        q̇ = (I - α J_d⁺J_d) J⁺ẋ + β (J_d N)⁺ (ẋ0 - w),  N = I - J⁺J.

    `eq10-literal` takes w = J_d J⁺ẋ as printed, which takes the primary motion away twice. `eq10` takes
    w = J_d (I - α J_d⁺J_d) J⁺ẋ, the remaining part of it, and applies α only while the primary motion closes in; α as
    printed would brake an arm that already recedes. The projector is bounded and not damped, (J_d N)⁺ is.
    """

    def __init__(self, config: Eq10Solver) -> None:
        super().__init__(config)
        kernels.alpha(1.0, 1.0), kernels.beta(1.0, 1.0, 2.0)  # no control step waits for the compiler

    def solve(self, problem: Problem) -> Solution:
        """Return the velocity of eq. 10, or J⁺ẋ without a pair in range; see `Solver.solve`."""
        rows, primary = problem.avoidance, problem.v_tracking.copy()
        if rows.d.size == 0:
            return Solution(primary)
        closest = int(np.argmin(rows.d))
        J_d = rows.J[closest]
        approach = float(J_d @ primary)
        literal = self.config.name == "eq10-literal"
        d = float(rows.d[closest])
        alpha = min(kernels.alpha(d, rows.d2), self.config.alpha_cap)
        if not literal and approach >= 0.0:
            alpha = 0.0
        switched = primary - alpha * approach * _row_inverse(J_d, damping=0.0)
        J_dN = null_space_part(J_d, problem.tracking)
        retreat_rate = self.config.retreat_speed - (approach if literal else float(J_d @ switched))
        retreat = kernels.beta(d, rows.d1, rows.d2) * retreat_rate * _row_inverse(J_dN, self.config.damping)
        return Solution(switched + retreat)


def _row_inverse(row: Array, damping: float) -> Array:
    """Compute the damped inverse rowᵀ/(row·row + λ²) of a 1 x nv matrix; zero for a vanishing row."""
    square = float(row @ row)
    if square < _MIN_SQUARE:
        return np.zeros_like(row)
    return row / (square + damping**2)
