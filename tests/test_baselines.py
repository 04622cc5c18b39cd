"""Gradient projection and the potential field: closed forms, exact gradients, and what is typical of them."""

from functools import cache

import numpy as np
import pytest
from closed_loop import cartesian, drive, make_controller
from conftest import CAPSULE, SPHERE, Bench, differences, obstacle, random_q
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from qpavoid import build_scene, load_scenario, make_solver
from qpavoid.config import Avoidance, GradientProjectionSolver, PotentialFieldSolver, Sphere
from qpavoid.config.shipped import shipped_names
from qpavoid.problem import AvoidanceRows, Tracking, make_problem
from qpavoid.run.simulate import simulate
from qpavoid.solvers.baselines import clearance_slope, repulsion, step_fraction

NV, D1, D2 = 7, 0.02, 0.12
LAWS = ("gradient-projection", "potential-field")
seeds = st.integers(0, 2**32 - 1)


def problem_of(A, b, d, J, limit=1e3, d1=D1, d2=D2):
    A, b, d, J = (np.asarray(x, dtype=float) for x in (A, b, d, J))
    k, nv = len(d), A.shape[1]
    rows = AvoidanceRows(np.arange(k), d, J.reshape(k, nv), np.full(k, -1.0), d1, d2, np.full(k, -2.0))
    names = [(f"body{i}", f"obstacle{i}") for i in range(k)]
    return make_problem(Tracking(A, b, b), rows, np.full(nv, -limit), np.full(nv, limit), names)


def random_problem(seed, pairs=3, **fields):
    rng = np.random.default_rng(seed)
    A, b = rng.normal(size=(3, NV)), 0.3 * rng.normal(size=3)
    return problem_of(A, b, rng.uniform(-0.02, D2, pairs), rng.normal(size=(pairs, NV)), **fields)


def added(name, problem, **settings_):
    """What a law adds to the tracking velocity."""
    config = {"gradient-projection": GradientProjectionSolver, "potential-field": PotentialFieldSolver}[name]
    return make_solver(config(**settings_)).solve(problem).v - problem.v_tracking


# --- by hand ------------------------------------------------------------------------------------------------------


def test_gradient_projection_by_hand():
    """The first joint tracks at 0.3; pairs at half the range and below d1 push with slopes 1/2 and 1, k = 4."""
    problem = problem_of([[1, 0, 0]], [0.3], [0.07, 0.01], [[5, 2, 0], [7, 0, -1]])
    v = make_solver(GradientProjectionSolver(gain=4.0)).solve(problem).v
    np.testing.assert_allclose(v, [0.3, 4 * 0.5 * 2, 4 * 1.0 * -1], atol=1e-14)


def test_potential_field_by_hand():
    """At d1 a pair pushes with `gain`, at 2 d1 with (4/5)/8 of it, deep inside with `cap`; the task is not spared."""
    problem = problem_of([[1, 0, 0]], [0.3], [0.02, 0.04, -1.0], [[1, 2, 0], [0, 0, 10], [0, 1, 0]])
    v = make_solver(PotentialFieldSolver(gain=0.5, cap=6.0)).solve(problem).v
    np.testing.assert_allclose(v, [0.3 + 0.5, 2 * 0.5 + 6.0, 10 * 0.5 * 0.8 / 8], atol=1e-14)


@given(st.floats(0.001, 0.119))
def test_repulsion_is_firas(d):
    """f(d) = η (1/d - 1/d2)/d² (Khatib 1986), with the η for which it is 0.7 at d1."""
    eta = 0.7 * D1**2 / (1 / D1 - 1 / D2)
    (push,) = repulsion(np.array([d]), D1, D2, 0.7, np.inf)
    assert push == pytest.approx(eta * (1 / d - 1 / D2) / d**2, rel=1e-9)


# --- gradients ----------------------------------------------------------------------------------------------------


def clearance(d):
    """h: the cost of CHOMP, negative, summed."""
    cost = np.where(d > D1, 0.5 * np.maximum(D2 - d, 0.0) ** 2 / (D2 - D1), 0.5 * (D1 + D2) - d)
    return -np.sum(cost)


def firas(d, gain, cap):
    """ΣU, which goes on linearly below the distance at which the push reaches the cap (found by bisection)."""
    eta, low, high = gain * D1**2 / (1 / D1 - 1 / D2), 1e-6, D2
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if eta * (1 / middle - 1 / D2) / middle**2 > cap else (low, middle)
    kept = np.clip(d, low, D2)
    return np.sum(0.5 * eta * (1 / kept - 1 / D2) ** 2 + cap * (kept - np.minimum(d, D2)))


@pytest.mark.parametrize("seed", range(4))
def test_gradients_are_those_of_the_clearance_and_of_the_potential(panda, seed):
    """Finite differences over a real robot's distances, with nothing to track: free motion is the gradient itself."""
    rng = np.random.default_rng(seed)
    places = [(0.45, 0.0, 0.75), (0.25, 0.25, 0.5), (0.5, -0.15, 0.5), (0.1, -0.15, 0.6)]
    shapes = [SPHERE, CAPSULE, SPHERE, CAPSULE]
    scene = build_scene(panda, [obstacle(f"o{i}", s, p) for i, (s, p) in enumerate(zip(shapes, places, strict=True))])
    bench, q = Bench(scene, avoidance=Avoidance(d1=D1, d2=D2)), random_q(panda, rng, 0.15)

    def near():
        return bench.compute(q, reach=D2)[1]._replace(lower=np.full(NV, -1e9), upper=np.full(NV, 1e9))

    def distance(q):
        return bench.compute(q)[0].distance.copy()

    d = near().avoidance.d.copy()
    assert len(d) >= 4 and d.max() > D1 and np.min(np.abs(np.subtract.outer(d, [D1, D2]))) > 1e-5
    up = added("gradient-projection", near(), gain=2.0)
    np.testing.assert_allclose(
        up, 2.0 * differences(lambda q: np.array([clearance(distance(q))]), panda, q)[0], atol=1e-6
    )
    down = added("potential-field", near(), gain=0.5, cap=0.6)
    slope = differences(lambda q: np.array([firas(distance(q), 0.5, 0.6)]), panda, q)[0]
    np.testing.assert_allclose(down, -slope, atol=1e-6)
    assert np.linalg.norm(up) > 0.01 and np.linalg.norm(down) > 1e-3


# --- what holds for any problem -----------------------------------------------------------------------------------


@given(seeds, st.floats(0.0, 100.0))
def test_gradient_projection_keeps_the_task_velocity(seed, gain):
    """A N = 0."""
    problem = random_problem(seed, limit=1e6)
    moved = problem.tracking.A @ added("gradient-projection", problem, gain=gain)
    np.testing.assert_allclose(moved, 0.0, atol=1e-9 * (1.0 + gain))


@given(seeds, st.floats(0.1, 5.0))
def test_self_motion_ascends_the_clearance(seed, limit):
    problem = random_problem(seed, limit=limit)
    rows = problem.avoidance
    gradient = clearance_slope(rows.d, D1, D2) @ rows.J
    assert gradient @ added("gradient-projection", problem) >= -1e-12


@given(seeds, st.integers(1, 5))
def test_potential_field_descends_its_potential(seed, pairs):
    problem = random_problem(seed, pairs)
    rows = problem.avoidance
    push = repulsion(rows.d, D1, D2, 1.0, 5.0)
    v = added("potential-field", problem)
    assert push @ (rows.J @ v) == pytest.approx(v @ v)  # minus the rate of the potential
    for i in range(pairs):
        alone = problem_of(problem.tracking.A, problem.tracking.b, rows.d[[i]], rows.J[[i]])
        parting = rows.J[i] @ added("potential-field", alone)
        assert parting == pytest.approx(push[i] * rows.J[i] @ rows.J[i]) and parting > 0.0


def test_step_fraction_by_hand():
    lower, upper, inf = np.array([-1.0, -1.0]), np.array([1.0, 1.0]), np.array([np.inf, np.inf])
    assert step_fraction(np.zeros(2), np.array([0.5, -1.0]), lower, upper) == 1.0
    assert step_fraction(np.array([0.5, 0.0]), np.array([2.0, 0.1]), lower, upper) == 0.25
    assert step_fraction(np.array([1.5, 0.0]), np.array([0.1, 0.1]), lower, upper) == 0.0
    assert step_fraction(np.array([1.5, 0.0]), np.array([-0.1, 0.1]), lower, upper) == 1.0
    assert step_fraction(np.array([1.0, 0.0]), np.array([0.0, 2.0]), lower, upper) == 0.5
    assert step_fraction(np.zeros(2), np.array([1e9, -1e-310]), -inf, inf) == 1.0
    assert np.isnan(step_fraction(np.zeros(2), np.array([np.nan, 1.0]), lower, upper))


# --- what is degenerate -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LAWS)
@given(seed=seeds)
def test_baselines_without_near_pairs_are_tracking_bit_for_bit(name, seed):
    problem = random_problem(seed, 0)
    assert np.array_equal(make_solver(name).solve(problem).v, make_solver("tracking").solve(problem).v)


@pytest.mark.parametrize("name", LAWS)
def test_pairs_that_no_joint_moves_and_pairs_at_the_edge_add_nothing(name):
    problem = problem_of(np.eye(3, NV), [0.1, 0.2, 0.3], [-0.01, D2], [np.zeros(NV), np.ones(NV)])
    assert np.array_equal(make_solver(name).solve(problem).v, problem.v_tracking)


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("d", [0.0, -1e-300, 1e-300, -0.3])
def test_in_contact_they_back_away_at_a_finite_speed(name, d):
    """1/d overflows below 1e-103 and is infinite in contact; warnings are errors here."""
    row = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, -2.0])
    v = added(name, problem_of(np.eye(3, NV), [0.1, 0.2, 0.3], [d], [row]))
    np.testing.assert_allclose(v, (10.0 if name == "gradient-projection" else 5.0) * row)


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("what", ["d", "J", "b"])
def test_nan_is_not_hidden(name, what):
    problem = random_problem(7)
    if what == "b":
        b = np.array([0.0, np.nan, 0.0])
        problem = problem_of(problem.tracking.A, b, problem.avoidance.d, problem.avoidance.J)
    else:
        value = getattr(problem.avoidance, what).copy()
        value[1] = np.nan
        problem = problem._replace(avoidance=problem.avoidance._replace(**{what: value}))
    assert np.isnan(make_solver(name).solve(problem).v).any()


# --- in the loop --------------------------------------------------------------------------------------------------


@cache
def run(scenario, solver, *overrides):
    return simulate(load_scenario(scenario, overrides, solver))


def test_gradient_projection_keeps_to_its_path_through_obstacles():
    """A sphere in the middle of it: the tool goes through to the goal, as tracking does; only the elbow steps aside."""
    ours, theirs = (run("situation1", name).metrics() for name in ("gradient-projection", "tracking"))
    assert ours["min_distance"] == pytest.approx(theirs["min_distance"], abs=1e-3) and ours["collided"]
    assert ours["max_deviation"] < 1e-3 and ours["arrived"]
    aside = np.abs(run("situation1", "gradient-projection").q - run("situation1", "tracking").q).max()
    assert aside > 0.1


def test_gradient_projection_clears_obstacles_with_its_links():
    """Past the box and the ball it is the hand that is in the way: it turns aside, while the tool goes on."""
    ours, theirs = (run("panda_line", name).metrics() for name in ("gradient-projection", "tracking"))
    assert theirs["collided"] and not ours["collided"]
    assert ours["max_deviation"] < 3e-3 and ours["arrived"]


FREE = [name for name in shipped_names("scenario") if not load_scenario(name).contacts]


@pytest.mark.slow
@pytest.mark.parametrize("scenario", FREE)
def test_potential_field_keeps_half_of_the_safe_distance(scenario):
    """With one set of defaults in every shipped scenario that it can run."""
    avoidance = load_scenario(scenario).avoidance
    asked = avoidance.d1 - avoidance.offset
    assert run(scenario, "potential-field").metrics()["min_distance"] > 0.5 * asked


@pytest.mark.parametrize(("dt", "settles"), [(0.01, True), (0.05, False)])
def test_potential_field_stalls_or_oscillates_at_its_balance(tmp_path, dt, settles):
    """Head on, on one joint: K (goal - x) = f(d). A step of dt multiplies what is left by 1 - dt (K + |f'|)."""
    robot = cartesian(tmp_path, "x", acceleration=None)
    wall = obstacle("ball", Sphere(radius=0.1), (0.5, 0.0, 0.0))  # the tool is a ball of 0.05
    controller = make_controller(robot, [wall], "x", "potential-field", dt, avoidance=Avoidance(d1=D1, d2=D2))

    def pull_and_push(d):
        return 2.0 * (0.5 - (0.35 - d)) - repulsion(np.array([d]), D1, D2, 1.0, 5.0)[0]

    d = brentq(pull_and_push, 0.016, D2)
    stiffness = (pull_and_push(d + 1e-6) - pull_and_push(d - 1e-6)) / 2e-6
    assert (abs(1.0 - dt * stiffness) < 1.0) == settles
    ticks = list(drive(controller, robot.home, round(6.0 / dt), target=[0.5, 0.0, 0.0]))
    found = np.array([tick.proximity.distance[0] for tick in ticks[-20:]])
    assert np.allclose(found, d, atol=1e-6) if settles else np.ptp(found) > 2e-3


@pytest.mark.slow
def test_potential_field_creeps_toward_a_goal_near_an_obstacle():
    """Goals not reachable with obstacles nearby (Ge and Cui 2000): a minute on, the tool all but rests, off it."""
    log = run("situation2", "potential-field", "duration=60")
    assert np.linalg.norm(log.tool[-1] - log.tool[-2]) < 0.5e-3 * 0.01
    assert log.metrics()["final_error"] > 0.03
    assert run("situation2", "qp").metrics()["arrived"]
