"""Who takes part: laws of this library with their settings, other libraries, and what users bring."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import PackageNotFoundError, distribution
from typing import Any

from qpavoid.arena.case import Case
from qpavoid.arena.outside.settings import MINK, PINK, PLACO, PLACO_PYTHON
from qpavoid.arena.pilot import Pilot
from qpavoid.arena.world import World
from qpavoid.config import ScenarioConfig, SolverConfig
from qpavoid.controller import Controller
from qpavoid.errors import ConfigError, UnknownName, nearest
from qpavoid.solvers import make_solver, parse_solver


@dataclass(frozen=True)
class Entrant:
    """One column of the report."""

    name: str
    says: str
    """What it is, in a line."""
    start: Callable[[Case, World], Pilot]
    """Sets it up for a case."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """What tells it from others of its kind; changes of it make results of their own."""
    packages: tuple[str, ...] = ()
    """What it runs on, as `pip install` knows it; where one is not installed, it does not take part."""
    elsewhere: str = ""
    """Environment variable that may name another Python interpreter that has its packages."""

    @property
    def digest(self) -> str:
        """Of its name and settings."""
        text = json.dumps([self.name, dict(self.settings)], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def missing(self) -> tuple[str, ...]:
        """Those of its packages that are not installed."""
        if self.elsewhere and os.environ.get(self.elsewhere):
            return ()
        return tuple(package for package in self.packages if not _installed(package))

    @property
    def remedy(self) -> str:
        """How to get what is missing."""
        instead = f", or set {self.elsewhere} to the Python interpreter that has it" if self.elsewhere else ""
        return f"pip install {' '.join(self.missing)}{instead}"


def law(name: str, says: str, solver: str | SolverConfig, packages: tuple[str, ...] = (), **changes: Any) -> Entrant:
    """A solver of this library, within a `Controller`.

    Args:
        name: of the entrant.
        says: what it is, in a line.
        solver: as in `eq10` or `qp:proxqp`, or with its settings.
        packages: what its back end needs.
        changes: blocks of the scenario that it has its own way, as in `avoidance={"row": {"type": "cbf"}}`; what is
            not named of a block stays as it is.
    """
    config = parse_solver(solver) if isinstance(solver, str) else solver

    def start(case: Case, world: World) -> Pilot:
        scenario = case.scenario.model_dump()
        for block, fields in changes.items():
            scenario[block] = {**scenario[block], **fields}
        scenario["solver"] = config.model_dump()
        x = ScenarioConfig.model_validate(scenario)
        blocks = x.avoidance, x.limits, x.tracking_damping, x.sensing, x.progress
        return Controller(world.scene, world.tasks, make_solver(x.solver), x.dt, *blocks)

    settings = {"solver": solver if isinstance(solver, str) else solver.model_dump(), **changes}
    return Entrant(name, says, start, settings, packages)


def outside(
    name: str, says: str, module: str, settings: Mapping[str, Any], packages: tuple[str, ...], elsewhere: str = ""
) -> Entrant:
    """Another library, through its adapter.

    Args:
        name: of the entrant.
        says: what it is, in a line.
        module: of the adapter, in `qpavoid.arena.outside`; read when the entrant is first started.
        settings: how it is set.
        packages: what it runs on.
        elsewhere: environment variable that may name another Python interpreter that has them.
    """

    def start(case: Case, world: World) -> Pilot:
        pilot: Pilot = import_module(f"qpavoid.arena.outside.{module}").Pilot(case, world)
        return pilot

    return Entrant(name, says, start, settings, packages, elsewhere)


def _law_alone(row: str) -> dict[str, Any]:
    """Avoidance rows of one kind, and no backup trajectory."""
    return {"row": {"type": row}, "escape": None}


ENTRANTS = {
    entrant.name: entrant
    for entrant in (
        law("tracking", "damped least squares on the task, no avoidance: the baseline", "tracking"),
        law("eq10", "task switching, eq. 10 with the consistent bracket", "eq10"),
        law("eq10-literal", "task switching, eq. 10 as printed", "eq10-literal"),
        law("gradient-projection", "tracking, clearance climbed in its null space", "gradient-projection"),
        law("potential-field", "tracking pulls, near pairs push: FIRAS at velocity level", "potential-field"),
        law("qp", "QP as each scenario has it, with a backup trajectory", "qp"),
        law(
            "qp-task-switching",
            "QP with the gains of eq. 10 in its rows, no backup trajectory",
            "qp",
            avoidance=_law_alone("task-switching"),
        ),
        law("qp-no-backup", "QP with beta rows, no backup trajectory", "qp", avoidance=_law_alone("beta")),
        law("qp-damper", "QP with velocity damper rows, no backup trajectory", "qp", avoidance=_law_alone("damper")),
        law("qp-cbf", "QP with control barrier rows, no backup trajectory", "qp", avoidance=_law_alone("cbf")),
        law(
            "qp-detour",
            "QP with beta rows that tries detours round what stalls it, no backup trajectory",
            "qp",
            avoidance=_law_alone("beta"),
            progress={"detour": {}},
        ),
        law("qp:native", "QP, compiled active-set method", "qp:native", ("numba",)),
        law("qp:daqp", "QP, back end daqp", "qp:daqp"),
        law("qp:proxqp", "QP, back end ProxQP", "qp:proxqp"),
        law("qp:osqp", "QP, back end OSQP", "qp:osqp"),
        law("qp:quadprog", "QP, back end quadprog", "qp:quadprog", ("quadprog",)),
        law("hqp", "strict priorities, a cascade of QPs, with a backup trajectory", "hqp"),
        outside("pink", "Pink, with its barrier between collision bodies", "pinks", PINK, ("pin-pink",)),
        outside("mink", "mink, with its limit on collisions", "minks", MINK, ("mink", "mujoco")),
        outside("placo", "placo, with its constraint on self-collisions", "placos", PLACO, ("placo",), PLACO_PYTHON),
    )
}
"""Those that ship, in the order of the report. One with the name of a solver is that solver in each scenario as it
is, safety options included; variants have names of their own."""


def find_entrant(name: str) -> Entrant:
    """One that ships.

    Raises:
        UnknownName: there is none of that name.
        ConfigError: it runs on something that is not installed.
    """
    if name not in ENTRANTS:
        raise UnknownName(f"unknown entrant {name!r}{nearest(name, ENTRANTS)}")
    entrant = ENTRANTS[name]
    if entrant.missing:
        raise ConfigError(f"entrant {name!r} needs {', '.join(entrant.missing)}: {entrant.remedy}")
    return entrant


def _installed(package: str) -> bool:
    try:
        distribution(package)
    except PackageNotFoundError:
        return False
    return True
