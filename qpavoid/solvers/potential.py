"""Artificial potential field: obstacles push every body that comes near, the task pulls."""

from __future__ import annotations

import numpy as np

from qpavoid.config import PotentialFieldSolver
from qpavoid.problem import Array, Problem, Solution
from qpavoid.solvers.analytic import tracking_velocity


class PotentialField:
    """q̇ = J⁺ẋ + Σ f(d_i) J_iᵀ over the pairs in range: the field of Khatib (1986), "Real-time obstacle avoidance for
    manipulators and mobile robots", IJRR 5(1), at velocity level.

    The tracking velocity attracts. FIRAS repels: U(d) = ½ η (1/d - 1/d2)² pushes with

        f(d) = -U'(d) = η (1/d - 1/d2)/d² = g (d2 - d)/(d2 - d1) (d1/d)³,  at most `cap`.

    η is set by g, the push at d1: as a number of its own, it would have to be another one for each scene, by orders of
    magnitude. Where the cap holds, U goes on linearly, into penetration too.

    Pushes come to the joints by J_iᵀ, as Khatib's forces come to torques. So the repelling velocity is -∂ΣU/∂q, descent
    of one potential (Choset et al. 2005, "Principles of Robot Motion", chapter 4): by itself it never adds to ΣU,
    however many pairs act on a link, and it has no singularity. An inverse of each J_i would part each pair at a set
    speed, but the joints' speeds for that grow as the lever shrinks.

    It takes no notice of the task: where pull and push are in balance, the robot stalls.
    """

    bounded = False

    def __init__(self, config: PotentialFieldSolver) -> None:
        self.config = config

    def solve(self, problem: Problem) -> Solution:
        """Pull and push; the pull itself when nothing is in range."""
        rows, primary = problem.avoidance, tracking_velocity(problem)
        if rows.d.size == 0:
            return Solution(primary)
        push = repulsion(rows.d, rows.d1, rows.d2, self.config.gain, self.config.cap)
        return Solution(primary + push @ rows.J)


def repulsion(d: Array, d1: float, d2: float, gain: float, cap: float) -> Array:
    """Push f (k,) of each pair along its distance [rad²/(m s)]: 0 from d2 on, `gain` at d1, `cap` at most.

    Args:
        d: distances (k,) [m].
        d1: safe distance [m].
        d2: influence distance [m].
        gain: push at d1 [rad²/(m s)].
        cap: largest push [rad²/(m s)].
    """
    near = np.maximum(d2 - d, 0.0) / (d2 - d1)
    with np.errstate(divide="ignore", over="ignore"):
        return np.asarray(np.minimum(gain * near * (d1 / np.maximum(d, 0.0)) ** 3, cap))
