"""Workloads of qpavoid alone: closed loops with what the recorded ones lack.

Public names only, which another version of qpavoid has as well.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import (
    Avoidance,
    Controller,
    Obstacle,
    Points,
    Pose,
    Robot,
    Sample,
    ScenarioConfig,
    build_scene,
    build_tasks,
)
from qpavoid.config import Box, Cone, Cylinder, PointCloud, Task
from qpavoid_bench.tick.build import close_pairs
from qpavoid_bench.tick.robots import ROBOTS, ROBOTS_FOLDER
from qpavoid_bench.tick.workloads import Array

PANDA, TCP = ROBOTS["panda"], "panda_hand_tcp"
LAP = 10.0
"""Time after which everything in `circling` repeats [s]."""
DT = 0.01
_FAR = 50
_SHAPES: dict[str, dict[str, Any]] = {
    "sphere": {"radius": 0.05},
    "capsule": {"radius": 0.04, "length": 0.1},
    "box": {"size": [0.1, 0.08, 0.06]},
    "cylinder": {"radius": 0.05, "length": 0.1},
    "cone": {"radius": 0.05, "length": 0.1},
    "ellipsoid": {"radii": [0.05, 0.08, 0.03]},
}
_CLOUDS = (0, 1_000, 10_000, 100_000)


class Loop:
    """A closed loop: the command is integrated between the control steps."""

    def __init__(
        self,
        controller: Controller,
        q: Array,
        targets: Callable[[float], Any] = lambda t: None,
        obstacles: Any = None,
        every: int = 1,
    ) -> None:
        self.controller, self.q, self.steps = controller, q, 0
        self.lap = round(LAP / controller.dt)
        """Control steps after which everything in `circling` repeats."""
        self._targets, self._obstacles, self._every = targets, obstacles, every
        self._inputs = 0.0, targets(0.0), obstacles

    def step(self, q: Any, targets: Any) -> Array:
        """Compute the velocity of a control step from where the robot is; the arguments do not matter."""
        return self.controller.step(self.q, *self._inputs).v

    def tick(self) -> Any:
        """Take a control step, with everything that led to its velocity."""
        return self.controller.tick(self.q, *self._inputs)

    def advance(self, v: Array) -> None:
        """Integrate the command, and make the next step's target."""
        dt = self.controller.dt
        self.q = pin.integrate(self.controller.scene.robot.model, self.q, v * dt)
        self.steps += 1
        t = self.steps * dt
        self._inputs = t, self._targets(t), None if self.steps % self._every else self._obstacles


def loop_names() -> list[str]:
    """Return the names of all closed loops."""
    return [
        "far-50",
        *(f"far-50+{kind}{count}" for kind in ("move", "sample", "pose", "array") for count in (1, 10, 50)),
        *(f"shape-{shape}" for shape in _SHAPES),
        *(f"bodies-{kind}" for kind in ("capsule", "convex", "mesh")),
        *(f"bodies-{kind}+{count}" for kind in ("capsule", "convex") for count in (5, 50)),
        *(f"cloud-{count}" for count in _CLOUDS),
        *(f"circling{rate}{variant}" for rate in ("", "-500") for variant in ("", "+alone")),
    ]


def make_loop(name: str) -> Loop:
    """Return the closed loop of that name."""
    warnings.simplefilter("ignore")
    scenery, _, variant = name.partition("+")
    kind, _, detail = scenery.partition("-")
    if kind == "far":
        return _far(*re.fullmatch(r"([a-z]*)(\d*)", variant).groups())  # type: ignore[union-attr]
    if kind == "shape":
        return _from(_scenario(_scattered(detail), {"type": "fixed"}))
    if kind == "bodies":
        return _bodies(detail, int(variant or 0))
    if kind == "cloud":
        return _cloud(int(detail))
    return _from(circling(1.0 / float(detail) if detail else DT, **({"backup": False} if variant else {})))


def circling(dt: float = DT, **avoidance: Any) -> ScenarioConfig:
    """Return a Panda's circle among 50 obstacles, 10 of which circle as well; all repeats after a LAP.

    Args:
        dt: control period [s].
        avoidance: fields of the block.
    """
    random, obstacles = np.random.default_rng(3), []
    for i in range(50):
        angle, distance, height = random.uniform(-np.pi, np.pi), random.uniform(0.45, 0.85), random.uniform(0.1, 0.9)
        size = random.uniform(0.03, 0.06)
        circle = {
            "type": "circle",
            "center": [distance * np.cos(angle), distance * np.sin(angle), height],
            "radius": random.uniform(0.05, 0.25),
            "normal": random.normal(size=3).tolist(),
            "start_direction": random.normal(size=3).tolist(),
            "period": LAP / int(random.integers(1, 3)),
        }
        shape = {"type": "box", "size": [2.0 * size, size, size]} if i % 2 else {"type": "sphere", "radius": size}
        motion = circle if i < 10 else {"type": "fixed", "position": circle["center"]}
        obstacles.append({"name": f"o{i}", "shape": shape, "motion": motion})
    tool = {"type": "circle", "radius": 0.12, "normal": [1, 0, 0], "start_direction": [0, 1, 0], "period": LAP}
    return _scenario(obstacles, tool, dt, d1=0.03, **avoidance)


def _scenario(
    obstacles: list[dict[str, Any]], tool: dict[str, Any], dt: float = DT, **avoidance: Any
) -> ScenarioConfig:
    return ScenarioConfig.model_validate(
        {
            "robot": "panda",
            "tasks": [{"frame": TCP, "type": "pose", "motion": tool}],
            "obstacles": obstacles,
            "avoidance": {"d1": 0.02, "d2": 0.10, **avoidance},
            "dt": dt,
            "duration": LAP,
        }
    )


def _from(scenario: ScenarioConfig, obstacles: Any = None) -> Loop:
    return Loop(*Controller.from_scenario(scenario), obstacles=obstacles)


def _far(kind: str, count: str) -> Loop:
    """Return a Panda that holds its tool still among spheres 2 m away; some of them move, or are given to `step`."""
    random, number, obstacles = np.random.default_rng(3), int(count or 0), []
    for i in range(_FAR):
        direction = random.normal(size=3)
        place = (2.0 * random.uniform(0.9, 1.1) * direction / np.linalg.norm(direction)).tolist()
        motion: dict[str, Any] = {"type": "fixed", "position": place}
        if kind == "move" and i < number:
            motion = {"type": "circle", "center": place, "radius": 0.1, "period": 10.0}
        obstacles.append({"name": f"o{i}", "shape": {"type": "sphere", "radius": 0.04}, "motion": motion})
    scenario = _scenario(obstacles, {"type": "fixed"})
    if kind in ("", "move"):
        return _from(scenario)
    update = Pose if kind == "pose" else Sample
    updates = {f"o{i}": update.at([2.0 + 0.1 * i, 0.0, 1.0]) for i in range(number)}
    rows = np.array([sample.row for sample in updates.values()])
    return _from(scenario, {tuple(updates): rows} if kind == "array" else updates)


def _scattered(shape: str) -> list[dict[str, Any]]:
    """Return 20 obstacles of one shape around the tool of a Panda in its home pose, 9 to 25 cm off its centre."""
    random, obstacles = np.random.default_rng(2), list[dict[str, Any]]()
    while len(obstacles) < 20:
        direction = random.normal(size=3)
        offset = random.uniform(0.2, 0.3) * direction / np.linalg.norm(direction)
        if offset[0] < 0.1:
            continue  # not into the arm
        motion = {"type": "fixed", "position": (np.array([0.4, 0.0, 0.5]) + offset).tolist()}
        obstacles.append({"name": f"o{len(obstacles)}", "shape": {"type": shape, **_SHAPES[shape]}, "motion": motion})
    return obstacles


def _swing(robot: Robot, obstacles: list[Obstacle], updates: Any = None, every: int = 1) -> Loop:
    """Return a robot that swings its tool about where it is at home."""
    tasks = build_tasks([Task(frame=TCP)], robot, robot.home)
    controller = Controller(build_scene(robot, obstacles), tasks, "qp", DT, Avoidance(d1=0.02, d2=0.10))
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.home)
    start = data.oMf[robot.model.getFrameId(TCP)].translation.copy()

    def targets(t: float) -> dict[str, Sample]:
        sway = np.array([0.1 * np.sin(t), 0.25 * np.sin(0.7 * t), 0.1 * np.sin(1.3 * t)])
        return {TCP: Sample.at(start + sway)}

    return Loop(controller, robot.home.copy(), targets, updates, every)


def _bodies(kind: str, count: int) -> Loop:
    """Return a Panda with capsules around its meshes, their hulls, or the triangle meshes, among some obstacles."""
    fields: dict[str, Any] = {
        "bodies": kind,
        "lock": {"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0},
        "home": PANDA.home,
    }
    robot = Robot.from_urdf(ROBOTS_FOLDER / PANDA.urdf, **fields)
    touching = close_pairs(robot, robot.home[None])
    return _swing(Robot.from_urdf(ROBOTS_FOLDER / PANDA.urdf, disabled_pairs=touching, **fields), _around(count))


def _around(count: int) -> list[Obstacle]:
    """Return cylinders, boxes and cones by turns in front of a Panda, 15 to 50 cm off where its tool swings."""
    random, obstacles = np.random.default_rng(4), list[Obstacle]()
    shapes = (Cylinder(radius=0.05, length=0.1), Box(size=(0.1, 0.08, 0.06)), Cone(radius=0.05, length=0.1))
    while len(obstacles) < count:
        direction = random.normal(size=3)
        offset = random.uniform(0.2, 0.5) * direction / np.linalg.norm(direction)
        if offset[0] < 0.1:
            continue  # not into the arm
        place, turned = np.array([0.45, 0.0, 0.5]) + offset, pin.exp3(random.uniform(-2.0, 2.0, 3))
        obstacles.append(Obstacle.at(f"o{len(obstacles)}", shapes[len(obstacles) % 3], place, turned))
    return obstacles


def _cloud(count: int) -> Loop:
    """Return a Panda that swings beside a shelf of points; a new picture of it comes in at every tenth step."""
    obstacles = [Obstacle.at("camera", PointCloud(), [0, 0, 0])] if count else []
    picture = {"camera": Points(_shelf(count))} if count else None
    return _swing(Robot.load("panda"), obstacles, picture, every=10)


def _shelf(count: int) -> Array:
    """Return points (count, 3) on the boards of a shelf in front of the robot [m]."""
    random = np.random.default_rng(1)
    boards = [([0.5, -0.6, z], [0.4, 0, 0], [0, 1.2, 0]) for z in (0.02, 0.3, 0.75, 1.1)]
    boards += [([0.5, y, 0.0], [0.4, 0, 0], [0, 0, 1.1]) for y in (-0.6, 0.6)]
    boards += [([0.9, -0.6, 0], [0, 1.2, 0], [0, 0, 1.1])]
    area = np.array([np.linalg.norm(np.cross(u, v)) for _, u, v in boards])
    chosen = random.choice(len(boards), count, p=area / area.sum())
    origin, u, v = (np.array([board[k] for board in boards])[chosen] for k in range(3))
    s, t = random.uniform(size=(2, count, 1))
    return np.asarray(origin + s * u + t * v + random.normal(0, 0.002, (count, 3)))
