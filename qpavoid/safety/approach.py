"""Proof by bounding spheres that no moving obstacle comes near: then nothing has to be looked ahead for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.settings import ControlSettings
from qpavoid.kernels.rollout import HORIZON, PREFERRED_DISTANCE
from qpavoid.problem import Array, IntArray
from qpavoid.safety.rollout import BackupRollouts

_PERIOD = 0.1
"""Time between two positions of the bounding spheres of moving obstacles [s]."""


class _Paths(NamedTuple):
    """Positions of the moving obstacles, every `_PERIOD` until the horizon."""

    first: int
    """Multiple of that period at which they begin."""
    moving: IntArray
    """(k,) numbers of the obstacles that move until then."""
    positions: Array
    """(t, k, 3) [m]."""
    max_deviation: Array
    """(k,) largest distance from the nearest of these positions in between [m]."""
    max_speed: float
    """Largest speed of any of their points [m/s]."""


class ApproachCheck:
    """Keeps one sample of obstacle paths, and the clearance from them of a robot that rests."""

    def __init__(self, settings: ControlSettings, rollouts: BackupRollouts, obstacles: ObstacleTracker) -> None:
        """Use the kinematics and distances of the rollouts."""
        self._model, self._period = settings.scene.robot.model, settings.dt
        self._braking = 0.5 / settings.bounds.acceleration
        self._rollouts, self._obstacles = rollouts, obstacles
        self._external_are_far(settings.scene.robot.home, 0.0)  # so that no step waits for the compiler
        kernels.braking_travel(self._braking, self._period, self._braking)
        kernels.min_sphere_distance(np.zeros((1, 1, 3)), np.zeros((1, 3)), np.zeros((1, 1)))
        self.reset()

    def reset(self) -> None:
        """Drop the sample."""
        self._paths: _Paths | None = None
        self._clearance: tuple[Array, float] | None = None
        self._numbers, self._max_external_speed = self._obstacles.on_trajectories, 0.0

    @property
    def max_speed(self) -> float:
        """Largest speed of any point of an obstacle [m/s]."""
        return max(self._max_external_speed, 0.0 if self._paths is None else self._paths.max_speed)

    def is_far(self, q: Array, v: Array, t: float) -> bool:
        """Return whether moving obstacles certainly stay away from a robot that moves at v (nv,) once more, and brakes.

        It is at q (nq,) at time t [s].
        """
        travel = kernels.braking_travel(v, self._period, self._braking)
        motion = self._rollouts.lever_arm * travel if travel else 0.0  # a lever arm may be infinite
        self._max_external_speed = 0.0
        if len(self._obstacles.external) and not self._external_are_far(q, motion):
            return False
        return not len(self._obstacles.on_trajectories) or self._trajectories_are_far(q, motion, t)

    def _external_are_far(self, q: Array, motion: float) -> bool:
        """Return whether external obstacles that go on at their mean twists stay away from points that move so far."""
        query, obstacles = self._rollouts.query, self._obstacles
        clearance, self._max_external_speed = kernels.line_clearance(
            self._rollouts.packed, q, query.table.spheres, obstacles.external, obstacles.current.states,
            obstacles.mean_twists, query.obstacle_radii + obstacles.current.margin, HORIZON,
        )  # fmt: skip
        return bool(motion < clearance - PREFERRED_DISTANCE)

    def _trajectories_are_far(self, q: Array, motion: float, t: float) -> bool:
        """Return whether obstacles on trajectories stay away from points that move so far [m].

        Between their sampled positions, obstacles are taken to be no faster than at these. A clearance counts until the
        next sample, less the motion of the robot since.
        """
        paths = self._sample(int(np.floor(t / _PERIOD)))
        if not len(paths.moving):
            return True
        lever_arm, query = self._rollouts.lever_arm, self._rollouts.query
        if self._clearance is not None:
            then, clearance = self._clearance
            moved = float(np.abs(pin.difference(self._model, then, q)).sum())
            if lever_arm * moved + motion < clearance:
                return True
        self._rollouts.kinematics.compute(q)
        centers, radii = query.body_spheres(self._rollouts.kinematics.joint_poses)
        obstacle_radii = query.obstacle_radii[paths.moving] + self._obstacles.current.margin[paths.moving]
        obstacle_radii += paths.max_deviation + PREFERRED_DISTANCE
        clearance = kernels.min_sphere_distance(paths.positions, centers, obstacle_radii[:, None] + radii)
        self._clearance = q.copy(), clearance
        return bool(motion < clearance)

    def _sample(self, first: int) -> _Paths:
        """Sample the positions of moving obstacles from a multiple of `_PERIOD` until the horizon."""
        numbers = self._obstacles.on_trajectories
        if self._paths is not None and first == self._paths.first and numbers is self._numbers:
            return self._paths
        self._numbers = numbers
        count = int(np.ceil(HORIZON / _PERIOD)) + 2
        times = _PERIOD * np.arange(first, first + count, dtype=np.float64)
        positions, rates = self._obstacles.paths(times)
        moves = np.flatnonzero(rates.any(axis=1) | (positions != positions[0]).any(axis=(0, 2)))
        moving = numbers[moves]
        speed, spin = rates[moves].T
        # half-spaces have no end: of one that does not turn, 0 · ∞ counts as 0
        radii, rim_speed = self._rollouts.query.obstacle_radii[moving], np.zeros_like(spin)
        np.multiply(spin, radii, out=rim_speed, where=spin > 0.0)
        max_speed = float(np.max(speed + rim_speed, initial=0.0))
        self._paths = _Paths(first, moving, positions[:, moves].copy(), 0.5 * _PERIOD * speed, max_speed)
        self._clearance = None
        return self._paths
