"""Tables of closed loops at the grasps of a problem set, with and without planning."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from qpavoid_bench.grasps.clearance import REQUIRED
from qpavoid_bench.grasps.closed_loop import DURATION, ENTRANTS, MAX_ANGLE, MAX_DISTANCE, GraspRun, run_grasp
from qpavoid_bench.grasps.problems import Problem
from qpavoid_bench.tables import number, table


def run_with_all(problem: Problem) -> dict[str, GraspRun]:
    """Run a problem with each entrant; return what became of it, by its name."""
    return {entrant.name: run_grasp(problem, entrant) for entrant in ENTRANTS}


def rows_of(problem: Problem, results: Mapping[str, GraspRun]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table for programs."""
    for name, result in results.items():
        yield {"problem": problem.name, "entrant": name, **asdict(result)}


def closed_loop_sections(reached: Sequence[tuple[Problem, Mapping[str, GraspRun]]]) -> Iterator[str]:
    """Yield the sections of a report on problems and what became of them, by entrant."""
    yield "## Closed loop"
    yield (
        f"The pose of each hand at the goal is its target from the start on, d1 = {1e3 * REQUIRED:g} mm. Reached: "
        f"after {DURATION:g} s each hand is within {1e3 * MAX_DISTANCE:g} mm and {np.degrees(MAX_ANGLE):g}° of it. "
        "Contacts are those of MuJoCo, at any time of the run. `least`: the smallest distance of any pair."
    )
    head = ["family", "problems", "entrant", "reached without contact", "contacts", "p50 [s]", "max [s]", "least [mm]"]
    robots = dict.fromkeys(problem.family.partition("/")[0] for problem, _ in reached)
    names = [*dict.fromkeys(problem.family for problem, _ in reached), *(f"{robot}/" for robot in robots)]
    rows = [
        _reached(name.replace("/", ": all") if name.endswith("/") else name, entrant.name, results)
        for name in names
        for entrant in ENTRANTS
        if (results := [by_entrant[entrant.name] for problem, by_entrant in reached if problem.family.startswith(name)])
    ]
    yield table(head, rows)
    missed = [
        f"{problem.name} ({1e3 * result.distance:.0f} mm)"
        for problem, by_entrant in reached
        if not (result := by_entrant[ENTRANTS[-1].name]).is_success
    ]
    if missed:
        yield f"Not reached with planning, or not without contact: {', '.join(missed)}."


def _reached(name: str, entrant: str, results: Sequence[GraspRun]) -> list[object]:
    times = np.array([result.time for result in results if result.is_success] or [np.nan])
    return [
        name, len(results), entrant, sum(result.is_success for result in results),
        sum(not result.is_clear for result in results), number(float(np.median(times))), number(float(times.max())),
        f"{1e3 * min(result.clearance for result in results):.1f}",
    ]  # fmt: skip
