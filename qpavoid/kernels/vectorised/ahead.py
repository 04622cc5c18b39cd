"""How near anything may come on the way of a velocity, without a look at what lies on it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from qpavoid.kernels.rotation import ANTICYCLE, CYCLE
from qpavoid.problem import Array


def closest_call(x: Any, v: Array, k: int, reach: float, horizon: float) -> float:
    """A bound below what is left of the safe distance of every pair on the straight way of v until `horizon`.

    No distance falls faster than the fastest points of its two bodies move. A point that a joint carries moves at most
    at the speed of the joint's origin plus its angular speed times the distance. It comes at most s h + ½ a h² far in
    the time h, if it starts at speed s and its acceleration stays below a; at constant joint rates that is at most
    Ω² R + 2 Ω V, with the sums Ω of the angular and V of the linear rates of the joints that carry it and the longest
    lever R.

    Args:
        x: reads what the tick found; writes the speeds of the joints.
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
        left = float(ways.min()) - x.hold - bend
        least = min(least, left) if left == left else left
    return float(least) if known == known else math.nan


def joint_speeds(x: Any, v: Array) -> None:
    """Largest speed of any point that each joint carries: of its origin, and angular speed times the farthest distance.

    Args:
        x: reads J_world, joint_poses and joint_reach; writes the first J of speeds.
        v: velocity (n,).
    """
    np.multiply(x.J_world, v.take(x.columns) if x.mimics else v, out=x.moved)
    twists = np.dot(x.moved, x.carried, out=x.joint_twists)
    products = twists[3:].take(CYCLE, axis=0)
    products *= x.origins.take(ANTICYCLE, axis=0)
    twists[:3] += products[:3]
    twists[:3] -= products[3:]
    twists *= twists
    speeds = np.dot(x.by_kind, twists, out=x.squares)
    np.sqrt(speeds, out=speeds)
    np.multiply(speeds[1], x.joint_reach, out=x.joint_speeds)
    x.joint_speeds += speeds[0]


def tracking_clear(x: Any, k: int, reach: float) -> bool:
    """Whether `closest_call` leaves something over on the way of v0 and a stop from it; see it for the arguments."""
    slowing = float((np.abs(x.v0) / x.v_step).max()) if x.accelerated else 0.0  # ticks to a standstill
    return closest_call(x, x.v0, k, reach, x.dt * (1.0 + 0.5 * slowing)) > 0.0
