"""A small strictly convex QP, solved in compiled code: the dual active-set method of Goldfarb and Idnani (1983).

It starts at the unconstrained minimiser, which the tracking law gives for nothing, and adds violated constraints one
by one, so that its work grows with the number of constraints that bind, not with the number there are. Calling a
library costs several times what a problem of this size takes to solve.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from qpavoid.problem import Array

_TOLERANCE = 1e-10
"""Violation of a constraint that counts as none [m/s, rad/s]."""


@njit(cache=True)
def project(
    A: Array, regularization: float, v0: Array, J: Array, least: Array, lower: Array, upper: Array
) -> tuple[Array, bool]:
    """The velocity closest to v0 in the metric P = AᵀA + λ with J v >= least and lower <= v <= upper.

    Args:
        A: tracking rows (r, nv).
        regularization: λ.
        v0: wanted velocity (nv,).
        J: avoidance rows (k, nv).
        least: their right-hand sides (k,).
        lower: lower bounds (nv,).
        upper: upper bounds (nv,).

    Returns:
        (nv,), and whether it is the answer; if not, no point meets all constraints, or round-off got in the way.
    """
    rows, nv = A.shape
    P = np.zeros((nv, nv))
    for r in range(rows):
        for i in range(nv):
            for j in range(nv):
                P[i, j] += A[r, i] * A[r, j]
    for i in range(nv):
        P[i, i] += regularization
    v = v0.copy()
    if not minimize(P, v, J, least, lower, upper):
        return v, False
    for i in range(nv):
        v[i] = min(max(v[i], lower[i]), upper[i])
        if not np.isfinite(v[i]):
            return v, False
    return v, True


@njit(cache=True)
def minimize(P: Array, x: Array, G: Array, h: Array, lower: Array, upper: Array) -> bool:
    """Moves x from the minimiser of ½ (x - x0)ᵀP (x - x0) to the one with G x >= h, lower <= x <= upper.

    Args:
        P: positive definite (n, n).
        x: x0 (n,), overwritten.
        G: rows (m, n).
        h: right-hand sides (m,).
        lower: lower bounds (n,).
        upper: upper bounds (n,).

    Returns:
        Whether x now solves the problem; if not, it is infeasible or too badly conditioned.
    """
    n, m = len(x), len(h)
    basis = _inverse_transposed_factor(P)  # J in the paper: basisᵀ P basis = 1
    R = np.zeros((n, n))
    active = np.empty(n, np.intp)
    u = np.zeros(n + 1)
    d, z, r, normal = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    count = 0
    for _ in range(10 * (n + m)):
        p, violation = _most_violated(x, G, h, lower, upper)
        if violation <= _TOLERANCE:
            return True
        if np.isnan(violation):
            return False
        normal[:] = 0.0
        if p < n:
            normal[p] = 1.0
        elif p < 2 * n:
            normal[p - n] = -1.0
        else:
            normal[:] = G[p - 2 * n]
        u[count] = 0.0
        while True:
            d[:] = 0.0
            for i in range(n):
                if normal[i] != 0.0:
                    for j in range(n):
                        d[j] += basis[i, j] * normal[i]
            square, free = 0.0, 0.0
            for j in range(n):
                square += d[j] * d[j]
                if j >= count:
                    free += d[j] * d[j]
            for i in range(count - 1, -1, -1):
                total = d[i]
                for j in range(i + 1, count):
                    total -= R[i, j] * r[j]
                r[i] = total / R[i, i]
            # the longest step that keeps all multipliers positive, and the one that reaches the constraint
            dual_step, leaving = np.inf, -1
            for j in range(count):
                if r[j] > 0.0 and u[j] / r[j] < dual_step:
                    dual_step, leaving = u[j] / r[j], j
            reachable = count < n and free > 1e-13 * square
            step = min(dual_step, violation / free) if reachable else dual_step
            if step == np.inf:
                return False
            if reachable:
                for i in range(n):
                    z[i] = 0.0
                    for j in range(count, n):
                        z[i] += basis[i, j] * d[j]
                    x[i] += step * z[i]
            for j in range(count):
                u[j] -= step * r[j]
            u[count] += step
            if reachable and step == violation / free:
                _add(basis, R, d, count)
                active[count] = p
                count += 1
                break
            _drop(basis, R, active, u, leaving, count)
            count -= 1
            violation = -_slack(p, x, G, h, lower, upper)
    return False


@njit(cache=True)
def _inverse_transposed_factor(P: Array) -> Array:
    """L⁻ᵀ of P = L Lᵀ (n, n)."""
    n = len(P)
    L = np.zeros((n, n))
    inverse = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = P[i, j]
            for c in range(j):
                total -= L[i, c] * L[j, c]
            L[i, j] = np.sqrt(total) if i == j else total / L[j, j]
    for j in range(n):
        inverse[j, j] = 1.0 / L[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for c in range(j, i):
                total -= L[i, c] * inverse[j, c]
            inverse[j, i] = total / L[i, i]
    return inverse


@njit(cache=True)
def _slack(p: int, x: Array, G: Array, h: Array, lower: Array, upper: Array) -> float:
    """How far inside constraint p the point x lies: n lower bounds, n upper bounds, then the rows; negative outside."""
    n = len(x)
    if p < n:
        return x[p] - lower[p]
    if p < 2 * n:
        return upper[p - n] - x[p - n]
    slack = -h[p - 2 * n]
    for i in range(n):
        slack += G[p - 2 * n, i] * x[i]
    return slack


@njit(cache=True)
def _most_violated(x: Array, G: Array, h: Array, lower: Array, upper: Array) -> tuple[int, float]:
    """Which constraint x violates most, and by how much; NaN in a row shows."""
    n = len(x)
    worst, violation = -1, -np.inf
    for i in range(n):
        if not lower[i] - x[i] <= violation:
            worst, violation = i, lower[i] - x[i]
        if not x[i] - upper[i] <= violation:
            worst, violation = n + i, x[i] - upper[i]
    for k in range(len(h)):
        outside = h[k]
        for i in range(n):
            outside -= G[k, i] * x[i]
        if not outside <= violation:
            worst, violation = 2 * n + k, outside
        if np.isnan(outside):
            break
    return worst, violation


@njit(cache=True)
def _rotate(a: float, b: float) -> tuple[float, float, float]:
    """Cosine and sine of the rotation that takes (a, b) to (length, 0), and the length."""
    length = np.sqrt(a * a + b * b)
    if length == 0.0:
        return 1.0, 0.0, 0.0
    return a / length, b / length, length


@njit(cache=True)
def _turn_columns(basis: Array, j: int, cosine: float, sine: float) -> None:
    for i in range(len(basis)):
        first, second = basis[i, j], basis[i, j + 1]
        basis[i, j] = cosine * first + sine * second
        basis[i, j + 1] = cosine * second - sine * first


@njit(cache=True)
def _add(basis: Array, R: Array, d: Array, count: int) -> None:
    """Takes a constraint with d = basisᵀ normal into the active set, as column `count` of R."""
    for j in range(len(d) - 2, count - 1, -1):
        cosine, sine, d[j] = _rotate(d[j], d[j + 1])
        _turn_columns(basis, j, cosine, sine)
    for i in range(count + 1):
        R[i, count] = d[i]


@njit(cache=True)
def _drop(basis: Array, R: Array, active: Array, u: Array, leaving: int, count: int) -> None:
    """Takes constraint number `leaving` out of the active set of `count`; u keeps the entering one's multiplier."""
    for j in range(leaving, count - 1):
        active[j] = active[j + 1]
        for i in range(count):
            R[i, j] = R[i, j + 1]
    for j in range(leaving, count):
        u[j] = u[j + 1]
    for j in range(leaving, count - 1):
        cosine, sine, R[j, j] = _rotate(R[j, j], R[j + 1, j])
        R[j + 1, j] = 0.0
        for c in range(j + 1, count - 1):
            first, second = R[j, c], R[j + 1, c]
            R[j, c] = cosine * first + sine * second
            R[j + 1, c] = cosine * second - sine * first
        _turn_columns(basis, j, cosine, sine)
