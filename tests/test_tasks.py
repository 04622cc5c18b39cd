"""Task rows against finite differences, and what their feedback does in closed loop."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from conftest import SPHERE, Bench, differences, obstacle, random_q

from qpavoid import Controller, NumericalError, Sample, UnknownName, build_scene, config
from qpavoid.control.tasks import build_tasks
from qpavoid.problem import Tracking

FIXED = config.Fixed(type="fixed")
FRAMES = {
    "paper": ("left_tool", "right_tool"),
    "panda": ("panda_hand_tcp",),
    "solo": ("FL_FOOT", "base_link", "HR_LOWER_LEG"),
}


class Tasks:
    """Tasks of a robot without anything else around them."""

    def __init__(self, robot, configs, damping=0.0):
        self.robot = robot
        self.tasks = build_tasks(configs, robot, robot.home, Path("bench.yaml"))
        self.ids = [task.frame_id for task in self.tasks]
        self.bench = Bench(build_scene(robot), self.tasks, damping=damping)

    @classmethod
    def of_frames(cls, robot, frames, **settings):
        """Pose tasks, or what the settings make of them."""
        return cls(robot, [config.Task(**{"frame": f, "type": "pose", "motion": FIXED, **settings}) for f in frames])

    def poses(self, q):
        """Samples at rest of all frames, on data of their own."""
        data = self.robot.model.createData()
        pin.framesForwardKinematics(self.robot.model, data, q)
        return [Sample.at(data.oMf[i].translation, data.oMf[i].rotation) for i in self.ids]

    def compute(self, q, targets=None):
        """Rows that the next call leaves alone."""
        A, b, damping = self.bench.compute(q, targets, reach=-1.0)[1].tracking
        return Tracking(A.copy(), b.copy(), damping)


@pytest.mark.parametrize("name", FRAMES)
def test_jacobian_against_finite_differences(name, request):
    """Position and orientation, of two arms, of a locked robot and of a floating base."""
    robot = request.getfixturevalue(name)
    bench, rng = Tasks.of_frames(robot, FRAMES[name]), np.random.default_rng(1)
    for _ in range(5):
        q = random_q(robot, rng)
        here = bench.poses(q)

        def displacement(q, here=here):
            moves = [
                (to.position - at.position, pin.log3(to.rotation @ at.rotation.T))
                for at, to in zip(here, bench.poses(q), strict=True)
            ]
            return np.concatenate([linear for linear, _ in moves] + [angular for _, angular in moves])

        np.testing.assert_allclose(bench.compute(q).A, differences(displacement, robot, q), atol=1e-6)


def test_position_and_pose_tasks_share_one_layout(paper):
    both = [
        config.Task(frame="left_tool", type="position", motion=FIXED, weight=3.0),
        config.Task(frame="right_tool", type="pose", motion=FIXED, weight=5.0, orientation_weight=0.5),
    ]
    q = random_q(paper, np.random.default_rng(2))
    found = Tasks(paper, both, damping=0.02).compute(q)
    separate = [Tasks.of_frames(paper, [task.frame], type=task.type).compute(q) for task in both]
    root = np.sqrt([3.0] * 3 + [5.0] * 3 + [0.5] * 3)
    np.testing.assert_allclose(found.A, root[:, None] * np.concatenate([s.A for s in separate]), atol=1e-15)
    np.testing.assert_allclose(found.b, root * np.concatenate([s.b for s in separate]), atol=1e-15)
    assert found.damping == 0.02


def test_at_the_target_only_the_feed_forward_is_left(panda):
    bench = Tasks.of_frames(panda, ["panda_hand_tcp"], gain=7.0)
    q = random_q(panda, np.random.default_rng(3))
    linear, angular = np.array([0.1, -0.2, 0.3]), np.array([0.4, 0.5, -0.6])
    target = bench.poses(q)[0]._replace(linear=linear, angular=angular)
    np.testing.assert_allclose(bench.compute(q, [target]).b, [*linear, *angular], atol=1e-12)


def test_a_frame_that_obeys_keeps_up_with_a_target_that_moves(panda):
    """A v = b moves the frame with the target's own twist: the error between the two does not grow."""
    bench, rng = Tasks.of_frames(panda, ["panda_hand_tcp"], gain=0.0), np.random.default_rng(4)
    q, step = panda.home, 1e-6
    target = bench.poses(q)[0]._replace(linear=rng.uniform(-1, 1, 3), angular=rng.uniform(-1, 1, 3))
    rows = bench.compute(q, [target])
    later = bench.poses(pin.integrate(panda.model, q, step * np.linalg.pinv(rows.A) @ rows.b))[0]
    np.testing.assert_allclose(later.position - target.position, step * target.linear, atol=1e-11)
    turned = pin.exp3(step * target.angular) @ target.rotation
    np.testing.assert_allclose(pin.log3(later.rotation @ turned.T), 0.0, atol=1e-11)


def test_pose_error_decays_exponentially(panda):
    gain, dt = 2.0, 1e-3
    bench = Tasks.of_frames(panda, ["panda_hand_tcp"], gain=gain)
    q, start = panda.home, bench.poses(panda.home)[0]
    turn = np.array([0.3, -0.2, 0.4])
    target = Sample.at(start.position + np.array([0.05, 0.08, -0.06]), pin.exp3(turn) @ start.rotation)
    for tick in range(501):
        if tick % 100 == 0:
            here = bench.poses(q)[0]
            left = np.exp(-gain * tick * dt)
            np.testing.assert_allclose(
                target.position - here.position, left * (target.position - start.position), atol=2e-4
            )
            np.testing.assert_allclose(pin.log3(target.rotation @ here.rotation.T), left * turn, atol=1e-3)
        rows = bench.compute(q, [target])
        q = pin.integrate(panda.model, q, dt * np.linalg.pinv(rows.A) @ rows.b)


def test_caps_shorten_the_command_and_keep_its_direction(panda):
    q = panda.home
    start = Tasks.of_frames(panda, ["panda_hand_tcp"]).poses(q)[0]
    shift, turn = np.array([3.0, 4.0, 0.0]), np.array([0.0, 0.6, 0.8])
    far = Sample.at(start.position + shift, pin.exp3(turn) @ start.rotation)

    def b(target, **caps):
        return Tasks.of_frames(panda, ["panda_hand_tcp"], gain=2.0, **caps).compute(q, [target]).b

    np.testing.assert_allclose(b(far), [*2 * shift, *2 * turn], atol=1e-9)
    np.testing.assert_allclose(b(far, max_speed=0.5), [0.3, 0.4, 0.0, *2 * turn], atol=1e-9)
    np.testing.assert_allclose(b(far, max_turn_rate=0.5), [*2 * shift, 0.0, 0.3, 0.4], atol=1e-9)
    near = Sample.at(start.position + 1e-3 * shift, start.rotation)
    np.testing.assert_allclose(b(near, max_speed=0.5, max_turn_rate=0.5), [*2e-3 * shift, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(b(start, max_speed=0.5, max_turn_rate=0.5), 0.0, atol=1e-9)


def test_a_motion_without_a_start_begins_where_the_frame_is(panda):
    bench = Tasks.of_frames(panda, ["panda_hand_tcp"])
    start, here = bench.tasks[0].motion.sample(0.0), bench.poses(panda.home)[0]
    np.testing.assert_allclose(start.position, here.position, atol=1e-12)
    np.testing.assert_allclose(start.rotation, here.rotation, atol=1e-12)


def test_frames_of_locked_joints_can_still_be_followed(paper):
    """Locking the wrist leaves the tool where it was, and its rows are those of the joints that still move."""
    q = random_q(paper, np.random.default_rng(5))
    locked, q_left = paper.lock(["left_joint[67]", "right_*"], q, "test")
    assert locked.model.nv == 5
    whole, part = Tasks.of_frames(paper, ["left_tool"]), Tasks.of_frames(locked, ["left_tool"])
    np.testing.assert_allclose(part.poses(q_left)[0].position, whole.poses(q)[0].position, atol=1e-12)
    np.testing.assert_allclose(part.poses(q_left)[0].rotation, whole.poses(q)[0].rotation, atol=1e-12)
    np.testing.assert_allclose(part.compute(q_left).A, whole.compute(q).A[:, :5], atol=1e-12)


def test_unknown_frame(panda):
    with pytest.raises(UnknownName, match=r"bench\.yaml: tasks\.0\.frame: panda has no frame 'panda_hand_tpc'.*tcp"):
        Tasks.of_frames(panda, ["panda_hand_tpc"])


@pytest.mark.parametrize("q0", [np.zeros(3), np.full(7, np.nan)])
def test_a_configuration_that_is_none_is_refused(panda, q0):
    with pytest.raises(NumericalError, match=r"q0: (shape \(3,\), expected \(7,\)|NaN)"):
        build_tasks([config.Task(frame="panda_hand_tcp")], panda, q0)


EVERY_KIND = [
    config.Task(frame="panda_hand_tcp"),
    config.Task(frame="panda_link6", type="orientation", orientation_weight=0.1, name="turn"),
    config.RelativeTask(frame="panda_hand", relative_to="panda_link3", weight=0.2),
    config.ComTask(weight=0.3),
    config.PostureTask(weight=0.1),
    config.DampingTask(weight=0.01),
    config.LookAtTask(frame="panda_hand", motion=config.Fixed(position=(0.6, 0.2, 0.1)), weight=0.2),
    config.AlignTask(frame="panda_link7", direction=(0, 0, -1), weight=0.2),
    config.ManipulabilityTask(frame="panda_hand_tcp", weight=0.01),
]


def test_controllers_share_tasks_and_a_scene_without_disturbing_each_other(panda):
    """Interleaved steps of two that share them are those of two with tasks and scenes of their own, bit for bit."""

    def scene():
        return build_scene(panda, [obstacle("ball", SPHERE, (0.5, 0.1, 0.4))])

    def controllers(tasks, scenes):
        return [Controller(scene, list(part), dt=0.01) for part, scene in zip(tasks, scenes, strict=True)]

    built = [build_tasks(EVERY_KIND, panda, panda.home) for _ in range(3)]
    sharing, alone = controllers([built[0]] * 2, [scene()] * 2), controllers(built[1:], [scene(), scene()])
    states, rng = [panda.home, random_q(panda, np.random.default_rng(6), 0.2)], np.random.default_rng(7)
    for _ in range(20):
        for i, (one, other) in enumerate(zip(sharing, alone, strict=True)):
            axis = rng.normal(size=3)
            targets = {"posture": panda.home + rng.uniform(-0.2, 0.2, 7), "align": axis / np.linalg.norm(axis)}
            targets["com"] = Sample.at(rng.uniform(0.0, 0.3, 3), linear=rng.normal(size=3))
            found, expected = (controller.tick(states[i], targets=targets) for controller in (one, other))
            np.testing.assert_array_equal(found.problem.tracking.A, expected.problem.tracking.A)
            np.testing.assert_array_equal(found.problem.tracking.b, expected.problem.tracking.b)
            np.testing.assert_array_equal(found.errors, expected.errors)
            np.testing.assert_array_equal(found.solution.v, expected.solution.v)
            states[i] = pin.integrate(panda.model, states[i], 0.01 * found.solution.v)
