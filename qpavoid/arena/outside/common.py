"""What adapters of other libraries share: what of a case they can be given, and the target of one tick."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from qpavoid.arena.case import Case
from qpavoid.arena.world import World
from qpavoid.config import Avoidance
from qpavoid.control.tasks.frames import FrameTask
from qpavoid.errors import ConfigError
from qpavoid.model.scene import Scene
from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, IntArray


def frame_tasks(case: Case, world: World, library: str) -> list[FrameTask]:
    """The tasks of a case, all of which follow frames.

    Raises:
        ConfigError: the case has something that the library is not given.
    """
    refused = []
    tasks = [task for task in world.tasks if isinstance(task, FrameTask)]
    if len(tasks) < len(world.tasks):
        refused.append("tasks other than `position`, `pose` and `orientation`")
    if world.scene.clouds:
        refused.append("point clouds")
    if any(joint.nq != 1 or joint.nv != 1 for joint in list(world.scene.robot.model.joints)[1:]):
        refused.append("joints that are neither hinges nor slides; lock them")
    if refused:
        raise ConfigError(f"{case.scenario.source}: the adapter of {library} knows no {', no '.join(refused)}")
    return tasks


def parted_pairs(scene: Scene) -> IntArray:
    """(k, 2) pairs whose distance the robot can change: a row for any other could only make a QP infeasible."""
    return np.asarray(scene.pairs[np.any(scene.support != 0.0, axis=1)], dtype=np.intp)


def pieces(scene: Scene) -> dict[str, list[int]]:
    """Geometries of each obstacle, by its name."""
    return {
        obstacle.name: np.flatnonzero(scene.obstacle_of == number).tolist()
        for number, obstacle in enumerate(scene.obstacles)
    }


def between(avoidance: Avoidance) -> tuple[float, float]:
    """d1 and d2 between surfaces [m]."""
    return avoidance.d1 - avoidance.offset, avoidance.d2 - avoidance.offset


def costs(task: FrameTask) -> tuple[float, float]:
    """Factors of a task's position and orientation errors: the roots of their weights, 0 for what does not count."""
    settings = task.settings
    return (
        math.sqrt(settings.weight) if task.moves else 0.0,
        math.sqrt(settings.orientation_weight) if task.turns else 0.0,
    )


def one_period_ahead(task: FrameTask, target: Sample, here: Array, dt: float) -> Array:
    """Where a task wants its frame to be after dt.

    These libraries close a share `gain` of the error in every step, 1 by default, and know no velocity of a target;
    here a task asks for v_ref + K (x_ref - x), capped. A target that lies dt times that velocity from where the frame
    is makes both the same, with the library's gain left alone.

    Args:
        task: with its gain K and caps.
        target: what it follows.
        here: pose of its frame (4, 4).
        dt: length of the step [s].

    Returns:
        Pose (4, 4); what of it does not count is as it is.
    """
    settings, there = task.settings, np.array(here)
    if task.moves:
        linear = target.linear + settings.gain * (target.position - here[:3, 3])
        there[:3, 3] += dt * _capped(linear, settings.max_speed)
    if task.turns:
        angular = target.angular + settings.gain * pin.log3(target.rotation @ here[:3, :3].T)
        there[:3, :3] = pin.exp3(dt * _capped(angular, settings.max_turn_rate)) @ here[:3, :3]
    return there


def _capped(velocity: Array, cap: float | None) -> Array:
    speed = float(np.linalg.norm(velocity))
    return velocity if cap is None or speed <= cap else velocity * (cap / speed)
