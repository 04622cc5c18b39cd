"""From a scenario to what a controller is made of."""

from __future__ import annotations

from typing import NamedTuple

from qpavoid.config import ScenarioConfig
from qpavoid.control.contacts import ContactRows, build_contacts
from qpavoid.control.tasks import RowTask, build_tasks
from qpavoid.errors import located
from qpavoid.model.robot import Robot
from qpavoid.model.scene import Scene, build_obstacles, build_scene
from qpavoid.problem import Array
from qpavoid.solvers import Solver, make_solver


class Parts(NamedTuple):
    """Parts of a controller, and the initial configuration."""

    scene: Scene
    tasks: list[RowTask]
    solver: Solver
    contacts: ContactRows | None
    q0: Array


def build_parts(scenario: ScenarioConfig, robot: Robot | None = None) -> Parts:
    """Build the parts of a scenario's controller.

    Args:
        scenario: configuration.
        robot: that of the scenario; loaded if left out.

    Raises:
        ConfigError, UnknownName, SolverNotInstalled: naming file, field and remedy.
    """
    source = scenario.source
    if robot is None:
        with located(f"{source}: robot"):
            robot = Robot.load(scenario.robot, source.parent)
    with located(f"{source}: solver"):
        solver = make_solver(scenario.solver)
    q0 = robot.configuration(scenario.q0, f"{source}: q0")
    robot, q0 = robot.lock(scenario.lock, q0, f"{source}: lock")
    obstacles = build_obstacles(scenario.obstacles, source)
    with located(str(source)):
        scene = build_scene(robot, obstacles, scenario.spare_obstacles)
    tasks = build_tasks(scenario.tasks, robot, q0, source)
    contacts = build_contacts(scenario.contacts, robot, q0, source)
    return Parts(scene, tasks, solver, contacts, q0)
