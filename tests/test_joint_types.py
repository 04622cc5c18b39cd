"""Every kind of joint through step, filter, simulation and log: nq differs from nv, and some joints follow others."""

import numpy as np
import pinocchio as pin
import pytest
import yaml
from conftest import EXAMPLES, SPHERE, differences, look, obstacle, random_q

from qpavoid import ConfigError, Controller, Log, Robot, Sample, build_scene, build_tasks, config, load_scenario
from qpavoid.model.kinematics import chains, max_lever_arm
from qpavoid.model.notes import RobotWarning
from qpavoid.run.simulate import simulate


def body(name, frame):
    return {"name": name, "frame": frame, "shape": {"type": "sphere", "radius": 0.03}}


ROBOTS = {
    "mimic": {
        "urdf": "baxter_description/urdf/baxter.urdf",
        "bodies": [body("finger", "l_gripper_r_finger_tip"), body("hand", "right_hand_link")],
    },
    "continuous": {
        "urdf": "kinova_description/robots/kinova.urdf",
        "bodies": [body("hand", "j2s6s200_link_6"), body("elbow", "j2s6s200_link_3")],
        "home": {"j2s6s200_joint_2": 2.5, "j2s6s200_joint_3": 1.3, "j2s6s200_joint_5": 1.0},
    },
    "planar": {
        "urdf": "tiago_description/robots/tiago_no_hand.urdf",
        "root_joint": "planar",
        "limits": {"velocity": {"root_joint": [3.0, 3.0, 3.0]}},
        "bodies": [body("hand", "arm_tool_link"), body("base", "base_link")],
    },
    "floating": {
        "urdf": "solo_description/robots/solo12.urdf",
        "root_joint": "free_flyer",
        "limits": {"velocity": {"root_joint": 3.0}},
        "bodies": [body("trunk", "base_link"), body("foot", "FL_FOOT")],
    },
}
TOOLS = {"mimic": "l_gripper_r_finger_tip", "continuous": "j2s6s200_end_effector", "planar": "arm_tool_link",
         "floating": "FL_FOOT"}  # fmt: skip


def load(name, **more):
    settings = {**ROBOTS[name], **more}
    return Robot.from_urdf(EXAMPLES / settings.pop("urdf"), **settings)


@pytest.fixture(scope="module", params=ROBOTS)
def named(request):
    return request.param, load(request.param)


def test_distances_change_as_the_rows_say(named):
    """By finite differences along every velocity coordinate."""
    _, robot = named
    scene = build_scene(robot, [obstacle("ball", SPHERE, (0.9, 0.4, 0.3))])
    q = random_q(robot, np.random.default_rng(1))
    expected = differences(lambda x: look(scene, x).distance.copy(), robot, q)
    np.testing.assert_allclose(look(scene, q).J, expected, atol=1e-6)


def test_bounds_of_looking_ahead_hold(named):
    """No point turns faster, and none lies farther from a joint that turns it, than is taken for granted."""
    _, robot = named
    model, rng = robot.model, np.random.default_rng(2)
    turning, sliding = chains(model)
    data = model.createData()
    lever_arm = max_lever_arm(model, np.zeros(model.njoints))
    for _ in range(20):
        q, v = random_q(robot, rng), rng.normal(size=model.nv)
        pin.forwardKinematics(model, data, q, v)
        velocities = np.array([motion.vector for motion in data.v])
        assert np.linalg.norm(velocities[:, 3:], axis=1).max() <= max(turning @ np.abs(v)) + 1e-9
        reach = max(turning @ np.abs(v)) * lever_arm + max(sliding @ np.abs(v))
        assert np.linalg.norm(velocities[:, :3], axis=1).max() <= reach + 1e-9


def test_a_run_from_file_to_log(named, tmp_path):
    name, robot = named
    q0 = robot.home
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q0)
    tool = data.oMf[robot.model.getFrameId(TOOLS[name])].translation
    settings = {**ROBOTS[name], "urdf": f"example-robot-data:{ROBOTS[name]['urdf']}"}
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump({"name": name, **settings}))
    scenario = {
        "robot": "robot.yaml",
        "tasks": [
            {"frame": TOOLS[name], "motion": {"type": "line", "displacement": [0.03, -0.03, 0.03], "speed": 0.06}},
            {"type": "posture", "weight": 1e-3},
            {"type": "damping", "weight": 1e-4},
        ],
        "obstacles": [
            {"name": "ball", "shape": SPHERE.model_dump(), "motion": {"type": "fixed", "position": [5.0, 0.0, 0.0]}}
        ],
        "duration": 2.0,
        "dt": 0.02,
    }
    (tmp_path / "run.yaml").write_text(yaml.safe_dump(scenario))
    log = simulate(load_scenario(str(tmp_path / "run.yaml")))
    assert log.q.shape[1:] == (robot.model.nq,) and log.v.shape[1:] == (robot.model.nv,)
    assert np.linalg.norm(log.tool[-1, 0] - tool - [0.03, -0.03, 0.03]) < 5e-3
    for before, v, after in zip(log.q[:-1], log.v[:-1], log.q[1:], strict=True):
        assert pin.isNormalized(robot.model, after, 1e-9)
        np.testing.assert_allclose(pin.difference(robot.model, before, after), 0.02 * v, atol=1e-9)
    again = Log.load(log.save(tmp_path / "log"))
    np.testing.assert_array_equal(again.task_error, log.task_error)
    assert again.metrics()["task_errors"].keys() == {"posture", "damping"}
    controller, q = Controller.from_scenario(load_scenario(str(tmp_path / "run.yaml")))
    wish = 1e-3 * np.arange(robot.model.nv)
    np.testing.assert_array_equal(controller.filter(q, wish).v, wish)


# Joints that follow others


def test_fingers_close_together():
    """One coordinate moves both; a finger that is to move takes the other one with it."""
    robot = load("mimic")
    assert "l_gripper_r_finger_joint" not in " ".join(robot.coordinate_names)
    data, ids = robot.model.createData(), [robot.model.getFrameId(f"l_gripper_{s}_finger") for s in "lr"]

    def fingers(q):
        pin.framesForwardKinematics(robot.model, data, q)
        return [data.oMf[i].translation.copy() for i in ids]

    q = robot.configuration({"l_gripper_l_finger_joint": 0.0}, "q0")
    bounds = robot.bounds()
    open_ = robot.configuration({"l_gripper_l_finger_joint": 0.02, "l_gripper_r_finger_joint": -0.02}, "q0")
    a, b = fingers(q), fingers(open_)
    np.testing.assert_allclose(np.linalg.norm(b[0] - a[0]), 0.02, atol=1e-9)
    np.testing.assert_allclose(b[0] - a[0], a[1] - b[1], atol=1e-9)
    others = [name for name in robot.joint_names if "finger" not in name]
    locked, q_left = robot.lock(others, q, "test")
    assert locked.model.nv == 2 and len(bounds.velocity) == robot.model.nv
    tasks = build_tasks([config.Task(frame="l_gripper_r_finger", gain=5.0)], locked, q_left)
    controller = Controller(build_scene(locked), tasks, dt=0.01)
    for _ in range(200):
        q_left = pin.integrate(
            locked.model, q_left, 0.01 * controller.step(q_left, targets={"l_gripper_r_finger": Sample.at(b[1])}).v
        )
    assert abs(q_left[locked.model.joints[locked.model.getJointId("l_gripper_l_finger_joint")].idx_q] - 0.02) < 1e-3


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        (
            {"home": {"l_gripper_l_finger_joint": 0.02, "l_gripper_r_finger_joint": 0.01}},
            "home: joint .*, to -0.02 and not",
        ),
        (
            {"lock": {"l_gripper_r_finger_joint": 0.0}},
            "lock: joint 'l_gripper_r_finger_joint' follows .*; lock that one",
        ),
        ({"limits": {"velocity": {"l_gripper_r_finger_joint": 0.1}}}, "limits.velocity: joint .*; limit that one"),
    ],
)
def test_a_joint_that_follows_has_nothing_of_its_own(fields, expected):
    with pytest.raises(ConfigError, match=expected):
        load("mimic", **fields)


def test_joints_that_cannot_be_read_as_followers_are_named(tmp_path):
    link = "".join(f'<link name="{name}"/>' for name in "abc")
    limit = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
    (tmp_path / "arm.urdf").write_text(
        f'<robot name="arm">{link}<joint name="j1" type="revolute"><parent link="a"/><child link="b"/>{limit}</joint>'
        '<joint name="j2" type="continuous"><parent link="b"/><child link="c"/><mimic joint="j1"/></joint></robot>'
    )
    with pytest.warns(
        RobotWarning, match=r"joint j2: should follow others \(mimic\), and move on their own.*hold them under `lock`"
    ):
        robot = Robot.from_urdf(tmp_path / "arm.urdf", bodies=[])
    assert robot.model.nv == 2
