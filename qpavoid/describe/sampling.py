"""What random configurations tell of a robot: pairs that always or never come near, a pose clear of collision."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from qpavoid.config import Avoidance
from qpavoid.geometry.pairs import pair_array
from qpavoid.kinematics import support_masks
from qpavoid.memory import read_results, view_results
from qpavoid.problem import Array, IntArray
from qpavoid.robot import Robot

SAMPLES, SEED = 5000, 0
NEAR = 0.02
"""Distance [m] that a pair must keep from each other in every sample, and where descent from the nearest of them
ends, to count as never colliding."""
FAR = Avoidance().d1
"""Distance [m] beyond which a pair must come in some sample: others could never keep the default margin. They are
neighbours by design, and the joints' limits keep them apart, if anything does."""
CLEAR = 0.005
"""Least distance [m] of any pair at a home pose."""
_SETTLE = 250
"""Samples after which pairs that have been near and far are not looked at any more."""
_STEPS = 60
"""Of a descent."""
_UNBOUNDED = np.pi
"""Range of coordinates without limits: joints that turn all the way round, and a root that never matters here."""


class PairDistances:
    """Distances of a robot's own pairs at any configuration."""

    def __init__(self, robot: Robot) -> None:
        self.model, self.data = robot.model, robot.model.createData()
        self._bodies = pin.GeometryModel(robot.bodies)
        self._geometry = self._bodies.createData()
        self.pairs = pair_array(self._bodies)
        joints = np.array([body.parentJoint for body in self._bodies.geometryObjects], dtype=np.intp)
        masks = support_masks(robot.model)
        self._support = masks[joints[self.pairs[:, 1]]] - masks[joints[self.pairs[:, 0]]]
        self.all(robot.home)  # so that there is something to compare the view with
        view = view_results(self._geometry.distanceResults)
        self._view = view

    def all(self, q: Array) -> Array:
        """Distances (m,) [m] of the pairs that are switched on; of the others, what they were last."""
        pin.updateGeometryPlacements(self.model, self.data, self._bodies, self._geometry, q)
        pin.computeDistances(self._bodies, self._geometry)
        results = getattr(self, "_view", None)
        if results is None:
            results = read_results(self._geometry.distanceResults)
        return np.array(results[:, 0]) if len(results) else np.zeros(0)

    def switch_off(self, pairs: Iterable[int]) -> None:
        """Leaves pairs out from now on."""
        for index in pairs:
            self._geometry.deactivateCollisionPair(int(index))

    def gradient(self, index: int, q: Array) -> tuple[float, Array]:
        """Distance of one pair [m] and its gradient (nv,)."""
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateGeometryPlacements(self.model, self.data, self._bodies, self._geometry)
        result = pin.computeDistance(self._bodies, self._geometry, index)
        normal, point = np.array(result.normal), np.array(result.getNearestPoint1())
        screw = np.concatenate((normal, np.cross(point, normal)))
        return float(result.min_distance), (screw @ self.data.J) * self._support[index]


class Space:
    """The configurations of a robot, its root left where it is."""

    def __init__(self, robot: Robot) -> None:
        bounds = robot.bounds()
        self.model = robot.model
        self._q, self._v = bounds.q_index, bounds.v_index
        finite = np.isfinite(bounds.lower) & np.isfinite(bounds.upper)
        self._lower = np.where(finite, bounds.lower, -_UNBOUNDED)
        self._upper = np.where(finite, bounds.upper, _UNBOUNDED)
        free = np.ones(robot.model.nv, dtype=bool)
        free[self._v] = False
        self.free = free & np.array([n not in _root_names(robot) for n in robot.coordinate_names])
        """(nv,) coordinates without limits."""

    def draw(self, random: np.random.Generator, count: int) -> Array:
        """Configurations (count, nq), even over the joints' ranges."""
        turns = random.uniform(-_UNBOUNDED, _UNBOUNDED, (count, self.model.nv)) * self.free
        neutral = pin.neutral(self.model)
        q = np.array([pin.integrate(self.model, neutral, turn) for turn in turns]).reshape(count, self.model.nq)
        q[:, self._q] = random.uniform(self._lower, self._upper, (count, len(self._q)))
        return q

    def move(self, q: Array, step: Array) -> Array:
        """q ⊕ step, kept within the limits."""
        moved = np.asarray(pin.integrate(self.model, q, step))
        moved[self._q] = np.clip(moved[self._q], self._lower, self._upper)
        return moved

    def towards(self, q: Array, aim: Array, part: float) -> Array:
        """The configuration at a part of the way from q to another."""
        return self.move(q, part * np.asarray(pin.difference(self.model, q, aim)))


def _root_names(robot: Robot) -> set[str]:
    model = robot.model
    if model.njoints > 1 and model.names[1] == "root_joint":
        return set(robot.coordinate_names[: model.joints[1].nv])
    return set()


BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Sampled:
    """What became of each of a robot's pairs."""

    always: BoolArray
    """(m,) were within `FAR` in every sample."""
    never: BoolArray
    """(m,) kept away from each other in every sample and in a descent from the nearest one."""
    closest: Array
    """(m,) nearest that was seen [m]; of pairs that were settled early, up to then."""


def sample_pairs(robot: Robot, samples: int = SAMPLES, seed: int = SEED) -> Sampled:
    """Looks which of a robot's pairs are always near and which never.

    Random configurations first; each pair that stayed apart in all of them is then led downhill from where it came
    closest, so that "never" does not rest on luck alone. It is still no proof: samples are finite, descents local.

    Args:
        robot: with its pairs.
        samples: configurations drawn.
        seed: of the draw.
    """
    distances, space, random = PairDistances(robot), Space(robot), np.random.default_rng(seed)
    count = len(distances.pairs)
    closest, farthest = np.full(count, np.inf), np.full(count, -np.inf)
    at = np.zeros((count, robot.model.nq))
    watched = np.ones(count, dtype=bool)
    done = 0
    while done < samples and watched.any():
        for q in space.draw(random, min(_SETTLE, samples - done)):
            d = distances.all(q)
            nearer = watched & (d < closest)
            closest[nearer], at[nearer] = d[nearer], q
            farthest = np.where(watched, np.maximum(farthest, d), farthest)
        done += _SETTLE
        settled = watched & (closest < NEAR) & (farthest >= FAR)
        distances.switch_off(np.flatnonzero(settled))
        watched &= ~settled
    for index in np.flatnonzero(closest >= NEAR):
        closest[index] = min(closest[index], _descend(distances, space, int(index), at[index]))
    always = farthest < FAR
    return Sampled(always, (closest >= NEAR) & ~always, closest)


def always_near(robot: Robot, samples: int, seed: int = SEED) -> IntArray:
    """Pairs of bodies (k, 2) that are within `FAR` in every sample."""
    distances = PairDistances(robot)
    near = np.ones(len(distances.pairs), dtype=bool)
    for q in Space(robot).draw(np.random.default_rng(seed), samples if near.any() else 0):
        near &= distances.all(q) < FAR
        distances.switch_off(np.flatnonzero(~near))
    return distances.pairs[near]


def _descend(distances: PairDistances, space: Space, index: int, q: Array) -> float:
    """Least distance [m] found along a pair's gradient, with steps that shrink where they lead up."""
    (least, slope), step = distances.gradient(index, q), 0.3
    for _ in range(_STEPS):
        size = float(np.linalg.norm(slope))
        if least < NEAR or size < 1e-9 or step < 1e-3:
            break
        tried = space.move(q, -step / size * slope)
        d, slope_there = distances.gradient(index, tried)
        if d < least:
            q, least, slope, step = tried, d, slope_there, 1.3 * step
        else:
            step *= 0.4
    return least


def clear_home(
    robot: Robot, wishes: Iterable[Array], samples: int = 2000, seed: int = SEED
) -> tuple[Array, float, int | None]:
    """A pose at which no pair is nearer than `CLEAR`, as close to a wished one as is found.

    Args:
        robot: with its pairs.
        wishes: configurations to take if they are clear, the best first; at least one.
        samples: configurations drawn, ever farther from the first wish.
        seed: of the draw.

    Returns:
        The pose (nq,), its least distance [m] (infinite where there are no pairs), and which wish it is. Where nothing
        is clear, the pose with the largest least distance.
    """
    distances, space = PairDistances(robot), Space(robot)

    def clearance(q: Array) -> float:
        return float(np.min(distances.all(q), initial=np.inf))

    wished = [np.asarray(q) for q in wishes]
    for index, q in enumerate(wished):
        if (d := clearance(q)) >= CLEAR:
            return q, d, index
    best, best_d = wished[0], clearance(wished[0])
    for i, aim in enumerate(space.draw(np.random.default_rng(seed), samples)):
        q = space.towards(wished[0], aim, (i + 1) / samples)
        if (d := clearance(q)) >= CLEAR:
            return q, d, None
        if d > best_d:
            best, best_d = q, d
    return best, best_d, None


def touching(robot: Robot, q: Array, within: float = 0.0) -> list[tuple[str, str, float]]:
    """Pairs of a robot's own bodies nearer than a distance, the nearest first, with their distance [m]."""
    names = [body.name for body in robot.bodies.geometryObjects]
    distances = PairDistances(robot)
    d = distances.all(q)
    order: Any = np.argsort(d, kind="stable")
    return [(names[a], names[b], float(d[i])) for i in order if d[i] <= within for a, b in [distances.pairs[i]]]
