"""Clearance of a configuration, and of straight motions between configurations."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from qpavoid.control.distances import DistanceQuery
from qpavoid.control.obstacle_states import ObstacleStates
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.problem import Array
from qpavoid_bench.arena.families.inverse_kinematics import JointRanges
from qpavoid_bench.arena.world import World

MIN_ADVANCE = 0.005
"""Smallest change of distance between two samples of a motion [m]: bounds their number near contact."""
_SEARCH_MARGIN = 0.1
"""Excess over the required distance up to which distances are computed [m]."""
_STATIC_PERIOD = 0.05
"""Time between two samples of pairs that no joint moves [s]."""
_SPEED_PERIOD = 0.01
"""Period of the samples from which the speed of obstacles is estimated [s]."""


class Clearance:
    """Distances of a world's pairs, for planning: q (nv,) of joints with one coordinate each."""

    def __init__(self, world: World, duration: float, required_distance: float) -> None:
        """Lay out distances and bounds on their rates.

        Args:
            world: nothing in it is carried.
            duration: how long obstacles are followed [s].
            required_distance: distance that everything is to keep all the time [m].
        """
        self.least = required_distance + 0.5 * MIN_ADVANCE
        """Smallest distance that every sample has to have [m]."""
        self._search_distance = self.least + _SEARCH_MARGIN
        scene = world.scene
        self._model, self._query = scene.robot.model, DistanceQuery(scene)
        self._kinematics = ForwardKinematics(self._model)
        self._motions = [obstacle.motion for obstacle in scene.obstacles]
        self.depends_on_time = any(obstacle.moves for obstacle in scene.obstacles)
        """Whether an obstacle moves."""
        self._fixed = ~np.any(scene.support != 0.0, axis=1)
        self._duration = duration
        self._robot, self.speed = scene.robot, self._max_obstacle_speed()
        """Largest speed of any point of an obstacle [m/s]."""

    @cached_property
    def lever_arm(self) -> Array:
        """(nv,) bound on the travel of any point of the robot per unit of each coordinate [m/rad or 1].

        A joint moves one body of a pair, or both as one: no distance changes by more than lever_arm @ |Δq|.
        """
        return self._lever_arms(JointRanges.of(self._robot))

    def at(self, q: Array, t: float) -> float:
        """Return the smallest distance of any pair [m], up to 0.1 m above the required one."""
        self._compute(q, t)
        pairs = self._query.pairs
        return float(
            min(self._query.arrays.results[pairs, 0].min(initial=self._search_distance), self._search_distance)
        )

    def is_clear(self, q: Array, t: float) -> bool:
        """Return True if all pairs have the distance that a sample needs."""
        return self.at(q, t) >= self.least

    def immovable_pairs_are_clear(self, q: Array) -> bool:
        """Return True if pairs that no joint can move stay clear, such as a base and an obstacle."""
        fixed = np.flatnonzero(self._fixed)
        if not len(fixed):
            return True
        for t in np.arange(0.0, self._duration + _STATIC_PERIOD, _STATIC_PERIOD) if self.depends_on_time else (0.0,):
            self._compute(q, float(t))
            if self._query.distances_of(fixed).min() < self.least:
                return False
        return True

    def is_clear_between(self, a: Array, ta: float, b: Array, tb: float) -> bool:
        """Return True if all pairs are clear on the straight motion from a (nv,) at ta to b at tb.

        Conservative advancement: no distance changes faster than the lever arms and the speed of obstacles allow, so
        that the margin of the smallest one bounds the next advance. Samples are at least `MIN_ADVANCE` apart, and each
        needs half as much beyond the required distance: between two samples no distance falls below the required one.
        """
        dq = b - a
        return self.is_clear(b, tb) and self._is_clear_along(a, dq, ta, tb, float(self.lever_arm @ np.abs(dq)))

    def stays_clear(self, q: Array) -> bool:
        """Return True if all pairs of a robot that rests at q (nq,) are clear all the time."""
        return self.is_clear(q, self._duration) and self._is_clear_along(q, 0.0 * q, 0.0, self._duration, 0.0)

    def _is_clear_along(self, a: Array, dq: Array, ta: float, tb: float, travel: float) -> bool:
        """Return True if all pairs are clear from a at ta to a + dq at tb, on which points travel so far [m]."""
        change, fraction = travel + self.speed * (tb - ta), 0.0
        while fraction < 1.0:
            margin = self.at(a + fraction * dq, ta + fraction * (tb - ta)) - self.least
            if margin < 0.0:
                return False
            fraction += max(margin, MIN_ADVANCE) / max(change, 1e-12)
        return True

    def _compute(self, q: Array, t: float) -> None:
        self._place(t)
        self._kinematics.compute(q)
        self._query.compute(self._kinematics.joint_poses, self._search_distance)

    def _place(self, t: float) -> None:
        if self.depends_on_time:
            self._query.place(ObstacleStates.of([motion.sample(t) for motion in self._motions]))

    def _max_obstacle_speed(self) -> float:
        fastest = 0.0
        for t in np.arange(0.0, self._duration, _SPEED_PERIOD) if self.depends_on_time else ():
            self._place(float(t))
            fastest = max(fastest, float(self._query.arrays.speeds.max()))
        return fastest

    def _lever_arms(self, ranges: JointRanges) -> Array:
        """Bound the distance of points from each joint (nv,) by the lengths of the links after it."""
        model, max_extension, lever_arm = self._model, self._query.table.joint_radius.copy(), np.ones(self._model.nv)
        farthest = np.maximum(np.abs(ranges.lower), np.abs(ranges.upper))
        for i in range(model.njoints - 1, 0, -1):
            joint, parent = model.joints[i], model.parents[i]
            slides = joint.shortname().startswith("JointModelP")
            lever_arm[joint.idx_v] = 1.0 if slides else max_extension[i]
            travel = farthest[joint.idx_v] if slides else 0.0
            length = float(np.linalg.norm(model.jointPlacements[i].translation)) + travel
            max_extension[parent] = max(max_extension[parent], length + max_extension[i])
        return lever_arm
