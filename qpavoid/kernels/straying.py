"""Whether what is comes as it was forecast: comparisons of each control step, with memory of none."""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray


@compiled
def largest_part(parts: Array) -> float:
    """Return the largest norm of vectors of three, one after the other (3 k,)."""
    largest = 0.0
    for k in range(0, len(parts), 3):
        largest = max(largest, parts[k] ** 2 + parts[k + 1] ** 2 + parts[k + 2] ** 2)
    return float(np.sqrt(largest))


@compiled
def strays(
    q: Array, errors: Array, t: float, times: Array, forecast_q: Array, forecast_errors: Array, moved: float,
    turned: float,
) -> bool:  # fmt: skip
    """Return whether the robot, or an error of its frames, is elsewhere than in a forecast of n steps.

    Args:
        q: where it is (nq,).
        errors: of the frames (3 k,) [m, rad].
        t: now [s].
        times: of the forecast (n,), evenly spaced [s].
        forecast_q: (n, nq).
        forecast_errors: (n,) largest errors [m, rad].
        moved: difference of the largest error that does not count [m, rad].
        turned: the same of a joint [rad, m].
    """
    last, step = len(times) - 1, 0
    if last > 0:
        step = min(max(int(np.round((t - times[0]) / (times[last] - times[0]) * last)), 0), last)
    if abs(largest_part(errors) - forecast_errors[step]) > moved:
        return True
    farthest = 0.0
    for i in range(len(q)):
        farthest = max(farthest, abs(q[i] - forecast_q[step, i]))
    return farthest > turned


@compiled
def note_courses(states: Array, which: IntArray, earlier: Array, elapsed: float, now: Array) -> tuple[bool, float]:
    """Note where k obstacles are, and compare that with where they were and what their velocities led to.

    Args:
        states: of all obstacles (o, 18).
        which: their numbers (k,).
        earlier: their states before (k, 18); of other obstacles (j, 18), nothing is compared.
        elapsed: time since then [s].
        now: their states (k, 18) are written here.

    Returns:
        Whether any of them has a velocity; how fast one of them has left its course since then, at most [m/s].
    """
    moves, square, known = False, 0.0, len(earlier) == len(which) and elapsed > 0.0
    for k in range(len(which)):
        for c in range(18):
            now[k, c] = states[which[k], c]
            moves = moves or (c >= 12 and now[k, c] != 0.0)
        if known:
            off = 0.0
            for c in range(9, 12):
                off += (now[k, c] - earlier[k, c] - elapsed * earlier[k, c + 3]) ** 2
            square = max(square, off)
    return moves, np.sqrt(square) / elapsed if known else 0.0


@compiled
def any_off_course(
    states: Array, which: IntArray, earlier: Array, elapsed: float, horizon: float, moved: float, turned: float
) -> bool:
    """Return whether any of k obstacles is, or soon will be, elsewhere than its velocity of before leads to.

    The rotation of one that turns does not count.

    Args:
        states: of all obstacles (o, 18).
        which: their numbers (k,).
        earlier: their states before (k, 18).
        elapsed: time since then [s].
        horizon: time for which their velocities of now lead on [s].
        moved: difference of a coordinate that does not count [m].
        turned: the same of an element of the rotation [-].
    """
    for k in range(len(which)):
        for c in range(9, 12):
            there = earlier[k, c] + (elapsed + horizon) * earlier[k, c + 3]
            if abs(states[which[k], c] + horizon * states[which[k], c + 3] - there) > moved:
                return True
        if earlier[k, 15] == 0.0 and earlier[k, 16] == 0.0 and earlier[k, 17] == 0.0:
            for c in range(9):
                if abs(states[which[k], c] - earlier[k, c]) > turned:
                    return True
    return False


@compiled
def surprise(
    states: Array, which: IntArray, earlier: Array, dt: float, horizon: float, moved: float
) -> tuple[float, bool]:
    """Compare k obstacles with what was known of them a step before.

    Args:
        states: of all obstacles (o, 18).
        which: their numbers (k,).
        earlier: their states dt before (k, 18); brought up to date.
        dt: [s].
        horizon: time for which velocities lead on [s].
        moved: difference of a coordinate that does not count [m].

    Returns:
        The largest square of what positions differ from those that velocities led to [m²]; whether a velocity leads
        elsewhere than that of the step before.
    """
    worst, turns = 0.0, False
    for k in range(len(which)):
        square = 0.0
        for c in range(9, 12):
            off = states[which[k], c] - earlier[k, c] - dt * earlier[k, c + 3]
            square += off**2
            turns = turns or abs(off + horizon * (states[which[k], c + 3] - earlier[k, c + 3])) > moved
        worst = max(worst, square)
        for c in range(18):
            earlier[k, c] = states[which[k], c]
    return worst, turns
