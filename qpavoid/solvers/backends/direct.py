"""daqp, called without a wrapper."""

from __future__ import annotations

import ctypes

import daqp
import numpy as np

from qpavoid.problem import Array

_INFINITY = 1e30
"""Bound from which daqp takes a side as unbounded [-]: its own constant DAQP_INF."""


class Daqp:
    """Dual active-set method (Arnström et al. 2022), with bounds as bounds.

    Every call is a cold start: daqp's own workspace and active set saved about 2 µs a call, but after a bound of the
    active set had become infinite, points were reported as optimal that were off the minimum by more than 1 rad/s.
    """

    def __init__(self) -> None:
        self._allocate(64)

    def _allocate(self, size: int) -> None:
        """Allocate memory for `size` constraints."""
        self._above, self._below = np.full(size, _INFINITY), np.empty(size)
        self._sense = np.zeros(size, dtype=ctypes.c_int)

    def __call__(self, P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
        """Compute the solution of a QP, see `Backend`; None where daqp finds none."""
        n, size = len(q), len(q) + len(h)
        if size > len(self._sense):
            self._allocate(2 * size)
        above, below = self._above[:size], self._below[:size]
        above[:n], above[n:] = upper, _INFINITY
        below[:n], below[n:] = lower, h
        x, _, flag, _ = daqp.solve(P, q, G, above, below, self._sense[:size], primal_tol=1e-9, dual_tol=1e-12)
        return np.asarray(x) if flag == 1 else None


def solve_daqp(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
    """Compute the same as `Daqp`, without memory between calls."""
    return Daqp()(P, q, G, h, lower, upper)
