"""All back ends that qpsolvers finds installed."""

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
over P's smallest eigenvalue: with 1e-3 there, a gap of 1e-10 still leaves x off by 4e-4. With 1e-15,
clarabel was right on nearly all recorded problems and failed on easy random ones."""


def through_qpsolvers(
    name: str, options: dict[str, Any] | None = None
) -> Callable[[Array, Array, Array, Array, Array, Array], Array | None]:
    """Return a back end of qpsolvers.

    Args:
        name: as in `qpsolvers.available_solvers`.
        options: arguments of the back end; tight tolerances if left out.
    """
    options = _TIGHT.get(name, {}) if options is None else options
    sparse = name in qpsolvers.sparse_solvers and name not in qpsolvers.dense_solvers

    def solve(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
        convert = csc_matrix if sparse else np.asarray
        rows = {"G": convert(-G), "h": -h} if len(h) else {}
        problem = qpsolvers.Problem(convert(P), q, **rows, lb=lower, ub=upper)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "no solution" is an answer here, and not to be printed
            try:
                solution = qpsolvers.solve_problem(problem, solver=name, **options)
            except qpsolvers.exceptions.QPError:
                return None
        return solution.x if solution.found else None

    return solve
