"""Summary of a sweep, and consistency checks of its results."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import pandas as pd
from rich import box
from rich.markup import escape
from rich.table import Table

from qpavoid.config import Fixed
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.suite import Suite

_MAX_BASELINE_DEVIATION = 0.02
"""Largest deviation of the `tracking` solver, whose damping lets it lag by some millimetres [m]."""


def summary(runs: pd.DataFrame) -> list[dict[str, Any]]:
    """Summarize runs, a row each entrant, in the order in which they first appear.

    Args:
        runs: rows of `scores.Score`.

    Returns:
        entrant, runs, success [-], collided [-], min_distance (of all its runs) [m], failed (runs in which it failed
        at some step), tick_p50 (median of its runs) [µs], failure (what it said in the first of them).
    """
    rows = []
    for name, own in runs.groupby("entrant", sort=False):
        failing = own[own["failed"] > 0.0]
        rows.append(
            {
                "entrant": name,
                "runs": len(own),
                "success": float(own["success"].mean()),
                "collided": float(own["collided"].mean()),
                "min_distance": float(own["min_distance"].min()),
                "failed": len(failing),
                "tick_p50": float(own["tick_p50"].median()),
                "failure": failing["failure"].iloc[0] if len(failing) else "",
            }
        )
    return rows


def summary_table(rows: Iterable[dict[str, Any]], title: str) -> Table:
    """Lay out the rows of a summary for a terminal."""
    table = Table(title=escape(title), title_justify="left", title_style="", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("entrant", no_wrap=True)
    for heading in ("runs", "success\n[%]", "collided\n[%]", "min dist\n[mm]", "tick\n[µs]", "failed\n[runs]"):
        table.add_column(escape(heading), justify="right", no_wrap=True)
    for row in rows:
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


def find_faults(suite: Suite, runs: pd.DataFrame, cases: list[Case]) -> Iterator[str]:
    """Yield what must hold whatever the solvers are worth, and does not.

    - every entrant has a row for every case, and no figure is NaN;
    - no entrant fails at every step of a run, nor at any step in all of its runs;
    - `tracking`, which knows of no obstacles, stays on its path, to 20 mm, and touches something somewhere;
    - `qp` touches nothing where all obstacles rest and are seen as they are.

    Args:
        suite: what was run.
        runs: its rows, and no others.
        cases: its cases, and no others.
    """
    for entrant in suite.entrants:
        own = runs[runs["entrant"] == entrant.name]
        if len(own) != len(cases) or own["case"].nunique() != len(cases):
            yield f"{entrant.name}: {len(own)} rows for {len(cases)} cases"
        if len(own) and (own["failed"] > 0.0).all():
            yield f"{entrant.name} fails in all of its {len(own)} runs: {own['failure'].iloc[0]}"
        for row in own[own["failed"] == 1.0].itertuples():
            yield f"{entrant.name} fails at every tick of {row.family}, seed {row.seed}: {row.failure}"
    yield from (f"{name}: NaN" for name in runs.columns[runs.isna().any()])
    tracking = runs[runs["entrant"] == "tracking"]
    if len(tracking) and not tracking["collided"].any():
        yield "tracking touches nothing: the families need no avoidance, or the checker finds no contact"
    if len(tracking) and (worst := tracking["deviation"].max()) > _MAX_BASELINE_DEVIATION:
        yield f"tracking is {1e3 * worst:.1f} mm off its path"
    static_cases = {case.key for case in cases if _is_static(case)}
    for row in runs[(runs["entrant"] == "qp") & runs["collided"] & runs["case"].isin(static_cases)].itertuples():
        yield f"qp touches something in {row.family}, seed {row.seed}, where all obstacles rest"


def _is_static(case: Case) -> bool:
    """Return True if all obstacles of a case rest and are measured exactly."""
    return case.sensor.perfect and all(isinstance(obstacle.motion, Fixed) for obstacle in case.scenario.obstacles)
