"""Recovery: slow, where nothing but the robot itself is the cause.

Rows ask pairs below d1 to part, and bounds ask joints beyond a limit to come back. What joint speeds that takes is up
to Jacobians and tasks: several rad/s for neighbouring links, or where other joints hold the tool meanwhile. A robot
that should rest must not start like that, so that the whole velocity is slowed down towards a stop, until no joint
exceeds its recovery speed: the robot goes the same way, in more time.

An obstacle that comes is evaded as fast as it can be: the faster one near approaches, the less is slowed. Neither is a
task that leaves by itself, at a velocity that meets all rows and bounds.
"""

from __future__ import annotations

import numpy as np

from qpavoid.kernels import speed_to_stop
from qpavoid.kernels.step import TOLERATED_DEPTH
from qpavoid.model.limits import JointBounds
from qpavoid.problem import Array, Problem, Solution
from qpavoid.reason import Reason, ReasonKind

_COMING = 0.05
"""Speed of an obstacle towards a body from which nothing is slowed down [m/s]: beyond what noise makes of a rest."""

_NO_LEVER = 1e-6
"""Entry of a distance Jacobian up to which a joint does not move the pair: round-off of axes in files [m/rad or 1]."""


def recovery_limits(
    problem: Problem, feedforward: Array, bounds: JointBounds, v_prev: Array, dt: float
) -> tuple[Array, Array] | None:
    """Return the least and largest velocities (nv,), (nv,) in recovery; None where the robot does not recover.

    They come down to `JointBounds.recovery` between the tolerated depth or excess and twice of it, and grow without
    bound with the speed at which an obstacle comes. A joint with a jerk limit comes to them without overshoot.

    Args:
        problem: of this control step.
        feedforward: rate of the distances of its pairs due to the obstacles (k,) [m/s].
        bounds: limits of the joints.
        v_prev: velocity (nv,) of the control step before.
        dt: control period [s].
    """
    degree = max(float(_depths(problem).max(initial=0.0)), -problem.position_margin) / TOLERATED_DEPTH - 1.0
    rest = 1.0 + float(feedforward.min(initial=0.0)) / _COMING
    if not (degree > 0.0 and rest > 0.0):
        return None
    fastest = bounds.recovery / (min(degree, 1.0) * rest)
    lower, upper = -fastest, fastest
    if problem.jerk_limited:
        change = bounds.finite_dv_step(dt)
        fall, rise = (speed_to_stop(np.maximum(fastest - v, 0.0), change, 1.0) for v in (-v_prev, v_prev))
        lower, upper = np.maximum(lower, v_prev - fall), np.minimum(upper, v_prev + rise)
    return lower, upper


def slowed(v: Array, v_stop: Array, limits: tuple[Array, Array]) -> tuple[Array, float]:
    """Return v (nv,) slowed down towards the stop until it is within limits, and its share [-].

    Args:
        v: velocity (nv,).
        v_stop: that of a stop (nv,), which is allowed anyway.
        limits: of `recovery_limits`.
    """
    change = v - v_stop
    limit = np.where(change > 0.0, np.maximum(limits[1], v_stop), np.minimum(limits[0], v_stop))
    shares = (limit - v_stop) / np.where(change == 0.0, np.inf, change)
    scale = float(np.min(shares, where=change != 0.0, initial=1.0))
    return (v, 1.0) if scale == 1.0 else (v_stop + scale * change, scale)


def slow_recovery(
    q: Array, problem: Problem, solution: Solution, limits: tuple[Array, Array] | None, bounds: JointBounds
) -> Solution:
    """Return the solution, slowed down, as RELAXED, with what the robot recovers from as reasons.

    Args:
        q: configuration (nq,).
        problem: of this control step.
        solution: of the problem.
        limits: of `recovery_limits`; None to slow nothing down.
        bounds: limits of the joints.
    """
    rows, depth = problem.avoidance, _depths(problem)
    named = {reason.subject for reason in solution.reasons if reason.kind is ReasonKind.BELOW_SAFETY_DISTANCE}
    reasons = list(bounds.outside(q, problem.joint_names, problem.joint_units, TOLERATED_DEPTH))
    for i in np.flatnonzero(depth > TOLERATED_DEPTH).tolist():
        pair = problem.pair_names[rows.pair[i]]
        if pair not in named:
            reasons.append(Reason.of(ReasonKind.BELOW_SAFETY_DISTANCE, *pair, amount=float(depth[i]), unit="m"))
    if limits is not None:
        v, scale = slowed(solution.v, problem.v_stop, limits)
        if scale < 1.0:
            slack = np.maximum(rows.b - rows.J @ v, 0.0)
            solution = solution._replace(v=v, slack=slack, command_scale=scale)
    return solution.with_reasons(*reasons)


def _depths(problem: Problem) -> Array:
    """Return how much nearer than d1 each pair is (k,) [m]; 0 for a base that stands on something, without a way."""
    rows = problem.avoidance
    depth = rows.d1 - rows.d
    return np.where(np.abs(rows.J).max(axis=1) > _NO_LEVER, depth, 0.0) if depth.max(initial=0.0) > 0.0 else depth
