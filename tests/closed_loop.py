"""What the tests of safety share: a Cartesian robot, loops with perfect execution, distances measured independently."""

import numpy as np
import pinocchio as pin
from conftest import place

from qpavoid import Avoidance, Controller, Limits, Robot, Sample, build_scene, build_tasks, load_scenario
from qpavoid.config import Progress, ScenarioConfig, Sensing, Task
from qpavoid.control.distances import DistanceQuery
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.planning.worker import ProcessWorker

SHIPPED = load_scenario("situation1").source
"""A place from which scenarios made here are taken to be read, so that robots are found by name."""


def cartesian(folder, axes="xyz", speed=1.0, acceleration=4.0, reach=5.0, shape=None):
    """A tool on prismatic joints along the world's axes: q is where it is; acceleration None for no limit."""
    parts, last = ['<link name="base"/>'], "base"
    for axis in axes:
        direction = " ".join("1" if axis == a else "0" for a in "xyz")
        parts.append(
            f'<link name="{axis}"/><joint name="joint_{axis}" type="prismatic"><parent link="{last}"/>'
            f'<child link="{axis}"/><axis xyz="{direction}"/>'
            f'<limit lower="-{reach}" upper="{reach}" velocity="{speed}" effort="1"/></joint>'
        )
        last = axis
    path = folder / "cartesian.urdf"
    path.write_text(f'<robot name="cartesian">{"".join(parts)}</robot>')
    body = {"name": "tool", "frame": last, "shape": shape or {"type": "sphere", "radius": 0.05}}
    limits = {} if acceleration is None else {"acceleration": {f"joint_{axis}": acceleration for axis in axes}}
    return Robot.from_urdf(path, bodies=[body], limits=limits)


def planar(folder, home=(0.3, 0.5, 0.4)):
    """An arm of links of 0.4, 0.4 and 0.3 m in a plane, with the tool `tip`."""
    parts = ['<link name="l0"/>']
    for i, x in enumerate((0.0, 0.4, 0.4)):
        parts.append(
            f'<link name="l{i + 1}"/><joint name="j{i + 1}" type="revolute"><parent link="l{i}"/>'
            f'<child link="l{i + 1}"/><origin xyz="{x} 0 0"/><axis xyz="0 0 1"/>'
            '<limit lower="-6" upper="6" velocity="2" effort="1"/></joint>'
        )
    parts.append(
        '<link name="tip"/><joint name="end" type="fixed"><parent link="l3"/><child link="tip"/>'
        '<origin xyz="0.3 0 0"/></joint>'
    )
    path = folder / "planar.urdf"
    path.write_text(f'<robot name="planar">{"".join(parts)}</robot>')
    return Robot.from_urdf(path, bodies=[], home=dict(zip(("j1", "j2", "j3"), home, strict=True)))


def make_controller(robot, obstacles=(), frame=None, solver="qp", dt=0.01, **fields):
    """A controller with one position task for `frame`, if one is named, and avoidance from 0.02 to 0.1 m."""
    task = {"gain": 2.0, **fields.pop("task", {})}
    tasks = build_tasks([Task(frame=frame, **task)], robot, robot.home) if frame else []
    fields.setdefault("avoidance", Avoidance(d1=0.02, d2=0.10))
    return Controller(build_scene(robot, list(obstacles)), tasks, solver, dt, **fields)


def scenario(robot, motion, obstacles=(), frame=None, **fields):
    """A scenario with one task."""
    task = {"frame": frame or "panda_hand_tcp", "motion": motion, **fields.pop("task", {})}
    return ScenarioConfig.model_validate(
        {"robot": robot, "tasks": [task], "obstacles": list(obstacles), "duration": 3.0, **fields}
    ).with_source(SHIPPED)


def changed(name, **fields):
    """A shipped scenario with other fields."""
    base = load_scenario(name)
    return ScenarioConfig.model_validate({**base.model_dump(mode="json"), **fields}).with_source(base.source)


def drive(controller, q, ticks, *, target=None, obstacles=None, start=0, hold=None):
    """Ticks of a loop that follows every velocity exactly.

    Args:
        controller: of one task at most.
        q: start.
        ticks: how many.
        target: t -> position, or a position.
        obstacles: t -> what is given of them.
        start: number of the first tick.
        hold: k -> time for which the velocity of that tick is held, in place of dt.
    """
    model, dt = controller.scene.robot.model, controller.dt
    t = start * dt
    for k in range(start, start + ticks):
        targets = None
        if target is not None:
            place = target(t) if callable(target) else target
            targets = {controller.tasks[0].settings.frame: Sample.at(place)}
        tick = controller.tick(q, t, targets, obstacles(t) if obstacles else None)
        yield tick
        held = dt if hold is None else hold(k)
        q = pin.integrate(model, q, tick.solution.v * held)
        t += held


ROWS = {
    "beta": {"type": "beta"},
    "damper": {"type": "beta", "near_speed": 10.0},
    "task-switching": {"type": "task-switching"},
}
"""Forms of rows as scenarios give them."""


def through_an_obstacle(shape, row, dt, duration, speed=2.0, **fields):
    """A target that leaves the Panda's tool at some speed and leads through a body 20 mm from which it has to stay."""
    return scenario(
        "panda-capsules",
        {"type": "line", "displacement": [0.4, 0.05, -0.1], "speed": speed},
        [{"name": "it", "shape": shape, "motion": {"type": "fixed", "position": [0.55, 0.0, 0.45]}}],
        avoidance={"d1": 0.02, "d2": 0.10, **row},
        dt=dt,
        duration=duration,
        **fields,
    )


class Ruler:
    """Distances of all pairs of a scene, with memory of its own."""

    def __init__(self, scene):
        self.scene, self.model = scene, scene.robot.model
        self.kinematics, self.query = ForwardKinematics(self.model), DistanceQuery(scene)

    def distances(self, q, samples=None):
        """(m,) at q, infinite beyond 10 m, with obstacles by number at `samples`."""
        if samples:
            place(self.query, self.scene, samples)
        self.kinematics.compute(q)
        self.query.compute(self.kinematics.joint_poses, 10.0)
        return self.query.distances_of(np.arange(len(self.scene.pairs))).copy()

    def least_between(self, q, v, dt, t, steps=10):
        """Least distance on the way from q at v for dt, obstacles on their motions from t on."""
        moving = [(i, o.motion) for i, o in enumerate(self.scene.obstacles) if o.moves]
        return min(
            self.distances(pin.integrate(self.model, q, v * s), {i: m.sample(t + s) for i, m in moving}).min()
            for s in np.linspace(0.0, dt, steps + 1)[1:]
        )


def accelerations(vs, dt, before=None):
    """|dv|/dt of every tick (N, nv), from standstill on or from `before`."""
    vs = np.asarray(vs)
    first = np.zeros(vs.shape[1]) if before is None else before
    return np.abs(np.diff(vs, axis=0, prepend=first[None])) / dt


class Awaited(ProcessWorker):
    """A process that plans, whose answers a step waits for."""

    is_asked = False

    def ask(self, question):
        super().ask(question)
        self.is_asked = True

    def has_answer(self):
        return self.is_asked or super().has_answer()

    def poll(self):
        answer = None
        while self.is_asked and answer is None and self.process.poll() is None:
            answer = super().poll()
        self.is_asked = False
        return answer or super().poll()


__all__ = [
    "ROWS", "SHIPPED", "Awaited", "Limits", "Progress", "Ruler", "Sensing", "accelerations", "cartesian", "changed",
    "drive", "make_controller", "planar", "scenario", "through_an_obstacle",
]  # fmt: skip
