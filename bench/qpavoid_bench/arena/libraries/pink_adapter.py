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

from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, Solution
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.libraries.common import (
    frame_tasks,
    movable_pairs,
    obstacle_geometries,
    surface_distances,
    target_after_step,
    task_costs,
)
from qpavoid_bench.arena.libraries.settings import PINK
from qpavoid_bench.arena.world import World


class Pilot:
    """Pink's solver for one case; obstacles are geometries that no joint moves.

    Their placements are set at every step.

    The barrier knows no motion of obstacles, and keeps its rows for as long as q stays the same to `np.allclose`:
    a robot at rest does not see what comes. It is used as it is.
    """

    def __init__(self, case: Case, world: World) -> None:
        """Set Pink up on copies of model and geometry.

        Pink adds attributes to the model, and the checker uses the scene's geometry.

        Raises:
            ConfigError: the case has something that it cannot be given.
        """
        scenario, scene = case.scenario, world.scene
        self._frame_tasks = frame_tasks(case, world, "Pink")
        self._dt, self._geometries = scenario.dt, obstacle_geometries(scene)
        self._damping = (PINK["cost"] * scenario.tracking_damping) ** 2
        model, geometry = scene.robot.model.copy(), pin.GeometryModel(scene.geometry)
        geometry.removeAllCollisionPairs()
        pairs = movable_pairs(scene).tolist()
        for a, b in pairs:
            geometry.addCollisionPair(pin.CollisionPair(a, b))
        self.configuration = pink.Configuration(model, model.createData(), world.q0, collision_model=geometry)
        self._tasks = []
        for task in self._frame_tasks:
            position, orientation = task_costs(task)
            frame = scene.robot.model.frames[task.frame_id].name
            self._tasks.append(FrameTask(frame, PINK["cost"] * position, PINK["cost"] * orientation))
        bounds = scene.robot.bounds().within(scenario.limits)
        self._limits: list[Any] = [ConfigurationLimit(model), VelocityLimit(model, bounds.velocity)]
        self._accelerations = None
        if np.isfinite(bounds.acceleration).any():  # with no such joint, Pink's own limit cannot be made
            self._accelerations = AccelerationLimit(model, bounds.acceleration)
            self._limits.append(self._accelerations)
        self._barriers = []
        if pairs:
            barrier = SelfCollisionBarrier(
                min(PINK["n_collision_pairs"], len(pairs)),
                gain=PINK["gain"],
                safe_displacement_gain=PINK["safe_displacement_gain"],
                d_min=surface_distances(scenario.avoidance)[0],
            )
            self._barriers = [barrier]

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        """Compute the velocity for the next control period.

        Raises:
            NoSolutionFound, NotWithinConfigurationLimits: by Pink; the robot is held then.
        """
        configuration, bodies = self.configuration, self.configuration.collision_model.geometryObjects
        for name, sample in obstacles.items():
            for piece in self._geometries[name]:
                bodies[piece].placement = pin.SE3(sample.rotation, sample.position)
        configuration.update(q)
        for task, task_config in zip(self._tasks, self._frame_tasks, strict=True):
            pose = configuration.get_transform_frame_to_world(task.frame).homogeneous
            target = targets[task_config.settings.label]
            task.set_target(pin.SE3(target_after_step(task_config, target, pose, self._dt)))
        v = np.zeros(configuration.model.nv)
        try:
            v = pink.solve_ik(
                configuration,
                self._tasks,
                self._dt,
                solver=PINK["solver"],
                damping=self._damping,
                limits=self._limits,
                barriers=self._barriers,
            )
        finally:
            if self._accelerations is not None:
                self._accelerations.set_last_integration(v, self._dt)
        return Solution(np.asarray(v))

    def frames(self) -> Array:
        """Return the poses (f, 4, 4) of the tasks' frames by Pink."""
        poses = [self.configuration.get_transform_frame_to_world(task.frame).homogeneous for task in self._tasks]
        return np.array(poses)

    def distances(self) -> Array:
        """Return the distances (k,) of the pairs by Pink [m]."""
        return np.array([result.min_distance for result in self.configuration.collision_data.distanceResults])
