"""Artificial potential field: obstacles repel every body within the influence distance, the task attracts."""

from __future__ import annotations

import numpy as np

from qpavoid.config import PotentialFieldSolver
from qpavoid.problem import Array, Problem, Solution
from qpavoid.solvers.analytic import tracking_velocity


class PotentialField:
    """q̇ = J⁺ẋ + Σ f(d_i) J_iᵀ over the pairs in range: the field of Khatib (1986), "Real-time obstacle avoidance for
    manipulators and mobile robots", IJRR 5(1), at velocity level.

    The tracking velocity attracts. FIRAS repels: U(d) = ½ η (1/d - 1/d2)² has the repulsion

        f(d) = -U'(d) = η (1/d - 1/d2)/d² = g (d2 - d)/(d2 - d1) (d1/d)³,  at most `cap`.

    η follows from g, the repulsion at d1: as a setting of its own, it would differ from scene to scene by orders of
    magnitude. Above the cap, U continues linearly, into penetration too.

    J_iᵀ maps repulsions to joint velocities, as it maps Khatib's forces to torques. So the repelling velocity is
    -∂ΣU/∂q, descent of one potential (Choset et al. 2005, "Principles of Robot Motion", chapter 4): by itself it never
    adds to ΣU, however many pairs act on a link, and it has no singularity. An inverse of each J_i would separate each
    pair at a set speed, but the joints' speeds for that grow as the lever arm shrinks.

    It ignores the task: where attraction and repulsion balance, the robot stalls.
    """

    bounded = False

    def __init__(self, config: PotentialFieldSolver) -> None:
        self.config = config

    def solve(self, problem: Problem) -> Solution:
        """Return attraction plus repulsion; the attraction itself without a pair in range; see `Solver.solve`."""
        rows, primary = problem.avoidance, tracking_velocity(problem)
        if rows.d.size == 0:
            return Solution(primary)
        f = repulsion(rows.d, rows.d1, rows.d2, self.config.gain, self.config.cap)
        return Solution(primary + f @ rows.J)


def repulsion(d: Array, d1: float, d2: float, gain: float, cap: float) -> Array:
    """Compute the repulsion f (k,) of each pair [rad²/(m s)]: 0 from d2 on, `gain` at d1, at most `cap`.

    Args:
        d: distances (k,) [m].
        d1: safe distance [m].
        d2: influence distance [m].
        gain: repulsion at d1 [rad²/(m s)].
        cap: largest repulsion [rad²/(m s)].
    """
    weight = np.maximum(d2 - d, 0.0) / (d2 - d1)
    with np.errstate(divide="ignore", over="ignore"):
        return np.asarray(np.minimum(gain * weight * (d1 / np.maximum(d, 0.0)) ** 3, cap))
