"""The tracking law where rows are well conditioned: A⁺b, and bounds that show that the law gives no other velocity."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.kernels.task_curvature import add_curvature, curvature_weights
from qpavoid.kernels.task_scaling import MISSING_SIZE, UNLIMITED_SPEED, WEAK, WEAK_SPEED, weakness
from qpavoid.problem import Array

_MIN_PIVOT_RATIO = 1e-6
"""Ratio of the smallest to the largest pivot of A Aᵀ down to which A⁺ is taken from it [-]: half of the digits of a
double are left."""


@compiled
def follow_well_conditioned(x: Any, A: Array, b: Array, v: Array) -> bool:
    """Write v = A⁺b; return whether bounds show that the law gives the same."""
    rows, nv = A.shape
    if rows > nv:
        return False
    L, y, inverse = np.empty((rows, rows)), np.empty(rows), np.empty(rows)
    largest = _factorise_gram(x, A, b, L, y, inverse)
    if largest < 0.0:
        return False
    v[:] = 0.0
    for i in range(rows - 1, -1, -1):  # v = Aᵀ L⁻ᵀ y
        y[i] *= inverse[i]
        for c in range(i):
            y[c] -= L[i, c] * y[i]
        for c in range(nv):
            v[c] += A[i, c] * y[i]
    w, size = curvature_weights(x, b, np.ones(rows)), 0.0
    for k in range(rows):
        size += w[k] * w[k]
    size, inverse_size = np.sqrt(size), _inverse_size(L, inverse)
    if not _is_limited_by_nothing(x, v, largest, inverse_size, size):
        return False
    return 4.0 * size * inverse_size <= 1.0 or _bends_little(x, A, L, inverse, w, inverse_size)


@compiled
def _factorise_gram(x: Any, A: Array, b: Array, L: Array, y: Array, inverse: Array) -> float:
    """Write the Cholesky factor of A Aᵀ = L Lᵀ (c, c), y = L⁻¹ b and 1/L_ii (c,), row by row.

    Returns:
        ‖J Jᵀ‖ of the largest task, in the Frobenius norm; -1 where A is not well conditioned.
    """
    rows, nv = A.shape
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
                    return -1.0
                inverse[i] = 1.0 / np.sqrt(dot)
                L[i, i] = dot * inverse[i]
            else:
                L[i, j] = dot * inverse[j]
        total = b[i]
        for c in range(i):
            total -= L[i, c] * y[c]
        y[i] = total * inverse[i]
    return np.sqrt(sizes.max()) if rows else 0.0


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
    if rate > 1.0 or (MISSING_SIZE * ratio > 1.0 and size > 0.0):
        return False
    limited = weakness(1.0 / ratio, rate) if ratio > 1.0 else 0.0
    return limited == 0.0 or (limited * np.sqrt(square) <= WEAK_SPEED * slowest and square <= slowest * slowest)


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
