"""A QP within an affine space: the velocities and impulses that contacts and a floating base leave."""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.cholesky import dot
from qpavoid.kernels.contact_forces import add_gram
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.qp import minimize
from qpavoid.problem import Array


@compiled
def project_within(
    A: Array, regularization: float, target: Array, X: Array, start: Array, k: int, J: Array, b: Array,
    G: Array, g: Array, mirrored: int, lower: Array, upper: Array,
) -> tuple[Array, bool]:  # fmt: skip
    """Compute the x = (v, ·) = start + X y closest to a target, see `project_soft`, with rows and bounds.

    Args:
        A: rows (r, n) of the cost, of v.
        regularization: λ.
        target: (d,) of least cost, one of these x.
        X: (d, c), whose first k columns are orthonormal in v, and whose others, orthonormal and orthogonal to these,
            move no v; see `eliminate_base`.
        start: (d,).
        k: see X.
        J: rows (p, n) with J v >= b.
        b: (p,).
        G: rows (m, d) with G x >= g.
        g: (m,).
        mirrored: how many rows of G, the first, come in pairs of opposite sign.
        lower: lower bounds on v (n,).
        upper: upper bounds on v (n,).

    Returns:
        x (d,), and whether it is the minimiser; if not, there is none, or round-off prevented an answer.
    """
    (d, size), n = X.shape, A.shape[1]
    P, aim, row = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    for r in range(len(A)):
        _reduce(A[r], X, k, row)
        for i in range(k):
            for c in range(i + 1):
                P[i, c] += row[i] * row[c]
    add_gram(X, n, k, regularization, P)
    for i in range(size):
        P[i, i] += regularization
    for j in range(d):
        for c in range(0 if j < n else k, k if j < n else size):
            aim[c] += X[j, c] * (target[j] - start[j])
    count, first = len(b) + len(g), len(b)
    for j in range(n):
        count += (lower[j] > -np.inf) + (upper[j] < np.inf)
    rows, rhs, x = np.zeros((count, size)), np.empty(count), target.copy()
    for p in range(first):
        _reduce(J[p], X, k, rows[p])
        rhs[p] = b[p] - dot(J[p], start)
    for p in range(len(g)):
        if p < mirrored and p % 2:
            for c in range(size):
                rows[first + p, c] = -rows[first + p - 1, c]
        else:
            _reduce(G[p], X, size, rows[first + p])
        rhs[first + p] = g[p] - dot(G[p], start)
    at = first + len(g)
    for side, bound in ((1.0, lower), (-1.0, upper)):
        for j in range(n):
            if abs(bound[j]) < np.inf:
                for c in range(k):
                    rows[at, c] = side * X[j, c]
                rhs[at] = side * (bound[j] - start[j])
                at += 1
    far = np.full(size, np.inf)
    if not minimize(P, aim, rows, rhs, -far, far, np.zeros(count)):
        return x, False
    for j in range(d):
        x[j] = start[j]
        for c in range(k if j < n else size):
            x[j] += X[j, c] * aim[c]
        if j < n:
            x[j] = min(max(x[j], lower[j]), upper[j])
        if not np.isfinite(x[j]):
            return x, False
    return x, True


@compiled
def _reduce(row: Array, X: Array, k: int, out: Array) -> None:
    """Write to the first k entries of `out` what a row is in y: row · X."""
    out[:k] = 0.0
    for j in range(len(row)):
        entry = row[j]
        if entry != 0.0:  # a cone has three of them
            for c in range(k):
                out[c] += entry * X[j, c]
