"""Step-wise search: the best of all candidates by brute force, its bounded number, and what is typical of it."""

from functools import cache
from itertools import product
from math import comb

import numpy as np
import pytest
from closed_loop import cartesian, drive, make_controller
from hypothesis import given
from hypothesis import strategies as st

from qpavoid import Avoidance, Obstacle, load_scenario, make_solver, simulate
from qpavoid.config import Box, StepSearchSolver
from qpavoid.problem import AvoidanceRows, Tracking, make_problem
from qpavoid.solvers.step_search import LENGTHS, neighbourhood

SPEED, MOTION = 0.4, 1e-3
LAW = make_solver(StepSearchSolver(speed=SPEED, motion_cost=MOTION))
seeds = st.integers(0, 2**32 - 1)


def random_problem(seed, n=3, pairs=2, asked=0.0):
    rng = np.random.default_rng(seed)
    A, v = rng.normal(size=(2, n)), rng.uniform(-0.6, 0.6, n)
    rows = AvoidanceRows(
        np.arange(pairs), np.full(pairs, 0.05), rng.normal(size=(pairs, n)), rng.uniform(-0.2, 0.1, pairs) + asked,
        0.02, 0.1, np.full(pairs, -1.0),
    )  # fmt: skip
    names = [("link", f"ball{i}") for i in range(pairs)]
    lower, upper = -rng.uniform(0.0, 0.6, n), rng.uniform(0.0, 0.6, n)
    return make_problem(Tracking(A, A @ v, A @ v), rows, lower, upper, names)


def candidates(problem):
    """Every candidate of a problem of three coordinates, by the page's words."""
    steps = [problem.v_tracking, *[SPEED * s * np.array(e) for s in LENGTHS for e in product((-1, 0, 1), repeat=3)]]
    return [np.clip(step, problem.lower, problem.upper) for step in steps]


def cost(problem, v):
    return np.sum((problem.tracking.A @ v - problem.tracking.b) ** 2) + MOTION * np.sum(v**2)


def violation(problem, v):
    return float(np.max(problem.avoidance.b - problem.avoidance.J @ v, initial=0.0))


@given(seeds)
def test_step_is_the_best_of_all_candidates(seed):
    problem = random_problem(seed)
    clear = [v for v in candidates(problem) if violation(problem, v) <= 1e-9]
    v = LAW.solve(problem).v
    if clear:
        assert violation(problem, v) <= 1e-9
        assert cost(problem, v) == pytest.approx(min(cost(problem, one) for one in clear), abs=1e-12)
    assert (problem.lower <= v).all() and (v <= problem.upper).all()


@given(seeds)
def test_step_violates_rows_least_where_none_is_clear(seed):
    problem = random_problem(seed, asked=5.0)
    least = min(violation(problem, one) for one in candidates(problem))
    assert violation(problem, LAW.solve(problem).v) == pytest.approx(least, abs=1e-12) and least > 1.0


@given(seeds)
def test_without_a_pair_in_range_it_tracks(seed):
    problem = random_problem(seed, pairs=0)
    wide = problem._replace(lower=np.full(3, -9.0), upper=np.full(3, 9.0))
    np.testing.assert_array_equal(LAW.solve(wide).v, problem.v_tracking)
    v = LAW.solve(problem).v
    if (problem.lower <= problem.v_tracking).all() and (problem.v_tracking <= problem.upper).all():
        np.testing.assert_array_equal(v, problem.v_tracking)
    else:
        assert cost(problem, v) <= min(cost(problem, one) for one in candidates(problem)) + 1e-12


def test_nan_stays_nan():
    problem = random_problem(0)
    unknown = problem._replace(tracking=problem.tracking._replace(b=np.full(2, np.nan), b_feasible=np.full(2, np.nan)))
    assert np.isnan(LAW.solve(unknown).v).all()


@pytest.mark.parametrize("n", [1, 2, 6, 7, 14, 37])
def test_candidates_are_bounded_and_all_different(n):
    """As many joints may move at once as the bound allows; of few joints, all 3ⁿ steps are there."""
    grid = neighbourhood(n, 2000)
    p = int(np.abs(grid).sum(axis=1).max())
    counts = [sum(comb(n, k) * 2**k for k in range(size + 1)) for size in range(n + 1)]
    assert len(grid) == counts[p] == len(np.unique(grid, axis=0)) and set(np.unique(grid)) <= {-1.0, 0.0, 1.0}
    assert p == 1 or 1 + 3 * counts[p] <= 2000
    assert p == n or 1 + 3 * counts[p + 1] > 2000
    assert p == {1: 1, 2: 2, 6: 5, 7: 3, 14: 2, 37: 1}[n]


@cache
def run(name):
    return simulate(load_scenario(name), solver="step-search").metrics()


def test_it_arrives_in_situation_1_and_chatters():
    found, by_qp = run("situation1"), simulate("situation1", solver="qp").metrics()
    assert found["arrived"] and found["min_distance"] >= 0.08 and found["time_in_collision"] == 0.0
    assert found["jitter"] > 5.0 * by_qp["jitter"], "steps of a grid are jumps of the velocity"


def test_it_rests_in_a_local_minimum_in_situation_2():
    found = run("situation2")
    assert not found["arrived"] and found["final_error"] > 0.1 and found["time_in_collision"] == 0.0
    assert found["min_distance"] >= 0.02 - 1e-3


def test_it_rests_in_front_of_a_wall(tmp_path):
    """No step of one moment leads around it; it never touches."""
    wall = Obstacle.at("wall", Box(size=(0.1, 0.6, 0.6)), [0.5, 0.0, 0.0])
    controller = make_controller(
        cartesian(tmp_path, acceleration=None), [wall], "z", "step-search", avoidance=Avoidance(d1=0.02, d2=0.1)
    )
    ticks = list(drive(controller, np.zeros(3), 400, target=[1.0, 0.0, 0.0]))
    assert 0.02 - 1e-3 < ticks[-1].proximity.distance.min() < 0.05
    assert max(np.abs(tick.state.q[1:]).max() for tick in ticks) < 1e-9
