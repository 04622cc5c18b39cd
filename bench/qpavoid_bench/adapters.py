"""`qpavoid bench adapters`: what each adapter adds to a control step, and how much of that is conversion."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import typer

from qpavoid import Avoidance, Controller, Obstacle, Robot, Sample, build_scene, build_tasks
from qpavoid.config import Sphere, Task
from qpavoid_bench.tables import RESULTS, describe_machine, table, write

_WARM_UP = 50
"""Steps before those that are timed [-]."""
_DT, _TOOL, _PLACE = 0.01, "panda_hand_tcp", [0.5, 0.0, 0.45]
_SCENARIO = """
robot: panda
dt: 0.01
duration: 1.0
tasks: [{type: posture}]
avoidance: {d1: 0.03, d2: 0.15}
obstacles:
- {name: ball, source: external, shape: {type: sphere, radius: 0.06}, motion: {type: fixed, position: [0.5, 0.0, 0.45]}}
"""


def adapters(
    steps: Annotated[int, typer.Option(min=10, help="Steps of each adapter that are timed.")] = 2_000,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = RESULTS,
) -> None:
    """Time the adapters of Pink, mink, roboplan, MuJoCo, LeRobot and ROS 2, a Panda beside a ball."""
    print(write(out, "adapters", _sections(steps)))


class _Timed:
    """A controller that adds up the time that its own calls take."""

    def __init__(self, controller: Controller) -> None:
        self.controller, self.seconds = controller, 0.0

    def __getattr__(self, name: str) -> Any:
        value = getattr(self.controller, name)
        if name not in ("step", "filter", "rows", "command"):
            return value

        def call(*arguments: Any, **named: Any) -> Any:
            begin = perf_counter()
            answer = value(*arguments, **named)
            self.seconds += perf_counter() - begin
            return answer

        self.__dict__[name] = call
        return call


class _Case:
    """What is timed of an adapter: a step of it, and the conversions in that alone."""

    def __init__(self, name: str, plug: Any, step: Callable[[int], Any], convert: Callable[[int], Any]) -> None:
        plug.controller = self.timed = _Timed(plug.controller)
        self.name, self.step, self.convert = name, step, convert

    def row(self, steps: int) -> list[str]:
        """Return the medians of what the adapter adds, of the conversions, and of the difference [µs]."""
        added, converted = list[float](), list[float]()
        for k in range(_WARM_UP + steps):
            _ball(k)  # is the program's own, and remembered
            self.timed.seconds, begin = 0.0, perf_counter()
            self.step(k)
            middle = perf_counter()
            self.convert(k)
            converted.append(perf_counter() - middle)
            added.append(middle - begin - self.timed.seconds)
        whole, part = (1e6 * float(np.median(times[_WARM_UP:])) for times in (added, converted))
        return [self.name, f"{whole:.1f}", f"{part:.1f}", f"{max(whole - part, 0.0):.1f}"]


def _sections(steps: int) -> Iterator[str]:
    yield "# Adapters"
    yield (
        f"Medians of {steps} steps of each, without the time of the controller's own call in them; a Panda beside a "
        f"ball that goes up and down. "
        f"{describe_machine('qpavoid', 'numpy', 'pin-pink', 'mink', 'roboplan', 'mujoco')}; "
        f"load of the machine: {os.getloadavg()[0]:.1f}."
    )
    robot = Robot.load("panda")
    rows = [case.row(steps) for make in _MAKERS for case in make(robot)]
    yield table(["a step of", "adds [µs]", "of which conversion [µs]", "the rest [µs]"], rows)
    yield (
        "Conversion: configurations, velocities, rows and poses from the form and order of the other program, and "
        "back. The rest is what the adapter decides and remembers."
    )


@cache
def _ball(k: int) -> Sample:
    t = k * _DT
    return Sample.at([0.5, 0.0, 0.45 + 0.1 * np.sin(t)], linear=[0.0, 0.0, 0.1 * np.cos(t)])


def _controller(robot: Robot, tasks: bool = False, dt: float = _DT) -> Controller:
    scene = build_scene(robot, [Obstacle.at("ball", Sphere(radius=0.06), _PLACE)])
    own = build_tasks([Task(frame=_TOOL)], robot, robot.home) if tasks else []
    return Controller(scene, own, dt=dt, avoidance=Avoidance(d1=0.03, d2=0.15))


def _bare(robot: Robot) -> str:
    """Return the URDF of a robot without its shapes."""
    return re.sub(r"(?s)<(visual|collision)\b.*?</\1>", "", robot.urdf.read_text(encoding="utf-8"))


def _of_velocities(name: str, safe: Any, q: Any, limit: Any = None) -> Iterator[_Case]:
    """Yield the cases of a velocity filter and of a limit, of a program with the configuration q."""
    v, joints = 0.1 * np.ones(safe.joints.nv), safe.joints

    def convert(k: int) -> None:
        joints.q(q)
        joints.merged(joints.v(v), v)

    yield _Case(f"{name}: `velocity_filter`", safe, lambda k: safe(q, v, k * _DT, {"ball": _ball(k)}), convert)
    if limit is None:
        return

    def begin_and_end(k: int) -> None:
        limit.t, limit.obstacles = k * _DT, {"ball": _ball(k)}
        limit.inequalities(q, _DT)
        limit.command(v)

    problem = _controller(limit.controller.scene.robot).rows(limit.controller.scene.robot.home)

    def convert_rows(k: int) -> None:
        limit.as_inequalities(problem)
        convert(k)

    yield _Case(f"{name}: rows as a limit, {len(problem.avoidance.b)} pairs near", limit, begin_and_end, convert_rows)


def _pink(robot: Robot) -> Iterator[_Case]:
    import pink
    import pinocchio as pin

    from qpavoid.adapters.pink import AvoidanceLimit, velocity_filter

    model = pin.buildModelFromUrdf(str(robot.urdf))
    there = pink.Configuration(model, model.createData(), np.append(robot.home, [0.02, 0.02]))
    safe, limit = (make(_controller(robot), there) for make in (velocity_filter, AvoidanceLimit))
    yield from _of_velocities("Pink", safe, there.q, limit)


def _mink(robot: Robot) -> Iterator[_Case]:
    import mink
    import mujoco

    from qpavoid.adapters.mink import AvoidanceLimit, velocity_filter

    there = mink.Configuration(mujoco.MjModel.from_xml_string(_bare(robot)), np.append(robot.home, [0.02, 0.02]))
    safe, limit = (make(_controller(robot), there) for make in (velocity_filter, AvoidanceLimit))
    yield from _of_velocities("mink", safe, there.q, limit)


def _roboplan(robot: Robot) -> Iterator[_Case]:
    from roboplan import core

    from qpavoid.adapters.roboplan import velocity_filter

    scene = core.Scene("panda", core.loadUrdfSceneDescriptionFromXml(_bare(robot)))
    q = scene.getCurrentJointPositions()
    q[scene.getJointPositionIndices(robot.joint_names)] = robot.home
    yield from _of_velocities("roboplan", velocity_filter(_controller(robot), scene), q)


def _mujoco(robot: Robot) -> Iterator[_Case]:
    import mujoco

    from qpavoid.adapters.mujoco import MujocoRobot

    spec = mujoco.MjSpec.from_string(_bare(robot))
    for name in robot.joint_names:
        spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_position(kp=500.0, kv=50.0)
    ball = spec.worldbody.add_body(name="ball", mocap=True, pos=_PLACE)
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.06, 0.0, 0.0])
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:7] = robot.home
    mujoco.mj_forward(model, data)
    plug = MujocoRobot(_controller(robot, tasks=True), model, ["ball"])
    target, v = {_TOOL: [0.35, 0.1, 0.5]}, np.zeros(7)

    def step(k: int) -> None:
        data.time = k * _DT
        plug.step(data, target)

    def convert(k: int) -> None:
        plug.q(data)
        plug.obstacles(data)
        plug.command(data, v)

    yield _Case("MuJoCo: `MujocoRobot`", plug, step, convert)


def _actions(robot: Robot) -> Iterator[_Case]:
    from qpavoid.adapters.actions import ActionFilter

    safe = ActionFilter(_controller(robot, dt=1.0 / 30.0))

    actions = list(robot.home + 0.2 * np.sin(0.03 * np.arange(1000))[:, None])
    count = len(actions)
    yield _Case(
        "positions of a policy: `ActionFilter`", safe,
        lambda k: safe(robot.home, actions[k % count], k / 30.0, {"ball": _ball(k)}), lambda k: None,
    )  # fmt: skip


def _lerobot(robot: Robot) -> Iterator[_Case]:
    from lerobot.processor import TransitionKey, create_transition

    from qpavoid.adapters.lerobot import SafetyFilterStep

    with TemporaryDirectory() as folder:
        path = Path(folder) / "scene.yaml"
        path.write_text(_SCENARIO, encoding="utf-8")
        made = SafetyFilterStep(str(path))
    values = {f"{name}.pos": float(np.degrees(a)) for name, a in zip(robot.joint_names, robot.home, strict=True)}
    transition, units = create_transition(observation=values, action=values), np.full(7, np.pi / 180.0)

    def step(k: int) -> None:
        made.obstacles.put("ball", _ball(k))
        made(transition)[TransitionKey.ACTION]

    def convert(k: int) -> None:
        _ball(k)
        for _ in ("action", "observation"):
            read = np.array([float(values[key]) for key in values]) * units
        {**values, **dict(zip(values, (read / units).tolist(), strict=True))}

    yield _Case("LeRobot: its pipeline's step, `ActionFilter` included", made.filter, step, convert)


def _ros(robot: Robot) -> Iterator[_Case]:
    from qpavoid.adapters.ros2 import NodeLogic

    with TemporaryDirectory() as folder:
        path = Path(folder) / "scene.yaml"
        path.write_text(_SCENARIO, encoding="utf-8")
        node = NodeLogic(str(path))
    q, v = robot.home.tolist(), [0.1] * 7

    def convert(k: int) -> None:
        t = k * _DT
        node.joint_state(robot.joint_names, q, t)
        node.obstacle("ball", _ball(k).position.tolist(), (0.0, 0.0, 0.0, 1.0), t)
        node.desired(robot.joint_names, v, t)

    def step(k: int) -> None:
        convert(k)
        node.step(k * _DT)

    yield _Case("ROS 2: `NodeLogic`, with a joint state, an obstacle and a command", node, step, convert)


def _needing(module: str, make: Callable[[Robot], Iterator[_Case]]) -> Callable[[Robot], Iterator[_Case]]:
    """Return a maker of no cases where a package is missing, and of those of `make` otherwise."""
    return lambda robot: make(robot) if find_spec(module) is not None else iter(())


_MAKERS = (
    _needing("pink", _pink), _needing("mink", _mink), _needing("roboplan", _roboplan), _needing("mujoco", _mujoco),
    _actions, _needing("lerobot", _lerobot), _ros,
)  # fmt: skip
