"""An entrant that a user brings in a file of their own."""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from qpavoid.arena.case import Case
from qpavoid.arena.entrants import Entrant
from qpavoid.arena.pilot import Pilot
from qpavoid.arena.world import World
from qpavoid.config.text import read_text
from qpavoid.controller import Controller
from qpavoid.errors import ConfigError, UnknownName, nearest
from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, Problem, Solution, require_finite

_LARGEST = 10_000_000
"""Size of a Python file [bytes]."""
_KINDS = (
    "give a class with `solve(problem)`, made without arguments; a function of a problem; or, made from (case, world), "
    "what has `step(q, t, targets, obstacles)`"
)


def own_entrant(path: Path, name: str) -> Entrant:
    """The entrant that stands in a Python file; the file is run.

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
    text = read_text(path, _LARGEST)
    found = _find(text, path.name, name)
    if _kind(found) is None:
        raise ConfigError(f"{path}:{name}: cannot take part; {_KINDS}")
    says = (inspect.getdoc(found) or f"from {path.name}").partition("\n")[0]
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    return Entrant(name, says, partial(_start, text, path.name, name), {"file": path.name, "digest": digest})


def _start(text: str, file: str, name: str, case: Case, world: World) -> Pilot:
    found = _find(text, file, name)
    kind = _kind(found)
    if kind == "pilot":
        pilot: Pilot = found(case, world)
        return pilot
    solver = found() if kind == "solver" else None
    controller, _ = Controller.from_scenario(case.scenario)
    return _LawPilot(controller, solver.solve if solver else found, getattr(solver, "bounded", False))


def _kind(found: Any) -> str | None:
    """`solver`, `law` (a function of a problem) or `pilot`; None: neither."""
    if inspect.isclass(found):
        return "solver" if hasattr(found, "solve") else "pilot" if hasattr(found, "step") else None
    if not inspect.isfunction(found):
        return None
    needed = [p for p in inspect.signature(found).parameters.values() if p.default is p.empty]
    return {1: "law", 2: "pilot"}.get(len(needed))


class _LawPilot:
    """A law in its controller; what it raises is a failure of the entrant, not the braking stop that it ends in."""

    def __init__(self, controller: Controller, law: Callable[[Problem], Any], bounded: bool) -> None:
        self.bounded = bounded
        self._controller, self._law = controller, law
        self._raised: Exception | None = None
        controller.solver = self

    def solve(self, problem: Problem) -> Solution:
        """What the law says, which may be a velocity alone."""
        try:
            answer = self._law(problem)
            solution = answer if isinstance(answer, Solution) else Solution(np.asarray(answer, dtype=np.float64))
            require_finite("its velocity", solution.v, problem.lower.shape)
        except Exception as error:  # whatever a user's law does
            self._raised = error
            raise
        return solution

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        """Velocity to follow until the next tick."""
        self._raised = None
        solution = self._controller.step(q, t, targets, obstacles)
        if self._raised is not None:
            raise self._raised
        return solution


def _find(text: str, file: str, name: str) -> Any:
    module = _module(text, file)
    if not hasattr(module, name):
        own = [key for key, value in vars(module).items() if getattr(value, "__module__", None) == module.__name__]
        raise UnknownName(f"{file}: there is no {name!r} in it{nearest(name, own)}")
    return getattr(module, name)


@lru_cache(maxsize=32)
def _module(text: str, file: str) -> ModuleType:
    """The module of a file's text: the same in every process, wherever the file lies."""
    module = ModuleType(f"qpavoid_entrant_{hashlib.sha256(text.encode()).hexdigest()[:16]}")
    sys.modules[module.__name__] = module  # dataclasses and pickle look for it there
    try:
        exec(compile(text, file, "exec"), module.__dict__)
    except (Exception, SystemExit) as error:  # whatever a user's file does
        del sys.modules[module.__name__]
        raise ConfigError(f"{file}: cannot be run: {type(error).__name__}: {error}") from None
    return module
