"""Entrants: solvers of this library with their settings, other libraries, and users' own."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import PackageNotFoundError, distribution
from typing import Any

from qpavoid import Controller
from qpavoid.config import ScenarioConfig, SolverConfig
from qpavoid.errors import ConfigError, UnknownName, nearest
from qpavoid.solvers import make_solver, parse_solver
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.library_pilot import DAMPING, LibraryPilot
from qpavoid_bench.arena.rollout import Pilot
from qpavoid_bench.arena.world import World
from qpavoid_bench.libraries import LIBRARIES, Library


@dataclass(frozen=True)
class Entrant:
    """One column of the report."""

    name: str
    description: str
    """Description in a line."""
    start: Callable[[Case, World], Pilot]
    """Function that sets the entrant up for a case."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings that distinguish it from others of its kind; changes of them make results of their own."""
    packages: tuple[str, ...] = ()
    """Packages that it needs, as `pip install` knows them; where one is not installed, it does not take part."""
    library: Library | None = None
    """Library that it is, which has an environment of its own."""

    @property
    def digest(self) -> str:
        """Return a digest of its name and settings."""
        text = json.dumps([self.name, dict(self.settings)], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def missing(self) -> tuple[str, ...]:
        """Return those of its packages that are not installed; of a library, all until its environment is made."""
        if self.library:
            return () if self.library.is_installed else self.library.requirements
        return tuple(package for package in self.packages if not _installed(package))

    def prepare(self) -> str:
        """Make the environment of a library if need be; return why it cannot take part, or nothing.

        Other packages are for the user to install.
        """
        try:
            if self.library:
                self.library.interpreter()
        except ConfigError as error:
            return str(error)
        return f"it needs {', '.join(self.missing)}: pip install {' '.join(self.missing)}" if self.missing else ""


def solver_entrant(
    name: str, description: str, solver: str | SolverConfig, packages: tuple[str, ...] = (), **changes: Any
) -> Entrant:
    """Return an entrant that runs a solver of this library within a `Controller`.

    Args:
        name: of the entrant.
        description: what it is, in a line.
        solver: as in `eq10` or `qp:proxqp`, or with its settings.
        packages: what its back end needs.
        changes: blocks of the scenario that it has its own way, as in `avoidance={"row": {"gain": 2.0}}`; what is
            not named of a block stays as it is.
    """
    config = parse_solver(solver) if isinstance(solver, str) else solver
    settings = {"solver": solver if isinstance(solver, str) else solver.model_dump(), **changes}
    return Entrant(name, description, partial(_start_solver, config, changes), settings, packages)


def _start_solver(solver: SolverConfig, changes: Mapping[str, Mapping[str, Any]], case: Case, world: World) -> Pilot:
    scenario = case.scenario.model_dump()
    for block, fields in changes.items():
        scenario[block] = {**(scenario[block] or {}), **fields}
    x = ScenarioConfig.model_validate({**scenario, "solver": solver.model_dump()})
    blocks = x.avoidance, x.limits, x.sensing, x.progress, world.contacts
    return Controller(
        world.scene, world.tasks, make_solver(x.solver), x.dt, *blocks, planning=x.planning_in_time, dynamics=x.dynamics
    )


def _library_entrant(library: Library) -> Entrant:
    """Return the entrant that a library is."""
    settings = {
        "given": library.settings,
        "targets": "one period ahead along the task's own law",
        "damping": f"{DAMPING} squared, where it takes any",
        **library.options,
    }
    start = partial(LibraryPilot, library)
    return Entrant(library.name, library.description, start, settings, library.packages, library)


def _qp_without_backup(name: str, description: str, row: str) -> Entrant:
    """Return the QP with rows of one kind and no backup trajectory."""
    changes = {"row": {"type": row}, "backup": False}
    return solver_entrant(name, f"QP with {description}, no backup trajectory", "qp", avoidance=changes)


ENTRANTS = {
    entrant.name: entrant
    for entrant in (
        solver_entrant("tracking", "damped least squares on the task, no avoidance: the baseline", "tracking"),
        solver_entrant("eq10", "task switching, eq. 10 with the consistent bracket", "eq10"),
        solver_entrant("eq10-literal", "task switching, eq. 10 as printed", "eq10-literal"),
        solver_entrant("gradient-projection", "tracking, clearance climbed in its null space", "gradient-projection"),
        solver_entrant(
            "potential-field", "tracking pulls, near pairs push: FIRAS at velocity level", "potential-field"
        ),
        solver_entrant("step-search", "the best collision-free step of a grid, one step ahead", "step-search"),
        solver_entrant("qp", "QP as each scenario has it, with a backup trajectory", "qp"),
        _qp_without_backup("qp-task-switching", "the gains of eq. 10 in its rows", "task-switching"),
        _qp_without_backup("qp-no-backup", "beta rows", "beta"),
        solver_entrant("qp-planning", "qp with forecasts, and what is driven where they fail", "qp", planning={}),
        solver_entrant("qp:native", "QP, compiled active-set method", "qp:native"),
        solver_entrant("qp:daqp", "QP, back end daqp", "qp:daqp"),
        solver_entrant("qp:proxqp", "QP, back end ProxQP", "qp:proxqp"),
        solver_entrant("qp:osqp", "QP, back end OSQP", "qp:osqp"),
        solver_entrant("qp:quadprog", "QP, back end quadprog", "qp:quadprog", ("quadprog",)),
        solver_entrant("hqp", "strict priorities, a cascade of QPs, with a backup trajectory", "hqp"),
        *(_library_entrant(library) for library in LIBRARIES.values()),
    )
}
"""Those that ship, in the order of the report. One with the name of a solver is that solver in each scenario as it
is, safety options included; variants have names of their own."""


def find_entrant(name: str) -> Entrant:
    """Return a shipped entrant that is ready; an environment of its own is made if need be.

    Raises:
        UnknownName: there is none of that name.
        ConfigError: it runs on something that is not installed.
    """
    if name not in ENTRANTS:
        raise UnknownName(f"unknown entrant {name!r}{nearest(name, ENTRANTS)}")
    entrant = ENTRANTS[name]
    if reason := entrant.prepare():
        raise ConfigError(f"entrant {name!r} cannot take part: {reason}")
    return entrant


def _installed(package: str) -> bool:
    """Return True if a package is installed."""
    try:
        distribution(package)
    except PackageNotFoundError:
        return False
    return True
