"""Entrants from users' Python files."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from qpavoid import Controller, Solver
from qpavoid.config.files import read_text
from qpavoid.errors import ConfigError
from qpavoid.model.sample import Sample
from qpavoid.problem import Array, Problem, Solution
from qpavoid.solvers.python_file import MAX_FILE_SIZE, OwnLaw, load_attribute
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.entrants import Entrant
from qpavoid_bench.arena.rollout import Pilot
from qpavoid_bench.arena.world import World

_ACCEPTED = (
    "give a class with `solve(problem)`, made without arguments; a function of a problem; or, made from (case, world), "
    "what has `step(q, t, targets, obstacles)`"
)


def entrant_from_file(path: Path, name: str) -> Entrant:
    """Return the entrant of a Python file; the file is run.

    It may be one of

    - a class with `solve(problem)`, made without arguments: a `Solver`, which runs within a `Controller`;
    - a function of one argument, the problem, that gives a `Solution` or a velocity (nv,): the same;
    - a class with `step(q, t, targets, obstacles)`, made from (case, world): a `Pilot`;
    - a function of two arguments, (case, world), that gives such a pilot.

    Its digest covers the text of the file, which travels with it to wherever it runs; not what that imports.

    Args:
        path: the file.
        name: of the class or function in it, and of the entrant.

    Raises:
        ConfigError, UnknownName: the file cannot be read or run, or there is no such entrant in it.
    """
    text = read_text(path, MAX_FILE_SIZE)
    candidate = load_attribute(text, path.name, name)
    if _classify(candidate) is None:
        raise ConfigError(f"{path}:{name}: cannot take part; {_ACCEPTED}")
    description = (inspect.getdoc(candidate) or f"from {path.name}").partition("\n")[0]
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    return Entrant(
        name, description, partial(_start_pilot, text, path.name, name), {"file": path.name, "digest": digest}
    )


def _start_pilot(text: str, file: str, name: str, case: Case, world: World) -> Pilot:
    """Set the entrant of a file's text up for a case."""
    candidate = load_attribute(text, file, name)
    kind = _classify(candidate)
    if kind == "pilot":
        pilot: Pilot = candidate(case, world)
        return pilot
    solver = candidate() if kind == "solver" else None
    controller, _ = Controller.from_scenario(case.scenario)
    return _SolverPilot(
        controller, OwnLaw(solver.solve if solver else candidate, name), getattr(solver, "bounded", False)
    )


def _classify(candidate: Any) -> str | None:
    """Return `solver`, `law` (a function of a problem), `pilot` or None for none of these."""
    if inspect.isclass(candidate):
        return "solver" if hasattr(candidate, "solve") else "pilot" if hasattr(candidate, "step") else None
    if not inspect.isfunction(candidate):
        return None
    required = [p for p in inspect.signature(candidate).parameters.values() if p.default is p.empty]
    return {1: "law", 2: "pilot"}.get(len(required))


class _SolverPilot(Solver):
    """A user's solver in a controller.

    An exception of the solver is a failure of the entrant, not the braking stop that the controller makes of it.
    """

    def __init__(self, controller: Controller, law: OwnLaw, bounded: bool) -> None:
        self.bounded = bounded
        self._controller, self._law = controller, law
        self._error: Exception | None = None
        controller.solver = self

    def solve(self, problem: Problem) -> Solution:
        """Return the solver's solution, which may be a velocity alone."""
        try:
            return self._law.solve(problem)
        except Exception as error:  # whatever a user's law does
            self._error = error
            raise

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        """Compute the velocity to follow until the next step."""
        self._error = None
        solution = self._controller.step(q, t, targets, obstacles)
        if self._error is not None:
            raise self._error
        return solution
