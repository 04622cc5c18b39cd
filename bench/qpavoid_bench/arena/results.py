"""Results as a report needs them: a value for each case and entrant, none dropped silently."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd

from qpavoid.problem import Array
from qpavoid_bench.arena.scores import COLUMNS
from qpavoid_bench.arena.statistics import ranks


@dataclass(frozen=True)
class Results:
    """One run of every entrant in every case."""

    runs: pd.DataFrame
    """Runs that count, columns of `scores.Score`."""
    entrants: list[str]
    replaced: int
    """Rows of older versions or settings of an entrant, or of older cases, which do not count."""
    bounded: int
    """Number of figures that were not finite, and were replaced by the worst of all runs."""

    @property
    def families(self) -> list[str]:
        """Return the families of the runs, by name."""
        return sorted(self.runs["family"].unique())

    @property
    def cases(self) -> int:
        """Return the number of cases that any entrant has run."""
        return int(self.runs["case"].nunique())

    @cached_property
    def common(self) -> pd.DataFrame:
        """Return the runs in the cases that every entrant has run."""
        return self.runs[self.runs.groupby("case")["entrant"].transform("nunique") == len(self.entrants)]

    def table(self, column: str, family: str | None = None) -> Array:
        """Return numbers or flags (cases, entrants) of the common cases, of one family or of all."""
        runs = self.common if family is None else self.common[self.common["family"] == family]
        table = runs.pivot(index=["family", "case"], columns="entrant", values=column).reindex(columns=self.entrants)
        return np.asarray(table, dtype=np.float64)

    def missing(self) -> Iterator[tuple[str, str, int]]:
        """Yield (entrant, family, number of cases) of cases that only other entrants have run."""
        total = self.runs.groupby("family")["case"].nunique()
        counts = self.runs.groupby(["entrant", "family"])["case"].nunique()
        for entrant in self.entrants:
            for family in self.families:
                if missing := int(total[family] - counts.get((entrant, family), 0)):
                    yield entrant, family, missing

    def ranking(self, family: str | None = None) -> dict[str, int]:
        """Rank entrants by name, best first: by success, then by tracking error."""
        success = self.table("success", family).astype(bool)
        return ranks(success, self.table("tracking_error", family), self.entrants)


def results_of(runs: pd.DataFrame, order: Sequence[str] = ()) -> Results:
    """Arrange a table of runs by case and entrant.

    An entrant is as its last row has it: rows under the same name with other settings, or of another version of this
    library, are not mixed with these. The case of a seed of a family is the one that was run last, so that a family
    that has been changed does not count twice.

    Args:
        runs: columns as in `scores.COLUMNS`, at least one row, in the order in which they were done.
        order: entrants that come first, in this order; the others follow by name.
    """
    selected = _latest_rows(runs, ["entrant"], ["settings", "version"])
    selected = _latest_rows(selected, ["family", "seed"], ["case"]).copy()
    bounded = sum(_replace_non_finite(selected, name) for name, kind in COLUMNS.items() if kind == "float")
    names = set(selected["entrant"])
    entrants = [name for name in order if name in names] + sorted(names.difference(order))
    return Results(selected, entrants, len(runs) - len(selected), bounded)


def _latest_rows(runs: pd.DataFrame, key: list[str], columns: list[str]) -> pd.DataFrame:
    """Keep rows whose `columns` are as in the last row with the same `key` columns."""
    return runs[(runs[columns] == runs.groupby(key)[columns].transform("last")).all(axis=1)]


def _replace_non_finite(runs: pd.DataFrame, name: str) -> int:
    """Replace non-finite figures of a column by the worst finite one; return their number."""
    values = runs[name].to_numpy()
    if np.isnan(values).all():  # a figure that these runs do not have
        return 0
    if name == "min_distance":  # the one of which less is worse; infinite where there is nothing to touch
        is_invalid, worst = ~(values > -np.inf), np.min
    else:
        is_invalid, worst = ~np.isfinite(values), np.max
    if is_invalid.any():
        runs[name] = np.where(is_invalid, worst(values[np.isfinite(values)], initial=0.0), values)
    return int(is_invalid.sum())
