"""How near anything comes at a configuration, and along a straight motion between two."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from qpavoid.arena.families.reach import Ranges
from qpavoid.arena.world import World
from qpavoid.control.distances import DistanceQuery
from qpavoid.problem import Array

STEP = 0.005
"""Shortest change of distance between two looks at a motion [m]."""
_FAR = 0.1
"""Distances are looked for up to so much more than what is kept [m]."""
_LOOKS = 0.05
"""Time between two looks at what no joint moves [s]."""
_PERIOD = 0.01
"""Of the samples that tell how fast obstacles move [s]."""


class Clearance:
    """Distances of a world's pairs, for planning: q (nv,) of joints with one coordinate each."""

    def __init__(self, world: World, duration: float, keep: float) -> None:
        """Lays everything out.

        Args:
            world: nothing in it is carried.
            duration: how long obstacles are followed [s].
            keep: distance that everything is to keep all the time [m].
        """
        self.least = keep + 0.5 * STEP
        """What every look has to find [m]."""
        self._reach = self.least + _FAR
        scene = world.scene
        self._model, self._data, self._query = scene.robot.model, scene.robot.model.createData(), DistanceQuery(scene)
        self._movers = [(i, o.motion) for i, o in enumerate(scene.obstacles) if o.moves]
        self._fixed = ~np.any(scene.support != 0.0, axis=1)
        self._duration = duration
        self.speed = self._fastest()
        """Largest speed of any point of an obstacle [m/s]."""
        self.lever_arm = self._levers(Ranges.of(scene.robot))
        """(nv,) how far a unit of each coordinate moves any point of the robot, at most [m/rad or 1]. A joint moves one
        body of a pair, or both as one: no distance changes by more than lever @ |Δq|."""

    @property
    def timed(self) -> bool:
        """Whether it depends on the time."""
        return bool(self._movers)

    def at(self, q: Array, t: float) -> float:
        """Least distance of any pair [m]; of those 0.1 m farther apart than they must be, that limit."""
        self._look(q, t)
        pairs = self._query.pairs
        return float(min(self._query.results[pairs, 0].min(initial=self._reach), self._reach))

    def clear(self, q: Array, t: float) -> bool:
        """Whether everything is far enough apart for a look."""
        return self.at(q, t) >= self.least

    def roots_clear(self, q: Array) -> bool:
        """A first look, with any q (nv,), at pairs that no joint can part, such as a base and an obstacle."""
        fixed = np.flatnonzero(self._fixed)
        if not len(fixed):
            return True
        for t in np.arange(0.0, self._duration + _LOOKS, _LOOKS) if self.timed else (0.0,):
            self._look(q, float(t))
            if self._query.found(fixed).min() < self.least:
                return False
        return True

    def clear_between(self, a: Array, ta: float, b: Array, tb: float) -> bool:
        """Whether everything keeps its distance on the straight motion from a (nv,) at ta to b at tb.

        Conservative advancement: no distance changes faster than the levers and the speed of obstacles allow, so that
        what is left of the least one tells how far to go before looking again. Looks are at least `STEP` apart, and
        each has to find half as much more than what is to be kept: nothing between two looks can come below that.
        """
        if not self.clear(b, tb):
            return False
        way, share = b - a, 0.0
        change = float(self.lever_arm @ np.abs(way)) + self.speed * (tb - ta)
        while share < 1.0:
            room = self.at(a + share * way, ta + share * (tb - ta)) - self.least
            if room < 0.0:
                return False
            share += max(room, STEP) / max(change, 1e-12)
        return True

    def _look(self, q: Array, t: float) -> None:
        for index, motion in self._movers:
            self._query.place_obstacle(index, motion.sample(t))
        pin.forwardKinematics(self._model, self._data, q)
        self._query.compute(self._data, self._reach)

    def _fastest(self) -> float:
        fastest = 0.0
        for t in np.arange(0.0, self._duration, _PERIOD) if self._movers else ():
            for index, motion in self._movers:
                self._query.place_obstacle(index, motion.sample(float(t)))
            fastest = max(fastest, float(self._query.placing.speeds.max()))
        return fastest

    def _levers(self, ranges: Ranges) -> Array:
        """A joint turns no point that is farther from it than the links after it are long together."""
        model, reach, lever_arm = self._model, self._query.joint_radius(), np.ones(self._model.nv)
        farthest = np.maximum(np.abs(ranges.lower), np.abs(ranges.upper))
        for i in range(model.njoints - 1, 0, -1):
            joint, parent = model.joints[i], model.parents[i]
            slides = joint.shortname().startswith("JointModelP")
            lever_arm[joint.idx_v] = 1.0 if slides else reach[i]
            travel = farthest[joint.idx_v] if slides else 0.0
            length = float(np.linalg.norm(model.jointPlacements[i].translation)) + travel
            reach[parent] = max(reach[parent], length + reach[i])
        return lever_arm
