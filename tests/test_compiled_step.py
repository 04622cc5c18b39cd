"""A control step of `qp` in one compiled call is what the same law gives step by step, as one of a user's own."""

import numpy as np
import pinocchio as pin
import pytest
from conftest import SPHERE, frames, obstacle

from qpavoid import Avoidance, Controller, Pose, Sample, build_scene, build_tasks
from qpavoid.config import QpSolver, Task
from qpavoid.solvers.qp import Qp

STEPS, DT = 250, 0.01
TOOL = "panda_hand_tcp"


class Own(Qp):
    """The same law as one of a user's own, which sees the problem of every step."""

    def __init__(self):
        super().__init__(QpSolver())
        self.calls = self.bound = 0

    def solve(self, problem):
        self.calls += 1
        self.bound += problem.violation > 0.0
        return super().solve(problem)


def controllers(robot, avoidance):
    """Two of the same scene and tasks: compiled, and with a law of one's own."""
    (home,) = frames(robot, [TOOL], robot.home)
    places = [(0.0, 0.2, -0.05), (-0.05, -0.25, 0.1)]
    balls = [obstacle(f"ball{i}", SPHERE, home.translation + place) for i, place in enumerate(places)]
    scene = build_scene(robot, balls)
    tasks = build_tasks([Task(frame=TOOL)], robot, robot.home)
    return [Controller(scene, tasks, law, DT, avoidance) for law in ("qp", Own())]


def target(robot, k):
    """A target that circles through both balls."""
    (home,) = frames(robot, [TOOL], robot.home)
    angle = 2.0 * np.pi * k / STEPS
    offset = 0.35 * np.array([0.3 * np.cos(3.0 * angle) - 0.3, np.sin(angle), -0.3 * np.sin(2.0 * angle)])
    return Sample.at(home.translation + offset, home.rotation)


def assert_same(one, other):
    np.testing.assert_allclose(one.v, other.v, rtol=0, atol=1e-12)
    assert (one.status, one.reasons, one.stalled, one.assumptions) == (
        other.status, other.reasons, other.stalled, other.assumptions,
    )  # fmt: skip
    assert one.command_scale == pytest.approx(other.command_scale, abs=1e-9)


@pytest.mark.parametrize("avoidance", [Avoidance(), Avoidance(look_ahead=False), Avoidance(d1=0.12, d2=0.25)])
def test_steps_are_those_of_the_law(panda, avoidance):
    """Where rows bind, where they contradict each other, and where the robot begins too near."""
    one, other = controllers(panda, avoidance)
    q, law = panda.home.copy(), other.solver
    calls, bound = law.calls, law.bound
    for k in range(STEPS):
        targets = {TOOL: target(panda, k)}
        solution = one.step(q, targets=targets)
        assert_same(solution, other.step(q, targets=targets))
        q = pin.integrate(panda.model, q, DT * solution.v)
    assert law.calls - calls == STEPS and law.bound - bound > 20


def test_filtered_commands_are_those_of_the_law(panda):
    """Safe ones come back bit for bit."""
    one, other = controllers(panda, Avoidance())
    q, rng, same = panda.home.copy(), np.random.default_rng(5), 0
    for k in range(STEPS):
        if k % 25 == 0:
            wish = rng.uniform(-0.6, 0.6, panda.model.nv)
        solution = one.filter(q, wish)
        assert_same(solution, other.filter(q, wish))
        same += np.array_equal(solution.v, wish)
        q = pin.integrate(panda.model, q, DT * solution.v)
    assert 0 < same < STEPS


def test_a_tick_has_the_problem_that_was_solved(panda):
    """It is laid out for those who look, and its v_tracking and rows are those of the solution."""
    one, _ = controllers(panda, Avoidance())
    q = panda.home.copy()
    for k in range(60):
        tick = one.tick(q, targets={TOOL: target(panda, k)})
        rows, v = tick.problem.avoidance, tick.solution.v
        assert tick.solution.reasons or (rows.J @ v >= rows.b - 1e-6).all()
        assert (v >= tick.problem.lower - 1e-9).all() and (v <= tick.problem.upper + 1e-9).all()
        q = pin.integrate(panda.model, q, DT * v)


def test_plain_arguments_take_a_shorter_way_to_the_same_step(panda):
    """Lists and numbers of another type are read one by one, arrays and floats in one call: bit for bit the same.

    With an obstacle that is given, NaN, rotations to be normalised, a measured velocity and a gap in time among them.
    """
    one, other = controllers(panda, Avoidance())[0], controllers(panda, Avoidance())[0]
    q, v, t = panda.home.copy(), np.zeros(panda.model.nv), 0.0
    for k in range(STEPS):
        t += 2.0 if k == 180 else DT
        given = q.copy()
        given[3] = np.nan if k == 60 else given[3]
        goal = target(panda, k)
        if k == 90:
            goal = Sample.at(goal.position, np.round(goal.rotation + 3e-4, 4))
        balls = {"ball1": Pose.at([0.3, -0.4 + 0.002 * k, 0.5])} if k > 120 else None
        measured = v if k % 3 == 0 else None
        short = one.step(given, t, {TOOL: goal}, balls, measured)
        long = other.step(list(given), np.float64(t), {TOOL: goal}, balls, None if measured is None else list(v))
        np.testing.assert_array_equal(short.v, long.v)
        assert_same(short, long)
        q, v = pin.integrate(panda.model, q, short.v * DT), short.v
