"""Cases and runs that a suite asks of a results folder: present and missing ones.

All of these are joins of tables, without loops.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pyarrow as pa

from qpavoid_bench.arena.scores import KEY
from qpavoid_bench.arena.store import CASES, read_cases, read_runs
from qpavoid_bench.arena.suite import Suite, origin


def missing_cases(suite: Suite, folder: Path) -> pa.Table:
    """Return cases of a suite that are not made: (family, seed, origin), family by family."""
    wanted = _wanted_cases(suite)
    return wanted.take(_join_indices(wanted, read_cases(folder, CASES.key), CASES.key, "left anti"))


def cases_of(suite: Suite, folder: Path, columns: Sequence[str] = ("case",)) -> pa.Table:
    """Return cases of a suite that are made, family by family.

    Columns are their digests, or other columns of `store.CASES`.
    """
    cases, wanted = read_cases(folder, [*CASES.key, *columns]), _wanted_cases(suite)
    wanted_in_order = wanted.append_column("order", pa.array(np.arange(len(wanted))))
    present = cases.select(CASES.key).append_column("at", pa.array(np.arange(len(cases))))
    positions = wanted_in_order.join(present, keys=list(CASES.key), join_type="inner").sort_by("order")["at"]
    return cases.select(columns).take(positions)


def missing_runs(suite: Suite, folder: Path, cases: pa.Table) -> pa.Table:
    """Return runs of a suite that are not done: (case, entrant), case by case.

    Args:
        suite: what is wanted.
        folder: of results.
        cases: of the suite; column `case`.
    """
    wanted = _wanted_runs(suite, cases)
    return wanted.take(_join_indices(wanted, read_runs(folder, KEY), KEY, "left anti")).select(["case", "entrant"])


def is_complete(suite: Suite, folder: Path) -> bool:
    """Return True if all cases and runs of a suite are there."""
    return not len(missing_cases(suite, folder)) and not len(missing_runs(suite, folder, cases_of(suite, folder)))


def runs_of(suite: Suite, folder: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Return runs of a suite that are done: of its cases, its entrants and this version.

    Args:
        suite: what is wanted.
        folder: of results.
        columns: of `scores.Score`, beside those of `scores.KEY`; all if left out.
    """
    runs = read_runs(folder, columns and list(dict.fromkeys((*KEY, *columns))))
    return runs.take(_join_indices(runs, _wanted_runs(suite, cases_of(suite, folder)), KEY, "left semi"))


def _wanted_cases(suite: Suite) -> pa.Table:
    """Return keys of all cases of a suite."""
    count, families = len(suite.seeds), suite.families
    return pa.table(
        {
            "family": pa.array(np.repeat([family.name for family in families], count), type=pa.string()),
            "seed": np.tile(np.arange(suite.seeds.start, suite.seeds.stop), len(families)),
            "origin": pa.array(np.repeat([origin(family) for family in families], count), type=pa.string()),
        }
    )


def _wanted_runs(suite: Suite, cases: pa.Table) -> pa.Table:
    """Return keys of all runs of a suite."""
    count, entrants = len(cases), suite.entrants
    return pa.table(
        {
            "case": cases["case"].take(pa.array(np.repeat(np.arange(count), len(entrants)))),
            "entrant": pa.array(np.tile([entrant.name for entrant in entrants], count), type=pa.string()),
            "settings": pa.array(np.tile([entrant.digest for entrant in entrants], count), type=pa.string()),
            "version": pa.array(np.repeat(version("qpavoid"), count * len(entrants)), type=pa.string()),
        }
    )


def _join_indices(rows: pa.Table, other_rows: pa.Table, key: Sequence[str], how: str) -> pa.Array:
    """Return indices of rows with a key in `other_rows` ("left semi") or not ("left anti")."""
    keys = rows.select(key).append_column("order", pa.array(np.arange(len(rows))))
    return keys.join(other_rows.select(key), keys=list(key), join_type=how)["order"].combine_chunks().sort()
