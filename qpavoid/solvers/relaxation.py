"""What gives way when rows and bounds contradict each other: margins, then accelerations, then contact.

Among pairs, the deepest threat gives way last: first, every pair is kept from touching, from the deepest on; then
margins are restored as far as that allows, in the same order. Acceleration limits give way only where pairs would
touch otherwise: given up for margins, a few mm/s cost jumps of a joint with a short lever between its velocity limits.
Position and velocity limits never give way.

Only a tick that has no safe velocity comes here, so its QPs are solved cold and one after the other: such a tick takes
longer, for an answer that gives up no more than it must.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from qpavoid import kernels
from qpavoid.problem import Array, AvoidanceRows, IntArray, Problem
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
    rows, within = problem.avoidance, _Bounds(problem.lower, problem.upper)
    nothing = np.full(len(rows.d), -np.inf)
    touch = rows.touch - TOLERANCE
    if problem.hard_lower is not problem.lower and _solve(P, q, rows, touch, within, backend) is None:
        hard = _Bounds(problem.hard_lower, problem.hard_upper)
        touch = touch - _lexicographic_slack(P, q, rows, touch, nothing, hard, backend)
        within = _least_excess(P, q, problem, touch, backend)
    touch = touch - _lexicographic_slack(P, q, rows, touch, nothing, within, backend)
    slack = _lexicographic_slack(P, q, rows, rows.b, touch, within, backend)
    v = _solve(P, q, rows, np.maximum(touch, rows.b - slack) - TOLERANCE, within, backend)
    if v is None:
        return None
    excess = np.maximum(np.maximum(v - problem.upper, problem.lower - v), 0.0)
    return Relaxed(v, np.maximum(rows.b - rows.J @ v, 0.0), excess)


class _Bounds(NamedTuple):
    lower: Array
    upper: Array


def closest(backend: Backend, P: Array, q: Array, J: Array, b: Array, lower: Array, upper: Array) -> Array | None:
    """Minimiser of ½ vᵀP v + qᵀv within rows and bounds; None when the back end fails or its answer does not verify."""
    try:
        v = backend(P, q, J, b, lower, upper)
    except Exception:  # whatever a library raises, the robot must get a velocity
        return None
    if v is None or np.shape(v) != q.shape or not kernels.shortfall(v, J, b, lower, upper) <= TOLERANCE:
        return None  # NaN fails the comparison too
    return np.asarray(np.minimum(np.maximum(v, lower), upper))


def _least_excess(P: Array, q: Array, x: Problem, least: Array, backend: Backend) -> _Bounds:
    """Bounds widened just so far, in squares of their widths, that some v meets the rows J v >= least.

    Where nothing does, the velocity limits are all that is left.
    """
    n, J = len(q), x.avoidance.J
    room = np.maximum(x.upper - x.lower, 1e-9)
    eye = np.eye(n)
    G = np.block([[J, np.zeros_like(J)], [eye, eye], [-eye, eye]])
    b = np.concatenate((least, x.lower, -x.upper))
    finite = np.isfinite(b)
    G, b = np.ascontiguousarray(G[finite]), b[finite]
    hessian = np.zeros((2 * n, 2 * n))
    lower = np.concatenate((x.hard_lower, np.zeros(n)))
    upper = np.concatenate((x.hard_upper, np.full(n, np.inf)))
    answer = None
    for small in (_SMALL, 1e2 * _SMALL, 1e3 * _SMALL):  # daqp fails on some of the first
        hessian[:n, :n], hessian[n:, n:] = small * P, np.diag(1.0 / room**2)
        answer = closest(backend, hessian, np.concatenate((small * q, np.zeros(n))), G, b, lower, upper)
        if answer is not None:
            break
    if answer is None:
        return _Bounds(x.hard_lower, x.hard_upper)
    v = answer[:n]  # each side gives for itself: no joint gets room to jump the other way
    lower, upper = np.minimum(x.lower, v - TOLERANCE), np.maximum(x.upper, v + TOLERANCE)
    return _Bounds(np.maximum(lower, x.hard_lower), np.minimum(upper, x.hard_upper))


def _lexicographic_slack(
    P: Array, q: Array, rows: AvoidanceRows, b: Array, floor: Array, within: _Bounds, backend: Backend
) -> Array:
    """Slack (k,) of the rows J v >= b, level by level from the deepest threat on.

    Each level gives only what those before it and the rows J v >= floor, which can be met, force it to.
    """
    slack = np.zeros(len(rows.d))
    levels = _levels(rows.d)

    def least(count: int) -> Array:
        """Right-hand sides with the first `count` levels at their bounds, less their slack, the others at the floor."""
        chosen = np.concatenate([*levels[:count], np.zeros(0, dtype=np.intp)])
        bound = floor.copy()
        bound[chosen] = np.maximum(floor[chosen], b[chosen] - slack[chosen])
        return np.asarray(bound)

    def feasible(count: int) -> bool:
        return _solve(P, q, rows, least(count), within, backend) is not None

    done = 0
    for _ in range(_MOST_LEVELS):
        done = _last_true(feasible, done, len(levels))
        if done == len(levels):
            return slack
        _give(slack, levels[done], P, q, rows, b, least(done), within, backend)
        done += 1
    if done < len(levels):
        _give(slack, np.concatenate(levels[done:]), P, q, rows, b, least(done), within, backend)
    return slack


def _solve(P: Array, q: Array, rows: AvoidanceRows, least: Array, within: _Bounds, backend: Backend) -> Array | None:
    """`closest` with those of the rows J v >= least that ask for something."""
    asking = np.flatnonzero(least > -np.inf)
    return closest(backend, P, q, rows.J[asking], least[asking], *within)


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


def _give(
    slack: Array, giving: IntArray, P: Array, q: Array, rows: AvoidanceRows, b: Array, least: Array, within: _Bounds,
    backend: Backend,
) -> None:  # fmt: skip
    """Writes the least slack of the rows `giving` with which they can be met together with J v >= least."""
    n, count = len(q), len(giving)
    asking = np.flatnonzero(least > -np.inf)
    hessian = np.zeros((n + count, n + count))
    hessian[:n, :n], hessian[n:, n:] = _SMALL * P, np.eye(count)
    J = np.zeros((len(asking) + count, n + count))
    J[: len(asking), :n], J[len(asking) :, :n] = rows.J[asking], rows.J[giving]
    J[len(asking) :, n:] = np.eye(count)
    lower = np.concatenate((within.lower, np.zeros(count)))
    upper = np.concatenate((within.upper, np.full(count, np.inf)))
    right = np.concatenate((least[asking], b[giving]))
    answer = closest(backend, hessian, np.concatenate((_SMALL * q, np.zeros(count))), J, right, lower, upper)
    if answer is None:  # give everything that the bounds could ever take
        slack[giving] = np.inf
    else:
        slack[giving] = np.maximum(b[giving] - rows.J[giving] @ answer[:n], 0.0) + TOLERANCE
