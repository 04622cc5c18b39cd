"""Reasons of a relaxed solution: pairs, joints and amounts."""

from __future__ import annotations

import numpy as np

from qpavoid.problem import Array, Problem
from qpavoid.reason import Reason, ReasonKind, Severity
from qpavoid.solvers.relaxation import TOLERANCE, Relaxed

_USED = 5.0 * TOLERANCE
"""Violation of a row [m/s] or bound [rad/s or m/s] that counts: tolerances of the relaxation add up to 4e-6."""
_CONTACT = 1e-5
"""Violation of a row with no margin from which contact is predicted [m/s]."""


def relaxation_reasons(relaxed: Relaxed, problem: Problem) -> tuple[Reason, ...]:
    """List each relaxed pair, the deepest first, then accelerations and jerks passed, then joints that limit pairs.

    A relaxed row alarms where its pair may come into contact, warns below d1, and else informs; the joints that limit
    the rows have the worst severity of these.

    Args:
        relaxed: the solution.
        problem: what it is a solution of.
    """
    slack, excess = relaxed.slack, relaxed.excess
    rows, names, units = problem.avoidance, problem.joint_names, problem.joint_units
    violated = np.flatnonzero(slack > _USED)
    violated = violated[np.argsort(rows.d[violated], kind="stable")]
    found = []
    for i in violated.tolist():
        pair, missing = problem.pair_names[rows.pair[i]], float(rows.d1 - rows.d[i])
        touches = rows.b[i] - slack[i] < rows.b_contact[i] - _CONTACT
        severity = Severity.ALARM if touches else Severity.WARNING if missing > 0.0 else Severity.INFO
        amount = float(slack[i])
        found.append(Reason.of(ReasonKind.ROW_RELAXED, *pair, amount=amount, unit="m/s", severity=severity))
        if missing > 0.0:
            found.append(
                Reason.of(ReasonKind.BELOW_SAFETY_DISTANCE, *pair, amount=missing, unit="m", severity=severity)
            )
    kind = ReasonKind.JERK_RELAXED if problem.jerk_limited else ReasonKind.ACCELERATION_RELAXED
    passed = [
        Reason.of(kind, names[j], amount=float(excess[j]), unit=f"{units[j]}/s")
        for j in np.flatnonzero(excess > _USED).tolist()
    ]
    worst = max([reason.severity for reason in found], default=Severity.INFO)
    return (*found, *passed, *_limiting_joints(rows.J[violated], relaxed.v, problem, worst))


def _limiting_joints(J: Array, v: Array, problem: Problem, severity: Severity) -> list[Reason]:
    """Joints at a limit of which the rows J (k, nv) want more; a bound below the full speed is of a position limit."""
    lower, upper = problem.hard_lower, problem.hard_upper
    found: list[Reason] = []
    matters = np.abs(J) > 0.05 * np.max(np.abs(J), axis=1, initial=0.0)[:, None]
    fastest = np.maximum(upper, -lower)
    for kind, limit, wanted in (
        (ReasonKind.AT_LOWER_LIMIT, lower, J < 0.0),
        (ReasonKind.AT_UPPER_LIMIT, upper, J > 0.0),
    ):
        at_limit = (np.abs(v - limit) <= 1e-5) & (matters & wanted).any(axis=0)
        for j in np.flatnonzero(at_limit).tolist():
            full = abs(limit[j]) >= fastest[j]
            found.append(
                Reason.of(
                    ReasonKind.AT_VELOCITY_LIMIT if full else kind,
                    problem.joint_names[j],
                    amount=float(limit[j]) + 0.0,  # no negative zero
                    unit=f"{problem.joint_units[j]}/s",
                    severity=severity,
                )
            )
    return sorted(found, key=lambda reason: reason.subject)
