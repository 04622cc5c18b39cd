"""A small strictly convex QP, solved in compiled code: the dual active-set method of Goldfarb and Idnani (1983).

D. Goldfarb and A. Idnani, "A numerically stable dual method for solving strictly convex quadratic programs",
Mathematical Programming 27. It starts at the unconstrained minimiser, which is the tracking law's velocity, and adds
violated constraints one by one, so that its work grows with the number of constraints that bind, not with the number
there are. A call of a library costs several times what a problem of this size takes to solve.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from qpavoid.kernels.cholesky import dot, extend_factor, factorise, solve_factored
from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray

_TOLERANCE = 1e-10
"""Violation of a constraint that counts as none [m/s, rad/s]: two digits above the round-off of a row."""
_ROUND_OFF = 1e-7
"""Residual of an active constraint up to which a solution counts [m/s, rad/s]: below what any row or limit means."""
_DEPENDENT = 1e-11
"""Share of a constraint's normal, squared in the metric P⁻¹, below which it depends on the active ones [-]: round-off
of the projection."""


@compiled
def project(
    A: Array, regularization: float, v_tracking: Array, J: Array, b: Array, lower: Array, upper: Array
) -> tuple[Array, bool]:
    """Compute the feasible velocity of least cost: `project_soft` without soft rows.

    Args:
        A: tracking rows (r, nv).
        regularization: λ.
        v_tracking: velocity of least cost (nv,) [rad/s or m/s].
        J: avoidance rows (k, nv).
        b: their right-hand sides (k,) [m/s].
        lower: lower bounds (nv,) [rad/s or m/s].
        upper: upper bounds (nv,) [rad/s or m/s].

    Returns:
        See `project_soft`.
    """
    return project_soft(A, regularization, v_tracking, J, b, lower, upper, np.zeros(len(b)))


@compiled
def project_soft(
    A: Array, regularization: float, v_tracking: Array, J: Array, b: Array, lower: Array, upper: Array, soft: Array
) -> tuple[Array, bool]:
    """Compute the velocity closest to v_tracking that meets all hard rows and bounds.

    It minimises ½ (v - v_tracking)ᵀP (v - v_tracking), P = AᵀA + λ I, with J v >= b, lower <= v <= upper. Rows may be
    soft: one is violated by s at the cost of ½ s² / its softness.

    Args:
        A: tracking rows (r, nv).
        regularization: λ.
        v_tracking: velocity of least cost (nv,) [rad/s or m/s].
        J: avoidance rows (k, nv).
        b: their right-hand sides (k,) [m/s].
        lower: lower bounds (nv,) [rad/s or m/s].
        upper: upper bounds (nv,) [rad/s or m/s].
        soft: softness of the rows (k,); 0 of hard ones.

    Returns:
        v (nv,), and whether it is the minimiser; if not, no point meets all hard constraints, or round-off prevented
        an answer.
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
    if not minimize(P, v, J, b, lower, upper, soft):
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
    """Compute the velocity w of largest clearance s at the horizon, to first order.

        max s - ½ s²/c - ε/2c ‖w - v‖²  over w and s,  with d + h (J w + ḋ_obs) >= s,  lower <= w <= upper,  s <= c.

    Times c, that is a QP in (w, s) with the Hessian diag(ε, …, ε, 1) and the unconstrained minimiser (v, c).

    Args:
        h: horizon [s].
        closest: d first (k, 10) [m].
        J: velocity Jacobian of these distances (k, nv).
        feedforward: ḋ_obs (k,) [m/s].
        comfort: c, clearance from which the objective no longer grows [m].
        deepest: s is at least the negative of this [m].
        low_effort: ε [m²/(rad/s)²].
        v: velocity without a clearance to gain (nv,) [rad/s or m/s].
        lower: lower bounds (nv,) [rad/s or m/s].
        upper: upper bounds (nv,) [rad/s or m/s].

    Returns:
        w (nv,), and whether it is the maximiser; if not, round-off prevented an answer, or s would be below -`deepest`.
    """
    k, n = J.shape
    P, G, rhs = np.zeros((n + 1, n + 1)), np.empty((k, n + 1)), np.empty(k)
    x, low, high = np.empty(n + 1), np.empty(n + 1), np.empty(n + 1)
    for i in range(n):
        P[i, i], x[i], low[i], high[i] = low_effort, v[i], lower[i], upper[i]
    for j in range(k):
        rhs[j] = -(closest[j, 0] + h * feedforward[j])
        for i in range(n):
            G[j, i] = h * J[j, i]
    P[n, n], x[n], low[n], high[n] = 1.0, comfort, -deepest, comfort
    G[:, n] = -1.0
    solved = minimize(P, x, G, rhs, low, high, np.zeros(k))
    return x[:n], solved


@compiled
def minimize(P: Array, x: Array, G: Array, h: Array, lower: Array, upper: Array, soft: Array) -> bool:
    """Move x from the minimiser of ½ (x - x0)ᵀP (x - x0) to the one with G x >= h, lower <= x <= upper.

    The most violated constraint p, with normal n_p, enters: with the normals N of the active constraints, W = P⁻¹N,
    w_p = P⁻¹n_p and S = NᵀW, its primal direction is z = w_p - W r, with S r = Nᵀw_p, and its dual direction is -r on
    the multipliers of the active ones. The step is the shorter of the one that meets the constraint,
    violation / n_pᵀz, and the longest one that keeps all multipliers positive, after which a constraint leaves. A row
    of softness c and multiplier u is violated by c u: in the dual, softness adds to the diagonal of S.

    N and W are stored, with a Cholesky factor R of S: few constraints bind at a time, so that this is less work than to
    update an orthogonal basis of the whole space.

    Args:
        P: positive definite (n, n); its lower triangle is read.
        x: x0 (n,), overwritten.
        G: rows (m, n).
        h: right-hand sides (m,).
        lower: lower bounds (n,).
        upper: upper bounds (n,).
        soft: softness of the rows (m,); see `project_soft`.

    Returns:
        Whether x now is the minimiser; if not, the problem is infeasible or too badly conditioned.
    """
    n, m = len(x), len(h)
    L = np.zeros((n, n))
    factorise(P, L, n)
    capacity = n + np.count_nonzero(soft)  # constraints that can be active at a time
    N, W = np.zeros((capacity + 1, n)), np.zeros((capacity + 1, n))
    S, R = np.zeros((capacity + 1, capacity + 1)), np.zeros((capacity + 1, capacity + 1))
    active, u = np.empty(capacity + 1, np.intp), np.zeros(capacity + 1)
    r, z, bound = np.empty(capacity + 1), np.empty(n), h.copy()
    is_satisfied = np.zeros(2 * n + m, np.bool_)  # the active ones, up to round-off
    count = 0
    for _ in range(10 * (n + m)):
        p, violation = _most_violated(x, G, bound, lower, upper, is_satisfied)
        if violation <= _TOLERANCE:
            residual = 0.0
            for j in range(count):
                residual = max(residual, abs(_slack(active[j], x, G, bound, lower, upper)))
            return residual <= _ROUND_OFF
        if np.isnan(violation):
            return False
        _write_normal(p, N[count], G)
        solve_factored(L, N[count], W[count], n)
        u[count] = 0.0
        softness = soft[p - 2 * n] if p >= 2 * n else 0.0
        square = dot(N[count], W[count]) + softness
        while True:
            for j in range(count):
                S[count, j] = dot(N[j], W[count])
            solve_factored(R, S[count], r, count)
            z[:] = W[count]
            for j in range(count):
                for i in range(n):
                    z[i] -= r[j] * W[j, i]
            curvature = dot(N[count], z) + softness
            # the longest step that keeps all multipliers positive, and the one that reaches the constraint
            dual_step, leaving = np.inf, -1
            for j in range(count):
                if r[j] > 0.0 and u[j] / r[j] < dual_step:
                    dual_step, leaving = u[j] / r[j], j
            reachable = count < capacity and curvature > _DEPENDENT * square
            step = min(dual_step, violation / curvature) if reachable else dual_step
            if step == np.inf:
                return False
            if reachable:
                for i in range(n):
                    x[i] += step * z[i]
            for j in range(count):
                u[j] -= step * r[j]
                _update_soft_row(active[j], u[j], bound, h, soft, n)
            u[count] += step
            _update_soft_row(p, u[count], bound, h, soft, n)
            if reachable and step == violation / curvature:
                S[count, count] = square
                extend_factor(S, R, count)
                active[count], is_satisfied[p] = p, True
                count += 1
                break
            is_satisfied[active[leaving]] = False
            _update_soft_row(active[leaving], 0.0, bound, h, soft, n)
            _drop(N, W, S, R, active, u, leaving, count)
            count -= 1
            violation = -_slack(p, x, G, bound, lower, upper)
    return False


@compiled
def _update_soft_row(p: int, multiplier: float, bound: Array, h: Array, soft: Array, n: int) -> None:
    """Write the right-hand side of soft row p at its multiplier: h - softness times multiplier.

    Args:
        p: number of the constraint; bounds and hard rows are not changed.
        multiplier: its multiplier.
        bound: right-hand sides with their softness (m,); overwritten.
        h: right-hand sides (m,).
        soft: softness of the rows (m,).
        n: number of variables.
    """
    if p >= 2 * n:
        bound[p - 2 * n] = h[p - 2 * n] - soft[p - 2 * n] * multiplier


@compiled
def _write_normal(p: int, normal: Array, G: Array) -> None:
    """Write the normal of constraint p, pointing inwards: n lower bounds, n upper bounds, then the rows.

    Args:
        p: number of the constraint.
        normal: out (n,).
        G: rows (m, n).
    """
    n = len(normal)
    if p < 2 * n:
        normal[:] = 0.0
        normal[p % n] = 1.0 if p < n else -1.0
    else:
        normal[:] = G[p - 2 * n]


@compiled
def _drop(N: Array, W: Array, S: Array, R: Array, active: IntArray, u: Array, leaving: int, count: int) -> None:
    """Remove constraint number `leaving` from the `count` active ones, and update the factor R.

    The constraint that is about to enter, number `count`, moves up with its multiplier.

    Args:
        N: normals (·, n).
        W: P⁻¹ times these (·, n).
        S: lower triangle of NᵀW.
        R: its Cholesky factor, see `extend_factor`.
        active: numbers of the active constraints.
        u: their multipliers, then that of the entering one.
        leaving: place of the constraint in `active`.
        count: number of active constraints.
    """
    for j in range(leaving, count):
        u[j], N[j], W[j] = u[j + 1], N[j + 1], W[j + 1]
    for j in range(leaving, count - 1):
        active[j] = active[j + 1]
        for c in range(j + 1):
            S[j, c] = S[j + 1, c if c < leaving else c + 1]
        extend_factor(S, R, j)


@compiled
def _slack(p: int, x: Array, G: Array, h: Array, lower: Array, upper: Array) -> float:
    """Compute the slack of constraint p at x, negative outside.

    Constraints are numbered: n lower bounds, n upper bounds, then the rows.

    Args:
        p: number of the constraint.
        x: point (n,).
        G: rows (m, n).
        h: right-hand sides (m,).
        lower: lower bounds (n,).
        upper: upper bounds (n,).
    """
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
    x: Array, G: Array, h: Array, lower: Array, upper: Array, is_satisfied: npt.NDArray[np.bool_]
) -> tuple[int, float]:
    """Find the most violated constraint at x, and its violation; NaN in a row is returned.

    Args:
        x: point (n,).
        G: rows (m, n).
        h: right-hand sides (m,).
        lower: lower bounds (n,).
        upper: upper bounds (n,).
        is_satisfied: constraints that are not considered (2 n + m,).

    Returns:
        Number of the constraint, and its violation, negative inside.
    """
    n = len(x)
    worst, violation = -1, -np.inf
    for i in range(n):
        if not (lower[i] - x[i] <= violation or is_satisfied[i]):
            worst, violation = i, lower[i] - x[i]
        if not (x[i] - upper[i] <= violation or is_satisfied[n + i]):
            worst, violation = n + i, x[i] - upper[i]
    for k in range(len(h)):
        if is_satisfied[2 * n + k]:
            continue
        outside = h[k]
        for i in range(n):
            outside -= G[k, i] * x[i]
        if not outside <= violation:
            worst, violation = 2 * n + k, outside
        if np.isnan(outside):
            break
    return worst, violation
