"""What an answer is worth, computed from P, q, G, h, lower, upper alone: no solver's word is taken for it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import qpsolvers
from scipy.optimize import linprog, nnls

from bench.solvers.record import QP
from qpavoid.problem import Array
from qpavoid.solvers.backends import solve_daqp

VIOLATION = 1e-6
"""Largest violation of a row or bound [m/s, rad/s]: what the `qp` solver accepts."""
DISTANCE = 1e-6
"""Largest distance from the reference in any coordinate [rad/s]."""
GAP = 1e-8
"""Largest relative excess of the cost, where the minimum is too flat for the distance to mean anything."""
FLAT = 1e-6
"""Smallest eigenvalue of P below which a minimum is called flat."""

EDGE = 1e-9
"""Room between rows and bounds below which round-off decides whether there is any [m/s]."""


class Truth(NamedTuple):
    """What the right answer to a QP is."""

    x: Array | None
    """The minimum (n,); None where rows and bounds contradict each other."""
    stationarity: float
    """‖P x + q - Aᵀy‖∞ of the reference itself, y >= 0 of its active rows and bounds by non-negative least squares."""
    flat: bool
    """Whether the minimum is judged by its cost."""
    edge: bool = False
    """Rows can be met with less than `EDGE` to spare, below what solvers can tell: no answer is right too."""
    open: bool = False
    """Neither minimum nor contradiction could be shown; answers to such a QP are not judged."""


class Judgement(NamedTuple):
    """What is known of one answer."""

    solved: bool
    """It gave an x, whatever that is worth; or, for a contradiction, it gave none."""
    right: bool
    violation: float
    distance: float
    """‖x - reference‖∞ [rad/s]; NaN where it means nothing."""


def truth(qp: QP) -> Truth:
    """The best of daqp's and quadprog's answers, solved again as equations on its active set, and what proves it."""
    flat = bool(np.linalg.eigvalsh(qp.P)[0] < FLAT)
    best = Truth(None, np.inf, flat)
    for x in (solve_daqp(*qp), _quadprog(qp)):
        if x is None or violation(qp, x) > VIOLATION:
            continue
        for candidate in (x, _on_active_set(qp, x)):
            residual = stationarity(qp, candidate)
            if violation(qp, candidate) <= 1e-9 and residual < best.stationarity:
                best = Truth(candidate, residual, flat)
    if best.x is not None:
        edge = least_violation(qp) > -EDGE
        return best._replace(edge=edge, open=best.stationarity > 1e-8 * max(1.0, float(np.abs(qp.q).max())))
    return best._replace(open=least_violation(qp) <= VIOLATION)


def judge(qp: QP, right: Truth, x: Array | None) -> Judgement:
    """Compares an answer with the truth."""
    if right.x is None:
        return Judgement(x is None, x is None or not violation(qp, x) <= VIOLATION, np.nan, np.nan)
    if x is None:
        return Judgement(right.edge, right.edge, np.nan, np.nan)
    excess, off = violation(qp, x), float(np.abs(x - right.x).max())
    reference = cost(qp, right.x)
    close = abs(cost(qp, x) - reference) <= GAP * (1.0 + abs(reference)) if right.flat else off <= DISTANCE
    return Judgement(True, excess <= VIOLATION and close, excess, np.nan if right.flat else off)


def cost(qp: QP, x: Array) -> float:
    """½ xᵀP x + qᵀx."""
    return float(0.5 * x @ qp.P @ x + qp.q @ x)


def violation(qp: QP, x: Array) -> float:
    """Largest amount by which a row or bound is missed; NaN stays NaN."""
    short = np.concatenate((qp.h - qp.G @ x, qp.lower - x, x - qp.upper))
    return float(np.maximum(short.max(), 0.0))


def stationarity(qp: QP, x: Array) -> float:
    """‖P x + q - Aᵀy‖∞ with the y >= 0 that makes it least; A are the rows and bounds that hold as equations at x."""
    A, _ = _active(qp, x)
    gradient = qp.P @ x + qp.q
    return float(np.abs(gradient - A.T @ nnls(A.T, gradient)[0]).max() if len(A) else np.abs(gradient).max())


def least_violation(qp: QP) -> float:
    """Least t for which some x within the bounds meets every row up to t: above 0, the rows contradict; at least -1."""
    m, n = qp.G.shape
    bounds = [*zip(qp.lower, qp.upper, strict=True), (-1.0, None)]
    result = linprog(np.eye(n + 1)[-1], np.hstack((-qp.G, -np.ones((m, 1)))), -qp.h, bounds=bounds)
    return float(result.x[-1]) if result.success else np.inf


def _active(qp: QP, x: Array, within: float = 1e-7) -> tuple[Array, Array]:
    """Rows A (k, n) and sides b (k,) of what is active at x: A x >= b."""
    eye = np.eye(len(x))
    rows = np.vstack((qp.G, eye, -eye))
    sides = np.concatenate((qp.h, qp.lower, -qp.upper))
    active = rows @ x - sides < within
    return rows[active], sides[active]


def _on_active_set(qp: QP, x: Array) -> Array:
    """Minimum on the active set of x, by its linear equations: takes the last digits of round-off away."""
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
