"""Tables of runs, for terminals and for other programs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from typing import Any

from rich import box
from rich.cells import cell_len
from rich.markup import escape
from rich.table import Table
from rich.text import Text

_COLUMNS: tuple[tuple[str, Callable[[dict[str, Any]], str]], ...] = (
    ("min\ndist\n[mm]", lambda run: "-" if run["min_distance"] is None else f"{1e3 * run['min_distance']:.1f}"),
    ("in\ncoll\n[s]", lambda run: f"{run['time_in_collision']:.2f}"),
    ("end\nerr\n[mm]", lambda run: f"{1e3 * run['final_error']:.2f}"),
    ("dev\n[mm]", lambda run: f"{1e3 * run['max_deviation']:.1f}"),
    ("peak q̇\n[rad/s]", lambda run: f"{run['peak_velocity']:.2f}"),
    ("Σ|Δq̇|\n[rad/s]", lambda run: f"{run['jitter']:.1f}"),
    ("tick\n[µs]", lambda run: f"{run['tick_us']['p50']:.0f}"),
)
"""Heading and cell of each column between solver and outcome, the most important first."""
_OUTCOME_WIDTH = 13
"""Width of the outcome below which columns are left out [characters]: `short of goal` on one line."""


def rows(runs: Sequence[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return the headings of the figures of runs, and their cells, a row for each run; solver first, outcome last."""
    headings = ["solver", *(heading.replace("\n", " ") for heading, _ in _COLUMNS), "outcome"]
    return headings, [[run["solver"], *(cell(run) for _, cell in _COLUMNS), _plain_text(outcome(run))] for run in runs]


def _plain_text(markup: str) -> str:
    return Text.from_markup(markup).plain


def metrics_table(runs: Sequence[dict[str, Any]], width: int = 80) -> Table:
    """Lay out runs of one scenario, a row each; where the terminal is narrow, the last columns are left out.

    Args:
        runs: results of `Log.metrics`.
        width: of the terminal [characters].
    """
    cells = [[cell(run) for _, cell in _COLUMNS] for run in runs]
    width_used, count_shown = 2 + max(cell_len(run["solver"]) for run in (*runs, {"solver": "solver"})), 0
    for (heading, _), *column in zip(_COLUMNS, *cells, strict=True):
        width_used += 1 + max(map(cell_len, (*heading.split("\n"), *column)))
        if width_used + 1 + _OUTCOME_WIDTH > width:
            break
        count_shown += 1
    hidden = len(_COLUMNS) - count_shown
    more = f"; {hidden} more column{'s' * (hidden > 1)} in a wider terminal" if hidden else ""
    title = f"[bold]{escape(runs[0]['scenario'])}[/] (distances between surfaces{more})"
    table = Table(title=title, title_justify="left", title_style="", box=box.SIMPLE_HEAD, pad_edge=False, padding=0)
    table.add_column("solver", no_wrap=True)
    for heading, _ in _COLUMNS[:count_shown]:
        table.add_column(escape(heading), justify="right", no_wrap=True)
    table.add_column("outcome")
    for run, row in zip(runs, cells, strict=True):
        table.add_row(run["solver"], *row[:count_shown], outcome(run))
    return table


def outcome(run: dict[str, Any]) -> str:
    """Say how a run went: how many steps stopped and relaxed, and how many have each severity as their worst."""
    counts, levels = run["status_counts"], run["severity_counts"]
    parts = []
    if run["collided"]:
        parts.append("[red]collided[/]")
    if counts["STOPPED"]:
        parts.append(f"[red]{counts['STOPPED']} stopped[/]")
    if counts["RELAXED"]:
        parts.append(f"[yellow]{counts['RELAXED']} relaxed[/]")
    for level, word, style in (("ALARM", "alarm", "red"), ("WARNING", "warning", "yellow"), ("INFO", "info", "dim")):
        if levels[level]:
            parts.append(f"[{style}]{levels[level]} {word}[/]")
    if run["time_blocked"] > 0.0:
        parts.append(f"[yellow]stalled {run['time_blocked']:.1f} s[/]")
    if not run["completed"]:
        parts.append("[red]broken off[/]")
    parts.append("[green]arrived[/]" if run["arrived"] else "[yellow]short of goal[/]")
    return ", ".join(parts)


_MAX_LINE = 200
"""Characters of a line of events: two to three lines of a terminal."""


def events(run: dict[str, Any], max_events: int = 4) -> list[str]:
    """List the first events of a run, a line each: time, status, reasons."""
    lines = [
        f"{t:.3f} s {status}: {'; '.join(reason['text'] for reason in reasons)}"
        for t, status, reasons in run["events"][:max_events]
    ]
    return [line if len(line) <= _MAX_LINE else f"{line[: _MAX_LINE - 2]} …" for line in lines]


def failed(run: dict[str, Any]) -> bool:
    """Return True if a run collided, stopped or ended before its time."""
    return bool(run["collided"] or run["status_counts"]["STOPPED"] or not run["completed"])


def to_json(document: Any) -> str:
    """Serialize strictly: dataclasses and named tuples as objects, NaN and infinity, unknown to JSON, as null."""
    return json.dumps(_plain(document), indent=2, allow_nan=False)


def _plain(value: Any) -> Any:
    """Return a document of dicts, lists and what JSON knows."""
    if is_dataclass(value):
        value = vars(value)
    elif isinstance(value, tuple) and hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
