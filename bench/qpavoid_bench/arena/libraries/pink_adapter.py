"""Pink: FrameTasks, a SelfCollisionBarrier over the scene's pairs, and its limits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pink
import pinocchio as pin
from pink.barriers import SelfCollisionBarrier
from pink.limits import AccelerationLimit, ConfigurationLimit, VelocityLimit
from pink.tasks import FrameTask

from qpavoid.model.sample import Sample
from qpavoid.problem import Array, Solution
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.libraries.common import Adapter, task_costs
from qpavoid_bench.arena.libraries.settings import DAMPING, PINK
from qpavoid_bench.arena.world import World


class Pilot(Adapter):
    """Pink's solver for one case; obstacles are geometries that no joint moves.

    The barrier knows no motion of obstacles, and keeps its rows for as long as q stays the same to `np.allclose`:
    a robot at rest does not see what comes. It is used as it is.
    """

    def __init__(self, case: Case, world: World) -> None:
        """Set Pink up on copies of model and geometry.

        Pink adds attributes to the model, and the checker uses the scene's geometry.

        Raises:
            ConfigError: the case has something that it cannot be given.
        """
        super().__init__(case, world, "Pink")
        self._damping = (PINK["cost"] * DAMPING) ** 2
        model, geometry = world.scene.robot.model.copy(), pin.GeometryModel(world.scene.geometry)
        geometry.removeAllCollisionPairs()
        for a, b in self.pairs.tolist():
            geometry.addCollisionPair(pin.CollisionPair(a, b))
        self.configuration = pink.Configuration(model, model.createData(), world.q0, collision_model=geometry)
        self._tasks = [
            FrameTask(model.frames[task.frame_id].name, *(PINK["cost"] * cost for cost in task_costs(task)))
            for task in self.frame_tasks
        ]
        self._limits: list[Any] = [ConfigurationLimit(model), VelocityLimit(model, self.bounds.velocity)]
        if np.isfinite(self.bounds.acceleration).any():  # with no such joint, Pink's own limit cannot be made
            self._limits.append(AccelerationLimit(model, self.bounds.acceleration))
        self._barriers = []
        if len(self.pairs):
            count, gains = min(PINK["n_collision_pairs"], len(self.pairs)), ("gain", "safe_displacement_gain")
            self._barriers.append(SelfCollisionBarrier(count, d_min=self.d1, **{name: PINK[name] for name in gains}))

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        """Compute the velocity for the next control period.

        Raises:
            NoSolutionFound, NotWithinConfigurationLimits: by Pink; the robot is held then.
        """
        configuration = self.configuration
        for geometry, placement in self.placements(obstacles):
            configuration.collision_model.geometryObjects[geometry].placement = placement
        configuration.update(q)
        for task, pose in zip(self._tasks, self.targets_after_step(targets, self.frames()), strict=True):
            task.set_target(pin.SE3(pose))
        v, options = np.zeros(configuration.model.nv), {"solver": PINK["solver"], "damping": self._damping}
        try:
            v = pink.solve_ik(
                configuration, self._tasks, self.dt, limits=self._limits, barriers=self._barriers, **options
            )
        finally:
            for limit in self._limits:
                if isinstance(limit, AccelerationLimit):
                    limit.set_last_integration(v, self.dt)
        return Solution(np.asarray(v))

    def frames(self) -> Array:
        """Return the poses (f, 4, 4) of the tasks' frames by Pink."""
        poses = [self.configuration.get_transform_frame_to_world(task.frame).homogeneous for task in self._tasks]
        return np.array(poses)

    def distances(self) -> Array:
        """Return the distances (k,) of the pairs by Pink [m]."""
        return np.array([result.min_distance for result in self.configuration.collision_data.distanceResults])
