"""States of obstacles at the time of a step: on trajectories, or as a program gives them, in one call.

A *state* is a row of 18, see `kernels.obstacles`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.near_pairs import place_obstacles
from qpavoid.kernels.obstacles import (
    EXACT,
    FINE,
    NEARLY,
    NO_QUATERNION,
    NORMALISED,
    POSE,
    REST,
    Pieces,
    check_state,
    sample_pieces,
)
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.pose_fit import extrapolate, fit_pose, start_fit
from qpavoid.kernels.turns import fit_turn
from qpavoid.problem import Array, IntArray, Mask

MARGIN_GROWTH = 0.1
"""Rate at which the margin of a stale obstacle grows [m/s]: a bound on the error of its last twist."""
_STEADY = 0.2
"""Time over which twists are averaged [s]."""
_LONGEST = 1e3
"""Time for which an obstacle keeps its last twist at the most [s]: by then it is out of every scene."""
QUATERNION = 7
"""Numbers in a pose whose rotation is given as a quaternion: position, x, y, z, w."""


class ObstacleArrays(NamedTuple):
    """Memory of the states of o obstacles."""

    pieces: Pieces
    """Trajectories of those that follow one."""
    uncertainty: Array
    """(o,) [m]."""
    margin: Array
    """(o,) out: `uncertainty`, more for stale ones [m]."""
    states: Array
    """(o, 18) out: at the time of the step."""
    updates: Array
    """(o, 18) what the step is given, before it is taken over."""
    codes: IntArray
    """(o,) out, the first entries: what `check_updates` finds."""
    deviation: Array
    """(o,) out, the first entries: how far rotations that are given are from the nearest ones [-]."""
    stamps: Array
    """(o,) time stamps of the last updates [s], NaN where there is none."""
    last: Array
    """(o, 18) the last updates, at their time stamps."""
    at_rest: Mask
    """(o,) whether these were at rest."""
    means: Array
    """(o, 6) means of their twists [m/s, rad/s]."""
    twists: Array
    """(o, 6) twists that they are predicted with: the means, or as far as they turn, those of the fit [m/s, rad/s]."""
    turns: Array
    """(o, 3) rates at which their linear velocities turn [rad/s]."""
    turn_fits: Array
    """(o, TURN_FIT) of their linear velocities, see `fit_turn`."""
    counts: Array
    """(o,) how many twists are in each mean."""
    fits: Array
    """(o, FIT) of bare poses, see `fit_pose`."""
    displacement: Array
    """(6,) scratch."""
    line: Array
    """(2, 6) scratch."""
    shortest: float
    """Time between two poses below which no twist is estimated [s]."""
    stale_after: float
    """Age from which an obstacle is stale [s]."""
    max_position: float
    """Largest coordinate of a position that can be true [m]."""
    max_speed: float
    """Largest component of a twist that can be true [m/s, rad/s]."""


@compiled
def check_updates(x: Any, which: IntArray, rows: Array, kind: IntArray) -> int:
    """Write samples, or bare poses, into rows of `updates`, and check them; the velocities of poses are zero.

    Args:
        x: see `ObstacleArrays`; writes updates, normalised, codes and deviation.
        which: numbers of the obstacles (k,).
        rows: (k, 18) or (k, 12) as in a state, or (k, 7) with quaternions.
        kind: how each is given (k,): SAMPLE, POSE or REST.

    Returns:
        How many are not FINE.
    """
    count = 0
    for k in range(len(which)):
        state, off = x.updates[which[k]], 0.0
        for c in range(12, 18):
            state[c] = 0.0
        if rows.shape[1] == QUATERNION:
            off = _write_rotation(state, rows[k])
        else:
            for c in range(rows.shape[1]):
                state[c] = rows[k, c]
        code, deviation = check_state(state, kind[k], x.max_position, x.max_speed)
        if off > EXACT and code == FINE:
            code = NORMALISED if off <= NEARLY else NO_QUATERNION
        x.codes[k], x.deviation[k] = code, max(off, deviation)
        count += code != FINE
    return count


@compiled
def _write_rotation(state: Array, row: Array) -> float:
    """Write position and quaternion (7,) as rotation by columns and position; return | |quaternion| - 1 |."""
    length = np.sqrt(row[3] * row[3] + row[4] * row[4] + row[5] * row[5] + row[6] * row[6])
    scale = 0.0 if length == 0.0 else 1.0 / length  # NaN stays NaN
    i, j, k, w = scale * row[3], scale * row[4], scale * row[5], scale * row[6]
    state[0], state[1], state[2] = 1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j + k * w), 2.0 * (i * k - j * w)
    state[3], state[4], state[5] = 2.0 * (i * j - k * w), 1.0 - 2.0 * (i * i + k * k), 2.0 * (j * k + i * w)
    state[6], state[7], state[8] = 2.0 * (i * k + j * w), 2.0 * (j * k - i * w), 1.0 - 2.0 * (i * i + j * j)
    state[9], state[10], state[11] = row[0], row[1], row[2]
    return abs(length - 1.0)


@compiled
def observe(x: Any, t: float, which: IntArray, kind: IntArray, times: Array, external: IntArray) -> tuple[int, int]:
    """Take over the updates of a step, and bring all obstacles to its time.

    Args:
        x: see `ObstacleArrays`; updates are checked.
        t: time [s].
        which: numbers of the obstacles that are updated (k,).
        kind: how each is given (k,): SAMPLE, POSE or REST.
        times: their time stamps (k,) [s].
        external: numbers of all that a program gives, these among them (e,).

    Returns:
        How many updates were not taken over, as their poses are too far apart: their stamps stay as they were; how many
        obstacles are stale.
    """
    sample_pieces(x.pieces, t, x.states)
    rejected = 0
    for k in range(len(which)):
        if not _take_over(x, which[k], kind[k], times[k]):
            rejected += 1
    states, last, stamps, margin, stale = x.states, x.last, x.stamps, x.margin, 0
    for i in range(len(margin)):
        margin[i] = x.uncertainty[i]
    for i in external:
        age = t - stamps[i]
        for c in range(18):
            states[i, c] = last[i, c]
        if age > 0.0:
            if age > x.stale_after and not x.at_rest[i]:
                stale += 1
                margin[i] += MARGIN_GROWTH * (age - x.stale_after)
            extrapolate(states[i], min(age, _LONGEST))
    return rejected, stale


@compiled
def follow_trajectories(x: Any, distances: Any, t: float, numbers: IntArray) -> bool:
    """Bring all obstacles to a time, and place them, where none of them is given by a program.

    Args:
        x: see `ObstacleArrays`.
        distances: see `place_obstacles`.
        t: time [s].
        numbers: of the obstacles to place (k,).

    Returns:
        Whether any moves, or has a margin.
    """
    sample_pieces(x.pieces, t, x.states)
    for i in range(len(x.margin)):
        x.margin[i] = x.uncertainty[i]
    return place_obstacles(distances, numbers, x.states, x.margin)[1]


@compiled
def _take_over(x: Any, i: int, kind: int, stamp: float) -> bool:
    """Take over the update of obstacle i, and its twist into mean and fit of these; that of a bare pose by `fit_pose`.

    A mean is of all twists at first, then of those within about `_STEADY`: m += λ (ν - m) with λ the larger of 1/n and
    T / (steady + T), T since the update before.

    Args:
        x: see `ObstacleArrays`.
        i: number of the obstacle.
        kind: SAMPLE, POSE or REST.
        stamp: time stamp [s].

    Returns:
        False where the pose is too far from the one before; nothing is changed then.
    """
    elapsed, new, last, fit = stamp - x.stamps[i], x.updates[i], x.last[i], x.fits[i]
    is_first = fit[12] == 0.0
    if kind != POSE:
        start_fit(fit, new)
        for c in range(12, 18 if kind == REST else 12):
            new[c] = 0.0
    elif is_first or elapsed > x.shortest:
        if not fit_pose(new, fit, 0.0 if is_first else elapsed, x.max_speed, x.displacement, x.line):
            return False
    else:
        for c in range(12, 18):
            new[c] = last[c]
    for c in range(18):
        last[c] = new[c]
    x.stamps[i], x.at_rest[i] = stamp, kind == REST
    if kind == POSE and is_first:  # no twist is known of a first pose
        return True
    x.counts[i] += 1.0
    gain = 1.0 / x.counts[i]
    if elapsed > 0.0:
        gain = max(gain, elapsed / (_STEADY + elapsed))
    mean, turning = x.means[i], x.turn_fits[i]
    if not elapsed <= x.shortest:  # NaN, too
        fit_turn(turning, new[12:15], elapsed, x.turns[i])
    for c in range(6):
        mean[c] += gain * (new[12 + c] - mean[c])
        x.twists[i, c] = mean[c]
    for c in range(3):
        x.twists[i, c] += turning[9] * (turning[c] - mean[c])
    return True
