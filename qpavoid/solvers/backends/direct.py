"""daqp, called without a wrapper."""

from __future__ import annotations

import ctypes

import daqp
import numpy as np

from qpavoid.problem import Array

_INFINITY = 1e30
"""What daqp takes for no bound."""


class Daqp:
    """Dual active-set method (Arnström et al. 2022). Bounds stay bounds.

    Always started cold: keeping daqp's own workspace and active set saved about 2 µs a call, but after a bound of the
    active set had become infinite it called points optimal that were feasible and off the minimum by more than 1 rad/s.
    """

    def __init__(self) -> None:
        self._grow(64)

    def _grow(self, size: int) -> None:
        self._above, self._below = np.full(size, _INFINITY), np.empty(size)
        self._sense = np.zeros(size, dtype=ctypes.c_int)

    def __call__(self, P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
        """Minimiser of ½ xᵀP x + qᵀx subject to G x >= h, lower <= x <= upper; None where daqp finds none."""
        n, size = len(q), len(q) + len(h)
        if size > len(self._sense):
            self._grow(2 * size)
        above, below = self._above[:size], self._below[:size]
        above[:n], above[n:] = upper, _INFINITY
        below[:n], below[n:] = lower, h
        x, _, flag, _ = daqp.solve(P, q, G, above, below, self._sense[:size], primal_tol=1e-9, dual_tol=1e-12)
        return np.asarray(x) if flag == 1 else None


def solve_daqp(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
    """One call of daqp that keeps no memory."""
    return Daqp()(P, q, G, h, lower, upper)
