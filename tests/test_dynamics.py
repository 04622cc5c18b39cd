"""The torque level of a fixed base: torques are those of pinocchio, within their limits, and the QP is the same one."""

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from pydantic import ValidationError

from qpavoid import (
    Avoidance,
    ConfigError,
    Controller,
    NumericalError,
    Obstacle,
    ReasonKind,
    Robot,
    Sample,
    Status,
    UnknownName,
    build_scene,
    build_tasks,
)
from qpavoid.config import Beta, Dynamics, Limits, PostureTask, Sphere, Task

TOOL, DT = "panda_hand_tcp", 1e-3
ARMATURE = 0.1
LIMITS = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
BALL = Obstacle.at("ball", Sphere(radius=0.06), [0.5, 0.1, 0.5])


def make(robot, solver="qp", dynamics=None, obstacles=(BALL,), dt=DT, limits=None, **avoidance):
    priorities = {"priority": 1} if solver == "hqp" else {}
    tasks = build_tasks(
        [Task(frame=TOOL, type="pose", gain=4.0), PostureTask(weight=1e-3, **priorities)], robot, robot.home
    )
    block = Avoidance(**{"d1": 0.03, "d2": 0.15, "row": Beta(near_speed=10.0), **avoidance})
    return Controller(build_scene(robot, obstacles), tasks, solver, dt, block, limits, dynamics=dynamics)


def states(robot, rng, count):
    """Configurations around home, velocities, and targets around the tool."""
    for _ in range(count):
        q = robot.home + rng.uniform(-0.3, 0.3, 7)
        target = Sample.at(rng.uniform([0.3, -0.4, 0.2], [0.7, 0.4, 0.8]), np.diag([1.0, -1.0, -1.0]))
        yield q, rng.uniform(-0.5, 0.5, 7), {TOOL: target}


@pytest.fixture(scope="module")
def robot():
    return Robot.load("panda")


@pytest.fixture(scope="module")
def model(robot):
    model = robot.model.copy()
    model.armature = np.full(7, ARMATURE)
    return model


@pytest.mark.parametrize("solver", ["qp", "qp:daqp", "qp:proxqp", "hqp", "eq10", "tracking", "potential-field"])
def test_torques_are_inverse_dynamics_and_within_their_limits(robot, model, solver):
    """Of every law, solved or not; a law that knows no limits is cut at them."""
    controller, data = make(robot, solver, Dynamics(armature=ARMATURE)), model.createData()
    solved = 0
    for q, v, targets in states(robot, np.random.default_rng(0), 40):
        controller.reset()
        solution = controller.step(q, targets=targets, v=v)
        torque, a = solution.torque, solution.acceleration
        np.testing.assert_allclose(torque, pin.rnea(model, data, q, v, a), atol=1e-9)
        np.testing.assert_allclose(solution.v, v + DT * a, atol=1e-12)
        assert (np.abs(torque) <= LIMITS + 1e-9).all()
        solved += solution.status is Status.SOLVED
    assert solved > 10 or not controller.solver.bounded


@pytest.mark.parametrize("solver", ["qp", "qp:daqp", "hqp"])
def test_limits_of_torque_hold_where_they_bind(robot, solver):
    """Some joint is at its torque limit in nearly every step, and the QP knows of it."""
    controller = make(robot, solver, Dynamics(armature=ARMATURE, torque_limits=0.5, tracking_rate=1000.0))
    binding = 0
    for q, v, targets in states(robot, np.random.default_rng(1), 40):
        controller.reset()
        solution = controller.step(q, targets=targets, v=v)
        assert (np.abs(solution.torque) <= 0.5 * LIMITS + 1e-9).all()
        if solution.status is Status.SOLVED:
            binding += bool((np.abs(solution.torque) > 0.499 * LIMITS).any())
        else:
            assert solution.reasons
    assert binding > 5


def play(controller, robot, steps, dynamics):
    """Follow velocities exactly; return them."""
    q, v, commands = robot.home.copy(), np.zeros(7), []
    for k in range(steps):
        target = Sample.at([0.5, 0.3 * np.sin(4.0 * k * controller.dt), 0.35], np.diag([1.0, -1.0, -1.0]))
        ball = {"ball": Sample.at([0.5, 0.25 - 0.3 * k * controller.dt, 0.4], linear=[0.0, -0.3, 0.0])}
        v = controller.step(q, targets={TOOL: target}, obstacles=ball, v=v if dynamics else None).v
        q = pin.integrate(robot.model, q, controller.dt * v)
        commands.append(v)
    return np.array(commands)


@pytest.mark.parametrize(
    ("solver", "jerk", "acceleration"),
    [("qp", None, None), ("qp:daqp", None, None), ("hqp", None, None), ("eq10", None, None),
     ("qp", 3000.0, None), ("qp", None, 0.0)],
)  # fmt: skip
def test_without_torque_limits_at_full_rates_it_is_the_velocity_level(robot, solver, jerk, acceleration):
    if acceleration == 0.0:
        robot = dataclasses.replace(robot, acceleration={})
    free, dt = Dynamics(torque_limits=None, tracking_rate=100.0, row_rate=100.0), 0.01
    velocities = [
        play(make(robot, solver, dynamics, dt=dt, limits=Limits(jerk=jerk)), robot, 150, dynamics)
        for dynamics in (None, free)
    ]
    np.testing.assert_allclose(velocities[0], velocities[1], atol=1e-9)
    assert np.abs(velocities[0]).max() > 0.5


def test_every_acceleration_that_braking_counts_on_is_within_the_torques(robot, model):
    """The box of s times the joints' accelerations, at its corners, needs no more than the share of the torques."""
    controller, data = make(robot, dynamics=Dynamics(armature=ARMATURE)), model.createData()
    rng = np.random.default_rng(2)
    reference = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
    for q, v, _ in states(robot, rng, 20):
        controller.reset(v)
        problem = controller.rows(q, v=v)
        (v_stop, dynamics), room = (problem.v_stop, problem.dynamics), 0.75 * LIMITS
        scale = min(1.0, ((room - np.abs(dynamics.h)) / (np.abs(dynamics.M) @ reference)).min())
        for _ in range(20):
            a = scale * reference * rng.choice([-1.0, 1.0], 7)
            assert (np.abs(pin.rnea(model, data, q, v, a)) <= room + 1e-9).all()
        assert (np.abs(dynamics.torque(v_stop)) <= LIMITS).all()
        assert (dynamics.J @ v_stop >= dynamics.b - 1e-9)[: dynamics.torque_rows].all()


def test_rows_of_holding_are_the_slope_of_gravity(robot, model):
    controller, data = make(robot, dynamics=Dynamics(armature=ARMATURE, row_rate=1000.0)), model.createData()
    q, v, h = robot.home, np.zeros(7), 1e-6

    def gravity(q):
        return pin.computeGeneralizedGravity(model, data, q).copy()

    dynamics = controller.rows(q, v=v).dynamics
    slope = np.array([gravity(q + h * e) - gravity(q - h * e) for e in np.eye(7)]).T / (2.0 * h)
    J, b = dynamics.J[dynamics.torque_rows :], dynamics.b[dynamics.torque_rows :]
    np.testing.assert_allclose(J[1::2], slope / LIMITS[:, None], atol=1e-7)
    np.testing.assert_allclose(J[::2], -J[1::2], atol=1e-12)
    np.testing.assert_allclose(b[::2], -5.0 * (0.6 - gravity(q) / LIMITS), atol=1e-9)
    np.testing.assert_allclose(b[1::2], -5.0 * (0.6 + gravity(q) / LIMITS), atol=1e-9)


@pytest.mark.parametrize("solver", ["qp", "qp:daqp", "hqp", "eq10"])
def test_starved_of_torque_it_says_so_with_finite_torques(robot, solver):
    """A robot that cannot hold its arm: no step is SOLVED, joints are named, torques stay within what there is."""
    controller = make(robot, solver, Dynamics(armature=ARMATURE, torque_limits=0.1))
    q, v, kinds = robot.home.copy(), np.zeros(7), set()
    for _ in range(60):
        solution = controller.step(q, v=v, targets={TOOL: np.array([0.5, 0.3, 0.6])})
        assert solution.status is not Status.SOLVED
        assert (np.abs(solution.torque) <= 0.1 * LIMITS + 1e-9).all()
        kinds |= {reason.kind for reason in solution.reasons}
        v = solution.v
        q = pin.integrate(robot.model, q, DT * v)
    assert kinds & {ReasonKind.TORQUE_SATURATED, ReasonKind.AT_TORQUE_LIMIT, ReasonKind.HOLDING_RELAXED}


def test_commands_come_back_where_torques_allow_them(robot):
    """A velocity of a QP of one's own is taken as it is; one that is filtered is approached at the tracking rate."""
    controller = make(robot, dynamics=Dynamics(armature=ARMATURE), obstacles=())
    v, wanted = np.full(7, 0.1), np.full(7, 0.101)
    controller.rows(robot.home, v=v)
    assert np.array_equal(controller.command(wanted).v, wanted)
    controller.reset()
    np.testing.assert_allclose(controller.filter(robot.home, wanted, v=v).v, v + 0.1 * (wanted - v), atol=1e-15)


def test_measured_velocity_is_required(robot):
    controller = make(robot, dynamics=Dynamics())
    with pytest.raises(NumericalError, match="v: with `dynamics`, a step needs the velocity"):
        controller.step(robot.home)
    unknown = controller.step(robot.home, v=np.full(7, np.nan))
    assert unknown.status is Status.STOPPED
    assert np.isfinite(unknown.torque).all()


def test_settings_that_cannot_be_meant_are_refused(robot):
    with pytest.raises(ValidationError, match="must be below braking_fraction"):
        Dynamics(holding_fraction=0.8)
    with pytest.raises(ConfigError, match="row_rate: 10 1/s is below 4 times"):
        make(robot, dynamics=Dynamics(row_rate=10.0))
    with pytest.raises(ConfigError, match="not together with `latency`"):
        Controller(build_scene(robot), [], dynamics=Dynamics(), latency=0.01)
    with pytest.raises(UnknownName, match="armature: no joint"):
        make(robot, dynamics=Dynamics(armature={"panda_joint11": 0.1}))
    g1 = Robot.load("g1")
    with pytest.raises(ConfigError, match="floats stands on `contacts`"):
        Controller(build_scene(g1), [], dynamics=Dynamics())
    bare = dataclasses.replace(robot, model=robot.model.copy())
    bare.model.effortLimit = np.append(np.zeros(1), LIMITS[1:])
    with pytest.raises(ConfigError, match="no torque limit of panda_joint1"):
        make(bare, dynamics=Dynamics())
    given = dataclasses.replace(bare, torque={"panda_joint1": 50.0})
    solution = make(given, dynamics=Dynamics(torque_limits=0.5)).step(robot.home, v=np.zeros(7))
    assert solution.status is Status.SOLVED


def test_clone_has_the_dynamics(robot):
    controller = make(robot, dynamics=Dynamics(armature=ARMATURE))
    steps = [c.step(robot.home, v=np.full(7, 0.1)) for c in (controller, controller.clone())]
    np.testing.assert_array_equal(steps[0].torque, steps[1].torque)
