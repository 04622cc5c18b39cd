"""The safety filter: any command comes back unchanged where it is safe, else the closest velocity that is."""

import numpy as np
import pytest
import qpsolvers
from closed_loop import cartesian, make_controller

from qpavoid import Avoidance, Controller, NumericalError, Obstacle, Status, build_scene
from qpavoid.config import Box, Sphere


@pytest.fixture
def filtering(panda):
    """No tasks at all."""
    boxes = [Obstacle.at("shelf", Box(size=(0.4, 0.8, 0.02)), [0.5, 0.0, 0.35])]
    balls = [Obstacle.at(f"ball{i}", Sphere(radius=0.06), p) for i, p in enumerate([[0.5, 0.2, 0.6], [0.3, -0.3, 0.6]])]
    return Controller(build_scene(panda, boxes + balls), [], "qp", 0.01, Avoidance(d1=0.02, d2=0.15))


@pytest.mark.parametrize("seed", range(2))
def test_filter_returns_a_safe_command_bit_for_bit(panda, seed):
    """Nothing near, within the joints' speeds and accelerations: also zeros, and what rounding would change."""
    controller = Controller(build_scene(panda), [], "qp", 0.01, Avoidance(d1=0.005, d2=0.01))
    rng, bounds = np.random.default_rng(seed), panda.bounds()
    q, v = panda.home, np.zeros(7)
    for _ in range(100):
        command = v + rng.uniform(-1.0, 1.0, 7) * 0.0099 * bounds.acceleration
        command = np.clip(command, -0.3, 0.3) * rng.choice([0.0, -0.0, 1.0], 7)
        if (np.abs(command - v) > 0.01 * bounds.acceleration).any():
            command = v.copy()
        s = controller.filter(q, command)
        assert s.v.tobytes() == command.tobytes() and s.v is not command
        assert s.status is Status.SOLVED and s.command_scale == 1.0 and s.reasons == ()
        q, v = q + 0.01 * s.v, s.v


@pytest.mark.parametrize("solver", ["qp", "qp:daqp"])
def test_filter_returns_the_closest_velocity_within_rows_and_bounds(panda, filtering, solver):
    """min |v - command| by a QP of our own on the same rows; commands from a robot that is already moving."""
    controller = make_controller(
        panda, filtering.scene.obstacles, solver=solver, avoidance=Avoidance(d1=0.02, d2=0.15, look_ahead=False)
    )
    rng, changed = np.random.default_rng(1), 0
    q, v = panda.home, np.zeros(7)
    for k in range(300):
        if k % 25 == 0:
            q, v = panda.home + rng.uniform(-0.3, 0.3, 7), np.zeros(7)
            controller.reset()
        command = rng.uniform(-2.0, 2.0, 7)
        rows = rows_at(controller, q, v)
        expected = qpsolvers.solve_qp(
            np.eye(7), -command, -rows.avoidance.J, -rows.avoidance.b, lb=rows.lower, ub=rows.upper, solver="quadprog"
        )
        s = controller.filter(q, command)
        if expected is not None and rows.avoidance.d.min(initial=1.0) > 0.019:  # recovery is slow
            np.testing.assert_allclose(s.v, expected, atol=1e-6)
            changed += bool(len(rows.avoidance.d))
        q, v = q + 0.01 * s.v, s.v
    assert changed > 150


def rows_at(controller, q, v):
    """The problem of the tick that comes, without taking it."""
    problem = controller.tick(q, v=v).problem
    controller.reset(v)
    return problem


def test_filter_slides_along_a_wall(tmp_path):
    robot = cartesian(tmp_path)
    controller = make_controller(robot, [Obstacle.at("wall", Box(size=(0.1, 2, 2)), [0.55, 0, 0])])
    q = np.zeros(3)
    for _ in range(300):
        v = controller.filter(q, np.array([5.0, 0.1, 0.0])).v
        q = q + 0.01 * v
    assert 0.0199 < 0.5 - 0.05 - q[0] < 0.05
    assert v[1] == pytest.approx(0.1)  # along the wall it is the operator's


def test_filter_ignores_tasks(panda):
    free = make_controller(panda)
    bound = make_controller(panda, frame="panda_hand_tcp")
    command = np.full(7, 0.05)
    np.testing.assert_array_equal(bound.filter(panda.home, command).v, command)
    np.testing.assert_array_equal(free.filter(panda.home, command).v, command)
    free.reset()
    assert not free.step(panda.home).v.any()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_filter_stops_at_an_implausible_command(panda, filtering, value):
    moving = np.full(7, 0.2)
    filtering.reset(moving)
    bad = np.zeros(7)
    bad[4] = value
    s = filtering.filter(panda.home, bad)
    assert s.status is Status.STOPPED and s.reasons[0].key == ("IMPLAUSIBLE", ("v_desired",))
    np.testing.assert_allclose(s.v, (1.0 - 0.075 / 0.2) * moving)
    again = filtering.filter(panda.home, s.v)
    np.testing.assert_array_equal(again.v, s.v)


@pytest.mark.parametrize("command", [np.zeros(6), np.zeros((7, 1)), "left", None])
def test_filter_names_a_malformed_command(panda, filtering, command):
    with pytest.raises(NumericalError, match=r"^v_desired: "):
        filtering.filter(panda.home, command)
