"""What the arguments of a control step usually are: finite, within wide bounds, with nothing to normalise."""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.obstacles import EXACT, FARTHEST, FASTEST, FINE, SAMPLE, check_state
from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array


@compiled
def take_usual(q: Array, bounds: Array, squares: Array, targets: Array, taken: Array) -> bool:
    """Copy a configuration if it, and the states of some targets, can be true as they are.

    Args:
        q: configuration (nq,), strided at will.
        bounds: (3, nq) least and largest value of each coordinate, and the number of the part of length 1 that it
            belongs to, negative for none.
        squares: scratch, an entry for each such part.
        targets: (f, 18) states.
        taken: out (nq,); not changed where anything is not as usual.

    Returns:
        Whether all is as usual; NaN is not.
    """
    usual, squares[:] = True, 0.0
    for i in range(len(q)):
        usual = usual and bounds[0, i] <= q[i] <= bounds[1, i]
        if bounds[2, i] >= 0.0:
            squares[int(bounds[2, i])] += q[i] * q[i]
    for square in squares:
        usual = usual and abs(np.sqrt(square) - 1.0) <= EXACT
    for state in targets:
        usual = usual and check_state(state, SAMPLE, FARTHEST, FASTEST)[0] == FINE
    if usual:
        for i in range(len(q)):
            taken[i] = q[i]
    return usual
