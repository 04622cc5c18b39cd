"""Array work of moving obstacles in numpy: where all of them are at a time, and what distances need to know of it.

`qpavoid.kernels.compiled.motions` has the same functions as loops for numba; both pass the same tests.

A *state* is a row of 18: rotation by columns, position, linear and angular velocity, in world axes [-, m, m/s, rad/s].
"""

from __future__ import annotations

from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.rotation import ANTICYCLE, CYCLE, rotation_vector
from qpavoid.problem import Array, IntArray, Mask


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


class Running:
    """The pieces on which the bodies are, which stay the same until one of them ends, and memory for the weights."""

    def __init__(self, pieces: Pieces) -> None:
        self.pieces = pieces
        count = len(pieces.bodies)
        # numbers of bodies and times, in lexicographic order: one search finds the pieces of all
        self._starts = np.repeat(np.arange(count), np.diff(pieces.first)).astype(np.complex128)
        self._starts.imag = pieces.starts
        self._ends = np.append(pieces.starts[1:], np.inf)
        self._ends[pieces.first[1:] - 1] = np.inf
        self._now = np.arange(count).astype(np.complex128)
        self.since, self.until = np.inf, -np.inf
        self.weights = np.ones((count, 1, 7))
        self.s, self.turned, self.rate, self.spun = (self.weights[:, 0].T[i] for i in (1, slice(2, 4), 4, slice(5, 7)))

    def change(self, t: float) -> None:
        """Lays out anew what holds at time t [s]."""
        x = self.pieces
        self._now.imag = t
        piece = self._starts.searchsorted(self._now, side="right") - 1
        self.since, self.until = x.starts[piece].max(), self._ends[piece].min()
        self.origin, self.duration, self.angle, smooth = np.ascontiguousarray(x.clock[piece].T)
        self.terms = x.terms[piece]
        self.eased = np.flatnonzero(smooth)
        self.constant_rate = 1.0 / self.duration
        self.spin = self.constant_rate * self.angle
        self.rate[:] = self.constant_rate


def pack_pieces(pieces: Pieces) -> Running:
    """The pieces in the form that `sample_pieces` takes."""
    return Running(pieces)


def sample_pieces(x: Any, t: float, tolerance: float, states: Array) -> None:
    """Where the bodies are.

    Args:
        x: their motions.
        t: time [s].
        tolerance: how early a piece ends [s].
        states: out: rows of `bodies`; the others stay (o, 18).
    """
    if not x.since <= t + tolerance < x.until:
        x.change(t + tolerance)
    s, spin = x.s, x.spin
    np.subtract(t, x.origin, out=s)
    s /= x.duration
    np.maximum(s, 0.0, out=s)
    if len(x.eased):
        share = s[x.eased]
        rate = x.constant_rate[x.eased] * 30.0 * (share * (1.0 - share)) ** 2
        s[x.eased] = share * share * share * (10.0 + share * (6.0 * share - 15.0))
        x.rate[x.eased] = rate
        spin = x.rate * x.angle
    turned = s * x.angle
    np.sin(turned, out=x.turned[0])
    np.cos(turned, out=x.turned[1])
    np.multiply(spin, x.turned, out=x.spun)
    states[x.pieces.bodies] = np.matmul(x.weights, x.terms)[:, 0]


class Placed(NamedTuple):
    """What the distances of g bodies know of o obstacles, of which the first c can be carried."""

    states: Array
    """(o, 18)."""
    twists: Array
    """(o + 1 + c, 6) velocities at the world's origin; row o stays zero, the last c are negative."""
    margin: Array
    """(o + 1 + c,) taken off the distances to each, likewise but positive [m]."""
    speeds: Array
    """(o,) largest speed of any of its points [m/s]."""
    reach: Array
    """(o,) distance from its origin to its farthest point that matters [m]."""
    placements: Array
    """(g, 12) poses of all bodies: rotation by columns, then position."""
    local: Array
    """(g, 3) centres of their bounding spheres in their own frames [m]."""
    centred: bool
    """Whether these are zero for all that can be placed."""
    centers: Array
    """(g, 5) the same in the world, as rows [c, 1, -|c|²]; those that joints carry are not kept up to date."""


def place_obstacles(
    x: Placed, which: IntArray, geometries: IntArray, owners: IntArray, states: Array, margin: Array
) -> tuple[int, bool]:
    """Moves some obstacles.

    Args:
        x: overwritten; as it was where a number is NaN or infinite.
        which: numbers of the obstacles (k,).
        geometries: numbers of their bodies (b,).
        owners: to which of the k each of these belongs (b,).
        states: of all obstacles; read where `which` says (o, 18).
        margin: to be taken off their distances, likewise (o,) [m].

    Returns:
        Number of the first obstacle with NaN or infinity, -1 where there is none; whether any of all obstacles has a
        velocity or a margin.
    """
    new = states.take(which, axis=0)
    if not isfinite(np.vdot(new, new)):
        return int(which[~np.isfinite(new).all(axis=1)][0]), True
    x.states[which] = new
    linear, angular = new[:, 12:15], new[:, 15:]
    twists, speed = new[:, 12:], np.sqrt(np.vecdot(linear, linear))
    if np.count_nonzero(angular):
        twists = twists.copy()
        products = angular.take(CYCLE, axis=1)
        products *= new[:, 9:12].take(ANTICYCLE, axis=1)  # ω × p
        twists[:, :3] -= products[:, :3]
        twists[:, :3] += products[:, 3:]
        speed += np.sqrt(np.vecdot(angular, angular)) * x.reach.take(which)
    x.twists[which], x.margin[which], x.speeds[which] = twists, margin.take(which), speed
    obstacles = len(x.states)
    last = len(x.twists) - obstacles - 1
    if last:
        np.negative(x.twists[:last], out=x.twists[obstacles + 1 :])
        x.margin[obstacles + 1 :] = x.margin[:last]
    poses = new[:, :12].take(owners, axis=0)
    x.placements[geometries] = poses
    spheres = np.ones((len(poses), 5))
    center = spheres[:, :3]
    center[:] = poses[:, 9:]
    if not x.centred:
        center += np.matmul(x.local.take(geometries, axis=0)[:, None], poses[:, :9].reshape(-1, 3, 3))[:, 0]
    np.vecdot(center, -center, out=spheres[:, 4])
    x.centers[geometries] = spheres
    return -1, bool(np.count_nonzero(x.twists) or np.count_nonzero(x.margin))


FINE, NORMALISED, NOT_FINITE, FAR, FAST, NO_ROTATION, LEFT_HANDED = range(7)
"""What `check_states` finds."""
EXACT, NEARLY = 1e-6, 1e-3
"""|RᵀR - I| up to which a matrix is taken for a rotation as it is (those of 32 bits are 1e-7 off), and up to which it
is replaced by the rotation next to it."""
SAMPLE, POSE, REST = range(3)
"""How an obstacle is given: with a twist, without one, at rest."""


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
    codes, off = np.zeros(len(which), dtype=np.intp), np.zeros(len(which))
    for k, (i, how) in enumerate(zip(which.tolist(), kind.tolist(), strict=True)):
        state = states[i, : 18 if how == SAMPLE else 12]
        R = state[:9].reshape(3, 3).T
        if not np.isfinite(state).all():
            codes[k] = NOT_FINITE
        elif np.abs(state[9:12]).max() > farthest:
            codes[k] = FAR
        elif np.abs(state[12:]).max(initial=0.0) > fastest:
            codes[k] = FAST
        else:
            off[k] = np.abs(R.T @ R - np.eye(3)).max()
            if np.linalg.det(R) < 0.0:
                codes[k] = LEFT_HANDED
            elif not off[k] <= NEARLY:
                codes[k] = NO_ROTATION
            elif off[k] > EXACT:
                codes[k] = NORMALISED
                for _ in range(4):
                    R = 0.5 * R @ (3.0 * np.eye(3) - R.T @ R)
                state[:9] = R.T.ravel()
    return codes, off


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
    fine = np.ones(len(which), dtype=bool)
    for k, (i, how) in enumerate(zip(which.tolist(), kind.tolist(), strict=True)):
        new, old, since = news[i], last[i], times[k] - stamps[i]
        if how != SAMPLE:
            new[12:] = 0.0
        if how == POSE and since > shortest:
            turn = new[:9].reshape(3, 3).T @ old[:9].reshape(3, 3)
            new[12:15] = (new[9:12] - old[9:12]) / since
            new[15:] = np.array(rotation_vector(turn.tolist())) / since
            fine[k] = np.abs(new[12:]).max() <= fastest
        elif how == POSE and stamps[i] == stamps[i]:
            new[12:] = old[12:]
        if fine[k]:
            last[i] = states[i] = new
            stamps[i] = times[k]
    return fine
