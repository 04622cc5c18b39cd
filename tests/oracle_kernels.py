"""Three kernels by their definitions, in plain numpy on whole arrays: what the compiled loops are compared with.

Each takes a `RowLayout` as its memory and writes nothing.
"""

import numpy as np

from qpavoid.kernels.braking_bounds import speed_to_stop, stopping_distance

# --- rows of the near pairs --------------------------------------------------------------------------------------


def distance_rows(x, pairs, influence_distance):
    """Near pairs (k,), Jacobian (k, n) of their distances, and the rates (k,) due to the obstacles.

    A row is (n, p × n) J_world at the world's origin; columns that one coordinate moves are added up.
    """
    near = pairs[~(x.results[pairs, 0] - x.margin[x.twist_row[pairs]] >= influence_distance)]  # a NaN is near
    n, p = x.results[near, 1:4], x.results[near, 4:7]
    row_wrenches = np.hstack((n, np.cross(p, n)))
    fold = np.eye(len(x.v_max))[x.columns]
    J = (row_wrenches @ x.J_world * x.support[near]) @ fold
    return near, J, np.sum(row_wrenches * x.twists[x.twist_row[near]], axis=1)


# --- bounds on v -------------------------------------------------------------------------------------------------


def velocity_bounds(x, q):
    """hard_lower, hard_upper, lower, upper (n,), and the margin to the nearest position limit.

    Both directions at once: row 0 is the lower limit, in which signs are turned round, row 1 the upper one.
    """
    margin, sign = np.full((2, len(x.v_max)), np.inf), np.array([[-1.0], [1.0]])
    margin[0, x.v_index], margin[1, x.v_index] = q[x.q_index] - x.q_lower, x.q_upper - q[x.q_index]
    limited = np.isfinite(x.v_step)
    step = np.where(limited, x.v_step, 1.0)
    stop = speed_to_stop(np.maximum(margin, 0.0), step, x.dt)
    given = np.maximum(x.position_rate * margin, -x.v_recovery)
    slowed = np.maximum(given, sign * x.v_prev - np.minimum(step, x.dv_step - sign * x.dv_prev))
    speed = np.where(limited, np.where(margin > 0.0, stop, slowed), given)
    # on the way back from outside one limit, a coordinate can still brake for the other
    speed = np.where(limited & (margin < 0.0), np.maximum(speed, -speed[::-1]), speed)
    hard = np.clip(speed, -x.v_max, x.v_max)
    inner = np.full((2, len(x.v_max)), np.inf)
    if x.jerk_limited:
        inner = _within_jerk(x, margin, sign)
        jerky = np.isfinite(x.dv_step)
        unit = np.where(jerky, x.dv_step, 1.0)
        fall = unit * speed_to_stop(np.maximum(sign * x.v_prev - hard, 0.0) / unit, 1.0, 1.0)
        soonest = np.maximum(-inner[::-1], sign * x.v_prev - fall)  # at the speed of the return, without overshoot
        hard = np.where(jerky & (margin < 0.0), np.maximum(hard, np.minimum(soonest, x.v_max)), hard)
    hard_lower, hard_upper = -hard[0], hard[1]
    lower, upper = (np.clip(x.v_prev + s * x.v_step, hard_lower, hard_upper) for s in (-1.0, 1.0))
    bounds = np.clip(-inner[0], lower, upper), np.clip(inner[1], lower, upper)
    return hard_lower, hard_upper, *(bounds if x.jerk_limited else (lower, upper)), margin.min(initial=np.inf)


def _within_jerk(x, margin, sign):
    """(2, n) largest speed in each direction from which a stop within the limit of the jerk ends in time."""
    unit = np.where(np.isfinite(x.dv_step), x.dv_step, 1.0)
    speed, change, max_change = sign * x.v_prev / unit, sign * x.dv_prev / unit, x.v_step / unit
    target = -np.sign(speed) * np.minimum(speed_to_stop(np.abs(speed), 1.0, 1.0), max_change)
    stop = np.clip(target, change - 1.0, change + 1.0)
    fastest = np.where(margin >= 0.0, x.v_max / unit, 0.0)
    high = np.minimum(np.minimum(change + 1.0, max_change), speed_to_stop(np.maximum(fastest - speed, 0.0), 1.0, 1.0))
    change = np.maximum(_change_to_stop(speed, high, max_change, np.maximum(margin, 0.0) / (x.dt * unit)), stop)
    return np.where(np.isfinite(x.dv_step), sign * x.v_prev + unit * change, np.inf)


def _change_to_stop(speed, high, max_change, margin):
    """Largest change, no larger than `high`, after which a stop ends within `margin`: by bisection."""
    max_change = np.broadcast_to(max_change, speed.shape)
    low, top = high - 1e3, high.copy()
    fits = stopping_distance(speed + top, top, max_change)[0] <= margin
    for _ in range(100):
        middle = 0.5 * (low + top)
        over = stopping_distance(speed + middle, middle, max_change)[0] > margin
        low, top = np.where(over, low, middle), np.where(over, middle, top)
    return np.where(fits, high, low)


# --- how near anything may come ----------------------------------------------------------------------------------


def joint_twists(x, v):
    """(J, 6) twists of the joints at the world's origin: the sum of the columns that move each of them."""
    twists = np.zeros((len(x.joint_poses), 6))
    for joint in range(1, len(twists)):
        own = x.column_joints == joint
        twists[joint] = twists[x.parents[joint]] + x.J_world[:, own] @ v[x.columns[own]]
    return twists


def clearance_lower_bound(x, v, k, influence_distance, horizon):
    """Least of distance - safety distance along v until `horizon`, by bounds on the speeds of points [m]."""
    twists, joints = joint_twists(x, v), len(x.joint_poses)
    origins = twists[:, :3] + np.cross(twists[:, 3:], x.joint_poses[:, 9:])
    by_joints = np.linalg.norm(origins, axis=1) + np.linalg.norm(twists[:, 3:], axis=1) * x.joint_radius
    speeds = np.concatenate((by_joints, x.speeds[joints:]))
    omega = np.concatenate((twists[:, 3:], x.twists[:, 3:]))
    turning, sliding = ((chains @ np.abs(v)).max() for chains in (x.chain_rotation, x.chain_translation))
    bend = horizon**2 * turning * (turning * x.lever_arm + 2.0 * sliding)
    far = influence_distance + x.offset - x.d1 - (by_joints.max() + speeds.max()) * horizon - bend
    near = x.near_pairs[:k]
    margin = x.d[:k] - x.d1
    fastest = margin - horizon * speeds[x.moved_by[near]].sum(axis=1) - bend
    approach = x.J[:k] @ v
    closing = (np.abs(approach) if x.jerk_limited else np.maximum(-approach, 0.0)) + np.maximum(-x.feedforward[:k], 0.0)
    bent = np.zeros(k)
    for side, sign in ((0, 1.0), (1, -1.0)):
        mover, body = x.moved_by[near, side], x.bodies[near, side]
        columns = x.body_poses[body, :9].reshape(-1, 3, 3)  # rotations, transposed
        turned = sign * np.cross(x.closest[:k, 1:4], omega[mover])
        along = np.einsum("ijk,ik->ij", columns, turned)
        witness = x.closest[:k, 4 + 3 * side : 7 + 3 * side] - x.body_poses[body, 9:]
        to = x.boxes[body, :3] - np.einsum("ijk,ik->ij", columns, witness)
        farthest = np.sum(along * to, axis=1) + np.sum(np.abs(along) * x.boxes[body, 3:], axis=1)
        closing += np.maximum(farthest, 0.0)
        arc = np.linalg.norm(omega[mover], axis=1) * speeds[mover]
        bent += np.where(mover >= joints, 0.5 * horizon**2 * arc, 0.5 * bend)
    normal = np.where(x.convex[near], margin - horizon * closing - bent, -np.inf)
    least = np.where(fastest > 0.0, fastest, np.maximum(fastest, normal))
    return min(far, least.min(initial=np.inf))
