"""The QP of the two tasks: tracking as cost, avoidance rows as inequalities, joint limits as bounds."""

from __future__ import annotations

import numpy as np

from qpavoid.config import QpSolver
from qpavoid.problem import Array, AvoidanceRows, Problem, Solution, Status
from qpavoid.solvers.analytic import tracking_velocity
from qpavoid.solvers.backends import make_backend

_TOLERANCE = 1e-6
"""Largest violation of a row [m/s] or bound [rad/s] with which an answer still counts as a solution."""
_ALPHA_CAP = 1e4
"""Largest α in the weight of a row's slack: the Hessian must stay well conditioned in deep penetration."""


class Qp:
    """min ‖A (v - v0)‖²_W + λ ‖v - v0‖²  s.t.  J v + drift >= bound,  lower <= v <= upper.

    v0 = J⁺ẋ is the tracking law's velocity, so the answer is the safe velocity closest to it, and v0 itself whenever
    that is safe. As A v0 = b wherever the task can be met, the first term is the tracking cost ‖A v - b‖²_W;
    measuring λ from v0 rather than from 0 leaves tracking free of bias.

    Where the rows contradict each other or the bounds, a second QP finds the least slack that lets them be met,
    each weighted by 1 + α so that the nearer threat gives less, and the first is solved again with that slack.
    """

    bounded = True

    def __init__(self, config: QpSolver) -> None:
        self.config = config
        self._backend = make_backend(config.backend)

    def solve(self, problem: Problem) -> Solution:
        """The closest safe velocity; relaxed where there is none; a stop where that fails too."""
        v0, J, _ = tracking_velocity(problem.tracking)
        rows = problem.avoidance
        if _violation(v0, rows.bound, problem) <= 0.0:
            return Solution(v0)
        P = J.T @ J
        P[np.diag_indices_from(P)] += self.config.regularization
        v = self._closest(P, v0, rows.bound, problem)
        if v is not None:
            return Solution(v)
        return self._relaxed(P, v0, problem)

    def _closest(self, P: Array, v0: Array, bound: Array, problem: Problem) -> Array | None:
        """Minimiser of (v - v0)ᵀP (v - v0) within rows and bounds; None when the answer does not verify."""
        rows = problem.avoidance
        v = self._backend(P, -P @ v0, -rows.J, rows.drift - bound, problem.lower, problem.upper)
        if v is None or not _violation(v, bound, problem) <= _TOLERANCE:
            return None
        return np.clip(v, problem.lower, problem.upper)

    def _relaxed(self, P: Array, v0: Array, problem: Problem) -> Solution:
        rows = problem.avoidance
        slack = self._least_slack(P, v0, problem)
        v = None if slack is None else self._closest(P, v0, rows.bound - slack - 0.5 * _TOLERANCE, problem)
        if v is None or slack is None:
            still = np.clip(np.zeros_like(v0), problem.lower, problem.upper)
            return Solution(still, Status.STOPPED, ("the QP back end returned no usable velocity",))
        return Solution(v, Status.RELAXED, _shortfalls(slack, rows, problem), slack)

    def _least_slack(self, P: Array, v0: Array, problem: Problem) -> Array | None:
        """Slack s >= 0 (k,) that minimises Σ (1 + α) s² over all v within the bounds."""
        rows = problem.avoidance
        n, k = len(v0), len(rows.d)
        hessian = np.zeros((n + k, n + k))
        hessian[:n, :n] = 1e-6 * P
        hessian[n:, n:] = np.diag(1.0 + np.minimum(rows.alpha, _ALPHA_CAP))
        gradient = np.concatenate((-1e-6 * (P @ v0), np.zeros(k)))
        G = np.hstack((-rows.J, -np.eye(k)))
        lower = np.concatenate((problem.lower, np.zeros(k)))
        upper = np.concatenate((problem.upper, np.full(k, np.inf)))
        x = self._backend(hessian, gradient, G, rows.drift - rows.bound, lower, upper)
        if x is None:
            return None
        v = np.clip(x[:n], problem.lower, problem.upper)
        return np.maximum(rows.bound - rows.J @ v - rows.drift, 0.0)


def _violation(v: Array, bound: Array, problem: Problem) -> float:
    """Largest violation of rows and bounds by v; NaN stays NaN."""
    rows = problem.avoidance
    short = np.max(bound - rows.J @ v - rows.drift, initial=-np.inf)
    over = np.max(np.maximum(v - problem.upper, problem.lower - v), initial=-np.inf)
    return float(np.maximum(short, over))


def _shortfalls(slack: Array, rows: AvoidanceRows, problem: Problem) -> tuple[str, ...]:
    """Which pairs gave way, the largest shortfall first."""
    order = np.argsort(-slack)
    return tuple(
        f"{' - '.join(problem.pair_names[rows.pair[i]])}: {1e3 * slack[i]:.1f} mm/s short of its row"
        for i in order
        if slack[i] > _TOLERANCE
    )
