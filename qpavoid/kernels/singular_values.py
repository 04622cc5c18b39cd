"""Singular values of small matrices, by rotations of their rows: M. R. Hestenes (1958), "Inversion of matrices by
biorthogonalization and related results", J. SIAM 6(1).

Small singular values come out to the last digits, which an eigenvalue problem of A Aᵀ would lose.
"""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array

_MAX_SWEEPS = 30
"""Rounds over all pairs of rows [-]: six are usual, as convergence is quadratic."""
_ORTHOGONAL = 1e-15
"""Cosine of two rows below which they count as orthogonal [-]: round-off."""
NEGLIGIBLE = 1e-12
"""Share of the largest singular value below which one counts as zero [-]: its direction would be round-off."""


@compiled
def orthogonalise(B: Array, squares: Array) -> None:
    """Turn the rows of B = A into σ_i v_iᵀ, with A = Σ σ_i u_i v_iᵀ, in any order.

    Args:
        B: in A, out σ_i v_iᵀ (c, n); zero where σ_i is negligible.
        squares: out σ_i² (c,).
    """
    (rows, columns), negligible = B.shape, 0.0
    for _ in range(_MAX_SWEEPS):
        largest = 0.0
        for i in range(rows):
            squares[i] = 0.0
            for c in range(columns):
                squares[i] += B[i, c] * B[i, c]
            largest = max(largest, squares[i])
        negligible = NEGLIGIBLE * NEGLIGIBLE * largest
        rotated = False
        for i in range(rows - 1):
            for j in range(i + 1, rows):
                product = 0.0
                for c in range(columns):
                    product += B[i, c] * B[j, c]
                if not (product * product > _ORTHOGONAL * _ORTHOGONAL * squares[i] * squares[j]):
                    continue
                if squares[i] <= negligible or squares[j] <= negligible:
                    continue
                rotated = True
                slope = 0.5 * (squares[j] - squares[i]) / product
                tangent = 1.0 / (abs(slope) + np.sqrt(1.0 + slope * slope))
                if slope < 0.0:
                    tangent = -tangent
                cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
                sine = tangent * cosine
                for c in range(columns):
                    first, second = B[i, c], B[j, c]
                    B[i, c], B[j, c] = cosine * first - sine * second, sine * first + cosine * second
                squares[i] -= tangent * product
                squares[j] += tangent * product
        if not rotated:
            break
    for i in range(rows):
        if squares[i] <= negligible:
            B[i] = 0.0
        squares[i] = 0.0
        for c in range(columns):
            squares[i] += B[i, c] * B[i, c]
