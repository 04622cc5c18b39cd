"""Suites: entrants, families and seeds that run together; a YAML file each."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from qpavoid.config import Avoidance, Limits, Progress, Sensing, SolverConfig
from qpavoid.config.base import Block
from qpavoid.config.loading import read_config
from qpavoid.config.shipped import find_shipped
from qpavoid.errors import ConfigError, located
from qpavoid_bench.arena.entrant_file import entrant_from_file
from qpavoid_bench.arena.entrants import ENTRANTS, Entrant, find_entrant, solver_entrant
from qpavoid_bench.arena.families import Family, load_family

MAX_SEEDS = 1_000_000


class EntrantConfig(Block):
    """A solver of this library with settings of one's own."""

    name: Annotated[str, Field(min_length=1)]
    """Name under which it appears."""
    description: str = ""
    """Description in a line."""
    solver: SolverConfig
    """Solver, as in a scenario."""
    avoidance: Avoidance | None = None
    """Fields that replace those of every scenario; the blocks below do the same."""
    limits: Limits | None = None
    sensing: Sensing | None = None
    progress: Progress | None = None

    def entrant(self) -> Entrant:
        """Return the entrant that it configures."""
        fields = self.model_dump(exclude_unset=True)
        changes = {
            block: fields[block] for block in ("avoidance", "limits", "sensing", "progress") if fields.get(block)
        }
        return solver_entrant(self.name, self.description or self.solver.label, self.solver, **changes)


class SuiteConfig(Block):
    """A file of tasks/suites/."""

    title: Annotated[str, Field(min_length=1)]
    """Title in a few words."""
    about: str = ""
    """Purpose of the suite."""
    families: Annotated[list[str], Field(min_length=1)]
    """Shipped names, or paths of YAML files, from this file's folder."""
    entrants: Annotated[list[str | EntrantConfig], Field(min_length=1)]
    """Shipped names, `my_law.py:MyLaw` from this file's folder, or solvers with settings of their own."""
    seeds: Annotated[int, Field(ge=1, le=MAX_SEEDS)] = 10
    """Cases of each family [-]."""
    first_seed: Annotated[int, Field(ge=0)] = 0
    """Seed of the first one."""


@dataclass(frozen=True)
class Suite:
    """A suite that was read and checked."""

    name: str
    title: str
    families: tuple[Family, ...]
    entrants: tuple[Entrant, ...]
    seeds: range
    absent: tuple[Entrant, ...]
    """Entrants of the file that cannot take part, because their packages are not installed."""

    def prepare(self) -> tuple[Suite, dict[str, str]]:
        """Make the environments of libraries that are absent for want of one.

        Returns:
            The suite with them, and why others are absent, by their names.
        """
        reasons = {entrant.name: entrant.prepare() for entrant in self.absent}
        ready = tuple(entrant for entrant in self.absent if not reasons[entrant.name])
        absent = tuple(entrant for entrant in self.absent if reasons[entrant.name])
        suite = replace(self, entrants=(*self.entrants, *ready), absent=absent)
        return suite, {name: reason for name, reason in reasons.items() if reason}


def load_suite(
    name_or_path: str | Path, solvers: Sequence[str] = (), more: Sequence[str] = (), seeds: int | None = None
) -> Suite:
    """Read a suite.

    Args:
        name_or_path: shipped name or path of a YAML file. Python files that it names are run.
        solvers: these entrants in place of its own; names of its own or shipped ones, or `my_law.py:MyLaw`.
        more: further entrants, as shipped names or `my_law.py:MyLaw`.
        seeds: number of seeds in place of its own.

    Raises:
        ConfigError, UnknownName: naming file, field and remedy.
    """
    path = find_shipped("suite", name_or_path)
    config = read_config(path, SuiteConfig)
    families = []
    for i, family in enumerate(config.families):
        with located(f"{path}: families.{i}"):
            local_path = path.parent / family
            families.append(load_family(local_path if local_path.is_file() else family))
    own: dict[str, Entrant] = {}
    for i, entry in enumerate(config.entrants):
        with located(f"{path}: entrants.{i}"):
            entrant = entry.entrant() if isinstance(entry, EntrantConfig) else _entrant(entry, path.parent)
            _add_entrant(own, entrant)
    absent = tuple(entrant for entrant in own.values() if entrant.missing)
    chosen = {name: entrant for name, entrant in own.items() if not entrant.missing}
    with located("--solvers"):
        if solvers:
            chosen = {}
            for name in solvers:
                _add_entrant(chosen, own[name] if name in own and not own[name].missing else find_any(name))
            absent = ()
    with located("--entrant"):
        for name in more:
            _add_entrant(chosen, find_any(name))
    if not chosen and not any(entrant.library for entrant in absent):
        missing = ", ".join(f"{entrant.name} needs {', '.join(entrant.missing)}" for entrant in absent)
        raise ConfigError(f"{path}: entrants: none can take part: {missing}")
    names = [family.name for family in families]
    if duplicates := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(f"{path}: families: {duplicates[0]!r} is there twice; leave one out, or rename its file")
    return Suite(
        name=path.stem,
        title=config.title,
        families=tuple(families),
        entrants=tuple(chosen.values()),
        seeds=range(config.first_seed, config.first_seed + _check_seeds(config.seeds if seeds is None else seeds)),
        absent=absent,
    )


def origin(family: Family) -> str:
    """Return a digest of what a family's cases are made of.

    These are its file, what that refers to, and the version that makes the cases.
    """
    generator = (family.config.generator or "").rpartition(":")[0]
    text = (family.path.parent / generator).read_text(encoding="utf-8") if generator else ""
    fields: list[Any] = [version("qpavoid"), family.config.model_dump(mode="json"), family.templates, text]
    return hashlib.sha256(json.dumps(fields, sort_keys=True, default=str).encode()).hexdigest()[:12]


def find_any(name: str) -> Entrant:
    """Return a shipped entrant by name, or a user's own as `my_law.py:MyLaw`.

    Raises:
        ConfigError, UnknownName: there is none.
    """
    return find_entrant(name) if name in ENTRANTS else _entrant(name, Path())


def describe_entrants(entrants: Iterable[Entrant]) -> dict[str, Any]:
    """Return the facts of entrants that a report needs, by their digests."""
    return {e.digest: {"name": e.name, "says": e.description, "settings": dict(e.settings)} for e in entrants}


def _check_seeds(count: int) -> int:
    """Return a number of seeds, or raise ConfigError if it is out of range."""
    if not 1 <= count <= MAX_SEEDS:
        raise ConfigError(f"--seeds {count}: give 1 to {MAX_SEEDS}")
    return count


def _entrant(name: str, folder: Path) -> Entrant:
    """Return an entrant by shipped name, installed or not, or from a file."""
    file, _, inside = name.rpartition(":")
    if name.endswith(".py"):
        raise ConfigError(f"{name}: give FILE.py:NAME, with the class or function in it, as in my_law.py:MyLaw")
    if file.endswith(".py"):
        return entrant_from_file(folder / file, inside)
    return ENTRANTS[name] if name in ENTRANTS else find_entrant(name)


def _add_entrant(chosen: dict[str, Entrant], entrant: Entrant) -> None:
    """Add an entrant under its name, or raise ConfigError if the name is taken."""
    if entrant.name in chosen:
        raise ConfigError(f"{entrant.name!r} is there twice; leave one out, or give it another name")
    chosen[entrant.name] = entrant
