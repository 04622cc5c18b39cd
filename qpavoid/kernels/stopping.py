"""Stops of one coordinate within limits of acceleration and jerk, in closed form.

The functions take arrays or numbers: Python calls them as they are, kernels what numba compiles of them.

With acceleration limits alone, `speed_to_stop` is all. With jerk limits, units are ticks, and what jerk allows: v is
held for a tick and changes by w, which changes by no more than 1 and is no larger than `most`, the largest change of v
over the largest change of that change.

The stop brakes as hard as it can without having to let v pass zero: from v, a change of -b can be taken back, 1 less in
every tick, before v is used up, if b is at most σ(v) = `speed_to_stop(v, 1, 1)`: the braking law of positions, one
derivative up. With T(v) = -sgn(v) min(σ(|v|), most), the next change is T(v), as far as w - 1 and w + 1 allow.

It keeps order: of two states with v <= v' and w <= w', the second one's speed is never below the first one's. v + T(v)
does not fall with v, and once the changes are the other way round, the second has reached T from above and the first
from below; as T changes by at most 1 along itself, it stays so. So ways grow with the change that is chosen now, and
the changes from which a stop ends before a limit are an interval. The next change of the stop itself is in the
intervals of both limits: its way is part of the one of the tick before. So bounds made of these never cross.
"""

from __future__ import annotations

from typing import Any

import numpy as np

MOST_STEPS = 20
"""Newton steps of `change_to_stop`; two to five are taken."""
AT_REST = 1e-9
"""Share of the largest change of v below which a speed is round-off of 0 [-]."""


def speed_to_stop(room: Any, step: Any, dt: Any) -> Any:
    """Compute the largest speed from which a coordinate that slows by `step` every period stops within `room`.

    From v it still moves S(v) = dt Σ max(v - i step, 0), i = 0, 1, …; on (n - 1) step <= v <= n step that is
    n dt v - dt step n (n - 1) / 2, and S(n step) = dt step n (n + 1) / 2, which gives the number of periods n. Once it
    moves at such a speed, slowing by `step` keeps to it, so that the bounds of the next period never contradict.

    Args:
        room: distance left (...), not negative; infinite where there is no limit [rad or m].
        step: change of speed in one period (...), positive [rad/s or m/s].
        dt: length of a period [s].

    Returns:
        Speed (...) [rad/s or m/s].
    """
    n = np.minimum(np.maximum(np.ceil(0.5 * np.sqrt(1.0 + 8.0 * room / (step * dt)) - 0.5), 1.0), 1e15)
    return room / (dt * n) + 0.5 * step * (n - 1.0)


def way_to_stop(v: Any, w: Any, most: Any) -> tuple[Any, Any]:
    """Compute how far a coordinate at v, after a change of w, moves until its stop ends, the period of v included.

    Elementwise, of arrays or numbers. The stop has three parts: v changes less by 1 in every tick, until -most or T(v)
    is reached; by -most; by -b with b = σ(v), b - 1, and so on. In each, the way is a polynomial of the number of
    ticks. Where w is below T already, the stop is taken from T, which is farther.

    Args:
        v: speed (...) [changes of the change of v].
        w: change that has led to it (...) [likewise].
        most: largest change (...), positive [likewise].

    Returns:
        The way (...), 0 where v never gets above 0, and its derivative (...) where v and w grow by the same amount, as
        they do with the change that is chosen. It is convex in that amount, and linear but for kinks.
    """
    whole = np.floor(w)
    part = w - whole
    rising = np.maximum(whole, 0.0)
    peak = v + rising * w - 0.5 * rising * (rising + 1.0)
    # the first part ends with the first tick n - 1 after the change was below 1 whose v is at most σ⁻¹(what comes next)
    n = np.ceil(part + np.sqrt(np.maximum(part * part + v + (whole - 1.0) * (0.5 * whole + part), 0.0)))
    k = np.maximum(n, np.maximum(1.0, 1.0 - whole)) - 1.0 + whole
    k = np.minimum(k, np.maximum(np.ceil(most - 1.0 + w), 0.0))
    speed = v + k * w - 0.5 * k * (k + 1.0)
    way = (k + 1.0) * v + k * (k + 1.0) * (0.5 * w - (k + 2.0) / 6.0)
    n = np.ceil(most)
    m = np.maximum(np.ceil((speed - n * most + 0.5 * n * (n - 1.0)) / most), 0.0)
    way = way + m * speed - 0.5 * most * m * (m + 1.0)
    speed = np.maximum(speed - m * most, 0.0)
    n = np.maximum(np.ceil(0.5 * np.sqrt(1.0 + 8.0 * speed) - 0.5), 1.0)
    braking = speed / n + 0.5 * (n - 1.0)
    way = way + (n - 1.0) * n * ((n + 1.0) / 6.0 + 0.5 * (braking - n))
    moves = (peak > 0.0) * (way > 0.0)
    return moves * way, moves * (k + 1.0) * (0.5 * (k + 2.0) + m + 0.5 * (n - 1.0))


def longest_way(v: Any, w: Any, most: Any) -> Any:
    """Compute a quick bound above `way_to_stop` (...): up to the largest speed, and from there."""
    rising = np.maximum(w, 0.0)
    speed = np.maximum(v, 0.0) + 0.5 * rising * rising
    return speed * (rising + 2.0 + 0.5 * (speed / most + most))
