"""QP back ends behind one call: min ½ xᵀP x + qᵀx subject to G x >= h, lower <= x <= upper.

daqp, proxqp and osqp are called without a wrapper, the last two with a persistent, warm-started workspace for each
size; every other one through qpsolvers. All have tight tolerances: the result is a velocity, and an error of 1e-2 rad/s
is a fault even where the back end reports success.
"""

from __future__ import annotations

from collections.abc import Callable

import qpsolvers

from qpavoid.errors import SolverNotInstalled, UnknownName
from qpavoid.problem import Array
from qpavoid.solvers.backends.direct import Daqp, solve_daqp
from qpavoid.solvers.backends.persistent import OsqpWorkspace, Persistent, ProxqpWorkspace
from qpavoid.solvers.backends.wrapped import through_qpsolvers

Backend = Callable[[Array, Array, Array, Array, Array, Array], "Array | None"]
"""(P, q, G, h, lower, upper) -> x, or None where no solution was found.

P (n, n) is symmetric and positive definite, G (m, n) C-contiguous; m may be 0 and change from call to call; bounds may
be infinite. A back end belongs to one thread: it has memory between calls, but no call depends on another one.
"""

_NATIVE: dict[str, Callable[[], Backend]] = {
    "daqp": Daqp,
    "proxqp": lambda: Persistent(ProxqpWorkspace),
    "osqp": lambda: Persistent(OsqpWorkspace),
}
"""Back ends that are called without qpsolvers, by name."""

_PACKAGES = {"jaxopt_osqp": "jaxopt", "mosek": "Mosek", "highs": "highspy", "gurobi": "gurobipy", "proxqp": "proxsuite",
             "qpoases": "qpoases", "hpipm": "hpipm-python"}  # fmt: skip
"""Package to install of each back end whose package has another name."""
_KNOWN = {
    *("clarabel", "cvxopt", "ecos", "gurobi", "highs", "hpipm", "jaxopt_osqp", "kvxopt", "mosek", "nppro", "osqp"),
    *("pdlp", "piqp", "proxqp", "pyqpmad", "qpalm", "qpax", "qpoases", "qpswift", "quadprog", "scs", "sip"),
}
"""Names of the back ends that qpsolvers supports, installed or not."""


def backend_names() -> list[str]:
    """Return the names of the installed back ends, daqp first."""
    return ["daqp", *sorted({*_NATIVE, *qpsolvers.available_solvers} - {"daqp"})]


def make_backend(name: str) -> Backend:
    """Return a new back end.

    Args:
        name: one of `backend_names`.

    Raises:
        SolverNotInstalled: qpsolvers knows it, but its package is missing.
        UnknownName: neither this package nor qpsolvers knows it.
    """
    if name in _NATIVE:
        return _NATIVE[name]()
    if name in qpsolvers.available_solvers:
        return through_qpsolvers(name)
    usable = ", ".join(backend_names())
    if name in _KNOWN:
        raise SolverNotInstalled(
            f"QP back end {name!r} is not installed: pip install {_PACKAGES.get(name, name)}; usable now: {usable}"
        )
    raise UnknownName(f"unknown QP back end {name!r}; usable are {usable}")


__all__ = ["Backend", "Daqp", "backend_names", "make_backend", "solve_daqp"]
