"""How far bodies stand out of geometry, against closed forms; and which links are from the wrist on."""

import coal
import numpy as np
import pinocchio as pin
import pytest
from conftest import EXAMPLES, write_chain
from scipy.spatial import ConvexHull

from qpavoid import ConfigError, Robot
from qpavoid.geometry.bodies import hull_points
from qpavoid.geometry.meshes import convex_hull
from qpavoid.geometry.primitives import fit_box, fit_cylinder
from qpavoid.geometry.protrusion import Surface, surface_samples
from qpavoid.model.end_effectors import end_effectors
from qpavoid.model.urdf import read_model, read_pieces
from qpavoid.setup.shapes import pieces_of
from qpavoid.setup.wrist import wrist_links

ORIGIN = pin.SE3.Identity()
PLACE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.5, 1.0), np.array([0.1, -0.2, 0.3]))
BALL = coal.Sphere(0.1)
SHAPES = {
    "sphere": BALL, "capsule": coal.Capsule(0.05, 0.2), "box": coal.Box(0.1, 0.2, 0.3),
    "cylinder": coal.Cylinder(0.06, 0.2), "ellipsoid": coal.Ellipsoid(0.1, 0.05, 0.08),
    "hull": convex_hull(np.random.default_rng(0).normal(size=(30, 3)) * 0.1),
}  # fmt: skip


@pytest.mark.parametrize(
    ("body", "geometry", "expected"),
    [
        (coal.Sphere(0.13), BALL, 0.03),
        (BALL, coal.Box(0.08, 0.08, 0.08), 0.06),  # over the middle of a face
        (coal.Box(0.2, 0.2, 0.2), BALL, 0.1 * (np.sqrt(3.0) - 1.0)),  # a corner
        (coal.Capsule(0.05, 0.4), coal.Cylinder(0.05, 0.4), 0.05),  # its caps
        (coal.Cylinder(0.1, 0.2), BALL, 0.1 * (np.sqrt(2.0) - 1.0)),  # the rim
    ],
)
@pytest.mark.parametrize("place", [ORIGIN, PLACE])
def test_one_body_stands_out_by_its_farthest_point(body, geometry, expected, place):
    surface = Surface([(geometry, place)], 0.01)
    found = surface.protrusion([(body, place)])
    assert expected - surface.spacing / 2 < found < expected + surface.spacing / 2
    assert not surface.holds([(body, place)])
    assert Surface([(geometry, place)], 1.3 * expected).holds([(body, place)])


def test_what_other_bodies_or_the_geometry_cover_does_not_stand_out():
    """Two halves of a bar meet inside it; of two balls on a bar, only what is beyond both counts."""
    bar, half = coal.Box(0.1, 0.1, 0.4), coal.Box(0.1, 0.1, 0.2)
    at = [pin.SE3(np.eye(3), np.array([0.0, 0.0, z])) for z in (-0.1, 0.1)]
    surface = Surface([(bar, ORIGIN)], 0.01)
    assert surface.protrusion([(half, place) for place in at]) < surface.spacing
    assert surface.protrusion([(coal.Box(0.02, 0.02, 0.02), ORIGIN)]) == 0.0  # inside
    balls = [(coal.Sphere(0.15), place) for place in at]
    assert surface.protrusion(balls) == pytest.approx(0.1, abs=surface.spacing)
    assert surface.protrusion([*balls, (coal.Box(0.3, 0.3, 0.3), at[0])]) == pytest.approx(
        float(np.sqrt(0.1**2 + 0.1**2 + 0.05**2)), abs=surface.spacing
    )


@pytest.mark.parametrize("kind", SHAPES)
def test_samples_are_on_the_surface_and_leave_no_gap(kind):
    shape, spacing = SHAPES[kind], 0.01
    points, outwards = surface_samples(shape, spacing)
    np.testing.assert_allclose(np.linalg.norm(outwards, axis=1), 1.0, atol=1e-9)
    rng, probe = np.random.default_rng(1), coal.Capsule(1e-9, 0.0)  # coal is wrong about spheres inside cylinders
    for point, outward in zip(points[::97], outwards[::97], strict=True):
        for height in (-2e-4, 2e-4):
            at = coal.Transform3s(np.eye(3), point + height * outward)
            distance = coal.distance(
                probe, at, shape, coal.Transform3s(), coal.DistanceRequest(), coal.DistanceResult()
            )
            assert abs(distance) < 4e-4
    if kind in ("box", "hull"):  # any point of a face
        corners = hull_points(shape)[ConvexHull(hull_points(shape)).simplices]
        anywhere = np.einsum(
            "nk,nki->ni", rng.dirichlet(np.ones(3), 100), corners[rng.integers(len(corners), size=100)]
        )
    else:  # on other samples of it, so fine that the gaps of these would show
        anywhere = rng.permutation(surface_samples(shape, spacing / 7)[0])[:100]
    assert max(np.linalg.norm(points - point, axis=1).min() for point in anywhere) <= spacing


@pytest.mark.parametrize("fit", [fit_box, fit_cylinder])
def test_boxes_and_cylinders_enclose_and_find_themselves_again(fit):
    rng = np.random.default_rng(2)
    cloud = rng.normal(size=(60, 3)) * [0.1, 0.2, 0.5] @ PLACE.rotation.T
    geometry, place = fit(cloud)
    local = (cloud - place.translation) @ place.rotation
    if fit is fit_box:
        assert (np.abs(local) <= geometry.halfSide).all()
        box, own = coal.Box(0.1, 0.2, 0.4), PLACE
        again = fit_box(hull_points(box) @ own.rotation.T + own.translation)[0]
        assert again.computeVolume() == pytest.approx(box.computeVolume(), rel=1e-6)
    else:
        assert (np.hypot(local[:, 0], local[:, 1]) <= geometry.radius).all()
        assert (np.abs(local[:, 2]) <= geometry.halfLength).all()


@pytest.mark.parametrize(
    ("path", "first", "before"),
    [
        ("panda_description/urdf/panda.urdf", ["panda_link5"], ["panda_link4"]),
        ("ur_description/urdf/ur5_robot.urdf", ["wrist_1_link"], ["forearm_link"]),
        (
            "baxter_description/urdf/baxter.urdf",
            ["left_lower_forearm", "right_lower_forearm", "l_gripper_l_finger_tip"],
            ["left_upper_forearm", "right_upper_forearm", "torso"],
        ),
        (
            "g1_description/urdf/g1_29dof_rev_1_0.urdf",
            ["left_ankle_pitch_link", "left_wrist_pitch_link"],
            ["left_knee_link", "left_elbow_link"],
        ),
    ],
)
def test_wrists_begin_where_joints_follow_each_other_closely(path, first, before):
    model = read_model(EXAMPLES / path, "fixed")
    links = wrist_links(model, end_effectors(model))
    assert links >= set(first) and not links & set(before)


@pytest.mark.parametrize(("name", "chosen_by_hand"), [("panda", set()), ("baxter", {"torso", "pedestal"})])
def test_shipped_robots_stand_out_no_farther_than_they_should(name, chosen_by_hand):
    robot, notes = Robot.load(name), []
    model = read_model(robot.urdf, "fixed")
    pieces = pieces_of(read_pieces(robot.urdf, model, robot.package_dirs, robot.urdf, notes).geometryObjects, model)
    wrist, frames = wrist_links(model, robot.end_effectors), robot.model.frames
    links = dict.fromkeys(frames[body.parentFrame].name for body in robot.bodies.geometryObjects)
    for link in [link for link in links if link not in chosen_by_hand]:
        bodies = [
            (body.geometry, frames[body.parentFrame].placement.actInv(body.placement))
            for body in robot.bodies.geometryObjects
            if frames[body.parentFrame].name == link
        ]
        shapes = [(piece.geometry, piece.placement) for piece in pieces if piece.link == link]
        assert Surface(shapes, 0.005 if link in wrist else 0.02).holds(bodies), link


def test_polytope_is_the_hull_of_its_corners(tmp_path):
    corners = (hull_points(coal.Box(0.1, 0.2, 0.3)) + np.array([0.0, 0.1, 0.0])).tolist()
    shape = {"type": "polytope", "corners": corners}
    body = {"name": "box", "frame": "link1", "shape": shape, "position": [0.0, 0.0, 0.2]}
    robot = Robot.from_urdf(write_chain(tmp_path), bodies=[body])
    (made,) = robot.bodies.geometryObjects
    found, wanted = (np.unique(np.round(points, 9), axis=0) for points in (np.array(made.geometry.points()), corners))
    np.testing.assert_allclose(found, wanted)
    np.testing.assert_allclose(made.placement.translation, [0.0, 0.0, 0.2], atol=1e-12)
    with pytest.raises(ConfigError, match="corners"):
        Robot.from_urdf(write_chain(tmp_path), bodies=[{**body, "shape": {**shape, "corners": corners[:3]}}])
