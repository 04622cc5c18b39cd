"""Rollout of a backup trajectory, pose by pose: it pauses after as many as asked for, and a later call goes on.

What compiled code cannot do is left to the caller: `advance_rollout` returns with a request, and goes on afterwards.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.backup import backup_rows, closes_below, max_offset
from qpavoid.kernels.kinematics import update_kinematics
from qpavoid.kernels.near_pairs import place_bodies, place_obstacles
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.prediction import Prediction, predict
from qpavoid.kernels.qp import max_clearance_velocity
from qpavoid.kernels.ramps import RampLimits, follow_ramp
from qpavoid.kernels.rollout_pairs import PairMemory, forget_pairs, near_pairs_along
from qpavoid.problem import Array, Mask

HORIZON = 1.5
"""Time for which a backup trajectory has to stay clear [s]: longer than an arm needs to stop or to step aside."""
BEYOND = 0.1
"""Time by which a rollout exceeds the horizon [s], so that it stays valid for some control steps."""
PREFERRED_DISTANCE = 0.1
"""c: distance from which on a pair is not parted any farther [m]: the default influence distance of the rows."""
TOUCH = 1e-3
"""Distance below which a pair counts as in contact [m]: above the error of any distance algorithm in use."""
_EFFORT_WEIGHT = 1e-4
"""ε: weight of the square of a joint speed beside that of a distance [m²/(rad/s)²]; only breaks ties."""
_MAX_DEPTH = 10.0
"""Lower bound of s in the QP [m]: deeper than any penetration."""
_TIME_TOLERANCE = 1e-9
"""Difference of two times that counts as none [s]."""

PAUSED, FINISHED, DROPPED, TO_MEASURE, TO_MOVE, NOT_FINITE = range(6)
"""Why `advance_rollout` returns: all poses that were asked for are evaluated; the trajectory is whole; it is no better
than the one to beat; distances of the pose are to be computed; configurations up to the next decision;
the state of an obstacle is NaN or infinite."""
PLACE, MEASURED, DECIDE, MOVED = range(4)
"""What comes next: a pose is to be evaluated, its distances are known, a decision is due, its path is known."""
_START, _MIDWAY, _END = range(3)
"""Pose that is evaluated: the first, between two decisions, at a decision."""

PROGRESS = np.dtype(
    [
        # constant
        ("dt", float), ("period_steps", np.intp), ("influence_distance", float), ("sufficient", float),
        ("measures_outside", bool), ("completes_outside", bool), ("moves_outside", bool),
        # given at its start
        ("end", float), ("deadline", float), ("horizon", float), ("prefix_steps", np.intp),
        # how far it is
        ("stage", np.intp), ("pose", np.intp), ("poses", np.intp), ("t", float), ("steps", np.intp),
        ("count", np.intp), ("t_pose", float), ("span", float),
        ("rows", np.intp), ("near", np.intp), ("is_moving", bool),
        # what came of it
        ("contact_time", float), ("lost_time", float), ("clearance", float), ("clearance_before", float),
        # the score to beat
        ("least_time", float), ("least_clearance", float),
    ],
    align=True,
)  # fmt: skip
"""Numbers of a rollout.

dt: control period [s]; period_steps: control steps between two decisions; influence_distance: below which a pair
counts [m]; sufficient: clearance from which on a trajectory need not be improved [m]; measures_outside: the caller
computes all distances; completes_outside: those that kernels do not; moves_outside: configurations. end: time at
which it ends; deadline: at which contacts are forgiven [s]; horizon: of the policy, 0 of a stop [s]; prefix_steps:
control steps before the policy decides. stage, pose: what comes next; poses: that may still be evaluated; t: time of
the last pose [s]; steps: control steps until then; count: to the next decision; t_pose: time of the pose that is
evaluated, `span` after the one before [s]; rows: pairs that get rows; near: rows of the last pose; is_moving: whether
any obstacle moves. See `BackupScore` for what came of it.
"""


class RolloutArrays(NamedTuple):
    """Memory of one rollout of at most n control steps; row i of q and v is the state after i of them."""

    progress: Any
    """(1,) numbers, of the type `PROGRESS`."""
    q: Array
    """(n + 1, nq)."""
    v: Array
    """(n + 1, nv) velocity that led there."""
    dv: Array
    """(nv,) change of velocity in the control step before the start."""
    prefix: Array
    """(n, nv) velocities of the first control steps."""
    bias_velocity: Array
    """(nv,) of the policy."""
    targets: Array
    """(period_steps, nv) velocities that are aimed at until the next decision."""
    ramp_limits: RampLimits
    """Of a control step."""
    q_middle: Array
    """(nq,) halfway to the next decision."""
    q_pose: Array
    """(nq,) pose that is evaluated."""
    v_pose: Array
    """(nv,) velocity that led there."""
    enabled: Mask
    """(m,) enabled pairs that were not in contact so far."""
    states: Array
    """(o, 18) of the obstacles at the pose."""
    pairs: PairMemory
    """Of their distances."""


@compiled
def begin_rollout(
    r: Any, x: Any, t: float, horizon: float, prefix_steps: int, time: float, clearance: float, measures_outside: bool
) -> None:
    """Begin a rollout whose first row, `dv`, prefix, bias velocity and enabled pairs are written.

    Args:
        r: memory, see `RolloutArrays`.
        x: memory of its distances, see `DistanceArrays`.
        t: time of the start [s].
        horizon: of the policy [s].
        prefix_steps: control steps before the policy decides.
        time: score that is to be beaten, -∞ for none.
        clearance: the same.
        measures_outside: whether the caller computes all distances.
    """
    s = r.progress[0]
    s.measures_outside = measures_outside
    s.t, s.t_pose, s.end, s.deadline = t, t, t + HORIZON + BEYOND, t + HORIZON
    s.horizon, s.prefix_steps, s.least_time, s.least_clearance = horizon, prefix_steps, time, clearance
    s.stage, s.pose, s.steps, s.near, s.span = PLACE, _START, 0, 0, 0.0
    s.contact_time, s.lost_time, s.clearance, s.clearance_before = np.inf, 0.0, np.inf, np.inf
    r.q_pose[:], r.v_pose[:] = r.q[0], r.v[0]
    forget_pairs(x, r.pairs)


@compiled
def rollout_outcome(r: Any) -> tuple[int, float, float, float]:
    """Return what came of a finished rollout.

    Args:
        r: memory, see `RolloutArrays`.

    Returns:
        Control steps; time to contact as in `BackupScore` [s]; time of the first contact, or of the end [s]; least
        distance of the pairs without contact [m].
    """
    s = r.progress[0]
    return s.steps, HORIZON - s.lost_time, min(s.contact_time, s.t), s.clearance


@compiled
def offset_of_start(r: Any, offset: Array, v: Array, dv: Array, targets: Array, is_accelerated: bool) -> float:
    """Compute `max_offset` from a trajectory that is joined from another start.

    Args:
        r: memory, see `RolloutArrays`; not changed.
        offset: of the start from that of the trajectory (n,) [rad or m].
        v: velocity of the control step before (n,).
        dv: change of velocity in that step (n,).
        targets: velocities of the trajectory (k, n).
        is_accelerated: whether any acceleration has a limit; without one, the first target is met at once.
    """
    ramp = follow_ramp(r.ramp_limits, v, dv, targets, False, True) if is_accelerated else targets[:0]
    return max_offset(offset, ramp, targets, r.progress[0].dt)


@compiled
def offset_after_step(
    r: Any, x: Any, q: Array, path: Array, targets: Array, steps: int, enabled: Mask, separable: Mask,
    is_accelerated: bool,
) -> float:  # fmt: skip
    """Compute `offset_of_start` from a trajectory without its first steps, after a control step at the velocity of x.

    Args:
        r: memory, see `RolloutArrays`; not changed.
        x: memory of the control step, see `RowLayout`; not changed.
        q: configuration of that (nq,), with nq = n.
        path: configurations of the trajectory after each of its steps (k, n).
        targets: velocities of its steps (k, n).
        steps: how many of these are left out.
        enabled: pairs that may not come into contact along it (m,).
        separable: pairs whose distance depends on a joint (m,).
        is_accelerated: see `offset_of_start`.

    Returns:
        The offset; infinite where a pair is in contact, or others are enabled by now.
    """
    for i in range(x.summary[0].rows):
        if not x.closest[i, 0] >= TOUCH:
            return np.inf
    same = True
    for k in range(len(enabled)):
        same = same and enabled[k] == (separable[k] and not x.distances.ignored[k])
    if not same:
        return np.inf
    offset = q + r.progress[0].dt * x.v - path[steps - 1]
    return offset_of_start(r, offset, x.v, x.v - x.v_prev, targets[steps:], is_accelerated)


@compiled
def advance_rollout(r: Any, x: Any, prediction: Prediction) -> tuple[int, int, int, int]:
    """Go on with a rollout until it ends, pauses, or asks the caller for something.

    Args:
        r: memory of the rollout, see `RolloutArrays`; `poses` of its progress says how many it may evaluate.
        x: memory of rows and distances, see `RowLayout`; others may use it while the rollout is paused.
        prediction: of the obstacles, the same until the end.

    Returns:
        PAUSED, FINISHED, DROPPED, TO_MEASURE, TO_MOVE or NOT_FINITE; where distances are to be completed, what
        `near_pairs` returns; number of the obstacle that is not finite.
    """
    s = r.progress[0]
    while True:
        if s.stage == DECIDE:
            if s.t >= s.end - _TIME_TOLERANCE:
                return FINISHED, 0, 0, 0
            _decide(r, x)
            s.stage = MOVED
            if s.moves_outside:
                return TO_MOVE, 0, 0, 0
            _move(r)
        if s.stage == MOVED:
            _choose_pose(r, x)
            s.stage = PLACE
        if s.stage == PLACE:
            if s.poses <= 0:
                return PAUSED, 0, 0, 0
            s.poses, s.stage = s.poses - 1, MEASURED
            if s.measures_outside:
                return TO_MEASURE, 0, 0, 0
            predict(prediction, s.t_pose, r.states)
            bad, s.is_moving = place_obstacles(x.distances, prediction.which, r.states, prediction.margin)
            if bad >= 0:
                return NOT_FINITE, bad, 0, 0
            update_kinematics(x.kinematics, r.q_pose)
            place_bodies(x.distances, x.joint_poses)
            near, s.rows, meeting = near_pairs_along(x.distances, r.pairs, s.influence_distance, PREFERRED_DISTANCE)
            if meeting > 0 or s.completes_outside:
                return TO_MEASURE, near, s.rows, meeting
        if _evaluate(r, x):
            return DROPPED, 0, 0, 0


@compiled
def _decide(r: Any, x: Any) -> None:
    """Write velocities until the next decision, towards those of the prefix, then that of the policy.

    All trajectories decide at multiples of the period, and where their prefix ends.
    """
    s = r.progress[0]
    count = s.period_steps - round(s.t / s.dt) % s.period_steps
    left = s.prefix_steps - s.steps
    decides = left <= 0
    first, s.count = s.steps, count if decides else min(count, left)
    if decides:
        _write_policy_velocity(r, x)
    else:
        r.targets[: s.count] = r.prefix[first : first + s.count]
    dv = r.dv if first == 0 else r.v[first] - r.v[first - 1]
    r.v[first + 1 : first + 1 + s.count] = follow_ramp(
        r.ramp_limits, r.v[first], dv, r.targets[: s.count], decides, False
    )


@compiled
def _write_policy_velocity(r: Any, x: Any) -> None:
    """Write the velocity of the policy as the one to aim at; that of a stop where its QP fails."""
    s = r.progress[0]
    v, k, solved = np.zeros(len(x.lower)), s.near, True
    if s.horizon > 0.0:
        v, solved = max_clearance_velocity(
            s.horizon, x.closest[:k], x.J[:k], x.feedforward[:k], PREFERRED_DISTANCE, _MAX_DEPTH, _EFFORT_WEIGHT,
            r.bias_velocity, x.lower, x.upper,
        )  # fmt: skip
    for j in range(len(v)):
        target = min(max(v[j] if solved else 0.0, x.lower[j]), x.upper[j])
        for i in range(s.count):
            r.targets[i, j] = target


@compiled
def _move(r: Any) -> None:
    """Write configurations up to the next decision, where they add up."""
    s = r.progress[0]
    first, last = s.steps, s.steps + s.count
    for i in range(first, last):
        for j in range(r.q.shape[1]):
            r.q[i + 1, j] = r.q[i, j] + s.dt * r.v[i + 1, j]
    for j in range(r.q.shape[1]):
        r.q_middle[j] = 0.5 * (r.q[first, j] + r.q[last, j])


@compiled
def _choose_pose(r: Any, x: Any) -> None:
    """Choose the pose at the next decision, or midway where a pair may come too near and part again before that."""
    s = r.progress[0]
    k, first, last = s.near, s.steps, s.steps + s.count
    s.span, s.pose = s.count * s.dt, _END
    v = r.v[first + 1 + s.count // 2]
    if closes_below(x.closest[:k], x.J[:k], x.feedforward[:k], v, s.span, s.sufficient):
        s.span, s.pose = 0.5 * s.span, _MIDWAY
        r.q_pose[:], r.v_pose[:] = r.q_middle, r.v[first]
    else:
        r.q_pose[:], r.v_pose[:] = r.q[last], r.v[last]
    s.t_pose = s.t + s.span


@compiled
def _evaluate(r: Any, x: Any) -> bool:
    """Write the rows of a pose, count its contacts, and say what comes next; return whether the rollout is dropped.

    Contacts are dated by interpolation between two poses. A pair that has been in contact does not count any more.
    """
    s = r.progress[0]
    x.v_prev[:] = r.v_pose
    pairs = x.distances.rows[: s.rows]
    k, touching, nearest, separable = backup_rows(
        x, r.q_pose, pairs, r.pairs.bounds, s.influence_distance, s.is_moving, r.enabled, TOUCH
    )
    s.near, s.t = k, s.t_pose
    if touching > 0:
        closing, time = s.clearance_before - nearest, s.t
        if 0.0 < closing < np.inf:
            time -= s.span * (TOUCH - nearest) / closing
        s.contact_time = min(s.contact_time, time)
        s.lost_time += touching * max(s.deadline - time, 0.0)
    s.clearance, s.clearance_before = min(s.clearance, separable), separable
    if s.pose == _MIDWAY:
        last = s.steps + s.count
        s.stage, s.pose, s.t_pose = PLACE, _END, s.t + s.span
        r.q_pose[:], r.v_pose[:] = r.q[last], r.v[last]
        return False
    s.stage = DECIDE
    if s.pose == _START:
        return False
    s.steps += s.count
    time, clearance = HORIZON - s.lost_time, min(s.clearance, s.sufficient)
    return time < s.least_time or (time == s.least_time and clearance <= s.least_clearance)
