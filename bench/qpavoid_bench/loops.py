"""`qpavoid bench loops`: whole closed loops with their logs, as `simulate` runs them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from time import thread_time
from typing import Annotated

import numpy as np
import typer

from qpavoid import Controller, ScenarioConfig, load_scenario, simulate
from qpavoid_bench.tables import RESULTS, describe_machine, number, table, write

_SCENARIOS = "situation2,crossing_arms,chasing_sphere,panda_line,moving_sphere"
_ROUNDS = 5


def loops(
    scenarios: Annotated[str, typer.Option(help="Shipped names or paths, separated by commas.")] = _SCENARIOS,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = RESULTS,
) -> None:
    """Time `simulate`, with backup trajectories and without, and building its controller."""
    print(write(out, "loops", _sections([load_scenario(name) for name in scenarios.split(",")])))


def _sections(scenarios: list[ScenarioConfig]) -> Iterator[str]:
    yield "# Closed loops"
    yield (
        f"`simulate`, with its whole log: the least of {_ROUNDS} runs each, in turns. Times are those that the thread "
        "had a core; a tick is without building the controller, which is done once a run."
    )
    yield describe_machine()
    rows = []
    for scenario in scenarios:
        avoidances = [scenario.avoidance.model_copy(update={"backup": backup}) for backup in (True, False)]
        kinds = [scenario.model_copy(update={"avoidance": avoidance}) for avoidance in avoidances]
        for kind in kinds:
            simulate(kind)  # compiled before it is timed
        times = np.array([[_times(kind) for kind in kinds] for _ in range(_ROUNDS)]).min(axis=0)
        ticks = round(scenario.duration / scenario.dt) + 1
        tick, bare = (times[:, 1] - times[:, 0]) / ticks
        figures = 1e6 * tick, 1e6 * bare, 1.0 / tick, 1.0 / bare, 1e3 * times[0, 0]
        rows.append([scenario.source.stem, ticks, *map(number, figures)])
    yield table(
        ["scenario", "ticks", "tick [µs]", "without backup [µs]", "ticks/s", "without backup", "build [ms]"], rows
    )


def _times(scenario: ScenarioConfig) -> tuple[float, float]:
    """Return how long it takes to build a controller, and a whole run [s]."""
    begin = thread_time()
    Controller.from_scenario(scenario)
    middle = thread_time()
    simulate(scenario)
    return middle - begin, thread_time() - middle  # the run builds its own
