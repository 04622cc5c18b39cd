"""Results of a sweep: a growing folder of Parquet files that survives a killed writer.

    runs/*.parquet     a row each run, columns as in `scores.Score`
    cases/*.parquet    a row each case that was made: family, seed, where it came from, its digest, itself as JSON
    runs.jsonl, cases.jsonl    journals: rows that are in no Parquet file yet
    failures.jsonl     what the last sweep could not make or run
    suite.json         what the last sweep was, and who ever took part

A row is in its journal, flushed, before anything else begins. A journal becomes a Parquet file when it has grown long,
when a sweep ends and when the next one begins: the file is written beside, renamed, and only then is the journal
removed. A writer that is killed in between leaves rows in both: the file is named after its content, so that it is not
written again, and what is in both is read once.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from qpavoid.errors import ConfigError
from qpavoid_bench.arena.scores import COLUMNS, KEY

FOLD = 5000
"""Rows after which a journal becomes a Parquet file."""
_TYPES = {"str": pa.string(), "int": pa.int64(), "float": pa.float64(), "bool": pa.bool_()}


class Kind(NamedTuple):
    """Schema and key of one of the tables of a folder."""

    name: str
    schema: pa.Schema
    key: tuple[str, ...]
    """Columns that identify a row."""


RUNS = Kind("runs", pa.schema([(name, _TYPES[kind]) for name, kind in COLUMNS.items()]), KEY)
CASES = Kind(
    "cases",
    pa.schema([("seed", pa.int64()), *((name, pa.string()) for name in ("family", "origin", "case", "json"))]),
    ("family", "seed", "origin"),
)
"""Table of cases. `origin` is the digest of the family and the version that made the case, `case` is `Case.key`."""


def read_runs(folder: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Read all runs of a folder, each once, in the order in which they were done.

    A sweep may be going on in the folder.

    Args:
        folder: of results.
        columns: only these; they must hold `scores.KEY`.

    Raises:
        ConfigError: the folder holds no results, or a damaged file.
    """
    return _read(folder, RUNS, columns)


def read_cases(folder: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Read all cases of a folder, each once.

    Columns: family, seed, origin, case, json (see `Case.from_json`).

    Raises:
        ConfigError: as `read_runs`.
    """
    return _read(folder, CASES, columns)


def read_failures(folder: Path) -> list[dict[str, Any]]:
    """Read what the last sweep could not make or run.

    Fields: family, seed, entrant (None: the case could not be made), failure.
    """
    try:
        return list(_rows((folder / "failures.jsonl").read_bytes()))
    except FileNotFoundError:
        return []


def _read(folder: Path, kind: Kind, columns: Sequence[str] | None = None) -> pa.Table:
    if not any((folder / name).exists() for name in (kind.name, f"{kind.name}.jsonl")):
        raise ConfigError(f"{folder}: no results here; give a folder that `qpavoid bench run … --out` wrote")
    journal = _journal_rows(folder / f"{kind.name}.jsonl", kind)  # first: what moves meanwhile is seen twice, not never
    parts = sorted(map(str, (folder / kind.name).glob("*.parquet")))
    selected = None if columns is None else list(columns)
    try:
        table = ds.dataset(parts, schema=kind.schema, format="parquet").to_table(selected) if parts else None
    except (pa.ArrowException, OSError) as error:
        remedy = "move the damaged file away, and its rows are made again by the same sweep"
        raise ConfigError(f"{folder / kind.name}: {error}; {remedy}") from None
    if table is None or len(journal):
        journal = journal if selected is None else journal.select(selected)
        table = journal if table is None else pa.concat_tables([table, journal])
    return _drop_duplicates(table, kind.key)


def _drop_duplicates(table: pa.Table, key: Sequence[str]) -> pa.Table:
    """Keep the first row of each key, in the order of the table."""
    order = pa.array(np.arange(len(table)))
    first = table.select(key).append_column("order", order).group_by(list(key)).aggregate([("order", "min")])
    return table if len(first) == len(table) else table.take(first["order_min"].combine_chunks().sort())


def _journal_rows(path: Path, kind: Kind) -> pa.Table:
    """Read the rows of a journal; a last line without an end is dropped and done once more."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        data = b""
    return pa.Table.from_pylist(list(_rows(data)), schema=kind.schema)


def _rows(data: bytes) -> Iterator[dict[str, Any]]:
    for line in data.split(b"\n")[:-1]:
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict):
            yield row


class Journal:
    """Rows that are not in a Parquet file yet."""

    def __init__(self, folder: Path, kind: Kind) -> None:
        self._parts, self._path, self._kind = folder / kind.name, folder / f"{kind.name}.jsonl", kind
        self._parts.mkdir(exist_ok=True)
        self.fold()

    def append(self, row: Mapping[str, Any]) -> None:
        """Write a row, which survives any end of this process."""
        self._file.write(json.dumps(row).encode() + b"\n")
        self._file.flush()
        self._count += 1
        if self._count >= FOLD:
            self.fold()

    def fold(self) -> None:
        """Turn the journal into a Parquet file, and begin a new one."""
        self.close()
        table = _journal_rows(self._path, self._kind)
        if len(table):
            self._write(table, hashlib.sha256(self._path.read_bytes()).hexdigest()[:16])
        self._path.unlink(missing_ok=True)
        self._file, self._count = self._path.open("ab"), 0

    def _write(self, table: pa.Table, digest: str) -> None:
        parts = list(self._parts.glob("*.parquet"))
        if any(part.stem.endswith(digest) for part in parts):
            return
        beside = self._parts / f".{digest}.tmp"
        with beside.open("wb") as file:
            pq.write_table(table, file, compression="zstd")
            file.flush()
            os.fsync(file.fileno())
        beside.replace(self._parts / f"{len(parts):06d}-{digest}.parquet")

    def close(self) -> None:
        """Close the journal; its rows stay there."""
        if hasattr(self, "_file"):
            self._file.close()


class Store:
    """The one writer of a folder.

    Rows of earlier sweeps that are still in journals become Parquet at once.
    """

    def __init__(self, folder: Path) -> None:
        """Open a folder, new or not.

        Raises:
            ConfigError: it cannot be written, or something else writes it.
        """
        self.folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = _locked(folder)
            self.runs, self.cases = Journal(folder, RUNS), Journal(folder, CASES)
            self._failures = (folder / "failures.jsonl").open("w", encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"{folder}: {error.strerror or error}; give a folder that can be written") from None

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with self._lock, self._failures:
            for journal in (self.cases, self.runs):
                journal.fold()
                journal.close()

    def fail(self, failure: Mapping[str, Any]) -> None:
        """Record what could not be made or run."""
        self._failures.write(json.dumps(failure) + "\n")
        self._failures.flush()

    def describe(self, facts: Mapping[str, Any]) -> None:
        """Write suite.json: facts of this sweep; `entrants` of earlier sweeps stay in it."""
        path = self.folder / "suite.json"
        try:
            before = json.loads(path.read_text(encoding="utf-8"))["entrants"]
        except (OSError, ValueError, KeyError, TypeError):
            before = {}
        text = json.dumps({**facts, "entrants": {**before, **facts["entrants"]}}, indent=2, default=str)
        beside = path.with_suffix(".tmp")
        beside.write_text(text + "\n", encoding="utf-8")
        beside.replace(path)


def _locked(folder: Path) -> Any:
    """Lock a folder until the lock is closed or this process ends in any way.

    Raises:
        ConfigError: another process holds it.
    """
    file = (folder / "lock").open("a+", encoding="utf-8")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        who = file.read().strip() or "another process"
        file.close()
        raise ConfigError(f"{folder}: {who} writes here; let it end, or give another folder with --out") from None
    file.truncate(0)
    file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
    file.flush()
    return file
