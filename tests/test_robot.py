"""Robots from files: what is read, what is locked, and how a mistake is reported."""

import numpy as np
import pinocchio as pin
import pytest
from conftest import EXAMPLES, random_q, write_chain
from urdfs import write_stl

from qpavoid import ConfigError, Controller, Robot, UnknownName, load_scenario


def body_poses(robot, q):
    """World pose (4, 4) of every body, by name."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    return {b.name: (data.oMi[b.parentJoint] * b.placement).homogeneous for b in robot.bodies.geometryObjects}


def frame_pose(robot, name, q):
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    return data.oMf[robot.frame_id(name, "test")].homogeneous


# --- where robots come from ----------------------------------------------------------------------------------------


def test_robot_of_ones_own_in_a_scenario(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    write_chain(folder)
    (folder / "robot.yaml").write_text(
        "name: mine\nurdf: chain.urdf\nend_effectors: [link3]\nhome: {joint2: 0.5}\nlimits: {velocity: {joint1: 0.2}}\n"
    )
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(
        "robot: mine/robot.yaml\nq0: {joint3: 0.25}\nduration: 0.1\n"
        "tasks:\n  - {frame: link3, motion: {type: fixed}}\n"
        "obstacles:\n  - {name: ball, shape: {type: sphere, radius: 0.1}, motion: {type: fixed, position: [1, 0, 0]}}\n"
    )
    controller, q0 = Controller.from_scenario(load_scenario(scenario))
    assert controller.scene.robot.name == "mine"
    np.testing.assert_array_equal(q0, [0.0, 0.5, 0.25])
    np.testing.assert_allclose(controller.step(q0).v, 0.0, atol=1e-9)
    scenario.write_text(scenario.read_text().replace("robot.yaml", "chain.urdf"))
    controller, q0 = Controller.from_scenario(load_scenario(scenario))
    np.testing.assert_array_equal(q0, [0.0, 0.0, 0.25])


def test_mesh_is_found_in_package_dirs_and_along_ros_package_path(tmp_path, monkeypatch):
    folder, mesh = tmp_path / "robot", tmp_path / "packages" / "parts" / "meshes" / "a.stl"
    mesh.parent.mkdir(parents=True)
    folder.mkdir()
    write_stl(mesh)
    urdf = write_chain(folder, shape='<mesh filename="package://parts/meshes/a.stl"/>')
    with pytest.raises(ConfigError):
        Robot.from_urdf(urdf)
    assert len(Robot.from_urdf(urdf, package_dirs=["../packages"]).bodies.geometryObjects) == 4
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "packages"))
    assert len(Robot.from_urdf(urdf).bodies.geometryObjects) == 4


# --- what is in them ---------------------------------------------------------------------------------------------


def test_home_is_zero_or_the_middle_of_the_range(panda):
    bare = Robot.from_urdf(EXAMPLES / "panda_description/urdf/panda.urdf", bodies=[])
    middle = 0.5 * (bare.model.lowerPositionLimit[3] + bare.model.upperPositionLimit[3])
    np.testing.assert_allclose(bare.home[:4], [0.0, 0.0, 0.0, middle])
    np.testing.assert_allclose(panda.home[:4], [0.0, -0.785398, 0.0, -2.356194])


def test_configuration_from_a_list_or_by_name(panda):
    values, home = [0.1, -0.2, 0.3, -1.0, 0.5, 1.0, 0.7], panda.home.copy()
    np.testing.assert_array_equal(panda.configuration(values, "q0"), values)
    by_name = panda.configuration({"panda_joint2": 0.25, "panda_joint7": -1.0}, "q0")
    np.testing.assert_array_equal(by_name, [*home[:1], 0.25, *home[2:6], -1.0])
    np.testing.assert_array_equal(panda.configuration({}, "q0"), home)
    with pytest.raises(ConfigError, match=r"file: q0: 3 values for 7 coordinates; the order is panda_joint1, panda"):
        panda.configuration([0.0, 1.0, 2.0], "file: q0")


def test_limits_override_those_of_the_urdf(tmp_path):
    urdf = write_chain(tmp_path)
    limits = {"position": {"joint1": [-0.5, 0.25]}, "velocity": {"joint3": 0.1}}
    bounds = Robot.from_urdf(urdf, limits=limits).bounds()
    np.testing.assert_array_equal(bounds.lower, [-0.5, -2.0, -2.0])
    np.testing.assert_array_equal(bounds.upper, [0.25, 2.0, 2.0])
    np.testing.assert_array_equal(bounds.velocity, [1.5, 1.5, 0.1])


def test_continuous_joints_have_two_numbers_in_q_and_no_position_limit(tmp_path):
    robot = Robot.from_urdf(write_chain(tmp_path, joint_type="continuous"))
    assert (robot.model.nq, robot.model.nv) == (6, 3)
    assert robot.coordinate_names == robot.joint_names
    np.testing.assert_array_equal(robot.home, [1.0, 0.0] * 3)
    q = robot.configuration({"joint2": 0.7}, "q0")
    np.testing.assert_allclose(q, [1.0, 0.0, np.cos(0.7), np.sin(0.7), 1.0, 0.0])
    np.testing.assert_allclose(pin.difference(robot.model, robot.home, q), [0.0, 0.7, 0.0], atol=1e-12)
    bounds = robot.bounds()
    assert bounds.q_index.size == 0
    np.testing.assert_array_equal(bounds.velocity, 1.5)
    locked, rest = robot.lock(["joint2"], q, "lock")
    np.testing.assert_array_equal(rest, [1.0, 0.0, 1.0, 0.0])
    np.testing.assert_allclose(frame_pose(locked, "link3", rest), frame_pose(robot, "link3", q), atol=1e-12)


def test_a_joint_of_many_coordinates_cannot_be_set_by_one_number(solo):
    with pytest.raises(ConfigError, match=r"q0: joint 'root_joint' has 7 coordinates; give q0 as a list"):
        solo.configuration({"root_joint": 1.0}, "q0")


# --- lock ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["paper", "panda", "solo"])
def test_lock_leaves_every_pose_where_it_is(name, request):
    robot = request.getfixturevalue(name)
    rng = np.random.default_rng(1)
    q = random_q(robot, rng)
    held = [robot.joint_names[i] for i in (1, 3, 4)]
    locked, kept = robot.lock(held, q, "lock")
    assert locked.joint_names == [name for name in robot.joint_names if name not in held]
    # also after the joints that are left have moved
    v = np.zeros(robot.model.nv)
    free = [robot.model.joints[robot.model.getJointId(n)] for n in locked.joint_names]
    columns = np.concatenate([np.arange(j.idx_v, j.idx_v + j.nv) for j in free])
    v[columns] = rng.uniform(-1.0, 1.0, len(columns))
    whole, part = pin.integrate(robot.model, q, v), pin.integrate(locked.model, kept, v[columns])
    poses, expected = body_poses(locked, part), body_poses(robot, whole)
    assert poses.keys() == expected.keys()
    for body, pose in poses.items():
        np.testing.assert_allclose(pose, expected[body], atol=1e-12)


def test_patterns_of_a_lock(paper):
    locked, _ = paper.lock(["right_joint1", "right_*", "*_joint[12]"], paper.home, "lock")
    assert locked.joint_names == [f"left_joint{i}" for i in range(3, 8)]
    assert paper.lock([], paper.home, "lock")[0] is paper


def test_lock_in_the_robot_file_is_the_same_as_a_joint_held_there(tmp_path):
    urdf = write_chain(tmp_path)
    whole, held = Robot.from_urdf(urdf), Robot.from_urdf(urdf, lock={"joint2": 0.4}, home={"joint3": 0.1})
    np.testing.assert_array_equal(held.home, [0.0, 0.1])
    q = np.array([0.2, 0.4, -0.3])
    np.testing.assert_allclose(frame_pose(held, "link3", q[[0, 2]]), frame_pose(whole, "link3", q), atol=1e-12)


# --- mistakes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"home": {"jont1": 0.0}}, r"home: no joint 'jont1'; did you mean 'joint1'\?"),
        ({"lock": {"jont1": 0.0}}, r"lock: no joint 'jont1'; did you mean 'joint1'\?"),
        ({"limits": {"velocity": {"joint_1": 1.0}}}, r"limits\.velocity: no joint 'joint_1'; did you mean 'joint1'\?"),
        ({"limits": {"position": {"jnt2": [0, 1]}}}, r"limits\.position: no joint 'jnt2'; did you mean"),
        ({"end_effectors": ["lnk3"]}, r"end_effectors: no frame 'lnk3'; did you mean 'link3'\?"),
        (
            {"bodies": [{"name": "a", "frame": "lnk3", "shape": {"type": "sphere", "radius": 0.1}}]},
            r"bodies\.0\.frame: no frame 'lnk3'; did you mean 'link3'\?",
        ),
    ],
)
def test_unknown_names_come_with_the_nearest(tmp_path, fields, message):
    with pytest.raises(UnknownName, match=rf"chain\.urdf: {message}"):
        Robot.from_urdf(write_chain(tmp_path), **fields)


def test_unknown_names_at_run_time(panda):
    with pytest.raises(UnknownName, match=r"file: q0: no joint 'panda_jiont3'; did you mean 'panda_joint3'\?"):
        panda.configuration({"panda_jiont3": 0.0}, "file: q0")
    with pytest.raises(
        UnknownName, match=r"file: lock: panda-capsules has no joint 'panda_jo1nt3'; did you mean 'panda_joint3'\?"
    ):
        panda.lock(["panda_jo1nt3"], panda.home, "file: lock")
    with pytest.raises(UnknownName, match=r"panda-capsules has no frame 'panda_hnd'; did you mean 'panda_hand'\?"):
        panda.frame_id("panda_hnd", "file: frame")
    with pytest.raises(UnknownName, match=r"unknown robot 'pandaa'; did you mean 'panda'\?"):
        Robot.load("pandaa")


def test_missing_urdf(tmp_path):
    (tmp_path / "robot.yaml").write_text("name: x\nurdf: none.urdf\n")
    with pytest.raises(
        ConfigError, match=r"robot\.yaml: urdf: no such file 'none\.urdf'; give a path relative to this"
    ):
        Robot.load(str(tmp_path / "robot.yaml"))
    with pytest.raises(ConfigError, match=r"none\.urdf: no such file; give a robot file, or one of baxter, g1, panda"):
        Robot.load(str(tmp_path / "none.urdf"))
    with pytest.raises(ConfigError, match=r"none\.urdf: .*no such file"):
        Robot.from_urdf(tmp_path / "none.urdf")


@pytest.mark.parametrize("text", ["<robot name='x'><link", "not XML at all", "<robot name='x'/>", ""])
def test_broken_urdf_is_one_line_and_nothing_else(tmp_path, capfd, text):
    path = tmp_path / "broken.urdf"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"broken\.urdf: not a usable URDF: \w+") as error:
        Robot.from_urdf(path)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_position_limits_of_a_joint_that_cannot_have_them(tmp_path):
    urdf = write_chain(tmp_path, joint_type="continuous")
    with pytest.raises(ConfigError, match=r"limits\.position: .*joint1"):
        Robot.from_urdf(urdf, limits={"position": {"joint1": [-1.0, 1.0]}})
