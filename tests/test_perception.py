"""Depth images to points: by oracles, in MuJoCo's pictures, and in a process that may be slow, late or dead."""

import ctypes.util
import mmap
import os
import subprocess
import sys
import time
import warnings

import coal
import numpy as np
import pinocchio as pin
import pytest
from closed_loop import Ruler
from conftest import EXAMPLES, random_q, write_chain

from qpavoid import (
    Avoidance,
    ConfigError,
    Controller,
    NumericalError,
    Obstacle,
    Points,
    Robot,
    Sample,
    Sensing,
    Status,
    UnknownName,
    Voxels,
    build_scene,
    build_tasks,
    kernels,
)
from qpavoid.config import Box, PointCloud, PostureTask, Sphere, Task
from qpavoid.perception.camera import Camera
from qpavoid.perception.depth_voxels import DepthVoxels, GridFull
from qpavoid.perception.exchange import LatestSlot, slots_size
from qpavoid.perception.own_bodies import OwnBodiesAt
from qpavoid.perception.process import Perception

pytestmark = pytest.mark.filterwarnings("ignore::qpavoid.model.notes.RobotWarning")
LENS, SIZE = (80.0, 75.0, 31.0, 24.5), (64, 48)
TOOL, RESOLUTION = "panda_hand_tcp", 0.02
SHAPES = [
    {"type": "sphere", "radius": 0.12},
    {"type": "capsule", "radius": 0.08, "length": 0.3},
    {"type": "box", "size": (0.2, 0.3, 0.1)},
    {"type": "cylinder", "radius": 0.1, "length": 0.25},
    {"type": "cone", "radius": 0.12, "length": 0.3},
    {"type": "ellipsoid", "radii": (0.1, 0.2, 0.15)},
]
EXACT = {"sphere", "capsule", "box"}


def looking_at(position, point, **fields):
    """A camera that stands somewhere and looks at a point."""
    z = np.subtract(point, position)
    z = z / np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    return Camera.at(position, np.column_stack((x, np.cross(z, x), z)), LENS, SIZE, **fields)


def unprojected(camera, depth, pose):
    """World points (h, w, 3) of a depth image, by plain numpy."""
    fx, fy, cx, cy = camera.lens
    v, u = np.mgrid[: camera.height, : camera.width]
    points = depth[..., None] * np.stack(((u - cx) / fx, (v - cy) / fy, np.ones(u.shape)), axis=-1)
    return points @ pose[:9].reshape(3, 3) + pose[9:]


def distances(robot, q, points):
    """(b, n) distances of points to the robot's bodies by coal."""
    data, ball = robot.model.createData(), 0.01
    pin.forwardKinematics(robot.model, data, q)
    found = []
    for body in robot.bodies.geometryObjects:
        there = data.oMi[body.parentJoint] * body.placement
        place, request, row = coal.Transform3s(there.rotation, there.translation), coal.DistanceRequest(), []
        request.gjk_tolerance = 1e-9
        for point in points:
            result, where = coal.DistanceResult(), coal.Transform3s(np.eye(3), point)
            row.append(coal.distance(body.geometry, place, coal.Capsule(ball, 0.0), where, request, result) + ball)
        found.append(row)
    return np.array(found)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A chain of links with one body of every shape."""
    bodies = [
        {"name": shape["type"], "frame": f"link{i % 4}", "shape": shape, "position": (0.05 * i, 0.0, 0.1)}
        for i, shape in enumerate(SHAPES)
    ]
    return Robot.from_urdf(write_chain(tmp_path_factory.mktemp("arm")), bodies=bodies)


# --- by oracles --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["arm", "panda", "panda_convex"])
def test_own_pixels_are_those_within_the_margin(name, request):
    """Spheres, capsules and boxes exactly; around others at most twice the margin is taken away."""
    robot, rng = request.getfixturevalue(name), np.random.default_rng(1)
    exact = [
        b.name in EXACT or isinstance(b.geometry, coal.Capsule | coal.Sphere) for b in robot.bodies.geometryObjects
    ]
    margin, marked = 0.03, 0
    for _ in range(2):
        q = random_q(robot, rng)
        camera = looking_at(rng.uniform([0.6, -0.4, 0.3], [1.0, 0.4, 0.8]), [0.0, 0.0, 0.4])
        own = OwnBodiesAt(robot, camera)
        pose = own.place(q)
        depth = rng.uniform(0.3, 1.4, (camera.height, camera.width)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.05] = np.nan
        mask = np.zeros(depth.shape, dtype=bool)
        kernels.mark_own_pixels(depth, camera.lens, own.arrays, margin, mask)
        assert not mask[np.isnan(depth)].any()
        pick = rng.choice(np.flatnonzero(~np.isnan(depth)), 500, replace=False)
        pick = np.union1d(pick, np.flatnonzero(mask)[:200])
        d = distances(robot, q, unprojected(camera, depth, pose).reshape(-1, 3)[pick])
        nearest, is_own = d.min(axis=0), mask.ravel()[pick]
        assert is_own[nearest < margin - 1e-6].all()
        assert (nearest[is_own] < 2.0 * margin).all()
        alone = d[exact].min(axis=0, initial=np.inf) == nearest
        only_exact = alone & (d[~np.array(exact)].min(axis=0, initial=np.inf) > 2.0 * margin)
        assert (nearest[is_own & only_exact] <= margin + 1e-6).all()
        marked += is_own.sum()
    assert marked > 50


def test_voxels_hold_all_other_points(arm):
    rng, q = np.random.default_rng(2), np.array([0.3, -0.4, 0.5])
    region = np.array([[-0.8, -0.8, 0.0], [0.9, 0.8, 1.1]])
    camera = looking_at([0.9, 0.2, 0.7], [0.0, 0.0, 0.4], ranges=(0.35, 1.3))
    own = OwnBodiesAt(arm, camera)
    pose = own.place(q)
    depth = rng.uniform(0.3, 1.4, (camera.height, camera.width)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = 0.0
    mask = np.zeros(depth.shape, dtype=bool)
    kernels.mark_own_pixels(depth, camera.lens, own.arrays, 0.02, mask)
    points = unprojected(camera, depth.astype(np.float64), pose)
    good = ~mask & (depth >= 0.35) & (depth <= 1.3) & ((points >= region[0]) & (points <= region[1])).all(axis=2)
    for least in (1, 2):
        sorter = DepthVoxels(camera, RESOLUTION, least_pixels=least, region=region)
        voxels = sorter.voxels(depth, own.arrays, pose, 0.0)
        cells, counts = np.unique(np.floor(points[good] / RESOLUTION), axis=0, return_counts=True)
        expected = (cells[counts >= least] + 0.5) * RESOLUTION
        assert len(expected) > 20
        np.testing.assert_allclose(np.unique(np.round(voxels.centers, 6), axis=0), np.round(expected, 6), atol=1e-9)
        reference = Voxels.of(expected, RESOLUTION)
        np.testing.assert_array_equal(voxels.keys, reference.keys)
        np.testing.assert_array_equal(voxels.starts, reference.starts)


def image(background=2.0, **patches):
    """A picture of a wall, with square patches in its middle: depth by half their size in pixels."""
    depth = np.full((SIZE[1], SIZE[0]), background, dtype=np.float32)
    for half, z in patches.values():
        depth[24 - half : 25 + half, 31 - half : 32 + half] = z
    return depth


def test_what_is_hidden_is_remembered_until_it_is_shown_to_be_gone(arm):
    """A board at 1 m; then something at 0.5 m before all of it; then the wall at 2 m alone."""
    camera = looking_at([3.0, 0.0, 0.5], [0.0, 0.0, 0.5])  # the arm is 3 m away
    own = OwnBodiesAt(arm, camera)
    pose = own.place(arm.home)

    def board(sorter, depth, t):
        """Voxels at the board's depth."""
        x = sorter.voxels(depth, own.arrays, pose, t).centers[:, 0]
        return int(((x > 1.9) & (x < 2.1)).sum())

    seen, hidden, unknown = image(board=(4, 1.0)), image(hand=(9, 0.5)), image(hole=(9, 0.0))
    sorter, brief = DepthVoxels(camera), DepthVoxels(camera, memory=0.5)
    count = board(sorter, seen, 0.0)
    assert count == board(brief, seen, 0.0) > 10
    assert board(sorter, hidden, 0.1) == board(brief, hidden, 0.1) == count
    assert board(sorter, unknown, 0.2) == count
    assert board(sorter, hidden, 9.0) == count and board(brief, hidden, 9.0) == 0
    assert board(sorter, image(), 9.1) == 0
    without = DepthVoxels(camera, memory=0.0)
    board(without, seen, 0.0)
    assert board(without, hidden, 0.1) == 0
    steady = DepthVoxels(camera)
    rng, counts = np.random.default_rng(3), []
    for k in range(30):
        noisy = seen + rng.normal(0.0, 0.004, seen.shape).astype(np.float32)
        counts.append(board(steady, noisy, 0.1 * k))
    assert max(counts) <= 2 * np.mean(counts[:3])  # surfaces do not grow thicker with noise


def test_too_many_voxels_are_refused(arm):
    camera = looking_at([3.0, 0.0, 0.5], [0.0, 0.0, 0.5])
    own = OwnBodiesAt(arm, camera)
    pose, full = own.place(arm.home), DepthVoxels(camera, capacity=50)
    with pytest.raises(GridFull, match="50 voxels"):
        full.voxels(image(), own.arrays, pose, 0.0)
    small = image(background=np.inf, board=(2, 1.0))
    assert 0 < len(full.voxels(small, own.arrays, pose, 0.1).centers) <= 50


def test_wrong_arguments_are_refused(arm):
    eye = np.eye(3)
    for fields in ({"lens": (0, 1, 0, 0)}, {"rotation": -eye}, {"size": (0, 3)}, {"ranges": (2.0, 1.0)},
                   {"unit": 0.0}, {"position": [0, 0, np.nan]}, {"lens": "x"}):  # fmt: skip
        with pytest.raises(ConfigError, match="camera"):
            Camera.at(**{"position": [0, 0, 0], "rotation": eye, "lens": LENS, "size": SIZE, **fields})
    with pytest.raises(UnknownName, match="hand"):
        OwnBodiesAt(arm, Camera.at([0, 0, 0], eye, LENS, SIZE, frame="hand"))
    camera = Camera.at([0, 0, 0], eye, LENS, SIZE)
    for fields in ({"margin": -1.0}, {"resolution": 0.0}, {"capacity": 0}, {"region": [[0, 0, 0], [0, 1, 1]]}):
        with pytest.raises(ConfigError):
            DepthVoxels(camera, **fields)


def test_camera_on_the_hand_moves_with_it(panda):
    """The world points of a picture do not depend on where the hand is."""
    rng, mount = np.random.default_rng(4), pin.SE3(pin.rpy.rpyToMatrix(0.1, 0.2, 0.3), np.array([0.05, 0.0, 0.02]))
    camera = Camera.at(mount.translation, mount.rotation, LENS, SIZE, frame="panda_hand")
    own, data, q = OwnBodiesAt(panda, camera), panda.model.createData(), random_q(panda, rng)
    pose = own.place(q)
    pin.framesForwardKinematics(panda.model, data, q)
    expected = data.oMf[panda.model.getFrameId("panda_hand")] * mount
    np.testing.assert_allclose(pose[:9].reshape(3, 3).T, expected.rotation, atol=1e-12)
    np.testing.assert_allclose(pose[9:], expected.translation, atol=1e-12)


def test_held_object_is_the_robots_own(arm):
    camera = looking_at([3.0, 0.0, 0.5], [0.0, 0.0, 0.5])
    own, sorter = OwnBodiesAt(arm, camera), DepthVoxels(camera, memory=0.0)

    def count():
        pose = own.place(np.zeros(3))
        return len(sorter.voxels(image(background=np.inf, board=(4, 1.0)), own.arrays, pose, 0.0).centers)

    free = count()
    own.hold("board", Box(size=(0.1, 0.3, 0.3)), "link0", [2.0, 0.0, 0.5], np.eye(3))
    assert count() == 0 < free
    with pytest.raises(ConfigError, match="board"):
        own.hold("board", Sphere(radius=0.1), "link0", [0, 0, 0], np.eye(3))
    own.release("board")
    assert count() == free
    with pytest.raises(UnknownName):
        own.release("board")


PLAIN = """
import numpy as np
from qpavoid import Robot
from qpavoid.perception.camera import Camera
from qpavoid.perception.depth_voxels import DepthVoxels
from qpavoid.perception.own_bodies import OwnBodiesAt
robot = Robot.load("panda")
camera = Camera.at([1.503, 0.0012, 0.5071], [[0, 0, -1], [1, 0, 0], [0, -1, 0]], (10.0, 10.0, 5.5, 3.5), (12, 8))
own, sorter = OwnBodiesAt(robot, camera), DepthVoxels(camera)
pose = own.place(robot.home)
for depth in (np.linspace(0.3, 2.0, 96), np.full(96, 0.211)):
    found = sorter.voxels(depth.reshape(8, 12).astype(np.float32), own.arrays, pose, 0.0)
print(len(found.centers), found.keys.sum())
"""


def test_kernels_run_without_the_compiler():
    said = [
        subprocess.run(
            [sys.executable, "-c", PLAIN], env={**os.environ, "NUMBA_DISABLE_JIT": off}, text=True,
            capture_output=True, check=True, timeout=500,
        ).stdout
        for off in ("0", "1")
    ]  # fmt: skip
    assert said[0] == said[1] and int(said[0].split()[0]) > 20


# --- beside the loop ---------------------------------------------------------------------------------------------

WRITER = """
import mmap, sys
import numpy as np
from qpavoid.perception.exchange import LatestSlot, slots_size
fields = {"a": (np.int64, (20000,)), "b": (np.float32, (100, 100))}
file = int(sys.argv[1])
slots = LatestSlot(mmap.mmap(file, slots_size(fields)), file, 0, fields)
for k in range(1, 30001):
    slots.back.a.fill(k)
    slots.back.b.fill(k)
    slots.publish()
"""


def test_slots_are_read_whole_and_in_order():
    """Another process writes as fast as it can; no slot that is read is of two writes."""
    fields = {"a": (np.int64, (20000,)), "b": (np.float32, (100, 100))}
    file = os.memfd_create("slots")
    os.truncate(file, slots_size(fields))
    slots = LatestSlot(mmap.mmap(file, slots_size(fields)), file, 0, fields)
    slots.clear()
    assert slots.read() is None
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(file)], pass_fds=[file])
    last, reads = 0, 0
    while writer.poll() is None:
        if (slot := slots.read()) is not None:
            number = int(slot.a[0])
            assert number > last and (slot.a == number).all() and (slot.b == number).all()
            last, reads = number, reads + 1
    assert writer.wait() == 0 and last > 0 and reads > 3
    os.close(file)


def wait_for(condition, seconds=60.0):
    """Wait until something is not None, and return it."""
    end = time.monotonic() + seconds
    while (found := condition()) is None:
        assert time.monotonic() < end
        time.sleep(0.002)
    return found


@pytest.fixture(scope="module")
def perception(panda):
    """A camera that looks at where the Panda is from 3 m."""
    with Perception(panda, looking_at([3.0, 0.0, 0.5], [0.0, 0.0, 0.5]), margin=0.03) as perception:
        yield perception


def test_newest_image_comes_back_with_its_stamp(perception, panda):
    q = panda.home
    for k in range(6):
        perception.record(q + 0.1 * k, 0.1 * k)
    np.testing.assert_allclose(perception.configuration(0.25), q + 0.25, atol=1e-12)
    np.testing.assert_allclose(perception.configuration(0.55), q + 0.5, atol=1e-12)
    assert perception.configuration(-0.1) is None and perception.configuration(0.9) is None
    assert not perception.submit(image(), 0.9)
    for k in range(5):
        assert perception.submit(image(board=(4, 1.0 + 0.1 * k)), 0.1 * k)
    stamps = []
    while not stamps or stamps[-1] < 0.4:
        points = wait_for(lambda: perception.latest(0.5))
        assert isinstance(points, Points) and points.points.resolution == RESOLUTION
        stamps.append(points.t)
    assert stamps == sorted(set(stamps))
    x = points.points.centers[:, 0]
    assert ((x > 1.55) & (x < 1.65)).any() and not ((x > 1.65) & (x < 2.1)).any()  # the last board alone
    timing = perception.timing
    assert timing.submitted == 5 and timing.refused == 1 and timing.latency[1] >= 0.1 - 1e-9
    perception.record(q, 0.0)  # the clock is set back
    assert perception.configuration(0.3) is None


def test_images_that_cannot_be_used_are_refused(perception, panda):
    for wrong in (np.zeros((3, 3)), "image", np.zeros((48, 64), dtype=complex), None):
        with pytest.raises(NumericalError, match="depth"):
            perception.submit(wrong, 0.0, panda.home)
    assert not perception.submit(image(), np.nan, panda.home)
    assert not perception.submit(image(), 0.0, np.full(7, np.nan))


def test_images_in_millimetres(panda):
    camera = looking_at([3.0, 0.0, 0.5], [0.0, 0.0, 0.5], unit=0.001)
    with Perception(panda, camera) as perception:
        perception.submit((1000.0 * image(board=(4, 1.0))).astype(np.uint16), 0.0, panda.home)
        x = wait_for(lambda: perception.latest(0.1)).points.centers[:, 0]
        assert ((x > 1.9) & (x < 2.1)).sum() > 10


def test_fault_and_death_of_the_process_end_in_a_stop(panda):
    """A picture that does not fit is named; without pictures the cloud is stale, and the robot stops."""
    camera = looking_at([3.0, 0.0, 0.5], [0.0, 0.0, 0.5])
    cloud = Obstacle.at("camera", PointCloud(resolution=RESOLUTION), [0, 0, 0])
    controller = Controller(build_scene(panda, [cloud]), [], sensing=Sensing(stale_after=0.05, stop_after=0.1))
    with Perception(panda, camera, capacity=60) as perception:
        perception.submit(image(), 0.0, panda.home)
        wait_for(lambda: perception.latest(0.0) or perception.fault or None)
        assert "60 voxels" in perception.fault
        perception.submit(image(background=np.inf, board=(2, 1.0)), 0.01, panda.home)
        points = wait_for(lambda: perception.latest(0.01))
        assert perception.fault == "" and perception.is_alive
        first = controller.filter(panda.home, np.zeros(7), 0.01, obstacles={"camera": points})
        assert first.status is Status.SOLVED
        perception.close()
        assert not perception.is_alive and perception.latest(0.02) is None
        assert not perception.submit(image(), 0.02, panda.home)
    for k in range(2, 15):
        solution = controller.filter(panda.home, np.zeros(7), 0.01 * k)
    assert solution.status is Status.STOPPED and solution.reasons[0].key == ("STALE", ("camera",))


# --- in MuJoCo's pictures ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def panda_hulls():
    """A Panda whose bodies are the hulls of its meshes: as a camera sees it."""
    fingers = {"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04}
    urdf = EXAMPLES / "panda_description/urdf/panda.urdf"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Robot.from_urdf(urdf, bodies="convex", lock=fingers)


@pytest.fixture(scope="module")
def mujoco_camera(panda_hulls):
    """Renders a scene with the hulls of the Panda's meshes: what a camera sees of it."""
    pytest.importorskip("mujoco")
    if not (ctypes.util.find_library("OSMesa") or ctypes.util.find_library("EGL")):
        assert "QPAVOID_REQUIRE_RENDERER" not in os.environ
        pytest.skip("neither libosmesa6 nor libegl1")
    import mujoco

    from qpavoid.perception.rendering import RenderedCamera
    from qpavoid.run.mujoco import build

    made = []

    def make(obstacles, q):
        model = build(build_scene(panda_hulls, obstacles), q)
        view = mujoco.MjvCamera()
        view.lookat, view.distance, view.azimuth, view.elevation = [0.3, 0.0, 0.4], 1.5, 150.0, -25.0
        made.append(RenderedCamera(model.model, model.data, view, (320, 240)))
        return model, made[-1]

    yield make
    for rendered in made:
        rendered.close()


BALL, CENTER = 0.07, np.array([0.5, 0.12, 0.45])


def test_ball_is_seen_and_the_arm_is_not(mujoco_camera, panda):
    """The arm looks as its meshes' hulls do, and is taken away as its capsules are."""
    rng = np.random.default_rng(5)
    model, rendered = mujoco_camera([Obstacle.at("ball", Sphere(radius=BALL), CENTER)], panda.home)
    own, seen = OwnBodiesAt(panda, rendered.camera), 0
    for _ in range(6):
        q = random_q(panda, rng, 0.4)
        model.place(q, 0.0)
        sorter = DepthVoxels(rendered.camera, RESOLUTION, margin=0.02)
        centers = sorter.voxels(rendered.depth(model.data), own.arrays, own.place(q), 0.0).centers
        off = np.abs(np.linalg.norm(centers - CENTER, axis=1) - BALL)
        assert len(centers) and off.max() < 0.5 * np.sqrt(3.0) * RESOLUTION + 2e-3
        seen += len(centers)
    assert seen > 100


def test_tool_goes_round_what_the_camera_sees(mujoco_camera, panda):
    """Pictures at 20 Hz that come 80 ms late; the target leads through the ball, which the arm hides at times.

    The tool keeps d1 of what was in the pictures; the far side of the ball never is.
    """
    q, dt, late = panda.home.copy(), 0.01, 8
    data = panda.model.createData()
    pin.framesForwardKinematics(panda.model, data, q)
    start = data.oMf[panda.model.getFrameId(TOOL)].translation.copy()
    goal, aside = start + np.array([0.0, 0.45, 0.0]), np.array([0.0, 0.15, 0.0])
    ball = Obstacle.at("ball", Sphere(radius=BALL), start + np.array([0.02, 0.22, 0.0]))
    model, rendered = mujoco_camera([ball], q)
    cloud = Obstacle.at("camera", PointCloud(resolution=RESOLUTION), [0, 0, 0])
    tasks = build_tasks([Task(frame=TOOL), PostureTask(weight=1e-3)], panda, q)
    controller = Controller(build_scene(panda, [cloud]), tasks, dt=dt, avoidance=Avoidance(d1=0.02, d2=0.1))
    own, sorter = OwnBodiesAt(panda, rendered.camera), DepthVoxels(rendered.camera, RESOLUTION, margin=0.02)
    ruler, least, under_way = Ruler(build_scene(panda, [ball])), np.inf, []
    pairs = [i for i, pair in enumerate(ruler.scene.pair_names) if "ball" in pair]
    for k in range(500):
        if k % 5 == 0:
            model.place(q, 0.0)
            voxels = sorter.voxels(rendered.depth(model.data), own.arrays, own.place(q), k * dt)
            under_way.append((k + late, Points(voxels, t=k * dt)))
        given = None
        if under_way[0][0] == k:
            given = {"camera": under_way.pop(0)[1]}
        target = Sample.at(start + min(k * dt, 3.0) * aside)
        q = pin.integrate(panda.model, q, dt * controller.step(q, k * dt, {TOOL: target}, given).v)
        least = min(least, ruler.distances(q)[pairs].min())
    pin.framesForwardKinematics(panda.model, data, q)
    assert least > 0.01
    assert np.linalg.norm(data.oMf[panda.model.getFrameId(TOOL)].translation - goal) < 0.02
