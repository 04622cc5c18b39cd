"""A small strictly convex QP, solved in compiled code: the dual active-set method of Goldfarb and Idnani (1983).

It starts at the unconstrained minimiser, which the tracking law gives for nothing, and adds violated constraints one
by one, so that its work grows with the number of constraints that bind, not with the number there are. Calling a
library costs several times what a problem of this size takes to solve.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray

_TOLERANCE = 1e-10
"""Violation of a constraint that counts as none [m/s, rad/s]."""
_ROUND_OFF = 1e-7
"""How far off an active constraint a solution may lie after all [m/s, rad/s]."""
_DEPENDENT = 1e-11
"""Share of a constraint's normal, in the metric P⁻¹, below which the active ones are said to contain it."""


@compiled
def project(
    A: Array, regularization: float, v_tracking: Array, J: Array, least: Array, lower: Array, upper: Array
) -> tuple[Array, bool]:
    """`project_soft` with no soft rows."""
    return project_soft(A, regularization, v_tracking, J, least, lower, upper, np.zeros(len(least)))


@compiled
def project_soft(
    A: Array, regularization: float, v_tracking: Array, J: Array, least: Array, lower: Array, upper: Array, soft: Array
) -> tuple[Array, bool]:
    """The velocity closest to v0 in the metric P = AᵀA + λ with J v >= least and lower <= v <= upper.

    Rows may be soft: one falls short of its right-hand side at the cost of ½ (what it lacks)² / its softness.

    Args:
        A: tracking rows (r, nv).
        regularization: λ.
        v_tracking: wanted velocity (nv,).
        J: avoidance rows (k, nv).
        least: their right-hand sides (k,).
        lower: lower bounds (nv,).
        upper: upper bounds (nv,).
        soft: softness of the rows (k,); 0 of those that have to be met.

    Returns:
        (nv,), and whether it is the answer; if not, no point meets all constraints, or round-off got in the way.
    """
    rows, nv = A.shape
    P = np.zeros((nv, nv))
    for r in range(rows):
        row = A[r]
        for i in range(nv):
            if row[i] != 0.0:  # a frame is moved by few of the joints
                for j in range(i + 1):  # the lower triangle is all that is read
                    P[i, j] += row[i] * row[j]
    for i in range(nv):
        P[i, i] += regularization
    v = v_tracking.copy()
    if not minimize(P, v, J, least, lower, upper, soft):
        return v, False
    for i in range(nv):
        v[i] = min(max(v[i], lower[i]), upper[i])
        if not np.isfinite(v[i]):
            return v, False
    return v, True


@compiled
def max_clearance_velocity(
    h: float,
    closest: Array,
    J: Array,
    feedforward: Array,
    comfort: float,
    deepest: float,
    low_effort: float,
    v: Array,
    lower: Array,
    upper: Array,
) -> tuple[Array, bool]:
    """max s - ½ s²/c - ε/2c ‖w - v‖² over w and s, with d + h (J w + ḋ_obs) >= s, lower <= w <= upper, s <= c.

    Args:
        h: horizon [s].
        closest: d first (k, 10) [m].
        J: velocity Jacobian of these distances (k, nv).
        feedforward: ḋ_obs (k,) [m/s].
        comfort: c, where the slope of the objective in s has come to nothing.
        deepest: s is not below its negative.
        low_effort: ε.
        v: (nv,).
        lower: lower bounds (nv,).
        upper: upper bounds (nv,).

    Returns:
        w (nv,), and whether it is the answer; if not, round-off got in the way, or s would lie too deep.
    """
    k, n = J.shape
    P, G, least = np.zeros((n + 1, n + 1)), np.empty((k, n + 1)), np.empty(k)
    x, low, high = np.empty(n + 1), np.empty(n + 1), np.empty(n + 1)
    for i in range(n):
        P[i, i], x[i], low[i], high[i] = low_effort, v[i], lower[i], upper[i]
    for j in range(k):
        least[j] = -(closest[j, 0] + h * feedforward[j])
        for i in range(n):
            G[j, i] = h * J[j, i]
    P[n, n], x[n], low[n], high[n] = 1.0, comfort, -deepest, comfort
    G[:, n] = -1.0
    met = minimize(P, x, G, least, low, high, np.zeros(k))
    return x[:n], met


@compiled
def minimize(P: Array, x: Array, G: Array, h: Array, lower: Array, upper: Array, soft: Array) -> bool:
    """Moves x from the minimiser of ½ (x - x0)ᵀP (x - x0) to the one with G x >= h, lower <= x <= upper.

    With the multiplier u, a row of softness c falls short by c u: in the dual, softness adds to the diagonal of S.

    The active constraints' normals N and what they become, W = P⁻¹N, are kept, with a Cholesky factor of S = NᵀW: few
    constraints bind at a time, so that this is less work than to keep an orthogonal basis of the whole space.

    Args:
        P: positive definite (n, n); its lower triangle is read.
        x: x0 (n,), overwritten.
        G: rows (m, n).
        h: right-hand sides (m,).
        lower: lower bounds (n,).
        upper: upper bounds (n,).
        soft: softness of the rows (m,); see `project_soft`.

    Returns:
        Whether x now solves the problem; if not, it is infeasible or too badly conditioned.
    """
    n, m = len(x), len(h)
    L = np.zeros((n, n))
    _factorise(P, L, n)
    most = n + np.count_nonzero(soft)  # constraints that can be active at a time
    N, W = np.zeros((most + 1, n)), np.zeros((most + 1, n))
    S, R = np.zeros((most + 1, most + 1)), np.zeros((most + 1, most + 1))
    active, u = np.empty(most + 1, np.intp), np.zeros(most + 1)
    r, z, bound = np.empty(most + 1), np.empty(n), h.copy()
    met = np.zeros(2 * n + m, np.bool_)  # active ones are, but for round-off
    count = 0
    for _ in range(10 * (n + m)):
        p, violation = _most_violated(x, G, bound, lower, upper, met)
        if violation <= _TOLERANCE:
            off = 0.0
            for j in range(count):
                off = max(off, abs(_slack(active[j], x, G, bound, lower, upper)))
            return off <= _ROUND_OFF
        if np.isnan(violation):
            return False
        _enter(p, N[count], G)
        _solve(L, N[count], W[count], n)
        u[count] = 0.0
        give = soft[p - 2 * n] if p >= 2 * n else 0.0
        square = _dot(N[count], W[count]) + give
        while True:
            for j in range(count):
                S[count, j] = _dot(N[j], W[count])
            _solve(R, S[count], r, count)
            z[:] = W[count]
            for j in range(count):
                for i in range(n):
                    z[i] -= r[j] * W[j, i]
            free = _dot(N[count], z) + give
            # the longest step that keeps all multipliers positive, and the one that reaches the constraint
            dual_step, leaving = np.inf, -1
            for j in range(count):
                if r[j] > 0.0 and u[j] / r[j] < dual_step:
                    dual_step, leaving = u[j] / r[j], j
            reachable = count < most and free > _DEPENDENT * square
            step = min(dual_step, violation / free) if reachable else dual_step
            if step == np.inf:
                return False
            if reachable:
                for i in range(n):
                    x[i] += step * z[i]
            for j in range(count):
                u[j] -= step * r[j]
                _settle(active[j], u[j], bound, h, soft, n)
            u[count] += step
            _settle(p, u[count], bound, h, soft, n)
            if reachable and step == violation / free:
                S[count, count] = square
                _extend(S, R, count)
                active[count], met[p] = p, True
                count += 1
                break
            met[active[leaving]] = False
            _settle(active[leaving], 0.0, bound, h, soft, n)
            _drop(N, W, S, R, active, u, leaving, count)
            count -= 1
            violation = -_slack(p, x, G, bound, lower, upper)
    return False


@compiled
def _settle(p: int, multiplier: float, bound: Array, h: Array, soft: Array, n: int) -> None:
    """Writes what a row asks for once its multiplier has made it give."""
    if p >= 2 * n:
        bound[p - 2 * n] = h[p - 2 * n] - soft[p - 2 * n] * multiplier


@compiled
def _dot(a: Array, b: Array) -> float:
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@compiled
def _factorise(M: Array, L: Array, n: int) -> None:
    """Writes the lower Cholesky factor of the first n rows and columns of M."""
    for i in range(n):
        _extend(M, L, i)


@compiled
def _extend(M: Array, L: Array, i: int) -> None:
    """Writes row i of the Cholesky factor, on the diagonal the inverse of it; NaN where M is not positive definite."""
    for j in range(i):
        total = M[i, j]
        for c in range(j):
            total -= L[i, c] * L[j, c]
        L[i, j] = total * L[j, j]
    total = M[i, i]
    for c in range(i):
        total -= L[i, c] * L[i, c]
    L[i, i] = 1.0 / np.sqrt(total)


@compiled
def _solve(L: Array, b: Array, y: Array, n: int) -> None:
    """Writes the solution of L Lᵀ y = b, of the first n rows and columns."""
    for i in range(n):
        total = b[i]
        for c in range(i):
            total -= L[i, c] * y[c]
        y[i] = total * L[i, i]
    for i in range(n - 1, -1, -1):
        y[i] *= L[i, i]
        for c in range(i):
            y[c] -= L[i, c] * y[i]


@compiled
def _enter(p: int, normal: Array, G: Array) -> None:
    """Writes the normal of constraint p, pointing inwards."""
    n = len(normal)
    if p < 2 * n:
        normal[:] = 0.0
        normal[p % n] = 1.0 if p < n else -1.0
    else:
        normal[:] = G[p - 2 * n]


@compiled
def _drop(N: Array, W: Array, S: Array, R: Array, active: IntArray, u: Array, leaving: int, count: int) -> None:
    """Takes constraint number `leaving` out of the active set of `count`; what enters moves up with its multiplier."""
    for j in range(leaving, count):
        u[j], N[j], W[j] = u[j + 1], N[j + 1], W[j + 1]
    for j in range(leaving, count - 1):
        active[j] = active[j + 1]
        for c in range(j + 1):
            S[j, c] = S[j + 1, c if c < leaving else c + 1]
        _extend(S, R, j)


@compiled
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


@compiled
def _most_violated(
    x: Array, G: Array, h: Array, lower: Array, upper: Array, met: npt.NDArray[np.bool_]
) -> tuple[int, float]:
    """Which constraint x violates most, and by how much, without those that are met; NaN in a row shows."""
    n = len(x)
    worst, violation = -1, -np.inf
    for i in range(n):
        if not (lower[i] - x[i] <= violation or met[i]):
            worst, violation = i, lower[i] - x[i]
        if not (x[i] - upper[i] <= violation or met[n + i]):
            worst, violation = n + i, x[i] - upper[i]
    for k in range(len(h)):
        if met[2 * n + k]:
            continue
        outside = h[k]
        for i in range(n):
            outside -= G[k, i] * x[i]
        if not outside <= violation:
            worst, violation = 2 * n + k, outside
        if np.isnan(outside):
            break
    return worst, violation
