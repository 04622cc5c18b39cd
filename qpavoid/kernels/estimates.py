"""Estimates of obstacles that a program gives: updates checked, taken over, and extrapolated in one call each.

A *state* is a row of 18, see `kernels.obstacles`.
"""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.obstacles import FINE, POSE, REST, SAMPLE, check_states
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.tasks import _rotation_vector
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


FIT = 27
"""Numbers in the fit of an obstacle's poses: its last pose; the weighted sums of 1, x, x², y and x y over all poses,
with times x and displacements y (6,) from the last one, rotations as vectors."""
POSE_WEIGHT = 0.6
"""Weight of a pose in the fit, to that of the next one [-]: errors are those of a line through 7 poses of equal weight;
a change of velocity takes 3 poses."""
_JUMP = 0.03, 0.3
"""Distance [m] and angle [rad] from the fit at which a pose starts it anew: several times the noise of a camera."""


@compiled
def fit_pose(x: Array, fit: Array, interval: float, max_speed: float) -> bool:
    """Put a pose on the line through it and those before, and estimate its twist as the slope of that line.

    The line of least weighted squares, a + b x with times x from now and displacements from this pose: the pose is
    moved by a, and gets the twist b. Two poses give the difference over the interval, one gives a twist of zero.

    Args:
        x: state (18,) with a pose; overwritten.
        fit: (FIT,) of the poses before; overwritten.
        interval: time since the pose before [s].
        max_speed: largest component of a twist between two poses [m/s, rad/s].

    Returns:
        False where the pose is too far from the one before for that; nothing is changed then.
    """
    y, R, pose = np.zeros(6), np.empty((3, 3)), x[:12].copy()
    if fit[12] > 0.0:
        for r in range(3):
            y[r] = x[9 + r] - fit[9 + r]
            for c in range(3):
                R[r, c] = x[r] * fit[c] + x[3 + r] * fit[3 + c] + x[6 + r] * fit[6 + c]
        y[3], y[4], y[5] = _rotation_vector(R)
        for c in range(6):
            if not abs(y[c]) <= max_speed * interval:
                return False
        displacement, slope = _line(fit)
        off = y - displacement - interval * slope
        if np.sqrt(np.sum(off[:3] ** 2)) > _JUMP[0] or np.sqrt(np.sum(off[3:] ** 2)) > _JUMP[1]:
            start_fit(fit, fit[:12].copy())
    s, sx, sxx, T = fit[12], fit[13], fit[14], interval
    for c in range(6):
        sy, sxy = fit[15 + c], fit[21 + c]
        fit[15 + c] = POSE_WEIGHT * (sy - y[c] * s)
        fit[21 + c] = POSE_WEIGHT * (sxy - y[c] * sx - T * sy + T * y[c] * s)
    fit[12], fit[13] = 1.0 + POSE_WEIGHT * s, POSE_WEIGHT * (sx - T * s)
    fit[14] = POSE_WEIGHT * (sxx - 2.0 * T * sx + T * T * s)
    fit[:12] = pose
    displacement, slope = _line(fit)
    x[12:] = displacement
    extrapolate(x, 1.0)
    x[12:] = slope
    return True


@compiled
def start_fit(fit: Array, pose: Array) -> None:
    """Let the fit (FIT,) begin with one pose (12,)."""
    fit[:12] = pose
    fit[12] = 1.0
    fit[13:] = 0.0


@compiled
def _line(fit: Array) -> tuple[Array, Array]:
    """Compute displacement (6,) and slope (6,) of the line of a fit at its last pose; zero of less than two poses."""
    s, sx, sxx = fit[12], fit[13], fit[14]
    det = s * sxx - sx * sx
    if not det > 0.0:
        return np.zeros(6), np.zeros(6)
    return (sxx * fit[15:21] - sx * fit[21:27]) / det, (s * fit[21:27] - sx * fit[15:21]) / det


@compiled
def update_estimates(
    which: IntArray, kind: IntArray, times: Array, updates: Array, stamps: Array, last: Array, states: Array,
    fits: Array, shortest: float, max_speed: float, steady: float, means: Array, counts: Array, at_rest: Array,
) -> int:  # fmt: skip
    """Take over checked states, and their twists into the means of these; those of bare poses from `fit_pose`.

    A mean is of all twists at first, then of those within about `steady`: m += λ (ν - m) with λ the larger of 1/n and
    T / (steady + T), T since the update before.

    Args:
        which: numbers of the obstacles (k,).
        kind: how each is given (k,): SAMPLE, POSE or REST.
        times: their time stamps (k,) [s].
        updates: what is given, read where `which` says (o, 18); bare poses are overwritten.
        stamps: time stamps of the last update, NaN where there was none (o,) [s]; overwritten.
        last: the last update, with its twist (o, 18); overwritten.
        states: (o, 18) overwritten as well.
        fits: of bare poses (o, FIT); overwritten.
        shortest: time between two poses below which no twist is estimated [s].
        max_speed: largest component of a twist that is estimated [m/s, rad/s].
        steady: time over which twists are averaged [s].
        means: mean twists (o, 6); overwritten.
        counts: how many twists are in each mean (o,); overwritten.
        at_rest: out: which of them rest (o,).

    Returns:
        How many were not taken over, as their poses are too far apart; their stamps stay as they were.
    """
    rejected = 0
    for k in range(len(which)):
        i, elapsed = which[k], times[k] - stamps[which[k]]
        x, is_first = updates[i], fits[i, 12] == 0.0
        if kind[k] != POSE:
            start_fit(fits[i], x[:12])
            if kind[k] == REST:
                x[12:] = 0.0
        elif is_first or elapsed > shortest:
            if not fit_pose(x, fits[i], 0.0 if is_first else elapsed, max_speed):
                rejected += 1
                continue
        else:
            x[12:] = last[i, 12:]
        last[i], states[i], stamps[i], at_rest[i] = x, x, times[k], kind[k] == REST
        if kind[k] == POSE and is_first:  # no twist is known of a first pose
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
        extrapolate(x, min(age, longest))
    return stale


@compiled
def extrapolate_states(states: Array, times: Array) -> None:
    """Bring bodies to where they are some time later at constant twists about their origins.

    Args:
        states: (k, 18), overwritten.
        times: (k,) [s].
    """
    for k in range(len(states)):
        extrapolate(states[k], times[k])


@compiled
def extrapolate(x: Array, t: float) -> None:
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
