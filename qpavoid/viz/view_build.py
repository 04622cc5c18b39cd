"""Builds what a page's scenario runs with, while something else runs: controllers of one scene, a robot each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from threading import Thread
from typing import NamedTuple

import numpy as np

from qpavoid.config import Box, Capsule, Cylinder, ObstacleShape, ScenarioConfig, Sphere
from qpavoid.control.tick import Tick
from qpavoid.controller import Controller
from qpavoid.errors import QpavoidError
from qpavoid.model.sample import Sample
from qpavoid.problem import Array
from qpavoid.run.simulate import Follower
from qpavoid.solvers import Solver
from qpavoid.solvers.python_file import scenario_with_law

SHAPES = ("ball", "box", "capsule", "cylinder")
"""Shapes of obstacles that a page adds."""
_SPARE = 6
"""Obstacles that may be added on the page, at least."""


class Runs(NamedTuple):
    """What a page runs."""

    config: ScenarioConfig
    """Of the first controller."""
    q0: Array
    """(nq,) initial configuration."""
    controllers: list[Controller]


def build_runs(name: str, sets: Sequence[str], solvers: Sequence[str | None], removed: set[str]) -> Runs:
    """Build the controllers of a scenario, one for each solver, with spare slots.

    Args:
        name: shipped name or path.
        sets: overrides of fields.
        solvers: as in `scenario_with_law`.
        removed: names of the obstacles that are left out.

    Raises:
        ConfigError, UnknownName, SolverNotInstalled: it cannot be built.
    """
    configs = configs_of(name, sets, solvers, removed)
    controllers, q0 = [], np.zeros(0)
    for config, law in configs:
        controller, q0 = Controller.from_scenario(config)
        controller.solver = law or controller.solver
        controllers.append(controller)
    return Runs(configs[0][0], q0, controllers)


def configs_of(
    name: str, sets: Sequence[str], solvers: Sequence[str | None], removed: set[str]
) -> list[tuple[ScenarioConfig, Solver | None]]:
    """Return the configurations of these controllers, and laws from files; see `build_runs`."""
    configs = []
    for solver in solvers:
        config, law = scenario_with_law(name, sets, solver)
        present = [obstacle for obstacle in config.obstacles if obstacle.name not in removed]
        changes = {"obstacles": present, "spare_obstacles": max(config.spare_obstacles, _SPARE)}
        configs.append((config.model_copy(update=changes).with_source(config.source), law))
    return configs


class Build(Thread):
    """Builds controllers while others run."""

    def __init__(self, name: str, sets: Sequence[str], solvers: Sequence[str | None], removed: set[str]) -> None:
        """Start; see `build_runs`."""
        super().__init__(daemon=True)
        self._arguments = name, sets, solvers, set(removed)
        self.runs: Runs | None = None
        self.fault = ""
        self.start()

    def run(self) -> None:
        """Build them, or keep why that cannot be."""
        try:
            self.runs = build_runs(*self._arguments)
        except QpavoidError as error:
            self.fault = str(error)


class Loop:
    """A controller, and the robot that follows it."""

    def __init__(self, controller: Controller, q: Array, config: ScenarioConfig) -> None:
        """Begin at rest at q (nq,)."""
        self.controller = controller
        self._follower = Follower(controller.scene.robot.model, q, config.latency, config.dt)
        self.tick: Tick | None = None
        """The last control step."""

    @property
    def q(self) -> Array:
        """Return the configuration (nq,), as measured."""
        return self._follower.q

    @property
    def v(self) -> Array | None:
        """Return the velocity (nv,) of the last control step."""
        return None if self.tick is None else self.tick.solution.v

    def swap(self, controller: Controller) -> None:
        """Take another controller; the robot goes on at its velocity."""
        controller.reset(self.v)
        self.controller = controller

    def look(self, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Tick:
        """Take a control step at t [s], which the robot does not follow yet."""
        self.tick = self.controller.tick(self.q, t, targets or None, obstacles or None)
        return self.tick

    def follow(self) -> None:
        """Hold the velocity of the last control step for one control period."""
        assert self.v is not None
        self._follower.follow(self.v)


def shape_of(kind: str, size: float) -> ObstacleShape:
    """Return one of SHAPES that is `size` [m] wide."""
    match kind:
        case "box":
            return Box(size=(size, size, size))
        case "capsule":
            return Capsule(radius=0.25 * size, length=size)
        case "cylinder":
            return Cylinder(radius=0.5 * size, length=size)
        case _:
            return Sphere(radius=0.5 * size)
