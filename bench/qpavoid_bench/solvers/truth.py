"""What an answer is worth, computed from P, q, G, h, lower, upper alone: no solver's word is taken for it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import qpsolvers
from scipy.optimize import linprog, nnls

from qpavoid.problem import Array
from qpavoid.solvers.backends import solve_daqp
from qpavoid_bench.solvers.record import QP

VIOLATION = 1e-6
"""Largest violation of a row or bound [m/s, rad/s]: what the `qp` solver accepts."""
DISTANCE = 1e-6
"""Largest distance from the reference in any coordinate [rad/s]."""
EDGE = 1e-9
"""Slack of rows and bounds below which round-off decides whether there is any [m/s]."""


class Truth(NamedTuple):
    """What the right answer to a QP is."""

    x: Array | None
    """The minimum (n,); None where rows and bounds contradict each other."""
    stationarity: float
    """‖P x + q - Aᵀy‖∞ of the reference itself, y >= 0 of its active rows and bounds by non-negative least squares."""
    at_edge: bool = False
    """Rows can be met with less than `EDGE` to spare, below what solvers can tell: no answer is right too."""
    is_open: bool = False
    """Neither minimum nor contradiction could be shown; answers to such a QP are not judged."""


class Judgement(NamedTuple):
    """What is known of one answer."""

    solved: bool
    """It gave an x, whatever that is worth; or, for a contradiction, it gave none."""
    right: bool
    violation: float
    """Largest violation of a row or bound [m/s, rad/s]; NaN where it means nothing."""
    distance: float
    """‖x - reference‖∞ [rad/s]; NaN where it means nothing."""


def find_truth(qp: QP) -> Truth:
    """Return the better of daqp's and quadprog's answers, solved again on its active set, with its proof."""
    best = Truth(None, np.inf)
    for x in (solve_daqp(*qp[:6]), _quadprog(qp)):
        if x is None or violation(qp, x) > VIOLATION:
            continue
        for candidate in (x, _on_active_set(qp, x)):
            residual = stationarity(qp, candidate)
            if violation(qp, candidate) <= 1e-9 and residual < best.stationarity:
                best = Truth(candidate, residual)
    if best.x is None:
        return best._replace(is_open=least_violation(qp) <= VIOLATION)
    is_open = best.stationarity > 1e-8 * max(1.0, float(np.abs(qp.q).max()))
    return best._replace(at_edge=least_violation(qp) > -EDGE, is_open=is_open)


def judge(qp: QP, truth: Truth, x: Array | None) -> Judgement:
    """Compare an answer with the truth."""
    if truth.x is None:
        return Judgement(x is None, x is None or not violation(qp, x) <= VIOLATION, np.nan, np.nan)
    if x is None:
        return Judgement(truth.at_edge, truth.at_edge, np.nan, np.nan)
    excess, distance = violation(qp, x), float(np.abs(x - truth.x).max())
    return Judgement(True, excess <= VIOLATION and distance <= DISTANCE, excess, distance)


def violation(qp: QP, x: Array) -> float:
    """Return the largest amount by which a row or bound is missed; NaN stays NaN."""
    missing = np.concatenate((qp.h - qp.G @ x, qp.lower - x, x - qp.upper))
    return float(np.maximum(missing.max(), 0.0))


def stationarity(qp: QP, x: Array) -> float:
    """Return the least ‖P x + q - Aᵀy‖∞ over y >= 0; A are the rows and bounds that hold as equations at x."""
    A, _ = _active(qp, x)
    gradient = qp.P @ x + qp.q
    return float(np.abs(gradient - A.T @ nnls(A.T, gradient)[0]).max() if len(A) else np.abs(gradient).max())


def least_violation(qp: QP) -> float:
    """Return the least t >= -1 such that an x within the bounds meets every row up to t: above 0, a contradiction."""
    m, n = qp.G.shape
    bounds = [*zip(qp.lower, qp.upper, strict=True), (-1.0, None)]
    result = linprog(np.eye(n + 1)[-1], np.hstack((-qp.G, -np.ones((m, 1)))), -qp.h, bounds=bounds)
    return float(result.x[-1]) if result.success else np.inf


def _active(qp: QP, x: Array) -> tuple[Array, Array]:
    """Return rows A (k, n) and sides b (k,) of what is active at x: A x >= b."""
    eye = np.eye(len(x))
    rows = np.vstack((qp.G, eye, -eye))
    sides = np.concatenate((qp.h, qp.lower, -qp.upper))
    active = rows @ x - sides < 1e-7
    return rows[active], sides[active]


def _on_active_set(qp: QP, x: Array) -> Array:
    """Return the minimum on the active set of x, by its linear equations: takes the last digits of round-off away."""
    A, b = _active(qp, x)
    k = len(b)
    matrix = np.block([[qp.P, A.T], [A, np.zeros((k, k))]])
    return np.asarray(np.linalg.lstsq(matrix, np.concatenate((-qp.q, b)), rcond=None)[0][: len(x)])


def _quadprog(qp: QP) -> Array | None:
    eye = np.eye(len(qp.q))
    low, high = np.isfinite(qp.lower), np.isfinite(qp.upper)
    G = np.vstack((-qp.G, eye[high], -eye[low]))
    h = np.concatenate((-qp.h, qp.upper[high], -qp.lower[low]))
    try:
        x: Array | None = qpsolvers.solve_qp(qp.P, qp.q, G, h, solver="quadprog")
    except (ValueError, qpsolvers.exceptions.QPError):
        return None
    return x
