"""Every kind of task: its rows against finite differences on the manifold, and where its feedback leads."""

import numpy as np
import pinocchio as pin
import pytest
from conftest import EXAMPLES, Bench, differences, random_q

from qpavoid import (
    ConfigError,
    Controller,
    NumericalError,
    ReasonKind,
    Robot,
    Sample,
    UnknownName,
    build_scene,
    build_tasks,
    config,
)

STILL = config.Fixed(position=(0.7, 0.3, 1.2))
ROBOTS = ("panda", "solo", "baxter_fingers", "tiago")
"""A fixed arm; a floating base; joints that mimic others; a planar base and continuous joints."""
TOOLS = {
    "panda": ("panda_hand_tcp", "panda_link4"),
    "solo": ("FL_FOOT", "HR_FOOT"),
    "baxter_fingers": ("l_gripper_r_finger_tip", "right_gripper"),
    "tiago": ("arm_tool_link", "head_2_link"),
}


@pytest.fixture(scope="module")
def baxter_fingers():
    """Its fingers come in pairs: one of each mimics the other one, at a ratio of -1."""
    return Robot.from_urdf(EXAMPLES / "baxter_description/urdf/baxter.urdf", bodies=[])


@pytest.fixture(scope="module")
def tiago():
    """Continuous wheels (nq = 2, nv = 1), on a planar base (nq = 4, nv = 3)."""
    limits = {"velocity": {"root_joint": 10.0}}
    return Robot.from_urdf(
        EXAMPLES / "tiago_description/robots/tiago.urdf", root_joint="planar", bodies=[], limits=limits
    )


DATA = {}
"""Models and memory by file: making it takes longer than using it."""


class Rows:
    """Rows of tasks, unscaled and on data of their own."""

    def __init__(self, robot, *configs, damping=0.0):
        self.robot = robot
        self.tasks = build_tasks(configs, robot, robot.home)
        self.bench = Bench(build_scene(robot), self.tasks, damping=damping)

    def compute(self, q, targets=None):
        tracking = self.bench.compute(q, targets, reach=-1.0)[1].tracking
        return tracking.A.copy(), tracking.b.copy()


def frames(robot, names, q):
    key = robot.source, robot.model.nq
    if key not in DATA:
        DATA[key] = robot.model, robot.model.createData()
    model, data = DATA[key]
    pin.framesForwardKinematics(model, data, q)
    return [data.oMf[robot.model.getFrameId(name)].copy() for name in names]


@pytest.fixture(params=ROBOTS)
def case(request):
    """A robot, the names of two of its frames, and configurations."""
    robot = request.getfixturevalue(request.param)
    rng = np.random.default_rng(7)
    return robot, TOOLS[request.param], [random_q(robot, rng) for _ in range(3)]


def test_the_robots_are_what_they_are_chosen_for(baxter_fingers, tiago, solo):
    assert baxter_fingers.model.nvExtended == baxter_fingers.model.nv + 2
    assert tiago.model.nq > tiago.model.nv and tiago.model.joints[1].shortname() == "JointModelPlanar"
    assert {"JointModelRUBY", "JointModelRUBZ"} & {joint.shortname() for joint in tiago.model.joints}
    assert solo.model.joints[1].shortname() == "JointModelFreeFlyer"


def test_frames_and_orientations_alone(case):
    """An orientation is the angular rows of a pose, in whatever order the tasks are given."""
    robot, (tool, other), configurations = case
    orientation = config.Task(frame=tool, type="orientation", orientation_weight=4.0, name="turn")
    rows = Rows(robot, orientation, config.Task(frame=other, type="pose"))
    for q in configurations:

        def moved(x, q=q):
            (at, base), (to, far) = frames(robot, (tool, other), q), frames(robot, (tool, other), x)
            turns = [pin.log3(b.rotation @ a.rotation.T) for a, b in ((base, far), (at, to))]
            return np.concatenate((far.translation, turns[0], 2.0 * turns[1]))

        np.testing.assert_allclose(rows.compute(q)[0], differences(moved, robot, q), atol=1e-6)


@pytest.mark.parametrize("part", ["position", "orientation", "pose"])
def test_relative_pose(case, part):
    robot, (a, b), configurations = case
    rows = Rows(robot, config.RelativeTask(frame=b, relative_to=a, rows=part, gain=0.0))
    chosen = {"position": slice(0, 3), "orientation": slice(3, 6), "pose": slice(0, 6)}[part]
    for q in configurations:

        def moved(x, q=q):
            (a0, b0), (a1, b1) = frames(robot, (a, b), q), frames(robot, (a, b), x)
            before, after = a0.actInv(b0), a1.actInv(b1)
            return np.concatenate((after.translation, pin.log3(after.rotation @ before.rotation.T)))[chosen]

        np.testing.assert_allclose(rows.compute(q)[0], differences(moved, robot, q), atol=1e-6)


def test_centre_of_mass(case):
    robot, _, configurations = case
    rows, flat = Rows(robot, config.ComTask()), Rows(robot, config.ComTask(axes="xy", weight=9.0))
    data = robot.model.createData()
    for q in configurations:
        expected = differences(lambda x: pin.centerOfMass(robot.model, data, x).copy(), robot, q)
        np.testing.assert_allclose(rows.compute(q)[0], expected, atol=1e-6)
        np.testing.assert_allclose(flat.compute(q)[0], 3.0 * expected[:2], atol=3e-6)


def test_posture_and_damping_are_rates_of_coordinates(case):
    robot, _, configurations = case
    rows = Rows(robot, config.PostureTask(weight=4.0), config.DampingTask())
    one = [c for c, joint in ((j.idx_v, j) for j in list(robot.model.joints)[1:]) if joint.nv == 1]
    for q in configurations:
        A, b = rows.compute(q)
        away = differences(lambda x, q=q: pin.difference(robot.model, q, x), robot, q)
        np.testing.assert_allclose(A, np.concatenate((2.0 * away[one], away)), atol=1e-6)
        np.testing.assert_allclose(b[: len(one)], 2.0 * pin.difference(robot.model, q, robot.home)[one], atol=1e-12)
        assert not b[len(one) :].any()


@pytest.mark.parametrize("looks", [True, False])
def test_axes(case, looks):
    """The rows turn the wanted direction, as the frame sees it, towards the axis and across."""
    robot, (tool, _), configurations = case
    axis, direction = np.array([2.0, -1.0, 2.0]) / 3.0, np.array([0.6, 0.0, -0.8])
    if looks:
        task = config.LookAtTask(frame=tool, axis=tuple(axis), motion=STILL, gain=3.0)
    else:
        task = config.AlignTask(frame=tool, axis=tuple(axis), direction=tuple(2.0 * direction), gain=3.0)
    rows = Rows(robot, task)

    def wanted(x):
        (M,) = frames(robot, (tool,), x)
        d = np.array(STILL.position) - M.translation if looks else direction
        return M.rotation.T @ d / np.linalg.norm(d)

    def angle(x):
        return np.array([np.arctan2(np.linalg.norm(np.cross(axis, wanted(x))), axis @ wanted(x))])

    for q in configurations:
        A, b = rows.compute(q)
        d = wanted(q)
        across = np.cross(d, axis) / np.linalg.norm(np.cross(d, axis))
        np.testing.assert_allclose(A[0], -differences(angle, robot, q)[0], atol=1e-6)
        np.testing.assert_allclose(A[1], across @ differences(wanted, robot, q), atol=1e-6)
        np.testing.assert_allclose(b, [3.0 * angle(q)[0], 0.0], atol=1e-9)


@pytest.mark.parametrize("part", ["position", "orientation", "pose"])
def test_manipulability(case, part):
    """The analytic gradient of √det(J Jᵀ); its row asks for the rate of ascent along it."""
    robot, (tool, _), configurations = case
    rows = Rows(robot, config.ManipulabilityTask(frame=tool, rows=part, gain=2.0))
    chosen = {"position": slice(0, 3), "orientation": slice(3, 6), "pose": slice(0, 6)}[part]
    data = robot.model.createData()

    def measure(x):
        pin.computeJointJacobians(robot.model, data, x)
        pin.updateFramePlacements(robot.model, data)
        J = pin.getFrameJacobian(robot.model, data, robot.model.getFrameId(tool), pin.LOCAL_WORLD_ALIGNED)[chosen]
        return np.array([np.sqrt(np.linalg.det(J @ J.T))])

    for q in configurations:
        A, b = rows.compute(q)
        gradient = differences(measure, robot, q)[0]
        np.testing.assert_allclose(A[0], gradient, atol=1e-5 * max(1.0, np.abs(gradient).max()))
        np.testing.assert_allclose(b, 2.0 * A[0] @ A[0], rtol=1e-12)
        assert rows.bench.assembly.task_errors[0] == pytest.approx(measure(q)[0], rel=1e-9)


def test_gradient_agrees_with_the_hessian_of_the_kinematics(panda):
    """∂w/∂q = w tr(∂J/∂q J⁺), with Pinocchio's own ∂J/∂q."""
    rows = Rows(panda, config.ManipulabilityTask(frame="panda_link7", rows="pose"))
    model, data = panda.model, panda.model.createData()
    q = random_q(panda, np.random.default_rng(3))
    pin.computeJointKinematicHessians(model, data, q)
    joint = model.frames[model.getFrameId("panda_link7")].parentJoint
    J = pin.getJointJacobian(model, data, joint, pin.LOCAL)
    H = np.asarray(pin.getJointKinematicHessian(model, data, joint, pin.LOCAL))
    H = (
        H.ravel(order="K").reshape(7, 7, 6).transpose(2, 1, 0)
    )  # a column-major tensor, which the binding gives as a row-major one
    w = np.sqrt(np.linalg.det(J @ J.T))
    expected = w * np.einsum("rji,jr->i", H, np.linalg.pinv(J))
    np.testing.assert_allclose(rows.compute(q)[0][0], expected, atol=1e-9)


# Where feedback leads


def settle(controller, q, seconds=4.0, dt=0.01, **given):
    """The state after following the tasks for a while."""
    for _ in range(round(seconds / dt)):
        solution = controller.step(q, **given)
        assert solution.status.value == "SOLVED", solution.reasons
        q = pin.integrate(controller.scene.robot.model, q, dt * solution.v)
    return q


def controller_of(robot, *tasks, **settings):
    return Controller(build_scene(robot), build_tasks(tasks, robot, robot.home), dt=0.01, **settings)


def test_a_camera_keeps_looking_at_a_point_that_moves(panda):
    """The feed-forward leaves no lag; from behind it turns through a full turn."""
    circle = config.Circle(center=(0.6, 0.0, 0.2), radius=0.2, period=6.0)
    controller = controller_of(panda, config.LookAtTask(frame="panda_hand", motion=circle, gain=4.0))
    q = panda.home
    for k in range(500):
        tick = controller.tick(q, 0.01 * k)
        q = pin.integrate(panda.model, q, 0.01 * tick.solution.v)
        if k >= 350:
            assert tick.errors[0] < 2e-3


def test_an_axis_turns_to_any_direction(panda):
    cup = config.AlignTask(frame="panda_hand", direction=(0.0, 0.0, -1.0))
    controller = controller_of(panda, cup)
    for direction in ([0.0, 0.6, -0.8], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]):
        q = settle(controller, panda.home, targets={"align": np.array(direction)})
        (M,) = frames(panda, ["panda_hand"], q)
        np.testing.assert_allclose(M.rotation[:, 2], direction, atol=2e-3)


def test_manipulability_rises_while_the_tool_stays(panda):
    tip = config.Task(frame="panda_hand_tcp", type="position", gain=5.0)
    controller = controller_of(
        panda, tip, config.ManipulabilityTask(frame="panda_hand_tcp", gain=20.0, weight=1e-3), tracking_damping=1e-3
    )
    q0 = panda.configuration({"panda_joint2": -0.3, "panda_joint4": -2.9, "panda_joint6": 2.6}, "q0")
    before = controller.tick(q0).errors[0]
    target = Sample.at(frames(panda, ["panda_hand_tcp"], q0)[0].translation)
    q = settle(controller, q0, targets={"panda_hand_tcp": target})
    assert controller.tick(q).errors[0] > 1.05 * before
    assert np.linalg.norm(frames(panda, ["panda_hand_tcp"], q)[0].translation - target.position) < 2e-3


def test_a_posture_in_the_null_space_of_a_tool(panda):
    """A light posture draws the elbow to where it was; the tool stays where the tool's task has it."""
    tip = config.Task(frame="panda_hand_tcp", type="pose")
    controller = controller_of(panda, tip, config.PostureTask(weight=1e-3), tracking_damping=1e-3)
    q = settle(controller, pin.integrate(panda.model, panda.home, 0.3 * np.ones(7)), seconds=12.0)
    np.testing.assert_allclose(q, panda.home, atol=2e-3)


def test_a_posture_given_at_run_time_turns_a_floating_base_the_short_way(solo):
    controller = controller_of(solo, config.PostureTask(joints=["*", "root_joint"], gain=2.0))
    goal = pin.integrate(solo.model, solo.home, np.concatenate(([0.3, -0.2, 0.1, 0.9, -1.2, 2.0], 0.4 * np.ones(12))))
    q = settle(controller, solo.home, targets={"posture": goal}, seconds=5.0)
    assert np.linalg.norm(pin.difference(solo.model, q, goal)) < 1e-3
    assert np.linalg.norm(q[3:7]) == pytest.approx(1.0, abs=1e-12)


def test_two_hands_on_one_object():
    """Baxter carries a box 0.3 m to the left and up: one hand leads, the other one keeps its place on the box."""
    names = ("left_gripper", "right_gripper")
    robot = Robot.from_urdf(
        EXAMPLES / "baxter_description/urdf/baxter.urdf",
        bodies=[],
        home={"left_s0": -0.5, "left_s1": -0.6, "left_e1": 1.2, "left_w1": 0.8, "right_s0": 0.5, "right_s1": -0.6,
              "right_e1": 1.2, "right_w1": 0.8},
        lock={"head_pan": 0.0},
    )  # fmt: skip
    line = config.Line(displacement=(0.05, 0.15, 0.10), speed=0.08, profile="smooth")
    tasks = [
        config.Task(frame=names[0], type="pose", motion=line, weight=0.1, orientation_weight=0.1),
        config.RelativeTask(frame=names[1], relative_to=names[0], weight=100.0, orientation_weight=100.0, gain=5.0),
        config.DampingTask(weight=1e-6),
    ]
    controller = controller_of(robot, *tasks, tracking_damping=1e-3)
    a, b = frames(robot, names, robot.home)
    start, q, worst = a.actInv(b), robot.home, 0.0
    for tick in range(350):
        q = pin.integrate(robot.model, q, 0.01 * controller.step(q, 0.01 * tick).v)
        now = frames(robot, names, q)
        grip = now[0].actInv(now[1])
        worst = max(worst, float(np.linalg.norm(grip.translation - start.translation)))
        assert np.linalg.norm(pin.log3(grip.rotation @ start.rotation.T)) < 1e-3
    assert worst < 1e-4
    assert np.linalg.norm(now[0].translation - a.translation - [0.05, 0.15, 0.10]) < 2e-3


# What cannot be used


@pytest.mark.parametrize(
    ("block", "message"),
    [
        (config.Task(frame="hand"), "tasks.0.frame: panda has no frame 'hand'"),
        (config.RelativeTask(frame="panda_hand", relative_to="x"), "tasks.0.relative_to: panda has no frame 'x'"),
        (config.PostureTask(joints=["elbow"]), "tasks.0.joints: panda has no joint 'elbow'"),
        (config.PostureTask(q={"panda_joint9": 1.0}), "tasks.0.q: no joint 'panda_joint9'; did you mean"),
        (config.AlignTask(frame="panda_hand", direction=(0, 0, 0)), "tasks.0.direction has no length"),
        (config.LookAtTask(frame="panda_hand", axis=(0, 0, 0), motion=STILL), "tasks.0.axis has no length"),
        (config.LookAtTask(frame="panda_hand", motion=config.Fixed()), "tasks.0: motion.position is missing"),
    ],
)
def test_what_cannot_be_used_is_named(panda, block, message):
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        build_tasks([block], panda, panda.home)


def test_targets_of_the_wrong_kind(panda):
    controller = controller_of(
        panda, config.Task(frame="panda_hand_tcp"), config.PostureTask(weight=1e-3), config.DampingTask(weight=1e-3)
    )
    for name, target, message in [
        ("posture", np.zeros(3), r"target 'posture': q: shape \(3,\), expected \(7,\)"),
        ("posture", Sample.at([0, 0, 0]), "target 'posture'"),
        ("damping", np.zeros(7), "target 'damping': a task of type damping takes none"),
        ("panda_hand_tcp", np.zeros(3), r"target 'panda_hand_tcp': neither .*; give Sample.at\(position"),
    ]:
        with pytest.raises(NumericalError, match=message):
            controller.step(panda.home, targets={name: target})
    with pytest.raises(UnknownName, match="no target 'postur'; did you mean 'posture'"):
        controller.step(panda.home, targets={"postur": panda.home})
    stopped = controller.step(panda.home, targets={"posture": np.full(7, np.nan)})
    assert stopped.status.value == "STOPPED"
    assert [(reason.kind, reason.subject) for reason in stopped.reasons] == [
        (ReasonKind.IMPLAUSIBLE, ("target", "posture"))
    ]
    assert controller.step(panda.home).status.value == "SOLVED"


def test_names_must_differ(panda):
    twice = [config.Task(frame="panda_hand_tcp"), config.Task(frame="panda_hand_tcp", type="orientation")]
    with pytest.raises(ConfigError, match="two have the same name among panda_hand_tcp"):
        controller_of(panda, *twice)
    named = twice[1].model_copy(update={"name": "upright"})
    assert [task.settings.label for task in controller_of(panda, twice[0], named).tasks] == [
        "panda_hand_tcp",
        "upright",
    ]
