"""`qpavoid robot check` and `add` as a user meets them, and the robots that ship."""

import json
import math
import re
import shlex

import numpy as np
import pytest
import yaml
from conftest import EXAMPLES, write_chain
from urdfs import write_stl

from qpavoid import Robot, load_scenario
from qpavoid.config import RobotConfig
from qpavoid.config.loading import read_config
from qpavoid.config.shipped import find_robot
from qpavoid.model.notes import RobotWarning
from qpavoid.model.packages import find_mesh
from qpavoid.run.simulate import simulate
from qpavoid.setup import commands
from qpavoid.setup.add import DescribeOptions, describe
from qpavoid.setup.check import check_robot
from qpavoid.setup.sampling import touching

MADE = ("baxter", "g1", "tiago", "ur5")
"""Robots that ship as `robot add` wrote them."""
MJCF = """
<mujoco model="arm"><compiler angle="radian"/><worldbody><geom type="plane" size="1 1 1"/>
  <body name="base"><geom type="box" size=".1 .1 .1"/>
    <body name="upper" pos="0 0 .2"><joint name="turn" type="hinge" axis="0 0 1" range="-2 2"/>
      <geom type="capsule" fromto="0 0 0 0 0 .3" size=".04"/>
      <body name="lower" pos="0 0 .3"><joint name="bend" type="hinge" axis="0 1 0" range="-2 2"/>
        <geom type="cylinder" fromto="0 0 0 0 0 .3" size=".04"/><site name="tool" pos="0 0 .35"/>
</body></body></body></worldbody></mujoco>
"""


def problems(report, severity=None):
    return " | ".join(
        f"{', '.join(note.subject)}: {note.what} → {note.remedy}"
        for note in report.notes
        if severity in (None, note.severity)
    )


# --- check ----------------------------------------------------------------------------------------------------


def test_a_ready_robot_has_no_problem(cli):
    result = cli("robot", "check", "panda")
    assert result.status == 0
    assert not re.search(r"^(error|warning)", result.stdout, re.MULTILINE)
    assert "panda_joint4 [-3.07, -0.0698]" in result.stdout
    assert "panda_finger_joint2 mimics panda_finger_joint1 locked" in result.stdout


def test_json_is_all_there_is_on_stdout(cli):
    urdf = EXAMPLES / "ur_description/urdf/ur5_robot.urdf"
    result = cli("robot", "check", urdf, "--json")
    report = json.loads(result.stdout)
    assert (result.status, report["usable"], report["nq"], report["nv"]) == (0, True, 6, 6)
    assert report["shapes"] == {"mesh": 7, "box": 1} and report["triangles"] == 5328
    assert report["end_effectors"] == ["tool0"]
    assert [j["kind"] for j in report["joints"]].count("fixed") == 4
    assert 1.0 < report["tick_us"] < 1e5 and report["home_collisions"] == []
    assert any("singular" in note["what"] for note in report["notes"])  # stretched out at zero
    assert report["conditioning"]["tool0"]["value"] < 1e-6 < report["conditioning"]["tool0"]["typical"]


def test_missing_meshes_are_named_with_where_they_were_looked_for(cli, tmp_path):
    shape = '<mesh filename="package://arm/hand.stl"/>'
    urdf = write_chain(tmp_path, shape=shape)
    result = cli("robot", "check", urdf)
    assert result.status == 1
    assert "collision meshes are missing, such as 'package://arm/hand.stl'; looked for in" in result.stdout
    assert str(tmp_path) in result.stdout and "--package-dir" in result.stdout
    (tmp_path / "elsewhere" / "arm").mkdir(parents=True)
    write_stl(tmp_path / "elsewhere" / "arm" / "hand.stl")
    assert cli("robot", "check", urdf, "--package-dir", tmp_path / "elsewhere").status == 0
    assert cli("robot", "check", urdf, "--package", f"arm={tmp_path}/elsewhere/arm").status == 0
    assert "left out" in cli("robot", "check", urdf, "--allow-missing-meshes").stdout
    assert cli("robot", "add", urdf, "--package-dir", tmp_path / "elsewhere", "--samples", "50").status == 0
    assert yaml.safe_load((tmp_path / "chain" / "robot.yaml").read_text())["package_dirs"] == ["../elsewhere"]
    assert Robot.load("chain/robot.yaml").bodies.ngeoms == 4


def test_a_mesh_that_was_left_out_is_named_by_every_later_check_and_load(cli, tmp_path):
    urdf = write_chain(tmp_path)
    rod, mesh = '<cylinder radius="0.03" length="0.2"/>', '<mesh filename="package://arm/hand.stl"/>'
    head, link3, tail = urdf.read_text().partition('<link name="link3">')
    urdf.write_text(head + link3 + tail.replace(rod, mesh, 1))
    added = cli("robot", "add", urdf, "--allow-missing-meshes", "--samples", "50")
    assert added.status == 0 and "link3_0: left out: a mesh in package://arm is missing" in added.stdout
    checked = cli("robot", "check", "chain/robot.yaml")
    assert checked.status == 0
    assert len(re.findall(r"^warning  mesh .*link3_0: left out: a mesh in package://arm", checked.stdout, re.M)) == 1
    with pytest.warns(RobotWarning, match="link3_0: left out: a mesh in package://arm is missing"):
        Robot.load("chain/robot.yaml")
    (tmp_path / "arm").mkdir()  # the mesh turns up, and the bodies were listed without it
    write_stl(tmp_path / "arm" / "hand.stl")
    with pytest.warns(RobotWarning, match="link link3: none of the listed bodies is theirs"):
        Robot.load("chain/robot.yaml", package_dirs=[".."])


@pytest.mark.parametrize("name", ["package://arm/hand.stl", "package:///arm/hand.stl", "model://arm/hand.stl"])
def test_meshes_are_looked_for_as_pinocchio_does(tmp_path, name):
    (tmp_path / "arm").mkdir()
    (tmp_path / "arm" / "hand.stl").touch()
    assert find_mesh(name, ["/nowhere", str(tmp_path)]) == str(tmp_path / "arm" / "hand.stl")
    assert find_mesh(f"file://{tmp_path}/arm/hand.stl", ["/nowhere"]) == str(tmp_path / "arm" / "hand.stl")
    assert find_mesh(name.replace("hand", "foot"), ["/nowhere", str(tmp_path)]) is None


def test_limits_that_cannot_be_meant(tmp_path):
    urdf = write_chain(tmp_path, 4)
    old = '<limit lower="-2" upper="2" velocity="1.5" effort="1"/>'
    text = urdf.read_text()
    for new in (
        '<limit lower="0" upper="0" velocity="0" effort="1"/>',
        '<limit lower="-99" upper="99" velocity="1e3" effort="1"/>',
        '<limit lower="0" upper="0.0001" velocity="1" effort="1"/>',
    ):  # fmt: skip
        text = text.replace(old, new, 1)
    urdf.write_text(text)
    report = check_robot(str(urdf))
    text = problems(report, "warning")
    assert "joint1: locked at 0, which is its lower and its upper limit" in text
    assert "joint2: a velocity limit beyond what such joints do →" in text
    assert "joint2: a range wider than such joints have →" in text
    assert "joint3: hardly any range → `lock" in text
    assert "joint4" not in text
    assert report.usable


def test_check_names_mimic_joints_masses_feet_and_home_collisions(tmp_path):
    urdf = write_chain(tmp_path, 3, shape='<sphere radius="0.35"/>')
    urdf.write_text(
        urdf.read_text().replace('<child link="link3"/>', '<child link="link3"/><mimic joint="joint1"/>')
        .replace("link3", "left_foot")
    )  # fmt: skip
    report = check_robot(str(urdf))
    text = problems(report)
    joints = {joint.name: joint for joint in report.joints}
    assert joints["joint3"].led and joints["joint3"].mimics == "joint1" and joints["joint3"].kind == "revolute"
    assert report.nv == 2 and "joint3" not in text
    assert "3 moving links have no mass → none is needed" in text
    assert "it has feet (left_foot) and a fixed base → `root_joint: free_flyer`" in text
    assert [(a, b) for a, b, _ in report.home_collisions] or "its bodies touch in 100 % of" in text
    assert check_robot(str(urdf), root="free_flyer").nv == 8


def test_no_bodies_is_an_error_with_its_remedy(cli, tmp_path):
    urdf = write_chain(tmp_path)
    urdf.write_text(urdf.read_text().replace("collision>", "visual>"))
    result = cli("robot", "check", urdf)
    assert result.status == 0 and "what is meant to be seen of it serves instead" in result.stdout
    urdf.write_text(urdf.read_text().replace("visual>", "nothing>"))
    result = cli("robot", "check", urdf)
    assert result.status == 1
    assert "it has no collision bodies: nothing would be avoided" in result.stdout
    assert "robot add" in result.stdout


def test_mjcf_is_read_checked_and_added(cli, tmp_path):
    (tmp_path / "arm.xml").write_text(MJCF)
    report = check_robot("arm.xml")
    assert report.shapes == {"box": 1, "capsule": 1, "cylinder": 1}  # the floor is the world's
    assert report.end_effectors == ["tool"] and report.nq == 2
    assert "turn, bend: no velocity limit" in problems(report)
    assert cli("robot", "add", "arm.xml").status == 0
    assert [body.name for body in Robot.load("arm/robot.yaml").bodies.geometryObjects] == ["base", "upper", "lower"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco/>", "worldbody has no body"),
        ("<robot/>", "its root is <robot>; must be <mujoco>"),
        (MJCF.replace('pos="0 0 .2"', 'pos="0 0 nan"'), r"body pos='0 0 nan': must be finite"),
        (MJCF.replace("<worldbody>", '<include file="x.xml"/><worldbody>'), "it has an <include>"),
        (MJCF.replace('<joint name="turn"', '<joint class="a" name="turn"'), "a name that it does not define|class"),
        ("<mujoco><worldbody>", "not a usable MJCF"),
    ],
)
def test_bad_mjcf_is_refused_in_one_line(cli, tmp_path, text, message):
    (tmp_path / "arm.xml").write_text(text)
    for command in ("check", "add"):
        result = cli("robot", command, "arm.xml")
        assert result.status == 2 and result.stdout == ""
        (line,) = [
            line for line in result.stderr.splitlines() if not line.endswith("…")
        ]  # what a busy machine waits for
        assert line.startswith("error: ") and "arm.xml" in line
        assert re.search(message, line)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["check", "pandaa"], ["unknown robot 'pandaa'", "did you mean 'panda'"]),
        (["check", "none.urdf"], ["none.urdf: no such file"]),
        (["check", "example-robot-data:none.urdf"], ["none.urdf: no such file", "example-robot-data: holds ", "ur_d"]),
        (
            ["check", "example-robot-data:xarm_description/urdf/wrong.urdf"],
            ["wrong.urdf: no such file; example-robot-data:xarm_description/urdf holds ", "xarm7.urdf"],
        ),
        (["check", "panda", "--root", "wheels"], ["--root: 'wheels' is none of fixed, planar, free_flyer"]),
        (["add", "panda"], ["panda: is described already; give a URDF or MJCF"]),
        (["add", "chain.urdf", "--bodies", "box"], ["--bodies box: 'box' is none of auto, capsule, capsules, convex"]),
        (["add", "chain.urdf", "--bodies", "arm=auto"], ["--bodies: no link with geometry 'arm'"]),
        (["add", "chain.urdf", "--lock", "joint9"], ["--lock: no joint 'joint9'; did you mean 'joint"]),
        (["add", "chain.urdf", "--home", "joint1"], ["--home joint1: expected JOINT=VALUE"]),
        (["add", "chain.urdf", "--home", "joint1=nan"], ["--home joint1=nan: expected JOINT=VALUE"]),
        (["add", "chain.urdf", "--home", "j=1"], ["--home: no joint 'j'"]),
        (["add", "chain.urdf", "--home", "joint1=90"], ["--home: joint1 = 90 lies outside its limits"]),
        (["check", "chain.urdf", "--package", "arm=none"], ["--package arm=none: no such folder 'none'"]),
        (["add", "chain.urdf", "--srdf", "none.srdf"], ["none.srdf", "cannot be read"]),
        (["add", "chain.urdf", "--out", "chain.urdf"], ["chain.urdf", "--out"]),
    ],
)
def test_bad_arguments_are_refused_in_one_line(cli, tmp_path, arguments, words):
    write_chain(tmp_path)
    result = cli("robot", *arguments)
    assert result.status == 2 and result.stdout == ""
    (line,) = [line for line in result.stderr.splitlines() if not line.endswith("…")]  # what a busy machine waits for
    assert line.startswith("error: ") and all(word in line for word in words)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["chain.urdf"]


# --- add ------------------------------------------------------------------------------------------------------


def test_the_written_command_writes_the_same_again(cli, tmp_path, monkeypatch):
    """What was edited since is overwritten by force alone."""
    write_chain(tmp_path)
    arguments = ["--name", "my arm", "--bodies", "capsule", "--bodies", "link0=convex", "--home", "joint1=0.5",
                 "--lock", "joint3", "--root", "planar", "--samples", "40", "--seed", "3"]  # fmt: skip
    first = json.loads(cli("robot", "add", "chain.urdf", *arguments, "--json").stdout)
    assert first["files"] == {"my arm/robot.yaml": "written", "my arm/my arm.srdf": "written"}
    robot = Robot.load("my arm/robot.yaml")
    assert robot.name == "my arm" and (robot.model.nq, robot.model.nv) == (6, 5)
    assert robot.home[4] == pytest.approx(0.5)
    path = tmp_path / "my arm" / "robot.yaml"
    before = path.read_text()
    (command,) = [line for line in before.splitlines() if line.startswith("# Again: ")]
    again = shlex.split(command.removeprefix("# Again: qpavoid "))
    assert cli(*again).stdout.count("unchanged") == 2
    path.write_text(before.replace("joint1: 0.5", "joint1: 0.6"))
    with monkeypatch.context() as patch:
        patch.setattr(commands, "describe", None)  # it is refused before the work begins
        refused, another = cli(*again), cli(*again, "--samples", "41")
    assert refused.status == 2 and "--force" in refused.stderr and "0.6" in path.read_text()
    assert another.status == 2 and "--force" in another.stderr
    assert "updated" in cli(*again, "--force").stdout and path.read_text() == before


def test_home_is_shown_as_angles_and_poses_of_the_tools(cli, tmp_path):
    """Links of 0.3 m in a row along z, the first joint about x turned by 0.5 rad: r = (0, -0.6 sin, 0.3 + 0.6 cos)."""
    write_chain(tmp_path)
    added = cli("robot", "add", "chain.urdf", "--home", "joint1=0.5", "--samples", "40", "--lock", "joint3").stdout
    checked = cli("robot", "check", "chain/robot.yaml").stdout
    document = json.loads(cli("robot", "check", "chain/robot.yaml", "--json").stdout)
    home = document["home"]
    assert home["joint1"] == 0.5 and set(home) == {"joint1", "joint2"}
    a, b = home["joint1"], home["joint1"] + home["joint2"]
    ((tool, (xyz, rpy)),) = document["end_effector_poses"].items()
    expected = [0.0, -0.3 * (math.sin(a) + math.sin(b)), 0.3 + 0.3 * (math.cos(a) + math.cos(b))]
    np.testing.assert_allclose(xyz, expected, atol=1e-9)
    np.testing.assert_allclose(rpy, [b, 0.0, 0.0], atol=1e-9)
    for text in (added, checked):
        assert re.search(rf"^home pose +joint1 0\.5, joint2 {home['joint2']:.4g}$", text, re.MULTILINE)
        numbers = re.search(rf"^ +{tool}: xyz (\S+) (\S+) (\S+) m, rpy (\S+) (\S+) (\S+) rad$", text, re.MULTILINE)
        np.testing.assert_allclose([float(number) for number in numbers.groups()], [*xyz, *rpy], atol=5.1e-4)
    assert "the SRDF's" not in cli("robot", "add", "chain.urdf", "--samples", "40", "--out", "other").stdout


def test_a_run_into_the_folder_of_the_urdf_does_not_honour_its_own_srdf(cli, tmp_path):
    write_chain(tmp_path, 4)
    for outcome in ("written", "unchanged"):
        document = json.loads(cli("robot", "add", "chain.urdf", "--out", ".", "--json").stdout)
        assert document["srdf"] is None and set(document["files"].values()) == {outcome}


@pytest.mark.parametrize(("root", "size"), [("planar", 3), ("free_flyer", 6)])
def test_added_base_has_the_speed_limit_that_was_assumed(cli, tmp_path, root, size):
    """A URDF gives no speed of a base: `add` writes the assumed one, which then is no assumption any more."""
    write_chain(tmp_path)
    with pytest.warns(RobotWarning, match="root_joint: no velocity limit"):
        bare = Robot.from_urdf(tmp_path / "chain.urdf", root_joint=root)
    assert cli("robot", "add", "chain.urdf", "--root", root).status == 0
    path = tmp_path / "chain" / "robot.yaml"
    assert yaml.safe_load(path.read_text())["limits"] == {"velocity": {"root_joint": [1.0] * size}}
    added = Robot.load(path)
    np.testing.assert_array_equal(added.bounds().velocity, bare.bounds().velocity)
    assert not any("root_joint" in note.subject for note in added.notes)


# --- robots that ship -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MADE)
def test_shipped_robots_are_as_they_were_written_and_ready(name):
    robot = Robot.load(name)
    assert not touching(robot, robot.home, 0.005)
    assert robot.end_effectors and robot.always_touching == []
    report = check_robot(name)
    warned = [note for note in report.notes if note.severity == "warning"]
    assert report.usable and all("a control step takes" in note.what for note in warned)  # that depends on the machine


def test_a_shipped_robot_comes_out_the_same_again():
    """But for the small box at the flange, now the sphere around it, by hand: the arm rests smoothly on that.

    Digits may differ where another machine rounds otherwise.
    """
    shipped = read_config(find_robot("ur5"), RobotConfig)
    home = {name: value for name, value in shipped.home.items() if value}
    options = DescribeOptions(
        name="ur5", home=home, bodies_of={"base_link": "convex"}, protrusion=0.06, wrist_protrusion=0.03
    )
    made = describe(EXAMPLES / "ur_description/urdf/ur5_robot.urdf", options).config
    assert made.home == shipped.home and made.end_effectors == shipped.end_effectors
    assert made.disabled_pairs == shipped.disabled_pairs
    for mine, theirs in zip(made.bodies, shipped.bodies, strict=True):
        assert mine.name == theirs.name
        assert (mine.shape.type, theirs.shape.type) == ("box", "sphere") or mine.shape.type == theirs.shape.type
        np.testing.assert_allclose(mine.position, theirs.position, atol=1e-3)


SHOWN = {
    # scenario: what tracking alone runs into
    "ur5_pole": "the pole",
    "baxter_cross": "the other arm",
    "g1_reach_across": "its own body",
    "tiago_column": "the column",
}


@pytest.mark.parametrize("scenario", SHOWN)
def test_scenarios_of_shipped_robots_show_avoidance(scenario):
    """Tracking alone collides; the QP arrives, keeps its margin, and never has to let it go."""
    config = load_scenario(scenario)
    assert simulate(load_scenario(scenario, solver="tracking")).metrics()["collided"], SHOWN[scenario]
    metrics = simulate(config).metrics()
    assert not metrics["collided"] and metrics["completed"]
    assert metrics["final_error"] < config.goal_tolerance
    assert metrics["min_distance"] > config.avoidance.d1 - 1e-3
    assert metrics["status_counts"]["STOPPED"] == 0
    assert metrics["relaxed_ticks"] <= 0.02 * math.ceil(config.duration / config.dt)
