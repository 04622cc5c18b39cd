"""How near anything may come on the way of a velocity, without a look at what lies on it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from qpavoid.kernels.rotation import ANTICYCLE, CYCLE
from qpavoid.problem import Array, IntArray

TOLERANCE = 2e-4
"""How much nearer than its safe distance a pair may come along the way of a velocity [m]."""


def closest_call(x: Any, v: Array, k: int, reach: float, horizon: float) -> float:
    """A bound below what is left of the safe distance of every pair on the straight way of v until `horizon`.

    No distance falls faster than the fastest points of its two bodies move. A point that a joint carries moves at most
    at the speed of the joint's origin plus its angular speed times the distance. It comes at most s h + ½ a h² far in
    the time h, if it starts at speed s and its acceleration stays below a; at constant joint rates that is at most
    Ω² R + 2 Ω V, with the sums Ω of the angular and V of the linear rates of the joints that carry it and the longest
    lever R. Where that leaves nothing of a pair, `_left_along_normal` may.

    Args:
        x: reads what the tick found; writes the speeds and spins of the joints.
        v: velocity (n,).
        k: number of near pairs.
        reach: surface distance below which a pair is near; all others are at least so far apart [m].
        horizon: h [s].

    Returns:
        Least of distance - hold [m] on the way, or less; NaN where there is one.
    """
    rates = np.abs(v)
    turning = max(np.dot(x.turning, rates).tolist())  # of a few numbers, Python's max is the quicker one
    sliding = max(np.dot(x.sliding, rates).tolist()) if x.slides else 0.0
    bend = horizon * horizon * turning * (turning * x.lever + 2.0 * sliding)  # of both bodies: twice ½ a h²
    joint_speeds(x, v)
    speeds = x.speeds.tolist()
    fastest, known = max(speeds[: x.joints]), sum(speeds)
    least = reach + x.offset - x.hold - (fastest + max(speeds)) * horizon - bend
    if k:
        rows = x.rows(k)
        closing = x.speeds.take(x.carriers.take(rows.near, axis=0, mode="clip"), mode="clip")
        ways = rows.share
        np.add(closing[:, 0], closing[:, 1], out=ways)
        ways *= horizon
        np.subtract(rows.d, ways, out=ways)
        ways -= x.hold + bend
        left = float(ways.min())
        if left <= 0.0:
            spent = np.flatnonzero(ways <= 0.0)
            ways[spent] = np.maximum(ways[spent], _left_along_normal(x, v, spent, horizon, bend))
            left = float(ways.min())
        least = min(least, left) if left == left else left
    return float(least) if known == known else math.nan


def _left_along_normal(x: Any, v: Array, rows: IntArray, horizon: float, bend: float) -> Array:
    """A bound below what is left of the safe distances of some near pairs until `horizon`.

    Two convex bodies are at least as far apart as any direction tells them apart: as far along it as the nearest points
    of the two. In the direction of the normal n, these move with the witness points, and with the turning of the
    bodies: x, of a body that turns with ω, comes by (x - p)·(n × ω) closer in a second than the witness point p. Of
    the box around the body, no point comes closer than |n × ω| along its edges says. An obstacle that turns bends its
    way by no more than ½ ω h² times the speed of its fastest point.

    A pair of bodies that are not convex, or that stands for others, has -∞ left.

    Args:
        x: reads what the tick found, and the spins of the joints.
        v: velocity (n,).
        rows: numbers of the near pairs (c,).
        horizon: h [s].
        bend: what the curved ways of two bodies of the robot may add [m].
    """
    near, closest = x.near[rows], x.closest[rows]
    approach = np.dot(x.J[rows], v)
    # a stop within jerk limits may lead backwards, and an obstacle need not move as long as the robot does
    closing = (np.abs(approach) if x.jerked else np.maximum(-approach, 0.0)) + np.maximum(-x.drift[rows], 0.0)
    spins, bent = np.concatenate((x.spins, x.twists[:, 3:])), np.zeros(len(rows))
    for side, sign in ((0, 1.0), (1, -1.0)):
        carrier, body = x.carriers[near, side], x.bodies[near, side]
        spin = spins[carrier]
        m = np.einsum("ijk,ik->ij", x.body_rotations[body], sign * np.cross(closest[:, 1:4], spin))
        witness = closest[:, 4 + 3 * side : 7 + 3 * side] - x.body_poses[body, 9:]
        to = x.boxes[body, :3] - np.einsum("ijk,ik->ij", x.body_rotations[body], witness)
        closing += np.maximum(np.sum(m * to, axis=1) + np.sum(np.abs(m) * x.boxes[body, 3:], axis=1), 0.0)
        turned = np.sqrt(np.sum(np.square(spin), axis=1)) * x.speeds[carrier]
        bent += np.where(carrier >= x.joints, 0.5 * horizon**2 * turned, 0.5 * bend)
    return np.where(x.convex[near], x.d[rows] - x.hold - horizon * closing - bent, -np.inf)


def bends(x: Any, q: Array, v: Array, horizon: float) -> bool:
    """Whether a coordinate has to brake harder than the others on the way of v, as it would pass its position limit."""
    ahead = q[x.q_index] + horizon * v[x.v_index]
    return bool(((ahead < x.q_lower) | (ahead > x.q_upper)).any())


def joint_speeds(x: Any, v: Array) -> None:
    """Largest speed of any point that each joint carries: of its origin, and angular speed times the farthest distance.

    Args:
        x: reads J_world, joint_poses and joint_reach; writes spins and the first J of speeds.
        v: velocity (n,).
    """
    np.multiply(x.J_world, v.take(x.columns) if x.mimics else v, out=x.moved)
    twists = np.dot(x.moved, x.carried, out=x.joint_twists)
    products = twists[3:].take(CYCLE, axis=0)
    products *= x.origins.take(ANTICYCLE, axis=0)
    twists[:3] += products[:3]
    twists[:3] -= products[3:]
    x.spins[:] = twists[3:].T
    twists *= twists
    speeds = np.dot(x.by_kind, twists, out=x.squares)
    np.sqrt(speeds, out=speeds)
    np.multiply(speeds[1], x.joint_reach, out=x.joint_speeds)
    x.joint_speeds += speeds[0]


def tracking_clear(x: Any, q: Array, k: int, reach: float) -> bool:
    """Whether `closest_call` tells that nothing comes too near on the way of v0 and a stop from it."""
    slowing = float((np.abs(x.v0) / x.v_step).max()) if x.accelerated else 0.0  # ticks to a standstill
    horizon = x.dt * (1.0 + 0.5 * slowing)
    if slowing > 0.0 and bends(x, q, x.v0, horizon):
        return False
    return closest_call(x, x.v0, k, reach, horizon) > -TOLERANCE
