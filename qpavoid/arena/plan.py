"""What a suite wants of a results folder, what of it is there, and what is missing: joins of tables, no loops."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pyarrow as pa

from qpavoid.arena.scores import KEY
from qpavoid.arena.store import CASES, read_cases, read_runs
from qpavoid.arena.suite import Suite, origin


def missing_cases(suite: Suite, folder: Path) -> pa.Table:
    """Cases of a suite that are not made: (family, seed, origin), family by family."""
    wanted = _wanted_cases(suite)
    return wanted.take(_which(wanted, read_cases(folder, CASES.key), CASES.key, "left anti"))


def cases_of(suite: Suite, folder: Path, columns: Sequence[str] = ("case",)) -> pa.Table:
    """Cases of a suite that are made, family by family: their digests, or other columns of `store.CASES`."""
    cases, wanted = read_cases(folder, [*CASES.key, *columns]), _wanted_cases(suite)
    ours = wanted.append_column("order", pa.array(np.arange(len(wanted))))
    there = cases.select(CASES.key).append_column("at", pa.array(np.arange(len(cases))))
    at = ours.join(there, keys=list(CASES.key), join_type="inner").sort_by("order")["at"]
    return cases.select(columns).take(at)


def missing_runs(suite: Suite, folder: Path, cases: pa.Table) -> pa.Table:
    """Runs of a suite that are not done: (case, entrant), case by case.

    Args:
        suite: what is wanted.
        folder: of results.
        cases: of the suite; column `case`.
    """
    wanted = _wanted_runs(suite, cases)
    return wanted.take(_which(wanted, read_runs(folder, KEY), KEY, "left anti")).select(["case", "entrant"])


def complete(suite: Suite, folder: Path) -> bool:
    """Whether everything that a suite wants is there."""
    return not len(missing_cases(suite, folder)) and not len(missing_runs(suite, folder, cases_of(suite, folder)))


def runs_of(suite: Suite, folder: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Runs of a suite that are done: of its cases, its entrants and this version alone.

    Args:
        suite: what is wanted.
        folder: of results.
        columns: of `scores.Score`, beside those of `scores.KEY`; all if left out.
    """
    runs = read_runs(folder, columns and list(dict.fromkeys((*KEY, *columns))))
    return runs.take(_which(runs, _wanted_runs(suite, cases_of(suite, folder)), KEY, "left semi"))


def _wanted_cases(suite: Suite) -> pa.Table:
    count, families = len(suite.seeds), suite.families
    return pa.table(
        {
            "family": pa.array(np.repeat([family.name for family in families], count), type=pa.string()),
            "seed": np.tile(np.arange(suite.seeds.start, suite.seeds.stop), len(families)),
            "origin": pa.array(np.repeat([origin(family) for family in families], count), type=pa.string()),
        }
    )


def _wanted_runs(suite: Suite, cases: pa.Table) -> pa.Table:
    count, entrants = len(cases), suite.entrants
    return pa.table(
        {
            "case": cases["case"].take(pa.array(np.repeat(np.arange(count), len(entrants)))),
            "entrant": pa.array(np.tile([entrant.name for entrant in entrants], count), type=pa.string()),
            "settings": pa.array(np.tile([entrant.digest for entrant in entrants], count), type=pa.string()),
            "version": pa.array(np.repeat(version("qpavoid"), count * len(entrants)), type=pa.string()),
        }
    )


def _which(rows: pa.Table, others: pa.Table, key: Sequence[str], how: str) -> pa.Array:
    """Indices of the rows whose key the others have ("left semi") or have not ("left anti"), in order."""
    keys = rows.select(key).append_column("order", pa.array(np.arange(len(rows))))
    return keys.join(others.select(key), keys=list(key), join_type=how)["order"].combine_chunks().sort()
