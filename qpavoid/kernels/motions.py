"""Moving obstacles: where all of them are at a time, and what distances need to know of it.

A *state* is a row of 18: rotation by columns, position, linear and angular velocity, in world axes [-, m, m/s, rad/s].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.kernels.frames import _rotation_vector
from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray, Mask

FINE, NORMALISED, NOT_FINITE, FAR, FAST, NO_ROTATION, LEFT_HANDED = range(7)
"""What `check_states` finds."""
EXACT, NEARLY = 1e-6, 1e-3
"""|RᵀR - I| up to which a matrix is taken for a rotation as it is (those of 32 bits are 1e-7 off), and up to which it
is replaced by the rotation next to it."""
SAMPLE, POSE, REST = range(3)
"""How an obstacle is given: with a twist, without one, at rest."""


class Pieces(NamedTuple):
    """Motions of k bodies, cut into n pieces on which the state is a weighted sum of seven constant ones.

    With the share s of a piece's time, its rate s' and the angle φ of the piece, the weights are 1, s, sin sφ, cos sφ,
    s', s'φ sin sφ, s'φ cos sφ. A body's first piece starts at -∞, and each lasts until the next one starts.
    """

    bodies: IntArray
    """(k,) row of the states that each body has."""
    first: IntArray
    """(k + 1,) first piece of each body, and n."""
    starts: Array
    """(n,) [s]."""
    clock: Array
    """(n, 4) time from which s counts and in which it grows by 1, infinite at rest [s]; φ [rad]; 1 where s is smooth:
    10 τ³ - 15 τ⁴ + 6 τ⁵ in place of τ."""
    terms: Array
    """(n, 7, 18) the constant states."""


class Placed(NamedTuple):
    """What the distances of g bodies know of o obstacles, of which the first c can be carried."""

    states: Array
    """(o, 18)."""
    twists: Array
    """(o + 1 + c, 6) velocities at the world's origin; row o stays zero, the last c are negative."""
    margin: Array
    """(o + 1 + c,) taken off the distances to each, in the same order but positive [m]."""
    speeds: Array
    """(o,) largest speed of any of its points [m/s]."""
    reach: Array
    """(o,) distance from its origin to its farthest point that matters [m]."""
    placements: Array
    """(g, 12) poses of all bodies: rotation by columns, then position."""
    local: Array
    """(g, 3) centres of their bounding spheres in their own frames [m]."""
    centers: Array
    """(g, 5) the same in the world, as rows [c, 1, -|c|²]; those that joints carry are not kept up to date."""


@compiled
def sample_pieces(x: Pieces, t: float, tolerance: float, states: Array) -> None:
    """Write where the bodies are.

    Args:
        x: their motions.
        t: time [s].
        tolerance: how early a piece ends [s].
        states: out: rows of `bodies`; the others stay (o, 18).
    """
    weights = np.empty(7)
    for k in range(len(x.bodies)):
        low, high = x.first[k], x.first[k + 1]
        while high - low > 1:  # the piece lies in [low, high)
            middle = (low + high) // 2
            if x.starts[middle] <= t + tolerance:
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
def place_obstacles(
    x: Placed, which: IntArray, geometries: IntArray, owners: IntArray, states: Array, margin: Array
) -> tuple[int, bool]:
    """Move some obstacles.

    Args:
        x: overwritten; as it was where a number is NaN or infinite.
        which: numbers of the obstacles (k,).
        geometries: numbers of their bodies (b,).
        owners: to which of the k each of these belongs (b,).
        states: of all obstacles; read where `which` says (o, 18).
        margin: to be taken off their distances, read where `which` says (o,) [m].

    Returns:
        Number of the first obstacle with NaN or infinity, -1 where there is none; whether any of all obstacles has a
        velocity or a margin.
    """
    obstacles = len(x.states)
    negative = len(x.twists) - obstacles - 1
    for i in which:
        total = 0.0
        for c in range(18):
            total += states[i, c]
        if not abs(total) < np.inf:  # isfinite does not survive the reordering of sums
            return i, True
    for i in which:
        x.states[i] = states[i]
        state, twist = x.states[i], x.twists[i]
        px, py, pz = state[9], state[10], state[11]
        vx, vy, vz, wx, wy, wz = state[12], state[13], state[14], state[15], state[16], state[17]
        twist[0], twist[1], twist[2] = vx - wy * pz + wz * py, vy - wz * px + wx * pz, vz - wx * py + wy * px
        twist[3], twist[4], twist[5] = wx, wy, wz
        x.margin[i] = margin[i]
        if i < negative:
            x.margin[obstacles + 1 + i] = margin[i]
            for c in range(6):
                x.twists[obstacles + 1 + i, c] = -twist[c]
        turn = np.sqrt(wx * wx + wy * wy + wz * wz)
        x.speeds[i] = np.sqrt(vx * vx + vy * vy + vz * vz) + turn * x.reach[i]
    for n in range(len(geometries)):
        g, state = geometries[n], x.states[which[owners[n]]]
        for c in range(12):
            x.placements[g, c] = state[c]
        length = 0.0
        for r in range(3):
            turned = state[r] * x.local[g, 0] + state[3 + r] * x.local[g, 1] + state[6 + r] * x.local[g, 2]
            x.centers[g, r] = turned + state[9 + r]
            length += x.centers[g, r] ** 2
        x.centers[g, 4] = -length
    for i in range(obstacles):
        if x.margin[i] != 0.0:
            return -1, True
        for c in range(6):
            if x.twists[i, c] != 0.0:
                return -1, True
    return -1, False


@compiled
def check_states(
    states: Array, which: IntArray, kind: IntArray, farthest: float, fastest: float
) -> tuple[IntArray, Array]:
    """Find states that cannot be true, and normalise rotations that are nearly ones in place.

    R becomes ½ R (3 I - RᵀR), which squares its distance from the nearest rotation, four times over: from 1e-3 that
    leaves nothing but round-off.

    Args:
        states: (o, 18).
        which: numbers of those to look at (k,).
        kind: how each is given (k,): SAMPLE, POSE or REST; of the latter two, twists are not looked at.
        farthest: largest coordinate of a position [m].
        fastest: largest component of a twist [m/s, rad/s].

    Returns:
        (k,) FINE, NORMALISED, or the first thing that is wrong; (k,) largest entry of |RᵀR - I|.
    """
    codes, off, gram, new = np.zeros(len(which), np.intp), np.zeros(len(which)), np.empty((3, 3)), np.empty(9)
    for k in range(len(which)):
        x, count = states[which[k]], 18 if kind[k] == SAMPLE else 12
        total, far, fast = 0.0, 0.0, 0.0
        for c in range(count):
            total += abs(x[c])
        if not total < np.inf:  # isfinite does not survive the reordering of sums
            codes[k] = NOT_FINITE
            continue
        for c in range(9, 12):
            far = max(far, abs(x[c]))
        for c in range(12, count):
            fast = max(fast, abs(x[c]))
        if far > farthest or fast > fastest:
            codes[k] = FAR if far > farthest else FAST
            continue
        _gram(x, gram)
        for r in range(3):
            for c in range(3):
                off[k] = max(off[k], abs(gram[r, c] - (1.0 if r == c else 0.0)))
        across = x[1] * x[5] - x[2] * x[4], x[2] * x[3] - x[0] * x[5], x[0] * x[4] - x[1] * x[3]
        if across[0] * x[6] + across[1] * x[7] + across[2] * x[8] < 0.0:
            codes[k] = LEFT_HANDED
        elif not off[k] <= NEARLY:
            codes[k] = NO_ROTATION
        elif off[k] > EXACT:
            codes[k] = NORMALISED
            for _ in range(4):
                _gram(x, gram)
                for c in range(3):
                    for r in range(3):
                        new[3 * c + r] = 1.5 * x[3 * c + r]
                        for i in range(3):
                            new[3 * c + r] -= 0.5 * x[3 * i + r] * gram[i, c]
                x[:9] = new
    return codes, off


@compiled
def _gram(x: Array, gram: Array) -> None:
    """RᵀR (3, 3) of a rotation by columns (9,)."""
    for r in range(3):
        for c in range(3):
            gram[r, c] = x[3 * r] * x[3 * c] + x[3 * r + 1] * x[3 * c + 1] + x[3 * r + 2] * x[3 * c + 2]


@compiled
def take_in(
    which: IntArray, kind: IntArray, times: Array, news: Array, stamps: Array, last: Array, states: Array,
    shortest: float, fastest: float,
) -> Mask:  # fmt: skip
    """Take over checked states of obstacles that are given from outside; a bare pose gets the twist that has led to it.

    That is the difference of its last two poses, over the time between their stamps; the first one counts as at rest,
    and where no time lies between them the twist stays as it was.

    Args:
        which: numbers of the obstacles (k,).
        kind: how each is given (k,): SAMPLE, POSE or REST.
        times: their time stamps (k,) [s].
        news: what is given, read where `which` says (o, 18); the twists of bare poses are overwritten.
        stamps: time stamps of what was given last, NaN where nothing was (o,) [s]; overwritten.
        last: what was given last, with its twist (o, 18); overwritten.
        states: (o, 18) overwritten as well.
        shortest: time between two poses below which no twist is estimated [s].
        fastest: largest component of a twist that is estimated [m/s, rad/s].

    Returns:
        Which of them were taken over (k,); not those whose poses are too far apart for `fastest`.
    """
    fine, turn = np.ones(len(which), np.bool_), np.empty((3, 3))
    for k in range(len(which)):
        i = which[k]
        new, old, since = news[i], last[i], times[k] - stamps[i]
        if kind[k] != SAMPLE:
            new[12:] = 0.0
        if kind[k] == POSE and since > shortest:
            for r in range(3):
                new[12 + r] = (new[9 + r] - old[9 + r]) / since
                for c in range(3):
                    turn[r, c] = new[r] * old[c] + new[3 + r] * old[3 + c] + new[6 + r] * old[6 + c]
            angles = _rotation_vector(turn)
            for r in range(3):
                new[15 + r] = angles[r] / since
            for c in range(12, 18):
                fine[k] = fine[k] and abs(new[c]) <= fastest
        elif kind[k] == POSE and stamps[i] == stamps[i]:
            new[12:] = old[12:]
        if fine[k]:
            old[:] = new
            states[i] = new
            stamps[i] = times[k]
    return fine
