"""QP back ends: the same minimum from all of them, whatever they were asked before."""

from typing import NamedTuple

import numpy as np
import pytest
import qpsolvers

from qpavoid.solvers.backends import backend_names, make_backend, solve_daqp

BACKENDS = backend_names()
TOLERANCE = {"daqp": 1e-9, "quadprog": 1e-9, "proxqp": 1e-6, "osqp": 1e-6}
"""Largest error of x [rad/s]; P's smallest eigenvalue is 1e-3."""
LESS_EXACT = 5e-4
"""The same for what else may be installed: about the root of twice an interior-point method's gap over 1e-3."""


class QP(NamedTuple):
    P: np.ndarray
    q: np.ndarray
    G: np.ndarray
    h: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def make_qp(random: np.random.Generator, n: int, m: int, free: bool = False) -> QP:
    """A QP as a tick makes it: six tracking rows and a regularised rest, rows and bounds that some point meets."""
    A = random.normal(size=(6, n))
    P = A.T @ A + 1e-3 * np.eye(n)
    lower, upper = -random.uniform(0.1, 2.0, n), random.uniform(0.1, 2.0, n)
    G, inside = random.normal(size=(m, n)), random.uniform(lower, upper)
    h = G @ inside - random.uniform(0.0, 0.3, m)
    if free:
        lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    return QP(P, -P @ random.normal(size=n), G, h, lower, upper)


def contradicting(qp: QP) -> QP:
    """The same, with two rows that exclude each other: g x >= h and -g x >= 1 - h."""
    G, h = qp.G.copy(), qp.h.copy()
    G[1], h[1] = -G[0], 1.0 - h[0]
    return qp._replace(G=G, h=h)


def minimum(qp: QP) -> np.ndarray | None:
    """By quadprog (Goldfarb and Idnani), with finite bounds as rows."""
    rows = [(-qp.G, -qp.h)] if len(qp.h) else []
    eye = np.eye(len(qp.q))
    rows += [(eye[keep], qp.upper[keep]) for keep in [np.isfinite(qp.upper)]]
    rows += [(-eye[keep], -qp.lower[keep]) for keep in [np.isfinite(qp.lower)]]
    G, h = np.concatenate([g for g, _ in rows]), np.concatenate([b for _, b in rows])
    return qpsolvers.solve_qp(qp.P, qp.q, *((G, h) if len(h) else ()), solver="quadprog")


def assert_minimum(name: str, answer: np.ndarray | None, qp: QP, reference: np.ndarray | None = None) -> None:
    assert answer is not None, f"{name} found no solution to a feasible problem of shape {qp.G.shape}"
    reference = minimum(qp) if reference is None else reference
    np.testing.assert_allclose(answer, reference, rtol=0.0, atol=TOLERANCE.get(name, LESS_EXACT))


@pytest.mark.parametrize("name", BACKENDS)
def test_back_ends_find_the_minimum_after_any_size(name):
    """proxqp finds no solution of one in 800, which `Qp` then gives to daqp."""
    random, solve, unsolved = np.random.default_rng(1), make_backend(name), 0
    kept, copy = np.zeros(0), np.zeros(0)
    for _ in range(150):
        qp = make_qp(random, int(random.choice([7, 14, 35])), int(random.integers(0, 31)))
        given = QP(*map(np.copy, qp))
        answer = solve(*qp)
        unsolved += answer is None
        if answer is not None or name != "proxqp":
            assert_minimum(name, answer, qp)
        for array, before in zip((*qp, kept), (*given, copy), strict=True):
            np.testing.assert_array_equal(array, before)  # neither the problem nor the answer before it is written to
        if answer is not None:
            kept, copy = answer, answer.copy()
    assert unsolved <= 1


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("free_first", [False, True])
def test_back_ends_forget_a_very_different_problem(name, free_first):
    """The answer is the one that a fresh back end gives, also where bounds of the old active set are now infinite."""
    random = np.random.default_rng(3)
    for _ in range(25):
        solve = make_backend(name)
        other, qp = make_qp(random, 7, 5, free_first), make_qp(random, 7, 5, not free_first)
        solve(*other._replace(q=100.0 * other.q))
        cold = make_backend(name)(*qp)
        assert_minimum(name, cold, qp)
        assert_minimum(name, solve(*qp), qp, cold)


@pytest.mark.parametrize("name", BACKENDS)
def test_back_ends_return_none_for_an_infeasible_problem(name):
    random, solve = np.random.default_rng(4), make_backend(name)
    for _ in range(10):
        good, bad = make_qp(random, 7, 6), contradicting(make_qp(random, 7, 6))
        assert minimum(bad) is None
        assert_minimum(name, solve(*good), good)
        assert solve(*bad) is None
        again = make_qp(random, 7, 6)
        assert_minimum(name, solve(*again), again)


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("m", [0, 4])
def test_infinite_bounds(name, m):
    """Unbounded on some sides, or on all: without rows too, the minimum is then -P⁻¹q."""
    random, solve = np.random.default_rng(6), make_backend(name)
    for _ in range(10):
        qp = make_qp(random, 7, m)
        lower, upper = qp.lower.copy(), qp.upper.copy()
        lower[:4], upper[2:6] = -np.inf, np.inf
        qp = qp._replace(lower=lower, upper=upper)
        assert_minimum(name, solve(*qp), qp)
        free = make_qp(random, 7, m, free=True)
        assert_minimum(name, solve(*free), free, None if m else np.linalg.solve(free.P, -free.q))


@pytest.mark.parametrize("name", BACKENDS)
def test_locked_coordinates_stay(name):
    qp = make_qp(np.random.default_rng(7), 7, 3)
    lower, upper = qp.lower.copy(), qp.upper.copy()
    lower[2] = upper[2] = 0.0
    qp = qp._replace(G=qp.G, h=qp.h - 5.0, lower=lower, upper=upper)
    answer = make_backend(name)(*qp)
    assert answer is not None and answer[2] == pytest.approx(0.0, abs=1e-9)
    assert_minimum(name, answer, qp)


@pytest.mark.parametrize("name", ["daqp", "proxqp", "osqp"])
@pytest.mark.parametrize("field", ["P", "q", "G", "h"])
def test_back_ends_reject_and_forget_nan(name, field):
    random, solve = np.random.default_rng(8), make_backend(name)
    for _ in range(3):
        good, bad = make_qp(random, 7, 4), make_qp(random, 7, 4)
        assert_minimum(name, solve(*good), good)
        broken = getattr(bad, field).copy()
        broken.flat[0] = np.nan
        answer = solve(*bad._replace(**{field: broken}))
        if answer is not None:  # daqp: x is NaN, or the row that has no number in it was never looked at
            assert name == "daqp"


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("m", [0, 4])
@pytest.mark.parametrize("slack", [1.0, 0.0, -1e-8, -1e-3])
def test_nothing_is_printed(name, m, slack, capfd):
    """Not even from C, and not where no row is active, or hardly: `run --json` owns the process's output."""
    random, solve = np.random.default_rng(15), make_backend(name)
    for _ in range(5):
        qp = make_qp(random, 7, m)
        x = np.linalg.solve(qp.P, -qp.q)
        lower = np.concatenate((x[:1] - slack, x[1:] - 1.0))
        qp = qp._replace(h=qp.G @ x - slack, lower=lower, upper=x + 1.0)
        assert_minimum(name, solve(*qp), qp)
    assert capfd.readouterr() == ("", "")


def test_daqp_takes_any_number_of_rows():
    """Its memory grows, and what a larger problem left in it is not read."""
    random, solve = np.random.default_rng(14), make_backend("daqp")
    for m in (3, 300, 3, 0, 40):
        qp = make_qp(random, 7, m)
        np.testing.assert_array_equal(solve(*qp), solve_daqp(*qp))
        assert_minimum("daqp", solve(*qp), qp)
