"""mink: FrameTasks on sites of the MuJoCo model, and its limits."""

from __future__ import annotations

from collections.abc import Mapping

import mink
import mujoco
import numpy as np

from qpavoid.errors import ConfigError
from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, Solution
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.libraries.common import (
    frame_tasks,
    movable_pairs,
    surface_distances,
    target_after_step,
    task_costs,
)
from qpavoid_bench.arena.libraries.settings import MINK
from qpavoid_bench.arena.mujoco_model import build, place_mocap
from qpavoid_bench.arena.world import World


class Pilot:
    """mink's solver for one case; obstacles are mocap bodies.

    Its limit knows no motion of obstacles, and leaves out pairs of parent and child.
    """

    def __init__(self, case: Case, world: World) -> None:
        """Build a MuJoCo model of its own, and mink's tasks and limits.

        Raises:
            ConfigError: the case has something that it cannot be given.
        """
        scenario, scene = case.scenario, world.scene
        self._frame_tasks = frame_tasks(case, world, "mink")
        try:
            mujoco_model = build(scene, world.q0, [task.frame_id for task in self._frame_tasks])
        except ValueError as error:
            raise ConfigError(f"{scenario.source}: MuJoCo knows no such thing: {error}") from error
        self._mujoco_model, self._dt, self._damping = mujoco_model, scenario.dt, scenario.tracking_damping**2
        self._numbers = {obstacle.name: number for number, obstacle in enumerate(scene.obstacles)}
        self.configuration = mink.Configuration(mujoco_model.model, mujoco_model.data.qpos)
        self.configuration.data.mocap_pos[:] = mujoco_model.data.mocap_pos
        self.configuration.data.mocap_quat[:] = mujoco_model.data.mocap_quat
        self._tasks = []
        for number, task in enumerate(self._frame_tasks):
            position, orientation = task_costs(task)
            self._tasks.append(mink.FrameTask(f"frame {number}", "site", position, orientation))
        d1, d2 = surface_distances(scenario.avoidance)
        self.collision = mink.CollisionAvoidanceLimit(
            mujoco_model.model,
            [([a], [b]) for a, b in mujoco_model.geoms[movable_pairs(scene)].tolist()],
            minimum_distance_from_collisions=d1,
            collision_detection_distance=d2,
        )
        bounds = scene.robot.bounds().within(scenario.limits)
        speeds = zip(list(scene.robot.model.names)[1:], bounds.velocity.tolist(), strict=True)
        self._limits = [
            mink.ConfigurationLimit(mujoco_model.model),
            self.collision,
            mink.VelocityLimit(mujoco_model.model, {name: speed for name, speed in speeds if np.isfinite(speed)}),
        ]

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        """Compute the velocity for the next control period.

        Raises:
            NoSolutionFound: by mink; the robot is held then.
        """
        configuration, mujoco_model = self.configuration, self._mujoco_model
        for name, sample in obstacles.items():
            place_mocap(configuration.data, self._numbers[name], sample)
        position = configuration.data.qpos.copy()
        position[mujoco_model.q_index] = q
        configuration.update(position)
        for task, task_config, pose in zip(self._tasks, self._frame_tasks, self.frames(), strict=True):
            there = target_after_step(task_config, targets[task_config.settings.label], pose, self._dt)
            task.set_target(mink.SE3.from_matrix(there))
        v = mink.solve_ik(
            configuration, self._tasks, self._dt, solver=MINK["solver"], damping=self._damping, limits=self._limits
        )
        return Solution(np.asarray(v)[mujoco_model.v_index])

    def frames(self) -> Array:
        """Return the poses (f, 4, 4) of the tasks' frames by mink."""
        transform = self.configuration.get_transform_frame_to_world
        return np.array([transform(task.frame_name, "site").as_matrix() for task in self._tasks])

    def distances(self) -> dict[tuple[int, int], float]:
        """Return the distance of each pair of mink's limit [m], by the scene's geometries."""
        data, max_distance, points = self.configuration.data, 100.0, np.empty(6)
        number = {geom: index for index, geom in enumerate(self._mujoco_model.geoms.tolist())}
        distances_by_pair = {}
        for a, b in self.collision.geom_id_pairs:
            pair = min(number[a], number[b]), max(number[a], number[b])
            distances_by_pair[pair] = float(
                mujoco.mj_geomDistance(self._mujoco_model.model, data, a, b, max_distance, points)
            )
        return distances_by_pair
