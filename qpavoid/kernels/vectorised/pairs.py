"""Rows of the pairs that are near, and how fast they may close."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.rotation import ANTICYCLE, CYCLE
from qpavoid.kernels.vectorised.bounds import change_to_stop
from qpavoid.kernels.workspace import Rows
from qpavoid.problem import Array, IntArray

BRAKING_SHARE = 0.5
"""Share of the joints' accelerations on which a pair counts for braking; other pairs want some, too [-]."""


def distance_rows(x: Any, pairs: IntArray, reach: float, moving: bool) -> int:
    """Closest points and rates of the pairs that are nearer than `reach`, or whose distance is NaN.

    The normal n is parallel to the line between the witness points, so p × n is the same at both, and every row is
    J = [n, p × n]ᵀ J_world, masked with the difference of the supports of the two bodies.

    Args:
        x: reads results, J_world, support, twists, twist_row; writes near, closest, J, drift.
        pairs: which pairs to look at (c,), increasing.
        reach: distance below which a pair is near [m].
        moving: whether any of the twists is not zero.

    Returns:
        How many are near.
    """
    results = x.results
    distance = results[:, 0] if len(pairs) == len(results) else results[pairs, 0]
    near = pairs[~(distance >= reach)]  # a NaN is near, not hidden
    k = len(near)
    if not k:
        return 0
    rows = x.rows(k)
    rows.near[:] = near
    results.take(near, axis=0, out=rows.closest, mode="clip")
    rows.linear[:] = rows.normal
    products = rows.point[CYCLE]
    products *= rows.normal[ANTICYCLE]
    np.subtract(products[:3], products[3:], out=rows.angular)
    if x.mimics:
        np.dot(np.dot(rows.screw_rows, x.J_world) * x.support[near], x.fold, out=rows.J)
    else:
        J = rows.J
        np.dot(rows.screw_rows, x.J_world, out=J)
        J *= x.support.take(near, axis=0, mode="clip")
    if moving:
        np.einsum("ij,ji->i", x.twists[x.twist_row[near]], rows.screws, out=rows.drift)
    elif x.was_moving:
        x.drift.fill(0.0)
    x.was_moving = moving
    return k


def row_bounds(x: Any, k: int, moving: bool) -> None:
    """Right-hand sides of the first k avoidance rows: see `qpavoid.avoidance`; writes d, least and touch.

    With acceleration limits, a pair closes no faster than the speed from which a share of its joints' accelerations,
    all at work on it, brings it to rest in what is left: ½ a dt - √((½ a dt)² + 2 a h).

    A row never asks for more than can be had: of a pair that may still close, and whose obstacle does not come nearer,
    no more than a stop gives, so that the stop meets all such rows at once; of one that has to part, no more speed of
    parting than the bounds allow, and where they do not allow any yet, no harder braking.
    """
    rows = x.rows(k)
    d, least, touch, share, drift = rows.d, rows.least, rows.touch, rows.share, rows.drift
    np.add(rows.distance, x.offset_, out=d)
    if moving:
        d -= x.margin[x.twist_row[rows.near]]
    if x.eased:
        d += x.slack[rows.near]
    np.subtract(x.hold_, d, out=least)
    parting = least > x.zero
    some = np.count_nonzero(parting) > 0
    if x.switching:
        np.subtract(d, x.d1_, out=share)
        share *= x.blend
        if some:
            np.maximum(share, x.zero, out=share)
        np.minimum(share, x.quarter, out=share)
        np.sin(share, out=share)
        share *= share
        share *= least
        # 1 - β = sin² is 0 below d1, where the row asks for recovery instead, which β does not weaken
        if some:
            np.maximum(least, x.zero, out=rows.beyond)
            np.add(share, rows.beyond, out=least)
            least *= x.gain_
        else:
            np.multiply(share, x.gain_, out=least)
    else:
        least *= x.gain_
    if x.accelerated:
        _leave_room_to_brake(x, rows)
    if some or x.jerked:
        np.minimum(least, x.recovery_, out=least)
    if moving:
        least -= drift
    if x.accelerated:
        np.minimum(least, np.dot(rows.J, x.v_stop), out=least, where=~parting & (drift >= 0.0))
    if some:
        with np.errstate(invalid="ignore"):  # no lever times no limit
            most = np.nansum(np.fmax(rows.J * x.lower, rows.J * x.upper), axis=1)
        np.maximum(most, -drift, out=most, where=drift < 0.0)
        np.minimum(least, most, out=least, where=parting)
    np.subtract(x.offset_, d, out=touch)
    if x.eased:
        touch += x.slack[rows.near]
    touch *= x.gain_
    if moving:
        touch -= drift
    np.minimum(touch, least, out=touch)


def _leave_room_to_brake(x: Any, rows: Rows) -> None:
    with np.errstate(invalid="ignore"):  # no lever times no limit
        braking = 0.5 * BRAKING_SHARE * np.nansum(np.abs(rows.J) * x.v_step, axis=1)
        room = np.maximum(rows.d - x.hold, 0.0) / x.dt
        fastest = braking - np.sqrt(braking * braking + 4.0 * braking * room)
    closing = (rows.least < 0.0) & np.isfinite(braking)
    np.maximum(rows.least, fastest, out=rows.least, where=closing)
    if x.jerked:
        _room_for_jerk(x, rows, np.flatnonzero(closing), 2.0 * braking, room)


def _room_for_jerk(x: Any, rows: Rows, closing: IntArray, step: Array, room: Array) -> None:
    """Raises the bounds of closing pairs to the speeds from which a share of their joints' jerks, too, brings them to
    rest in time, at the change of speed that has led to them (`kernels.stopping`).

    Args:
        x: memory of the tick.
        rows: of the near pairs (k,).
        closing: which of them close (c,).
        step: change of the speed of closing that a share of the joints' accelerations makes in a tick (k,) [m/s].
        room: distance left over the length of a tick (k,) [m/s].
    """
    J = rows.J[closing]
    with np.errstate(invalid="ignore"):  # no lever times no limit
        unit = BRAKING_SHARE * np.nansum(np.abs(J) * x.w_step, axis=1)
    known = (unit > 0.0) & (unit < np.inf)
    closing, J, unit = closing[known], J[known], unit[known]
    speed, change = -np.dot(J, x.v_last) - rows.drift[closing], -np.dot(J, x.w_last)
    # all jerks at work on a pair change the change of its speed no more than this
    high = np.minimum((-rows.least[closing] - speed) / unit, change / unit + 1.0 / BRAKING_SHARE)
    change = change_to_stop(speed / unit, high, step[closing] / unit, room[closing] / unit)
    rows.least[closing] = np.maximum(rows.least[closing], -speed - unit * change)
