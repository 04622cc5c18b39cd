"""Estimates of obstacles that a program gives: updates checked, taken over, and extrapolated in one call each.

A *state* is a row of 18, see `kernels.obstacles`.
"""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.obstacles import FINE, POSE, REST, SAMPLE, check_states, update_measured_states
from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray


@compiled
def are_fine(states: Array, max_position: float, max_speed: float) -> bool:
    """Return True if `check_states` finds all of some samples FINE.

    Args:
        states: (k, 18), normalised in place.
        max_position: largest coordinate of a position [m].
        max_speed: largest component of a twist [m/s, rad/s].
    """
    k = len(states)
    codes, _ = check_states(states, np.arange(k), np.full(k, SAMPLE), max_position, max_speed)
    faults = 0
    for code in codes:
        faults += code != FINE
    return faults == 0


@compiled
def write_rows(
    states: Array, which: IntArray, rows: Array, kind: IntArray, max_position: float, max_speed: float,
    codes: IntArray, off: Array,
) -> int:  # fmt: skip
    """Write samples, or bare poses, into rows of states, and check them; the velocities of poses are zero.

    Args:
        states: out: rows `which` (o, 18), normalised.
        which: numbers of the rows (k,).
        rows: (k, 18) or (k, 12).
        kind: how each is given (k,): SAMPLE, POSE or REST.
        max_position: largest coordinate of a position [m].
        max_speed: largest component of a twist [m/s, rad/s].
        codes: out: (k,) what `check_states` finds.
        off: out: (k,) largest entry of |RᵀR - I|.

    Returns:
        How many are not FINE.
    """
    for k in range(len(which)):
        x = states[which[k]]
        x[12:] = 0.0
        for c in range(rows.shape[1]):
            x[c] = rows[k, c]
    codes[:], off[:] = check_states(states, which, kind, max_position, max_speed)
    count = 0
    for code in codes:
        count += code != FINE
    return count


@compiled
def update_estimates(
    which: IntArray, kind: IntArray, times: Array, updates: Array, stamps: Array, last: Array, states: Array,
    shortest: float, max_speed: float, steady: float, means: Array, counts: Array, at_rest: Array,
) -> int:  # fmt: skip
    """Take over checked states, see `update_measured_states`, and their twists into the means of these.

    A mean is of all twists at first, then of those within about `steady`: m += λ (ν - m) with λ the larger of 1/n and
    T / (steady + T), T since the update before.

    Args:
        which: numbers of the obstacles (k,).
        kind: how each is given (k,): SAMPLE, POSE or REST.
        times: their time stamps (k,) [s].
        updates: what is given, read where `which` says (o, 18); the twists of bare poses are overwritten.
        stamps: time stamps of the last update, NaN where there was none (o,) [s]; overwritten.
        last: the last update, with its twist (o, 18); overwritten.
        states: (o, 18) overwritten as well.
        shortest: time between two poses below which no twist is estimated [s].
        max_speed: largest component of a twist that is estimated [m/s, rad/s].
        steady: time over which twists are averaged [s].
        means: mean twists (o, 6); overwritten.
        counts: how many twists are in each mean (o,); overwritten.
        at_rest: out: which of them rest (o,).

    Returns:
        How many were not taken over, as their poses are too far apart; their stamps stay as they were.
    """
    previous_stamps = stamps[which]
    fine = update_measured_states(which, kind, times, updates, stamps, last, states, shortest, max_speed)
    rejected = 0
    for k in range(len(which)):
        i, elapsed = which[k], times[k] - previous_stamps[k]
        if not fine[k]:
            rejected += 1
            continue
        at_rest[i] = kind[k] == REST
        if kind[k] == POSE and previous_stamps[k] != previous_stamps[k]:  # no twist is known of a first pose
            continue
        counts[i] += 1.0
        gain = 1.0 / counts[i]
        if elapsed > 0.0:
            gain = max(gain, elapsed / (steady + elapsed))
        for c in range(6):
            means[i, c] += gain * (last[i, 12 + c] - means[i, c])
    return rejected


MARGIN_GROWTH = 0.1
"""Rate at which the margin of a stale obstacle grows [m/s]: a bound on the error of its last twist."""


@compiled
def extrapolate_estimates(
    which: IntArray, t: float, longest: float, stamps: Array, last: Array, states: Array,
    stale_after: float, at_rest: Array, margin: Array,
) -> int:  # fmt: skip
    """Bring obstacles from where they were at their time stamps to t, at constant twists about their origins.

    Args:
        which: numbers of the obstacles (k,).
        t: time [s].
        longest: time for which they keep their twists at the most [s].
        stamps: time stamps (o,) [s].
        last: states at these (o, 18).
        states: out: rows `which` (o, 18).
        stale_after: age from which one is stale [s].
        at_rest: those that are never stale (o,).
        margin: what stale ones get is added (o,) [m].

    Returns:
        How many are stale.
    """
    stale = 0
    for i in which:
        age = t - stamps[i]
        x = states[i]
        x[:] = last[i]
        if not age > 0.0:
            continue
        if age > stale_after and not at_rest[i]:
            stale += 1
            margin[i] += MARGIN_GROWTH * (age - stale_after)
        _extrapolate(x, min(age, longest))
    return stale


@compiled
def extrapolate_states(states: Array, times: Array) -> None:
    """Bring bodies to where they are some time later at constant twists about their origins.

    Args:
        states: (k, 18), overwritten.
        times: (k,) [s].
    """
    for k in range(len(states)):
        _extrapolate(states[k], times[k])


@compiled
def _extrapolate(x: Array, t: float) -> None:
    """Bring one body (18,) to where it is after t [s]: p + t v, and R + sin φ [a] R + (1 - cos φ) [a]² R.

    The angle is φ = t |ω|, about the axis a = ω / |ω| (Rodrigues).
    """
    for r in range(3):
        x[9 + r] += t * x[12 + r]
    rate = np.sqrt(x[15] * x[15] + x[16] * x[16] + x[17] * x[17])
    if rate > 0.0:
        ax, ay, az = x[15] / rate, x[16] / rate, x[17] / rate
        sin, versin = np.sin(t * rate), 2.0 * np.sin(0.5 * t * rate) ** 2
        for c in range(3):
            u, v, w = x[3 * c], x[3 * c + 1], x[3 * c + 2]
            cu, cv, cw = ay * w - az * v, az * u - ax * w, ax * v - ay * u
            x[3 * c] += sin * cu + versin * (ay * cw - az * cv)
            x[3 * c + 1] += sin * cv + versin * (az * cu - ax * cw)
            x[3 * c + 2] += sin * cw + versin * (ax * cv - ay * cu)
