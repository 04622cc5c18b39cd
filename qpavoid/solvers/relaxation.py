"""Relaxation of rows and bounds that contradict each other: margins first, then accelerations, then contact.

Among pairs, the deepest one is relaxed last: first, every pair is kept from contact, from the deepest on; then margins
are restored as far as that allows, in the same order. Acceleration and jerk limits, one set of bounds, are relaxed only
where pairs would get into contact otherwise: relaxed for margins, a few mm/s would cost jumps of a joint with a short
lever arm between its velocity limits. Position and velocity limits are never relaxed.

Only a control step without a safe velocity needs this. It takes longer than others, some tens of small QPs, for slacks
that are no larger than necessary.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from qpavoid import kernels
from qpavoid.problem import Array, AvoidanceRows, IntArray, Problem
from qpavoid.solvers.backends import Backend

TOLERANCE = 1e-6
"""Largest violation of a row [m/s] or bound [rad/s] with which an answer counts as a solution: what back ends reach."""
_LEVEL_WIDTH = 2e-3
"""Difference of distances below which rows are of one level, whose slacks are shared [m]: pairs of one contact."""
_MAX_LEVELS = 4
"""Levels that are relaxed one after the other [-]; all further ones share by least squares: the time is bounded."""
_SMALL = 1e-6
"""Weight of ‖v - v_tracking‖² beside that of the squared slacks [m²/rad²]: small, with digits to spare."""

Closest = Callable[[Array, Array, Array, Array, Array], "Array | None"]
"""(J, b, soft, lower, upper) -> the velocity of least tracking cost with J v >= b within bounds; None without any.

A row of softness c > 0 may be violated by s at the cost of ½ s² / c; with such rows, the other cost is
½ ‖v - v_tracking‖²: the tracking cost, flat in many directions, would leave too few digits."""


class Relaxed(NamedTuple):
    """A velocity and the violations that it takes."""

    v: Array
    """(n,) velocity [rad/s or m/s]."""
    slack: Array
    """(k,) violation of each avoidance row [m/s]."""
    excess: Array
    """(n,) violation of the bounds from acceleration and jerk limits [rad/s or m/s]."""


class _Bounds(NamedTuple):
    """Bounds on v (nv,) [rad/s or m/s]."""

    lower: Array
    upper: Array


def relax(problem: Problem, solve: Closest) -> Relaxed | None:
    """Compute the velocity of least violations, in the order of this module.

    Args:
        problem: rows and bounds that no velocity meets.
        solve: solves its QPs.

    Returns:
        The velocity with its violations; None where those QPs fail.
    """
    rows, bounds = problem.avoidance, _Bounds(problem.lower, problem.upper)
    no_floor, hard_rows = np.full(len(rows.d), -np.inf), np.zeros(len(rows.d))
    b_contact = rows.b_contact - TOLERANCE
    if problem.hard_lower is not problem.lower and solve(rows.J, b_contact, hard_rows, *bounds) is None:
        hard = _Bounds(problem.hard_lower, problem.hard_upper)
        b_contact = b_contact - _lexicographic_slack(rows, b_contact, no_floor, hard, solve)[0]
        bounds = _widened_bounds(problem, b_contact, solve)
    slack, first = _lexicographic_slack(rows, b_contact, no_floor, bounds, solve)
    b_contact = b_contact - slack
    slack, second = _lexicographic_slack(rows, rows.b, b_contact, bounds, solve)
    final = solve(rows.J, np.maximum(b_contact, rows.b - slack) - TOLERANCE, hard_rows, *bounds)
    for v in (final, second, first):  # an earlier one violates a little more, where round-off prevents a later one
        if v is not None:
            excess = np.maximum(np.maximum(v - problem.upper, problem.lower - v), 0.0)
            return Relaxed(v, np.maximum(rows.b - rows.J @ v, 0.0), excess)
    return None


def closest(backend: Backend, P: Array, q: Array, J: Array, b: Array, lower: Array, upper: Array) -> Array | None:
    """Compute the minimiser of ½ vᵀP v + qᵀv with J v >= b, lower <= v <= upper, and verify it.

    Args:
        backend: solves the QP; whatever it raises counts as a failure.
        P: positive definite (n, n).
        q: (n,).
        J: rows (k, n).
        b: right-hand sides (k,).
        lower: lower bounds (n,).
        upper: upper bounds (n,).

    Returns:
        v (n,), clipped to the bounds; None where the back end fails or a violation is above `TOLERANCE`.
    """
    try:
        v = backend(P, q, J, b, lower, upper)
    except Exception:  # whatever a library raises, the robot must get a velocity
        return None
    if v is None or np.shape(v) != q.shape or not kernels.violation(v, J, b, lower, upper) <= TOLERANCE:
        return None  # NaN fails the comparison too
    return np.asarray(np.minimum(np.maximum(v, lower), upper))


def by_back_end(backend: Backend, P: Array, q: Array, v_tracking: Array) -> Closest:
    """Return a function that solves the QPs of a tracking cost by a back end.

    Violations of soft rows become variables.

    Args:
        backend: solves the QPs.
        P: tracking cost ½ vᵀP v + qᵀv (n, n).
        q: its linear part (n,).
        v_tracking: velocity of least cost (n,) [rad/s or m/s].
    """

    def solve(J: Array, b: Array, soft: Array, lower: Array, upper: Array) -> Array | None:
        finite = b > -np.inf
        hard, relaxable = np.flatnonzero(finite & (soft == 0.0)), np.flatnonzero(finite & (soft > 0.0))
        n, count = len(q), len(relaxable)
        if not count:
            return closest(backend, P, q, J[hard], b[hard], lower, upper)
        # a row is violated by √(c / small) s, so that the weights are small and 1, whatever the softness c is
        hessian, rows = np.zeros((n + count, n + count)), np.zeros((len(hard) + count, n + count))
        np.fill_diagonal(hessian[:n, :n], _SMALL)
        np.fill_diagonal(hessian[n:, n:], 1.0)
        rows[: len(hard), :n], rows[len(hard) :, :n] = J[hard], J[relaxable]
        rows[len(hard) :, n:] = np.diag(np.sqrt(soft[relaxable] / _SMALL))
        answer = closest(
            backend,
            hessian,
            np.concatenate((-_SMALL * v_tracking, np.zeros(count))),
            rows,
            np.concatenate((b[hard], b[relaxable])),
            np.concatenate((lower, np.zeros(count))),
            np.concatenate((upper, np.full(count, np.inf))),
        )
        return None if answer is None else answer[:n]

    return solve


def _widened_bounds(x: Problem, b: Array, solve: Closest) -> _Bounds:
    """Widen the bounds as little as possible for some v to meet the rows J v >= b.

    Excesses are minimised in squares, relative to the widths. Where no v meets the rows, the bounds from position and
    velocity limits remain.

    Args:
        x: problem.
        b: right-hand sides of its rows (k,) [m/s].
        solve: solves the QP.
    """
    J, width, eye = x.avoidance.J, np.maximum(x.upper - x.lower, 1e-9), np.eye(len(x.lower))
    G, h = np.concatenate((J, eye, -eye)), np.concatenate((b, x.lower, -x.upper))
    soft = np.concatenate((np.zeros(len(J)), _SMALL * width**2, _SMALL * width**2))
    limited = np.isfinite(h) & np.isfinite(soft)
    v = solve(np.ascontiguousarray(G[limited]), h[limited], soft[limited], x.hard_lower, x.hard_upper)
    if v is None:
        return _Bounds(x.hard_lower, x.hard_upper)
    # each side is widened by itself: no joint may jump in the other direction
    lower, upper = np.minimum(x.lower, v - TOLERANCE), np.maximum(x.upper, v + TOLERANCE)
    return _Bounds(np.maximum(lower, x.hard_lower), np.minimum(upper, x.hard_upper))


def _lexicographic_slack(
    rows: AvoidanceRows, b: Array, floor: Array, bounds: _Bounds, solve: Closest
) -> tuple[Array, Array | None]:
    """Compute the least slacks of the rows J v >= b, level by level from the deepest on.

    The slacks of each level are the least that those before it and the rows J v >= floor, which are feasible, allow.
    The first level that cannot be met is found by bisection, and its slacks minimised in the sum of squares.

    Args:
        rows: with J and the distances.
        b: right-hand sides (k,) [m/s].
        floor: right-hand sides that are not relaxed (k,), -∞ for none [m/s].
        bounds: on v.
        solve: solves the QPs.

    Returns:
        Slacks (k,) [m/s], and a velocity (nv,) that meets the relaxed rows; None where round-off prevents one.
    """
    slack, level = np.zeros(len(rows.d)), _levels(rows.d)
    levels, hard_rows = int(np.max(level, initial=-1)) + 1, np.zeros(len(rows.d))
    best: Array | None = None
    done = 0

    def rhs(count: int) -> Array:
        """Return b - slack of the first `count` levels, the floor of all others."""
        return np.where(level < count, np.maximum(floor, b - slack), floor)

    for attempt in range(_MAX_LEVELS + 1):
        low, high = done, levels + 1  # so many levels can be met, so many cannot
        while high - low > 1:
            middle = levels if high > levels else (low + high) // 2
            v = solve(rows.J, rhs(middle), hard_rows, *bounds)
            low, high, best = (low, middle, best) if v is None else (middle, high, v)
        if low == levels:
            break
        relaxed = (level == low) if attempt < _MAX_LEVELS else (level >= low)
        done = low + 1 if attempt < _MAX_LEVELS else levels
        soft = np.where(relaxed, _SMALL, 0.0)
        v = solve(rows.J, np.where(relaxed, b, rhs(low)), soft, *bounds)
        if v is None:  # their slacks are unlimited
            slack[relaxed] = np.inf
        else:
            slack[relaxed], best = np.maximum(b - rows.J @ v, 0.0)[relaxed] + TOLERANCE, v
    return slack, best


def _levels(d: Array) -> IntArray:
    """Compute the level (k,) of each row by depth, 0 the deepest.

    A level has the rows within `_LEVEL_WIDTH` of its deepest one.

    Args:
        d: distances (k,) [m].
    """
    level, current, start = np.empty(len(d), dtype=np.intp), -1, -np.inf
    for i in np.argsort(d, kind="stable").tolist():
        if current < 0 or d[i] - start > _LEVEL_WIDTH:
            current, start = current + 1, d[i]
        level[i] = current
    return level
