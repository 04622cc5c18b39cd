"""Proof by bounding spheres that no moving obstacle comes near a robot that brakes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.kinematics import update_kinematics
from qpavoid.kernels.near_pairs import place_bodies
from qpavoid.kernels.obstacles import Pieces, sample_pieces
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.rollout import HORIZON, PREFERRED_DISTANCE
from qpavoid.problem import Array, IntArray

PATH_PERIOD = 0.1
"""Time between two positions on the path of an obstacle [s]."""
PATH_POINTS = 17
"""Positions until the horizon, with one before and one after it [-]."""


class Paths(NamedTuple):
    """Positions of o obstacles at the multiples of `PATH_PERIOD` until the horizon; number s is in row s % r."""

    numbers: IntArray
    """(r,) number of each row, r >= `PATH_POINTS`."""
    positions: Array
    """(r, o, 3) [m]."""
    rates: Array
    """(r, o, 2) speeds there, linear and angular [m/s, rad/s]."""


@compiled
def extend_paths(x: Paths, pieces: Pieces, first: int, states: Array) -> None:
    """Sample the paths at numbers `first` to `first + PATH_POINTS - 1`, where that is not done yet.

    Args:
        x: rows of the bodies of `pieces` are overwritten.
        pieces: trajectories.
        first: number of the first position.
        states: scratch (o, 18).
    """
    for s in range(first, first + PATH_POINTS):
        row = s % len(x.numbers)
        if x.numbers[row] == s:
            continue
        x.numbers[row] = s
        sample_pieces(pieces, s * PATH_PERIOD, states)
        for i in pieces.bodies:
            write_path_point(x, row, i, states[i])


@compiled
def write_path_point(x: Paths, row: int, i: int, state: Array) -> None:
    """Write position and speeds of obstacle i in a state (18,)."""
    linear, angular = 0.0, 0.0
    for c in range(3):
        x.positions[row, i, c] = state[9 + c]
        linear += state[12 + c] ** 2
        angular += state[15 + c] ** 2
    x.rates[row, i, 0], x.rates[row, i, 1] = np.sqrt(linear), np.sqrt(angular)


@compiled
def comes_near(
    x: Any, q: Array, v: Array, braking: Array, lever_arm: float, dt: float, spheres: Array, radii: Array,
    margin: Array, external: IntArray, states: Array, twists: Array, on_paths: IntArray, paths: Paths, first: int,
) -> tuple[bool, float]:  # fmt: skip
    """Find out whether a moving obstacle may come within the preferred distance until the horizon.

    The robot moves at v once more, and brakes. External obstacles go on straight; between the positions on their paths,
    others are no faster than at these.

    Args:
        x: memory of rows and distances, in which joints and the bodies that they move are placed.
        q: configuration (nq,).
        v: velocity (n,) [rad/s or m/s].
        braking: way on which each coordinate brakes, over the square of its speed (n,) [s²/rad or s²/m].
        lever_arm: bound on the distance that a point of the robot moves when a joint moves by 1 [m/rad, 1].
        dt: control period [s].
        spheres: bounding sphere of each body in its frame, centre and radius (g, 4) [m].
        radii: of the bounding spheres of the obstacles (o,) [m].
        margin: taken off the distances to each (o,) [m].
        external: numbers of those that go on straight (k,).
        states: of all obstacles (o, 18).
        twists: velocities that they keep (o, 6) [m/s, rad/s].
        on_paths: numbers of those on paths (l,).
        paths: sampled from number `first` on.
        first: number of the first position.

    Returns:
        Whether one may; largest speed of any point of an obstacle that moves [m/s].
    """
    bodies, center, radius = _place_spheres(x, q, spheres)
    travel, fastest, near = 0.0, 0.0, False
    for j in range(len(v)):
        travel += dt * abs(v[j]) + braking[j] * v[j] * v[j]
    distance = PREFERRED_DISTANCE + (lever_arm * travel if travel > 0.0 else 0.0)  # a lever arm may be infinite
    for i in external:
        u, w = twists[i, :3], twists[i, 3:]
        speed, turning = np.sqrt(u[0] ** 2 + u[1] ** 2 + u[2] ** 2), np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
        if speed > 0.0 or turning > 0.0:
            fastest = max(fastest, speed + (turning * radii[i] if turning > 0.0 else 0.0))
            keep = radii[i] + margin[i] + distance
            near = near or _passes(states[i, 9:12], u, speed, keep, bodies, center, radius)
    for i in on_paths:
        speed, turning, moves = 0.0, 0.0, False
        for s in range(first, first + PATH_POINTS):
            row = s % len(paths.numbers)
            speed, turning = max(speed, paths.rates[row, i, 0]), max(turning, paths.rates[row, i, 1])
            for c in range(3):
                moves = moves or paths.positions[row, i, c] != paths.positions[first % len(paths.numbers), i, c]
        if moves or speed > 0.0 or turning > 0.0:
            fastest = max(fastest, speed + (turning * radii[i] if turning > 0.0 else 0.0))
            keep = radii[i] + margin[i] + distance + 0.5 * PATH_PERIOD * speed
            for s in range(first, first + PATH_POINTS):
                p = paths.positions[s % len(paths.numbers), i]
                near = near or _passes(p, p, 0.0, keep, bodies, center, radius)
    return near, fastest


@compiled
def _place_spheres(x: Any, q: Array, spheres: Array) -> tuple[Array, Array, float]:
    """Return the bounding spheres (b, 4) of the bodies that joints move, centre (3,) and radius of one around all."""
    update_kinematics(x.kinematics, q)
    place_bodies(x.distances, x.joint_poses)
    joints, poses = x.distances.joints, x.distances.poses
    bodies, center, radius, count = np.empty((len(joints), 4)), np.zeros(3), 0.0, 0
    for b in range(len(joints)):
        if joints[b] < 0:
            continue
        pose, sphere = poses[b], spheres[b]
        for c in range(3):
            bodies[count, c] = pose[c] * sphere[0] + pose[3 + c] * sphere[1] + pose[6 + c] * sphere[2] + pose[9 + c]
            center[c] += bodies[count, c]
        bodies[count, 3] = sphere[3]
        count += 1
    center /= max(count, 1)
    for b in range(count):
        offset = bodies[b, :3] - center
        radius = np.maximum(radius, np.sqrt(np.sum(offset * offset)) + bodies[b, 3])  # keeps NaN, unlike max
    return bodies[:count], center, radius


@compiled
def _passes(p: Array, u: Array, speed: float, keep: float, bodies: Array, center: Array, radius: float) -> bool:
    """Return whether a point at p (3,) that goes on at u (3,) until the horizon comes within `keep` of a sphere.

    The sphere around all is looked at first. NaN counts as near.
    """
    if _line_distance(p, u, speed, center) > keep + radius:
        return False
    for b in range(len(bodies)):  # noqa: SIM110 (numba knows no generators)
        if not _line_distance(p, u, speed, bodies[b]) > keep + bodies[b, 3]:
            return True
    return False


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
