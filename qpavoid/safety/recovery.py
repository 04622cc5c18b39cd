"""Recovery: slow, where nothing but the robot itself is the cause.

Rows ask pairs below d1 to part, and bounds ask joints beyond a limit to come back. What joint speeds that takes is up
to Jacobians and tasks: several rad/s for neighbouring links, or where other joints hold the tool meanwhile. A robot
that should rest must not start like that, so that the whole velocity is slowed down towards a stop, until no joint
exceeds its recovery speed: the robot goes the same way, in more time.

An obstacle that moves may be coming, and is evaded as fast as it can be: while anything near moves, nothing is slowed.
Neither is a task that leaves by itself, at a velocity that meets all rows and bounds.
"""

from __future__ import annotations

import numpy as np

from qpavoid.model.limits import JointBounds
from qpavoid.problem import Array, Problem, Solution
from qpavoid.reason import Reason, ReasonKind

_TOLERATED = 1e-3
"""Depth below the safety distance [m], or excess over a position limit [rad or m], that slows nothing down: noise and
control periods lead that far."""


def slow_recovery(q: Array, problem: Problem, feedforward: Array, solution: Solution, bounds: JointBounds) -> Solution:
    """Return the solution, slowed down where the robot recovers, as RELAXED, with what it recovers from as reasons.

    From the tolerated depth or excess to twice of it, the largest speeds fall to those of recovery.

    Args:
        q: configuration (nq,).
        problem: of this control step.
        feedforward: rate of the distances of its pairs due to the obstacles (k,) [m/s].
        solution: of the problem.
        bounds: limits of the joints.
    """
    rows = problem.avoidance
    depth = rows.d1 - rows.d
    degree = max(float(depth.max(initial=0.0)), -problem.position_margin) / _TOLERATED - 1.0
    if not degree > 0.0 or feedforward.any():
        return solution
    fastest, v_stop = bounds.recovery / min(degree, 1.0), problem.v_stop
    change = solution.v - v_stop
    limit = np.where(change > 0.0, np.maximum(fastest, v_stop), np.minimum(-fastest, v_stop))
    shares = (limit - v_stop) / np.where(change == 0.0, np.inf, change)
    scale = float(np.min(shares, where=change != 0.0, initial=1.0))
    if scale == 1.0:
        return solution
    v = v_stop + scale * change
    named = {reason.subject for reason in solution.reasons if reason.kind is ReasonKind.BELOW_SAFETY_DISTANCE}
    reasons = list(bounds.outside(q, problem.joint_names, problem.joint_units))
    for i in np.flatnonzero(depth > _TOLERATED).tolist():
        pair = problem.pair_names[rows.pair[i]]
        if pair not in named:
            reasons.append(Reason.of(ReasonKind.BELOW_SAFETY_DISTANCE, *pair, amount=float(depth[i]), unit="m"))
    slack = np.maximum(rows.b - rows.J @ v, 0.0)
    return solution._replace(v=v, slack=slack, command_scale=scale).with_reasons(*reasons)
