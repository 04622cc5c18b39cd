"""Common parts of the adapters of other libraries: tasks, pairs, target of a step."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from qpavoid.config import Avoidance
from qpavoid.control.tasks import FrameTask
from qpavoid.errors import ConfigError
from qpavoid.model.scene import Scene
from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, IntArray
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.world import World


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


def obstacle_geometries(scene: Scene) -> dict[str, list[int]]:
    """Return the geometries of each obstacle, by its name."""
    return {
        obstacle.name: np.flatnonzero(scene.obstacle_of == number).tolist()
        for number, obstacle in enumerate(scene.obstacles)
    }


def surface_distances(avoidance: Avoidance) -> tuple[float, float]:
    """Return d1 and d2 between surfaces [m]."""
    return avoidance.d1 - avoidance.offset, avoidance.d2 - avoidance.offset


def task_costs(task: FrameTask) -> tuple[float, float]:
    """Return factors of a task's position and orientation errors.

    They are the roots of the weights, 0 for an error that does not count.
    """
    settings = task.settings
    return (
        math.sqrt(settings.weight) if task.moves else 0.0,
        math.sqrt(settings.orientation_weight) if task.turns else 0.0,
    )


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
