"""Braking of one coordinate within limits of acceleration and jerk, in closed form.

The functions take arrays or numbers: Python calls them as they are, kernels call what numba compiles of them.

With acceleration limits alone, `speed_to_stop` is all. With jerk limits, time is counted in control steps and v in the
largest change of the change of v: v is constant over a step and changes by w, which changes by no more than 1 from step
to step and is no larger than `w_max`, the largest change of v over the largest change of that change.

The stop brakes as hard as it can without having to let v pass zero: from v, a change of -b can be taken back, 1 less in
every step, before v is used up, if b is at most σ(v) = `speed_to_stop(v, 1, 1)`: the braking law of positions, one
derivative up. With T(v) = -sgn(v) min(σ(|v|), w_max), the next change is T(v), as far as w - 1 and w + 1 allow.

The stop keeps order: of two states with v <= v' and w <= w', the second one's speed is never below the first one's.
v + T(v) does not fall with v, and once the changes are ordered in reverse, the second has reached T from above and the
first from below; as T changes by at most 1 along itself, it stays so. So stopping distances grow with the change that
is chosen now, and the changes from which a stop ends before a limit are an interval. The next change of the stop itself
is in the intervals of both limits: its path is part of that of the previous step. So bounds made of these never cross.
"""

from __future__ import annotations

from typing import Any

import numpy as np

MAX_NEWTON_STEPS = 20
"""Newton steps of `bounds._change_to_stop` at most [-]; two to five are taken."""
ZERO_SPEED = 1e-9
"""Share of the largest change of v below which a speed is round-off of 0 [-]."""


def speed_to_stop(distance: Any, v_step: Any, dt: Any) -> Any:
    """Compute the largest speed from which braking by `v_step` every period takes `distance`.

    From v it still moves S(v) = dt Σ max(v - i v_step, 0), i = 0, 1, …; on (n - 1) v_step <= v <= n v_step that is
    n dt v - dt v_step n (n - 1) / 2, and S(n v_step) = dt v_step n (n + 1) / 2, which gives the number of periods n.
    Once it moves at such a speed, braking by `v_step` keeps to it, so that the bounds of the next period never
    contradict.

    Args:
        distance: to the limit (...), not negative; infinite where there is no limit [rad or m].
        v_step: change of speed in one period (...), positive [rad/s or m/s].
        dt: length of a period [s].

    Returns:
        Speed (...) [rad/s or m/s].
    """
    n = np.minimum(np.maximum(np.ceil(0.5 * np.sqrt(1.0 + 8.0 * distance / (v_step * dt)) - 0.5), 1.0), 1e15)
    return distance / (dt * n) + 0.5 * v_step * (n - 1.0)


def stopping_distance(v: Any, w: Any, w_max: Any) -> tuple[Any, Any]:
    """Compute the distance that a jerk-limited stop takes, the period of v included, and its derivative.

    Elementwise, of arrays or numbers, in the units of this module. The stop has three parts: v changes by 1 less in
    every step, until -w_max or T(v) is reached; by -w_max; by -b with b = σ(v), b - 1, and so on. In each, the distance
    is a polynomial of the number of steps. Where w is below T already, the stop is taken from T, which is longer.

    Args:
        v: speed (...) [changes of the change of v].
        w: change that has led to it (...) [changes of the change of v].
        w_max: largest change (...), positive [changes of the change of v].

    Returns:
        The distance (...) [changes of the change of v, times the period], 0 where v never gets above 0, and its
        derivative (...) where v and w grow by the same amount, as they do with the change that is chosen. The distance
        is convex in that amount, and linear but for kinks.
    """
    whole = np.floor(w)
    part = w - whole
    rising = np.maximum(whole, 0.0)
    peak = v + rising * w - 0.5 * rising * (rising + 1.0)
    # the first part ends with the first step n - 1 after the change was below 1 whose v is at most σ⁻¹(what comes next)
    n = np.ceil(part + np.sqrt(np.maximum(part * part + v + (whole - 1.0) * (0.5 * whole + part), 0.0)))
    k = np.maximum(n, np.maximum(1.0, 1.0 - whole)) - 1.0 + whole
    k = np.minimum(k, np.maximum(np.ceil(w_max - 1.0 + w), 0.0))
    speed = v + k * w - 0.5 * k * (k + 1.0)
    distance = (k + 1.0) * v + k * (k + 1.0) * (0.5 * w - (k + 2.0) / 6.0)
    n = np.ceil(w_max)
    m = np.maximum(np.ceil((speed - n * w_max + 0.5 * n * (n - 1.0)) / w_max), 0.0)
    distance = distance + m * speed - 0.5 * w_max * m * (m + 1.0)
    speed = np.maximum(speed - m * w_max, 0.0)
    n = np.maximum(np.ceil(0.5 * np.sqrt(1.0 + 8.0 * speed) - 0.5), 1.0)
    braking = speed / n + 0.5 * (n - 1.0)
    distance = distance + (n - 1.0) * n * ((n + 1.0) / 6.0 + 0.5 * (braking - n))
    moves = (peak > 0.0) * (distance > 0.0)
    return moves * distance, moves * (k + 1.0) * (0.5 * (k + 2.0) + m + 0.5 * (n - 1.0))


def max_stopping_distance(v: Any, w: Any, w_max: Any) -> Any:
    """Compute a quick upper bound (...) of `stopping_distance`.

    It adds the distances up to the largest speed, and from there to 0.

    Args:
        v: speed (...) [changes of the change of v].
        w: change that has led to it (...) [changes of the change of v].
        w_max: largest change (...), positive [changes of the change of v].
    """
    rising = np.maximum(w, 0.0)
    speed = np.maximum(v, 0.0) + 0.5 * rising * rising
    return speed * (rising + 2.0 + 0.5 * (speed / w_max + w_max))
