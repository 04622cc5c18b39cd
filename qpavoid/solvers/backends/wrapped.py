"""Every back end that qpsolvers finds installed."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import qpsolvers
from scipy.sparse import csc_matrix

from qpavoid.problem import Array

_TIGHT: dict[str, dict[str, Any]] = {
    "piqp": {"eps_abs": 1e-10, "eps_rel": 0.0, "eps_duality_gap_abs": 1e-13, "eps_duality_gap_rel": 1e-14},
    "clarabel": {"tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-10},
    "scs": {"eps_abs": 1e-9, "eps_rel": 1e-10},
}
"""Tolerances by back end; exact (active-set) ones need none. An error in x is about the root of twice the duality gap
over P's smallest eigenvalue: with 1e-3 there, a gap of 1e-10 still leaves x off by 4e-4. Asked for 1e-15, clarabel was
right on nearly all recorded problems and gave up on easy random ones."""


def through_qpsolvers(
    name: str, options: dict[str, Any] | None = None
) -> Callable[[Array, Array, Array, Array, Array, Array], Array | None]:
    """The back end of that name in qpsolvers.

    Args:
        name: as in `qpsolvers.available_solvers`.
        options: given to the solver; tight tolerances if left out.
    """
    options = _TIGHT.get(name, {}) if options is None else options
    sparse = name in qpsolvers.sparse_solvers and name not in qpsolvers.dense_solvers

    def solve(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
        as_given = csc_matrix if sparse else np.asarray
        rows = {"G": as_given(-G), "h": -h} if len(h) else {}
        problem = qpsolvers.Problem(as_given(P), q, **rows, lb=lower, ub=upper)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "no solution" is an answer here, not news for the terminal
            try:
                solution = qpsolvers.solve_problem(problem, solver=name, **options)
            except qpsolvers.exceptions.QPError:
                return None
        return solution.x if solution.found else None

    return solve
