"""Runs a scenario under a live view: at the pace of the clock, with another solver or other distances while it runs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from qpavoid.config import ScenarioConfig
from qpavoid.control.scenario import build_parts
from qpavoid.control.tasks import in_order
from qpavoid.control.tick import Tick
from qpavoid.controller import Controller
from qpavoid.errors import QpavoidError
from qpavoid.model.scene import Obstacle
from qpavoid.problem import Array
from qpavoid.solvers import SOLVERS
from qpavoid.viz.view import View, page_setup, pose_of, run_page
from qpavoid.viz.view_build import SHAPES, Build, Loop, Runs, build_runs, configs_of, shape_of
from qpavoid.viz.view_clock import SPEEDS, PlayClock
from qpavoid.viz.view_drag import Pulled
from qpavoid.viz.view_link import Frame, still_frame

ROWS = ("beta", "task-switching")
"""Row forms that a page offers."""
ALONE = "none"
"""Choice of no second solver."""
LOOK_BACK = 30.0
"""Time that can be looked back at [s]."""
_RATE = 30.0
"""Frames a second."""
_PLANNED_POINTS = 300
_HINT = "Drag {} into the robot with the mouse: it steps aside. Pull its target by the arrows."
_WAITING = "The robot moves once its controller is built (the first time on a machine: a minute or two of compiling)"


class Session:
    """A scenario that runs while a page shows it and changes it."""

    def __init__(
        self,
        scenario: str,
        sets: Sequence[str] = (),
        solver: str | None = None,
        *,
        beside: str | None = None,
        port: int = 8080,
        host: str = "127.0.0.1",
        quality: str = "high",
    ) -> None:
        """Build the controller and start the page.

        Args:
            scenario: shipped name or path.
            sets: overrides of fields, `avoidance.d2=0.30`.
            solver: as in `scenario_with_law`.
            beside: solver of a second robot in the same scene, which is shown translucent; None: there is none.
            port: see `View`.
            host: see `View`.
            quality: see `View`.

        Raises:
            ConfigError, UnknownName, SolverNotInstalled: the scenario cannot be built, or viser is missing.
        """
        self._name, self._sets, self._solver, self._beside = scenario, list(sets), solver, beside or ALONE
        self._fields: dict[str, str] = {}
        self._removed: set[str] = set()
        self._added: dict[str, Obstacle] = {}
        self.loops: list[Loop] = []
        """The robot that is shown in full, then the one beside it, if there is one."""
        self._obstacles: dict[str, Pulled] = {}
        self.view = self._open_page(port, host, quality)
        try:
            self._take(build_runs(*self._build_arguments()))
        except BaseException:
            self.view.close()
            raise
        self._labels = [task.settings.label for task in self.controller.tasks]
        self.clock = PlayClock(self.config.dt)
        self._build: Build | None = None
        self._note, self._restarts, self._back = "", False, 0.0
        self.shown_time = 0.0
        """Time of what the page shows, which is in the past while it looks back [s]."""
        self._history: deque[Frame] = deque(maxlen=round(LOOK_BACK * _RATE))
        self._restart()
        self.view.scene = self.controller.scene

    def _open_page(self, port: int, host: str, quality: str) -> View:
        """Start the page, which shows the scene while the controller is built."""
        config, law = configs_of(*self._build_arguments())[0]
        parts = build_parts(config)
        frames, scene, q0 = in_order(parts.tasks)[0], parts.scene, parts.q0
        times = np.linspace(0.0, config.duration, _PLANNED_POINTS)
        planned = [np.array([task.motion.sample(t).position for t in times]) for task in frames if task.moves]
        nearby = np.array(
            [o.motion.sample(t).position for o in scene.slots if o.name for t in times[:: len(times) // 10]]
        )
        targets = [(task.settings.label, task.turns) for task in frames]
        setup = page_setup(scene.robot, [], targets, config.title or config.source.stem, q0, planned, nearby)
        setup.controls = _controls(
            config, self._solver if law else None, self._beside, [o.name for o in config.obstacles]
        )
        setup.others, setup.waiting = ["beside"], _WAITING
        setup.port, setup.host, setup.quality, setup.rate = port, host, quality, _RATE
        view = View.of_setup(setup, scene)
        view.show(still_frame(scene, parts.tasks, q0, config.avoidance))
        return view

    @property
    def controller(self) -> Controller:
        """Return the controller of the robot that is shown in full."""
        return self.loops[0].controller

    @property
    def tick(self) -> Tick:
        """Return its last control step."""
        assert self.loops[0].tick is not None
        return self.loops[0].tick

    @property
    def t(self) -> float:
        """Return the time of the next step [s]."""
        return self._steps * self.config.dt

    def run(self, is_done: Callable[[], bool] = lambda: False) -> None:
        """Run until `is_done`, the page fails, or the keyboard interrupts; it begins to play at the first browser."""
        run_page(self.view, self.clock, self._apply, self._advance, is_done)

    def _restart(self) -> None:
        self._steps, self._targets, self._obstacles = 0, dict[str, Pulled](), {}
        self.loops = [Loop(loop.controller, self._q0, self.config) for loop in self.loops]
        self._history.clear()
        for loop in self.loops:
            loop.controller.reset()
            loop.look(0.0, {}, {})
            loop.controller.reset()  # that step was not taken

    def _advance(self) -> None:
        self._swap()
        if self.clock.wait():
            self._step()
        if self.view.is_due():
            if not self.clock.is_playing:  # what is pulled while time stands still is there when it goes on
                for pulled in (*self._targets.values(), *self._obstacles.values()):
                    pulled.advance(1.0 / _RATE)
            frame = self._past_frame() if self._back else self._frame()
            self.shown_time = frame.t
            self.view.show(frame)

    def _step(self) -> None:
        for pulled in (*self._targets.values(), *self._obstacles.values()):
            pulled.advance(self.config.dt)
        targets = {name: pulled.sample for name, pulled in self._targets.items()}
        obstacles = {name: pulled.sample for name, pulled in self._obstacles.items()}
        for loop in self.loops:
            loop.look(self.t, targets, obstacles)
            loop.follow()
        self.view.count_time(self.tick)
        self._steps += 1

    def _frame(self) -> Frame:
        frame = self.view.frame(self.tick, self._note)
        if not self.clock.is_playing:
            frame = frame._replace(obstacles=frame.obstacles.copy(), targets=frame.targets.copy())
            slots = [obstacle.name for obstacle in self.controller.scene.slots]
            for rows, names, all_pulled in (
                (frame.obstacles, slots, self._obstacles), (frame.targets, self._labels, self._targets),
            ):  # fmt: skip
                for name, pulled in all_pulled.items():
                    rows[names.index(name)] = pulled.sample.row[:12]
        if len(self.loops) > 1 and (tick := self.loops[1].tick) is not None:
            nearest = min(tick.proximity.distance, default=np.inf)
            frame = frame._replace(ghosts=np.vstack((frame.ghosts, (1.0, nearest, *tick.state.q))))
        if not self._history or frame.t > self._history[-1].t:
            self._history.append(frame)
        return frame

    def _past_frame(self) -> Frame:
        """Return the frame of the moment that is looked back at."""
        t = self._history[-1].t - self._back
        return next((frame for frame in self._history if frame.t >= t - 1e-9), self._history[-1])

    def _apply(self, event: dict[str, Any]) -> None:
        """Do what a control of the page asks for."""
        self.clock.apply(event)
        kind = event["type"]
        match kind:
            case "play" | "step" | "toggle":
                self._back = 0.0
            case "back":
                self.clock.is_playing = False
                self._back = min(max(float(event["value"]), 0.0), LOOK_BACK) if self._history else 0.0
            case "reset":
                self._back, self._restarts = 0.0, True
                self._start_build()
            case "target" | "obstacle":
                pulled = self._pulled(kind, event["name"])
                if pulled is not None:
                    pulled.pull(pose_of(event))
            case "add":
                self._add(event["shape"], 1e-3 * float(event["size"]))
            case "remove":
                self._remove(event["name"])
            case "solver":
                self._solver = event["value"]
                self._start_build()
            case "beside":
                self._beside = event["value"]
                self._start_build()
            case "row":
                self._change("avoidance.row", f"{{type: {event['value']}}}")
            case "d1" | "d2":
                self._change(f"avoidance.{kind}", f"{1e-3 * event['value']:.6g}")
            case "weight":
                labels = [task.label for task in self.config.tasks]
                self._change(f"tasks.{labels.index(event['name'])}.weight", f"{event['value']:.6g}")

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
        names = [obstacle.name for obstacle in self.controller.scene.slots]
        if name not in names or name in self.controller.attached:
            return None
        return np.asarray(self.tick.obstacles[names.index(name)])

    def _add(self, kind: str, size: float) -> None:
        """Add an obstacle beside the first tool, away from the robot's axis."""
        number = 1 + len(self._added)
        while any(f"{kind} {number}" in loop.controller.scene.obstacle_names for loop in self.loops):
            number += 1
        tools = self.tick.kinematics.position
        tool = tools[0] if len(tools) else np.array([0.4, 0.0, 0.5])
        outward = np.array([tool[0], tool[1], 0.0]) / max(float(np.hypot(tool[0], tool[1])), 1e-9)
        obstacle = Obstacle.at(f"{kind} {number}", shape_of(kind, size), tool + (0.25 + size) * outward)
        try:
            for loop in self.loops:
                loop.controller.add_obstacle(obstacle)
        except QpavoidError as error:
            self._note = str(error)
            return
        self._added[obstacle.name] = obstacle

    def _remove(self, name: str) -> None:
        """Remove an obstacle: at once if it was added here, else by a controller of a scene without it."""
        if self._added.pop(name, None) is not None:
            for loop in self.loops:
                loop.controller.remove_obstacle(name)
        else:
            self._removed.add(name)
            self._start_build()
        self._obstacles.pop(name, None)

    def _change(self, field: str, value: str) -> None:
        self._fields[field] = value
        self._start_build()

    def _build_arguments(self) -> tuple[str, list[str], list[str | None], set[str]]:
        sets = [*self._sets, *(f"{field}={value}" for field, value in self._fields.items())]
        solvers = [self._solver] if self._beside == ALONE else [self._solver, self._beside]
        return self._name, sets, solvers, self._removed

    def _start_build(self) -> None:
        """Build controllers of the fields as they are now, aside."""
        self._build = Build(*self._build_arguments())
        self._note = "building the controller"

    def _swap(self) -> None:
        """Take the controllers that were built aside, once they are ready; the robots go on at their velocities."""
        if self._build is None or self._build.is_alive():
            return
        runs, self._note, self._build = self._build.runs, self._build.fault, None
        if runs is None:
            return
        self._take(runs)
        if self._restarts:
            self._restarts = False
            self._restart()
        self.view.scene = self.controller.scene

    def _take(self, runs: Runs) -> None:
        loops_now, self.loops = self.loops, []
        self.config, self._q0 = runs.config, runs.q0
        for number, controller in enumerate(runs.controllers):
            for name, obstacle in self._added.items():
                place = self._obstacles[name].sample if name in self._obstacles else obstacle.motion.sample(0.0)
                controller.add_obstacle(Obstacle.at(name, obstacle.shape, place.position, place.rotation))
            if number < len(loops_now):
                loops_now[number].swap(controller)
                self.loops.append(loops_now[number])
            else:
                self.loops.append(Loop(controller, loops_now[0].q if loops_now else self._q0, runs.config))
                controller.reset(loops_now[0].v if loops_now else None)
                self.loops[number].tick = loops_now[0].tick if loops_now else None


def _controls(config: ScenarioConfig, own: str | None, beside: str, obstacles: Sequence[str]) -> dict[str, Any]:
    """Return choices and values of the controls of a scenario's page; `own` names the law of a file, if that runs."""
    solver, row = own or config.solver.label, config.avoidance.row.type
    solvers = tuple(dict.fromkeys([solver, *SOLVERS]))
    return {
        "hint": _HINT.format(f"the {obstacles[0]}" if obstacles else "an obstacle, added below,"),
        "speeds": SPEEDS,
        "solvers": solvers,
        "solver": solver,
        "besides": (ALONE, *dict.fromkeys([*solvers, *(() if beside == ALONE else (beside,))])),
        "beside": beside,
        "rows": ROWS,
        "row": row,
        "d1": config.avoidance.d1,
        "d2": config.avoidance.d2,
        "weights": [(task.label, task.weight) for task in config.tasks],
        "shapes": SHAPES,
        "look back": LOOK_BACK,
    }
