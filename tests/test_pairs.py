"""Which pairs are watched."""

import xml.etree.ElementTree as ElementTree

import pytest
from conftest import EXAMPLES, look, obstacle, write_chain

from qpavoid import ConfigError, Robot, build_scene, config
from qpavoid.model.notes import NoteKind, RobotWarning

SPHERE = {"type": "sphere", "radius": 0.02}


def pairs_of(robot):
    """Names of the bodies of all pairs, without order."""
    names = [body.name for body in robot.bodies.geometryObjects]
    return {frozenset((names[p.first], names[p.second])) for p in robot.bodies.collisionPairs}


def links(*indices):
    """Pairs of the chain's bodies, given as strings of two digits."""
    return {frozenset(f"link{i}_0" for i in pair) for pair in indices}


def test_neighbours_and_bodies_of_one_link_are_left_out(tmp_path):
    assert pairs_of(Robot.from_urdf(write_chain(tmp_path, 4))) == links("02", "03", "04", "13", "14", "24")
    bodies = [{"name": n, "frame": f"link{n[0]}", "shape": SPHERE} for n in ("0a", "0b", "1a", "1b", "2a")]
    robot = Robot.from_urdf(write_chain(tmp_path), bodies=bodies)
    assert pairs_of(robot) == {frozenset(("0a", "2a")), frozenset(("0b", "2a"))}


def test_disabled_pairs_match_patterns_in_either_order(tmp_path):
    urdf = write_chain(tmp_path, 4)
    disabled = [("link[34]_0", "link0_0"), ("link2_*", "link4_*")]
    assert pairs_of(Robot.from_urdf(urdf, disabled_pairs=disabled)) == links("02", "13", "14")
    assert pairs_of(Robot.from_urdf(urdf, disabled_pairs=[("*", "*")])) == set()


def test_srdf_of_the_panda_is_honoured_for_every_body_of_a_link(panda):
    srdf = ElementTree.parse(EXAMPLES / "panda_description/srdf/panda.srdf")
    off = {frozenset((d.get("link1"), d.get("link2"))) for d in srdf.iter("disable_collisions")}
    bodies = [(body.name, body.name.rpartition("_")[0], body.parentJoint) for body in panda.bodies.geometryObjects]
    expected = {
        frozenset((name_a, name_b))
        for i, (name_a, link_a, joint_a) in enumerate(bodies)
        for name_b, link_b, joint_b in bodies[:i]
        if abs(joint_a - joint_b) > 1 and frozenset((link_a, link_b)) not in off
    }
    assert pairs_of(panda) == expected and len(expected) > 20
    assert panda.notes == ()


def test_missing_and_broken_srdf(tmp_path):
    (tmp_path / "broken.srdf").write_text("<nonsense/>")
    for name, message in (("none.srdf", r"chain\.urdf: srdf: no such file"), ("broken.srdf", r"broken\.srdf")):
        with pytest.raises(ConfigError, match=message):
            Robot.from_urdf(write_chain(tmp_path), srdf=name)


@pytest.mark.parametrize("radius", [0.31, 0.40])
def test_pairs_that_always_touch_are_dropped_and_noted(tmp_path, radius):
    """Balls of more than 0.3 m in the middle of links of 0.3 m: every second one is never farther than 0.6 m away.

    The first and the last are 0.9 m apart when stretched and touch when folded: however seldom they part, and though
    they touch at the home pose, they are watched.
    """
    bodies = [
        {"name": f"b{i}", "frame": f"link{i}", "shape": {"type": "sphere", "radius": radius}, "position": [0, 0, 0.15]}
        for i in range(4)
    ]
    folded = {f"joint{i}": 2.0 for i in (1, 2, 3)}
    with pytest.warns(RobotWarning, match=r"home b0 - b3 \(-.* mm\): touch there"):
        robot = Robot.from_urdf(write_chain(tmp_path), bodies=bodies, home=folded)
    assert pairs_of(robot) == {frozenset(("b0", "b3"))}
    pairs = [note for note in robot.notes if note.kind is NoteKind.PAIR]
    assert [(note.subject, note.fraction) for note in pairs] == [(("b0", "b2"), 1.0), (("b1", "b3"), 1.0)]
    assert look(build_scene(robot), robot.home).distance[0] < 0.0


def test_no_pair_of_bodies_that_a_lock_makes_rigid(tmp_path):
    """With joints 2 and 3 held, links 1 to 3 are one body; links 0 and 3 can still meet."""
    robot = Robot.from_urdf(write_chain(tmp_path))
    locked, _ = robot.lock(["joint[23]"], robot.home, "test")
    joints = {body.name: body.parentJoint for body in locked.bodies.geometryObjects}
    rigid = [pair for pair in pairs_of(locked) if len({joints[name] for name in pair}) == 1]
    assert rigid == []
    assert links("03") <= pairs_of(locked)


def test_every_body_is_paired_with_every_obstacle(paper):
    ball = config.Sphere(type="sphere", radius=0.05)
    scene = build_scene(paper, [obstacle(name, ball, (0.0, 0.0, 2.0)) for name in ("one", "two")])
    assert len(scene.pair_names) == len(scene.pairs) == 9 + 2 * 6
    assert {a for a, b in scene.pair_names if b == "two"} == set(scene.body_names)
    assert scene.obstacle_names == ["one", "two"]
    assert (scene.pairs[:, 0] < 6).all()  # the first of a pair is always the robot's
    assert len(paper.bodies.geometryObjects) == 6  # the robot itself is left as it was


def test_an_obstacle_cannot_have_the_name_of_a_body(paper):
    with pytest.raises(ConfigError, match="'left_hand' is the name of a body of paper-dual-arm: rename it"):
        build_scene(paper, [obstacle("left_hand", config.Sphere(type="sphere", radius=0.05), (0.0, 0.0, 0.0))])
