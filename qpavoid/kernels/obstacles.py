"""Obstacle states at a time, checks of states from outside, and the arrays that distances are computed from.

A *state* is a row of 18: rotation by columns, position, linear and angular velocity, in world axes [-, m, m/s, rad/s].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray

FINE, NORMALISED, NOT_FINITE, FAR, FAST, NO_ROTATION, LEFT_HANDED, NO_QUATERNION = range(8)
"""Codes of `check_states`; the last one of `check_updates` alone: a quaternion that is not of length 1."""
FARTHEST = 1e6
"""Coordinate of a position that is farther than any in a scene [m]; round-off is 0.1 nm there."""
FASTEST = 1e3
"""Component of a twist that nothing in a scene has [m/s, rad/s]."""
EXACT, NEARLY = 1e-6, 1e-3
"""|RᵀR - I| up to which a matrix is taken for a rotation as it is (rotations in single precision are 1e-7 off), and up
to which it is replaced by the nearest rotation (the rounding of a matrix that was typed with three digits) [-]."""
_EARLY = 1e-9
"""Time before its start from which a piece counts [s]: k·dt may be rounded to less than the time it stands for."""
SAMPLE, POSE, REST = range(3)
"""Kind of an update: with a twist, without one, at rest."""


class Pieces(NamedTuple):
    """Motions of k bodies, cut into n pieces on which the state is a weighted sum of seven constant terms.

    With the fraction s of a piece's time, its rate s' and the angle φ of the piece, the weights are 1, s, sin sφ,
    cos sφ, s', s'φ sin sφ, s'φ cos sφ: lines and rotations at constant speed, or smooth from rest to rest. A body's
    first piece starts at -∞, and each lasts until the next one starts.
    """

    bodies: IntArray
    """(k,) row of each body in the states."""
    first: IntArray
    """(k + 1,) first piece of each body; the last entry is n."""
    starts: Array
    """(n,) time at which each piece starts [s]."""
    clock: Array
    """(n, 4) time at which s is 0, and time in which it grows by 1, infinite at rest [s]; φ [rad]; 1 where s is smooth:
    s = 10 τ³ - 15 τ⁴ + 6 τ⁵ in place of the fraction of time τ."""
    terms: Array
    """(n, 7, 18) the constant terms."""


@compiled
def sample_pieces(x: Pieces, t: float, states: Array) -> None:
    """Write the states of the bodies of `x` at time t.

    Args:
        x: their motions.
        t: time [s].
        states: out (o, 18): rows `x.bodies`; the others are not changed.
    """
    weights = np.empty(7)
    for k in range(len(x.bodies)):
        low, high = x.first[k], x.first[k + 1]
        while high - low > 1:  # the piece lies in [low, high)
            middle = (low + high) // 2
            if x.starts[middle] <= t + _EARLY:
                low = middle
            else:
                high = middle
        origin, duration, angle = x.clock[low, 0], x.clock[low, 1], x.clock[low, 2]
        s, rate = max((t - origin) / duration, 0.0), 1.0 / duration
        if x.clock[low, 3] > 0.0:
            rate *= 30.0 * (s * (1.0 - s)) ** 2
            s *= s * s * (10.0 + s * (6.0 * s - 15.0))
        sin, cos, spin = np.sin(s * angle), np.cos(s * angle), rate * angle
        weights[0], weights[1], weights[2], weights[3] = 1.0, s, sin, cos
        weights[4], weights[5], weights[6] = rate, spin * sin, spin * cos
        state = states[x.bodies[k]]
        state[:] = 0.0
        for i in range(7):
            if weights[i] != 0.0:
                for c in range(18):
                    state[c] += weights[i] * x.terms[low, i, c]


@compiled
def check_states(
    states: Array, numbers: IntArray, kind: IntArray, max_position: float, max_twist: float
) -> tuple[IntArray, Array]:
    """Find states that are implausible, and normalise rotations that are nearly ones in place.

    R becomes ½ R (3 I - RᵀR), which squares its distance from the nearest rotation (Higham 2008, "Functions of
    matrices", 8.3, Newton-Schulz), four times over: from 1e-3 that leaves nothing but round-off.

    Args:
        states: (o, 18).
        numbers: of the states to check (k,).
        kind: of each update (k,): SAMPLE, POSE or REST; of the latter two, twists are not checked.
        max_position: largest coordinate of a position [m].
        max_twist: largest component of a twist [m/s, rad/s].

    Returns:
        (k,) FINE, NORMALISED, or the code of the first fault; (k,) largest entry of |RᵀR - I|.
    """
    codes, deviation = np.zeros(len(numbers), np.intp), np.zeros(len(numbers))
    for k in range(len(numbers)):
        codes[k], deviation[k] = check_state(states[numbers[k]], kind[k], max_position, max_twist)
    return codes, deviation


@compiled
def check_state(x: Array, kind: int, max_position: float, max_twist: float) -> tuple[int, float]:
    """Check one state (18,) of a kind, and normalise it in place; see `check_states`.

    Returns:
        Its code; largest entry of |RᵀR - I|.
    """
    count, total, far, fast = 18 if kind == SAMPLE else 12, 0.0, 0.0, 0.0
    for c in range(count):
        total += abs(x[c])
    if not total < np.inf:  # isfinite does not survive the reordering of sums
        return NOT_FINITE, 0.0
    for c in range(9, 12):
        far = max(far, abs(x[c]))
    for c in range(12, count):
        fast = max(fast, abs(x[c]))
    if far > max_position or fast > max_twist:
        return FAR if far > max_position else FAST, 0.0
    deviation = 0.0
    for r in range(3):
        for c in range(r + 1):
            product = x[3 * r] * x[3 * c] + x[3 * r + 1] * x[3 * c + 1] + x[3 * r + 2] * x[3 * c + 2]
            deviation = max(deviation, abs(product - (1.0 if r == c else 0.0)))
    normal = x[1] * x[5] - x[2] * x[4], x[2] * x[3] - x[0] * x[5], x[0] * x[4] - x[1] * x[3]
    if normal[0] * x[6] + normal[1] * x[7] + normal[2] * x[8] < 0.0:
        return LEFT_HANDED, deviation
    if not deviation <= NEARLY:
        return NO_ROTATION, deviation
    if deviation > EXACT:
        _normalise(x)
        return NORMALISED, deviation
    return FINE, deviation


@compiled
def _normalise(x: Array) -> None:
    """Replace a rotation by columns, the first nine entries, by the nearest one; see `check_states`."""
    gram, new = np.empty((3, 3)), np.empty(9)
    for _ in range(4):
        for r in range(3):
            for c in range(3):
                gram[r, c] = x[3 * r] * x[3 * c] + x[3 * r + 1] * x[3 * c + 1] + x[3 * r + 2] * x[3 * c + 2]
        for c in range(3):
            for r in range(3):
                new[3 * c + r] = 1.5 * x[3 * c + r]
                for i in range(3):
                    new[3 * c + r] -= 0.5 * x[3 * i + r] * gram[i, c]
        x[:9] = new
