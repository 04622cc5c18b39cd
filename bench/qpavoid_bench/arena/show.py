"""One case of a results folder: as a scenario, and run once more."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from qpavoid.errors import ConfigError, UnknownName, nearest
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.entrants import ENTRANTS
from qpavoid_bench.arena.store import read_cases, read_facts
from qpavoid_bench.arena.suite import EntrantConfig, find_any
from qpavoid_bench.arena.trial import run_trial


def find_case(folder: Path, family: str, seed: int) -> Case:
    """Return the case of a family and seed, the last one made where there are several.

    Raises:
        UnknownName: the folder has no such family.
        ConfigError: it has no case of that seed, or no results.
    """
    cases = read_cases(folder)
    in_family = cases[cases["family"] == family]
    if in_family.empty:
        raise UnknownName(f"{folder}: no family {family!r}{nearest(family, cases['family'].unique())}")
    texts = in_family.loc[in_family["seed"] == seed, "json"].to_list()
    if not texts:
        low, high = in_family["seed"].min(), in_family["seed"].max()
        raise ConfigError(f"{folder}: {family} has no seed {seed}; there are {len(in_family)} from {low} to {high}")
    return Case.from_json(texts[-1])


def write_scenario(case: Case, path: Path) -> None:
    """Write a case as a scenario file.

    Relative paths in it start from the folder of the family's file.
    """
    text = yaml.safe_dump(case.scenario.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"--scenario {path}: {error.strerror}; give a file that can be written") from None


def rerun(case: Case, entrant: str, folder: Path) -> dict[str, Any]:
    """Run an entrant in a case once more and return its figures.

    Args:
        case: what is run.
        entrant: a name that ships, `my_law.py:MyLaw`, or the name that a law has in a suite that the folder is of.
        folder: of results.

    Raises:
        ConfigError, UnknownName: there is no such entrant.
    """
    config = _suite_entrant(entrant, folder)
    return run_trial(case, config.entrant() if config else find_any(entrant)).row()


def _suite_entrant(name: str, folder: Path) -> EntrantConfig | None:
    """Return a solver with settings of its own as the last sweep had it; None if there is none."""
    entrants = read_facts(folder)["entrants"].values()
    fields = [entry for entry in entrants if entry["name"] == name and "solver" in entry["settings"]]
    if name in ENTRANTS or not fields:
        return None
    return EntrantConfig(name=name, description=fields[-1]["says"], **fields[-1]["settings"])
