"""From a URDF to a robot.yaml: bodies enclose, pairs are judged right, a home pose is clear, tools are found."""

import math
import xml.etree.ElementTree as ElementTree
from itertools import pairwise

import coal
import numpy as np
import pinocchio as pin
import pytest
from conftest import EXAMPLES, differences, write_chain
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import ConvexHull

from qpavoid import ConfigError, Robot, UnknownName
from qpavoid.config import Capsule, Hull
from qpavoid.geometry.bodies import hull_points, surface_triangles
from qpavoid.geometry.capsules import CapsuleFit, fit_capsule
from qpavoid.geometry.meshes import cut
from qpavoid.geometry.protrusion import Surface
from qpavoid.model.end_effectors import end_effectors
from qpavoid.model.pairs import D1
from qpavoid.model.trajectory import rpy_to_matrix
from qpavoid.model.urdf import read_model
from qpavoid.run.metrics import point_segment_distance
from qpavoid.setup.add import DescribeOptions, describe
from qpavoid.setup.fit import decompose, fit_piece, inside_volume
from qpavoid.setup.home import HOME_CLEARANCE, MIN_CONDITIONING, Limbs, find_home
from qpavoid.setup.sampling import (
    NEVER_NEAR,
    PairDistances,
    draw_poses,
    robot_size,
    safety_distances,
    sample_pairs,
    touching,
)
from qpavoid.setup.shapes import capsule_fields
from qpavoid.setup.srdf import MADE_BY, Semantics, find_srdf, read_srdf, srdf_text
from qpavoid.setup.texts import description_files, write_files

PANDA = EXAMPLES / "panda_description/urdf/panda.urdf"
PLACE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.5, 1.0), np.array([0.1, -0.2, 0.3]))


def box_surface(low, high):
    """Triangles (12, 3, 3) of a box."""
    points = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * np.subtract(high, low) + low
    return points[ConvexHull(points).simplices]


L_SHAPE = np.concatenate([box_surface([0, 0, 0], [0.5, 0.05, 0.05]), box_surface([0, 0, 0], [0.05, 0.05, 0.4])])


def on_surface(surface, count, rng):
    """Random points (count, 3) on triangles."""
    corners = surface[rng.integers(len(surface), size=count)]
    return np.einsum("nk,nki->ni", rng.dirichlet(np.ones(3), count), corners)


def outside(points, capsules):
    """How far the outermost point sticks out of all capsules [m]."""
    depth = []
    for fit in capsules:
        half = 0.5 * fit.length * fit.rotation[:, 2]
        depth.append(point_segment_distance(points, fit.center - half, fit.center + half) - fit.radius)
    return float(np.min(depth, axis=0).max())


# --- fit ------------------------------------------------------------------------------------------------------


@settings(max_examples=60)
@given(
    arrays(np.float64, (6, 3, 3), elements=st.floats(-1.0, 1.0)),
    arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)).filter(lambda n: np.linalg.norm(n) > 0.1),
    st.floats(-0.8, 0.8),
)
def test_a_cut_surface_is_the_same_surface(surface, normal, height):
    """The halves have the whole's area, and each lies on its side of the plane."""

    def area(surface):
        return (
            0.5 * np.linalg.norm(np.cross(surface[:, 1] - surface[:, 0], surface[:, 2] - surface[:, 0]), axis=1).sum()
        )

    normal = normal / np.linalg.norm(normal)
    below, above = cut(surface, surface @ normal - height)
    in_plane = np.all(surface @ normal - height == 0.0, axis=1)  # such triangles belong to both
    assert area(above) + area(below) == pytest.approx(area(surface) + area(surface[in_plane]), abs=1e-9)
    assert np.all(above @ normal >= height - 1e-9) and np.all(below @ normal <= height + 1e-9)


def test_several_capsules_enclose_an_angle_in_less_room():
    """A rod stays one: a cut would not pay."""
    rod, whole = box_surface([0, 0, 0], [0.6, 0.05, 0.05]), fit_capsule(L_SHAPE.reshape(-1, 3))
    capsules = decompose(L_SHAPE, whole)
    assert len(capsules) >= 2 and sum(fit.volume for fit in capsules) < 0.4 * whole.volume
    assert outside(on_surface(L_SHAPE, 4000, np.random.default_rng(0)), capsules) <= 1e-9
    assert len(decompose(rod, fit_capsule(rod.reshape(-1, 3)))) == 1


@pytest.mark.parametrize("flipped", range(4))
def test_volume_inside_a_mesh_does_not_depend_on_how_its_triangles_are_turned(flipped):
    box = coal.BVHModelOBBRSS()
    box.beginModel(12, 36)
    for k, corners in enumerate(box_surface([1.0, 0, 0], [1.5, 0.2, 0.4])):
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        is_outward = normal @ (corners[0] - [1.25, 0.1, 0.2]) > 0.0
        box.addTriangle(*(corners if is_outward == (k >= flipped) else corners[::-1]))
    box.endModel()
    assert inside_volume(box) == pytest.approx(0.04)


def kinds_of(shape, how="auto", bound=0.02, place=PLACE):
    parts = fit_piece(shape, place, how, Surface([(shape, place)], bound))
    return [type(part.geometry) for part in parts]


@pytest.mark.parametrize(
    ("shape", "bound", "expected"),
    [
        (coal.Sphere(0.1), 0.0, coal.Sphere),
        (coal.Capsule(0.05, 0.3), 0.0, coal.Capsule),
        (
            coal.Cylinder(0.02, 0.4),
            0.03,
            coal.Capsule,
        ),  # its caps stand out by 20 mm
        (coal.Cylinder(0.02, 0.4), 0.01, coal.Cylinder),
        (coal.Cylinder(0.02, 0.002), 0.03, coal.Cylinder),  # a disc: the capsule is gross
        (coal.Box(0.02, 0.02, 0.02), 0.03, coal.Box),  # 2.7 times its volume
    ],
)
def test_auto_takes_a_capsule_where_it_is_within_the_bound_and_not_gross(shape, bound, expected):
    assert kinds_of(shape, "auto", bound) == [expected]
    assert kinds_of(shape, "capsule", bound) in ([coal.Capsule], [coal.Sphere])


def mesh(surface):
    result = coal.BVHModelOBBRSS()
    result.beginModel(len(surface), 3 * len(surface))
    for corners in surface:
        result.addTriangle(*corners)
    result.endModel()
    return result


def test_auto_takes_the_cheapest_body_that_is_within_the_bound():
    """Of a bar a box; of a wedge its hull; of two bars at an angle two hulls."""
    assert kinds_of(mesh(box_surface([0, 0, 0], [0.5, 0.1, 0.2])), bound=0.005) == [coal.Box]
    wedge = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.3, 0], [0, 0, 0.2], [0.3, 0, 0.2], [0, 0.3, 0.2]])
    (kind,) = kinds_of(mesh(wedge[ConvexHull(wedge).simplices]), bound=0.01)
    assert issubclass(kind, coal.ConvexBase)
    bars = [(coal.Box(0.5, 0.05, 0.05), [0.25, 0.025, 0.025]), (coal.Box(0.05, 0.05, 0.35), [0.025, 0.025, 0.225])]
    angle = np.concatenate([surface_triangles(box) + np.array(center) for box, center in bars])
    surface = Surface([(mesh(angle), PLACE)], 0.005)
    parts = fit_piece(mesh(angle), PLACE, "auto", surface)
    assert len(parts) == 2 and surface.holds([part.placed for part in parts])
    for point in on_surface(angle, 200, np.random.default_rng(0)):
        at = pin.SE3(np.eye(3), PLACE.act(point))
        assert min(signed_distance(coal.Sphere(1e-9), at, part.geometry, part.place) for part in parts) < 1e-6


directions = arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)).filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(max_examples=100)
@given(directions, directions, st.floats(1e-6, 0.5), st.floats(0.0, 0.8), directions)
def test_what_is_written_encloses_what_was_fitted(axis, center, radius, length, turn):
    """Five digits after the point, and the radius makes up for what they lose."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    fit = CapsuleFit(center, np.column_stack([x, np.cross(z, x), z]), radius, length)
    placement = pin.SE3(pin.exp3(turn), np.array([0.3, -0.2, 0.1]))
    fields = capsule_fields(CapsuleFit(placement.act(fit.center), placement.rotation @ fit.rotation, radius, length))
    shape = fields["shape"]
    written = 0.5 * getattr(shape, "length", 0.0) * rpy_to_matrix(fields["rpy"])[:, 2]
    for side in (-1.0, 1.0):
        end = placement.act(fit.center + side * 0.5 * length * fit.rotation[:, 2])
        sticks_out = np.linalg.norm(end - (np.array(fields["position"]) + side * written))
        assert sticks_out + radius <= shape.radius + 1e-12
    assert shape.radius < radius + 5e-5
    assert all(round(number, 5) == number for number in (*fields["position"], *fields["rpy"], shape.radius))


@pytest.fixture(scope="module")
def panda_described():
    kinds = ("auto", "capsule", "capsules", "convex")
    return {kind: describe(PANDA, DescribeOptions(bodies=kind, samples=300)) for kind in kinds}


@pytest.mark.parametrize("kind", ["auto", "capsule", "capsules", "convex"])
def test_bodies_enclose_every_vertex(panda_described, kind):
    """Of every mesh and box, in the shapes that are written, but for rounding errors of coal's own distance."""
    described = panda_described[kind]
    bodies = {}
    for body, live in zip(described.config.bodies, described.robot.bodies.geometryObjects, strict=True):
        in_link = described.robot.model.frames[live.parentFrame].placement.actInv(live.placement)
        bodies.setdefault(body.frame, []).append((live.geometry, in_link))
    point = coal.Sphere(1e-9)
    for piece in described.pieces:
        corners = surface_triangles(piece.geometry).reshape(-1, 3)
        corners = corners[np.unique(ConvexHull(corners).vertices)] if kind == "convex" else np.unique(corners, axis=0)
        for corner in corners[:: max(1, len(corners) // 60)]:
            place = pin.SE3(np.eye(3), piece.placement.act(corner))
            assert min(signed_distance(point, place, shape, at) for shape, at in bodies[piece.link]) < 1e-6


def signed_distance(point, place, shape, at):
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance = 1e-9
    to = [coal.Transform3s(pose.rotation, pose.translation) for pose in (place, at)]
    return coal.distance(point, to[0], shape, to[1], request, result)


def test_single_links_may_be_another_kind():
    described = describe(PANDA, DescribeOptions(bodies="capsule", bodies_of={"panda_link[02]": "convex"}, samples=10))
    shapes = {body.name: type(body.shape) for body in described.config.bodies}
    assert shapes["panda_link0"] is shapes["panda_link2"] is Hull
    assert shapes["panda_link1"] is Capsule
    with pytest.raises(UnknownName, match=r"--bodies: no link with geometry 'panda_lnk0'; did you mean 'panda_link"):
        describe(PANDA, DescribeOptions(bodies_of={"panda_lnk0": "convex"}))


# --- pairs ----------------------------------------------------------------------------------------------------


def chain(tmp_path, bodies, joints=2, **fields):
    return Robot.from_urdf(write_chain(tmp_path, joints), bodies=bodies, **fields)


def ball(name, frame, position, radius=0.05):
    return {"name": name, "frame": frame, "shape": {"type": "sphere", "radius": radius}, "position": position}


def test_distances_fall_along_their_gradient(tmp_path):
    robot = chain(tmp_path, [ball("base", "link0", [0, 0.3, 0]), ball("tip", "link2", [0, 0, 0.25])])
    distances = PairDistances(robot)
    q = np.array([0.4, -0.7])
    d, slope = distances.gradient(0, q)
    assert d == pytest.approx(distances.all(q)[0])
    np.testing.assert_allclose(slope, differences(lambda q: distances.all(q), robot, q)[0], atol=1e-6)


def test_descent_finds_what_samples_miss(tmp_path):
    """A ball in the reach of the tip at one pose only: of ten samples none comes near, the descent does."""
    reach = 0.3 * np.array([0.0, -math.sin(1.2), math.cos(1.2)]) + [0, 0, 0.3]
    tip = reach + 0.25 * np.array([0.0, -math.sin(1.2 - 0.9), math.cos(1.2 - 0.9)])
    robot = chain(tmp_path, [ball("base", "link0", tip, 0.01), ball("tip", "link2", [0, 0, 0.25], 0.01)])
    assert touching(robot, np.array([1.2, -0.9]))
    distances, draws = PairDistances(robot), draw_poses(robot, 10)
    assert min(distances.all(q)[0] for q in draws) > NEVER_NEAR * robot_size(robot)
    assert not sample_pairs(robot, samples=10).never[0]


@pytest.mark.filterwarnings("ignore::qpavoid.model.notes.RobotWarning")
def test_pairs_are_judged_by_samples_and_a_descent(tmp_path):
    """Of a ball out of reach, one that is struck now and then, and two that never part by design."""
    bodies = [
        ball("far", "link0", [0, 0, -2.0]), ball("tip", "link2", [0, 0, 0.25]), ball("side", "link0", [0, 0.4, 0.3])
    ]  # fmt: skip
    robot = chain(tmp_path, bodies)
    sampled, distances = sample_pairs(robot, samples=300), PairDistances(robot)
    far, side = [[distances.names[a] for a, _ in distances.pairs].index(name) for name in ("far", "tip")]
    assert sampled.never.tolist()[far] and not sampled.never[side] and not sampled.always.any()
    draws = draw_poses(robot, 3000, 1)  # the descent comes as near as ten times the samples
    assert sampled.closest[far] <= min(distances.all(q)[far] for q in draws) + 1e-6
    held = chain(tmp_path, [ball("a", "link0", [0.0, 0.0, 0.26], 0.01), ball("b", "link2", [0, 0, -0.3], 0.01)],
                 limits={"position": {"joint1": (-0.01, 0.01), "joint2": (-0.01, 0.01)}})  # fmt: skip
    sampled = sample_pairs(held, 300)  # near all along its range, but never in touch: it is kept
    assert not sampled.always.any() and not sampled.touching.any()
    gap = np.median([touching(held, q, np.inf)[0][2] for q in sampled.poses])
    assert safety_distances(sampled)[0] == pytest.approx(0.5 * gap, abs=1e-4) and gap < D1


@pytest.mark.filterwarnings("ignore::qpavoid.model.notes.RobotWarning")
def test_home_is_the_wish_or_near_it(tmp_path):
    """Clear by 4/3 of the safety distance, or of the pair's own, and hardly farther from the wish than that takes."""
    robot = chain(tmp_path, [ball("base", "link0", [0, 0, 0.85]), ball("tip", "link2", [0, 0, 0.25])])
    assert touching(robot, robot.home)[0][2] < 0.0
    d1, good = np.array([D1]), np.array([0.0, 1.0])
    home = find_home(robot, [robot.home, good], [], d1)
    assert (
        home.preference == 1
        and np.array_equal(home.q, good)
        and home.clearance >= HOME_CLEARANCE * D1
        and home.deficit == 0.0
    )
    for own in (D1, 0.003):
        home = find_home(robot, [robot.home], [], np.array([own]))
        assert home.preference is None and touching(robot, home.q, np.inf)[0][2] == home.clearance
        assert HOME_CLEARANCE * own <= home.clearance < HOME_CLEARANCE * own + 0.02 and home.nearest == ("base", "tip")
        assert np.linalg.norm(home.q - robot.home) < 1.0
        bounds = robot.bounds()
        assert np.all(home.q >= bounds.lower) and np.all(home.q <= bounds.upper)


def test_home_is_bent(tmp_path):
    """Stretched, links cannot move their tip along themselves: the smaller singular value is that of a closed form."""
    robot = chain(tmp_path, [ball("base", "link0", [0, 0, 0.0])])
    limbs = Limbs(robot, ["link2"])
    for bend in (0.0, 0.7, -1.2):
        J = np.array([[0.3 + 0.0 * bend, 0.0], [0.0, 0.0]])  # of the frame of link2, 0.3 m from joint1 and on joint2
        limb = limbs.at(np.array([0.2, bend]))["link2"]
        assert limb.value == pytest.approx(np.linalg.svd(J, compute_uv=False)[0], abs=1e-9)
    tool = chain(tmp_path, [ball("base", "link0", [0, 0, 0.0])], 3)
    q = np.array([0.3, 0.8, 0.1])
    limb = Limbs(tool, ["link3"]).at(q)["link3"]
    angles = np.cumsum(q)
    along = 0.3 * np.array([[-np.cos(a), -np.sin(a)] for a in angles])
    columns = np.array([along[0] + along[1], along[1], [0.0, 0.0]]).T
    assert limb.value == pytest.approx(np.linalg.svd(columns, compute_uv=False)[1], abs=1e-9)
    straight = find_home(tool, [np.zeros(3)], ["link3"], np.zeros(0))
    assert (
        straight.preference is None
        and not straight.singular
        and straight.conditioning["link3"].ratio >= MIN_CONDITIONING
    )
    assert np.count_nonzero(straight.q) == 1  # one bend is enough
    pinned = find_home(tool, [np.zeros(3)], ["link3"], np.zeros(0), pinned=["joint2"])
    assert pinned.singular == ["link3"] and pinned.q[1] == 0.0


@pytest.mark.filterwarnings("ignore::qpavoid.model.notes.RobotWarning")
def test_samples_keep_to_the_limits_and_the_root_stays():
    robot = Robot.from_urdf(EXAMPLES / "kinova_description/robots/kinova.urdf", root_joint="free_flyer")
    bounds = robot.bounds()
    draws = draw_poses(robot, 50)
    np.testing.assert_allclose(draws[:, :7], np.tile(pin.neutral(robot.model)[:7], (50, 1)), atol=1e-12)
    assert all(np.allclose(pin.normalize(robot.model, q), q) for q in draws)
    assert np.all(draws[:, bounds.q_index] >= bounds.lower) and np.all(draws[:, bounds.q_index] <= bounds.upper)
    assert np.ptp(draws[:, 7:], axis=0).min() > 0.5


# --- ends and SRDF ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("urdf", "expected"),
    [
        ("panda_description/urdf/panda.urdf", ["panda_hand_tcp"]),
        ("ur_description/urdf/ur5_robot.urdf", ["tool0"]),
        ("baxter_description/urdf/baxter.urdf", ["left_gripper", "right_gripper"]),
        ("solo_description/robots/solo12.urdf", ["FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"]),
        ("tiago_description/robots/tiago_dual.urdf", ["arm_left_tool_link", "arm_right_tool_link"]),
        (
            "g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf",
            ["left_ankle_roll_link", "right_ankle_roll_link", "left_hand_palm_link", "right_hand_palm_link"],
        ),
        ("double_pendulum_description/urdf/double_pendulum.urdf", ["link2"]),
        ("hector_description/robots/quadrotor_base.urdf", []),
    ],
)
def test_ends_of_limbs(urdf, expected):
    assert end_effectors(read_model(EXAMPLES / urdf, "fixed")) == expected


def test_hands_of_a_dual_arm_are_its_ends(tmp_path):
    """Two arms of seven joints below a waist, with a thumb of five joints and fingers of four, none called a finger."""
    links, joints = ["base", "torso"], ["base torso"]
    for side in "lr":
        arm = ["torso", *(f"{side}_arm{i}" for i in range(1, 8))]
        links += arm[1:]
        joints += [f"{a} {b}" for a, b in pairwise(arm)]
        for digit, count in (("th", 5), ("ff", 4), ("mf", 4), ("rf", 4), ("lf", 4)):
            chain = [arm[-1], *(f"{side}_{digit}{i}" for i in range(count))]
            links += chain[1:]
            joints += [f"{a} {b}" for a, b in pairwise(chain)]
    text = "".join(f'<link name="{link}"/>' for link in [*links, "l_tcp"])
    for joint in joints:
        parent, child = joint.split()
        text += (
            f'<joint name="{child}_joint" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
            '<origin xyz="0 0 .1"/><axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
        )
    text += '<joint name="flange" type="fixed"><parent link="l_arm7"/><child link="l_tcp"/></joint>'
    (tmp_path / "dual.urdf").write_text(f'<robot name="dual">{text}</robot>')
    model = read_model(tmp_path / "dual.urdf", "fixed")
    assert end_effectors(model) == ["l_tcp", "r_arm7"]
    assert end_effectors(model, ["l_arm7"]) == ["l_tcp", "r_arm7"]  # an SRDF names the link that carries the hand


def test_srdf_is_read_back_as_written(tmp_path):
    disabled = {frozenset(("a", "b")): "Never", frozenset(('c"&', "a")): "User"}
    path = tmp_path / "x.srdf"
    text = srdf_text("x", "words -- and more", disabled, ["hand"])
    states = "".join(f"<group_state name='{n}'><joint name='j' value='{v}'/></group_state>"
                     for n, v in (("arm_up", "1"), ("home", "2"), ("odd", "1 2")))  # fmt: skip
    path.write_text(text.replace("</robot>", f"{states}</robot>"))
    read = read_srdf(path)
    assert read == Semantics(disabled, {"home": {"j": 2.0}, "arm_up": {"j": 1.0}, "odd": {}}, ("hand",))
    assert list(read.states) == ["home", "arm_up", "odd"]


def test_the_srdf_beside_a_urdf_is_found_unless_it_is_our_own(tmp_path):
    urdf = write_chain(tmp_path)
    assert find_srdf(urdf) is None
    (tmp_path / "other.srdf").write_text("<robot name='x'/>")
    (tmp_path / "chain.srdf").write_text(f"<!-- {MADE_BY} --><robot name='x'/>")
    assert find_srdf(urdf) is None
    (tmp_path / "srdf").mkdir()
    (tmp_path / "srdf" / "chain_moveit.srdf").write_text("<robot name='x'/>")
    assert find_srdf(urdf) == tmp_path / "srdf" / "chain_moveit.srdf"
    assert find_srdf(PANDA) == EXAMPLES / "panda_description/srdf/panda.srdf"


# --- the whole ------------------------------------------------------------------------------------------------


def pairs(robot):
    names = [body.name for body in robot.bodies.geometryObjects]
    return {frozenset((names[p.first], names[p.second])) for p in robot.bodies.collisionPairs}


@pytest.mark.parametrize("kind", ["auto", "capsules"])
def test_the_written_robot_is_the_one_that_was_worked_out(panda_described, kind, tmp_path):
    described = panda_described[kind]
    write_files(description_files(described, tmp_path / "made"))
    robot = Robot.load(str(tmp_path / "made" / "robot.yaml"))
    assert pairs(robot) == pairs(described.robot) and len(pairs(robot)) == described.counts["active"]
    np.testing.assert_allclose(robot.home, described.robot.home, atol=1e-5)
    assert robot.end_effectors == ("panda_hand_tcp",)
    assert not touching(robot, robot.home, D1)
    assert robot.always_touching == [] and robot.margins == described.robot.margins
    for mine, theirs in zip(robot.bodies.geometryObjects, described.robot.bodies.geometryObjects, strict=True):
        assert mine.name == theirs.name
        np.testing.assert_allclose(mine.placement.homogeneous, theirs.placement.homogeneous, atol=1e-12)


def test_an_srdf_is_honoured_and_its_pairs_are_kept(panda_described, tmp_path):
    described = panda_described["auto"]
    theirs = read_srdf(EXAMPLES / "panda_description/srdf/panda.srdf").disabled
    assert {pair: described.disabled[pair] for pair in theirs} == dict(theirs)
    links = {body.name: body.frame for body in described.config.bodies}
    assert not any(frozenset(links[b] for b in pair) in theirs for pair in pairs(described.robot))
    counts = described.counts
    assert counts["all"] == sum(counts[k] for k in ("adjacent", "srdf", "always", "drawn in", "never", "active"))
    path = tmp_path / "made" / "panda.srdf"
    write_files(description_files(described, path.parent))
    assert {d.get("reason") for d in ElementTree.parse(path).iter("disable_collisions")} >= {"Adjacent", "Never"}


def test_home_and_locks_may_be_wished():
    urdf = EXAMPLES / "ur_description/urdf/ur5_robot.urdf"
    wishes = {"home": {"elbow_joint": 1.57, "wrist_3_joint": 0.5}, "lock": ["wrist_3*"]}
    options = DescribeOptions(**wishes, samples=10, protrusion=0.1, wrist_protrusion=0.1)
    config = describe(urdf, options).config
    assert config.home["elbow_joint"] == 1.57 and config.lock == {"wrist_3_joint": 0.5}
    with pytest.raises(UnknownName, match=r"--home: no joint 'elbow'; did you mean 'elbow_joint'"):
        describe(urdf, DescribeOptions(home={"elbow": 1.0}))
    with pytest.raises(UnknownName, match=r"--lock: no joint 'wrist_9'"):
        describe(urdf, DescribeOptions(lock=["wrist_9"]))


def test_capsules_too_fat_for_the_home_pose_become_tighter(tmp_path):
    """Two discs, 8 cm apart: the capsules around them are 20 cm thick."""
    urdf = write_chain(tmp_path, 2, shape='<cylinder radius="0.1" length="0.12"/>')
    described = describe(urdf, DescribeOptions(samples=50, protrusion=0.1, wrist_protrusion=0.1))
    assert all(isinstance(body.shape, Capsule) for body in described.config.bodies)
    close = urdf.read_text().replace('xyz="0 0 0.3"', 'xyz="0 0 0.08"')
    urdf.write_text(close.replace('length="0.12"', 'length="0.12"'))
    described = describe(urdf, DescribeOptions(samples=50, protrusion=0.1, wrist_protrusion=0.1))
    shapes = {body.name: body.shape.type for body in described.config.bodies}
    assert shapes["link0"] == shapes["link2"] == "cylinder"
    assert any("tighter bodies" in note.what and {"link0", "link2"} <= {*note.subject} for note in described.notes)


def test_hulls_of_a_robot_yaml(panda_convex):
    bodies = [
        {"name": "elbow", "frame": "panda_link4", "shape": {"type": "hull", "geometry": "panda_link4_0"}},
        {"name": "shifted", "frame": "panda_link4", "shape": {"type": "hull", "geometry": "panda_link4_0"},
         "position": [0.1, 0.0, 0.0]},
    ]  # fmt: skip
    robot = Robot.from_urdf(PANDA, bodies=bodies)
    whole = {body.name: body for body in panda_convex.bodies.geometryObjects}["panda_link4_0"]
    elbow, shifted = robot.bodies.geometryObjects
    np.testing.assert_array_equal(hull_points(elbow.geometry), hull_points(whole.geometry))
    assert elbow.parentJoint == whole.parentJoint
    np.testing.assert_allclose(elbow.placement.homogeneous, whole.placement.homogeneous, atol=1e-12)
    np.testing.assert_allclose(shifted.placement.translation - elbow.placement.translation, [0.1, 0, 0], atol=1e-12)
    bodies[0]["shape"]["geometry"] = "panda_link4"
    with pytest.raises(UnknownName, match=r"bodies\.0\.shape\.geometry: no collision geometry 'panda_link4'; did you"):
        Robot.from_urdf(PANDA, bodies=bodies)


def test_all_files_are_written_or_none(tmp_path):
    a, b = tmp_path / "new" / "a", tmp_path / "new" / "b"
    assert write_files({a: "old", b: "old"}) == {a: "written", b: "written"}
    with pytest.raises(ConfigError, match=r"new/b: is there already.*--force"):
        write_files({a: "old", b: "new"})
    assert (a.read_text(), b.read_text()) == ("old", "old")
    assert write_files({a: "old", b: "new"}, force=True) == {a: "unchanged", b: "updated"}
    with pytest.raises(ConfigError, match="--out"):
        write_files({a / "c": "new"})
