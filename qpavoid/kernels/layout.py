"""Memory of a tick: what the kernels read and write, laid out once when a controller is made.

Arrays that look into the memory of Pinocchio and coal are views; outputs are overwritten by every tick.
"""

from __future__ import annotations

from typing import NamedTuple

from qpavoid.problem import Array, IntArray, Mask


class RowLayout(NamedTuple):
    """Everything from which the rows and bounds of a tick are made, and where they go.

    n velocity coordinates, f tracked frames of which the first p have a position and t an orientation to follow,
    r >= 3 (p + t) task rows, m pairs, o obstacles, l coordinates with a position limit. The world Jacobian has e >= n
    columns: those of joints that mimic another one are moved by its coordinate.
    """

    J_world: Array
    """(6, e) world Jacobian of all joints."""
    columns: IntArray
    """(e,) which velocity coordinate moves each of its columns."""
    mimics: bool
    """Whether any coordinate moves several columns."""
    mimicking: Array
    """(e,) scratch: one row before the columns of a coordinate are added up."""
    # --- tasks
    frame_poses: Array
    """(frames, 12) world poses of all frames of the model: rotation by columns, then position [m]."""
    frame_ids: IntArray
    """(f,) the tracked ones."""
    targets: Array
    """(f, 18) state of each target, see `kernels.obstacles`."""
    turns: IntArray
    """(t,) which frames have an orientation to follow."""
    gain: Array
    """(f,) feedback gain [1/s]."""
    cap: Array
    """(p + t,) largest commanded linear, then angular speed; infinite where there is none [m/s, rad/s]."""
    scale: Array
    """(3 (p + t),) root of each row's weight."""
    task_support: Array
    """(3 (p + t), e) scale of the columns that move each row's frame, 0 for the others."""
    row_wrenches: Array
    """(3 (p + t), 6) directions of the rows; the moments of the linear ones are filled in by every tick."""
    poses: Array
    """(f, 12) out: poses of the tracked frames."""
    A: Array
    """(r, n) task rows; out: those of the frames, which come first."""
    b: Array
    """(r,) their right-hand sides; likewise."""
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
    """(o + 1,) taken off the distances to each obstacle, for what is not known of it [m]; the last one stays zero."""
    distance_allowance: Array
    """(m,) added to the distance of a pair whose own safety distance is less than `hold`: the difference [m]."""
    joint_poses: Array
    """(J, 12) world poses of all joints: rotation by columns, then origin [m]; row 0 is the world."""
    parents: IntArray
    """(J,) the joint that carries each joint, which comes before it; that of the world is the world."""
    column_joints: IntArray
    """(e,) the joint that each column of the world Jacobian belongs to, in increasing order."""
    joint_radius: Array
    """(J,) distance from a joint's origin to the farthest point of a body that it carries [m]."""
    moved_by: IntArray
    """(m, 2) what moves the two bodies of each pair: number of a joint, or J plus that of an obstacle."""
    bodies: IntArray
    """(m, 2) the two bodies of each pair."""
    body_poses: Array
    """(g, 12) world poses of all bodies: rotation by columns, then origin [m]."""
    boxes: Array
    """(g, 6) a box around each body, in its frame: centre and half its sizes [m]."""
    convex: Mask
    """(m,) whether both bodies are convex, and their distance stands for nothing else."""
    turning: Array
    """(chains, n) how many angles each coordinate turns among those that move the end of a chain of joints."""
    sliding: Array
    """(chains, n) the same for lengths."""
    omega: Array
    """(J, 3) out: angular velocity of each joint [rad/s]."""
    speeds: Array
    """(J + o,) largest speed of any point that a joint carries, which is overwritten, or of an obstacle [m/s]."""
    near: IntArray
    """(m,) out: which pairs are near, in increasing order; here as below, as many as there are near ones count."""
    closest: Array
    """(m, 10) out: their results."""
    J: Array
    """(m, n) out: velocity Jacobian of their distances."""
    feedforward: Array
    """(m,) out: rate of their distances due to the obstacles [m/s]."""
    d: Array
    """(m,) out: distance that the gains take [m]."""
    least: Array
    """(m,) out: lower bound on J v [m/s]."""
    touch: Array
    """(m,) out: the same of rows without a margin, which only keep pairs from touching [m/s]."""
    # --- limits
    q_index: IntArray
    """(l,) index in q of each limited coordinate."""
    v_index: IntArray
    """(l,) index in v of the same."""
    q_lower: Array
    """(l,) [rad or m]."""
    q_upper: Array
    """(l,) [rad or m]."""
    v_max: Array
    """(n,) largest speed, infinite where there is none."""
    v_step: Array
    """(n,) largest change of v in one tick; infinite where the acceleration has no limit."""
    v_prev: Array
    """(n,) velocity of the tick before."""
    dv_step: Array
    """(n,) largest change, from one tick to the next, of that change of v; infinite where the jerk has no limit."""
    dv_prev: Array
    """(n,) by how much v changed in the tick before, no more than `v_step`."""
    hard_lower: Array
    """(n,) out: lower bound on v from position and velocity limits.

    The same array as `lower` where no acceleration has a limit."""
    hard_upper: Array
    """(n,) out: upper bound from the same."""
    lower: Array
    """(n,) out: lower bound on v from all limits, acceleration and jerk included."""
    upper: Array
    """(n,) out: upper bound from the same."""
    v_stop: Array
    """(n,) out: the next velocity of a stop: all coordinates slowed alike, as fast as their limits allow."""
    # --- answer of the tracking law
    v_tracking: Array
    """(n,) out: J⁺ẋ."""
    # --- numbers
    damping: float
    """λ of the damped J⁺ [-]."""
    offset: float
    """Added to surface distances [m]."""
    hold: float
    """Distance at which a row allows no more closing [m]."""
    row_gain: float
    """ξ [1/s]."""
    recovery: float
    """Cap on the speed of parting that a row asks for [m/s]."""
    beta: bool
    """Whether rows are weighted with 1 - β."""
    task_switching: bool
    """Whether rows have the rate of eq. 10, which depends on v0."""
    retreat_speed: float
    """ẋ0 of such rows [m/s]."""
    alpha_cap: float
    """Largest α of such rows [-]."""
    d1: float
    """[m]."""
    d2: float
    """[m]."""
    rate: float
    """Share of the room to a position limit that may be used in a second [1/s]."""
    dt: float
    """Length of a tick [s]."""
    lever_arm: float
    """Largest distance that any point can ever have from a joint that turns it [m]."""
    accelerated: bool
    """Whether any acceleration has a limit."""
    jerked: bool
    """Whether any jerk has one."""
    looks_ahead: bool
    """Whether the way of the tracking law's velocity is looked at, where that velocity is safe."""
