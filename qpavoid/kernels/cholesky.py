"""Cholesky factors of small matrices, row by row, with inverted diagonals."""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array


@compiled
def dot(a: Array, b: Array) -> float:
    """Compute aᵀb of two vectors (n,)."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@compiled
def factorise(M: Array, L: Array, n: int) -> None:
    """Write to L the lower Cholesky factor of the first n rows and columns of M; see `extend_factor`."""
    for i in range(n):
        extend_factor(M, L, i)


@compiled
def extend_factor(M: Array, L: Array, i: int) -> None:
    """Write row i of the Cholesky factor L of M, given the rows before.

    It is NaN where M is not positive definite. The diagonal has the inverses: 1 / L_ii, as divisions are slow.
    """
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
def solve_factored(L: Array, b: Array, y: Array, n: int) -> None:
    """Solve L Lᵀ y = b of the first n rows and columns; the diagonal of L is inverted."""
    for i in range(n):
        total = b[i]
        for c in range(i):
            total -= L[i, c] * y[c]
        y[i] = total * L[i, i]
    for i in range(n - 1, -1, -1):
        y[i] *= L[i, i]
        for c in range(i):
            y[c] -= L[i, c] * y[i]
