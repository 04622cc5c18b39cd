"""Array work of a tick in numpy: no Python loop over pairs, few calls, each on small arrays.

`qpavoid.kernels.compiled` has the same functions as loops for numba; both pass the same tests.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.linalg.lapack import dposv

from qpavoid.kernels.layout import RowLayout
from qpavoid.problem import Array, IntArray

BRAKING_SHARE = 0.5
"""Share of the joints' accelerations on which a pair counts for braking; other pairs want some, too [-]."""
WELL_CONDITIONED = 1e-6
"""Ratio of the smallest to the largest pivot of J Jᵀ down to which J⁺ is taken from it without damping."""

_SWAPPED, _DOUBLED = np.array([0, 1, 2, 4, 3]), np.array([2.0, 2.0, 2.0, 1.0, 1.0])
_CYCLE = np.array([1, 2, 0, 2, 0, 1])
_ANTICYCLE = np.array([2, 0, 1, 1, 2, 0])
_SKEW = np.zeros((3, 9))
_SKEW[2, [1, 3]] = 1.0, -1.0
_SKEW[1, [2, 6]] = -1.0, 1.0
_SKEW[0, [5, 7]] = 1.0, -1.0


class Workspace:
    """A layout as attributes, with scratch memory and views: a tick allocates and slices as little as it can."""

    def __init__(self, layout: RowLayout) -> None:
        for name, value in layout._asdict().items():
            setattr(self, name, value)
        (rows, nv), frames, pairs = layout.A.shape, len(layout.targets), len(layout.near)
        split = 3 * frames
        # numbers as arrays: a ufunc takes them in half the time
        self.damping2, self.rate_, self.quarter = (
            np.array([value]) for value in (layout.damping**2, layout.rate, 0.5 * np.pi)
        )
        self.offset_, self.hold_, self.d1_ = (np.array([value]) for value in (layout.offset, layout.hold, layout.d1))
        self.gain_, self.recovery_, self.zero = (np.array([v]) for v in (layout.row_gain, layout.recovery, 0.0))
        self.blend = np.array([0.5 * np.pi / (layout.d2 - layout.d1)])
        self.gain_column = layout.gain[:, None]
        self.here = layout.poses[:, 9:]
        self.turned = layout.poses[:, :9].reshape(-1, 3, 3)
        self.position, self.rotation = layout.targets[:, :3], layout.targets[:, 3:12].reshape(-1, 3, 3)
        self.linear, self.angular = layout.targets[:, 12:15], layout.targets[:, 15:]
        self.moments = layout.screws.reshape(-1, 3, 6)[:frames, :, 3:]
        self.wanted, self.wanted_turns = layout.b[:split].reshape(-1, 3), layout.b[split:].reshape(-1, 3)
        self.asked = layout.b.reshape(-1, 3)
        self.every_turns = len(layout.turns) == frames
        self.capped = bool(np.isfinite(layout.cap).any())
        self.gram = np.empty((rows, rows))
        self.gram_diagonal = self.gram.ravel()[:: rows + 1]
        self.over = np.empty(2 * nv + pairs)
        self.over_upper, self.over_lower = self.over[:nv], self.over[nv : 2 * nv]
        self.was_moving = True
        self.screw_columns = np.empty((6, pairs))
        self.scratch = np.empty((3, pairs))
        joints = len(layout.joint_velocities)
        self.slides = bool(layout.sliding.any())
        self.squares, self.linear_angular = np.empty((joints, 6)), np.empty((joints, 2))
        self.squares_by_kind = self.squares.reshape(-1, 2, 3)
        self.linear_speed, self.angular_speed = self.linear_angular[:, 0], self.linear_angular[:, 1]
        self.joint_speeds = layout.speeds[:joints]
        # every joint has one coordinate and position limits: bounds are made in place, the lower and upper ones at once
        self.plain = np.array_equal(layout.q_index, np.arange(nv)) and np.array_equal(layout.v_index, np.arange(nv))
        self.q_limits = np.stack((layout.q_lower, layout.q_upper))
        self.room = np.empty_like(self.q_limits)
        self.signs = np.array([[-1.0], [1.0]])
        self.limited_step = layout.v_step[layout.v_index]
        self.finite_step = np.where(np.isfinite(self.limited_step), self.limited_step, 1.0)
        self.fastest = layout.v_max[layout.v_index]
        self.slowest, self.v_min = -self.fastest, -layout.v_max

    def __getattr__(self, name: str) -> Any:  # for the type checker: the fields of the layout
        raise AttributeError(name)


def pack(layout: RowLayout) -> Workspace:
    """The layout in the form that the kernels take."""
    return Workspace(layout)


def candidates(
    poses: Array, local: Array, centers: Array, radius: Array, pair_of: IntArray, reach: float, found: IntArray
) -> int:
    """Pairs whose bounding spheres are within reach of each other.

    Args:
        poses: world poses of all geometries, rotation by columns and translation (g, 12).
        local: centres of their bounding spheres in their own frames (g, 3) [m].
        centers: the same in the world, as rows [c, 1, -|c|²] (g, 5) [m]; those of the b bodies of the robot, which
            come first, are overwritten.
        radius: of the spheres (g,) [m].
        pair_of: index of the pair of each combination (b, g), increasing along the rows, one after the other;
            negative where there is none.
        reach: distance between spheres up to which a pair counts [m].
        found: overwritten with the indices of these pairs, increasing (m,).

    Returns:
        How many there are.
    """
    bodies = len(pair_of)
    body = centers[:bodies]
    body[:, :3] = np.matmul(local[:bodies, None], poses[:bodies, :9].reshape(-1, 3, 3))[:, 0] + poses[:bodies, 9:]
    np.einsum("ij,ij->i", body[:, :3], -body[:, :3], out=body[:, 4])
    within = (radius[:bodies, None] + reach) + radius
    within *= within
    within *= 1.0 + 1e-9
    # 2 a·c - |a|² - |c|² >= -within, the left side as one matrix product
    within += (body[:, _SWAPPED] * _DOUBLED) @ centers.T
    pairs = pair_of[(within >= 0.0) & (pair_of >= 0)]
    found[: len(pairs)] = pairs
    return len(pairs)


def assemble(x: Any, q: Array, pairs: IntArray, reach: float, moving: bool) -> tuple[int, float]:
    """All rows and bounds of a tick, and the tracking law's velocity.

    Args:
        x: memory of the tick; its outputs are overwritten.
        q: configuration (nq,).
        pairs: those whose results are of this tick (c,), increasing.
        reach: surface distance below which a pair is near [m].
        moving: whether any obstacle moves.

    Returns:
        Number k of near pairs; by how much the tracking law's velocity violates the worst of rows and bounds
        (negative inside, NaN where there is one).
    """
    frame_rows(x)
    velocity_bounds(x, q)
    stop_velocity(x)
    damped_solution(x, x.v0)
    k = distance_rows(x, pairs, reach, moving)
    if k:
        row_bounds(x, k, moving)
    return k, tracking_shortfall(x, k)


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
    x.near[:k] = near
    closest, J, drift, screws = x.closest[:k], x.J[:k], x.drift[:k], x.screw_columns[:, :k]
    results.take(near, axis=0, out=closest, mode="clip")
    columns = closest.T
    normal, point = columns[1:4], columns[4:7]
    screws[:3] = normal
    products = point[_CYCLE]
    products *= normal[_ANTICYCLE]
    np.subtract(products[:3], products[3:], out=screws[3:])
    np.dot(screws.T, x.J_world, out=J)
    J *= x.support.take(near, axis=0, mode="clip")
    if moving:
        np.einsum("ij,ji->i", x.twists[x.twist_row[near]], screws, out=drift)
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
    d, least = x.d[:k], x.least[:k]
    np.add(x.closest[:k, 0], x.offset_, out=d)
    if moving:
        d -= x.margin[x.twist_row[x.near[:k]]]
    np.subtract(x.hold_, d, out=least)
    if x.switching:
        beyond, share = x.scratch[0, :k], x.scratch[1, :k]
        np.subtract(d, x.d1_, out=share)
        share *= x.blend
        np.maximum(share, x.zero, out=share)
        np.minimum(share, x.quarter, out=share)
        np.sin(share, out=share)
        share *= share
        share *= least
        # 1 - β = sin² is 0 below d1, where the row asks for recovery instead, which β does not weaken
        np.maximum(least, x.zero, out=beyond)
        np.add(share, beyond, out=least)
    least *= x.gain_
    if x.accelerated:
        with np.errstate(invalid="ignore"):  # no lever times no limit
            braking = 0.5 * BRAKING_SHARE * np.nansum(np.abs(x.J[:k]) * x.v_step, axis=1)
            room = np.maximum(d - x.hold, 0.0) / x.dt
            fastest = braking - np.sqrt(braking * braking + 4.0 * braking * room)
        np.maximum(least, fastest, out=least, where=(least < 0.0) & np.isfinite(braking))
    np.minimum(least, x.recovery_, out=least)
    parting = least > x.zero
    if moving:
        least -= x.drift[:k]
    if x.accelerated:
        np.minimum(least, np.dot(x.J[:k], x.v_stop), out=least, where=~parting & (x.drift[:k] >= 0.0))
    if np.count_nonzero(parting):
        with np.errstate(invalid="ignore"):  # no lever times no limit
            most = np.nansum(np.fmax(x.J[:k] * x.lower, x.J[:k] * x.upper), axis=1)
        coming = x.drift[:k] < 0.0
        np.maximum(most, -x.drift[:k], out=most, where=coming)
        np.minimum(least, most, out=least, where=parting)
    touch = x.touch[:k]
    np.subtract(x.offset_, d, out=touch)
    touch *= x.gain_
    if moving:
        touch -= x.drift[:k]
    np.minimum(touch, least, out=touch)


def closest_call(x: Any, v: Array, k: int, reach: float, horizon: float) -> float:
    """A bound below what is left of the safe distance of every pair on the straight way of v until `horizon`.

    No distance falls faster than the fastest points of its two bodies move. A point that a joint carries moves at most
    at the speed of the joint's origin plus its angular speed times the distance. It comes at most s h + ½ a h² far in
    the time h, if it starts at speed s and its acceleration stays below a; at constant joint rates that is at most
    Ω² R + 2 Ω V, with the sums Ω of the angular and V of the linear rates of the joints that carry it and the longest
    lever R.

    Args:
        x: reads what the tick found, and joint_velocities; writes the speeds of the joints.
        v: velocity (n,), that of joint_velocities.
        k: number of near pairs.
        reach: surface distance below which a pair is near; all others are at least so far apart [m].
        horizon: h [s].

    Returns:
        Least of distance - hold [m] on the way, or less; NaN where there is one.
    """
    rates = np.abs(v)
    turning = np.dot(x.turning, rates).max()
    sliding = np.dot(x.sliding, rates).max() if x.slides else 0.0
    bend = horizon * horizon * turning * (turning * x.lever + 2.0 * sliding)  # of both bodies: twice ½ a h²
    np.multiply(x.joint_velocities, x.joint_velocities, out=x.squares)
    np.add.reduce(x.squares_by_kind, axis=2, out=x.linear_angular)
    np.sqrt(x.linear_angular, out=x.linear_angular)
    np.multiply(x.angular_speed, x.joint_reach, out=x.joint_speeds)
    x.joint_speeds += x.linear_speed
    fastest = x.joint_speeds.max()
    fastest_two = (fastest + max(fastest, x.speeds[len(x.joint_speeds) :].max(initial=0.0))) * horizon
    others = reach + x.offset - x.hold - fastest_two - bend
    if not k:
        return float(others)
    d = x.d[:k]
    least = d.min() - x.hold - fastest_two - bend
    if least <= 0.0:  # look closer
        closing = np.add.reduce(x.speeds[x.carriers[x.near[:k]]], axis=1)
        closing *= horizon
        least = (d - closing).min() - x.hold - bend
    return float(min(least, others)) if least == least else math.nan


def rotation_vector(R: Any) -> tuple[float, float, float]:
    """Rotation vector [rad] of a rotation R[i][j], with an angle up to and including π.

    By way of the quaternion, whose largest component is taken first, so that nothing is lost near half a turn.
    """
    trace = R[0][0] + R[1][1] + R[2][2]
    if trace >= max(R[0][0], R[1][1], R[2][2]):
        w, x, y, z = 1.0 + trace, R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1]
    elif R[0][0] >= max(R[1][1], R[2][2]):
        w, x, y, z = R[2][1] - R[1][2], 1.0 + 2.0 * R[0][0] - trace, R[0][1] + R[1][0], R[0][2] + R[2][0]
    elif R[1][1] >= R[2][2]:
        w, x, y, z = R[0][2] - R[2][0], R[0][1] + R[1][0], 1.0 + 2.0 * R[1][1] - trace, R[1][2] + R[2][1]
    else:
        w, x, y, z = R[1][0] - R[0][1], R[0][2] + R[2][0], R[1][2] + R[2][1], 1.0 + 2.0 * R[2][2] - trace
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-12:
        return 0.5 * x, 0.5 * y, 0.5 * z
    scale = (2.0 if w >= 0.0 else -2.0) * math.atan2(length, abs(w)) / length
    return scale * x, scale * y, scale * z


def frame_rows(x: Any) -> None:
    """Rows A v = b of f frames that follow targets: feed-forward plus gain times what is missing, capped and scaled.

    The orientation error is the rotation vector of R_target Rᵀ. Three linear rows for each frame come first, then
    three angular rows for each frame whose orientation counts.

    Args:
        x: reads frame_poses, targets and the layout of the tasks; writes poses, A, b.
    """
    x.frame_poses.take(x.frame_ids, axis=0, out=x.poses, mode="clip")
    here, turns, wanted = x.here, x.turns, x.wanted
    x.moments[:] = np.dot(here, _SKEW).reshape(-1, 3, 3)
    np.subtract(x.position, here, out=wanted)
    wanted *= x.gain_column
    wanted += x.linear
    if len(turns):
        # poses hold rotations by columns, so these are their transposes
        missing = (x.rotation @ x.turned).tolist()
        if x.every_turns:
            x.wanted_turns[:] = [rotation_vector(R) for R in missing]
            x.wanted_turns *= x.gain_column
            x.wanted_turns += x.angular
        else:
            x.wanted_turns[:] = [rotation_vector(missing[f]) for f in turns]
            x.wanted_turns *= x.gain_column[turns]
            x.wanted_turns += x.angular[turns]
    if x.capped:
        asked = x.asked
        asked *= np.minimum(x.cap / np.maximum(np.sqrt((asked * asked).sum(axis=1)), 1e-12), 1.0)[:, None]
    np.dot(x.screws, x.J_world, out=x.A)
    np.multiply(x.A, x.task_support, out=x.A)
    np.multiply(x.b, x.scale, out=x.b)


def speed_to_stop(room: Array, step: Array, dt: float) -> Array:
    """Largest speed from which a coordinate that is slowed by `step` in every tick comes to rest within `room`.

    From v it still goes S(v) = dt Σ max(v - i step, 0), i = 0, 1, …; on (n - 1) step <= v <= n step that is
    n dt v - dt step n (n - 1) / 2, and S(n step) = dt step n (n + 1) / 2, which gives the number of ticks n. Once it
    moves at such a speed, slowing down by `step` keeps to it, so that the bounds of the next tick never contradict.

    Args:
        room: distance left (...), not negative; infinite where there is no limit [rad or m].
        step: change of speed in one tick (...), positive [rad/s or m/s].
        dt: length of a tick [s].
    """
    ticks = np.clip(np.ceil(0.5 * np.sqrt(1.0 + 8.0 * room / (step * dt)) - 0.5), 1.0, 1e15)
    return np.asarray(room / (dt * ticks) + 0.5 * step * (ticks - 1.0))


def velocity_bounds(x: Any, q: Array) -> None:
    """Bounds on v from the joint limits: see `qpavoid.limits`; writes hard_lower, hard_upper, lower and upper."""
    room = x.room  # [lower, upper]: how far the coordinate is above its lower limit, and below the upper one
    np.subtract(x.q_limits, q if x.plain else q[x.q_index], out=room)
    if x.accelerated:
        room[0] *= -1.0
        slowed = np.maximum(x.rate_ * room, x.signs * x.v_last[x.v_index] - x.limited_step)
        stop = speed_to_stop(np.maximum(room, 0.0), x.finite_step, x.dt)
        speed = np.where(np.isinf(x.limited_step), x.rate_ * room, np.where(room > 0.0, stop, slowed))
        # on the way back from outside one limit it can still brake for the other
        np.maximum(speed, -speed[::-1], out=speed, where=room < 0.0)
        room[:] = speed
        room[0] *= -1.0
    else:
        room *= x.rate_
    np.minimum(room, x.fastest, out=room)
    if x.plain:
        np.maximum(room[0], x.slowest, out=x.hard_lower)
        np.maximum(room[1], x.slowest, out=x.hard_upper)
    else:
        np.maximum(room, x.slowest, out=room)
        x.hard_lower[:], x.hard_upper[:] = x.v_min, x.v_max
        x.hard_lower[x.v_index], x.hard_upper[x.v_index] = room
    if x.accelerated:
        np.clip(x.v_last - x.v_step, x.hard_lower, x.hard_upper, out=x.lower)
        np.clip(x.v_last + x.v_step, x.hard_lower, x.hard_upper, out=x.upper)


def stop_velocity(x: Any) -> None:
    """Slows v_last down by one factor for all coordinates, so that no distance closes faster; writes v_stop.

    Bounds of position and velocity come first. Without acceleration limits it is a standstill, if they allow that.
    """
    if x.accelerated:
        slowing = np.max(np.abs(x.v_last) / x.v_step, initial=1.0)  # number of ticks to a standstill
        np.clip((1.0 - 1.0 / slowing) * x.v_last, x.lower, x.upper, out=x.v_stop)
    else:
        np.minimum(x.upper, x.zero, out=x.v_stop)
        np.maximum(x.v_stop, x.lower, out=x.v_stop)


def damped_solution(x: Any, v: Array) -> None:
    """A⁺b with A⁺ = Aᵀ (A Aᵀ + λ²)⁻¹.

    Args:
        x: reads A (r, n), b (r,) and the damping λ.
        v: out (n,); NaN where there is no damping and A Aᵀ is close to singular.
    """
    if not len(x.b):
        v.fill(0.0)
        return
    gram = x.gram
    np.dot(x.A, x.A.T, out=gram)
    x.gram_diagonal += x.damping2
    factor, y, info = dposv(gram, x.b)
    if x.damping == 0.0 and info == 0:
        pivots = factor.diagonal() ** 2
        info = int(pivots.min() < WELL_CONDITIONED * pivots.max())
    if info == 0:
        np.dot(y, x.A, out=v)
    else:
        v.fill(np.nan)


def tracking_shortfall(x: Any, k: int) -> float:
    """`shortfall` of v0, with the first k rows."""
    v, over = x.v0, x.over[: 2 * len(x.v0) + k]
    np.subtract(v, x.upper, out=x.over_upper)
    np.subtract(x.lower, v, out=x.over_lower)
    if k:
        outside = over[2 * len(v) :]
        np.dot(x.J[:k], v, out=outside)
        np.subtract(x.least[:k], outside, out=outside)
    return float(over.max())


def shortfall(v: Array, J: Array, b: Array, lower: Array, upper: Array) -> float:
    """Largest violation of J v >= b and lower <= v <= upper; negative inside, NaN where there is one."""
    over = np.maximum(v - upper, lower - v).max()
    if len(b):
        outside = (b - np.dot(J, v)).max()
        if not (over >= outside or over != over):
            return float(outside)
    return float(over)


def projection_cost(A: Array, regularization: float, v0: Array) -> tuple[Array, Array]:
    """P = AᵀA + λ (n, n) and q = -P v0 (n,): ½ vᵀP v + qᵀv is smallest at v0."""
    P = np.dot(A.T, A)
    P.ravel()[:: len(P) + 1] += regularization
    return P, -np.dot(P, v0)
