"""Runs a scenario under a live view: at the pace of the clock, with another solver or other distances while it runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from threading import Thread
from typing import Any

import numpy as np

from qpavoid.config import ScenarioConfig
from qpavoid.config.loading import load_scenario
from qpavoid.control.tasks import in_order
from qpavoid.control.tick import Tick
from qpavoid.controller import Controller
from qpavoid.errors import QpavoidError
from qpavoid.problem import Array
from qpavoid.run.simulate import Follower, describe_obstacle
from qpavoid.solvers import SOLVERS
from qpavoid.viz.view import View, page_setup, pose_of, run_page
from qpavoid.viz.view_clock import SPEEDS, PlayClock
from qpavoid.viz.view_drag import Pulled

ROWS = ("beta", "task-switching")
"""Row forms that a page offers."""


class Session:
    """A scenario that runs while a page shows it and changes it."""

    def __init__(
        self,
        scenario: str,
        sets: Sequence[str] = (),
        solver: str | None = None,
        *,
        port: int = 8080,
        host: str = "127.0.0.1",
        quality: str = "high",
    ) -> None:
        """Build the controller and start the page.

        Args:
            scenario: shipped name or path.
            sets: overrides of fields, `avoidance.d2=0.30`.
            solver: as in `load_scenario`.
            port: see `View`.
            host: see `View`.
            quality: see `View`.

        Raises:
            ConfigError, UnknownName, SolverNotInstalled: the scenario cannot be built, or viser is missing.
        """
        self._name, self._sets, self._solver = scenario, list(sets), solver
        self.config = load_scenario(scenario, sets, solver)
        """The scenario, with what was changed on the page."""
        self.controller, self._q0 = Controller.from_scenario(self.config)
        self._labels = [task.settings.label for task in self.controller.tasks]
        scene = self.controller.scene
        described = [describe_obstacle(scene, i) for i in range(len(scene.slots))]
        self._restart()
        self.tick = self._tick(self.controller)
        """The last control step."""
        targets = [(task.settings.label, task.turns) for task in in_order(self.controller.tasks)[0]]
        setup = page_setup(scene.robot, described, targets, self.config.title or self.config.source.stem)
        setup.controls = _controls(self.config)
        setup.port, setup.host, setup.quality = port, host, quality
        self.clock = PlayClock(self.config.dt)
        self._build: _Build | None = None
        self._changes: dict[str, str] = {}
        self._note, self._restarts = "", False
        self.view = View.of_setup(setup)

    @property
    def t(self) -> float:
        """Return the time of the next step [s]."""
        return self._steps * self.config.dt

    def _restart(self) -> None:
        self._steps, self._targets, self._obstacles = 0, dict[str, Pulled](), dict[str, Pulled]()
        self._follower = Follower(self.controller.scene.robot.model, self._q0, self.config.latency, self.config.dt)
        self.controller.reset()

    def run(self, is_done: Callable[[], bool] = lambda: False) -> None:
        """Run until `is_done`, the page fails, or the keyboard interrupts; it begins to play at the first browser."""
        run_page(self.view, self.clock, self._apply, self._advance, is_done)

    def _advance(self) -> None:
        self._swap()
        if self.clock.wait():
            self._step()
        self.view.update(self.tick, self._note)

    def _apply(self, event: dict[str, Any]) -> None:
        """Do what a control of the page asks for."""
        self.clock.apply(event)
        kind = event["type"]
        if kind == "reset":
            self._start_build(restarts=True)
        elif kind in ("target", "obstacle"):
            pulled = self._pulled(kind, event["name"])
            if pulled is not None:
                pulled.pull(pose_of(event))
        elif kind == "solver":
            self._solver = event["value"]
            self._start_build()
        elif kind == "row":
            self._changes["avoidance.row"] = f"{{type: {event['value']}}}"
            self._start_build()
        elif kind in ("d1", "d2"):
            self._changes[f"avoidance.{kind}"] = f"{1e-3 * event['value']:.6g}"
            self._start_build()

    def _pulled(self, kind: str, name: str) -> Pulled | None:
        """Return what follows the mouse, from now on where it did not before."""
        pulled = self._targets if kind == "target" else self._obstacles
        if name not in pulled:
            pose = self._pose(kind, name)
            if pose is None:
                return None
            pulled[name] = Pulled(pose)
        return pulled[name]

    def _pose(self, kind: str, name: str) -> Array | None:
        if kind == "target":
            return np.asarray(self.tick.targets[self._labels.index(name)].row[:12])
        index = [obstacle.name for obstacle in self.controller.scene.slots].index(name)
        return None if name in self.controller.attached else self.tick.obstacles[index]

    def _start_build(self, restarts: bool = False) -> None:
        """Build a controller of the fields as they are now, aside."""
        self._restarts |= restarts
        sets = [*self._sets, *(f"{field}={value}" for field, value in self._changes.items())]
        self._build = _Build(self._name, sets, self._solver)
        self._note = "building the controller"

    def _swap(self) -> None:
        """Take the controller that was built aside, once it is ready; the robot goes on at its velocity."""
        build = self._build
        if build is None or build.is_alive():
            return
        self._build = None
        if build.controller is None or build.config is None:
            self._note = build.fault
            return
        self.controller, self.config, self._note = build.controller, build.config, ""
        if self._restarts:
            self._restarts = False
            self._restart()
            self.tick = self._tick(self.controller)
            self.controller.reset()
        else:
            self.controller.reset(self.tick.solution.v)

    def _tick(self, controller: Controller) -> Tick:
        targets = {name: pulled.sample for name, pulled in self._targets.items()}
        obstacles = {name: pulled.sample for name, pulled in self._obstacles.items()}
        return controller.tick(self._follower.q, self.t, targets or None, obstacles or None)

    def _step(self) -> None:
        for pulled in (*self._targets.values(), *self._obstacles.values()):
            pulled.advance(self.config.dt)
        self.tick = self._tick(self.controller)
        self._follower.follow(self.tick.solution.v)
        self._steps += 1


class _Build(Thread):
    """Builds a controller while another one runs."""

    def __init__(self, name: str, sets: Sequence[str], solver: str | None) -> None:
        super().__init__(daemon=True)
        self._arguments = name, sets, solver
        self.config: ScenarioConfig | None = None
        self.controller: Controller | None = None
        self.fault = ""
        self.start()

    def run(self) -> None:
        """Build it, or keep why that cannot be."""
        try:
            config = load_scenario(*self._arguments)
            self.controller, self.config = Controller.from_scenario(config)[0], config
        except QpavoidError as error:
            self.fault = str(error)


def _controls(config: ScenarioConfig) -> dict[str, Any]:
    """Return choices and values of the controls of a scenario's page."""
    solver, row = config.solver.label, config.avoidance.row.type
    return {
        "speeds": SPEEDS,
        "solvers": tuple(dict.fromkeys([solver, *SOLVERS])),
        "solver": solver,
        "rows": ROWS,
        "row": row,
        "d1": config.avoidance.d1,
        "d2": config.avoidance.d2,
    }
