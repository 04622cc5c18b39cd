"""Solvers, the exchangeable part of a control step: Problem in, Solution out.

A solver derives from `Solver`; those that ship are listed in SOLVERS and chosen by name.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pydantic import TypeAdapter, ValidationError

from qpavoid.config import SolverConfig, expand_solver
from qpavoid.errors import ConfigError, UnknownName, nearest
from qpavoid.solvers.analytic import Eq10, TrackingOnly
from qpavoid.solvers.backends import backend_names
from qpavoid.solvers.baselines import GradientProjection, PotentialField
from qpavoid.solvers.hqp import Hqp
from qpavoid.solvers.qp import Qp
from qpavoid.solvers.solver import Solver, check_solver
from qpavoid.solvers.step_search import StepSearch

SOLVERS: dict[str, Callable[[Any], Solver]] = {
    "tracking": TrackingOnly,
    "eq10": Eq10,
    "eq10-literal": Eq10,
    "gradient-projection": GradientProjection,
    "potential-field": PotentialField,
    "step-search": StepSearch,
    "qp": Qp,
    "hqp": Hqp,
}


def parse_solver(name: str, settings: SolverConfig | None = None) -> SolverConfig:
    """Return the configuration of a short form such as `eq10` or `qp:proxqp`.

    Args:
        name: the short form.
        settings: used where they are of the same solver, but for what `name` says.

    Raises:
        ConfigError, UnknownName: there is no such solver, or it takes no back end.
    """
    fields = expand_solver(name)
    if settings is not None and settings.name == fields["name"]:
        fields = {**settings.model_dump(), **fields}
    try:
        return TypeAdapter[SolverConfig](SolverConfig).validate_python(fields)
    except ValidationError:
        if fields["name"] in SOLVERS:
            raise ConfigError(f"solver {name!r}: {fields['name']} takes no backend; only qp and hqp do") from None
        raise UnknownName(f"unknown solver {name!r}{nearest(fields['name'], SOLVERS)}") from None


def make_solver(config: SolverConfig | str) -> Solver:
    """Return a new solver of a configuration block or a short form.

    Args:
        config: block of the scenario, or short form.

    Raises:
        ConfigError, UnknownName, SolverNotInstalled: of the solver or the QP's back end.
    """
    config = parse_solver(config) if isinstance(config, str) else config
    return SOLVERS[config.name](config)


__all__ = ["SOLVERS", "Solver", "backend_names", "check_solver", "make_solver", "parse_solver"]
