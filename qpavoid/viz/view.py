"""Live view of a control loop, in a browser; the loop never waits for it."""

from __future__ import annotations

import atexit
import importlib.util
import json
import os
import pickle
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Sequence
from operator import is_
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pinocchio as pin

import qpavoid
from qpavoid.control.tick import Tick
from qpavoid.errors import ConfigError
from qpavoid.model.robot import Robot
from qpavoid.model.sample import Pose
from qpavoid.model.scene import Obstacle, Scene
from qpavoid.problem import Array, IntArray
from qpavoid.run.recorder import describe_obstacle
from qpavoid.viz.meshes import EMPTY, of_geometry, of_obstacle
from qpavoid.viz.view_clock import PlayClock
from qpavoid.viz.view_link import (
    Frame,
    PageSetup,
    SlotChange,
    bodies_in_contact,
    frame_of,
    make_link,
    obstacles_of_pairs,
    pack,
    pack_change,
    received,
    send,
)
from qpavoid.viz.view_status import status_html

_BODY = (0.31, 0.63, 0.94, 0.35)
_STATUS_PERIOD = 6
"""Frames between two texts of the status, which the page draws no more often."""
_TIMED = 200
"""Control steps whose time is shown."""
_MAX_EVENTS = 1000
"""Events that wait for a loop that does not ask for them."""


class View:
    """Shows a robot and its obstacles on a page that a process of its own serves.

    Nothing is sent while no browser is connected, and at most `rate` times a second otherwise; where the page is slow
    or its process is dead, frames are dropped.
    """

    def __init__(
        self,
        scene: Scene,
        targets: Sequence[str] = (),
        *,
        title: str = "",
        port: int = 8080,
        host: str = "127.0.0.1",
        rate: float = 30.0,
        quality: str = "high",
    ) -> None:
        """Start the process; its page is ready after some seconds, and its address then printed on stderr.

        Args:
            scene: robot and obstacles; see `Controller.scene`.
            targets: names of the tasks that follow frames, in their order, where the page may drag their targets.
            title: shown above the controls.
            port: of the page; the next free one if it is taken; 0: any.
            host: address that the page is served on; by default only this machine can see it.
            rate: frames a second, at most.
            quality: `low` for browsers without a graphics processor.

        Raises:
            ConfigError: viser is not installed, or the system has no local sockets.
        """
        setup = page_setup(scene.robot, [], [(name, True) for name in targets], title)
        setup.port, setup.host, setup.rate, setup.quality = port, host, rate, quality
        self._start(setup, scene)

    @classmethod
    def of_setup(cls, setup: PageSetup, scene: Scene | None = None) -> View:
        """Start a view of a setup, and of a scene whose obstacles may come and go."""
        view = cls.__new__(cls)
        view._start(setup, scene)
        return view

    def _start(self, setup: PageSetup, scene: Scene | None) -> None:
        self.camera, self.look_at = setup.camera
        """Where the page is looked at from at first, and the point in its middle (3,) [m]."""
        self.scene = scene
        """Robot and obstacles that are shown; that of another controller of the same robot may take its place."""
        self._shown = 0
        self._numbered: Scene | None = None  # whose obstacles have these numbers
        self._obstacle_of_pair: IntArray = np.zeros(0, np.intp)
        self._slots: list[Obstacle] = []  # as the page knows them
        self._changes: deque[bytes] = deque()
        self._step_times: deque[float] = deque(maxlen=_TIMED)
        if scene is not None:
            self._notice_obstacles(scene)  # their meshes take milliseconds each: not in the loop
        for module in ("viser", "trimesh"):
            if importlib.util.find_spec(module) is None:
                raise ConfigError(f"the live view needs {module}: pip install 'qpavoid[view]'")
        self.url = ""
        """Address of the page, once it is ready."""
        self.clients = 0
        """Number of browsers that show it."""
        self.dragged_targets: dict[str, Pose] = {}
        """Where targets were dragged on the page, by name: for `Controller.step`."""
        self.dragged_obstacles: dict[str, Pose] = {}
        """Where obstacles were dragged on the page, by name."""
        self.fault = ""
        """Why the page could not be made, if so."""
        self._period, self._next, self._events = 1.0 / setup.rate, 0.0, deque[dict[str, Any]](maxlen=_MAX_EVENTS)
        setup.parent = os.getpid()
        descriptor, self._file = tempfile.mkstemp(suffix=".qpavoid-view")
        with open(descriptor, "wb") as file:
            pickle.dump(setup, file)
        self._link, other = make_link()
        path = os.pathsep.join(filter(None, (str(Path(qpavoid.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
        command = [sys.executable, "-m", "qpavoid.viz.view_window", str(other.fileno()), self._file]
        self._process = subprocess.Popen(
            command, pass_fds=[other.fileno()], stdin=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": path}
        )
        other.close()
        atexit.register(self.close)

    @property
    def pid(self) -> int:
        """Return the number of its process."""
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """Return whether its process runs."""
        return self._process.poll() is None

    def update(self, tick: Tick, note: str = "") -> None:
        """Show a control step, unless the last one was shown a moment ago; it never waits (`qpavoid bench endurance`).

        Args:
            tick: what `Controller.tick` gave.
            note: more to say in the status.
        """
        self.count_time(tick)
        if self.is_due():
            self._shown += 1
            self.show(self.frame(tick, note, has_status=self._shown % _STATUS_PERIOD == 1))

    def count_time(self, tick: Tick) -> None:
        """Take the time that a control step took into the status."""
        self._step_times.append(tick.solution.build_time + tick.solution.solve_time)

    def frame(self, tick: Tick, note: str = "", has_status: bool = True) -> Frame:
        """Return what is shown of a control step; see `update`."""
        assert self.scene is not None
        if self._numbered is not self.scene:
            self._numbered, self._obstacle_of_pair = self.scene, obstacles_of_pairs(self.scene)
        text = status_html(tick, self._step_times, note) if has_status else ""
        frame = frame_of(tick, self.scene.robot, self._obstacle_of_pair, text)
        return frame._replace(
            touching=bodies_in_contact(self.scene, tick.proximity.pair, tick.proximity.distance)
        )  # fmt: skip

    def is_due(self) -> bool:
        """Return whether a browser is connected, and the last frame was shown long enough ago."""
        now = perf_counter()
        if now < self._next:
            return False
        self._next = now + self._period
        self._receive()
        return self.clients > 0

    def show(self, frame: Frame) -> None:
        """Send a frame, whenever the last one was sent; first obstacles that have come or gone."""
        if self.scene is not None:
            self._notice_obstacles(self.scene)
        while self._changes and send(self._link, self._changes[0]):
            self._changes.popleft()
        send(self._link, pack(frame))

    def _notice_obstacles(self, scene: Scene) -> None:
        known, slots = self._slots, scene.slots
        if len(known) == len(slots) and all(map(is_, known, slots)):
            return
        for index in range(max(len(known), len(slots))):
            new = slots[index] if index < len(slots) else None
            old = known[index] if index < len(known) else None
            if new is None or not new.name:
                if old is not None and old.name:
                    self._changes.append(pack_change(SlotChange(index, "", EMPTY)))
            elif old is None or (old.name, old.shape) != (new.name, new.shape):
                mesh = of_obstacle(describe_obstacle(scene, index), index)
                self._changes.append(pack_change(SlotChange(index, new.name, mesh)))
        self._slots = list(slots)

    def events(self) -> list[dict[str, Any]]:
        """Return what was done on the page since the last call: its `type`, and what belongs to it."""
        self._receive()
        events = list(self._events)
        self._events.clear()
        return events

    def _receive(self) -> None:
        for datagram in received(self._link):
            event = json.loads(datagram)
            match event["type"]:
                case "ready":
                    self.url = event["url"]
                case "clients":
                    self.clients = event["count"]
                case "failed":
                    self.fault = event["reason"]
                case "target":
                    self.dragged_targets[event["name"]] = pose_of(event)
                    self._events.append(event)
                case "obstacle":
                    self.dragged_obstacles[event["name"]] = pose_of(event)
                    self._events.append(event)
                case _:
                    self._events.append(event)

    def close(self) -> None:
        """End the process."""
        atexit.unregister(self.close)
        self._process.terminate()
        try:
            self._process.wait(3.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._link.close()
        self.clients = 0
        Path(self._file).unlink(missing_ok=True)

    def __enter__(self) -> View:
        """Return the view itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()


def run_page(
    view: View,
    clock: PlayClock,
    apply: Callable[[dict[str, Any]], None],
    advance: Callable[[], None],
    is_done: Callable[[], bool],
) -> None:
    """Run what a page shows until `is_done`, the page fails, or the keyboard interrupts, and close the view.

    Args:
        view: of the page.
        clock: begins to play at the first browser.
        apply: does what an event of the page asks for.
        advance: takes a step if one is due, and shows it.
        is_done: whether to end.
    """
    has_begun = False
    try:
        while not is_done() and view.is_alive:
            for event in view.events():
                apply(event)
            if view.clients and not has_begun:
                has_begun = True
                clock.play()
            advance()
    except KeyboardInterrupt:
        pass
    finally:
        view.close()


def pose_of(event: dict[str, Any]) -> Pose:
    """Return the pose to which an event of the page drags something."""
    return Pose.at(event["position"], np.array(event["rotation"]))


def page_setup(
    robot: Robot,
    obstacles: Sequence[dict[str, Any]],
    targets: Sequence[tuple[str, bool]],
    title: str,
    q: Array | None = None,
    planned: Sequence[Array] = (),
    nearby: Array | None = None,
) -> PageSetup:
    """Return the setup of a page.

    Args:
        robot: the robot.
        obstacles: those that never change, as `describe_obstacle` gives them.
        targets: names of the frame tasks, and whether their targets may be turned.
        title: shown above the controls.
        q: configuration (nq,) in which the camera sees the whole robot; the home pose if left out.
        planned: paths (n, 3) of the tools [m].
        nearby: points (n, 3) that the camera sees as well, if they are not far away [m].
    """
    meshes = [of_obstacle(described, i) for i, described in enumerate(obstacles)]
    return PageSetup(
        title=title or robot.name,
        model=robot.model,
        urdf=robot.urdf,
        package_dirs=robot.package_dirs,
        bodies=[
            (body.parentJoint, body.placement, of_geometry(body.geometry, _BODY))
            for body in robot.bodies.geometryObjects
        ],
        obstacles=[(described["name"], mesh) for described, mesh in zip(obstacles, meshes, strict=True)],
        targets=list(targets),
        camera=_camera(robot, robot.home if q is None else q, planned, nearby),
        planned=list(planned),
        joint_names=robot.coordinate_names,
        speed_limits=np.array(robot.bounds().velocity),
    )


_FAR = 1.5
"""Distance from the robot from which on an obstacle is not looked at [m]."""


def _camera(robot: Robot, q: Array, planned: Sequence[Array], nearby: Array | None) -> tuple[Array, Array]:
    """Return where to look at a robot and its paths from, and the point in the middle of the picture (3,) [m]."""
    model, data = robot.model, robot.model.createData()
    pin.forwardKinematics(model, data, q)
    points = [data.oMi[body.parentJoint].act(body.placement.translation) for body in robot.bodies.geometryObjects] or [
        np.zeros(3)
    ]
    points += [point for path in planned for point in path]
    middle = np.mean(points, axis=0)
    points += [point for point in (() if nearby is None else nearby) if np.linalg.norm(point - middle) < _FAR]
    lower, upper = np.min(points, axis=0), np.max(points, axis=0)
    size = max(float(np.linalg.norm(upper - lower)), 0.3)
    look_at = 0.5 * (lower + upper)
    return look_at + 1.25 * size * np.array([0.80, -0.53, 0.35]), look_at
