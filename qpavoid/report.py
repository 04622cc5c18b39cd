"""Tables of runs, for terminals and for other programs."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

from rich import box
from rich.markup import escape
from rich.table import Table

_COLUMNS = (
    "min\ndist\n[mm]", "in\ncoll\n[s]", "end\nerr\n[mm]", "dev\n[mm]", "peak q̇\n[rad/s]", "Σ|Δq̇|\n[rad/s]", "tick\n[µs]"
)  # fmt: skip


def metrics_table(runs: Sequence[dict[str, Any]]) -> Table:
    """Runs of one scenario, a row each; fits a terminal of 80 columns.

    Args:
        runs: results of `Log.metrics`.
    """
    table = Table(
        title=f"[bold]{escape(runs[0]['scenario'])}[/] (distances between surfaces)",
        title_justify="left",
        title_style="",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=0,  # columns are a blank apart, which leaves the outcome its room
    )
    table.add_column("solver", no_wrap=True)
    for heading in _COLUMNS:
        table.add_column(escape(heading), justify="right", no_wrap=True)
    table.add_column("outcome")
    for run in runs:
        table.add_row(
            run["solver"],
            "-" if run["min_distance"] is None else f"{1e3 * run['min_distance']:.1f}",
            f"{run['time_in_collision']:.2f}",
            f"{1e3 * run['final_error']:.2f}",
            f"{1e3 * run['max_deviation']:.1f}",
            f"{run['peak_velocity']:.2f}",
            f"{run['jitter']:.1f}",
            f"{run['tick_us']['p50']:.0f}",
            outcome(run),
        )
    return table


def outcome(run: dict[str, Any]) -> str:
    """How a run went, in words."""
    counts = run["status_counts"]
    said = []
    if run["collided"]:
        said.append("[red]collided[/]")
    if counts["STOPPED"]:
        said.append(f"[red]{counts['STOPPED']} stopped[/]")
    if counts["RELAXED"]:
        said.append(f"[yellow]{counts['RELAXED']} relaxed[/]")
    if run["severity_counts"]["ALARM"]:
        said.append(f"[red]{run['severity_counts']['ALARM']} alarms[/]")
    if run["time_stalled"] > 0.0:
        said.append(f"[yellow]stalled {run['time_stalled']:.1f} s[/]")
    if not run["completed"]:
        said.append("[red]broken off[/]")
    said.append("[green]arrived[/]" if run["arrived"] else "[yellow]short of goal[/]")
    return ", ".join(said)


_WIDEST = 200
"""Characters of a line of events."""


def events(run: dict[str, Any], most: int = 4) -> list[str]:
    """List the first events of a run, a line each: time, status, reasons."""
    lines = [
        f"{t:.3f} s {status}: {'; '.join(reason['text'] for reason in reasons)}"
        for t, status, reasons in run["events"][:most]
    ]
    return [line if len(line) <= _WIDEST else f"{line[: _WIDEST - 2]} …" for line in lines]


def failed(run: dict[str, Any]) -> bool:
    """Whether a run ended in a defined failure: a collision, a stop, or before its time."""
    return bool(run["collided"] or run["status_counts"]["STOPPED"] or not run["completed"])


def to_json(document: Any) -> str:
    """Strict JSON: NaN and infinity, which JSON has no word for, become null."""
    return json.dumps(_without_nan(document), indent=2, allow_nan=False)


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
