"""Distances against closed forms, rates against finite differences, culling against none, and what a tick costs."""

import gc
import tracemalloc
from dataclasses import replace

import coal
import numpy as np
import pinocchio as pin
import pytest
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

from qpavoid import Avoidance, Controller, Obstacle, Sample, build_scene, config, load_scenario
from qpavoid.control import distances as proximity
from qpavoid.control import placement as placing
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.tasks.frames import build_tasks
from qpavoid.model import views as memory
from qpavoid.model.kinematics import support_masks
from qpavoid.problem import Proximity
from qpavoid.solvers.analytic import tracking_velocity

TICKS = 10
ROUND = 5e-5
"""Tolerance on rates [m/rad] where coal iterates to a curved surface: its stopping criterion leaves the normal
uncertain by the root of 1e-6."""


def world_placements(scene, q):
    """Pose of every body of the scene at q, by Pinocchio alone."""
    data = scene.robot.model.createData()
    pin.forwardKinematics(scene.robot.model, data, q)
    return [data.oMi[body.parentJoint] * body.placement for body in scene.geometry.geometryObjects]


def by_coal(scene, q):
    """[distance, normal, point a, point b] of every pair by coal's own formulas (m, 10)."""
    places, rows = world_placements(scene, q), []
    bodies = [body.geometry for body in scene.geometry.geometryObjects]
    for a, b in scene.pairs:
        at = [coal.Transform3s(places[i].rotation, places[i].translation) for i in (a, b)]
        result = coal.DistanceResult()
        coal.distance(bodies[a], at[0], bodies[b], at[1], coal.DistanceRequest(), result)
        rows.append((result.min_distance, *result.normal, *result.getNearestPoint1(), *result.getNearestPoint2()))
    return np.array(rows)


@pytest.fixture
def culling(monkeypatch):
    """Bounding spheres are looked at however few pairs there are."""
    monkeypatch.setattr(proximity, "_CULL_FROM", 0)


def with_obstacle(scene):
    """(m,) which pairs have an obstacle as their second body."""
    return scene.pairs[:, 1] >= len(scene.body_names)


# --- distances, normals, witness points --------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["paper", "panda"])
def test_capsules_and_spheres_agree_with_coal(name, request):
    robot = request.getfixturevalue(name)
    rng = np.random.default_rng(1)
    scene = random_scene(robot, rng, [SPHERE, CAPSULE] * 4)
    for _ in range(TICKS):
        q = random_q(robot, rng, spread=2.0)
        radii = np.array([body.geometry.radius for body in scene.geometry.geometryObjects])
        expected, found = by_coal(scene, q), look(scene, q)
        np.testing.assert_allclose(found.distance, expected[:, 0], atol=1e-9)
        distinct = (
            expected[:, 0] + radii[scene.pairs].sum(axis=1) > 1e-3
        )  # elsewhere the normal has no definite direction
        assert distinct.mean() > 0.9
        parts = np.column_stack((found.normal, found.point_a, found.point_b))
        np.testing.assert_allclose(parts[distinct], expected[distinct, 1:], atol=1e-7)


def distance_to_box(points, box, size):
    """Distance of points (n, 3) outside a box of full side lengths `size` at placement `box`."""
    local = (points - box.translation) @ box.rotation
    return np.linalg.norm(np.maximum(np.abs(local) - np.array(size) / 2, 0.0), axis=1)


def test_boxes_agree_with_a_search_along_the_capsule(panda):
    rng = np.random.default_rng(2)
    scene = random_scene(panda, rng, [BOX] * 3)
    count, boxes = len(scene.body_names), len(scene.obstacles)
    for _ in range(TICKS):
        q = random_q(panda, rng)
        placements = world_placements(scene, q)
        bodies = scene.geometry.geometryObjects[:count].tolist()
        half = np.array([b.geometry.halfLength if isinstance(b.geometry, coal.Capsule) else 0.0 for b in bodies])
        radius = np.array([b.geometry.radius for b in bodies])
        center = np.array([p.translation for p in placements[:count]])
        axis = np.array([p.rotation[:, 2] for p in placements[:count]])
        distance = look(scene, q).distance
        for i in range(boxes):
            pairs = np.flatnonzero(scene.pairs[:, 1] == count + i)
            np.testing.assert_array_equal(scene.pairs[pairs, 0], np.arange(count))
            found = distance[pairs]

            def at(z, box=placements[count + i], center=center, axis=axis):
                return distance_to_box(center + z[:, None] * axis, box, BOX.size)

            low, high = -half, half.copy()  # the distance is convex along the axis: ternary search
            for _ in range(80):
                third = (high - low) / 3
                left = at(low + third) < at(high - third)
                low, high = np.where(left, low, low + third), np.where(left, high - third, high)
            axis_distance = at((low + high) / 2)
            outside = axis_distance > 0.0
            np.testing.assert_allclose(found[outside], (axis_distance - radius)[outside], atol=1e-6)


@pytest.mark.parametrize("shapes", [[SPHERE, CAPSULE], [BOX, CYLINDER]])
def test_normal_is_a_unit_vector_from_a_to_b_that_spans_the_witness_points(panda, shapes):
    rng = np.random.default_rng(3)
    scene = random_scene(panda, rng, shapes * 3)
    found = look(scene, random_q(panda, rng))
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(found.point_b - found.point_a, found.distance[:, None] * found.normal, atol=1e-6)


# --- rates -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["paper", "panda", "solo"])
def test_distance_jacobian_of_capsules_and_spheres(name, request):
    """Includes pairs of the two arms, or of two legs, in which both bodies move; and a floating base."""
    robot = request.getfixturevalue(name)
    rng = np.random.default_rng(4)
    scene = random_scene(robot, rng, [SPHERE, CAPSULE] * 2)
    masks = support_masks(robot.model)
    joints = [body.parentJoint for body in scene.geometry.geometryObjects]
    assert any(masks[joints[a]].any() and masks[joints[b]].any() for a, b in scene.pairs)
    for _ in range(TICKS):
        q = random_q(robot, rng)
        radii = np.array([body.geometry.radius for body in scene.geometry.geometryObjects])
        found = look(scene, q)
        smooth = found.distance + radii[scene.pairs].sum(axis=1) > 1e-3  # crossing axes are a kink of the distance
        expected = differences(lambda q: look(scene, q).distance, robot, q)
        np.testing.assert_allclose(found.J[smooth], expected[smooth], atol=1e-6)


@pytest.mark.parametrize(("shape", "tolerance"), [(BOX, 1e-5), (CYLINDER, ROUND)])
def test_distance_jacobian_of_boxes_and_cylinders(panda, shape, tolerance):
    rng = np.random.default_rng(5)
    scene = random_scene(panda, rng, [shape] * 4)
    others = with_obstacle(scene)
    for _ in range(TICKS):
        q = random_q(panda, rng)
        found = look(scene, q)
        expected = differences(lambda q: look(scene, q).distance, panda, q, step=1e-5)
        apart = others & (found.distance > 1e-3)
        assert apart.sum() > 0.8 * others.sum()
        np.testing.assert_allclose(found.J[apart], expected[apart], atol=tolerance)


def test_distance_jacobian_of_convex_hulls(panda_convex):
    rng = np.random.default_rng(6)
    scene = random_scene(panda_convex, rng, [SPHERE] * 4)
    others = with_obstacle(scene)
    for _ in range(TICKS):
        q = random_q(panda_convex, rng)
        found = look(scene, q)
        expected = differences(lambda q: look(scene, q).distance, panda_convex, q, step=1e-5)
        apart = others & (found.distance > 1e-3)
        np.testing.assert_allclose(found.J[apart], expected[apart], atol=1e-4)


@pytest.mark.parametrize(("shapes", "tolerance"), [([SPHERE, CAPSULE], 1e-6), ([BOX], 1e-5), ([CYLINDER], ROUND)])
def test_drift_is_the_rate_when_only_obstacles_move(panda, shapes, tolerance):
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


@pytest.mark.parametrize("name", ["paper", "solo"])
def test_support_masks_are_the_pattern_of_the_joint_jacobians(name, request):
    model = request.getfixturevalue(name).model
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.randomConfiguration(model, -np.ones(model.nq), np.ones(model.nq)))
    masks = support_masks(model)
    np.testing.assert_array_equal(masks[0], 0.0)
    for joint in range(1, model.njoints):
        jacobian = pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.LOCAL)
        np.testing.assert_array_equal(masks[joint] > 0, np.abs(jacobian).max(axis=0) > 0)


def test_columns_of_joints_beyond_the_body_are_exactly_zero(paper):
    """`left_forearm` hangs on link 5: it moves with joints 1 to 5 of the left arm, and with nothing else."""
    rng = np.random.default_rng(8)
    scene = build_scene(paper, [obstacle("ball", SPHERE, (0.3, 0.1, 0.8))])
    rows = np.array([look(scene, random_q(paper, rng, spread=3.0)).J for _ in range(TICKS)])
    moving = {"upper_arm": 3, "forearm": 5, "hand": 7}
    for (a, b), row in zip(scene.pair_names, np.abs(rows).max(axis=0), strict=True):
        columns = set()
        for body in {a, b} - {"ball"}:
            side, _, part = body.partition("_")
            columns |= {i + 7 * (side == "right") for i in range(moving[part])}
        assert set(np.flatnonzero(row)) <= columns
        assert row.max() > 1e-2  # not in every configuration: the closest points may be the shoulders, which rest


@pytest.mark.parametrize("name", ["paper", "panda", "solo"])
def test_nothing_comes_nearer_than_the_closest_call_says(name, request):
    """Robot and obstacles move on at constant velocities; also what was out of reach counts."""
    robot = request.getfixturevalue(name)
    rng = np.random.default_rng(19)
    scene = random_scene(robot, rng, [SPHERE, CAPSULE, BOX, CYLINDER])
    bench, hold = Bench(scene), Avoidance().safety_distance
    for trial in range(40):
        q, v = random_q(robot, rng), 0.1 ** (trial % 3) * rng.uniform(-1.0, 1.0, robot.model.nv)
        samples = {}
        for i, body in enumerate(scene.obstacles):
            start, speed = body.motion.sample(0.0), rng.choice([0.0, 0.3, 1.0])
            twist = {"linear": speed * rng.uniform(-1, 1, 3), "angular": speed * rng.uniform(-1, 1, 3)}
            samples[i] = start._replace(**twist)
            bench.query.place_obstacle(i, samples[i])
        near = len(bench.compute(q, reach=0.3)[0].pair)
        for horizon in (0.01, 0.03, 0.1, 0.3):
            least = bench.assembly.clearance_lower_bound(v, near, 0.3, horizon)
            assert np.isfinite(least)
            for t in (0.5 * horizon, horizon):
                later = {i: moved(sample, t) for i, sample in samples.items()}
                found = look(scene, pin.integrate(robot.model, q, t * v), later)
                assert found.distance.min() - hold >= least - 1e-9


# --- penetration -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [SPHERE, CAPSULE, BOX])
def test_in_penetration_the_normal_still_points_the_way_out(paper, shape):
    """Moving the obstacle along the normal raises the signed distance one to one; J and drift agree with that."""
    rng = np.random.default_rng(9)
    q = random_q(paper, rng)
    bare = build_scene(paper)
    hand = bare.body_names.index("left_hand")
    center = world_placements(bare, q)[hand]
    place = center.translation + center.rotation @ np.array([0.02, 0.03, 0.01])
    scene = build_scene(paper, [obstacle("o", shape, place, (0.3, 0.4, 0.5))])
    pair = scene.pair_names.index(("left_hand", "o"))
    start = scene.obstacles[0].motion.sample(0.0)
    step, tolerance = (1e-5, 1e-4) if shape is BOX else (1e-6, 1e-6)
    found = look(scene, q, {0: start._replace(linear=np.array([1.0, 0, 0]), angular=np.array([0, 1.0, 0]))})
    assert found.distance[pair] < -0.01
    normal = found.normal[pair]
    out, into = (look(scene, q, {0: start._replace(position=start.position + s * normal)}) for s in (step, -step))
    assert (out.distance[pair] - into.distance[pair]) / (2 * step) == pytest.approx(1.0, abs=tolerance)
    expected = differences(lambda q: look(scene, q).distance, paper, q, step)
    np.testing.assert_allclose(found.J[pair], expected[pair], atol=tolerance)
    twist = start._replace(linear=np.array([1.0, 0, 0]), angular=np.array([0, 1.0, 0]))
    ahead, behind = (look(scene, q, {0: moved(twist, t)}) for t in (step, -step))
    rate = (ahead.distance[pair] - behind.distance[pair]) / (2 * step)
    assert found.feedforward[pair] == pytest.approx(rate, abs=tolerance)


# --- how it is read ----------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("culling")
def test_the_views_of_the_libraries_memory_equal_the_accessors(panda):
    rng = np.random.default_rng(10)
    scene = random_scene(panda, rng, [SPHERE, CAPSULE, BOX])
    query = DistanceQuery(scene)
    assert not query._copy, "coal's layout has changed: the slow path is in use"
    assert not query._copy_poses, "Pinocchio's layout has changed: the slow path is in use"
    for _ in range(3):
        look(scene, random_q(panda, rng), query=query)
        np.testing.assert_array_equal(query.results, memory.read_results(query._data.distanceResults))
        np.testing.assert_array_equal(query.poses, memory.read_poses(query._data.oMg))


@pytest.mark.usefixtures("culling")
@pytest.mark.parametrize("missing", [["view_results"], ["view_poses"], ["view_results", "view_poses"]])
def test_without_the_views_the_result_is_the_same(panda, monkeypatch, missing):
    rng = np.random.default_rng(11)
    scene = random_scene(panda, rng, [SPHERE, CAPSULE, BOX])
    qs = [random_q(panda, rng) for _ in range(3)]
    starts = {i: o.motion.sample(0.0) for i, o in enumerate(scene.obstacles)}
    samples = [{i: next_sample(rng, start) for i, start in starts.items()} for _ in qs]
    fast = [look(scene, q, there, reach=0.3) for q, there in zip(qs, samples, strict=True)]
    for name in missing:
        monkeypatch.setattr(proximity, name, lambda *_, **__: None)
        monkeypatch.setattr(placing, name, lambda *_, **__: None, raising=False)
    query = DistanceQuery(scene)
    assert query._cull is not None
    views = ("view_results", "view_poses", "view_poses")
    assert (query._copy, query._copy_poses, query.placing.copies) == tuple(name in missing for name in views)
    for q, there, expected in zip(qs, samples, fast, strict=True):
        slow = look(scene, q, there, reach=0.3)
        assert len(slow.pair)
        for name in Proximity._fields:  # GJK starts elsewhere in a fresh query: equal to rounding
            np.testing.assert_allclose(getattr(slow, name), getattr(expected, name), rtol=0, atol=1e-12)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_pairs(paper, count):
    left, q = paper.lock(["right_*"], paper.home, "test")
    obstacles = [obstacle(f"o{i}", SPHERE, (0.0, 0.3 + 0.2 * i, -0.3)) for i in range(count)]
    bodies = left.bodies.copy()
    left = replace(left, bodies=bodies)
    bodies.removeAllCollisionPairs()
    scene = build_scene(left, obstacles)
    keep = [i for i, (a, _) in enumerate(scene.pair_names) if a == "left_hand"]
    for i in reversed(range(len(scene.pairs))):
        if i not in keep:
            scene.geometry.removeCollisionPair(scene.geometry.collisionPairs[i])
    scene = replace(scene, pairs=scene.pairs[keep], support=scene.support[keep])
    found = look(scene, q)
    assert found.distance.shape == found.feedforward.shape == (count,)
    assert found.J.shape == (count, 7) and found.normal.shape == (count, 3)
    tip = np.array([0.0, 0.3, 0.3])  # the hand's axis ends there at the zero pose; radii 0.05 and 0.06
    for i in range(count):
        gap = np.linalg.norm(np.array([0.0, 0.3 + 0.2 * i, -0.3]) - tip) - 0.11
        assert found.distance[i] == pytest.approx(gap, abs=1e-9)


def test_only_pairs_within_reach_have_rows(panda):
    rng = np.random.default_rng(12)
    scene = random_scene(panda, rng, [SPHERE] * 5)
    q = random_q(panda, rng)
    everything, some = look(scene, q), look(scene, q, reach=0.2)
    np.testing.assert_array_equal(everything.pair, np.arange(len(scene.pairs)))
    np.testing.assert_array_equal(some.pair, np.flatnonzero(everything.distance < 0.2))
    assert 0 < len(some.pair) < len(scene.pairs)
    np.testing.assert_array_equal(some.distance, everything.distance[some.pair])
    np.testing.assert_allclose(some.J, everything.J[some.pair], rtol=0, atol=1e-15)


def arrays_of(value):
    """All arrays in nested named tuples, in order."""
    if isinstance(value, np.ndarray):
        return [value]
    return [array for part in value for array in arrays_of(part)] if hasattr(value, "_fields") else []


def test_what_a_tick_returned_is_not_overwritten_by_the_next(panda):
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


def test_an_obstacle_is_seen_to_move_while_the_robot_rests(panda):
    scene = build_scene(panda, [obstacle("ball", SPHERE, (0.6, 0.0, 0.5))])
    query = DistanceQuery(scene)
    first = look(scene, panda.home, query=query)
    later = look(scene, panda.home, {0: Sample.at((2.6, 0.0, 0.5))}, query=query)
    assert later.distance[-1] > first.distance[-1] + 1.0


# --- culling -----------------------------------------------------------------------------------------------------


def pair_of_queries(scene):
    """A query with bounding spheres and one without."""
    culled, whole = DistanceQuery(scene), DistanceQuery(scene)
    assert culled._cull is not None
    whole._cull = None
    return culled, whole


def next_sample(rng, sample):
    """Most obstacles move on a little and turn, some jump, some of these far away."""
    twist = {"linear": rng.uniform(-1, 1, 3), "angular": rng.uniform(-2, 2, 3)}
    if rng.random() < 0.7:
        return moved(sample._replace(**twist), 0.02)._replace(**twist)
    place = rng.uniform(-0.8, 0.8, 3) * (50.0 if rng.random() < 0.3 else 1.0)
    return Sample.at(place, pin.exp3(rng.uniform(-2, 2, 3)), **twist)


@pytest.mark.usefixtures("culling")
@pytest.mark.parametrize("name", ["panda", "panda_convex"])
def test_culling_changes_nothing(name, request):
    robot = request.getfixturevalue(name)
    rng = np.random.default_rng(15)
    scene = random_scene(robot, rng, [SPHERE, CAPSULE, BOX, CYLINDER] * 2)
    culled, whole = pair_of_queries(scene)
    samples = {i: o.motion.sample(0.0) for i, o in enumerate(scene.obstacles)}
    counts, looked_at = [], []
    for _ in range(40):
        q = random_q(robot, rng, spread=1.5)
        samples = {i: next_sample(rng, sample) for i, sample in samples.items()}
        reach = rng.choice([-0.02, 0.0, 0.05, 0.1, 0.3, 2.0, np.inf])
        found, expected = (look(scene, q, samples, reach, query) for query in (culled, whole))
        np.testing.assert_array_equal(found.pair, expected.pair)
        # coal starts from where it ended the last time, which shows within its stopping criteria
        error = np.abs(found.distance - expected.distance)
        assert (error <= np.where(expected.distance > 0.0, 1e-9 * np.maximum(expected.distance, 1.0), 1e-6)).all()
        close = (expected.distance > 0.0) & (expected.distance < 3.0)
        for field in ("point_a", "point_b", "normal", "J", "feedforward"):
            np.testing.assert_allclose(
                getattr(found, field)[close], getattr(expected, field)[close], rtol=0, atol=ROUND
            )
        counts.append(len(found.pair))
        looked_at.append(culled._cull.active.sum())
        switched_on = np.array(culled._data.activeCollisionPairs)
        np.testing.assert_array_equal(switched_on, culled._cull.active & ~culled._known)
    assert len(set(counts)) > 20
    assert min(looked_at) < 0.3 * len(scene.pairs) < len(scene.pairs) == max(looked_at)


CORNERS = [
    (SPHERE, (1.0, 0.0, 0.0), SPHERE.radius),
    (CAPSULE, (0.0, 0.0, 1.0), CAPSULE.radius + CAPSULE.length / 2),
    (BOX, BOX.size, np.linalg.norm(BOX.size) / 2),
    (CYLINDER, (CYLINDER.radius, 0.0, CYLINDER.length / 2), np.hypot(CYLINDER.radius, CYLINDER.length / 2)),
]


@pytest.mark.usefixtures("culling")
@pytest.mark.parametrize(("shape", "corner", "size"), CORNERS, ids=lambda value: getattr(value, "type", ""))
def test_bounding_spheres_lose_nothing_where_they_are_tight(panda, shape, corner, size):
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
    query = DistanceQuery(scene)
    facing = [scene.pair_names.index((scene.body_names[i], f"o{i}")) for i in range(count)]
    everything = look(scene, q, samples, query=query)
    np.testing.assert_allclose(everything.distance[facing], gap, rtol=0, atol=1e-8)
    for reach, expected in ((gap + 1e-7, facing), (gap - 1e-7, [])):
        found = look(scene, q, reach=reach, query=query)
        assert sorted(set(facing) & set(found.pair)) == sorted(expected)
        np.testing.assert_array_equal(found.pair, np.flatnonzero(everything.distance < reach))


class Switches:
    """Geometry data that notes which pairs are switched on and off."""

    def __init__(self, query):
        self.data, self.calls = query._data, []
        query._cull._data = self

    def __getattr__(self, name):
        return getattr(self.data, name)

    def activateCollisionPair(self, pair):
        self.calls.append(("on", pair))
        self.data.activateCollisionPair(pair)

    def deactivateCollisionPair(self, pair):
        self.calls.append(("off", pair))
        self.data.deactivateCollisionPair(pair)


@pytest.mark.usefixtures("culling")
def test_pairs_are_switched_only_when_something_changed(panda):
    rng = np.random.default_rng(17)
    scene, q = random_scene(panda, rng, [CYLINDER, BOX, CAPSULE]), random_q(panda, rng)
    query = DistanceQuery(scene)
    switches = Switches(query)
    near = Sample.at(world_placements(scene, q)[len(scene.body_names) - 1].translation)

    def switched(**change):
        before = list(query._data.activeCollisionPairs)
        switches.calls.clear()
        look(scene, q, query=query, **{"reach": 0.1, **change})
        after = list(query._data.activeCollisionPairs)
        changes = [("on" if after[i] else "off", i) for i in range(len(after)) if before[i] != after[i]]
        assert sorted(switches.calls) == sorted(changes)
        return len(changes)

    assert switched(samples={0: near}) > 0
    assert switched() == switched() == 0
    assert switched(samples={0: Sample.at((30.0, 0.0, 0.0))}) > 0
    assert switched() == switched(samples={0: Sample.at((31.0, 0.0, 0.0))}) == 0
    assert switched(samples={0: near}) > 0
    assert switched() == 0
    assert switched(reach=np.inf) > 0
    np.testing.assert_array_equal(query._data.activeCollisionPairs, ~query._known)
    assert switched(reach=np.inf) == 0
    assert switched() > 0


# --- cost of a tick ----------------------------------------------------------------------------------------------


def balls(rng, count, radius):
    """Small spheres in all directions, at `radius` [m] from the origin, give or take a tenth."""
    directions = rng.normal(size=(count, 3))
    places = radius * rng.uniform(0.9, 1.1, (count, 1)) * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    shape = config.Sphere(type="sphere", radius=0.01)
    return [Obstacle.at(f"o{i}", shape, place) for i, place in enumerate(places)]


PARTING = Avoidance(d1=20.0, d2=30.0)
"""All pairs nearer than that have to part: with few and with many, the rows take the same branches."""


@pytest.mark.usefixtures("culling")
@pytest.mark.parametrize(("radius", "reach"), [(50.0, 0.1), (0.6, 0.1), (0.6, 10.0)])
def test_python_work_does_not_grow_with_the_number_of_pairs(panda, radius, reach):
    rng = np.random.default_rng(14)
    work, near = [], []
    for count in (10, 500):
        bench = Bench(build_scene(panda, balls(rng, count, radius)), avoidance=PARTING)
        switches = Switches(bench.query)
        bench.compute(panda.home, reach=reach)
        switches.calls.clear()
        near.append(len(bench.compute(panda.home, reach=reach)[0].pair))
        work.append(instructions(lambda bench=bench: bench.compute(panda.home, reach=reach)))
        assert not switches.calls
    assert 0 < work[0] == work[1] < 3000
    assert near[0] == near[1] if radius == 50.0 else 0 < 10 * near[0] < near[1]


CASES = {
    # (distance of the obstacles, avoidance, way that the tool has to go)
    "far": (50.0, Avoidance(), 0.0),
    "near": (2.0, Avoidance(d1=1e-3, d2=5.0), 0.0),
    "near, solving": (2.0, Avoidance(d1=1e-3, d2=5.0, row={"type": "damper", "gain": 0.02}), 0.3),
}


@pytest.mark.usefixtures("culling")
@pytest.mark.parametrize("case", CASES)
def test_python_work_of_a_tick_does_not_grow_with_the_number_of_pairs(panda, case):
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
        unconstrained = tracking_velocity(tick.problem)
        assert np.allclose(tick.solution.v, unconstrained, atol=1e-6) == (way == 0.0)
        switches = Switches(controller._query)
        work.append(instructions(lambda controller=controller: controller.step(panda.home)))
        assert not switches.calls
    assert 0 < work[0] == work[1] < 4000


@pytest.mark.usefixtures("culling")
def test_memory_does_not_grow():
    """20 000 ticks of a scene in which pairs come within reach and leave it, and the QP is solved."""
    controller, q = Controller.from_scenario(load_scenario("panda_line", ["avoidance.backup=null"]))
    model, dt = controller.scene.robot.model, controller.dt
    for near in range(len(controller.scene.pairs) + 1):
        controller._assembly._view(near)  # made once for each number of near pairs, and kept
    used, last, switches = [], b"", 0
    tracemalloc.start()
    try:
        for k in range(22_000):
            q = pin.integrate(model, q, dt * controller.step(q, (k * dt) % 12.0).v)
            switches += last != controller._query._cull._last
            last = controller._query._cull._last
            if k in (2_000 - 1, 22_000 - 1):
                assert switches > 10
                switches = 0
                gc.collect()
                used.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert used[1] - used[0] < 100_000  # numba fills a pool; an object that is lost takes 16 bytes at the least, a tick
