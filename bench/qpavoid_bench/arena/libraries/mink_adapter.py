"""mink: FrameTasks on sites of the MuJoCo model, and its limits."""

from __future__ import annotations

from collections.abc import Mapping

import mink
import mujoco
import numpy as np

from qpavoid.errors import ConfigError
from qpavoid.model.sample import Sample
from qpavoid.problem import Array, Solution
from qpavoid.run.mujoco import MAX_DISTANCE, build, place_mocap
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.libraries.common import Adapter, task_costs
from qpavoid_bench.arena.libraries.settings import DAMPING, MINK
from qpavoid_bench.arena.world import World


class Pilot(Adapter):
    """mink's solver for one case; obstacles are mocap bodies.

    Its limit knows no motion of obstacles, and leaves out pairs of parent and child.
    """

    def __init__(self, case: Case, world: World) -> None:
        """Build a MuJoCo model of its own, and mink's tasks and limits.

        Raises:
            ConfigError: the case has something that it cannot be given.
        """
        super().__init__(case, world, "mink")
        try:
            model = self._model = build(world.scene, world.q0, [task.frame_id for task in self.frame_tasks])
        except ValueError as error:
            raise ConfigError(f"{self.source}: MuJoCo knows no such thing: {error}") from error
        self.configuration = mink.Configuration(model.model, model.data.qpos)
        self.configuration.data.mocap_pos[:] = model.data.mocap_pos
        self.configuration.data.mocap_quat[:] = model.data.mocap_quat
        self._tasks = [
            mink.FrameTask(f"frame {number}", "site", *task_costs(task)) for number, task in enumerate(self.frame_tasks)
        ]
        self.collision = mink.CollisionAvoidanceLimit(
            model.model,
            [([a], [b]) for a, b in model.geoms[self.pairs].tolist()],
            minimum_distance_from_collisions=self.d1,
            collision_detection_distance=self.d2,
        )
        speeds = dict(zip(list(world.scene.robot.model.names)[1:], self.bounds.velocity.tolist(), strict=True))
        self._limits = [
            mink.ConfigurationLimit(model.model),
            self.collision,
            mink.VelocityLimit(model.model, {name: speed for name, speed in speeds.items() if np.isfinite(speed)}),
        ]

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        """Compute the velocity for the next control period.

        Raises:
            NoSolutionFound: by mink; the robot is held then.
        """
        configuration, model = self.configuration, self._model
        for name, sample in obstacles.items():
            place_mocap(configuration.data, self._numbers[name], sample)
        position = configuration.data.qpos.copy()
        position[model.q_index] = q
        configuration.update(position)
        for task, pose in zip(self._tasks, self.targets_after_step(targets, self.frames()), strict=True):
            task.set_target(mink.SE3.from_matrix(pose))
        v = mink.solve_ik(
            configuration,
            self._tasks,
            self.dt,
            solver=MINK["solver"],
            damping=DAMPING**2,
            limits=self._limits,
        )
        return Solution(np.asarray(v)[model.v_index])

    def frames(self) -> Array:
        """Return the poses (f, 4, 4) of the tasks' frames by mink."""
        transform = self.configuration.get_transform_frame_to_world
        return np.array([transform(task.frame_name, "site").as_matrix() for task in self._tasks])

    def distances(self) -> dict[tuple[int, int], float]:
        """Return the distance of each pair of mink's limit [m], by the scene's geometries."""
        model, data = self._model.model, self.configuration.data
        number = {geom: index for index, geom in enumerate(self._model.geoms.tolist())}
        return {
            (min(number[a], number[b]), max(number[a], number[b])): float(
                mujoco.mj_geomDistance(model, data, a, b, MAX_DISTANCE, np.empty(6))
            )
            for a, b in self.collision.geom_id_pairs
        }
