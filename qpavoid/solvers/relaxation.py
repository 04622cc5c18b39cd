"""Relaxation of rows and bounds that contradict each other: margins first, then accelerations, then contact.

Among pairs, the deepest one is relaxed last: first, every pair is kept from contact, from the deepest on; then margins
are restored as far as that allows, in the same order. Acceleration and jerk limits, one set of bounds, are relaxed only
where pairs would get into contact otherwise: relaxed for margins, a few mm/s would cost jumps of a joint with a short
lever arm between its velocity limits. Position and velocity limits are never relaxed.

Only a control step without a safe velocity needs this. It takes longer than others, some tens of small QPs in compiled
code, for slacks that are no larger than necessary.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from qpavoid import kernels
from qpavoid.problem import Array, AvoidanceRows, IntArray, Problem, Solution, Status
from qpavoid.reason import Reason, ReasonKind, Severity
from qpavoid.solvers.backends import TOLERANCE, reduced_rows
from qpavoid.solvers.holding import Bounds, Closest, dynamics_reasons, loosened_holding

_LEVEL_WIDTH = 2e-3
"""Difference of distances below which rows are of one level, whose slacks are shared [m]: pairs of one contact."""
_MAX_LEVELS = 4
"""Levels that are relaxed one after the other [-]; all further ones share by least squares: the time is bounded."""
_SMALL = 1e-6
"""Weight of ‖v - v_tracking‖² beside that of the squared slacks [m²/rad²]: small, with digits to spare."""
_MIN_RELAXATION = 5.0 * TOLERANCE
"""Violation of a row [m/s] or bound [rad/s or m/s] that counts: tolerances of the relaxation add up to 4e-6."""
_CONTACT_TOLERANCE = 1e-5
"""Violation of a row without a margin from which contact is predicted [m/s]: above what those tolerances add up to."""


def relax(problem: Problem, regularization: float) -> Array | None:
    """Compute the velocity (nv,) of least violations, in the order of this module.

    Args:
        problem: rows and bounds that no velocity meets.
        regularization: λ of the tracking cost.

    Returns:
        The velocity; None where a QP fails.
    """
    rows, bounds, dynamics = problem.avoidance, (problem.lower, problem.upper), problem.dynamics
    if dynamics is not None:  # torques first, then contact, then holding, then margins
        problem = problem._replace(dynamics=dynamics.with_holding(dynamics.b[:0]))
        bounds = (problem.hard_lower, problem.hard_upper) if dynamics.torque_rows else bounds
    closest, no_floor = partial(_closest, problem, regularization), np.full(len(rows.d), -np.inf)
    b_contact = rows.b_contact - TOLERANCE
    if bounds[0] is not problem.hard_lower and closest(rows.J, b_contact, *bounds) is None:
        hard = problem.hard_lower, problem.hard_upper
        b_contact = b_contact - _lexicographic_slack(rows, b_contact, no_floor, hard, closest)[0]
        bounds = _widened_bounds(problem, b_contact, closest)
    slack, first = _lexicographic_slack(rows, b_contact, no_floor, bounds, closest)
    b_contact = b_contact - slack
    if dynamics is not None:
        problem = problem._replace(dynamics=loosened_holding(dynamics, rows.J, b_contact, bounds, closest))
        closest = partial(_closest, problem, regularization)
    slack, second = _lexicographic_slack(rows, rows.b, b_contact, bounds, closest)
    final = closest(rows.J, np.maximum(b_contact, rows.b - slack) - TOLERANCE, *bounds)
    # an earlier one violates a little more, where round-off prevents a later one
    return next((v for v in (final, second, first) if v is not None), None)


def project(
    problem: Problem, A: Array, regularization: float, J: Array, b: Array, lower: Array, upper: Array,
    soft: Array | None = None,
) -> Array | None:  # fmt: skip
    """Compute the velocity (nv,) closest to tracking that meets rows, bounds, contacts and the rows of the dynamics.

    See `kernels.project_soft`.

    Args:
        problem: with v_tracking and contacts.
        A: rows of the cost (r, nv).
        regularization: λ.
        J: rows (k, nv).
        b: their right-hand sides (k,) [m/s].
        lower: lower bounds (nv,).
        upper: upper bounds (nv,).
        soft: softness of the rows (k,); all are hard if left out.

    Returns:
        None where there is none.
    """
    v_tracking, contacts = problem.v_tracking, problem.contacts
    soft = np.zeros(len(b)) if soft is None else soft
    if (dynamics := problem.dynamics) is not None:
        J, b = np.concatenate((J, dynamics.J)), np.concatenate((b, dynamics.b))
        soft = np.concatenate((soft, np.zeros(len(dynamics.b))))
    if contacts is None:
        v, solved = kernels.project_soft(A, regularization, v_tracking, J, b, lower, upper, soft)
        return v if solved else None
    Z, start = contacts.Z, contacts.v_particular
    G, h = reduced_rows(Z, start, J, b, lower, upper)
    soft, free = np.concatenate((soft, np.zeros(len(h) - len(b)))), np.full(Z.shape[1], np.inf)
    w, solved = kernels.project_soft(A @ Z, regularization, Z.T @ (v_tracking - start), G, h, -free, free, soft)
    return np.clip(start + Z @ w, lower, upper) if solved else None


def _closest(
    problem: Problem, regularization: float, J: Array, b: Array, lower: Array, upper: Array, soft: Array | None = None
) -> Array | None:
    """Compute the velocity (nv,) of least tracking cost with J v >= b within bounds; None without any.

    A row of softness c > 0 may be violated by s at the cost of ½ s² / c. With such rows, the other cost is
    ½ ‖v - v_tracking‖²: the tracking cost, flat in many directions, would leave too few digits.
    """
    problem.budget.check("relaxation")
    if soft is None:
        return project(problem, problem.tracking.A, regularization, J, b, lower, upper)
    return project(problem, np.zeros((0, len(lower))), 1.0, J, b, lower, upper, soft)


def _widened_bounds(x: Problem, b: Array, closest: Closest) -> Bounds:
    """Widen the bounds as little as possible for some v to meet J v >= b, in squares relative to their widths."""
    J, width, eye = x.avoidance.J, np.maximum(x.upper - x.lower, 1e-9), np.eye(len(x.lower))
    G, h = np.concatenate((J, eye, -eye)), np.concatenate((b, x.lower, -x.upper))
    soft = np.concatenate((np.zeros(len(J)), _SMALL * width**2, _SMALL * width**2))
    limited = np.isfinite(h) & np.isfinite(soft)
    v = closest(np.ascontiguousarray(G[limited]), h[limited], x.hard_lower, x.hard_upper, soft[limited])
    if v is None:
        return x.hard_lower, x.hard_upper
    # each side is widened by itself: no joint may jump in the other direction
    lower, upper = np.minimum(x.lower, v - TOLERANCE), np.maximum(x.upper, v + TOLERANCE)
    return np.maximum(lower, x.hard_lower), np.minimum(upper, x.hard_upper)


def _lexicographic_slack(
    rows: AvoidanceRows, b: Array, floor: Array, bounds: Bounds, closest: Closest
) -> tuple[Array, Array | None]:
    """Compute the least slacks (k,) of J v >= b, level by level from the deepest on, and a velocity (nv,) with them.

    The slacks of each level are the least that those before it and the rows J v >= floor, which are feasible, allow.
    The first level that cannot be met is found by bisection, and its slacks minimised in the sum of squares. The
    velocity is None where round-off prevents one.
    """
    slack, level = np.zeros(len(rows.d)), _levels(rows.d)
    levels, done = int(np.max(level, initial=-1)) + 1, 0
    best: Array | None = None

    def rhs(count: int) -> Array:
        """Return b - slack of the first `count` levels, the floor of all others."""
        return np.where(level < count, np.maximum(floor, b - slack), floor)

    for attempt in range(_MAX_LEVELS + 1):
        low, high = done, levels + 1  # so many levels can be met, so many cannot
        while high - low > 1:
            middle = levels if high > levels else (low + high) // 2
            v = closest(rows.J, rhs(middle), *bounds)
            low, high, best = (low, middle, best) if v is None else (middle, high, v)
        if low == levels:
            break
        relaxed = (level == low) if attempt < _MAX_LEVELS else (level >= low)
        done = low + 1 if attempt < _MAX_LEVELS else levels
        v = closest(rows.J, np.where(relaxed, b, rhs(low)), *bounds, np.where(relaxed, _SMALL, 0.0))
        if v is None:  # their slacks are unlimited
            slack[relaxed] = np.inf
        else:
            slack[relaxed], best = np.maximum(b - rows.J @ v, 0.0)[relaxed] + TOLERANCE, v
    return slack, best


def _levels(d: Array) -> IntArray:
    """Compute the level (k,) of each row by depth, 0 the deepest, with the rows within `_LEVEL_WIDTH` of its first."""
    level, current, start = np.empty(len(d), dtype=np.intp), -1, -np.inf
    for i in np.argsort(d, kind="stable").tolist():
        if current < 0 or d[i] - start > _LEVEL_WIDTH:
            current, start = current + 1, d[i]
        level[i] = current
    return level


def relaxed_solution(v: Array, problem: Problem, *reasons: Reason) -> Solution:
    """Return a relaxed velocity (nv,) as a solution, with `reasons` after those of the relaxation.

    It is SOLVED where nothing is relaxed by more than the tolerance of a QP. Relaxed pairs come first, the deepest one
    at the head, then relaxed limits, then the joints that limit the pairs. The severity of a relaxed row is ALARM where
    its pair may come into contact, WARNING below d1, else INFO; the joints have the worst severity of these.
    """
    rows, names, units = problem.avoidance, problem.joint_names, problem.joint_units
    slack = np.maximum(rows.b - rows.J @ v, 0.0)
    violated = np.flatnonzero(slack > _MIN_RELAXATION)
    violated = violated[np.argsort(rows.d[violated], kind="stable")]
    relaxed = []
    for i in violated.tolist():
        pair, missing = problem.pair_names[rows.pair[i]], float(rows.d1 - rows.d[i])
        touches = rows.b[i] - slack[i] < rows.b_contact[i] - _CONTACT_TOLERANCE
        severity = Severity.ALARM if touches else Severity.WARNING if missing > 0.0 else Severity.INFO
        amount = float(slack[i])
        relaxed.append(Reason.of(ReasonKind.ROW_RELAXED, *pair, amount=amount, unit="m/s", severity=severity))
        if missing > 0.0:
            relaxed.append(
                Reason.of(ReasonKind.BELOW_SAFETY_DISTANCE, *pair, amount=missing, unit="m", severity=severity)
            )
    worst = max([reason.severity for reason in relaxed], default=Severity.INFO)
    kind = ReasonKind.JERK_RELAXED if problem.jerk_limited else ReasonKind.ACCELERATION_RELAXED
    excess = np.maximum(np.maximum(v - problem.upper, problem.lower - v), 0.0)
    passed = [
        Reason.of(kind, names[j], amount=float(excess[j]), unit=f"{units[j]}/s")
        for j in np.flatnonzero(excess > _MIN_RELAXATION).tolist()
    ]
    limiting = _limiting_joints(rows.J[violated], v, problem, worst)
    reasons = (*relaxed, *passed, *limiting, *dynamics_reasons(v, problem, worst), *reasons)
    if not reasons:
        return Solution(np.clip(v, problem.lower, problem.upper))
    return Solution(v, Status.RELAXED, reasons, slack if slack.any() else None)


def _limiting_joints(J: Array, v: Array, problem: Problem, severity: Severity) -> list[Reason]:
    """List the joints at a limit beyond which the violated rows J (k, nv) would improve.

    A bound below the full speed comes from a position limit.
    """
    lower, upper = problem.hard_lower, problem.hard_upper
    reasons: list[Reason] = []
    contributes = np.abs(J) > 0.05 * np.max(np.abs(J), axis=1, initial=0.0)[:, None]
    fastest = np.maximum(upper, -lower)
    for kind, limit, improves in (
        (ReasonKind.AT_LOWER_LIMIT, lower, J < 0.0),
        (ReasonKind.AT_UPPER_LIMIT, upper, J > 0.0),
    ):
        at_limit = (np.abs(v - limit) <= 1e-5) & (contributes & improves).any(axis=0)
        for j in np.flatnonzero(at_limit).tolist():
            name, unit = problem.joint_names[j], f"{problem.joint_units[j]}/s"
            what = ReasonKind.AT_VELOCITY_LIMIT if abs(limit[j]) >= fastest[j] else kind
            amount = float(limit[j]) + 0.0  # no negative zero
            reasons.append(Reason.of(what, name, amount=amount, unit=unit, severity=severity))
    return sorted(reasons, key=lambda reason: reason.subject)
