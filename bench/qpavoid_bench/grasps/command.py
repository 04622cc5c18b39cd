"""`qpavoid bench grasps`: the grasps of a public problem set, as the shipped robots see them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from qpavoid.errors import ConfigError
from qpavoid_bench.grasps.clearance import REQUIRED, Clearance, measure
from qpavoid_bench.grasps.plans import Plan, plan
from qpavoid_bench.grasps.problems import FOLDER, Problem, load_problems
from qpavoid_bench.tables import RESULTS, describe_machine, number, table, write

Measured = tuple[Problem, Clearance, Clearance, Plan]
"""A problem, with the clearance of its start and of its goal, and a plan from one to the other."""


def grasps(
    data: Annotated[Path, typer.Option(help="The problem set, or its folder.")] = FOLDER,
    robot: Annotated[
        list[str] | None, typer.Option(metavar="NAME=ROBOT", help="Another robot.yaml for a robot of the set.")
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Every how many problems one is run in closed loop.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = RESULTS,
) -> None:
    """Measure bodies, paths and closed loops at the grasps of MotionBenchMaker: clearances, times, goals reached."""
    from qpavoid_bench.grasps.closed_loop_report import closed_loop_sections, rows_of, run_with_all

    robots = dict(text.partition("=")[::2] for text in robot or ())
    if not all(robots.values()):
        raise ConfigError("--robot: expected NAME=ROBOT, as in panda=my/robot.yaml")
    problems = load_problems(data, robots)
    for problem in problems[:1]:
        plan(problem)  # compiles the planner
    measured = [(problem, *measure(problem), plan(problem)) for problem in problems]
    reached = [(problem, run_with_all(problem)) for problem in problems[::every]]
    sections = (*_sections(measured), *closed_loop_sections(reached))
    print(write(out, "grasps", sections, [row for problem, results in reached for row in rows_of(problem, results)]))


def _sections(measured: Sequence[Measured]) -> Iterator[str]:
    yield "# Grasps of a public problem set"
    yield (
        f"`qpavoid bench grasps`: {len(measured)} problems of MotionBenchMaker (Chamzas et al. 2022), as they are "
        "distributed with VAMP. At their goals a hand is within 3 to 10 mm of objects: bodies have to be tight. "
        f"{describe_machine('qpavoid', 'pin', 'coal')}."
    )
    yield "## Clearance of start and goal"
    yield (
        f"A configuration is clear when all pairs are at least {1e3 * REQUIRED:g} mm apart: the robot's bodies from "
        "obstacles, and from each other; pairs of its own that are nearer by design, as far as their own safety "
        "distance. Fingers are where the shipped robot locks them. `least`: distance of the pair that has least to "
        "spare, in the whole family."
    )
    head = ["family", "problems", "start clear", "least [mm]", "goal clear", "least [mm]", "the nearest at a goal"]
    families = dict.fromkeys(problem.family for problem, *_ in measured)
    rows = [_row(family, [entry for entry in measured if entry[0].family == family]) for family in families]
    yield table(head, [*rows, _row("all", measured)])
    if tight := [f"{problem.name} ({_nearest(goal)})" for problem, _, goal, _ in measured if not goal.is_clear]:
        yield f"Goals that are not clear: {', '.join(tight)}."
    yield "## Paths"
    yield (
        f"`plan_to` from the start to the goal configuration, {1e3 * REQUIRED:g} mm from everything. Times are of the "
        "processor, on one thread, for the plan alone; `of clear`: of the problems with a clear start and goal. "
        "`more`: what the median path keeps beyond that; `by coal`: the least that any of them has, by coal alone."
    )
    head = ["family", "problems", "paths", "of clear", "p50 [ms]", "p90 [ms]", "max [ms]", "more [mm]", "by coal [mm]"]
    paths = [_paths(family, [entry for entry in measured if entry[0].family == family]) for family in families]
    yield table(head, [*paths, _paths("all", measured)])
    without = [
        f"{problem.name} ({path.reason})"
        for problem, start, goal, path in measured
        if start.is_clear and goal.is_clear and not path.is_complete
    ]
    if without:
        yield f"Without a path, though start and goal are clear: {', '.join(without)}."


def _paths(name: str, measured: Sequence[Measured]) -> list[object]:
    plans = [path for *_, path in measured]
    clear = [path for _, start, goal, path in measured if start.is_clear and goal.is_clear]
    times = 1e3 * np.array([path.time for path in clear] or [np.nan])
    clearances = [1e3 * path.clearance for path in plans if path.is_complete]
    return [
        name, len(measured), sum(path.is_complete for path in plans),
        f"{sum(path.is_complete for path in clear)}/{len(clear)}",
        *(number(float(np.quantile(times, fraction))) for fraction in (0.5, 0.9, 1.0)),
        number(float(np.median(clearances)) if clearances else np.nan),
        number(1e3 * min((path.by_coal for path in plans if path.is_complete), default=np.nan)),
    ]  # fmt: skip


def _row(name: str, measured: Sequence[Measured]) -> list[object]:
    cells: list[object] = [name, len(measured)]
    for clearances in ([start for _, start, *_ in measured], [goal for _, _, goal, _ in measured]):
        nearest = min(clearances, key=lambda clearance: (clearance.is_clear, clearance.distance))
        cells += [sum(clearance.is_clear for clearance in clearances), f"{1e3 * nearest.distance:.1f}"]
    return [*cells, " - ".join(nearest.pair)]


def _nearest(clearance: Clearance) -> str:
    return f"{' - '.join(clearance.pair)} {1e3 * clearance.distance:.1f} mm"
