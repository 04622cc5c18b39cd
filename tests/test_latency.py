"""Actuators that follow late: commands under way are counted, and a measured velocity does no harm."""

from collections import deque

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import cartesian, make_controller
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from qpavoid import (
    Avoidance,
    ConfigError,
    Controller,
    NumericalError,
    Obstacle,
    Pose,
    Sample,
    Status,
    build_scene,
    build_tasks,
    load_scenario,
    simulate,
)  # fmt: skip
from qpavoid.config import Circle, Line, Sphere, Task
from qpavoid.control.latency import CommandsUnderWay
from qpavoid.model.trajectory import build_motion

TOOL, DT = "panda_hand_tcp", 0.01


class Servos:
    """A robot with critically damped position servos, exactly: two lags of half the time behind a moving setpoint."""

    def __init__(self, robot, lag):
        self.q, self._x = robot.home, np.array([robot.home] * 3 + [0.0 * robot.home])
        rate = 2.0 / max(lag, 1e-6)  # of q behind what it follows, of that behind the setpoint, which moves at v
        self._step = expm(DT * np.array([[-rate, rate, 0, 0], [0, -rate, rate, 0], [0, 0, 0, 1], [0, 0, 0, 0]]))

    def command(self, v):
        self._x[3] = v
        self._x = self._step @ self._x
        self.q = self._x[0].copy()


class Lagging:
    """A robot whose drives follow velocities some control periods later, and then as a first-order lag."""

    def __init__(self, robot, lag, delay=0):
        self.q, self.setpoint, self.v = robot.home.copy(), robot.home.copy(), np.zeros(robot.model.nv)
        self._commands, self._gain = deque([self.v] * delay), 1.0 - np.exp(-DT / lag) if lag else 1.0

    def command(self, v):
        self._commands.append(v)
        self.setpoint = self.setpoint + DT * self._commands.popleft()
        step = self._gain * (self.setpoint - self.q)
        self.q, self.v = self.q + step, step / DT


def circling(robot, latency=0.0, obstacles=(), gain=5.0):
    """A controller whose tool goes round at 0.2 m/s, 0.1 m from the centre."""
    motion = Circle(radius=0.1, period=np.pi, start_direction=(1.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))
    tasks = build_tasks([Task(frame=TOOL, motion=motion, gain=gain)], robot, robot.home)
    avoidance = Avoidance(d1=0.03, d2=0.1)
    return Controller(build_scene(robot, obstacles), tasks, dt=DT, avoidance=avoidance, latency=latency)


def tool_errors(controller, plant, ticks, latency=0.0, measured=None):
    """Distances of the tool from where its motion is, and the commands."""
    task, model = controller.tasks[0], controller.scene.robot.model
    data, frame, errors, commands = model.createData(), model.getFrameId(TOOL), [], []
    for k in range(ticks):
        v = controller.step(plant.q, k * DT, v=None if measured is None else measured(plant)).v
        plant.command(v)
        pin.framesForwardKinematics(model, data, plant.q)
        errors.append(np.linalg.norm(data.oMf[frame].translation - task.motion.sample((k + 1) * DT).position))
        commands.append(v)
    return np.array(errors), np.array(commands)


def test_a_measured_velocity_of_lagging_servos_changes_no_command(panda):
    with_v, without = (
        tool_errors(circling(panda), Lagging(panda, 0.05), 600, measured=measured)
        for measured in (lambda plant: plant.v, None)
    )
    np.testing.assert_array_equal(with_v[1], without[1])
    assert np.sqrt(np.mean(np.square(with_v[0]))) < 0.02


@pytest.mark.parametrize("gain", [5.0, 50.0, 1.0 / DT])
@pytest.mark.parametrize(("lag", "delay"), [(0.02, 0), (0.05, 0), (0.03, 2), (0.0, 5)])
def test_latency_makes_up_for_lag_and_delay_at_any_gain(panda, lag, delay, gain):
    """On a circle at 0.2 m/s. Without it the tool is late at small gains, and behind a delay swings at large ones: by
    80 mm at a gain of 50, 137 at 100, less than twice its radius since tasks are scaled to what joints can do.
    """
    latency = lag + delay * DT
    errors = tool_errors(circling(panda, latency, gain=gain), Lagging(panda, lag, delay), 500)[0][200:].max()
    assert errors < 1e-3
    if gain < 10.0 or delay == 5:
        late = tool_errors(circling(panda, gain=gain), Lagging(panda, lag, delay), 500)[0][200:].max()
        assert late > (0.075 if gain > 10.0 else max(1.5e-3, 2.0 * errors))


@settings(max_examples=6, deadline=None)
@given(latency=st.floats(0.001, 0.12), kind=st.sampled_from(["trajectory", "given", "bare"]))
def test_late_robot_gets_the_commands_of_a_prompt_one(panda, latency, kind):
    """The step of t with latency L is that of t + L without: targets, obstacles, predicted q, the same velocities."""
    start, velocity = np.array([0.9, 0.15, 0.55]), np.array([-0.3, 0.0, 0.0])
    line = build_motion(Line(start=tuple(start), displacement=tuple(2.0 * velocity), speed=0.3), None, None)
    commands = []
    for lag in (0.0, latency):
        ball = Obstacle("ball", Sphere(radius=0.05), line) if kind == "trajectory" else Obstacle.at(
            "ball", Sphere(radius=0.05), start
        )  # fmt: skip
        controller, plant, vs = circling(panda, lag, [ball]), Servos(panda, lag), []
        for k in range(100):
            now = k * DT + latency - lag
            seen = start + now * velocity
            given = {"ball": Sample.at(seen, linear=velocity) if kind == "given" else Pose.at(seen)}
            vs.append(controller.step(plant.q, now, obstacles=None if kind == "trajectory" else given).v)
            plant.command(vs[-1])
        commands.append(vs)
    skip = 3 if kind == "bare" else 0  # a first pose has no velocity, with which it could be moved on
    np.testing.assert_allclose(*np.array(commands)[:, skip:], rtol=0, atol=1e-2 if skip else 1e-4)


def test_given_targets_are_moved_on_at_their_velocities(panda):
    at, velocity = np.array([0.4, 0.1, 0.6]), np.array([0.1, 0.2, 0.0])
    prompt, late = circling(panda), circling(panda, 0.05)
    expected = prompt.step(panda.home, 0.0, {TOOL: Sample.at(at + 0.05 * velocity, linear=velocity)}).v
    np.testing.assert_allclose(late.step(panda.home, 0.0, {TOOL: Sample.at(at, linear=velocity)}).v, expected)
    tick = late.tick(panda.home, 0.01, {TOOL: Sample.at(at, linear=velocity)})
    np.testing.assert_allclose(tick.targets[0].position, at + 0.05 * velocity)
    assert tick.state.t == pytest.approx(0.06)


def test_refused_and_unknown_arguments_leave_the_commands_under_way_as_they_were(panda):
    """Beside a loop that is never disturbed: calls that raise, a measurement that is missing, a reset at speed."""
    loops = [(circling(panda, 0.045), Servos(panda, 0.045)) for _ in range(2)]
    for k in range(60):
        vs = []
        for i, (controller, plant) in enumerate(loops):
            if i and k % 7 == 3:
                with pytest.raises(NumericalError):
                    controller.step(plant.q[:3])
                with pytest.raises(NumericalError):
                    controller.step(plant.q, v=np.zeros(3))
            vs.append(controller.step(plant.q, k * DT).v)
            plant.command(vs[-1])
        np.testing.assert_array_equal(*vs)
    (controller, plant), q = loops[0], loops[0][1].q
    unknown = controller.tick(np.full(7, np.nan), 60 * DT)
    predicted = loops[1][0].tick(loops[1][1].q, 60 * DT)
    assert unknown.solution.status is Status.STOPPED
    np.testing.assert_allclose(unknown.state.q, predicted.state.q, atol=1e-5)
    controller.reset(np.full(7, 0.1))
    np.testing.assert_allclose(controller.tick(q, 0.0).state.q, q + 0.045 * 0.1, atol=1e-12)
    controller.reset()
    np.testing.assert_array_equal(controller.tick(q, 0.0).state.q, q)
    np.testing.assert_allclose(controller.tick(q, 9.0, v=np.full(7, 0.2)).state.q, q + 0.045 * 0.2, atol=1e-12)
    np.testing.assert_array_equal(controller.tick(q, 20.0).state.q, q)  # after a gap it stands


def test_commands_count_for_the_periods_that_they_were_held(panda):
    controller, under_way = circling(panda, 0.05), CommandsUnderWay(7, 0.05, DT)
    for k in range(10):
        v = controller.step(panda.home, k * DT).v
        under_way.add(v, 3 if k == 9 else 1)
    q = controller.tick(panda.home, 0.12).state.q  # the last one was held for three periods
    np.testing.assert_allclose(q, panda.home + under_way.displacement, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(latency=st.floats(1e-3, 0.2), seed=st.integers(0, 99))
def test_commands_under_way_are_what_servos_still_have_to_do(panda, latency, seed):
    rng, under_way, plant = np.random.default_rng(seed), CommandsUnderWay(7, latency, DT), Servos(panda, latency)
    setpoint = plant.q
    for _ in range(60):
        v = rng.normal(size=7)
        under_way.add(v)
        plant.command(v)
        setpoint = setpoint + DT * v
        np.testing.assert_allclose(under_way.displacement, setpoint - plant.q, atol=2e-5 * latency + 1e-6)
    under_way.fill(v)
    np.testing.assert_allclose(under_way.displacement, latency * v, atol=1e-12)


@pytest.mark.parametrize("wrong", [-0.01, 50.0, np.nan])
def test_a_latency_that_is_none_is_refused(tmp_path, wrong):
    with pytest.raises(ConfigError, match="latency"):
        make_controller(cartesian(tmp_path), latency=wrong)


def test_simulation_with_latency_follows_as_one_without():
    prompt = load_scenario("panda_line").model_copy(update={"duration": 1.0})
    late = simulate(prompt.model_copy(update={"latency": 0.035}))
    assert np.abs(late.q[100] - simulate(prompt).q[-1]).max() < 0.1 and late.t[0] == pytest.approx(0.035)
    assert late.metrics()["collided"] is False
