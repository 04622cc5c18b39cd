"""Tables of the arena's report, as Markdown."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from qpavoid.problem import Array
from qpavoid_bench.arena.results import Results
from qpavoid_bench.arena.statistics import Interval, mean, median, rate
from qpavoid_bench.tables import table


class Column(NamedTuple):
    """One figure of a table."""

    name: str
    """Name of the figure in `scores.Score`."""
    heading: str
    """Heading with its unit."""
    scale: float
    """Factor from the score's unit to the table's."""
    digits: int
    kind: str
    """`rate`, `mean` and `median` come with an interval; `low`, what 95 % of the runs are above, without."""
    description: str


COLUMNS = (
    Column("success", "success [%]", 100.0, 0, "rate", "no contact, and every goal reached; at rest where none can be"),
    Column("collided", "contact [%]", 100.0, 0, "rate", "runs in which something touched"),
    Column("avoidable", "avoidable contact [%]", 100.0, 0, "rate", "runs with one that the robot could have avoided"),
    Column(
        "min_distance", "nearest, worst 5 % [mm]", 1e3, 1, "low", "smallest distance of the run that 95 % are above"
    ),
    Column("below_d1", "below d1 [%]", 100.0, 1, "mean", "time with something nearer than d1"),
    Column("tracking_error", "tracking [mm]", 1e3, 0, "mean", "root mean square distance from the moving target"),
    Column(
        "time_to_goal", "time to goal [%]", 100.0, 0, "mean", "share of the duration until it stays there; 100 if never"
    ),
    Column("stuck", "stuck [%]", 100.0, 0, "mean", "not arrived, no contact, at rest"),
    Column(
        "frozen", "frozen [%]", 100.0, 1, "mean", "time at rest, away from a target in reach, whatever is in between"
    ),
    Column("lurch", "lurch [rad/s]", 1.0, 2, "mean", "largest Σ|Δq̇| of a tick"),
    Column("chatter", "chatter [rad/s]", 1.0, 4, "mean", "mean Σ|Δq̇| of a tick, in the last half second"),
    Column("jitter", "jitter [rad/s²]", 1.0, 2, "median", "Σ|Δq̇| over joints and ticks, per second"),
    Column("tick_p50", "tick [µs]", 1.0, 0, "median", "median time of a tick, median over runs"),
    Column("tick_p99", "p99 [µs]", 1.0, 0, "median", "99th percentile of a run, median over runs"),
    Column("tick_max", "worst [µs]", 1.0, 0, "median", "longest tick of a run, median over runs"),
)
MORE = (
    Column("final_error", "final error [mm]", 1e3, 1, "mean", "of the worst tool from its goal"),
    Column("deviation", "off the path [mm]", 1e3, 0, "mean", "largest distance of a tool from its target's path"),
    Column("path_length", "length [-]", 1.0, 2, "mean", "of the tools' paths, over that of their targets"),
    Column("jerk", "jerk [rad/s³]", 1.0, 0, "median", "root mean square over joints and ticks"),
    Column("peak_velocity", "peak q̇ [-]", 1.0, 2, "median", "of the fastest joint, over its limit"),
    Column("violations", "limits passed [%]", 100.0, 2, "mean", "ticks beyond a speed, position, acceleration or jerk"),
    Column("relaxed", "relaxed [%]", 100.0, 1, "mean", "ticks that gave something up and said so"),
    Column("stopped", "stopped [%]", 100.0, 1, "mean", "ticks in which the robot was braked or held"),
    Column("failed", "failed [%]", 100.0, 2, "mean", "ticks in which the entrant raised or gave no finite velocity"),
)  # fmt: skip
MOTORS = (
    Column("torque", "torque [%]", 100.0, 0, "mean", "largest commanded one, over its limit"),
    Column("torque_jitter", "torque jitter [Nm/s]", 1.0, 0, "median", "Σ|Δτ| over motors and ticks, per second"),
    Column("slip", "slip [mm]", 1e3, 2, "mean", "largest way of a contact point along the floor"),
    Column("fallen", "fallen [%]", 100.0, 0, "mean", "share of the duration after the robot fell"),
)
"""Figures of robots with motors."""

_ESTIMATES: dict[str, Callable[[Array], Interval]] = {"rate": rate, "mean": mean, "median": median}


def has_motors(results: Results) -> bool:
    """Return True if robots with motors are among the runs."""
    return bool(results.runs["torque"].max() > 0.0)


def groups_of(results: Results) -> tuple[tuple[Column, ...], ...]:
    """Return the groups of figures that the runs have."""
    return (COLUMNS, MORE, MOTORS) if has_motors(results) else (COLUMNS, MORE)


def score_tables(results: Results, family: str | None = None) -> list[str]:
    """Tabulate the main figures, and the further ones, of one family or of all.

    Entrants are in the order of their ranks.
    """
    place = results.ranking(family)
    lines = []
    for group in groups_of(results):
        columns = [column for column in group if not results.runs[column.name].isna().all()]
        tables = [results.table(column.name, family) for column in columns]
        rows = []
        for name, rank in place.items():
            i = results.entrants.index(name)
            rows.append((rank, escape(name), *(_cell(t[:, i], c) for t, c in zip(tables, columns, strict=True))))
        lines += markdown_table(("rank", "entrant", *(column.heading for column in columns)), rows)
    return lines


_HIGHER_IS_BETTER = ("success", "min_distance")
_COMPARED = (
    "success", "collided", "min_distance", "below_d1", "tracking_error", "time_to_goal", "final_error", "frozen",
    "lurch", "chatter", "jitter", "violations", "failed", "tick_p50", "tick_p99", "tick_max",
)  # fmt: skip


def better_than(results: Results, name: str) -> list[str]:
    """Tabulate for each figure the best entrant, and in which families others are ahead of one entrant by how much.

    A family counts where the best of the others is ahead by more than a unit of the last digit.
    """
    own, rows = results.entrants.index(name), []
    columns = [c for c in (*COLUMNS, *MORE) if c.name in _COMPARED and not results.runs[c.name].isna().all()]
    for column in columns:
        sign = -1.0 if column.name in _HIGHER_IS_BETTER else 1.0
        better = []
        for family in results.families:
            values = _summaries(results, column, family)
            best = int(np.argmin(sign * values))
            if sign * (values[own] - values[best]) > 10.0**-column.digits:
                best_text, own_text = (_shown(value, column.digits) for value in (values[best], values[own]))
                better.append(f"{family}: {results.entrants[best]} {best_text}, {own_text} here")
        values = _summaries(results, column, None)
        order = np.argsort(sign * values, kind="stable")
        first = ", ".join(f"{escape(results.entrants[i])} {_shown(values[i], column.digits)}" for i in order[:3])
        rows.append(
            (escape(column.heading), first, _shown(values[own], column.digits), escape("; ".join(better) or "-"))
        )
    return markdown_table(
        ("figure", "best three over all", name, f"families in which others are ahead of {name}"), rows
    )


def _summaries(results: Results, column: Column, family: str | None) -> Array:
    """Return a figure of each entrant (k,) over the common cases, in the table's unit."""
    if column.kind == "low":
        values = np.quantile(results.table(column.name, family), 0.05, axis=0, method="inverted_cdf")
    else:
        values = (np.median if column.kind == "median" else np.mean)(results.table(column.name, family), axis=0)
    return np.asarray(column.scale * values)


def _cell(values: Array, column: Column) -> str:
    if column.kind == "low":
        value = float(np.quantile(values, 0.05, method="inverted_cdf"))  # one of them: some may be infinite
        return _shown(column.scale * value, column.digits)
    return interval_text(_ESTIMATES[column.kind](values), column.scale, column.digits)


def interval_text(interval: Interval, scale: float, digits: int) -> str:
    """Return a figure with its interval."""
    value, low, high = (_shown(scale * side, digits) for side in interval)
    return f"{value} ({low} – {high})"


def _shown(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:.{digits}f}"  # -0.0 + 0.0 is 0.0


def markdown_table(headings: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[str]:
    """Return the lines of a Markdown table, whose cells are Markdown already; none without rows."""
    body = list(rows)
    return [*table(headings, body, text_columns=len(headings)).split("\n"), ""] if body else []


def escape(text: str) -> str:
    """Escape a text so that a cell of a Markdown table shows it as it is."""
    return re.sub(r"([\\`*_<>\[\]|~])", r"\\\1", " ".join(text.split()))


def code(text: str) -> str:
    """Return a cell of a Markdown table that shows a text as code."""
    return f"`{' '.join(text.split()).replace('|', chr(92) + '|')}`"
