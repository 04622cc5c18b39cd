"""Results as a report wants them: a cell for each case and entrant, none of them dropped without a word."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from qpavoid.arena.scores import COLUMNS, KEY
from qpavoid.arena.statistics import ranks
from qpavoid.problem import Array, IntArray


@dataclass(frozen=True)
class Results:
    """One run of every entrant in every case."""

    entrants: tuple[str, ...]
    settings: tuple[str, ...]
    """Digest of each."""
    versions: tuple[str, ...]
    """Of qpavoid, with which each ran."""
    families: tuple[str, ...]
    columns: dict[str, Any]
    """Column of `scores.Score` -> (n,) its values."""
    cell: IntArray
    """(cases, entrants) row of each; -1 where there is none."""
    family: IntArray
    """(cases,) index of the family."""
    replaced: int
    """Rows of older versions or settings of an entrant, or of older cases, which count for nothing."""
    bounded: int
    """Figures that were not finite, and stand at the worst of all runs."""

    @cached_property
    def common(self) -> Any:
        """(cases,) whether every entrant has run it: what rankings and figures are made of."""
        return (self.cell >= 0).all(axis=1)

    def values(self, column: str, entrant: int, family: int | None = None) -> Array:
        """(n,) of one entrant in the cases that all have run, of one family or of all."""
        return np.asarray(self.columns[column][self._common_rows[family][:, entrant]])

    def table(self, column: str, family: int | None = None) -> Array:
        """(cases, entrants) of the cases that all have run."""
        return np.asarray(self.columns[column][self._common_rows[family]])

    def missing(self) -> Iterator[tuple[str, str, int]]:
        """(entrant, family, number of cases) that somebody else has run and this entrant has not."""
        for i, entrant in enumerate(self.entrants):
            for j, family in enumerate(self.families):
                count = int(np.sum((self.cell[:, i] < 0) & (self.family == j)))
                if count:
                    yield entrant, family, count

    def rows_of(self, entrant: int) -> IntArray:
        """(n,) all its rows, whoever else has run these cases."""
        rows = self.cell[:, entrant]
        return np.asarray(rows[rows >= 0])

    def row(self, index: int) -> dict[str, Any]:
        """One run, by its column."""
        return {name: values[index] for name, values in self.columns.items()}

    def ranking(self, family: int | None = None) -> dict[str, int]:
        """Rank by name, best first: by success, then by tracking error (see `statistics.ranks`)."""
        success = self.table("success", family).astype(bool)
        return ranks(success, self.table("tracking_error", family), self.entrants)

    @cached_property
    def _common_rows(self) -> dict[int | None, IntArray]:
        """Family, None for all -> (cases, entrants) rows of the cases that all have run."""
        rows, family = self.cell[self.common], self.family[self.common]
        return {None: rows, **{j: rows[family == j] for j in range(len(self.families))}}


def results_of(runs: pa.Table, order: Sequence[str] = ()) -> Results:
    """Results of a table of runs.

    An entrant is what its last row says that it is: rows under the same name with other settings, or of another version
    of this library, are not mixed with these. Likewise a seed of a family is the case that was run last, so that a
    family that has been changed does not count twice.

    Args:
        runs: columns as in `scores.COLUMNS`, at least one row, in the order in which they were done.
        order: entrants that come first, in this order; the others follow by name.
    """
    given = len(runs)
    runs = _newest(runs, ("entrant",), [name for name in KEY if name != "case"])
    runs = _newest(runs, ("family", "seed"), ("case",))
    columns = {name: runs[name].to_numpy(zero_copy_only=False) for name in runs.column_names}
    bounded = sum(_bound(columns, name) for name, kind in COLUMNS.items() if kind == "float")
    who, names = _coded(runs["entrant"], order)
    case, cases = _coded(runs["case"])
    family, families = _coded(runs["family"])
    cell = np.full((len(cases), len(names)), -1, dtype=np.intp)
    cell[case, who] = np.arange(len(runs))
    family_of = np.empty(len(cases), dtype=np.intp)
    family_of[case] = family
    some = cell.max(axis=0)
    settings, versions = (tuple(columns[name][some].tolist()) for name in ("settings", "version"))
    kept = int(np.sum(cell >= 0))
    return Results(names, settings, versions, families, columns, cell, family_of, given - kept, bounded)


def _newest(runs: pa.Table, of: Sequence[str], what: Sequence[str]) -> pa.Table:
    """The rows in which the columns `what` are as in the last row that has the same columns `of`."""
    place, values = _coded(_joined(runs, of))
    said, _ = _coded(_joined(runs, what))
    last = np.empty(len(values), dtype=np.intp)
    last[place] = np.arange(len(runs))  # of several numpy keeps the last
    return runs.filter(pa.array(said == said[last[place]]))


def _joined(runs: pa.Table, columns: Sequence[str]) -> pa.ChunkedArray:
    """Columns as one of text."""
    return pc.binary_join_element_wise(*(runs[name].cast("string") for name in columns), "\0")


def _coded(column: pa.ChunkedArray, first: Sequence[str] = ()) -> tuple[IntArray, tuple[str, ...]]:
    """(n,) index of each value among the distinct ones, and those: `first` as far as they occur, then by name."""
    coded = pc.dictionary_encode(column).combine_chunks()
    found = coded.dictionary.to_pylist()
    values = (*(name for name in first if name in found), *sorted(set(found).difference(first)))
    place = {value: i for i, value in enumerate(values)}
    return np.array([place[value] for value in found], dtype=np.intp)[coded.indices.to_numpy()], values


def _bound(columns: dict[str, Any], name: str) -> int:
    """Puts figures that are not finite at the worst of their column; gives how many these were."""
    values = columns[name]
    if name == "min_distance":  # the one of which less is worse; infinite where there is nothing to touch
        wrong, worst = ~(values > -np.inf), np.min
    else:
        wrong, worst = ~np.isfinite(values), np.max
    if wrong.any():
        columns[name] = np.where(wrong, worst(values[np.isfinite(values)], initial=0.0), values)
    return int(wrong.sum())
