"""A target or an obstacle is given as Sample, Pose, pin.SE3, 4×4 matrix or position: the same step."""

import numpy as np
import pinocchio as pin
import pytest

from qpavoid import (
    Avoidance,
    Controller,
    NumericalError,
    Obstacle,
    Points,
    Pose,
    ReasonKind,
    Sample,
    Status,
    build_scene,
    build_tasks,
)
from qpavoid.config import Box, ComTask, Fixed, LookAtTask, PointCloud, RelativeTask, Task

TCP = "panda_hand_tcp"


def tool_pose(panda, q):
    data = panda.model.createData()
    pin.framesForwardKinematics(panda.model, data, q)
    return data.oMf[panda.model.getFrameId(TCP)]


TURN = pin.rpy.rpyToMatrix(0.3, -0.2, 0.5)


def forms(position, rotation):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    pose = Pose(position, rotation)
    return [pose, pin.SE3(rotation, np.array(position)), matrix, matrix.tolist(), matrix.astype(np.float32)]


def controller_of(panda, *tasks):
    turned = Obstacle.at("box", Box(size=(0.3, 0.1, 0.05)), [0.45, 0.25, 0.45], TURN)
    scene = build_scene(panda, [turned, Obstacle.at("camera", PointCloud(), [0, 0, 0])])
    return Controller(scene, build_tasks(list(tasks), panda, panda.home), dt=0.01, avoidance=Avoidance(d1=0.02, d2=0.3))


def test_targets_in_all_forms_are_the_same(panda):
    tasks = (
        Task(frame=TCP, type="pose"),
        ComTask(weight=0.1),
        LookAtTask(frame="panda_link5", motion=Fixed(position=(1, 0, 1)), weight=0.1),
    )
    names, here = [TCP, "com", "look_at"], tool_pose(panda, panda.home)
    steps = []
    for form in range(5):
        targets = {
            name: forms(here.translation + shift, here.rotation @ TURN)[form]
            for name, shift in zip(names, ([0.02, 0.01, 0.0], [0.0, 0.1, 0.0], [0.3, 0.2, 0.4]), strict=True)
        }
        tick = controller_of(panda, *tasks).tick(panda.home, targets=targets)
        assert tick.solution.status is Status.SOLVED
        steps.append(tick.problem.tracking.b.copy())
    for b in steps[:4]:
        np.testing.assert_array_equal(b, steps[0])
    np.testing.assert_allclose(steps[4], steps[0], atol=1e-5)


def test_position_alone_leaves_the_orientation_of_the_target(panda):
    here = tool_pose(panda, panda.home)
    there, turned = here.translation + np.array([0.0, 0.05, 0.0]), here.rotation @ TURN
    for kind in ("position", "pose"):
        given, by_pose = (controller_of(panda, Task(frame=TCP, type=kind)) for _ in range(2))
        for position, rotation in ((there, here.rotation), (None, turned), (there, turned), (there.tolist(), turned)):
            target = Pose(here.translation, turned) if position is None else position
            one = given.tick(panda.home, targets={TCP: target})
            two = by_pose.tick(
                panda.home, targets={TCP: Pose(here.translation if position is None else there, rotation)}
            )
            np.testing.assert_array_equal(one.problem.tracking.b, two.problem.tracking.b)
        with pytest.raises(NumericalError):
            given.step(panda.home, targets={TCP: Pose(there, here.rotation)}, obstacles={"box": "there"})
        refused = given.tick(panda.home, targets={TCP: there}).problem.tracking.b  # it has changed nothing
        np.testing.assert_array_equal(refused, two.problem.tracking.b)
        given.reset()
        first = given.tick(panda.home, targets={TCP: there}).problem.tracking.b
        expected = by_pose.tick(panda.home, targets={TCP: Pose(there, here.rotation)}).problem.tracking.b
        np.testing.assert_array_equal(first, expected)


def test_position_where_only_the_orientation_counts_is_refused(panda):
    relative = RelativeTask(frame=TCP, relative_to="panda_link3", rows="orientation")
    controller = controller_of(panda, Task(frame=TCP, type="orientation"), relative)
    for name in (TCP, "relative"):
        with pytest.raises(NumericalError, match=f"^target '{name}': a position, but only the orientation counts"):
            controller.step(panda.home, targets={name: np.zeros(3)})


def test_obstacles_in_all_forms_are_the_same(panda):
    runs = []
    for form in range(4):
        controller, vs = controller_of(panda, Task(frame=TCP)), []
        for k in range(12):
            box = forms([0.45, 0.25 - 0.01 * k, 0.45], TURN @ pin.exp3(np.array([0.0, 0.0, 0.02 * k])))[form]
            tick = controller.tick(panda.home, 0.01 * k, obstacles={"box": box})
            vs.append(np.append(tick.solution.v, tick.proximity.feedforward.sum()))
            assert {reason.kind for reason in tick.solution.assumptions} == {ReasonKind.ESTIMATED}
        runs.append(np.array(vs))
    for vs in runs[1:]:
        np.testing.assert_array_equal(vs, runs[0])


def test_position_of_an_obstacle_leaves_its_orientation(panda):
    """That of the scene at first, then as it was given last; of the frame of a cloud, too."""
    given, by_pose = (controller_of(panda, Task(frame=TCP)) for _ in range(2))
    other, points = pin.rpy.rpyToMatrix(0.0, 0.9, 0.0), np.array([[0.5, 0.1, 0.3]])
    for k, (form, rotation) in enumerate(
        [(np.array, TURN), (list, TURN), (lambda p: Sample.at(p, other), other), (np.array, other), (tuple, other)]
    ):
        place = [0.45, 0.25 - 0.01 * k, 0.45]
        one = given.tick(panda.home, obstacles={"box": form(place), "camera": Points(points, [0.01 * k, 0, 0])})
        pose = (Sample.at if k == 2 else Pose.at)(place, rotation)
        two = by_pose.tick(panda.home, obstacles={"box": pose, "camera": Points(points, Pose.at([0.01 * k, 0, 0]))})
        np.testing.assert_array_equal(one.proximity.distance, two.proximity.distance)
        np.testing.assert_array_equal(one.solution.v, two.solution.v)
        np.testing.assert_array_equal(given.obstacle_pose("box").rotation, rotation)


def test_what_is_no_pose_is_refused_or_stops(panda):
    controller = controller_of(panda, Task(frame=TCP, type="pose"))
    transposed, mirrored, unknown = np.eye(4), np.diag([1.0, -1.0, 1.0, 1.0]), np.full((4, 4), np.nan)
    transposed[3, :3] = [0.4, 0.0, 0.5]
    for where, name in (({"targets": {TCP: None}}, TCP), ({"obstacles": {"box": None}}, "box")):
        ((argument, values),) = where.items()
        for wrong in (
            transposed,
            np.zeros(7),
            np.zeros((3, 4)),
            "there",
            None,
            1j * np.ones(3),
            {"x": 1},
            [[1], [2, 3]],
        ):
            with pytest.raises(NumericalError, match=f"'{name}': (neither|a 4x4)") as error:
                controller.step(panda.home, **{argument: {**values, name: wrong}})
            assert "\n" not in str(error.value)
        for wrong in (mirrored, unknown, 0.5 * np.diag([1.0, 1.0, 1.0, 2.0]), np.full(3, np.inf)):
            solution = controller.step(panda.home, **{argument: {name: wrong}})
            reasons = (*solution.reasons, *solution.assumptions)
            assert ReasonKind.IMPLAUSIBLE in {reason.kind for reason in reasons if name in reason.subject}
            assert (solution.status is Status.STOPPED) == (argument == "targets")
