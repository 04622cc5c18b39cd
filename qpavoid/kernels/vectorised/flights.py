"""Work of a flight from one decision to the next: what is near, how fast velocities may change, and who stays away."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.vectorised.bounds import velocity_bounds
from qpavoid.kernels.vectorised.pairs import distance_rows
from qpavoid.problem import Array, IntArray, Mask


def look_around(
    x: Any, q: Array, pairs: IntArray, reach: float, moving: bool, watched: Mask, touch: float
) -> tuple[int, int, float, float]:
    """Velocity bounds, and rows of the watched pairs that are near and apart, closest ones or not.

    Args:
        x: see `velocity_bounds` and `distance_rows`.
        q: configuration (nq,).
        pairs: which pairs to look at (c,), increasing.
        reach: distance below which a pair is near [m].
        moving: whether any obstacle is.
        watched: (m,) which pairs count; those that touch are taken out.
        touch: distance below which a pair touches [m].

    Returns:
        How many rows there are, how many watched pairs touch, and the least distance with these and without [m], plus
        the slack of each pair; `reach`, where nothing is nearer.
    """
    velocity_bounds(x, q)
    k = distance_rows(x, pairs, reach, moving)
    distance, slack = x.closest[:k, 0], x.slack[x.near[:k]]
    counts = watched[x.near[:k]]
    nearest = float(np.min((distance + slack)[counts], initial=reach))
    touching = counts & ~(distance >= touch)
    count = int(np.count_nonzero(touching))
    watched[x.near[:k][touching]] = False
    kept = np.flatnonzero(counts & ~touching)
    n, rest = len(kept), float(np.min((distance + slack)[kept], initial=reach))
    if n < k:
        for rows in (x.closest, x.J, x.drift, x.near):
            rows[:n] = rows[kept]
    return n, count, nearest, rest


def comes_too_near(closest: Array, J: Array, drift: Array, v: Array, span: float, safe: float) -> bool:
    """Whether a pair is nearer than is safe after a while, to first order.

    Args:
        closest: distances first (k, 10) [m].
        J: velocity Jacobian of these (k, n).
        drift: their rates due to the obstacles (k,) [m/s].
        v: velocity (n,).
        span: [s].
        safe: [m].
    """
    return bool((closest[:, 0] + span * (J @ v + drift) < safe).any())


def ramp(v: Array, wanted: Array, v_step: Array, meets: bool) -> Array:
    """Velocities of some ticks, as close to what is wanted as the largest changes allow.

    Args:
        v: velocity (n,) before.
        wanted: velocities (k, n).
        v_step: largest change of v in a tick (n,), infinite where there is none.
        meets: whether to end where what is wanted is met.

    Returns:
        As many as there are until then (<= k, n).
    """
    steps = np.empty_like(wanted)
    for k, target in enumerate(wanted):
        v = v + np.minimum(np.maximum(target - v, -v_step), v_step)
        steps[k] = v
        if meets and np.abs(v - target).max() < ROUND_OFF:
            return steps[: k + 1]
    return steps


ROUND_OFF = 1e-12
"""Difference of velocities that counts as none [rad/s, m/s]."""


def least_apart(paths: Array, centers: Array, sizes: Array) -> float:
    """How far things stay apart that move along some paths from others that rest; spheres all of them [m].

    Args:
        paths: centres at some times (t, o, 3) [m].
        centers: of those that rest (b, 3) [m].
        sizes: what each combination has to be apart to touch just not (o, b) [m].
    """
    if not paths.size:
        return np.inf
    offset = paths[:, :, None] - centers
    return float((np.sqrt(np.einsum("tobi,tobi->tob", offset, offset)) - sizes).min())
