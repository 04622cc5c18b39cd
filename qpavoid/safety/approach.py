"""Proof by bounding spheres that no moving obstacle comes near: then nothing has to be looked ahead for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.settings import ControlSettings
from qpavoid.problem import Array, IntArray
from qpavoid.safety.rollout import HORIZON, PREFERRED_DISTANCE, BackupRollouts

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
        zero = np.zeros(settings.scene.robot.model.nv)
        kernels.line_clearance(
            rollouts.packed, settings.scene.robot.home, zero, self._period, self._braking, rollouts.query.table.spheres,
            obstacles.external, obstacles.current.states, obstacles.mean_twists, rollouts.query.obstacle_radii, HORIZON,
        )  # fmt: skip
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
        """Return whether moving obstacles certainly stay away from a robot that moves at v once more, and brakes.

        Args:
            q: configuration (nq,).
            v: velocity (nv,) of this control step.
            t: time [s].
        """
        return self._external_are_far(q, v) and self._trajectories_are_far(q, v, t)

    def _external_are_far(self, q: Array, v: Array) -> bool:
        """Return whether external obstacles stay away that go on at their mean twists."""
        rollouts, obstacles, self._max_external_speed = self._rollouts, self._obstacles, 0.0
        if not len(obstacles.external):
            return True
        clearance, travel, self._max_external_speed = kernels.line_clearance(
            rollouts.packed, q, v, self._period, self._braking, rollouts.query.table.spheres, obstacles.external,
            obstacles.current.states, obstacles.mean_twists, rollouts.query.obstacle_radii, HORIZON,
        )  # fmt: skip
        return bool(rollouts.lever_arm * travel < clearance - PREFERRED_DISTANCE)

    def _trajectories_are_far(self, q: Array, v: Array, t: float) -> bool:
        """Return whether obstacles on trajectories stay away.

        Between their sampled positions, obstacles are taken to be no faster than at these. A clearance counts until the
        next sample, less the motion of the robot since.
        """
        if not len(self._obstacles.on_trajectories):
            return True
        paths = self._sample(int(np.floor(t / _PERIOD)))
        if not len(paths.moving):
            return True
        lever_arm, query = self._rollouts.lever_arm, self._rollouts.query
        travel = float((self._period * np.abs(v) + self._braking * np.square(v)).sum())
        if self._clearance is not None:
            then, clearance = self._clearance
            moved = float(np.abs(pin.difference(self._model, then, q)).sum())
            if lever_arm * (moved + travel) < clearance:
                return True
        self._rollouts.kinematics.compute(q)
        centers, radii = query.body_spheres(self._rollouts.kinematics.joint_poses)
        obstacle_radii = query.obstacle_radii[paths.moving] + paths.max_deviation + PREFERRED_DISTANCE
        clearance = kernels.min_sphere_distance(paths.positions, centers, obstacle_radii[:, None] + radii)
        self._clearance = q.copy(), clearance
        return lever_arm * travel < clearance

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
