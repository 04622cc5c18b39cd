"""Obstacles given as one array, a row each: the same step as one by one; refused as these are; nothing loaded late."""

import gc
import subprocess
import sys

import numpy as np
import pinocchio as pin
import pytest

from qpavoid import (
    Avoidance,
    Controller,
    NumericalError,
    Obstacle,
    Pose,
    ReasonKind,
    Sample,
    UnknownName,
    build_scene,
    build_tasks,
)
from qpavoid.config import Box, Sphere, Task

NAMES = ("ball", "box", "post")


def make_controller(panda, spare=0, names=NAMES):
    shapes = (Sphere(radius=0.04), Box(size=(0.3, 0.1, 0.05)))
    obstacles = [
        Obstacle.at(name, shapes[i % 2], [0.6, 0.3 * i, 0.4], graspable=i == 2) for i, name in enumerate(names)
    ]
    tasks = build_tasks([Task(frame="panda_hand_tcp")], panda, panda.home)
    scene = build_scene(panda, obstacles, spare_obstacles=spare)
    return Controller(scene, tasks, dt=0.01, avoidance=Avoidance(d1=0.02, d2=0.3))


def states(rng, count, k):
    """(count, 18) samples at step k, and the same poses with quaternions (count, 7)."""
    samples, poses = np.zeros((count, 18)), np.zeros((count, 7))
    for i in range(count):
        R = pin.exp3(rng.normal(size=3))
        place = np.array([0.55, 0.4 * i - 0.3 - 0.01 * k, 0.45])
        samples[i] = Sample.at(place, R, rng.normal(size=3) * 0.1, rng.normal(size=3) * 0.1).row
        poses[i] = *place, *pin.Quaternion(R).coeffs()
    return samples, poses


def of_pose(row):
    return Pose.at(row[:3], pin.Quaternion(*row[[6, 3, 4, 5]]).toRotationMatrix())


@pytest.mark.parametrize("bare", [False, True])
def test_array_gives_the_step_of_its_rows(panda, bare):
    """In the order of `obstacle_names`, or of the names that are its key."""
    rng, controllers = np.random.default_rng(3), [make_controller(panda) for _ in range(3)]
    names = controllers[0].obstacle_names
    assert sorted(names) == sorted(NAMES) and list(names) == controllers[0].scene.obstacle_names
    for k in range(8):
        rows = states(rng, 3, k)[bare]
        one_by_one = {n: of_pose(row) if bare else Sample.of_row(row) for n, row in zip(names, rows, strict=True)}
        forms = one_by_one, rows, {names[::-1]: rows[::-1]}
        ticks = [c.tick(panda.home, 0.01 * k, obstacles=o) for c, o in zip(controllers, forms, strict=True)]
        for tick in ticks[1:]:
            np.testing.assert_allclose(tick.solution.v, ticks[0].solution.v, rtol=0, atol=1e-11)
            np.testing.assert_allclose(tick.obstacles, ticks[0].obstacles, rtol=0, atol=1e-14)
            assert sorted(tick.solution.assumptions) == sorted(ticks[0].solution.assumptions)


@pytest.mark.parametrize(
    "wrong",
    [np.zeros((3, 17)), np.zeros((2, 18)), np.zeros(18), np.zeros((3, 7), dtype=complex), "there", 5],
)
def test_array_of_the_wrong_shape_is_refused_and_changes_nothing(panda, wrong):
    rng, (one, other) = np.random.default_rng(1), (make_controller(panda) for _ in range(2))
    for k in range(2):
        rows, _ = states(rng, 3, k)
        for controller in (one, other):
            controller.step(panda.home, 0.01 * k, obstacles=rows)
        with pytest.raises(NumericalError, match=r"^obstacles: ") as error:
            one.step(panda.home, 0.01 * k + 0.005, obstacles=wrong)
        assert "\n" not in str(error.value)
    np.testing.assert_array_equal(one.step(panda.home).v, other.step(panda.home).v)


def test_arrays_of_unknown_or_repeated_names_are_refused(panda):
    controller, rows = make_controller(panda), np.zeros((2, 18))
    for names, kind in ((("ball", "bal"), UnknownName), (("ball", "ball"), NumericalError)):
        with pytest.raises(kind):
            controller.step(panda.home, obstacles={names: rows})
    with pytest.raises(NumericalError, match="an array among others"):
        controller.step(panda.home, obstacles={("ball", "box"): rows, "post": Sample.at([1, 0, 0])})


@pytest.mark.parametrize(
    ("columns", "column", "value", "words"),
    [
        (18, 9, np.nan, "NaN"),
        (18, 12, 1e4, "faster"),
        (18, 0, 3.0, "rotation"),
        (7, 0, np.inf, "NaN or infinity"),
        (7, 5, np.nan, "NaN"),
        (7, 1, 1e7, "farther"),
        (7, slice(3, 7), 0.0, "quaternion"),
        (7, 4, 2.0, "quaternion"),
    ],
)
def test_row_that_cannot_be_true_is_no_update_of_its_obstacle(panda, columns, column, value, words):
    """As a sample that cannot be: a reason names the obstacle, it goes on at its last twist, the others are updated."""
    rng, (one, other) = np.random.default_rng(5), (make_controller(panda) for _ in range(2))
    names = one.obstacle_names
    for k in range(4):
        rows = states(rng, 3, k)[columns == 7]
        last = k == 3
        without = {names[:1] + names[2:]: rows[[0, 2]]} if last else rows
        rows = rows.copy()
        if last:
            rows[1, column] = value
        ticks = [one.tick(panda.home, 0.01 * k, obstacles=rows), other.tick(panda.home, 0.01 * k, obstacles=without)]
    np.testing.assert_array_equal(ticks[0].obstacles, ticks[1].obstacles)
    np.testing.assert_array_equal(ticks[0].solution.v, ticks[1].solution.v)
    (reason,) = [r for r in ticks[0].solution.assumptions if r.kind is ReasonKind.IMPLAUSIBLE]
    assert reason.subject == names[1:2] and words in str(reason) and "\n" not in str(reason)


def test_quaternion_with_round_off_is_normalised(panda):
    rows = states(np.random.default_rng(2), 3, 0)[1]
    rows[1, 3:] *= 1.0 + 5e-4
    solution = make_controller(panda).step(panda.home, obstacles=rows)
    (reason,) = [r for r in solution.assumptions if r.kind is ReasonKind.NORMALISED]
    assert reason.amount == pytest.approx(5e-4, rel=1e-6)


def test_rows_follow_what_is_in_the_scene(panda):
    """One that is added gets a row, an attached one is ignored with a reason."""
    controller, rng = make_controller(panda, spare=1), np.random.default_rng(4)
    controller.step(panda.home, obstacles=states(rng, 3, 0)[0])
    controller.add_obstacle(Obstacle.at("late", Sphere(radius=0.03), [0.9, 0.0, 0.3]))
    names = controller.obstacle_names
    assert set(names) == {*NAMES, "late"}
    controller.attach("post", "panda_hand_tcp", panda.home)
    rows = states(rng, 4, 1)[0]
    tick = controller.tick(panda.home, obstacles=rows)
    assert [r.subject for r in tick.solution.assumptions if r.kind is ReasonKind.IGNORED] == [("post",)]
    np.testing.assert_allclose(controller.obstacle_pose("late").position, rows[names.index("late"), 9:12])
    controller.release("post", panda.home)
    controller.remove_obstacle("late")
    assert not controller.step(panda.home, obstacles=states(rng, 3, 2)[0]).assumptions


FIRST_USES = """
import sys
import numpy as np
from qpavoid import Controller, Obstacle, Pose, Robot, Sample, build_scene, build_tasks, load_scenario
from qpavoid.config import Sphere, Task

passing, q = Controller.from_scenario(load_scenario("panda_line"))
robot = Robot.load("panda")
scene = build_scene(robot, [Obstacle.at(f"o{i}", Sphere(radius=0.04), [1.5, 0.1 * i, 0.4]) for i in range(5)])
controller = Controller(scene, build_tasks([Task(frame="panda_hand_tcp")], robot, robot.home))

def loaded():
    modules = [module for name, module in sys.modules.items() if name.startswith("qpavoid")]
    kernels = {id(f): f for module in modules for f in vars(module).values() if hasattr(f, "signatures")}
    return {f.__name__: len(f.signatures) for f in kernels.values()}

before = loaded()
for k in range(5):
    passing.step(q, 0.01 * k)
sample = Sample.at([1.0, 0.0, 0.5], linear=[-0.5, 0.0, 0.0])
poses = np.tile([1.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0], (5, 1))
for form in (
    {"o1": Pose.at([1.0, 0.0, 0.5])}, {"o1": sample}, {"o1": Sample.at([1.0, 0.0, 0.5], t=0.035)},
    {"o1": [1.0, 0.0, 0.5], "o2": sample}, {"o1": Pose.at([1.0, 0.0, 0.5], at_rest=True)}, np.tile(sample.row, (5, 1)),
    poses, {("o1", "o2"): poses[:2]}, 0.9995 * poses, np.nan * poses, {"o1": Sample.at([0.55, 0.1, 0.5])}, None,
):
    for _ in range(3):
        controller.step(robot.home, obstacles=form)
print(sorted(name for name, count in loaded().items() if count != before.get(name)))
"""
"""Gives obstacles in all forms, near at the end; prints the kernels that steps had to load."""


def test_no_form_of_an_update_loads_a_kernel():
    run = subprocess.run([sys.executable, "-c", FIRST_USES], capture_output=True, text=True, check=True, timeout=900)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize("form", ["samples", "poses", "array", "quaternions"])
def test_updates_leave_nothing_for_the_garbage_collector(panda, form):
    names = tuple(f"o{i}" for i in range(50))
    controller = make_controller(panda, names=names)
    rows = np.array([Sample.at([2.0, 0.1 * i, 0.5], linear=[0.0, 0.1, 0.0]).row for i in range(50)])
    quaternions = np.hstack((rows[:, 9:12], np.tile([0.0, 0.0, 0.0, 1.0], (50, 1))))
    updates = {
        "samples": {name: Sample.of_row(row) for name, row in zip(names, rows, strict=True)},
        "poses": {name: Pose.at(row[9:12]) for name, row in zip(names, rows, strict=True)},
        "array": rows,
        "quaternions": quaternions,
    }[form]
    for k in range(5):
        controller.step(panda.home, 0.01 * k, obstacles=updates)
    gc.collect()
    before = [generation["collections"] for generation in gc.get_stats()]
    for k in range(5, 305):
        controller.step(panda.home, 0.01 * k, obstacles=updates)
    young, *old = [g["collections"] - count for g, count in zip(gc.get_stats(), before, strict=True)]
    assert young <= 1 and not any(old)  # 700 new containers each: 50 a step would be 21
