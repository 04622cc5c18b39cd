"""Rates of distances against finite differences, culling against none, and what a control step costs."""

import gc
import tracemalloc
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import cartesian
from conftest import (
    BOX,
    CAPSULE,
    CYLINDER,
    SPHERE,
    Bench,
    differences,
    instructions,
    look,
    moved,
    obstacle,
    random_q,
    random_scene,
)

from qpavoid import (
    Avoidance,
    Controller,
    NumericalError,
    Obstacle,
    Robot,
    Sample,
    build_scene,
    build_tasks,
    config,
    load_scenario,
)
from qpavoid.config import HalfSpace, Sphere
from qpavoid.control import distances
from qpavoid.model import kinematics
from qpavoid.model import views as memory
from qpavoid.problem import Proximity

CONFIGURATIONS = 4
ROUND = 5e-5
"""Tolerance on rates [m/rad] where coal iterates to a curved surface: its stopping criterion leaves the normal
uncertain by the root of 1e-6."""


def world_placements(scene, q):
    """Pose of every body of the scene at q, by Pinocchio alone."""
    data = scene.robot.model.createData()
    pin.forwardKinematics(scene.robot.model, data, q)
    return [data.oMi[body.parentJoint] * body.placement for body in scene.geometry.geometryObjects]


def with_obstacle(scene):
    """(m,) which pairs have an obstacle as their second body."""
    return scene.pairs[:, 1] >= len(scene.body_names)


# --- rates -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "shapes", "tolerance"),
    [
        ("paper", [SPHERE, CAPSULE], 1e-6),
        ("panda", [SPHERE, CAPSULE], 1e-6),
        ("solo", [SPHERE, CAPSULE], 1e-6),
        ("panda", [BOX], 1e-5),
        ("panda", [CYLINDER], ROUND),
        ("panda_convex", [SPHERE], 1e-4),
    ],
)
def test_distance_jacobian_agrees_with_finite_differences(name, shapes, tolerance, request):
    """Includes pairs of the two arms, or of two legs, in which both bodies move; and a floating base."""
    robot = request.getfixturevalue(name)
    rng = np.random.default_rng(4)
    scene = random_scene(robot, rng, shapes * 3)
    checked = with_obstacle(scene) | (tolerance == 1e-6)
    for _ in range(CONFIGURATIONS):
        q = random_q(robot, rng)
        found = look(scene, q)
        expected = differences(lambda q: look(scene, q).distance, robot, q, 1e-6 if tolerance == 1e-6 else 1e-5)
        apart = checked & (found.distance > 1e-3)  # crossing axes are a kink of the distance
        assert apart.sum() > 0.5 * checked.sum()
        np.testing.assert_allclose(found.J[apart], expected[apart], atol=tolerance)


@pytest.mark.parametrize(("shapes", "tolerance"), [([SPHERE, CAPSULE], 1e-6), ([BOX], 1e-5), ([CYLINDER], ROUND)])
def test_feedforward_is_the_rate_when_only_obstacles_move(panda, shapes, tolerance):
    rng = np.random.default_rng(7)
    scene = random_scene(panda, rng, shapes * 3)
    q = random_q(panda, rng)
    starts = [o.motion.sample(0.0) for o in scene.obstacles]
    samples = {
        i: start._replace(linear=rng.uniform(-1, 1, 3), angular=rng.uniform(-2, 2, 3)) for i, start in enumerate(starts)
    }
    step = 1e-6 if tolerance == 1e-6 else 1e-5
    ahead, behind = (look(scene, q, {i: moved(s, t) for i, s in samples.items()}) for t in (step, -step))
    found = look(scene, q, samples)
    expected = (ahead.distance - behind.distance) / (2.0 * step)
    obstacles = with_obstacle(scene)
    assert np.abs(expected[obstacles]).max() > 0.1
    apart = found.distance > -0.02
    np.testing.assert_allclose(found.feedforward[apart], expected[apart], atol=tolerance)
    np.testing.assert_array_equal(found.feedforward[~obstacles], 0.0)


@pytest.mark.parametrize(
    ("name", "shapes"),
    [*((name, [SPHERE, CAPSULE, BOX, CYLINDER]) for name in ("paper", "panda", "solo")), ("panda", [HalfSpace()])],
)
def test_clearance_lower_bound_holds_on_straight_paths(name, shapes, request):
    """Robot and obstacles move on at constant velocities; also what was out of reach counts."""
    robot = request.getfixturevalue(name)
    rng = np.random.default_rng(19)
    scene = random_scene(robot, rng, shapes)
    bench, hold = Bench(scene), Avoidance().d1
    for trial in range(15):
        q, v = random_q(robot, rng), 0.1 ** (trial % 3) * rng.uniform(-1.0, 1.0, robot.model.nv)
        samples = {}
        for i, body in enumerate(scene.obstacles):
            start, speed = body.motion.sample(0.0), rng.choice([0.0, 0.3, 1.0])
            twist = {"linear": speed * rng.uniform(-1, 1, 3), "angular": speed * rng.uniform(-1, 1, 3)}
            samples[i] = start._replace(**twist)
        bench.place(samples)
        near = len(bench.compute(q, reach=0.3)[0].pair)
        for horizon in (0.01, 0.1, 0.3):
            least = bench.assembler.clearance_lower_bound(v, near, horizon)
            assert np.isfinite(least)
            for t in (0.5 * horizon, horizon):
                later = {i: moved(sample, t) for i, sample in samples.items()}
                found = look(scene, pin.integrate(robot.model, q, t * v), later)
                assert found.distance.min() - hold >= least - 1e-9


# --- how it is read ----------------------------------------------------------------------------------------------


def test_views_of_the_memory_of_the_libraries_equal_the_accessors(panda):
    rng = np.random.default_rng(10)
    scene = random_scene(panda, rng, [SPHERE, CAPSULE, BOX])
    geometry, model = scene.geometry, panda.model
    data, placed = model.createData(), geometry.createData()
    results, poses = memory.view_results(placed.distanceResults), memory.view_poses(placed.oMg, writeable=True)
    assert results is not None, "coal's layout has changed: the slow path is in use"
    assert poses is not None, "Pinocchio's layout has changed: the slow path is in use"
    for _ in range(3):
        pin.computeDistances(model, data, geometry, placed, random_q(panda, rng))
        np.testing.assert_array_equal(results, memory.read_results(placed.distanceResults))
        np.testing.assert_array_equal(poses, memory.read_poses(placed.oMg))


@pytest.mark.parametrize("missing", [["view_results"], ["view_poses"], ["view_results", "view_poses"]])
def test_distances_without_the_views_are_the_same(panda, monkeypatch, missing):
    rng = np.random.default_rng(11)
    scene = random_scene(panda, rng, [SPHERE, CAPSULE, BOX])
    qs = [random_q(panda, rng) for _ in range(3)]
    starts = {i: o.motion.sample(0.0) for i, o in enumerate(scene.obstacles)}
    samples = [{i: next_sample(rng, start) for i, start in starts.items()} for _ in qs]
    expected = [look(scene, q, there, reach=0.3) for q, there in zip(qs, samples, strict=True)]
    for name in missing:
        for module in (distances, kinematics):
            monkeypatch.setattr(module, name, lambda *_, **__: None, raising=False)
    for q, there, fast in zip(qs, samples, expected, strict=True):
        slow = look(scene, q, there, reach=0.3)
        assert len(slow.pair)
        for name in Proximity._fields:  # GJK starts elsewhere in a fresh query: equal to rounding
            np.testing.assert_allclose(getattr(slow, name), getattr(fast, name), rtol=0, atol=1e-12)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_distances_of_few_pairs(tmp_path, count):
    """A ball of radius 0.05 at the origin, others of radius 0.06 along x."""
    scene = build_scene(
        cartesian(tmp_path), [obstacle(f"o{i}", SPHERE, (0.3 + 0.2 * i, 0.0, 0.0)) for i in range(count)]
    )
    found = look(scene, np.zeros(3))
    np.testing.assert_allclose(found.distance, 0.19 + 0.2 * np.arange(count), atol=1e-9)
    np.testing.assert_allclose(found.J, [[-1.0, 0.0, 0.0]] * count if count else np.zeros((0, 3)), atol=1e-9)


def arrays_of(value):
    """All arrays in nested named tuples, in order."""
    if isinstance(value, np.ndarray):
        return [value]
    return [array for part in value for array in arrays_of(part)] if hasattr(value, "_fields") else []


def test_tick_is_not_overwritten_by_the_next(panda):
    """Nor is the velocity that a step returns; what an assembly returns looks into memory that is."""
    rng = np.random.default_rng(13)
    scene = random_scene(panda, rng, [SPHERE, CAPSULE])
    tasks = build_tasks([config.Task(frame="panda_hand_tcp", type="pose")], panda, panda.home)
    controller = Controller(scene, tasks, avoidance=Avoidance(d2=2.0))
    q = random_q(panda, rng, 0.3)
    tick, v = controller.tick(q), controller.step(q).v
    arrays = [*arrays_of(tick), v, q]
    kept = [array.copy() for array in arrays]
    later = controller.tick(random_q(panda, rng, 0.3), obstacles={"o0": Sample.at((0.5, 0.2, 0.3), linear=(0.1, 0, 0))})
    for part in ("kinematics", "proximity", "problem"):
        before, after = (arrays_of(getattr(t, part)) for t in (tick, later))
        assert not all(np.array_equal(a, b) for a, b in zip(before, after, strict=True)), part
    for array, before in zip(arrays, kept, strict=True):
        np.testing.assert_array_equal(array, before)


# --- culling -----------------------------------------------------------------------------------------------------


def next_sample(rng, sample):
    """Most obstacles move on a little and turn, some jump, some of these far away."""
    twist = {"linear": rng.uniform(-1, 1, 3), "angular": rng.uniform(-2, 2, 3)}
    if rng.random() < 0.7:
        return moved(sample._replace(**twist), 0.02)._replace(**twist)
    place = rng.uniform(-0.8, 0.8, 3) * (50.0 if rng.random() < 0.3 else 1.0)
    return Sample.at(place, pin.exp3(rng.uniform(-2, 2, 3)), **twist)


@pytest.mark.parametrize("name", ["panda", "panda_convex"])
def test_distances_of_near_pairs_are_those_among_all(name, request):
    """One query that looks at bounding spheres first, step by step, against a fresh one that looks at all pairs."""
    robot = request.getfixturevalue(name)
    rng = np.random.default_rng(15)
    scene = random_scene(robot, rng, [SPHERE, CAPSULE, BOX, CYLINDER] * 2)
    assert len(scene.pairs) > 48
    culled, whole = Bench(scene), Bench(scene)
    samples = {i: o.motion.sample(0.0) for i, o in enumerate(scene.obstacles)}
    counts = set()
    for _ in range(40):
        q = random_q(robot, rng, spread=1.5)
        samples = {i: next_sample(rng, sample) for i, sample in samples.items()}
        influence = rng.choice([-0.02, 0.0, 0.05, 0.1, 0.3, 2.0, np.inf])
        found, everything = look(scene, q, samples, influence, culled), look(scene, q, samples, bench=whole)
        np.testing.assert_array_equal(found.pair, np.flatnonzero(everything.distance < influence))
        # coal starts from where it ended the last time, which shows within its stopping criteria
        distance = everything.distance[found.pair]
        error = np.abs(found.distance - distance)
        assert (error <= np.where(distance > 0.0, 1e-9 * np.maximum(distance, 1.0), 1e-6)).all()
        close = (distance > 0.0) & (distance < 3.0)
        for field in ("point_a", "point_b", "normal", "J", "feedforward"):
            expected = getattr(everything, field)[found.pair][close]
            np.testing.assert_allclose(getattr(found, field)[close], expected, rtol=0, atol=ROUND)
        counts.add(len(found.pair))
    assert len(counts) > 20


CORNERS = [
    (SPHERE, (1.0, 0.0, 0.0), SPHERE.radius),
    (CAPSULE, (0.0, 0.0, 1.0), CAPSULE.radius + CAPSULE.length / 2),
    (BOX, BOX.size, np.linalg.norm(BOX.size) / 2),
    (CYLINDER, (CYLINDER.radius, 0.0, CYLINDER.length / 2), np.hypot(CYLINDER.radius, CYLINDER.length / 2)),
]


@pytest.mark.parametrize(("shape", "corner", "size"), CORNERS, ids=lambda value: getattr(value, "type", ""))
def test_bounding_spheres_are_tight(panda, shape, corner, size):
    """Each capsule of the robot points with its cap at the outermost point of an obstacle, 0.1 m away."""
    rng = np.random.default_rng(16)
    scene = random_scene(panda, rng, [shape] * len(panda.bodies.geometryObjects))
    q, count, gap = random_q(panda, rng), len(scene.body_names), 0.1
    samples = {}
    for i, placement in enumerate(world_placements(scene, q)[:count]):
        body, axis = scene.geometry.geometryObjects[i].geometry, placement.rotation[:, 2]
        tip = body.halfLength + body.radius
        turn = pin.Quaternion.FromTwoVectors(np.array(corner) / np.linalg.norm(corner), -axis).matrix()
        samples[i] = Sample.at(placement.translation + (tip + gap + size) * axis, turn)
    query = Bench(scene)
    facing = [scene.pair_names.index((scene.body_names[i], f"o{i}")) for i in range(count)]
    everything = look(scene, q, samples, bench=query)
    np.testing.assert_allclose(everything.distance[facing], gap, rtol=0, atol=1e-8)
    for reach, expected in ((gap + 1e-7, facing), (gap - 1e-7, [])):
        found = look(scene, q, reach=reach, bench=query)
        assert sorted(set(facing) & set(found.pair)) == sorted(expected)
        np.testing.assert_array_equal(found.pair, np.flatnonzero(everything.distance < reach))


# --- cost of a tick ----------------------------------------------------------------------------------------------


def balls(rng, count, radius):
    """Small spheres in all directions, at `radius` [m] from the origin, give or take a tenth."""
    directions = rng.normal(size=(count, 3))
    places = radius * rng.uniform(0.9, 1.1, (count, 1)) * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    shape = config.Sphere(type="sphere", radius=0.01)
    return [Obstacle.at(f"o{i}", shape, place) for i, place in enumerate(places)]


CASES = {
    # (distance of the obstacles, avoidance, way that the tool has to go)
    "far": (50.0, Avoidance(), 0.0),
    "near, solving": (2.0, Avoidance(d1=1e-3, d2=5.0, row={"type": "beta", "gain": 0.02, "near_speed": 1.0}), 0.3),
}


@pytest.mark.parametrize("case", CASES)
def test_python_work_of_a_step_does_not_grow_with_the_number_of_pairs(panda, case):
    radius, avoidance, way = CASES[case]
    rng = np.random.default_rng(18)
    data = panda.model.createData()
    pin.framesForwardKinematics(panda.model, data, panda.home)
    place = data.oMf[panda.model.getFrameId("panda_hand_tcp")].translation + way * np.array([0.6, 0.0, 0.8])
    task = config.Task(frame="panda_hand_tcp", motion={"type": "fixed", "position": place.tolist()})
    work = []
    for count in (10, 500):
        scene = build_scene(panda, balls(rng, count, radius))
        controller = Controller(scene, build_tasks([task], panda, panda.home), avoidance=avoidance)
        tick = controller.tick(panda.home)
        assert len(tick.proximity.pair) == (len(scene.pairs) if radius < 5.0 else len(tick.problem.avoidance.d))
        assert tick.solution.status == "SOLVED"
        unconstrained = tick.problem.v_tracking
        assert np.allclose(tick.solution.v, unconstrained, atol=1e-6) == (way == 0.0)
        work.append(instructions(lambda controller=controller: controller.step(panda.home)))
    assert 0 < work[0] == work[1] < 4000


@pytest.mark.slow
def test_memory_of_steps_does_not_grow():
    """Pairs come within the influence distance and leave it, and the QP is solved."""
    controller, q = Controller.from_scenario(load_scenario("panda_line", ["avoidance.backup=false"]))
    used = []
    tracemalloc.start()
    try:
        for k in range(24_000):  # views for each number of near pairs are made once, within the first 4,000
            q = pin.integrate(controller.scene.robot.model, q, 0.01 * controller.step(q, (k * 0.01) % 12.0).v)
            if k in (4_000 - 1, 24_000 - 1):
                gc.collect()
                used.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert used[1] - used[0] < 100_000  # numba fills a pool; an object that is lost takes 16 bytes at the least, a step


def test_hulls_and_curved_bodies_that_are_apart_need_no_coal(monkeypatch):
    """Nor does a half-space, or a hull that comes in at run time."""
    robot = Robot.load("g1")
    hull = config.Mesh(path=str(Path(__file__).parents[1] / "tasks" / "shelf.stl"), method="convex")
    shapes = [CYLINDER, config.Cone(radius=0.1, length=0.2), config.Ellipsoid(radii=(0.1, 0.2, 0.1)), BOX]
    obstacles = [obstacle(f"o{i}", shape, (0.5, 0.25 * i - 0.375, 0.1)) for i, shape in enumerate(shapes)]
    floor = obstacle("floor", HalfSpace(), (0.0, 0.0, -1.2))
    controller = Controller(build_scene(robot, [*obstacles, floor], spare_obstacles=1), [], avoidance=Avoidance(d2=0.5))
    controller.add_obstacle(obstacle("hull", hull, (-0.8, 0.0, 0.0)))

    def fail(*_):
        raise AssertionError("coal was called")

    for module, name in ((pin, "computeDistances"), (distances.coal, "distance")):
        monkeypatch.setattr(module, name, fail)
    for t in (0.01, 0.02, 0.03):
        tick = controller.tick(robot.home, t, obstacles={"hull": [-0.8 - t, 0.0, 0.0]})
        names = {name for pair in tick.proximity.pair for name in controller.scene.pair_names[pair]}
        assert {"o0", "o1", "o2", "o3", "floor", "hull"} < names and tick.proximity.distance.min() > 0.0


def test_distances_of_all_pairs_by_name(panda):
    """Of two balls at known places, one far beyond d2, one given by a step: from its surface to the nearest capsule."""
    balls = [Obstacle.at(name, Sphere(radius=0.1), [x, 0.0, 0.5]) for name, x in (("near", 1.0), ("far", 5.0))]
    controller = Controller(build_scene(panda, balls, spare_obstacles=2), [])
    controller.filter(panda.home, np.zeros(panda.model.nv), obstacles={"near": [0.9, 0.0, 0.5]})
    all_pairs = controller.pair_distances(panda.home)
    assert len(all_pairs) == len([pair for pair in controller.scene.pair_names if all(pair)])
    distances = [pair.distance for pair in all_pairs]
    assert distances == sorted(distances) and np.isfinite(distances).all()
    for pair in all_pairs:
        gap = np.subtract(pair.point_b, pair.point_a)
        np.testing.assert_allclose(gap, pair.distance * pair.normal, atol=1e-6)
        for name, x in (("near", 0.9), ("far", 5.0)):
            if name in pair.bodies:
                point = (pair.point_a, pair.point_b)[pair.bodies.index(name)]
                assert np.linalg.norm(point - [x, 0.0, 0.5]) == pytest.approx(0.1, abs=1e-6)
    own = {frozenset(pair.bodies): pair.distance for pair in all_pairs if not {"near", "far"} & set(pair.bodies)}
    assert own == pytest.approx(dict(panda.home_distances), abs=1e-6)
    within = controller.pair_distances(panda.home, within=0.3)
    assert [pair.bodies for pair in within] == [pair.bodies for pair in all_pairs if pair.distance <= 0.3]
    with pytest.raises(NumericalError, match="q: shape"):
        controller.pair_distances(panda.home[:-1])
