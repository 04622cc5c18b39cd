"""What gives way when rows and bounds contradict each other: margins, then accelerations, then contact.

Among pairs, the deepest threat gives way last: first, every pair is kept from touching, from the deepest on; then
margins are restored as far as that allows, in the same order. Acceleration and jerk limits, one set of bounds, give way
only where pairs would touch otherwise: given up for margins, a few mm/s cost jumps of a joint with a short lever
between its velocity limits. Position and velocity limits never give way.

Only a tick that has no safe velocity comes here. It takes longer than others, some tens of small QPs, for an answer
that gives up no more than it must.
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
_MOST_LEVELS = 4
"""Levels that are relaxed one after the other; what is left shares by least squares, so that the time is bounded."""
_SMALL = 1e-6
"""Weight of the way to v0 beside that of what is given up."""

Closest = Callable[[Array, Array, Array, Array, Array], "Array | None"]
"""(J, least, soft, lower, upper) -> the velocity of least tracking cost with J v >= least within bounds; None without.

A row of softness c > 0 may fall short by s at the cost of ½ s² / c; where there are such, the cost beside is
½ ‖v - v0‖²: the tracking cost, flat in many directions, would leave too few digits."""


class Relaxed(NamedTuple):
    """A velocity and what was given up for it."""

    v: Array
    """(n,)."""
    slack: Array
    """(k,) what each avoidance row gave way [m/s]."""
    excess: Array
    """(n,) by how much each coordinate passes what its acceleration and jerk limits allow [rad/s or m/s]."""


class _Bounds(NamedTuple):
    lower: Array
    upper: Array


def relax(problem: Problem, solve: Closest) -> Relaxed | None:
    """The velocity that gives up least.

    Args:
        problem: rows and bounds that no velocity meets.
        solve: solves its QPs.

    Returns:
        None where those fail.
    """
    rows, within = problem.avoidance, _Bounds(problem.lower, problem.upper)
    nothing, hard_rows = np.full(len(rows.d), -np.inf), np.zeros(len(rows.d))
    touch = rows.b_contact - TOLERANCE
    if problem.hard_lower is not problem.lower and solve(rows.J, touch, hard_rows, *within) is None:
        hard = _Bounds(problem.hard_lower, problem.hard_upper)
        touch = touch - _lexicographic_slack(rows, touch, nothing, hard, solve)[0]
        within = _least_excess(problem, touch, solve)
    slack, first = _lexicographic_slack(rows, touch, nothing, within, solve)
    touch = touch - slack
    slack, second = _lexicographic_slack(rows, rows.b, touch, within, solve)
    final = solve(rows.J, np.maximum(touch, rows.b - slack) - TOLERANCE, hard_rows, *within)
    for v in (final, second, first):  # an earlier one gives up a little more, where round-off leaves no later one
        if v is not None:
            excess = np.maximum(np.maximum(v - problem.upper, problem.lower - v), 0.0)
            return Relaxed(v, np.maximum(rows.b - rows.J @ v, 0.0), excess)
    return None


def closest(backend: Backend, P: Array, q: Array, J: Array, b: Array, lower: Array, upper: Array) -> Array | None:
    """Minimiser of ½ vᵀP v + qᵀv within rows and bounds; None when the back end fails or its answer does not verify."""
    try:
        v = backend(P, q, J, b, lower, upper)
    except Exception:  # whatever a library raises, the robot must get a velocity
        return None
    if v is None or np.shape(v) != q.shape or not kernels.violation(v, J, b, lower, upper) <= TOLERANCE:
        return None  # NaN fails the comparison too
    return np.asarray(np.minimum(np.maximum(v, lower), upper))


def by_back_end(backend: Backend, P: Array, q: Array, v_tracking: Array) -> Closest:
    """Lets a back end solve the QPs of a tracking cost ½ vᵀP v + qᵀv: what soft rows lack becomes a variable."""

    def solve(J: Array, least: Array, soft: Array, lower: Array, upper: Array) -> Array | None:
        asking = least > -np.inf
        hard, giving = np.flatnonzero(asking & (soft == 0.0)), np.flatnonzero(asking & (soft > 0.0))
        n, count = len(q), len(giving)
        if not count:
            return closest(backend, P, q, J[hard], least[hard], lower, upper)
        # a row lacks √(c / small) s, so that the weights are small and 1, whatever the softness c is
        hessian, rows = np.zeros((n + count, n + count)), np.zeros((len(hard) + count, n + count))
        np.fill_diagonal(hessian[:n, :n], _SMALL)
        np.fill_diagonal(hessian[n:, n:], 1.0)
        rows[: len(hard), :n], rows[len(hard) :, :n] = J[hard], J[giving]
        rows[len(hard) :, n:] = np.diag(np.sqrt(soft[giving] / _SMALL))
        answer = closest(
            backend,
            hessian,
            np.concatenate((-_SMALL * v_tracking, np.zeros(count))),
            rows,
            np.concatenate((least[hard], least[giving])),
            np.concatenate((lower, np.zeros(count))),
            np.concatenate((upper, np.full(count, np.inf))),
        )
        return None if answer is None else answer[:n]

    return solve


def _least_excess(x: Problem, least: Array, solve: Closest) -> _Bounds:
    """Bounds widened just so far, in squares of their widths, that some v meets the rows J v >= least.

    Where nothing does, the velocity limits are all that is left.
    """
    J, room, eye = x.avoidance.J, np.maximum(x.upper - x.lower, 1e-9), np.eye(len(x.lower))
    G, h = np.concatenate((J, eye, -eye)), np.concatenate((least, x.lower, -x.upper))
    soft = np.concatenate((np.zeros(len(J)), _SMALL * room**2, _SMALL * room**2))
    limited = np.isfinite(h) & np.isfinite(soft)
    v = solve(np.ascontiguousarray(G[limited]), h[limited], soft[limited], x.hard_lower, x.hard_upper)
    if v is None:
        return _Bounds(x.hard_lower, x.hard_upper)
    # each side gives for itself: no joint gets room to jump the other way
    lower, upper = np.minimum(x.lower, v - TOLERANCE), np.maximum(x.upper, v + TOLERANCE)
    return _Bounds(np.maximum(lower, x.hard_lower), np.minimum(upper, x.hard_upper))


def _lexicographic_slack(
    rows: AvoidanceRows, b: Array, floor: Array, within: _Bounds, solve: Closest
) -> tuple[Array, Array | None]:
    """Slack (k,) of the rows J v >= b, level by level from the deepest threat on, and a velocity that meets them so.

    Each level gives only what those before it and the rows J v >= floor, which can be met, force it to.
    """
    slack, level = np.zeros(len(rows.d)), _levels(rows.d)
    levels, nothing = int(np.max(level, initial=-1)) + 1, np.zeros(len(rows.d))
    best: Array | None = None
    done = 0

    def asked(count: int) -> Array:
        """Right-hand sides with the first `count` levels at their bounds, less their slack, the others at the floor."""
        return np.where(level < count, np.maximum(floor, b - slack), floor)

    for attempt in range(_MOST_LEVELS + 1):
        low, high = done, levels + 1  # so many levels can be met, so many cannot
        while high - low > 1:
            middle = levels if high > levels else (low + high) // 2
            v = solve(rows.J, asked(middle), nothing, *within)
            low, high, best = (low, middle, best) if v is None else (middle, high, v)
        if low == levels:
            break
        giving = (level == low) if attempt < _MOST_LEVELS else (level >= low)
        done = low + 1 if attempt < _MOST_LEVELS else levels
        soft = np.where(giving, _SMALL, 0.0)
        v = solve(rows.J, np.where(giving, b, asked(low)), soft, *within)
        if v is None:  # they give everything that the bounds could ever take
            slack[giving] = np.inf
        else:
            slack[giving], best = np.maximum(b - rows.J @ v, 0.0)[giving] + TOLERANCE, v
    return slack, best


def _levels(d: Array) -> IntArray:
    """Level (k,) of each row, by depth, 0 the deepest: each holds what lies within `_LEVEL` of its deepest one."""
    level, current, start = np.empty(len(d), dtype=np.intp), -1, -np.inf
    for i in np.argsort(d, kind="stable").tolist():
        if current < 0 or d[i] - start > _LEVEL:
            current, start = current + 1, d[i]
        level[i] = current
    return level
