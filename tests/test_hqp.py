"""Strict priorities against the closed form where nothing binds, and against plain cascades of QPs elsewhere."""

import numpy as np
import pinocchio as pin
import pytest
import qpsolvers
from conftest import SPHERE, obstacle

from qpavoid import Controller, ReasonKind, Robot, Severity, build_scene, build_tasks, config
from qpavoid.config import HqpSolver
from qpavoid.problem import AvoidanceRows, Status, Tracking, make_problem
from qpavoid.solvers import backend_names, make_solver
from qpavoid.solvers.backends import solve_daqp
from qpavoid.solvers.hqp import Hqp

NV = 9
SMALL = 1e-7
BACKENDS = ["auto", *[name for name in ("daqp", "proxqp", "quadprog") if name in backend_names()]]


def random_problem(seed, sizes=(3, 3, 4), bound=10.0, k=0, low=-0.5, touch=-5.0):
    """Levels of random rows; the second one repeats a row of the first, at another right-hand side."""
    rng = np.random.default_rng(seed)
    A, b = rng.normal(size=(sum(sizes), NV)), rng.normal(size=sum(sizes))
    A[sizes[0]] = A[0]
    rows = AvoidanceRows(
        np.arange(k), np.linspace(0.02, 0.05, k), rng.normal(size=(k, NV)), low + rng.uniform(0.0, 0.8, k), 0.03, 0.1,
        np.full(k, touch),
    )  # fmt: skip
    ends = np.cumsum(sizes)
    levels = tuple(np.arange(end - size, end) for size, end in zip(sizes, ends, strict=True))
    limits = np.full(NV, bound)
    problem = make_problem(Tracking(A, b, b), rows, -limits, limits, [(f"a{i}", f"b{i}") for i in range(k)])
    return problem._replace(levels=levels)


def costs(problem, v):
    """Residual of each level."""
    A, b, _ = problem.tracking
    return np.array([np.linalg.norm(A[rows] @ v - b[rows]) for rows in problem.levels])


@pytest.mark.parametrize("seed", range(4))
def test_hqp_without_active_rows_is_the_null_space_cascade(seed):
    """v += (A_p N)⁺ (b_p - A_p v), N the projector on what levels before leave free (Siciliano and Slotine 1991)."""
    problem = random_problem(seed, bound=1e3)
    v, stacked = np.zeros(NV), np.zeros((0, NV))
    for rows in problem.levels:
        A, b = problem.tracking.A[rows], problem.tracking.b[rows]
        N = np.eye(NV) - np.linalg.pinv(stacked, rcond=1e-9) @ stacked if len(stacked) else np.eye(NV)
        v = v + np.linalg.pinv(A @ N, rcond=1e-9) @ (b - A @ v)
        stacked = np.concatenate((stacked, A))
    solution = make_solver("hqp").solve(problem)
    assert solution.status is Status.SOLVED
    np.testing.assert_allclose(solution.v, v, atol=1e-9)
    assert costs(problem, v)[0] < 1e-9 < costs(problem, v)[1]  # the row that repeats another one cannot be met


def cascade(problem):
    """Lexicographic optimum by QPs in all of v, each level before kept by equalities; None where daqp fails."""
    rows = problem.avoidance
    E, e, v = np.zeros((0, NV)), np.zeros(0), np.zeros(NV)
    for level in problem.levels:
        A, b = problem.tracking.A[level], problem.tracking.b[level]
        held = (E, e) if len(e) else ()
        P = A.T @ A + SMALL * np.eye(NV)
        qp = qpsolvers.Problem(P, -A.T @ b, -rows.J, -rows.b, *held, lb=problem.lower, ub=problem.upper)
        v = qpsolvers.solve_problem(qp, solver="daqp").x
        if v is None:
            return None
        E, e = np.concatenate((E, A)), np.concatenate((e, A @ v))
    return v


@pytest.mark.parametrize("backend", BACKENDS)
def test_hqp_with_active_rows_and_bounds_is_the_lexicographic_optimum(backend):
    """Every level is as good as in the plain cascade, and no better: the levels before it would have had to give."""
    solver, binding, later = Hqp(HqpSolver(backend=backend, regularization=SMALL)), 0, 0
    for seed in range(30):
        problem = random_problem(seed, bound=0.6, k=4, low=-0.6)
        solution = solver.solve(problem)
        if solution.status is not Status.SOLVED:
            continue
        v, rows = solution.v, problem.avoidance
        assert (np.abs(v) <= 0.6 + 1e-9).all() and (rows.J @ v >= rows.b - 1e-6).all()
        reference = cascade(problem)
        if reference is None:
            continue
        found = costs(problem, v)
        np.testing.assert_allclose(found, costs(problem, reference), atol=2e-5)
        binding += found[0] > 1e-3
        later += found[2] > 1e-3
    assert binding >= 3 and later >= 6


def _rows(solution):
    """Its reasons about pairs."""
    kinds = ReasonKind.ROW_RELAXED, ReasonKind.BELOW_SAFETY_DISTANCE
    return [
        reason for reason in solution.reasons if reason.kind in kinds and (reason.unit == "m" or reason.amount > 3e-3)
    ]


def test_contradicting_rows_relax_as_those_of_the_qp():
    """The same pairs by the same amounts; tasks then keep their order within what is left."""
    relaxed = 0
    for seed in range(15):
        problem = random_problem(seed, bound=0.3, k=8, low=0.0)
        found, expected = make_solver("hqp").solve(problem), make_solver("qp").solve(problem)
        assert found.status is expected.status
        if found.status is Status.RELAXED:
            relaxed += 1
            np.testing.assert_allclose(found.slack, expected.slack, atol=3e-3)
            for got, wanted in zip(_rows(found), _rows(expected), strict=True):
                assert (got.kind, got.subject, got.unit) == (wanted.kind, wanted.subject, wanted.unit)
                assert got.amount == pytest.approx(wanted.amount, abs=3e-3)
            assert (np.abs(found.v) <= 0.3 + 1e-9).all()
    assert relaxed >= 5


def test_an_unsolved_level_is_named_and_keeps_the_levels_before(monkeypatch):
    problem = random_problem(0, bound=0.6, k=3)
    expected = Hqp(HqpSolver(regularization=SMALL)).solve(problem._replace(levels=problem.levels[:1]))
    calls = []

    def fails_at_the_second(*args):
        calls.append(args)
        return None if len(calls) == 2 else solve_daqp(*args)

    monkeypatch.setattr("qpavoid.solvers.qp.make_backend", lambda name: fails_at_the_second)
    solution = Hqp(HqpSolver(regularization=SMALL)).solve(problem)
    assert solution.status is Status.RELAXED
    (reason,) = solution.reasons
    assert (reason.kind, reason.subject) == (ReasonKind.PRIORITY_UNSOLVED, ("priority level 2",))
    assert costs(problem, solution.v)[0] == pytest.approx(costs(problem, expected.v)[0], abs=1e-5)


def test_hqp_stops_at_nan():
    problem = random_problem(0, k=2)
    J = problem.avoidance.J.copy()
    J[1, 0] = np.nan
    bad = problem._replace(avoidance=problem.avoidance._replace(J=J), violation=np.nan)
    solution = make_solver("hqp").solve(bad)
    (reason,) = solution.reasons
    assert solution.status is Status.STOPPED and reason.severity is Severity.ALARM
    assert (reason.kind, reason.subject) == (ReasonKind.UNKNOWN_DISTANCE, ("a1", "b1"))
    b = problem.tracking.b.copy()
    b[0] = np.nan
    assert np.isfinite(make_solver("hqp").solve(problem._replace(tracking=problem.tracking._replace(b=b))).v).all()


def test_one_safe_level_is_the_tracking_velocity_bit_for_bit():
    problem = random_problem(1, bound=100.0)._replace(levels=())
    solution = make_solver("hqp").solve(problem)
    np.testing.assert_array_equal(solution.v, problem.v_tracking)


# On a robot


def panda_controller(panda, solver, tool=1, posture=2, **settings):
    tasks = [
        config.Task(frame="panda_hand_tcp", type="position", priority=tool, gain=5.0),
        config.PostureTask(priority=posture, q={"panda_joint4": -1.2}),
    ]
    ball = obstacle("ball", SPHERE, (0.55, 0.2, 0.55))
    return Controller(build_scene(panda, [ball]), build_tasks(tasks, panda, panda.home), solver, dt=0.01, **settings)


@pytest.mark.parametrize("order", [(1, 2), (2, 1)])
def test_the_order_of_priorities_is_that_of_the_file(panda, order):
    controller = panda_controller(panda, "hqp", *order)
    q = pin.integrate(panda.model, panda.home, 0.1 * np.ones(7))
    problem = controller.tick(q).problem
    assert [len(rows) for rows in problem.levels] == ([3, 7] if order == (1, 2) else [7, 3])
    free = np.full(7, np.inf)
    v = make_solver("hqp").solve(problem._replace(lower=-free, upper=free)).v
    A, b, _ = problem.tracking
    first = problem.levels[0]
    np.testing.assert_allclose(A[first] @ v, b[first], atol=1e-6)


@pytest.mark.parametrize("dt", [0.002, 0.01])
@pytest.mark.parametrize("gain", [2.0, None], ids=["gain 2", "gain 1/dt"])
@pytest.mark.parametrize(("name", "frame"), [("panda", "panda_hand_tcp"), ("ur5", "tool0")])
def test_a_posture_after_a_tool_that_is_out_of_reach_rests(name, frame, gain, dt):
    """The posture would bend the arm, which the first priority has stretched out: it neither moves nor chatters, and
    what the tool lacks is named.
    """
    robot = Robot.load(name)
    goal = pin.SE3(np.eye(3), np.array([1.3, 0.2, 0.4]))
    tool = config.Task(frame=frame, gain=gain or 1.0 / dt, priority=1)
    tasks = build_tasks([tool, config.PostureTask(priority=2)], robot, robot.home)
    controller, q, vs = Controller(build_scene(robot), tasks, "hqp", dt), robot.home, []
    for _ in range(round(5.0 / dt)):
        solution = controller.step(q, targets={frame: goal})
        vs.append(solution.v)
        q = pin.integrate(robot.model, q, dt * solution.v)
    assert np.abs(np.diff(vs[-round(0.5 / dt) :], axis=0)).sum(axis=1).mean() <= 0.05
    assert [(reason.kind, reason.subject) for reason in solution.stalled] == [(ReasonKind.OUT_OF_REACH, (frame,))]
