"""Reasons of a relaxed solution: pairs, joints and amounts."""

from __future__ import annotations

import numpy as np

from qpavoid.problem import Array, Problem
from qpavoid.reason import Reason, ReasonKind, Severity
from qpavoid.solvers.relaxation import TOLERANCE, Relaxed

_MIN_RELAXATION = 5.0 * TOLERANCE
"""Violation of a row [m/s] or bound [rad/s or m/s] that counts: tolerances of the relaxation add up to 4e-6."""
_CONTACT_TOLERANCE = 1e-5
"""Violation of a row without a margin from which contact is predicted [m/s]: above what those tolerances add up to."""


def relaxation_reasons(relaxed: Relaxed, problem: Problem) -> tuple[Reason, ...]:
    """List relaxed pairs, the deepest first, then relaxed limits, then the joints that limit the pairs.

    The severity of a relaxed row is ALARM where its pair may come into contact, WARNING below d1, else INFO; the joints
    that limit the rows have the worst severity of these.

    Args:
        relaxed: the velocity, with its slacks.
        problem: the one that it solves.
    """
    slack, excess = relaxed.slack, relaxed.excess
    rows, names, units = problem.avoidance, problem.joint_names, problem.joint_units
    violated = np.flatnonzero(slack > _MIN_RELAXATION)
    violated = violated[np.argsort(rows.d[violated], kind="stable")]
    reasons = []
    for i in violated.tolist():
        pair, missing = problem.pair_names[rows.pair[i]], float(rows.d1 - rows.d[i])
        touches = rows.b[i] - slack[i] < rows.b_contact[i] - _CONTACT_TOLERANCE
        severity = Severity.ALARM if touches else Severity.WARNING if missing > 0.0 else Severity.INFO
        amount = float(slack[i])
        reasons.append(Reason.of(ReasonKind.ROW_RELAXED, *pair, amount=amount, unit="m/s", severity=severity))
        if missing > 0.0:
            reasons.append(
                Reason.of(ReasonKind.BELOW_SAFETY_DISTANCE, *pair, amount=missing, unit="m", severity=severity)
            )
    kind = ReasonKind.JERK_RELAXED if problem.jerk_limited else ReasonKind.ACCELERATION_RELAXED
    passed = [
        Reason.of(kind, names[j], amount=float(excess[j]), unit=f"{units[j]}/s")
        for j in np.flatnonzero(excess > _MIN_RELAXATION).tolist()
    ]
    worst = max([reason.severity for reason in reasons], default=Severity.INFO)
    return (*reasons, *passed, *_limiting_joints(rows.J[violated], relaxed.v, problem, worst))


def _limiting_joints(J: Array, v: Array, problem: Problem, severity: Severity) -> list[Reason]:
    """List the joints at a limit beyond which the violated rows would improve.

    A bound below the full speed comes from a position limit.

    Args:
        J: violated rows (k, nv).
        v: velocity (nv,).
        problem: with the limits and the names of the joints.
        severity: of the reasons.
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
            full = abs(limit[j]) >= fastest[j]
            reasons.append(
                Reason.of(
                    ReasonKind.AT_VELOCITY_LIMIT if full else kind,
                    problem.joint_names[j],
                    amount=float(limit[j]) + 0.0,  # no negative zero
                    unit=f"{problem.joint_units[j]}/s",
                    severity=severity,
                )
            )
    return sorted(reasons, key=lambda reason: reason.subject)
