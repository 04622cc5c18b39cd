"""The embeddable tick: what it accepts, and that bad input is named and leaves it usable."""

import subprocess
import sys

import numpy as np
import pytest

from qpavoid import (
    Avoidance,
    ConfigError,
    Controller,
    Obstacle,
    Pose,
    Sample,
    Solution,
    Solver,
    Status,
    UnknownName,
    build_scene,
    build_tasks,
    kernels,
)
from qpavoid.config import Sphere, Task


@pytest.fixture
def make(panda):
    """Makes a controller of a Panda and a ball."""

    def make():
        scene = build_scene(panda, [Obstacle.at("ball", Sphere(radius=0.05), [0.6, 0.0, 0.5])])
        tasks = build_tasks([Task(frame="panda_hand_tcp")], panda, panda.home)
        return Controller(scene, tasks, "qp", dt=0.01, avoidance=Avoidance(d1=0.03, d2=0.2))

    return make


@pytest.fixture
def controller(make):
    return make()


@pytest.mark.parametrize("dt", [0.0, -0.01, 10.0, np.nan])
def test_controller_refuses_a_period_that_is_none(panda, dt):
    with pytest.raises(ConfigError, match=r"dt: .* in seconds"):
        Controller(build_scene(panda, []), [], "qp", dt=dt)


def test_step_names_the_nearest_of_an_unknown_name(controller, panda):
    with pytest.raises(UnknownName, match=r"no target 'panda_hand'; did you mean 'panda_hand_tcp'"):
        controller.step(panda.home, targets={"panda_hand": Sample.at([0, 0, 0])})
    with pytest.raises(UnknownName, match=r"no obstacle 'bal'; did you mean 'ball'"):
        controller.step(panda.home, obstacles={"bal": Sample.at([0, 0, 0])})


def test_targets_replace_the_motion(controller, panda):
    here = controller.tick(panda.home).kinematics.position[0]
    solution = controller.step(panda.home, targets={"panda_hand_tcp": Sample.at(here + np.array([0.0, 0.0, 0.05]))})
    assert solution.status is Status.SOLVED
    assert np.abs(solution.v).max() > 1e-2
    controller.reset()
    bare = controller.step(panda.home, targets={"panda_hand_tcp": Pose.at(here + np.array([0.0, 0.0, 0.05]))})
    np.testing.assert_allclose(bare.v, solution.v, rtol=0, atol=1e-14)


def test_accelerations_count_from_the_last_command_and_at_first_from_the_measured_velocity(controller, panda):
    bound = panda.bounds().acceleration * controller.dt
    here = controller.tick(panda.home).kinematics.position[0]
    far = {"panda_hand_tcp": Sample.at(here + np.array([0.0, 0.4, 0.0]))}
    controller.reset()
    commands = [np.zeros(7), *(controller.step(panda.home, targets=far).v for _ in range(10))]
    changes = np.abs(np.diff(commands, axis=0))
    assert (changes <= bound + 1e-9).all() and np.isclose(changes, bound).any()
    measured = np.full(7, 0.3)
    v = controller.step(panda.home, targets=far, v=measured).v
    assert (np.abs(v - commands[-1]) <= bound + 1e-9).all() and (np.abs(v - measured) > bound + 1e-3).any()
    controller.reset()
    v = controller.step(panda.home, targets=far, v=measured).v
    assert (np.abs(v - measured) <= bound + 1e-9).all() and (np.abs(v - commands[1]) > bound + 1e-3).any()


def test_solver_may_be_exchanged(controller, panda):
    class Creep(Solver):
        bounded = False

        def solve(self, problem):
            return Solution(np.full(7, 0.01))

    before, controller.solver = controller.solver, Creep()
    assert isinstance(controller.solver, Creep)
    np.testing.assert_array_equal(controller.step(panda.home).v, 0.01)
    controller.solver = before
    assert not np.isclose(controller.step(panda.home).v, 0.01).any()


FIRST_USE = """
import sys
import numpy as np
import pinocchio as pin
from qpavoid import Controller, Robot, Sample, build_scene, build_tasks
from qpavoid.config import Task

robot = Robot.load("panda")
controller = Controller(build_scene(robot), build_tasks([Task(frame="panda_hand_tcp", type="pose")], robot, robot.home))

def loaded():
    modules = [module for name, module in sys.modules.items() if name.startswith("qpavoid")]
    kernels = {id(f): f for module in modules for f in vars(module).values() if hasattr(f, "signatures")}
    return {f.__name__: len(f.signatures) for f in kernels.values()}

before, q = loaded(), robot.home
for k in range(700):
    target = Sample.at([-0.1, 0.1, 0.3] if k < 120 else [1.5, 0.0, 0.3])
    solution = controller.step(q, targets={"panda_hand_tcp": target})
    q = pin.integrate(robot.model, q, 0.01 * solution.v)
assert solution.stalled, "a reason was to be named"
print(sorted(name for name, count in loaded().items() if count != before.get(name)))
"""
"""Runs a Panda without obstacles into itself, then beyond its reach; prints the kernels that steps had to load."""


def test_no_step_loads_a_kernel_of_a_scene_without_obstacles():
    run = subprocess.run([sys.executable, "-c", FIRST_USE], capture_output=True, text=True, check=True, timeout=300)
    assert run.stdout.strip() == "[]"


def test_controller_compiles_nothing_after_construction(controller, panda):
    def compiled():
        functions = {name: getattr(kernels, name) for name in kernels.__all__}
        return {name: len(f.signatures) for name, f in functions.items() if hasattr(f, "signatures")}

    assert controller.warm_up_time > 0.0
    before = compiled()
    assert before["leaves_position_limits"] and before["clearance_lower_bound"]  # of which not every tick has need
    for x in (2.0, 0.45, 0.40):  # out of range, in range, so near that the QP is needed
        controller.step(panda.home, obstacles={"ball": Sample.at([x, 0.0, 0.5], linear=[-0.3, 0.0, 0.0])})
        controller.filter(panda.home, np.full(7, 0.2), v=np.full(7, 0.1))
    assert len(before) > 8 and compiled() == before
