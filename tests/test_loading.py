"""Robots whose files have faults: nothing vanishes, and what was left out, mended or assumed is named."""

import itertools
import math
import os
import site
import sys
import warnings
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from conftest import EXAMPLES
from urdfs import BASE, HEAD, LIMITS, ROD, SEEN_ROD, arm, write, write_stl

from qpavoid import ConfigError, Robot
from qpavoid.config.shipped import shipped_names
from qpavoid.model.notes import NoteKind, RobotWarning
from qpavoid.model.urdf import read_model, read_pieces
from qpavoid.model.xml_file import read_robot_xml


def load(path, **fields):
    """The robot, and the texts of its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        robot = Robot.load(path, **fields)
    assert all(issubclass(warning.category, RobotWarning) for warning in caught) and len(caught) <= 1
    serious = [str(note) for note in robot.notes if note.severity == "warning"]
    assert bool(serious) == bool(caught), "a warning comes exactly where a note is one"
    assert all(note in str(warning.message) for warning in caught for note in serious)
    return robot, serious


def shapes(robot):
    """Link: types of its bodies, in their order."""
    found: dict[str, list[str]] = {}
    for body in robot.bodies.geometryObjects:
        found.setdefault(robot.model.frames[body.parentFrame].name, []).append(type(body.geometry).__name__)
    return found


INTACT = {"base": ["Box"], "forearm": ["Cylinder"], "b": ["Cylinder"]}
INERTIA = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
BOX = '<geometry><box size=".1 .1 .1"/></geometry>'

# --- shapes -------------------------------------------------------------------------------------------------------

HARMLESS = {
    "material without a name": f'<visual>{BOX}<material><color rgba="1 0 0 1"/></material></visual>',
    "material with a bad color": f'<visual>{BOX}<material name="a"><color rgba="1 0"/></material></visual>',
    "visual with a bad origin": f'<visual><origin xyz="0 0"/>{BOX}</visual>',
    "visual without geometry": "<visual/>",
    "visual of an unknown shape": "<visual><geometry><torus/></geometry></visual>",
    "visual whose mesh is missing": '<visual><geometry><mesh filename="no.stl"/></geometry></visual>',
    "inertial without inertia": '<inertial><mass value="1"/></inertial>',
    "inertial without mass": f"<inertial>{INERTIA}</inertial>",
    "inertial with half an inertia": '<inertial><mass value="1"/><inertia ixx="1"/></inertial>',
    "inertial with a bad origin": f'<inertial><origin xyz="0"/><mass value="1"/>{INERTIA}</inertial>',
    "inertial with NaN": f'<inertial><mass value="1"/>{INERTIA.replace("1", "nan", 1)}</inertial>',
    "empty inertial": "<inertial/>",
}


@pytest.mark.parametrize("fault", HARMLESS)
@pytest.mark.parametrize("last", [False, True])
def test_fault_beside_a_shape_loses_no_shape(tmp_path, fault, last):
    own = {"base": BASE, "forearm": ROD, "b": ROD}
    faulty = {link: text + HARMLESS[fault] if last else HARMLESS[fault] + text for link, text in own.items()}
    robot, serious = load(write(tmp_path, arm(**faulty)))
    assert shapes(robot) == INTACT and len(serious) == (fault in ("inertial with NaN", "inertial with a bad origin"))
    mended = [note.subject for note in robot.notes if note.kind is NoteKind.LINK]
    assert mended == ([("base", "forearm", "b")] if "inertial" in fault else [])


def test_mass_stays_where_its_inertia_is_missing(tmp_path):
    robot, _ = load(write(tmp_path, arm(forearm='<inertial><mass value="2.5"/></inertial>' + ROD)))
    assert robot.model.inertias[1].mass == 2.5
    robot, _ = load(write(tmp_path, arm(forearm=f"<inertial>{INERTIA}</inertial>{ROD}")))
    assert robot.model.inertias[1].mass == 0.0


@pytest.mark.parametrize("kind", ["convex", "capsule", "mesh"])
@pytest.mark.parametrize("prefix", ["", "drake:"])
def test_capsules_and_ellipsoids_are_read(tmp_path, kind, prefix):
    capsule = f'<collision><geometry><{prefix}capsule radius="0.05" length="0.3"/></geometry></collision>'
    radii = 'a="0.1" b="0.2" c="0.3"' if prefix else 'radii="0.1 0.2 0.3"'
    ellipsoid = f'<collision><origin xyz="0 0 .5"/><geometry><{prefix}ellipsoid {radii}/></geometry></collision>'
    head = '<robot name="m" xmlns:drake="http://drake.mit.edu">'
    robot, serious = load(write(tmp_path, arm(forearm=ROD + capsule, b=ellipsoid, head=head)), bodies=kind)
    assert serious == []
    assert list(map(len, shapes(robot).values())) == [1, 2, 1]
    bodies = {body.name: body.geometry for body in robot.bodies.geometryObjects}
    assert bodies["forearm_1"].radius == 0.05 and bodies["forearm_1"].halfLength == 0.15
    if kind != "capsule":
        np.testing.assert_array_equal(bodies["b_0"].radii, [0.1, 0.2, 0.3])


REFUSED = {
    '<collision><origin xyz="0 0"/>{box}</collision>': "collision 1: origin xyz='0 0': 2 numbers; give 3",
    '<collision><origin rpy="0 0 0 0"/>{box}</collision>': "collision 1: origin rpy='0 0 0 0': 4 numbers; give 3",
    '<collision><origin xyz="a 0 0"/>{box}</collision>': "origin xyz='a 0 0': 'a' is not a number",
    '<collision><geometry><box size="1 1"/></geometry></collision>': "collision 1: box size='1 1': 2 numbers; give 3",
    "<collision><geometry><box/></geometry></collision>": "collision 1: box size is missing; give it 3 numbers",
    '<collision><geometry><capsule radius="1"/></geometry></collision>': "capsule length is missing; give it 1 number",
    "<collision><geometry><sphere/></geometry></collision>": "sphere radius is missing",
    "<collision><geometry><torus/></geometry></collision>": "<torus> is no shape that is known; give one of <mesh>",
    "<collision><geometry><mesh/></geometry></collision>": "mesh filename is missing; name the file",
    '<collision><geometry><mesh filename="a.stl" scale="1 1"/></geometry></collision>': "mesh scale='1 1': 2 numbers",
    '<collision><geometry><mesh filename="a.stl"/></geometry></collision>': "mesh a.stl could not be found; name the",
    '<collision><geometry><sphere radius="-1"/></geometry></collision>': "sphere radius='-1': must not be negative",
}


@pytest.mark.parametrize("fault", REFUSED)
def test_shape_that_cannot_be_read_is_refused_by_name(tmp_path, fault):
    with pytest.raises(ConfigError) as error:
        load(write(tmp_path, arm(forearm=ROD + fault.replace("{box}", BOX))))
    assert "link 'forearm'" in str(error.value) and REFUSED[fault] in str(error.value)
    assert "\n" not in str(error.value)


EMPTY = ["<collision/>", "<collision><geometry/></collision>", '<collision><origin xyz="0 0 1"/></collision>']
DUMMIES = [f"<collision><geometry>{shape}</geometry></collision>" for shape in (
    '<sphere radius="0"/>', '<box size="0 0 0"/>', '<cylinder radius="0" length="0.0"/>',
)]  # fmt: skip


@pytest.mark.parametrize("dummy", EMPTY + DUMMIES)
def test_shape_without_size_is_left_out_and_named(tmp_path, dummy):
    robot, (message,) = load(write(tmp_path, arm(forearm=dummy + ROD)))
    assert shapes(robot) == INTACT
    assert "shape forearm_0: left out" in message
    assert robot.bodies.geometryObjects[1].name == "forearm_1", "names do not depend on what is left out"


@pytest.mark.parametrize(
    ("shape", "half"),
    [
        ('<box size="0.2 0 0.1"/>', [0.1, 5e-5, 0.05]),
        ('<cylinder radius="0.1" length="0"/>', [0.1, 0.1, 5e-5]),
        ('<cylinder radius="0" length="0.2"/>', [1e-4, 1e-4, 0.1]),
    ],
)
def test_flat_shape_gets_a_thickness(tmp_path, shape, half):
    flat = f"<collision><geometry>{shape}</geometry></collision>"
    robot, (message,) = load(write(tmp_path, arm(b=flat)))
    assert "shape b_0: a size of 0" in message and "0.0001 m" in message
    geometry = robot.bodies.geometryObjects[2].geometry
    geometry.computeLocalAABB()
    np.testing.assert_allclose(geometry.aabb_local.max_, half, atol=1e-12)


def test_several_shapes_in_one_element_all_count(tmp_path):
    both = '<collision><geometry><sphere radius=".1"/><box size=".3 .01 .01"/></geometry></collision>'
    robot, serious = load(write(tmp_path, arm(b=both)))
    assert shapes(robot)["b"] == ["Sphere", "Box"] and serious == []
    assert [body.name for body in robot.bodies.geometryObjects][2:] == ["b_0", "b_0_1"]


def test_shape_in_another_element_is_named(tmp_path):
    robot, (message,) = load(write(tmp_path, arm(b=f"{ROD}<visual>{BOX}{ROD}</visual>")))
    assert shapes(robot) == INTACT and "shape b: 1 of its <collision> elements are left out" in message


def test_origin_as_a_quaternion(tmp_path):
    half = math.sqrt(0.5)
    turned = ROD.replace('<origin xyz="0 0 .2"/>', f'<origin xyz="0 0 .2" quat_xyzw="{half} 0 0 {half}"/>')
    robot, _ = load(write(tmp_path, arm(b=turned)))
    placement = robot.bodies.geometryObjects[2].placement
    np.testing.assert_allclose(placement.rotation, pin.utils.rotate("x", math.pi / 2), atol=1e-12)
    np.testing.assert_array_equal(placement.translation, [0.0, 0.0, 0.2])


# --- what is meant to be seen --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seen", [("base",), ("forearm", "b")])
def test_visuals_serve_link_by_link(tmp_path, seen):
    own = {"base": BASE, "forearm": ROD, "b": ROD}
    path = write(tmp_path, arm(**{link: own[link].replace("collision", "visual") for link in seen}))
    robot, (message,) = load(path)
    assert shapes(robot) == INTACT
    assert message.startswith(f"link {', '.join(seen)}: no collision shape")
    bare, serious = load(path, visuals=False)
    assert shapes(bare) == {link: types for link, types in INTACT.items() if link not in seen} and serious == []


def test_visual_tool_on_a_chain_of_fixed_links(tmp_path):
    """A flange, an adapter and a tool that hang from b by fixed joints: the tool alone is only seen."""
    fixed = '<joint name="{0}" type="fixed"><parent link="{1}"/><child link="{0}l"/><origin xyz="0 0 .1"/></joint>'
    links = f'<link name="f1l"/><link name="f2l">{ROD}</link><link name="f3l">{SEEN_ROD}</link>'
    inside = links + fixed.format("f1", "b") + fixed.format("f2", "f1l") + fixed.format("f3", "f2l")
    robot, (message,) = load(write(tmp_path, arm(inside=inside)))
    assert shapes(robot) == {**INTACT, "f2l": ["Cylinder"], "f3l": ["Cylinder"]} and "link f3l:" in message
    tool = robot.bodies.geometryObjects[robot.bodies.getGeometryId("f3l_0")]
    assert tool.parentJoint == 2
    np.testing.assert_allclose(tool.placement.translation, [0.0, 0.0, 0.5], atol=1e-12)


def test_a_visual_that_cannot_be_read_does_not_refuse_a_robot_with_collision_shapes(tmp_path):
    missing = '<visual><geometry><mesh filename="package://no/tool.stl"/></geometry></visual>'
    robot, (message,) = load(write(tmp_path, arm(b=missing)))
    assert "b" not in shapes(robot)
    assert "mesh b_0: left out: a mesh in package://no is missing" in message
    everything = dict.fromkeys(("base", "forearm", "b"), missing)
    with pytest.raises(ConfigError, match=r"link 'base': visual 0: mesh package://no/tool\.stl could not be found"):
        load(write(tmp_path, arm(**everything)))


# --- XML of other tools --------------------------------------------------------------------------------------------


def test_undeclared_prefix_is_named(tmp_path):
    foreign = f'{LIMITS} drake:acceleration="3"'
    robot, (message,) = load(write(tmp_path, arm(limits=foreign, inside="<gz:plugin><gz:a/></gz:plugin>")))
    assert shapes(robot) == INTACT and "file drake, gz: prefix of XML that no xmlns attribute declares" in message
    declared = '<robot name="m" xmlns:drake="d" xmlns:gz="g">'
    robot, serious = load(write(tmp_path, arm(limits=foreign, head=declared)))
    assert shapes(robot) == INTACT and serious == []


def test_elements_of_other_tools_lose_nothing(tmp_path):
    tags = '<gazebo reference="b"><material>Red</material></gazebo><transmission name="t"/><material name="x"/>'
    robot, serious = load(write(tmp_path, arm(forearm=ROD + "<contact/><self_collision_checking/>", inside=tags)))
    assert shapes(robot) == INTACT and serious == []


XACRO = '<robot name="m" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:property name="r" value="0.04"/>'


@pytest.mark.parametrize("name", ["arm.urdf.xacro", "arm.xacro", "arm.urdf"])
def test_xacro_is_expanded(tmp_path, name):
    pytest.importorskip("xacro")
    robot, serious = load(write(tmp_path, arm(b=ROD.replace('".04"', '"${2 * r}"'), head=XACRO), name))
    assert robot.name == "arm" and shapes(robot) == INTACT and serious == []
    assert robot.bodies.geometryObjects[2].geometry.radius == 0.08


def test_xacro_finds_packages_without_ros(tmp_path):
    pytest.importorskip("xacro")
    package = tmp_path / "checkout"
    for folder in ("urdf", "parts"):
        (package / folder).mkdir(parents=True)
    (package / "package.xml").write_text("<package><name>my_description</name></package>")
    (package / "parts" / "size.xacro").write_text(XACRO.replace("0.04", "0.03") + "</robot>")
    include = '<xacro:include filename="$(find my_description)/parts/size.xacro"/>'
    head = HEAD.replace(">", ' xmlns:xacro="http://ros.org/wiki/xacro">') + include
    path = write(package / "urdf", arm(b=ROD.replace('".04"', '"${r}"'), head=head), "arm.urdf.xacro")
    assert load(path)[0].bodies.geometryObjects[2].geometry.radius == 0.03


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('<xacro:include filename="$(find nowhere)/a.xacro"/>', "xacro: .*nowhere"),
        ("<xacro:nothing/>", "xacro: .*nothing"),
        ('<xacro:property name="x" value="${1/0}"/><a b="${x}"/>', "xacro: .*zero"),
        ('<a b="$(arg side)"/>', "xacro: .*side"),
    ],
)
def test_xacro_that_cannot_be_expanded_says_what_to_run(tmp_path, capfd, text, message):
    pytest.importorskip("xacro")
    path = write(tmp_path, arm(head=XACRO + text), "arm.urdf.xacro")
    with pytest.raises(
        ConfigError, match=rf"arm\.urdf\.xacro: {message}.*`xacro arm\.urdf\.xacro > arm\.urdf`"
    ) as error:
        Robot.load(path)
    assert "\n" not in str(error.value)


def test_xacro_without_its_package_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "xacro", None)
    with pytest.raises(ConfigError, match=r"arm\.urdf\.xacro: it is written in xacro: pip install xacro, or run `"):
        Robot.load(write(tmp_path, arm(head=XACRO), "arm.urdf.xacro"))


# --- limits --------------------------------------------------------------------------------------------------------


def test_limits_in_reverse_order_are_swapped(tmp_path):
    robot, (message,) = load(write(tmp_path, arm(limits='lower="0" upper="-1" velocity="1" effort="1"')))
    bounds = robot.bounds()
    np.testing.assert_array_equal([bounds.lower[1], bounds.upper[1]], [-1.0, 0.0])
    assert "limit j2: its lower limit 0 is above its upper one -1" in message


@pytest.mark.parametrize("value", [0.3, -0.7, 0.0])
@pytest.mark.parametrize("type_", ["revolute", "prismatic"])
def test_joint_without_a_range_is_fixed_there(tmp_path, value, type_):
    limits = f'lower="{value}" upper="{value}" velocity="0" effort="0"'
    robot, (message,) = load(write(tmp_path, arm(limits=limits, type_=type_)))
    assert robot.joint_names == ["j1"] and f"joint j2: locked at {value:g}" in message
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, np.zeros(1))
    pose = data.oMf[robot.frame_id("b", "test")]
    turned = type_ == "revolute"
    np.testing.assert_allclose(pose.rotation, pin.utils.rotate("y", value * turned), atol=1e-12)
    np.testing.assert_allclose(pose.translation, [0.0, 0.0 if turned else value, 0.5], atol=1e-12)


def test_range_of_the_robot_file_frees_a_joint(tmp_path):
    path = write(tmp_path, arm(limits='lower="0.3" upper="0.3" velocity="1" effort="1"'))
    robot, serious = load(path, limits={"position": {"j2": [-1.0, 1.0]}})
    assert robot.joint_names == ["j1", "j2"] and serious == []
    robot, serious = load(path, lock={"j2": 0.1})
    assert robot.joint_names == ["j1"] and serious == []


def test_ranges_that_are_all_zero_say_nothing(tmp_path):
    """As an exporter writes them unless asked otherwise: a robot of which no joint moved would be of no use."""
    text = arm(limits='lower="0" upper="0" velocity="0" effort="0"').replace(LIMITS, 'lower="0" upper="0"')
    robot, message = load(write(tmp_path, text))
    assert robot.joint_names == ["j1", "j2"] and robot.bounds().q_index.size == 0
    assert any("limit j1, j2: every range of the file is [0, 0]" in line for line in message)
    ball = {"type": "sphere", "radius": 0.2}
    bodies = [{"name": "a", "frame": "base", "shape": ball}, {"name": "c", "frame": "b", "shape": ball}]
    bodies[1]["position"] = [0.0, 0.0, -0.4]  # touches the other one where both joints are 0, and there alone
    assert len(load(tmp_path / "m.urdf", bodies=bodies)[0].bodies.collisionPairs) == 1


@pytest.mark.parametrize("limits", ['velocity="0" effort="1" lower="-1" upper="1"', 'lower="-1" upper="1"'])
def test_speed_that_is_not_given_is_assumed_and_named(tmp_path, limits):
    robot, (message,) = load(write(tmp_path, arm(limits=limits)))
    np.testing.assert_array_equal(robot.bounds().velocity, [1.0, 1.0])
    assert "limit j2: no velocity limit is given: 1 rad/s is assumed" in message
    robot, serious = load(write(tmp_path, arm(limits=limits)), limits={"velocity": {"j2": 0.4}})
    np.testing.assert_array_equal(robot.bounds().velocity, [1.0, 0.4])
    assert serious == []


@pytest.mark.parametrize("limits", ["", 'velocity="1" effort="1"'])
def test_range_that_is_not_given_is_named(tmp_path, limits):
    robot, message = load(write(tmp_path, arm(limits=limits)))
    assert robot.bounds().q_index.tolist() == [0]
    assert any("limit j2: has no <limit> lower and upper: it moves without position limits" in line for line in message)


@pytest.mark.parametrize(("root", "nv"), [("planar", 3), ("free_flyer", 6)])
def test_base_has_a_speed_limit_that_is_named(tmp_path, root, nv):
    path = write(tmp_path, arm())
    robot, (message,) = load(path, root_joint=root)
    assert "limit root_joint: no velocity limit is given: 1 m/s and 1 rad/s are assumed" in message
    np.testing.assert_array_equal(robot.bounds().velocity, np.ones(nv + 2))
    speeds = [0.5 + 0.1 * i for i in range(nv)]
    robot, serious = load(path, root_joint=root, limits={"velocity": {"root_joint": speeds}}, lock={"j1": 0.2})
    np.testing.assert_array_equal(robot.bounds().velocity, [*speeds, 1.0])
    assert serious == []
    with pytest.raises(ConfigError, match=f"'root_joint': 2 values for {nv} coordinates"):
        load(path, root_joint=root, limits={"velocity": {"root_joint": [1.0, 1.0]}})


# --- packages and meshes -------------------------------------------------------------------------------------------


@pytest.fixture
def checkout(tmp_path):
    """A package whose folder has another name than the package: folder/urdf/m.urdf, folder/meshes/box.stl."""
    folder = tmp_path / "checkout_of_my_robot"
    for name in ("urdf", "meshes"):
        (folder / name).mkdir(parents=True)
    write_stl(folder / "meshes" / "box.stl")
    mesh = '<collision><geometry><mesh filename="package://my_description/meshes/box.stl"/></geometry></collision>'
    return write(folder / "urdf", arm(forearm=mesh, b=mesh))


MANIFEST = '<?xml version="1.0"?><package format="3"><!-- <name>x</name> --><name> my_description </name></package>'


@pytest.mark.parametrize("how", ["packages", "package_dirs", "beside", "manifest above"])
def test_package_by_name(checkout, tmp_path, how):
    folder, fields = checkout.parents[1], {}
    path = write(tmp_path, checkout.read_text())
    if how == "packages":
        fields = {"packages": {"my_description": folder}}
    elif how == "package_dirs":
        fields = {"package_dirs": ["my_description=checkout_of_my_robot"]}
    else:
        (folder / "package.xml").write_text(MANIFEST)
        fields = {"package_dirs": [str(tmp_path)]} if how == "manifest above" else {}
    if how == "beside":
        (tmp_path / "other").mkdir()
        (tmp_path / "other" / "package.xml").write_text("<package><name>other</name></package>")
        path = write(tmp_path / "other", checkout.read_text())
    assert load(path, **fields)[0].bodies.ngeoms == 3


def test_missing_mesh_may_be_left_out(tmp_path):
    missing = '<collision><geometry><mesh filename="package://no/hand.stl"/></geometry></collision>'
    path = write(tmp_path, arm(b=missing))
    with pytest.raises(ConfigError, match=r"link 'b': collision 0: mesh package://no/hand.stl .*allow_missing_meshes"):
        load(path)
    robot, (message,) = load(path, allow_missing_meshes=True)
    assert shapes(robot) == {link: types for link, types in INTACT.items() if link != "b"}
    assert "mesh b_0: left out: a mesh in package://no is missing" in message
    robot, message = load(write(tmp_path, arm(b=missing + SEEN_ROD)), allow_missing_meshes=True)
    assert shapes(robot) == INTACT and len(message) == 2, "what is meant to be seen serves instead"


def test_pointer_of_git_lfs_is_called_one(tmp_path):
    (tmp_path / "hand.stl").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
    mesh = '<collision><geometry><mesh filename="hand.stl"/></geometry></collision>'
    with pytest.raises(ConfigError, match=r"link 'b': collision 0: mesh .*hand\.stl: it is a pointer of Git LFS"):
        load(write(tmp_path, arm(b=mesh)))


# --- sizes and duplicates ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("scale", "message"), [(1000, "is 100 m across"), (0.001, "is 0.1 mm across")])
def test_mesh_of_implausible_size_is_named(tmp_path, scale, message):
    write_stl(tmp_path / "part.stl")
    mesh = f'<collision><geometry><mesh filename="part.stl" scale="{scale} {scale} {scale}"/></geometry></collision>'
    _, (line,) = load(write(tmp_path, arm(b=mesh)))
    assert f"mesh b_0: {message}" in line and "scale" in line


def test_offset_of_implausible_length_is_named(tmp_path):
    _, (line,) = load(write(tmp_path, arm().replace('<origin xyz="0 0 .4"/>', '<origin xyz="0 0 400"/>')))
    assert "joint j2: stands 400 m from the joint before it" in line


OUTER = {
    "box": '<box size=".4 .4 .4"/>',
    "sphere": '<sphere radius=".3"/>',
    "cylinder": '<cylinder radius=".3" length=".4"/>',
    "capsule": '<capsule radius=".2" length=".2"/>',
    "ellipsoid": '<ellipsoid radii=".3 .3 .4"/>',
}


@pytest.mark.parametrize("outer", OUTER)
@pytest.mark.parametrize(("inner", "first"), [("mesh", True), ("box", False)])
def test_shape_inside_another_of_its_link_is_left_out(tmp_path, outer, inner, first):
    """And only that: moved out of it, both count."""
    write_stl(tmp_path / "part.stl")
    shape = '<mesh filename="part.stl"/>' if inner == "mesh" else '<box size=".1 .1 .1"/>'
    small = '<collision><origin xyz="0 0 {}"/><geometry>' + shape + "</geometry></collision>"
    large = f"<collision><geometry>{OUTER[outer]}</geometry></collision>"
    for shift, count in ((0.0, 1), (0.35, 2)):
        pair = (small.format(shift), large)
        robot, serious = load(write(tmp_path, arm(b="".join(pair if first else pair[::-1]))))
        assert len(shapes(robot)["b"]) == count and serious == []
        kept = {body.name for body in robot.bodies.geometryObjects}
        name = "b_0" if first else "b_1"
        assert (name in kept) is (count == 2)
        assert any(f"shape {name}: left out: it lies inside b_" in str(note) for note in robot.notes) is (count == 1)


def test_same_shape_twice_is_kept_once_and_a_mixture_is_named(tmp_path):
    write_stl(tmp_path / "part.stl")
    mesh = '<collision><geometry><mesh filename="part.stl"/></geometry></collision>'
    robot, _ = load(write(tmp_path, arm(forearm=ROD * 3, b=mesh * 2)))
    assert shapes(robot) == {"base": ["Box"], "forearm": ["Cylinder"], "b": ["Convex"]}
    for other in (mesh.replace('part.stl"', 'part.stl" scale="2 2 2"'), ROD):
        robot, serious = load(write(tmp_path, arm(b=mesh + other)))
        assert len(shapes(robot)["b"]) == 2 and serious == []
    assert any("shape b_0, b_1: meshes and simple shapes of one link" in str(note) for note in robot.notes)


def test_hull_of_a_listed_body_may_lie_inside_another_shape(tmp_path):
    write_stl(tmp_path / "part.stl")
    mesh = '<collision><geometry><mesh filename="part.stl"/></geometry></collision>'
    large = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
    body = {"name": "hand", "frame": "b", "shape": {"type": "hull", "geometry": "b_1"}}
    robot, serious = load(write(tmp_path, arm(b=large + mesh)), bodies=[body])
    assert isinstance(robot.bodies.geometryObjects[0].geometry, coal.ConvexBase) and serious == []


# --- both ways in --------------------------------------------------------------------------------------------------


def test_bare_urdf_has_end_effectors(tmp_path):
    robot, _ = load(write(tmp_path, arm()))
    assert robot.end_effectors == ("b",)
    assert any(note.kind is NoteKind.FRAME and note.subject == ("b",) for note in robot.notes)
    robot, _ = load(write(tmp_path, arm()), end_effectors=["forearm"])
    assert robot.end_effectors == ("forearm",)
    assert not any(note.kind is NoteKind.FRAME for note in robot.notes)


def test_fields_replace_those_of_a_robot_file(tmp_path):
    write(tmp_path, arm())
    path = write(tmp_path, "name: mine\nurdf: m.urdf\nhome: {j1: 0.5}\nbodies: capsule\n", "robot.yaml")
    robot, _ = load(path, home={"j2": 0.25})
    np.testing.assert_array_equal(robot.home, [0.0, 0.25])
    assert set(itertools.chain(*shapes(robot).values())) == {"Capsule"}
    with pytest.raises(ConfigError, match="bodis: unknown key"):
        load(path, bodis="convex")


def test_meshes_as_bodies_warn_with_cost_and_remedy(tmp_path):
    write_stl(tmp_path / "part.stl")
    mesh = '<collision><geometry><mesh filename="part.stl"/></geometry></collision>'
    path = write(tmp_path, arm(forearm=mesh, b=mesh))
    robot, (message,) = load(path, bodies="mesh")
    assert "2 triangle meshes cost 100 to 500 µs a pair" in message and "set `bodies` to convex" in message
    assert [note.subject for note in robot.notes if note.kind is NoteKind.MESH] == [("forearm_0", "b_0")]
    assert load(path, bodies="convex")[1] == load(path, bodies="capsule")[1] == []


@pytest.mark.parametrize("name", shipped_names("robot"))
def test_shipped_robots_do_not_warn(name):
    assert load(name)[1] == []


# --- many files ----------------------------------------------------------------------------------------------------

FEW = ["panda", "ur5_robot", "talos_full_v2_box", "tiago", "go2", "baxter", "romeo_small"]
"""Robots of every test; the others are loaded by `make campaign`."""


def every_urdf():
    """Those of example-robot-data, and of other packages of robots where these are installed."""
    folders = [EXAMPLES]
    for base in site.getsitepackages():
        folders += [Path(base) / name for name in ("airo_models", "stretch_urdf")]
    folders.append(Path(sys.prefix) / "share" / "iCub" / "robots")
    for path in (path for folder in folders for path in sorted(folder.rglob("*.urdf"))):
        if "<link" in path.read_text():  # no list of other files
            few = path.is_relative_to(EXAMPLES) and path.stem in FEW
            yield pytest.param(path, id="/".join(path.parts[-3:]), marks=[] if few else pytest.mark.slow)


URDFS = list(every_urdf())


@contextmanager
def quiet():
    """Without what C++ prints on the process's error stream."""
    saved = os.dup(2)
    with open(os.devnull) as null:
        os.dup2(null.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


@pytest.mark.parametrize("path", URDFS)
def test_model_and_shapes_are_those_of_pinocchio(path):
    """Where its own parser has nothing to complain of, the way around it makes no difference; no shape is lost."""
    notes = []
    model = read_model(path, "fixed", notes)
    ours = read_pieces(path, model, [], path, notes, visuals=False, enclosed=True).geometryObjects
    links = read_robot_xml(path, "URDF").iter("link")
    counts = Counter({link.get("name"): len(link.findall("collision/geometry/*")) for link in links})
    assert Counter(model.frames[piece.parentFrame].name for piece in ours) == +counts
    assert not [note for note in notes if note.kind in (NoteKind.SHAPE, NoteKind.MESH)]
    if not path.is_relative_to(EXAMPLES):
        return
    with quiet():
        try:
            expected = pin.buildModelFromUrdf(str(path), mimic=True)
        except ValueError:
            expected = pin.buildModelFromUrdf(str(path), mimic=False)
        folders = [*(str(parent) for parent in path.parents), str(EXAMPLES.parents[1])]
        theirs = pin.buildGeomFromUrdf(expected, str(path), pin.COLLISION, package_dirs=folders).geometryObjects
    assert model == expected
    for mine, other in zip(ours, theirs, strict=True):
        assert (mine.name, mine.parentJoint, mine.parentFrame) == (other.name, other.parentJoint, other.parentFrame)
        np.testing.assert_allclose(mine.placement.homogeneous, other.placement.homogeneous, atol=1e-12)
        if isinstance(mine.geometry, coal.BVHModelBase):
            vertices = other.geometry.points if isinstance(other.geometry, coal.ConvexBase) else other.geometry.vertices
            np.testing.assert_array_equal(mine.geometry.vertices(), vertices())
        else:
            assert mine.geometry == other.geometry


@pytest.mark.parametrize("path", URDFS)
def test_every_robot_is_read_or_does_not_move(path):
    try:
        robot, _ = load(path, bodies="capsule")
    except ConfigError as error:
        assert "no joint of" in str(error)
    else:
        assert np.isfinite(robot.bounds().velocity).all()
        assert robot.bodies.ngeoms > 0 or "<geometry" not in path.read_text()
