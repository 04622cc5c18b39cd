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
"""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.kernels.singular_values import orthogonalise
from qpavoid.kernels.straight_rows import scale_straight, solve_together
from qpavoid.kernels.task_curvature import add_curvature
from qpavoid.kernels.task_scaling import (
    APPROACH_RATE,
    UNLIMITED_SPEED,
    WEAK,
    joint_rate,
    scale_down,
    task_parts,
    task_sizes,
)
from qpavoid.problem import Array

_WEAK_SPEED = 0.3
"""Share of the joints' speeds that a weak direction may use [-]; it counts fully where a fifth more would be needed."""
_MISSING_SIZE = 0.01
"""σ_i²/l_i² from which a direction is not missing for good, whatever its curvature [-]."""
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
    curvature that 1 m or 1 rad makes, |w|. In a direction that several tasks share, |w| counts each by its part in u_i.

    Args:
        x: reads feedback, scale, dead_beat, row_tasks, bending_rows, straight_rows, v_max, dt, and what `add_curvature`
            does.
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
    damping = np.zeros(len(B))
    if not _follow_well_conditioned(x, B, rates, v):
        rates = rates.copy()
        B = _follow_bending(x, B, rates, v, damping)
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
def _follow_well_conditioned(x: Any, A: Array, b: Array, v: Array) -> bool:
    """Write v = A⁺b; return whether bounds show that the law gives the same.

    By a Cholesky factorisation of the Gram matrix, row by row: L Lᵀ = A Aᵀ; L y = b is solved as the rows of L are
    made, then Lᵀ z = y backwards, and v = Aᵀ z.
    """
    rows, nv = A.shape
    if rows > nv:
        return False
    L = np.empty((rows, rows))
    y, inverse = np.empty(rows), np.empty(rows)
    smallest, largest, sizes = np.inf, 0.0, np.zeros(x.row_tasks.max() + 1 if rows else 0)
    for i in range(rows):
        task = x.row_tasks[x.bending_rows[i]]
        for j in range(i + 1):
            dot = 0.0
            for c in range(nv):
                dot += A[i, c] * A[j, c]
            if task == x.row_tasks[x.bending_rows[j]]:
                sizes[task] += dot * dot if i == j else 2.0 * dot * dot
            for c in range(j):
                dot -= L[i, c] * L[j, c]
            if i == j:
                smallest, largest = min(smallest, dot), max(largest, dot)
                if not dot > 0.0 or smallest < _MIN_PIVOT_RATIO * largest:
                    return False
                inverse[i] = 1.0 / np.sqrt(dot)
                L[i, i] = dot * inverse[i]
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
    w, size = _curvature_weights(x, b, np.ones(rows)), 0.0
    for k in range(rows):
        size += w[k] * w[k]
    size = np.sqrt(size)
    inverse_size = _inverse_size(L, inverse)
    largest = np.sqrt(sizes.max()) if rows else 0.0
    if not _is_limited_by_nothing(x, v, largest, inverse_size, size):
        return False
    return 4.0 * size * inverse_size <= 1.0 or _bends_little(x, A, L, inverse, w, inverse_size)


@compiled
def _inverse_size(L: Array, inverse: Array) -> float:
    """Compute ‖(L Lᵀ)⁻¹‖ in the Frobenius norm, at least 1/σ_min²; `inverse` has 1/L_ii."""
    rows, square = len(L), 0.0
    columns = np.empty((rows, rows))  # of L⁻¹, one in each row
    for j in range(rows):
        for i in range(j, rows):
            total = 1.0 if i == j else 0.0
            for c in range(j, i):
                total -= L[i, c] * columns[j, c]
            columns[j, i] = total * inverse[i]
        for k in range(j + 1):
            product = 0.0
            for i in range(j, rows):
                product += columns[j, i] * columns[k, i]
            square += product * product if j == k else 2.0 * product * product
    return np.sqrt(square)


@compiled
def _is_limited_by_nothing(x: Any, v: Array, largest: float, inverse_size: float, size: float) -> bool:
    """Return whether neither speed limits nor those of weak directions change v = A⁺b.

    σ_min² is at least 1/`inverse_size`, l_i² at most WEAK² `largest`; no direction moves by more than ‖v‖.

    Args:
        x: reads v_max.
        v: (n,).
        largest: ‖J Jᵀ‖ of the largest task.
        inverse_size: see above.
        size: |w|.
    """
    square, slowest, rate = 0.0, UNLIMITED_SPEED, 0.0
    for c in range(len(v)):
        if v[c] != 0.0:
            square += v[c] * v[c]
            slowest = min(slowest, x.v_max[c])
            rate = max(rate, abs(v[c]) / min(x.v_max[c], UNLIMITED_SPEED))
    ratio = WEAK * WEAK * largest * inverse_size  # at least l²/σ_min²
    if rate > 1.0 or (_MISSING_SIZE * ratio > 1.0 and size > 0.0):
        return False
    weakness = _weakness(1.0 / ratio, rate) if ratio > 1.0 else 0.0
    return weakness == 0.0 or (weakness * np.sqrt(square) <= _WEAK_SPEED * slowest and square <= slowest * slowest)


@compiled
def _weakness(ratio: float, rate: float) -> float:
    """Compute how much the speed of a direction is limited: 0 for none, to 1.

    Args:
        ratio: σ_i²/l_i² [-].
        rate: of A⁺b, largest joint speed over its limit [-].
    """
    fast = min(max(5.0 * (rate / _WEAK_SPEED - 1.0), 0.0), 1.0)
    return max(1.0 - ratio, 0.0) * fast


@compiled
def _bends_little(x: Any, A: Array, L: Array, inverse: Array, w: Array, inverse_size: float) -> bool:
    """Return whether AᵀA + G(w) is positive on all that the rows move, so that no curvature c_i exceeds σ_i².

    So it is where ‖G‖ is below σ_min², at least 1/`inverse_size`. Else, with the basis Q = Aᵀ L⁻ᵀ of that space, it is
    Qᵀ G Q + Lᵀ L, whose Cholesky factor is made where it stands.
    """
    rows, nv = A.shape
    framed, others = len(x.feedback), 0.0
    for k in range(framed, rows):
        others += abs(w[k])
    G, Q, turned = np.zeros((nv, nv)), np.empty((rows, nv)), np.empty(nv)
    for part in range(framed // 3):
        add_curvature(x, part, w[3 * part : 3 * part + 3], G)
    square = 0.0
    for a in range(nv):
        for c in range(nv):
            square += G[a, c] * G[a, c]
    if (np.sqrt(square) + others) * inverse_size <= 1.0:
        return True
    H = np.empty((rows, rows))
    for i in range(rows):
        for c in range(nv):
            Q[i, c] = A[i, c]
            for j in range(i):
                Q[i, c] -= L[i, j] * Q[j, c]
            Q[i, c] *= inverse[i]
        for a in range(nv):
            turned[a] = 0.0
            for c in range(nv):
                turned[a] += G[a, c] * Q[i, c]
        for j in range(i + 1):
            H[i, j] = 0.0
            for c in range(nv):
                H[i, j] += turned[c] * Q[j, c]
            for k in range(i, rows):
                H[i, j] += L[k, i] * L[k, j]
        H[i, i] -= others
        for j in range(i + 1):
            for c in range(j):
                H[i, j] -= H[i, c] * H[j, c]
            if j < i:
                H[i, j] *= H[j, j]
        if not H[i, i] > 0.0:
            return False
        H[i, i] = 1.0 / np.sqrt(H[i, i])
    return True


@compiled
def _curvature_weights(x: Any, b: Array, g: Array) -> Array:
    """Compute w = (2 dt b + f/κ)/g of the rows that bend, given b/g and g (c,); f is all of b but of frames."""
    w = np.empty(len(b))
    for k in range(len(b)):
        r = x.bending_rows[k]
        feedback = x.feedback[r] / g[k] if r < len(x.feedback) else b[k]
        w[k] = x.scale[r] * (2.0 * x.dt * b[k] + feedback / APPROACH_RATE)
    return w


@compiled
def _follow_bending(x: Any, A: Array, b: Array, v: Array, damping: Array) -> Array:
    """Write the velocity of the law for the rows that bend, by their singular values; return σ_i v_iᵀ (c, n).

    Args:
        x: see `tracking_law`.
        A: the rows (c, n).
        b: in their velocity (c,), out b/g.
        v: out (n,).
        damping: out m_i - σ_i² (c,).
    """
    count, nv = A.shape
    v[:] = 0.0
    B, U, squares, weak = A.copy(), np.zeros((count, count)), np.zeros(count), np.zeros(count)
    orthogonalise(B, squares)
    largest = squares.max() if count else 0.0
    if largest == 0.0:
        return B
    for i in range(count):
        for k in range(count):  # u_i = A v_i / σ_i
            for c in range(nv):
                U[i, k] += A[k, c] * B[i, c]
            U[i, k] = U[i, k] / squares[i] if squares[i] > 0.0 else 0.0
    sizes, parts = task_sizes(x, U, squares), np.empty(x.row_tasks.max() + 1)
    for i in range(count):
        task_parts(x, U[i], parts)
        for task in range(len(parts)):
            weak[i] += WEAK * WEAK * parts[task] * sizes[task]
    g = np.ones(count)
    scale_down(x, B, U, squares, weak, b, g)
    rate = joint_rate(x, B, U, squares, np.zeros(count), b)
    w = _curvature_weights(x, b, g)
    framed, G = len(x.feedback), np.zeros((nv, nv))
    for part in range(framed // 3):
        add_curvature(x, part, w[3 * part : 3 * part + 3], G)
    direction = np.empty(nv)
    for i in range(count):
        if squares[i] == 0.0:
            continue
        y, size, curvature = 0.0, 0.0, 0.0
        task_parts(x, U[i], parts)
        parts /= parts.max()
        for k in range(count):
            pull = parts[x.row_tasks[x.bending_rows[k]]] * w[k]
            y += U[i, k] * b[k]
            size += pull * pull
            if x.bending_rows[k] >= framed:
                curvature += abs(pull)
        size = np.sqrt(size)
        m = max(squares[i], _TINY * largest)
        fastest = np.inf
        if squares[i] < max(4.0 * size, weak[i]):
            bent = 0.0
            for c in range(nv):
                direction[c] = B[i, c] / np.sqrt(squares[i])
            for a in range(nv):
                turn = 0.0
                for c in range(nv):
                    turn += G[a, c] * direction[c]
                curvature -= direction[a] * turn
                bent += turn * turn
            ratio = squares[i] / weak[i]
            if size > 0.0:
                m = max(m, max(0.0, 1.0 - squares[i] / (4.0 * size)) * curvature)
            m = max(m, max(0.0, 1.0 - ratio / _MISSING_SIZE) * (size - np.sqrt(bent) / _MISSING))
            weakness = _weakness(ratio, rate)
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
    return B
