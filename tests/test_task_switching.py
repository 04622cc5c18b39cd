"""The row `task-switching` against the law that it stands for: eq. 10 with the consistent bracket."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import cartesian, drive, make_controller
from conftest import SPHERE, Bench, frames, make_layout, obstacle

from qpavoid import Avoidance, Obstacle, Robot, Sample, Status, build_scene, build_tasks, kernels
from qpavoid.config import Eq10Solver, QpSolver, Sphere, Task
from qpavoid.control.avoidance import row_form
from qpavoid.problem import AvoidanceRows, Tracking, make_problem
from qpavoid.solvers import make_solver

D1, D2 = 0.12, 0.36
NV = 7
SETTINGS = {"d1": 0.02, "d2": 0.3, "row": {"type": "task-switching"}}


def formula(d, u, d1=D1, d2=D2, retreat=0.0, cap=50.0):
    """(1 - β)(1 - α) min(u, ẋ0) + β ẋ0 of scalars, written out."""
    beta = 1.0 if d < d1 else 0.0 if d > d2 else 0.5 * (1.0 + np.cos(np.pi * (d - d1) / (d2 - d1)))
    alpha = min(((d2 - d) / d) ** 2, cap) if u < 0.0 and d < d2 else 0.0
    return (1.0 - beta) * (1.0 - alpha) * min(u, retreat) + beta * retreat


def rows(d, J, v_tracking, feedforward=0.0, own=False, **settings):
    """Memory with the bounds of rows between the robot and an obstacle, or of its `own` pairs, without limits."""
    count, fields = len(d), {"recovery_speed": settings.pop("recovery_speed", 1e3)}
    avoidance = Avoidance(d1=D1, d2=D2, row={"type": "task-switching", **settings}, **fields)
    closest = np.zeros((count, 10))
    closest[:, 0] = d
    free = np.full(J.shape[1], np.inf)
    x = make_layout(
        J.shape[1], pairs=count, obstacles=1, closest=closest, near_pairs=np.arange(count), J=J,
        v_tracking=np.array(v_tracking), feedforward=np.full(count, feedforward),
        twist_row=np.full(count, 1 if own else 0), lower=-free, upper=free,
        **row_form(avoidance),
    )  # fmt: skip
    kernels.row_bounds(kernels.pack(x), count, True)
    return x


# --- the row ------------------------------------------------------------------------------------------------------


def test_task_switching_row_by_hand():
    """d2 = 3 d1: α is 1/4 at 0.24 and 1 at 0.18, β is 1/2 at 0.24; u = -0.4 m/s, then 0.2; below d1, ξ (d1 - d)."""
    one = np.ones((1, 1))

    def bound(d, u, **settings):
        return rows(np.array([d]), one, [u], **settings).rhs[0]

    assert bound(0.24, -0.4) == pytest.approx(0.5 * 0.75 * -0.4)
    assert bound(0.24, 0.2) == pytest.approx(0.0)
    assert bound(0.24, 0.2, retreat_speed=0.1) == pytest.approx(0.1)  # parts faster than that: no more is asked
    assert bound(0.24, 0.04, retreat_speed=0.1) == pytest.approx(0.5 * 0.04 + 0.5 * 0.1)
    assert bound(0.18, -0.4) == pytest.approx(0.0)
    assert bound(D2, -0.4) == pytest.approx(-0.4)
    assert bound(0.10, -0.4) == pytest.approx(5.0 * 0.02)
    assert bound(0.10, -0.4, retreat_speed=0.3) == pytest.approx(0.3)
    assert bound(-1.0, -0.4, recovery_speed=0.2) == pytest.approx(0.2)
    half = 0.5 - 0.5 * np.cos(np.pi * 0.01 / 0.24)
    assert bound(0.13, -1.0) == pytest.approx(half * ((0.23 / 0.13) ** 2 - 1.0))  # α > 1: it is asked to part
    assert bound(0.13, -1.0, alpha_cap=1.5) == pytest.approx(half * 0.5)
    assert bound(0.13, -1.0, own=True) == pytest.approx(0.0)  # two bodies of the robot are not


def test_task_switching_row_uses_up_no_more_than_the_distance_in_a_step():
    """At 100 m/s, 0.2 m are gone in 2 ms; the row leaves the safety distance after 10 ms."""
    found = rows(np.array([0.32]), np.ones((1, 1)), [-100.0]).rhs[0]
    assert found == pytest.approx(-(0.32 - D1) / 0.01)


@pytest.mark.parametrize("seed", range(5))
def test_task_switching_row_by_its_formula(seed):
    rng = np.random.default_rng(seed)
    d, J, v_tracking = rng.uniform(D1, D2, 50), rng.normal(size=(50, NV)), rng.normal(size=NV)
    feedforward, retreat, cap = rng.normal(), rng.uniform(0.0, 0.2), rng.uniform(1.0, 50.0)
    x = rows(d, J, v_tracking, feedforward, retreat_speed=retreat, alpha_cap=cap)
    rate = np.array(
        [formula(a, u, retreat=retreat, cap=cap) for a, u in zip(d, J @ v_tracking + feedforward, strict=True)]
    )
    np.testing.assert_allclose(x.rhs, np.maximum(rate, (D1 - d) / 0.01) - feedforward, atol=1e-12)


# --- beside eq. 10 ------------------------------------------------------------------------------------------------


def test_task_switching_row_gives_the_rate_of_eq10():
    """Of all velocities with the rate of eq. 10, the QP takes one that tracks no worse, as λ goes to 0."""
    bound = better = 0
    for seed in range(500):
        rng = np.random.default_rng(seed)
        A, b, J = rng.normal(size=(3, NV)), 0.3 * rng.normal(size=3), rng.normal(size=(1, NV))
        d, retreat, cap = rng.uniform(D1, D2, 1), rng.choice([0.0, 0.1]), rng.choice([1.0, 50.0])
        v_tracking = np.linalg.pinv(A) @ b
        least = rows(d, J, v_tracking, retreat_speed=retreat, alpha_cap=cap).rhs.copy()
        pair = AvoidanceRows(np.arange(1), d, J, least, D1, D2, least - 1.0)
        problem = make_problem(Tracking(A, b, b), pair, np.full(NV, -1e3), np.full(NV, 1e3), [("hand", "fist")])
        eq10 = make_solver(Eq10Solver(damping=0.0, retreat_speed=retreat, alpha_cap=cap)).solve(problem).v
        qp = make_solver(QpSolver(regularization=1e-9)).solve(problem)
        assert qp.status is Status.SOLVED
        if J[0] @ v_tracking < least[0]:
            bound += 1
            assert J[0] @ qp.v == pytest.approx(J[0] @ eq10, abs=1e-9)
            of_eq10, of_qp = (np.linalg.norm(A @ v - b) for v in (eq10, qp.v))
            assert of_qp <= of_eq10 + 1e-9
            better += of_qp < of_eq10 - 1e-3
        else:
            np.testing.assert_allclose(qp.v, v_tracking, rtol=0, atol=1e-12)
            assert J[0] @ eq10 >= least[0] - 1e-9
    assert 200 < bound < 475 and better > 20


# --- pairs that cannot part ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "frame"), [("panda", "panda_hand_tcp"), ("ur5", "tool0")])
def test_task_switching_rows_of_own_pairs_are_feasible(name, frame):
    """Neighbouring links at random configurations, within 0.3 m of each other: ten of them are asked at once."""
    robot = Robot.load(name)
    controller = make_controller(robot, (), frame, avoidance=Avoidance(**SETTINGS))
    rng, close, bounds = np.random.default_rng(0), 0, robot.bounds()
    for _ in range(300):
        q = pin.integrate(robot.model, robot.home, rng.uniform(-0.8, 0.8, robot.model.nv))
        q[bounds.q_index] = np.clip(q[bounds.q_index], bounds.lower, bounds.upper)
        controller.reset()
        tick = controller.tick(q, 0.0, {frame: Sample.at(rng.uniform(-0.8, 0.8, 3))})
        if tick.proximity.distance.min(initial=np.inf) > 0.02:
            close += np.sum((tick.proximity.distance < 0.1) & (tick.proximity.J @ tick.problem.v_tracking < 0.0))
            assert tick.solution.status is Status.SOLVED, tick.solution.reasons
    assert close > 50


def test_task_switching_row_of_a_fixed_body_is_feasible(tmp_path):
    """A tool on one rail, along x; a ball comes along z from 0.3 m: only below the safety distance is it said."""
    robot = cartesian(tmp_path, axes="x")
    ball = Obstacle.at("ball", Sphere(radius=0.05), [0.0, 0.0, 1.0])
    controller = make_controller(robot, [ball], "x", avoidance=Avoidance(**SETTINGS, backup=False))

    def here(t):
        return {"ball": Sample.at([0.0, 0.0, 0.405 - 0.2 * t], linear=[0.0, 0.0, -0.2])}

    for tick in drive(controller, np.zeros(1), 150, target=[0.0, 0.0, 0.0], obstacles=here):
        (d, v) = tick.proximity.distance.min(initial=np.inf), tick.solution.v[0]
        # the plain damper is met as long as ξ (d - d1) covers the ball's speed
        assert (tick.solution.status is Status.SOLVED) == (5.0 * (d - 0.02) > 0.2) and v == pytest.approx(0.0)


# --- what is really tracked ---------------------------------------------------------------------------------------


def rate(scene, pair, d, u, d2=0.3):
    """The formula with SETTINGS; of pairs of the robot's own bodies with α up to 1."""
    own = scene.pairs[pair, 1] < len(scene.body_names)
    return formula(d, u, 0.02, d2, cap=1.0 if own else 50.0)


def test_task_switching_rows_of_a_filter_follow_its_command(panda):
    """u is of the command, not of any task: some commands close in and are braked, those that part are not."""
    robot = replace(panda, acceleration={})
    ball = Obstacle.at("ball", Sphere(radius=0.05), [0.45, 0.05, 0.45])
    controller = make_controller(robot, [ball], "panda_hand_tcp", avoidance=Avoidance(**SETTINGS | {"d2": 0.06}))
    rng, braked, parted = np.random.default_rng(0), 0, 0
    for _ in range(400):
        q, v = pin.integrate(robot.model, robot.home, rng.uniform(-0.5, 0.5, 7)), rng.uniform(-0.1, 0.1, 7)
        near = controller.tick(q, 0.0).proximity
        solution = controller.filter(q, v)
        if not near.distance.min(initial=np.inf) > 0.02 or solution.status is not Status.SOLVED:
            continue
        least = [rate(controller.scene, *row, 0.06) for row in zip(near.pair, near.distance, near.J @ v, strict=True)]
        assert (near.J @ solution.v >= np.array(least) - 1e-6).all()
        safe = (near.J @ v >= least).all()
        assert np.array_equal(solution.v, v) == safe
        braked, parted = braked + (not safe), parted + safe
    assert braked > 20 and parted > 0


@pytest.mark.parametrize("change", ["eased", "followed", "of a cascade"])
def test_task_switching_rows_follow_the_tracked_velocity(panda, change):
    """Whatever takes the place of v0, u is of that; the problem that it was made from stays as it was."""
    jerk = dict.fromkeys(panda.acceleration, 1e6)
    robot = replace(panda, jerk=jerk) if change == "eased" else replace(panda, acceleration={})
    scene = build_scene(robot, [obstacle("ball", SPHERE, [0.5, 0.3, 0.45])])
    hand, wrist = Task(frame="panda_hand_tcp"), Task(frame="panda_link7", priority=2)
    bench = Bench(scene, build_tasks([hand, wrist], robot, robot.home), Avoidance(**SETTINGS, recovery_speed=1e3))
    rng = np.random.default_rng(1)
    bench.assembler.previous.restart(0.1 * rng.normal(size=7))
    targets = [Sample.at([0.45, 0.4, 0.4]), Sample.at([0.3, -0.2, 0.5])]
    near, problem = bench.compute(robot.home, targets, reach=0.3)
    before, v = problem.avoidance.b.copy(), problem.v_tracking.copy()
    assert_rows(scene, near, problem, v)
    if change == "eased":
        changed = bench.assembler.within_jerks(problem)
    elif change == "followed":
        _, changed = bench.compute(robot.home, targets, reach=0.3, v_desired=0.1 * rng.normal(size=7))
    else:
        changed = bench.assembler.prioritised(problem)
        np.testing.assert_array_equal(changed.v_tracking, changed.cascade[-1])
    tracked = changed.v_tracking
    assert np.abs(tracked - v).max() > 0.01 and np.abs(changed.avoidance.b - before).max() > 0.01
    assert_rows(scene, near, changed, tracked)
    if change != "followed":  # which takes the tasks' place for good
        np.testing.assert_array_equal(problem.avoidance.b, before)
        np.testing.assert_array_equal(problem.v_tracking, v)


def assert_rows(scene, near, problem, v):
    """Rows by the formula, or by what accelerations leave room for, where there are some."""
    expected = np.array([rate(scene, *row) for row in zip(near.pair, near.distance, near.J @ v, strict=True)])
    most = np.maximum(near.J * problem.lower, near.J * problem.upper).sum(axis=1)
    by_formula = np.abs(problem.avoidance.b - np.minimum(expected, most)) < 1e-10
    assert len(expected) > 5 and np.sum(by_formula & (expected < 0.0)) >= 2
    assert by_formula.all() or (np.isfinite(problem.v_stop).all() and scene.robot.acceleration)


def test_task_switching_rows_of_repeated_tasks(panda):
    """The same task twice: J⁺ẋ is that of the pseudo-inverse, and rows are bounded by it."""
    robot = replace(panda, acceleration={})
    scene = build_scene(robot, [obstacle("ball", SPHERE, [0.5, 0.3, 0.45])])
    tasks = build_tasks([Task(frame="panda_hand_tcp"), Task(frame="panda_hand_tcp", name="again")], robot, robot.home)
    (tool,) = frames(robot, ["panda_hand_tcp"], robot.home)
    near, problem = Bench(scene, tasks, Avoidance(**SETTINGS, recovery_speed=1e3)).compute(
        robot.home, [Sample.at(tool.translation + np.array([0.03, 0.05, -0.03]))] * 2, reach=0.3
    )
    expected = np.linalg.pinv(problem.tracking.A, rcond=1e-9) @ problem.tracking.b
    np.testing.assert_allclose(problem.v_tracking, expected, rtol=0, atol=1e-12)
    assert_rows(scene, near, problem, expected)
