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

from qpavoid.arena.case import Case
from qpavoid.arena.outside.common import between, costs, frame_tasks, one_period_ahead, parted_pairs, pieces
from qpavoid.arena.outside.settings import PINK
from qpavoid.arena.world import World
from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, Solution


class Pilot:
    """Obstacles are geometries of the collision model that no joint moves; their placements are set at every tick.

    The barrier knows no motion of obstacles, and keeps its rows for as long as q stays the same to `np.allclose`:
    a robot at rest does not see what comes. It is used as it is.
    """

    def __init__(self, case: Case, world: World) -> None:
        """Works on copies: Pink hangs attributes on the model, and the scene's geometry is the referee's.

        Raises:
            ConfigError: the case has something that it cannot be given.
        """
        scenario, scene = case.scenario, world.scene
        self._followed = frame_tasks(case, world, "Pink")
        self._dt, self._pieces = scenario.dt, pieces(scene)
        self._damping = (PINK["cost"] * scenario.tracking_damping) ** 2
        model, geometry = scene.robot.model.copy(), pin.GeometryModel(scene.geometry)
        geometry.removeAllCollisionPairs()
        pairs = parted_pairs(scene).tolist()
        for a, b in pairs:
            geometry.addCollisionPair(pin.CollisionPair(a, b))
        self.configuration = pink.Configuration(model, model.createData(), world.q0, collision_model=geometry)
        self._tasks = []
        for task in self._followed:
            position, orientation = costs(task)
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
                d_min=between(scenario.avoidance)[0],
            )
            self._barriers = [barrier]

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        """Velocity for the next dt.

        Raises:
            NoSolutionFound, NotWithinConfigurationLimits: by Pink; the robot is held then.
        """
        configuration, bodies = self.configuration, self.configuration.collision_model.geometryObjects
        for name, seen in obstacles.items():
            for piece in self._pieces[name]:
                bodies[piece].placement = pin.SE3(seen.rotation, seen.position)
        configuration.update(q)
        for task, followed in zip(self._tasks, self._followed, strict=True):
            here = configuration.get_transform_frame_to_world(task.frame).homogeneous
            target = targets[followed.settings.label]
            task.set_target(pin.SE3(one_period_ahead(followed, target, here, self._dt)))
        held = np.zeros(configuration.model.nv)
        try:
            held = pink.solve_ik(
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
                self._accelerations.set_last_integration(held, self._dt)
        return Solution(np.asarray(held))

    def frames(self) -> Array:
        """(f, 4, 4) where Pink has the frames of the tasks."""
        poses = [self.configuration.get_transform_frame_to_world(task.frame).homogeneous for task in self._tasks]
        return np.array(poses)

    def distances(self) -> Array:
        """(k,) what Pink takes for the distances of the pairs [m]."""
        return np.array([result.min_distance for result in self.configuration.collision_data.distanceResults])
