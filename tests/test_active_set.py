"""The compiled active-set method against quadprog, and on what active-set methods stumble over."""

import numpy as np
import pytest
import qpsolvers
import quadprog
from hypothesis import given, settings
from hypothesis import strategies as st

from qpavoid.kernels import minimize, project, project_soft

seeds = st.integers(0, 2**32 - 1)


def random_problem(seed, feasible, repeated):
    """P, x0, G, h, lower, upper; rows that repeat each other, exactly or nearly; some bounds infinite."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 20)), int(rng.integers(0, 40))
    A = rng.normal(size=(int(rng.integers(1, 7)), n))
    P = A.T @ A + 1e-3 * np.eye(n)
    G = rng.normal(size=(m, n))
    inside = rng.uniform(-0.5, 0.5, n)
    h = G @ inside - rng.uniform(0, 1, m) * rng.choice([0.0, 0.01, 1.0], m) if feasible else rng.normal(size=m)
    if repeated and m > 4:
        G[3], h[3] = G[2], h[2]
        G[1], h[1] = G[0] * (1.0 + 1e-9), h[0] * (1.0 + 1e-9)
    lower = np.where(rng.random(n) < 0.3, -np.inf, -1.0)
    return P, rng.normal(size=n) * rng.choice([0.1, 1.0, 5.0]), G, h, lower, np.ones(n)


@settings(deadline=None, max_examples=300, derandomize=True)
@given(seeds, st.booleans())
def test_minimize_agrees_with_quadprog(seed, repeated):
    P, x0, G, h, lower, upper = random_problem(seed, True, repeated)
    x = x0.copy()
    if not minimize(P, x, G, h, lower, upper, np.zeros(len(h))):
        return  # it says so, and the caller asks another back end; how often is held below
    assert np.all(G @ x >= h - 1e-8) and np.all(x >= lower - 1e-9) and np.all(x <= upper + 1e-9)
    constraints = np.vstack((G, np.eye(len(x)), -np.eye(len(x))))
    bounds = np.concatenate((h, np.maximum(lower, -1e6), -upper))
    try:
        reference = quadprog.solve_qp(P, P @ x0, constraints.T.copy(), bounds)[0]
    except ValueError:  # quadprog fails on some problems with rows that repeat each other
        return
    np.testing.assert_allclose(x, reference, atol=1e-7)


def test_minimize_solves_nearly_all_feasible_problems():
    """Of 4,000 it may leave four to another back end: where rows nearly depend on each other."""
    solved = 0
    for seed in range(2000):
        for repeated in (False, True):
            P, x, G, h, lower, upper = random_problem(seed, True, repeated)
            solved += minimize(P, x, G, h, lower, upper, np.zeros(len(h)))
    assert solved >= 3996


@settings(deadline=None, max_examples=200, derandomize=True)
@given(seeds)
def test_minimize_fails_only_on_infeasible_problems(seed):
    from scipy.optimize import linprog

    P, x0, G, h, lower, upper = random_problem(seed, False, False)
    x = x0.copy()
    if minimize(P, x, G, h, lower, upper, np.zeros(len(h))):
        assert np.all(G @ x >= h - 1e-8)
    else:
        programme = linprog(np.zeros(len(x)), A_ub=-G, b_ub=-h - 1e-9, bounds=list(zip(lower, upper, strict=True)))
        assert programme.status == 2


@pytest.mark.parametrize("place", ["A", "v_tracking", "J", "b"])
def test_project_rejects_nan(place):
    arguments = {
        "A": np.eye(3), "regularization": 1e-3, "v_tracking": np.ones(3), "J": np.ones((2, 3)),
        "b": np.array([2.9, 0.0]), "lower": -np.ones(3), "upper": 0.99 * np.ones(3),
    }  # fmt: skip
    arguments[place] = arguments[place].copy()
    arguments[place].flat[0] = np.nan
    assert not project(*arguments.values())[1]


@settings(derandomize=True, deadline=None, max_examples=300)
@given(seeds)
def test_soft_rows_have_the_slack_of_least_cost(seed):
    """Against quadprog, to which what a row lacks is a variable of its own."""
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 7), rng.integers(1, 12)
    J, h, v_tracking = rng.normal(size=(m, n)), rng.normal(size=m), rng.normal(size=n)
    soft = np.where(rng.random(m) < 0.6, 10.0 ** rng.uniform(-6.0, 0.0, m), 0.0)
    lower, upper = -rng.uniform(0.0, 1.0, n), rng.uniform(0.0, 1.0, n)
    giving = np.flatnonzero(soft)
    count = len(giving)
    G = np.hstack((J, np.zeros((m, count))))
    G[giving, n + np.arange(count)] = np.sqrt(soft[giving])
    far = np.full(count, 1e9)
    limits = {"lb": np.r_[lower, -far], "ub": np.r_[upper, far]}
    expected = qpsolvers.solve_qp(
        np.eye(n + count), np.r_[-v_tracking, np.zeros(count)], -G, -h, **limits, solver="quadprog"
    )  # fmt: skip
    v, solved = project_soft(np.zeros((0, n)), 1.0, v_tracking, J, h, lower, upper, soft)
    assert solved == (expected is not None)
    if solved:
        np.testing.assert_allclose(v, expected[:n], atol=1e-6)
