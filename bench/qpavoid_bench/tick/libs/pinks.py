"""Pink, on the same Pinocchio model and geometry."""

from __future__ import annotations

from typing import Any

import numpy as np
import pink
import pinocchio as pin
from pink.barriers import SelfCollisionBarrier
from pink.tasks import FrameTask

from qpavoid_bench.tick.build import make_scene
from qpavoid_bench.tick.workloads import Array, Workload


class AllPairs:
    """A row for every pair."""

    count: int | None = None
    """How many of the closest pairs get a row; None: all."""

    def __init__(self, workload: Workload) -> None:
        self.workload = workload
        scene = make_scene(workload)
        self._q = list(workload.q)
        model = scene.robot.model
        self.configuration = pink.Configuration(
            model, model.createData(), workload.q[0], collision_model=scene.geometry
        )
        pairs = len(workload.pairs)
        count = pairs if self.count is None else min(self.count, pairs)
        self.barriers = [SelfCollisionBarrier(count, d_min=workload.d_min)] if count else []
        self.tasks = [FrameTask(name, position_cost=1.0, orientation_cost=1.0) for name, _, _ in workload.frames]
        self._targets = [[pin.SE3(target) for target in targets] for targets in workload.targets]

    def step(self, tick: int) -> Array:
        """One control step."""
        for task, target in zip(self.tasks, self._targets[tick], strict=True):
            task.set_target(target)
        self.configuration.update(self._q[tick])
        v = pink.solve_ik(self.configuration, self.tasks, self.workload.dt, solver="daqp", barriers=self.barriers)
        return np.asarray(v)

    def velocity(self, v: Any) -> Array:
        """As it is."""
        return np.asarray(v)

    def frames(self, tick: int) -> Array:
        """Of Pink's configuration."""
        self.configuration.update(self._q[tick])
        return np.array(
            [self.configuration.get_transform_frame_to_world(task.frame).homogeneous for task in self.tasks]
        )

    def distances(self, tick: int) -> Array:
        """Of Pink's configuration."""
        self.configuration.update(self._q[tick])
        return np.array([result.min_distance for result in self.configuration.collision_data.distanceResults])


class Closest20(AllPairs):
    """A row for each of the 20 closest pairs."""

    count = 20
