"""No two links collide unseen: the robot's own geometry, by coal alone, against the pairs that `robot add` keeps."""

import json

import numpy as np
import pinocchio as pin
import pytest
from collision_oracle import Oracle, configuration, unseen
from conftest import EXAMPLES

from qpavoid import Controller, Robot, Sample, build_scene, build_tasks
from qpavoid.config import Task
from qpavoid.model.notes import NoteKind
from qpavoid.model.pairs import D1
from qpavoid.setup.add import PROTRUSION, WRIST_PROTRUSION, DescribeOptions, describe
from qpavoid.setup.check import check_robot
from qpavoid.setup.home import HOME_CLEARANCE, MIN_CONDITIONING
from qpavoid.setup.sampling import touching
from qpavoid.setup.texts import description_files, write_files

LIMIT = 'velocity="1" effort="1"'


def box(x, y, z):
    return f'<box size="{x} {y} {z}"/>'


def cylinder(radius, length):
    return f'<cylinder radius="{radius}" length="{length}"/>'


def urdf(name, links, joints):
    """A URDF of links, name: (shape, z of its middle), and joints, (name, type, parent, child, xyz, axis, rest)."""
    parts = []
    for link, body in links.items():
        shape = ""
        if body is not None:
            shape = f'<collision><origin xyz="0 0 {body[1]}"/><geometry>{body[0]}</geometry></collision>'
        parts.append(f'<link name="{link}">{shape}</link>')
    for joint, kind, parent, child, xyz, axis, rest in joints:
        parts.append(
            f'<joint name="{joint}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}"/><axis xyz="{axis}"/>{rest}</joint>'
        )
    return f'<robot name="{name}">{"".join(parts)}</robot>'


def span(low, high):
    return f'<limit lower="{low}" upper="{high}" {LIMIT}/>'


TURNS = f"<limit {LIMIT}/>"
WRIST = urdf(
    "wrist",
    {"base": (cylinder(0.08, 0.1), 0.05), "forearm": (cylinder(0.05, 0.34), 0.2),
     "knuckle": ('<sphere radius=".015"/>', 0), "hand": (box(0.12, 0.12, 0.10), 0.075)},
    [("shoulder", "revolute", "base", "forearm", "0 0 .12", "0 1 0", span(-1, 1)),
     ("pitch", "revolute", "forearm", "knuckle", "0 0 .374", "0 1 0", span(-0.6, 0.6)),
     ("roll", "revolute", "knuckle", "hand", "0 0 0", "1 0 0", span(-0.6, 0.6))],
)  # fmt: skip
STRAIGHT = urdf(
    "straight",
    {"base": (cylinder(0.08, 0.1), 0.05), "l1": None, "l2": (cylinder(0.05, 0.26), 0.2),
     "l3": (cylinder(0.04, 0.24), 0.18), "l4": None, "l5": (cylinder(0.04, 0.12), 0.1), "tool": None},
    [("j1", "continuous", "base", "l1", "0 0 .12", "0 0 1", TURNS),
     ("j2", "revolute", "l1", "l2", "0 0 0", "0 1 0", span(-2.2, 2.2)),
     ("j3", "revolute", "l2", "l3", "0 0 .4", "0 1 0", span(-2.5, 2.5)),
     ("j4", "continuous", "l3", "l4", "0 0 .35", "0 0 1", TURNS),
     ("j5", "revolute", "l4", "l5", "0 0 0", "0 1 0", span(-2, 2)),
     ("j6", "continuous", "l5", "tool", "0 0 .2", "0 0 1", TURNS)],
)  # fmt: skip
TELESCOPE = urdf(
    "telescope",
    {"base": (box(0.3, 0.3, 0.1), 0.05), "s0": (box(0.1, 0.1, 0.5), 0.25), "s1": (box(0.08, 0.08, 0.5), 0.25),
     "s2": (box(0.06, 0.06, 0.5), 0.25), "hand": ('<sphere radius="0.05"/>', 0.05),
     "tip": (box(0.02, 0.02, 0.08), 0.05)},
    [("turn", "revolute", "base", "s0", "0 0 .12", "0 0 1", span(-1, 1)),
     ("t1", "prismatic", "s0", "s1", "0 0 .02", "0 0 1", span(0, 0.4)),
     ("t2", "prismatic", "s1", "s2", "0 0 .02", "0 0 1", span(0, 0.4)),
     ("wrist", "revolute", "s2", "hand", "0 0 .52", "0 1 0", span(-1, 1)),
     ("held", "revolute", "hand", "tip", "0 0 .12", "0 1 0", span(0, 0))],
)  # fmt: skip
RAIL = urdf(  # two carriages on one rail collide, in the middle of their ranges: no telescope
    "rail",
    {"rail": (box(1.2, 0.04, 0.04), -0.1), "mast": None, "left": (box(0.2, 0.1, 0.1), 0),
     "right": (box(0.2, 0.1, 0.1), 0)},
    [("fix", "fixed", "rail", "mast", "0 0 0", "0 0 1", ""),
     ("x1", "prismatic", "mast", "left", "0 0 0", "1 0 0", span(-0.4, 0.4)),
     ("x2", "prismatic", "mast", "right", "0 0 0", "1 0 0", span(-0.4, 0.4))],
)  # fmt: skip
FINGERS = urdf(
    "fingers",
    {"base": (box(0.2, 0.2, 0.1), 0), "palm": (box(0.1, 0.1, 0.2), 0.15), "f1": (cylinder(0.01, 0.12), 0.1),
     "t1": (cylinder(0.01, 0.1), 0.06), "f2": (cylinder(0.01, 0.12), 0.1), "t2": (cylinder(0.01, 0.1), 0.06)},
    [("wrist", "revolute", "base", "palm", "0 0 .1", "0 0 1", span(-1, 1)),
     ("k1", "revolute", "palm", "f1", ".04 0 .25", "0 1 0", span(-1.2, 0.5)),
     ("d1", "revolute", "f1", "t1", "0 0 .18", "0 1 0", span(-1.2, 0.5) + '<mimic joint="k1"/>'),
     ("k2", "revolute", "palm", "f2", "-.04 0 .25", "0 1 0", span(-0.5, 1.2)),
     ("d2", "revolute", "f2", "t2", "0 0 .18", "0 1 0", span(-0.5, 1.2) + '<mimic joint="k2"/>')],
)  # fmt: skip
ROVER = urdf(
    "rover",
    {"chassis": (box(0.6, 0.4, 0.1), 0.1), "wheel_one": (cylinder(0.1, 0.05), 0), "two": (cylinder(0.1, 0.05), 0),
     "pivot": None, "ball": ('<sphere radius="0.05"/>', 0), "arm": (cylinder(0.04, 0.3), 0.2),
     "fore": (cylinder(0.03, 0.3), 0.2), "crank": (cylinder(0.02, 0.1), 0.1)},
    [("drive_a", "continuous", "chassis", "wheel_one", "0.2 0.25 0", "0 0 1", TURNS),
     ("left_wheel", "continuous", "chassis", "two", "0.2 -0.25 0", "0 1 0", TURNS),
     ("caster_swivel", "continuous", "chassis", "pivot", "-0.25 0 0", "0 0 1", TURNS),
     ("caster_roll", "continuous", "pivot", "ball", "-0.02 0 -0.05", "0 1 0", TURNS),
     ("shoulder", "continuous", "chassis", "arm", "0 0 0.15", "0 1 0", TURNS),
     ("elbow", "revolute", "arm", "fore", "0 0 0.4", "0 1 0", span(-2.6, 2.6)),
     ("winder", "continuous", "fore", "crank", "0 0 0.4", "1 0 0", TURNS)],
).replace('xyz="0.2 0.25 0"/><axis xyz="0 0 1"', 'xyz="0.2 0.25 0" rpy="-1.5708 0 0"/><axis xyz="0 0 1"')  # fmt: skip
ROBOTS = {
    "wrist": WRIST,
    "straight": STRAIGHT,
    "telescope": TELESCOPE,
    "rail": RAIL,
    "fingers": FINGERS,
    "rover": ROVER,
}


def tiny(text, scale):
    """The robot at another size: all lengths of the file times a factor."""
    from xml.etree import ElementTree

    root = ElementTree.fromstring(text)
    for element in root.iter():
        for field in ("xyz", "size", "radius", "length"):
            if element.get(field) and element.tag != "axis":
                element.set(field, " ".join(str(scale * float(x)) for x in element.get(field).split()))
    return ElementTree.tostring(root, encoding="unicode")


def made(tmp_path, name, text=None, **options):
    path = tmp_path / f"{name}.urdf"
    path.write_text(ROBOTS[name] if text is None else text)
    return path, describe(path, DescribeOptions(samples=2000, **options))


def nothing_unseen(path, described, samples, folders=()):
    """Every collision of two links is one of a pair that is kept, or of links that are named with how often."""
    named = {frozenset(entry.links): entry for entry in described.unchecked}
    missed = unseen(path, described.robot, described.config.lock, samples, folders)
    for links, count in missed.items():
        assert links in named and named[links].reason != "never", (sorted(links), count)
        if named[links].reason != "srdf" and count > 0.05 * samples:  # of 200 configurations
            assert named[links].geometry == pytest.approx(count / samples, abs=0.15)


def notes_of(described, kind):
    return {note.subject: note for note in described.notes if note.kind is kind}


@pytest.mark.parametrize("name", ROBOTS)
def test_no_collision_is_unseen(tmp_path, name):
    root = "planar" if name == "rover" else "fixed"
    path, described = made(tmp_path, name, root=root)
    nothing_unseen(path, described, 300)


@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_the_size_of_a_robot_does_not_matter(tmp_path, scale):
    """What is near by design is judged beside the robot's size, with bodies as tight for it: the hand strikes the
    forearm in a fifth of samples.
    """
    path, described = made(
        tmp_path, "wrist", tiny(WRIST, scale), protrusion=scale * PROTRUSION, wrist_protrusion=scale * WRIST_PROTRUSION
    )
    names = [body.name for body in described.robot.bodies.geometryObjects]
    pairs = {frozenset((names[p.first], names[p.second])) for p in described.robot.bodies.collisionPairs}
    assert pairs == {frozenset(("forearm", "hand"))}
    nothing_unseen(path, described, 200)
    oracle, random = Oracle(path), np.random.default_rng(0)
    strikes = 0
    for _ in range(300):
        q = configuration(oracle.model, {"pitch": random.uniform(-0.6, 0.6), "roll": random.uniform(-0.6, 0.6)})
        strikes += frozenset(("forearm", "hand")) in oracle.collisions(q)
    assert 0.15 < strikes / 300 < 0.3


def test_near_by_design_has_a_safety_distance_of_its_own(tmp_path):
    """The hand of `wrist` is some mm from the forearm in most poses: 30 mm could not be kept, its own distance can."""
    _, described = made(tmp_path, "wrist")
    (own,) = described.config.pair_margins
    assert set(own.bodies) == {"forearm", "hand"} and 0.001 < own.d1 < 0.01
    write_files(description_files(described, tmp_path / "out"))
    robot = Robot.load(str(tmp_path / "out" / "robot.yaml"))
    assert robot.safety_distance("hand", "forearm", D1) == own.d1 and robot.safety_distance("hand", "base", D1) == D1
    controller = Controller(build_scene(robot), [], dt=0.005)
    q, least = robot.home.copy(), np.inf
    for tick in range(600):  # pitched and rolled into the forearm until the row holds it
        v = controller.filter(q, np.array([0.0, 0.4, 0.4]), t=0.005 * tick).v
        q = pin.integrate(robot.model, q, 0.005 * v)
        least = min(least, touching(robot, q, np.inf)[0][2])
    assert own.d1 - 1e-3 < least < D1 - 1e-3


def test_a_telescope_may_be_drawn_in(tmp_path):
    _, described = made(tmp_path, "telescope")
    assert described.counts["drawn in"] == 1
    note = notes_of(described, NoteKind.PAIR)["s0", "s2"]
    # s0 and s2 overlap while t1 + t2 < 0.46, of two even ranges of 0.4
    assert note.fraction == pytest.approx(1.0 - 0.5 * ((0.8 - 0.46) / 0.4) ** 2, abs=0.1)
    home = described.robot.home
    bounds = described.robot.bounds()
    assert np.all(home[bounds.q_index] >= bounds.lower) and np.all(home[bounds.q_index] <= bounds.upper)
    assert described.config.home.get("held", 0.0) == 0.0
    drawn = dict(described.config.home, t1=0.0, t2=0.0)
    q = described.robot.configuration({k: v for k, v in drawn.items() if k in described.robot.joint_names}, "test")
    assert not touching(described.robot, q)


def test_carriages_on_a_rail_are_no_telescope(tmp_path):
    """They touch in the middle of their ranges: P(|x1 - x2| < 0.2) = 1 - (1 - 0.2/0.8)² of two even ranges of 0.8."""
    _, described = made(tmp_path, "rail")
    assert described.counts["drawn in"] == described.counts["always"] == 0
    assert described.counts["active"] == 1 and described.home.clearance >= HOME_CLEARANCE * D1
    assert described.home.preference is None and notes_of(described, NoteKind.HOME)


def test_home_of_a_straight_arm_starts_a_line_straight_down(tmp_path):
    _, described = made(tmp_path, "straight")
    robot, home = described.robot, described.home
    assert (
        home.clearance >= HOME_CLEARANCE * D1
        and not home.singular
        and home.conditioning["tool"].ratio >= MIN_CONDITIONING
    )
    controller = Controller(build_scene(robot), build_tasks([Task(frame="tool")], robot, robot.home), dt=0.005)
    data, frame = robot.model.createData(), robot.frame_id("tool", "test")
    pin.framesForwardKinematics(robot.model, data, robot.home)
    start, q = data.oMf[frame].translation.copy(), robot.home.copy()
    for tick in range(800):
        aim = Sample.at(start - [0.0, 0.0, 0.1 * min(0.005 * tick, 1.5)])
        q = pin.integrate(robot.model, q, 0.005 * controller.step(q, t=0.005 * tick, targets={"tool": aim}).v)
    pin.framesForwardKinematics(robot.model, data, q)
    np.testing.assert_allclose(data.oMf[frame].translation, start - [0.0, 0.0, 0.15], atol=3e-3)


def test_mimic_drivers_are_free_in_check_and_add(tmp_path):
    path, described = made(tmp_path, "fingers")
    report = check_robot(str(path))
    assert report.nv == described.robot.model.nv == 3 and described.config.lock == {}
    assert ("k1", "k2") in notes_of(described, NoteKind.JOINT)
    assert described.counts["active"] >= 4


@pytest.mark.parametrize(("root", "wheels"), [("planar", True), ("free_flyer", True), ("fixed", False)])
def test_wheels_of_a_mobile_base_are_locked_and_named(tmp_path, root, wheels):
    """By their names or those of their links; a shoulder or a crank is none."""
    _, described = made(tmp_path, "rover", root=root)
    locked = {"drive_a", "left_wheel", "caster_swivel", "caster_roll"} if wheels else set()
    assert set(described.config.lock) == locked
    found = {name for subject in notes_of(described, NoteKind.JOINT) for name in subject}
    assert found == locked
    assert {"shoulder", "elbow", "winder"} <= set(described.robot.joint_names)


def test_one_table_holds_all_that_was_left_out(cli, tmp_path):
    (tmp_path / "telescope.urdf").write_text(TELESCOPE)
    added = cli("robot", "add", "telescope.urdf")
    row = next(line for line in added.stdout.splitlines() if "s0 - s2" in line)
    severity, kind, share, sign = row.split()[:4]
    assert (severity, kind, sign) == ("note", "pair", "%") and 50 < int(share) < 75
    assert any(line.split()[:2] == ["warning", "joint"] and "held" in line for line in added.stdout.splitlines())
    document = json.loads(cli("robot", "add", "telescope.urdf", "--json").stdout)
    (note,) = [note for note in document["notes"] if note["subject"] == ["s0", "s2"]]
    assert note["kind"] == "pair" and note["fraction"] == pytest.approx(int(share) / 100, abs=0.006)
    entry = next(entry for entry in document["left_out"] if entry["links"] == ["s0", "s2"])
    assert entry["reason"] == "drawn in" and entry["geometry"] == note["fraction"]
    assert {tuple(entry["links"]) for entry in document["left_out"]} >= {("base", "s0"), ("s0", "s1"), ("base", "s2")}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "ur_description/urdf/ur10_robot.urdf",
        "z1_description/urdf/z1.urdf",
        "tiago_description/robots/tiago_no_hand.urdf",
        "allegro_hand_description/urdf/allegro_left_hand.urdf",
        "baxter_description/urdf/baxter.urdf",
    ],
)
def test_robots_of_example_robot_data(name):
    from qpavoid.model.packages import mesh_folders

    described = describe(EXAMPLES / name, DescribeOptions())
    nothing_unseen(EXAMPLES / name, described, 200, [e for e in mesh_folders(EXAMPLES / name, []) if "=" not in e])
