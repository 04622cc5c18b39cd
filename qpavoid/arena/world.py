"""What a case consists of once it is built: the scene, what is to be followed, and where the robot starts."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from qpavoid.config import ScenarioConfig
from qpavoid.control.tasks.frames import AnyTask, FrameTask, build_tasks
from qpavoid.errors import ConfigError, located
from qpavoid.model.robot import Robot
from qpavoid.model.scene import Scene, build_obstacles, build_scene
from qpavoid.problem import Array


class World(NamedTuple):
    """A scenario, built."""

    scene: Scene
    tasks: tuple[AnyTask, ...]
    q0: Array
    """(nq,) where the robot starts."""

    @property
    def tools(self) -> list[FrameTask]:
        """Tasks whose frames have a position to follow."""
        return [task for task in self.tasks if isinstance(task, FrameTask) and task.moves]


def build_world(scenario: ScenarioConfig) -> World:
    """The world of a scenario.

    Raises:
        ConfigError, UnknownName: naming file, field and remedy.
    """
    source = scenario.source
    with located(f"{source}: robot"):
        robot = _loaded(scenario.robot, source.parent)
    q0 = robot.configuration(scenario.q0, f"{source}: q0")
    return world_of(scenario, *robot.lock(scenario.lock, q0, f"{source}: lock"))


@lru_cache(maxsize=16)
def _loaded(name: str, folder: Path) -> Robot:
    """Sweeps run the same few robots again and again; reading the meshes of a humanoid takes longer than a run."""
    return Robot.load(name, folder)


def world_of(scenario: ScenarioConfig, robot: Robot, q0: Array) -> World:
    """The same, of a robot that is loaded, its joints locked.

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
