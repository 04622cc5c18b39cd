"""Proof by bounding spheres that no moving obstacle comes near a robot that brakes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.obstacles import Pieces, sample_pieces
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.rollout import HORIZON, PREFERRED_DISTANCE
from qpavoid.kernels.turns import follow_arc
from qpavoid.problem import Array, IntArray

PATH_PERIOD = 0.1
"""Time between two positions on the path of an obstacle [s]."""
PATH_POINTS = 17
"""Positions until the horizon, with one before and one after it [-]: as many as there are rows."""


class ApproachArrays(NamedTuple):
    """What is read of o obstacles and the g bodies; paths at the multiples of `PATH_PERIOD`, number s in row s % r."""

    braking: Array
    """(n,) way on which each coordinate brakes, over the square of its speed [s²/rad or s²/m]."""
    spheres: Array
    """(g, 4) bounding sphere of each body in its frame, centre and radius [m]."""
    radii: Array
    """(o,) of the bounding spheres of the obstacles [m]."""
    margin: Array
    """(o,) taken off the distances to each [m]."""
    states: Array
    """(o, 18) of the obstacles."""
    twists: Array
    """(o, 6) velocities of external ones [m/s, rad/s]."""
    turns: Array
    """(o, 3) rates at which the linear ones turn [rad/s]."""
    numbers: IntArray
    """(r,) number of each row, r = `PATH_POINTS`."""
    positions: Array
    """(r, o, 3) on the paths [m]."""
    rates: Array
    """(r, o, 2) speeds there, linear and angular [m/s, rad/s]."""
    spans: Array
    """(o, 4) ball around each path, until the horizon: centre and radius, negative of one that does not move [m]."""
    peaks: Array
    """(o, 2) largest of the speeds until the horizon."""
    scratch: Array
    """(o, 18)."""
    proof: Array
    """(3,) of the last proof that none comes near: the way that is left over [m], negative without a proof; the
    distance that was kept [m]; the largest speed of an obstacle [m/s]."""
    proof_centers: Array
    """(g, 3) where the centres of the bodies were then [m]."""
    lever_arm: float
    """Bound on the distance that a point of the robot moves when a joint moves by 1 [m/rad, 1]."""
    dt: float
    """Control period [s]."""


@compiled
def write_path_point(x: Any, row: int, i: int, state: Array) -> None:
    """Write position and speeds of obstacle i in a state (18,)."""
    linear, angular = 0.0, 0.0
    for c in range(3):
        x.positions[row, i, c] = state[9 + c]
        linear += state[12 + c] ** 2
        angular += state[15 + c] ** 2
    x.rates[row, i, 0], x.rates[row, i, 1] = np.sqrt(linear), np.sqrt(angular)


@compiled
def extend_paths(x: Any, pieces: Pieces, on_paths: IntArray, first: int) -> None:
    """Sample the paths from number `first` until the horizon, where that is not done yet, and bound them.

    Args:
        x: see `ApproachArrays`; rows of obstacles on trajectories of another class are written already.
        pieces: trajectories.
        on_paths: numbers of the obstacles on paths (l,).
        first: number of the first position.
    """
    rows = len(x.numbers)
    for s in range(first, first + PATH_POINTS):
        if x.numbers[s % rows] != s:
            x.numbers[s % rows] = s
            sample_pieces(pieces, s * PATH_PERIOD, x.scratch)
            for i in pieces.bodies:
                write_path_point(x, s % rows, i, x.scratch[i])
    for i in on_paths:
        span, peak, begin, moves = x.spans[i], x.peaks[i], x.positions[first % rows, i], False
        span[:], peak[:] = 0.0, 0.0
        for s in range(first, first + PATH_POINTS):
            for c in range(3):
                span[c] += x.positions[s % rows, i, c] / PATH_POINTS
                moves = moves or x.positions[s % rows, i, c] != begin[c]
            for c in range(2):
                peak[c] = max(peak[c], x.rates[s % rows, i, c])
        for s in range(first, first + PATH_POINTS):
            span[3] = max(span[3], _distance(x.positions[s % rows, i], span))
        if not (moves or peak[0] > 0.0 or peak[1] > 0.0):
            span[3] = -1.0


@compiled
def comes_near(x: Any, distances: Any, v: Array, external: IntArray, on_paths: IntArray) -> tuple[bool, float]:
    """Find out whether a moving obstacle may come within the preferred distance until the horizon.

    The robot moves at v once more, and brakes. External obstacles go on along lines or arcs; between the positions on
    their paths, others are no faster than at these.

    Args:
        x: see `ApproachArrays`.
        distances: of this step; reads joints and centers, see `DistanceArrays`.
        v: velocity (n,) [rad/s or m/s].
        external: numbers of the obstacles that go on along lines or arcs (k,).
        on_paths: numbers of those on paths (l,).

    Returns:
        Whether one may; largest speed of any point of an obstacle that moves [m/s].
    """
    travel, fastest, near = 0.0, 0.0, False
    for j in range(len(v)):
        travel += x.dt * abs(v[j]) + x.braking[j] * v[j] * v[j]
    distance = PREFERRED_DISTANCE + (x.lever_arm * travel if travel > 0.0 else 0.0)  # a lever arm may be infinite
    if len(external) == 0 and _still_holds(x, distances, distance):
        return False, x.proof[2]
    center, radius = _surround(x, distances)
    for i in external:
        u, w = x.twists[i, :3], x.twists[i, 3:]
        speed, turning = np.sqrt(u[0] ** 2 + u[1] ** 2 + u[2] ** 2), np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
        if speed > 0.0 or turning > 0.0:
            fastest = max(fastest, speed + (turning * x.radii[i] if turning > 0.0 else 0.0))
            keep, p = x.radii[i] + x.margin[i] + distance, x.states[i, 9:12]
            if near:
                continue
            if x.turns[i, 0] == 0.0 and x.turns[i, 1] == 0.0 and x.turns[i, 2] == 0.0:
                if not _line_distance(p, u, speed, center) > keep + radius:
                    near = not _least_gap(x, distances, p, u, speed, keep) > 0.0
            elif not _distance(p, center) > keep + radius + speed * HORIZON:
                near = _comes_round(x, distances, i, keep + 0.5 * PATH_PERIOD * speed, center, radius)
    left = np.inf
    for i in on_paths:
        if x.spans[i, 3] < 0.0:
            continue
        speed, turning = x.peaks[i, 0], x.peaks[i, 1]
        fastest = max(fastest, speed + (turning * x.radii[i] if turning > 0.0 else 0.0))
        if near:
            continue
        keep = x.radii[i] + x.margin[i] + distance + 0.5 * PATH_PERIOD * speed
        gap = _distance(x.spans[i], center) - (keep + radius + x.spans[i, 3])
        if not gap > 0.0:
            gap = np.inf
            for s in range(PATH_POINTS):
                p = x.positions[s, i]
                away = _distance(p, center) - (keep + radius)
                gap = np.minimum(gap, away if away > 0.0 else _least_gap(x, distances, p, p, 0.0, keep))
        near, left = not gap > 0.0, min(left, gap)
    x.proof[0], x.proof[1], x.proof[2] = -1.0 if near else left, distance, fastest
    for b in range(len(distances.joints)):
        for c in range(3):
            x.proof_centers[b, c] = distances.centers[b, c]
    return near, fastest


@compiled
def _still_holds(x: Any, distances: Any, distance: float) -> bool:
    """Return whether the last proof holds at another distance, as the bodies have not gone far since.

    Where no centre has moved by more than δ, the sphere around all is no more than 3 δ nearer to anything.
    """
    square = 0.0
    if not x.proof[0] > 0.0:
        return False
    for b in range(len(distances.joints)):
        if distances.joints[b] >= 0:
            moved = 0.0
            for c in range(3):
                moved += (distances.centers[b, c] - x.proof_centers[b, c]) ** 2
            square = np.maximum(square, moved)  # keeps NaN, unlike max
    return bool(3.0 * np.sqrt(square) + distance - x.proof[1] < x.proof[0])


@compiled
def _comes_round(x: Any, distances: Any, i: int, keep: float, center: Array, radius: float) -> bool:
    """Return whether obstacle i comes within `keep` of a body at a time of its arc, these `PATH_PERIOD` apart.

    Args:
        x: see `ApproachArrays`; writes scratch.
        distances: see `comes_near`.
        i: number of the obstacle.
        keep: distance [m].
        center: of a ball around all bodies (3,) [m].
        radius: of that [m].
    """
    state = x.scratch[i]
    for s in range(PATH_POINTS - 1):
        state[:12], state[12:] = x.states[i, :12], x.twists[i]
        follow_arc(state, x.turns[i], s * PATH_PERIOD)
        p = state[9:12]
        if not _distance(p, center) > keep + radius and not _least_gap(x, distances, p, p, 0.0, keep) > 0.0:
            return True
    return False


@compiled
def _distance(a: Array, b: Array) -> float:
    """Compute the distance of two points, the first three entries each [m]."""
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@compiled
def _surround(x: Any, distances: Any) -> tuple[Array, float]:
    """Return centre (3,) and radius of a sphere around all bodies that joints move."""
    joints, centers, center, radius, count = distances.joints, distances.centers, np.zeros(3), 0.0, 0
    for b in range(len(joints)):
        if joints[b] >= 0:
            count += 1
            for c in range(3):
                center[c] += centers[b, c]
    for c in range(3):
        center[c] /= max(count, 1)
    for b in range(len(joints)):
        if joints[b] >= 0:
            radius = np.maximum(radius, _distance(centers[b], center) + x.spheres[b, 3])  # keeps NaN, unlike max
    return center, radius


@compiled
def _least_gap(x: Any, distances: Any, p: Array, u: Array, speed: float, keep: float) -> float:
    """Compute how far beyond `keep` from all bodies a point at p (3,) stays that goes on at u (3,) until the horizon.

    Negative where it comes nearer; NaN where any number is.
    """
    gap = np.inf
    for b in range(len(distances.joints)):
        if distances.joints[b] >= 0:
            away = _line_distance(p, u, speed, distances.centers[b]) - (keep + x.spheres[b, 3])
            gap = np.minimum(gap, away)  # keeps NaN, unlike min
    return gap


@compiled
def _line_distance(p: Array, u: Array, speed: float, center: Array) -> float:
    """Compute the least distance of a point that moves at u until the horizon from a centre (3,) [m]."""
    toward, square = 0.0, 0.0
    if speed > 0.0:
        for c in range(3):
            toward += (center[c] - p[c]) * u[c]
        toward = min(max(toward / (speed * speed), 0.0), HORIZON)
    for c in range(3):
        square += (p[c] + (toward * u[c] if speed > 0.0 else 0.0) - center[c]) ** 2
    return np.sqrt(square)
