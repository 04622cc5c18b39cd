"""Baselines of the literature: clearance climbed in the null space of the task, and an artificial potential field."""

from __future__ import annotations

import numpy as np

from qpavoid.problem import Array, Problem, Solution
from qpavoid.solvers.analytic import null_space_part
from qpavoid.solvers.solver import NamedSolver


class GradientProjection(NamedSolver):
    """q̇ = J⁺ẋ + (I - J⁺J) a,  a = k ∇h (Liégeois 1977, "Automatic supervisory control of the configuration and behavior
    of multibody mechanisms", IEEE Trans. SMC 7(12); eq. 9 of the task-switching paper).

    The clearance h = -Σ c(d_i) [m] adds up over the pairs in range the obstacle cost of CHOMP (Ratliff et al. 2009;
    Zucker et al. 2013, IJRR 32(9-10)) for a safe distance d1 and an influence distance d2:

        c(d) = 0 beyond d2,  (d2 - d)²/(2 (d2 - d1)) down to d1,  (d1 + d2)/2 - d below.

    Its slope grows from 0 to 1, so that there is no jump at d2, and the slope is bounded in contact. With J_i, the
    Jacobians of the distances, ∇h = -Σ c'(d_i) J_iᵀ is exact. The motion of obstacles is ignored.

    k is `gain`, or the part of it at which joints that J⁺ẋ keeps within their bounds stay there (Euler, Dubey and
    Babcock 1989, "Self motion determination based on actuator velocity bounds for redundant manipulators"): clipped
    joint by joint, the motion would leave the null space and move the tool.
    """

    def solve(self, problem: Problem) -> Solution:
        """Return J⁺ẋ plus the self-motion that adds clearance; see `Solver.solve`."""
        rows, primary = problem.avoidance, problem.v_tracking.copy()
        if rows.d.size == 0:
            return Solution(primary)
        gradient = clearance_slope(rows.d, rows.d1, rows.d2) @ rows.J
        a = null_space_part(self.config.gain * gradient, problem.tracking)
        return Solution(primary + step_fraction(primary, a, problem.lower, problem.upper) * a)


def clearance_slope(d: Array, d1: float, d2: float) -> Array:
    """Compute ∂h/∂d (k,) of each pair: 0 from d2 on, 1 from d1 down, linear between [-].

    Args:
        d: distances (k,) [m].
        d1: safe distance [m].
        d2: influence distance [m].
    """
    return np.asarray(np.clip((d2 - d) / (d2 - d1), 0.0, 1.0))


def step_fraction(v: Array, a: Array, lower: Array, upper: Array) -> float:
    """Compute the largest s in [0, 1] at which v + s a violates no bound more than v [-].

    Args:
        v: velocity (nv,).
        a: change of velocity (nv,); where it is 0, bounds are ignored.
        lower: lower bound (nv,), may be infinite.
        upper: upper bound (nv,), may be infinite.
    """
    margin = np.where(a > 0.0, upper, lower) - v
    moving = a != 0.0
    with np.errstate(over="ignore"):
        fraction = np.min(margin[moving] / a[moving], initial=1.0)
    return float(np.maximum(fraction, 0.0))


class PotentialField(NamedSolver):
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

    def solve(self, problem: Problem) -> Solution:
        """Return attraction plus repulsion; the attraction itself without a pair in range; see `Solver.solve`."""
        rows, primary = problem.avoidance, problem.v_tracking.copy()
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
