"""Results as a report wants them: a cell for each case and entrant, none of them dropped without a word."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from qpavoid.problem import Array, IntArray


@dataclass(frozen=True)
class Results:
    """The newest run of every entrant in every case."""

    entrants: tuple[str, ...]
    families: tuple[str, ...]
    columns: dict[str, Any]
    """Column of `scores.Score` -> (n,) its values."""
    cell: IntArray
    """(cases, entrants) row of each; -1 where there is none."""
    family: IntArray
    """(cases,) index of the family."""
    replaced: int
    """Rows of older versions or settings that newer ones stand for."""

    @property
    def common(self) -> Any:
        """(cases,) whether every entrant has run it: what rankings and figures are made of."""
        return (self.cell >= 0).all(axis=1)

    def values(self, column: str, entrant: int, family: int | None = None) -> Array:
        """(n,) of one entrant in the cases that all have run, of one family or of all."""
        return np.asarray(self.columns[column][self.cell[self._cases(family), entrant]])

    def table(self, column: str, family: int | None = None) -> Array:
        """(cases, entrants) of the cases that all have run."""
        return np.asarray(self.columns[column][self.cell[self._cases(family)]])

    def missing(self) -> Iterator[tuple[str, str, int]]:
        """(entrant, family, number of cases) that somebody else has run and this entrant has not."""
        for i, entrant in enumerate(self.entrants):
            for j, family in enumerate(self.families):
                count = int(np.sum((self.cell[:, i] < 0) & (self.family == j)))
                if count:
                    yield entrant, family, count

    def row(self, index: int) -> dict[str, Any]:
        """One run, by its column."""
        return {name: values[index] for name, values in self.columns.items()}

    def _cases(self, family: int | None) -> Any:
        return self.common if family is None else self.common & (self.family == family)


def results_of(runs: pa.Table, order: tuple[str, ...] = ()) -> Results:
    """Results of a table of runs.

    Args:
        runs: columns as in `scores.COLUMNS`; of several rows of one case and entrant, the last one counts.
        order: entrants that come first, in this order; the others follow by name.
    """
    columns = {name: runs[name].to_numpy(zero_copy_only=False) for name in runs.column_names}
    names, who = np.unique(columns["entrant"].astype(str), return_inverse=True)
    first = [name for name in order if name in names]
    entrants = (*first, *(name for name in names.tolist() if name not in first))
    who = np.array([entrants.index(name) for name in names.tolist()], dtype=np.intp)[who]
    _, seen, case = np.unique(columns["case"].astype(str), return_index=True, return_inverse=True)
    families, family = np.unique(columns["family"].astype(str)[seen], return_inverse=True)
    cell = np.full((len(seen), len(entrants)), -1, dtype=np.intp)
    cell[case, who] = np.arange(len(runs))  # numpy keeps the last of several
    kept = int(np.sum(cell >= 0))
    return Results(entrants, tuple(families.tolist()), columns, cell, family, len(runs) - kept)
