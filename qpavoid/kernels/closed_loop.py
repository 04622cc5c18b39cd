"""Control periods of a robot that follows its commands exactly, one after the other in one call."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.approach import PATH_PERIOD
from qpavoid.kernels.arguments import take_usual
from qpavoid.kernels.clearance import leaves_position_limits
from qpavoid.kernels.look_ahead import LOOKED, LookAhead, LookAheadCalls, stop_duration, write_straight_path
from qpavoid.kernels.obstacles import Pieces
from qpavoid.kernels.packing import compiled, exact, released
from qpavoid.kernels.rows import alpha, beta
from qpavoid.kernels.step import SETTLED, UNCLEAR
from qpavoid.kernels.structures import call, call_for_code, call_for_nearness, call_for_placing, call_for_truth
from qpavoid.problem import Array, IntArray


class LoopCalls(NamedTuple):
    """Addresses of the kernels of a control step, see `kernels.structures`."""

    sample_pieces: Any
    follow_trajectories: Any
    control_step: Any
    extend_paths: Any
    comes_near: Any
    extrapolate_states: Any
    place_obstacles: Any
    look_along: Any


class LoopSetting(NamedTuple):
    """What stays as it is for some control periods."""

    targets: Pieces
    """Motions of the f tracked frames."""
    limits: Array
    """(3, nq) see `take_usual`."""
    squares: Array
    """Scratch of that."""
    none: IntArray
    """(0,) obstacles that are given by a program."""
    placed: IntArray
    """Numbers of the obstacles that may have another state than at time 0."""
    on_paths: IntArray
    """Numbers of those on trajectories."""
    influence_distance: float
    """Surface distance below which a pair is near [m]."""
    dt: float
    """Control period [s]."""
    observes: bool
    """Whether any obstacle may move."""
    is_moving: bool
    """Whether any counts as moving though none does: for its margin."""
    looks: bool
    """Whether kernels look ahead where bounds do not show that a velocity is clear."""
    watches: bool
    """Whether backup trajectories are needed where one comes near."""
    largest_velocity: float
    """Norm of a velocity that no robot has [rad/s, m/s]."""


class Periods(NamedTuple):
    """Record of n control periods."""

    t: Array
    """(n,) time [s]."""
    q: Array
    """(n + 1, nq) configuration at the start of each; the first one is given."""
    v: Array
    """(n, nv) commanded velocity."""
    targets: Array
    """(n, f, 18) states of the targets."""
    poses: Array
    """(n, f, 12) poses of the tracked frames."""
    obstacles: Array
    """(n, o, 12) poses of the obstacles."""
    alpha: Array
    """(n,) eq. 11 for the closest pair; 0 out of range."""
    beta: Array
    """(n,) eq. 12 for the same."""


@released
def run_periods(
    calls: LoopCalls,
    x: Any,
    obstacles: Any,
    approach: Any,
    look_calls: LookAheadCalls,
    look: LookAhead,
    kinematics: Any,
    later: Any,
    q: Array,
    s: LoopSetting,
    log: Periods,
    first: int,
    last: int,
) -> int:
    """Take control steps as `Controller.step`, as long as all there is to one is compiled.

    Args:
        calls: kernels.
        x: memory of the step, see `RowLayout`.
        obstacles: memory of their states, see `ObstacleArrays`.
        approach: memory of their paths, see `ApproachArrays`.
        look_calls: kernels of the stop look-ahead.
        look: memory of that.
        kinematics: the same, see `KinematicsArrays`.
        later: the same, see `DistanceArrays`.
        q: configuration that the memory of the step has (nq,).
        s: see `LoopSetting`.
        log: record; t, and the first q, are given.
        first: number of the first step in the record.
        last: number after that of the last step.

    Returns:
        Number after that of the last step that has been taken. The next one, where that is not `last`, is of another
        kind, or its velocity has to be decided otherwise; nothing of it has been recorded.
    """
    first_point, moving, o = -1, s.is_moving, len(obstacles.states)
    for k in range(first, last):
        t = log.t[k]
        if not norm_squared(x.v_prev) <= s.largest_velocity**2:
            return k
        call(calls.sample_pieces, (s.targets, t, x.targets))
        if not take_usual(log.q[k], s.limits, s.squares, x.targets, q):
            return k
        if s.observes:
            moving = call_for_truth(calls.follow_trajectories, (obstacles, x.distances, t, s.placed))
        code = call_for_code(calls.control_step, (x, q, s.influence_distance, moving, True, False))
        if code == UNCLEAR and s.looks and can_look_along(calls, x, obstacles, look, later, q, s):
            code = call_for_code(
                calls.look_along, (look_calls, look, x.distances, kinematics, later, q, look.times, look.travel)
            )
            if code != LOOKED or not look.result[0] >= 0.0:
                return k
        elif code != SETTLED:
            return k
        if s.watches:
            point = int(np.floor(t / PATH_PERIOD))
            if point != first_point:
                call(calls.extend_paths, (approach, obstacles.pieces, s.on_paths, point))
                first_point, approach.proof[0] = point, -1.0
            if call_for_nearness(calls.comes_near, (approach, x.distances, x.v, s.none, s.on_paths))[0]:
                return k
        log.v[k], log.targets[k], log.poses[k] = x.v, x.targets, x.poses
        for i in range(o):
            for c in range(12):
                log.obstacles[k, i, c] = obstacles.states[i, c]
        rows, nearest = x.summary[0].rows, np.inf
        for i in range(rows):
            nearest = min(nearest, x.d[i])
        log.alpha[k] = alpha(nearest, x.d2) if rows > 0 else 0.0
        log.beta[k] = beta(nearest, x.d1, x.d2) if rows > 0 else 0.0
        x.v_prev[:] = x.v
        integrate(log.q[k], x.v, s.dt, log.q[k + 1])
    return last


@compiled
def can_look_along(
    calls: LoopCalls, x: Any, obstacles: Any, look: LookAhead, later: Any, q: Array, s: LoopSetting
) -> bool:
    """Write the path that a step of which bounds show nothing leads along; return whether kernels may look along it.

    Args:
        calls: kernels.
        x: memory of the step, see `RowLayout`.
        obstacles: memory of their states, see `ObstacleArrays`.
        look: memory of the stop look-ahead.
        later: its distances; obstacles are placed where they are at the end of the control period.
        q: configuration (nq,).
        s: see `LoopSetting`.
    """
    for j in range(len(q)):
        if not x.lower[j] <= x.v[j] <= x.upper[j]:
            return False
    duration = stop_duration(x.v, look.acceleration, s.dt)
    if duration > s.dt and leaves_position_limits(x, q, x.v, duration):
        return False
    look.allowance[:], look.states[:] = 0.0, obstacles.states
    call(calls.extrapolate_states, (look.states, look.durations))
    call_for_placing(calls.place_obstacles, (later, s.placed, look.states, obstacles.margin))
    write_straight_path(look, x.v, duration)
    return True


@compiled
def norm_squared(v: Array) -> float:
    """Compute |v|² of v (n,)."""
    total = 0.0
    for j in range(len(v)):
        total += v[j] * v[j]
    return total


@exact
def integrate(q: Array, v: Array, dt: float, after: Array) -> None:
    """Write where a robot whose configurations add up comes to from q (n,) at v (n,) in dt [s]."""
    for j in range(len(q)):
        after[j] = q[j] + v[j] * dt
