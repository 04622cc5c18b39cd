"""Frames at rest: held exactly by every back end, whatever is relaxed; and a humanoid that reaches without sliding."""

import numpy as np
import pinocchio as pin
import pytest
from conftest import SPHERE, frames, obstacle, random_q

from qpavoid import (
    ConfigError,
    Controller,
    ReasonKind,
    Robot,
    Severity,
    Solver,
    UnknownName,
    build_scene,
    build_tasks,
    config,
    load_scenario,
)
from qpavoid.control.contacts import build_contacts, solve_contacts
from qpavoid.problem import AvoidanceRows, Contacts, Problem, Solution, Status, Tracking, least_squares, make_problem
from qpavoid.run.simulate import simulate
from qpavoid.solvers import backend_names, make_solver
from qpavoid.solvers.backends import solve_daqp

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
BACKENDS = ["auto", *[name for name in ("daqp", "proxqp", "osqp", "quadprog") if name in backend_names()]]


def random_contacts(rng, rows, nv, dependent=0):
    J = rng.normal(size=(rows, nv))
    if dependent:
        J = np.concatenate((J, rng.normal(size=(dependent, rows)) @ J))
    return solve_contacts(J, J @ rng.normal(scale=0.01, size=nv))


def problem_with(contacts, rng, k=4, low=-0.5, touch=None):
    """Random tasks, rows and bounds; v0 holds the contacts."""
    nv = len(contacts.v_particular)
    A, task = rng.normal(size=(6, nv)), rng.normal(size=6)
    tracking = Tracking(A, task, task)
    b = rng.uniform(low, 0.2, k)
    rows = AvoidanceRows(
        np.arange(k), np.linspace(0.02, 0.05, k), rng.normal(size=(k, nv)), b, 0.03, 0.1, b if touch is None else touch
    )
    bound = rng.uniform(0.3, 1.0, nv) * (0.5 if k > 4 else 1.0)
    problem = make_problem(tracking, rows, -bound, bound, [(f"a{i}", f"b{i}") for i in range(k)])
    Z, v_tracking = contacts.Z, contacts.v_particular
    v_tracking = v_tracking + Z @ least_squares(A @ Z, task - A @ v_tracking)
    short = max(float(np.max(rows.b - rows.J @ v_tracking, initial=-np.inf)), float(np.max(np.abs(v_tracking) - bound)))
    return problem._replace(v_tracking=v_tracking, violation=short, contacts=contacts)


@pytest.mark.parametrize(("rows", "dependent"), [(3, 0), (12, 0), (6, 4), (1, 0), (20, 0)])
def test_contact_basis_spans_what_moves_no_contact(rows, dependent):
    contacts = random_contacts(np.random.default_rng(rows), rows, 20, dependent)
    assert contacts.Z.shape == (20, 20 - rows)
    np.testing.assert_allclose(contacts.Z.T @ contacts.Z, np.eye(20 - rows), atol=1e-12)
    np.testing.assert_allclose(contacts.J @ contacts.Z, 0.0, atol=1e-11)
    np.testing.assert_allclose(contacts.J @ contacts.v_particular, contacts.b, atol=1e-11)
    np.testing.assert_allclose(contacts.v_particular, np.linalg.pinv(contacts.J) @ contacts.b, atol=1e-10)  # least


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["qp", "hqp"])
def test_contacts_hold_exactly_and_the_solution_is_optimal(name, backend):
    """Against daqp with the contacts as pairs of rows."""
    binding = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        problem = problem_with(random_contacts(rng, 4, 12), rng)
        solver = make_solver(name if backend == "auto" else f"{name}:{backend}")
        solution = solver.solve(problem)
        J, b = problem.contacts.J, problem.contacts.b
        assert solution.status is Status.SOLVED
        np.testing.assert_allclose(J @ solution.v, b, atol=1e-8)
        rows, A = problem.avoidance, problem.tracking.A
        P = A.T @ A + 1e-3 * np.eye(12)
        both = np.ascontiguousarray(np.concatenate((rows.J, J, -J)))
        right = np.concatenate((rows.b, b - 1e-10, -b - 1e-10))
        v = solve_daqp(P, -P @ problem.v_tracking, both, right, problem.lower, problem.upper)
        np.testing.assert_allclose(solution.v, v, atol=1e-5)
        binding += problem.violation > 0.0
    assert binding >= 6


@pytest.mark.parametrize("name", ["qp", "hqp"])
def test_contacts_are_never_relaxed(name):
    relaxed = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        problem = problem_with(random_contacts(rng, 6, 12), rng, k=8, low=0.19, touch=np.full(8, -2.0))
        solution = make_solver(name).solve(problem)
        assert solution.status is not Status.STOPPED
        np.testing.assert_allclose(problem.contacts.J @ solution.v, problem.contacts.b, atol=1e-8)
        assert (np.abs(solution.v) <= problem.upper + 1e-9).all()
        relaxed += solution.status is Status.RELAXED
    assert relaxed >= 4


def test_contacts_beyond_the_limits_are_a_stop():
    contacts = solve_contacts(np.array([[1.0, 0.0, 0.0]]), np.array([0.9]))
    problem, bound = problem_with(contacts, np.random.default_rng(0)), np.full(3, 0.5)
    problem = problem._replace(lower=-bound, upper=bound, hard_lower=-bound, hard_upper=bound, violation=0.4)
    solution = make_solver("qp").solve(problem)
    (reason,) = solution.reasons
    assert solution.status is Status.STOPPED
    assert (reason.kind, reason.severity) == (ReasonKind.CONTACTS_INFEASIBLE, Severity.ALARM)


# On robots


def standing(solo, kind="point", **settings):
    """A quadruped on its feet, whose trunk follows a target."""
    q0 = pin.integrate(solo.model, solo.home, np.concatenate((np.zeros(6), np.tile([0.0, 0.7, -1.4], 4))))
    tasks = build_tasks([config.Task(frame="base_link", type="pose"), config.DampingTask(weight=1e-4)], solo, q0)
    contacts = build_contacts([config.Contact(frame=foot, type=kind) for foot in FEET], solo, q0)
    ball = obstacle("ball", SPHERE, (1.0, 0.0, 0.0))
    return Controller(build_scene(solo, [ball]), tasks, dt=0.01, contacts=contacts, **settings), q0


def feet(robot, q):
    return np.array([M.translation for M in frames(robot, FEET, q)])


@pytest.mark.parametrize("solver", ["qp", "hqp"])
def test_contacts_rest_while_the_trunk_sways(solo, solver):
    controller, q = standing(solo, solver=solver)
    begin, here = feet(solo, q), controller.tick(q).targets[0]
    for tick in range(200):
        way = 0.04 * np.sin(0.03 * tick) * np.array([1.0, 0.5, 0.3])
        target = here._replace(position=here.position + way, rotation=pin.exp3(3.0 * way) @ here.rotation)
        solution = controller.step(q, targets={"base_link": target})
        assert solution.status is Status.SOLVED
        q = pin.integrate(solo.model, q, 0.01 * solution.v)
        assert np.abs(feet(solo, q) - begin).max() < 1e-4
    assert np.linalg.norm(q[:3] - here.position) > 0.005


def test_contacts_that_slid_return(solo):
    controller, q0 = standing(solo)
    begin = feet(solo, q0)
    q = pin.integrate(solo.model, q0, np.concatenate(([0.004, -0.003, 0.002], np.zeros(15))))
    assert np.abs(feet(solo, q) - begin).max() > 3e-3
    for _ in range(100):
        q = pin.integrate(solo.model, q, 0.01 * controller.step(q).v)
    assert np.abs(feet(solo, q) - begin).max() < 1e-5


def test_filter_keeps_commands_that_hold_the_contacts(solo):
    controller, q = standing(solo)
    held = controller.tick(q).problem.contacts
    wish = 0.2 * held.Z @ np.random.default_rng(2).normal(size=held.Z.shape[1])
    np.testing.assert_array_equal(controller.filter(q, wish).v, wish)
    sliding = wish + 0.3 * np.linalg.pinv(held.J) @ np.ones(len(held.b))
    np.testing.assert_allclose(controller.filter(q, sliding).v, wish, atol=1e-7)  # the nearest one that holds them


def test_stop_holds_the_contacts(solo):
    """From full speed, within acceleration limits, with no news of the state but the last command."""
    controller, q = standing(solo, limits=config.Limits(acceleration=5.0))
    begin, here = feet(solo, q), controller.tick(q).targets[0]
    target = here._replace(position=here.position + np.array([0.05, 0.0, 0.02]))
    for tick in range(80):
        solution = controller.step(q if tick < 30 else np.full_like(q, np.nan), targets={"base_link": target})
        assert (solution.status is Status.STOPPED) == (tick >= 30)
        q = pin.integrate(solo.model, q, 0.01 * solution.v)
    assert not solution.v.any()
    assert np.abs(feet(solo, q) - begin).max() < 1e-4


def test_solvers_without_contacts_are_refused(solo):
    for solver in ("eq10", "tracking", "gradient-projection", "potential-field"):
        with pytest.raises(ConfigError, match=f"contacts: solver '{solver}' cannot hold them; use qp or hqp"):
            standing(solo, solver=solver)
    with pytest.raises(ConfigError, match=r"humanoid_reach\.yaml: contacts: solver 'eq10' cannot hold them"):
        Controller.from_scenario(load_scenario("humanoid_reach", solver="eq10"))


def test_solver_of_the_user_may_hold_contacts(solo):
    class Own(Solver):
        bounded = True
        holds_contacts = True

        def solve(self, problem: Problem) -> Solution:
            assert isinstance(problem.contacts, Contacts)
            return Solution(problem.contacts.project(problem.v_tracking))

    controller, q = standing(solo, solver=Own())
    assert controller.step(q).status is Status.SOLVED


def test_contacts_that_cannot_be_used_are_named(solo, panda):
    with pytest.raises(UnknownName, match=r"contacts: contacts\.0\.frame: .* has no frame 'FOOT'"):
        build_contacts([config.Contact(frame="FOOT")], solo, solo.home)
    with pytest.raises(ConfigError, match="contacts leave panda-capsules no way to move"):
        pair = [config.Contact(frame="panda_hand"), config.Contact(frame="panda_link4", type="point")]
        build_contacts(pair, panda, random_q(panda, np.random.default_rng(0)))


@pytest.mark.parametrize("solver", ["qp", pytest.param("hqp", marks=pytest.mark.slow)])
def test_humanoid_reaches_past_a_ball_without_sliding(solver):
    scenario, g1 = load_scenario("humanoid_reach", solver=solver), Robot.load("g1")
    log = simulate(scenario)
    metrics = log.metrics()
    assert metrics["arrived"] and not metrics["collided"]
    assert metrics["status_counts"]["SOLVED"] == len(log.t)
    names = [contact.frame for contact in scenario.contacts]
    places = np.array([[M.homogeneous for M in frames(g1, names, q)] for q in log.q])
    slid, turned = np.abs(places - places[0])[:, :, :3, 3], np.abs(places - places[0])[:, :, :3, :3]
    assert slid.max() < 1e-4 and turned.max() < 2e-4
    assert metrics["max_deviation"] > 0.02  # the ball is in its way
    assert log.task_error[:, 0].max() < 0.02  # the centre of mass stays over them
    assert np.abs(np.linalg.norm(log.q[:, 3:7], axis=1) - 1.0).max() < 1e-9
