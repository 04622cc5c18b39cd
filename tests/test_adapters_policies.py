"""Programs that are not installed here: positions of policies, LeRobot where it is, and ROS 2 with messages by hand."""

import importlib
import sys
import types
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from closed_loop import Ruler, accelerations

from qpavoid import Avoidance, ConfigError, Controller, Obstacle, Pose, Sample, build_scene
from qpavoid.adapters.actions import ActionFilter
from qpavoid.adapters.ros2 import NodeLogic
from qpavoid.config import Sphere

ROOT, D1, DT = Path(__file__).parents[1], 0.03, 1.0 / 30.0
SCENARIO = """
robot: panda-capsules
dt: 0.01
duration: 1.0
tasks: [{frame: panda_hand_tcp, name: hand}]
avoidance: {d1: 0.03, d2: 0.15}
obstacles:
- {name: ball, source: external, shape: {type: sphere, radius: 0.06}, motion: {type: fixed, position: [0.3, 0.3, 0.5]}}
"""
PLACE, UPRIGHT = (0.22, 0.23, 0.5), (0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text(SCENARIO)
    return str(path)


def scene(panda):
    return build_scene(panda, [Obstacle.at("ball", Sphere(radius=0.06), PLACE)])


def make_filter(panda):
    return ActionFilter(Controller(scene(panda), [], dt=DT, avoidance=Avoidance(d1=D1, d2=0.15)))


def swing(panda, k):
    """Actions that swing the hand through the ball."""
    angle = 0.5 * (1.0 - np.cos(0.03 * np.asarray(k, dtype=float)))
    return panda.home + np.multiply.outer(angle, [1.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0])


def least(panda, qs, places=None):
    ruler = Ruler(scene(panda))
    to_ball = ruler.scene.obstacle_of[ruler.scene.pairs[:, 1]] >= 0
    places = [PLACE] * len(qs) if places is None else places
    return min(ruler.distances(q, {0: Sample.at(p)})[to_ball].min() for q, p in zip(qs, places, strict=True))


# --- actions ------------------------------------------------------------------------------------------------------


def test_actions_that_lead_into_a_ball_do_not(panda):
    safe, q, sent = make_filter(panda), panda.home, []
    for k in range(200):
        q = safe(q, swing(panda, k))
        sent.append(q)
    assert least(panda, swing(panda, np.arange(200))) < 0.0 and least(panda, sent) > D1 - 1e-3
    np.testing.assert_allclose(sent[:12], swing(panda, np.arange(12)), atol=1e-12)  # far from it, as they were
    np.testing.assert_allclose(sent[-1], swing(panda, 199), atol=1e-6)  # and when they lead away


def test_an_action_far_off_is_reached_straight_and_without_overshoot(panda):
    """Within speeds and accelerations; the setpoint goes on where servos lag, and nothing is asked twice."""
    safe, goal, sent, q = (
        make_filter(panda),
        panda.home + np.array([-0.8, 0.2, 0.0, 0.1, 0.0, 0.0, 0.3]),
        [],
        panda.home,
    )
    for _ in range(90):
        sent.append(safe(q, goal))
        q = q + 0.3 * (sent[-1] - q)
    v = np.diff(sent, axis=0, prepend=panda.home[None]) / DT
    np.testing.assert_allclose(sent[-1], goal, atol=1e-6)
    assert (accelerations(v, DT) <= panda.bounds().acceleration + 1e-6).all()
    assert (np.abs(v) <= panda.bounds().velocity + 1e-9).all()
    along = (np.array(sent) - panda.home) @ (goal - panda.home) / np.sum((goal - panda.home) ** 2)
    assert along.max() < 1.0 + 1e-6 and (np.diff(along) > -1e-9).all()
    np.testing.assert_allclose(sent, panda.home + np.outer(along, goal - panda.home), atol=1e-6)


def test_a_chunk_is_what_its_actions_become(panda):
    """Of a ball that rests; nothing is remembered of it. One that comes nearer is met earlier."""
    safe, actions, rest = make_filter(panda), swing(panda, np.arange(60)), {"ball": Pose.at(PLACE)}
    chunk = safe.chunk(panda.home, actions, rest)
    q, sent = panda.home, []
    for action in actions:
        q = safe(q, action, obstacles=rest)
        sent.append(q)
    np.testing.assert_allclose(chunk.actions, sent, atol=1e-9)
    assert chunk.changed == np.flatnonzero(np.abs(sent - actions).max(axis=1) > 1e-6)[0] > 10
    np.testing.assert_array_equal(chunk.actions[: chunk.changed], actions[: chunk.changed])
    safe.reset()
    start = np.add(PLACE, [0.0, 0.3, 0.0])
    comes = {"ball": Sample.at(start, linear=[0.0, -0.3, 0.0])}
    chunk = safe.chunk(panda.home, actions, comes)
    places = [start - [0.0, 0.3 * DT * k, 0.0] for k in range(1, 61)]
    assert least(panda, actions, places) < 0.0 and least(panda, chunk.actions, places) > 0.015


def test_a_robot_with_other_joints_is_refused(solo):
    with pytest.raises(ConfigError, match="lock it"):
        ActionFilter(Controller(build_scene(solo), []))


# --- LeRobot ------------------------------------------------------------------------------------------------------


def test_step_of_a_lerobot_pipeline(panda, scenario):
    """In degrees, with a gripper that is no joint of the robot; where LeRobot is installed."""
    pytest.importorskip("lerobot")
    from lerobot.processor import RobotProcessorPipeline
    from lerobot.processor.converters import robot_action_observation_to_transition, transition_to_robot_action

    from qpavoid.adapters.lerobot import SafetyFilterStep

    step = SafetyFilterStep(scenario)
    pipeline = RobotProcessorPipeline(
        steps=[step], to_transition=robot_action_observation_to_transition, to_output=transition_to_robot_action
    )
    q, sent = panda.home, []

    def as_keys(q):
        keys = {f"{name}.pos": x for name, x in zip(panda.joint_names, np.rad2deg(q).tolist(), strict=True)}
        return {**keys, "gripper.pos": 40.0}

    for k in range(0, 200):
        step.obstacles.put("ball", Pose.at(PLACE))
        action = pipeline((as_keys(swing(panda, 0.3 * k)), as_keys(q)))
        assert action.keys() == as_keys(q).keys() and action["gripper.pos"] == 40.0
        q = np.deg2rad([action[f"{name}.pos"] for name in panda.joint_names])
        sent.append(q)
    assert least(panda, swing(panda, np.arange(60))) < 0.0 and least(panda, sent) > D1 - 1e-3
    assert SafetyFilterStep(**step.get_config()).get_config() == step.get_config()


# --- ROS 2 --------------------------------------------------------------------------------------------------------


def test_messages_lead_to_safe_velocities(panda, scenario):
    """Joint states in another order and of a gripper, a ball at 33 Hz, a joystick that ends: safe, then at rest."""
    node = NodeLogic(scenario)
    assert node.step(0.0) is None  # no joint state yet
    q, names, sent, places = panda.home, ["finger", *reversed(panda.joint_names)], [], []
    for k in range(400):
        t = 0.01 * k
        node.joint_state(names, [0.0, *q[::-1]], t)
        node.joint_state(["gripper"], [0.1], t)
        if k % 3 == 0:
            node.obstacle("ball", PLACE, UPRIGHT, t)
        if k < 300:
            node.desired([] if k % 2 else panda.joint_names, 0.4 * np.eye(7)[0], t)
        command = node.step(t)
        q = q + 0.01 * command.velocities
        np.testing.assert_allclose(command.positions, q, atol=1e-12)
        sent.append(q)
        places.append(PLACE)
    assert list(command.names) == panda.joint_names
    assert least(panda, [panda.home + 0.004 * k * np.eye(7)[0] for k in range(300)]) < 0.0
    assert least(panda, sent) > D1 - 1e-3
    assert not command.velocities.any()


def test_missing_joint_states_and_obstacles_stop_the_robot(panda, scenario):
    node, q = NodeLogic(scenario, timeout=0.05), panda.home
    for k in range(30):
        t = 0.01 * k
        if k < 10:
            node.joint_state(panda.joint_names, q, t)
        node.obstacle("ball", PLACE if k % 2 else (np.nan, 0.0, 0.0), UPRIGHT if k % 3 else (0.0, 0.0, 0.0, 0.0), t)
        node.desired([], -0.2 * np.eye(7)[0], t)
        command = node.step(t)
        q = q + 0.01 * command.velocities
        if k == 9:
            assert command.velocities[0] < -0.1
    assert command.solution.status.value == "STOPPED" and not command.velocities.any()
    assert ("IMPLAUSIBLE", ("q",)) in {reason.key for reason in command.solution.reasons}
    with pytest.raises(ConfigError, match=r"mode: 'follow', expected one of filter, tasks"):
        NodeLogic(scenario, mode="follow")


def test_targets_are_followed_until_another_one_comes(panda, scenario):
    node, q = NodeLogic(scenario, mode="tasks"), panda.home
    for k in range(300):
        node.joint_state(panda.joint_names, q, 0.01 * k)
        node.obstacle("ball", PLACE, UPRIGHT, 0.01 * k)
        if k == 0:
            node.target("hand", (0.4, -0.1, 0.5), UPRIGHT)
        command = node.step(0.01 * k)
        q = q + 0.01 * command.velocities
    node.controller.reset()
    tick = node.controller.tick(q, obstacles={"ball": Pose.at(PLACE)})
    np.testing.assert_allclose(tick.kinematics.position[0], [0.4, -0.1, 0.5], atol=1e-3)


class Message(types.SimpleNamespace):
    """A message: fields as they are given or taken."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        value = Message()
        setattr(self, name, value)
        return value


def message(name):
    return type(name, (Message,), {})


class FakeNode:
    """A node of rclpy, with a clock that is set, and messages that are given and taken by hand."""

    parameters: dict[str, object] = {}  # noqa: RUF012

    def __init__(self, name):
        self.name, self.now, self.subscribed, self.published, self.timers, self.errors = name, 5.0, {}, {}, [], []

    def declare_parameter(self, name, value):
        return Message(value=self.parameters.get(name, value))

    def get_clock(self):
        return Message(now=lambda: Message(nanoseconds=round(1e9 * self.now)))

    def get_logger(self):
        return Message(error=self.errors.append)

    def create_subscription(self, kind, topic, call, depth):
        self.subscribed[topic] = call

    def create_publisher(self, kind, topic, depth):
        self.published[topic] = []
        return Message(publish=self.published[topic].append)

    def create_timer(self, period, call):
        self.timers.append((period, call))


@pytest.fixture
def node_module(monkeypatch):
    """The node's module, with what it needs of ROS 2 in its place."""
    modules = {
        "rclpy": {}, "rclpy.node": {"Node": FakeNode}, "geometry_msgs.msg": {"PoseStamped": message("PoseStamped")},
        "sensor_msgs.msg": {"JointState": message("JointState")},
        "std_msgs.msg": {"Float64MultiArray": message("Float64MultiArray"), "String": message("String")},
        "trajectory_msgs.msg": {
            "JointTrajectory": message("JointTrajectory"), "JointTrajectoryPoint": message("JointTrajectoryPoint")
        },
    }  # fmt: skip
    for name, members in modules.items():
        module = types.ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.setitem(sys.modules, name.split(".")[0], sys.modules.get(name.split(".")[0], module))
    yield importlib.import_module("qpavoid.adapters.ros2_node")
    del sys.modules["qpavoid.adapters.ros2_node"]


@pytest.mark.parametrize("output", ["velocity", "trajectory"])
def test_the_node_wires_topics(node_module, monkeypatch, panda, scenario, output):
    monkeypatch.setattr(FakeNode, "parameters", {"scenario": scenario, "output": output})
    node = node_module.QpavoidNode()
    ((period, step),), q = node.timers, panda.home.copy()
    assert period == 0.01
    step()
    assert not any(node.published.values())
    for k in range(20):
        node.subscribed["joint_states"](Message(name=panda.joint_names, position=q.tolist()))
        node.subscribed["~/desired"](Message(name=[], velocity=[-0.2] + 6 * [0.0]))
        stamp = Message(sec=int(node.now), nanosec=round(1e9 * (node.now % 1.0)))
        header = Message(frame_id="" if k else "camera", stamp=stamp)
        pose = Message(position=Message(x=0.3, y=0.3, z=0.5), orientation=Message(x=0.0, y=0.0, z=0.0, w=1.0))
        node.subscribed["~/obstacles/ball"](Message(header=header, pose=pose))
        node.now += 0.01
        step()
        last = node.published[f"~/{output}"][-1]
        v = np.array(last.data if output == "velocity" else last.points[0].velocities)
        q = q + 0.01 * v
    assert v == pytest.approx([-0.2] + 6 * [0.0])
    assert len(node.errors) == 1 and "expected 'world'" in node.errors[0]
    if output == "trajectory":
        assert last.joint_names == panda.joint_names and last.points[0].time_from_start.nanosec == 10_000_000
        np.testing.assert_allclose(last.points[0].positions, q, atol=1e-12)
    assert node.published["~/status"][-1].data.startswith("SOLVED") and "~/targets/hand" in node.subscribed


def test_the_launch_file_starts_the_node():
    (run,) = ET.parse(ROOT / "examples" / "adapters" / "ros2_filter.launch.xml").getroot().findall("executable")
    command = run.get("cmd", "").split()
    assert command[:3] == ["python3", "-m", "qpavoid.adapters.ros2_node"]
    assert (ROOT / "qpavoid" / "adapters" / "ros2_node.py").is_file() and "-p scenario:=$(var scenario)" in run.get(
        "cmd", ""
    )
