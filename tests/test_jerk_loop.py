"""Jerk limits in the loop of a controller: static obstacles, stops, relaxation, and settings."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop import ROWS, Ruler, cartesian, drive, make_controller, through_an_obstacle
from conftest import Bench

from qpavoid import (
    Avoidance,
    ConfigError,
    Controller,
    Limits,
    Obstacle,
    ReasonKind,
    Robot,
    Sample,
    Status,
    UnknownName,
    build_scene,
)
from qpavoid.config import Box, Sphere
from qpavoid.run.simulate import simulate

SAFE = 0.02


def within_limits(controller, vs, slack=1e-9):
    """Assert that commands, from rest on, keep velocity, acceleration and jerk limits."""
    b, dt = controller.scene.robot.bounds().within(controller.limits), controller.dt
    changes = np.diff(vs, axis=0, prepend=np.zeros((1, len(vs[0]))))
    jumps = np.diff(changes, axis=0, prepend=np.zeros((1, len(vs[0]))))
    assert (np.abs(vs) <= b.velocity + slack).all()
    assert (np.abs(changes) <= b.acceleration * dt + slack).all()
    assert (np.abs(jumps) <= b.jerk * dt**2 + slack).all()
    return np.max(np.abs(jumps) / (b.jerk * dt**2))


@pytest.mark.parametrize("row", ROWS)
@pytest.mark.parametrize("size", [[0.004, 0.6, 0.6], [0.2, 0.2, 0.2]], ids=["plate", "box"])
@pytest.mark.parametrize(
    ("dt", "duration"), [(0.01, 1.5), (0.05, 3.0), pytest.param(0.002, 0.8, marks=pytest.mark.slow)]
)
def test_safety_distance_is_kept_at_any_period_and_speed(row, size, dt, duration):
    """As without jerk limits, with ones of about 10 times the accelerations a second: a target leads through a body."""
    shape = {"type": "box", "size": size}
    run = through_an_obstacle(shape, {"row": ROWS[row]}, dt, duration, limits={"jerk": 100.0})
    log = simulate(run)
    controller, _ = Controller.from_scenario(run)
    ruler = Ruler(controller.scene)
    least = min(ruler.least_between(q, v, dt, t, 4) for q, v, t in zip(log.q, log.v, log.t, strict=True))
    assert least > SAFE - 1e-3
    solved = log.metrics()["status_counts"]["SOLVED"] / len(log.t)
    assert solved == 1.0 or (dt < 0.01 and solved > 0.97 and log.slack.max() < 2e-4)  # by 0.1 mm/s, at the margin
    assert within_limits(controller, log.v) > 0.95  # and jerks go up to their limit
    assert log.metrics()["peak_velocity"] > 0.95  # 1.0 to 2.6: near a body it goes round, no longer as fast as it can


@pytest.mark.parametrize("solver", ["qp", "hqp"])
@pytest.mark.parametrize(("jerk", "gain"), [(20.0, 5.0), (10.0, 1.0)])
def test_target_is_reached_and_the_robot_rests_there(panda, solver, jerk, gain):
    """At 2 rad/s²: the velocity closest to v_tracking in every step would oscillate at up to 0.7 rad/s."""
    slow = replace(panda, acceleration=dict.fromkeys(panda.coordinate_names, 2.0))
    goal = np.array([0.407, 0.3, 0.387])
    controller = make_controller(slow, (), "panda_hand_tcp", solver, limits=Limits(jerk=jerk), task={"gain": gain})
    ticks = list(drive(controller, panda.home, 700, target=goal))
    assert np.linalg.norm(ticks[-1].kinematics.position[0] - goal) < 1e-3
    assert max(np.abs(tick.solution.v).max() for tick in ticks[-100:]) < 5e-3
    assert within_limits(controller, np.array([tick.solution.v for tick in ticks])) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_random_targets_among_obstacles_stay_feasible(panda, seed):
    """At up to full speed, half of the targets inside obstacles, with the robot's own accelerations."""
    rng, bounds = np.random.default_rng(seed), panda.bounds()
    shapes = Box(size=(0.3, 0.3, 0.3)), Sphere(radius=0.1), Box(size=(0.004, 0.5, 0.5))
    clear = False
    while not clear:
        obstacles = [Obstacle.at(f"o{i}", s, rng.uniform(-0.8, 0.8, 3)) for i, s in enumerate(shapes)]
        controller = make_controller(
            panda, obstacles, "panda_hand_tcp", task={"gain": 5.0, "max_speed": 2.0}, limits=Limits(jerk=300.0)
        )
        ruler = Ruler(controller.scene)
        q = rng.uniform(bounds.lower, bounds.upper)
        clear = ruler.distances(q).min() > 0.03
    vs, least = [], np.inf
    for k in range(700):
        if k % 60 == 0:
            inside = obstacles[rng.integers(3)].motion.sample(0.0).position
            target = {"panda_hand_tcp": Sample.at(rng.uniform(-0.8, 0.8, 3) if rng.random() < 0.5 else inside)}
        s = controller.step(q, 0.01 * k, target)
        assert s.status is Status.SOLVED, s.reasons
        vs.append(s.v)
        q = q + 0.01 * s.v
        assert (q <= bounds.upper + 1e-9).all() and (q >= bounds.lower - 1e-9).all()
        least = min(least, ruler.distances(q).min())
    assert within_limits(controller, np.array(vs)) > 0.99
    assert least > SAFE - 1e-3


def test_clearance_lower_bound_holds_along_stops(panda):
    """Distances along stops from random velocities and accelerations, by brute force."""
    rng, bounds = np.random.default_rng(0), panda.bounds()
    balls = [Obstacle.at(f"ball{i}", Sphere(radius=0.08), p) for i, p in enumerate(rng.uniform(-0.7, 0.7, (3, 3)))]
    scene = build_scene(replace(panda, jerk=dict.fromkeys(panda.acceleration, 400.0)), balls)
    bench, ruler, close = Bench(scene, avoidance=Avoidance(d1=SAFE, d2=0.1)), Ruler(scene), 0
    for _ in range(150):
        q = rng.uniform(bounds.lower + 0.3, bounds.upper - 0.3)
        before, change = rng.uniform(-0.3, 0.3, 7) * bounds.velocity, rng.uniform(-1.0, 1.0, 7) * bounds.acceleration
        bench.assembler.previous.restart(before)
        near = len(bench.compute(q, reach=0.1)[0].pair)
        v = before + 0.01 * change
        stop = bench.assembler.stop(q, v)
        velocities = stop.velocities.copy()
        bound = bench.assembler.clearance_lower_bound(v, near, float(stop.equivalent_time.sum()), stop)
        least = np.inf
        for velocity in velocities:
            least = min(least, ruler.distances(q).min())
            q = q + 0.01 * velocity
        assert min(least, ruler.distances(q).min()) - SAFE >= bound - 1e-9
        close += bound > 0.0
    assert close > 3


def test_stop_keeps_the_jerk_and_valid_input_resumes(panda):
    controller = make_controller(panda, frame="panda_hand_tcp", task={"gain": 4.0}, limits=Limits(jerk=200.0))
    q, vs, target = panda.home.copy(), [], {"panda_hand_tcp": Sample.at([0.4, 0.3, 0.6])}
    for k in range(90):
        measured = np.full(7, np.nan) if 15 <= k < 60 else q
        s = controller.step(measured, 0.01 * k, target)
        assert s.status is (Status.STOPPED if 15 <= k < 60 else Status.SOLVED)
        vs.append(s.v)
        q = q + 0.01 * s.v
    within_limits(controller, np.array(vs))
    assert np.abs(vs[14]).max() > 0.2 and np.abs(vs[59]).max() < 1e-9 and np.abs(vs[75]).max() > 0.1


def test_jerks_count_from_the_last_command_and_reset_drops_the_acceleration(panda):
    controller = make_controller(panda, frame="panda_hand_tcp", task={"gain": 50.0}, limits=Limits(jerk=200.0))
    q, target, v, change = panda.home, {"panda_hand_tcp": Sample.at([0.2, 0.6, 0.6])}, np.zeros(7), np.zeros(7)
    unit = 200.0 * 0.01**2
    for _ in range(4):
        s = controller.step(q, 0.0, target)
        assert (np.abs(s.v - v - change) <= unit + 1e-12).all()
        v, change = s.v, s.v - v
    assert np.abs(change).max() > 3.9 * unit
    found = controller.step(q, 0.0, target, v=v + 0.1).v
    assert (np.abs(found - v - change) <= unit + 1e-12).all()
    controller.reset(v)
    assert (np.abs(controller.step(q, 0.0, target).v - v) <= unit + 1e-12).all()


# --- relaxation, and settings --------------------------------------------------------------------------


PASSED = ReasonKind.ACCELERATION_RELAXED, ReasonKind.JERK_RELAXED


@pytest.mark.parametrize("relaxes", [True, False])
def test_jerk_is_relaxed_with_the_acceleration_or_never(tmp_path, relaxes):
    """A ball that comes straight at the tool at 2 m/s from 60 mm off: contact cannot be avoided within the limits."""
    robot = cartesian(tmp_path, speed=5.0, acceleration=4.0)
    limits = Limits(jerk=40.0, relax_acceleration=relaxes)
    ball = Obstacle.at("ball", Sphere(radius=0.1), [9.0, 0.0, 0.0])
    controller = make_controller(robot, [ball], "z", limits=limits)
    seen = {"ball": Sample.at([0.21, 0.0, 0.0], linear=[-6.0, 0.0, 0.0])}
    tick = controller.tick(np.zeros(3), 0.0, {"z": Sample.at([0.0, 0.0, 0.0])}, seen)
    assert tick.problem.jerk_limited and tick.solution.status is Status.RELAXED
    step = np.abs(tick.solution.v).max()
    if relaxes:
        assert step > 4.0 * 0.01
        (reason,) = [reason for reason in tick.solution.reasons if reason.kind is ReasonKind.JERK_RELAXED]
        assert reason.subject == ("joint_x",) and reason.unit == "m/s"
        assert reason.amount == pytest.approx(step - 40.0 * 0.01**2, abs=1e-6)
    else:
        assert step <= 40.0 * 0.01**2 + 1e-12
        assert not any(reason.kind in PASSED for reason in tick.solution.reasons)


def test_scenario_jerk_limit_applies_to_joints_without_one(tmp_path):
    cartesian(tmp_path)
    body = {"name": "tool", "frame": "z", "shape": {"type": "sphere", "radius": 0.05}}
    limits = {"acceleration": {"joint_x": 2.0, "joint_y": 3.0}, "jerk": {"joint_x": 30.0}}
    robot = Robot.from_urdf(tmp_path / "cartesian.urdf", bodies=[body], limits=limits)
    np.testing.assert_array_equal(robot.bounds().jerk, [30.0, np.inf, np.inf])
    found = robot.bounds().within(Limits(acceleration=5.0, jerk=70.0))
    np.testing.assert_array_equal(found.jerk, [30.0, 70.0, 70.0])
    np.testing.assert_array_equal(robot.bounds().within(Limits()).jerk, [30.0, np.inf, np.inf])
    make_controller(robot, frame="z")
    with pytest.raises(ConfigError, match=r"limits\.jerk: 1 of 3 coordinates have no acc.*give limits\.acceleration"):
        make_controller(robot, frame="z", limits=Limits(jerk=70.0))


def test_limits_take_patterns_where_names_come_first(tmp_path):
    cartesian(tmp_path)
    body = {"name": "tool", "frame": "z", "shape": {"type": "sphere", "radius": 0.05}}
    limits = {"acceleration": {"joint_x": 2.0, "*": 3.0, "joint_?": 4.0}, "jerk": {"*": 30.0}, "torque": {"*y": 7.0}}
    robot = Robot.from_urdf(tmp_path / "cartesian.urdf", bodies=[body], limits=limits)
    np.testing.assert_array_equal(robot.bounds().acceleration, [2.0, 4.0, 4.0])
    np.testing.assert_array_equal(robot.bounds().jerk, [30.0, 30.0, 30.0])
    assert robot.torque == {"joint_y": 7.0}
    with pytest.raises(UnknownName, match=r"limits\.velocity: no joint 'arm\*'"):
        Robot.from_urdf(tmp_path / "cartesian.urdf", bodies=[body], limits={"velocity": {"arm*": 1.0}})


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"jerk": {"joint_x": 30.0}}, "jerk of 'joint_x': needs a limit under `acceleration`, too"),
        ({"acceleration": {"joint_x": 3.0}, "jerk": {"joint_x": -1.0}}, "greater than 0"),
        ({"acceleration": {"joint_q": 3.0}, "jerk": {"joint_q": 9.0}}, "joint_q"),
    ],
)
def test_invalid_jerk_limits_name_the_field(tmp_path, limits, said):
    cartesian(tmp_path)
    with pytest.raises(ConfigError, match=said):
        Robot.from_urdf(tmp_path / "cartesian.urdf", bodies="convex", limits=limits)
