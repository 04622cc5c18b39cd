"""`qpavoid bench grasps`: the grasps of a public problem set, as the shipped robots see them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from qpavoid.errors import ConfigError
from qpavoid_bench.grasps.clearance import REQUIRED, Clearance, measure
from qpavoid_bench.grasps.problems import FOLDER, Problem, load_problems
from qpavoid_bench.tables import RESULTS, describe_machine, table, write

Measured = tuple[Problem, Clearance, Clearance]
"""A problem, with the clearance of its start and of its goal."""


def grasps(
    data: Annotated[Path, typer.Option(help="The problem set, or its folder.")] = FOLDER,
    robot: Annotated[
        list[str] | None, typer.Option(metavar="NAME=ROBOT", help="Another robot.yaml for a robot of the set.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = RESULTS,
) -> None:
    """Measure how clear the bodies of the shipped robots are at the grasps of MotionBenchMaker."""
    robots = dict(text.partition("=")[::2] for text in robot or ())
    if not all(robots.values()):
        raise ConfigError("--robot: expected NAME=ROBOT, as in panda=my/robot.yaml")
    measured = [(problem, *measure(problem)) for problem in load_problems(data, robots)]
    print(write(out, "grasps", _sections(measured)))


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
    if tight := [f"{problem.name} ({_nearest(goal)})" for problem, _, goal in measured if not goal.is_clear]:
        yield f"Goals that are not clear: {', '.join(tight)}."


def _row(name: str, measured: Sequence[Measured]) -> list[object]:
    cells: list[object] = [name, len(measured)]
    for clearances in ([start for _, start, _ in measured], [goal for *_, goal in measured]):
        nearest = min(clearances, key=lambda clearance: (clearance.is_clear, clearance.distance))
        cells += [sum(clearance.is_clear for clearance in clearances), f"{1e3 * nearest.distance:.1f}"]
    return [*cells, " - ".join(nearest.pair)]


def _nearest(clearance: Clearance) -> str:
    return f"{' - '.join(clearance.pair)} {1e3 * clearance.distance:.1f} mm"
