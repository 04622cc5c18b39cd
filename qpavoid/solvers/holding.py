"""What is relaxed of the rows of the dynamics: those that keep gravity holdable, never those of torques."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from qpavoid import kernels
from qpavoid.dynamics import StepDynamics
from qpavoid.problem import Array, Problem
from qpavoid.reason import Reason, ReasonKind, Severity
from qpavoid.solvers.backends import TOLERANCE

_SMALL = 1e-6
"""Softness of the holding rows [rad²]: small, with digits to spare."""
_MIN_RELAXATION = 5.0 * TOLERANCE
"""Violation of a row of holding [1/s] or balance [m/s] that counts."""
_AT_LIMIT = 1e-5
"""Distance of a torque row from its bound below which the torque is at its limit [rad/s or m/s]."""
_AT_EDGE = 1e-7
"""Distance of a force from the edge of its cone below which it is there [N s, scaled]."""

Bounds = tuple[Array, Array]
"""Lower and upper bound (nv,) on v [rad/s or m/s]."""
Closest = Callable[..., "Array | None"]
"""(J, b, lower, upper, soft) -> velocity of least cost, None without any."""


def loosened_holding(dynamics: StepDynamics, J: Array, b: Array, bounds: Bounds, closest: Closest) -> StepDynamics:
    """Return the dynamics with holding rows as they are, or loosened as little as other rows make necessary.

    Args:
        dynamics: of the control step.
        J: rows that come before them (k, nv).
        b: their right-hand sides (k,).
        bounds: on v.
        closest: solves the QP with the torque rows alone.

    Returns:
        Without holding rows, where no slack lets them be met.
    """
    n = dynamics.torque_rows
    H, h = dynamics.J[n:], dynamics.b[n:]
    if not len(h):
        return dynamics
    rows, right = np.concatenate((J, H)), np.concatenate((b, h))
    if closest(rows, right, *bounds) is not None:
        return dynamics
    soft = np.concatenate((np.zeros(len(b)), np.full(len(h), _SMALL)))
    v = closest(rows, right, *bounds, soft)
    return dynamics.with_holding(h[:0] if v is None else h - np.maximum(h - H @ v, 0.0) - TOLERANCE)


def dynamics_reasons(v: Array, problem: Problem, severity: Severity) -> list[Reason]:
    """List the joints whose holding rows a velocity (nv,) violates, and those at a torque limit.

    Args:
        v: of a relaxed step.
        problem: of the step.
        severity: of the joints at a limit: the worst of what is relaxed.
    """
    if (x := problem.dynamics) is None:
        return []
    n, names, units = x.torque_rows, problem.joint_names, problem.joint_units
    violation = x.b - x.J @ v
    if x.points:
        unbalanced = float(violation[n:].max(initial=-np.inf))
        is_off = unbalanced > _MIN_RELAXATION
        reasons = [Reason.of(ReasonKind.BALANCE_RELAXED, "centre of mass", amount=unbalanced, unit="m/s")] * is_off
    else:
        lacking = np.max(violation[n:].reshape(-1, 2), axis=1, initial=-np.inf)
        reasons = [
            Reason.of(ReasonKind.HOLDING_RELAXED, names[x.actuated[r]], amount=float(lacking[r]), unit="1/s")
            for r in np.flatnonzero(lacking > _MIN_RELAXATION).tolist()
        ]
    torques, cones = np.split(violation[:n], [n - kernels.ROWS_PER_POINT * len(x.points)])
    at_limit = torques.reshape(-1, 2).max(axis=1, initial=-np.inf) > -_AT_LIMIT
    for r in np.flatnonzero(at_limit).tolist():
        j, torque = x.actuated[r], float(x.torque(v)[r])
        unit = "Nm" if units[j] == "rad" else "N"
        reasons.append(Reason.of(ReasonKind.AT_TORQUE_LIMIT, names[j], amount=torque, unit=unit, severity=severity))
    at_edge = cones.reshape(-1, kernels.ROWS_PER_POINT).max(axis=1, initial=-np.inf) > -_AT_EDGE
    frames = dict.fromkeys(x.points[i] for i in np.flatnonzero(at_edge))
    return reasons + [Reason.of(ReasonKind.AT_FRICTION_LIMIT, frame, severity=severity) for frame in frames]
