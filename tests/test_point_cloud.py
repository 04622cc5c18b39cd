"""Point clouds: voxels, the nearest of them to each body by brute force, the loop, and bad pictures."""

import coal
import numpy as np
import pinocchio as pin
import pytest
from closed_loop import Ruler, cartesian, drive, make_controller
from conftest import SPHERE, Bench, differences, look, random_q

from qpavoid import (
    Avoidance,
    ConfigError,
    NumericalError,
    Obstacle,
    Points,
    Pose,
    Sample,
    Sensing,
    Severity,
    Status,
    Voxels,
    build_scene,
)
from qpavoid.config import PointCloud
from qpavoid.model.cloud import read_points, voxel_radius

CLOUD = PointCloud()
BALL = voxel_radius(CLOUD.resolution)


def scattered(rng, count=400, spread=0.8):
    return rng.uniform(-spread, spread, (count, 3))


def wall(x=0.5, width=0.8, pitch=0.01):
    """A wall of points across the x axis."""
    side = np.arange(-0.5 * width, 0.5 * width, pitch)
    y, z = np.meshgrid(side, side)
    return np.column_stack((np.full(y.size, x), y.ravel(), z.ravel()))


def cloud_scene(robot, points=None, shape=CLOUD, tmp=None):
    if points is None:
        return build_scene(robot, [Obstacle.at("camera", shape, [0, 0, 0])])
    np.save(tmp / "cloud.npy", points)
    return build_scene(
        robot, [Obstacle.at("camera", shape.model_copy(update={"path": str(tmp / "cloud.npy")}), [0, 0, 0])]
    )


def body_distances(scene, q, centers):
    """(b, n) distances of the robot's bodies to balls about centres, by coal, one pair at a time."""
    data = scene.robot.model.createData()
    pin.forwardKinematics(scene.robot.model, data, q)
    ball, request = coal.Capsule(BALL, 0.0), coal.DistanceRequest()
    request.gjk_tolerance = 1e-10
    found = []
    for body in scene.robot.bodies.geometryObjects:
        there = data.oMi[body.parentJoint] * body.placement
        place = coal.Transform3s(there.rotation, there.translation)
        row = []
        for center in centers:
            result = coal.DistanceResult()
            row.append(coal.distance(body.geometry, place, ball, coal.Transform3s(np.eye(3), center), request, result))
        found.append(row)
    return np.array(found)


# --- voxels ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [0.005, 0.02, 0.1])
def test_voxels_contain_every_point(resolution):
    points = scattered(np.random.default_rng(0), 3000)
    voxels = Voxels.of(points, resolution)
    expected = np.unique(np.floor(points / resolution), axis=0)
    assert len(voxels.centers) == len(expected) == len(np.unique(voxels.keys))
    np.testing.assert_allclose(np.unique(voxels.centers, axis=0), (expected + 0.5) * resolution, atol=1e-9)
    nearest = np.min(np.linalg.norm(points[:300, None] - voxels.centers, axis=2), axis=1)
    assert nearest.max() <= voxel_radius(resolution)


def test_voxels_drop_points_that_are_no_numbers():
    points = scattered(np.random.default_rng(3), 20)
    points[3], points[7, 1], points[9, 2] = np.nan, np.inf, 1e6
    voxels = Voxels.of(points, 0.02)
    assert (voxels.given, voxels.dropped, len(voxels.centers)) == (20, 3, 17)
    assert len(Voxels.of(np.zeros((0, 3)), 0.02).centers) == 0
    for bad in (np.zeros(3), np.zeros((4, 2)), "points", None):
        with pytest.raises(NumericalError):
            Voxels.of(bad, 0.02)


def test_voxels_of_a_coal_octree():
    points = scattered(np.random.default_rng(4), 300)
    tree = coal.makeOctree(points, 0.04)
    voxels, finer = Voxels.of_octree(tree), Voxels.of_octree(tree, 0.02)
    np.testing.assert_array_equal(voxels.keys, Voxels.of(points, 0.04).keys)
    assert len(finer.centers) == 8 * len(voxels.centers)


# --- nearest voxels by brute force -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["panda", "panda_convex"])
@pytest.mark.parametrize("turned", [False, True])
def test_nearest_voxels_of_each_body_have_pairs(name, turned, request, tmp_path):
    """Capsules and hulls: the nearest voxel there is has one, and all are at their real distances."""
    robot, rng = request.getfixturevalue(name), np.random.default_rng(5)
    points = scattered(rng, 200 if name == "panda" else 80)
    scene = cloud_scene(robot, points, tmp=tmp_path)
    centers, pose = Voxels.of(points, CLOUD.resolution).centers, {}
    if turned:
        pose = {0: Sample.at([0.1, -0.2, 0.3], pin.rpy.rpyToMatrix(0.3, 0.2, 0.9))}
        centers = centers @ pose[0].rotation.T + pose[0].position
    query = Bench(scene)
    for _ in range(3):
        q = random_q(robot, rng)
        found = look(scene, q, pose, reach=0.25, bench=query)
        expected = np.sort(body_distances(scene, q, centers), axis=1)
        for body in range(len(scene.body_names)):
            pairs = np.flatnonzero((scene.pairs[:, 0] == body) & (scene.obstacle_of[scene.pairs[:, 1]] == 0))
            mine = np.sort(found.distance[np.isin(found.pair, pairs)])
            wanted = expected[body][expected[body] < 0.25]
            assert len(mine) <= CLOUD.nearest and (len(mine) > 0) == (len(wanted) > 0)
            np.testing.assert_allclose(mine[:1], wanted[:1], atol=1e-5)
            assert np.abs(mine[:, None] - wanted).min(axis=1, initial=np.inf).max(initial=0.0) < 1e-5 or not len(mine)


def test_voxels_of_a_body_surround_it(tmp_path):
    """A rod between a point at one end, thick with voxels, and one at the other that is a little farther."""
    robot = cartesian(tmp_path, shape={"type": "capsule", "radius": 0.05, "length": 0.6})
    rng = np.random.default_rng(6)
    heap = np.array([0.15, 0.0, 0.3]) + rng.uniform(-0.03, 0.03, (500, 3))
    scene = cloud_scene(robot, np.concatenate((heap, [[0.2, 0.0, -0.3]])), tmp=tmp_path)
    found = look(scene, np.zeros(3), reach=0.3)
    assert found.point_a[:, 2].min() < -0.25 and (found.point_a[:, 2] > 0.2).sum() >= 3


def test_voxel_rows_agree_with_finite_differences(panda, tmp_path):
    """Balls that move with their cloud, and the robot."""
    rng = np.random.default_rng(7)
    points = scattered(rng, 60, 0.5)
    scene = cloud_scene(panda, points, tmp=tmp_path)
    centers = Voxels.of(points, CLOUD.resolution).centers
    sample = Sample.at([0.1, 0.0, 0.2], pin.rpy.rpyToMatrix(0.1, 0.4, 0.2), [0.2, -0.1, 0.3], [0.5, 0.2, -0.4])

    def nearest(q, t=0.0):
        rotation = pin.exp3(t * sample.angular) @ sample.rotation
        return body_distances(scene, q, centers @ rotation.T + sample.position + t * sample.linear).min(axis=1)

    q = random_q(panda, rng)
    found, least = look(scene, q, {0: sample}, reach=2.0), nearest(q)
    J, rate = differences(nearest, panda, q), (nearest(q, 1e-6) - nearest(q, -1e-6)) / 2e-6
    checked = 0
    for body in range(len(scene.body_names)):
        rows = np.flatnonzero(scene.pairs[found.pair, 0] == body)
        row = rows[found.distance[rows].argmin()] if len(rows) else None
        if row is not None and least[body] > 0.0:
            np.testing.assert_allclose(found.J[row], J[body], atol=1e-4)
            assert found.feedforward[row] == pytest.approx(rate[body], abs=1e-4)
            checked += 1
    assert checked > 5


# --- in the loop -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dt", "speed"), [(0.005, 2.0), (0.02, 0.5)])
def test_wall_of_points_is_not_passed(tmp_path, dt, speed):
    """The tool is sent through it at full speed; the look ahead sees voxels that no row knows yet."""
    robot = cartesian(tmp_path, speed=speed, acceleration=8.0)
    controller = make_controller(robot, [Obstacle.at("camera", CLOUD, [0, 0, 0])], "z", dt=dt, task={"gain": 20.0})
    points = wall()
    surface = Voxels.of(points, CLOUD.resolution).centers
    for k, tick in enumerate(
        drive(controller, np.array([-0.5, 0.03, 0.0]), round(2.5 / dt), target=[2.0, 0.1, 0.05],
              obstacles=lambda t: {"camera": Points(points, at_rest=True)} if t < 0.5 * dt else None)
    ):  # fmt: skip
        after = tick.state.q + dt * tick.solution.v
        assert np.linalg.norm(surface - after, axis=1).min() - 0.05 - BALL > 0.02 - 1e-3
        assert tick.solution.status is Status.SOLVED, (k, tick.solution.reasons)
    assert np.linalg.norm(surface - after, axis=1).min() - 0.05 - BALL < 0.05


def test_wall_of_points_causes_no_chatter(tmp_path):
    """Sliding at 0.2 m/s along a wall while pressed against it: the nearest voxel changes all the time.

    Voxels 20 mm apart, of which the nearest is 87 mm from the axis, tilt the normal by 6.6° at most: no more than that
    is felt of them.
    """
    robot = cartesian(tmp_path, speed=1.0, acceleration=20.0, shape={"type": "capsule", "radius": 0.05, "length": 0.2})
    controller = make_controller(robot, [Obstacle.at("camera", CLOUD, [0, 0, 0])], "z")
    points, v = wall(width=1.6), []
    for tick in drive(controller, np.array([0.3, -0.5, 0.0]), 500, target=lambda t: [0.6, -0.5 + 0.2 * t, 0.0],
                      obstacles=lambda t: {"camera": Points(points, at_rest=True)} if t == 0.0 else None):  # fmt: skip
        v.append(tick.solution.v)
        assert tick.solution.status is Status.SOLVED
    change = np.abs(np.diff(np.array(v)[100:], axis=0)) / 0.01
    assert change.max() < 10.0  # half of the acceleration limit
    assert np.abs(np.array(v)[100:, 0]).max() < 1.2 * 0.2 * np.tan(np.radians(6.6))
    assert np.abs(np.array(v)[100:, 2]).max() < 1e-6


def test_points_replace_those_before(panda):
    controller = make_controller(panda, cloud_scene(panda).obstacles)
    far, near, nothing = np.full((50, 3), 3.0), np.full((50, 3), [0.45, 0.0, 0.5]), np.zeros((0, 3))
    prepared = Voxels.of(near, CLOUD.resolution)
    for points, seen in ((None, 0), (far, 0), (near, 1), (None, 1), (far, 0), (prepared, 1), (nothing, 0)):
        given = None if points is None else {"camera": Points(points)}
        tick = controller.tick(panda.home, obstacles=given)
        assert (len(tick.proximity.pair) > 0) == seen
        assert tick.solution.assumptions == ()


def test_point_cloud_moves_with_its_frame(panda):
    controller = make_controller(panda, cloud_scene(panda).obstacles)
    pose = Sample.at([0.45, 0.0, 0.5], linear=[0.1, 0.0, 0.0])
    first = controller.tick(panda.home, obstacles={"camera": Points(np.zeros((1, 3)), pose)})
    ray = first.proximity.normal[0]
    assert first.proximity.feedforward[0] == pytest.approx(0.1 * ray[0])
    rest = controller.tick(panda.home, obstacles={"camera": Pose.at([0.45, 0.0, 0.5])})
    np.testing.assert_allclose(rest.proximity.distance, first.proximity.distance, atol=0.02)


def test_points_that_cannot_be_used_are_reasons(panda):
    controller = make_controller(panda, cloud_scene(panda).obstacles, sensing=Sensing(stale_after=0.05, stop_after=0.1))
    near = np.full((10, 3), [0.45, 0.0, 0.5])
    some, all_bad = np.vstack((near, np.full((2, 3), np.nan))), np.full((10, 3), np.nan)
    seen = controller.tick(panda.home, obstacles={"camera": Points(some)})
    (dropped,) = seen.solution.assumptions
    assert dropped.key == ("POINTS_DROPPED", ("camera",)) and dropped.amount == 2
    distance = seen.proximity.distance.min()
    for _ in range(4):
        tick = controller.tick(panda.home, obstacles={"camera": Points(all_bad)})
        dropped = tick.solution.assumptions[0]
        assert dropped.key == ("POINTS_DROPPED", ("camera",)) and dropped.amount == 10
        assert dropped.severity is Severity.WARNING
        assert tick.proximity.distance.min() == pytest.approx(distance)  # the last good ones
    for _ in range(8):
        tick = controller.tick(panda.home)
    assert tick.solution.status is Status.STOPPED and tick.solution.reasons[0].key == ("STALE", ("camera",))
    assert controller.tick(panda.home, obstacles={"camera": Points(near)}).solution.status is not Status.STOPPED
    for wrong in (np.zeros(3), "x", np.zeros((2, 4)), Voxels.of(near, 0.05)):
        with pytest.raises(NumericalError, match="camera"):
            controller.step(panda.home, obstacles={"camera": Points(wrong)})
    balls = make_controller(panda, [Obstacle.at("ball", SPHERE, [1, 0, 0])])
    with pytest.raises(NumericalError, match="points of a sphere"):
        balls.step(panda.home, obstacles={"ball": Points(near)})


def test_clearance_lower_bound_includes_voxels_without_pairs(panda, tmp_path):
    rng = np.random.default_rng(9)
    points = scattered(rng, 300, 0.7)
    scene = cloud_scene(panda, points, tmp=tmp_path)
    bench, hold, ruler = Bench(scene), Avoidance().d1, Ruler(scene)
    for _ in range(15):
        q, v = random_q(panda, rng), rng.uniform(-1.0, 1.0, 7)
        near = len(bench.compute(q, reach=0.3)[0].pair)
        for horizon in (0.01, 0.1):
            least = bench.assembler.clearance_lower_bound(v, near, horizon)
            assert ruler.distances(pin.integrate(panda.model, q, horizon * v)).min() - hold >= least - 1e-9


# --- files -------------------------------------------------------------------------------------------------------


def test_points_are_read_from_files(tmp_path):
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    np.save(tmp_path / "a.npy", points.astype(np.float32))
    np.savetxt(tmp_path / "a.csv", points, delimiter=",", header="x,y,z", comments="")
    for name in ("a.npy", "a.csv"):
        np.testing.assert_allclose(read_points(tmp_path / name, "here"), points, atol=1e-6)
    np.save(tmp_path / "flat.npy", points.ravel())
    np.save(tmp_path / "text.npy", np.array([["a", "b", "c"]]))
    (tmp_path / "b.csv").write_text("1,2,3\n")
    (tmp_path / "c.csv").write_text("x,y,z\n1,2\n")
    (tmp_path / "d.csv").write_text("x,y,z\n1,2,x\n")
    (tmp_path / "e.npy").write_bytes(b"\x93NUMPY junk")
    (tmp_path / "f.ply").write_text("ply")
    for name in ("flat.npy", "text.npy", "b.csv", "c.csv", "d.csv", "e.npy", "f.ply", "none.npy"):
        with pytest.raises(ConfigError, match="here"):
            read_points(tmp_path / name, "here")
