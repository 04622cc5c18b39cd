"""Proof by bounding spheres that no moving obstacle comes near: then nothing has to be looked ahead for."""

from __future__ import annotations

from math import floor

import numpy as np

from qpavoid import kernels
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.settings import ControlSettings
from qpavoid.kernels.approach import PATH_PERIOD, PATH_POINTS
from qpavoid.problem import Array
from qpavoid.safety.rollout import BackupRollouts


class ApproachCheck:
    """Keeps the sampled paths of obstacles."""

    def __init__(self, settings: ControlSettings, rollouts: BackupRollouts, obstacles: ObstacleTracker) -> None:
        """Use the kinematics and distances of the rollouts."""
        self._dt, self._braking = settings.dt, 0.5 / settings.bounds.acceleration
        self._rollouts, self._obstacles, count = rollouts, obstacles, len(obstacles.current.states)
        positions, rates = np.zeros((PATH_POINTS, count, 3)), np.zeros((PATH_POINTS, count, 2))
        self._paths = kernels.Paths(np.zeros(PATH_POINTS, np.intp), positions, rates)
        self._scratch = np.zeros_like(obstacles.current.states)
        self.max_speed = 0.0
        """Largest speed of any point of an obstacle, at the last call [m/s]."""
        self.reset()
        self.is_far(settings.scene.robot.home, np.zeros(settings.scene.robot.model.nv), 0.0)  # compiled before any step
        self.reset()

    def reset(self) -> None:
        """Drop the paths."""
        self._paths.numbers.fill(np.iinfo(np.intp).min)
        self._first, self._moving = -1, self._obstacles.moving

    def is_far(self, q: Array, v: Array, t: float) -> bool:
        """Return whether moving obstacles certainly stay away from a robot that moves at v (nv,) once more, and brakes.

        It is at q (nq,) at time t [s].
        """
        first, obstacles, rollouts = floor(t / PATH_PERIOD), self._obstacles, self._rollouts
        if obstacles.moving is not self._moving:
            self.reset()
        if first != self._first:
            self._extend(first)
        now, query = obstacles.current, rollouts.query
        near, self.max_speed = kernels.comes_near(
            rollouts.packed, q, v, self._braking, rollouts.lever_arm, self._dt, query.table.spheres,
            query.obstacle_radii, now.margin, obstacles.external, now.states, obstacles.mean_twists,
            obstacles.on_trajectories, self._paths, first,
        )  # fmt: skip
        return not near

    def _extend(self, first: int) -> None:
        """Sample the paths from a multiple of their period until the horizon."""
        self._first, paths = first, self._paths
        numbers = range(first, first + PATH_POINTS)
        missing = [s for s in numbers if paths.numbers[s % PATH_POINTS] != s]
        for index, motion in self._obstacles.custom_trajectories.items():
            for s in missing:
                kernels.write_path_point(paths, s % PATH_POINTS, index, motion.sample(s * PATH_PERIOD).row)
        kernels.extend_paths(paths, self._obstacles.prediction.pieces, first, self._scratch)
