"""Summary of a sweep, and consistency checks of its results."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from rich import box
from rich.markup import escape
from rich.table import Table

from qpavoid.config import Fixed
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.suite import Suite

FIGURES = ("entrant", "success", "collided", "min_distance", "tick_p50", "failed", "failure")
"""Columns that the summary needs."""


def summary(runs: pa.Table) -> list[dict[str, Any]]:
    """Summarize runs, a row each entrant, in the order in which they first appear.

    Args:
        runs: rows of `scores.Score`, FIGURES of them at least.

    Returns:
        entrant, runs, success [-], collided [-], min_distance (of all its runs) [m], tick_p50 (median of its runs)
        [µs], failed (runs in which it failed at some tick), failure (what it said in the first of them).
    """
    if not len(runs):
        return []
    marks = pa.table(
        {
            "entrant": runs["entrant"],
            "success": pc.cast(runs["success"], pa.float64()),
            "collided": pc.cast(runs["collided"], pa.float64()),
            "min_distance": runs["min_distance"],
            "tick_p50": runs["tick_p50"],
            "failed": pc.cast(pc.greater(runs["failed"], 0.0), pa.int64()),
        }
    )
    means = [("success", "mean"), ("collided", "mean"), ("min_distance", "min"), ("failed", "sum")]
    table = marks.group_by("entrant", use_threads=False).aggregate(
        [("entrant", "count"), *means, ("tick_p50", "approximate_median")]
    )
    columns = ["entrant", "entrant_count", *(f"{name}_{how}" for name, how in means), "tick_p50_approximate_median"]
    names = ["entrant", "runs", "success", "collided", "min_distance", "failed", "tick_p50"]
    failing_runs = runs.filter(pc.greater(runs["failed"], 0.0)).group_by("entrant", use_threads=False)
    first = {row["entrant"]: row["failure_first"] for row in failing_runs.aggregate([("failure", "first")]).to_pylist()}
    rows: list[dict[str, Any]] = table.select(columns).rename_columns(names).to_pylist()
    return [{**row, "failure": first.get(row["entrant"], "")} for row in rows]


def summary_table(runs: pa.Table, title: str) -> Table:
    """Lay out the summary of runs for a terminal."""
    table = Table(title=escape(title), title_justify="left", title_style="", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("entrant", no_wrap=True)
    for heading in ("runs", "success\n[%]", "collided\n[%]", "min dist\n[mm]", "tick\n[µs]", "failed\n[runs]"):
        table.add_column(escape(heading), justify="right", no_wrap=True)
    for row in summary(runs):
        table.add_row(
            escape(row["entrant"]),
            str(row["runs"]),
            f"{100 * row['success']:.0f}",
            f"{100 * row['collided']:.0f}",
            f"{1e3 * row['min_distance']:.1f}",
            f"{row['tick_p50']:.0f}",
            str(row["failed"] or "-"),
        )
    return table


def find_faults(suite: Suite, runs: pa.Table, cases: pa.Table) -> Iterator[str]:
    """Yield what must hold whatever the solvers are worth, and does not.

    - every entrant has a row for every case, and no figure is NaN;
    - no entrant fails at every tick of a run, nor at any tick in all of its runs;
    - `tracking`, which knows of no obstacles, stays on its path, to 20 mm, and touches something somewhere;
    - `qp` touches nothing where all obstacles rest and are seen as they are.

    Args:
        suite: what was run.
        runs: its rows, and no others.
        cases: its cases (case, json), and no others.
    """
    rows = runs.select(["case", "family", "seed", "entrant", "collided", "failed", "failure"]).to_pylist()
    for entrant in suite.entrants:
        own = [row for row in rows if row["entrant"] == entrant.name]
        if len(own) != len(cases) or len({row["case"] for row in own}) != len(cases):
            yield f"{entrant.name}: {len(own)} rows for {len(cases)} cases"
        if own and all(row["failed"] > 0.0 for row in own):
            yield f"{entrant.name} fails in all of its {len(own)} runs: {own[0]['failure']}"
        for row in own:
            if row["failed"] == 1.0:
                yield f"{entrant.name} fails at every tick of {row['family']}, seed {row['seed']}: {row['failure']}"
    for name, kind in zip(runs.column_names, runs.schema.types, strict=True):
        if pa.types.is_floating(kind) and np.isnan(runs[name].to_numpy()).any():
            yield f"{name}: NaN"
    tracking = runs.filter(pc.equal(runs["entrant"], "tracking"))
    if len(tracking) and not pc.any(tracking["collided"]).as_py():
        yield "tracking touches nothing: the families need no avoidance, or the checker finds no contact"
    if len(tracking) and (worst := pc.max(tracking["deviation"]).as_py()) > _MAX_BASELINE_DEVIATION:
        yield f"tracking is {1e3 * worst:.1f} mm off its path"
    static_cases = {case["case"] for case in cases.to_pylist() if _is_static(Case.from_json(case["json"]))}
    for row in rows:
        if row["entrant"] == "qp" and row["collided"] and row["case"] in static_cases:
            yield f"qp touches something in {row['family']}, seed {row['seed']}, where all obstacles rest"


_MAX_BASELINE_DEVIATION = 0.02
"""Largest deviation of the `tracking` solver, whose damping lets it lag by some millimetres [m]."""


def _is_static(case: Case) -> bool:
    """Return True if all obstacles of a case rest and are measured exactly."""
    return case.sensor.perfect and all(isinstance(obstacle.motion, Fixed) for obstacle in case.scenario.obstacles)
