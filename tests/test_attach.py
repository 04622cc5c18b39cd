"""Objects that are picked up, carried and put down: rows, pairs, the loop, the look ahead, and the referee."""

import coal
import numpy as np
import pinocchio as pin
import pytest
from closed_loop import Ruler, accelerations, cartesian, drive, make_controller
from conftest import differences, random_q

from qpavoid import (
    Avoidance,
    ConfigError,
    Controller,
    Obstacle,
    Points,
    Pose,
    Sample,
    Sensing,
    Status,
    UnknownName,
    build_scene,
    build_tasks,
)
from qpavoid.config import Box, Capsule, Cylinder, HalfSpace, Line, PointCloud, Sphere, Task
from qpavoid.geometry.bodies import make_shape
from qpavoid.model.trajectory import build_motion

TCP = "panda_hand_tcp"
TCP_BODY = "panda_hand_0"
BOX = Box(size=(0.06, 0.06, 0.24))
POLE = Cylinder(radius=0.03, length=0.8)
HOLD = 0.02


def grasp_at(robot, q, frame=TCP, offset=(0.0, 0.0, 0.0)):
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    return data.oMf[robot.model.getFrameId(frame)] * pin.SE3(np.eye(3), np.array(offset))


def panda_with(panda, others=(), offset=(0.0, 0.0, 0.08), shape=BOX, **fields):
    place = grasp_at(panda, panda.home, offset=offset)
    box = Obstacle.at("box", shape, place.translation, place.rotation, graspable=True)
    tasks = build_tasks([Task(frame=TCP, gain=3.0)], panda, panda.home)
    fields.setdefault("avoidance", Avoidance(d1=HOLD, d2=0.12))
    return Controller(build_scene(panda, [box, *others]), tasks, "qp", 0.01, **fields)


def distance_between(one, pose_one, two, pose_two):
    """By coal, of two of its shapes."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance = 1e-10
    places = [coal.Transform3s(pose.rotation, pose.translation) for pose in (pose_one, pose_two)]
    return coal.distance(one, places[0], two, places[1], request, result)


# --- rows ---------------------------------------------------------------------------------------------------------


def test_attached_rows_agree_with_finite_differences(panda):
    """Against an obstacle that moves, and against the robot's own links."""
    rng, place = np.random.default_rng(0), np.array([0.45, 0.25, 0.3])
    controller = panda_with(panda, [Obstacle.at("pole", POLE, place)], avoidance=Avoidance(d1=HOLD, d2=3.0))
    controller.attach("box", TCP, panda.home)
    held, twist = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.08])), Sample.at(place, linear=[0.1, -0.2, 0.05])
    names, apart = controller.scene.pair_names, 0
    body = panda.bodies.geometryObjects[0]

    def to_pole(q, t=0.0):
        pole = pin.SE3(np.eye(3), place + t * twist.linear)
        return np.array([distance_between(make_shape(BOX), grasp_at(panda, q) * held, make_shape(POLE), pole)])

    def to_link(q):
        data = panda.model.createData()
        pin.forwardKinematics(panda.model, data, q)
        link = data.oMi[body.parentJoint] * body.placement
        return np.array([distance_between(body.geometry, link, make_shape(BOX), grasp_at(panda, q) * held)])

    for _ in range(6):
        q = random_q(panda, rng, 0.7)
        near = controller.tick(q, obstacles={"pole": twist}).proximity
        pairs = [names[pair] for pair in near.pair]
        for pair, distance in ((("box", "pole"), to_pole), ((body.name, "box"), to_link)):
            row = pairs.index(pair)
            assert near.distance[row] == pytest.approx(distance(q)[0], abs=1e-6)
            if near.distance[row] > 5e-3:
                np.testing.assert_allclose(near.J[row], differences(distance, panda, q, 1e-5)[0], atol=1e-4)
                apart += 1
        row, rate = pairs.index(("box", "pole")), (to_pole(q, 1e-5)[0] - to_pole(q, -1e-5)[0]) / 2e-5
        assert near.distance[row] < 5e-3 or near.feedforward[row] == pytest.approx(rate, abs=1e-4)
    assert apart > 8


def test_attached_pairs_are_those_beyond_the_hand(panda):
    controller = panda_with(panda, [Obstacle.at("pole", POLE, [0.45, 0.4, 0.3])], avoidance=Avoidance(d1=HOLD, d2=5.0))

    def watched():
        tick = controller.tick(panda.home)
        return {frozenset(controller.scene.pair_names[pair]) for pair in tick.proximity.pair}

    bodies = controller.scene.body_names
    free = watched()
    assert {frozenset((body, "box")) for body in bodies} <= free
    assert frozenset(("box", "pole")) not in free
    controller.attach("box", TCP)
    carried = watched()
    joint = panda.model.frames[panda.model.getFrameId(TCP)].parentJoint
    rigid = [b.name for b in panda.bodies.geometryObjects if b.parentJoint == joint]
    assert rigid and not {frozenset((body, "box")) for body in rigid} & carried
    assert {frozenset((body, "box")) for body in bodies[:4]} <= carried
    assert frozenset(("box", "pole")) in carried
    assert {pair for pair in free if "box" not in pair} == {pair for pair in carried if "box" not in pair}
    controller.release("box")
    # what touched the box when it was put down is looked at again once it has been clear
    assert {frozenset((body, "box")) for body in bodies[:4]} <= watched()


# --- the loop -----------------------------------------------------------------------------------------------------


def carry_past(panda, attach):
    """The tool goes along a line that the pole is beside: far from the hand, near what hangs from it."""
    place = grasp_at(panda, panda.home, offset=(0.0, 0.0, 0.14)).translation
    pole = Obstacle.at("pole", Capsule(radius=0.025, length=0.16), [place[0] + 0.02, 0.2, place[2] - 0.02])
    controller = panda_with(panda, [pole], offset=(0.0, 0.0, 0.14))
    if attach:
        controller.attach("box", TCP, panda.home)
    start = grasp_at(panda, panda.home).translation
    q, least, vs = panda.home.copy(), np.inf, []
    held = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.14]))
    pole_at, shapes = pin.SE3(np.eye(3), pole.motion.sample(0.0).position), (make_shape(BOX), make_shape(pole.shape))
    for k in range(500):
        target = Sample.at(start + np.array([0.0, min(0.08 * k * 0.01, 0.4), 0.0]))
        given = None if attach else {"box": Sample.at([0.0, 0.0, 5.0])}
        tick = controller.tick(q, targets={TCP: target}, obstacles=given)
        q = pin.integrate(panda.model, q, 0.01 * tick.solution.v)
        vs.append(tick.solution.v)
        least = min(least, distance_between(shapes[0], grasp_at(panda, q) * held, shapes[1], pole_at))
    return controller, q, least, np.array(vs), tick


def test_attached_box_keeps_clear_of_a_pole(panda):
    *_, without, _, _ = carry_past(panda, False)
    _, _, least, vs, tick = carry_past(panda, True)
    assert without < 0.0, "the way must lead through the pole, or this shows nothing"
    assert least > HOLD - 1e-3
    assert tick.solution.status is Status.SOLVED
    bounds = panda.bounds()
    assert (accelerations(vs, 0.01) <= bounds.acceleration + 1e-6).all()


def test_attach_and_release_in_motion_keep_to_the_accelerations(panda):
    """The robot is at full tilt when the box becomes its own, and when it stops being so."""
    near = Obstacle.at("wall", Box(size=(0.5, 0.02, 0.5)), [0.4, 0.3, 0.45])
    controller = panda_with(panda, [near])
    controller.allow_contact("box", controller.scene.body_names)
    start, q, vs = grasp_at(panda, panda.home).translation, panda.home.copy(), []
    for k in range(300):
        if k == 61:
            controller.attach("box", TCP, q)
        if k == 180:
            controller.release("box", q)
        box = grasp_at(panda, q, offset=(0.0, 0.0, 0.08))
        given = {"box": Pose(box.translation, box.rotation)} if k == 60 else None
        target = {TCP: Sample.at(start + np.array([0.0, 0.4 * np.sin(0.02 * k), 0.0]))}
        solution = controller.step(q, targets=target, obstacles=given)
        assert solution.status is Status.SOLVED, solution.reasons
        vs.append(solution.v)
        q = pin.integrate(panda.model, q, 0.01 * solution.v)
    assert np.abs(vs).max() > 0.3
    assert (accelerations(vs, 0.01) <= panda.bounds().acceleration + 1e-6).all()


def test_released_box_is_an_obstacle(panda):
    controller = panda_with(panda, [], offset=(0.0, 0.0, 0.14))
    controller.attach("box", TCP, panda.home)
    start, q = grasp_at(panda, panda.home).translation, panda.home.copy()
    for k in range(150):
        q = pin.integrate(
            panda.model, q, 0.01 * controller.step(q, targets={TCP: Sample.at(start + np.array([0, 0.001 * k, 0]))}).v
        )
    there = grasp_at(panda, q, offset=(0.0, 0.0, 0.14))
    np.testing.assert_allclose(controller.obstacle_pose("box", q).position, there.translation, atol=1e-9)
    sample = controller.release("box", q)
    np.testing.assert_allclose(sample.position, there.translation, atol=1e-9)
    np.testing.assert_allclose(sample.rotation, there.rotation, atol=1e-9)
    here, ruler = grasp_at(panda, q).translation, Ruler(controller.scene)
    for k in range(150):  # up and away, then down again: now it is in the way
        q = pin.integrate(
            panda.model, q, 0.01 * controller.step(q, targets={TCP: Sample.at(here + np.array([0, 0, 0.0015 * k]))}).v
        )
    np.testing.assert_allclose(controller.obstacle_pose("box", q).position, there.translation, atol=1e-12)
    away = ruler.distances(q, {0: sample}).min()
    assert away > HOLD
    for _ in range(300):
        solution = controller.step(q, targets={TCP: Sample.at(here - [0, 0, 0.15])})
        q = pin.integrate(panda.model, q, 0.01 * solution.v)
    pairs = [i for i, pair in enumerate(controller.scene.pair_names) if "box" in pair]
    assert ruler.distances(q, {0: sample})[pairs].min() > HOLD - 1e-3


def test_attached_box_leaves_its_table_smoothly(panda):
    """It touches the table when it is picked up: that pair counts once it has been clear, and then it does."""
    place = grasp_at(panda, panda.home, offset=(0.0, 0.0, 0.08)).translation
    top = place[2] - 0.12
    table = Obstacle.at("table", HalfSpace(), [0, 0, top - 1e-4])
    controller = panda_with(panda, [table], avoidance=Avoidance(d1=HOLD, d2=0.06))
    controller.allow_contact("table", controller.scene.body_names)
    controller.attach("box", TCP, panda.home)
    first = controller.step(panda.home)
    assert first.status is Status.SOLVED and np.abs(first.v).max() < 1e-3
    start, q, heights = grasp_at(panda, panda.home).translation, panda.home.copy(), []
    for k in range(600):
        z = 0.0005 * min(k, 200) - 0.0005 * max(k - 300, 0)
        solution = controller.step(q, targets={TCP: Sample.at(start + np.array([0, 0, z]))})
        q = pin.integrate(panda.model, q, 0.01 * solution.v)
        pose = grasp_at(panda, q, offset=(0.0, 0.0, 0.08))
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.5 * np.array(BOX.size)
        heights.append((corners @ pose.rotation.T + pose.translation)[:, 2].min() - top)
    assert max(heights) > 0.05
    assert min(heights[300:]) > HOLD - 1e-3


def test_braking_look_ahead_includes_attached_objects(tmp_path):
    """Full speed at a wall with a rod in front: it stops with the rod's tip short of it, braking seen to."""
    robot = cartesian(tmp_path, speed=2.0, acceleration=4.0)
    rod = Obstacle.at(
        "rod", Capsule(radius=0.02, length=0.6), [0.37, 0, 0], pin.rpy.rpyToMatrix(0, np.pi / 2, 0), graspable=True
    )
    wall = Obstacle.at("wall", Box(size=(0.02, 2.0, 2.0)), [2.0, 0.0, 0.0])
    controller = make_controller(robot, [rod, wall], "z", task={"gain": 20.0})
    controller.attach("rod", "z", np.zeros(3))
    for tick in drive(controller, np.zeros(3), 300, target=[5.0, 0.0, 0.0]):
        tip = tick.state.q[0] + 0.01 * tick.solution.v[0] + 0.37 + 0.3 + 0.02
        assert 1.99 - tip > HOLD - 1e-3
        assert tick.solution.status is Status.SOLVED
    assert 1.99 - tip < HOLD + 5e-3


def test_clear_tracking_velocity_with_a_load_stays_clear(panda):
    """Where the look-ahead calls the tracking law clear, the box keeps its distance until the end of a stop."""
    rng, clear = np.random.default_rng(3), 0
    balls = [
        Obstacle.at(f"b{i}", Sphere(radius=0.05), rng.uniform([0.35, -0.5, 0.0], [0.8, 0.5, 0.9])) for i in range(5)
    ]
    controller = panda_with(panda, balls, offset=(0.0, 0.0, 0.14), avoidance=Avoidance(d1=HOLD, d2=0.3))
    controller.attach("box", TCP, panda.home)
    held = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.14]))
    for _ in range(200):
        q = random_q(panda, rng, 0.4)
        controller.reset()
        target = Sample.at(grasp_at(panda, q).translation + rng.uniform(-0.05, 0.05, 3))
        controller.reset(controller.tick(q, targets={TCP: target}).problem.v_tracking)
        problem = controller.tick(q, targets={TCP: target}).problem
        if not problem.tracking_is_clear:
            continue
        clear, v = clear + 1, problem.v_tracking
        seconds = 0.01 + 0.5 * np.max(np.abs(v) / panda.bounds().acceleration)
        for t in (0.01, seconds):
            box = grasp_at(panda, pin.integrate(panda.model, q, t * v)) * held
            for ball in balls:
                there = pin.SE3(np.eye(3), ball.motion.sample(0.0).position)
                assert distance_between(make_shape(BOX), box, make_shape(ball.shape), there) >= HOLD - 2e-4
    assert clear > 20


def test_attached_box_has_rows_with_points(panda, tmp_path):
    controller = panda_with(
        panda, [Obstacle.at("camera", PointCloud(), [0, 0, 0])], avoidance=Avoidance(d1=HOLD, d2=0.3)
    )
    tip = grasp_at(panda, panda.home, offset=(0.0, 0.0, 0.30)).translation
    given = {"camera": Points(tip[None])}
    names = controller.scene.pair_names
    before = [names[pair] for pair in controller.tick(panda.home, obstacles=given).proximity.pair]
    assert ("box", "camera") not in before
    controller.attach("box", TCP)
    tick = controller.tick(panda.home, obstacles=given)
    row = [names[pair] for pair in tick.proximity.pair].index(("box", "camera"))
    voxel = 0.02 * (np.floor(tip / 0.02) + 0.5)
    box = grasp_at(panda, panda.home, offset=(0.0, 0.0, 0.08))
    expected = distance_between(make_shape(BOX), box, coal.Sphere(0.01 * np.sqrt(3.0)), pin.SE3(np.eye(3), voxel))
    assert tick.proximity.distance[row] == pytest.approx(expected, abs=1e-6)


def test_attached_objects_are_obstacles_to_each_other(tmp_path):
    """Each is a body of the robot; free ones are obstacles to the carried ones, moving ones included."""
    robot = cartesian(tmp_path)
    one = Obstacle.at("one", Sphere(radius=0.05), [0.2, 0, 0], graspable=True)
    two = Obstacle.at("two", Sphere(radius=0.05), [0.6, 0, 0], graspable=True)
    controller = make_controller(robot, [one, two], "z", avoidance=Avoidance(d1=HOLD, d2=1.0))
    names = controller.scene.pair_names
    for carried, free, sign in (("one", "two", 1.0), ("two", "one", -1.0)):
        controller.attach(carried, "z", np.zeros(3))
        at = {"one": 0.2, "two": 0.6}[free]
        tick = controller.tick(np.zeros(3), obstacles={free: Sample.at([at, 0, 0], linear=[0.3, 0, 0])})
        row = [names[pair] for pair in tick.proximity.pair].index(("one", "two"))
        assert tick.proximity.distance[row] == pytest.approx(0.3)
        np.testing.assert_allclose(tick.proximity.J[row], [-sign, 0, 0], atol=1e-12)
        assert tick.proximity.feedforward[row] == pytest.approx(0.3 * sign)
        controller.release(carried, np.zeros(3))
    for carried in ("one", "two"):
        controller.attach(carried, "y", np.zeros(3))
    rows = controller.tick(np.zeros(3)).proximity.pair
    assert ("one", "two") not in [names[pair] for pair in rows]  # carried by the same joint
    controller.attach("two", "x", np.zeros(3))  # handed over, to a joint above: now y moves one against two
    tick = controller.tick(np.zeros(3))
    assert ("one", "two") not in [names[pair] for pair in tick.proximity.pair]  # one hangs below two's carrier


# --- what is said ------------------------------------------------------------------------------------------------


def test_attach_errors_name_the_remedy(panda):
    controller = panda_with(panda, [Obstacle.at("pole", POLE, [1, 0, 0])])
    with pytest.raises(ConfigError, match="declare it with `graspable: true`"):
        controller.attach("pole", TCP)
    with pytest.raises(UnknownName, match="did you mean 'box'"):
        controller.attach("bax", TCP)
    with pytest.raises(UnknownName, match=TCP):
        controller.attach("box", "panda_hand_tpc")
    with pytest.raises(ConfigError, match="fixed to the world"):
        controller.attach("box", "universe")
    with pytest.raises(ConfigError, match="not carried"):
        controller.release("box")
    with pytest.raises(UnknownName, match="no body or obstacle 'no_one'"):
        controller.allow_contact("box", [TCP_BODY, "no_one"])
    with pytest.raises(UnknownName, match="no body or obstacle 3"):
        controller.allow_contact("box", [3])
    with pytest.raises(UnknownName, match="list of names"):
        controller.allow_contact("box", 3)
    with pytest.raises(ConfigError, match="no pair"):
        controller.allow_contact("pole", "pole")
    controller.step(panda.home, obstacles={"box": Sample.at([5.0, 0, 0])})
    with pytest.raises(ConfigError, match="too far"):
        controller.attach("box", TCP)
    for shape in (HalfSpace(), PointCloud()):
        with pytest.raises(ConfigError, match="cannot be carried"):
            build_scene(panda, [Obstacle.at("it", shape, [0, 0, 0], graspable=True)])


def test_updates_of_an_attached_box_are_ignored(panda):
    controller = panda_with(panda, sensing=Sensing(stale_after=0.02, stop_after=0.05))
    controller.step(panda.home, obstacles={"box": controller.obstacle_pose("box")})
    controller.attach("box", TCP)
    before = controller.obstacle_pose("box").position
    solution = controller.step(panda.home, obstacles={"box": Sample.at([0.0, 0.0, 3.0])})
    assert [reason.key for reason in solution.assumptions] == [("IGNORED", ("box",))]
    np.testing.assert_allclose(controller.obstacle_pose("box").position, before)
    for _ in range(20):
        solution = controller.step(panda.home)
    assert solution.status is Status.SOLVED and solution.assumptions == ()  # it is not late


def test_attach_leaves_other_controllers_of_the_scene_alone(panda):
    one, two = panda_with(panda), None
    two = Controller(one.scene, one.tasks, "qp", 0.01, avoidance=one.avoidance)
    before = two.tick(panda.home).proximity
    one.attach("box", TCP)
    after = two.tick(panda.home).proximity
    for name in ("pair", "closest", "J"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))


def test_graspable_changes_nothing_before_it_is_attached(panda):
    others = [Obstacle.at("pole", POLE, [0.45, 0.2, 0.3])]
    commands = []
    for graspable in (False, True):
        box = Obstacle.at("box", BOX, [0.4, -0.2, 0.4], graspable=graspable)
        controller = Controller(build_scene(panda, [box, *others]), [], "qp")
        commands.append(controller.filter(panda.home, np.full(7, 0.1)).v)
    np.testing.assert_array_equal(*commands)


def test_an_object_released_from_a_trajectory_stays_where_it_is(tmp_path):
    """Also among others that go on along theirs."""
    lines = [Line(start=(x, 0.0, 0.0), displacement=(0.0, 5.0, 0.0), speed=0.5) for x in (0.3, 9.0)]
    ball, far = (
        Obstacle(name, Sphere(radius=0.05), build_motion(line), moves=True, graspable=name == "ball")
        for name, line in zip(("ball", "far"), lines, strict=True)
    )
    controller, q = make_controller(cartesian(tmp_path), [ball, far], "z"), np.zeros(3)
    controller.step(q, 0.0)
    controller.attach("ball", "z", q)
    controller.step(q, 0.01)
    placed = controller.release("ball", q).position
    for k in range(2, 5):
        controller.step(q, 0.01 * k)
        np.testing.assert_array_equal(controller.obstacle_pose("ball").position, placed)
    np.testing.assert_allclose(controller.obstacle_pose("far").position, [9.0, 0.02, 0.0], atol=1e-12)
