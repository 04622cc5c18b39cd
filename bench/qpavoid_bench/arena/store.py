"""Results of a sweep: one SQLite file, to which rows are added and from which none is ever removed.

    runs       a row each run, columns as in `scores.Score`
    cases      a row each case that was made: family, seed, where it came from, its digest, itself as JSON
    failures   what the last sweep could not make or run
    facts      what the last sweep was, and who ever took part

A row is committed before anything else begins. The file may be read, and written by another sweep, meanwhile.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pandas as pd

from qpavoid.errors import ConfigError
from qpavoid_bench.arena.scores import COLUMNS, KEY

FILE = "results.sqlite"
"""Name of the file in a folder of results."""
_SQL_TYPES = {"str": "TEXT", "int": "INTEGER", "float": "REAL", "bool": "INTEGER"}
_PANDAS_TYPES = {"str": "object", "int": "int64", "float": "float64", "bool": "bool"}
_CASE_COLUMNS = {"family": "str", "seed": "int", "origin": "str", "case": "str", "json": "str"}
_CASE_KEY = ("family", "seed", "origin")
_FAILURE_COLUMNS = {"family": "str", "seed": "int", "entrant": "str", "failure": "str"}
_WAIT = 60.0
"""Time to wait for another writer [s]."""


class Store:
    """The file of a folder of results."""

    def __init__(self, folder: Path) -> None:
        """Open a folder for writing, new or not.

        Raises:
            ConfigError: it cannot be written, or holds a damaged file.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._database = sqlite3.connect(folder / FILE, timeout=_WAIT, isolation_level=None)
            self._database.execute("PRAGMA journal_mode = WAL")
            for name, columns, key in (
                ("runs", COLUMNS, KEY),
                ("cases", _CASE_COLUMNS, _CASE_KEY),
                ("failures", _FAILURE_COLUMNS, ()),
                ("facts", {"name": "str", "json": "str"}, ("name",)),
            ):
                fields = [f'"{column}" {_SQL_TYPES[kind]}' for column, kind in columns.items()]
                fields += [f"PRIMARY KEY ({_quoted(key)})"] * bool(key)
                self._database.execute(f"CREATE TABLE IF NOT EXISTS {name} ({', '.join(fields)})")
                for column in set(columns) - _columns(self._database, name):
                    self._database.execute(f'ALTER TABLE {name} ADD COLUMN "{column}" {_SQL_TYPES[columns[column]]}')
        except (OSError, sqlite3.Error) as error:
            reason = getattr(error, "strerror", None) or error
            raise ConfigError(
                f"{folder}: {reason}; give a folder that can be written, with no damaged {FILE} in it"
            ) from None

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: Any) -> None:
        self._database.close()

    def add(self, table: str, row: Mapping[str, Any]) -> None:
        """Add a row to `runs` or `cases`, unless its key is there; it survives any end of this process."""
        self._database.execute(
            f"INSERT OR IGNORE INTO {table} ({_quoted(row)}) VALUES ({', '.join('?' * len(row))})", [*row.values()]
        )

    def fail(self, failure: Mapping[str, Any]) -> None:
        """Record what could not be made or run: family, seed, entrant (None: the case could not be made), failure."""
        self.add("failures", failure)

    def drop_failures(self) -> None:
        """Drop what an earlier sweep could not make or run."""
        self._database.execute("DELETE FROM failures")

    def begin(self, facts: Mapping[str, Any]) -> None:
        """Begin a sweep: write its facts, to whose `entrants` those of earlier sweeps are added; drop its failures."""
        earlier = self._database.execute("SELECT json FROM facts WHERE name = 'sweep'").fetchone()
        entrants = {**(json.loads(earlier[0])["entrants"] if earlier else {}), **facts["entrants"]}
        text = json.dumps({**facts, "entrants": entrants}, default=str)
        self.drop_failures()
        self._database.execute("INSERT OR REPLACE INTO facts VALUES ('sweep', ?)", [text])

    def cases(self) -> dict[tuple[str, int, str], tuple[str, str]]:
        """Return digest and JSON text of each case by family, seed and origin."""
        return {row[:3]: row[3:] for row in self._database.execute(f"SELECT {_quoted(_CASE_COLUMNS)} FROM cases")}

    def run_keys(self) -> set[tuple[str, ...]]:
        """Return the keys of all runs, as `scores.KEY` has them."""
        return set(self._database.execute(f"SELECT {_quoted(KEY)} FROM runs"))


def read_runs(folder: Path, columns: Sequence[str] = tuple(COLUMNS)) -> pd.DataFrame:
    """Read all runs of a folder, in the order in which they were done.

    Args:
        folder: of results.
        columns: of `scores.Score`.

    Raises:
        ConfigError: the folder holds no results, or a damaged file.
    """
    table = _read(folder, "runs", columns)
    return table.astype({name: _PANDAS_TYPES[COLUMNS[name]] for name in columns})


def read_cases(folder: Path) -> pd.DataFrame:
    """Read all cases of a folder: family, seed, origin, case, json (see `Case.from_json`).

    Raises:
        ConfigError: as `read_runs`.
    """
    return _read(folder, "cases", tuple(_CASE_COLUMNS))


def read_failures(folder: Path) -> list[dict[str, Any]]:
    """Read what the last sweep could not make or run; `entrant` is None where the case could not be made."""
    return _records(_read(folder, "failures", tuple(_FAILURE_COLUMNS)))


def read_facts(folder: Path) -> dict[str, Any]:
    """Read what the last sweep was: suite, versions, machine; and all entrants by digest."""
    texts = _read(folder, "facts", ("json",))["json"]
    facts: dict[str, Any] = json.loads(texts[0]) if len(texts) else {}
    return facts


def _read(folder: Path, table: str, columns: Iterable[str]) -> pd.DataFrame:
    nothing = ConfigError(f"{folder}: no results here; give a folder that `qpavoid bench run … --out` wrote")
    if not (folder / FILE).is_file():
        raise nothing
    try:
        with closing(sqlite3.connect(folder / FILE, timeout=_WAIT)) as database:
            if not database.execute("SELECT 1 FROM sqlite_master WHERE name = ?", [table]).fetchone():
                raise nothing  # a sweep that begins has just made the file
            known = _columns(database, table)  # older files lack some figures
            chosen = ", ".join(f'"{name}"' if name in known else "NULL" for name in columns)
            cursor = database.execute(f"SELECT {chosen} FROM {table} ORDER BY rowid")
            return pd.DataFrame(cursor.fetchall(), columns=list(columns))
    except sqlite3.Error as error:
        remedy = "move the damaged file away, and its rows are made again by the same sweep"
        raise ConfigError(f"{folder / FILE}: {error}; {remedy}") from None


def _columns(database: sqlite3.Connection, table: str) -> set[str]:
    return {row[1] for row in database.execute(f"PRAGMA table_info({table})")}


def _records(table: pd.DataFrame) -> list[dict[str, Any]]:
    return [{str(name): value for name, value in row.items()} for row in table.to_dict("records")]


def _quoted(columns: Iterable[str]) -> str:
    return ", ".join(f'"{column}"' for column in columns)
