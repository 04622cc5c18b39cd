"""What gives way when rows and bounds contradict each other: accelerations first, then rows, the deepest threat last.

Position and velocity limits never give way. Only a tick that has no safe velocity comes here, so its QPs are solved
cold and one after the other; a few hundred microseconds buy an answer that gives up no more than it must.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from qpavoid import kernels
from qpavoid.problem import Array, IntArray, Problem
from qpavoid.solvers.backends import Backend

TOLERANCE = 1e-6
"""Largest violation of a row [m/s] or bound [rad/s] with which an answer still counts as a solution."""
_LEVEL = 2e-3
"""Rows whose distances differ by less are threats of the same depth and share what has to be given up [m]."""
_MOST_LEVELS = 8
"""Levels that are relaxed one after the other; what is left shares by least squares, so that the time is bounded."""
_SMALL = 1e-6
"""Weight of the tracking cost beside that of what is given up."""


class Relaxed(NamedTuple):
    """A velocity and what was given up for it."""

    v: Array
    """(n,)."""
    slack: Array
    """(k,) what each avoidance row gave way [m/s]."""
    excess: Array
    """(n,) by how much each coordinate passes what its acceleration limit allows [rad/s or m/s]."""


def relax(P: Array, q: Array, problem: Problem, backend: Backend) -> Relaxed | None:
    """The velocity that gives up least.

    Args:
        P: tracking cost (n, n).
        q: its gradient at 0 (n,).
        problem: rows and bounds that no velocity meets.
        backend: solves the QPs.

    Returns:
        None where the back end fails.
    """
    x = problem
    rows, none = x.avoidance, np.zeros(len(x.avoidance.d))
    if x.hard_lower is not x.lower:
        excess = _least_excess(P, q, problem, backend)
        if excess is not None:
            lower, upper = np.maximum(x.lower - excess, x.hard_lower), np.minimum(x.upper + excess, x.hard_upper)
            v = closest(backend, P, q, rows.J, rows.b - 0.5 * TOLERANCE, lower, upper)
            if v is not None:
                return Relaxed(v, none, np.maximum(np.maximum(v - x.upper, x.lower - v), 0.0))
    slack = _lexicographic_slack(P, q, problem, backend)
    v = closest(backend, P, q, rows.J, rows.b - slack - 0.5 * TOLERANCE, x.hard_lower, x.hard_upper)
    if v is None:
        return None
    left = np.maximum(rows.b - rows.J @ v, 0.0)
    return Relaxed(v, left, np.maximum(np.maximum(v - x.upper, x.lower - v), 0.0))


def closest(backend: Backend, P: Array, q: Array, J: Array, b: Array, lower: Array, upper: Array) -> Array | None:
    """Minimiser of ½ vᵀP v + qᵀv within rows and bounds; None when the back end fails or its answer does not verify."""
    try:
        v = backend(P, q, J, b, lower, upper)
    except Exception:  # whatever a library raises, the robot must get a velocity
        return None
    if v is None or np.shape(v) != q.shape or not kernels.shortfall(v, J, b, lower, upper) <= TOLERANCE:
        return None  # NaN fails the comparison too
    return np.asarray(np.minimum(np.maximum(v, lower), upper))


def _least_excess(P: Array, q: Array, x: Problem, backend: Backend) -> Array | None:
    """Least e >= 0 (n,), in units of the speeds, with lower - e <= v <= upper + e for some v that meets all rows."""
    n, rows = len(q), x.avoidance
    room = np.maximum(x.upper - x.lower, 1e-9)
    eye, none = np.eye(n), np.zeros((len(rows.d), n))
    J = np.block([[rows.J, none], [eye, eye], [-eye, eye]])
    b = np.concatenate((rows.b, x.lower, -x.upper))
    finite = np.isfinite(b)
    hessian = np.zeros((2 * n, 2 * n))
    hessian[:n, :n] = _SMALL * P
    hessian[n:, n:] = np.diag(1.0 / room**2)
    gradient = np.concatenate((_SMALL * q, np.zeros(n)))
    lower = np.concatenate((x.hard_lower, np.zeros(n)))
    upper = np.concatenate((x.hard_upper, np.full(n, np.inf)))
    answer = closest(backend, hessian, gradient, np.ascontiguousarray(J[finite]), b[finite], lower, upper)
    return None if answer is None else answer[n:] + TOLERANCE


def _lexicographic_slack(P: Array, q: Array, x: Problem, backend: Backend) -> Array:
    """Slack (k,) of the rows, level by level from the deepest threat on: each gives only what those before it force."""
    rows = x.avoidance
    slack = np.zeros(len(rows.d))
    levels = _levels(rows.d)

    def feasible(count: int) -> bool:
        """Whether the first `count` levels can be met with the slack that they have."""
        chosen = np.concatenate(levels[:count])
        b = rows.b[chosen] - slack[chosen]
        return closest(backend, P, q, rows.J[chosen], b, x.hard_lower, x.hard_upper) is not None

    done = 0
    for _ in range(_MOST_LEVELS):
        done = _last_true(feasible, done, len(levels))
        if done == len(levels):
            return slack
        _give(slack, np.concatenate([*levels[:done], np.zeros(0, dtype=np.intp)]), levels[done], P, q, x, backend)
        done += 1
    if done < len(levels):
        _give(slack, np.concatenate(levels[:done]), np.concatenate(levels[done:]), P, q, x, backend)
    return slack


def _levels(d: Array) -> list[IntArray]:
    """Rows by depth: each level holds those within `_LEVEL` of its deepest one."""
    order = np.argsort(d, kind="stable")
    levels: list[IntArray] = []
    start = 0
    for i in range(1, len(order) + 1):
        if i == len(order) or d[order[i]] - d[order[start]] > _LEVEL:
            levels.append(order[start:i])
            start = i
    return levels


def _last_true(test: Callable[[int], bool], low: int, high: int) -> int:
    """Largest i in [low, high] with test(i), for a test that is true up to some i; `low` is taken to be true."""
    if low < high and test(high):
        return high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if test(middle) else (low, middle)
    return low


def _give(slack: Array, kept: IntArray, giving: IntArray, P: Array, q: Array, x: Problem, backend: Backend) -> None:
    """Writes the least slack of the rows `giving` that lets them be met together with the rows `kept`."""
    n, rows, count = len(q), x.avoidance, len(giving)
    hessian = np.zeros((n + count, n + count))
    hessian[:n, :n] = _SMALL * P
    hessian[n:, n:] = np.eye(count)
    J = np.zeros((len(kept) + count, n + count))
    J[: len(kept), :n], J[len(kept) :, :n] = rows.J[kept], rows.J[giving]
    J[len(kept) :, n:] = np.eye(count)
    b = np.concatenate((rows.b[kept] - slack[kept], rows.b[giving]))
    lower = np.concatenate((x.hard_lower, np.zeros(count)))
    upper = np.concatenate((x.hard_upper, np.full(count, np.inf)))
    answer = closest(backend, hessian, np.concatenate((_SMALL * q, np.zeros(count))), J, b, lower, upper)
    if answer is None:  # give everything that the bounds could ever take
        slack[giving] = np.inf
    else:
        slack[giving] = np.maximum(rows.b[giving] - rows.J[giving] @ answer[:n], 0.0) + TOLERANCE
