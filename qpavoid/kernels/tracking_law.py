"""The velocity that follows the tasks: J⁺ẋ, made calm where the tasks bend more than a control step can follow.

A = Σ σ_i u_i v_iᵀ are the task rows, b their velocity, of which f is feedback. Each task is scaled down to what its
joints can do, b/g. Gauss-Newton drops the curvature G(w) = Σ w_r ∂²x_r/∂q² of the rows, so that J⁺ overshoots in v_i
where dt |v_iᵀ G(b) v_i| > 2 σ_i², and bursts where σ_i vanishes. The law divides by the curvature where that is larger:

    v = Σ v_i σ_i y_i / m_i,   y = Uᵀ b/g,   m_i = max(σ_i², c_i, z_i),   w = (2 dt b + f/κ)/g
    c_i = max(0, 1 - σ_i²/4|w|) max(0, -v_iᵀ G(w) v_i),   z_i = max(0, 1 - σ_i²/l_i²) max(0, |w| - 50 |G(w) v_i|)

c_i is what a Newton step divides by; z_i keeps off directions that the robot lacks for good. Below l_i = 0.1 σ_1, v_i
is weak: m_i is large enough that no joint of it is faster than 0.3 v_max / (1 - σ_i²/l_i²). It is J⁺b/g, exactly, where
σ_i >= l_i and σ_i² >= 4|w|, and there is nothing to choose.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.kernels.singular_values import orthogonalise
from qpavoid.kernels.straight_rows import scale_straight, solve_together
from qpavoid.kernels.task_curvature import add_curvature
from qpavoid.kernels.task_scaling import UNLIMITED_SPEED, WEAK, scale_down
from qpavoid.problem import Array

_APPROACH_RATE = 20.0
"""κ: how fast a singular direction is approached at most [1/s]; finite, so that acceleration limits can follow."""
_WEAK_SPEED = 0.3
"""Share of the joints' speeds that a weak direction may use [-]."""
_MISSING = 0.02
"""Curvature along a direction, over |w|, below which the robot lacks the direction for good [m/m]."""
_MIN_PIVOT_RATIO = 1e-6
"""Ratio of the smallest to the largest pivot of A Aᵀ down to which A⁺ is taken from it [-]: half of the digits of a
double are left."""
_TINY = 1e-12
"""Least divisor, over σ_1² [-]."""


@compiled
def tracking_law(x: Any, A: Array, b: Array, v: Array, b_feasible: Array) -> float:
    """Write the velocity that follows the rows A v = b of all tasks.

    Rows of a constant A, as of postures, do not bend: they are scaled down to the joints' speeds, and solved together
    with the others, which get the rows √(m_i - σ_i²) v_iᵀ v = 0. Tasks other than frames count with the largest
    curvature that 1 m or 1 rad makes, |w|. In a direction that several tasks share, each counts by its part in u_i.

    Args:
        x: reads feedback, scale, row_tasks, bending_rows, straight_rows, gain_shares, v_max, dt, and what
            `add_curvature` does.
        A: (r, n).
        b: (r,).
        v: out (n,), NaN where A or b has one [rad/s or m/s].
        b_feasible: out b/g (r,).

    Returns:
        How far the rows bend within a control step, dt ‖b/g‖: the regularization that keeps a QP calm [-].
    """
    bending, straight = x.bending_rows, x.straight_rows
    size = 0.0
    for r in range(len(b)):
        b_feasible[r] = b[r]
        size += b[r] * b[r]
        for c in range(len(v)):
            size += A[r, c] * A[r, c]
    v[:] = 0.0
    if not size < np.inf:
        v[:] = np.nan
        return 0.0
    B, rates = (A, b) if not len(straight) else (A[bending], b[bending])
    damping = np.zeros(len(B))
    if not _follow_well_conditioned(x, B, rates, v):
        B, rates = B.copy(), rates.copy()
        _follow_bending(x, B, rates, v, damping)
        for k in range(len(bending)):
            b_feasible[bending[k]] = rates[k]
    if len(straight):
        scale_straight(x, A, b_feasible)
        solve_together(A, b_feasible, B, damping, v)
    bent = 0.0
    for r in bending:
        part = x.gain_shares[r] * x.scale[r] * b_feasible[r]
        bent += part * part
    return x.dt * np.sqrt(bent)


@compiled
def _follow_well_conditioned(x: Any, A: Array, b: Array, v: Array) -> bool:
    """Write v = A⁺b; return whether bounds show that the law gives the same.

    By a Cholesky factorisation of the Gram matrix, row by row: L Lᵀ = A Aᵀ; L y = b is solved as the rows of L are
    made, then Lᵀ z = y backwards, and v = Aᵀ z. In Frobenius norms, σ_min² >= 1/‖L⁻¹‖² and σ_1² <= ‖A Aᵀ‖.
    """
    rows, nv = A.shape
    if rows > nv:
        return False
    L = np.empty((rows, rows))
    y, inverse = np.empty(rows), np.empty(rows)
    smallest, largest, gram = np.inf, 0.0, 0.0
    for i in range(rows):
        for j in range(i + 1):
            dot = 0.0
            for c in range(nv):
                dot += A[i, c] * A[j, c]
            gram += dot * dot if i == j else 2.0 * dot * dot
            for c in range(j):
                dot -= L[i, c] * L[j, c]
            if i == j:
                smallest, largest = min(smallest, dot), max(largest, dot)
                if not dot > 0.0 or smallest < _MIN_PIVOT_RATIO * largest:
                    return False
                inverse[i] = 1.0 / np.sqrt(dot)
            else:
                L[i, j] = dot * inverse[j]
        total = b[i]
        for c in range(i):
            total -= L[i, c] * y[c]
        y[i] = total * inverse[i]
    v[:] = 0.0
    for i in range(rows - 1, -1, -1):
        y[i] *= inverse[i]
        for c in range(i):
            y[c] -= L[i, c] * y[i]
        for c in range(nv):
            v[c] += A[i, c] * y[i]
    inverse_square = 0.0
    for j in range(rows):  # columns of L⁻¹
        for i in range(j, rows):
            total = 1.0 if i == j else 0.0
            for c in range(j, i):
                total -= L[i, c] * y[c]
            y[i] = total * inverse[i]
            inverse_square += y[i] * y[i]
    is_weak = WEAK * WEAK * np.sqrt(gram) * inverse_square > 1.0
    return _is_within_speeds(x, v, is_weak) and _bends_little(x, b, inverse_square)


@compiled
def _is_within_speeds(x: Any, v: Array, is_weak: bool) -> bool:
    """Return whether neither the speed limits nor, if any direction is weak, the limits of those change v."""
    square, slowest, excess = 0.0, UNLIMITED_SPEED, 0.0
    for c in range(len(v)):
        square += v[c] * v[c]
        slowest = min(slowest, x.v_max[c])
        excess = max(excess, abs(v[c]) - x.v_max[c])
    return square <= _WEAK_SPEED * _WEAK_SPEED * slowest * slowest if is_weak else excess <= 0.0


@compiled
def _bends_little(x: Any, b: Array, inverse_square: float) -> bool:
    """Return whether σ_min² is above 4|w|, or above any curvature; 1/`inverse_square` is below σ_min²."""
    w = _curvature_weights(x, b, np.ones(len(b)))
    size, framed = 0.0, len(x.feedback)
    for k in range(len(w)):
        size += w[k] * w[k]
    size = np.sqrt(size)
    if not len(b) or 4.0 * size * inverse_square <= 1.0:
        return True
    if len(b) > framed:
        return False
    G, bound = np.empty((len(x.v_max), len(x.v_max))), 0.0
    for f in range(len(x.poses)):
        G[:] = 0.0
        for part in range(framed // 3):
            if x.row_tasks[3 * part] == f:
                add_curvature(x, part, w[3 * part : 3 * part + 3], G)
        square = 0.0
        for i in range(len(G)):
            for j in range(len(G)):
                square += G[i, j] * G[i, j]
        bound += np.sqrt(square)
    return bound * inverse_square <= 1.0


@compiled
def _curvature_weights(x: Any, b: Array, g: Array) -> Array:
    """Compute w = (2 dt b + f/κ)/g of the rows that bend, given b/g and g (c,); f is all of b but of frames."""
    w = np.empty(len(b))
    for k in range(len(b)):
        r = x.bending_rows[k]
        feedback = x.feedback[r] / g[k] if r < len(x.feedback) else b[k]
        w[k] = x.scale[r] * (2.0 * x.dt * b[k] + feedback / _APPROACH_RATE)
    return w


@compiled
def _follow_bending(x: Any, B: Array, b: Array, v: Array, damping: Array) -> None:
    """Write the velocity of the law for the rows that bend, by their singular values.

    Args:
        x: see `tracking_law`.
        B: in the rows (c, n), out σ_i v_iᵀ.
        b: in their velocity (c,), out b/g.
        v: out (n,).
        damping: out m_i - σ_i² (c,).
    """
    count, nv = B.shape
    v[:] = 0.0
    U, squares, weak = np.empty((count, count)), np.zeros(count), np.zeros(count)
    orthogonalise(B, U)
    heaviest = 0.0
    for i in range(count):
        for c in range(nv):
            squares[i] += B[i, c] * B[i, c]
        heaviest = max(heaviest, x.scale[x.bending_rows[i]])
    largest = squares.max() if count else 0.0
    if largest == 0.0:
        return
    for i in range(count):
        for k in range(count):
            weight = U[i, k] * x.scale[x.bending_rows[k]] / heaviest
            weak[i] += WEAK * WEAK * largest * weight * weight
    g = np.ones(count)
    scale_down(x, B, U, squares, weak, b, g)
    w = _curvature_weights(x, b, g)
    frames, framed = len(x.poses), len(x.feedback)
    G = np.zeros((frames, nv, nv))
    for part in range(framed // 3):
        add_curvature(x, part, w[3 * part : 3 * part + 3], G[x.row_tasks[3 * part]])
    shares = np.empty(x.row_tasks.max() + 1)
    direction = np.empty(nv)
    for i in range(count):
        if squares[i] == 0.0:
            continue
        y, size, curvature = 0.0, 0.0, 0.0
        _task_shares(x, U[i], shares)
        for k in range(count):
            share = shares[x.row_tasks[x.bending_rows[k]]] * w[k]
            y += U[i, k] * b[k]
            size += share * share
            if x.bending_rows[k] >= framed:
                curvature += abs(share)
        size = np.sqrt(size)
        m = max(squares[i], _TINY * largest)
        fastest = np.inf
        if squares[i] < max(4.0 * size, weak[i]):
            bent = 0.0
            for c in range(nv):
                direction[c] = B[i, c] / np.sqrt(squares[i])
            for a in range(nv):
                turn = 0.0
                for f in range(frames):
                    for c in range(nv):
                        turn += shares[f] * G[f, a, c] * direction[c]
                curvature -= direction[a] * turn
                bent += turn * turn
            weakness = max(0.0, 1.0 - squares[i] / weak[i])
            if size > 0.0:
                m = max(m, max(0.0, 1.0 - squares[i] / (4.0 * size)) * curvature)
            m = max(m, weakness * (size - np.sqrt(bent) / _MISSING))
            if weakness > 0.0:
                for c in range(nv):
                    if direction[c] != 0.0:
                        fastest = min(fastest, min(x.v_max[c], UNLIMITED_SPEED) / abs(direction[c]))
                fastest *= _WEAK_SPEED / weakness
        speed = np.sqrt(squares[i]) * abs(y)
        if speed > m * fastest:
            m = speed / fastest
        damping[i] = max(m - squares[i], 0.0)
        for c in range(nv):
            v[c] += B[i, c] * y / m


@compiled
def _task_shares(x: Any, u: Array, shares: Array) -> None:
    """Write the part of each task in a direction u (c,) of the rows that bend, over the largest one."""
    shares[:] = 0.0
    for k in range(len(u)):
        shares[x.row_tasks[x.bending_rows[k]]] += u[k] * u[k]
    largest = shares.max()
    for task in range(len(shares)):
        shares[task] /= largest
