"""mink: FrameTasks on sites of the MuJoCo twin, a CollisionAvoidanceLimit over the scene's pairs, and its limits."""

from __future__ import annotations

from collections.abc import Mapping

import mink
import mujoco
import numpy as np

from qpavoid.arena.case import Case
from qpavoid.arena.outside.common import between, costs, frame_tasks, one_period_ahead, parted_pairs
from qpavoid.arena.outside.settings import MINK
from qpavoid.arena.twin import build, place_mocap
from qpavoid.arena.world import World
from qpavoid.errors import ConfigError
from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, Solution


class Pilot:
    """Obstacles are mocap bodies. Its limit knows no motion of theirs, and leaves out pairs of parent and child."""

    def __init__(self, case: Case, world: World) -> None:
        """Writes a model of its own.

        Raises:
            ConfigError: the case has something that it cannot be given.
        """
        scenario, scene = case.scenario, world.scene
        self._followed = frame_tasks(case, world, "mink")
        try:
            twin = build(scene, world.q0, [task.frame_id for task in self._followed])
        except ValueError as error:
            raise ConfigError(f"{scenario.source}: MuJoCo knows no such thing: {error}") from error
        self._twin, self._dt, self._damping = twin, scenario.dt, scenario.tracking_damping**2
        self._numbers = {obstacle.name: number for number, obstacle in enumerate(scene.obstacles)}
        self.configuration = mink.Configuration(twin.model, twin.data.qpos)
        self.configuration.data.mocap_pos[:] = twin.data.mocap_pos
        self.configuration.data.mocap_quat[:] = twin.data.mocap_quat
        self._tasks = []
        for number, task in enumerate(self._followed):
            position, orientation = costs(task)
            self._tasks.append(mink.FrameTask(f"frame {number}", "site", position, orientation))
        d1, d2 = between(scenario.avoidance)
        self.collision = mink.CollisionAvoidanceLimit(
            twin.model,
            [([a], [b]) for a, b in twin.geoms[parted_pairs(scene)].tolist()],
            minimum_distance_from_collisions=d1,
            collision_detection_distance=d2,
        )
        bounds = scene.robot.bounds().within(scenario.limits)
        speeds = zip(list(scene.robot.model.names)[1:], bounds.velocity.tolist(), strict=True)
        self._limits = [
            mink.ConfigurationLimit(twin.model),
            self.collision,
            mink.VelocityLimit(twin.model, {name: speed for name, speed in speeds if np.isfinite(speed)}),
        ]

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        """Velocity for the next dt.

        Raises:
            NoSolutionFound: by mink; the robot is held then.
        """
        configuration, twin = self.configuration, self._twin
        for name, seen in obstacles.items():
            place_mocap(configuration.data, self._numbers[name], seen)
        position = configuration.data.qpos.copy()
        position[twin.q_index] = q
        configuration.update(position)
        for task, followed, here in zip(self._tasks, self._followed, self.frames(), strict=True):
            there = one_period_ahead(followed, targets[followed.settings.label], here, self._dt)
            task.set_target(mink.SE3.from_matrix(there))
        v = mink.solve_ik(
            configuration, self._tasks, self._dt, solver=MINK["solver"], damping=self._damping, limits=self._limits
        )
        return Solution(np.asarray(v)[twin.v_index])

    def frames(self) -> Array:
        """(f, 4, 4) where mink has the frames of the tasks."""
        at = self.configuration.get_transform_frame_to_world
        return np.array([at(task.frame_name, "site").as_matrix() for task in self._tasks])

    def distances(self) -> dict[tuple[int, int], float]:
        """What mink takes for the distance of each pair that it watches [m], by the scene's geometries."""
        data, far, unused = self.configuration.data, 100.0, np.empty(6)
        number = {geom: index for index, geom in enumerate(self._twin.geoms.tolist())}
        found = {}
        for a, b in self.collision.geom_id_pairs:
            pair = min(number[a], number[b]), max(number[a], number[b])
            found[pair] = float(mujoco.mj_geomDistance(self._twin.model, data, a, b, far, unused))
        return found
