"""Results as a report needs them: a cell for each case and entrant, none dropped silently."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from qpavoid.problem import Array, IntArray
from qpavoid_bench.arena.scores import COLUMNS, KEY
from qpavoid_bench.arena.statistics import ranks


@dataclass(frozen=True)
class Results:
    """One run of every entrant in every case."""

    entrants: tuple[str, ...]
    settings: tuple[str, ...]
    """Digest of each entrant's settings."""
    versions: tuple[str, ...]
    """Version of qpavoid with which each ran."""
    families: tuple[str, ...]
    columns: dict[str, Any]
    """Column of `scores.Score` -> (n,) its values."""
    cell: IntArray
    """(cases, entrants) row of each; -1 where there is none."""
    family: IntArray
    """(cases,) index of the family."""
    replaced: int
    """Rows of older versions or settings of an entrant, or of older cases, which do not count."""
    bounded: int
    """Number of figures that were not finite, and were replaced by the worst of all runs."""

    @cached_property
    def common(self) -> Any:
        """Return for each case (cases,) whether every entrant has run it."""
        return (self.cell >= 0).all(axis=1)

    def values(self, column: str, entrant: int, family: int | None = None) -> Array:
        """Return values (n,) of one entrant in the common cases, of one family or of all."""
        return np.asarray(self.columns[column][self._common_rows[family][:, entrant]])

    def table(self, column: str, family: int | None = None) -> Array:
        """Return values (cases, entrants) of the common cases, of one family or of all."""
        return np.asarray(self.columns[column][self._common_rows[family]])

    def missing(self) -> Iterator[tuple[str, str, int]]:
        """Yield (entrant, family, number of cases) of cases that only other entrants have run."""
        for i, entrant in enumerate(self.entrants):
            for j, family in enumerate(self.families):
                count = int(np.sum((self.cell[:, i] < 0) & (self.family == j)))
                if count:
                    yield entrant, family, count

    def rows_of(self, entrant: int) -> IntArray:
        """Return indices (n,) of all rows of an entrant, in common cases or not."""
        rows = self.cell[:, entrant]
        return np.asarray(rows[rows >= 0])

    def row(self, index: int) -> dict[str, Any]:
        """Return one run, by column."""
        return {name: values[index] for name, values in self.columns.items()}

    def ranking(self, family: int | None = None) -> dict[str, int]:
        """Rank entrants by name, best first: by success, then by tracking error."""
        success = self.table("success", family).astype(bool)
        return ranks(success, self.table("tracking_error", family), self.entrants)

    @cached_property
    def _common_rows(self) -> dict[int | None, IntArray]:
        """Return rows (cases, entrants) of the common cases by family, None for all."""
        rows, family = self.cell[self.common], self.family[self.common]
        return {None: rows, **{j: rows[family == j] for j in range(len(self.families))}}


def results_of(runs: pa.Table, order: Sequence[str] = ()) -> Results:
    """Arrange a table of runs by case and entrant.

    An entrant is as its last row has it: rows under the same name with other settings, or of another version of this
    library, are not mixed with these. The case of a seed of a family is the one that was run last, so that a family
    that has been changed does not count twice.

    Args:
        runs: columns as in `scores.COLUMNS`, at least one row, in the order in which they were done.
        order: entrants that come first, in this order; the others follow by name.
    """
    count_all = len(runs)
    runs = _latest_rows(runs, ("entrant",), [name for name in KEY if name != "case"])
    runs = _latest_rows(runs, ("family", "seed"), ("case",))
    columns = {name: runs[name].to_numpy(zero_copy_only=False) for name in runs.column_names}
    bounded = sum(_replace_non_finite(columns, name) for name, kind in COLUMNS.items() if kind == "float")
    entrant, names = _encode(runs["entrant"], order)
    case, cases = _encode(runs["case"])
    family, families = _encode(runs["family"])
    cell = np.full((len(cases), len(names)), -1, dtype=np.intp)
    cell[case, entrant] = np.arange(len(runs))
    family_of = np.empty(len(cases), dtype=np.intp)
    family_of[case] = family
    last_row = cell.max(axis=0)
    settings, versions = (tuple(columns[name][last_row].tolist()) for name in ("settings", "version"))
    count_kept = int(np.sum(cell >= 0))
    return Results(names, settings, versions, families, columns, cell, family_of, count_all - count_kept, bounded)


def _latest_rows(runs: pa.Table, key: Sequence[str], columns: Sequence[str]) -> pa.Table:
    """Keep rows whose `columns` are as in the last row with the same `key` columns."""
    place, values = _encode(_join_columns(runs, key))
    value, _ = _encode(_join_columns(runs, columns))
    last = np.empty(len(values), dtype=np.intp)
    last[place] = np.arange(len(runs))  # of several numpy keeps the last
    return runs.filter(pa.array(value == value[last[place]]))


def _join_columns(runs: pa.Table, columns: Sequence[str]) -> pa.ChunkedArray:
    """Join columns into one of text."""
    return pc.binary_join_element_wise(*(runs[name].cast("string") for name in columns), "\0")


def _encode(column: pa.ChunkedArray, first: Sequence[str] = ()) -> tuple[IntArray, tuple[str, ...]]:
    """Return the index (n,) of each value among the distinct ones, and these.

    Distinct values are ordered: `first` as far as they occur, then by name.
    """
    coded = pc.dictionary_encode(column).combine_chunks()
    distinct = coded.dictionary.to_pylist()
    values = (*(name for name in first if name in distinct), *sorted(set(distinct).difference(first)))
    place = {value: i for i, value in enumerate(values)}
    return np.array([place[value] for value in distinct], dtype=np.intp)[coded.indices.to_numpy()], values


def _replace_non_finite(columns: dict[str, Any], name: str) -> int:
    """Replace non-finite figures of a column by the worst finite one; return their number."""
    values = columns[name]
    if name == "min_distance":  # the one of which less is worse; infinite where there is nothing to touch
        is_invalid, worst = ~(values > -np.inf), np.min
    else:
        is_invalid, worst = ~np.isfinite(values), np.max
    if is_invalid.any():
        columns[name] = np.where(is_invalid, worst(values[np.isfinite(values)], initial=0.0), values)
    return int(is_invalid.sum())
