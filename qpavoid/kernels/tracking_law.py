"""The velocity that follows the tasks: J⁺ẋ, made calm where the tasks bend more than a control step can follow.

A = Σ σ_i u_i v_iᵀ are the task rows, b their velocity, of which f is feedback. Each task is scaled down to what its
joints can do, b/g. Gauss-Newton drops the curvature G(w) = Σ w_r ∂²x_r/∂q² of the rows, so that J⁺ overshoots in v_i
where dt |v_iᵀ G(b) v_i| > 2 σ_i², and bursts where σ_i vanishes. The law divides by the curvature where that is larger:

    v = Σ v_i σ_i y_i / m_i,   y = Uᵀ b/g,   m_i = max(σ_i², c_i, z_i),   w = (2 dt b + f/κ)/g
    c_i = max(0, 1 - σ_i²/4|w|) max(0, -v_iᵀ G(w) v_i),   z_i = max(0, 1 - 100 σ_i²/l_i²) max(0, |w| - 50 |G(w) v_i|)

c_i is what a Newton step divides by; z_i keeps off directions that the robot lacks for good. Below l_i, a tenth of the
size of its tasks, √‖J Jᵀ‖ in the Frobenius norm, v_i is weak: where A⁺b/g needs more than 0.3 of the speed limits of
the joints, m_i is so large that no joint of v_i is faster than that over 1 - σ_i²/l_i². The law is J⁺b/g, exactly,
where σ_i >= l_i and σ_i² >= 4|w|, and there is nothing to choose.

Rows that do not bend move the null space, too, where the others bend as well: a stretched arm's tool draws back by
½ γ_k of a motion along n_k. With r = Σ (1 - σ_i²/m_i) u_i u_iᵀ w, the part of w that is left undone, γ_k and n_k are
the eigenvalues and eigenvectors of G(r) on what those rows move of the null space; where nothing is left, r is 0.

From full reach, a target that comes back is followed by folding to either side, and one of them ends at the limits of
the joints. Where v_i is weak and v_iᵀ G(w) v_i > σ_i², with y_i v_i away from the middle of the joints' ranges, the
speed along v_i is turned round: the arm goes back over full reach, and folds to the other side.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.cholesky import dot
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.singular_values import orthogonalise
from qpavoid.kernels.straight_rows import bent_directions, scale_straight, solve_together
from qpavoid.kernels.task_curvature import add_curvature, curvature_weights
from qpavoid.kernels.task_scaling import (
    MISSING_SIZE,
    UNLIMITED_SPEED,
    WEAK_SPEED,
    joint_rate,
    scale_down,
    task_parts,
    weak_sizes,
    weakness,
)
from qpavoid.kernels.well_conditioned import follow_well_conditioned
from qpavoid.problem import Array

_MISSING = 0.02
"""Curvature along a direction, over |w|, below which the robot lacks the direction for good [m/m]."""
_CENTERING = 0.1
"""Motion of v_i away from the middle of the joints' ranges, over half of them, that turns it round [1/rad, 1/m]."""
_TINY = 1e-12
"""Least divisor, over σ_1² [-]."""


@compiled
def tracking_law(x: Any, A: Array, b: Array, v: Array, b_feasible: Array) -> float:
    """Write the velocity that follows the rows A v = b of all tasks.

    Rows of a constant A, as of postures, do not bend: they are scaled down to the joints' speeds, and solved together
    with the others, which get the rows √(m_i - σ_i²) v_iᵀ v = 0, and √|γ_k| n_kᵀ v = 0 in their null space. Tasks other
    than frames count with the largest curvature that 1 m or 1 rad makes, |w|, and not in γ_k. In a direction that
    several tasks share, |w| counts each by its part in u_i.

    Args:
        x: reads feedback, scale, dead_beat, row_tasks, bending_rows, straight_rows, v_max, centering, dt, and what
            `add_curvature` does.
        A: (r, n).
        b: (r,).
        v: out (n,), NaN where A or b has one [rad/s or m/s].
        b_feasible: out b/g (r,).

    Returns:
        How far the rows bend within a control step, dt ‖b/g‖, of each as far as its gain nears 1/dt: the
        regularization that keeps a QP calm [-].
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
    damping = np.zeros(len(B) + len(straight))
    if not follow_well_conditioned(x, B, rates, v):
        rates = rates.copy()
        B = _follow_bending(x, B, rates, v, damping, A[straight])
        for k in range(len(bending)):
            b_feasible[bending[k]] = rates[k]
    if len(straight):
        scale_straight(x, A, b_feasible)
        solve_together(A, b_feasible, B, damping, v)
    bent = 0.0
    for r in bending:
        part = x.scale[r] * x.dead_beat[r] * b_feasible[r]
        bent += part * part
    return x.dt * np.sqrt(bent)


@compiled
def _follow_bending(x: Any, A: Array, b: Array, v: Array, damping: Array, S: Array) -> Array:
    """Write the velocity of the law for the rows that bend, by their singular values.

    Args:
        x: see `tracking_law`.
        A: the rows (c, n).
        b: in their velocity (c,), out b/g.
        v: out (n,).
        damping: out m_i - σ_i² (c,), and of the directions of `bent_directions` (s,).
        S: rows that do not bend (s, n).

    Returns:
        σ_i v_iᵀ (c, n), and below it the directions of `bent_directions`, where there are any.
    """
    count, nv = A.shape
    v[:] = 0.0
    B, squares, g = A.copy(), np.zeros(count), np.ones(count)
    orthogonalise(B, squares)
    largest = squares.max() if count else 0.0
    if largest == 0.0:
        return B
    U = _left_vectors(A, B, squares)
    weak = weak_sizes(x, U, squares)
    scale_down(x, B, U, squares, weak, b, g)
    rate = joint_rate(x, B, U, squares, np.zeros(count), b)
    w, G = curvature_weights(x, b, g), np.zeros((nv, nv))
    for part in range(len(x.feedback) // 3):
        add_curvature(x, part, w[3 * part : 3 * part + 3], G)
    for i in range(count):
        if squares[i] > 0.0:
            y, size, others = _pull(x, U[i], b, w)
            m, curvature = _divisor(B[i], squares[i], weak[i], G, size, others)
            m = max(m, _TINY * largest)
            m = max(
                m, np.sqrt(squares[i]) * abs(y) / _fastest(x, B[i], squares[i], weakness(squares[i] / weak[i], rate))
            )
            damping[i] = m - squares[i]
            if squares[i] < min(weak[i], curvature):
                nearness = (1.0 - squares[i] / curvature) * (1.0 - squares[i] / weak[i])
                y *= _turn_round(x, B[i], y, squares[i], nearness)
            for c in range(nv):
                v[c] += B[i, c] * y / m
    if not len(S) or damping.max() == 0.0:
        return B
    lacking = np.zeros(count)
    for i in range(count):
        if damping[i] > 0.0:
            undone = damping[i] / (squares[i] + damping[i]) * dot(U[i], w)
            for k in range(count):
                lacking[k] += undone * U[i, k]
    G[:] = 0.0
    for part in range(len(x.feedback) // 3):
        add_curvature(x, part, lacking[3 * part : 3 * part + 3], G)
    return np.concatenate((B, bent_directions(S, B, squares, G, damping[count:])))


@compiled
def _turn_round(x: Any, row: Array, y: float, square: float, nearness: float) -> float:
    """Compute the factor on the speed along v_i near full reach: 1 towards the middle of the joints' ranges, -1 away.

    Args:
        x: reads centering.
        row: σ_i v_i (n,).
        y: y_i.
        square: σ_i².
        nearness: how near full reach is, (1 - σ_i²/v_iᵀ G(w) v_i) (1 - σ_i²/l_i²).
    """
    centering = 0.0
    for c in range(len(row)):
        centering += row[c] * x.centering[c]
    centering *= np.copysign(1.0, y) / np.sqrt(square)
    return 1.0 - 2.0 * nearness * min(max(-centering / _CENTERING, 0.0), 1.0)


@compiled
def _left_vectors(A: Array, B: Array, squares: Array) -> Array:
    """Compute u_iᵀ = (A v_i)ᵀ/σ_i (c, c), zero where σ_i is, given σ_i v_iᵀ and σ_i²."""
    count, nv = A.shape
    U = np.zeros((count, count))
    for i in range(count):
        if squares[i] > 0.0:
            for k in range(count):
                for c in range(nv):
                    U[i, k] += A[k, c] * B[i, c]
                U[i, k] /= squares[i]
    return U


@compiled
def _pull(x: Any, u: Array, b: Array, w: Array) -> tuple[float, float, float]:
    """Compute y_i = u·b, |w|, and the part of |w| from rows of tasks other than frames, of a direction u (c,).

    Rows count in |w| by the part of their task in u, over the largest one.
    """
    parts = np.empty(x.row_tasks.max() + 1)
    task_parts(x, u, parts)
    y, square, others, most = 0.0, 0.0, 0.0, parts.max()
    for k in range(len(u)):
        r = x.bending_rows[k]
        pull = parts[x.row_tasks[r]] / most * w[k]
        y += u[k] * b[k]
        square += pull * pull
        if r >= len(x.feedback):
            others += abs(pull)
    return y, np.sqrt(square), others


@compiled
def _divisor(row: Array, square: float, weak: float, G: Array, size: float, others: float) -> tuple[float, float]:
    """Compute max(σ_i², c_i, z_i), and v_iᵀ G(w) v_i.

    Args:
        row: σ_i v_i (n,).
        square: σ_i².
        weak: l_i².
        G: curvature of the frames (n, n).
        size: |w|.
        others: curvature of the other tasks.
    """
    if square >= max(4.0 * size, weak):
        return square, 0.0
    nv, curvature, bent = len(row), 0.0, 0.0
    for a in range(nv):
        turn = 0.0
        for c in range(nv):
            turn += G[a, c] * row[c]
        curvature -= row[a] * turn
        bent += turn * turn
    curvature, bent = curvature / square + others, bent / square
    m = max(square, max(0.0, 1.0 - square / weak / MISSING_SIZE) * (size - np.sqrt(bent) / _MISSING))
    return max(m, max(0.0, 1.0 - square / (4.0 * size)) * curvature) if size > 0.0 else m, -curvature


@compiled
def _fastest(x: Any, row: Array, square: float, limited: float) -> float:
    """Compute the speed along v_i at which no joint exceeds its share of the speed limits, infinite where none has.

    Args:
        x: reads v_max.
        row: σ_i v_i (n,).
        square: σ_i².
        limited: how much the speed of v_i is, see `weakness`.
    """
    fastest = np.inf
    if limited > 0.0:
        for c in range(len(row)):
            if row[c] != 0.0:
                fastest = min(fastest, min(x.v_max[c], UNLIMITED_SPEED) / abs(row[c]))
        fastest *= np.sqrt(square) * WEAK_SPEED / limited
    return fastest
