"""The functions of `qpavoid.kernels.vectorised.motions` as loops that numba compiles; documented there."""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.compiled.frames import _rotation_vector
from qpavoid.kernels.compiled.packing import compiled
from qpavoid.kernels.vectorised.motions import (
    EXACT,
    FAR,
    FAST,
    LEFT_HANDED,
    NEARLY,
    NO_ROTATION,
    NORMALISED,
    NOT_FINITE,
    POSE,
    SAMPLE,
    Pieces,
    Placed,
)
from qpavoid.problem import Array, IntArray, Mask


def pack_pieces(pieces: Pieces) -> Pieces:
    """See `vectorised.motions.pack_pieces`."""
    return pieces


@compiled
def sample_pieces(x: Pieces, t: float, tolerance: float, states: Array) -> None:
    """See `vectorised.motions.sample_pieces`."""
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
    """See `vectorised.motions.place_obstacles`."""
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
    """See `vectorised.motions.check_states`."""
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
    """See `vectorised.motions.take_in`."""
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
