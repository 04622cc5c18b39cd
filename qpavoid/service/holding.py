"""What counts where a client leaves a target or an obstacle out: nothing of a scenario moves by itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.config import Fixed, LookAtTask, ScenarioConfig
from qpavoid.control.tasks import build_tasks
from qpavoid.model.cloud import Points
from qpavoid.model.robot import Robot
from qpavoid.model.sample import Pose, Sample
from qpavoid.model.scene import build_obstacles
from qpavoid.model.trajectory import build_motion
from qpavoid.problem import Array


def moving_obstacles(scenario: ScenarioConfig) -> list[str]:
    """Return the names of the obstacles that a scenario moves."""
    return [obstacle.name for obstacle in build_obstacles(scenario.obstacles, scenario.source) if obstacle.moves]


def without_motions(scenario: ScenarioConfig) -> ScenarioConfig:
    """Return a scenario in which nothing moves by itself.

    Obstacles stand where they are at t = 0, as points to look at do; all else that follows a motion rests where it is
    at the start.
    """
    built = build_obstacles(scenario.obstacles, scenario.source)
    obstacles = [
        config.model_copy(update={"motion": _standing(obstacle.motion.sample(0.0))}) if obstacle.moves else config
        for config, obstacle in zip(scenario.obstacles, built, strict=True)
    ]
    tasks = [
        task.model_copy(update={"motion": _still_motion(task, scenario)}) if hasattr(task, "motion") else task
        for task in scenario.tasks
    ]
    return scenario.model_copy(update={"obstacles": obstacles, "tasks": tasks}).with_source(scenario.source)


def _still_motion(task: Any, scenario: ScenarioConfig) -> Fixed:
    if not isinstance(task, LookAtTask):
        return Fixed()
    return _standing(build_motion(task.motion, folder=scenario.source.parent).sample(0.0))


def _standing(sample: Sample) -> Fixed:
    rpy = pin.rpy.matrixToRpy(sample.rotation).tolist()
    return Fixed(position=tuple(sample.position.tolist()), rpy=tuple(rpy))


class HeldTargets:
    """Targets of all tasks: those that were sent last, at rest; until one is sent, where the robot was at first."""

    def __init__(self, scenario: ScenarioConfig, robot: Robot) -> None:
        """Begin without a client.

        Args:
            scenario: one `without_motions`.
            robot: that is controlled.
        """
        self._scenario, self._robot = scenario, robot
        self._turning = {
            task.label for task in scenario.tasks if "orientation" in (task.type, getattr(task, "rows", ""))
        }
        self._targets: dict[str, Any] = {}
        self._is_due = True

    def forget(self) -> None:
        """Forget what was sent, when the next step begins."""
        self._is_due = True

    def begin(self, q: Array) -> None:
        """Begin a step at q (nq,), where the robot is to stay if nothing was sent, or that was forgotten."""
        if not self._is_due:
            return
        tasks = build_tasks(self._scenario.tasks, self._robot, q, self._scenario.source)
        at_start = {task.settings.label: task.motion.sample(0.0) for task in tasks}
        self._targets = {name: target for name, target in at_start.items() if target is not None}

    @property
    def rotations(self) -> dict[str, Array]:
        """Rotations (3, 3) of those that have one, and a position that may be sent without."""
        return {name: turn for name, turn in _rotations(self._targets).items() if name not in self._turning}

    def complete(self, sent: Mapping[str, Any]) -> dict[str, Any]:
        """Return the targets of a step: those that were sent, and the held ones of all other tasks."""
        return {**self._targets, **sent}

    def keep(self, sent: Mapping[str, Any]) -> None:
        """Hold what was sent from now on; what moves is held where it was sent."""
        self._is_due = False
        self._targets |= {name: _at_rest(target, self._targets.get(name)) for name, target in sent.items()}


class HeldObstacles:
    """Where obstacles were sent last, for the first step after a reset: what was seen then is not forgotten."""

    def __init__(self) -> None:
        self._sent: dict[str, Any] = {}
        self._is_due = False

    def after_reset(self) -> None:
        """Let the next step have all obstacles."""
        self._is_due = True

    def drop(self, name: str) -> None:
        """Forget one that was removed, or is held by the robot."""
        self._sent.pop(name, None)

    @property
    def rotations(self) -> dict[str, Array]:
        """Rotations (3, 3) of those that have one."""
        return _rotations(self._sent)

    def complete(self, sent: Mapping[str, Any]) -> dict[str, Any]:
        """Return the obstacles of a step: those that were sent, and after a reset all others as they were seen last."""
        if not self._is_due:
            return dict(sent)
        return {**{name: _seen_before(update) for name, update in self._sent.items()}, **sent}

    def keep(self, sent: Mapping[str, Any]) -> None:
        """Remember what a step was given."""
        self._is_due = False
        self._sent |= {name: _whole(update, self._sent.get(name)) for name, update in sent.items()}


def _rotations(given: Mapping[str, Any]) -> dict[str, Array]:
    return {name: what.rotation for name, what in given.items() if isinstance(what, Sample | Pose)}


def _whole(update: Any, last: Any) -> Any:
    """Return an update; of a position alone, with the rotation of the `last` one."""
    is_position = isinstance(update, np.ndarray) and isinstance(last, Sample | Pose)
    return Pose.at(update, last.rotation) if is_position else update


def _at_rest(target: Any, last: Any) -> Any:
    """Return a target that rests."""
    whole = _whole(target, last)
    return Pose.at(whole.position, whole.rotation) if isinstance(whole, Sample) else whole


def _seen_before(update: Any) -> Any:
    """Return an update as one of now, without a velocity: how long ago it was is not known after a reset."""
    if isinstance(update, Points):
        return update._replace(t=None, pose=None if update.pose is None else _at_rest(update.pose, None))
    if isinstance(update, Sample | Pose):
        return Pose.at(update.position, update.rotation, None, update.at_rest)
    return update
