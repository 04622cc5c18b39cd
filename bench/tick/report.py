"""The report: Markdown for people, CSV for programs."""

from __future__ import annotations

import csv
import os
import platform
from pathlib import Path
from typing import Any

import numpy as np

from bench.tick.runner import Cell, Results, Row
from qpavoid.run.machine import cpu

OURS = "qpavoid"
TARGETS = {"pink-20": 38.0, "mink": 8.0, "placo": 5.0}
"""How many times faster than a peer it is meant to be."""
PLACO_FROM = 80
"""The target against placo holds from that many pairs on."""


def write(results: Results, folder: Path, name: str) -> str:
    """Writes NAME.md and NAME.csv, and returns the Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    markdown = "\n".join(_sections(results)) + "\n"
    (folder / f"{name}.md").write_text(markdown)
    with (folder / f"{name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(_CSV_FIELDS))
        writer.writeheader()
        for row in results.rows:
            for library, cell in row.cells.items():
                writer.writerow(_csv_row(row, library, cell))
    return markdown


_CSV_FIELDS = (
    "workload", "nv", "pairs", "influence_m", "in_range_mean", "library", "samples", "p50_us", "p99_us", "max_us",
    "p50_free_us", "p50_bound_us", "frame_error", "distance_error_m", "box_error_m", "tracking_error_m", "refused",
)  # fmt: skip


def _csv_row(row: Row, library: str, cell: Cell) -> dict[str, Any]:
    workload = row.workload
    free, bound = _split(row, cell)
    return {
        "workload": workload.name,
        "nv": workload.nv,
        "pairs": len(workload.pairs),
        "influence_m": workload.influence,
        "in_range_mean": round(float(row.in_range.mean()), 1),
        "library": library,
        "samples": len(cell.ns),
        "p50_us": _number(_quantile(cell.us, 50)),
        "p99_us": _number(_quantile(cell.us, 99)),
        "max_us": _number(_quantile(cell.us, 100)),
        "p50_free_us": _number(free),
        "p50_bound_us": _number(bound),
        "frame_error": f"{cell.frame_error:.2g}",
        "distance_error_m": f"{cell.distance_error:.2g}",
        "box_error_m": f"{cell.box_error:.2g}",
        "tracking_error_m": f"{cell.tracking_error:.2g}",
        "refused": cell.refused,
    }


def _sections(results: Results) -> list[str]:
    libraries = [name for name in results.libraries if any(row.cells[name].ns for row in results.rows)]
    return [
        "# One control step",
        "",
        f"From a new configuration to a joint velocity: kinematics, Jacobians, distances, rows, tasks, limits, QP. "
        f"All libraries get the same joints, capsules, obstacles, pairs, configurations and targets. "
        f"{_machine()}; one thread; up to {results.ticks} ticks in each of {results.rounds} rounds in which the "
        f"libraries take turns (a round of one library takes at most about {results.budget:g} s: slow ones make fewer "
        "steps); 20 steps before each round are not timed; garbage is collected before a round, and the collector "
        f"stays on. Load of the machine before and at the end: {results.load[0]:.1f} and {results.load[1]:.1f}.",
        "",
        "## Median [µs]",
        "",
        *_table(results, libraries, lambda row, cell: _number(_quantile(cell.us, 50))),
        "",
        "`bound`: share of the ticks at which an avoidance row or a limit changes qpavoid's velocity; at the others "
        "it needs no QP iterations.",
        "",
        "## 99th percentile [µs]",
        "",
        *_table(results, libraries, lambda row, cell: _number(_quantile(cell.us, 99))),
        "",
        *(_ratios(results, libraries) if OURS in libraries else []),
        "## Growth with the number of pairs",
        "",
        *_growth(results, libraries),
        "",
        "## qpavoid: ticks at which nothing binds, and ticks at which something does (median [µs])",
        "",
        *_free_and_bound(results),
        "",
        "## qpavoid: where the time goes (median of each stage [µs])",
        "",
        "Measured apart from the above, with clocks around its functions, which cost about 0.3 µs each; medians of "
        "parts need not add up to the median of the whole.",
        "",
        *_stages(results),
        "",
        "## Agreement",
        "",
        "Largest difference to Pinocchio and coal: frames [m, -] (1e-9 allowed) / distances of spheres and capsules "
        "[m] (1e-6) / of pairs with a box, nearer than twice the influence distance [m] (1e-5). The pairs in range "
        "must be the same, but for those within 1e-5 m of the influence distance. qpavoid's "
        "velocities must let no pair in range close faster than its rows allow. A library that disagrees is not timed.",
        "",
        *_table(results, libraries, lambda row, c: f"{c.frame_error:.0e} / {c.distance_error:.0e} / {c.box_error:.0e}"),
        "",
        "Median distance of the frames to their targets after one step [mm]. It tells how far each law's avoidance and "
        "regularisation hold it back, not how good it is.",
        "",
        *_table(results, libraries, lambda row, c: f"{1e3 * c.tracking_error:.3f}"),
        "",
        "## Libraries",
        "",
        *[
            f"- **{name}**: {', '.join(f'{k} {v}' for k, v in info['versions'].items())}. {info['settings']}."
            for name, info in results.libraries.items()
            if name in libraries
        ],
        *[f"- **{name}** was not run: {reason}." for name, reason in results.missing.items()],
        *_refusals(results),
    ]


def _refusals(results: Results) -> list[str]:
    """Which library was not timed on what, and why."""
    where: dict[tuple[str, str], list[str]] = {}
    for row in results.rows:
        for name, cell in row.cells.items():
            if cell.refused:
                where.setdefault((name, cell.refused), []).append(row.workload.name)
    return [
        f"- **{name}** was not timed on {'any workload' if len(on) == len(results.rows) else ', '.join(on)}: {reason}."
        for (name, reason), on in where.items()
    ]


def _table(results: Results, libraries: list[str], entry: Any) -> list[str]:
    head = ["workload", "nv", "pairs", "in range", "bound", *libraries]
    lines = [_line(head), _line(["---", *["---:"] * (len(head) - 1)])]
    for row in results.rows:
        cells = [entry(row, row.cells[name]) if row.cells[name].ns else "-" for name in libraries]
        workload = row.workload
        share = "-" if np.isnan(row.bound).any() else f"{100 * row.bound.mean():.0f} %"
        lines.append(
            _line([workload.name, workload.nv, len(workload.pairs), f"{row.in_range.mean():.0f}", share, *cells])
        )
    return lines


def _ratios(results: Results, libraries: list[str]) -> list[str]:
    peers = [name for name in libraries if name != OURS]
    lines = [
        f"## How many times faster {OURS} is (ratio of medians)",
        "",
        _line(["workload", "pairs", *peers]),
        _line(["---", *["---:"] * (len(peers) + 1)]),
    ]
    for row in results.rows:
        mine, pairs = _quantile(row.cells[OURS].us, 50), len(row.workload.pairs)
        entries = []
        for peer in peers:
            ratio = _quantile(row.cells[peer].us, 50) / mine
            target = None if peer == "placo" and pairs < PLACO_FROM else TARGETS.get(peer)
            missed = target is not None and ratio < target
            entries.append("-" if np.isnan(ratio) else f"{ratio:.1f}" + (f" (missed: {target:g})" if missed else ""))
        lines.append(_line([row.workload.name, pairs, *entries]))
    return [*lines, ""]


def _growth(results: Results, libraries: list[str]) -> list[str]:
    by_name = {row.workload.name: row for row in results.rows}
    lines = [_line(["from", "to", "pairs", *libraries]), _line(["---", "---", "---:", *["---:"] * len(libraries)])]
    for influence in ("0.10", "0.30"):
        least = by_name.get(f"panda-0@{influence}")
        if least is None:
            continue
        for count in (5, 50, 500):
            most = by_name.get(f"panda-{count}@{influence}")
            if most is None:
                continue
            ratios = [_quantile(most.cells[n].us, 50) / _quantile(least.cells[n].us, 50) for n in libraries]
            pairs = f"{len(least.workload.pairs)} → {len(most.workload.pairs)}"
            entries = ["-" if np.isnan(r) else f"{r:.1f}" for r in ratios]
            lines.append(_line([least.workload.name, most.workload.name, pairs, *entries]))
    return lines


def _stages(results: Results) -> list[str]:
    own = [(row.workload.name, row.cells[OURS].stages) for row in results.rows if OURS in row.cells]
    stages = list(dict.fromkeys(stage for _, times in own for stage in times))
    lines = [_line(["workload", *stages]), _line(["---", *["---:"] * len(stages)])]
    return lines + [_line([name, *(_number(times.get(s, np.nan)) for s in stages)]) for name, times in own if times]


def _free_and_bound(results: Results) -> list[str]:
    own = [(row, row.cells[OURS]) for row in results.rows if OURS in row.cells]
    parts = [(row.workload.name, *map(_number, _split(row, cell))) for row, cell in own]
    return [_line(["workload", "free", "bound"]), _line(["---", "---:", "---:"]), *map(_line, parts)]


def _split(row: Row, cell: Cell) -> tuple[float, float]:
    """Medians of the ticks at which nothing binds for qpavoid, and of the others [µs]."""
    bound = row.bound[np.array(cell.ticks, dtype=np.intp)]
    return _quantile(cell.us[bound == 0.0], 50), _quantile(cell.us[bound == 1.0], 50)


def _quantile(us: Any, percent: float) -> float:
    return float(np.percentile(us, percent)) if len(us) else float("nan")


def _number(us: float) -> str:
    return "-" if np.isnan(us) else f"{us:.1f}" if us < 100.0 else f"{us:.0f}"


def _line(cells: Any) -> str:
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def _machine() -> str:
    return f"{cpu()}, {os.cpu_count()} CPUs, {platform.system()}, Python {platform.python_version()}"
