"""A case, built: scene, tasks, and configuration at the start."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from qpavoid.config import ScenarioConfig
from qpavoid.control.tasks import FrameTask, RowTask, build_tasks
from qpavoid.errors import ConfigError, located
from qpavoid.model.robot import Robot
from qpavoid.model.scene import Scene, build_obstacles, build_scene
from qpavoid.problem import Array


class World(NamedTuple):
    """A scenario, built."""

    scene: Scene
    tasks: tuple[RowTask, ...]
    q0: Array
    """(nq,) configuration at the start."""

    @property
    def tools(self) -> list[FrameTask]:
        """Return the tasks whose frames have a position to follow."""
        return [task for task in self.tasks if isinstance(task, FrameTask) and task.moves]


def build_world(scenario: ScenarioConfig) -> World:
    """Build the world of a scenario.

    Raises:
        ConfigError, UnknownName: naming file, field and remedy.
    """
    source = scenario.source
    with located(f"{source}: robot"):
        robot = _load_robot(scenario.robot, source.parent)
    q0 = robot.configuration(scenario.q0, f"{source}: q0")
    return build_world_of(scenario, *robot.lock(scenario.lock, q0, f"{source}: lock"))


@lru_cache(maxsize=16)
def _load_robot(name: str, folder: Path) -> Robot:
    """Load a robot once a process: a humanoid's meshes take longer to read than a run takes."""
    return Robot.load(name, folder)


def build_world_of(scenario: ScenarioConfig, robot: Robot, q0: Array) -> World:
    """Build the world of a scenario with a robot that is loaded, its joints locked.

    Raises:
        ConfigError, UnknownName: naming file, field and remedy.
    """
    source = scenario.source
    if scenario.contacts or any(obstacle.attached_to for obstacle in scenario.obstacles):
        raise ConfigError(f"{source}: the arena knows neither contacts nor obstacles that are carried; leave them out")
    obstacles = build_obstacles(scenario.obstacles, source)
    with located(str(source)):
        scene = build_scene(robot, obstacles)
    return World(scene, tuple(build_tasks(scenario.tasks, robot, q0, source)), q0)
