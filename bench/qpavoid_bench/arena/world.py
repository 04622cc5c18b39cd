"""A case, built: scene, tasks, and configuration at the start."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from qpavoid import build_contacts
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
    contacts: Any = None
    """Frames that rest, of a robot that stands, see `qpavoid.build_contacts`; None of others."""

    @property
    def tools(self) -> list[FrameTask]:
        """Return the tasks whose frames have a position to follow."""
        return [task for task in self.tasks if isinstance(task, FrameTask) and task.moves]


def load_robot(name: str, q0: Any, lock: Sequence[str], source: Path) -> tuple[Robot, Array]:
    """Load a robot, once a process, without its locked joints, and its configuration (nq,) at the start.

    Args:
        name: of a robot, as a scenario has it.
        q0: joint: value.
        lock: names of joints.
        source: file that asks for it; a relative path starts from its folder.

    Raises:
        ConfigError, UnknownName: naming file, field and remedy.
    """
    with located(f"{source}: robot"):
        robot = _load_robot(name, source.parent)
    return robot.lock(lock, robot.configuration(q0, f"{source}: q0"), f"{source}: lock")


@lru_cache(maxsize=16)
def _load_robot(name: str, folder: Path) -> Robot:
    """Load a robot once a process: a humanoid's meshes take longer to read than a run takes."""
    return Robot.load(name, folder)


def build_world(scenario: ScenarioConfig) -> World:
    """Build the world of a scenario.

    Raises:
        ConfigError, UnknownName: naming file, field and remedy.
    """
    source = scenario.source
    if any(obstacle.attached_to for obstacle in scenario.obstacles):
        raise ConfigError(f"{source}: the arena knows no obstacles that are carried; leave them out")
    if scenario.contacts and scenario.plant is None:
        raise ConfigError(f"{source}: contacts are checked on a plant; give `dynamics` and `plant`, or leave them out")
    if scenario.dynamics and scenario.plant is None:
        raise ConfigError(f"{source}: torques need something that they move; give `plant`, or leave `dynamics` out")
    robot, q0 = load_robot(scenario.robot, scenario.q0, scenario.lock, source)
    obstacles = build_obstacles(scenario.obstacles, source)
    with located(str(source)):
        scene = build_scene(robot, obstacles)
    contacts = build_contacts(scenario.contacts, robot, q0, source)
    return World(scene, tuple(build_tasks(scenario.tasks, robot, q0, source)), q0, contacts)


def surface_safety_distance(scenario: ScenarioConfig) -> float:
    """Return d1 between surfaces, below which avoidance has taken over entirely [m]."""
    return scenario.avoidance.d1 - scenario.avoidance.offset
