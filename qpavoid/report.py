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


_RATIOS = (
    ("min dist\n[mm]", "min_distance", 1e3, ".1f"), ("rms\n[mm]", "tracking_rmse", 1e3, ".0f"),
    ("dev\n[mm]", "max_deviation", 1e3, ".0f"), ("peak q̇\n[rad/s]", "peak_velocity", 1.0, ".2f"),
    ("Σ|Δq̇|\n[rad/s]", "jitter", 1.0, ".0f"),
)  # fmt: skip
"""Heading, name, unit and format of the figures that are set against each other."""


def ratios_table(runs: Sequence[dict[str, Any]], over: str, under: str) -> Table:
    """Figures of one solver over those of another, scenario by scenario, with their ratios; fits 80 columns.

    Args:
        runs: results of `Log.metrics` of all scenarios.
        over: solver whose figures stand above the line.
        under: the other one.
    """
    table = Table(
        title=f"[bold]{escape(over)} / {escape(under)}[/], and ratios (rms: of the distance to the target)",
        title_justify="left", title_style="", box=box.SIMPLE_HEAD, pad_edge=False, padding=0,
    )  # fmt: skip
    table.add_column("scenario", no_wrap=True)
    for heading in (*(heading for heading, *_ in _RATIOS), "in coll\n[s]"):
        table.add_column(escape(heading), justify="right", no_wrap=True)
    table.add_column("arrived", justify="right", no_wrap=True)
    found = {(run["scenario"], run["solver"]): run for run in runs}
    for scenario in dict.fromkeys(run["scenario"] for run in runs):
        if (scenario, over) in found and (scenario, under) in found:
            a, b = found[scenario, over], found[scenario, under]
            cells = [_ratio(a[name], b[name], unit, form) for _, name, unit, form in _RATIOS]
            hit = " / ".join(f"{run['time_in_collision']:.2f}".replace("0.00", "0") for run in (a, b))
            table.add_row(scenario, *cells, hit, " / ".join("yes" if run["arrived"] else "no" for run in (a, b)))
    return table


def _ratio(a: float | None, b: float | None, unit: float, form: str) -> str:
    """`a / b` and their ratio below; one of figures that are not both positive says nothing."""
    if a is None or b is None:
        return "-"
    said = f"{unit * a:{form}} / {unit * b:{form}}"
    return f"{said}\n[bold]{a / b:.2f}[/]" if a > 0.0 and b > 1e-6 else said


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
    if run["time_blocked"] > 0.0:
        said.append(f"[yellow]blocked {run['time_blocked']:.1f} s[/]")
    if not run["completed"]:
        said.append("[red]broken off[/]")
    said.append("[green]arrived[/]" if run["arrived"] else "[yellow]short of goal[/]")
    return ", ".join(said)


_WIDEST = 200
"""Characters of a line of events."""


def events(run: dict[str, Any], most: int = 4) -> list[str]:
    """What the ticks of a run had to say first, a line each: time, status, reasons."""
    lines = [f"{t:.3f} s {status}: {'; '.join(said)}" for t, status, said in run["events"][:most]]
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
