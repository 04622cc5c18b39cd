"""Every kind of task: its rows against finite differences on the manifold, and what is refused of it."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from conftest import EXAMPLES, differences, frames, random_q, task_bench, write_chain

from qpavoid import ConfigError, NumericalError, Robot, build_tasks, config

STILL = config.Fixed(position=(0.7, 0.3, 1.2))
TOOLS = {
    "panda": ("panda_hand_tcp", "panda_link4"),
    "paper": ("left_tool", "right_tool"),
    "solo": ("FL_FOOT", "HR_FOOT"),
    "baxter_fingers": ("l_gripper_r_finger_tip", "right_gripper"),
    "tiago": ("arm_tool_link", "head_2_link"),
}
"""A fixed arm; two arms; a floating base; joints that mimic others; a planar base, continuous joints."""
PARTS = {"position": slice(0, 3), "orientation": slice(3, 6), "pose": slice(0, 6)}


@pytest.fixture(scope="module")
def baxter_fingers():
    """Its fingers come in pairs: one of each mimics the other one, at a ratio of -1."""
    return Robot.from_urdf(EXAMPLES / "baxter_description/urdf/baxter.urdf", bodies=[])


@pytest.fixture(scope="module")
def tiago():
    """Continuous wheels (nq = 2, nv = 1), on a planar base (nq = 4, nv = 3)."""
    limits = {"velocity": {"root_joint": 10.0}}
    urdf = EXAMPLES / "tiago_description/robots/tiago.urdf"
    return Robot.from_urdf(urdf, root_joint="planar", bodies=[], limits=limits)


@pytest.fixture(params=TOOLS)
def case(request):
    """A robot, the names of two of its frames, and configurations."""
    robot = request.getfixturevalue(request.param)
    rng = np.random.default_rng(7)
    return robot, TOOLS[request.param], [random_q(robot, rng) for _ in range(3)]


def test_robots_have_mimic_joints_and_moving_bases(baxter_fingers, tiago, solo):
    assert baxter_fingers.model.nvExtended == baxter_fingers.model.nv + 2
    assert tiago.model.nq > tiago.model.nv and tiago.model.joints[1].shortname() == "JointModelPlanar"
    assert {"JointModelRUBY", "JointModelRUBZ"} & {joint.shortname() for joint in tiago.model.joints}
    assert solo.model.joints[1].shortname() == "JointModelFreeFlyer"


def test_frame_rows_agree_with_finite_differences(case):
    """Positions before orientations, scaled with the roots of the weights, in whatever order the tasks are given."""
    robot, (tool, other), configurations = case
    orientation = config.Task(frame=tool, type="orientation", orientation_weight=4.0, name="turn")
    position = config.Task(frame=tool, weight=9.0)
    bench = task_bench(robot, orientation, position, config.Task(frame=other, type="pose"))
    for q in configurations:

        def moved(x, q=q):
            (at, base), (to, far) = frames(robot, (tool, other), q), frames(robot, (tool, other), x)
            turns = [pin.log3(b.rotation @ a.rotation.T) for a, b in ((base, far), (at, to))]
            return np.concatenate((3.0 * to.translation, far.translation, turns[0], 2.0 * turns[1]))

        np.testing.assert_allclose(bench.rows(q)[0], differences(moved, robot, q), atol=2e-6)


@pytest.mark.parametrize("part", PARTS)
def test_relative_rows_agree_with_finite_differences(case, part):
    robot, (a, b), configurations = case
    bench = task_bench(robot, config.RelativeTask(frame=b, relative_to=a, rows=part, gain=0.0))
    for q in configurations:

        def moved(x, q=q):
            (a0, b0), (a1, b1) = frames(robot, (a, b), q), frames(robot, (a, b), x)
            before, after = a0.actInv(b0), a1.actInv(b1)
            return np.concatenate((after.translation, pin.log3(after.rotation @ before.rotation.T)))[PARTS[part]]

        np.testing.assert_allclose(bench.rows(q)[0], differences(moved, robot, q), atol=1e-6)


def test_com_rows_agree_with_finite_differences(case):
    robot, _, configurations = case
    bench = task_bench(robot, config.ComTask(), config.ComTask(axes="xy", weight=9.0))
    data = robot.model.createData()
    for q in configurations:
        expected = differences(lambda x: pin.centerOfMass(robot.model, data, x).copy(), robot, q)
        np.testing.assert_allclose(bench.rows(q)[0], np.concatenate((expected, 3.0 * expected[:2])), atol=3e-6)


def test_momentum_rows_agree_with_finite_differences(case):
    """Of every body, m (c - c_all) × ċ + I ω, by where it is a little before and after."""
    robot, _, configurations = case
    bench, model, h = task_bench(robot, config.MomentumTask(weight=4.0, angular=(1.0, 0.0, -2.0))), robot.model, 1e-6
    bodies = range(1, model.njoints)

    def at(q):
        data = model.createData()
        pin.centerOfMass(model, data, q)
        pin.forwardKinematics(model, data, q)
        return data

    for q in configurations:
        A, b = bench.rows(q)
        now, expected = at(q), np.zeros((3, model.nv))
        for j, e in enumerate(np.eye(model.nv)):
            before, after = at(pin.integrate(model, q, -h * e)), at(pin.integrate(model, q, h * e))
            for i in bodies:
                body, pose = model.inertias[i], now.oMi[i]
                speed = (after.oMi[i].act(body.lever) - before.oMi[i].act(body.lever)) / (2.0 * h)
                turn = pin.log3(after.oMi[i].rotation @ before.oMi[i].rotation.T) / (2.0 * h)
                inertia = pose.rotation @ body.inertia @ pose.rotation.T
                expected[:, j] += np.cross(pose.act(body.lever) - now.com[0], body.mass * speed) + inertia @ turn
        np.testing.assert_allclose(A, 2.0 * expected, atol=1e-6)
        np.testing.assert_allclose(b, [2.0, 0.0, -4.0])


def test_posture_and_damping_rows_are_rates_of_coordinates(case):
    robot, _, configurations = case
    bench = task_bench(robot, config.PostureTask(weight=4.0), config.DampingTask())
    one = [joint.idx_v for joint in list(robot.model.joints)[1:] if joint.nv == 1]
    for q in configurations:
        A, b = bench.rows(q)
        away = differences(lambda x, q=q: pin.difference(robot.model, q, x), robot, q)
        np.testing.assert_allclose(A, np.concatenate((2.0 * away[one], away)), atol=1e-6)
        np.testing.assert_allclose(b[: len(one)], 2.0 * pin.difference(robot.model, q, robot.home)[one], atol=1e-12)
        assert not b[len(one) :].any()


@pytest.mark.parametrize("looks", [True, False])
def test_axis_rows_agree_with_finite_differences(case, looks):
    """The rows turn the wanted direction, as the frame sees it, towards the axis and across."""
    robot, (tool, _), configurations = case
    axis, direction = np.array([2.0, -1.0, 2.0]) / 3.0, np.array([0.6, 0.0, -0.8])
    if looks:
        task = config.LookAtTask(frame=tool, axis=tuple(axis), motion=STILL, gain=3.0)
    else:
        task = config.AlignTask(frame=tool, axis=tuple(axis), direction=tuple(2.0 * direction), gain=3.0)
    bench = task_bench(robot, task)

    def wanted(x):
        (M,) = frames(robot, (tool,), x)
        d = np.array(STILL.position) - M.translation if looks else direction
        return M.rotation.T @ d / np.linalg.norm(d)

    def angle(x):
        return np.array([np.arctan2(np.linalg.norm(np.cross(axis, wanted(x))), axis @ wanted(x))])

    for q in configurations:
        A, b = bench.rows(q)
        across = np.cross(wanted(q), axis) / np.sin(angle(q))
        np.testing.assert_allclose(A[0], -differences(angle, robot, q)[0], atol=1e-6)
        np.testing.assert_allclose(A[1], across @ differences(wanted, robot, q), atol=1e-6)
        np.testing.assert_allclose(b, [3.0 * angle(q)[0], 0.0], atol=1e-9)


@pytest.mark.parametrize("part", PARTS)
def test_manipulability_row_is_the_gradient(case, part):
    """The analytic gradient of √det(J Jᵀ); its row asks for the rate of ascent along it."""
    robot, (tool, _), configurations = case
    bench = task_bench(robot, config.ManipulabilityTask(frame=tool, rows=part, gain=2.0))
    data = robot.model.createData()

    def measure(x):
        pin.computeJointJacobians(robot.model, data, x)
        pin.updateFramePlacements(robot.model, data)
        J = pin.getFrameJacobian(robot.model, data, robot.model.getFrameId(tool), pin.LOCAL_WORLD_ALIGNED)[PARTS[part]]
        return np.array([np.sqrt(np.linalg.det(J @ J.T))])

    for q in configurations:
        A, b = bench.rows(q)
        gradient = differences(measure, robot, q)[0]
        np.testing.assert_allclose(A[0], gradient, atol=1e-5 * max(1.0, np.abs(gradient).max()))
        np.testing.assert_allclose(b, 2.0 * A[0] @ A[0], rtol=1e-12)
        assert bench.assembler.task_errors[0] == pytest.approx(measure(q)[0], rel=1e-9)


@pytest.mark.parametrize(
    ("block", "message"),
    [
        (
            config.Task(frame="panda_hand_tpc"),
            "tasks.0.frame: panda-capsules has no frame 'panda_hand_tpc'; did you",
        ),
        (
            config.RelativeTask(frame="panda_hand", relative_to="x"),
            "tasks.0.relative_to: panda-capsules has no frame 'x'",
        ),
        (config.PostureTask(joints=["elbow"]), "tasks.0.joints: panda-capsules has no joint 'elbow'"),
        (config.PostureTask(q={"panda_joint9": 1.0}), "tasks.0.q: no joint 'panda_joint9'; did you mean"),
        (config.AlignTask(frame="panda_hand", direction=(0, 0, 0)), "tasks.0.direction has no length"),
        (config.LookAtTask(frame="panda_hand", axis=(0, 0, 0), motion=STILL), "tasks.0.axis has no length"),
        (config.LookAtTask(frame="panda_hand", motion=config.Fixed()), "tasks.0: motion.position is missing"),
    ],
)
def test_tasks_that_cannot_be_used_are_named(panda, block, message):
    with pytest.raises(ConfigError, match=f"bench.yaml: {message}".replace(".", r"\.")):
        build_tasks([block], panda, panda.home, Path("bench.yaml"))


def test_com_task_needs_a_mass(tmp_path):
    robot = Robot.from_urdf(write_chain(tmp_path), bodies=[])
    with pytest.raises(ConfigError, match=r"tasks: tasks\.0: chain has no mass, so no centre of mass"):
        build_tasks([config.ComTask()], robot, robot.home)


@pytest.mark.parametrize("q0", [np.zeros(3), np.full(7, np.nan)])
def test_tasks_refuse_a_configuration_that_is_none(panda, q0):
    with pytest.raises(NumericalError, match=r"q0: (shape \(3,\), expected \(7,\)|NaN)"):
        build_tasks([config.Task(frame="panda_hand_tcp")], panda, q0)
