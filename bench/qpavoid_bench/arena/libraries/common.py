"""Common parts of the adapters of other libraries: tasks, pairs, target of a step."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
import pinocchio as pin

from qpavoid.control.tasks import FrameTask
from qpavoid.errors import ConfigError
from qpavoid.model.sample import Sample
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, IntArray
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.world import World


class Adapter:
    """What every adapter is made from."""

    def __init__(self, case: Case, world: World, library: str) -> None:
        """Take what a library can be given of a case.

        Raises:
            ConfigError: the case has something that it cannot be given.
        """
        scenario, self.scene = case.scenario, world.scene
        self.dt, self.source = scenario.dt, str(scenario.source)
        self.frame_tasks = frame_tasks(case, world, library)
        self.pairs = movable_pairs(world.scene)
        self.d1, self.d2 = (d - scenario.avoidance.offset for d in (scenario.avoidance.d1, scenario.avoidance.d2))
        self.bounds = world.scene.robot.bounds().within(scenario.limits)
        numbers, count = world.scene.obstacle_of, len(world.scene.obstacles)
        self._geometries = [np.flatnonzero(numbers == number).tolist() for number in range(count)]
        self._numbers = {obstacle.name: number for number, obstacle in enumerate(world.scene.obstacles)}

    def placements(self, obstacles: Mapping[str, Sample]) -> Iterator[tuple[int, pin.SE3]]:
        """Yield the geometries of obstacles, by their numbers, and where they are."""
        for name, sample in obstacles.items():
            placement = pin.SE3(sample.rotation, sample.position)
            yield from ((geometry, placement) for geometry in self._geometries[self._numbers[name]])

    def targets_after_step(self, targets: Mapping[str, Sample], poses: Iterable[Array]) -> list[Array]:
        """Return the pose (4, 4) that each task asks of its frame after a step, from its pose (4, 4) now."""
        return [
            target_after_step(task, targets[task.settings.label], pose, self.dt)
            for task, pose in zip(self.frame_tasks, poses, strict=True)
        ]


def frame_tasks(case: Case, world: World, library: str) -> list[FrameTask]:
    """Return the tasks of a case, all of which follow frames.

    Raises:
        ConfigError: the case has something that the library is not given.
    """
    unsupported = []
    tasks = [task for task in world.tasks if isinstance(task, FrameTask)]
    if len(tasks) < len(world.tasks):
        unsupported.append("tasks other than `position`, `pose` and `orientation`")
    if world.scene.clouds:
        unsupported.append("point clouds")
    if any(joint.nq != 1 or joint.nv != 1 for joint in list(world.scene.robot.model.joints)[1:]):
        unsupported.append("joints that are neither hinges nor slides; lock them")
    if unsupported:
        raise ConfigError(f"{case.scenario.source}: the adapter of {library} knows no {', no '.join(unsupported)}")
    return tasks


def movable_pairs(scene: Scene) -> IntArray:
    """Return pairs (k, 2) whose distance the robot can change.

    A row for any other pair could only make a QP infeasible.
    """
    return np.asarray(scene.pairs[np.any(scene.support != 0.0, axis=1)], dtype=np.intp)


def task_costs(task: FrameTask) -> tuple[float, float]:
    """Return factors of a task's position and orientation errors.

    They are the roots of the weights, 0 for an error that does not count.
    """
    settings = task.settings
    weights = settings.weight if task.moves else 0.0, settings.orientation_weight if task.turns else 0.0
    return math.sqrt(weights[0]), math.sqrt(weights[1])


def target_after_step(task: FrameTask, target: Sample, pose: Array, dt: float) -> Array:
    """Return the pose that a task asks of its frame after dt.

    These libraries close a share `gain` of the error in every step, 1 by default, and know no velocity of a target;
    here a task asks for v_ref + K (x_ref - x), capped. A target that lies dt times that velocity from where the frame
    is makes both the same, with the library's gain left alone.

    Args:
        task: with its gain K and caps.
        target: what it follows.
        pose: pose of its frame (4, 4).
        dt: length of the step [s].

    Returns:
        Pose (4, 4); what of it does not count is as it is.
    """
    settings, there = task.settings, np.array(pose)
    if task.moves:
        linear = target.linear + settings.gain * (target.position - pose[:3, 3])
        there[:3, 3] += dt * _limit_norm(linear, settings.max_speed)
    if task.turns:
        angular = target.angular + settings.gain * pin.log3(target.rotation @ pose[:3, :3].T)
        there[:3, :3] = pin.exp3(dt * _limit_norm(angular, settings.max_turn_rate)) @ pose[:3, :3]
    return there


def _limit_norm(velocity: Array, cap: float | None) -> Array:
    """Scale a velocity down to a cap on its norm."""
    speed = float(np.linalg.norm(velocity))
    return velocity if cap is None or speed <= cap else velocity * (cap / speed)
