"""Obstacles that turn: the rate at which the velocity of one turns, from its last velocities, and the arc that follows.

A *state* is a row of 18, see `kernels.obstacles`.
"""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.kernels.pose_fit import extrapolate
from qpavoid.problem import Array

TURN_FIT = 10
"""Numbers in the fit of an obstacle's velocities: velocity and acceleration, the mean square of what they leave
unexplained, how many velocities, the time since the first of them, and how far a turn explains them, 0 to 1."""
_MEMORY = 0.1
"""Time in which a velocity loses weight in the fit [s]: a change of velocity is followed within 0.3 s."""
_SPAN = 0.2
"""Time over which a change of velocity counts as one that goes on [s]: that of the mean twists."""
_FEWEST = 4.0
"""Velocities from which on a turn counts [-]: two explain themselves."""
_RATIO = 3.0
"""Change of velocity, over what is left unexplained, from which on a turn counts [-]: noise alone changes the fit by
about half of it, a sudden change of velocity by up to 2.6 times."""
_LEAST_ACCELERATION = 1e-3
"""Below which an obstacle goes straight [m/s²]: 1 mm in the horizon of a backup trajectory."""
_AT_REST = 1e-9
"""Speed below which none turns [m/s]: round-off."""


@compiled
def fit_turn(fit: Array, velocity: Array, interval: float, turn: Array) -> None:
    """Put a velocity into the fit of those before.

    Velocity v and acceleration a follow with fading memory, θ = memory/(memory + T), as the line of least weighted
    squares does (Brookner 1998, "Tracking and Kalman filtering made easy", 4.1): v += (1 - θ²) e, a += (1 - θ)² e / T,
    more for the first ones; but between two velocities v turns with a, in their plane. So e is 0 on a circle.

    A turn explains 1 - (3 s/(a⊥ span))² of them, s the root mean square of e: nothing where noise may be all there is.

    Args:
        fit: (TURN_FIT,) of the velocities before; overwritten.
        velocity: linear velocity (3,) [m/s].
        interval: time since the one before [s].
        turn: out: v × a / |v|² times that (3,) [rad/s].
    """
    v, a = fit[:3], fit[3:6]
    turn[:] = 0.0
    if not 0.0 < interval <= _SPAN or fit[7] == 0.0:  # NaN, too
        fit[:], fit[:3], fit[7] = 0.0, velocity[:3], 1.0
        return
    _turn_on(v, a, interval, turn)
    n = fit[7] + 1.0
    fade = _MEMORY / (_MEMORY + interval)
    follow, bend = max(1.0 - fade * fade, (4.0 * n - 2.0) / (n * n + n)), max((1.0 - fade) ** 2, 6.0 / (n * n + n))
    square = 0.0
    for c in range(3):
        error = velocity[c] - v[c]
        square += error * error
        v[c] += follow * error
        a[c] += bend * error / interval
    if n > 2.0:
        fit[6] += max(1.0 - fade, 1.0 / (n - 2.0)) * (square - fit[6])
    fit[7], fit[8] = n, min(fit[8] + interval, _SPAN)
    speed, across = _speed_and_turn(v, a, turn)
    unexplained, change = _RATIO * np.sqrt(fit[6]), min(across * fit[8], speed)
    counts = n >= _FEWEST and across >= _LEAST_ACCELERATION and change > unexplained
    fit[9] = 1.0 - (unexplained / change) ** 2 if counts else 0.0
    for c in range(3):
        turn[c] *= fit[9]


@compiled
def _speed_and_turn(v: Array, a: Array, turn: Array) -> tuple[float, float]:
    """Write v × a / |v|² (3,); return |v| and the acceleration across v."""
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if square < _AT_REST**2:
        turn[:] = 0.0
        return 0.0, 0.0
    turn[0] = (v[1] * a[2] - v[2] * a[1]) / square
    turn[1] = (v[2] * a[0] - v[0] * a[2]) / square
    turn[2] = (v[0] * a[1] - v[1] * a[0]) / square
    speed = np.sqrt(square)
    return speed, speed * np.sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2])


@compiled
def _turn_on(v: Array, a: Array, t: float, turn: Array) -> None:
    """Bring velocity and acceleration (3,) to a later time, in place: both turn at the rate at which v does, `turn`."""
    speed, across = _speed_and_turn(v, a, turn)
    if across == 0.0:
        for c in range(3):
            v[c] += t * a[c]
        return
    along = (v[0] * a[0] + v[1] * a[1] + v[2] * a[2]) / speed
    sin, cos = np.sin(t * across / speed), np.cos(t * across / speed)
    for c in range(3):
        one = v[c] / speed
        two = (a[c] - along * one) / across
        forward, aside = cos * one + sin * two, cos * two - sin * one
        v[c], a[c] = (speed + t * along) * forward, along * forward + across * aside


@compiled
def follow_arc(x: Array, turn: Array, t: float) -> None:
    """Bring one body (18,) to where it is after t [s] if its velocity turns at a rate (3,) [rad/s].

    With ω = |turn|, its axis u, the part v∥ along it and v⊥ across it: p + t v∥ + (sin ωt v⊥ + (1 - cos ωt) u×v⊥) / ω.
    """
    rate = np.sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2])
    extrapolate(x, t)
    if rate == 0.0:
        return
    sin, versin = np.sin(rate * t), 2.0 * np.sin(0.5 * rate * t) ** 2
    ux, uy, uz = turn[0] / rate, turn[1] / rate, turn[2] / rate
    vx, vy, vz = x[12], x[13], x[14]
    sx, sy, sz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx  # u×v, and u×(u×v) below
    bx, by, bz = uy * sz - uz * sy, uz * sx - ux * sz, ux * sy - uy * sx
    aside, back = versin / rate, t - sin / rate
    x[9] += aside * sx + back * bx
    x[10] += aside * sy + back * by
    x[11] += aside * sz + back * bz
    x[12] += sin * sx + versin * bx
    x[13] += sin * sy + versin * by
    x[14] += sin * sz + versin * bz
