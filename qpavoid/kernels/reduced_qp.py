"""A QP within an affine space: the velocities and impulses that contacts and a floating base leave."""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.kernels.qp import minimize
from qpavoid.problem import Array


@compiled
def project_within(
    A: Array, regularization: float, target: Array, X: Array, start: Array, G: Array, g: Array,
    lower: Array, upper: Array,
) -> tuple[Array, bool]:  # fmt: skip
    """Compute the x = start + X y closest to a target, see `project_soft`, with G x >= g and lower <= x <= upper.

    Args:
        A: rows (r, n) of the cost, of the first n coordinates.
        regularization: λ.
        target: (d,) of least cost.
        X: (d, k) orthonormal columns.
        start: (d,).
        G: rows (m, d).
        g: their right-hand sides (m,).
        lower: lower bounds (d,).
        upper: upper bounds (d,).

    Returns:
        x (d,), and whether it is the minimiser; if not, there is none, or round-off prevented an answer.
    """
    (d, k), m = X.shape, len(g)
    P, aim, row = np.zeros((k, k)), np.zeros(k), np.empty(k)
    for r in range(len(A)):
        row[:] = 0.0
        for j in range(A.shape[1]):
            if A[r, j] != 0.0:
                for c in range(k):
                    row[c] += A[r, j] * X[j, c]
        for i in range(k):
            for c in range(i + 1):
                P[i, c] += row[i] * row[c]
    for i in range(k):
        P[i, i] += regularization
    for j in range(d):
        for c in range(k):
            aim[c] += X[j, c] * (target[j] - start[j])
    count, x = m, target.copy()
    for j in range(d):
        count += (lower[j] > -np.inf) + (upper[j] < np.inf)
    rows, rhs, far, at = np.zeros((count, k)), np.empty(count), np.full(k, np.inf), m
    for p in range(m):
        rhs[p] = g[p]
        for j in range(d):
            if G[p, j] != 0.0:
                rhs[p] -= G[p, j] * start[j]
                for c in range(k):
                    rows[p, c] += G[p, j] * X[j, c]
    for side, bound in ((1.0, lower), (-1.0, upper)):
        for j in range(d):
            if abs(bound[j]) < np.inf:
                rows[at], rhs[at] = side * X[j], side * (bound[j] - start[j])
                at += 1
    if not minimize(P, aim, rows, rhs, -far, far, np.zeros(count)):
        return x, False
    for j in range(d):
        x[j] = start[j]
        for c in range(k):
            x[j] += X[j, c] * aim[c]
        x[j] = min(max(x[j], lower[j]), upper[j])
        if not np.isfinite(x[j]):
            return x, False
    return x, True
