"""What the feedback of tasks asks for and where it leads, and controllers that share tasks."""

import numpy as np
import pinocchio as pin
import pytest
from conftest import EXAMPLES, SPHERE, frames, obstacle, random_q, task_bench

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

TIP = "panda_hand_tcp"
EVERY_KIND = [
    config.Task(frame=TIP),
    config.Task(frame="panda_link6", type="orientation", orientation_weight=0.1, name="turn"),
    config.RelativeTask(frame="panda_hand", relative_to="panda_link3", weight=0.2),
    config.ComTask(weight=0.3),
    config.MomentumTask(weight=0.1),
    config.PostureTask(weight=0.1),
    config.DampingTask(weight=0.01),
    config.LookAtTask(frame="panda_hand", motion=config.Fixed(position=(0.6, 0.2, 0.1)), weight=0.2),
    config.AlignTask(frame="panda_link7", direction=(0, 0, -1), weight=0.2),
    config.ManipulabilityTask(frame=TIP, weight=0.01),
]


def controller_of(robot, *blocks, **settings):
    return Controller(build_scene(robot), build_tasks(blocks, robot, robot.home), dt=0.01, **settings)


def sample(robot, frame, q):
    """A frame at rest where it is."""
    (M,) = frames(robot, [frame], q)
    return Sample.at(M.translation, M.rotation)


def settle(controller, q, seconds=4.0, dt=0.01, **given):
    """The state after following the tasks for a while."""
    for _ in range(round(seconds / dt)):
        solution = controller.step(q, **given)
        assert solution.status.value == "SOLVED", solution.reasons
        q = pin.integrate(controller.scene.robot.model, q, dt * solution.v)
    return q


# What the rows of frames ask for


def test_frame_rows_at_the_target_are_the_feedforward(panda):
    bench = task_bench(panda, config.Task(frame=TIP, type="pose", gain=7.0, weight=9.0, orientation_weight=4.0))
    q = random_q(panda, np.random.default_rng(3))
    linear, angular = np.array([0.1, -0.2, 0.3]), np.array([0.4, 0.5, -0.6])
    target = sample(panda, TIP, q)._replace(linear=linear, angular=angular)
    np.testing.assert_allclose(bench.rows(q, [target])[1], [*3.0 * linear, *2.0 * angular], atol=1e-12)


def test_pose_error_decays_exponentially(panda):
    gain, dt, q = 2.0, 1e-3, panda.home
    bench = task_bench(panda, config.Task(frame=TIP, type="pose", gain=gain))
    start, shift, turn = sample(panda, TIP, q), np.array([0.05, 0.08, -0.06]), np.array([0.3, -0.2, 0.4])
    target = Sample.at(start.position + shift, pin.exp3(turn) @ start.rotation)
    for tick in range(501):
        if tick % 100 == 0:
            here, left = sample(panda, TIP, q), np.exp(-gain * tick * dt)
            np.testing.assert_allclose(target.position - here.position, left * shift, atol=2e-4)
            np.testing.assert_allclose(pin.log3(target.rotation @ here.rotation.T), left * turn, atol=1e-3)
        A, b = bench.rows(q, [target])
        q = pin.integrate(panda.model, q, dt * np.linalg.pinv(A) @ b)


def test_caps_keep_the_direction_of_the_command(panda):
    q = panda.home
    start = sample(panda, TIP, q)
    shift, turn = np.array([3.0, 4.0, 0.0]), np.array([0.0, 0.6, 0.8])
    far = Sample.at(start.position + shift, pin.exp3(turn) @ start.rotation)

    def b(target, **caps):
        return task_bench(panda, config.Task(frame=TIP, type="pose", **caps)).rows(q, [target])[1]

    np.testing.assert_allclose(b(far), [*2 * shift, *2 * turn], atol=1e-9)
    np.testing.assert_allclose(b(far, max_speed=0.5), [0.3, 0.4, 0.0, *2 * turn], atol=1e-9)
    np.testing.assert_allclose(b(far, max_turn_rate=0.5), [*2 * shift, 0.0, 0.3, 0.4], atol=1e-9)
    near = Sample.at(start.position + 1e-3 * shift, start.rotation)
    np.testing.assert_allclose(b(near, max_speed=0.5, max_turn_rate=0.5), [*2e-3 * shift, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(b(start, max_speed=0.5, max_turn_rate=0.5), 0.0, atol=1e-9)


def test_motion_without_a_start_begins_at_the_frame(panda):
    (task,) = build_tasks([config.Task(frame=TIP)], panda, panda.home)
    start, here = task.motion.sample(0.0), sample(panda, TIP, panda.home)
    np.testing.assert_allclose(start.position, here.position, atol=1e-12)
    np.testing.assert_allclose(start.rotation, here.rotation, atol=1e-12)


# Where feedback leads


def test_look_at_task_follows_a_point_without_lag(panda):
    """The feed-forward leaves no lag; from behind it turns through a full turn."""
    circle = config.Circle(center=(0.6, 0.0, 0.2), radius=0.2, period=6.0)
    controller, q = controller_of(panda, config.LookAtTask(frame="panda_hand", motion=circle, gain=4.0)), panda.home
    for k in range(500):
        tick = controller.tick(q, 0.01 * k)
        q = pin.integrate(panda.model, q, 0.01 * tick.solution.v)
        assert k < 350 or tick.errors[0] < 2e-3


def test_align_task_reaches_any_direction(panda):
    controller = controller_of(panda, config.AlignTask(frame="panda_hand", direction=(0.0, 0.0, -1.0)))
    for direction in ([0.0, 0.6, -0.8], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]):
        q = settle(controller, panda.home, targets={"align": np.array(direction)})
        np.testing.assert_allclose(sample(panda, "panda_hand", q).rotation[:, 2], direction, atol=2e-3)


def test_manipulability_task_keeps_the_tool(panda):
    tasks = config.Task(frame=TIP, gain=5.0), config.ManipulabilityTask(frame=TIP, gain=20.0, weight=1e-3)
    controller = controller_of(panda, *tasks)
    q0 = panda.configuration({"panda_joint2": -0.3, "panda_joint4": -2.9, "panda_joint6": 2.6}, "q0")
    before, target = controller.tick(q0).errors[0], sample(panda, TIP, q0)
    q = settle(controller, q0, targets={TIP: target})
    assert controller.tick(q).errors[0] > 1.05 * before
    assert np.linalg.norm(sample(panda, TIP, q).position - target.position) < 2e-3


def test_posture_task_acts_in_the_null_space_of_a_tool(panda):
    """A light posture draws the elbow to where it was; the tool stays where the tool's task has it."""
    tasks = config.Task(frame=TIP, type="pose"), config.PostureTask(weight=1e-3)
    controller = controller_of(panda, *tasks)
    q = settle(controller, pin.integrate(panda.model, panda.home, 0.3 * np.ones(7)), seconds=12.0)
    np.testing.assert_allclose(q, panda.home, atol=2e-3)


def test_posture_target_turns_a_floating_base_the_short_way(solo):
    controller = controller_of(solo, config.PostureTask(joints=["*", "root_joint"], gain=2.0))
    goal = pin.integrate(solo.model, solo.home, np.concatenate(([0.3, -0.2, 0.1, 0.9, -1.2, 2.0], 0.4 * np.ones(12))))
    q = settle(controller, solo.home, targets={"posture": goal}, seconds=5.0)
    assert np.linalg.norm(pin.difference(solo.model, q, goal)) < 1e-3
    assert np.linalg.norm(q[3:7]) == pytest.approx(1.0, abs=1e-12)


def test_relative_task_keeps_two_hands_on_an_object():
    """Baxter carries a box 0.3 m to the left and up: one hand leads, the other one keeps its place on the box."""
    names = ("left_gripper", "right_gripper")
    home = {f"{side}_{joint}": value for side in ("left", "right")
            for joint, value in {"s0": -0.5, "s1": -0.6, "e1": 1.2, "w1": 0.8}.items()}  # fmt: skip
    urdf = EXAMPLES / "baxter_description/urdf/baxter.urdf"
    robot = Robot.from_urdf(urdf, bodies=[], home={**home, "right_s0": 0.5}, lock={"head_pan": 0.0})
    line = config.Line(displacement=(0.05, 0.15, 0.10), speed=0.08, profile="smooth")
    tasks = [
        config.Task(frame=names[0], type="pose", motion=line, weight=0.1, orientation_weight=0.1),
        config.RelativeTask(frame=names[1], relative_to=names[0], weight=100.0, orientation_weight=100.0, gain=5.0),
        config.DampingTask(weight=1e-6),
    ]
    controller = controller_of(robot, *tasks)
    a, b = frames(robot, names, robot.home)
    start, q = a.actInv(b), robot.home
    for tick in range(350):
        q = pin.integrate(robot.model, q, 0.01 * controller.step(q, 0.01 * tick).v)
        now = frames(robot, names, q)
        grip = now[0].actInv(now[1])
        assert np.linalg.norm(grip.translation - start.translation) < 1e-4
        assert np.linalg.norm(pin.log3(grip.rotation @ start.rotation.T)) < 1e-3
    assert np.linalg.norm(now[0].translation - a.translation - [0.05, 0.15, 0.10]) < 2e-3


# Tasks, targets and controllers


def test_controllers_share_tasks_and_a_scene(panda):
    """Interleaved steps of two that share them are those of two with tasks and scenes of their own, bit for bit."""

    def controller(tasks, scene):
        return Controller(scene, tasks, dt=0.01)

    lists = [build_tasks(EVERY_KIND, panda, panda.home) for _ in range(3)]
    scenes = [build_scene(panda, [obstacle("ball", SPHERE, (0.5, 0.1, 0.4))]) for _ in range(3)]
    shared = [controller(lists[0], scenes[0]) for _ in range(2)]
    alone = [controller(lists[i], scenes[i]) for i in (1, 2)]
    states, rng = [panda.home, random_q(panda, np.random.default_rng(6), 0.2)], np.random.default_rng(7)
    for _ in range(20):
        for i in range(2):
            targets = {"posture": panda.home + rng.uniform(-0.2, 0.2, 7), "align": rng.normal(size=3)}
            targets["com"] = Sample.at(rng.uniform(0.0, 0.3, 3), linear=rng.normal(size=3))
            found, expected = (one.tick(states[i], targets=targets) for one in (shared[i], alone[i]))
            np.testing.assert_array_equal(found.problem.tracking.A, expected.problem.tracking.A)
            np.testing.assert_array_equal(found.problem.tracking.b, expected.problem.tracking.b)
            np.testing.assert_array_equal(found.errors, expected.errors)
            np.testing.assert_array_equal(found.solution.v, expected.solution.v)
            states[i] = pin.integrate(panda.model, states[i], 0.01 * found.solution.v)


def test_targets_of_the_wrong_kind_are_named(panda):
    light = {"weight": 1e-3}
    controller = controller_of(panda, config.Task(frame=TIP), config.PostureTask(**light), config.DampingTask(**light))
    for name, target, message in [
        ("posture", np.zeros(3), r"target 'posture': q: shape \(3,\), expected \(7,\)"),
        ("posture", Sample.at([0, 0, 0]), "target 'posture'"),
        ("damping", np.zeros(7), "target 'damping': a task of type damping takes none"),
        (TIP, np.zeros(7), r"target 'panda_hand_tcp': neither .*shape \(7,\).*; give a Sample, a Pose, a pin.SE3"),
    ]:
        with pytest.raises(NumericalError, match=message):
            controller.step(panda.home, targets={name: target})
    with pytest.raises(UnknownName, match="no target 'postur'; did you mean 'posture'"):
        controller.step(panda.home, targets={"postur": panda.home})
    stopped = controller.step(panda.home, targets={"posture": np.full(7, np.nan)})
    assert stopped.status.value == "STOPPED"
    assert [reason.key for reason in stopped.reasons] == [(ReasonKind.IMPLAUSIBLE.name, ("target", "posture"))]
    assert controller.step(panda.home).status.value == "SOLVED"


def test_task_names_must_differ(panda):
    twice = [config.Task(frame=TIP), config.Task(frame=TIP, type="orientation")]
    with pytest.raises(ConfigError, match="two have the same name among panda_hand_tcp"):
        controller_of(panda, *twice)
    named = twice[1].model_copy(update={"name": "upright"})
    assert [task.settings.label for task in controller_of(panda, twice[0], named).tasks] == [TIP, "upright"]
