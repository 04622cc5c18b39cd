"""The QP of the two tasks: tracking as cost, avoidance rows as inequalities, joint limits as bounds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from qpavoid import gains, kernels
from qpavoid.config import QpSolver
from qpavoid.errors import SolverNotInstalled
from qpavoid.problem import Array, AvoidanceRows, Problem, Solution, Status
from qpavoid.solvers.analytic import tracking_velocity
from qpavoid.solvers.backends import make_backend

_TOLERANCE = 1e-6
"""Largest violation of a row [m/s] or bound [rad/s] with which an answer still counts as a solution."""
_ALPHA_CAP = 1e4
"""Largest α in the weight of a row's slack: the Hessian must stay well conditioned in deep penetration."""


class Qp:
    """min ‖A (v - v0)‖² + λ ‖v - v0‖²  s.t.  J v >= b,  lower <= v <= upper.

    v0 = J⁺ẋ is the tracking law's velocity, so the answer is the safe velocity closest to it, and v0 itself whenever
    that is safe. As A v0 = b wherever the task can be met, the first term is the tracking cost ‖A v - b‖²;
    measuring λ from v0 rather than from 0 leaves tracking free of bias.

    Where the rows contradict each other or the bounds, a second QP finds the least slack that lets them be met,
    each weighted by 1 + α so that the nearer threat gives less, and the first is solved again with that slack.
    """

    bounded = True

    def __init__(self, config: QpSolver) -> None:
        self.config = config
        compiled = config.backend == "native" or (config.backend == "auto" and kernels.ACCELERATED)
        self._project = _compiled_projection() if compiled else None
        self._backend = make_backend("daqp" if config.backend in ("auto", "native") else config.backend)

    def solve(self, problem: Problem) -> Solution:
        """The closest safe velocity; relaxed where there is none; a stop where that fails too."""
        if problem.shortfall <= 0.0:
            return Solution(problem.v0.copy())
        A, rows, lower, upper, v0 = problem.tracking.A, problem.avoidance, problem.lower, problem.upper, problem.v0
        if v0[0] != v0[0]:
            v0 = tracking_velocity(problem)
            if kernels.shortfall(v0, rows.J, rows.b, lower, upper) <= 0.0:
                return Solution(v0)
        if self._project is not None:
            answer, solved = self._project(A, self.config.regularization, v0, rows.J, rows.b, lower, upper)
            if solved:
                return Solution(answer)
        P, q = kernels.projection_cost(A, self.config.regularization, v0)
        v = self._closest(P, q, rows.b, problem)
        if v is not None:
            return Solution(v)
        return self._relaxed(P, q, problem)

    def _closest(self, P: Array, q: Array, b: Array, problem: Problem) -> Array | None:
        """Minimiser of ½ vᵀP v + qᵀv within rows and bounds; None when the answer does not verify."""
        J, lower, upper = problem.avoidance.J, problem.lower, problem.upper
        v = self._backend(P, q, J, b, lower, upper)
        if v is None or not kernels.shortfall(v, J, b, lower, upper) <= _TOLERANCE:
            return None
        return np.asarray(np.minimum(np.maximum(v, lower), upper))

    def _relaxed(self, P: Array, q: Array, problem: Problem) -> Solution:
        slack = self._least_slack(P, q, problem)
        v = None if slack is None else self._closest(P, q, problem.avoidance.b - slack - 0.5 * _TOLERANCE, problem)
        if v is None or slack is None:
            still = np.clip(np.zeros_like(q), problem.lower, problem.upper)
            return Solution(still, Status.STOPPED, ("the QP back end returned no usable velocity",))
        return Solution(v, Status.RELAXED, _shortfalls(slack, problem.avoidance, problem), slack)

    def _least_slack(self, P: Array, q: Array, problem: Problem) -> Array | None:
        """Slack s >= 0 (k,) that minimises Σ (1 + α) s² over all v within the bounds."""
        rows = problem.avoidance
        n, k = len(q), len(rows.d)
        hessian = np.zeros((n + k, n + k))
        hessian[:n, :n] = 1e-6 * P
        hessian[n:, n:] = np.diag(1.0 + np.minimum(gains.alpha(rows.d, rows.d2), _ALPHA_CAP))
        gradient = np.concatenate((1e-6 * q, np.zeros(k)))
        lower = np.concatenate((problem.lower, np.zeros(k)))
        upper = np.concatenate((problem.upper, np.full(k, np.inf)))
        x = self._backend(hessian, gradient, np.hstack((rows.J, np.eye(k))), rows.b, lower, upper)
        if x is None:
            return None
        v = np.clip(x[:n], problem.lower, problem.upper)
        return np.maximum(rows.b - rows.J @ v, 0.0)


def _compiled_projection() -> Callable[..., tuple[Array, bool]]:
    """The back end `native`, warmed up.

    Raises:
        SolverNotInstalled: it needs numba.
    """
    try:
        from qpavoid.kernels.active_set import project
    except ModuleNotFoundError:
        raise SolverNotInstalled("QP back end 'native' needs numba: pip install 'qpavoid[fast]'") from None
    one, row = np.ones(1), np.ones((1, 1))
    project(row, 1.0, one, row, 2.0 * one, -3.0 * one, 3.0 * one)
    return project  # type: ignore[no-any-return]


def _shortfalls(slack: Array, rows: AvoidanceRows, problem: Problem) -> tuple[str, ...]:
    """Which pairs gave way, the largest shortfall first."""
    order = np.argsort(-slack)
    return tuple(
        f"{' - '.join(problem.pair_names[rows.pair[i]])}: {1e3 * slack[i]:.1f} mm/s short of its row"
        for i in order
        if slack[i] > _TOLERANCE
    )
