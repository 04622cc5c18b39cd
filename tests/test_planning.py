"""Planned paths: clear by coal, certain between their configurations, reproducible; refusals that say why."""

from dataclasses import replace

import coal
import numpy as np
import pinocchio as pin
import pytest

from qpavoid import (
    ConfigError,
    Controller,
    NumericalError,
    Obstacle,
    Planner,
    PlannerSettings,
    Points,
    Pose,
    ReasonKind,
    Robot,
    UnknownName,
    build_scene,
    build_tasks,
    plan_to,
)
from qpavoid.config import Box, Capsule, Cylinder, PointCloud, Sphere, Task
from qpavoid.control.distances import DistanceQuery
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.setup.sampling import draw_poses

D1 = 0.02
SETTINGS = PlannerSettings(safety_distance=D1)


def shelf():
    """Boards and a pillar within reach of a Panda: pairs with closed forms alone."""
    return [
        Obstacle.at("board", Box(size=(0.4, 0.8, 0.02)), [0.65, 0.0, 0.55]),
        Obstacle.at("side", Box(size=(0.4, 0.02, 0.5)), [0.65, 0.1, 0.5]),
        Obstacle.at("ball", Sphere(radius=0.08), [0.4, -0.4, 0.3]),
        Obstacle.at("bar", Capsule(radius=0.03, length=0.6), [-0.3, 0.3, 0.5]),
    ]


def least_distance(scene):
    """Function from q to the least distance of pairs that a joint moves, by the distance query."""
    query, kinematics = DistanceQuery(scene), ForwardKinematics(scene.robot.model)
    pairs = np.flatnonzero(query.table.separable)

    def least(q):
        kinematics.compute(q)
        query.compute(kinematics.joint_poses, np.inf)
        return query.distances_of(pairs).min()

    return least


class Checker:
    """Distances by coal alone, of the pairs that a joint moves."""

    def __init__(self, scene):
        self.model, self.geometry = scene.robot.model, scene.geometry
        self.data, self.placed = self.model.createData(), scene.geometry.createData()
        self.pairs = scene.pairs[np.any(scene.support != 0.0, axis=1)].tolist()

    def distances(self, q):
        pin.updateGeometryPlacements(self.model, self.data, self.geometry, self.placed, q)
        bodies = [body.geometry for body in self.geometry.geometryObjects]
        at = [coal.Transform3s(pose.rotation, pose.translation) for pose in self.placed.oMg]
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        found = []
        for i, j in self.pairs:
            result.clear()
            found.append(coal.distance(bodies[i], at[i], bodies[j], at[j], request, result))
        return np.array(found)

    def points(self, q):
        """Centres of all moving bodies [m]."""
        pin.updateGeometryPlacements(self.model, self.data, self.geometry, self.placed, q)
        return np.array([pose.translation for pose in self.placed.oMg])


def samples(checker, path, spacing=0.005):
    """Configurations along a path between which no body's origin moves farther than a spacing [m]."""
    for a, b in zip(path.q[:-1], path.q[1:], strict=True):
        moved = np.linalg.norm(checker.points(b) - checker.points(a), axis=1).max() + np.abs(b - a).max()
        for s in np.linspace(0.0, 1.0, 2 + int(moved / spacing)):
            yield a + s * (b - a)


@pytest.mark.parametrize("name", ["panda", "ur5", "paper-dual-arm"])
def test_clearance_equals_the_distance_query(name):
    """On 1000 configurations: to rounding where all pairs have closed forms."""
    robot = Robot.load(name)
    scene = build_scene(robot, shelf())
    planner, least = Planner(scene, SETTINGS), least_distance(scene)
    closed = np.isin(DistanceQuery(scene).table.method, (2,)).all()
    apart = 0
    for q in draw_poses(robot, 1000):
        ours, theirs = planner.clearance(q), least(q)
        assert ours <= theirs + 1e-9
        if theirs > 0.0:
            apart += 1
            assert ours == pytest.approx(theirs, abs=1e-9 if closed else 1e-8)
    assert apart > 50


def test_paths_are_clear_by_coal():
    robot = Robot.load("panda")
    scene = build_scene(robot, [*shelf(), Obstacle.at("can", Cylinder(radius=0.05, length=0.2), [0.5, 0.35, 0.2])])
    checker, solved = Checker(scene), 0
    allowance = scene.distance_allowance(D1)[np.any(scene.support != 0.0, axis=1)]
    for k, point in enumerate([[0.55, -0.25, 0.45], [0.55, 0.3, 0.4], [0.5, 0.3, 0.75], [-0.4, 0.4, 0.6]]):
        path = plan_to(scene, robot.home, targets={"panda_hand_tcp": point}, seed=k, settings=SETTINGS)
        if not path:
            continue
        solved += 1
        assert np.array_equal(path.q[0], robot.home)
        data = robot.model.createData()
        pin.framesForwardKinematics(robot.model, data, path.q[-1])
        reached = data.oMf[robot.model.getFrameId("panda_hand_tcp")].translation
        assert np.linalg.norm(reached - point) <= 1e-4
        start = checker.distances(robot.home)
        for q in samples(checker, path):
            assert np.all(checker.distances(q) >= np.minimum(D1 - allowance, start - 1e-3) - 1e-6)
    assert solved >= 3


def test_same_arguments_give_the_same_path():
    robot = Robot.load("panda")
    target = {"panda_hand_tcp": [0.55, 0.3, 0.4]}
    paths = [plan_to(build_scene(robot, shelf()), robot.home, targets=target, seed=3, settings=SETTINGS) for _ in "ab"]
    planner = Planner(build_scene(robot, shelf()), SETTINGS)
    planner.plan(robot.home, targets=target, seed=8)
    paths.append(planner.plan(robot.home, targets=target, seed=3))
    assert paths[0]
    for path in paths[1:]:
        assert np.array_equal(path.q, paths[0].q) and path.checks == paths[0].checks


def test_goal_configuration_is_attained_and_limits_hold():
    robot = Robot.load("panda")
    scene, bounds = build_scene(robot, shelf()), robot.bounds()
    goal = robot.home + np.array([1.2, 0.3, 0.0, 0.2, 0.0, 0.0, 0.0])
    path = plan_to(scene, robot.home, goal, settings=SETTINGS)
    assert path and np.array_equal(path.q[-1], goal)
    assert (path.q[:, bounds.q_index] >= bounds.lower).all() and (path.q[:, bounds.q_index] <= bounds.upper).all()
    assert (np.abs(np.diff(path.q, axis=0)) <= bounds.velocity * np.diff(path.t)[:, None] + 1e-12).all()
    assert path.at(path.duration) == pytest.approx(goal)


def test_poses_of_frames_and_relative_poses_are_attained():
    robot = Robot.load("baxter")
    left, right = robot.end_effectors[:2]
    data = robot.model.createData()
    q = robot.home + 0.1
    pin.framesForwardKinematics(robot.model, data, q)
    a, b = (data.oMf[robot.model.getFrameId(frame)].copy() for frame in (left, right))
    planner = Planner(build_scene(robot), SETTINGS)
    for targets in ({left: Pose.at(a.translation, a.rotation), right: b.translation}, {(right, left): a.actInv(b)}):
        path = planner.plan(robot.home, targets=targets)
        assert path, path.reason
        pin.framesForwardKinematics(robot.model, data, path.q[-1])
        at = [data.oMf[robot.model.getFrameId(frame)] for frame in (left, right)]
        if left in targets:
            assert np.linalg.norm(at[1].translation - b.translation) <= 1e-4
            assert np.linalg.norm(pin.log6(at[0].actInv(a)).vector) <= 2e-3
        else:
            assert np.linalg.norm(pin.log6(at[0].actInv(at[1]).actInv(a.actInv(b))).vector) <= 2e-3


def test_path_in_time_evades_an_obstacle_that_moves():
    robot = Robot.load("panda")
    from qpavoid.control.obstacle_states import ObstacleStates
    from qpavoid.model.sample import Sample

    scene = build_scene(robot, [Obstacle.at("ball", Sphere(radius=0.1), [0.5, 0.9, 0.5])])
    planner, twist = Planner(scene, SETTINGS), np.array([0.0, -0.6, 0.0])
    planner.place(ObstacleStates.of([Sample.at([0.5, 0.9, 0.5], np.eye(3), linear=twist)]))
    path = planner.plan(robot.home, targets={"panda_hand_tcp": [0.45, 0.3, 0.5]}, arrivals=(0.4, 0.8, 1.6, 3.0))
    assert path and path.duration in (0.4, 0.8, 1.6, 3.0)
    for t in np.linspace(0.0, path.duration, 60):
        moved = build_scene(robot, [Obstacle.at("ball", Sphere(radius=0.1), np.array([0.5, 0.9, 0.5]) + t * twist)])
        q = path.at(float(t))
        assert Checker(moved).distances(q).min() >= min(D1, Checker(moved).distances(robot.home).min()) - 1e-6


def test_attached_objects_and_points_count():
    robot = Robot.load("panda")
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.home)
    tool = data.oMf[robot.model.getFrameId("panda_hand_tcp")]
    stick = Obstacle.at(
        "stick", Capsule(radius=0.01, length=0.4), tool.translation, np.eye(3)[[2, 0, 1]], graspable=True
    )
    cloud = Obstacle.at("camera", PointCloud(resolution=0.02), [0, 0, 0])
    scene = build_scene(robot, [stick, cloud])
    controller = Controller(scene, build_tasks([Task(frame="panda_hand_tcp")], robot, robot.home))
    wall = np.array([[x, y, z] for x in (0.5,) for y in np.arange(0.25, 0.8, 0.02) for z in np.arange(0.0, 0.9, 0.02)])
    controller.step(robot.home, obstacles={"camera": Points(wall, at_rest=True)})
    target = {"panda_hand_tcp": [0.35, 0.35, 0.5]}
    free = plan_to(controller, robot.home, targets=target)
    assert free, free.reason
    controller.allow_contact("stick", ["panda_hand_0", "panda_leftfinger_0", "panda_rightfinger_0"])
    controller.attach("stick", "panda_hand_tcp", robot.home)
    controller.step(robot.home, obstacles={"camera": Points(wall, at_rest=True)})
    path = plan_to(controller, robot.home, targets=target)
    data = robot.model.createData()
    placement = tool.actInv(pin.SE3(stick.motion.sample(0.0).rotation, tool.translation))
    for q in path.q:
        pin.framesForwardKinematics(robot.model, data, q)
        at = data.oMf[robot.model.getFrameId("panda_hand_tcp")] * placement
        along = np.array([at.translation + s * at.rotation[:, 2] for s in np.linspace(-0.2, 0.2, 41)])
        gaps = np.linalg.norm(along[:, None] - wall[None], axis=2).min() - 0.01
        assert gaps >= controller.avoidance.d1


def test_reasons_say_why_there_is_no_path():
    robot = Robot.load("panda")
    home = robot.home
    scene = build_scene(robot, shelf())
    reason = plan_to(scene, home, targets={"panda_hand_tcp": [3.0, 0.0, 0.0]}, settings=SETTINGS).reason
    assert reason.kind is ReasonKind.NOT_ATTAINED
    inside = build_scene(robot, [Obstacle.at("block", Box(size=(0.3, 0.3, 0.3)), [0.4, 0.0, 0.5])])
    path = plan_to(inside, home, home + 0.1, settings=SETTINGS)
    assert not path and path.reason.kind is ReasonKind.START_TOO_NEAR and "block" in path.reason.subject
    blocked = build_scene(robot, [Obstacle.at("block", Sphere(radius=0.15), [0.0, 0.45, 0.5])])
    goal = home + np.array([np.pi / 2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    path = plan_to(blocked, home, goal, settings=SETTINGS)
    assert not path and path.reason.kind is ReasonKind.GOAL_TOO_NEAR and "block" in path.reason.subject
    few, far = replace(SETTINGS, max_checks=1), home + np.array([-0.9 * np.pi, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    path = plan_to(build_scene(robot, shelf()), home, far, settings=few)
    assert not path and path.reason.kind is ReasonKind.NO_PATH and path.reason.amount == path.checks > 0


def test_what_cannot_be_planned_is_refused():
    robot = Robot.load("panda")
    scene = build_scene(robot, shelf())
    with pytest.raises(ConfigError, match="one of"):
        plan_to(scene, robot.home)
    with pytest.raises(NumericalError, match="q_goal"):
        plan_to(scene, robot.home, robot.home[:3])
    with pytest.raises(NumericalError, match="NaN"):
        plan_to(scene, robot.home, np.full(7, np.nan))
    with pytest.raises(UnknownName):
        plan_to(scene, robot.home, targets={"panda_hand": [0.5, 0.0, 0.5], "nothing": [0.0, 0.0, 0.0]})
    base = Robot.load("g1")
    if base.model.nq != base.model.nv:
        path = plan_to(build_scene(base), base.home, base.home)
        assert path.reason.kind is ReasonKind.NO_PLAN and "several coordinates" in str(path.reason)
