"""Memory of a control step: what the kernels read and write, laid out once when a controller is made.

Outputs are overwritten by every step.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.problem import Array, IntArray, Mask

SUMMARY = np.dtype(
    [
        ("rows", np.intp), ("violation", float), ("is_clear", bool), ("position_margin", float), ("bent", float)
    ],
    align=True,
)  # fmt: skip
"""Numbers of a control step.

rows: number k of near pairs; violation: largest one of rows and bounds by `v_tracking` [m/s, rad/s], negative inside,
NaN where there is one; is_clear: whether v_tracking is safe, its clearance is bounded (`looks_ahead`) and the bound
suffices; position_margin: distance to the nearest position limit [rad, m]; bent: how far the task rows bend within the
step, see `tracking_law`.
"""


class RowLayout(NamedTuple):
    """Everything from which the rows and bounds of a control step are made, and where they go.

    n velocity coordinates, f tracked frames of which the first p have a position and t an orientation to follow,
    r >= 3 (p + t) task rows, m pairs, o obstacles, l coordinates with a position limit. The world Jacobian has e >= n
    columns: those of joints that mimic another joint are moved by the coordinate of that joint.
    """

    kinematics: Any
    """`KinematicsArrays` in compiled code: everything about the robot's configuration comes from them."""
    distances: Any
    """`DistanceArrays` in compiled code: everything about the pairs comes from them."""
    J_world: Array
    """(6, e) world Jacobian of all joints, linear rows first, at the world's origin."""
    columns: IntArray
    """(e,) velocity coordinate that moves each column of `J_world`."""
    has_mimics: bool
    """Whether any coordinate moves several columns."""
    unfolded_row: Array
    """(e,) scratch: one row before the columns of a coordinate are added up."""
    # --- tasks
    frame_poses: Array
    """(frames, 12) world poses of all frames of the model: rotation by columns, then position [m]."""
    frame_ids: IntArray
    """(f,) the tracked ones among these."""
    targets: Array
    """(f, 18) state of each target, see `kernels.obstacles`."""
    oriented: IntArray
    """(t,) numbers of the tracked frames that have an orientation to follow."""
    gain: Array
    """(f,) feedback gain [1/s]."""
    cap: Array
    """(p + t,) largest commanded linear, then angular speed; infinite where there is none [m/s, rad/s]."""
    scale: Array
    """(r,) root of each row's weight."""
    dead_beat: Array
    """(r,) how near the gain of each row's task is to one that removes the error in a step, at most 1 [-]."""
    row_tasks: IntArray
    """(r,) number of each row's task: that of a frame, then the other tasks."""
    bending_rows: IntArray
    """Rows that turn as the robot moves, those of the frames first."""
    straight_rows: IntArray
    """All others: A is constant, as of a posture."""
    task_support: Array
    """(3 (p + t), e) scale of the columns that move each row's frame, 0 for the others."""
    row_wrenches: Array
    """(3 (p + t), 6) directions of the rows; the moments of the linear ones are filled in by every step."""
    poses: Array
    """(f, 12) out: poses of the tracked frames."""
    errors: Array
    """(3 (p + t),) out: what each frame lacks to its target, not scaled [m, rad]."""
    feedback: Array
    """(3 (p + t),) out: the part of `b` that is gain times error, capped and scaled [m/s, rad/s]."""
    A: Array
    """(r, n) task rows; out: those of the frames, which come first."""
    b: Array
    """(r,) right-hand sides of `A`; out: those of the frames, which come first."""
    b_feasible: Array
    """(r,) out: `b`, of each task scaled down to what the joints can do."""
    # --- pairs
    results: Array
    """(m, 10) [distance, normal, point a, point b] of all pairs."""
    support: Array
    """(m, e) support of the second body minus that of the first."""
    twists: Array
    """(o + 1, 6) velocity of each obstacle at the world's origin, [linear, angular]; the last row stays zero."""
    twist_row: IntArray
    """(m,) row of `twists` that moves each pair's second body."""
    margin: Array
    """(o + 1,) taken off the distances to each obstacle, for its uncertainty [m]; the last one stays zero."""
    distance_allowance: Array
    """(m,) added to the distance of a pair whose own safety distance is below d1: the difference [m]."""
    joint_poses: Array
    """(J, 12) world poses of all joints: rotation by columns, then origin [m]; row 0 is the world."""
    parents: IntArray
    """(J,) parent joint of each joint, which comes before it; that of the world is the world."""
    column_joints: IntArray
    """(e,) joint that each column of the world Jacobian belongs to, in increasing order."""
    joint_radius: Array
    """(J,) distance from a joint's origin to the farthest point of the bodies fixed to it [m]."""
    moved_by: IntArray
    """(m, 2) what moves the two bodies of each pair: number of a joint, or J plus that of an obstacle."""
    bodies: IntArray
    """(m, 2) the two bodies of each pair."""
    body_poses: Array
    """(g, 12) world poses of all bodies: rotation by columns, then origin [m]."""
    boxes: Array
    """(g, 6) a box around each body, in its frame: centre and half its sizes [m]."""
    convex: Mask
    """(m,) whether both bodies are convex, and their distance stands for no other pair's."""
    chain_rotation: Array
    """(chains, n) number of angles that each coordinate turns among those that move the end of a chain of joints."""
    chain_translation: Array
    """(chains, n) the same for lengths."""
    omega: Array
    """(J, 3) out: angular velocity of each joint [rad/s]."""
    speeds: Array
    """(J + o,) largest speed of any point: out for those fixed to a joint, given for those of an obstacle [m/s]."""
    near_pairs: IntArray
    """(m,) out: numbers of the k near pairs, in increasing order. Here as below, the first k entries count."""
    closest: Array
    """(m, 10) out: their results."""
    J: Array
    """(m, n) out: velocity Jacobian of their distances."""
    feedforward: Array
    """(m,) out: rate of their distances due to the obstacles [m/s]."""
    d: Array
    """(m,) out: distance that the gains take [m]."""
    rhs: Array
    """(m,) out: lower bound on J v [m/s]."""
    rhs_contact: Array
    """(m,) out: the same of rows without a margin, which only keep pairs from contact [m/s]."""
    # --- limits
    q_index: IntArray
    """(l,) index in q of each limited coordinate."""
    v_index: IntArray
    """(l,) index in v of the same."""
    q_lower: Array
    """(l,) lower position limit [rad or m]."""
    q_upper: Array
    """(l,) upper position limit [rad or m]."""
    v_max: Array
    """(n,) largest speed, infinite where there is none [rad/s or m/s]."""
    v_recovery: Array
    """(n,) largest speed at which a coordinate is made to come back from outside a position limit [rad/s or m/s]."""
    v_step: Array
    """(n,) largest change of v in a step; infinite where the acceleration has no limit [rad/s or m/s]."""
    v_prev: Array
    """(n,) velocity of the previous step [rad/s or m/s]."""
    dv_step: Array
    """(n,) largest difference of the changes of v in two successive steps; infinite where the jerk has no limit."""
    dv_prev: Array
    """(n,) change of v in the previous step, no more than `v_step` [rad/s or m/s]."""
    hard_lower: Array
    """(n,) out: lower bound on v from position and velocity limits.

    The same array as `lower` where no acceleration has a limit."""
    hard_upper: Array
    """(n,) out: upper bound from the same."""
    lower: Array
    """(n,) out: lower bound on v from all limits, acceleration and jerk included."""
    upper: Array
    """(n,) out: upper bound from the same."""
    centering: Array
    """(n,) out: towards the middle of a coordinate's range, over half of it; zero without two position limits [-]."""
    v_stop: Array
    """(n,) out: the next velocity of a stop: all coordinates slowed by one factor, as fast as their limits allow."""
    # --- answer of the tracking law
    v_tracking: Array
    """(n,) out: J⁺ẋ, see `kernels.tracking_law`; a velocity to follow in place of the tasks, where one is given."""
    # --- answer of the step
    v: Array
    """(n,) out: velocity that may be commanded, where `control_step` returns SETTLED or UNCLEAR [rad/s or m/s]."""
    summary: Any
    """(1,) out: numbers of the type `SUMMARY`."""
    identity: Array
    """(n, n) rows of a step without tasks."""
    # --- numbers
    offset: float
    """Added to surface distances [m]."""
    row_gain: float
    """ξ [1/s]."""
    recovery_speed: float
    """Cap on the speed of separation that a row asks for [m/s]."""
    near_speed: float
    """Closing speed up to which rows are not weighted with 1 - β [m/s]."""
    task_switching: bool
    """Whether rows have the rate of eq. 10, which depends on `v_tracking`."""
    retreat_speed: float
    """ẋ0 of such rows [m/s]."""
    alpha_cap: float
    """Largest α of such rows [-]."""
    d1: float
    """Safety distance, at which a row allows no more closing: below it β is 1 [m]."""
    d2: float
    """Influence distance [m]."""
    position_rate: float
    """Share of the distance to a position limit that may be used in a second [1/s]."""
    dt: float
    """Control period [s]."""
    lever_arm: float
    """Largest distance that any point can ever have from a joint that turns it [m]."""
    acceleration_limited: bool
    """Whether any acceleration has a limit."""
    jerk_limited: bool
    """Whether any jerk has one."""
    looks_ahead: bool
    """Whether a step bounds the clearance along a velocity that meets all rows and bounds."""
    regularization: float
    """λ of the QP that a step solves where `v_tracking` violates a row or bound; 0 where another law does."""
