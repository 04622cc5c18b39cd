"""Proofs in one compiled call that spare a control step the search for backup trajectories.

By bounding spheres, that no moving obstacle comes near; by how far the robot is off it, that the kept one stays valid.
"""

from __future__ import annotations

from math import floor

import numpy as np

from qpavoid import kernels
from qpavoid.control.assembler import RowAssembler
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.settings import ControlSettings
from qpavoid.kernels.approach import PATH_PERIOD, PATH_POINTS
from qpavoid.kernels.rollout import HORIZON
from qpavoid.problem import Array
from qpavoid.safety.rollout import ROUND_OFF, BackupRollouts, BackupTrajectory


class ApproachCheck:
    """Keeps the sampled paths of obstacles."""

    def __init__(
        self, settings: ControlSettings, query: DistanceQuery, lever_arm: float, obstacles: ObstacleTracker
    ) -> None:
        """Use the distances of the control step; `lever_arm` is that of the robot, see `ApproachArrays`."""
        self._distances, self._obstacles, now = query.packed, obstacles, obstacles.current
        count = len(now.states)
        self._memory = kernels.ApproachArrays(
            braking=0.5 / settings.bounds.acceleration,
            spheres=query.table.spheres,
            radii=query.obstacle_radii,
            margin=now.margin,
            states=now.states,
            twists=obstacles.twists,
            turns=obstacles.turns,
            numbers=np.zeros(PATH_POINTS, np.intp),
            positions=np.zeros((PATH_POINTS, count, 3)),
            rates=np.zeros((PATH_POINTS, count, 2)),
            spans=np.zeros((count, 4)),
            peaks=np.zeros((count, 2)),
            scratch=np.zeros_like(now.states),
            proof=np.full(3, -1.0),
            proof_centers=np.zeros((len(query.table.joints), 3)),
            lever_arm=lever_arm,
            dt=settings.dt,
        )
        self.packed = kernels.pack(self._memory)
        self.max_speed = 0.0
        """Largest speed of any point of an obstacle, at the last call [m/s]."""
        self.reset()
        if count:
            kernels.write_path_point(self.packed, 0, 0, now.states[0])
        self._v = np.zeros(settings.scene.robot.model.nv)
        self._comes_near = kernels.direct(
            kernels.comes_near, self.packed, self._distances, self._v, obstacles.external, obstacles.on_trajectories
        )
        self.is_far(self._v, 0.0)  # compiled before any step
        self.reset()

    def brake_with(self, acceleration: Array) -> None:
        """Take accelerations (nv,) as those on which braking counts from now on [rad/s² or m/s²]."""
        self._memory.braking[:] = 0.5 / acceleration

    def reset(self) -> None:
        """Drop the paths."""
        self._memory.numbers.fill(np.iinfo(np.intp).min)
        self._memory.proof[0] = -1.0
        self._first, self._moving = -1, self._obstacles.moving

    def is_far(self, v: Array, t: float) -> bool:
        """Return whether moving obstacles certainly stay away from a robot that moves at v (nv,) once more, and brakes.

        It is where the distances of the control step have it, at time t [s].
        """
        first, obstacles = floor(t / PATH_PERIOD), self._obstacles
        if obstacles.moving is not self._moving:
            self.reset()
        if first != self._first:
            self._extend(first)
        self._v[:] = v  # the code takes v as it is: in one piece
        near, self.max_speed = self._comes_near(
            self.packed, self._distances, self._v, obstacles.external, obstacles.on_trajectories
        )
        return not near

    def _extend(self, first: int) -> None:
        """Sample the paths from a multiple of their period until the horizon."""
        self._first, x, obstacles = first, self._memory, self._obstacles
        x.proof[0] = -1.0
        missing = [s for s in range(first, first + PATH_POINTS) if x.numbers[s % PATH_POINTS] != s]
        for index, motion in obstacles.custom_trajectories.items():
            for s in missing:
                kernels.write_path_point(self.packed, s % PATH_POINTS, index, motion.sample(s * PATH_PERIOD).row)
        kernels.extend_paths(self.packed, obstacles.prediction.pieces, obstacles.on_trajectories, first)


class SettledSteps:
    """Checks kept trajectories with what the control step has in the memory of the kernels."""

    def __init__(self, rollouts: BackupRollouts, rows: RowAssembler) -> None:
        """Compile the check; `rows` are those of the control step."""
        self._rollouts, self._rows, self._separable = rollouts, rows, rollouts.query.table.separable
        if not rollouts.adds_up:
            return
        path = np.zeros((2, len(rows.v)))
        self._offset = kernels.direct(
            kernels.offset_after_step, rollouts.packed_memory, rows.packed, rows.q, path, path, 1, rollouts.enabled,
            self._separable, rollouts.is_accelerated,
        )  # fmt: skip

    def leaves_valid(self, trajectory: BackupTrajectory, steps: int, t: float) -> bool:
        """Return whether a sufficient trajectory is certainly so after the step at t [s], without its first steps.

        False says nothing. The step is settled, at the velocity of the rows, and obstacles move as the trajectory has
        it; see `BackupRollouts.is_valid_from`.
        """
        x, start = self._rollouts, trajectory.start
        if not x.adds_up:
            return False
        end, then = t + x.dt, start.t + steps * x.dt
        if len(trajectory.v) <= steps or trajectory.contact_time < end + HORIZON - 1e-9 or abs(end - then) > ROUND_OFF:
            return False
        rows = self._rows
        offset = self._offset(
            x.packed_memory, rows.packed, rows.q, trajectory.q, trajectory.v, steps, start.enabled, self._separable,
            x.is_accelerated,
        )  # fmt: skip
        return bool(trajectory.clearance - x.lever_arm * offset >= x.sufficient_score.clearance)
