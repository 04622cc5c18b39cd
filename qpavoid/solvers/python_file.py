"""Functions and classes from users' Python files, laws among them."""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from qpavoid.config import ScenarioConfig
from qpavoid.config.files import read_text
from qpavoid.config.loading import load_scenario
from qpavoid.errors import ConfigError, UnknownName, nearest
from qpavoid.problem import Problem, Solution, require_finite
from qpavoid.solvers.solver import Solver

MAX_FILE_SIZE = 10_000_000
"""Largest Python file that is read [bytes]: more is no source file."""


def load_attribute(text: str, file: str, name: str) -> Any:
    """Run a file's text as a module, the same wherever the file lies, and return what is called `name` in it.

    Args:
        text: of the file; what it defines can be sent to other processes that run the same text.
        file: its name, for messages.
        name: of a class or function.

    Raises:
        ConfigError, UnknownName: the text cannot be run, or there is nothing of that name in it.
    """
    module = _load_module(text, file)
    if not hasattr(module, name):
        own_names = [key for key, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__]
        raise UnknownName(f"{file}: there is no {name!r} in it{nearest(name, own_names)}")
    return getattr(module, name)


@lru_cache(maxsize=32)
def _load_module(text: str, file: str) -> ModuleType:
    module = ModuleType(f"qpavoid_file_{hashlib.sha256(text.encode()).hexdigest()[:16]}")
    sys.modules[module.__name__] = module  # dataclasses and pickle look for it there
    try:
        exec(compile(text, file, "exec"), module.__dict__)
    except (Exception, SystemExit) as error:  # whatever a user's file does
        del sys.modules[module.__name__]
        raise ConfigError(f"{file}: cannot be run: {type(error).__name__}: {error}") from None
    return module


class OwnLaw(Solver):
    """A user's law that is no `Solver`: a function of a problem, or what has such a `solve`."""

    def __init__(self, solve: Callable[[Problem], Any], name: str) -> None:
        self._solve, self._name = solve, name

    @property
    def label(self) -> str:
        """Name in its file."""
        return self._name

    def solve(self, problem: Problem) -> Solution:
        """Return the law's solution, which may be a velocity alone."""
        answer = self._solve(problem)
        solution = answer if isinstance(answer, Solution) else Solution(np.asarray(answer, dtype=np.float64))
        require_finite("its velocity", solution.v, problem.lower.shape)
        return solution


def names_file(name: str) -> bool:
    """Return whether a name is that of a law in a file, as in `my_law.py:MyLaw`, and not of one that ships."""
    return name.endswith(".py") or name.rpartition(":")[0].endswith(".py")


def scenario_with_law(
    name_or_path: str | Path, overrides: Sequence[str] = (), solver: str | None = None
) -> tuple[ScenarioConfig, Solver | None]:
    """Read a scenario, and the law that replaces its solver where that is given as `my_law.py:MyLaw`, else None.

    Args:
        name_or_path: as in `load_scenario`.
        overrides: as there.
        solver: as there, or the law of a Python file.

    Raises:
        ConfigError, UnknownName: the scenario or the law cannot be read.
    """
    if solver is not None and names_file(solver):
        return load_scenario(name_or_path, overrides), solver_from_file(solver)
    return load_scenario(name_or_path, overrides, solver), None


def solver_from_file(name: str) -> Solver:
    """Return the law of a Python file, given as `my_law.py:MyLaw`; the file is run.

    It is a class with `solve(problem)`, made without arguments, or a function of a problem that gives a `Solution` or
    a velocity (nv,).

    Raises:
        ConfigError, UnknownName: the file cannot be read or run, or there is no such law in it.
    """
    file, _, inside = name.rpartition(":")
    if not file:
        raise ConfigError(f"{name}: give FILE.py:NAME, with the class or function in it, as in my_law.py:MyLaw")
    candidate = load_attribute(read_text(Path(file), MAX_FILE_SIZE), Path(file).name, inside)
    if inspect.isfunction(candidate):
        return OwnLaw(candidate, inside)
    if not (inspect.isclass(candidate) and hasattr(candidate, "solve")):
        raise ConfigError(f"{name}: is no law; give a class with `solve(problem)`, or a function of a problem")
    try:
        law: Any = candidate()
    except Exception as error:  # whatever a user's law does
        raise ConfigError(f"{name}: cannot be made without arguments: {type(error).__name__}: {error}") from None
    if isinstance(law, Solver):
        return law
    wrapped = OwnLaw(law.solve, inside)
    for answer in ("bounded", "holds_contacts", "prioritised"):
        setattr(wrapped, answer, getattr(law, answer, getattr(wrapped, answer)))
    return wrapped
