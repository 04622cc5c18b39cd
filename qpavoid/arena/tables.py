"""Tables of the arena's report: which figures they show, of which runs, with which intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from qpavoid.arena.results import Results
from qpavoid.arena.statistics import mean, ranks, rate
from qpavoid.problem import Array


class Column(NamedTuple):
    """One figure of a table."""

    name: str
    """Of `scores.Score`."""
    heading: str
    """With its unit."""
    scale: float
    """From the score's unit to the table's."""
    digits: int
    kind: str
    """`rate` and `mean` come with an interval; `share` and `median` without."""
    says: str


COLUMNS = (
    Column("success", "success [%]", 100.0, 0, "rate", "no contact, and every goal reached; at rest where none can be"),
    Column("collided", "contact [%]", 100.0, 0, "rate", "runs in which something touched"),
    Column(
        "min_distance", "nearest, worst 5 % [mm]", 1e3, 1, "low", "smallest distance of the run that 95 % are above"
    ),
    Column("below_d1", "below d1 [%]", 100.0, 1, "average", "time with something nearer than d1"),
    Column("tracking_error", "tracking [mm]", 1e3, 0, "mean", "root mean square distance from the moving target"),
    Column(
        "time_to_goal", "time to goal [%]", 100.0, 0, "mean", "share of the duration until it stays there; 100 if never"
    ),
    Column("stuck", "stuck [%]", 100.0, 0, "average", "not arrived, no contact, at rest"),
    Column("jitter", "jitter [rad/s²]", 1.0, 2, "median", "Σ|Δq̇| over joints and ticks, per second"),
    Column("tick_p50", "tick [µs]", 1.0, 0, "median", "median time of a tick, median over runs"),
    Column("tick_p99", "p99 [µs]", 1.0, 0, "median", "99th percentile of a run, median over runs"),
)
MORE = (
    Column("final_error", "final error [mm]", 1e3, 1, "average", "of the worst tool from its goal"),
    Column("deviation", "off the path [mm]", 1e3, 0, "average", "largest distance of a tool from its target's path"),
    Column("path_length", "length [-]", 1.0, 2, "average", "of the tools' paths, over that of their targets"),
    Column("jerk", "jerk [rad/s³]", 1.0, 0, "median", "root mean square over joints and ticks"),
    Column("peak_velocity", "peak q̇ [-]", 1.0, 2, "median", "of the fastest joint, over its limit"),
    Column("violations", "limits passed [%]", 100.0, 2, "average", "ticks beyond a speed, position or acceleration"),
    Column("relaxed", "relaxed [%]", 100.0, 1, "average", "ticks that gave something up and said so"),
    Column("stopped", "stopped [%]", 100.0, 1, "average", "ticks in which the robot was braked or held"),
    Column("failed", "failed [%]", 100.0, 2, "average", "ticks in which the entrant raised or gave no finite velocity"),
)  # fmt: skip


class Cell(NamedTuple):
    """What a table shows, and what it is sorted by."""

    text: str
    sort: float | str


@dataclass(frozen=True)
class Table:
    """Headings and rows."""

    headings: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


@dataclass(frozen=True)
class Section:
    """A part of the report."""

    title: str
    text: tuple[str, ...] = ()
    points: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[tuple[str, str, Any], ...] = ()
    """Name, caption, figure."""


def score_table(results: Results, columns: Sequence[Column], family: int | None = None) -> Table:
    """Entrants in the order of their ranks."""
    place = ranks(results.table("success", family).astype(bool), results.entrants)
    rows = []
    for name, rank in place.items():
        entrant = results.entrants.index(name)
        cells = [_cell(results.values(column.name, entrant, family), column) for column in columns]
        rows.append((Cell(str(rank), rank), text_cell(name), *cells))
    return Table(("rank", "entrant", *(column.heading for column in columns)), tuple(rows))


def _cell(values: Array, column: Column) -> Cell:
    values = column.scale * values.astype(float)

    def shown(value: float) -> str:
        return f"{value:.{column.digits}f}"

    match column.kind:
        case "rate":
            share = rate(round(values.sum() / column.scale), len(values))
            low, high = (shown(column.scale * side) for side in share[1:])
            return Cell(f"{shown(column.scale * share.value)} ({low} – {high})", share.value)
        case "mean":
            middle = mean(values)
            return Cell(f"{shown(middle.value)} ({shown(middle.low)} – {shown(middle.high)})", middle.value)
        case "low":
            value = float(np.quantile(values, 0.05))
        case "median":
            value = float(np.median(values))
        case _:
            value = float(np.mean(values))
    return Cell(shown(value), value)


def text_cell(value: Any) -> Cell:
    """A cell that is sorted by what it shows."""
    return Cell(str(value), str(value))
