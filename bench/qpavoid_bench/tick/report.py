"""The report on one control step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from qpavoid_bench.tables import describe_machine, number, table, write
from qpavoid_bench.tick.libraries import Ours
from qpavoid_bench.tick.runner import Cell, Results, Row

OURS = "qpavoid"
TARGETS = {"pink": 38.0, "mink": 12.0, "placo": 5.0, "roboplan": 1.5}
"""How many times faster than a peer it is meant to be; than placo, from PLACO_FROM pairs on."""
PLACO_FROM = 80


def write_report(results: Results, folder: Path, name: str) -> str:
    """Write NAME.md and NAME.csv, and return the Markdown."""
    rows = [_record(row, library, cell) for row in results.rows for library, cell in row.cells.items()]
    return write(folder, name, _sections(results), rows)


def _record(row: Row, library: str, cell: Cell) -> dict[str, Any]:
    workload = row.workload
    return {
        "workload": row.name,
        "nv": workload.nv if workload else "",
        "pairs": len(workload.pairs) if workload else "",
        "in_range_mean": number(row.in_range),
        "library": library,
        "samples": sum(map(len, cell.rounds)),
        "p50_us": number(cell.quantile(50)),
        "p99_us": number(cell.quantile(99)),
        "max_us": number(cell.worst),
        "frame_error": f"{cell.frame_error:.2g}",
        "distance_error_m": f"{cell.distance_error:.2g}",
        "box_error_m": f"{cell.box_error:.2g}",
        "tracking_error_m": f"{cell.tracking_error:.2g}",
        "refused": cell.refused,
    }


def _sections(results: Results) -> Iterator[str]:
    with_times = {name for row in results.rows for name, cell in row.cells.items() if cell.rounds}
    timed = [library.name for library in results.libraries if library.name in with_times]
    yield "# One control step"
    yield (
        "From a new configuration to a joint velocity: kinematics, Jacobians, distances, rows, tasks, limits, QP. All "
        f"libraries get the same joints, capsules, obstacles, pairs, configurations and targets. {describe_machine()}; "
        f"up to {results.ticks} steps in each of {results.rounds} rounds in which the libraries take turns (a "
        f"round of one library takes about {results.budget:g} s at most: slow ones make fewer steps); up to 20 steps "
        "before each round are not timed; garbage is collected before a round, and the collector stays on. Medians "
        "and 99th percentiles are those of the round in which they are least, the worst step is that of all rounds. "
        f"Load of the machine before and at the end: {results.load[0]:.1f} and {results.load[1]:.1f}."
    )
    yield "## Median [µs]"
    yield _table(results, timed, lambda cell: number(cell.quantile(50)))
    yield "## 99th percentile / worst step [µs]"
    yield _table(results, timed, lambda cell: f"{number(cell.quantile(99))} / {number(cell.worst)}")
    others = [name for name in timed if name != OURS]
    if OURS in timed and others:
        yield f"## How many times faster {OURS} is (ratio of medians)"
        ratios = ([row.name, *(_ratio(row, name) for name in others)] for row in results.rows)
        yield table(["workload", *others], ratios)
    yield "## Agreement"
    yield (
        "Largest difference to Pinocchio and coal: frames [m, -] (1e-9 allowed) / distances of spheres and capsules "
        "[m] (1e-6) / of pairs with a box, nearer than twice the influence distance [m] (1e-5). The pairs in range "
        "must be the same, but for those within 1e-5 m of the influence distance. qpavoid's velocities must let no "
        "pair in range close faster than its rows allow. A library that disagrees is not timed. Last: median distance "
        "of the frames to their targets after one step [mm], which tells how far each law's avoidance and "
        "regularisation hold it back, not how good it is."
    )
    yield _table(results, timed, _agreement, only_recorded=True)
    same = [each.name for each in results.libraries if isinstance(each, Ours) and each.path and each.name in timed]
    if same and OURS in timed:
        yield f"Largest difference of a velocity from that of this {OURS} [rad/s, m/s]:"
        rows = [[row.name, *(_difference(row, name) for name in same)] for row in results.rows if row.workload]
        yield table(["workload", *same], rows)
    yield "## Libraries"
    yield "\n".join(_libraries(results, timed))


def _difference(row: Row, name: str) -> str:
    ours, theirs = row.cells[OURS].velocities, row.cells[name].velocities
    return "-" if ours is None or theirs is None else f"{np.abs(ours - theirs).max():.0e}"


def _agreement(cell: Cell) -> str:
    errors = " / ".join(f"{error:.0e}" for error in (cell.frame_error, cell.distance_error, cell.box_error))
    return f"{errors} / {1e3 * cell.tracking_error:.3f}"


def _libraries(results: Results, timed: list[str]) -> Iterator[str]:
    for library in results.libraries:
        name = library.name
        if name in timed:
            yield f"- **{name}**: {results.versions[name]}. {library.settings}."
        if name in results.missing:
            yield f"- **{name}** was not run: {results.missing[name]}."
        refusals: dict[str, list[str]] = {}
        for row in results.rows:
            if name in row.cells and row.cells[name].refused:
                refusals.setdefault(row.cells[name].refused, []).append(row.name)
        for reason, on in refusals.items():
            yield f"- **{name}** was not timed on {', '.join(on)}: {reason}."


def _table(results: Results, libraries: list[str], entry: Callable[[Cell], str], only_recorded: bool = False) -> str:
    rows = []
    for row in results.rows:
        if row.workload is None and only_recorded:
            continue
        size = ["", "", ""]
        if row.workload is not None:
            size = [str(row.workload.nv), str(len(row.workload.pairs)), f"{row.in_range:.0f}"]
        cells = [row.cells.get(name, Cell()) for name in libraries]
        rows.append([row.name, *size, *(entry(cell) if cell.rounds else "-" for cell in cells)])
    return table(["workload", "nv", "pairs", "in range", *libraries], rows) if rows else ""


def _ratio(row: Row, peer: str) -> str:
    if peer not in row.cells or OURS not in row.cells:
        return "-"
    ratio = row.cells[peer].quantile(50) / row.cells[OURS].quantile(50)
    pairs = len(row.workload.pairs) if row.workload else 0
    target = None if peer == "placo" and pairs < PLACO_FROM else TARGETS.get(peer)
    missed = f" (missed: {target:g})" if target is not None and ratio < target else ""
    return number(ratio) if np.isnan(ratio) else f"{ratio:.2f}{missed}"
