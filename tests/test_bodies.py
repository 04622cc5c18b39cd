"""Collision shapes made from meshes: they enclose what they stand for, and not much more."""

import coal
import numpy as np
import pinocchio as pin
import pytest
from conftest import BOX, CYLINDER, EXAMPLES, write_chain
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracle import DIRECTIONS, support
from scipy.optimize import minimize
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from urdfs import TETRAHEDRON, write_stl

from qpavoid import Robot
from qpavoid.config import Cone, Ellipsoid
from qpavoid.geometry.bodies import convert_bodies, enclosing_capsule, make_shape
from qpavoid.geometry.capsules import fit_capsule
from qpavoid.model.urdf import read_model, read_pieces
from qpavoid.run.metrics import point_segment_distance

PANDA = EXAMPLES / "panda_description/urdf/panda.urdf"


@pytest.fixture(scope="module")
def meshes():
    """Vertices of the Panda's collision meshes, by name."""
    bodies = read_pieces(PANDA, read_model(PANDA, "fixed"), [], PANDA, visuals=False, enclosed=True).geometryObjects
    return {b.name: np.array(b.geometry.vertices()) for b in bodies if isinstance(b.geometry, coal.BVHModelBase)}


def overlap(fit, points):
    """How far the outermost point sticks out of the capsule [m]; negative when all are inside."""
    half = 0.5 * fit.length * fit.rotation[:, 2]
    return float(np.max(point_segment_distance(points, fit.center - half, fit.center + half)) - fit.radius)


def capsule_volume(ends, points):
    """Volume of the smallest capsule around `points` with the given ends of its axis, flattened (6,)."""
    a, b = ends.reshape(2, 3)
    r = np.max(point_segment_distance(points, a, b))
    return np.pi * r**2 * (np.linalg.norm(b - a) + 4.0 / 3.0 * r)


# --- fit_capsule ---------------------------------------------------------------------------------------------


clouds = st.integers(1, 30).flatmap(lambda n: arrays(np.float64, (n, 3), elements=st.floats(-1.0, 1.0)))
flattened = st.sampled_from([(1, 1, 1), (1, 1, 0), (0, 1, 0), (0, 0, 0), (1, 1, 1e-9)])
turned = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(lambda r: Rotation.from_rotvec(r).as_matrix())
shifted = st.tuples(*[st.floats(-5.0, 5.0)] * 3).map(np.array)


@settings(max_examples=60, deadline=None)
@given(clouds, flattened, turned, shifted)
def test_every_point_is_inside(cloud, scale, rotation, shift):
    """Of a cloud in space, in a plane, on a line, and of a single point."""
    points = cloud * np.array(scale) @ rotation.T + shift
    fit = fit_capsule(points, directions=40)
    assert overlap(fit, points) < 1e-9
    assert fit.radius > 0.0 and fit.length >= 0.0
    np.testing.assert_allclose(fit.rotation.T @ fit.rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(fit.rotation) == pytest.approx(1.0)


def smallest_volume(points, guess):
    """Volume that a local search over the ends of the axis comes to, from a fit and from a short axis."""
    half = 0.5 * guess.length * guess.rotation[:, 2]
    center = points.mean(axis=0)
    principal = np.linalg.svd(points - center)[2][0] * 0.05
    starts = ((guess.center - half, guess.center + half), (center - principal, center + principal))
    options = {"maxfev": 800, "xatol": 1e-6, "fatol": 1e-10}
    return min(
        minimize(capsule_volume, np.concatenate(ends), (points,), "Nelder-Mead", options=options).fun for ends in starts
    )


def test_every_vertex_of_the_panda_is_inside_and_little_else(meshes):
    for name, points in meshes.items():
        fit = fit_capsule(points)
        assert overlap(fit, points) < 1e-9, name
        hull = ConvexHull(points)
        assert hull.volume < fit.volume < 1.2 * smallest_volume(points[hull.vertices], fit), name


@pytest.mark.parametrize(("radius", "length"), [(0.05, 0.4), (0.1, 0.1), (0.08, 0.0)])
def test_points_on_a_capsule_give_it_back(radius, length):
    polar, around = np.meshgrid(np.linspace(0.0, np.pi, 26), np.linspace(0.0, 2.0 * np.pi, 33))
    ball = np.stack((np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)), axis=-1)
    caps = radius * ball.reshape(-1, 3)
    caps[:, 2] += np.copysign(length / 2, caps[:, 2])
    rotation, center = Rotation.from_rotvec([0.5, -1.0, 0.7]).as_matrix(), np.array([1.0, 2.0, 3.0])
    points = caps @ rotation.T + center
    fit = fit_capsule(points)
    assert fit.radius == pytest.approx(radius, rel=0.03)
    assert fit.length + 2 * fit.radius == pytest.approx(length + 2 * radius, rel=0.03)
    np.testing.assert_allclose(fit.center, center, atol=0.05 * radius)
    if length > 2 * radius:
        assert abs(fit.rotation[:, 2] @ rotation[:, 2]) > np.cos(0.06)


# --- whole shapes ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [BOX, CYLINDER, Cone(radius=0.09, length=0.25), Ellipsoid(radii=(0.1, 0.16, 0.07))])
def test_shapes_are_enclosed(shape):
    """In every direction the capsule reaches as far as the shape."""
    geometry = make_shape(shape)
    fit = enclosing_capsule(geometry)
    capsule = support(coal.Capsule(fit.radius, fit.length), pin.SE3(fit.rotation, fit.center))
    assert (capsule(DIRECTIONS) >= support(geometry, pin.SE3.Identity())(DIRECTIONS) - 1e-9).all()


@pytest.mark.parametrize(("radius", "length"), [(0.03, 0.2), (0.1, 0.1)])
def test_cylinder_is_enclosed_tightly(radius, length):
    angle = np.linspace(0.0, 2.0 * np.pi, 360)
    rim = np.column_stack((radius * np.cos(angle), radius * np.sin(angle), np.full(360, length / 2)))
    points = np.concatenate((rim, rim * (1, 1, -1)))
    fit = enclosing_capsule(coal.Cylinder(radius, length))
    assert overlap(fit, points) < 1e-9
    # coaxial capsules: a radius R lets the ends of the axis come in by √(R² - r²)
    R = np.linspace(radius, np.hypot(radius, length / 2), 1000)
    axis = np.maximum(length - 2.0 * np.sqrt(R**2 - radius**2), 0.0)
    assert fit.volume < 1.1 * np.min(np.pi * R**2 * (axis + 4.0 / 3.0 * R))


# --- convert_bodies --------------------------------------------------------------------------------------------


def read_panda():
    return read_pieces(PANDA, read_model(PANDA, "fixed"), [], PANDA, visuals=False, enclosed=True)


@pytest.mark.parametrize(
    ("kind", "kinds"),
    [
        ("mesh", {coal.BVHModelOBBRSS, coal.Box}),
        ("convex", {coal.Convex, coal.Box}),
        ("capsule", {coal.Capsule, coal.Sphere}),
    ],
)
def test_what_becomes_of_meshes_and_primitives(kind, kinds):
    before, after = read_panda(), convert_bodies(read_panda(), kind)
    assert {type(b.geometry) for b in after.geometryObjects} <= kinds
    for old, new in zip(before.geometryObjects, after.geometryObjects, strict=True):
        assert (new.name, new.parentJoint, new.parentFrame) == (old.name, old.parentJoint, old.parentFrame)
        if kind != "capsule":
            assert new.placement == old.placement


def test_hulls_and_capsules_sit_around_the_meshes_in_the_link_frame(meshes):
    before = {b.name: b for b in read_panda().geometryObjects}
    hulls, capsules = (convert_bodies(read_panda(), kind).geometryObjects for kind in ("convex", "capsule"))
    for hull, body in zip(hulls, capsules, strict=True):
        if body.name not in meshes:
            continue
        volume = ConvexHull(np.array(hull.geometry.points())).volume
        assert volume == pytest.approx(ConvexHull(meshes[body.name]).volume, rel=1e-9)
        half = getattr(body.geometry, "halfLength", 0.0)
        a, b = (body.placement.act(np.array([0.0, 0.0, z])) for z in (-half, half))
        points = np.array([before[body.name].placement.act(point) for point in meshes[body.name]])
        assert np.max(point_segment_distance(points, a, b)) < body.geometry.radius + 1e-9


@pytest.mark.filterwarnings("ignore::qpavoid.model.notes.RobotWarning")
def test_scaled_mesh_of_a_urdf_keeps_its_size(tmp_path):
    """A tetrahedron in mm with a scale of 0.001."""
    write_stl(tmp_path / "part.stl", 1000.0 * TETRAHEDRON)
    urdf = write_chain(tmp_path, shape='<mesh filename="part.stl" scale="0.001 0.001 0.001"/>')
    for kind in ("convex", "mesh"):
        geometry = Robot.from_urdf(urdf, bodies=kind).bodies.geometryObjects[0].geometry
        geometry.computeLocalAABB()
        np.testing.assert_allclose(geometry.aabb_local.max_, 0.1, atol=1e-9)
    capsule = Robot.from_urdf(urdf, bodies="capsule").bodies.geometryObjects[0].geometry
    assert 0.05 < capsule.radius < 0.1


@pytest.mark.filterwarnings("ignore::qpavoid.model.notes.RobotWarning")
def test_flat_mesh_does_not_take_the_process_down(tmp_path):
    """A plate without thickness has no hull of its own, and qhull ends the process over it."""
    square = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    write_stl(tmp_path / "plate.stl", square[[[0, 1, 2], [1, 3, 2]]])
    urdf = write_chain(tmp_path, shape='<mesh filename="plate.stl"/>')
    hull, capsule = (Robot.from_urdf(urdf, bodies=kind).bodies.geometryObjects[0] for kind in ("convex", "capsule"))
    assert ConvexHull(hull.geometry.points()).volume == pytest.approx(1e-4, rel=1e-6)  # 0.1 mm thick
    assert capsule.geometry.radius < 0.6
