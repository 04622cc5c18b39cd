"""Statistics over random configurations: how often each pair touches, its least distance, the size of the robot."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid.geometry.bodies import bounding_sphere
from qpavoid.model.kinematics import columns, support_masks
from qpavoid.model.pairs import ALWAYS_TOUCHING, D1, pair_array
from qpavoid.model.robot import Robot
from qpavoid.model.space import Space
from qpavoid.model.views import read_results, view_results
from qpavoid.problem import Array, Mask

SAMPLES, SEED = 5000, 0
NEVER_NEAR = 0.02
"""Distance, as a share of the robot's size, that a pair must keep in every sample, and where descent from the nearest
of them ends, to count as never colliding [-]: 20 mm of an arm with a maximal extension of 1 m."""
_FIRST = 500
"""Samples in which all pairs are computed; later ones only compute pairs that may always or never touch."""
_DOUBT = 0.1
"""Share of samples by which a pair's contact may differ from `ALWAYS_TOUCHING` and still come to attain it [-]."""
_STEPS = 60
"""Steps of a descent, at most."""
_CLOSE = 4.0 / 3.0
"""Typical distance of a pair, in units of the default safety distance, below which it gets one of its own [-]."""


def draw_poses(robot: Robot, count: int, seed: int = SEED) -> Array:
    """Draw configurations (count, nq) of a robot, the same ones each time."""
    return Space(robot.model, robot.bounds()).draw(np.random.default_rng(seed), count)


def robot_size(robot: Robot) -> float:
    """Estimate the size of a robot [m], never 0: half the diagonal of the largest box that it fills in some poses.

    About the maximal extension of an arm, the height of a humanoid: the scale of distances on this robot.
    """
    bodies = robot.bodies.geometryObjects
    if not len(bodies):
        return 1.0
    centers, radii = zip(*(bounding_sphere(body.geometry) for body in bodies), strict=True)
    radius = np.array(radii)[:, None]
    data, geometry, diagonal = robot.model.createData(), robot.bodies.createData(), 0.0
    for q in [robot.home, *draw_poses(robot, 20)]:
        pin.updateGeometryPlacements(robot.model, data, robot.bodies, geometry, q)
        at = np.array([pose.act(center) for pose, center in zip(geometry.oMg, centers, strict=True)])
        diagonal = max(diagonal, float(np.linalg.norm((at + radius).max(axis=0) - (at - radius).min(axis=0))))
    return max(0.5 * diagonal, 1e-3)


class PairDistances:
    """Distances of a robot's own pairs at any configuration."""

    def __init__(self, robot: Robot) -> None:
        self.model, self.data = robot.model, robot.model.createData()
        self._bodies = pin.GeometryModel(robot.bodies)
        self._geometry = self._bodies.createData()
        self.pairs = pair_array(self._bodies)
        self.names = [body.name for body in robot.bodies.geometryObjects]
        joints = np.array([body.parentJoint for body in self._bodies.geometryObjects], dtype=np.intp)
        masks = support_masks(robot.model)
        self._support = masks[joints[self.pairs[:, 1]]] - masks[joints[self.pairs[:, 0]]]
        self._columns = columns(robot.model)
        self._compute(robot.home)  # so that there is something to compare the view with
        self._view = view_results(self._geometry.distanceResults)

    def _compute(self, q: Array) -> None:
        pin.updateGeometryPlacements(self.model, self.data, self._bodies, self._geometry, q)
        pin.computeDistances(self._bodies, self._geometry)

    def all(self, q: Array) -> Array:
        """Compute the distances (m,) of the active pairs [m]; others keep the value from when they were active."""
        self._compute(q)
        results = read_results(self._geometry.distanceResults) if self._view is None else self._view
        return np.array(results[:, 0])

    def deactivate(self, pairs: Iterable[int]) -> None:
        """Deactivate pairs from now on."""
        for index in pairs:
            self._geometry.deactivateCollisionPair(int(index))

    def gradient(self, index: int, q: Array) -> tuple[float, Array]:
        """Compute the distance of one pair [m] and its gradient (nv,)."""
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateGeometryPlacements(self.model, self.data, self._bodies, self._geometry)
        result = pin.computeDistance(self._bodies, self._geometry, index)
        normal, point = np.array(result.normal), np.array(result.getNearestPoint1())
        row = (np.concatenate((normal, np.cross(point, normal))) @ self.data.J) * self._support[index]
        return float(result.min_distance), np.bincount(self._columns, row, self.model.nv).astype(np.float64)

    def moved_by(self, index: int) -> Mask:
        """Return the coordinates (nv,) that change the distance of one pair."""
        return np.bincount(self._columns, np.abs(self._support[index]), self.model.nv) > 0.0


class PairSamples(NamedTuple):
    """Statistics of each of a robot's m pairs over random configurations."""

    always: Mask
    """(m,) touches in at least `ALWAYS_TOUCHING` of them."""
    never: Mask
    """(m,) keeps away in every sample and in a descent from the nearest one."""
    closest: Array
    """(m,) least distance found [m]; of pairs that were settled early, up to then."""
    typical: Array
    """(m,) median of its distances where it does not touch [m]; infinite where it always does."""
    poses: Array
    """(k, nq) the first samples."""
    touching: Mask
    """(k, m) which pairs touch in them."""
    near: float
    """Distance that counts as away [m]."""


def sample_pairs(robot: Robot, samples: int = SAMPLES, seed: int = SEED) -> PairSamples:
    """Find which of a robot's pairs always touch and which never come near.

    Random configurations first; each pair that stayed apart in all of them then descends along its gradient from where
    it came closest, so that "never" does not depend on the samples alone. It is still no proof: samples are finite,
    descents local.
    """
    distances, space = PairDistances(robot), Space(robot.model, robot.bounds())
    near, count = NEVER_NEAR * robot_size(robot), len(distances.pairs)
    draws = space.draw(np.random.default_rng(seed), samples)
    poses = draws[:_FIRST]
    first = np.array([distances.all(q) for q in poses]).reshape(len(poses), count)
    touching = first <= 0.0
    closest, at, contact = np.min(first, axis=0), poses[np.argmin(first, axis=0)], touching.mean(axis=0)
    is_open = (closest >= near) | (contact >= ALWAYS_TOUCHING - _DOUBT)
    distances.deactivate(np.flatnonzero(~is_open))
    later_contacts = np.zeros(count)
    for q in draws[len(poses) :] if is_open.any() else ():
        d = distances.all(q)
        nearer = is_open & (d < closest)
        closest[nearer], at[nearer] = d[nearer], q
        later_contacts += d <= 0.0
    contact[is_open] = (touching.sum(axis=0) + later_contacts)[is_open] / samples
    for index in np.flatnonzero(closest >= near):
        closest[index] = min(closest[index], _descend(distances, space, int(index), at[index], near))
    gaps = np.where(touching, np.nan, first).T
    typical = np.array([np.nanmedian(d) if not np.isnan(d).all() else np.inf for d in gaps]).reshape(count)
    return PairSamples(contact >= ALWAYS_TOUCHING, closest >= near, closest, typical, poses, touching, near)


def _descend(distances: PairDistances, space: Space, index: int, q: Array, near: float) -> float:
    """Descend along a pair's gradient, by steps that shrink where they lead up; return the least distance [m]."""
    (least, slope), step = distances.gradient(index, q), 0.3
    for _ in range(_STEPS):
        size = float(np.linalg.norm(slope))
        if least < near or size < 1e-9 or step < 1e-3:
            break
        candidate = space.move(q, -step / size * slope)
        d, slope_there = distances.gradient(index, candidate)
        if d < least:
            q, least, slope, step = candidate, d, slope_there, 1.3 * step
        else:
            step *= 0.4
    return least


def safety_distances(sampled: PairSamples) -> Array:
    """Choose the safety distance (m,) of each pair [m]: the default one, less where the design leaves less clearance.

    A pair whose bodies are near each other nearly all along their joints' ranges could not keep the default distance
    in most of them. Half of what it typically has leaves it as much to move in as to keep.
    """
    own = np.maximum(np.floor(0.5e4 * sampled.typical) / 1e4, 1e-4)
    return np.where(sampled.typical < _CLOSE * D1, np.minimum(own, D1), D1)


def touching(robot: Robot, q: Array, within: float = 0.0) -> list[tuple[str, str, float]]:
    """List the pairs of a robot's own bodies nearer than a distance [m], the nearest first, with theirs [m]."""
    distances = PairDistances(robot)
    names, d = distances.names, distances.all(q)
    order = [int(i) for i in np.argsort(d, kind="stable") if d[i] <= within]
    return [(names[a], names[b], float(d[i])) for i in order for a, b in [distances.pairs[i]]]
